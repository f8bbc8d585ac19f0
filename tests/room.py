# SPDX-License-Identifier: GPL-3.0-or-later
"""A room as people model it: with Solidify, Bevel, Array, Mirror and Subdivision, linked duplicates, a curve and a wide ground. Needs bpy.

Nothing in it has a UV layer or applied modifiers. It is the standing test scene of lightmaps, and of the picture in the README.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
import numpy as np

SIZE = (4.0, 5.0, 2.6)  # metres, inside
WINDOW = ((1.2, 2.8), (0.9, 2.0))  # along the wall at y = 5, and up
GROUND = 30.0
MODELLED = ("Walls", "Table", "Planks", "Cupboard", "Plant", "Stool", "Stool Twin")  # meshes with modifiers, or that share one


def build(extras: bool = True) -> bpy.types.Scene:
    """Build the room into the open scene; with `extras` also a leaf card, a glass pane, a lit panel and a camera's view of all."""
    scene = bpy.context.scene
    white, wood, green, grey = (_paint(*x) for x in PAINTS)
    _walls(white)
    _table(wood)
    _planks(wood)
    _cupboard(grey)
    _plant(green)
    _stools(wood)
    _cable(grey)
    half = GROUND / 2
    _quad("Ground", [(-half, -half), (half, -half), (half, half), (-half, half)], -0.15, green)
    if extras:
        _panel()
        _pane()
        _card(green)
    _lights(scene)
    _camera(scene)
    bpy.context.view_layer.update()
    return scene


PAINTS = (
    ("White", (0.75, 0.73, 0.7)),
    ("Wood", (0.45, 0.25, 0.12)),
    ("Green", (0.15, 0.4, 0.12)),
    ("Grey", (0.4, 0.42, 0.46)),
)


def _walls(material: bpy.types.Material) -> None:
    """Floor, ceiling and walls as single faces, seen from inside, with an opening for the window; Solidify makes them thick outwards."""
    x, y, z = SIZE
    (a, b), (c, d) = WINDOW
    v: list[tuple[float, float, float]] = []
    f: list[tuple[int, ...]] = []

    def face(*points: tuple[float, float, float]) -> None:
        f.append(tuple(_index(v, p) for p in points))

    face((0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0))
    face((0, 0, z), (0, y, z), (x, y, z), (x, 0, z))
    face((0, 0, 0), (0, 0, z), (x, 0, z), (x, 0, 0))
    face((0, 0, 0), (0, y, 0), (0, y, z), (0, 0, z))
    face((x, 0, 0), (x, 0, z), (x, y, z), (x, y, 0))
    face((0, y, 0), (x, y, 0), (b, y, c), (a, y, c))
    face((x, y, 0), (x, y, z), (b, y, d), (b, y, c))
    face((x, y, z), (0, y, z), (a, y, d), (b, y, d))
    face((0, y, z), (0, y, 0), (a, y, c), (a, y, d))
    walls = _mesh("Walls", v, f, material)
    thick = walls.modifiers.new("Solidify", "SOLIDIFY")
    thick.thickness, thick.offset = 0.1, -1.0


def _index(vertices: list[tuple[float, float, float]], point: tuple[float, float, float]) -> int:
    if point not in vertices:
        vertices.append(point)
    return vertices.index(point)


def _table(material: bpy.types.Material) -> None:
    """A table of one piece with rounded edges."""
    parts = [((0.0, 0.0, 0.7), (1.4, 0.8, 0.06))]
    parts += [((sx * 0.6, sy * 0.3, 0.34), (0.08, 0.08, 0.66)) for sx in (-1, 1) for sy in (-1, 1)]
    table = _boxes("Table", parts, material)
    table.location = (1.3, 2.4, 0.0)
    bevel = table.modifiers.new("Bevel", "BEVEL")
    bevel.width, bevel.segments = 0.015, 2


def _planks(material: bpy.types.Material) -> None:
    """A wooden wall of one plank, many times."""
    planks = _boxes("Planks", [((0.0, 0.0, 0.0), (0.04, 0.3, 2.0))], material)
    planks.location = (0.03, 1.0, 1.2)
    array = planks.modifiers.new("Array", "ARRAY")
    array.count, array.use_relative_offset, array.use_constant_offset = 9, False, True
    array.constant_offset_displace = (0.0, 0.34, 0.0)


def _cupboard(material: bpy.types.Material) -> None:
    """One half of a cupboard; Mirror makes the other."""
    half = _boxes("Cupboard", [((0.25, 0.0, 0.0), (0.48, 0.4, 1.8)), ((0.03, -0.22, 0.1), (0.02, 0.04, 0.3))], material)
    half.location, half.rotation_euler = (3.75, 2.7, 0.91), (0.0, 0.0, math.radians(-90))
    half.modifiers.new("Mirror", "MIRROR")


def _plant(material: bpy.types.Material) -> None:
    """A coarse plant that Subdivision rounds, by more levels in renders than in the viewport, as Blender sets it."""
    plant = _boxes("Plant", [((0.0, 0.0, 0.2), (0.35, 0.35, 0.4)), ((0.0, 0.0, 0.8), (0.5, 0.5, 0.7))], material)
    plant.location = (3.3, 4.3, 0.0)
    plant.modifiers.new("Subdivision", "SUBSURF")


def _stools(material: bpy.types.Material) -> None:
    """A stool and its linked duplicate."""
    stool = _boxes("Stool", [((0.0, 0.0, 0.4), (0.4, 0.4, 0.05)), ((0.0, 0.0, 0.19), (0.15, 0.15, 0.37))], material)
    stool.location = (2.4, 3.1, 0.0)
    twin = stool.copy()
    twin.name = "Stool Twin"
    twin.location = (1.2, 1.4, 0.0)
    bpy.context.scene.collection.objects.link(twin)


def _cable(material: bpy.types.Material) -> None:
    """The cable of a lamp: a curve with a bevel."""
    curve = bpy.data.curves.new("Cable", "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution, curve.resolution_u = "3D", 0.02, 1, 4
    spline = curve.splines.new("BEZIER")
    spline.bezier_points.add(1)
    for point, place in zip(spline.bezier_points, ((1.3, 2.4, 2.58), (1.5, 2.4, 1.7)), strict=True):
        point.co = place
        point.handle_left_type = point.handle_right_type = "AUTO"
    curve.materials.append(material)
    _link(bpy.data.objects.new("Cable", curve))


def _panel() -> None:
    """A panel on the ceiling that gives light."""
    _quad("Panel", [(1.5, 2.0), (1.5, 3.0), (2.5, 3.0), (2.5, 2.0)], 2.59, _lit("Lit", (1.0, 0.9, 0.75), 6.0))


def _pane() -> None:
    """A pane of glass that stands on the table."""
    glass = _paint("Pane", (1.0, 1.0, 1.0))
    principled = glass.node_tree.nodes["Principled BSDF"]
    principled.inputs["Transmission Weight"].default_value, principled.inputs["Roughness"].default_value = 1.0, 0.0
    principled.inputs["IOR"].default_value = 1.0
    _mesh("Pane", [(1.2, 2.6, 0.735), (1.7, 2.6, 0.735), (1.7, 2.6, 1.1), (1.2, 2.6, 1.1)], [(0, 1, 2, 3)], glass)


def _card(material: bpy.types.Material) -> None:
    """A leaf on a card: round by the alpha of a picture."""
    leaf = material.copy()
    leaf.name = "Leaf"
    nodes, links = leaf.node_tree.nodes, leaf.node_tree.links
    picture = bpy.data.images.new("Leaf", 64, 64, alpha=True)
    y, x = np.mgrid[0:64, 0:64]
    pixels = np.ones((64, 64, 4), np.float32)
    pixels[..., :3] = (0.1, 0.45, 0.1)
    pixels[..., 3] = (x - 31.5) ** 2 + (y - 31.5) ** 2 < 30**2
    picture.pixels.foreach_set(pixels.ravel())
    picture.pack()
    texture = nodes.new("ShaderNodeTexImage")
    texture.image, texture.interpolation = picture, "Closest"
    principled = nodes["Principled BSDF"]
    links.new(texture.outputs["Color"], principled.inputs["Base Color"])
    links.new(texture.outputs["Alpha"], principled.inputs["Alpha"])
    card = _mesh("Card", [(2.6, 4.2, 0.5), (3.1, 4.2, 0.5), (3.1, 4.2, 1.0), (2.6, 4.2, 1.0)], [(0, 1, 2, 3)], leaf)
    layer = card.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))


def _lights(scene: bpy.types.Scene) -> None:
    """A low sun through the window, and a sky."""
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.data.energy, sun.data.angle = 8.0, math.radians(2.0)
    sun.rotation_euler = (math.radians(-55.0), 0.0, math.radians(20.0))
    _link(sun)
    scene.world = scene.world or bpy.data.worlds.new("World")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
    background = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.6, 0.8, 1.0, 1.0)
    background.inputs["Strength"].default_value = 1.0


def _camera(scene: bpy.types.Scene) -> None:
    """Looks from a corner at the window."""
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.lens = 16.0
    camera.location, camera.rotation_euler = (2.9, 0.2, 1.5), (math.radians(82.0), 0.0, math.radians(12.0))
    _link(camera)
    scene.camera = camera


def _paint(name: str, color: tuple[float, float, float]) -> bpy.types.Material:
    """A matt material."""
    made = bpy.data.materials.new(name)
    if made.node_tree is None:
        made.use_nodes = True
    principled = made.node_tree.nodes["Principled BSDF"]
    principled.inputs["Base Color"].default_value = (*color, 1.0)
    principled.inputs["Roughness"].default_value = 1.0
    principled.inputs["Specular IOR Level"].default_value = 0.0
    return made


def _lit(name: str, color: tuple[float, float, float], strength: float) -> bpy.types.Material:
    """A material that gives light."""
    made = _paint(name, (0.8, 0.8, 0.8))
    principled = made.node_tree.nodes["Principled BSDF"]
    principled.inputs["Emission Color"].default_value = (*color, 1.0)
    principled.inputs["Emission Strength"].default_value = strength
    return made


def _boxes(
    name: str, parts: Sequence[tuple[tuple[float, float, float], tuple[float, float, float]]], material: bpy.types.Material
) -> bpy.types.Object:
    """A mesh of boxes, each given by centre and size."""
    corner = np.array([(x, y, z) for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    sides = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    vertices = np.concatenate([corner * size + center for center, size in parts])
    faces = np.concatenate([sides + 8 * k for k in range(len(parts))])
    return _mesh(name, vertices.tolist(), faces.tolist(), material)


def _quad(name: str, corners: Sequence[tuple[float, float]], z: float, material: bpy.types.Material) -> bpy.types.Object:
    """One level face."""
    return _mesh(name, [(x, y, z) for x, y in corners], [(0, 1, 2, 3)], material)


def _mesh(name: str, vertices: Sequence[Sequence[float]], faces: Sequence[Sequence[int]], material: bpy.types.Material) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    mesh.materials.append(material)
    return _link(bpy.data.objects.new(name, mesh))


def _link(obj: bpy.types.Object) -> bpy.types.Object:
    bpy.context.scene.collection.objects.link(obj)
    return obj
