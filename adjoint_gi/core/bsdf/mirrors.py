"""Perfect reflection and refraction: every direction that mirror-like lobes send light from, with its weight, without random numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from . import table as bsdf
from .lobes import LOBES, PASSING, REFLECTING, REFRACTING, present


@dataclass(frozen=True, eq=False)
class Branch:
    """Rays that leave some of the points: rows (m,), wi (m, 3) unit in the world, weight (m, 3) = f |cos| over the delta's measure.

    `through`: all of them lie beyond the surface, or none.
    """

    rows: np.ndarray
    wi: np.ndarray
    weight: np.ndarray
    through: bool


def branches(lobes: bsdf.Lobes, mirror: tuple[np.ndarray, ...]) -> Iterator[Branch]:
    """For every slot of `lobes` its reflected and its transmitted ray, at the points where `mirror` (one (n,) bool for each slot) says
    that the lobe is taken as perfectly smooth. Glass splits by Fresnel's equations; where it reflects totally nothing goes through.
    """
    for i, which in enumerate(mirror):
        for through, able in ((False, REFLECTING), (True, PASSING)):
            rows = np.flatnonzero(which & able[lobes.slots[i].kind])
            if len(rows):
                yield _branch(lobes, i, rows, through)


def _branch(lobes: bsdf.Lobes, i: int, rows: np.ndarray, through: bool) -> Branch:
    """The rays of slot `i` that are reflected, or that go through."""
    number = lobes.slots[i].kind[rows]
    wi = lobes.local[rows] * np.array([-1, -1, 1], np.float32)
    weight = np.zeros((len(rows), 3), np.float32)
    for k in present(number):
        at = np.flatnonzero(number == k)
        seen = lobes.seen(i, rows[at])
        if through:
            wi[at], passed = LOBES[k].passed(seen)
            weight[at] = seen.color * passed[:, None]
        else:
            weight[at] = LOBES[k].reflected(seen, seen.wo[:, 2])
        weight[at] *= lobes.slots[i].weight[rows[at], None]
    world = lobes.take(rows).to_world(wi)
    if through:
        # A transparent surface must not turn rays where its shading normal leans away.
        straight = ~REFRACTING[number]
        world[straight] = -lobes.wo[rows[straight]]
    return Branch(rows, world, weight, through)
