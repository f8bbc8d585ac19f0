"""The elements as a mesh: receivers at its corners, with a value wherever elements meet, and the mesh that is written as an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..base.errors import TargetError
from ..method.solution import Solution
from ..receivers.base import SurfaceReceivers
from .elements import Elements
from .refinement import RefinedElements

INSET = 0.1  # how far the points of a receiver lie from the corner, as a share of the way to the middle of the element
PARTS = ("emitted", "direct", "indirect", "albedo", "weight")
MESH = ("vertices", "corners", "start", "triangle", "values")


@dataclass(frozen=True, eq=False)
class ElementMesh:
    """A mesh of quads and triangles.

    vertices   (nv, 3) float64 world space, metres; shared where the surface is smooth, doubled along hard edges
    corners    (nl,) int32 vertex of every face corner, anticlockwise about the front; start (nf + 1,) int64 first corner of each face
    triangle   (nf,) int32 triangle of the scene that each face lies on (the first one of its polygon)
    values     (nl, c) float32 at the corners, of the front side
    """

    vertices: np.ndarray
    corners: np.ndarray
    start: np.ndarray
    triangle: np.ndarray
    values: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        """For `Solution.extra`: every array, "mesh_" before its name."""
        return {f"mesh_{name}": getattr(self, name) for name in MESH}


def corners_around(elements: Elements, element: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners (m, 4) int64, 0 to 3, of elements (m,) in order around each, and which of them (m, 4) bool it has."""
    quad = elements.is_quad[element]
    # A quad's far corner, which is its last, comes third.
    order = np.where(quad[:, None], [0, 1, 3, 2], [0, 1, 2, 2])
    has = np.ones(order.shape, bool)
    has[:, 3] = quad
    return order, has


def element_mesh(elements: Elements, values: np.ndarray) -> ElementMesh:
    """The mesh of `elements` with smooth corner values made of `values` (2 count, c), one for each side."""
    nodes = elements.nodes
    order, has = corners_around(elements, np.arange(elements.count))
    corners = np.take_along_axis(nodes.of_element, order, axis=1)[has]
    start = np.concatenate([[0], np.cumsum(has.sum(axis=1))])
    smooth = nodes.values(values)[2 * corners]
    triangle = elements.patch_triangle[elements.patch].astype(np.int32)
    return ElementMesh(nodes.position + elements.world.center, corners.astype(np.int32), start, triangle, smooth)


class ElementNodes(SurfaceReceivers):
    """One receiver for each vertex of the mesh of the elements of some objects; the mean of a point in each element that meets there.

    Elements of one object and material share a vertex where the surface is smooth; along hard edges, and where materials or
    objects meet, every side has its own.

    elements   methods that work on elements take these; objects: indices into `world.scene.objects`
    vertices   (count, 3) float64 world space, metres; corners (nl,) int32 receiver of every face corner; face_start (nf + 1,) int64
    triangle_of_face   (nf,) int32 triangle of the scene that each face lies on
    """

    def __init__(self, elements: Elements, objects: Sequence[int]) -> None:
        """Raises TargetError where the objects have no face with an area."""
        self.elements, self.objects = elements, tuple(objects)
        scene = elements.world.scene
        triangle = elements.patch_triangle[elements.patch]
        owner = np.asarray(scene.object)[triangle]
        face = np.flatnonzero(np.isin(owner, self.objects) & (elements.area > 0))
        if not len(face):
            names = ", ".join(scene.objects[i].name for i in self.objects)
            raise TargetError(names, "has no face to receive light", "Choose an object with faces")

        # Step 1: the corners of each face in order around it.
        order, has = corners_around(elements, face)
        node = np.take_along_axis(elements.nodes.of_element[face], order, axis=1)[has].astype(np.int64)
        element = np.repeat(face, has.sum(axis=1))

        # Step 2: receivers are nodes, apart by object and material.
        kind = owner.astype(np.int64) * len(scene.materials) + np.asarray(scene.material)[triangle]
        self._key = np.stack([kind[element], node], axis=1)
        self._key, first, corner = np.unique(self._key, axis=0, return_index=True, return_inverse=True)
        corner = corner.reshape(-1)
        self.corners = corner.astype(np.int32)
        self.face_start = np.concatenate([[0], np.cumsum(has.sum(axis=1))])
        self.vertices = elements.nodes.position[node[first]] + elements.world.center
        self.triangle_of_face = triangle[face].astype(np.int32)

        # Step 3: their points, a little inside each face, so that no point lies in the plane of a wall that the face ends at.
        at = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])[order[has]]
        middle = np.where(elements.is_quad[element], 0.5, 1 / 3)[:, None]
        at += INSET * (middle - at)
        points = elements.point(element, at[:, 0], at[:, 1])
        by = np.argsort(corner, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(corner))])
        super().__init__("vertices", start, *(x[by] for x in points))

    def mesh(self) -> ElementMesh:
        """The faces, without values."""
        none = np.zeros((len(self.corners), 0), np.float32)
        return ElementMesh(self.vertices, self.corners, self.face_start, self.triangle_of_face, none)

    @cached_property
    def _hanging(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Receivers inside longer edges of neighbours, those at the ends there, and how far along they are; the groups must keep order."""
        if not isinstance(self.elements, RefinedElements):
            return []
        nodes = self.elements.nodes
        kinds = np.unique(self._key[:, 0])
        flat = self._key[:, 0] * nodes.count + self._key[:, 1]  # sorted, as the keys are
        out = []
        for group in nodes.groups:
            node, low, high, share = (np.tile(x[group], len(kinds)) for x in nodes.hanging)
            kind = np.repeat(kinds, len(group))
            wanted = [kind * nodes.count + x for x in (node, low, high)]
            at = [np.minimum(np.searchsorted(flat, x), len(flat) - 1) for x in wanted]
            there = np.all([flat[a] == x for a, x in zip(at, wanted, strict=True)], axis=0)
            out.append((*(a[there] for a in at), share[there]))
        return out

    def without_cracks(self, values: np.ndarray) -> np.ndarray:
        """`values` (count, c), those of vertices inside longer edges of neighbours replaced by what lies between the ends there."""
        out = np.array(values)
        # Longest edges come first, as their ends rule the rest.
        for node, low, high, share in self._hanging:
            w = share[:, None]
            out[node] = (1 - w) * out[low] + w * out[high]
        return out

    def wire(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The mesh and the parts of a solution (count, c) at its vertices, for `Solution.extra`; names as in `ElementMesh` and `PARTS`."""
        found = {name: self.without_cracks(arrays[name].reshape(self.count, -1)).reshape(arrays[name].shape) for name in PARTS}
        mesh = replace(self.mesh(), values=(found["direct"] + found["indirect"])[self.corners])
        return mesh.arrays() | {f"mesh_{name}": array for name, array in found.items()}


def mesh_solution(receivers: ElementNodes, solution: Solution) -> tuple[ElementMesh, Solution]:
    """The mesh that `solution` for these receivers has values for, and a solution with one row for each of its vertices.

    That is the mesh of the receivers, or the finer one that adaptive subdivision has made.
    """
    found = solution.extra
    if "mesh_weight" not in found:
        return receivers.mesh(), solution
    mesh = ElementMesh(*(found[f"mesh_{name}"] for name in MESH))
    return mesh, replace(solution, **{name: found[f"mesh_{name}"] for name in PARTS})
