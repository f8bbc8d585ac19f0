"""What all emitters of a scene emit, and what of it enters its surfaces: one definition for every method.

emitted   power of the lamps that have a place, and of the emitting faces; of suns and of the background, whose power has no end, that which
          falls on the scene: irradiance across the rays times the area that the scene shows them, from outside
          (found by points of its triangles or by particles, whatever tries less in vain: how far apart things lie does not matter)
entering  what of this arrives at surfaces straight from the emitters, before any reflection
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ..sampling.additive import STEPS, additive
from ..sampling.maps import PowerTable, Stretches, cosine_directions, dot_rows, triangle
from ..scene.arrays import RayKind
from ..scene.clusters import clusters
from ..scene.world import World
from .background import Background
from .base import ParticleSource
from .emission import Emission
from .lamps import Lamps
from .mesh import MeshLights

PARTICLES = 1 << 13  # by which it is found how much of the light of lamps, and of faces, meets a surface
RAYS = 1 << 16  # by which it is found what light from far away falls on
TRIED = 16  # directions of it by which triangles are drawn
LEAST = 0.05  # of their areas by which they are drawn besides, for directions that are not among those
ROUNDING = 1e-5  # share of the power of lamps that sums of float32 weights may miss


@dataclass(frozen=True)
class LightFlux:
    """W, the channels summed. passing: light of lamps that have a place which meets no surface."""

    emitted: float
    entering: float
    passing: float


_MEASURED: WeakKeyDictionary[World, LightFlux] = WeakKeyDictionary()  # a world does not change after it is made


def light_flux(world: World, mesh: MeshLights, lamps: Lamps, background: Background) -> LightFlux:
    """Of a world with its lights. Powers are exact but for products of images; what meets a surface is found by rays, always the same, so
    it is found once for each world."""
    if world not in _MEASURED:
        _MEASURED[world] = _measure(world, mesh, lamps, background)
    return _MEASURED[world]


def _measure(world: World, mesh: MeshLights, lamps: Lamps, background: Background) -> LightFlux:
    sources = lamps.sources() + background.sources()
    far = _falling(world, [s for s in sources if s.kind.far])
    near = [s for s in sources if not s.kind.far]
    power = sum(float(s.flux.sum()) for s in near)
    met = _lamps_met(world, near)
    met = power if met > power * (1 - ROUNDING) else met
    faces = float(mesh.importance.sum())
    return LightFlux(power + far + faces, met + far + faces * _faces_met(world, mesh), power - met)


def _falling(world: World, sources: list[ParticleSource]) -> float:
    """Flux of `sources`, light from far away, that falls on the scene."""
    emission = Emission(world, sources)
    if emission.is_dark or not world.triangle_count:
        return 0.0
    p = emission.draw(RAYS, np.random.default_rng(0))
    power = float(emission.total.sum()) / clusters(world).area  # W m-2 of all
    # A triangle shows light from everywhere its area times a cosine; what it is drawn by is the mean over some of the directions.
    normal, tried = world.rows[:, 9:12], p.direction[RAYS // TRIED // 2 :: RAYS // TRIED]
    shown = world.area * (LEAST + sum(np.abs(normal @ w) for w in tried) / len(tried))
    if 0 < shown.sum() < clusters(world).area:
        return power * _triangles_met(world, shown, p.direction.astype(np.float64))
    met = world.intersect(p.origin, p.direction, p.kind)[0] >= 0
    return float(p.weight[met].sum(dtype=np.float64))


def _triangles_met(world: World, shown: np.ndarray, direction: np.ndarray) -> float:
    """m2 that the scene shows light along `direction` (n, 3), in the mean, from points on triangles that are drawn by `shown` (nt,).

    A place in the shadow that the scene throws counts once, for the triangle that light meets there first.
    """
    number, drawn = np.arange(1, len(direction) + 1), Stretches(shown)
    which = drawn.pick(additive(number, STEPS[1], 0.5)[0])
    surface = world.surface(which, *(x.astype(np.float32) for x in triangle(*additive(number, STEPS[2], 0.5))))
    origin, _ = clusters(world).before(surface.position.astype(np.float64), direction)
    first = _first_met(world, origin, direction) == which
    cosine = np.abs(dot_rows(surface.ng, direction))
    return float((first * cosine * world.area[which] / drawn.probability[which]).mean())


def _lamps_met(world: World, sources: list) -> float:
    """Flux of lamps that meets a surface."""
    emission = Emission(world, sources)
    if emission.is_dark:
        return 0.0
    p = emission.draw(PARTICLES, np.random.default_rng(0))
    triangle, _, _, t = world.intersect(p.origin, p.direction, p.kind)
    return float(p.weight[(triangle >= 0) & (t >= p.dark)].sum(dtype=np.float64))


def _faces_met(world: World, mesh: MeshLights) -> float:
    """Share of the flux of emitting faces that meets a surface."""
    if not mesh.any:
        return 0.0
    u = additive(np.arange(1, PARTICLES + 1), STEPS[4], 0.5)
    u = np.concatenate([u, additive(np.arange(1, PARTICLES + 1), STEPS[1], 0.5)])
    which = mesh.triangles[PowerTable(mesh.importance).pick(u[4])]
    surface = world.surface(which, *(x.astype(np.float32) for x in triangle(u[0], u[1])))
    back = u[2] < 0.5
    normal = np.where(back[:, None], -surface.ng, surface.ng)
    met = _first_met(world, world.leave(surface, back), cosine_directions(normal, (2 * u[2]) % 1, u[3]))
    return float((met >= 0).mean())


def _first_met(world: World, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(n,) int32 triangles that light along these rays meets, -1 for none."""
    rays = (np.ascontiguousarray(x, np.float32) for x in (origin, direction))
    return world.intersect(*rays, RayKind.SHADOW)[0]
