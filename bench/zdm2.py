# SPDX-License-Identifier: GPL-3.0-or-later
"""A real scene by every method and to every target: the game level zdm2 (58,697 triangles) in sun and sky, from the command line.

    python bench/zdm2.py --out out/zdm2 [--methods path_tracing ...] [--targets texture attribute render]

The level has neither light nor camera. It gets a sun of 5 W/m2, 1 degree wide, rotated by (40, 20, 0) degrees, a sky of the constant
radiance (0.5, 0.7, 1.0), and a camera in its vaulted gallery. Each bake is a process of its own, so that its peak memory is its own.
What a method refuses is a row as well. Writes table.md, result.json, and the pictures.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT.parent / "shared" / "scenes" / "zdm2.blend"
LOAD = """
import importlib.util, sys
root = sys.argv.pop(1)
spec = importlib.util.spec_from_file_location("adjgi", root + "/__init__.py", submodule_search_locations=[root])
sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["adjgi"])
"""
CONSOLE = LOAD + "from adjgi.adjoint_gi.bridge.cli.main import console\nconsole()\n"
TARGETS = {
    "texture": ["--resolution", "512"],
    "attribute": ["--domain", "CORNER", "--new-object"],  # its modifiers triangulate it
    "render": ["--size", "480x270"],
}
# Work that looks finished; methods that are not named run with their defaults.
SETTINGS = {
    "path_tracing": {"texture": {"samples": 64}, "attribute": {"samples": 64}, "render": {"samples": 64}},
    "particle_tracing": {t: {"particles": 4_000_000} for t in TARGETS},
}
CAMERA, LOOK_AT, LENS = (22.0, 9.0, 8.0), (0.0, 6.0, 5.0), 22.0


def light_scene(source: Path, target: Path) -> None:
    """Save `source` with its sun, sky and camera as `target`. Runs in a process of its own."""
    import bpy
    from adjgi.adjoint_gi.bridge.cli.cornell import black_world
    from mathutils import Vector

    bpy.ops.wm.open_mainfile(filepath=str(source), use_scripts=False)
    scene = bpy.context.scene
    data = bpy.data.lights.new("Sun", "SUN")
    data.energy, data.angle = 5.0, math.radians(1.0)
    sun = bpy.data.objects.new("Sun", data)
    sun.rotation_euler = [math.radians(a) for a in (40.0, 20.0, 0.0)]
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("Sky")
    black_world(scene.world, (0.5, 0.7, 1.0))
    data = bpy.data.cameras.new("Camera")
    data.lens = LENS
    camera = bpy.data.objects.new("Camera", data)
    camera.location = CAMERA
    camera.rotation_euler = (Vector(LOOK_AT) - Vector(CAMERA)).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera
    bpy.ops.wm.save_as_mainfile(filepath=str(target), copy=True)


def run(arguments: list[str], seconds: int) -> tuple[int, str, float]:
    """Run the console command; returns exit code, its last line of words, and wall seconds."""
    began = time.perf_counter()
    command = [sys.executable, "-c", CONSOLE, str(ROOT), *arguments]
    process = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
    text = process.stderr if process.returncode else process.stdout
    lines = [line for line in text.splitlines() if line.strip()]
    said = next((line for line in reversed(lines) if line.startswith(("error:", "finished:"))), lines[-1] if lines else "")
    return process.returncode, said, time.perf_counter() - began


def bake(scene: Path, method: str, target: str, out: Path, seconds: int) -> dict:
    """One bake; a row of the table."""
    folder = out / method
    folder.mkdir(parents=True, exist_ok=True)
    report = folder / f"{target}.json"
    arguments = ["bake", str(scene), "--method", method, "--target", target, "--report", str(report), *TARGETS[target]]
    arguments += ["--save-blend", str(folder / "attribute.blend"), "--overwrite"] if target == "attribute" else ["--output", str(folder)]
    for key, value in SETTINGS.get(method, {}).get(target, {}).items():
        arguments += ["--set", f"{key}={value}"]
    code, said, wall = run(arguments, seconds)
    row = {"method": method, "target": target, "exit_code": code, "wall_seconds": wall, "said": said}
    if code == 0:
        found = json.loads(report.read_text(encoding="utf-8"))
        row |= {key: found[key] for key in ("seconds", "rays", "longest_step_seconds", "mean", "energy_balance", "settings")}
        row |= {"receivers": found["scene"]["receivers"], "peak_bytes": found["memory"]["peak_bytes"]}
        row |= {"estimated_bytes": found["memory"]["estimated_bytes"], "files": [Path(f).name for f in found["files"]]}
        row["notices"] = [f"{n['object']}: {n['reason']}" for n in found["warnings"]]
    return row


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        "| method | target | receivers | solve s | whole process s | million rays | longest step s | peak MB | mean RGB |",
        "|---|---|--:|--:|--:|--:|--:|--:|---|",
    ]
    for r in rows:
        if r["exit_code"]:
            lines.append(f"| {r['method']} | {r['target']} | | | {r['wall_seconds']:.1f} | | | | exit {r['exit_code']}: {r['said']} |")
            continue
        mean = r["mean"].get("irradiance") or r["mean"]["radiance"]
        numbers = (
            f"{r['receivers']:,} | {r['seconds']:.1f} | {r['wall_seconds']:.1f} | {r['rays'] / 1e6:.1f} | {r['longest_step_seconds']:.2f}"
        )
        lines.append(f"| {r['method']} | {r['target']} | {numbers} | {r['peak_bytes'] / 1e6:.0f} | {', '.join(f'{x:.3f}' for x in mean)} |")
    return "\n".join(lines)


def main() -> None:
    """Light the scene, bake, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "zdm2")
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--methods", nargs="+", default=["path_tracing", "particle_tracing", "matrix_radiosity", "progressive_radiosity"])
    parser.add_argument("--targets", nargs="+", choices=tuple(TARGETS), default=list(TARGETS))
    parser.add_argument("--limit", type=int, default=1800, help="seconds for one bake")
    options = parser.parse_args()
    if not options.scene.is_file():
        sys.exit(f"{options.scene} is missing: name the level with --scene (see the sources in the documentation)")
    options.out.mkdir(parents=True, exist_ok=True)
    lit = options.out.absolute() / "zdm2-lit.blend"
    make = f"sys.path[:0] = [{str(ROOT / 'bench')!r}]\nimport os, zdm2\nfrom pathlib import Path\n"
    make += f"zdm2.light_scene(Path({str(options.scene)!r}), Path({str(lit)!r}))\nsys.stdout.flush()\nos._exit(0)\n"
    subprocess.run([sys.executable, "-c", LOAD + make, str(ROOT)], check=True, timeout=300, stdout=subprocess.DEVNULL)

    rows = []
    for method in options.methods:
        for target in options.targets:
            rows.append(bake(lit, method, target, options.out.absolute(), options.limit))
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    about = {"scene": "zdm2, 58,697 triangles, sun and sky", "cores": os.cpu_count(), "python": sys.version.split()[0], "rows": rows}
    (options.out / "result.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    (options.out / "table.md").write_text(table(rows) + "\n", encoding="utf-8")
    print(f"\n{table(rows)}\n\nwrote {options.out}")


if __name__ == "__main__":
    main()
