# SPDX-License-Identifier: GPL-3.0-or-later
"""Time to error of a bake: our path tracing against Cycles, on the floor of a Cornell box, in one run on one machine.

    python bench/bake_vs_cycles.py --out out/bake        (a Python with bpy, numpy, embreex)

Both get the same Blender scene, texels, bounces and processor threads, without denoiser, clamping, Filter Glossy and adaptive sampling.
Times are wall clock of everything between the scene in Blender and the finished texels: for Cycles the bake operator (it copies
the scene, builds its BVH, bakes, fills the image); for ours extraction, Embree, the UV raster and the solve. Both are also given
without this preparation: minus the time of one sample. Best of `--repeat`. The reference is a converged Cycles bake. Texels that the
outline of a box cuts are left out: Cycles does not average evenly over a texel there, so the two converge to different values.
Writes table.md, result.json and plot.svg.
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
sys.path[:0] = [str(ROOT / "bench")]
import plot  # noqa: E402

if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract  # noqa: E402
from adjgi.adjoint_gi.core.receivers import texels as lightmap  # noqa: E402
from adjgi.adjoint_gi.core.scene.world import World  # noqa: E402
from adjgi.solvers.path_tracing import PathSettings, PathTracing  # noqa: E402

BOUNCES = 4  # path length 5


def material(name, color, emission=0.0):
    """A diffuse material, or one that only emits."""
    m = bpy.data.materials.new(name)
    if m.node_tree is None:
        m.use_nodes = True
    tree = m.node_tree
    tree.nodes.clear()
    out = tree.nodes.new("ShaderNodeOutputMaterial")
    node = tree.nodes.new("ShaderNodeEmission" if emission else "ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = (*color, 1.0)
    if emission:
        node.inputs["Strength"].default_value = emission
    tree.links.new(node.outputs[0], out.inputs["Surface"])
    return m


def quad(name, corner, x, y, mat):
    """A parallelogram with a UV layer over it; its normal is x cross y."""
    p, a, b = (np.array(v, float) for v in (corner, x, y))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(v) for v in (p, p + a, p + a + b, p + b)], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new(name="UVMap").uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    mesh.materials.append(mat)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


BOXES = {"Short": ((0.67, 0.32), 0.3, 0.3, 0.3, -0.29), "Tall": ((0.34, 0.64), 0.3, 0.3, 0.6, 0.3)}


def whole_texels(resolution: int, grid: int = 16):
    """(h, w) bool: floor texels that no outline of a box cuts."""
    c = (np.arange(resolution * grid) + 0.5) / (resolution * grid)
    x, y = np.meshgrid(c, c)
    covered = np.zeros(x.shape, bool)
    for centre, sx, sy, _, angle in BOXES.values():
        dx, dy = x - centre[0], y - centre[1]
        a, b = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        covered |= (np.abs(a) <= sx / 2) & (np.abs(b) <= sy / 2)
    share = covered.reshape(resolution, grid, resolution, grid).mean(axis=(1, 3))
    return (share == 0) | (share == 1)


def turned_box(name, centre, sx, sy, height, angle, mat):
    """A box without a bottom on the floor."""
    x = np.array([np.cos(angle), np.sin(angle), 0]) * sx
    y = np.array([-np.sin(angle), np.cos(angle), 0]) * sy
    z = np.array([0, 0, height])
    low = np.array([*centre, 0]) - x / 2 - y / 2
    for label, corner, e, f in (("-x", low, z, y), ("+x", low + x, y, z), ("-y", low, x, z), ("+y", low + y, z, x), ("top", low + z, x, y)):
        quad(f"{name} {label}", corner, e, f, mat)


def cornell(light: str):
    """A unit Cornell box open towards -y; returns its floor. `light` is "mesh" (an emitting quad) or "lamp" (an area lamp)."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    white, red = material("White", (0.73, 0.73, 0.73)), material("Red", (0.63, 0.065, 0.05))
    green = material("Green", (0.14, 0.45, 0.091))
    floor = quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), white.copy())
    quad("Ceiling", (0, 0, 1), (0, 1, 0), (1, 0, 0), white)
    quad("Back", (0, 1, 0), (1, 0, 0), (0, 0, 1), white)
    quad("Left", (0, 0, 0), (0, 1, 0), (0, 0, 1), red)
    quad("Right", (1, 0, 0), (0, 0, 1), (0, 1, 0), green)
    for name, shape in BOXES.items():
        turned_box(name, *shape, white)
    if light == "mesh":
        quad("Lamp", (0.35, 0.35, 0.99), (0, 0.3, 0), (0.3, 0, 0), material("Lamp", (1, 1, 1), 15.0))
    else:
        data = bpy.data.lights.new("Lamp", "AREA")
        data.shape, data.size, data.energy = "SQUARE", 0.3, 15.0 * math.pi * 0.09
        obj = bpy.data.objects.new("Lamp", data)
        obj.location = (0.5, 0.5, 0.99)
        scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    return floor


def prepare_cycles(floor, resolution: int, threads: int):
    """Settings that both renderers share; returns the image Cycles bakes into."""
    scene = bpy.context.scene
    c = scene.cycles
    c.device, c.use_adaptive_sampling, c.use_denoising = "CPU", False, False
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = BOUNCES
    c.sample_clamp_direct = c.sample_clamp_indirect = c.blur_glossy = 0.0
    scene.render.threads_mode, scene.render.threads = "FIXED", threads
    image = bpy.data.images.new("bake", resolution, resolution, alpha=False, float_buffer=True)
    tree = floor.data.materials[0].node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    tree.nodes.active = node
    bpy.ops.object.select_all(action="DESELECT")
    floor.select_set(True)
    bpy.context.view_layer.objects.active = floor
    return image


def bake_cycles(image, samples: int, seed: int = 0):
    """Irradiance (h, w, 3) float64 and seconds of one Cycles bake."""
    c = bpy.context.scene.cycles
    c.samples, c.seed = samples, seed
    began = time.perf_counter()
    bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT", "INDIRECT"}, margin=0, use_clear=True)
    flat = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(flat)
    seconds = time.perf_counter() - began
    return flat.reshape(image.size[1], image.size[0], 4)[:, :, :3].astype(float) * np.pi, seconds


def bake_ours(resolution: int, samples: int, seed: int = 0):
    """The same from our path tracing."""
    began = time.perf_counter()
    scene = extract(bpy.context.evaluated_depsgraph_get())
    world = World(scene)
    floor = [i for i, o in enumerate(scene.objects) if o.source == "Floor"]
    texels = lightmap.rasterize(world, floor, resolution=resolution, subsamples=16)
    settings = PathSettings(seed=seed, samples=samples, max_length=BOUNCES + 1)
    for step in PathTracing().solve(world, texels.receivers, settings, np.random.default_rng(seed)):
        last = step
    values = texels.image(last.solution().quantity("irradiance"))
    return values.astype(float), time.perf_counter() - began


def error(values, reference) -> float:
    """Relative root mean square error over the texels that are not cut."""
    whole = whole_texels(len(reference))
    return float(np.sqrt(((values - reference)[whole] ** 2).mean()) / reference[whole].mean())


def time_at(points, target: float, key: str) -> float:
    """Seconds at which the error is `target`, on a line through the logarithms (least squares, as single points are noisy)."""
    x, y = np.log([p["error"] for p in points]), np.log([p[key] for p in points])
    slope, base = np.polyfit(x, y, 1)
    return float(np.exp(base + slope * np.log(target)))


def compare(light: str, options) -> dict:
    """All bakes of one scene."""
    floor = cornell(light)
    image = prepare_cycles(floor, options.resolution, options.threads)
    parts = [bake_cycles(image, options.reference // 4, seed)[0] for seed in range(1000, 1004)]
    reference = np.mean(parts, axis=0)
    noise = error(parts[0], reference) / math.sqrt(3)  # of the mean of the four
    ours_converged, _ = bake_ours(options.resolution, options.reference, seed=2000)
    whole = whole_texels(options.resolution)
    ratio = float(ours_converged[whole].mean() / reference[whole].mean())
    out = {"light": light, "reference_error": noise, "mean_ratio": ratio, "texels": int(whole.sum())}
    out["distance"] = error(ours_converged, reference)

    # Turn and turn about, so that whatever else the machine does meets both.
    bakers = {"cycles": lambda n, s: bake_cycles(image, n, s), "ours": lambda n, s: bake_ours(options.resolution, n, s)}
    for bake in bakers.values():
        bake(1, 0)
    start = {name: min(bake(1, 0)[1] for _ in range(3)) for name, bake in bakers.items()}
    out.update({name: [] for name in bakers})
    for samples in options.samples:
        runs = [{name: bake(samples, seed) for name, bake in bakers.items()} for seed in range(options.repeat)]
        for name in bakers:
            seconds = min(r[name][1] for r in runs)
            measured = float(np.sqrt(np.mean([error(r[name][0], reference) ** 2 for r in runs])))
            # The reference has noise of its own, independent of these.
            true = math.sqrt(max(measured**2 - noise**2, 1e-12))
            out[name].append({"samples": samples, "seconds": seconds, "solve": max(seconds - start[name], 1e-4), "error": true})
            print(f"{light:5s} {name:7s} {samples:5d} samples {seconds:7.2f} s  error {100 * true:6.2f} %", flush=True)
    low = max(min(p["error"] for p in out[k]) for k in ("cycles", "ours"))
    high = min(max(p["error"] for p in out[k]) for k in ("cycles", "ours"))
    out["start"] = start
    out["ratios"] = [
        {"error": e, **{k: time_at(out["ours"], e, k) / time_at(out["cycles"], e, k) for k in ("seconds", "solve")}}
        for e in np.geomspace(high, low, 3)
    ]
    for r in out["ratios"]:
        print(f"{light:5s} time of ours / time of Cycles at {100 * r['error']:.2f} %: {r['seconds']:.2f} in all, {r['solve']:.2f} solving")
    return out


def table(results: list[dict]) -> str:
    """Markdown of all points and ratios."""
    lines = ["| light | renderer | samples | seconds | solving | relative RMSE |", "|---|---|---|---|---|---|"]
    for r in results:
        for name in ("cycles", "ours"):
            for p in r[name]:
                lines.append(
                    f"| {r['light']} | {name} | {p['samples']} | {p['seconds']:.2f} | {p['solve']:.2f} | {100 * p['error']:.2f} % |"
                )
    lines += ["", "| light | at error | time ours / Cycles, in all | solving only |", "|---|---|---|---|"]
    for r in results:
        for q in r["ratios"]:
            lines.append(f"| {r['light']} | {100 * q['error']:.2f} % | {q['seconds']:.2f} | {q['solve']:.2f} |")
    for r in results:
        lines += ["", f"{r['light']}: {r['texels']} texels, mean of ours over the reference {r['mean_ratio']:.4f}, the reference's noise"]
        lines += [f"{100 * r['reference_error']:.2f} %, distance of ours with as many samples {100 * r['distance']:.2f} %"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the comparison and write its files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/bake_vs_cycles"))
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--samples", type=int, nargs="+", default=[16, 64, 256])
    parser.add_argument("--reference", type=int, default=8192, help="samples of the reference bake")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--light", nargs="+", choices=("mesh", "lamp"), default=["mesh", "lamp"])
    options = parser.parse_args()
    results = [compare(light, options) for light in options.light]
    options.out.mkdir(parents=True, exist_ok=True)
    text = table(results)
    print("\n" + text)
    (options.out / "table.md").write_text(text, encoding="utf-8")
    data = {"blender": bpy.app.version_string, "resolution": options.resolution, "threads": options.threads, "results": results}
    (options.out / "result.json").write_text(json.dumps(data, indent=1), encoding="utf-8")
    curves = {f"{n}, {r['light']}": [(p["seconds"], 100 * p["error"]) for p in r[n]] for r in results for n in ("cycles", "ours")}
    (options.out / "plot.svg").write_text(plot.log_log(curves, "seconds", "relative RMSE, %"), encoding="utf-8")


if __name__ == "__main__":
    main()
