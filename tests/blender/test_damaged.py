# SPDX-License-Identifier: GPL-3.0-or-later
"""Files in which something else stands under the names of our custom properties: it counts as absent, is named, and can be cleared away."""

from __future__ import annotations

import bpy
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import preflight, rehearse
from adjgi.adjoint_gi.bridge.cli.bake import save_blend
from adjgi.adjoint_gi.bridge.results import attribute, image, lightmap_uv, links, preview, show, stored
from adjgi.adjoint_gi.bridge.results.remove import remove_results
from adjgi.tests import baking
from adjgi.tests.cycles_patch import add_light, diffuse_material
from adjgi.tests.hostile import SQUARE, mesh

NOTED = (stored.UV, stored.SHARED, stored.FACES, stored.ASKED)  # of a lightmap layer
WRONG = (
    *(1, 0, 2.5, "x", "[1]", '[{"name": 3}]', [1, 2], {}, {"a": 1}, {"irradiance": 3}, {"owner": 1, "irradiance": {"owner": "floor"}}),
    *({"irradiance": '[{"name": "a", "wanted": "b"}]'}, {"irradiance": {"owner": "floor", "image": 5}}),
    *({"irradiance": {"owner": "floor", "scale": "ab"}}, {"object": {"owner": "floor", "made": 4}}),
    *({"layer": 3, "seen": "x", "scene": 1, "made_selected": "y"}, {"count": "y", "link0": 4, "key": 7}, {"count": 1, "link0": "x"}),
    *({"count": 1, "link0": "DATA", "material0": 6}, {"layer": "ViewLayer", "made_selected": 0, "scene": "Scene"}),
)


def floor():
    made = mesh(*SQUARE, name="floor")
    made.data.materials.append(diffuse_material("grey", 0.5))
    add_light("SUN", energy=2.0, angle=0.0)
    return made


def blocks():
    return [b for kind in stored.COLLECTIONS for b in getattr(bpy.data, kind)]


@pytest.mark.parametrize("value", WRONG, ids=repr)
def test_anything_under_the_names_of_our_properties_is_met(value, registered, tmp_path):
    """On every datablock, also of another scene, at once: check, bake, show, restore and clear go on as if nothing stood there."""
    obj = floor()
    mesh(*SQUARE, name="elsewhere")
    other = bpy.data.scenes.new("other")
    other.collection.objects.link(bpy.data.objects["elsewhere"])
    bpy.context.scene.collection.objects.unlink(bpy.data.objects["elsewhere"])
    bpy.data.images.new("any", 1, 1)
    bpy.data.node_groups.new("any", "ShaderNodeTree")
    for block in blocks():
        for name in stored.PROPERTIES:
            block[name] = value
    assert stored.damaged()
    request = baking.request(resolution=16, values={"samples": 1}, output=str(tmp_path))
    told = [n for n in preflight(bpy.context, request) if "counts as absent" in n.reason]
    assert told and len(told) <= len(stored.PROPERTIES) and not [n for n in told if n.severity == "error"]

    for target in ("texture", "attribute"):
        made = baking.bake(baking.request(target=target, resolution=16, values={"samples": 1}))
        assert [n for n in made.notices if "counts as absent" in n.reason]
        record = bpy.context.scene.adjoint_gi.result
        record.target, record.quantity = target, "irradiance"
        assert show.show(bpy.context.scene) == 1 and show.restore(bpy.context.scene) == 1
    assert image.linked_image(obj, "irradiance") is not None and attribute.linked_attribute(obj, "irradiance") == "AdjointGI"
    remove_results(bpy.context.scene)
    assert not stored.damaged()
    assert not obj.data.uv_layers and not obj.data.color_attributes and obj.material_slots[0].material.name == "grey"


@pytest.mark.parametrize("value", (1, "x", [1, 2], {"a": [1]}), ids=repr)
def test_a_check_puts_back_what_it_found_damaged(value, registered):
    """So that the bake after it says the same; also where the check makes a layer that is carried, and where several lie in one square."""
    floor()
    mesh(*SQUARE, name="thick").modifiers.new("Solidify", "SOLIDIFY")
    owners = [*bpy.data.meshes, *bpy.data.objects]
    for owner in owners:
        for name in NOTED:
            owner[name] = value
    before = stored.damaged()
    assert before
    for atlas in (False, True):
        said = rehearse(bpy.context, baking.request(resolution=16, atlas=atlas, values={"samples": 1}))
        assert [n for n in said if "counts as absent" in n.reason] and not [n for n in said if n.severity == "error"]
        assert stored.damaged() == before
        assert all(getattr(owner[name], "to_dict", getattr(owner[name], "to_list", lambda v=owner[name]: v))() == value
                   for owner in owners for name in NOTED)  # fmt: skip


def test_what_a_bake_stores_is_not_damaged(registered):
    """Every property that a bake, a preview and a result object leave passes; a deleted material too."""
    obj = floor()
    for more in ({}, {"target": "attribute"}, {"target": "attribute", "new_object": True}):
        baking.bake(baking.request(values={"samples": 1}, **{"resolution": 16, **more}))
        record = bpy.context.scene.adjoint_gi.result
        record.target, record.quantity, record.new_object = more.get("target", "texture"), "irradiance", "new_object" in more
        show.show(bpy.context.scene)
        assert not stored.damaged()
    preview.restore([obj])
    preview.show([obj], "irradiance")
    bpy.data.materials.remove(bpy.data.materials["grey"])
    assert not stored.damaged() and links.keys(obj) == ["irradiance", "object"]
    assert lightmap_uv.find_uv_layer(obj, "") == "Lightmap"


def test_a_link_to_a_users_object_is_not_taken_for_a_result(registered):
    """Clear Results removes what a bake has made, and nothing else."""
    obj, mine = floor(), mesh(*SQUARE, name="mine")
    obj[stored.RESULTS] = {"object": {"owner": "floor"}}
    obj[stored.RESULTS]["object"]["made"] = mine
    assert stored.damaged() == [("floor", stored.RESULTS)]
    remove_results(bpy.context.scene)
    assert "mine" in bpy.data.objects and stored.RESULTS not in obj


def test_a_saved_file_need_not_hold_what_blender_does_not_save(tmp_path):
    """An image that nothing uses, and one of another file, however they are marked."""
    for name in ("theirs", "unused"):
        bpy.data.images.new(name, 1, 1)[stored.ABOUT] = "{}"
    library = tmp_path / "library.blend"
    bpy.data.libraries.write(str(library), {bpy.data.images["theirs"]}, fake_user=True)
    bpy.data.images.remove(bpy.data.images["theirs"])
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.images = ["theirs"]
    bpy.context.scene["uses"] = bpy.data.images["theirs"]
    assert save_blend(tmp_path / "saved.blend") == str(tmp_path / "saved.blend")


def baked_and_told(**options):
    """Names of the objects that a bake gives lightmaps, and what it says as warnings, which the check before has said as well."""
    request = baking.request(resolution=16, values={"samples": 1}, **options)
    checked = rehearse(bpy.context, request)
    made = baking.bake(request)
    told = [[(n.object, n.reason) for n in notices if n.severity != "info"] for notices in (checked, made.notices)]
    assert told[0] == told[1]
    return {o.name for o in bpy.data.objects if image.linked_image(o, "irradiance") is not None}, dict(told[1])


def result_and_copy():
    """The object that holds the result of "floor", and a copy of it, made by the user and shown in renders."""
    baking.bake(baking.request(target="attribute", new_object=True, values={"samples": 1}, objects=("floor",)))
    made = attribute.result_object(bpy.data.objects["floor"])
    copy = made.copy()
    copy.data, copy.name, copy.location.z, copy.hide_render = made.data.copy(), "mine", 1.0, False
    bpy.context.scene.collection.objects.link(copy)
    return made, copy


def test_a_copy_of_a_result_is_the_users(registered):
    """It casts a shadow, so it is baked, stands beside the result in Show, can be chosen, and stays when results are cleared."""
    floor()
    made, copy = result_and_copy()
    assert links.results() == {made}
    assert baked_and_told() == ({"floor", "mine"}, {})
    assert baked_and_told(objects=("mine",)) == ({"floor", "mine"}, {})
    for o in bpy.context.view_layer.objects:
        o.select_set(o in (made, copy))
    assert show.selected(bpy.context.view_layer) == ("mine",)
    bpy.context.scene.adjoint_gi.result.target, bpy.context.scene.adjoint_gi.result.quantity = "texture", "irradiance"
    assert copy in show.holders(bpy.context.scene, "irradiance", "texture", False)
    remove_results(bpy.context.scene)
    assert {o.name for o in bpy.data.objects if o.type == "MESH"} == {"floor", "mine"}


def test_a_result_without_its_original_is_the_users(registered):
    obj = floor()
    made, copy = result_and_copy()
    bpy.data.objects.remove(copy)
    bpy.data.objects.remove(obj)
    made.hide_render = False
    assert baked_and_told() == ({made.name}, {})


def test_a_result_that_renders_show_is_in_the_light_and_said(registered):
    floor()
    made, copy = result_and_copy()
    bpy.data.objects.remove(copy)
    made.hide_render = False
    baked, told = baked_and_told()
    assert baked == {"floor"} and list(told) == [made.name] and 'hold the result of "floor": it is in the light' in told[made.name]


@pytest.mark.parametrize("value", (True, 1, 5), ids=repr)
def test_a_mark_alone_hides_no_object(value, registered):
    floor()[stored.MADE] = value
    baked, told = baked_and_told()
    assert baked == {"floor"} and [k for k in told] == (["floor"] if value == 5 else [])
