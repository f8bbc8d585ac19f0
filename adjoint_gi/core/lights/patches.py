"""Points on triangles whose emission varies, drawn where it is bright: small triangles of equal area are picked by what they emit."""

from __future__ import annotations

import numpy as np

from ..sampling import maps as sampling
from ..scene.mean_emission import mean_emission
from ..scene.world import World

PATCHES = 1 << 16  # of all triangles together, about
MOST_SIDE = 64
FLOOR = 0.05  # share of its triangle's mean emission at which a patch is taken at least, as rounding or a product of images may hide light


def sides(area: np.ndarray, varies: np.ndarray) -> np.ndarray:
    """(k,) int64 patches a side of triangles of `area` (k,): several where their emission `varies` (k,)."""
    area = area * varies
    wanted = np.sqrt(PATCHES * area / max(area.sum(), 1e-300))
    return np.clip(wanted, 1, MOST_SIDE).astype(np.int64)


def numbered(side: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of every patch, (n,): its triangle's place in `side`, i, j, down, and whether it exists."""
    count = 2 * side**2
    own = np.repeat(np.arange(len(side)), count)
    number = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
    k = side[own]
    down = number & 1
    i, j = (number >> 1) // k, (number >> 1) % k
    return own, i, j, down, i + j + down < k


def radiance(world: World, triangles: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(n, 3) float64 mean radiance of every patch of `triangles` (k,), 0 of those that do not exist."""
    own, i, j, down, exists = (x[..., None] for x in numbered(side))
    exists = exists[:, 0]
    u, v = _corner(i, j, down, side[own], np.array([0, 1, 0]), np.array([0, 0, 1]))
    out = np.zeros((len(own), 3))
    out[exists] = mean_emission(world.shading, triangles[own[exists, 0]], u[exists], v[exists])
    return out


def _corner(
    i: np.ndarray, j: np.ndarray, down: np.ndarray, side: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return np.where(down, i + 1 - a, i + a) / side, np.where(down, j + 1 - b, j + b) / side


class Patches:
    """Small triangles of k triangles, side x side of each.

    A patch (i, j, down) has barycentrics (i + a, j + b) / side, or (i + 1 - a, j + 1 - b) / side where it stands upside down; number
    (i side + j) 2 + down. Those beyond the diagonal have no chance.
    """

    def __init__(self, side: np.ndarray, light: np.ndarray) -> None:
        """`side` (k,) of each triangle, `light` (sum of 2 side^2,) what patches emit per area."""
        self.side = side
        own, i, j, down, exists = numbered(side)
        self._start = np.concatenate([[0], np.cumsum(2 * side**2)])
        mean = np.bincount(own, light * exists, len(side)) / side**2
        light = np.where(exists, np.maximum(light, FLOOR * mean[own]), 0.0)
        total = np.bincount(own, light, len(side))
        light[exists] = np.where(total[own] > 0, light, 1.0)[exists]
        self._cum = np.concatenate([[0.0], np.cumsum(light)])
        # Density over that of uniform points: a patch has 1 / side^2 of the area.
        self._density = (light / np.maximum(np.bincount(own, light, len(side)), 1e-300)[own] * side[own] ** 2).astype(np.float32)

    def sample(self, k: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Barycentrics (n,) of points on triangles `k` (n,) and their density (n,) over that of uniform points."""
        low, high = self._cum[self._start[k]], self._cum[self._start[k + 1]]
        at = low + u * (high - low)
        patch = np.searchsorted(self._cum, at, side="right") - 1
        patch = np.clip(patch, self._start[k], self._start[k + 1] - 1)
        width = self._cum[patch + 1] - self._cum[patch]
        inside = np.clip((at - self._cum[patch]) / np.maximum(width, 1e-300), 0, 1)
        number, side = patch - self._start[k], self.side[k]
        a, b = sampling.triangle(inside.astype(np.float32), v)
        x, y = _corner((number >> 1) // side, (number >> 1) % side, number & 1, side, a, b)
        return x.astype(np.float32), y.astype(np.float32), self._density[patch]

    def density(self, k: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) float32 density of `sample` at barycentrics of triangles `k` (n,), over that of uniform points."""
        side = self.side[k]
        x, y = np.maximum(u, 0) * side, np.maximum(v, 0) * side
        i, j = (np.clip(z.astype(np.int64), 0, side - 1) for z in (x, y))
        down = ((x - i) + (y - j) > 1) & (i + j + 1 < side)
        # Rounding may carry a point beyond the diagonal.
        j = np.minimum(j, side - 1 - i)
        return self._density[self._start[k] + 2 * (i * side + j) + down]
