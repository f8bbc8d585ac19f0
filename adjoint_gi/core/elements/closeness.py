"""Light between surfaces that lie closer together than their elements are wide, which elements cannot resolve.

An element is one number: what it gets from a panel a centimetre away is spread over its whole width, and reflected from there. How much of
the light is in such places is found by a few rays from each element that sends any: its middle distance to what they meet, against its
width. A lamp beside a wall lights a spot of it that is smaller than an element: that is found by particles from lamps, and the width of the
elements they meet.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..base.errors import Notice
from ..bsdf.lobes import opaque
from ..lights.base import LampKind, ParticleSource
from ..lights.emission import Emission
from ..lights.lamps import Lamps
from ..sampling.maps import cosine_directions
from ..scene.arrays import RayKind
from ..scene.world import World
from .elements import Elements
from .rays import ElementRays

RAYS = 8  # from each side
MOST_SIDES = 8000  # that send most
PARTICLES = 1 << 12  # from lamps
CLOSE = 0.5  # of an element's width
TOLD = 0.02  # share of the light that is worth a notice
NAMED = 3  # objects
LOW = 0.1  # of the light that is close, the share that is closer than the distance which is told
MOST_PIECES = 1e6  # which surfaces may be cut into for a remedy


def middle_distances(elements: Elements, sides: np.ndarray) -> np.ndarray:
    """(m,) median distance of what rays of `sides` (m,) meet, inf where most escape."""
    owner = np.repeat(sides, RAYS)
    origin, direction, _ = ElementRays(elements).start(owner, np.tile(np.arange(RAYS), len(sides)), owner)
    triangle, _, _, t = elements.world.intersect(origin, direction, RayKind.DIFFUSE)
    return np.median(np.where(triangle >= 0, t, np.float32(np.inf)).reshape(-1, RAYS), axis=1)


def close_light(elements: Elements, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the `flux` (2 ne,) that sides send, W, the part sent where surfaces are closer than elements are wide: (objects,) by the object
    that sends it, and the least distance (objects,) found there, inf where there is none."""
    sides = np.argsort(-flux, kind="stable")[:MOST_SIDES]
    sides = np.sort(sides[flux[sides] > 0])
    objects = len(elements.world.scene.objects)
    nearest = np.full(objects, np.inf)
    if not len(sides):
        return np.zeros(objects), nearest
    distance, width = middle_distances(elements, sides), np.sqrt(elements.area[sides >> 1])
    near = np.flatnonzero(distance < CLOSE * width)
    owner = elements.world.scene.object[elements.patch_triangle[elements.patch[sides[near] >> 1]]]
    for index in np.unique(owner):
        nearest[index] = distance[near[owner == index]].min()
    return np.bincount(owner, flux[sides[near]], objects), nearest


@dataclass(frozen=True, eq=False)
class Spots:
    """What surfaces get, or reflect, straight from lights that have a place: `total` of it, and by light: names, `close` (k,) of it, where
    lights are closer than what counts it is wide, both W, and the least distance (k,) there, inf where there is none."""

    names: tuple[str, ...]
    close: np.ndarray
    nearest: np.ndarray
    total: float


# At barycentrics (m,) of triangles: (m,) how wide what counts light there is, m, and (m, 3) or 1, what share of it counts.
Counting = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray | float]]


def spots(world: World, sources: list[ParticleSource], counting: Counting) -> Spots:
    """Of `sources`, by particles, always the same. What a mesh sends is as far away as the middle one of rays from the same place: at its
    edges light to surfaces that meet it there is near, and changes slowly. What falls on emitting meshes themselves, as within a bulb, is
    not close to anything, and what falls on glass goes on."""
    if all(s.kind.far for s in sources):
        return Spots((), np.zeros(0), np.zeros(0), 0.0)
    emission = Emission(world, sources)
    rng = np.random.default_rng(0)
    p = emission.draw(PARTICLES, rng)
    triangle, u, v, t = world.intersect(p.origin, p.direction, p.kind)
    met = np.flatnonzero((triangle >= 0) & (t >= p.dark))
    met = met[opaque(world.scene)[triangle[met]]]
    width, share = counting(triangle[met], u[met], v[met])
    sent, light = (p.weight[met] * share).sum(axis=1), p.light[met]
    mesh = np.array([not isinstance(s.kind, LampKind) for s in sources])[light]
    far = np.array([s.kind.far for s in sources])[light] | (mesh & world.shading.emissive()[triangle[met]])
    around, away = np.flatnonzero(mesh & ~far), t[met]
    away[around] = _middle_around(world, p.origin[met[around]], p.direction[met[around]], rng)
    near = (away < CLOSE * width) & (sent > 0) & ~far
    nearest = np.full(len(sources), np.inf)
    for k in np.unique(light[near]):
        nearest[k] = np.quantile(away[near & (light == k)], LOW)
    close = np.bincount(light[near], sent[near], len(sources))
    return Spots(emission.names, close, nearest, float(sent.sum()))


def _middle_around(world: World, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n,) median distance of what rays by the cosine meet from places `origin` (n, 3) of meshes that send light along `direction`."""
    behind = world.intersect(origin, -direction, RayKind.SHADOW)[0]
    normal = world.rows[behind, 9:12]
    normal = normal * np.where(np.einsum("ij,ij->i", normal, direction) < 0, np.float32(-1), np.float32(1))[:, None]
    around = cosine_directions(np.repeat(normal, RAYS, axis=0), *rng.random((2, len(origin) * RAYS)))
    triangle, _, _, t = world.intersect(np.repeat(origin, RAYS, axis=0), around, RayKind.DIFFUSE)
    return np.median(np.where(triangle >= 0, t, np.float32(np.inf)).reshape(-1, RAYS), axis=1)


def lamp_spots(elements: Elements, lamps: Lamps) -> Spots:
    """What surfaces reflect straight from lamps, counted by elements."""

    def counting(*at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        element = elements.locate(*at)
        return np.sqrt(elements.area[element]), elements.albedo[element]

    return spots(elements.world, [s for s in lamps.sources() if not s.kind.far], counting)


def notices(elements: Elements, flux: np.ndarray, lamps: Lamps) -> tuple[Notice, ...]:
    """Says which objects and lamps send light to surfaces too close for their elements, where that is much of the light."""
    part, nearest = close_light(elements, flux)
    lit = lamp_spots(elements, lamps)
    # Points of elements that look at the lamps may miss such a spot: then particles know better how much there is.
    emitted = float((2 * elements.area * elements.emitted.sum(axis=1)).sum())
    total = max(float(flux.sum()), emitted + lit.total)
    names = tuple(x.name for x in elements.world.scene.objects) + lit.names
    found = Spots(names, np.concatenate([part, lit.close]), np.concatenate([nearest, lit.nearest]), total)
    return told(elements.world, found, "elements are wide", "wrong", "Max Element Edge (max_edge)", 1.0, "which has no elements")


def told(world: World, found: Spots, wide: str, how: str, setting: str, part: float, path: str) -> tuple[Notice, ...]:
    """Names the lights, where what is close is worth a notice. wide: what they are closer than. how: light is there. setting: which helps,
    at `part` of the distance. path: what path tracing does instead."""
    if found.total <= 0 or found.close.sum() < TOLD * found.total:
        return ()
    most = np.argsort(-found.close, kind="stable")[: int((found.close > 0).sum())]
    names = tuple(found.names[i] for i in most)
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    closest = float(found.nearest[most].min())
    share = f"{min(found.close.sum() / found.total, 1.0):.0%}"
    reason = f"lights surfaces {closest:.2g} m away, closer than {wide}: {share} of the light begins so, and is {how} there"
    help = _rounded_down(part * closest)
    able = help > 0 and world.area.sum() < MOST_PIECES * help**2
    first = f"Set {setting} to {help:g} m or less" if able else "Move it away from the surface"
    return (Notice(listed, reason, f"{first}, or take Path Tracing, {path}", names=names),)


def _rounded_down(x: float) -> float:
    """`x` to one digit, never more."""
    if not x > 0:
        return 0.0
    unit = 10.0 ** math.floor(math.log10(x))
    return math.floor(x / unit * (1 + 1e-6)) * unit
