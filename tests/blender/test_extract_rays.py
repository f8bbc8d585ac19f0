# SPDX-License-Identifier: GPL-3.0-or-later
"""Overrides of the view layer count as in Cycles; switches for kinds of rays do not, and are named."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.tests.cycles_patch import add_light, diffuse_material, render_patch, shader_material, white_plane


def seen():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get())


def told(arrays, severity="warning"):
    return [n for n in arrays.warnings if n.severity == severity]


def world(name, *color):
    made = bpy.data.worlds.new(name)
    if made.node_tree is None:
        made.use_nodes = True
    made.node_tree.nodes["Background"].inputs["Color"].default_value = (*color, 1.0)
    return made


def test_material_override():
    """Every slot, and objects without one, take the override's material, as Cycles' picture shows."""
    white_plane(2.0, diffuse_material("own", 0.5))
    bare = bpy.data.objects.new("bare", bpy.data.meshes.new("bare"))
    bare.data.from_pydata([(5, 0, 0), (6, 0, 0), (5, 1, 0)], [], [(0, 1, 2)])
    bpy.context.scene.collection.objects.link(bare)
    assert [m.name for m in seen().materials] == ["own", "Default"]
    lamp = shader_material("lamp", "ShaderNodeEmission", Color=(1.0, 0.5, 0.25, 1.0), Strength=2.0)
    bpy.context.view_layer.material_override = lamp
    arrays = seen()
    assert [m.name for m in arrays.materials] == ["lamp"] and not arrays.material.any() and not told(arrays)
    emission = arrays.materials[0].total("emission").constant
    np.testing.assert_allclose(emission, (2.0, 1.0, 0.5), rtol=1e-6)
    for at in ((0, 0), (5.2, 0.2)):
        np.testing.assert_allclose(render_patch(at, samples=1)[4, 4], emission, rtol=1e-4)


def test_world_override():
    white_plane(2.0)
    scene = bpy.context.scene
    scene.world, bpy.context.view_layer.world_override = world("own", 0.5, 0.5, 0.5), world("other", 0.75, 0.5, 0.25)
    background = seen().background
    np.testing.assert_allclose(background, (0.75, 0.5, 0.25), rtol=1e-6)
    np.testing.assert_allclose(render_patch(samples=64).mean(axis=(0, 1)), background, rtol=0.02)
    bpy.context.view_layer.world_override = None
    np.testing.assert_allclose(seen().background, (0.5, 0.5, 0.5), rtol=1e-6)


@pytest.mark.parametrize("kind", ["POINT", "AREA", "SUN", "MESH"])
@pytest.mark.parametrize("ray", ["diffuse", "glossy", "transmission", "shadow"])
def test_rays_that_are_turned_off(kind, ray):
    plane = white_plane(2.0)
    obj = plane if kind == "MESH" else add_light(kind)
    if kind == "MESH":
        add_light("POINT")
    assert not told(seen()), "nothing to say with the defaults"
    setattr(obj, f"visible_{ray}", False)
    found = told(seen())
    if ray == "shadow" and kind != "MESH":  # a lamp casts none itself; its own switch for shadows is computed
        assert found == []
        return
    (notice,) = found
    assert notice.object == obj.name and f"turned off for {ray} rays" in notice.reason and "Ray Visibility" in notice.remedy


def test_several_rays_and_the_camera():
    plane = white_plane(2.0)
    plane.visible_diffuse = plane.visible_shadow = plane.visible_camera = False
    arrays = seen()
    assert "diffuse and shadow rays" in told(arrays)[0].reason
    assert any(n.object == "plane" and "camera rays" in n.reason for n in told(arrays, "info"))


@pytest.mark.parametrize("which", ["receiver_collection", "blocker_collection"])
@pytest.mark.parametrize("kind", ["lamp", "mesh"])
def test_light_linking(which, kind):
    plane = white_plane(2.0, shader_material("glow", "ShaderNodeEmission"))
    obj = plane if kind == "mesh" else add_light("POINT")
    setattr(obj.light_linking, which, bpy.data.collections.new("linked"))
    (notice,) = told(seen())
    assert notice.object == obj.name and "light linking" in notice.reason and "shadow linking" in notice.remedy


def test_world_that_is_turned_off_for_rays():
    white_plane(2.0)
    bpy.context.scene.world = sky = world("sky", 0.5, 0.5, 0.5)
    assert not told(seen())
    sky.cycles_visibility.diffuse = sky.cycles_visibility.camera = False
    arrays = seen()
    (notice,) = told(arrays)
    assert notice.object == 'World "sky"' and "diffuse rays" in notice.reason and "Ray Visibility" in notice.remedy
    assert any("camera rays" in n.reason for n in told(arrays, "info"))
    sky.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    assert not told(seen()), "a black world gives no light that could be missed"


def test_nothing_is_said_of_what_does_not_count():
    white_plane(2.0)
    lamp = add_light("POINT")
    lamp.visible_diffuse, lamp.hide_render = False, True
    assert not told(seen())


def test_the_shading_terminator_is_read_for_each_object_and_what_is_not_followed_is_named():
    """Its two settings are Cycles' own up to Blender 4.5 and the object's since; both have the defaults of Cycles."""
    near, far = (white_plane(2.0, diffuse_material(name, 0.5)) for name in ("near", "far"))
    assert [round(o.terminator, 4) for o in seen().objects] == [0.1, 0.1]
    owner = far if hasattr(far, "shadow_terminator_geometry_offset") else far.cycles
    owner.shadow_terminator_geometry_offset = 0.4
    arrays = seen()
    assert {o.name: round(o.terminator, 4) for o in arrays.objects} == {near.name: 0.1, far.name: 0.4} and not told(arrays)
    setattr(owner, "shadow_terminator_shading_offset" if owner is far else "shadow_terminator_offset", 0.2)
    (one,) = told(seen())
    assert one.object == far.name and "Shading Offset" in one.reason
