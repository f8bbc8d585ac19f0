# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs of any method, the receivers they are asked for, and comparisons of what they answer: shared by the tests of methods."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.detectors import CameraDetector, Detector, Flux
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import Solution, Step
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, Receivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Light, SceneArrays
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

load()
ARRAYS = ("emitted", "direct", "indirect", "albedo", "weight")


# ---- runs


def steps(name: str, *places: World | Receivers, seed: int = 0, **options: object) -> Iterator[Step]:
    """Steps of a solve by the method `name`; `places` is (world, receivers), or the receivers alone where they know their world."""
    receivers = places[-1]
    world = places[0] if len(places) > 1 else receivers.elements.world if hasattr(receivers, "elements") else receivers.world
    solver = method(name)
    return solver.solve(world, receivers, solver.Settings(**{"seed": seed, **options}), np.random.default_rng(seed))


def solve(name: str, *places: World | Receivers, seed: int = 0, **options: object) -> Solution:
    """The finished solution of such a run."""
    *_, last = steps(name, *places, seed=seed, **options)
    return last.solution()


def solved_by_threads(monkeypatch, run: Callable[[], Solution], counts: tuple[int, ...] = (1, 3)) -> list[Solution]:
    """Solutions of the same run by different numbers of threads."""
    found = []
    for threads in counts:
        monkeypatch.setenv("ADJOINT_GI_THREADS", str(threads))
        found.append(run())
    return found


def bits(solution: Solution) -> bytes:
    """All arrays of a solution, for a comparison to the last bit."""
    extra = [solution.extra[key] for key in sorted(solution.extra)]
    return b"".join(np.ascontiguousarray(a).tobytes() for a in [*(getattr(solution, name) for name in ARRAYS), *extra])


# ---- receivers


def on_elements(scene: SceneArrays, edge: float = 10.0) -> ElementReceivers:
    """The elements of the scene, of at most this edge, as receivers; by default one for each face of a small scene."""
    return ElementReceivers(Elements(World(scene), edge))


def quad_points(u: np.ndarray, v: np.ndarray, first: int = 0, each: int = 1) -> SurfaceReceivers:
    """Texels at the coordinates (n,) of a parallelogram whose two triangles begin at `first`; `each` points in a row make a texel."""
    # Its triangles are (0, 1, 2) and (0, 2, 3): barycentrics of (u, v) in the one it lies in.
    lower = u > v
    a, b = np.where(lower, u - v, u), np.where(lower, v, v - u)
    return SurfaceReceivers("texels", np.arange(len(u) // each + 1) * each, np.where(lower, first, first + 1), a, b)


def quads(numbers: Iterable[int], count: int) -> SurfaceReceivers:
    """Texels on a count x count grid over each of a scene's first quads, by number."""
    u, v = grid(count)
    each = [quad_points(u, v, first=2 * k) for k in numbers]
    triangle, a, b = (np.concatenate([getattr(x, name) for x in each]) for name in ("triangle", "u", "v"))
    return SurfaceReceivers("texels", np.arange(len(triangle) + 1), triangle, a, b)


def grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the cells of a count x count grid over the unit square, row by row: two arrays (count * count,)."""
    x = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(x, x)
    return u.ravel(), v.ravel()


def scattered(world: World, count: int, seed: int = 0, triangles: np.ndarray | None = None, kind: str = "vertices") -> SurfaceReceivers:
    """Receivers of one point each, at uniform random points of all (or some) triangles."""
    rng = np.random.default_rng(seed)
    area = world.area if triangles is None else np.where(triangles, world.area, 0)
    k = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    flip = u + v > 1
    return SurfaceReceivers(kind, np.arange(count + 1), k, np.where(flip, 1 - u, u), np.where(flip, 1 - v, v))


def look(position, forward, half=0.5, size=8, kind="perspective", **lens) -> Camera:
    """A square camera; `half` is half its width, at distance 1 or in metres."""
    f = np.asarray(forward, float) / np.linalg.norm(forward)
    r = np.cross(f, (0, 0, 1) if abs(f[2]) < 0.9 else (0, 1, 0))
    r /= np.linalg.norm(r)
    return Camera(kind, tuple(position), tuple(r), tuple(np.cross(r, f)), tuple(f), (-half, half, -half, half), size, size, **lens)


def view(b: SceneBuilder, *camera: object, grid: int = 4, **options: object) -> tuple[World, CameraReceivers]:
    """The world of a scene and the pixels of a camera, described as for `look`, in it."""
    b.camera = look(*camera, **options)
    world = World(b.build())
    return world, CameraReceivers(world, grid=grid)


# ---- fluxes


def flux_by_radiance(detect: Detector, solution: Solution, elements: Elements | None = None) -> Flux:
    """Phi = <L, g> (Eq. 3) from what a method found: for faces on element sides (`elements` are those of its receivers), for the camera
    in its picture. Lamps and background that a camera sees are in its part 0, though they have no potential."""
    none = np.zeros((3, 3))
    if isinstance(detect, CameraDetector):
        e = detect.eye
        k = np.arange(e.count)
        weight = detect.share(e.rays(k, np.full(e.count, 0.5), np.full(e.count, 0.5))[1]) / e.count
        parts = (solution.emitted, solution.direct, solution.indirect)
        return Flux(np.stack([weight @ p.astype(np.float64) for p in parts]), none)
    weight = np.repeat(elements.area, 2)[:, None] * detect.on_elements(elements)
    rho = np.repeat(elements.albedo, 2, axis=0)
    parts = (solution.emitted.astype(np.float64), rho * solution.direct, rho * solution.indirect)
    return Flux(np.stack([(weight * p).sum(axis=0) for p in parts]), none)


def lamp_in_a_closed_box(solve: Callable[[ElementReceivers], Solution]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CIE 5.8, a point lamp in a cube of albedo 0.5: (3,) W of the lamp, arriving directly and indirectly.

    Backs must stay dark and all direct light must arrive. Indirect light is rho / (1 - rho) times the direct, so that all three are equal.
    """
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (4, 4, 4), diffuse("Wall", 0.5), inward=True)
    b.light(Light("Lamp", "point", (10.0, 20.0, 30.0), position=(2, 2, 2)))
    receivers = on_elements(b.build(), 1.0)
    s = solve(receivers)
    assert not s.direct[1::2].any()
    flux, area = 4 * np.pi * np.array([10, 20, 30]), receivers.elements.area
    direct = area @ s.direct[0::2]
    assert np.allclose(direct, flux, rtol=0.01)
    return flux, direct, area @ s.indirect[0::2]


# ---- comparisons


def group_means(group: np.ndarray, area: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(g, c) means by area of `values` (n, c) over groups (n,) int, -1 for none."""
    used = group >= 0
    total = np.bincount(group[used], area[used])
    return np.stack([np.bincount(group[used], (area * column)[used]) / total for column in values.T.astype(float)], axis=1)


def front_means(receivers: ElementReceivers, values: np.ndarray, group: np.ndarray | None = None) -> np.ndarray:
    """(g,) means of the first channel of `values` (2 ne, c) over the fronts of each patch (face), or of groups (ne,) of elements."""
    e = receivers.elements
    return group_means(e.patch if group is None else group, e.area, values[0::2, :1])[:, 0]


def agrees(values: np.ndarray, expected: float | np.ndarray, z: float, bias: float = 0.0, resolution: float = 0.004) -> None:
    """Z-test of the mean of independent estimates (n,) or (n, c) of `expected`, which must be known to the share `resolution` of it."""
    values, expected = np.asarray(values, float), np.asarray(expected, float)
    mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))
    assert (error <= resolution * np.abs(expected)).all(), f"standard error {error} cannot tell {expected}"
    assert (np.abs(mean - expected) <= z * error + bias).all(), f"{mean} is not {expected}, standard error {error}"
