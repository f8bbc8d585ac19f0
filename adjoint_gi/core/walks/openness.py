"""Whether light leaves the scene, and whether it arrives at the backs of faces: a few thousand particles, followed before a bake.

A bake shows the fronts of faces. Where much of an object's light arrives at backs, its normals point the wrong way, or it is an open
sheet lit from behind; the share is reported. Light that leaves a nearly closed scene is a leak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.errors import Notice
from ..lights.emission import Emission
from ..scene.world import World
from .particles import Hits, walk

PARTICLES = 8192
LENGTH = 8  # segments a particle is followed
LEAK = 0.03  # a scene that less than this share of the reflected particles leaves is meant to be closed
BACK = 0.01  # share of arrivals at backs from which on it is worth a warning
MIN_ARRIVALS = 50  # arrivals at an object from which on its share means something


@dataclass(frozen=True, eq=False)
class Openness:
    """escaped   share of the particles that met a surface and left the scene afterwards
    back      (number of objects,) float64, share of the arrivals at each object that are at its back
    arrivals  (number of objects,) int64
    """

    escaped: float
    back: np.ndarray
    arrivals: np.ndarray


def measure(world: World, particles: int = PARTICLES) -> Openness:
    """Follow `particles` particles of all lights; nothing arrives where nothing emits."""
    objects = len(world.scene.objects)
    arrivals, back = np.zeros(objects, np.int64), np.zeros(objects)
    emission = Emission(world)
    if emission.is_dark or world.triangle_count == 0:
        return Openness(0.0, back, arrivals)
    rng = np.random.default_rng(0)
    met = 0

    def visit(hits: Hits) -> None:
        nonlocal arrivals, back, met
        surface = hits.surface
        owner = world.scene.object[surface.triangle]
        met += len(owner) if hits.length == 1 else 0
        arrivals = arrivals + np.bincount(owner, minlength=objects)
        back = back + np.bincount(owner, surface.side < 0, minlength=objects)

    ends = walk(world, emission.draw(particles, rng), LENGTH, rng, visit)
    left = ends.escaped - (ends.emitted - met)
    return Openness(left / max(1, met), back / np.maximum(arrivals, 1), arrivals)


def notices(world: World, wanted: set[int] | None = None, particles: int = PARTICLES) -> list[Notice]:
    """What `measure` finds, in words. Backs are reported of the objects `wanted` (indices), by default of all."""
    found = measure(world, particles)
    out = []
    if 0 < found.escaped < LEAK:
        reason = f"{100 * found.escaped:.2g} % of the light leaves the scene, which is nearly closed: it leaks through gaps"
        out.append(Notice("Scene", reason, "Close the gaps, or see the escaped flux in the report"))
    elif found.escaped >= LEAK:
        out.append(Notice("Scene", f"is open: {100 * found.escaped:.0f} % of the light leaves it after a reflection", "", "info"))
    for index in np.flatnonzero((found.back > BACK) & (found.arrivals >= MIN_ARRIVALS)):
        if wanted is None or index in wanted:
            reason = f"{100 * found.back[index]:.0f} % of the light that reaches it arrives at the back of its faces"
            remedy = "Recalculate its normals, unless it is an open sheet; only fronts are baked"
            out.append(Notice(world.scene.objects[index].name, reason, remedy))
    return out
