# SPDX-License-Identifier: GPL-3.0-or-later
"""The floor of the Cornell box, 128 x 128 texels, by path tracing of few samples: its error before and after each denoiser.

    python bench/denoise.py [--samples 16 64] [--reference 4096]

Prints relative root mean square errors of irradiance against a reference of many samples, whose own noise is included, with that of
direct and indirect light apart. Needs a Python with the bpy wheel.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SIDE = 128


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
        results["Blender's denoiser"] = denoised(raw, ground, image_denoiser(ground, compositor.denoise))
        for name, found in results.items():
            print(
                f"{samples:5} samples, {name:18}",
                *(f"{part} {_error(found, right, part):.4f}" for part in ("irradiance", "direct", "indirect")),
            )
    return 0


def _error(found, right, part: str) -> float:
    """Relative root mean square error of one quantity."""
    difference = found.quantity(part) - right.quantity(part)
    return float(np.sqrt((difference**2).mean()) / right.quantity(part).mean())


if __name__ == "__main__":
    sys.exit(main())
