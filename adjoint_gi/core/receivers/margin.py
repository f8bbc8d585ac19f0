# SPDX-License-Identifier: GPL-3.0-or-later
"""Margins: values continue beyond the borders of UV islands, so that texture filtering does not pull in the empty background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.parallel import in_order
from ..images.rows import LazyRows

PIXELS_PER_BLOCK = 1 << 20  # pixels looked at in one go


@dataclass(frozen=True, eq=False)
class FilledImage:
    """receiver (h, w) int32: whose value each pixel shows, the margins filled, -1 for none; sampled (h, w) bool: texels with a sample."""

    receiver: np.ndarray
    sampled: np.ndarray

    @classmethod
    def of(cls, shape: tuple[int, int], pixel: np.ndarray, sampled: np.ndarray, width: int) -> FilledImage:
        """Of receivers at `pixel` (n,), row * columns + column, of which some are `sampled` (n,) bool, with margins of `width` pixels."""
        has = np.zeros(shape, bool)
        has.reshape(-1)[pixel[sampled]] = True
        own = np.full(has.size, -1, np.int32)
        own[pixel] = np.arange(len(pixel), dtype=np.int32)
        source = margin_source(has, width).reshape(-1)
        grown = np.flatnonzero((source >= 0) & ~has.reshape(-1))
        own[grown] = own[source[grown]]
        return cls(own.reshape(shape), has)

    def image(self, values: np.ndarray) -> LazyRows:
        """The image (h, w, c) float32 of `values` (n, c) of the receivers; 0 where there is none."""
        return LazyRows((*self.receiver.shape, values.shape[1]), lambda rows: self._rows(values, rows))

    def _rows(self, values: np.ndarray, rows: slice) -> np.ndarray:
        receiver = self.receiver[rows]
        out = np.zeros((*receiver.shape, values.shape[1]), np.float32)
        filled = receiver >= 0
        out[filled] = values[receiver[filled]]
        return out


def margin_source(covered: np.ndarray, width: int) -> np.ndarray:
    """(h, w) int32: the index of the texel each pixel has its value from: its own where `covered` (h, w) bool, else the nearest covered one
    up to `width` pixels away, -1 where there is none.

    Because the nearest texel wins, the margin of an island ends half way to the next one. Ties go to the texel whose row is nearer, then
    to the lower, then to the left one.
    """
    height, columns = covered.shape
    source = np.full(height * columns, -1, np.int32)
    step = max(1, PIXELS_PER_BLOCK // columns)
    blocks = [(low, min(low + step, height)) for low in range(0, height, step)]
    for (low, high), part in zip(blocks, in_order(lambda rows: _source_of_rows(covered, width, *rows), blocks), strict=True):
        source[low * columns : high * columns] = part
    return source.reshape(height, columns)


def _source_of_rows(covered: np.ndarray, width: int, low: int, high: int) -> np.ndarray:
    """`margin_source` of the rows from `low` to before `high`, flat; of the other rows those within `width` are looked at."""
    columns = covered.shape[1]
    first = max(0, low - width)
    around = covered[first : high + width]
    own = around[low - first : high - first].reshape(-1)
    source = np.where(own, np.arange(low * columns, high * columns, dtype=np.int32), np.int32(-1))
    if width > 0 and around.any() and not own.all():
        left, right = _neighbours(around, width)
        pixel = np.flatnonzero(_near(left, right, width)[low - first : high - first].reshape(-1) & ~own)
        found = _nearest(left, right, low - first + pixel // columns, pixel % columns, width)
        source[pixel] = np.where(found >= 0, found + np.int32(first * columns), np.int32(-1))
    return source


def _neighbours(covered: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 column of the nearest covered pixel to the left (or here) and to the right (or here); far away where none."""
    columns = covered.shape[1]
    far = np.int32(2 * columns + width)
    column = np.arange(columns, dtype=np.int32)[None, :]
    left = np.maximum.accumulate(np.where(covered, column, -far), axis=1)
    right = np.minimum.accumulate(np.where(covered, column, far)[:, ::-1], axis=1)[:, ::-1]
    return left, right


def _near(left: np.ndarray, right: np.ndarray, width: int) -> np.ndarray:
    """(h, w) bool: whether the square of `width` pixels around a pixel holds a covered one."""
    column = np.arange(left.shape[1], dtype=np.int32)[None, :]
    near = (column - left <= width) | (right - column <= width)
    done = 0
    while done < width:  # rows at twice the distance in every round
        step = min(max(1, done), width - done)
        grown = near.copy()
        grown[step:] |= near[:-step]
        grown[:-step] |= near[step:]
        near, done = grown, done + step
    return near


def _nearest(left: np.ndarray, right: np.ndarray, row: np.ndarray, column: np.ndarray, width: int) -> np.ndarray:
    """Index of the nearest covered texel within `width` of the pixels (n,), -1 where none: the nearest in each row, then over rows."""
    height, columns = left.shape
    best = np.full(len(row), width * width + 1, np.int64)
    found = np.full(len(row), -1, np.int32)
    open_ = np.arange(len(row))  # pixels that a farther row may still bring nearer to one
    for step in sorted(range(-width, width + 1), key=lambda s: (abs(s), s)):
        open_ = open_[best[open_] > step * step]
        other, at = row[open_] + step, column[open_]
        inside = (other >= 0) & (other < height)
        other = np.clip(other, 0, height - 1)
        a, b = left[other, at], right[other, at]
        nearer = np.where(at - a <= b - at, a, b)
        distance = (nearer - at).astype(np.int64) ** 2 + step * step
        better = inside & (distance < best[open_])
        best[open_[better]] = distance[better]
        found[open_[better]] = (other * columns + nearer)[better]
    return found
