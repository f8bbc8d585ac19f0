# SPDX-License-Identifier: GPL-3.0-or-later
"""How files by others look once baked: each through the camera by Cycles, as it was and with the result shown, as one picture.

    python bench/real_rooms.py FOLDER_OR_FILE ... [--samples 16] [--resolution 512] [--width 480] [--seconds 300] [--out out/real_rooms]

Each file is opened, rendered, baked to one atlas by the default method with so many samples a texel, shown, and rendered again (a
Python with bpy). Printed are the seconds of the bake and, of the pixels that are no background, how many are darker than half and how many
brighter than twice what Cycles shows. Of gloss and what is seen through, which no lightmap holds, that is no fault; the pictures
OUT/NAME.png (left as it was, right as baked) tell which. A folder is searched for .blend files; those without a camera are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def rendered(scene, path: Path, width: int):
    """(height, width, 3) float32: linear picture of Cycles through the camera; what Blender would save of it is saved as `path`."""
    import bpy
    import numpy as np

    scale = width / scene.render.resolution_x
    size = width, max(1, round(scene.render.resolution_y * scale))
    old = scene.render.resolution_x, scene.render.resolution_y
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    scene.render.use_border = False
    settings = scene.render.image_settings
    for name, value in {"media_type": "IMAGE", "file_format": "OPEN_EXR"}.items():
        if hasattr(settings, name):
            setattr(settings, name, value)
    scene.render.filepath = str(path.with_suffix(".exr"))
    bpy.ops.render.render(write_still=True)
    scene.render.resolution_x, scene.render.resolution_y = old
    image = bpy.data.images.load(scene.render.filepath)
    settings.file_format = "PNG"
    bpy.data.images["Render Result"].save_render(str(path), scene=scene)
    pixels = np.empty(size[0] * size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(size[1], size[0], 4)[..., :3]


def one(path: Path, options: argparse.Namespace) -> None:
    """Render, bake and render one file; print its line."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
    import bpy
    import numpy as np

    sys.modules["adjgi"].register()
    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    scene = bpy.context.scene
    if scene.camera is None:
        sys.exit("no camera")
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_denoising, cycles.time_limit = "CPU", 64, True, 40.0
    cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 64
    scene.render.use_sequencer = scene.render.use_compositing = False
    options.out.mkdir(parents=True, exist_ok=True)
    name = "_".join(path.with_suffix("").parts[-2:]).replace(" ", "_")
    before = rendered(scene, options.out / f"{name}_cycles.png", options.width)
    state = scene.adjoint_gi
    state.selection_only, state.atlas, state.resolution = False, True, options.resolution
    state.settings_path_tracing.samples = options.samples
    began = time.perf_counter()
    bpy.ops.adjoint_gi.bake()
    seconds = time.perf_counter() - began
    bpy.ops.adjoint_gi.show_result()
    after = rendered(scene, options.out / f"{name}_baked.png", options.width)
    light = before.mean(axis=2), after.mean(axis=2)
    seen = np.maximum(*light) > 0.02 * light[0].mean()
    dark, bright = ((seen & wrong).sum() / seen.sum() for wrong in (light[1] < 0.5 * light[0], light[1] > 2.0 * light[0]))
    mean = after.mean() / before.mean()
    print(f"LINE {name}: {seconds:.0f} s; darker than half {dark:.1%}, brighter than twice {bright:.1%}, mean {mean:.3f}")
    sheet = np.concatenate([png(options.out / f"{name}_{which}.png") for which in ("cycles", "baked")], axis=1)
    image = bpy.data.images.new("sheet", sheet.shape[1], sheet.shape[0])
    image.pixels.foreach_set(np.ascontiguousarray(sheet).ravel())
    image.file_format, image.filepath_raw = "PNG", str(options.out / f"{name}.png")
    image.save()


def png(path: Path):
    """(height, width, 4) float32: values of a PNG as they stand in it."""
    import bpy
    import numpy as np

    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)


def main() -> None:
    """One process a file, since a file by others can take Blender down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--seconds", type=float, default=300.0, help="for each file")
    parser.add_argument("--out", type=Path, default=Path("out/real_rooms"))
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        return one(options.files[0], options)
    files = [file for path in options.files for file in (sorted(path.rglob("*.blend")) if path.is_dir() else [path])]
    for path in files:
        common = [f"--{name}={getattr(options, name)}" for name in ("samples", "resolution", "width", "out")]
        command = [sys.executable, __file__, str(path), "--here", *common]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=options.seconds)
        except subprocess.TimeoutExpired:
            print(f"{path.name}: stopped after {options.seconds:g} s", flush=True)
            continue
        line = next((line[5:] for line in done.stdout.splitlines() if line.startswith("LINE ")), None)
        why = (done.stderr.strip().splitlines() or [""])[-1]
        print(line or f"{path.name}: exit code {done.returncode}, {why}", flush=True)
    return None


if __name__ == "__main__":
    main()
