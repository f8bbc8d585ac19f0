"""Transport between element sides and direction bins, T = S V, and the schemes that relax it (Immel, Cohen and Greenberg 1986).

Fields are (n sides, bins, 3) float64: L(i, d), the radiance that leaves side i into bin d, or I(i, d), what arrives there out of bin d.
V follows rays: every pair (i, d) has its own, kept as the pair (j, e) that each of them meets; I = V L is the mean over them. S is the
scattering on every element, L = E + S I. The adjoint under <x, y> = sum A x y over projected solid angle is exact, as both ways use the
same rays.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..base.parallel import in_order
from ..elements.rays import RAYS_PER_TASK, shifted_points
from .bins import Bins
from .pairs import PAIRS
from .rays import DirectionalRays
from .scattering import Scattering

RAYS_PER_SUM = 1 << 17  # rays that are summed at once
TOGETHER = 0.25  # sides that shoot together: those with this share of the largest unshot flux, or more


class DirectionalTransport:
    """Rays between (side, bin) pairs, sparse, and the scattering between them.

    met (n bins rays,) int32: pair j * bins + e that each ray meets, -1 where it escapes; rays of a pair follow one another.
    color (n bins rays, 3) float32: what rays take from tinted surfaces that they pass; None where there are none.
    """

    def __init__(self, caster: DirectionalRays, scattering: Scattering[Bins], rays: int) -> None:
        e = caster.elements
        self.caster, self.bins, self.scattering, self.rays = caster, scattering.basis, scattering, rays
        self.area, self.share = e.held.area, e.held.share[:, None, None]
        self.count = 2 * e.count
        self.met = np.zeros(0, np.int32)
        self.color: np.ndarray | None = None
        self._order: tuple[np.ndarray, np.ndarray] | None = None

    def cast(self) -> Iterator[float]:
        """Cast all rays, `rays` for every pair, stratified over the bin and the element; yields the share done."""
        k, per = self.bins.size, self.bins.size * self.rays
        block = max(1, RAYS_PER_TASK // per)
        pieces = []

        def work(first: int) -> tuple[np.ndarray, np.ndarray | None]:
            pair = np.repeat(np.arange(first * k, min(first + block, self.count) * k), self.rays)
            number = np.tile(np.arange(self.rays), len(pair) // self.rays)
            side = pair // k
            # One set over all rays of a side for the places, so that its bins do not share a few; one of each bin for directions.
            u = shifted_points(pair % k * self.rays + number, side).astype(np.float32)
            p = shifted_points(number, pair)
            met, w, color = self.caster.trace(side, u[0], u[1], self.bins.directions(pair % k, p[2], p[3], side))
            return np.where(met < 0, -1, met * k + self.bins.of(w, met)).astype(np.int32), color

        for done, piece in enumerate(in_order(work, range(0, self.count, block)), 1):
            pieces.append(piece)
            yield min(1.0, done * block / max(1, self.count))
        if pieces:
            self.met = np.concatenate([met for met, _ in pieces])
            self.color = np.concatenate([color for _, color in pieces]) if self.caster.tinted else None

    # ---- operators

    def field(self) -> np.ndarray:
        """A zero field with one more row, (n bins + 1, 3) float64, which stays 0 and is what rays that escape read."""
        return np.zeros((self.count * self.bins.size + 1, 3))

    def arriving(self, padded: np.ndarray, first: int, last: int) -> np.ndarray:
        """V: what arrives on sides `first` to `last`, (m, bins, 3), of a `field` of leaving radiance."""
        per = self.bins.size * self.rays
        rays = slice(first * per, last * per)
        light = padded.take(self.met[rays], axis=0, mode="wrap")
        if self.color is not None:
            light *= self.color[rays]
        return light.reshape(-1, self.rays, 3).mean(axis=1).reshape(last - first, self.bins.size, 3)

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Ranges of sides, whole elements each, that are worked on at once."""
        step = 2 * max(1, RAYS_PER_SUM // (2 * self.bins.size * self.rays))
        for first in range(0, self.count, step):
            yield first, min(first + step, self.count)

    def gather(self, x: np.ndarray) -> np.ndarray:
        """V x."""
        padded = self.field()
        padded[:-1] = x.reshape(-1, 3)
        return np.concatenate([self.arriving(padded, *b) for b in self.blocks()]) if self.count else x.copy()

    def spread(self, y: np.ndarray) -> np.ndarray:
        """V* y."""
        hit = np.flatnonzero(self.met >= 0)
        pair, target = hit // self.rays, self.met[hit]
        size = self.area[:, None, None] * self.bins.solid
        weighted = (size * y / self.rays).reshape(-1, 3)
        out = np.stack([np.bincount(target, self._colored(weighted[pair, c], hit, c), len(weighted)) for c in range(3)], axis=1)
        return out.reshape(x_shape(self)) / np.maximum(size, 1e-300)

    def apply(self, x: np.ndarray) -> np.ndarray:
        """T x = S V x."""
        return self.share * self.scattering.apply(self.gather(x))

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """T* y = V* S* y."""
        return self.spread(self.scattering.adjoint(self.share * y))

    def flux(self, x: np.ndarray) -> np.ndarray:
        """(n,) flux of a field, absolute values, the channels summed, W."""
        return self.area * (self.bins.solid * np.abs(x)).sum(axis=(1, 2))

    def sky(self) -> np.ndarray:
        """(n, bins, 1) share of the rays of every pair that escapes; (n, bins, 3) by channel where surfaces on their way are tinted."""
        out = (self.met < 0)[:, None]
        return self._mean(out if self.color is None else out * self.color)

    def taken(self) -> np.ndarray:
        """(n, bins, 3) share of what every pair sends that surfaces on the way take; (1,) zero where none is tinted."""
        return np.zeros(1) if self.color is None else 1 - self._mean(self.color)

    def _mean(self, x: np.ndarray) -> np.ndarray:
        """Means (n, bins, c) over the rays of each pair, of x (n bins rays, c)."""
        return x.reshape(-1, self.rays, x.shape[1]).mean(axis=1).reshape(self.count, self.bins.size, x.shape[1])

    def _colored(self, values: np.ndarray, ray: np.ndarray, channel: int) -> np.ndarray:
        return values if self.color is None else values * self.color[ray, channel]

    def middles(self) -> np.ndarray:
        """(n bins, 3) float32 unit directions in the world of the middles of every pair's bin."""
        half = np.full(self.count * self.bins.size, 0.5)
        side, bin = np.repeat(np.arange(self.count), self.bins.size), np.tile(np.arange(self.bins.size), self.count)
        return self.caster.to_world(side, self.bins.directions(bin, half, half, side))

    # ---- schemes: each yields the residual relative to the solution after every iteration, and None in between.

    def neumann(self, leaving: np.ndarray, arriving: np.ndarray, high: int, tolerance: float, limit: int) -> Iterator[tuple]:
        """Jacobi from zero: yields (None, None), and for path lengths 1, 2, .. `high` (residual, what arrives of just that length)."""
        padded, total = self.field(), 0.0
        padded[:-1] = leaving.reshape(-1, 3)
        term = np.empty(x_shape(self))
        for length in range(1, min(high, limit) + 1):
            for first, last in self.blocks():
                term[first:last] = self.arriving(padded, first, last)
                yield None, None
            if length == 1:
                term += arriving
            size = float(self.flux(term).sum())
            total += size
            residual = size / total if total else 0.0
            yield residual, term
            if residual <= tolerance or length == high:
                return
            for first, last in self.blocks():
                padded[first * self.bins.size : last * self.bins.size] = self._scattered(term, first, last)
                yield None, None

    def gauss_seidel(self, solution: np.ndarray, leaving: np.ndarray, arriving: np.ndarray, tolerance: float, limit: int) -> Iterator:
        """Block Gauss-Seidel on I = V (E + S I) + I0, in place in `solution` (n, bins, 3): each block of rows uses those already done."""
        k = self.bins.size
        padded = self.field()
        padded[:-1] = leaving.reshape(-1, 3)
        padded[:-1] += (self.share * self.scattering.apply(solution)).reshape(-1, 3)
        for _ in range(limit):
            change = 0.0
            for first, last in self.blocks():
                new = self.arriving(padded, first, last) + arriving[first:last]
                change += float((self.area[first:last, None, None] * np.abs(new - solution[first:last])).sum())
                solution[first:last] = new
                padded[first * k : last * k] = leaving[first:last].reshape(-1, 3) + self._scattered(solution, first, last)
                yield None
            size = float((self.area[:, None, None] * solution).sum())
            residual = change / size if size else 0.0
            yield residual
            if residual <= tolerance:
                return

    def southwell(self, solution: np.ndarray, leaving: np.ndarray, arriving: np.ndarray, tolerance: float, limit: int) -> Iterator:
        """Southwell on the same system: sides with the most unshot radiance add it, along their column, to what arrives elsewhere."""
        k = self.bins.size
        ray, start = self._columns()
        solution += arriving
        unshot = leaving + self.share * self.scattering.apply(arriving)
        whole = float(self.flux(unshot).sum())
        for _ in range(limit):
            flux = self.flux(unshot)
            left = float(flux.sum())
            yield left / whole if whole else 0.0
            if left <= tolerance * whole:
                return
            index = np.flatnonzero(flux >= TOGETHER * flux.max())
            # The rays that end at the shooting sides, which is their column of V.
            many = start[index + 1] - start[index]
            rays = ray[np.arange(int(many.sum())) - np.repeat(np.cumsum(many) - many, many) + np.repeat(start[index], many)]
            sent = unshot.reshape(-1, 3)[self.met[rays]] / self.rays
            if self.color is not None:
                sent *= self.color[rays]
            unshot[index] = 0.0
            pair = rays // self.rays
            light = np.stack([np.bincount(pair, sent[:, c], self.count * k) for c in range(3)], axis=1).reshape(x_shape(self))
            solution += light
            lit = light.any(axis=(1, 2))
            for first, last in self.blocks():
                if lit[first:last].any():
                    unshot[first:last] += self._scattered(light, first, last).reshape(last - first, k, 3)
                    yield None

    def _columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Rays in the order of the side they meet, and the first ray (n + 1,) of every side."""
        if self._order is None:
            side = self.met // np.int32(self.bins.size)  # -1 where they escape
            ray = np.argsort(side, kind="stable").astype(np.int32)
            many = np.bincount(side + 1, minlength=self.count + 1)
            self._order = ray, np.cumsum(many)
        return self._order

    def _scattered(self, arriving: np.ndarray, first: int, last: int) -> np.ndarray:
        return (self.share[first:last] * self.scattering.apply(arriving[first:last], first=first // 2)).reshape(-1, 3)


def x_shape(transport: DirectionalTransport) -> tuple[int, int, int]:
    """Shape of a field: (sides, bins, 3)."""
    return transport.count, transport.bins.size, 3


def pairs_needed(bins: int) -> int:
    """Pairs of directions from which the scattering between so many bins is counted."""
    return min(max(PAIRS, 64 * bins), 1 << 20)


def bytes_needed(sides: int, bins: int, rays: int, parts: int, tinted: bool) -> int:
    """Memory of the rays, both ways, coloured where any surface is `tinted`, of the fields, and of `parts` scattering matrices with what it
    takes to make them."""
    matrices = (parts + 3) * 4 * 8 * bins * bins + 400 * pairs_needed(bins) if parts else 0
    return sides * bins * ((36 if tinted else 12) * rays + 9 * 24) + matrices + (64 << 20)
