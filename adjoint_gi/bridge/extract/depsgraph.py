"""From Blender's evaluated depsgraph to plain arrays: the entry point of everything that is computed."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import bpy

from ...core.scene.arrays import SceneArrays
from ..host.notices import Notices
from ..host.versions import working_space_notice
from ..results.show import unhidden
from .camera import read_camera
from .cycles_settings import name_scene_settings
from .image_store import KNOWN
from .instances import InstanceWalk, place
from .lights import read_lights
from .materials import Materials
from .unsupported import name_bright_attributes, name_missing_layers
from .world import read_world


def extract(
    depsgraph: bpy.types.Depsgraph,
    scene: bpy.types.Scene | None = None,
    resolution: tuple[int, int] | None = None,
    real: Mapping[str, bpy.types.Object] | None = None,
) -> SceneArrays:
    """Copy the scene into arrays that own their memory, in metres, world space and Cycles' units.

    Nothing of the user's data is changed and no Blender reference survives. `resolution` (width, height) replaces that of
    the render settings for the camera; instances named in `real` count as the objects that were made of them. What could not be taken
    as it is stands in `warnings`; a scene in which there is nothing to compute gives a notice of severity "error" and empty arrays.
    Call it on the main thread.
    """
    # A depsgraph of a render lists what is hidden in the viewport anyway.
    with unhidden(depsgraph.view_layer) if depsgraph.mode == "VIEWPORT" else contextlib.nullcontext():
        return _extract(depsgraph, scene or depsgraph.scene_eval, resolution, real or {})


def _extract(
    depsgraph: bpy.types.Depsgraph, scene: bpy.types.Scene, resolution: tuple[int, int] | None, real: Mapping[str, bpy.types.Object]
) -> SceneArrays:
    notices = Notices()
    working_space_notice(notices)

    # Step 1: copy meshes, materials and lamps while walking over the instances (temporary objects die after the walk).
    materials = Materials(depsgraph, notices)
    walk = InstanceWalk(materials.index_of, materials.bodiless, notices, real)
    walk.run(depsgraph)

    # Step 2: bring every instance to world space.
    placed = place(walk.groups, materials.colors.uses_default_attribute, notices)

    for name in (name_missing_layers, name_bright_attributes):
        name(placed.objects, placed.object, placed.material, materials.result(), notices)

    # Step 3: what is not geometry.
    name_scene_settings(scene.original, depsgraph.view_layer, notices)
    lights = read_lights(walk.lights, notices)
    background = read_world(depsgraph.view_layer.world_override or scene.world, materials.colors, notices)
    camera = read_camera(scene, depsgraph, resolution, notices)

    KNOWN.settle()
    if not placed.objects:
        if lights or any(background):
            notices.add(scene.name, "has lights but no faces to receive them; every result is black", "Add a mesh object")
        else:
            notices.add(scene.name, "has no faces and no lights", "Add a mesh object that is visible in renders", "error")
    return SceneArrays(
        vertices=placed.vertices,
        triangles=placed.triangles,
        corner_normals=placed.corner_normals,
        smooth=placed.smooth,
        material=placed.material,
        object=placed.object,
        polygon=placed.polygon,
        corners=placed.corners,
        materials=materials.result(),
        objects=placed.objects,
        textures=materials.textures(),
        lights=lights,
        background=background,
        camera=camera,
        warnings=notices.result(),
    )
