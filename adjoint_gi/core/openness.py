"""Whether a scene is closed and its normals agree: random rays from the fronts of surfaces and from lamps.

With normals that agree, a ray that leaves the front of a surface arrives at the front of another one, in solids and in rooms alike. A
ray that arrives at a back has found a face whose normal points the other way, or an open sheet seen from behind. A bake of such a
face would show the dark side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import Notice
from .world import World

RAYS = 8192
LEAK = 0.03  # a scene from which less than this share of the rays escapes is meant to be closed
BACK = 0.01  # share of arrivals at backs from which on it is worth a warning


@dataclass(frozen=True, eq=False)
class Openness:
    """escaped   share of the rays from surfaces that meet nothing
    back      (number of objects,) float64, share of the arrivals at each object that are at its back
    arrivals  (number of objects,) int64
    """

    escaped: float
    back: np.ndarray
    arrivals: np.ndarray


def measure(world: World, rays: int = RAYS) -> Openness:
    """Send `rays` rays, three quarters from the fronts of surfaces by area (cosine weighted), the others from lamps."""
    objects = len(world.scene.objects)
    if world.triangle_count == 0 or not world.area.sum() > 0:
        return Openness(0.0, np.zeros(objects), np.zeros(objects, np.int64))
    rng = np.random.default_rng(0)

    # Step 1: rays from surfaces.
    many = 3 * rays // 4
    total = np.cumsum(world.area)
    triangle = np.minimum(np.searchsorted(total, rng.random(many) * total[-1], side="right"), world.triangle_count - 1)
    a, b = rng.random((2, many), np.float32)
    u, v = 1 - np.sqrt(a), b * np.sqrt(a)
    surface = world.surface(triangle, u, v)
    origin = world.leave(surface)
    direction = surface.ng + _sphere(rng, many)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-6)

    # Step 2: rays from lamps that have a place.
    lamps = [light for light in world.scene.lights if light.kind != "sun" and any(light.color)]
    if lamps:
        pick = np.arange(rays - many) % len(lamps)
        position = np.array([light.position for light in lamps], np.float64) - world.center
        axis = np.array([light.axis_z for light in lamps], np.float32)[pick]
        one_sided = np.array([light.kind != "point" for light in lamps])[pick]
        way = _sphere(rng, rays - many)
        behind = one_sided & (np.einsum("ij,ij->i", way, axis) > 0)
        way[behind] *= -1
        origin = np.concatenate([origin, position[pick].astype(np.float32)])
        direction = np.concatenate([direction, way])

    # Step 3: where they arrive.
    hit = world.intersect(np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32))[0]
    at = np.flatnonzero(hit >= 0)
    owner = world.scene.object[hit[at]]
    back = np.einsum("ij,ij->i", direction[at], world.rows[hit[at], 9:12]) > 0
    arrivals = np.bincount(owner, minlength=objects)
    share = np.bincount(owner, back, minlength=objects) / np.maximum(arrivals, 1)
    return Openness(float((hit[:many] < 0).mean()), share, arrivals)


def notices(world: World, wanted: set[int] | None = None, rays: int = RAYS) -> list[Notice]:
    """What `measure` finds, in words. Backs are told of the objects `wanted` (indices), by default of all."""
    found = measure(world, rays)
    out = []
    if 0 < found.escaped < LEAK:
        reason = f"{100 * found.escaped:.2g} % of random rays leave the scene, which is nearly closed: light leaks through gaps"
        out.append(Notice("Scene", reason, "Close the gaps, or see the escaped flux in the report"))
    elif found.escaped >= LEAK:
        out.append(Notice("Scene", f"is open: {100 * found.escaped:.0f} % of random rays reach the background", "", "info"))
    for index in np.flatnonzero((found.back > BACK) & (found.arrivals >= 50)):
        if wanted is None or index in wanted:
            reason = f"{100 * found.back[index]:.0f} % of the light that reaches it arrives at the back of its faces"
            remedy = "Recalculate its normals, unless it is an open sheet; only the front is baked"
            out.append(Notice(world.scene.objects[index].name, reason, remedy))
    return out


def _sphere(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 3) float32 unit vectors, uniform."""
    z = 2 * rng.random(n) - 1
    phi = 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
