# SPDX-License-Identifier: GPL-3.0-or-later
"""The properties say what the registry says, keep values exactly, and survive a .blend file."""

import dataclasses

import bpy
import pytest
from adjgi.adjoint_gi.bridge.props import fields, properties, records
from adjgi.adjoint_gi.core.base.errors import SettingsError
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.blender.fakes import Fake, FakeSettings, fake_method, square


@pytest.fixture
def state(registered):
    with fake_method(registered):
        yield bpy.context.scene.adjoint_gi


def test_every_method_has_its_settings_with_the_same_defaults(state):
    assert len(registry.methods()) >= 1
    for m in registry.methods():
        assert properties.settings_of(bpy.context.scene, m.spec.id) == m.Settings()
        group = getattr(state, properties.group_name(m.spec.id))
        for f in dataclasses.fields(m.Settings):
            p = group.bl_rna.properties[f.name]
            assert p.name == f.metadata["label"]
            assert p.description == f.metadata["help"].rstrip(".")


def test_bounds_units_and_numbers(state):
    group = state.settings_fake
    group.steps = -5
    assert group.steps == 1
    group.tiny = 5.0
    assert properties.settings_of(bpy.context.scene, "fake").tiny == 0.1
    p = group.bl_rna.properties
    assert (p["edge"].subtype, p["edge"].unit) == ("DISTANCE", "LENGTH")
    assert p["tiny"].precision >= 6


@pytest.mark.parametrize("value", [1e-4, 0.001, 0.1, 0.0123])
def test_floats_come_back_as_they_were_written(state, value):
    state.settings_fake.tiny = value
    assert properties.settings_of(bpy.context.scene, "fake").tiny == value


def test_assign_and_values_are_inverse(state):
    wanted = FakeSettings(seed=7, steps=9, tiny=0.003, flag=False, mode="fails", note="ü", max_length=3)
    for f in dataclasses.fields(wanted):
        setattr(state.settings_fake, f.name, getattr(wanted, f.name))
    assert properties.settings_of(bpy.context.scene, "fake") == wanted


def test_colours_come_back_as_they_were_written_and_old_names_of_models_stay(state):
    group = state.settings_local_illumination
    group.ambient_color, group.ambient = (0.1, 0.7, 0.0123), 0.3
    found = properties.settings_of(bpy.context.scene, "local_illumination")
    assert found.ambient_color == (0.1, 0.7, 0.0123) and found.ambient == 0.3
    for old in ("bouknight", "phong", "cook"):
        group.model = old
        assert properties.settings_of(bpy.context.scene, "local_illumination").model == old


def test_contradicting_settings_raise(state):
    state.settings_fake.min_length, state.settings_fake.max_length = 5, 2
    with pytest.raises(SettingsError, match="min_length"):
        properties.settings_of(bpy.context.scene, "fake")


def test_quadrants_show_what_fits(state):
    for strategy in registry.Strategy:
        for nature in registry.Nature:
            wanted = [m.spec.id for m in registry.fitting(strategy, nature)]
            prop = state.bl_rna.properties.get(properties.quadrant(strategy, nature))
            assert [i.identifier for i in prop.enum_items] == wanted if wanted else prop is None
            for i in prop.enum_items if prop else ():
                assert i.value == registry.method(i.identifier).spec.number
            state.strategy, state.nature = strategy.value, nature.value
            solver = properties.chosen(bpy.context.scene)
            assert solver.spec.id in wanted if wanted else solver is None


def test_a_new_file_starts_with_path_tracing(state):
    state.property_unset("strategy")
    state.property_unset("nature")
    assert state.method == "path_tracing"
    for name in properties.PREFERRED:
        spec = registry.method(name).spec
        prop = state.bl_rna.properties[properties.quadrant(spec.strategies[0], spec.natures[0])]
        assert prop.default == name


def test_setting_the_method_chooses_its_quadrant(state):
    state.strategy, state.nature = "gathering", "nondeterministic"
    state.method = "fake"
    assert (state.strategy, state.nature, state.method) == ("shooting", "deterministic", "fake")
    assert properties.chosen(bpy.context.scene).spec is Fake.spec


def test_choices_survive_a_file(state, tmp_path):
    state.settings_fake.mode, state.settings_fake.steps, state.target = "fails", 11, "attribute"
    record = state.result
    record.method, record.rays = "fake", str(5 * 10**12)
    path = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.open_mainfile(filepath=path)
    back = bpy.context.scene.adjoint_gi
    assert (back.method, back.settings_fake.mode, back.settings_fake.steps, back.target) == ("fake", "fails", 11, "attribute")
    assert int(back.result.rays) == 5 * 10**12


def test_enum_numbers_do_not_depend_on_the_order():
    items = fields.enum_items((("a", "A", "x."), ("b", "B", "y")))
    turned = fields.enum_items((("b", "B", "y"), ("a", "A", "x.")))
    assert dict((i[0], i[3]) for i in items) == dict((i[0], i[3]) for i in turned)
    assert items[0][2] == "x"


def test_record_keeps_the_numbers_and_clears(state):
    solution = next(Fake().solve(None, type("R", (), {"count": 3, "measure": "irradiance"}), FakeSettings(), None)).solution()
    records.store(state.result, solution, target="texture", quantity="direct", applied=True, files=["a.exr"], notices=solution.warnings)
    r = state.result
    assert (r.method, int(r.rays), r.partial, r.target) == ("fake", 3_000_000_000, True, "texture")
    assert (r.emitted, r.absorbed) == (10.0, 8.0)
    assert r.gap == pytest.approx(0.01)
    assert list(r.mean) == pytest.approx([0.25, 0.5, 0.75])
    assert [n.notice().reason for n in r.notices] == ["is not real"]
    records.clear(r)
    assert (r.method, r.rays, len(r.notices), r.has_balance) == ("", "", 0, False)


def test_the_folder_is_passed_on_as_it_was_typed(state):
    square()
    state.folder = "//out"
    state.target = "texture"
    assert properties.request_of(bpy.context.scene).output == "//out"
    state.target = "attribute"  # it has no field for a folder there
    assert properties.request_of(bpy.context.scene).output == ""


@pytest.mark.filterwarnings("error")
def test_folders_may_be_relative_to_the_file(state):
    bpy.context.scene.adjoint_gi.folder = bpy.context.scene.adjoint_gi_compare.folder = "//out"
