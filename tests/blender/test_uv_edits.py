# SPDX-License-Identifier: GPL-3.0-or-later
"""What users do to baked objects: the next bake gives each its own texels, says what is made anew, and changes nothing of others."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake, preflight
from adjgi.adjoint_gi.bridge.host.versions import modifier_input, set_modifier_input
from adjgi.adjoint_gi.bridge.results.lightmap_uv import layer_values, own_layer
from adjgi.tests.baking import bake, mesh_state, request
from adjgi.tests.blender.test_carried_uv import BUILT, box, evaluated

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
