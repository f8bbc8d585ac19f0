"""The dense form-factor matrix of the sides that light can reach: rays everywhere, closed forms where they hold.

F_ij is the share of the diffuse light leaving i that arrives at j (Goral, Torrance, Greenberg and Battaile 1984; review, Eq. 10 and 11).
It is reciprocal, A_i F_ij = A_j F_ji, and closed: each row and the share of its side's light that escapes sum to 1. Where surfaces between
sides are tinted, each channel has its own matrix, F times the mean colour of the rays of a pair: reciprocal still, but light is lost on
the way.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np

from ..elements.elements import Elements
from ..elements.rays import ElementRays
from .aligned import exact_pairs
from .transports import MatrixTransport

ROWS_PER_BLOCK = 512
CLOSED = 1e-13  # rows are scaled until their sums are this close to 1
NEWTON_STEPS = 8
CG_STEPS = 200


@dataclass(frozen=True)
class FactorReport:
    """What was done to the factors.

    rays          cast for rows and for visibility
    exact, cast   pairs of sides, both ways counted once, by closed form and by rays
    reciprocity   relative change that made the ray-cast ones reciprocal, root mean square weighted by the factors
    closure       largest relative change that closed the rows
    """

    rays: int
    exact: int
    cast: int
    reciprocity: float
    closure: float

    def arrays(self) -> dict[str, np.ndarray]:
        """For `Solution.extra`: all but the rays, "factors_" before each name, (1,) float64."""
        names = ("exact", "cast", "reciprocity", "closure")
        return {f"factors_{name}": np.array([getattr(self, name)], np.float64) for name in names}


def bytes_needed(sides: int, rays: int, tinted: bool) -> int:
    """Memory of `build` for so many sides: float64 factors, one byte of mask, the kept hits and a block of pairs.

    Where what lies between sides is `tinted`, three more matrices and the colours of rays.
    """
    return (33 if tinted else 9) * sides * sides + (16 if tinted else 4) * sides * rays + (64 << 20)


class FactorMatrix:
    """Builds the matrix step by step, so that its user can show progress and stop."""

    def __init__(self, elements: Elements, rays: int, closed_forms: bool = True) -> None:
        self.elements = elements
        self.caster = ElementRays(elements)
        self.rays = rays
        self.closed_forms = closed_forms
        self.sides = np.zeros(0, np.int64)

    def discover(self, lit: np.ndarray) -> Iterator[int]:
        """Follow rays from the sides `lit` (m,), breadth first, to all that light can reach; yields how many are known.

        Afterwards `sides` (n,) lists them in order and every one has its row of rays.
        """
        known = np.zeros(2 * self.elements.count, bool)
        known[lit] = True
        frontier = np.unique(lit)
        rows = []
        while len(frontier):
            fresh = []
            for part, met, color in self.caster.rows(frontier, self.rays):
                rows.append((part, met, color))
                new = np.unique(met)
                new = new[new >= 0]
                new = new[~known[new]]
                known[new] = True
                fresh.append(new)
                yield int(known.sum())
            frontier = np.concatenate(fresh)
        self.sides = np.flatnonzero(known)
        self._rows = rows

    def build(self, rho: np.ndarray) -> Iterator[float]:
        """Fill the matrix; yields the share done. Afterwards `transport` and `report` are there. `rho` (n, 3) of `sides`."""
        n, area = len(self.sides), self.elements.held.area[self.sides]
        factors, sky, mask = np.empty((n, n)), np.zeros(n), np.zeros((n, n), bool)
        tinted = self.caster.tinted
        colors, sky_colors = (np.empty((3, n, n)), np.ones((n, 3))) if tinted else (None, None)
        # 1. Rays everywhere, closed forms for pairs that see each other freely.
        yield from self._cast_rows(factors, sky, colors, sky_colors)
        if tinted:
            self._mean_colors(colors, factors, area)
        exact, rays, stretch = yield from self._put_closed_forms(factors, mask, area)
        # 2. What the closed forms leave of each row is shared out among rays and sky in the proportions that the rays found.
        sky *= stretch
        # 3. Reciprocity and closure, in exchange areas A_i F_ij.
        cast, reciprocity = yield from self._make_reciprocal(factors, mask, stretch, area)
        scale = yield from self._close(factors, area * sky, area)
        for a in range(0, n, ROWS_PER_BLOCK):
            rows = slice(a, a + ROWS_PER_BLOCK)
            factors[rows] *= scale[rows, None] * scale / area[rows, None]
        sky *= scale
        # 4. The colour of what lies between.
        if tinted:
            colors *= factors
            self.transport = MatrixTransport(area, rho, colors, sky[:, None] * sky_colors)
        else:
            self.transport = MatrixTransport(area, rho, factors, sky)
        self.report = FactorReport(n * self.rays + rays, exact, cast, reciprocity, float(np.abs(scale - 1).max(initial=0.0)))
        yield 1.0

    def _cast_rows(self, factors: np.ndarray, sky: np.ndarray, colors: np.ndarray | None, sky_colors: np.ndarray | None) -> Iterator[float]:
        """Fill `factors` (n, n) with the share of each side's rays that meet each side, and `sky` (n,) with that of those that escape.

        Where anything is tinted, `colors` (3, n, n) with the same, times the colours of the rays, and `sky_colors` (n, 3) with the mean
        colour of those that escape.
        """
        n = len(self.sides)
        number = np.full(2 * self.elements.count + 1, n, np.int64)
        number[self.sides] = np.arange(n)
        for done, (part, met, color) in enumerate(self._rows):
            index = number[part]
            column = number[met]  # -1 picks the last entry: escaped, column n
            flat = (np.arange(len(part))[:, None] * (n + 1) + column).ravel()
            counts = np.bincount(flat, minlength=len(part) * (n + 1)).reshape(len(part), n + 1)
            factors[index] = counts[:, :n] / self.rays
            sky[index] = counts[:, n] / self.rays
            for c in range(3) if color is not None else ():
                sums = np.bincount(flat, color[:, c], minlength=len(part) * (n + 1)).reshape(len(part), n + 1)
                colors[c, index] = sums[:, :n] / self.rays
                sky_colors[index, c] = sums[:, n] / np.maximum(counts[:, n], 1)
            yield 0.2 * done / len(self._rows)
        self._rows = []

    @staticmethod
    def _mean_colors(colors: np.ndarray, factors: np.ndarray, area: np.ndarray) -> None:
        """Make `colors` (3, n, n) the mean colour of the rays of each pair, both ways together; 1 where there are none."""
        n = len(area)
        blocks = [slice(a, a + ROWS_PER_BLOCK) for a in range(0, n, ROWS_PER_BLOCK)]
        for a, rows in enumerate(blocks):
            for columns in blocks[a:]:

                def both(x: np.ndarray, rows: slice = rows, columns: slice = columns) -> np.ndarray:
                    return area[rows, None] * x[rows, columns] + (area[columns, None] * x[columns, rows]).T

                found = both(factors)
                for channel in colors:
                    mean = np.where(found > 0, both(channel) / np.where(found > 0, found, 1), 1)
                    channel[rows, columns], channel[columns, rows] = mean, mean.T

    def _put_closed_forms(
        self, factors: np.ndarray, mask: np.ndarray, area: np.ndarray
    ) -> Generator[float, None, tuple[int, int, np.ndarray]]:
        """Replace factors by closed forms where they hold and mark these in `mask` (n, n).

        Returns how many pairs, the rays cast for them, and by how much (n,) the other factors of each row stretch to make up its rest.
        """
        n = len(area)
        exact_sum, met_sum = np.zeros(n), np.zeros(n)
        share = self.elements.held.share[self.sides]
        exact = rays = 0
        for piece in exact_pairs(self.elements, self.sides) if self.closed_forms else ():
            i, j = piece.i, piece.j
            # Of sides that let light through, closed forms know the whole, rays the held part.
            exchange = piece.exchange / (share[i] * share[j])
            f_ij, f_ji = exchange / area[i], exchange / area[j]
            # Rows of rays that meet far too few are a witness against free sight.
            free = self._plausible(factors[i, j], f_ij) & self._plausible(factors[j, i], f_ji)
            i, j, f_ij, f_ji = i[free], j[free], f_ij[free], f_ji[free]
            met_sum += np.bincount(i, factors[i, j], n) + np.bincount(j, factors[j, i], n)
            exact_sum += np.bincount(i, f_ij, n) + np.bincount(j, f_ji, n)
            factors[i, j], factors[j, i] = f_ij, f_ji
            mask[i, j] = mask[j, i] = True
            exact += len(i)
            rays += piece.rays
            yield 0.2 + 0.6 * float(i[-1] if len(i) else 0) / n
        left, found = 1 - exact_sum, 1 - met_sum
        stretch = np.where(found > 1e-9, np.clip(left / np.where(found > 1e-9, found, 1), 0.5, 2.0), 1.0)
        return exact, rays, stretch

    @staticmethod
    def _make_reciprocal(
        factors: np.ndarray, mask: np.ndarray, stretch: np.ndarray, area: np.ndarray
    ) -> Generator[float, None, tuple[int, float]]:
        """Turn factors into exchange areas; both directions of a ray-cast pair become their mean.

        Returns how many pairs rays have found, and the relative change, root mean square weighted by the factors.
        """
        n = len(area)
        change = weight = 0.0
        cast = 0
        for a in range(0, n, ROWS_PER_BLOCK):
            rows = slice(a, a + ROWS_PER_BLOCK)
            factors[rows] *= np.where(mask[rows], 1.0, stretch[rows, None]) * area[rows, None]
        for a in range(0, n, ROWS_PER_BLOCK):
            for b in range(a, n, ROWS_PER_BLOCK):
                rows, columns = slice(a, a + ROWS_PER_BLOCK), slice(b, b + ROWS_PER_BLOCK)
                upper, lower = factors[rows, columns], factors[columns, rows].T
                mean = 0.5 * (upper + lower)
                ray_cast = ~mask[rows, columns] & (mean > 0)
                change += float((((upper - lower)[ray_cast]) ** 2 / mean[ray_cast]).sum()) / 4
                weight += float(mean[ray_cast].sum())
                cast += int(ray_cast.sum())
                factors[rows, columns] = mean
                factors[columns, rows] = mean.T
            yield 0.8 + 0.1 * a / n
        return cast, float(np.sqrt(change / weight)) if weight else 0.0

    def _plausible(self, met: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Whether the share of rays that met a side is not far below its full factor (four standard deviations)."""
        return met >= factor - 4 * np.sqrt(factor / self.rays) - 1 / self.rays

    @staticmethod
    def _close(exchange: np.ndarray, sky: np.ndarray, area: np.ndarray) -> Generator[float, None, np.ndarray]:
        """Returns the scale d (n,) with d_i (sum_j S_ij d_j + sky_i) = area_i, for symmetric S (n, n), by Newton's method.

        Divided by d_i, the system of a Newton step is symmetric, so conjugate gradients solve it.
        """
        scale = np.ones(len(area))
        for _ in range(NEWTON_STEPS):
            got = exchange @ scale + sky
            error = np.where(got > 0, area / scale - got, 0.0)
            if np.abs(error * scale / area).max(initial=0.0) <= CLOSED:
                break
            diagonal = np.where(got > 0, got / scale, area)
            step = np.zeros_like(scale)
            rest, best = error, error / diagonal
            direction, power = best, float(rest @ best)
            for _ in range(CG_STEPS):
                product = diagonal * direction + exchange @ direction
                yield 0.95
                along = float(direction @ product)
                if along <= 0:
                    break
                step = step + power / along * direction
                rest = rest - power / along * product
                best = rest / diagonal
                old, power = power, float(rest @ best)
                if power <= 1e-6 * old or np.abs(rest * scale / area).max() <= 0.1 * CLOSED:
                    break
                direction = best + power / old * direction
            # A scale stays positive and moves by a factor of two at most.
            scale = np.clip(scale + step, 0.5 * scale, 2 * scale)
        return scale
