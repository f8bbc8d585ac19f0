"""Maps from random numbers to the rays that leave lights: origins and directions as rows, (n, 3) float64, for shooting."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..sampling.maps import cone_local, disk, frame_rows, polar_rows
from ..scene.clusters import Clusters

MOST_ROUNDS = 64


def reject(rows: np.ndarray, keep: Callable, propose: Callable, rng: np.random.Generator) -> None:
    """Replace `rows` (n, ...) by `propose(how many)` until each has passed with probability `keep(rows)`, in place.

    Callers see to it that about a third or more pass. What is left after `MOST_ROUNDS` repeats rows that have passed, which are
    distributed alike.
    """
    which = np.arange(len(rows))
    for _ in range(MOST_ROUNDS):
        which = which[rng.random(len(which)) >= keep(rows[which])]
        if not len(which):
            return
        rows[which] = propose(len(which))
    passed = np.delete(np.arange(len(rows)), which)
    if len(passed):
        rows[which] = rows[rng.choice(passed, len(which))]


def sphere_directions(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions."""
    return cone_directions(-1.0, s, t)


def cone_directions(low: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions with z between `low` and 1."""
    return np.ascontiguousarray(cone_local(1 - low, s, t).T)


def lambert_cone(widest: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) directions with density proportional to cosine, up to the angle of sine `widest` from z."""
    return polar_rows(widest**2 * s, 2 * np.pi * t)


def across(direction: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 3) offsets x, y (n,) along two axes at right angles to each direction (n, 3)."""
    first, second = frame_rows(direction)
    return x[:, None] * first + y[:, None] * second


def from_outside(spheres: Clusters, direction: np.ndarray, square: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) origins before the scene, uniform on the disks that beams along `direction` (n, 3) need to cover the spheres `which` (n,), and
    how many of the spheres each ray enters, (n,)."""
    x, y = disk(square[:, 0], square[:, 1])
    at = spheres.center[which] + spheres.radius[which, None] * across(direction, x, y)
    return spheres.before(at, direction, which)
