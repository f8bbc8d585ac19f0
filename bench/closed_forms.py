# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes with exact solutions (verification page, section 2.3) by every method that solves all diffuse light transport: numbers as a table.

    python bench/closed_forms.py --out out/closed_forms      (a Python with numpy and embreex; Blender is not needed)

The tests hold each method to its tolerance; this shows how near it comes. Writes table.md and result.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements  # noqa: E402
from adjgi.adjoint_gi.core.method.registry import method  # noqa: E402
from adjgi.adjoint_gi.core.scene.world import World  # noqa: E402
from adjgi.solvers import load  # noqa: E402
from adjgi.tests import scenes  # noqa: E402

METHODS = {
    "path_tracing": {"samples": 256, "max_length": 1024},
    "particle_tracing": {"particles": 400_000, "max_length": 1024},
    "matrix_radiosity": {"rays": 1024, "max_length": 1024},
    "progressive_radiosity": {"rays": 2_000_000, "tolerance": 1e-4, "max_length": 1024},
}


def face(element_normals):
    """0 wall, 1 floor, 2 ceiling, by the normals of a room seen from inside."""
    z = element_normals[:, 2]
    return np.where(z > 0.5, 1, np.where(z < -0.5, 2, 0))


def cases() -> list[tuple]:
    """(id, what is measured, scene, longest edge, quantity, groups of elements, exact values)."""
    a, b = scenes.snowman_answer(0.1, (0.5, 0.5), (1.0, 0.0))
    return [
        ("T1", "radiosity in a furnace", scenes.cube(0.5, 1.0), 0.25, "radiosity", one, [2.0]),
        ("T1", "the same, albedo 0.8", scenes.cube(0.8, 1.0), 0.25, "radiosity", one, [5.0]),
        ("T2", "mean irradiance of a room 4 x 4 x 3", scenes.room(0.5, 0.5, 0.5), 0.5, "irradiance", one, [0.4]),
        ("T3", "irradiance in the halves of a two-zone sphere", scenes.two_zone_sphere(4), 0.2, "irradiance", halves, [1.0, 1.0]),
        ("T6", "radiosity of two rooms joined by a door", scenes.snowman(2), 0.5, "radiosity", objects, [a, b]),
        ("T10", "walls, floor, ceiling of a lit cube", scenes.lit_cube(0.5), 0.125, "radiosity", faces, [0.1811, 0.1712, 1.1044]),
    ]  # fmt: skip


def one(world, elements, triangle):
    """All elements together."""
    return np.zeros(len(triangle), int)


def halves(world, elements, triangle):
    """Above and below the equator."""
    return (world.scene.vertices[world.scene.triangles[triangle]].mean(axis=1)[:, 2] < 0).astype(int)


def objects(world, elements, triangle):
    """By object."""
    return world.scene.object[triangle]


def faces(world, elements, triangle):
    """Walls, floor, ceiling."""
    p = world.scene.vertices[world.scene.triangles[triangle]]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return face(n / np.linalg.norm(n, axis=1, keepdims=True))


def measure(name: str, scene, edge: float, quantity: str, groups) -> list[float]:
    """Area means over the front sides of each group."""
    world = World(scene)
    elements = Elements(world, max_edge=edge)
    solver = method(name)
    *_, last = solver.solve(world, ElementReceivers(elements), solver.Settings(**METHODS[name]), np.random.default_rng(1))
    values = last.solution().quantity(quantity)[::2, 0].astype(float)
    group = groups(world, elements, elements.patch_triangle[elements.patch])
    return (np.bincount(group, elements.area * values) / np.bincount(group, elements.area)).tolist()


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[], metavar="ID", help="T1, T2 and so on")
    parser.add_argument("--out", type=Path, default=Path("out/closed_forms"))
    options = parser.parse_args()
    load()
    lines, rows = ["| scene | measured | exact | " + " | ".join(METHODS) + " |", "|---" * (3 + len(METHODS)) + "|"], []
    for label, what, scene, edge, quantity, groups, exact in cases():
        if options.only and label not in options.only:
            continue
        found = {name: measure(name, scene, edge, quantity, groups) for name in METHODS}
        rows.append({"scene": label, "measured": what, "exact": exact, **found})
        cells = ["; ".join(f"{v:.5f} ({100 * (v / e - 1):+.2f} %)" for v, e in zip(found[n], exact, strict=True)) for n in METHODS]
        lines.append(f"| {label} | {what} | {'; '.join(f'{e:.5f}' for e in exact)} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (options.out / "result.json").write_text(json.dumps({"settings": METHODS, "rows": rows}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
