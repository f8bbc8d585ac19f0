"""Light below panes by the methods that know radiance by direction, against particles: how much of it passes, and where it lands.

    python bench/panes.py [--orders 4 8] [--rows 8 16] [--only TEXT]        (a Python with numpy and embreex; Blender is not needed)

A black box of 4 x 4 m, 1.5 high, under a closed pane of glass that covers it (index 1.45, 0.1 thick, where the row says nothing else). Each
figure is the flux on floor and walls, and that on the floor alone, over what particles find there less one. Elements of 0.5 m (those of 2 m
blur where light falls: up to 30 % too little on the floor). Orders are of Spherical Harmonics; rows are of Directional Radiosity's bins,
which has twice as many columns.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.core.gallery.builder import diffuse  # noqa: E402
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material  # noqa: E402
from adjgi.adjoint_gi.core.scene.world import World  # noqa: E402
from adjgi.tests import scenes, solving  # noqa: E402

CASES = {
    "area lamp": {},
    "sun straight on": {"light": "sun"},
    "area lamp, roughness 0.3": {"roughness": 0.3},
    "area lamp, index 2.4": {"ior": 2.4},
    "area lamp, 0.3 thick": {"thick": 0.3},
    "area lamp, coloured": {"color": (0.8, 0.5, 0.2)},
    "an emitting panel": {"light": "panel"},
    "area lamp, two panes, 0.4 apart": {"panes": 2},
}


def scene(
    light: str = "area",
    ior: float = 1.45,
    thick: float = 0.1,
    roughness: float = 0.0,
    color: tuple[float, float, float] = (1.0, 1.0, 1.0),
    panes: int = 1,
) -> World:
    """Quads 0 to 4 are the box: floor, and walls."""
    b = scenes.box_below_panes(Material("Pane", (Lobe("glass", Color.of(*color), roughness, ior),)), thick, panes)
    if light == "area":
        b.light(Light("Area", "area", (5.0, 5.0, 5.0), position=(2, 2, 2.9), size_x=1.0, size_y=1.0))
    elif light == "sun":
        b.light(Light("Sun", "sun", (1.0, 1.0, 1.0), angle=0.02))
    else:
        b.quad("Panel", (1, 1, 2.9), (0, 2, 0), (2, 0, 0), diffuse("Glow", 0.0, 5.0))
    return World(b.build())


def flux(name: str, world: World, **options: object) -> np.ndarray:
    """(2,) W in the box and on its floor, the channels summed."""
    found = solving.solve(name, world, solving.quads(range(5), 8), **options).quantity("irradiance")
    each = scenes.BELOW_AREA * found.sum(axis=1).reshape(5, -1).mean(axis=1)
    return np.array([each.sum(), each[0]])


def main() -> None:
    """Solve and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--orders", type=int, nargs="*", default=[4, 8])
    parser.add_argument("--rows", type=int, nargs="*", default=[8])
    parser.add_argument("--only", default="", help="cases that have this in their name")
    options = parser.parse_args()
    heads = [f"harmonics {k}" for k in options.orders] + [f"bins {k} x {2 * k}" for k in options.rows]
    print(f"| light and pane | {' | '.join(heads)} |\n|---{'|---' * len(heads)}|")
    for name, values in CASES.items():
        if options.only not in name:
            continue
        world = scene(**values)
        exact, found = flux("particle_tracing", world, particles=1_000_000), []
        for order in options.orders:
            found.append(flux("spherical_harmonics", world, order=order, rays=30_000, tolerance=5e-3, max_edge=0.5, light_samples=16))
        for rows in options.rows:
            found.append(flux("directional_radiosity", world, bin_rows=rows, bin_columns=2 * rows, max_edge=0.5, light_samples=16))
        print(f"| {name} | {' | '.join('{:+.1%}, {:+.1%}'.format(*(x / exact - 1)) for x in found)} |", flush=True)


if __name__ == "__main__":
    main()
