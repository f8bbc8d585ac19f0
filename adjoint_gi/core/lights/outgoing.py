"""Maps from random numbers to the rays that leave lights: origins and directions as rows, (n, 3) float64, for shooting."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def reject(local: np.ndarray, keep: Callable, propose: Callable, rng: np.random.Generator) -> None:
    """Replace the directions in `local` (n, 3) until each has passed with probability `keep(direction)`, in place."""
    which = np.arange(len(local))
    while len(which):
        which = which[rng.random(len(which)) >= keep(local[which])]
        local[which] = propose(rng.random(len(which)), rng.random(len(which)))


def sphere_directions(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions."""
    return cone_directions(-1.0, s, t)


def cone_directions(low: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions with z between `low` and 1."""
    gap = (1 - low) * s  # 1 - z, kept apart because a narrow cone would lose it to rounding
    r = np.sqrt(np.maximum(0, gap * (2 - gap)))
    phi = 2 * np.pi * t
    return np.stack([r * np.cos(phi), r * np.sin(phi), 1 - gap], axis=1)


def lambert_cone(widest: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) directions with density proportional to cosine, up to the angle of sine `widest` from z."""
    r = widest * np.sqrt(s)
    phi = 2 * np.pi * t
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(np.maximum(0, 1 - r * r))], axis=1)


def disk(s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y of uniform points of the unit disk."""
    r = np.sqrt(s)
    phi = 2 * np.pi * t
    return r * np.cos(phi), r * np.sin(phi)


def across(direction: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 3) offsets x, y along two axes at right angles to each direction (frame of Duff et al. 2017)."""
    dx, dy, dz = direction.T
    sign = np.where(dz < 0, -1.0, 1.0)
    a = -1 / (sign + dz)
    b = dx * dy * a
    first = np.stack([1 + sign * dx * dx * a, sign * b, -sign * dx], axis=1)
    second = np.stack([b, sign + dy * dy * a, -dy], axis=1)
    return x[:, None] * first + y[:, None] * second


def from_outside(direction: np.ndarray, radius: float, square: np.ndarray) -> np.ndarray:
    """(n, 3) origins, uniform on the disk before the scene that a beam along `direction` needs to cover it."""
    x, y = disk(square[:, 0], square[:, 1])
    return radius * (across(direction, x, y) - direction)


def cosine_directions(normal: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) float32 unit directions with density cos / pi about unit normals (n, 3), from s and t uniform in 0..1.

    A uniform point of the unit sphere on top of the tip of the normal: no tangent frame is needed.
    """
    z = (1 - 2 * s).astype(np.float32)
    r = np.sqrt(np.maximum(1 - z * z, np.float32(0)))
    phi = (2 * np.pi * t).astype(np.float32)
    direction = np.empty((len(normal), 3), np.float32)
    direction[:, 0] = r * np.cos(phi)
    direction[:, 1] = r * np.sin(phi)
    direction[:, 2] = z
    direction += normal
    square = np.einsum("ij,ij->i", direction, direction)
    # The point opposite the normal gives no direction. It and what rounding cannot tell from it make 1 in 10^8: the normal is taken.
    bad = square < 1e-8
    if bad.any():
        direction[bad] = normal[bad]
        square[bad] = 1
    direction /= np.sqrt(square)[:, None]
    return direction
