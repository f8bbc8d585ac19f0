# SPDX-License-Identifier: GPL-3.0-or-later
"""The demonstration scene: a Cornell box of 1 m with two boxes, an area light and coloured walls, built from nothing.

Reflectances are those of Cornell's measured box as commonly given in RGB. Every wall is an object of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, radians

import bpy
from mathutils import Matrix

WHITE = (0.73, 0.73, 0.73)
RED = (0.63, 0.065, 0.05)
GREEN = (0.14, 0.45, 0.091)
LAMP = 0.3  # m, sides of the square light
POWER = 5.0  # W: pictures need no exposure
CELLS = 16  # faces along a wall, so that vertex colours have something to hold
DISTANCE = 1.4  # m, camera in front of the opening

Vector = tuple[float, float, float]


def build_cornell(name: str = "Cornell Box", size: tuple[int, int] = (480, 480)) -> bpy.types.Scene:
    """Add a scene of its own with the box, its light and its camera, and return it; other scenes stay as they are."""
    scene = bpy.data.scenes.new(name)
    white, red, green = (material(n, c) for n, c in (("Cornell White", WHITE), ("Cornell Red", RED), ("Cornell Green", GREEN)))
    quad(scene, "Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), white)
    quad(scene, "Ceiling", (0, 0, 1), (0, 1, 0), (1, 0, 0), white)
    quad(scene, "Back Wall", (0, 1, 0), (1, 0, 0), (0, 0, 1), white)
    quad(scene, "Left Wall", (0, 0, 0), (0, 1, 0), (0, 0, 1), red)
    quad(scene, "Right Wall", (1, 0, 0), (0, 0, 1), (0, 1, 0), green)
    box(scene, "Short Box", (0.67, 0.32), (0.3, 0.3, 0.3), -17.0, white)
    box(scene, "Tall Box", (0.34, 0.64), (0.3, 0.3, 0.6), 17.0, white)

    # The lamp shines down from just below the ceiling; lamps themselves are not seen.
    data = bpy.data.lights.new("Cornell Lamp", "AREA")
    data.shape, data.size, data.energy = "SQUARE", LAMP, POWER
    lamp = bpy.data.objects.new("Lamp", data)
    lamp.location = (0.5, 0.5, 0.999)
    scene.collection.objects.link(lamp)

    data = bpy.data.cameras.new("Cornell Camera")
    data.sensor_fit = "HORIZONTAL"
    data.angle = 2 * atan(0.5 / DISTANCE)  # the opening fills the picture
    camera = bpy.data.objects.new("Camera", data)
    camera.location, camera.rotation_euler = (0.5, -DISTANCE, 0.5), (radians(90), 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera

    scene.world = bpy.data.worlds.new("Cornell World")
    black_world(scene.world)
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    return scene


def material(name: str, color: Vector, emission: Vector | None = None) -> bpy.types.Material:
    """A diffuse material, which also emits `emission` (radiance, W m-2 sr-1)."""
    made = bpy.data.materials.new(name)
    nodes = node_tree(made).nodes
    nodes.clear()
    out, shader = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (*color, 1)
    link = made.node_tree.links.new
    if emission is None:
        link(shader.outputs[0], out.inputs["Surface"])
    else:
        light, add = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeAddShader")
        light.inputs["Color"].default_value = (*emission, 1)
        link(shader.outputs[0], add.inputs[0])
        link(light.outputs[0], add.inputs[1])
        link(add.outputs[0], out.inputs["Surface"])
    made.diffuse_color = (*color, 1)
    return made


def node_tree(owner: bpy.types.Material | bpy.types.World) -> bpy.types.NodeTree:
    """The node tree of a new datablock; before Blender 5.0 it has to be asked for."""
    if owner.node_tree is None:
        owner.use_nodes = True
    return owner.node_tree


def black_world(world: bpy.types.World, color: Vector = (0, 0, 0)) -> None:
    """Make `world` one radiance everywhere."""
    nodes = node_tree(world).nodes
    nodes.clear()
    out, background = nodes.new("ShaderNodeOutputWorld"), nodes.new("ShaderNodeBackground")
    background.inputs["Color"].default_value = (*color, 1)
    world.node_tree.links.new(background.outputs[0], out.inputs["Surface"])


def quad(scene: bpy.types.Scene, name: str, corner: Vector, x: Vector, y: Vector, color: bpy.types.Material) -> bpy.types.Object:
    """A parallelogram of CELLS x CELLS faces with the normal x cross y."""
    points, faces = grid(corner, x, y, CELLS)
    return mesh_object(scene, name, points, faces, color)


def box(
    scene: bpy.types.Scene, name: str, centre: tuple[float, float], size: Vector, degrees: float, color: bpy.types.Material
) -> bpy.types.Object:
    """A box without a bottom that stands on the floor, turned about the vertical, normals outward."""
    a, b, c = size
    low, far, top = (-a / 2, -b / 2, 0), (a / 2, b / 2, 0), (-a / 2, -b / 2, c)
    x, y, z = (a, 0, 0), (0, b, 0), (0, 0, c)
    sides = [(low, x, z), (_sum(low, x), y, z), (far, (-a, 0, 0), z), (_sum(low, y), (0, -b, 0), z), (top, x, y)]
    points, faces = [], []
    for side in sides:
        more, cells = grid(*side, CELLS // 2)
        faces += [tuple(i + len(points) for i in face) for face in cells]
        points += more
    made = mesh_object(scene, name, points, faces, color)
    made.matrix_world = Matrix.Translation((*centre, 0)) @ Matrix.Rotation(radians(degrees), 4, "Z")
    return made


def grid(corner: Vector, x: Vector, y: Vector, cells: int) -> tuple[list[Vector], list[tuple[int, ...]]]:
    """Points and faces of a parallelogram cut into `cells` by `cells` faces."""
    n = cells + 1
    points = [tuple(c + i / cells * p + j / cells * q for c, p, q in zip(corner, x, y, strict=True)) for j in range(n) for i in range(n)]
    faces = [(j * n + i, j * n + i + 1, (j + 1) * n + i + 1, (j + 1) * n + i) for j in range(cells) for i in range(cells)]
    return points, faces


def mesh_object(
    scene: bpy.types.Scene, name: str, points: Sequence[Vector], faces: Sequence[tuple[int, ...]], color: bpy.types.Material
) -> bpy.types.Object:
    """A mesh object in `scene`."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(list(points), [], list(faces))
    mesh.materials.append(color)
    mesh.validate()
    made = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(made)
    return made


def _sum(*vectors: Vector) -> Vector:
    return tuple(sum(parts) for parts in zip(*vectors, strict=True))
