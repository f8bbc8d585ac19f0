# SPDX-License-Identifier: GPL-3.0-or-later
"""The faces of a Blender mesh as they are unwrapped: triangles in the size that they have in the world."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ...core.base.errors import SceneError
from ...core.receivers.charts import Mesh, carry
from ..host.meshes import corner_vertices, positions, triangle_corners, triangle_polygons


@dataclass(frozen=True, eq=False)
class MeshFaces:
    """The triangles of a Blender mesh, in the object's size in the world so that texels are as large on all sides.

    mesh        what is unwrapped: the triangles that have an area and a position
    point       (nt, 3, 3) float64 positions of the corners of all triangles
    corners     (nt, 3) int32 corners (loops) of the Blender mesh
    polygon     (nt,) int32 face of each triangle
    area, good  (nt,) float64 and bool: twice the area, and whether it is a triangle of `mesh`
    count       number of corners of the Blender mesh
    """

    mesh: Mesh
    point: np.ndarray
    corners: np.ndarray
    polygon: np.ndarray
    area: np.ndarray
    good: np.ndarray
    count: int

    def spread(self, uv: np.ndarray) -> np.ndarray:
        """(count, 2) float32 UV of all corners from `uv` (n, 3, 2) of the triangles of `mesh`.

        Faces without an area or a position get the corner of the image and no texel, as in the extraction.
        """
        out = np.zeros((self.count, 2), np.float32)
        out[self.corners[self.good]] = uv
        self._carry_on(out)
        return out

    def _carry_on(self, out: np.ndarray) -> None:
        """Give corners that only flat triangles have the place to which the largest triangle of their face maps them.

        A modifier may cut the face along another diagonal, and then these corners are those of triangles with an area.
        """
        own = np.zeros(len(out), bool)
        own[self.corners[self.good]] = True
        which, k = np.nonzero(~self.good[:, None] & ~own[self.corners] & np.isfinite(self.point).all(axis=2))
        order = np.flatnonzero(self.good)[np.argsort(self.area[self.good], kind="stable")]
        largest = np.full(int(self.polygon.max(initial=-1)) + 1, -1)
        largest[self.polygon[order]] = order  # the last of equal indices stays
        base = largest[self.polygon[which]]
        which, k, base = which[base >= 0], k[base >= 0], base[base >= 0]
        uv = out[self.corners[base]].astype(np.float64)
        out[self.corners[which, k]] = carry(self.point[base], uv, self.point[which, k][:, None])[:, 0]


@dataclass(frozen=True, eq=False)
class FacesCopy:
    """What Blender says of the faces of an object called `name`; what is unwrapped is made of it without Blender.

    size              (3, 3) float64 from the mesh to the size that the object has
    positions         (nv, 3) float32
    corners, polygon  (nt, 3) and (nt,) int32 of its triangles
    vertices          (nc,) int32 vertex of each corner
    """

    name: str
    size: np.ndarray
    positions: np.ndarray
    corners: np.ndarray
    polygon: np.ndarray
    vertices: np.ndarray

    def faces(self) -> MeshFaces:
        """Raises SceneError where none can be unwrapped."""
        corners, polygon = self.corners, self.polygon
        triangles = self.vertices[corners]
        with np.errstate(invalid="ignore", over="ignore"):
            vertices = self.positions.astype(np.float64) @ self.size.T
            point = vertices[triangles]
            good = np.isfinite(point).all(axis=(1, 2)) & (np.abs(np.nan_to_num(point)).max(axis=(1, 2)) <= 1e12)
            area = np.linalg.norm(np.cross(point[:, 1] - point[:, 0], point[:, 2] - point[:, 0]), axis=1)
            good &= area > 0
        if not good.any():
            raise SceneError(self.name, "has no face with an area", "Give it faces with an area, and no scale of 0")
        flat = Mesh(np.where(np.isfinite(vertices), vertices, 0.0), triangles[good].astype(np.int64), polygon[good])
        return MeshFaces(flat, point, corners, polygon, area, good, len(self.vertices))


def copy_faces(obj: bpy.types.Object, mesh: bpy.types.Mesh, moved: np.ndarray | None = None) -> FacesCopy:
    """The faces of `mesh` with the size that `obj` has; raises SceneError where there are none.

    moved (nv, 3) float32: positions to take in place of those of `mesh`.
    """
    if not mesh.polygons:
        raise SceneError(obj.name, "has no faces to unwrap", "Give it faces")
    size, places = np.array(obj.matrix_world.to_3x3(), np.float64), positions(mesh) if moved is None else moved
    return FacesCopy(obj.name, size, places, triangle_corners(mesh), triangle_polygons(mesh), corner_vertices(mesh))


def has_flat_faces(mesh: bpy.types.Mesh) -> bool:
    """Whether faces of `mesh` have no area."""
    area = np.empty(len(mesh.polygons), np.float32)
    mesh.polygons.foreach_get("area", area)
    return bool((area <= 0.0).any())
