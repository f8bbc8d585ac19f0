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
from .image_store import KNOWN, Wanted
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
    reading = Reading(scene or depsgraph.scene_eval, resolution, real or {}, aside=False)
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
        last = attempt == ATTEMPTS - 1
        reading, seen = Reading(bpy.context.scene, resolution, real or {}, aside=not last), None
        while True:
            depsgraph, now = _looked()
            if seen not in (None, now):
                break
            turn = Turn()
            with unhidden(depsgraph.view_layer):
                # What is shown for the moment is evaluated for it, and gone afterwards.
                at_once = last or changes.count() != now[0]
                stage = reading.go_on(depsgraph, (lambda: False) if at_once else turn.over, turn.back)
            if stage is None:
                return (yield Aside("Placing the meshes", SCENES.arranged(reading.key, reading.arranging)))
            seen = _looked()[1] if at_once else now
            yield stage
    raise AssertionError("the last attempt reads all at once")


def _looked() -> tuple[bpy.types.Depsgraph, tuple]:
    """The depsgraph of the context, evaluated, and what is another after every change in it."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return depsgraph, (changes.count(), depsgraph.as_pointer(), bpy.context.scene.session_uid)


class Reading:
    """Copies a scene a little at a time, to arrange it without Blender. `resolution` and `real` as `extract` has them, `aside` as
    `Images`."""

    def __init__(
        self, scene: bpy.types.Scene, resolution: tuple[int, int] | None, real: Mapping[str, bpy.types.Object], aside: bool
    ) -> None:
        self._scene, self._resolution, self._notices, self._aside = scene, resolution, Notices(), aside
        self._materials: Materials | None = None
        self._real = real
        self._lights: tuple[Light, ...] | None = None  # once the walk is over
        self._copied: Copied | None = None

    def go_on(
        self, depsgraph: bpy.types.Depsgraph, over: Callable[[], bool], back: Callable[[], None] = lambda: None
    ) -> Aside | str | None:
        """Ask Blender until `over()`, or until something has to be computed before it is asked more; returns the stage that comes before
        the next call, None when all was asked. Nothing may have changed in the depsgraph between two calls. `back` as `InstanceWalk.go_on`
        has it."""
        # Step 1: copy meshes, materials and lamps while walking over the instances (temporary objects die after the walk).
        if self._materials is None:
            working_space_notice(self._notices)
            self._materials = Materials(depsgraph, self._notices, self._aside)
            self._walk = InstanceWalk(self._materials.index_of, self._materials.bodiless, self._notices, self._real)
        materials, walk, notices = self._materials, self._walk, self._notices
        materials.depsgraph = depsgraph
        scene = self._scene
        if self._lights is None:
            if not walk.go_on(depsgraph, over, back):
                return "Reading the scene"
            name_scene_settings(scene.original, depsgraph.view_layer, notices)
            self._lights = read_lights(walk.lights, notices)  # now: lamps that are shown for the moment are gone afterwards

        # Step 2: what has pixels.
        try:
            if not materials.go_on(over):
                return "Reading the scene"
            background = read_world(depsgraph.view_layer.world_override or scene.world, materials.colors, notices)
        except Wanted as wanted:
            return wanted.aside()

        # Step 3: the rest.
        camera = read_camera(scene, depsgraph, self._resolution, notices)
        KNOWN.settle()
        made, textures, default_color = materials.result(), materials.textures(), materials.colors.uses_default_attribute
        self._copied = Copied(scene.name, walk.walked(), default_color, made, textures, self._lights, background, camera)
        return None

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
