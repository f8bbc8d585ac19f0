"""Curves over the cosine that belong to a roughness and an index, as one table: exact where a lobe has one roughness and one index,
between the points of a grid where they vary over a surface.

The grid's steps are 1/32 in roughness, and 1/40 in (n - 1) / (n + 1), the root of the reflectance at normal incidence of index n. Curves
between its points are off by less than 0.7 % (tests/core/test_varying_lobes.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import microfacet as mf

MU = 32  # entries of a curve over the cosine
STEPS = np.array([32, 40])  # of the grid, for a change of 1 in roughness and in (n - 1) / (n + 1)
SHAPES = 33  # roughnesses on the grid


@dataclass(frozen=True, eq=False)
class Mixture:
    """For each of n points a sum of rows of a table: k arrays `rows` (n,) int32, and as many `shares` (n,), none of one row as it is."""

    rows: tuple[np.ndarray, ...]
    shares: tuple[np.ndarray, ...] = ()

    @staticmethod
    def of(row: int, n: int) -> Mixture:
        """The same row at n points."""
        return Mixture((np.full(n, row, np.int32),))

    def take(self, which: np.ndarray) -> Mixture:
        """The same at a subset of the points."""
        return Mixture(tuple(r[which] for r in self.rows), tuple(s[which] for s in self.shares))

    def any(self) -> bool:
        """Whether any row but number 0 is meant."""
        return any(r.any() for r in self.rows)

    def sum(self, value: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """(n,) sum of `value(rows)` times the shares."""
        if not self.shares:
            return value(self.rows[0])
        return sum((s * value(r) for s, r in zip(self.shares, self.rows, strict=True)), np.zeros(len(self.rows[0]), np.float32))


class Curves:
    """The table. `make(roughness, ior)` computes one curve (2, MU), for the outside and the inside, and its mean; a kind of lobe that
    has no index in its curve has ior None. `rest` is row 0."""

    def __init__(self, make: Callable[[float, float | None], tuple[np.ndarray, float]], rest: float) -> None:
        self._make = make
        self._known: dict[tuple[float, float | None], int] = {}
        self.curve = np.full((1, 2, MU), rest, np.float32)
        self.mean = np.full(1, rest, np.float32)

    def row(self, roughness: float, ior: float | None) -> int:
        """The row of a lobe, made where there is none yet."""
        key = (float(roughness), None if ior is None else float(ior))
        if key not in self._known:
            self._known[key] = self.add(*self._make(*key))
        return self._known[key]

    def add(self, curve: np.ndarray, mean: float) -> int:
        """A new row."""
        self.curve = np.concatenate([self.curve, np.broadcast_to(curve, (1, 2, MU)).astype(np.float32)])
        self.mean = np.append(self.mean, np.float32(mean))
        return len(self.mean) - 1

    def at(self, mix: Mixture, inside: np.ndarray | bool, cosine: np.ndarray) -> np.ndarray:
        """(n,) float32 curves at a cosine, linear between entries."""
        i, f = mf.cosine_entry(cosine, MU)
        side = np.asarray(inside).astype(np.int32)
        return mix.sum(lambda row: self.curve[row, side, i] * (1 - f) + self.curve[row, side, i + 1] * f)

    def mean_at(self, mix: Mixture) -> np.ndarray:
        """(n,) float32 means."""
        return mix.sum(lambda row: self.mean[row])


class Grid:
    """Rows of `curves` for all roughnesses and indices in two ranges (low, high); without a range of indices the curve has none."""

    def __init__(self, curves: Curves, roughness: tuple[float, float], ior: tuple[float, float] | None) -> None:
        low, high = (np.array([f(r), 0.0 if ior is None else root(f(ior))]) * STEPS for f, r in ((min, roughness), (max, roughness)))
        self._first = np.floor(low + 1e-6).astype(int)
        count = np.maximum(np.ceil(high - 1e-6).astype(int) - self._first, 0) + 1
        points = (self._first + np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)) / STEPS
        rows = [curves.row(r, None if ior is None else index_of(x)) for r, x in points.reshape(-1, 2)]
        self._rows = np.array(rows, np.int32).reshape(count)

    def mixture(self, roughness: np.ndarray, ior: np.ndarray) -> Mixture:
        """Bilinear between the four rows around the roughness (n,) and the index (n,) of each point."""
        rows, shares = [np.zeros(len(roughness), np.int64)], [np.ones(len(roughness), np.float32)]
        for axis, x in enumerate((roughness, root(ior))):
            size = self._rows.shape[axis]
            place = np.clip(x * STEPS[axis] - self._first[axis], 0, size - 1)
            low = np.minimum(place.astype(np.int64), max(size - 2, 0))
            beyond = (place - low).astype(np.float32)
            ends = ((low, 1 - beyond), (np.minimum(low + 1, size - 1), beyond)) if size > 1 else ((low, np.ones_like(beyond)),)
            stride = self._rows.shape[1] if axis == 0 else 1
            rows, shares = [r + stride * at for r in rows for at, _ in ends], [s * part for s in shares for _, part in ends]
        return Mixture(tuple(self._rows.ravel()[r] for r in rows), tuple(shares))


def root(ior: np.ndarray | float) -> np.ndarray | float:
    """(n - 1) / (n + 1), between -1 and 1."""
    return (ior - 1) / (ior + 1)


def index_of(x: float) -> float:
    """The index whose `root` this is."""
    x = min(max(x, -0.999), 0.999)
    return (1 + x) / (1 - x)


def rounded(roughness: np.ndarray, ior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest points of the grid."""
    x = np.clip(np.round(root(ior) * STEPS[1]) / STEPS[1], -0.95, 0.95)
    return np.round(roughness * STEPS[0]) / STEPS[0], (1 + x) / (1 - x)
