# SPDX-License-Identifier: GPL-3.0-or-later
"""Where path tracing spends its time: the share inside Embree and of each part, on one thread.

    python bench/profile_path_tracing.py --out out/profile

Floor of the Cornell box, 64 x 64 texels. Writes table.md and result.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.core.lights import direct, emitters  # noqa: E402
from adjgi.adjoint_gi.core.receivers import base as receivers  # noqa: E402
from adjgi.adjoint_gi.core.sampling import maps as sampling  # noqa: E402
from adjgi.adjoint_gi.core.sampling import sobol as low_discrepancy  # noqa: E402
from adjgi.adjoint_gi.core.scene import faces, world  # noqa: E402
from adjgi.adjoint_gi.core.walks import paths  # noqa: E402
from adjgi.solvers.path_tracing import PathSettings, PathTracing  # noqa: E402
from adjgi.tests import scenes  # noqa: E402

# What is timed, from the inside out: the time of an inner part is not counted again in the outer one.
PARTS = (
    (world.World, "intersect", "Embree: nearest hits"),
    (world.World, "occluded", "Embree: shadow rays"),
    (emitters.Emitters, "draw", "light points"),
    (direct, "from_lights", "direct light: rest"),
    (sampling, "cosine_hemisphere", "cosine directions"),
    (faces.Faces, "normals", "normals of hits"),
    (faces.Faces, "albedo_at", "reflectance of hits"),
    (low_discrepancy, "shifted", "Sobol numbers"),
    (receivers.SurfaceReceivers, "sample", "points of receivers"),
    (paths, "add", "adding up"),
)


def floor_texels(resolution: int, side: int = 4):
    """Receivers of the floor, `side` x `side` points each; the floor is triangles 0 and 1."""
    n = resolution * side
    c = (np.arange(n) + 0.5) / n
    x, y = (
        a.reshape(resolution, side, resolution, side).transpose(0, 2, 1, 3).ravel() for a in np.broadcast_arrays(c[None, :], c[:, None])
    )
    low = x >= y
    start = np.arange(resolution**2 + 1) * side**2
    return receivers.SurfaceReceivers("texels", start, np.where(low, 0, 1), np.where(low, x - y, x), np.where(low, y, y - x))


class Timers:
    """Wraps functions to measure the time in each without that in the others."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    def wrap(self, owner, name: str, label: str) -> None:
        """Replace `owner.name` by itself with a timer around it."""
        function = getattr(owner, name)
        self.seconds[label] = 0.0

        def timed(*args, **kwargs):
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.perf_counter() - began
                self.seconds[label] += spent - self._inner.pop()
                self._inner[-1] += spent

        setattr(owner, name, timed)


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/profile_path_tracing"))
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--max-length", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    os.environ["ADJOINT_GI_THREADS"] = "1"
    the_world, texels = world.World(scenes.cornell()), floor_texels(64)
    settings = PathSettings(samples=options.samples, max_length=options.max_length)

    def solve() -> tuple[float, int]:
        began = time.perf_counter()
        *_, last = PathTracing().solve(the_world, texels, settings, np.random.default_rng(0))
        return time.perf_counter() - began, last.solution().rays

    solve()
    plain, rays = min(solve() for _ in range(options.repeat))
    timers = Timers()
    for part in PARTS:
        timers.wrap(*part)
    runs = []
    for _ in range(options.repeat):
        timers.seconds = dict.fromkeys(timers.seconds, 0.0)
        total, _ = solve()
        runs.append((total, timers.seconds))
    total, seconds = min(runs, key=lambda r: r[0])
    seconds["everything else"] = total - sum(seconds.values())
    inside = sum(v for k, v in seconds.items() if k.startswith("Embree")) / total

    count = texels.count * options.samples
    lines = [
        f"{count / plain / 1e6:.2f} million paths/s, {rays / plain / 1e6:.2f} million rays/s, one thread, {rays / count:.2f} rays a path",
        "",
    ]
    lines += ["| part | seconds | share |", "|---|---|---|"]
    lines += [f"| {k} | {v:.3f} | {100 * v / total:.1f} % |" for k, v in sorted(seconds.items(), key=lambda x: -x[1])]
    lines += [f"| **inside Embree** | | {100 * inside:.1f} % |"]
    text = "\n".join(lines) + "\n"
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.md").write_text(text, encoding="utf-8")
    data = {"paths_per_second": count / plain, "rays_per_second": rays / plain, "embree_share": inside, "seconds": seconds}
    (options.out / "result.json").write_text(json.dumps(data, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
