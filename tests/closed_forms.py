# SPDX-License-Identifier: GPL-3.0-or-later
"""Form factors in closed form, which tests hold transports and exchange areas against (verification page, 2.1 and 2.2).

`F_12` is the share of the diffuse flux of 1 that arrives at 2. Names C-11 and C-14 are those of Howell's catalogue. All float64.
"""

from __future__ import annotations

import numpy as np


def parallel_rectangles(a: float, b: float, c: float) -> float:
    """C-11: F between identical, directly opposed rectangles a x b at distance c."""
    x, y = a / c, b / c
    p, q = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    total = 0.5 * np.log((1 + x * x) * (1 + y * y) / (1 + x * x + y * y))
    total += x * q * np.arctan(x / q) + y * p * np.arctan(y / p) - x * np.arctan(x) - y * np.arctan(y)
    return float(2 / (np.pi * x * y) * total)


def adjacent_rectangles(width: float, length: float, height: float) -> float:
    """C-14: F_12 between perpendicular rectangles with a common edge: A1 = width x length, A2 = height x length."""
    w, h = width / length, height / length
    ww, hh = w * w, h * h
    ss = ww + hh
    s = np.sqrt(ss)
    log = np.log((1 + ww) * (1 + hh) / (1 + ss))
    log += ww * np.log(ww * (1 + ss) / ((1 + ww) * ss)) + hh * np.log(hh * (1 + ss) / ((1 + hh) * ss))
    return float((w * np.arctan(1 / w) + h * np.arctan(1 / h) - s * np.arctan(1 / s) + 0.25 * log) / (np.pi * w))


def disks(r1: float, r2: float, h: float) -> float:
    """F_12 between coaxial disks of radii r1 and r2 at distance h."""
    big1, big2 = r1 / h, r2 / h
    x = 1 + (1 + big2**2) / big1**2
    return float(0.5 * (x - np.sqrt(x * x - 4 * (r2 / r1) ** 2)))


def point_to_polygon(point: np.ndarray, normal: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """F (n,) from surface elements at `point` (n, 3) with unit `normal` (n, 3) to convex `polygon` (n, k, 3), after Lambert.

    The part of the polygon below the horizon of the element is cut off. The polygon counts from both its sides; repeated corners
    are allowed. The irradiance of a polygon of radiance L is pi L F.
    """
    v = polygon - point[:, None]
    w = np.roll(v, -1, axis=1)
    hv, hw = np.einsum("nki,ni->nk", v, normal), np.einsum("nki,ni->nk", w, normal)
    crossing = (hv < 0) != (hw < 0)
    share = np.where(crossing, hv / np.where(crossing, hv - hw, 1), 0)[..., None]
    middle = v + share * (w - v)
    # Every edge is kept above the horizon; one that lies below shrinks to nothing.
    start = np.where(hv[..., None] >= 0, v, np.where(hw[..., None] >= 0, middle, 0))
    end = np.where(hw[..., None] >= 0, w, np.where(hv[..., None] >= 0, middle, 0))
    total = _edges(start, end, normal)
    # Where the polygon is cut, the edge along the horizon closes it: from the point where it goes down to where it comes up.
    down = np.where((crossing & (hv >= 0))[..., None], middle, 0).sum(axis=1)
    up = np.where((crossing & (hw >= 0))[..., None], middle, 0).sum(axis=1)
    total += _edges(down[:, None], up[:, None], normal)
    return np.abs(total) / (2 * np.pi)


def _edges(a: np.ndarray, b: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Sum over edges a -> b (n, k, 3) of their angle times the cosine between normal and edge plane."""
    cross = np.cross(a, b)
    length = np.linalg.norm(cross, axis=2)
    angle = np.arctan2(length, np.einsum("nki,nki->nk", a, b))
    along = np.einsum("nki,ni->nk", cross, normal)
    return np.where(length > 0, angle * along / np.where(length > 0, length, 1), 0).sum(axis=1)


def polygon_to_polygon(corners: np.ndarray, normal: np.ndarray, polygon: np.ndarray, points: int = 4) -> np.ndarray:
    """F_12 (n,) from parallelograms or triangles to convex polygons that nothing hides.

    corners (n, 4, 3) as `Elements.corners` gives them, a triangle repeating its last; normal (n, 3); polygon (n, k, 3).
    The inner integral is exact (Lambert), the outer one a Gauss rule of points x points; near a common edge it converges slowly.
    """
    x, w = np.polynomial.legendre.leggauss(points)
    x, w = 0.5 * (x + 1), 0.5 * w
    origin, along, across = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    triangle = (corners[:, 2] == corners[:, 3]).all(axis=1)
    total = np.zeros(len(corners))
    for a, wa in zip(x, w, strict=True):
        for b, wb in zip(x, w, strict=True):
            # On a triangle (Duffy) the second coordinate runs over what the first leaves.
            rest = np.where(triangle, 1 - a, 1.0)
            at = origin + a * along + (b * rest)[:, None] * across
            total += wa * wb * np.where(triangle, 2 * rest, 1.0) * point_to_polygon(at, normal, polygon)
    return total


def sphere_parts(area: np.ndarray, radius: float) -> np.ndarray:
    """F (n, n) between parts of the inside of a sphere: every part sees area_j / (4 pi radius^2), itself included."""
    return np.tile(area / (4 * np.pi * radius**2), (len(area), 1))
