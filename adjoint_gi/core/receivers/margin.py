"""Margins: values continue beyond the borders of UV islands, so that texture filtering does not pull in the empty background."""

from __future__ import annotations

import numpy as np

PIXELS_PER_BLOCK = 1 << 20  # pixels looked at in one go


def fill_margin(image: np.ndarray, covered: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A copy of `image` (h, w, c) float32 in which uncovered pixels up to `width` pixels away take the nearest covered one's value.

    `covered` (h, w) bool is never overwritten. Because the nearest texel wins, the margin of an island ends half way to the next
    one. Ties go to the texel whose row is nearer, then to the lower, then to the left one. Also returns the source (h, w) int64:
    the index of the texel each pixel has its value from, -1 where there is none. Coverage stays as it is; write it to alpha.
    """
    height, columns = covered.shape
    source = np.where(covered, np.arange(height * columns).reshape(height, columns), -1)
    if width > 0 and covered.any():
        rows, cols = np.nonzero(~covered & _near(covered, width))
        left, right = _neighbours(covered)
        for at in range(0, len(rows), PIXELS_PER_BLOCK):
            r, c = rows[at : at + PIXELS_PER_BLOCK], cols[at : at + PIXELS_PER_BLOCK]
            source[r, c] = _nearest(left, right, r, c, width)
    out = np.array(image, np.float32)
    grown = (source >= 0) & ~covered
    out[grown] = out.reshape(-1, out.shape[-1])[source[grown]]
    return out, source


def _near(covered: np.ndarray, width: int) -> np.ndarray:
    """(h, w) bool: whether the square of `width` pixels around a pixel holds a covered one, by a table of sums."""
    height, columns = covered.shape
    sums = np.zeros((height + 1, columns + 1), np.int64)
    sums[1:, 1:] = covered.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    y0, y1 = np.maximum(np.arange(height) - width, 0), np.minimum(np.arange(height) + width + 1, height)
    x0, x1 = np.maximum(np.arange(columns) - width, 0), np.minimum(np.arange(columns) + width + 1, columns)
    rows = sums[y1] - sums[y0]
    return rows[:, x1] > rows[:, x0]


def _neighbours(covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 column of the nearest covered pixel to the left (or here) and to the right (or here); far away where none."""
    height, columns = covered.shape
    far = 1 << 20
    column = np.arange(columns, dtype=np.int32)[None, :]
    left = np.maximum.accumulate(np.where(covered, column, np.int32(-far)), axis=1)
    right = np.minimum.accumulate(np.where(covered, column, np.int32(far))[:, ::-1], axis=1)[:, ::-1]
    return left, right


def _nearest(left: np.ndarray, right: np.ndarray, row: np.ndarray, column: np.ndarray, width: int) -> np.ndarray:
    """Index of the nearest covered texel within `width` of the pixels (n,), -1 where none: the nearest in each row, then over rows."""
    height, columns = left.shape
    best = np.full(len(row), width * width + 1, np.int64)
    found = np.full(len(row), -1, np.int64)
    for step in sorted(range(-width, width + 1), key=lambda s: (abs(s), s)):
        other = row + step
        inside = (other >= 0) & (other < height)
        other = np.clip(other, 0, height - 1)
        a, b = left[other, column].astype(np.int64), right[other, column].astype(np.int64)
        nearer = np.where(column - a <= b - column, a, b)
        distance = (nearer - column) ** 2 + step * step
        better = inside & (distance < best)
        best[better] = distance[better]
        found[better] = (other * columns + nearer)[better]
    return found
