# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels draw in each state, recorded by a stand-in for the layout that refuses whatever Blender would refuse."""

import dataclasses
import threading
import time
import types

import bpy
import pytest
from adjgi.adjoint_gi.bridge.baking import check, jobs, preflight
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.host import background
from adjgi.adjoint_gi.bridge.props import properties, records
from adjgi.adjoint_gi.core.base.errors import Notice
from adjgi.adjoint_gi.core.flux.density import Given
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.method.solution import EnergyBalance
from adjgi.panels import compare, draw, text, view3d
from adjgi.tests.blender.fakes import Fake, FakeSettings, fake_method, square
from adjgi.tests.blender.test_jobs import FakeBake

ICONS = set(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())


class Layout:
    """Records what is drawn as (kind, text) and checks names and icons."""

    def __init__(self, drawn=None):
        self.drawn = [] if drawn is None else drawn
        self.enabled = True

    def _inner(self, **_):
        inner = Layout(self.drawn)
        inner.enabled = self.enabled
        return inner

    use_property_split = property(lambda self: None, lambda self, on: None)

    def panel(self, name, default_closed=False):
        return self, self

    def separator(self, factor=1.0):
        pass

    row = column = box = split = _inner

    def _add(self, kind, what, icon="NONE"):
        assert icon in ICONS, icon
        self.drawn.append((kind, what))
        if not self.enabled:
            self.drawn.append(("locked", what))

    def label(self, text="", icon="NONE"):
        self._add("label", text, icon)

    def prop(self, data, name, text=None, icon="NONE", **_):
        assert name in data.bl_rna.properties, name
        self._add("prop", name, icon)

    def prop_search(self, data, name, where, collection, text=None, icon="NONE"):
        assert name in data.bl_rna.properties and collection in where.bl_rna.properties
        self._add("prop", name, icon)

    def operator(self, name, text=None, icon="NONE"):
        group, _, leaf = name.partition(".")
        assert leaf in dir(getattr(bpy.ops, group)), name
        self._add("operator", name, icon)

    def progress(self, factor=0.0, text=""):
        assert 0 <= factor <= 1
        self._add("progress", text)

    def names(self, kind):
        return [what for k, what in self.drawn if k == kind]

    @property
    def words(self):
        return " ".join(self.names("label"))


@pytest.fixture
def state(registered):
    with fake_method(registered):
        yield bpy.context.scene.adjoint_gi
    BAKES.forget()


def drawn(function, context=None):
    layout = Layout()
    function(layout, context or bpy.context)
    return layout


def sidebar(width):
    """The context with a region of this width at a resolution scale of 1; without a window Blender has a scale of 0."""
    system = types.SimpleNamespace(ui_scale=1.0)
    preferences = types.SimpleNamespace(system=system, ui_styles=bpy.context.preferences.ui_styles)
    region = types.SimpleNamespace(width=width)
    return types.SimpleNamespace(scene=bpy.context.scene, object=bpy.context.object, preferences=preferences, region=region)


def show(monkeypatch, *notices):
    monkeypatch.setattr(check, "cached", lambda scene: notices)


def test_strategy_and_nature_come_first(state):
    layout = drawn(draw.choice)
    assert layout.names("prop") == ["strategy", "nature", "method_shooting_deterministic"]


def test_every_method_shows_what_it_is(state):
    for m in registry.methods():
        state.method = m.spec.id
        words = drawn(draw.choice).words
        for part in (m.spec.authors, str(m.spec.year), m.spec.equation, *m.spec.limits):
            assert "".join(part.split()) in "".join(words.split()), (m.spec.id, part)


def test_every_setting_of_the_chosen_method_and_no_other(state):
    for m in registry.methods():
        state.method = m.spec.id
        shown = drawn(draw.settings).names("prop") + drawn(draw.common_settings).names("prop")
        assert sorted(shown) == sorted(m.Settings.__dataclass_fields__)


@pytest.mark.parametrize(
    ("target", "there", "missing"),
    [
        ("texture", {"resolution", "atlas", "uv_layer", "folder", "quantity"}, {"attribute", "domain"}),
        ("attribute", {"attribute", "domain", "new_object", "quantity", "selection_only"}, {"resolution", "uv_layer"}),
        ("render", {"folder"}, {"quantity", "attribute", "resolution", "selection_only"}),
    ],
)
def test_output_shows_what_the_target_uses(state, target, there, missing):
    state.target = target
    props = set(drawn(draw.output).names("prop"))
    assert there <= props
    assert not missing & props


def test_refusal_names_object_reason_and_remedy(state, monkeypatch):
    show(monkeypatch, Notice("Cube", "has no UV layer", "Add one", "error"), Notice("Sun", "is fine", "", "info"))
    layout = drawn(draw.bake)
    assert "Cube: has no UV layer" in layout.words and "Add one" in layout.words
    assert "Sun" not in layout.words
    assert layout.names("operator") == layout.names("locked") == ["adjoint_gi.bake"]
    show(monkeypatch, Notice("Cube", "is unusual", "", "warning"), Notice("Sun", "is fine", "", "info"))
    assert not drawn(draw.bake).names("locked")


def test_what_a_bake_is_asked_for_is_locked_while_it_runs(state, monkeypatch):
    forms = draw.choice, draw.settings, draw.common_settings, draw.output
    for running in (False, True):
        monkeypatch.setattr(type(BAKES), "running", running)
        for form in forms:
            layout = drawn(form)
            props = set(layout.names("prop"))
            assert props and props & set(layout.names("locked")) == (props if running else set())


def fake_job(monkeypatch, scene, **values):
    """The current job, started in `scene`."""
    driver = types.SimpleNamespace(fraction=0.256, seconds_left=75.2, text="Sample 3", seconds=12.34, rays=4_560_000)
    state = {"state": "running", "active": True, "driver": driver, "notices": [], "solution": None, "preparing": False}
    state |= {"scene": scene.session_uid} | values
    state.setdefault("resumable", state["state"] == "stopped")
    job = types.SimpleNamespace(**state)
    monkeypatch.setattr(BAKES, "job", job)
    return job


def test_a_job_of_another_scene_says_so_and_is_continued_there(state, monkeypatch):
    show(monkeypatch)
    other = bpy.data.scenes.new("Attic")
    job = fake_job(monkeypatch, other)
    layout = drawn(draw.bake)
    assert "Baking in scene Attic" in layout.words and layout.names("operator") == ["adjoint_gi.stop"]
    job.state, job.active, job.notices = "stopped", False, [Notice("Cube", "is odd", "", "error")]
    layout = drawn(draw.bake)
    assert layout.words == "Stopped at 26 % in scene Attic"
    assert layout.names("operator") == ["adjoint_gi.bake"] and not layout.names("progress")
    job.state, job.solution = "failed", object()
    layout = drawn(draw.bake)
    assert layout.words == "A result waits to be written in scene Attic" and layout.names("operator") == ["adjoint_gi.bake"]
    # With its scene gone nobody else can say what became of it.
    bpy.data.scenes.remove(other)
    layout = drawn(draw.bake)
    assert "Cube: is odd" in layout.words and "adjoint_gi.write" in layout.names("operator")
    monkeypatch.setattr(BAKES, "job", None)


def test_what_the_check_says_is_not_said_twice(state, monkeypatch):
    said = Notice("/gone", "is a file, not a folder", "Choose another folder", "error")
    show(monkeypatch, said)
    fake_job(monkeypatch, bpy.context.scene, state="finished", active=False, notices=[said, Notice("", "More")], solution=object())
    layout = drawn(draw.bake)
    assert layout.words.count("/gone") == 1 and "More" in layout.words and "adjoint_gi.write" in layout.names("operator")
    monkeypatch.setattr(BAKES, "job", None)


@pytest.mark.parametrize("width", [200, 305, 400])
def test_nothing_is_wider_than_the_sidebar(state, width, monkeypatch):
    """Lines leave room for icon, box and fold; names and values have the room that they are drawn in."""
    context = sidebar(width)
    measure = text._measure(context)
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    records.store(state.result, solution, target="texture", quantity="irradiance", applied=True)
    state.result.method = "progressive_radiosity"
    for m in registry.methods():
        state.method = m.spec.id
        lines = drawn(draw.choice, context).names("label")
        assert "Cannot Do" in lines
        # A panel inside a panel takes a unit more than text alone.
        for line in lines[lines.index("Cannot Do") + 1 :]:
            assert measure(line) <= width - 20 * (2.6 + 1 + 1.2), (m.spec.id, line)
        for line in drawn(draw.settings, context).names("label"):
            assert measure(line) <= width - 20 * 2.6, line
    for line in drawn(draw.result, context).names("label"):
        assert measure(line) <= width - 20 * 2.6, line


def test_names_and_buttons_stand_below_each_other_where_they_would_be_cut():
    words = ["Deterministic", "Nondeterministic"]
    assert [text.fits(sidebar(width), words, 0.5) for width in (200, 305, 400)] == [False, True, True]
    seen = []
    layout = types.SimpleNamespace(row=lambda align: seen.append("row"), column=lambda align: seen.append("column"))
    for width in (200, 305):
        draw._beside(layout, sidebar(width), words)
    assert seen == ["column", "row"]


def test_a_preparation_shows_how_far_it_is_and_leaves_no_bar(state, monkeypatch):
    show(monkeypatch)
    job = fake_job(monkeypatch, bpy.context.scene, preparing=True, resumable=False)
    job.driver.text = "Unwrapping"
    layout = drawn(draw.bake)
    assert layout.names("progress") and "Unwrapping" in layout.words and "rays" not in layout.words
    job.state, job.active = "stopped", False
    layout = drawn(draw.bake)
    assert "Stopped at" not in layout.words and not layout.names("progress")
    job.preparing = False
    assert drawn(draw.bake).names("progress")


def test_a_running_job_can_only_be_stopped(state, monkeypatch):
    show(monkeypatch)
    job = fake_job(monkeypatch, bpy.context.scene)
    layout = drawn(draw.bake)
    assert layout.names("progress") == ["26 %, 1 min 15 s left"]
    assert layout.names("operator") == ["adjoint_gi.stop"]
    assert "4.56 million" in layout.words
    job.state, job.active, job.resumable = "stopped", False, True
    layout = drawn(draw.bake)
    assert layout.names("operator") == ["adjoint_gi.bake", "adjoint_gi.resume"]
    assert layout.names("progress") == ["Stopped at 26 %"]
    monkeypatch.setattr(BAKES, "job", None)


def test_result_shows_its_numbers(state):
    assert not view3d.ADJOINTGI_PT_result.poll(bpy.context)
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    records.store(state.result, solution, target="texture", quantity="direct", applied=True, notices=solution.warnings)
    assert view3d.ADJOINTGI_PT_result.poll(bpy.context)
    layout = drawn(draw.result)
    for word in ("3.00 billion", "10 W", "8 W", "1.9 W", "1 %", "Material Fake: is not real", "Partial result"):
        assert word in layout.words
    assert {"adjoint_gi.show_result", "adjoint_gi.restore", "adjoint_gi.clear_results"} == set(layout.names("operator"))


@pytest.mark.parametrize("known", [True, False])
def test_every_flux_stands_beside_its_name(state, known):
    """Where the light goes is known to some methods only; what is emitted and what enters, to all."""
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    solution = dataclasses.replace(solution, balance=EnergyBalance(10.0, 7.0, 1.5, 1.25) if known else None)
    records.store(state.result, solution, target="texture", quantity="direct", applied=True)
    names = drawn(draw.result).names("label")
    rows = {"Emitted": "10 W", "Entering": "9.5 W"}
    where = {"Absorbed": "7 W", "Escaped": "1.5 W", "Not Yet Shot": "1.25 W", "Balance Gap": "2.5 %"}
    for name, value in (rows | where if known else rows).items():
        assert names[names.index(name) + 1] == value
    assert known or not where.keys() & set(names)


def test_a_comparison_shows_the_numbers_of_every_method(state):
    row = bpy.context.scene.adjoint_gi_compare.result.rows.add()
    row.label, row.state, row.seconds, row.rays, row.error, row.gathered, row.balance = "Some", "finished", 2.5, "1500", 0.125, 2.0, 0.015
    plain = drawn(lambda layout, context: compare.method(layout, context, row, "W"))
    assert plain.names("label")[:2] == ["Some", "12.5 %"]
    assert "2.50 s, 1,500 rays, finished Flux 2 W" in plain.words and "gap" not in plain.words
    row.has_gap, row.shot, row.gap, row.has_balance, row.error = True, 2.5, -0.2, True, -1.0
    full = drawn(lambda layout, context: compare.method(layout, context, row, "W"))
    assert full.names("label")[:2] == ["Some", "-"]
    assert "Flux gathered 2 W, shot 2.5 W, gap -20 %; energy gap 1.5 %" in full.words


def test_a_warning_above_the_button_is_not_repeated_below_the_numbers(state, monkeypatch):
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    plant = Notice("Plant", "differs in renders", "Make both the same", "warning")
    records.store(state.result, solution, target="texture", quantity="direct", applied=True, notices=[plant])
    for found, times in (((), 1), ((plant,), 0)):
        show(monkeypatch, *found)
        assert drawn(draw.result).words.count("Plant: differs in renders") == times


def test_density_is_offered_for_what_can_have_texels(state):
    for name, data in (("Rope", bpy.data.curves.new("Rope", "CURVE")), ("Lamp", bpy.data.lights.new("Lamp", "POINT"))):
        obj = bpy.data.objects.new(name, data)
        bpy.context.scene.collection.objects.link(obj)
        bpy.context.view_layer.objects.active = obj
        assert ("adjoint_gi_density" in drawn(draw.texels).names("prop")) == (name == "Rope")


def test_what_was_given_to_whom_is_listed(state):
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    what = {"target": "texture", "quantity": "direct", "applied": True}
    parts = [Given("Ground", 100, 1.25, 0.2, 0.04), Given("Floor", 400, 31.5, 0.8, 1.0)]
    records.store(state.result, solution, **what, given=parts)
    assert state.result.lightmaps() == [("Floor", 31.5, 0.8), ("Ground", 1.25, 0.2)]
    names = drawn(draw.result).names("label")
    assert names[names.index("Texels per Metre, Share of Image") + 1 :][:4] == ["Floor", "31.5, 80 %", "Ground", "1.25, 20 %"]
    state.result.given = '[["Floor", "many"'
    assert state.result.lightmaps() == [] and "Texels per Metre" not in drawn(draw.result).words
    records.store(state.result, solution, **what, given=[Given("Cube", 9, 3.0, 1.0, 1.0)])
    names = drawn(draw.result).names("label")
    assert names[names.index("Texels per Metre") + 1 :][:2] == ["Cube", "3"]
    records.clear(state.result)
    assert state.result.given == ""


def test_a_kept_result_is_told_once(state, monkeypatch, tmp_path):
    show(monkeypatch)
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    monkeypatch.setattr(jobs, "Bake", FakeBake)
    square()
    state.selection_only, state.settings_fake.steps = True, 3
    job = BAKES.start(bpy.context, properties.request_of(bpy.context.scene))
    bpy.data.objects["Square"].data.clear_geometry()
    while job.active:
        background.tick()
    (file,) = map(str, tmp_path.iterdir())

    def told():
        layout = Layout()
        for part in (draw.bake, draw.result):
            part(layout, bpy.context)
        return "".join(layout.names("label"))

    # Long words are broken over lines.
    assert told().count(file.split("/")[-1]) == 1 and told().count("mesh edited") == 1
    BAKES.forget()
    assert told().count(file.split("/")[-1]) == 1 and told().count("mesh edited") == 1 and "Kept as a file" in told()


def test_a_method_of_a_later_version_does_not_break_the_panel(state):
    state.result.method = "from_the_future"
    assert "from_the_future" in drawn(draw.result).words


def test_uv_layer_is_searched_in_the_active_mesh(state):
    square()
    assert "uv_layer" in drawn(draw.output).names("prop")
    assert properties.chosen(bpy.context.scene).spec.id == "fake"


@pytest.mark.parametrize(
    ("sentence", "width", "lines"),
    [
        ("one two three", 7, ["one two", "three"]),
        ("abcdefghij k", 4, ["abcd", "efgh", "ij k"]),
        ("", 5, [""]),
        ("a\nb", 5, ["a", "b"]),
        ("x", 0, ["x"]),
    ],
)
def test_wrap(sentence, width, lines):
    assert text.wrap(sentence, width, len) == lines


def test_numbers_as_people_read_them():
    assert [text.duration(s) for s in (0.1234, 9.999, 59.96, 245, 7380)] == ["0.12 s", "10.0 s", "1 min 00 s", "4 min 05 s", "2 h 03 min"]
    assert [text.count(n) for n in (950, 12300, 4_560_000, 1_200_000_000)] == ["950", "12,300", "4.56 million", "1.20 billion"]
    assert (text.watts(0.012345), text.percent(0.00123), text.percent(1e-15)) == ("0.01235 W", "0.12 %", "under 0.0001 %")


def finished(found):
    """Stages that end at once with `found`."""
    yield "Looking"
    return found


def refreshed():
    """Look, and go on until nothing is under way."""
    check.refresh()
    end = time.monotonic() + 20.0
    while check.under_way() is not None:
        assert time.monotonic() < end
        check.advance()


def test_the_check_looks_again_only_after_a_change(state, monkeypatch):
    seen = []
    monkeypatch.setattr(check, "preflighting", lambda context, request: seen.append(request) or finished([]))
    monkeypatch.setattr(check, "SHARE", 1e9)
    monkeypatch.setattr(check._Cache, "full_time", 0.0)
    square()
    refreshed()
    assert len(seen) == 1
    bpy.context.view_layer.update()
    check._Cache.dirty = False
    refreshed()
    assert len(seen) == 1
    state.resolution += 1
    refreshed()
    assert len(seen) == 2
    bpy.data.objects["Square"].location.x += 1
    bpy.context.view_layer.update()
    refreshed()
    assert len(seen) == 3


def test_a_slow_check_is_seldom_but_errors_are_seen_at_once(state, monkeypatch):
    monkeypatch.setattr(check, "preflighting", lambda context, request: pytest.fail("extracted again too early"))
    monkeypatch.setattr(check._Cache, "full_time", float("inf"))
    square()
    state.uv_layer = "Nowhere"
    check.refresh()
    assert check._Cache.notices[0].severity == "error" and "Nowhere" in str(check._Cache.notices[0])
    assert check._Cache.dirty
    state.uv_layer = ""
    check.refresh()
    assert not any(n.severity == "error" for n in check._Cache.notices)


def test_the_check_waits_until_nothing_changes_any_more(state, monkeypatch):
    monkeypatch.setattr(check, "refresh", lambda: pytest.fail("looked too early"))
    check._changed()
    assert 0 < check._look() <= check.QUIET + 0.02


def test_nothing_selected_is_said_before_bake(state):
    (notice,) = check.now(bpy.context)
    assert (notice.severity, notice.object) == ("error", "Selected Only")
    assert bpy.ops.adjoint_gi.bake() == {"CANCELLED"}


def test_the_check_extracts_in_slices_and_what_is_computed_in_a_thread(state, monkeypatch):
    """As a bake is prepared; what it finds is what is found at once."""
    monkeypatch.setattr(check._Cache, "full_time", 0.0)
    square()
    threads, real = [], preflight.baked_sides
    monkeypatch.setattr(preflight, "baked_sides", lambda *of: threads.append(threading.current_thread()) or real(*of))
    check.refresh()
    assert check.under_way() is not None and not threads, "nothing of it runs where it is begun"
    while check.under_way() is not None:
        check.advance()
    assert len(threads) == 1 and threads[0] is not threading.main_thread()
    assert check._Cache.notices == check.now(bpy.context) and len(check._Cache.notices) > 0
    assert not check._Cache.dirty


@pytest.mark.parametrize("how", ["stop", "change", "load"])
def test_a_check_under_way_ends(state, monkeypatch, how, tmp_path):
    monkeypatch.setattr(check._Cache, "full_time", 0.0)
    square()
    check.refresh()
    preparation = check.under_way()
    if how == "stop":
        assert bpy.ops.adjoint_gi.stop_check() == {"FINISHED"}
        assert preparation.state == "dropped"
    elif how == "change":
        check.advance()
        bpy.data.objects["Square"].location.x += 1
        bpy.context.view_layer.update()
        while check.under_way() is not None:
            check.advance()
        assert preparation.state in ("failed", "finished")
    else:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        assert check.under_way() is preparation
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert check.under_way() is None and not [t for t in threading.enumerate() if t.name == "adjoint_gi_preparation"]
    if how != "load":
        assert check._Cache.dirty and not any(n.severity == "error" for n in check._Cache.notices)


def test_a_check_under_way_is_shown_with_a_button_that_stops_it(state, monkeypatch):
    class Slow:
        seconds, fraction, text = 3.0, 0.25, "Reading image Big"

    monkeypatch.setattr(check, "under_way", lambda: Slow)
    layout = drawn(draw.bake)
    assert "Checking: Reading image Big" in layout.names("progress") and "adjoint_gi.stop_check" in layout.names("operator")
    Slow.seconds = 0.3
    assert "adjoint_gi.stop_check" not in drawn(draw.bake).names("operator"), "a quick one would flicker"
