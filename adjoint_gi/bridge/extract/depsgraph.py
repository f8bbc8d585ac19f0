"""From Blender's evaluated depsgraph to plain arrays: the entry point of everything that is computed."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass

import bpy

from ...core.scene.arrays import Camera, Light, Material, Rgb, SceneArrays
from ...core.scene.texture import Texture
from ..host.notices import Notices
from ..host.preparation import Aside, Stages, finish_stages, once
from ..host.versions import working_space_notice
from ..results.show import unhidden
from .camera import read_camera
from .cycles_settings import name_scene_settings
from .image_store import KNOWN
from .instances import Group, InstanceWalk, place
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
    return finish_stages(extracting(depsgraph, scene, resolution, real))


def extracting(
    depsgraph: bpy.types.Depsgraph,
    scene: bpy.types.Scene | None = None,
    resolution: tuple[int, int] | None = None,
    real: Mapping[str, bpy.types.Object] | None = None,
) -> Stages[SceneArrays]:
    """`extract` in two slices: Blender is asked at once, up to the first yield; what is computed of copied arrays runs aside."""
    notices = Notices()
    # A depsgraph of a render lists what is hidden in the viewport anyway.
    with unhidden(depsgraph.view_layer) if depsgraph.mode == "VIEWPORT" else contextlib.nullcontext():
        found = _ask(depsgraph, scene or depsgraph.scene_eval, resolution, real or {}, notices)
    return (yield Aside("Placing the meshes", once(lambda: _arrays(found, notices))))


@dataclass(frozen=True, eq=False)
class Copied:
    """What Blender has said, of which nothing refers to its data any more; `default_color` as `place` has it."""

    scene: str
    groups: list[Group]
    default_color: bool
    materials: tuple[Material, ...]
    textures: tuple[Texture, ...]
    lights: tuple[Light, ...]
    background: Rgb
    camera: Camera | None


def _ask(
    depsgraph: bpy.types.Depsgraph,
    scene: bpy.types.Scene,
    resolution: tuple[int, int] | None,
    real: Mapping[str, bpy.types.Object],
    notices: Notices,
) -> Copied:
    """Everything that needs Blender."""
    working_space_notice(notices)

    # Step 1: copy meshes, materials and lamps while walking over the instances (temporary objects die after the walk).
    materials = Materials(depsgraph, notices)
    walk = InstanceWalk(materials.index_of, materials.bodiless, notices, real)
    walk.run(depsgraph)

    # Step 2: what is not geometry.
    name_scene_settings(scene.original, depsgraph.view_layer, notices)
    lights = read_lights(walk.lights, notices)
    background = read_world(depsgraph.view_layer.world_override or scene.world, materials.colors, notices)
    camera = read_camera(scene, depsgraph, resolution, notices)
    KNOWN.settle()
    made, textures, default_color = materials.result(), materials.textures(), materials.colors.uses_default_attribute
    return Copied(scene.name, walk.groups, default_color, made, textures, lights, background, camera)


def _arrays(copied: Copied, notices: Notices) -> SceneArrays:
    """Everything that does not: every instance is brought to world space, and what is missing there is named."""
    placed = place(copied.groups, copied.default_color, notices)
    for name in (name_missing_layers, name_bright_attributes):
        name(placed.objects, placed.object, placed.material, copied.materials, notices)
    if not placed.objects:
        if copied.lights or any(copied.background):
            notices.add(copied.scene, "has lights but no faces to receive them; every result is black", "Add a mesh object")
        else:
            notices.add(copied.scene, "has no faces and no lights", "Add a mesh object that is visible in renders", "error")
    return SceneArrays(
        vertices=placed.vertices,
        triangles=placed.triangles,
        corner_normals=placed.corner_normals,
        smooth=placed.smooth,
        material=placed.material,
        object=placed.object,
        polygon=placed.polygon,
        corners=placed.corners,
        materials=copied.materials,
        objects=placed.objects,
        textures=copied.textures,
        lights=copied.lights,
        background=copied.background,
        camera=copied.camera,
        warnings=notices.result(),
    )
