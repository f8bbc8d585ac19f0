# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene is copied a slice at a time: with the same result as at once, and anew where something changes in between."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract import depsgraph, mesh
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract, extracting
from adjgi.adjoint_gi.bridge.extract.instances import InstanceWalk
from adjgi.adjoint_gi.bridge.host import meshes, preparation
from adjgi.adjoint_gi.bridge.host.notices import Notices
from adjgi.adjoint_gi.bridge.host.preparation import Aside, finish_stages
from adjgi.tests.blender.fakes import square


def grown(obj):
    """`obj` with modifiers, layers, slots and a selection."""
    for kind in ("SUBSURF", "BEVEL"):
        obj.modifiers.new(kind, kind)
    obj.data.materials.append(bpy.data.materials.new("One"))
    obj.data.materials.append(bpy.data.materials.new("Two"))
    for k, polygon in enumerate(obj.data.polygons):
        polygon.material_index, polygon.select, polygon.use_smooth = k % 2, k % 3 == 0, k % 5 == 0
    obj.data.color_attributes.new("Paint", "FLOAT_COLOR", "CORNER")
    return obj


@pytest.fixture
def scene(registered):
    """A monkey, two instances of a collection, a text, two lamps and a mirrored linked duplicate."""
    bpy.ops.mesh.primitive_monkey_add()
    monkey = grown(bpy.context.object)
    double = bpy.data.objects.new("Double", monkey.data)
    double.scale.x, double.location.x = -1.0, 4.0
    bpy.context.collection.objects.link(double)
    collection = bpy.data.collections.new("Set")
    collection.objects.link(square("Member"))
    for name in ("First", "Second"):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection = "COLLECTION", collection
        bpy.context.collection.objects.link(empty)
    text = bpy.data.objects.new("Text", bpy.data.curves.new("Text", "FONT"))
    text.data.body = "Light"
    bpy.context.collection.objects.link(text)
    for name in ("Lamp", "Other"):
        bpy.context.collection.objects.link(bpy.data.objects.new(name, bpy.data.lights.new(name, "POINT")))
    bpy.context.view_layer.update()
    return bpy.context.scene


def same(a, b):
    """Whether two values are equal, arrays and dataclasses by what they hold."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return a == b


def at_once():
    return extract(bpy.context.evaluated_depsgraph_get(), bpy.context.scene)


def sliced(monkeypatch, between=lambda k: None):
    """The scene, with one piece of Blender's data in each slice, and what is done after each; also the number of slices."""
    monkeypatch.setattr(preparation, "SLICE", -1.0)
    count = 0

    def stages():
        nonlocal count
        steps, answer = extracting(), None
        while True:
            try:
                stage = steps.send(answer)
            except StopIteration as end:
                return end.value
            answer = (yield stage) if isinstance(stage, Aside) else between(count)
            count += not isinstance(stage, Aside)

    return finish_stages(stages()), count


def test_many_slices_give_what_one_gives(scene, monkeypatch):
    found, count = sliced(monkeypatch)
    wanted = at_once()
    assert len(wanted.objects) == 6 and len(wanted.lights) == 2
    assert count > 3 * len(mesh.PIECES), "each piece of three meshes, and each object"
    assert same(found, wanted)


def test_a_change_between_two_slices_has_the_scene_read_anew(scene, monkeypatch):
    def move(k):
        if k == 20:  # after it was copied
            bpy.data.objects["Suzanne"].location.x += 1.0

    found, count = sliced(monkeypatch, move)
    assert same(found, at_once()) and count > 20


def test_what_changes_all_the_time_is_read_at_once_in_the_end(scene, monkeypatch):
    def move(k):
        bpy.data.objects["Double"].location.x += 1.0

    found, count = sliced(monkeypatch, move)
    assert same(found, at_once()) and count == depsgraph.ATTEMPTS


def test_an_object_that_goes_between_two_slices_is_not_touched_again(scene, monkeypatch):
    def remove(k):
        if k == 15:
            bpy.data.batch_remove([bpy.data.objects["Double"], bpy.data.objects["Lamp"]])

    found, _ = sliced(monkeypatch, remove)
    assert same(found, at_once()) and len(found.lights) == 1


@pytest.mark.parametrize("kind", ["plain", "modifiers", "edit", "triangles", "ngon", "edges"])
def test_quick_copies_of_a_mesh_are_what_blender_says_item_by_item(kind):
    if kind in ("ngon", "edges"):
        bpy.ops.mesh.primitive_circle_add(fill_type="NGON" if kind == "ngon" else "NOTHING")
    else:
        bpy.ops.mesh.primitive_monkey_add()
        grown(bpy.context.object)
    obj = bpy.context.object
    if kind == "triangles":
        obj.modifiers.new("Cut", "TRIANGULATE")
    if kind == "edit":
        bpy.ops.object.mode_set(mode="EDIT")
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    m = obj.data if kind in ("plain", "edit") else evaluated.data
    for found, wanted in (
        (meshes.positions(m), [v.co for v in m.vertices]),
        (meshes.corner_vertices(m), [c.vertex_index for c in m.loops]),
        (meshes.material_slots(m), [p.material_index for p in m.polygons]),
        (meshes.selected(m), [p.select for p in m.polygons]),
        (meshes.first_corners(m), [p.loop_start for p in m.polygons]),
        (meshes.triangle_corners(m), [t.loops for t in m.loop_triangles]),
        (meshes.triangle_polygons(m), [t.polygon_index for t in m.loop_triangles]),
    ):
        assert len(found) == len(wanted) and np.array_equal(found, np.array(wanted, found.dtype).reshape(found.shape))
    if kind == "edit":
        bpy.ops.object.mode_set(mode="OBJECT")


def test_the_way_back_to_the_last_instance_is_never_most_of_the_work(monkeypatch):
    """Blender goes through its whole list again in every slice: with a limit on both together, 8,000 instances took an item a slice."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(preparation, "time", clock)

    def tick(value):
        clock.now += 0.001
        return value

    listed = SimpleNamespace()
    walk = InstanceWalk(lambda material: 0, frozenset(), Notices())
    walk._visibility = SimpleNamespace(name_missing=lambda d: None)
    visited, slices = [], 0
    monkeypatch.setattr(walk, "_visit", lambda inst, *_: tick(visited.append(inst) is None))
    done = False
    while not done:
        listed.object_instances = map(tick, range(2000))
        turn = preparation.Turn()
        done = walk.go_on(listed, turn.over, turn.back)
        slices += 1
    assert visited == list(range(2000)) and 2 < slices < 12 and clock.now < 12
