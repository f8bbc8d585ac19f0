"""Closed-form exchange areas A_1 F_12, m2, of rectangles; `F_12` is the share of the diffuse flux of 1 that arrives at 2.

Names C-13 and C-15 are those of Howell's catalogue. All arithmetic is float64.
"""

from __future__ import annotations

import numpy as np


def parallel_exchange(x1: np.ndarray, y1: np.ndarray, x2: np.ndarray, y2: np.ndarray, z: np.ndarray) -> np.ndarray:
    """C-13: A_1 F_12 (n,) of rectangles in parallel planes at distance z (n,) > 0 that face each other.

    x1, y1, x2, y2 (n, 2): their ranges along two common axes.
    """

    def corner(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        xx, yy = x * x, y * y
        a, b = np.sqrt(xx + zz), np.sqrt(yy + zz)
        # In units of z the logarithm is that of a number near 1 for far pairs, which keeps its rounding small.
        return y * a * np.arctan(y / a) + x * b * np.arctan(x / b) - 0.5 * zz * np.log1p((xx + yy) / zz)

    zz = z * z
    total = np.zeros_like(z)
    for i in (0, 1):
        for k in (0, 1):
            x = x1[:, i] - x2[:, k]
            for j in (0, 1):
                for m in (0, 1):
                    term = corner(x, y1[:, j] - y2[:, m])
                    total += term if (i + j + k + m) % 2 == 0 else -term
    return np.maximum(total, 0) / (2 * np.pi)


def perpendicular_exchange(x: np.ndarray, y: np.ndarray, xi: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """C-15: A_1 F_12 (n,) of rectangles in perpendicular planes.

    x (n, 2) is the range of distances of rectangle 1 from the line where the planes meet, xi (n, 2) that of rectangle 2, both
    >= 0; y and eta (n, 2) are their ranges along the line.
    """

    def corner(cc: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        dd = d * d
        safe = np.where(c > 0, c, 1)
        sum_ = cc + dd
        log = np.log(np.where(sum_ > 0, sum_, 1))
        return d * c * np.arctan(d / safe) - 0.25 * (cc - dd) * log

    total = np.zeros(len(x))
    # The unit of length is free; the pair's own size keeps the logarithms small.
    scale = np.maximum(np.abs(y - eta).max(axis=1), np.maximum(x.max(axis=1), xi.max(axis=1)))
    scale = np.where(scale > 0, scale, 1)[:, None]
    x, y, xi, eta = x / scale, y / scale, xi / scale, eta / scale
    for i in (0, 1):
        for k in (0, 1):
            cc = x[:, i] ** 2 + xi[:, k] ** 2
            c = np.sqrt(cc)
            for j in (0, 1):
                for m in (0, 1):
                    term = corner(cc, c, y[:, j] - eta[:, m])
                    total += term if (i + j + k + m) % 2 == 0 else -term
    return np.maximum(total, 0) * scale[:, 0] ** 2 / (2 * np.pi)
