# SPDX-License-Identifier: GPL-3.0-or-later
"""Agreement with Cycles on whole scenes: our path tracing and Cycles bake the same texels of the same scene with paths of the same lengths.

    python bench/cycles_agreement.py --out out/agreement --zdm2 ../shared/scenes/zdm2.blend     (a Python with bpy, numpy, embreex)

Both bake every object several times with different seeds; differences are put in relation to the noise that the seeds show. Both use the
UV layer that a bake of ours makes (no overlaps). Cycles bakes a texel when its centre is covered, inside the triangle of its centre, over
the middle half of its width and height (tests/blender/test_cycles_bake.py). So only texels are compared that lie wholly on one triangle,
and on the floor of the Cornell box only those that no outline of a box cuts. zdm2 is a game level of 58,737 triangles, most of them smaller
than a texel. It is lit as ../shared/scenes/SOURCES.md says: a sun of 5 W/m2 and 1 degree, a world of (0.5, 0.7, 1.0); the edges of its
shadows are not left out. Faces are made flat (see `zdm2`). Left out are texels on which two faces of the level coincide.

Writes table.md, result.json and, for each scene, pictures of both results and of the differences in standard errors (red: ours brighter).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import sys
import time
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.bridge.cli import cornell as demo  # noqa: E402
from adjgi.adjoint_gi.bridge.cli.open import leave_edit_mode  # noqa: E402
from adjgi.adjoint_gi.core.images.png import write_png  # noqa: E402
from adjgi.tests import baking  # noqa: E402

BOXES = ("Short Box", "Tall Box")


def cornell():
    """The demonstration scene."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = demo.build_cornell()
    bpy.context.window_manager.windows[0].scene = scene
    return scene


def zdm2(path: Path):
    """The game level, out of the edit mode in which it was saved, with sun and sky."""
    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    leave_edit_mode()
    scene = bpy.context.scene
    lamp = bpy.data.lights.new("Sun", "SUN")
    lamp.energy, lamp.angle = 5.0, math.radians(1.0)
    sun = bpy.data.objects.new("Sun", lamp)
    sun.rotation_euler = tuple(math.radians(a) for a in (40, 20, 0))
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("Sky")
    demo.black_world(scene.world, (0.5, 0.7, 1.0))
    for obj in [o for o in scene.objects if o.type == "MESH"]:
        # Faces are made flat: at edges that more than two faces share Cycles has one normal for each vertex, Blender's corners have more.
        for modifier in [m for m in obj.modifiers if m.type == "NODES"]:
            obj.modifiers.remove(modifier)
        obj.data.shade_flat()
        if not obj.data.materials:  # Cycles needs a material to bake into; this is its default one
            obj.data.materials.append(demo.material("Default", (0.8, 0.8, 0.8)))
    bpy.context.view_layer.update()
    return scene


def run(scene, name: str, options, resolution: int, subsamples: int, length: int) -> dict:
    """Bake everything with both, compare, and write the pictures."""
    baking.use_cycles(scene, length)
    scene.render.threads_mode, scene.render.threads = "FIXED", options.threads
    values = {"samples": options.samples, "max_length": length}
    began = time.perf_counter()
    ours = []
    for seed in range(options.seeds):
        ours.append(baking.lightmaps(baking.request(values={**values, "seed": seed}, resolution=resolution, subsamples=subsamples)))
        print(f"{name}: ours {seed + 1} of {options.seeds}, {time.perf_counter() - began:.0f} s", flush=True)
    seconds = {"ours": time.perf_counter() - began}
    began = time.perf_counter()
    rows, pictures = [], []
    boxes = [scene.objects[b] for b in BOXES if b in scene.objects]
    for label, first in ours[0].items():
        obj = scene.objects[label]
        theirs = [baking.cycles_irradiance(obj, resolution, first.layer, options.samples, seed) for seed in range(options.seeds)]
        used = first.whole & ~baking.outlined(first, boxes)
        coincide = baking.doubled(first) & used
        c = baking.compare([o[label].values for o in ours], theirs, used & ~coincide)
        rows.append(
            {
                "object": label,
                "coincide": int(coincide.sum()),
                "texels": int(c.used.sum()),
                "covered": int((first.share > 0).sum()),
                **numbers(c),
            }
        )
        pictures.append(picture(c))
        print(f"{name}: {row_text(rows[-1])}", flush=True)
    seconds["cycles"] = time.perf_counter() - began
    write_png(options.out / f"{name}.png", np.concatenate(pictures, axis=1), folder=options.out)
    total = {k: sum(r["texels"] * r[k] for r in rows) for k in ("ours", "cycles")}
    return {
        "scene": name,
        "resolution": resolution,
        "samples": options.samples * options.seeds,
        "max_length": length,
        "mean_difference": total["ours"] / total["cycles"] - 1,
        "seconds": seconds,
        "rows": rows,
    }


def numbers(c) -> dict:
    """What is told of one comparison."""
    z = np.abs(c.z)
    return {
        "ours": float(c.ours[c.used].mean()),
        "cycles": float(c.theirs[c.used].mean()),
        "mean_difference": c.mean,
        "mean_error": c.mean_error,
        "noise": c.noise,
        "z_rms": float(np.sqrt((z**2).mean())),
        "z_median": float(np.median(z)),
        "above_2": float((z > 2).mean()),
        "above_4": float((z > 4).mean()),
        "worst_careful": c.worst,
        "limit": c.limit(),
    }


def picture(c):
    """Ours, Cycles' and the differences (-5 to 5 standard errors) above one another."""
    exposure = 0.5 / max(float(c.theirs[c.used].mean()), 1e-9)
    z = np.where(c.used[..., None], (c.ours - c.theirs) / np.maximum(c.error, c.floor), 0.0).mean(axis=2)
    red, blue = np.clip(z / 5, 0, 1), np.clip(-z / 5, 0, 1)
    difference = np.stack([red, 0 * z, blue], axis=2)
    return np.concatenate([difference, c.theirs * exposure, c.ours * exposure]).astype(np.float32)


def row_text(r: dict) -> str:
    """One line of the table."""
    means = f"{r['ours']:.4f} | {r['cycles']:.4f} | {100 * r['mean_difference']:+.2f} +- {100 * r['mean_error']:.2f} %"
    z = f"{r['z_rms']:.2f} | {100 * r['above_2']:.1f} % | {100 * r['above_4']:.2f} % | {r['worst_careful']:.1f} of {r['limit']:.1f}"
    return f"| {r['object']} | {r['texels']} of {r['covered']} | {means} | {100 * r['noise']:.1f} % | {z} |"


def table(results: list[dict]) -> str:
    """Markdown of all scenes."""
    lines = []
    for result in results:
        size = f"{result['resolution']} x {result['resolution']} texels, {result['samples']} samples"
        lines += [f"{result['scene']}: {size}, paths of up to {result['max_length']} segments", ""]
        lines += [
            "| object | texels compared | ours | Cycles | difference of means | noise of a texel | z rms | \\|z\\| > 2 | > 4 | worst |"
        ]
        lines += ["|---|---|---|---|---|---|---|---|---|---|", *(row_text(r) for r in result["rows"])]
        lines += ["", f"All: {100 * result['mean_difference']:+.2f} %", ""]
    return "\n".join(lines)


def main() -> None:
    """Run the comparisons and write their files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/agreement"))
    parser.add_argument("--scenes", nargs="+", choices=("cornell", "zdm2"), default=["cornell", "zdm2"])
    parser.add_argument("--zdm2", type=Path, default=ROOT.parent / "shared/scenes/zdm2.blend", help="the game level")
    parser.add_argument("--cornell-resolution", type=int, default=128)
    parser.add_argument("--zdm2-resolution", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=16, help="of each bake")
    parser.add_argument("--seeds", type=int, default=8, help="bakes by each renderer")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    options.out = options.out.absolute()
    options.out.mkdir(parents=True, exist_ok=True)
    results = []
    if "cornell" in options.scenes:
        results.append(run(cornell(), "cornell", options, options.cornell_resolution, 16, 5))
    if "zdm2" in options.scenes:
        if not options.zdm2.is_file():
            parser.error(f"{options.zdm2} does not exist: name the file with --zdm2, or leave it out with --scenes cornell")
        results.append(run(zdm2(options.zdm2), "zdm2", options, options.zdm2_resolution, 4, 4))
    text = table(results)
    print("\n" + text)
    (options.out / "table.md").write_text(text, encoding="utf-8")
    data = {"blender": bpy.app.version_string, "numpy": np.__version__, "results": results}
    (options.out / "result.json").write_text(json.dumps(data, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
