"""The world that solvers see: immutable, recentred triangles in Embree with the shading of every point on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from .arrays import SceneArrays
from .shading import Shading

# Rays leave a surface this far off it, relative to the largest coordinate after recentring: about ten float32 steps.
# Embree's `tnear` is fixed at 0 in embreex, so the offset is the only guard against hitting the surface just left.
OFFSET = 2e-6


@dataclass(frozen=True, eq=False)
class Surface:
    """Points on surfaces, oriented to the side that is looked at or lit.

    triangle (n,) int32; u, v (n,) float32 barycentrics; position, ng, ns (n, 3) float32 recentred, with ng and ns on the
    side given by `side` (n,) float32, +1 for the front (outward) side of the triangle and -1 for the back.
    """

    triangle: np.ndarray
    u: np.ndarray
    v: np.ndarray
    position: np.ndarray
    ng: np.ndarray
    ns: np.ndarray
    side: np.ndarray


class World:
    """A scene ready to be solved. All its positions are relative to `center`; nothing in it changes after construction.

    scene       the arrays it was made from
    center      (3,) float64 of the recentred origin in world space
    size        largest distance of a vertex from the centre, metres
    offset      how far a ray starts off its surface, metres
    area        (nt,) float64 triangle areas
    """

    def __init__(self, scene: SceneArrays) -> None:
        self.scene = scene
        vertices = np.asarray(scene.vertices, np.float64)
        triangles = np.asarray(scene.triangles, np.int32)
        used = vertices[np.unique(triangles)] if len(triangles) else np.zeros((1, 3))
        self.center = 0.5 * (used.min(axis=0) + used.max(axis=0))
        self.size = float(np.abs(used - self.center).max()) or 1.0
        self.offset = OFFSET * self.size

        # Everything a hit needs lies in one row, so that a batch of hits is one gather: v0, e1, e2, ng.
        corners = (vertices - self.center)[triangles]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(e1, e2)
        length = np.linalg.norm(cross, axis=1)
        self.area = 0.5 * length
        normal = cross / np.maximum(length, 1e-300)[:, None]
        self.rows = np.ascontiguousarray(np.concatenate([corners[:, 0], e1, e2, normal], axis=1), np.float32)
        self.corner_normals = np.asarray(scene.corner_normals, np.float32)
        self.smooth = np.asarray(scene.smooth, bool)
        self.any_smooth = bool(self.smooth.any())

        self._embree = None
        if len(triangles):
            self._embree = EmbreeScene()
            points = np.ascontiguousarray(vertices - self.center, np.float32)
            TriangleMesh(self._embree, points, np.ascontiguousarray(triangles, np.int32))
            # The first query commits (builds) the scene, which must not happen in two threads at once.
            self._embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
        self.shading = Shading(scene)

    @property
    def triangle_count(self) -> int:
        """Number of triangles."""
        return len(self.rows)

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nearest hits of rays (n, 3) float32: triangle (n,) int32 (-1 where none), barycentric u, v and distance t, (n,) float32."""
        n = len(origin)
        if self._embree is None or n == 0:
            return np.full(n, -1, np.int32), np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
        hit = self._embree.run(origin, direction, output=1)
        return hit["primID"], hit["u"], hit["v"], hit["tfar"]

    def occluded(self, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """(n,) bool: whether anything lies on the ray closer than `distance` (n,) float32, in units of the direction's length."""
        if self._embree is None or len(origin) == 0:
            return np.zeros(len(origin), bool)
        return self._embree.run(origin, direction, dists=distance, query="OCCLUDED") == 0

    def surface(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, towards: np.ndarray | None = None) -> Surface:
        """The surface at barycentrics (u, v) of `triangle`, on the front side, or on the side that faces `towards` (n, 3).

        `towards` points away from the surface (the direction back along an arriving ray).
        """
        rows = self.rows[triangle]
        position = rows[:, 0:3] + u[:, None] * rows[:, 3:6] + v[:, None] * rows[:, 6:9]
        ng = rows[:, 9:12]
        if towards is None:
            side = np.ones(len(triangle), np.float32)
        else:
            side = np.where(np.einsum("ij,ij->i", ng, towards) < 0, np.float32(-1), np.float32(1))
            ng = ng * side[:, None]
        ns = ng
        if self.any_smooth:
            ns = self._shading_normal(triangle, u, v, ng, side)
        return Surface(triangle, u, v, position, ng, ns, side)

    def _shading_normal(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, ng: np.ndarray, side: np.ndarray) -> np.ndarray:
        which = np.flatnonzero(self.smooth[triangle])
        if not len(which):
            return ng
        n = self.corner_normals[triangle[which]]
        a, b = u[which, None], v[which, None]
        smooth = (n[:, 0] * (1 - a - b) + n[:, 1] * a + n[:, 2] * b) * side[which, None]
        length = np.sqrt(np.einsum("ij,ij->i", smooth, smooth))
        # Custom normals that cancel out or point into the surface are no use for shading: the face's own is taken.
        good = (length > 1e-6) & (np.einsum("ij,ij->i", smooth, ng[which]) > 0)
        ns = ng.copy()
        ns[which[good]] = smooth[good] / length[good, None]
        return ns

    def leave(self, surface: Surface) -> np.ndarray:
        """(n, 3) float32 origins for rays that leave `surface` on the side of its `ng`."""
        return surface.position + np.float32(self.offset) * surface.ng

    def albedo(self, surface: Surface) -> np.ndarray:
        """(n, 3) float32 diffuse reflectance, between 0 and 1."""
        return self.shading.albedo(surface.triangle, surface.u, surface.v)

    def emission(self, surface: Surface) -> np.ndarray:
        """(n, 3) float32 emitted radiance, the same from both sides, W m-2 sr-1."""
        return self.shading.emission(surface.triangle, surface.u, surface.v)
