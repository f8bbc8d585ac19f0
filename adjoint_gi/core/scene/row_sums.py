"""Means of images over polygons, row by row of texels: however small a bright spot is, none lies between the points looked at.

A convex polygon is cut at its corners and at the rows of texels. On a line along a row the integral is a difference of running sums of the
row, exact for closest and linear interpolation; across the row it is by Gauss's rule. The cost grows with the rows, not with the texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .texture import Texture

# Across rows: of polygons of few rows, and of others, where what a point puts on the wrong side of an edge is small.
GAUSS = (np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)]), np.array([5, 8, 5]) / 18)
MIDDLE = (np.array([0.5]), np.array([1.0]))
FEW_ROWS = 40
MOST_ROWS = 1 << 14  # of one polygon: an image repeated more often is looked at in as many parts of equal height
LINES = 1 << 18  # that are integrated at once
FLAT = 1e-9  # texels^2 below which a polygon of the image is a line


@dataclass(frozen=True, eq=False)
class _Lines:
    """Parts (n,) of rows of an image: which polygon, row, from where to where in texels, and how much each counts."""

    polygon: np.ndarray
    row: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray


def polygon_means(texture: Texture, st: np.ndarray, channels: tuple[int, ...] = (0, 1, 2, 3)) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, c) float64 of `channels` of an image over convex polygons, of corners `st` (n, k, 2) in order, some repeated.

    Also (n,) bool: which could be measured; polygons that are flat in the image have no mean of this kind and 0.
    """
    xy = np.where(np.isfinite(st), st, 0).astype(np.float64) * (texture.width, texture.height)
    y = np.sort(xy[..., 1], axis=1)
    low, high = _across(xy, y)
    area = (np.diff(y, axis=1) * (high - low)[:, 1:] + np.diff(y, axis=1) * (high - low)[:, :-1]).sum(axis=1) / 2
    solid = area > FLAT
    total = np.zeros((len(xy), len(channels)))
    rows = np.ceil(y[:, -1]) - np.floor(y[:, 0]) + y.shape[1]
    for some, rule in ((solid & (rows <= FEW_ROWS), GAUSS), (solid & (rows > FEW_ROWS), MIDDLE)):
        some = np.flatnonzero(some)
        # As many polygons at once as make about LINES lines.
        group = np.cumsum(np.minimum(rows[some], MOST_ROWS)) * len(rule[0]) // LINES
        for part in np.split(some, np.flatnonzero(np.diff(group)) + 1):
            lines = _lines(texture, y[part], low[part], high[part], rule)
            total[part] = _integrals(texture, lines, len(part), list(channels))
    return total / np.where(solid, area, 1)[:, None], solid


def _across(xy: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x (n, m) of convex polygons (n, k, 2) at heights `y` (n, m)."""
    low, high = np.full(y.shape, np.inf), np.full(y.shape, -np.inf)
    for a in range(xy.shape[1]):
        (xa, ya), (xb, yb) = xy[:, a, :, None].swapaxes(0, 1), xy[:, a - 1, :, None].swapaxes(0, 1)
        meets = (y >= np.minimum(ya, yb)) & (y <= np.maximum(ya, yb))
        x = xa + np.clip((y - ya) / np.where(yb == ya, 1, yb - ya), 0, 1) * (xb - xa)
        low, high = np.where(meets, np.minimum(low, x), low), np.where(meets, np.maximum(high, x), high)
    return low, high


def _lines(texture: Texture, y: np.ndarray, low: np.ndarray, high: np.ndarray, rule: tuple) -> _Lines:
    """Lines of polygons whose corners lie at heights `y` (n, k), ascending, where they reach from `low` to `high`."""
    shift = 0.0 if texture.interpolation == "Closest" else 0.5
    # 1. Trapezoids between the heights of corners, cut at rows: texels, or the lines between the middles of texels.
    bottom, top = y[:, :-1].ravel() - shift, y[:, 1:].ravel() - shift
    first = np.floor(bottom)
    count = np.where(top > bottom, np.ceil(top) - first, 0)
    step = np.maximum(count / MOST_ROWS, 1)
    count = np.ceil(count / step).astype(np.int64)
    own = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
    a = np.maximum(bottom[own], first[own] + number * step[own])
    b = np.minimum(top[own], first[own] + (number + 1) * step[own])
    # 2. Gauss's points in each, where the sides of the trapezoid are straight.
    at = (a[:, None] + rule[0] * (b - a)[:, None]).ravel()
    weight = (rule[1] * np.maximum(b - a, 0)[:, None]).ravel()
    own = np.repeat(own, len(rule[0]))
    f = (at - bottom[own]) / (top - bottom)[own]
    ends = ((e[:, :-1].ravel()[own] * (1 - f) + e[:, 1:].ravel()[own] * f) for e in (low, high))
    polygon, row = own // (y.shape[1] - 1), np.floor(at)
    lines = _Lines(polygon, row.astype(np.int64), *ends, weight)
    # 3. Linear interpolation is between two rows of texels.
    return lines if not shift else _between(lines, at - row)


def _between(x: _Lines, f: np.ndarray) -> _Lines:
    """The lines on the row below and on that above, of which the latter counts `f` (n,)."""
    polygon, low, high = (np.concatenate([a, a]) for a in (x.polygon, x.low, x.high))
    return _Lines(polygon, np.concatenate([x.row, x.row + 1]), low, high, np.concatenate([x.weight * (1 - f), x.weight * f]))


def _integrals(texture: Texture, lines: _Lines, count: int, channels: list[int]) -> np.ndarray:
    """(count, c) float64 sums of `channels` over the lines of each polygon, texels^2."""
    out = np.zeros((count, len(channels)))
    row, counts = _inside(texture, lines.row, texture.height)
    order = np.argsort(np.where(counts, row, texture.height), kind="stable")[: np.count_nonzero(counts)]
    row = row[order]
    used = np.unique(row)
    step = max(1, LINES // texture.width)
    for a in range(0, len(used), step):
        rows = used[a : a + step]
        part = order[np.searchsorted(row, rows[0]) : np.searchsorted(row, rows[-1], side="right")]
        values = np.stack([texture.texels(np.full(texture.width, r), np.arange(texture.width))[:, channels] for r in rows]).astype(
            np.float64
        )
        sums = _RowSums(texture, values)
        which = np.searchsorted(rows, _inside(texture, lines.row[part], texture.height)[0])
        found = (sums.up_to(which, lines.high[part]) - sums.up_to(which, lines.low[part])) * lines.weight[part, None]
        for c in range(len(channels)):
            out[:, c] += np.bincount(lines.polygon[part], found[:, c], count)
    return out


def _inside(texture: Texture, index: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which texel of `size` stands for each index (n,), which may lie outside, and whether it counts there."""
    if texture.extension == "REPEAT":
        return index % size, np.ones(len(index), bool)
    if texture.extension == "MIRROR":
        index = index % (2 * size)
        return np.minimum(index, 2 * size - 1 - index), np.ones(len(index), bool)
    clipped = np.clip(index, 0, size - 1)
    return clipped, (clipped == index) | (texture.extension != "CLIP")


class _RowSums:
    """Running sums of rows `values` (r, w, c) float64 of a texture, continued beyond its sides as it is looked up."""

    def __init__(self, texture: Texture, values: np.ndarray) -> None:
        self.texture, self.values, self.width = texture, values, values.shape[1]
        self._sums = np.concatenate([np.zeros_like(values[:, :1]), np.cumsum(values, axis=1)], axis=1)

    def up_to(self, row: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(n, c) integral along rows (n,) up to `x` (n,) in texels, from wherever they begin."""
        if self.texture.interpolation == "Closest":
            i = np.floor(x).astype(np.int64)
            return self._whole(row, i) + (x - i)[:, None] * self._texel(row, i)
        i = np.floor(x - 0.5).astype(np.int64)
        f = (x - 0.5 - i)[:, None]
        here = self._texel(row, i)
        # Trapezoids between the middles of texels.
        return self._whole(row, i + 1) + (f - 0.5) * here + f * f / 2 * (self._texel(row, i + 1) - here)

    def _texel(self, row: np.ndarray, i: np.ndarray) -> np.ndarray:
        x, counts = _inside(self.texture, i, self.width)
        return self.values[row, x] * counts[:, None]

    def _whole(self, row: np.ndarray, i: np.ndarray) -> np.ndarray:
        """(n, c) sum of the texels before number `i` (n,), negative to the left of the first."""
        width, total = self.width, self._sums[row, -1]
        if self.texture.extension == "REPEAT":
            return (i // width)[:, None] * total + self._sums[row, i % width]
        if self.texture.extension == "MIRROR":
            turn, i = i // (2 * width), i % (2 * width)
            back = (i > width)[:, None]
            return (
                np.where(back, 2 * total, 0)
                + np.where(back, -1, 1) * self._sums[row, np.minimum(i, 2 * width - i)]
                + 2 * turn[:, None] * total
            )
        inside = np.clip(i, 0, width)
        out = self._sums[row, inside]
        if self.texture.extension == "EXTEND":
            out = out + (i - inside)[:, None] * self.values[row, np.where(i < 0, 0, width - 1)]
        return out
