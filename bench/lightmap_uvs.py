# SPDX-License-Identifier: GPL-3.0-or-later
"""Lightmap UVs by xatlas against our own projections, which made them before: share of the image covered, charts, faults, seconds.

    python bench/lightmap_uvs.py --out out/lightmap_uvs [--zdm2 ../shared/scenes/zdm2.blend]      (needs the bpy wheel)

Suzanne, a torus and a game level by themselves; 20 boxes and 60 props that share one atlas. "Before" each object of an atlas was unwrapped
into a square of its own, which was then scaled into the atlas, and so was the space between its charts. Writes table.md and result.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
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
from adjgi.adjoint_gi.bridge.results.faces import copy_faces  # noqa: E402
from adjgi.adjoint_gi.core.receivers.charts import area_vectors  # noqa: E402
from adjgi.adjoint_gi.core.receivers.pack import place_objects  # noqa: E402
from adjgi.adjoint_gi.core.receivers.unwrap import by_projection, unwrap  # noqa: E402
from adjgi.adjoint_gi.core.receivers.uv_check import check  # noqa: E402

PADDING = 4
SHAPES = {
    "box": lambda: bpy.ops.mesh.primitive_cube_add(),
    "cylinder": lambda: bpy.ops.mesh.primitive_cylinder_add(vertices=32),
    "cone": lambda: bpy.ops.mesh.primitive_cone_add(vertices=24),
    "ball": lambda: bpy.ops.mesh.primitive_uv_sphere_add(segments=24, ring_count=12),
    "torus": lambda: bpy.ops.mesh.primitive_torus_add(major_segments=32, minor_segments=12),
    "suzanne": lambda: bpy.ops.mesh.primitive_monkey_add(),
}


def add(shape: str, scale=(1.0, 1.0, 1.0)):
    """What is unwrapped of a primitive of Blender."""
    SHAPES[shape]()
    obj = bpy.context.view_layer.objects.active
    obj.scale = scale
    bpy.context.view_layer.update()
    return copy_faces(obj, obj.data).faces().mesh


def boxes():
    """20 boxes of random sizes."""
    return [add("box", scale) for scale in np.random.default_rng(1).uniform(0.3, 1.5, (20, 3))]


def props():
    """60 objects: ten of each shape, of random sizes."""
    rng = np.random.default_rng(2)
    return [add(shape, np.repeat(rng.uniform(0.2, 1.2), 3)) for shape in SHAPES for _ in range(10)]


def level(path: Path):
    """The mesh of the game level."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    obj = next(o for o in bpy.data.objects if o.type == "MESH")
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="OBJECT")  # the file was saved in edit mode
    return [copy_faces(obj, obj.data).faces().mesh]


def torus():
    """The torus of the tests."""
    bpy.ops.mesh.primitive_torus_add(major_segments=64, minor_segments=32)
    obj = bpy.context.view_layer.objects.active
    return [copy_faces(obj, obj.data).faces().mesh]


def before(meshes, resolution: int) -> np.ndarray:
    """UV of all triangles as they were made before: each object in a square of the atlas."""
    layers = [by_projection([mesh], resolution, (PADDING, 2, 1, 0), "before").uvs[0] for mesh in meshes]
    if len(meshes) == 1:
        return layers[0]
    area = {k: float(np.linalg.norm(area_vectors(mesh.corners()), axis=1).sum()) for k, mesh in enumerate(meshes)}
    squares = place_objects(area, (resolution, resolution), PADDING)
    return np.concatenate([layer * np.float32(squares[k].scale) + np.float32(squares[k].offset) for k, layer in enumerate(layers)])


def after(meshes, resolution: int) -> np.ndarray:
    """UV of all triangles as they are made now."""
    return np.concatenate(unwrap(meshes, resolution, (PADDING, 2, 1, 0)).uvs)


def measure(name: str, meshes, resolution: int) -> list[dict]:
    """One row for each way."""
    rows = []
    for way, make in (("projection", before), ("xatlas", after)):
        start = time.perf_counter()
        uv = make(meshes, resolution)
        seconds = time.perf_counter() - start
        found = check(meshes, uv, resolution, PADDING)
        rows.append(
            {
                "scene": name,
                "triangles": len(uv),
                "resolution": resolution,
                "way": way,
                "charts": found.charts,
                "covered": round(found.covered / resolution**2, 4),
                "claimed_twice": found.overlapping,
                "too_close": found.close,
                "seconds": round(seconds, 2),
            }
        )
        print(line(rows[-1]), flush=True)
    return rows


def line(row: dict) -> str:
    """A row of the table."""
    shares = f"{100 * row['covered']:.1f} % | {row['claimed_twice']:,} | {row['too_close']:,}"
    return f"| {row['scene']} | {row['resolution']} | {row['way']} | {row['charts']:,} | {shares} | {row['seconds']:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description="Lightmap UVs by xatlas against our own projections.")
    parser.add_argument("--out", type=Path, default=Path("out/lightmap_uvs"))
    parser.add_argument("--zdm2", type=Path, help="the game level; left out where it is not given")
    options = parser.parse_args()
    rows = measure("Suzanne", [add("suzanne")], 512) + measure("torus", torus(), 512)
    for resolution in (512, 1024, 2048):
        rows += measure("20 boxes", boxes(), resolution)
    rows += measure("60 props", props(), 1024)
    if options.zdm2:
        if not options.zdm2.is_file():
            raise SystemExit(f"there is no {options.zdm2}: leave --zdm2 out, or name the level's file")
        rows += measure("zdm2", level(options.zdm2), 1024) + measure("zdm2", level(options.zdm2), 2048)
    head = "| scene | texels a side | charts by | charts | covered | texels claimed twice | too close | seconds |"
    text = "\n".join([head, "|---|--:|---|--:|--:|--:|--:|--:|", *map(line, rows)]) + "\n"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.md").write_text(text, encoding="utf-8")
    (options.out / "result.json").write_text(json.dumps({"padding": PADDING, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
