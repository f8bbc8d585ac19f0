"""CIE 171:2006 cases 5.2 to 5.8 as scenes, points and closed forms (verification page, section 3). Luminous units stand for radiant ones.

Every case gives `(scene, positions (n, 3), expected (n,), measure)`, where `measure(solution)` turns a solution at the positions into the
tabulated quantity. Expected values are computed here from the closed forms, never copied from the report's tables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.solution import Solution
from adjgi.adjoint_gi.core.receivers.base import SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Light, SceneArrays
from adjgi.adjoint_gi.core.scene.world import World

BLACK = diffuse("Black", 0.0)
Measure = Callable[[Solution], np.ndarray]


@dataclass(frozen=True, eq=False)
class Case:
    """One case: where it is measured, what is expected, and the settings a path tracer needs for it."""

    name: str
    title: str
    scene: SceneArrays
    positions: np.ndarray
    expected: np.ndarray
    measure: Measure
    max_length: int = 1
    tolerance: float = 0.005


def receivers_at(world: World, positions: np.ndarray) -> SurfaceReceivers:
    """Point receivers on the surface that each position (n, 3) lies on; raises ValueError for one that lies on none."""
    triangle, us, vs = [], [], []
    v0, e1, e2, ng = (world.rows[:, a : a + 3].astype(float) for a in (0, 3, 6, 9))
    for p in np.asarray(positions) - world.center:
        to = p - v0
        solve = np.stack([e1, e2, ng], axis=2)
        u, v, w = np.linalg.solve(solve, to[:, :, None])[:, :, 0].T
        on = np.flatnonzero((np.abs(w) < 1e-5) & (u > -1e-5) & (v > -1e-5) & (u + v < 1 + 1e-5))
        if not len(on):
            raise ValueError(f"no surface at {p + world.center}")
        triangle.append(on[0])
        us.append(np.clip(u[on[0]], 0, 1))
        vs.append(np.clip(v[on[0]], 0, 1 - us[-1]))
    return SurfaceReceivers("texels", np.arange(len(triangle) + 1), np.array(triangle), np.array(us), np.array(vs))


def room(materials: dict[str, float] | None = None, size=(4.0, 4.0, 3.0)) -> SceneBuilder:
    """A closed room seen from inside; reflectances by face name -x +x -y +y -z +z, black where not given."""
    rho = materials or {}
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), size, [diffuse(f"Wall {k}", rho.get(k, 0.0)) for k in ("-x", "+x", "-y", "+y", "-z", "+z")], inward=True)
    return b


def lambert(point: np.ndarray, normal: np.ndarray, polygon: np.ndarray) -> float:
    """Configuration factor of a polygon (k, 3) above the horizon of a point: Lambert's formula."""
    v = np.asarray(polygon, float) - point
    v /= np.linalg.norm(v, axis=1)[:, None]
    following = np.roll(v, -1, axis=0)
    cross = np.cross(v, following)
    angle = np.arctan2(np.linalg.norm(cross, axis=1), (v * following).sum(axis=1))
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
    return abs(float((angle * (unit @ normal)).sum())) / (2 * np.pi)


def irradiance(solution: Solution) -> np.ndarray:
    """Irradiance at the points, first channel."""
    return solution.quantity("irradiance")[:, 0].astype(float)


def case_5_2() -> Case:
    """A small Lambertian source of 1000 cd, 3 m above the points."""
    b = SceneBuilder()
    b.quad("Floor", (-4, -4, 0), (8, 0, 0), (0, 8, 0), BLACK)
    size = 0.002
    b.light(Light("Source", "area", (1000 / size**2,) * 3, (0, 0, 3), size_x=size, size_y=size))
    xy = [(0, 0), (0.5, 0), (1, 0), (1.5, 0), (0.5, 0.5), (1, 0.5), (1.5, 0.5), (1, 1), (1.5, 1), (1.5, 1.5)]
    positions = np.array([(x, y, 0.0) for x, y in xy])
    d2 = (positions[:, :2] ** 2).sum(axis=1) + 9
    return Case("5.2", "Point source", b.build(), positions, 9000 / d2**2, irradiance)


def case_5_3() -> Case:
    """A 1 m x 1 m source of 1000 cd/m2 in the middle of the ceiling."""
    b = room()
    b.light(Light("Source", "area", (1000.0,) * 3, (2, 2, 3 - 1e-4), size_x=1, size_y=1))
    wall = [(2, 0, z) for z in (2.75, 2.25, 1.75, 1.25, 0.75, 0.25)]
    floor = [(2, y, 0) for y in (0.25, 0.75, 1.25, 1.75)]
    light = np.array([(1.5, 1.5, 3), (2.5, 1.5, 3), (2.5, 2.5, 3), (1.5, 2.5, 3)])
    positions = np.array(wall + floor, float)
    normals = [(0, 1, 0)] * 6 + [(0, 0, 1)] * 4
    expected = np.pi * 1000 * np.array([lambert(p, np.array(n), light) for p, n in zip(positions, normals, strict=True)])
    return Case("5.3", "Area source", b.build(), positions, expected, irradiance)


def grid_positions(size: tuple[float, float, float], per_metre: int) -> tuple[np.ndarray, np.ndarray]:
    """Cell middles on all six walls (n, 3) and the areas they stand for (n,)."""
    out, area = [], []
    for axis in range(3):
        a, b = (i for i in range(3) if i != axis)
        na, nb = (int(size[i] * per_metre) for i in (a, b))
        ga, gb = (x.ravel() for x in np.meshgrid((np.arange(na) + 0.5) / na * size[a], (np.arange(nb) + 0.5) / nb * size[b]))
        for end in (0.0, size[axis]):
            p = np.zeros((len(ga), 3))
            p[:, a], p[:, b], p[:, axis] = ga, gb, end
            out.append(p)
            area.append(np.full(len(ga), size[a] * size[b] / (na * nb)))
    return np.concatenate(out), np.concatenate(area)


def case_5_4() -> Case:
    """All flux of an isotropic source of 10,000 lm arrives at the black walls."""
    size = (4.0, 4.0, 3.0)
    b = room(size=size)
    b.light(Light("Source", "point", (10000 / (4 * np.pi),) * 3, (2, 2, 1.5)))
    positions, area = grid_positions(size, 8)
    return Case("5.4", "Flux conservation", b.build(), positions, np.array([10000.0]), lambda s: np.array([irradiance(s) @ area]))


def case_5_6() -> Case:
    """Scenario 2: a diffuse floor of reflectance 0.3, evenly lit, lights a black wall and ceiling; E / (E_hz rho) is the factor."""
    b = room({"-z": 0.3})
    # A vertical beam that casts no shadow reaches the floor alone: it lies in the plane of the walls, and behind the ceiling.
    b.light(Light("Beam", "sun", (100.0,) * 3, shadow=False))
    wall = [(2, 0, z) for z in (0.75, 1.25, 1.75, 2.25, 2.75)]
    ceiling = [(2, y, 3) for y in (0.25, 0.75, 1.25, 1.75)]
    floor = np.array([(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)])
    positions = np.array(wall + ceiling, float)
    normals = [(0, 1, 0)] * 5 + [(0, 0, -1)] * 4
    expected = np.array([lambert(p, np.array(n), floor) for p, n in zip(positions, normals, strict=True)])
    return Case("5.6", "Diffuse reflection, scenario 2", b.build(), positions, expected, lambda s: irradiance(s) / 30, max_length=2)


def case_5_7() -> Case:
    """The same with a lit wall at y = 4 and a black box that hides part of it from the opposite wall and the floor."""
    b = room({"+y": 0.3})
    b.box("Obstruction", (0, 2.5, 0), (4, 2.7, 1), BLACK, inward=False)
    b.light(Light("Beam", "sun", (100.0,) * 3, axis_x=(1, 0, 0), axis_y=(0, 0, 1), axis_z=(0, -1, 0), shadow=False))
    wall = [(2, 0, z) for z in (2.75, 2.25, 1.75, 1.25, 0.75, 0.25)]
    floor = [(2, y, 0) for y in (0.25, 0.75, 1.25, 1.75, 2.25)]
    positions = np.array(wall + floor, float)
    normals = [(0, 1, 0)] * 6 + [(0, 0, 1)] * 5
    expected = []
    for p, n in zip(positions, normals, strict=True):
        # The lowest point of the wall that is seen over both top edges of the box.
        low = max(0.0, *(p[2] + (1 - p[2]) * (4 - p[1]) / (y - p[1]) for y in (2.5, 2.7)))
        seen = np.array([(0, 4, low), (4, 4, low), (4, 4, 3), (0, 4, 3)])
        expected.append(lambert(p, np.array(n), seen) if low < 3 else 0.0)
    return Case("5.7", "Obstruction", b.build(), positions, np.array(expected), lambda s: irradiance(s) / 30, max_length=2)


def case_5_8(rho: float) -> Case:
    """Interreflection in a cube of 4 m with one reflectance; the mean indirect irradiance is rho flux / (S (1 - rho))."""
    size = (4.0, 4.0, 4.0)
    b = room(dict.fromkeys(("-x", "+x", "-y", "+y", "-z", "+z"), rho), size)
    b.light(Light("Source", "point", (10000 / (4 * np.pi),) * 3, (2, 2, 2)))
    positions, area = grid_positions(size, 4)
    expected = rho * 10000 / (96 * (1 - rho))

    def mean(s: Solution) -> np.ndarray:
        return np.array([s.indirect[:, 0].astype(float) @ area / area.sum()])

    return Case(
        f"5.8, rho {rho}", "Internal reflection", b.build(), positions, np.array([expected]), mean, max_length=1024, tolerance=0.003
    )


REFLECTANCES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def cases() -> list[Case]:
    """All cases in order."""
    return [case_5_2(), case_5_3(), case_5_4(), case_5_6(), case_5_7(), *(case_5_8(r) for r in REFLECTANCES)]
