# SPDX-License-Identifier: GPL-3.0-or-later
"""Showing the last bake and baking again: nothing that is shown changes a number, and everything is taken back exactly."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import BakeRequest, preflight
from adjgi.adjoint_gi.bridge.baking.check import now
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.baking.preflight import target_objects
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.comparison import records as compare_records
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.bridge.props import properties
from adjgi.adjoint_gi.bridge.results import links as targets
from adjgi.adjoint_gi.bridge.results import preview
from adjgi.adjoint_gi.bridge.results import show as results
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute, place_result_object, remove_result_object, result_object
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.adjoint_gi.core.base.errors import SettingsError
from adjgi.tests.blender.fakes import quick
from adjgi.tests.blender.test_preview import difference, everything

BOXES = ("Short Box", "Tall Box")


@pytest.fixture
def scene(registered):
    """A Cornell box in the window, all of it selected, with walls of few faces."""
    made = demo.build_cornell()
    bpy.context.window.scene = made
    for o in made.objects:
        o.select_set(o.type == "MESH")
    state = quick(made, "path_tracing")
    state.resolution = 8
    yield made
    BAKES.forget()


def bake(**values):
    state = bpy.context.scene.adjoint_gi
    for name, value in values.items():
        setattr(state, name, value)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}, now(bpy.context)
    return {o.name: held(o) for o in bpy.context.scene.objects if o.type == "MESH"}


def held(obj):
    """The values that the last bake has put on `obj`, as texels or colours."""
    record = bpy.context.scene.adjoint_gi.result
    if record.target == "texture":
        image = linked_image(obj, record.quantity)
        return read_pixels(image) if image is not None else None
    name = linked_attribute(obj, record.quantity)
    if name is None:
        return None
    out = np.empty(4 * len(obj.data.attributes[name].data), np.float32)
    obj.data.attributes[name].data.foreach_get("color", out)
    return out


def same(a, b):
    assert a.keys() == b.keys()
    assert any(x is not None for x in a.values())
    assert all(np.array_equal(a[k], b[k]) for k in a)


def said():
    """Notices of the last bake and of the check, except what differs from one bake to the next anyway."""
    record = bpy.context.scene.adjoint_gi.result
    words = {str(n.notice()) for n in record.notices} | {str(n) for n in now(bpy.context)}
    return {w for w in words if "of memory" not in w and "one is made" not in w}


def eyes(layer=None):
    """What is hidden by the eye, and what is selected."""
    layer = layer or bpy.context.view_layer
    return {o.name for o in layer.objects if o.hide_get(view_layer=layer)}, {o.name for o in layer.objects.selected}


def test_a_bake_does_not_see_what_is_shown(scene):
    wall = scene.objects["Left Wall"]
    red = wall.material_slots[0].material
    wall.material_slots[0].link = "OBJECT"
    wall.material_slots[0].material = red
    wall.data.materials[0] = None
    first = bake()
    before, words, mean = everything(), said(), list(scene.adjoint_gi.result.mean)
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    ours = {o.name: o.material_slots[0].material for o in scene.objects if preview.shown(o)}
    assert len(ours) == 7 and all(m.get(preview.OURS) for m in ours.values())
    same(first, bake())
    assert list(scene.adjoint_gi.result.mean) == mean and said() == words
    assert {o.name: o.material_slots[0].material for o in scene.objects if preview.shown(o)} == ours
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert difference(before, everything()) == []


def test_a_picture_does_not_see_what_is_shown(scene, tmp_path):
    scene.render.resolution_x = scene.render.resolution_y = 16
    bake()
    first = bake(target="render", folder=str(tmp_path / "a"))
    scene.render.engine = "ADJOINT_GI"

    def picture():
        bpy.ops.render.render(write_still=False)
        scene.render.filepath = str(tmp_path / "out")
        settings = scene.render.image_settings
        if hasattr(settings, "media_type"):
            settings.media_type = "IMAGE"
        settings.file_format, settings.color_depth = "OPEN_EXR", "32"
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(tmp_path / "out.exr"))
        out = read_pixels(image)
        bpy.data.images.remove(image)
        return out

    plain = picture()
    scene.adjoint_gi.result.target, scene.adjoint_gi.result.quantity = "texture", "irradiance"
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"} and first
    assert np.array_equal(picture(), plain) and plain[..., :3].max() > 0


def test_instances_show_the_users_materials_too(scene):
    boxes = bpy.data.collections.new("Boxes")
    for name in BOXES:
        boxes.objects.link(scene.objects[name])
    empty = bpy.data.objects.new("Instances", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", boxes
    empty.location = (2, 0, 0)
    scene.collection.objects.link(empty)

    def seen():
        arrays = extract(bpy.context.evaluated_depsgraph_get(), scene)
        return [o.name for o in arrays.objects], arrays.materials, arrays.material.tolist(), arrays.warnings

    bake()
    before = seen()
    assert sum("[" in name for name in before[0]) == 2
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert seen() == before
    # Joined meshes take our materials along, and nothing is remembered of their slots.
    obj = scene.objects["Floor"]
    shown = obj.material_slots[0].material
    other = demo.quad(scene, "Other", (0, 0, 3), (1, 0, 0), (0, 1, 0), shown)
    bpy.context.view_layer.update()
    arrays = extract(bpy.context.evaluated_depsgraph_get(), scene)
    assert arrays.materials == before[1] and "Other" in {o.name for o in arrays.objects}
    bpy.data.objects.remove(other)


@pytest.mark.parametrize("link", ["DATA", "OBJECT"])
def test_a_material_deleted_while_shown_is_told(scene, link):
    red = bpy.data.materials["Cornell Red"]
    if link == "OBJECT":
        slot = scene.objects["Left Wall"].material_slots[0]
        slot.link, slot.material = "OBJECT", red
    bake()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    bpy.data.materials.remove(red)
    bpy.context.view_layer.update()
    (notice,) = [n for n in now(bpy.context) if "was deleted" in n.reason]
    assert (notice.object, notice.severity) == ("Left Wall", "warning") and "Restore Materials" in notice.remedy


def test_a_reference_by_cycles_does_not_see_what_is_shown(scene):
    bake()
    before = everything()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    during = everything()
    with results.put_aside(scene, bpy.context.view_layer):
        now_slots = {o.name: [s.material for s in o.material_slots] for o in scene.objects}
        assert not any(m.get(preview.OURS) for slots in now_slots.values() for m in slots)
    assert difference(during, everything()) == []
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert difference(before, everything()) == []


def test_what_is_shown_follows_the_uv_layer_of_the_next_bake(scene):
    floor = scene.objects["Floor"]
    other = floor.data.uv_layers.new(name="Mine")
    bake(selection_only=False)
    layer = targets.link(floor, "irradiance")["uv_layer"]
    assert layer != other.name
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}

    def shown():
        nodes = floor.material_slots[0].material.node_tree.nodes
        return [n.uv_map for n in nodes if n.type == "UVMAP"]

    assert shown() == [layer]
    for o in scene.objects:
        o.select_set(o == floor)
    bake(selection_only=True, uv_layer="Mine")
    assert shown() == ["Mine"]


def test_new_uvs_take_back_what_was_shown_on_the_old_ones(scene):
    before = everything()[2]
    bake(selection_only=True)
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    floor = scene.objects["Floor"]
    for o in scene.objects:
        o.select_set(o == floor)
    assert bpy.ops.adjoint_gi.renew_uvs() == {"FINISHED"}
    meshes = [o for o in scene.objects if o.type == "MESH"]
    assert [o.name for o in meshes if not preview.shown(o)] == ["Floor"], "the others go on"
    assert everything()[2]["Floor"] == before["Floor"]


# ---- "NAME GI"


def new_objects(**values):
    return bake(target="attribute", new_object=True, **values)


@pytest.mark.parametrize("method", ["progressive_radiosity", "path_tracing"])
def test_showing_new_objects_hides_their_originals_and_changes_no_number(scene, method, tmp_path):
    quick(scene, method)
    scene.objects["Short Box"].hide_set(True)  # by the user; it is left out of bakes
    scene.objects["Left Wall"].select_set(False)
    first = new_objects()
    words, before, looks = said(), eyes(), everything()
    asked = properties.request_of(scene, bpy.context.view_layer)
    with_result = {o.name for o in scene.objects if result_object(o) is not None}
    assert with_result == {"Floor", "Ceiling", "Back Wall", "Right Wall", "Tall Box"}

    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    hidden, selected = eyes()
    assert hidden == {"Short Box"} | with_result and selected == {f"{n} GI" for n in with_result}
    assert properties.request_of(scene, bpy.context.view_layer) == asked
    same(first, new_objects())
    assert said() == words and eyes() == (hidden, selected)
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"} and eyes() == (hidden, selected)

    # All objects, none of them named: the same ones receive.
    everyone = new_objects(selection_only=False)
    assert {o.name for o in scene.objects if result_object(o)} == with_result | {"Left Wall"} and everyone["Floor GI"] is not None
    assert remove_result_object(scene.objects["Left Wall"])

    path = str(tmp_path / "a.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert eyes() == (hidden, selected)
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert eyes() == before
    assert difference(looks[2], everything()[2]) == []


def test_extraction_lists_hidden_originals_in_their_place(scene):
    quick(scene, "progressive_radiosity")
    new_objects()

    def seen():
        arrays = extract(bpy.context.evaluated_depsgraph_get(), scene)
        receive = [o.name for o in target_objects(bpy.context, everything_asked)]
        return [o.name for o in arrays.objects], arrays.vertices.tobytes(), arrays.material.tolist(), arrays.warnings, receive

    everything_asked = BakeRequest("path_tracing", properties.settings_of(scene, "path_tracing"))
    before = seen()
    assert len(before[-1]) == 7 and bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert scene.objects["Floor"].hide_get()
    assert seen() == before and scene.objects["Floor"].hide_get()
    updates = []
    bpy.app.handlers.depsgraph_update_post.append(lambda *_: updates.append(1))
    bpy.context.view_layer.update()
    bpy.app.handlers.depsgraph_update_post.pop()
    assert not updates, "something is left to update, so the check would run for ever"


def test_what_the_user_selects_while_they_are_hidden_counts(scene):
    quick(scene, "progressive_radiosity")
    new_objects()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    for o in scene.objects:
        o.select_set(o.name == "Floor GI")
    assert properties.request_of(scene, bpy.context.view_layer).objects == ("Floor",)
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert eyes() == (set(), {"Floor"})


def test_of_two_in_one_place_only_the_one_with_the_last_result_is_seen(scene):
    quick(scene, "progressive_radiosity")
    new_objects()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"} and scene.objects["Floor"].hide_get()
    bake(target="texture")
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert scene.objects["Floor GI"].hide_get() and not scene.objects["Floor"].hide_get() and preview.shown(scene.objects["Floor"])
    bake(target="attribute", new_object=False)
    assert results.holders(scene, "irradiance", "attribute") and scene.adjoint_gi.result.new_object is False
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert scene.objects["Floor GI"].hide_get() and not scene.objects["Floor"].hide_get()
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert eyes()[0] == set() and not any(preview.shown(o) for o in scene.objects)


def test_a_view_layer_renamed_meanwhile_does_not_keep_them_hidden(scene):
    quick(scene, "progressive_radiosity")
    new_objects()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    bpy.context.view_layer.name = "Renamed"
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert eyes()[0] == set()


def test_selected_results_are_no_targets_and_say_nothing(scene):
    quick(scene, "progressive_radiosity")
    new_objects()
    alone = said()
    for o in scene.objects:
        o.select_set(o.type == "MESH")
    assert "Floor GI" in eyes()[1]
    words = said()
    assert words == alone and not any(" GI" in w for w in words)
    asked = properties.request_of(scene, bpy.context.view_layer)
    assert set(asked.objects) == {o.name for o in scene.objects if result_object(o)}
    new_objects()
    assert not [o for o in scene.objects if o.name.endswith("GI GI")]
    # Also when the user has them rendered.
    scene.objects["Floor GI"].hide_render = False
    bake(selection_only=False, new_object=False)
    assert scene.adjoint_gi.result.applied and linked_attribute(scene.objects["Floor"], "irradiance")


def test_with_only_results_selected_it_says_what_to_select(scene):
    quick(scene, "progressive_radiosity")
    new_objects()
    for o in scene.objects:
        o.select_set(o.name in ("Floor GI", "Ceiling GI"))
    (notice,) = now(bpy.context)
    assert (notice.object, notice.severity) == ("Selected Only", "error")
    assert "only results are selected" in notice.reason and "(Floor, Ceiling)" in notice.remedy
    assert bpy.ops.adjoint_gi.bake() == {"CANCELLED"}
    assert results.nothing_selected(bpy.context.view_layer)[0] == notice.reason
    state = scene.adjoint_gi_compare
    state.selection_only, state.receivers = True, "texture"
    with pytest.raises(SettingsError, match="only results are selected"):
        compare_records.request_of(scene, bpy.context.view_layer)
    # By name, as on the command line.
    request = BakeRequest("path_tracing", properties.settings_of(scene, "path_tracing"), objects=("Floor GI",))
    (named,) = [n for n in preflight(bpy.context, request) if n.severity == "error"]
    assert named.object == "Floor GI" and "hold a result" in named.reason and named.remedy


def test_a_result_object_has_the_users_materials_and_comes_back_when_deleted(scene):
    quick(scene, "progressive_radiosity")
    bake()
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    new_objects()
    made = result_object(scene.objects["Left Wall"])
    assert [m.name for m in made.data.materials] == ["Cornell Red"]
    for collection in made.users_collection:  # as deleting does
        collection.objects.unlink(made)
    assert place_result_object(scene.objects["Left Wall"], made.data) == made and made.name in scene.objects


# ---- names


def test_names_are_those_that_were_asked_for_and_numbers_are_told(scene):
    floor = scene.objects["Floor"]
    floor.data.attributes.new("Full", "FLOAT", "POINT")
    bake(target="attribute", attribute="Full")
    assert any('something else called "Full"' in w for w in said())
    bake(attribute="DirectOnly")
    assert [a.name for a in floor.data.color_attributes] == ["Full.001", "DirectOnly"]
    assert not any("something else called" in w for w in said())
    # Images and UV layers are named by us.
    bpy.data.images.new("Floor irradiance", 2, 2)
    floor.data.uv_layers.new(name="Lightmap")
    assert any('with a number, because it has one called "Lightmap"' in str(n) for n in _texture_check(scene))
    bake(target="texture")
    assert linked_image(floor, "irradiance").name == "Floor irradiance.001"
    assert any('"Floor irradiance.001"' in w for w in said())
    bake()
    assert linked_image(floor, "irradiance").name == "Floor irradiance.001" and not any("another image" in w for w in said())


def _texture_check(scene):
    scene.adjoint_gi.target = "texture"
    return now(bpy.context)
