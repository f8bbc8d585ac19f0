"""Component-first tables of the triangles, for loops that trace millions of rays and read little at each hit."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import columns, dot
from .normals import shading_normals
from .terminator import Edge
from .world import SHORT, World


class Faces:
    """Normals, albedo and emission of every triangle of a world, one column each.

    ng (3, nt) float32; albedo and emission (3, nt) float32, None where they vary inside triangles; emits (nt + 1,) bool, the last entry
    for rays that hit nothing, whose triangle is -1.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.ng = columns(world.rows[:, 9:12])
        self._corner, self._e1, self._e2 = (columns(world.rows[:, a : a + 3]) for a in (0, 3, 6))
        shading, every = world.shading, np.arange(world.triangle_count, dtype=np.int32)
        zero = np.zeros(len(every), np.float32)
        self.albedo = None if shading.albedo_varies else columns(shading.albedo(every, zero, zero))
        self.emission = None if shading.emission_varies else columns(shading.emission(every, zero, zero))
        self.emits = np.append(shading.emissive(), False)
        self.corner_normals = columns(world.corner_normals.reshape(-1, 9)) if world.any_smooth else None

    def normals(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, w: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Geometric and shading normals (3, n) on the side that a ray arriving along `w` (3, n) sees, or on the front side."""
        ng = self.ng.take(triangle, axis=1)
        side = None
        if w is not None:
            side = np.copysign(np.float32(1), -dot(ng, w))
            ng *= side
        if self.corner_normals is None:
            return ng, ng
        ns = shading_normals(self.corner_normals.take(triangle, axis=1), u, v, ng, side)
        return ng, np.where(self.world.smooth.take(triangle), ns, ng)

    def edge(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, ng: np.ndarray, ns: np.ndarray) -> Edge | None:
        """Where light ends at points with normals (3, n); None where no face is smooth."""
        at = self.world.terminator
        return None if at is None else Edge(at, triangle, u, v, ng, ns)

    def positions(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) float32 points at barycentrics (u, v)."""
        return points(self._corner, self._e1, self._e2, triangle, u, v)

    def lifted(self, position: np.ndarray, normal: np.ndarray, triangle: np.ndarray, flown: np.ndarray | None = None) -> np.ndarray:
        """`World.lifted` of columns, (3, n) float32; further off where the position comes from a ray's length `flown` (n,)."""
        off = self.world.offset.take(triangle)
        return position + normal * (off if flown is None else off + SHORT * flown)

    def albedo_at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) float32 diffuse reflectance."""
        if self.albedo is not None:
            return self.albedo.take(triangle, axis=1)
        return columns(self.world.shading.albedo(triangle, u, v))

    def emission_at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) float32 emitted radiance."""
        if self.emission is not None:
            return self.emission.take(triangle, axis=1)
        return columns(self.world.shading.emission(triangle, u, v))


def points(corner: np.ndarray, e1: np.ndarray, e2: np.ndarray, k: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(3, n) float32 points at barycentrics (u, v) of triangles `k` (n,), whose first corners and edges are columns, (3, nt) each."""
    p = e1.take(k, axis=1)
    p *= u
    q = e2.take(k, axis=1)
    q *= v
    p += q
    p += corner.take(k, axis=1)
    return p
