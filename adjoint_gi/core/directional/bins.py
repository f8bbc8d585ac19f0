"""Bins of the hemisphere: direction discretisation as Immel, Cohen and Greenberg 1986 have it, on either side of an element.

A direction is given in the frame of a side: z along the side's normal, x horizontal. Bins are `rows` rings of equal steps of sin^2 theta,
each cut into `columns` equal angles: every bin has the same projected solid angle, pi / count. So the mean over bins of a radiance,
times pi, is its irradiance, and rays that are equal in number for every bin are distributed by the cosine.

On the inside of glass the rings keep apart what passes and what is reflected totally: `Bins.on` moves the edge nearest to the critical
angle onto it, and shares out the other rings evenly on either side of it (a bin across it let a part of each out: 5 % of a pane's light
were lost). There the bins inside and outside of it differ in size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import numpy as np

from ..sampling.maps import polar_rows
from .pairs import Pairs

TWO_PI = 2 * np.pi
SCALED = 1e-14  # sums of the scattering matrix are this close to the albedo
SCALINGS = 400


class Bins:
    """A hemisphere cut into `rows` x `columns` bins; bin = row * columns + column, row 0 around the normal.

    cut (n,) of all sides: sin^2 of the critical angle, 1 where there is none; None: there is none anywhere.
    solid: projected solid angle of the bins, (n, size, 1), or one number where all are alike.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self.rows, self.columns = rows, columns
        self.size = self.heard = rows * columns
        self.cut: np.ndarray | None = None
        self.solid: np.ndarray | float = np.pi / self.size

    def on(self, cut: np.ndarray) -> Bins:
        """The bins of sides with a critical angle each, `cut` (n,). One ring cannot be parted."""
        return self if self.rows == 1 or (cut >= 1).all() else self._with(cut)

    def _with(self, cut: np.ndarray) -> Bins:
        out = copy(self)
        out.cut = cut
        kinds, which = np.unique(cut, return_inverse=True)
        out.solid = np.pi * np.stack([self.share(c) for c in kinds])[which, :, None]
        return out

    def _below(self, cut: np.ndarray | float) -> np.ndarray:
        """Rings within the critical angle."""
        return np.where(np.asarray(cut) < 1, np.clip(np.round(self.rows * np.asarray(cut)), 1, max(1, self.rows - 1)), self.rows)

    def _row(self, s: np.ndarray, side: np.ndarray | None) -> np.ndarray:
        """(n,) float64 row, with its fraction, of sin^2 `s` (n,) on sides (n,)."""
        s = np.asarray(s, np.float64)
        if self.cut is None:
            return self.rows * s
        cut = self.cut[side]
        below = self._below(cut)
        return np.where(s < cut, below * s / cut, below + (self.rows - below) * (s - cut) / np.maximum(1 - cut, 1e-300))

    def _sine2(self, row: np.ndarray, cut: np.ndarray | float) -> np.ndarray:
        """sin^2 of rows with their fraction: the inverse of `_row`."""
        below = self._below(cut)
        return np.where(row < below, row / below * cut, cut + (1 - cut) * (row - below) / np.maximum(self.rows - below, 1))

    def share(self, cut: float = 1.0) -> np.ndarray:
        """(size,) share of the bins in a mean over the hemisphere of a side with this critical angle."""
        if self.rows == 1:
            cut = 1.0
        return np.repeat(np.diff(self._sine2(np.arange(self.rows + 1.0), cut)), self.columns) / self.columns

    def of(self, w: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """(n,) int64 bin of unit directions `w` (n, 3) of the frames of sides (n,), z > 0."""
        row = np.clip(self._row(w[:, 0] ** 2 + w[:, 1] ** 2, side).astype(np.int64), 0, self.rows - 1)
        turn = np.arctan2(w[:, 1], w[:, 0]) / TWO_PI % 1.0
        return row * self.columns + np.minimum((self.columns * turn).astype(np.int64), self.columns - 1)

    def directions(self, bin: np.ndarray, u: np.ndarray, v: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) float32 unit directions at places u, v (n,) in 0..1 of the bins (n,) of sides (n,), uniform in projected solid angle."""
        row = bin // self.columns + u
        s = row / self.rows if self.cut is None else self._sine2(row, self.cut[side])
        phi = TWO_PI * (bin % self.columns + v) / self.columns
        return polar_rows(s, phi).astype(np.float32)

    def basis(self, w: np.ndarray, side: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Bins (n, 4) int64 around directions `w` (n, 3) and their weights (n, 4), bilinear between the middles of the bins."""
        s = np.clip(self._row(w[:, 0] ** 2 + w[:, 1] ** 2, side) - 0.5, 0, self.rows - 1)
        t = self.columns * (np.arctan2(w[:, 1], w[:, 0]) / TWO_PI % 1.0) - 0.5
        row, low = s.astype(np.int64), np.floor(t)
        above = np.minimum(row + 1, self.rows - 1)
        fs, ft = s - row, t - low
        here, there = low.astype(np.int64) % self.columns, (low.astype(np.int64) + 1) % self.columns
        index = [row * self.columns + here, row * self.columns + there, above * self.columns + here, above * self.columns + there]
        weight = [(1 - fs) * (1 - ft), (1 - fs) * ft, fs * (1 - ft), fs * ft]
        return np.stack(index, axis=1), np.stack(weight, axis=1)

    def constant(self, value: float = 1.0, cut: float = 1.0) -> np.ndarray:
        """(size,) the radiance that is `value` in every direction."""
        return np.full(self.size, float(value))

    def even(self) -> np.ndarray:
        """(1, size) the radiance that is 1 in every direction, on every side."""
        return self.constant()[None]

    def irradiance(self, arriving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of radiance that arrives, a field (n, size, 3)."""
        return (self.solid * arriving).sum(axis=1)

    def exitance(self, leaving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of radiance that leaves, a field (n, size, 3)."""
        return (self.solid * leaving).sum(axis=1)

    def add(self, field: np.ndarray, side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
        """Add to the radiance `field` (n, size, 3) light that arrives on sides (m,) along `w` (m, 3) and adds `value` (m, 3) W m-2 to the
        irradiance."""
        flat = field.reshape(-1, 3)
        bin = self.of(w, side)
        pair = side * self.size + bin
        solid = self.solid if self.cut is None else self.solid[side, bin, 0]
        first = int(pair.min(initial=0))
        for c in range(3):
            sums = np.bincount(pair - first, value[:, c] / solid)
            flat[first : first + len(sums), c] += sums

    def dimming(self, curve: Callable[[np.ndarray], np.ndarray], cut: float = 1.0) -> np.ndarray:
        """(size,) means over the bins of `curve(cosine)`, on a side with this critical angle."""
        s = self._sine2(np.arange(self.rows)[:, None] + (np.arange(16) + 0.5) / 16, cut if self.rows > 1 else 1.0)
        mean = np.asarray(curve(np.sqrt(1 - s).ravel()), np.float64).reshape(s.shape).mean(axis=1)
        return np.repeat(mean, self.columns)

    def kernels(
        self, sides: Sequence[Pairs], measure: np.ndarray | None, cuts: Sequence[float] = (1.0, 1.0)
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Scattering between bins from pairs seen from the front and from the back: L_out = same @ L_in + other @ L_in beyond.

        same (2, size, size): row the bin of the outgoing, column of the incoming direction, both on the side of the first index;
        other likewise for light that comes from the other side, or None. `measure` (2,) is the square of the index on each side, for
        which the BRDF and BTDF are reciprocal; the matrix is made so too, with sums of rows that stay the albedo seen from the bin, so
        that what arrives in a bin is never sent on as more. None leaves it as counted. `cuts`: of the two sides.
        """
        rows, columns = self.rows, self.columns
        both = self if self.cut is None and (self.rows == 1 or min(cuts) >= 1) else self._with(np.asarray(cuts, np.float64))
        table = np.zeros((2, rows, 2, rows, columns))  # out: side, row; in: side, row, columns turned on
        for side, pairs in enumerate(sides):
            own = np.full(len(pairs.given), side)
            a, b = both.of(pairs.given, own), both.of(pairs.other, np.where(pairs.through, 1 - own, own))
            r, turned = a // columns, (b % columns - a % columns) % columns
            flat = ((pairs.through * rows + r) * rows + b // columns) * columns + turned
            count = np.maximum(np.bincount(r, minlength=rows), 1)
            met = np.bincount(flat, pairs.weight, 2 * rows * rows * columns).reshape(2, rows, rows, columns) / count[:, None, None]
            table[side, :, side], table[side, :, 1 - side] = met[0], met[1]
        # Isotropic lobes are mirror symmetric.
        table = 0.5 * (table + table[..., -np.arange(columns)])
        if measure is not None:
            solid = np.stack([self.share(c)[::columns] for c in cuts])
            table = _reciprocal(table, np.asarray(measure, np.float64)[:, None] * solid)
        turn = (np.arange(columns)[None, :] - np.arange(columns)[:, None]) % columns
        full = table[..., turn].transpose(0, 2, 1, 4, 3, 5).reshape(2, 2, self.size, self.size)
        same = np.stack([full[0, 0], full[1, 1]])
        other = np.stack([full[0, 1], full[1, 0]])
        return same, other if other.any() else None


def _reciprocal(table: np.ndarray, measure: np.ndarray) -> np.ndarray:
    """The matrix made symmetric under `measure` (2, rows) and scaled, symmetrically, until its rows sum to what they did."""
    weight = measure[:, :, None, None, None]
    # What passes is counted from both sides: the two counts are made equal, or no symmetric matrix could have both as its sums.
    passed = [float((weight[a] * table[a, :, 1 - a, None]).sum()) for a in (0, 1)]
    if min(passed) > 0:
        for a in (0, 1):
            table[a, :, 1 - a] *= min(passed) / passed[a]
    wanted = (weight * table).sum(axis=(2, 3, 4))  # (2, rows)
    table = weight * table
    table = 0.5 * (table + table.transpose(2, 3, 0, 1, 4))
    reduced = table.sum(axis=4)
    scale = np.ones_like(wanted)
    for _ in range(SCALINGS):
        got = scale * np.einsum("arbs,bs->ar", reduced, scale)
        ratio = np.where(got > 0, wanted / np.where(got > 0, got, 1.0), 1.0)
        scale *= np.sqrt(ratio)
        if np.abs(ratio - 1).max() <= SCALED:
            break
    return table * scale[:, :, None, None, None] * scale[None, None, :, :, None] / weight


def frames(normal: np.ndarray) -> np.ndarray:
    """(2 n, 3, 3) float32 rows x, y, z of the frames of both sides of elements with front normals `normal` (n, 3).

    x is horizontal, so that elements of a smooth surface have about the same frame; the x of `maps.frame` turns with the normal. Both
    sides share x and y; z is the side's normal.
    """
    n = np.asarray(normal, np.float64)
    x = np.stack([-n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)
    length = np.linalg.norm(x, axis=1)
    x = np.where(length[:, None] > 1e-6, x / np.maximum(length, 1e-300)[:, None], (1.0, 0.0, 0.0))
    x -= n * np.einsum("ij,ij->i", x, n)[:, None]
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(n, x)
    front, back = np.stack([x, y, n], axis=1), np.stack([x, y, -n], axis=1)
    return np.stack([front, back], axis=1).reshape(-1, 3, 3).astype(np.float32)
