"""Transports of light between element sides: the operator T of the radiance equation and its adjoint T*, in finite elements.

With x a radiosity, H = F x is the irradiance it causes and T x = rho F x what is reflected of it (review, Eq. 11). Under the
area-weighted product <x, y> = sum A x y the adjoint is T* y = F* (rho y), with F*_ji = A_i F_ij / A_j, whether or not the
factors obey reciprocity A_i F_ij = A_j F_ji; where they do, F* = F.

rho has three channels. Form factors are grey, or have three channels, too, where light between elements passes straight through tinted
surfaces. Then less arrives, or along single rays more, than was sent: what surfaces on the way have taken is `other`.
"""

from __future__ import annotations

import numpy as np

from ..base.parallel import in_order
from ..elements.elements import Elements
from ..elements.rays import RAYS_PER_TASK, STREAMS, ElementRays


class Transport:
    """Base. area (n,) float64 m2, rho (n, 3) float64; fields are (n, c) float64 with c = 3, or colours over and over; or 1 for grey
    ones, where form factors are grey.

    other (c,): flux in W of the last shot that surfaces took by other lobes than the diffuse one, or on the way; 0 where there are none.
    """

    area: np.ndarray
    rho: np.ndarray
    sky: np.ndarray
    other: np.ndarray = np.zeros(3)

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x: irradiance (n, c) from radiosity x (n, c)."""
        raise TypeError(f"{type(self).__name__} does not define gather()")

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y (n, c): the same light, pushed by those who send it."""
        raise TypeError(f"{type(self).__name__} does not define spread()")

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shoot `radiosity` (m, c) of sides `index` (m,), with `rays` (m,) rays each where rays are cast.

        Returns the irradiance (n, c) it causes everywhere and the flux (c,) in W that escapes; with `other`, no flux is lost in between.
        """
        raise TypeError(f"{type(self).__name__} does not define shoot()")

    @property
    def tinted(self) -> bool:
        """Whether form factors have three channels."""
        return self.sky.ndim == 2

    def escaping(self, index: np.ndarray, flux: np.ndarray) -> np.ndarray:
        """(c,) W that escapes of the flux (m, c) that sides `index` send."""
        return self.sky[index] @ flux if self.sky.ndim == 1 else (colored(self.sky[index], flux.shape[1]) * flux).sum(axis=0)

    def apply(self, x: np.ndarray) -> np.ndarray:
        """T x = rho F x."""
        return self.rho * self.gather(x)

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """T* y = F* (rho y)."""
        return self.spread(self.rho * y)


def colored(weight: np.ndarray, columns: int) -> np.ndarray:
    """Weights (m,), or (m, 3) by channel, as factors on fields of `columns` columns, which are colours over and over."""
    return weight[:, None] if weight.ndim == 1 else np.tile(weight, (1, columns // 3))


def product(factors: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(m, c) of factors (m, n), or (3, m, n) by channel, and fields (n, c)."""
    if factors.ndim == 2:
        return factors @ x
    out = np.empty((factors.shape[1], x.shape[1]))
    for c in range(3):
        out[:, c::3] = factors[c] @ x[:, c::3]
    return out


class MatrixTransport(Transport):
    """All form factors in one dense matrix (n, n), with the share `sky` (n,) of each side's light that escapes; where they are tinted, in
    three matrices (3, n, n), with `sky` (n, 3)."""

    def __init__(self, area: np.ndarray, rho: np.ndarray, factors: np.ndarray, sky: np.ndarray | None = None) -> None:
        self.area = np.asarray(area, np.float64)
        self.rho = np.asarray(rho, np.float64)
        self.factors = factors
        self.sky = np.zeros(len(self.area)) if sky is None else sky

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x."""
        return product(self.factors, x)

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y."""
        return product(self.factors.swapaxes(-1, -2), self.area[:, None] * y) / self.area[:, None]

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns of F* times the radiosity."""
        flux = self.area[index, None] * radiosity
        arrived = product(self.factors.take(index, axis=-2).swapaxes(-1, -2), flux)
        escaped = self.escaping(index, flux)
        if self.tinted:
            self.other = flux.sum(axis=0) - arrived.sum(axis=0) - escaped
        return arrived / self.area[:, None], escaped


class RayTransport(Transport):
    """Rays drawn once and kept as pairs of sides: no n x n array, and exactly dual because both ways use the same rays."""

    def __init__(self, area: np.ndarray, rho: np.ndarray, source: np.ndarray, target: np.ndarray, color: np.ndarray | None = None) -> None:
        """`source`, `target` (r,): sides at the two ends of every ray, target -1 where it escapes; each source's rays weigh the same, but
        for the `color` (r, 3) that they take on their way."""
        self.area = np.asarray(area, np.float64)
        self.rho = np.asarray(rho, np.float64)
        n = len(self.area)
        count = np.maximum(np.bincount(source, minlength=n), 1)
        hit = target >= 0
        self.sky = np.bincount(source[~hit], minlength=n) / count
        if color is not None:
            self.sky = self._sum(source[~hit], color[~hit]) / count[:, None]
        order = np.argsort(source[hit], kind="stable")
        self.source, self.target = source[hit][order], target[hit][order]
        self.weight = 1.0 / count[self.source]
        if color is not None:
            self.weight = self.weight[:, None] * color[hit][order]
        self._start = np.searchsorted(self.source, np.arange(n + 1))

    @classmethod
    def cast(cls, rays: ElementRays, per_side: int, sides: np.ndarray | None = None) -> RayTransport:
        """Draw `per_side` rays from each of `sides` (all sides when None)."""
        e = rays.elements
        sides = np.arange(2 * e.count) if sides is None else sides
        return cls.of_rows(e, sides, per_side, list(rays.rows(sides, per_side)))

    @classmethod
    def of_rows(cls, elements: Elements, sides: np.ndarray, per_side: int, rows: list[tuple]) -> RayTransport:
        """From all pieces of `ElementRays.rows`."""
        target = np.concatenate([np.zeros(0, np.int64), *(met.ravel() for _, met, _ in rows)]).astype(np.int64)
        tinted = bool(rows) and rows[0][2] is not None
        color = np.concatenate([color for *_, color in rows]) if tinted else None
        return cls(elements.held.area, elements.held.albedo, np.repeat(sides, per_side), target, color)

    def _sum(self, to: np.ndarray, values: np.ndarray) -> np.ndarray:
        n = len(self.area)
        return np.stack([np.bincount(to, values[:, c], n) for c in range(values.shape[1])], axis=1)

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F x."""
        return self._sum(self.source, colored(self.weight, x.shape[1]) * x[self.target])

    def spread(self, y: np.ndarray) -> np.ndarray:
        """F* y."""
        weight = colored((self.weight.T * self.area[self.source]).T, y.shape[1])
        return self._sum(self.target, weight * y[self.source]) / self.area[:, None]

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
        arrived = self._sum(self.target[ray], colored(self.weight[ray], flux.shape[1]) * flux[who])
        escaped = self.escaping(index, flux)
        if self.tinted:
            self.other = flux.sum(axis=0) - arrived.sum(axis=0) - escaped
        return arrived / self.area[:, None], escaped


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
        """Every ray carries the same share of its side's flux, times the colour that it takes on its way."""
        n = len(self.area)
        who = np.repeat(np.arange(len(index)), rays)
        number = np.arange(len(who)) - np.repeat(np.cumsum(rays) - rays, rays) + self._used[index][who]
        side = index[who]
        stream = side if self.rng is None else self.rng.integers(STREAMS, size=len(index))[who]
        self._used[index] += rays
        self.count += len(who)

        def work(first: int) -> tuple[np.ndarray, np.ndarray | None]:
            part = slice(first, first + RAYS_PER_TASK)
            return self.rays.cast(side[part], number[part], stream[part])

        pieces = list(in_order(work, range(0, len(who), RAYS_PER_TASK)))
        met = np.concatenate([met for met, _ in pieces])
        share = self.area[index, None] * radiosity / rays[:, None]
        color = np.concatenate([color for _, color in pieces]) if self.rays.tinted else None
        # Rays that escape are summed in one more bin, so that arrived and escaped come from the same sum.
        bins = np.where(met < 0, n, met)
        columns = range(share.shape[1])
        carried = (share[who, c] if color is None else share[who, c] * color[:, c % 3] for c in columns)
        arrived = np.stack([np.bincount(bins, flux, n + 1) for flux in carried], axis=1)
        if color is not None:
            self.other = (share * rays[:, None]).sum(axis=0) - arrived.sum(axis=0)
        return arrived[:n] / np.maximum(self.area, 1e-300)[:, None], arrived[n]
