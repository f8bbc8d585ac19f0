# SPDX-License-Identifier: GPL-3.0-or-later
"""The render engine: F12, `blender -b -f 1` and animations by the method chosen in the scene.

Blender calls `update` while its interface is locked and `render` afterwards, both outside the main thread when there is a window. So
`update` copies the scene, `render` computes on the copy, and neither writes to Blender's data.
"""

from __future__ import annotations

import dataclasses
import time
import traceback

import bpy
import numpy as np

from ...core.base.errors import AdjointError, SceneError, SettingsError
from ...core.base.resources import require_memory
from ...core.base.settings import Settings
from ...core.method.registry import Solver
from ...core.receivers.base import CameraReceivers
from ...core.scene.arrays import Camera, SceneArrays
from ...core.scene.world import World
from ..extract.camera import NO_PICTURE
from ..extract.depsgraph import extract
from ..host import preferences
from ..props.properties import chosen, settings_of
from .passes import Geometry, passes, pixels

ENGINE = "ADJOINT_GI"
REFRESH = 0.5  # seconds between two updates of the picture


@dataclasses.dataclass
class PreparedRender:
    """What `update` leaves for `render`: no Blender reference."""

    arrays: SceneArrays
    solver: Solver
    settings: Settings
    transparent: bool
    layer: str


class ADJOINTGI_RE_engine(bpy.types.RenderEngine):
    """Adjoint GI"""

    bl_idname = ENGINE
    bl_label = "Adjoint GI"
    bl_use_preview = False  # previews of materials are small scenes with a time limit that no method here keeps
    bl_use_shading_nodes_custom = False  # use the shader nodes of Cycles and EEVEE
    bl_use_eevee_viewport = True  # material preview is drawn by EEVEE
    bl_use_postprocess = True  # compositor and sequencer
    bl_use_spherical_stereo = False

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)
        self.prepared: PreparedRender | AdjointError | None = None

    def update(self, data: bpy.types.BlendData, depsgraph: bpy.types.Depsgraph) -> None:
        """Copy the scene."""
        self.prepared = None
        try:
            self.update_stats("Adjoint GI", "Reading the scene")
            self.prepared = prepare(depsgraph, self.resolution_x, self.resolution_y)
        except AdjointError as error:
            self.prepared = error

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Solve and hand over the passes."""
        try:
            if isinstance(self.prepared, AdjointError):
                raise self.prepared
            solve(self, self.prepared or prepare(depsgraph, self.resolution_x, self.resolution_y))
        except AdjointError as error:
            self.refuse(str(error))
        except Exception as error:  # an exception that leaves here would leave an unfinished render without a word
            traceback.print_exc()
            self.refuse(f"{type(error).__name__}: {error}")
        finally:
            self.prepared = None

    def refuse(self, text: str) -> None:
        """Show why there is no picture."""
        self.report({"ERROR"}, text)
        self.error_set(text)

    def update_render_passes(self, scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> None:
        """Name the passes for the compositor."""
        solver = chosen(scene)
        for name, channels, ids, kind in passes(solver.spec if solver else None):
            self.register_pass(scene, view_layer, name, channels, ids, kind)


def prepare(depsgraph: bpy.types.Depsgraph, width: int, height: int) -> PreparedRender:
    """Read everything that `solve` needs; raises `AdjointError` when there can be no picture."""
    scene = depsgraph.scene_eval
    solver = chosen(scene)
    if solver is None:
        raise SettingsError("Method", "no method has this strategy and nature", "Choose one in the render properties")
    if "camera" not in solver.spec.receivers:
        raise SettingsError(solver.spec.label, "does not compute pictures", "Choose another method, or bake")
    if scene.render.use_multiview:
        raise SceneError(scene.name, "stereoscopy is not supported", "Turn it off in the output properties")
    arrays = extract(depsgraph, scene, (width, height))
    for notice in arrays.warnings:
        if notice.severity == "error":
            raise SceneError(notice.object, notice.reason, notice.remedy)
    if arrays.camera is None:
        for notice in arrays.warnings:
            if NO_PICTURE in notice.reason:
                raise SceneError(notice.object, notice.reason, notice.remedy)
        raise SceneError(scene.name, "has no camera that can be used", "Add a perspective or orthographic camera and make it active")
    camera = cropped(arrays.camera, border(scene.render, width, height))
    return PreparedRender(
        dataclasses.replace(arrays, camera=camera),
        solver,
        settings_of(scene, solver.spec.id),
        scene.render.film_transparent,
        depsgraph.view_layer_eval.name,
    )


def border(render: bpy.types.RenderSettings, width: int, height: int) -> tuple[int, int, int, int]:
    """The part of the picture to render, in pixels (left, right, bottom, top), rounded as Blender does it; it refuses less than one."""
    if not render.use_border:
        return (0, width, 0, height)
    left, right = int(render.border_min_x * width), int(render.border_max_x * width)
    bottom, top = int(render.border_min_y * height), int(render.border_max_y * height)
    return (left, right, bottom, top)


def cropped(camera: Camera, part: tuple[int, int, int, int]) -> Camera:
    """The camera that sees only the pixels of `part`."""
    left, right, bottom, top = camera.frame
    x = left + (right - left) * np.array(part[:2]) / camera.width
    y = bottom + (top - bottom) * np.array(part[2:]) / camera.height
    frame = (float(x[0]), float(x[1]), float(y[0]), float(y[1]))
    return dataclasses.replace(camera, frame=frame, width=part[1] - part[0], height=part[3] - part[2])


def solve(engine: ADJOINTGI_RE_engine, prepared: PreparedRender) -> None:
    """Run the method and fill the passes of `engine`; a break leaves no result.

    The steps are advanced here and not by `core.method.driver.Driver`: Blender renders in a thread of its own already, and a break drops
    all, so nothing is needed of what a driver adds (its thread, copies of partial results on a clock, going on after a stop).
    """
    preferences.apply_threads()
    spec = prepared.solver.spec
    world = World(prepared.arrays)
    receivers = CameraReceivers(world)
    require_memory(spec.label, prepared.solver.memory(world, receivers, prepared.settings))
    rng = np.random.default_rng(prepared.settings.seed)
    for name, channels, ids, _ in passes(spec):
        if name != "Combined":  # there from the start
            engine.add_pass(name, channels, ids, layer=prepared.layer)
    result = engine.begin_result(0, 0, receivers.width, receivers.height, layer=prepared.layer)
    done = False
    try:
        geometry = Geometry.of(world, receivers)
        step, shown = None, time.monotonic()
        steps = prepared.solver.solve(world, receivers, prepared.settings, rng)
        for step in steps:
            engine.update_progress(step.fraction)
            engine.update_stats(spec.label, step.text)
            if engine.test_break():
                steps.close()
                return
            if time.monotonic() - shown > REFRESH:
                fill(result, pixels(spec, step.solution(), geometry, prepared.transparent))
                engine.update_result(result)
                shown = time.monotonic()
        if step is None:
            raise SceneError(spec.label, "gave no result", "Report this with the scene")
        solution = step.solution()
        fill(result, pixels(spec, solution, geometry, prepared.transparent))
        for notice in (*prepared.arrays.warnings, *solution.warnings):
            if notice.severity == "warning":
                engine.report({"WARNING"}, str(notice))
        if spec.uses_elements and "elements" not in solution.extra:
            engine.report({"WARNING"}, f"{spec.label} hands over no element radiosity; the pass Elements is black")
        done = True
    finally:
        engine.end_result(result, cancel=not done)


def fill(result: bpy.types.RenderResult, arrays: dict[str, np.ndarray]) -> None:
    """Copy pixel arrays (h * w, channels) float32 into the passes of the same names."""
    for item in result.layers[0].passes:
        if item.name in arrays:
            item.rect.foreach_set(np.ascontiguousarray(arrays[item.name], np.float32).ravel())


def register() -> None:
    """Add the engine."""
    bpy.utils.register_class(ADJOINTGI_RE_engine)


def unregister() -> None:
    """Take it away; scenes that use it fall back to what Blender chooses."""
    bpy.utils.unregister_class(ADJOINTGI_RE_engine)
