# SPDX-License-Identifier: GPL-3.0-or-later
"""The floor of the Cornell box, 128 x 128 texels, by path tracing of few samples: its error before and after each denoiser. Then narrow
charts, such as skirting boards have, of light that varies slowly, with noise of 40 %.

    python bench/denoise.py [--samples 16 64] [--reference 4096]

Prints relative root mean square errors of irradiance against a reference of many samples, whose own noise is included, with that of
direct and indirect light apart; of the charts, relative errors of a texel. Needs a Python with the bpy wheel.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SIDE = 128
ROWS, LONG = (1, 2, 3, 6, 20), 60


def main() -> int:
    """Solve, denoise, compare. Loads the repository as the package adjgi."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--reference", type=int, default=4096)
    arguments = parser.parse_args()
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
    from adjgi.adjoint_gi.bridge.host import compositor
    from adjgi.adjoint_gi.core.denoise.ground import texel_ground
    from adjgi.adjoint_gi.core.denoise.images import image_denoiser
    from adjgi.adjoint_gi.core.denoise.step import denoised, own_denoiser
    from adjgi.adjoint_gi.core.receivers.texels import rasterize
    from adjgi.adjoint_gi.core.scene.world import World
    from adjgi.tests.scenes import cornell
    from adjgi.tests.solving import solve

    world = World(cornell())
    lightmap = rasterize(world, [0], "", SIDE, 4)
    ground = texel_ground(world, lightmap.receivers, [lightmap])
    right = solve("path_tracing", world, lightmap.receivers, samples=arguments.reference, seed=77)
    for samples in arguments.samples:
        raw = solve("path_tracing", world, lightmap.receivers, samples=samples, seed=1)
        results = {"as computed": raw, "own filter": denoised(raw, ground, own_denoiser(ground))}
        results["Blender's denoiser"] = denoised(raw, ground, image_denoiser(ground, compositor.denoise, np.random.default_rng(0)))
        for name, found in results.items():
            print(
                f"{samples:5} samples, {name:18}",
                *(f"{part} {_error(found, right, part):.4f}" for part in ("irradiance", "direct", "indirect")),
            )
    for rows in ROWS:
        ground, right, noisy = strips(rows)
        by_blender = image_denoiser(ground, compositor.denoise, np.random.default_rng(0))
        found = [noisy, *(denoised(noisy, ground, denoiser) for denoiser in (own_denoiser(ground), by_blender))]
        errors = [float(np.sqrt(((s.indirect.mean(axis=1) / right - 1) ** 2).mean())) for s in found]
        words = ", ".join(f"{name} {error:.3f}" for name, error in zip(results, errors, strict=True))
        print(f"charts of {rows} x {LONG} texels: {words}")
    return 0


def strips(rows: int):
    """(ground, (n,) right values, `Solution` with noise) of twelve charts of `rows` by LONG texels in one image, four texels apart."""
    from adjgi.adjoint_gi.core.denoise.ground import GridNeighbours, Ground
    from adjgi.adjoint_gi.core.method.solution import Solution

    many, noise, rng = 12, 0.4, np.random.default_rng(0)
    k, y, x = (i.ravel() for i in np.mgrid[:many, :rows, :LONG])
    image = np.full((many * (rows + 4), LONG + 8), -1)
    image[k * (rows + 4) + y, x + 4] = np.arange(len(k))
    right = (1 + 0.8 * np.sin(6 * x / LONG + k)) * (1 + 0.5 * k / many)
    position, ones = np.stack([x, y + 10 * k, 0 * x], axis=1).astype(np.float32), np.ones((len(k), 3), np.float32)
    ground = Ground(k, position, ones * np.float32([0, 0, 1]), ones[:, 0], ones, GridNeighbours([image], k))
    values = (right[:, None] * rng.gamma(noise**-2, noise**2, (len(k), 1)) * ones).astype(np.float32)
    error = {"direct_error": 0 * ones[:, 0], "indirect_error": (3 * noise * right).astype(np.float32)}
    return ground, right, Solution("path_tracing", "irradiance", 0 * ones, 0 * ones, values, ones, ones[:, 0], extra=error)


def _error(found, right, part: str) -> float:
    """Relative root mean square error of one quantity."""
    difference = found.quantity(part) - right.quantity(part)
    return float(np.sqrt((difference**2).mean()) / right.quantity(part).mean())


if __name__ == "__main__":
    sys.exit(main())
