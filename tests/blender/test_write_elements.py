# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of element methods as objects made of the elements."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute, remove_result_object, result_object
from adjgi.adjoint_gi.bridge.results.links import ABOUT, RESULTS
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.scene.arrays import RayKind
from adjgi.tests.baking import bake, request

COARSE = {"max_edge": 0.25, "light_samples": 8}
SMALL = {**COARSE, "rays": 64, "samples": 4, "particles": 50_000}
SHOOTING = {**COARSE, "rays": 100_000}  # for all elements together


def few(method):
    """Settings with which a method on elements takes a moment."""
    fields = {f.name: f.default for f in dataclasses.fields(registry.method(method).Settings)}
    values = SHOOTING if fields.get("rays", 0) >= 100_000 else SMALL
    return {name: value for name, value in values.items() if name in fields}


def shadow(scale=(1, 1, 1)):
    """A floor of one quad, a screen above it and a lamp above that; the floor's object is turned, moved and scaled."""
    scene = bpy.context.scene
    white, black = demo.material("White", (0.5,) * 3), demo.material("Black", (0.1,) * 3)
    glow = demo.material("Glow", (0.0,) * 3, (50.0,) * 3)

    def quad(name, low, high, z, material):
        (x0, y0), (x1, y1) = low, high
        face = [(0, 1, 2, 3)] if name == "Floor" else [(3, 2, 1, 0)]
        return demo.mesh_object(scene, name, [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], face, material)

    floor = quad("Floor", (0, 0), (1, 1), 0, white)
    floor.scale = scale
    quad("Screen", (0.3, 0.35), (0.7, 0.65), 0.3, black)
    quad("Lamp", (0.45, 0.45), (0.55, 0.55), 1.0, glow)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.5, 0.5, 3)
    scene.collection.objects.link(camera)
    scene.camera = camera
    bpy.context.view_layer.update()
    return floor


def elements_of(obj, method="progressive_radiosity", values=None, **more):
    """Bake the elements of `obj`; the bake, and the result object."""
    settings = few(method) if values is None else values
    done = bake(request(method, "attribute", settings, new_object=True, **more))
    return done, result_object(obj)


def points(obj):
    """World-space vertices (n, 3), and for every corner its vertex."""
    mesh = obj.data
    co, loops = np.empty(3 * len(mesh.vertices), np.float32), np.empty(len(mesh.loops), np.int32)
    mesh.vertices.foreach_get("co", co)
    mesh.loops.foreach_get("vertex_index", loops)
    matrix = np.array(obj.matrix_world)
    return co.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3], loops


def colors(obj, name):
    data = obj.data.attributes[name].data
    out = np.empty(len(data) * 4, np.float32)
    data.foreach_get("color", out)
    return out.reshape(-1, 4)


@pytest.mark.parametrize("method", sorted(m.spec.id for m in registry.methods() if m.spec.uses_elements))
def test_every_element_method_makes_its_elements(method):
    floor = shadow()
    quantity = "potential" if method == "potential" else "irradiance"
    done, made = elements_of(floor, method, quantity=quantity, objects=("Floor",))
    assert len(made.data.polygons) == 16 and len(made.data.vertices) == 25 and len(floor.data.vertices) == 4
    assert made.hide_render and not made.data.validate()
    solution = done.driver.solution()
    place, loops = points(made)
    value = colors(made, linked_attribute(made, quantity))
    assert len(value) == len(loops) == 64 and np.all(value[:, 3] == 1)
    # Corners at one place of a smooth surface have one value, that of the receiver there.
    wanted = solution.quantity(quantity)
    vertices = done.writer.nodes.vertices
    nearest = np.linalg.norm(place[loops][:, None] - vertices, axis=2).argmin(axis=1)
    assert np.abs(vertices[nearest] - place[loops]).max() < 1e-5
    assert np.array_equal(value[:, :3], wanted[nearest]) and value[:, :3].max() > 0
    assert done.written == [f"attribute {linked_attribute(made, quantity)} of Floor GI"] and made.data[ABOUT]


@pytest.mark.parametrize("domain", ["POINT", "CORNER"])
def test_adaptive_elements_are_smaller_at_the_shadow_and_hold_the_light_there(domain):
    floor = shadow()
    settings = {"max_edge": 0.1, "min_edge": 0.025, "adaptive": True, "rays": 400_000, "light_samples": 32}
    done, made = elements_of(floor, values=settings, objects=("Floor",), domain=domain)
    place, loops = points(made)
    assert len(place) > 150 and len(done.writer.nodes.vertices) == 121  # 11 x 11 before
    at_shadow = np.abs(np.abs(place[:, :2] - 0.5) - (0.24, 0.21)).min(axis=1) < 0.06
    fine = [p.area < 0.002 for p in made.data.polygons]
    middle = np.array([(made.matrix_world @ p.center)[:2] for p in made.data.polygons])
    far = np.abs(middle - 0.5).max(axis=1) > 0.42
    assert at_shadow.any() and sum(fine) > 100 and not np.any(np.array(fine)[far])
    assert sum(p.area for p in made.data.polygons) == pytest.approx(1, rel=1e-5)
    # No cracks: a vertex inside the edge of a larger neighbour has the value of that edge.
    solution = done.driver.solution()
    assert "mesh_weight" in solution.extra
    light = solution.extra["mesh_direct"][:, 0]
    start, corners, at = (solution.extra[f"mesh_{x}"] for x in ("start", "corners", "vertices"))
    quads = corners.reshape(-1, 4)
    assert len(quads) == len(start) - 1
    inner = 0
    for a, b in zip(quads.ravel(), np.roll(quads, -1, axis=1).ravel(), strict=True):
        middle = np.flatnonzero(np.abs(at - 0.5 * (at[a] + at[b])).max(axis=1) < 1e-6)
        inner += len(middle)
        assert np.allclose(light[middle], 0.5 * (light[a] + light[b]), rtol=1e-4, atol=1e-5)
    assert inner > 10
    # Direct light at the vertices, against many points of the lamp.
    world = done.driver.world
    inside = (place[:, :2] > 0.05).all(axis=1) & (place[:, :2] < 0.95).all(axis=1)
    origin = (place - world.center + (0, 0, 0.01)).astype(np.float32)
    triangle, u, v, _ = world.intersect(origin, np.tile(np.array([[0, 0, -1]], np.float32), (len(place), 1)), RayKind.CAMERA)
    truth = direct_irradiance(world, Emitters(world), world.surface(triangle, u, v), 256, np.random.default_rng(0))[0][:, 0]
    value = colors(made, linked_attribute(made, "irradiance"))
    value = value if domain == "POINT" else value[np.unique(loops, return_index=True)[1]]
    error = value[inside, 0] - truth[inside]
    # The screen lets a little light come back from below; neighbours of hanging vertices are interpolated.
    assert np.sqrt((error**2).mean()) < 0.1 * truth.max() and abs(error.mean()) < 0.04 * truth.max()
    assert np.corrcoef(value[inside, 0], truth[inside])[0, 1] > 0.97


def test_hard_edges_are_hard_and_smooth_ones_smooth():
    lamp = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(lamp)
    for smooth in (False, True):
        bpy.ops.mesh.primitive_cube_add()
        box = bpy.context.view_layer.objects.active
        if smooth:
            box.data.shade_smooth()
        _, made = elements_of(box, values={"max_edge": 1.0, "rays": 10_000}, objects=(box.name,))
        place, loops = points(made)
        value = colors(made, linked_attribute(made, "irradiance"))[:, :3]
        # 9 vertices on each of 6 faces; on a smooth cube those of faces that meet are the same.
        assert len(made.data.polygons) == 24 and len(made.data.vertices) == (26 if smooth else 54)
        corner = np.linalg.norm(place[loops] - (1, 1, 1), axis=1) < 1e-5
        assert corner.sum() == 3
        assert (np.ptp(value[corner, 0]) == 0) if smooth else (value[corner, 0].max() > 2 and np.sort(value[corner, 0])[1] < 0.1)
        bpy.data.objects.remove(made)
        bpy.data.objects.remove(box)


@pytest.mark.parametrize("scale", [(1, 1, 1), (-2, 0.5, 3)])
def test_the_elements_lie_where_the_object_lies_and_face_the_same_way(scale):
    floor = shadow(scale)
    _, made = elements_of(floor, objects=("Floor",))
    place, _ = points(made)
    low, high = np.sort([(0, 0, 0), (scale[0], scale[1], 0)], axis=0)
    assert np.allclose(place.min(axis=0), low, atol=1e-6) and np.allclose(place.max(axis=0), high, atol=1e-6)
    up = made.matrix_world.inverted().transposed().to_3x3()
    assert all((up @ p.normal).normalized().z == pytest.approx(1) for p in made.data.polygons)
    assert [s.material for s in made.material_slots] == [s.material for s in floor.material_slots]


def test_an_object_made_flat_meanwhile_does_not_flatten_its_elements():
    floor = shadow((1, 2, 1))
    done, made = elements_of(floor, objects=("Floor",))
    floor.scale = (1, 0, 1)
    bpy.context.view_layer.update()
    done.write(done.driver.solution())
    assert np.array_equal(np.array(made.matrix_world), np.eye(4))
    assert np.allclose(np.ptp(points(made)[0], axis=0), (1, 2, 0), atol=1e-6)


def test_modifiers_and_materials_are_those_of_the_evaluated_mesh():
    floor = shadow()
    floor.data.materials.append(demo.material("Other", (0.8, 0.2, 0.2)))
    array = floor.modifiers.new("Two", "ARRAY")
    array.count = 2
    array.relative_offset_displace = (1.5, 0, 0)
    floor.data.polygons[0].material_index = 1
    _, made = elements_of(floor, objects=("Floor",), quantity="radiosity")
    place, _ = points(made)
    assert np.ptp(place[:, 0]) == pytest.approx(2.5) and len(made.data.polygons) == 32
    assert {p.material_index for p in made.data.polygons} == {1}
    value = colors(made, linked_attribute(made, "radiosity"))
    assert np.allclose(value[:, 0], 4 * value[:, 1], rtol=1e-3) and value[:, 0].max() > 0


def test_a_second_bake_updates_the_object_and_removing_leaves_nothing():
    floor = shadow()
    before = {k: len(getattr(bpy.data, k)) for k in ("meshes", "objects", "materials")}
    _, made = elements_of(floor, objects=("Floor",))
    _, again = elements_of(floor, objects=("Floor",), quantity="direct", attribute="Direct")
    assert again == made and linked_attribute(made, "irradiance") and linked_attribute(made, "direct") == "Direct"
    _, finer = elements_of(floor, values={**few("progressive_radiosity"), "max_edge": 0.125}, objects=("Floor",))
    assert finer == made and len(made.data.polygons) == 64 and linked_attribute(made, "direct") is None
    assert len(bpy.data.meshes) == before["meshes"] + 1
    assert remove_result_object(floor)
    assert {k: len(getattr(bpy.data, k)) for k in before} == before
    assert RESULTS not in floor and not floor.data.color_attributes


def test_partial_results_show_the_elements_while_they_are_cut():
    floor = shadow()
    settings = {"max_edge": 0.25, "min_edge": 0.0625, "adaptive": True, "rays": 100_000, "tolerance": 1e-4}
    made = Bake(bpy.context, request("progressive_radiosity", "attribute", settings, new_object=True, objects=("Floor",)))
    sizes = []
    for step in made.driver.solver.solve(made.driver.world, made.driver.receivers, made.request.settings, np.random.default_rng(0)):
        solution = step.solution()
        if not sizes or solution.partial and "mesh_weight" in solution.extra:
            made.write(solution)
            sizes.append(len(result_object(floor).data.polygons))
    assert sizes[0] == 16 and sizes[-1] > 16


def test_an_object_edited_meanwhile_is_named_and_its_elements_are_kept():
    """In the end; what is shown until then waits for it."""
    floor = shadow()
    made = Bake(bpy.context, request("progressive_radiosity", "attribute", few("progressive_radiosity"), new_object=True))
    solution = made.driver.run()
    floor.data.clear_geometry()
    bpy.context.view_layer.update()
    made.driver.state, state = "running", made.driver.state
    with pytest.raises(TargetError, match="Floor: was edited meanwhile.*Bake again"):
        made.write(solution)
    assert result_object(floor) is None and len(bpy.data.objects) == 4
    made.driver.state = state
    made.write(solution)
    assert len(result_object(floor).data.polygons) == 16
    assert any(n.object == "Floor" and "as they were then" in n.reason and n.remedy == "Bake again" for n in made.notices)


def test_other_methods_keep_the_evaluated_mesh():
    floor = shadow()
    _, made = elements_of(floor, "path_tracing", values={"samples": 4}, objects=("Floor",))
    assert len(made.data.polygons) == 1 and len(made.data.vertices) == 4
