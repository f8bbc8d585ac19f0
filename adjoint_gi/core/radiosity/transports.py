"""Transports of light between element sides: the operator T of the radiance equation and its adjoint T*, in finite elements.

With x a radiosity, H = F x is the irradiance it causes and T x = rho F x what is reflected of it (review, Eq. 11). Under the
area-weighted product <x, y> = sum A x y the adjoint is T* y = F* (rho y), with F*_ji = A_i F_ij / A_j, whether or not the
factors obey reciprocity A_i F_ij = A_j F_ji; where they do, F* = F. The form factors are grey, rho has three channels.
"""

from __future__ import annotations

import numpy as np

from ..base.parallel import in_order
from ..elements.rays import RAYS_PER_TASK, STREAMS, ElementRays


class Transport:
    """Base. area (n,) float64 m2, rho (n, 3) float64; fields are (n, c) float64 with c = 3, or 1 for grey ones.

    other (3,): flux in W of the last shot that surfaces took by other lobes than the diffuse one; 0 where there are none.
    """

    area: np.ndarray
    rho: np.ndarray
    other: np.ndarray = np.zeros(3)

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x: irradiance (n, c) from radiosity x (n, c)."""
        raise TypeError(f"{type(self).__name__} does not define gather()")

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y (n, c): the same light, pushed by those who send it."""
        raise TypeError(f"{type(self).__name__} does not define spread()")

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shoot `radiosity` (m, c) of sides `index` (m,), with `rays` (m,) rays each where rays are cast.

        Returns the irradiance (n, c) it causes everywhere and the flux (c,) in W that escapes; no flux is lost in between.
        """
        raise TypeError(f"{type(self).__name__} does not define shoot()")

    def apply(self, x: np.ndarray) -> np.ndarray:
        """T x = rho F x."""
        return self.rho * self.gather(x)

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """T* y = F* (rho y)."""
        return self.spread(self.rho * y)


class MatrixTransport(Transport):
    """All form factors in one dense matrix, with the share `sky` (n,) of each side's light that escapes."""

    def __init__(self, area: np.ndarray, rho: np.ndarray, factors: np.ndarray, sky: np.ndarray | None = None) -> None:
        self.area = np.asarray(area, np.float64)
        self.rho = np.asarray(rho, np.float64)
        self.factors = factors
        self.sky = np.zeros(len(self.area)) if sky is None else sky

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x."""
        return self.factors @ x

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y."""
        return (self.factors.T @ (self.area[:, None] * y)) / self.area[:, None]

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns of F* times the radiosity."""
        flux = self.area[index, None] * radiosity
        return (self.factors[index].T @ flux) / self.area[:, None], self.sky[index] @ flux


class RayTransport(Transport):
    """Rays drawn once and kept as pairs of sides: no n x n array, and exactly dual because both ways use the same rays."""

    def __init__(self, area: np.ndarray, rho: np.ndarray, source: np.ndarray, target: np.ndarray) -> None:
        """`source`, `target` (r,): sides at the two ends of every ray, target -1 where it escapes; each source's rays weigh the same."""
        self.area = np.asarray(area, np.float64)
        self.rho = np.asarray(rho, np.float64)
        n = len(self.area)
        count = np.maximum(np.bincount(source, minlength=n), 1)
        hit = target >= 0
        self.sky = np.bincount(source[~hit], minlength=n) / count
        order = np.argsort(source[hit], kind="stable")
        self.source, self.target = source[hit][order], target[hit][order]
        self.weight = 1.0 / count[self.source]
        self._start = np.searchsorted(self.source, np.arange(n + 1))

    @classmethod
    def cast(cls, rays: ElementRays, per_side: int, sides: np.ndarray | None = None) -> RayTransport:
        """Draw `per_side` rays from each of `sides` (all sides when None)."""
        e = rays.elements
        sides = np.arange(2 * e.count) if sides is None else sides
        pieces = [met.ravel() for _, met in rays.rows(sides, per_side)]
        target = np.concatenate(pieces).astype(np.int64) if pieces else np.zeros(0, np.int64)
        return cls(e.held.area, e.held.albedo, np.repeat(sides, per_side), target)

    def _sum(self, to: np.ndarray, values: np.ndarray) -> np.ndarray:
        n = len(self.area)
        return np.stack([np.bincount(to, values[:, c], n) for c in range(values.shape[1])], axis=1)

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x."""
        return self._sum(self.source, self.weight[:, None] * x[self.target])

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y."""
        return self._sum(self.target, (self.weight * self.area[self.source])[:, None] * y[self.source]) / self.area[:, None]

    def row(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Sides seen from `side`, with repeats, and their weights: one row of F."""
        part = slice(self._start[side], self._start[side + 1])
        return self.target[part], self.weight[part]

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Along the kept rays of the shooting sides."""
        many = self._start[index + 1] - self._start[index]
        who = np.repeat(np.arange(len(index)), many)
        ray = np.arange(len(who)) - np.repeat(np.cumsum(many) - many, many) + self._start[index][who]
        flux = self.area[index, None] * radiosity
        arrived = self._sum(self.target[ray], self.weight[ray, None] * flux[who])
        return arrived / self.area[:, None], self.sky[index] @ flux


class FreshRayTransport(Transport):
    """Rays cast anew at every shot, another part of the set each time a side shoots again, and none kept.

    With `rng` each shot of a side shifts the set at random, so that the mean over generators is exact.
    """

    def __init__(self, rays: ElementRays, rng: np.random.Generator | None = None) -> None:
        e = rays.elements
        self.rays = rays
        self.rng = rng
        self.area, self.rho = e.held.area, e.held.albedo
        self.count = 0  # rays cast so far
        self._used = np.zeros(2 * e.count, np.int64)  # points of its set that a side has used up

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every ray carries the same share of its side's flux."""
        n = len(self.area)
        who = np.repeat(np.arange(len(index)), rays)
        number = np.arange(len(who)) - np.repeat(np.cumsum(rays) - rays, rays) + self._used[index][who]
        side = index[who]
        stream = side if self.rng is None else self.rng.integers(STREAMS, size=len(index))[who]
        self._used[index] += rays
        self.count += len(who)

        def work(first: int) -> np.ndarray:
            part = slice(first, first + RAYS_PER_TASK)
            return self.rays.cast(side[part], number[part], stream[part])

        met = np.concatenate(list(in_order(work, range(0, len(who), RAYS_PER_TASK))))
        share = self.area[index, None] * radiosity / rays[:, None]
        # Rays that escape are summed in one more bin, so that arrived and escaped come from the same sum.
        bins = np.where(met < 0, n, met)
        arrived = np.stack([np.bincount(bins, share[who, c], n + 1) for c in range(share.shape[1])], axis=1)
        return arrived[:n] / np.maximum(self.area, 1e-300)[:, None], arrived[n]
