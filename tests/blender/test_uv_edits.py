# SPDX-License-Identifier: GPL-3.0-or-later
"""What users do to baked objects: the next bake gives each its own texels, says what is made anew, and changes nothing of others."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake, preflight, rehearse
from adjgi.adjoint_gi.bridge.host.versions import modifier_input, set_modifier_input
from adjgi.adjoint_gi.bridge.results import carried
from adjgi.adjoint_gi.bridge.results.lightmap_uv import layer_values, own_layer
from adjgi.adjoint_gi.bridge.results.stored import NODES
from adjgi.tests.baking import bake, make_lightmap_uv, mesh_state, request
from adjgi.tests.blender.test_carried_uv import BUILT, box, counts, evaluated, fits, raster

SOON = BUILT | {"resolution": 128}


def copy_of(obj, how="api"):
    """What Shift+D makes of `obj`, beside it."""
    if how == "operator":
        for other in bpy.context.scene.objects:
            other.select_set(other == obj)
        bpy.context.view_layer.objects.active = obj
        bpy.ops.object.duplicate()
        made = bpy.context.view_layer.objects.active
    else:
        made = obj.copy()
        made.data = obj.data.copy()
        bpy.context.scene.collection.objects.link(made)
    made.location.y = 3
    bpy.context.view_layer.update()
    return made


def said(found):
    """What is made anew, by the objects it is said of."""
    return {(name, n.reason) for n in found if "made anew" in n.reason for name in n.names or (n.object,)}


def next_bake(**more):
    """A bake, of which what is made anew has been said by a check before."""
    checked = preflight(bpy.context, request(**SOON | more))
    made = bake(request(**SOON | more))
    assert said(checked) == said(made.notices)
    assert not any("a render differs" in n.reason and "Adjoint GI" in n.reason for n in checked), "of our own modifier"
    return made, said(checked)


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize("how", ["api", "operator"])
@pytest.mark.parametrize("modifiers", [(), ("SUBSURF",), ("ARRAY",)], ids=["plain", "subdivided", "carried"])
def test_a_duplicate_and_its_original_have_texels_of_their_own(modifiers, how, saved, tmp_path):
    """In an atlas; checked where both are evaluated, and on the original meshes, whose memory Blender shares between copies."""
    box("Box", *modifiers)
    box("Other").location.x = -3
    bake(request(**SOON))
    copy_of(bpy.data.objects["Box"], how)
    if saved:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    made, told = next_bake()
    assert {name for name, _ in told} == {"Box", "Box.001"} and all("duplicate" in why or "is a copy" in why for _, why in told)
    lightmap = made.writer.sheets[0].lightmap
    assert (lightmap.overlapping, lightmap.no_area, lightmap.outside) == (0, 0, 0)
    objects = [bpy.data.objects[name] for name in ("Box", "Box.001", "Other")]
    values = [layer_values(obj, own_layer(obj)) for obj in objects]
    assert len(np.unique(np.concatenate(values), axis=0)) == sum(len(np.unique(v, axis=0)) for v in values)
    assert next_bake()[1] == set(), "said once"


def test_two_originals_of_one_file_are_told_apart_too():
    """Whoever appends an asset twice has two carried layers, each its own, in one place of a square."""
    first, second, _ = box("First", "ARRAY"), box("Second", "ARRAY"), box("Other")
    second.location.y = 3
    bake(request(**SOON))
    modifier, twin = (next(m for m in o.modifiers if m.type == "NODES") for o in (first, second))
    own = modifier_input(modifier, "UVs").copy()
    own.data = own.data.copy()
    set_modifier_input(twin, "UVs", own)
    made, told = next_bake()
    assert {name for name, why in told if "duplicate" in why} == {"First", "Second"}
    assert made.writer.sheets[0].lightmap.overlapping == 0


def test_without_an_atlas_a_duplicate_keeps_its_layer():
    """Its image is its own, so nothing is to be said."""
    first = box("Box")
    bake(request(**SOON | {"atlas": False}))
    copy_of(first)
    made, told = next_bake(atlas=False)
    assert told == set() and len(made.writer.sheets) == 2


WRITES = {
    "renewed UVs": {"renew_uvs": True},
    "values on vertices": {"target": "attribute", "domain": "POINT"},
    "values on corners": {"target": "attribute", "domain": "CORNER"},
    "elements": {"target": "attribute", "new_object": True, "method": "progressive_radiosity", "values": {"max_edge": 0.5}},
}


@pytest.mark.parametrize("what", WRITES)
def test_nothing_that_a_bake_writes_reaches_copies_of_the_mesh(what):
    """Copies share memory with their original until one of them is changed, and a write that goes around that changes both."""
    obj = box("Box")
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    ask = request(**SOON | {"resolution": 64} | WRITES[what])
    bake(ask)
    before = mesh_state(obj.data)
    copy, shown = obj.data.copy(), evaluated(obj)
    stands = [x.copy() for x in (uv_of(copy), uv_of(shown))]
    state = mesh_state(copy)
    obj.location.x += 1.0
    lamp.rotation_euler.x = 1.0
    bpy.context.view_layer.update()
    bake(ask)
    assert mesh_state(copy) == state and np.array_equal(uv_of(copy), stands[0])
    assert before[0] == mesh_state(obj.data)[0]


def uv_of(mesh):
    """All UVs of a mesh."""
    out = [np.empty((len(mesh.loops), 2), np.float32) for _ in mesh.uv_layers]
    for layer, values in zip(mesh.uv_layers, out, strict=True):
        layer.uv.foreach_get("vector", values.reshape(-1))
    return np.array(out)


def test_what_is_taken_back_is_so_on_original_and_copy():
    first = box("Box")
    bake(request(**SOON))
    objects = [first, copy_of(first)]
    before = [layer_values(obj, own_layer(obj)) for obj in objects]
    refused = Bake(bpy.context, request(**SOON))
    assert not np.array_equal(*(layer_values(obj, own_layer(obj)) for obj in objects))
    refused.take_back()
    assert all(np.array_equal(layer_values(obj, own_layer(obj)), b) for obj, b in zip(objects, before, strict=True))


# ---- other faces


def others(obj, kind):
    """An edit by which `obj` gets other faces."""
    if kind == "other mesh":
        obj.data = bpy.data.meshes.new("Other")
        obj.data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    elif kind == "fewer":
        obj.modifiers["Array"].count = 1
    else:
        obj.modifiers["Array"].count = 5
    if kind == "more, other levels":
        for modifier in obj.modifiers:
            if modifier.type == "SUBSURF":
                modifier.levels = modifier.render_levels = 1
    bpy.context.view_layer.update()


BEHIND = {
    "nothing": [],
    "subdivision": ["SUBSURF"],
    "smoothed UVs": ["SUBSURF"],
    "two of them": ["SUBSURF", "SUBSURF"],
    "what moves": ["SUBSURF", "CAST"],
    "triangles": ["SUBSURF", "TRIANGULATE"],
}


@pytest.mark.parametrize("kind", ["more", "fewer", "more, other levels", "other mesh"])
@pytest.mark.parametrize("behind", BEHIND)
def test_changed_faces_are_noticed_whatever_stands_behind_the_carried_layer(behind, kind):
    """Subdivision makes values in between of those that say so, which it rounds."""
    obj = box("Box", "ARRAY", *BEHIND[behind])
    for modifier in obj.modifiers:
        if modifier.type == "SUBSURF":
            modifier.levels = modifier.render_levels = 2
            modifier.uv_smooth = "SMOOTH_ALL" if behind == "smoothed UVs" else "PRESERVE_BOUNDARIES"
    obj.modifiers["Array"].count = 3
    obj.modifiers["Array"].relative_offset_displace = (1.2, 0, 0)
    make_lightmap_uv(obj)
    assert fits(obj) == ""
    others(obj, kind)
    assert "other faces" in fits(obj)
    make_lightmap_uv(obj)
    assert fits(obj) == "" and raster([evaluated(obj)]).no_area == 0


def test_the_next_bake_has_texels_for_them_and_says_so():
    obj = box("Box", "ARRAY", "SUBSURF")
    bake(request(**SOON))
    others(obj, "more, other levels")
    made, told = next_bake()
    assert [name for name, why in told if "other faces" in why] == ["Box"] and made.writer.sheets[0].lightmap.no_area == 0
    assert next_bake()[1] == set()


# ---- the modifier itself


def turn_off(obj):
    carried.carrier(obj).show_viewport = False


def cut_links(obj):
    links = carried.carrier(obj).node_group.links
    for link in list(links)[:3]:
        links.remove(link)


def other_value(obj):
    """Nothing is missing then, but every corner has the same UV."""
    tree = carried.carrier(obj).node_group
    store = next(n for n in tree.nodes if n.bl_idname == "GeometryNodeStoreNamedAttribute")
    for socket in store.inputs:
        for link in list(socket.links):
            if socket.name == "Value":
                tree.links.remove(link)


def mute(obj):
    next(n for n in carried.carrier(obj).node_group.nodes if n.bl_idname == "GeometryNodeSwitch").mute = True


def other_kind(obj):
    next(n for n in carried.carrier(obj).node_group.nodes if n.bl_idname == "FunctionNodeCompare").operation = "EQUAL"


def lose(obj):
    bpy.data.objects.remove(carried.holder(obj))  # its mesh is left


MEDDLING = {turn_off: "off in the viewport", cut_links: "edited", other_value: "edited", mute: "edited", other_kind: "edited", lose: "lost"}


@pytest.mark.parametrize("meddle", MEDDLING, ids=lambda f: f.__name__)
@pytest.mark.parametrize("behind", ["nothing", "subdivision"])
def test_a_layer_whose_modifier_users_have_changed_is_carried_again(meddle, behind):
    """Said, with what is done about it; of all objects that use an edited group. No group and no object is left over."""
    first, second = box("First", "ARRAY", *BEHIND[behind]), box("Second", "ARRAY")
    second.location.y = 3
    bake(request(**SOON))
    before = counts()
    meddle(first)
    bpy.context.view_layer.update()
    made, told = next_bake()
    concerned = {"First", "Second"} if MEDDLING[meddle] == "edited" else {"First"}
    assert {name for name, why in told if MEDDLING[meddle] in why} == concerned
    lightmap = made.writer.sheets[0].lightmap
    assert (lightmap.overlapping, lightmap.no_area, lightmap.outside) == (0, 0, 0)
    assert fits(first) == fits(second) == "" and counts()[::2] == before[::2]
    assert carried.carrier(first).show_viewport and carried.carrier(first).show_render
    assert next_bake()[1] == set()


def test_a_check_leaves_the_modifier_as_the_user_has_it():
    obj = box("Box", "ARRAY")
    bake(request(**SOON))
    turn_off(obj)
    assert any("off in the viewport" in n.reason for n in rehearse(bpy.context, request(**SOON)))
    assert not carried.carrier(obj).show_viewport and carried.carrier(obj).show_render


def test_nodes_moved_selected_and_loaded_are_the_same_nodes(tmp_path):
    obj = box("Box", "ARRAY")
    bake(request(**SOON))
    for node in carried.carrier(obj).node_group.nodes:
        node.location.x += 100
        node.select = node.hide = True
    assert fits(obj) == ""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert fits(bpy.data.objects["Box"]) == ""


def test_a_group_that_another_version_made_is_no_edit():
    """Its layer stays, or images of earlier bakes would not fit; a layer that is made anew gets a group of this version."""
    obj = box("Box", "ARRAY")
    bake(request(**SOON))
    tree = carried.carrier(obj).node_group
    tree[NODES] = "4.1.0/12345678"
    assert fits(obj) == ""
    del tree[NODES]
    assert fits(obj) == ""
    bake(request(**SOON, renew_uvs=True))
    assert NODES in carried.carrier(obj).node_group and counts()[2] == 1
