"""From Blender's evaluated depsgraph to plain arrays: the entry point of everything that is computed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import bpy

from ...core.base.digest import digest
from ...core.base.steps import Steps, finish, within
from ...core.scene.arrays import Camera, Light, Material, Rgb, SceneArrays
from ...core.scene.texture import Texture
from ..host import changes
from ..host.notices import Notices
from ..host.preparation import Aside, Stages, Turn
from ..host.versions import working_space_notice
from ..results.show import unhidden
from .camera import read_camera
from .cycles_settings import name_scene_settings
from .image_store import KNOWN
from .instances import InstanceWalk
from .lights import read_lights
from .materials import Materials
from .placed import Group, Walked, place
from .scene_store import SCENES
from .unsupported import name_bright_attributes, name_missing_layers
from .world import read_world

ATTEMPTS = 3  # of which the last reads all at once


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
    reading = Reading(scene or depsgraph.scene_eval, resolution, real or {})
    # A depsgraph of a render lists what is hidden in the viewport anyway.
    with unhidden(depsgraph.view_layer) if depsgraph.mode == "VIEWPORT" else contextlib.nullcontext():
        reading.go_on(depsgraph, lambda: False)
    return finish(reading.arranging())


def extracting(resolution: tuple[int, int] | None = None, real: Mapping[str, bpy.types.Object] | None = None) -> Stages[SceneArrays]:
    """`extract` of the scene of the context in slices: Blender is asked a little at a time, and what is computed runs aside, or is kept
    from the last time, if Blender says the same.

    Where something changes in the scene meanwhile, it is read anew, after some times at once.
    """
    yield "Reading the scene"  # whoever asks has looked at it first
    for attempt in range(ATTEMPTS):
        reading, last = Reading(bpy.context.scene, resolution, real or {}), attempt == ATTEMPTS - 1
        seen = None
        while True:
            depsgraph = bpy.context.evaluated_depsgraph_get()
            now = changes.count(), depsgraph.as_pointer(), bpy.context.scene.session_uid
            if seen not in (None, now):
                break
            seen, turn = now, Turn()
            with unhidden(depsgraph.view_layer):
                # What is shown for the moment is evaluated for it, and gone afterwards.
                at_once = last or changes.count() != now[0]
                if reading.go_on(depsgraph, (lambda: False) if at_once else turn.over, turn.back):
                    return (yield Aside("Placing the meshes", SCENES.arranged(reading.key, reading.arranging)))
            yield "Reading the scene"
    raise AssertionError("the last attempt reads all at once")


class Reading:
    """Copies a scene a little at a time, to arrange it without Blender. `resolution` and `real` as `extract` has them."""

    def __init__(self, scene: bpy.types.Scene, resolution: tuple[int, int] | None, real: Mapping[str, bpy.types.Object]) -> None:
        self._scene, self._resolution, self._notices = scene, resolution, Notices()
        self._materials: Materials | None = None
        self._real = real
        self._copied: Copied | None = None

    def go_on(self, depsgraph: bpy.types.Depsgraph, over: Callable[[], bool], back: Callable[[], None] = lambda: None) -> bool:
        """Ask Blender until `over()`; returns whether all was asked. Nothing may have changed in the depsgraph between two calls. `back` as
        `InstanceWalk.go_on` has it."""
        # Step 1: copy meshes, materials and lamps while walking over the instances (temporary objects die after the walk).
        if self._materials is None:
            working_space_notice(self._notices)
            self._materials = Materials(depsgraph, self._notices)
            self._walk = InstanceWalk(self._materials.index_of, self._materials.bodiless, self._notices, self._real)
        materials, walk, notices = self._materials, self._walk, self._notices
        materials.depsgraph = depsgraph
        if not walk.go_on(depsgraph, over, back):
            return False

        # Step 2: what is not geometry.
        scene = self._scene
        name_scene_settings(scene.original, depsgraph.view_layer, notices)
        lights = read_lights(walk.lights, notices)
        background = read_world(depsgraph.view_layer.world_override or scene.world, materials.colors, notices)
        camera = read_camera(scene, depsgraph, self._resolution, notices)
        KNOWN.settle()
        made, textures, default_color = materials.result(), materials.textures(), materials.colors.uses_default_attribute
        self._copied = Copied(scene.name, walk.walked(), default_color, made, textures, lights, background, camera)
        return True

    def key(self) -> bytes:
        """A digest of what was copied. Needs no Blender."""
        copied = self._copied
        assert copied is not None
        rest = [getattr(copied, f.name) for f in fields(copied) if f.name != "walked"]
        return digest((copied.walked.key(), *rest, self._notices.result()))

    def arranging(self) -> Steps[SceneArrays]:
        """The arrays of what was copied, which is gone afterwards. Needs no Blender."""
        copied, self._copied = self._copied, None
        assert copied is not None
        groups = yield from within(copied.walked.grouping(self._notices), 0.0, 0.7)
        return _arrays(copied, groups, self._notices)


@dataclass(frozen=True, eq=False)
class Copied:
    """What Blender has said, of which nothing refers to its data any more; `default_color` as `place` has it."""

    scene: str
    walked: Walked
    default_color: bool
    materials: tuple[Material, ...]
    textures: tuple[Texture, ...]
    lights: tuple[Light, ...]
    background: Rgb
    camera: Camera | None


def _arrays(copied: Copied, groups: list[Group], notices: Notices) -> SceneArrays:
    """Every instance is brought to world space, and what is missing there is named."""
    placed = place(groups, copied.default_color, notices)
    for name in (name_missing_layers, name_bright_attributes):
        name(placed.objects, placed.object, placed.material, copied.materials, notices)
    if not placed.objects:
        if copied.lights or any(copied.background):
            notices.add(copied.scene, "has lights but no faces to receive them; every result is black", "Add a mesh object")
        else:
            notices.add(copied.scene, "has no faces and no lights", "Add a mesh object that is visible in renders", "error")
    return replace(
        placed,
        materials=copied.materials,
        textures=copied.textures,
        lights=copied.lights,
        background=copied.background,
        camera=copied.camera,
        warnings=notices.result(),
    )
