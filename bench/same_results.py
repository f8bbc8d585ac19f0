# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a change of the code changed any number: every method on two Cornell boxes, compared bit by bit with an earlier run.

    python bench/same_results.py out/before.npz             at the revision before
    python bench/same_results.py out/after.npz out/before.npz    after: says which results differ, and by how much; exit 1 if any do
    ... --only path_tracing two_pass                        some methods only

The boxes: diffuse with the lamp as a mesh; and one with lamps of every kind, a mirror, gloss, metal, glass, a coat and a background.
Receivers: texels of the floor, pixels of the camera, and elements. In the second box each switch of a method is also turned the other
way and each of its choices taken, one at a time. Files are of one machine: libraries round differently on another.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.core.base.errors import AdjointError  # noqa: E402
from adjgi.adjoint_gi.core.base.settings import Settings  # noqa: E402
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements  # noqa: E402
from adjgi.adjoint_gi.core.method.registry import Solver, methods  # noqa: E402
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, Receivers  # noqa: E402
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material  # noqa: E402
from adjgi.adjoint_gi.core.scene.world import World  # noqa: E402
from adjgi.bench.profile_path_tracing import floor_texels  # noqa: E402
from adjgi.solvers import load  # noqa: E402
from adjgi.tests import scenes  # noqa: E402

SMALL = {  # settings that every method finishes with in seconds
    "samples": 4,
    "rays": 64,
    "particles": 20_000,
    "light_samples": 4,
    "pixel_samples": 2,
    "max_edge": 0.25,
    "max_length": 8,
}


def lamps_and_lobes():
    """A box with one lamp of every kind and one surface of every lobe."""
    b = scenes.cornell_builder(24, 24)

    def panel(name, x, *lobes):
        b.quad(name, (x, 0.6, 0.02), (0.12, 0, 0), (0, 0.1, 0.3), Material(name, tuple(lobes)))

    white = Color.of(0.8, 0.7, 0.6)
    panel("Mirror", 0.05, Lobe("glossy", white, 0.0))
    panel("Gloss", 0.2, Lobe("diffuse", Color.of(0.3, 0.3, 0.3)), Lobe("glossy", white, 0.4))
    panel("Metal", 0.35, Lobe("metallic", white, 0.3))
    panel("Coat", 0.5, Lobe("diffuse", white), Lobe("specular", Color.of(1, 1, 1), 0.2, 1.5))
    panel("Glass", 0.65, Lobe("glass", white, 0.1, 1.45))
    panel("Clear", 0.8, Lobe("transparent", white))
    b.light(Light("Point", "point", (1.0, 2.0, 3.0), position=(0.2, 0.2, 0.5)))
    b.light(Light("Ball", "point", (1.0, 1.0, 1.0), position=(0.8, 0.3, 0.7), radius=0.05))
    b.light(Light("Spot", "spot", (5.0, 4.0, 3.0), position=(0.5, 0.5, 0.9), radius=0.02, spot_angle=0.9, spot_blend=0.2))
    b.light(Light("Sun", "sun", (1.0, 1.0, 0.8), angle=0.02))
    b.light(Light("Area", "area", (2.0, 2.0, 2.0), position=(0.3, 0.1, 0.8), size_x=0.2, size_y=0.1))
    b.background = (0.1, 0.2, 0.3)
    return b.build()


def variants(solver: Solver, lobes: bool) -> dict[str, Settings]:
    """Small settings of a method, and with `lobes` every variant of them that differs in one switch or choice."""
    fields = dataclasses.fields(solver.Settings)
    small = {f.name: SMALL[f.name] for f in fields if f.name in SMALL}
    out = {"": small}
    for f in fields if lobes else ():
        if isinstance(f.default, bool):
            out[f.name] = small | {f.name: not f.default}
        for choice, *_ in f.metadata["choices"]:
            if choice != f.default:
                out[f"{f.name}={choice}"] = small | {f.name: choice}
    return {name: solver.Settings(**values) for name, values in out.items()}


def results(only: list[str]) -> dict[str, np.ndarray]:
    """Every array of every solution, by "method variant / scene / receivers / array"."""
    load()
    out = {}
    for scene_name, scene in (("diffuse", scenes.cornell(24, 24)), ("lobes", lamps_and_lobes())):
        world = World(scene)
        places = {"texels": floor_texels(16), "camera": CameraReceivers(world)}
        places["elements"] = ElementReceivers(Elements(world, 0.25))
        for solver in methods():
            if only and solver.spec.id not in only:
                continue
            start = time.perf_counter()
            for variant, settings in variants(solver, scene_name == "lobes").items():
                for kind in [k for k in places if k in solver.spec.receivers][: 2 if variant else 3]:
                    name = f"{solver.spec.id} {variant} / {scene_name} / {kind}"
                    out |= {f"{name} / {key}": array for key, array in solved(solver, world, places[kind], settings).items()}
            print(f"{solver.spec.id} / {scene_name}: {time.perf_counter() - start:.1f} s", flush=True)
    return out


def solved(solver: Solver, world: World, receivers: Receivers, settings: Settings) -> dict[str, np.ndarray]:
    """All arrays of one solution; of one that is refused the words."""
    try:
        for step in solver.solve(world, receivers, settings, np.random.default_rng(settings.seed)):
            last = step
        solution = last.solution()
    except AdjointError as error:
        return {"refused": np.frombuffer(str(error).encode(), np.uint8)}
    arrays = {k: getattr(solution, k) for k in ("emitted", "direct", "indirect", "albedo", "weight")}
    return {k: np.asarray(a) for k, a in ({"rays": solution.rays} | arrays | solution.extra).items()}


def differences(new: dict[str, np.ndarray], old: dict[str, np.ndarray], only: list[str]) -> list[str]:
    """One line for each result that is not the same to the last bit."""
    lines = []
    for name in sorted({*new, *(n for n in old if not only or n.split()[0] in only)}):
        a, b = new.get(name), old.get(name)
        if a is None or b is None or a.shape != b.shape:
            lines.append(f"{name}: {'only before' if a is None else 'new' if b is None else f'{b.shape} became {a.shape}'}")
        elif a.tobytes() != b.tobytes():
            a, b = a.astype(float), b.astype(float)
            scale = max(np.abs(b[np.isfinite(b)]).max(initial=0), 1e-30)
            mean = abs(np.mean(a) / max(abs(np.mean(b)), 1e-30) - 1)
            lines.append(f"{name}: most {np.nanmax(np.abs(a - b)) / scale:.2e} of the largest, mean {mean:.2e}")
    return lines


def main() -> int:
    """Run, save, compare; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("before", type=Path, nargs="?")
    parser.add_argument("--only", nargs="*", default=[])
    options = parser.parse_args()
    new = results(options.only)
    options.file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(options.file, **{k.replace("/", "|"): v for k, v in new.items()})
    if options.before is None:
        return 0
    with np.load(options.before, allow_pickle=False) as data:
        old = {k.replace("|", "/"): data[k] for k in data.files}
    lines = differences(new, old, options.only)
    print("\n".join(lines) or f"all {len(new)} arrays are the same")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
