# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `demo`: the Cornell box baked by several methods and to every target, as files that a person can open."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import bpy
import numpy as np

from ...core.base.errors import SettingsError
from ...core.images.exr import write_exr
from ...core.images.png import write_png
from ...core.method import registry
from ...core.receivers.base import CameraReceivers
from ...core.scene.arrays import Source
from ...core.scene.shading import source_at
from ...core.scene.world import World
from ..baking.bake import Bake, BakeRequest
from ..baking.report import of_bake
from ..extract.depsgraph import extract
from ..host import files
from .arguments import INTERRUPTED, use_threads
from .bake import require_blend, save_blend, solve, summary, write_report
from .cornell import build_cornell
from .progress import seconds_text
from .streams import say

ATTRIBUTE = "AdjointGI"
# What the pictures and the lightmap need to look finished; methods that are not named run with their defaults.
QUICK = {
    ("path_tracing", "render"): {"samples": "32"},
    ("path_tracing", "texture"): {"samples": "64"},
    ("particle_tracing", "render"): {"particles": "2000000"},
}
LARGEST = 4096


def demo(options: argparse.Namespace) -> int:
    """Build, bake, write, and say what to open; 130 when it was interrupted."""
    if not 16 <= options.size <= LARGEST:
        raise SettingsError("--size", f"{options.size} is not possible", f"Give 16 to {LARGEST}")
    wanted = [s.spec.id for s in registry.methods() if "camera" in s.spec.receivers] if options.methods == ["all"] else options.methods
    for name in wanted:
        registry.method(name)  # refuses a name that is no method before anything is baked
    use_threads(options.threads)
    began = time.perf_counter()
    folder = files.output_folder(str(files.absolute(options.output)))
    if not options.in_blender:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = build_cornell(size=(options.size, options.size))
    if not options.in_blender:
        # The file that is saved must open on the box, not on the empty scene of the start.
        for other in [s for s in bpy.data.scenes if s != scene]:
            bpy.data.scenes.remove(other)
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        return _bake_all(wanted, folder, began)


def _bake_all(methods: list[str], folder: Path, began: float) -> int:
    """All bakes of the open Cornell box into `folder`; returns the exit code."""
    opened: list[tuple[str, Path]] = []
    reports = []

    # Step 1: the picture by each method.
    for method in methods:
        made = _bake(method, "render", folder)
        if made is None:
            return INTERRUPTED
        reports.append(of_bake(made))
        opened.append((f"picture by {made.driver.solver.spec.label}", Path(made.files[1])))

    # Step 2: a lightmap for all objects by path tracing, and vertex colours by progressive radiosity.
    made = _bake("path_tracing", "texture", folder, resolution=256, atlas=True)
    if made is None:
        return INTERRUPTED
    reports.append(of_bake(made))
    opened += [("lightmap atlas by Path Tracing", Path(made.files[2])), ("its parts, as layers", Path(made.files[1]))]
    made = _bake("progressive_radiosity", "attribute", folder, quantity="radiosity", attribute=ATTRIBUTE)
    if made is None:
        return INTERRUPTED
    reports.append(of_bake(made))
    opened.append(("vertex colours, as the camera sees them", attribute_picture(folder)))

    # Step 3: the scene with everything in it, and the numbers.
    blend = folder / "cornell.blend"
    require_blend(blend, overwrite=is_demo(blend))
    save_blend(blend)
    write_report(folder / "report.json", {"format": 1, "bakes": reports, "versions": reports[0]["versions"]})
    opened.append(("the scene with lightmap and vertex colours", blend))
    say()
    say(f"{len(reports)} bakes in {seconds_text(time.perf_counter() - began)}. To open:")
    for what, path in opened:
        say(f"  {path}  {what}")
    return 0


def _bake(method: str, target: str, folder: Path, **values: object) -> Bake | None:
    """One bake, written; None when it was interrupted (what there is has been written)."""
    settings = registry.method(method).Settings().replaced(QUICK.get((method, target), {}))
    made = Bake(bpy.context, BakeRequest(method, settings, target, output=str(folder), **values))
    failure = solve(made)
    if failure is not None:
        raise failure
    solution = made.driver.solution()
    if solution is not None:
        made.write(solution)
        say(summary(made))
    if made.driver.state != "finished":
        say("interrupted", error=True)
        return None
    return made


def is_demo(path: Path) -> bool:
    """Whether a file is a Cornell box that this command has saved."""
    if not path.is_file():
        return False
    try:
        with bpy.data.libraries.load(str(path)) as (inside, _):
            return "Cornell Box" in inside.scenes and "Cornell Lamp" in inside.lights
    except OSError:  # not a .blend file
        return False


def attribute_picture(folder: Path) -> Path:
    """What the camera sees of the colour attribute alone, interpolated over faces as Blender does: EXR and PNG; returns the PNG."""
    context = bpy.context
    world = World(extract(context.evaluated_depsgraph_get(), context.scene))
    receivers = CameraReceivers(world)
    total = np.zeros((receivers.count, 3))
    source = Source("attribute", ATTRIBUTE)
    for points in receivers.sites():
        hit = np.flatnonzero(points.triangle >= 0)
        seen = source_at(source, world.scene, points.triangle[hit], points.u[hit], points.v[hit])
        # Only the front of a face carries the attribute's light.
        front = np.einsum("ij,ij->i", world.rows[points.triangle[hit], 9:12], points.towards[hit]) > 0
        for c in range(3):
            total[:, c] += np.bincount(points.receiver[hit], seen[:, c] * front, minlength=receivers.count)
    radiance = (total / (np.pi * receivers.grid**2)).astype(np.float32)
    image = radiance.reshape(receivers.height, receivers.width, 3)
    write_exr(files.output_file(folder, "vertex colors", ".exr"), image, folder=folder)
    return write_png(files.output_file(folder, "vertex colors", ".png"), image, folder=folder)
