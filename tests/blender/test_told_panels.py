# SPDX-License-Identifier: GPL-3.0-or-later
"""What all panels draw in every state, and what operators say, line by line; see `tests/approval.py`.

No two numbers are alike: each line can only come from its own value. A mean is that of the channels (1, 2, 3) x a, so 2 a.
"""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import check
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.cli.compare import table
from adjgi.adjoint_gi.bridge.comparison import records as comparisons
from adjgi.adjoint_gi.bridge.comparison.job import COMPARISONS
from adjgi.adjoint_gi.bridge.props import properties, records
from adjgi.adjoint_gi.bridge.results import show as results
from adjgi.adjoint_gi.core.base.errors import Notice
from adjgi.adjoint_gi.core.flux.density import Given
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution
from adjgi.operators import bake as bake_operators
from adjgi.operators import result as result_operators
from adjgi.panels import compare, draw, render, view3d
from adjgi.tests.approval import approve
from adjgi.tests.blender.fakes import square
from adjgi.tests.blender.test_panel import Layout, sidebar
from adjgi.tests.compared import DIM, disagreeing, pictured, too_few

WIDE = 6000  # pixels: no line is broken, whatever the font of this Blender


class Words(Layout):
    """Records each thing that is drawn as one line: what it is, its icon, its words, the value of a property; "(locked)", "(alert)"."""

    alert = False

    def _inner(self, **_):
        inner = Words(self.drawn)
        inner.enabled, inner.alert = self.enabled, self.alert
        return inner

    row = column = box = split = _inner

    def _line(self, kind, words, icon="NONE"):
        marks = (
            ("" if icon in ("NONE", "BLANK1") else f" [{icon}]")
            + ("" if self.enabled else " (locked)")
            + (" (alert)" if self.alert else "")
        )
        self.drawn.append(f"  {kind}{marks} {words}".rstrip())

    def panel(self, name, default_closed=False):
        self._line("panel", "closed" if default_closed else "")
        return self, self

    def label(self, text="", icon="NONE"):
        super().label(text, icon)
        self.drawn = self._taken(("label", text))
        self._line("label", text, icon)

    def prop(self, data, name, text=None, icon="NONE", **more):
        super().prop(data, name, text, icon, **more)
        self.drawn = self._taken(("prop", name))
        item, value = data.bl_rna.properties[name], getattr(data, name)
        if item.type in ("FLOAT", "INT", "BOOLEAN") and getattr(item, "is_array", False):
            value = ", ".join(f"{v:.6g}" for v in value)
        elif item.type == "FLOAT":
            value = f"{value:.6g}"
        self._line("prop", f"{item.name if text is None else text}: {value}" if text != "" else f"{name}: {value}", icon)

    def prop_search(self, data, name, where, collection, text=None, icon="NONE"):
        self._line("search", f"{text or name} in {collection}", icon)

    def operator(self, name, text=None, icon="NONE"):
        super().operator(name, text, icon)
        self.drawn = self._taken(("operator", name))
        self._line("button", text if text is not None else f"{name}", icon)
        return SimpleNamespace()

    def progress(self, factor=0.0, text=""):
        super().progress(factor, text)
        self.drawn = self._taken(("progress", text))
        self._line("bar", f"{factor:.3f} {text}")

    def _taken(self, what):
        """Without what the plain recorder has just added; the list is shared."""
        self.drawn[:] = [d for d in self.drawn if d not in (what, ("locked", what[1]))]
        return self.drawn


@pytest.fixture
def told(registered, monkeypatch):
    """Collects what is drawn and said, below headings."""
    monkeypatch.setattr(check, "cached", lambda scene: ())
    monkeypatch.setattr(check, "under_way", lambda: None)
    yield []
    BAKES.job = COMPARISONS.job = None


def drawn(out, heading, *parts):
    layout = Words()
    for part in parts:
        part(layout, sidebar(WIDE))
    out += ["", f"# {heading}", *layout.drawn]


def test_choices_and_settings_are_told_as_approved(told):
    state = bpy.context.scene.adjoint_gi
    for m in registry.methods():
        state.method = m.spec.id
        drawn(told, f"{m.spec.label}: settings", draw.settings, draw.common_settings)
    state.method = "path_tracing"
    drawn(told, "Path Tracing: choice", *view3d.ADJOINTGI_PT_main.parts)
    for target in ("texture", "attribute", "render"):
        state.target = target
        drawn(told, f"{target}: output", draw.output)
    square()
    state.target = "texture"
    drawn(told, "texture of a mesh: output and texels", draw.output, draw.texels)
    drawn(told, "film", *render.ADJOINTGI_PT_render_film.parts)
    choice = bpy.context.scene.adjoint_gi_compare
    for budget, reference, place in zip(
        ("time", "rays", "error"), ("method", "cycles", "constant"), ("texture", "camera", "texture"), strict=True
    ):
        choice.budget, choice.reference, choice.receivers = budget, reference, place
        drawn(told, f"compare: {budget}, {reference}, {place}", compare.choice)
    approve("settings", told[1:])


def job(**values):
    """A bake or a comparison in some state."""
    driver = SimpleNamespace(fraction=0.256, seconds_left=75.2, text="Sample 3", seconds=12.34, rays=4_560_000)
    state = {"state": "running", "active": True, "driver": driver, "notices": [], "solution": None, "preparing": False, "resumable": False}
    return SimpleNamespace(**(state | {"scene": bpy.context.scene.session_uid} | values))


def notices():
    return [
        Notice("Cube, Cone, Torus, Plane and 3 more", "have no faces", "Add some", "error"),
        Notice("Lamp", "has Max Bounces 0", "Raise it"),
        Notice("", "Nothing is about an object here", "", "warning"),
        Notice("Path Tracing", "takes about 12 MB", "", "info"),
    ]


def test_states_of_a_bake_are_told_as_approved(told, monkeypatch):
    drawn(told, "nothing was asked", draw.bake)
    monkeypatch.setattr(check, "cached", lambda scene: notices())
    drawn(told, "what the check finds", draw.bake)
    monkeypatch.setattr(check, "under_way", lambda: SimpleNamespace(seconds=1.5, fraction=0.375, text="Reading the scene"))
    monkeypatch.setattr(check, "cached", lambda scene: notices()[1:])
    drawn(told, "a check under way, and only warnings", draw.bake)
    monkeypatch.setattr(check, "under_way", lambda: SimpleNamespace(seconds=0.5, fraction=0.375, text="Reading the scene"))
    BAKES.job = job()
    drawn(told, "running", draw.bake)
    BAKES.job.driver.seconds_left, BAKES.job.driver.seconds, BAKES.job.preparing = 7380.0, 0.125, True
    drawn(told, "preparing", draw.bake)
    BAKES.job.driver.seconds_left, BAKES.job.state, BAKES.job.preparing = None, "stopping", False
    drawn(told, "stopping", draw.bake)
    BAKES.job = job(
        state="stopped", active=False, resumable=True, notices=[Notice("Lamp", "has Max Bounces 0", "Raise it"), Notice("Cup", "broke")]
    )
    drawn(told, "stopped; of its notices one is shown already", draw.bake)
    BAKES.job = job(state="failed", active=False, notices=[Notice("Disk", "is full", "Make room", "error")], solution=object())
    drawn(told, "failed with a result", draw.bake)
    BAKES.job = job(state="finished", active=False)
    drawn(told, "finished", draw.bake)
    attic = bpy.data.scenes.new("Attic").session_uid
    BAKES.job = job(scene=attic)
    drawn(told, "running in another scene", draw.bake)
    BAKES.job = job(scene=attic, state="stopped", active=False, resumable=True)
    drawn(told, "stopped in another scene", draw.bake)
    BAKES.job = job(scene=attic, state="failed", active=False, solution=object())
    drawn(told, "waiting in another scene", draw.bake)
    BAKES.job, COMPARISONS.job = None, job()
    drawn(told, "comparing", compare.run)
    COMPARISONS.job = job(state="finished", active=False, notices=notices()[:1])
    drawn(told, "compared, with a notice", compare.run)
    approve("states", told[1:])


def solution(a, method="path_tracing", measure="irradiance", **values):
    """Direct light a (1, 2, 3), half as much indirect, emitted 10 times; a fourth receiver without a sample has 1000 a."""
    whole = np.float32([[a], [a], [a], [1000 * a]]) * np.float32([1, 2, 3])
    return Solution(method, measure, 10 * whole, whole, whole / 2, np.full((4, 3), 0.5, np.float32), np.float32([1, 2, 1, 0]), **values)


def test_results_are_told_as_approved(told):
    record, numbers = bpy.context.scene.adjoint_gi.result, {"rays": 123_456, "seconds": 245.4, "emitted_flux": 50.0, "entering_flux": 44.0}
    balance = EnergyBalance(50.0, 31.0, 12.0, 5.5)  # 1.5 of 50 is lost: 3 %
    given = [Given("Ground", 100, 1.25, 0.2, 0.04), Given("Floor", 400, 31.5, 0.8, 1.0), Given("Wall", 225, 8.0, 0.0625, 0.5)]
    found = solution(0.5, "progressive_radiosity", balance=balance, **numbers)
    records.store(
        record,
        found,
        target="texture",
        quantity="irradiance",
        applied=True,
        files=["/a/one.exr", "/a/two.exr"],
        given=given,
        notices=notices(),
    )
    drawn(told, "lightmaps with a balance: irradiance 1.5 (0.5, 1, 1.5) has the mean 1.5", draw.result)
    records.store(record, solution(0.25, **numbers), target="attribute", quantity="radiosity", applied=True, new_object=True)
    drawn(told, "attributes without one: radiosity 10 * 0.5 + 0.5 * 1.5 * 0.5 = 5.375", draw.result)
    records.store(
        record, solution(0.125, partial=True), target="texture", quantity="direct", applied=False, files=["/a/kept.npz"], given=given[:1]
    )
    drawn(told, "partial, kept as a file, nothing emitted: direct 0.25", draw.result)
    records.store(
        record, solution(2.0, measure="radiance", rays=3_210_000_000, seconds=7384.0), target="render", quantity="irradiance", applied=True
    )
    drawn(told, "a picture: radiance 11.5 * 4 = 46", draw.result)
    seen = solution(0.01, "potential", "potential", rays=7_654_321, seconds=0.5)
    for target in ("texture", "render"):
        records.store(record, seen, target=target, quantity="potential", applied=True, notices=notices()[:2])
        drawn(told, f"potential, {target}: 11.5 * 0.02 = 0.23", draw.result)
    BAKES.job = job(state="finished", active=False, notices=notices()[:1])
    drawn(told, "the same; the bake panel tells one of its notices", draw.result)
    approve("results", told[1:])


def test_comparisons_are_told_as_approved(told):
    record = bpy.context.scene.adjoint_gi_compare.result
    for heading, result in (("four methods", disagreeing()), ("equal error", too_few()), ("a picture, stopped", pictured())):
        comparisons.store(record, result, [DIM], ["/a/page.html", "/a/page.json", "/a/histogram.png"])
        comparisons.store_pictures(record, {"error over time": np.zeros((2, 3, 3), np.float32)})
        drawn(told, heading, compare.result)
        told += ["", f"# {heading}: printed", *table(result)]
    comparisons.clear(record)
    approve("comparisons", told[1:])


def test_what_operators_say_is_as_approved(told, monkeypatch):
    said = SimpleNamespace(report=lambda kind, words: told.append(f"{', '.join(kind)} {words}"), remove=True)
    square()
    context, plain = bpy.context, properties.request_of(bpy.context.scene)
    for count in (0, 1, 2):
        monkeypatch.setattr(results, "show", lambda *_, count=count: count)
        monkeypatch.setattr(results, "restore", lambda *_, count=count: count)
        monkeypatch.setattr(bake_operators.textures, "renew", lambda *_, count=count: (count, notices()[1:2] if count else []))
        monkeypatch.setattr(bake_operators, "request_of", lambda *_: plain)
        monkeypatch.setattr(result_operators, "remove_results", lambda _, count=count: {"image": count, "UV layer": 2 * count, "object": 0})
        result_operators.ADJOINTGI_OT_show_result.execute(said, context)
        result_operators.ADJOINTGI_OT_restore.execute(said, context)
        bake_operators.ADJOINTGI_OT_renew_uvs.execute(said, context)
        result_operators.ADJOINTGI_OT_clear_results.clear(said, context.scene)
    for words in ([], notices()):
        monkeypatch.setattr(check, "now", lambda _, words=words: words)
        monkeypatch.setattr(check, "refresh", lambda: None)
        bake_operators.ADJOINTGI_OT_check.execute(said, context)
    record = context.scene.adjoint_gi.result
    for found in (
        solution(1.0, rays=1_234_567, seconds=12.34, balance=EnergyBalance(50.0, 31.0, 12.0, 5.5)),
        solution(1.0, rays=9, partial=True),
    ):
        records.store(record, found, target="texture", quantity="irradiance", applied=True)
        told.append(bake_operators.ADJOINTGI_OT_bake.summary(None, context.scene))
    told += [bake_operators.ADJOINTGI_OT_resume.refusal(context), bake_operators.ADJOINTGI_OT_write.refusal(context)]
    told += [cls.refusal(context) for cls in (bake_operators.ADJOINTGI_OT_stop, bake_operators.ADJOINTGI_OT_renew_uvs)]
    approve("operators", told)
