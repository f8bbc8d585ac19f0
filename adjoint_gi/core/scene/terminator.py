"""Where light ends on coarse smooth meshes: shadow rays start on the smooth surface that the shading normals stand for.

A flat triangle shades itself and its neighbours in jags where its shading normals still see a lamp. Cycles therefore lets light count as
far as the shading normal sees it, and lifts the origin of shadow rays near the terminator onto a curved surface over the triangle; rays
that are drawn by the BRDF it leaves as they are. We do the same (its Shading Terminator, Geometry Offset).

With corners V_i of barycentrics b_i and normals N_i the height over the triangle, in lengths of the interpolated normal, is the quadratic

    q = sum_(i<j) b_i b_j (V_j - V_i) . (N_j - N_i),

of which half is taken, or the lowest of the three planes that stand at the corners where that is more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling.maps import ONE, columns, dot

ZERO = np.float32(0)


class Terminator:
    """Heights of the smooth triangles of a world. cutoff (nt,) float32: cosine from which on rays are lifted, 0 on triangles without."""

    def __init__(self, corners: np.ndarray, normals: np.ndarray, cutoff: np.ndarray) -> None:
        """corners, normals (nt, 3, 3): of the triangles."""
        self.cutoff = cutoff.astype(np.float32)
        self._normals = columns(np.asarray(normals, np.float32).reshape(-1, 9))
        # (V_j - V_i) . N_i for j = i + 1 and i + 2, six numbers a triangle.
        rise = [np.einsum("tk,tk->t", corners[:, (i + s) % 3] - corners[:, i], normals[:, i]) for i in range(3) for s in (1, 2)]
        self._rise = np.stack(rise).astype(np.float32)

    def heights(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, ng: np.ndarray) -> np.ndarray:
        """(3, n) float32 way from points of the triangles to the smooth surface on the side of `ng` (3, n)."""
        b = np.stack([ONE - u - v, u, v])
        normals = self._normals.take(triangle, axis=1)
        n = normals[0:3] * b[0] + normals[3:6] * b[1] + normals[6:9] * b[2]
        # Seen from inside, the surface is curved the other way round.
        side = np.where(dot(n, ng) > 0, ONE, -ONE)
        d = self._rise.take(triangle, axis=1) * side
        planes = []
        for i in range(3):
            first, second = d[2 * i], d[2 * i + 1]
            top = np.maximum(np.maximum(first, second), ZERO)
            planes.append(np.maximum(top - b[(i + 1) % 3] * first - b[(i + 2) % 3] * second, ZERO))
        # (V_j - V_i) . (N_j - N_i) is - rise_ji - rise_ij.
        q = -sum(b[i] * b[(i + 1) % 3] * (d[2 * i] + d[2 * ((i + 1) % 3) + 1]) for i in range(3))
        return n * (side * np.maximum(np.minimum(np.minimum(planes[0], planes[1]), planes[2]), np.float32(0.5) * q))


@dataclass(frozen=True, eq=False)
class Edge:
    """The terminator at points: triangle, u, v (n,); ng, ns (3, n) on the side that is lit."""

    terminator: Terminator
    triangle: np.ndarray
    u: np.ndarray
    v: np.ndarray
    ng: np.ndarray
    ns: np.ndarray

    def take(self, rows: np.ndarray) -> Edge:
        """Some of the points."""
        at = (a.take(rows) for a in (self.triangle, self.u, self.v))
        return Edge(self.terminator, *at, *(a.take(rows, axis=1) for a in (self.ng, self.ns)))

    def lit(self, wi: np.ndarray) -> np.ndarray:
        """(n,) bool: directions (3, n) from which light counts, for all that the triangle itself says."""
        return (dot(wi, self.ng) > 0) | (self.terminator.cutoff.take(self.triangle) > 0)

    def lift(self, start: np.ndarray, wi: np.ndarray, distance: np.ndarray) -> None:
        """Move the starts of shadow rays (3, n) along `wi` of length `distance` (n,) onto the smooth surface; their ends stay."""
        rows, shift = self._shift(wi)
        if not len(rows):
            return
        start[:, rows] += shift
        near = np.flatnonzero(np.isfinite(distance.take(rows)))
        some = rows.take(near)
        way = wi.take(some, axis=1) * distance.take(some) - shift.take(near, axis=1)
        length = np.maximum(np.sqrt(dot(way, way)), np.float32(1e-30))
        wi[:, some], distance[some] = way / length, length

    def _shift(self, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (m,) whose shadow rays along `wi` (3, n) start elsewhere, and how far from there (3, m)."""
        cutoff = self.terminator.cutoff.take(self.triangle)
        shading, flat = np.abs(dot(wi, self.ns)), dot(wi, self.ng)
        near = np.maximum(cutoff, np.float32(1e-9))
        amount = np.where(shading < cutoff, 2 - (flat + shading) / near, 1 - flat / near)
        amount = np.where(cutoff > 0, np.clip(amount, ZERO, ONE), ZERO)
        rows = np.flatnonzero(amount > 0)
        at = self.take(rows)
        return rows, self.terminator.heights(at.triangle, at.u, at.v, at.ng) * amount.take(rows)
