# SPDX-License-Identifier: GPL-3.0-or-later
"""The lens is read as Cycles has it: the same blur of a small light, in front of and behind the plane of focus."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import distribution  # noqa: F401
from adjgi.tests.cycles_patch import rendered, shader_material, white_plane

SIZE = 48


def add_camera(kind="PERSP", **dof):
    data = bpy.data.cameras.new("camera")
    data.type, data.lens, data.ortho_scale, data.clip_start = kind, 50.0, 0.8, 0.05
    data.dof.use_dof = True
    for key, value in dof.items():
        setattr(data.dof, key, value)
    obj = bpy.data.objects.new("camera", data)
    obj.location, obj.scale = (0.0, 0.0, 3.0), (2.0, 2.0, 2.0)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.scene.camera = obj
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = SIZE, SIZE, 100
    return obj


def extracted():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get())


def test_values():
    add_camera(aperture_fstop=2.0, focus_distance=1.25)
    camera = extracted().camera
    assert camera.aperture_radius == pytest.approx(0.0125)
    assert camera.focus_distance == pytest.approx(1.25)


def test_focus_object_counts_along_the_view():
    obj = add_camera(aperture_fstop=2.0, focus_distance=1.25)
    target = bpy.data.objects.new("target", None)
    target.location = (5.0, -2.0, 1.0)
    bpy.context.scene.collection.objects.link(target)
    obj.data.dof.focus_object = target
    assert extracted().camera.focus_distance == pytest.approx(2.0)
    target.location = (1.0, 0.0, 3.0)
    arrays = extracted()
    assert arrays.camera.aperture_radius == 0
    assert any("focus" in n.reason for n in arrays.warnings)


def test_focus_follows_a_posed_bone_of_a_moved_armature():
    """The camera looks down from a height of 3; the armature stands at 0.5, its bone at 0.4 along its axis, posed 0.3 higher: 1.8 away."""
    obj = add_camera(aperture_fstop=2.0, focus_distance=1.25)
    rig = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    bone = rig.data.edit_bones.new("Eye")
    bone.head, bone.tail = (0, 0, 0.4), (0, 0, 1.4)
    bpy.ops.object.mode_set(mode="OBJECT")
    rig.location = (1.0, 0.0, 0.5)
    rig.pose.bones["Eye"].location = (0, 0.3, 0)  # along the bone
    obj.data.dof.focus_object, obj.data.dof.focus_subtarget = rig, "Eye"
    assert extracted().camera.focus_distance == pytest.approx(3 - 0.5 - 0.4 - 0.3)
    obj.data.dof.focus_subtarget = ""
    assert extracted().camera.focus_distance == pytest.approx(2.5)


def test_no_depth_of_field_is_a_pinhole():
    add_camera(use_dof=False, aperture_fstop=0.1)
    assert extracted().camera.aperture_radius == 0


def test_blades_are_said():
    add_camera(aperture_blades=6)
    assert any("aperture" in n.reason and n.severity == "info" for n in extracted().warnings)


def moments(picture):
    """Sum, centre and mean square of the distance from it, in pixels, of a (SIZE, SIZE) picture."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    total = picture.sum()
    cx, cy = (picture * x).sum() / total, (picture * y).sum() / total
    return total, cx, cy, (picture * ((x - cx) ** 2 + (y - cy) ** 2)).sum() / total


def cycles_picture():
    r, c = bpy.context.scene.render, bpy.context.scene.cycles
    r.engine = "CYCLES"
    c.device, c.samples, c.use_adaptive_sampling, c.use_denoising, c.max_bounces = "CPU", 1024, False, False, 0
    c.pixel_filter_type, c.filter_width = "BOX", 1.0
    return rendered(SIZE)[:, :, 0].astype(float)


@pytest.mark.parametrize(
    ("kind", "fstop", "focus"), [("PERSP", 0.1, 1.7), ("PERSP", 0.15, 8.0), ("ORTHO", 2.0, 1.7), ("ORTHO", 2.0, 6.0), ("PERSP", 0.1, 3.0)]
)
def test_blur_is_that_of_cycles(kind, fstop, focus):
    plane = white_plane(0.2, shader_material("light", "ShaderNodeEmission", Color=(1, 1, 1, 1), Strength=1.0))
    plane.location = (0.05, -0.03, 0.0)
    add_camera(kind, aperture_fstop=fstop, focus_distance=focus)
    theirs = cycles_picture()
    world = World(extracted())
    solver = method("distribution")

    def picture(**options):
        settings = solver.Settings(max_length=0, **options)
        *_, last = solver.solve(world, CameraReceivers(world), settings, np.random.default_rng(0))
        return last.solution().quantity("radiance")[:, 0].astype(float).reshape(SIZE, SIZE)

    ours, sharp = picture(samples=1024), picture(samples=64, depth_of_field=False)
    (a, ax, ay, a2), (b, bx, by, b2) = moments(ours), moments(theirs)
    assert a == pytest.approx(b, rel=0.02)
    assert (ax, ay) == (pytest.approx(bx, abs=0.15), pytest.approx(by, abs=0.15))
    assert a2 == pytest.approx(b2, rel=0.03)
    if focus == 3.0:
        assert a2 == pytest.approx(moments(sharp)[3], rel=0.03)
    else:
        assert a2 > 1.2 * moments(sharp)[3]
