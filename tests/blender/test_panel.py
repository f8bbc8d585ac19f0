# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels draw in each state, recorded by a stand-in for the layout that refuses whatever Blender would refuse."""

import types

import bpy
import pytest
from adjgi.adjoint_gi.bridge import check, jobs, properties, records
from adjgi.adjoint_gi.core import registry
from adjgi.adjoint_gi.core.errors import Notice
from adjgi.panels import draw, text, view3d
from adjgi.tests.blender.fakes import Fake, FakeSettings, fake_method, square

ICONS = set(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())


class Layout:
    """Records what is drawn as (kind, text) and checks names and icons."""

    def __init__(self, drawn=None):
        self.drawn = [] if drawn is None else drawn
        self.enabled = True

    def _inner(self, **_):
        return Layout(self.drawn)

    use_property_split = property(lambda self: None, lambda self, on: None)

    def panel(self, name, default_closed=False):
        return self, self

    def separator(self, factor=1.0):
        pass

    row = column = box = split = _inner

    def _add(self, kind, what, icon="NONE"):
        assert icon in ICONS, icon
        self.drawn.append((kind, what))

    def label(self, text="", icon="NONE"):
        self._add("label", text, icon)

    def prop(self, data, name, text=None, icon="NONE", **_):
        assert name in data.bl_rna.properties, name
        self._add("prop", name, icon)

    def prop_search(self, data, name, where, collection, icon="NONE"):
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
    jobs.forget()


def drawn(function):
    layout = Layout()
    function(layout, bpy.context)
    return layout


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
    assert layout.names("operator") == ["adjoint_gi.bake"]


def test_a_running_job_can_only_be_stopped(state, monkeypatch):
    show(monkeypatch)
    driver = types.SimpleNamespace(fraction=0.256, seconds_left=75.2, text="Sample 3", seconds=12.34, rays=4_560_000)
    job = types.SimpleNamespace(state="running", active=True, bake=types.SimpleNamespace(driver=driver), notices=[], solution=None)
    monkeypatch.setattr(jobs, "_job", job)
    layout = drawn(draw.bake)
    assert layout.names("progress") == ["26 %, 1 min 15 s left"]
    assert layout.names("operator") == ["adjoint_gi.stop"]
    assert "4.56 million" in layout.words
    job.state, job.active = "stopped", False
    layout = drawn(draw.bake)
    assert layout.names("operator") == ["adjoint_gi.bake", "adjoint_gi.resume"]
    assert layout.names("progress") == ["Stopped at 26 %"]
    monkeypatch.setattr(jobs, "_job", None)


def test_result_shows_its_numbers(state):
    assert not view3d.ADJOINTGI_PT_result.poll(bpy.context)
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    records.store(state.result, solution, target="texture", quantity="direct", applied=True, notices=solution.warnings)
    assert view3d.ADJOINTGI_PT_result.poll(bpy.context)
    layout = drawn(draw.result)
    for word in ("3.00 billion", "10 W", "8 W", "1.9 W", "1 %", "Material Fake: is not real", "Partial result"):
        assert word in layout.words
    assert {"adjoint_gi.show_result", "adjoint_gi.restore", "adjoint_gi.clear_results"} == set(layout.names("operator"))


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


def test_the_check_looks_again_only_after_a_change(state, monkeypatch):
    seen = []
    monkeypatch.setattr(check, "preflight", lambda context, request: seen.append(request) or [])
    monkeypatch.setattr(check, "SHARE", 1e9)
    monkeypatch.setattr(check._Cache, "full_time", 0.0)
    square()
    check.refresh()
    assert len(seen) == 1
    bpy.context.view_layer.update()
    check._Cache.dirty = False
    check.refresh()
    assert len(seen) == 1
    state.resolution += 1
    check.refresh()
    assert len(seen) == 2
    bpy.data.objects["Square"].location.x += 1
    bpy.context.view_layer.update()
    check.refresh()
    assert len(seen) == 3


def test_a_slow_check_is_seldom_but_errors_are_seen_at_once(state, monkeypatch):
    monkeypatch.setattr(check, "preflight", lambda context, request: pytest.fail("extracted again too early"))
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
