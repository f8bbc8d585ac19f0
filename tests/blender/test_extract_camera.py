# SPDX-License-Identifier: GPL-3.0-or-later
"""The camera projects points where Blender's own projection puts them."""

from __future__ import annotations

import itertools

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import preflight
from adjgi.adjoint_gi.bridge.extract.camera import NO_PICTURE
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.tests import baking
from adjgi.tests.cycles_patch import add_light
from adjgi.tests.hostile import SQUARE, mesh
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

POINTS = ((0.3, 0.2, -5.0), (-1.0, 2.0, -3.0), (0.0, 0.0, -8.0), (2.5, -1.5, -6.0))


def add_camera(**values):
    data = bpy.data.cameras.new("camera")
    for key, value in values.items():
        setattr(data, key, value)
    obj = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.scene.camera = obj
    return obj


def extracted():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get()).camera


def project(camera, point):
    """(x, y) in 0..1 from the lower left corner, by the arrays alone."""
    d = np.array(point) - camera.position
    x, y, z = d @ camera.right, d @ camera.up, d @ camera.forward
    if camera.kind == "perspective":
        x, y = x / z, y / z
    left, right, bottom, top = camera.frame
    return (x - left) / (right - left), (y - bottom) / (top - bottom)


# The larger side of the last two is another one in pixels than in length.
SIZES = (((640, 360), (1.0, 1.5)), ((300, 500), (1.0, 1.5)), ((400, 300), (1.0, 1.5)), ((300, 400), (1.5, 1.0)))


@pytest.mark.parametrize(
    ("kind", "fit", "size", "aspect"),
    [(k, f, *s) for k, f, s in itertools.product(("PERSP", "ORTHO"), ("AUTO", "HORIZONTAL", "VERTICAL"), SIZES)],
)
def test_projects_like_blender(kind, fit, size, aspect):
    camera = add_camera(
        type=kind, sensor_fit=fit, lens=35.0, sensor_width=30.0, sensor_height=20.0, ortho_scale=7.0, shift_x=0.13, shift_y=-0.2
    )
    camera.location, camera.rotation_euler, camera.scale = (1.0, -2.0, 0.5), (0.4, 0.2, 1.0), (2.0, 2.0, 2.0)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 50
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    ours = extracted()
    assert (ours.width, ours.height) == (size[0] // 2, size[1] // 2)
    axes = camera.matrix_world.normalized()
    for p in POINTS:
        world = axes @ Vector(p)
        theirs = world_to_camera_view(bpy.context.scene, camera, world)
        np.testing.assert_allclose(project(ours, world), theirs[:2], atol=2e-5)


def test_resolution_replaces_the_render_settings():
    add_camera()
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = 1920, 1080
    camera = extract(bpy.context.evaluated_depsgraph_get(), resolution=(100, 100)).camera
    assert (camera.width, camera.height) == (100, 100)
    left, right, bottom, top = camera.frame
    assert right - left == pytest.approx(top - bottom)


def test_clipping_and_axes():
    camera = add_camera(clip_start=0.5, clip_end=77.0)
    camera.rotation_euler = (0.7, 0.1, 2.0)
    ours = extracted()
    assert (ours.clip_start, ours.clip_end) == (0.5, 77.0)
    axes = np.array([ours.right, ours.up, ours.forward])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.cross(ours.right, ours.up), -np.array(ours.forward), atol=1e-6)


def panorama():
    return add_camera(type="PANO")


def empty_as_camera():
    bpy.context.scene.camera = bpy.data.objects.new("empty", None)
    bpy.context.scene.collection.objects.link(bpy.context.scene.camera)
    return bpy.context.scene.camera


def flat():
    camera = add_camera()
    camera.scale = (1, 0, 1)
    return camera


def no_number():
    return add_camera(shift_x=float("nan"))


@pytest.mark.parametrize("build", [panorama, empty_as_camera, flat, no_number])
def test_a_camera_that_cannot_be_used_refuses_a_picture_and_nothing_else(build, tmp_path):
    camera = build()
    floor = mesh(*SQUARE, name="floor")
    add_light("SUN", energy=2.0, angle=0.0)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert arrays.camera is None
    assert [n.severity for n in arrays.warnings if camera.name in n.names and NO_PICTURE in n.reason] == ["info"]
    for target, objects in (("texture", (floor.name,)), ("render", ())):
        request = baking.request(target=target, objects=objects, resolution=16, values={"samples": 1}, output=str(tmp_path))
        errors = [n.object for n in preflight(bpy.context, request) if n.severity == "error"]
        assert errors == ([camera.name] if target == "render" else [])


def test_no_camera_is_only_said():
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert arrays.camera is None
    assert any("no active camera" in n.reason and n.severity == "info" for n in arrays.warnings)


def test_an_empty_as_camera_is_said_once():
    empty = bpy.data.objects.new("Empty", None)
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.scene.camera = empty
    told = [n.reason for n in extract(bpy.context.evaluated_depsgraph_get()).warnings if n.object == "Empty"]
    assert len(told) == 1 and NO_PICTURE in told[0]
