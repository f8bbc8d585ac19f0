# SPDX-License-Identifier: GPL-3.0-or-later
"""Measuring with Cycles: radiance of a small spot of a plane, by a tiny orthographic render. Needs bpy."""

from __future__ import annotations

import os
import tempfile

import bpy
import numpy as np


def white_plane(size: float = 20.0, material=None):
    """A square in z = 0 facing up, with a UV layer over it; white diffuse unless a material is given."""
    s = size / 2
    mesh = bpy.data.meshes.new("plane")
    mesh.from_pydata([(-s, -s, 0), (s, -s, 0), (s, s, 0), (-s, s, 0)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    mesh.materials.append(material or diffuse_material("white", 1.0))
    obj = bpy.data.objects.new("plane", mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def empty_material(name: str):
    """A material with only an output node."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    return material


def shader_material(name: str, kind: str, **values):
    """A material of one shader node; values are typed into its inputs by name (underscores for spaces)."""
    material = empty_material(name)
    node = material.node_tree.nodes.new(kind)
    for key, value in values.items():
        node.inputs[key.replace("_", " ")].default_value = value
    material.node_tree.links.new(node.outputs[0], material.node_tree.nodes["Material Output"].inputs["Surface"])
    return material


def diffuse_material(name: str, grey: float):
    """A grey ideal diffuser."""
    return shader_material(name, "ShaderNodeBsdfDiffuse", Color=(grey, grey, grey, 1.0))


def add_light(kind: str, location=(0.0, 0.0, 2.0), rotation=(0.0, 0.0, 0.0), scale=(1.0, 1.0, 1.0), **values):
    """A lamp, by default two metres up and shining down."""
    light = bpy.data.lights.new("lamp", kind)
    for key, value in values.items():
        setattr(light, key, value)
    obj = bpy.data.objects.new("lamp", light)
    obj.location, obj.rotation_euler, obj.scale = location, rotation, scale
    bpy.context.scene.collection.objects.link(obj)
    return obj


def rendered(size):
    """(size, size, 3) float32 render of the scene as it is set up, a square of so many pixels, row 0 at the bottom."""
    r = bpy.context.scene.render
    r.image_settings.file_format, r.image_settings.color_depth, r.image_settings.color_mode = "OPEN_EXR", "32", "RGB"
    with tempfile.TemporaryDirectory() as folder:
        r.filepath = os.path.join(folder, "picture.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(r.filepath)
        flat = np.empty(size * size * 4, np.float32)
        image.pixels.foreach_get(flat)
        bpy.data.images.remove(image)
    return flat.reshape(size, size, 4)[:, :, :3]


def render_patch(at=(0.0, 0.0), width=2e-3, pixels=8, samples=64, bounces=0):
    """(pixels, pixels, 3) float32 radiance of the square of that width around `at` in z = 0, seen from just above."""
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("patch")
    camera.type, camera.ortho_scale, camera.clip_start = "ORTHO", width, 1e-3
    obj = bpy.data.objects.new("patch", camera)
    obj.location = (at[0], at[1], 0.05)
    scene.collection.objects.link(obj)
    previous, scene.camera = scene.camera, obj
    r, c = scene.render, scene.cycles
    r.engine, r.resolution_x, r.resolution_y, r.resolution_percentage = "CYCLES", pixels, pixels, 100
    c.device, c.samples, c.use_adaptive_sampling, c.use_denoising = "CPU", samples, False, False
    c.max_bounces, c.filter_width, c.sample_clamp_direct, c.sample_clamp_indirect = bounces, 0.01, 0.0, 0.0
    picture = rendered(pixels)
    bpy.data.objects.remove(obj)
    scene.camera = previous
    return picture


def measured_irradiance(at=(0.0, 0.0), samples=1024, width=2e-3):
    """(3,) irradiance at a point of a white plane, direct light only."""
    return np.pi * render_patch(at, width, samples=samples).mean(axis=(0, 1), dtype=np.float64)
