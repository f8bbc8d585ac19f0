"""Receivers for vertices and face corners: points just inside the faces around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import TargetError
from ..scene.arrays import ObjectArrays, SceneArrays
from ..scene.topology import components
from ..scene.world import World
from .base import SurfaceReceivers
from .inside import Interiors

DOMAINS = ("POINT", "CORNER")
STEP = np.pi / 8  # one sample point for each such angle that a triangle spans at the vertex
INSET = 0.05  # how far the points lie from the vertex, relative to the height of the triangle above the opposite edge
FARTHER = (0.15, 0.35, 0.6, 0.9)  # insets tried where all points of a receiver lie inside a body that stands there
NORMAL_CELL = 1e-3  # corner normals closer than this are the same


@dataclass(frozen=True, eq=False)
class VertexMap:
    """Receivers of vertices or corners, and which of them each vertex or corner of every object has.

    domain   POINT or CORNER
    index    for each object index an array of (vertex_count,) or (corner_count,) int64: its receiver, or -1 where no face with an
             area touches it. Vertices and corners are those of the evaluated mesh.
    """

    receivers: SurfaceReceivers
    domain: str
    index: dict[int, np.ndarray]

    def spread(self, object: int, values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        """(m, c) float32: for every vertex or corner of `object` its entry of `values` (n, c), or `fill` where it has no receiver."""
        index = self.index[object]
        values = np.asarray(values, np.float32).reshape(self.receivers.count, -1)
        out = np.full((len(index), values.shape[1]), np.float32(fill))
        out[index >= 0] = values[index[index >= 0]]
        return out

    def covered(self, object: int) -> np.ndarray:
        """(m,) bool: vertices or corners of `object` that have a receiver."""
        return self.index[object] >= 0


def vertex_receivers(
    world: World, objects: Sequence[int], domain: str = "CORNER", inset: float = INSET, facing: np.ndarray | None = None
) -> VertexMap:
    """Receivers for the vertices or corners of `objects` (indices into `world.scene.objects`).

    CORNER: corners at one vertex with the same corner normal share a receiver, so smooth surfaces stay smooth and hard edges hard.
    POINT: one receiver for each vertex, the mean over all its faces. The points of a receiver lie on small arcs around the
    vertex, their number grows with the angle of each face there (angle-weighted mean), and each has its own face's normal.
    `facing` as in `SurfaceReceivers`.
    Raises TargetError when nothing can receive.
    """
    if domain not in DOMAINS:
        raise TargetError("Vertices", f"{domain!r} is not a domain", "Choose POINT or CORNER")
    scene = world.scene
    triangle, corner, receiver, index, count = [], [], [], {}, 0
    for number in objects:
        obj = scene.objects[number]
        # Step 1: which receiver each corner of each triangle contributes to.
        if domain == "POINT":
            node = scene.triangles[obj.triangles].astype(np.int64).ravel() - obj.first_vertex
            size = obj.vertex_count
            _, label = np.unique(node, return_inverse=True)
            label = label.reshape(-1)
        else:
            node = scene.corners[obj.triangles].astype(np.int64).ravel()
            size = obj.corner_count
            label = corner_groups(scene, obj)
        # Step 2: the receiver of every vertex or corner of the mesh.
        of_node = np.full(size, -1, np.int64)
        of_node[node] = label + count
        index[number] = of_node
        receiver.append(label + count)
        triangle.append(np.repeat(np.arange(obj.first_triangle, obj.first_triangle + obj.triangle_count), 3))
        corner.append(np.tile(np.arange(3), obj.triangle_count))
        count += int(label.max(initial=-1)) + 1
    if count == 0:
        raise TargetError(", ".join(scene.objects[i].name for i in objects), "has no face to receive light", "Choose an object with faces")

    # Step 3: sample points outside of bodies, sorted by receiver.
    owner, tri, u, v = _outside(world, (np.concatenate(triangle), np.concatenate(corner), np.concatenate(receiver)), inset, count)
    order = np.argsort(owner, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return VertexMap(SurfaceReceivers("vertices", start, tri[order], u[order], v[order], facing), domain, index)


def _outside(world: World, arcs: tuple[np.ndarray, ...], inset: float, count: int) -> tuple[np.ndarray, ...]:
    """As `_arc_points` of `arcs`, without points inside bodies. Where a receiver has no others, they are looked for farther away on its
    faces, since its value is seen there as well; one that is inside as a whole keeps those at `inset`."""
    interiors = Interiors(world)

    def points(arcs: tuple[np.ndarray, ...], inset: float) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        found = _arc_points(world, *arcs, inset)
        return found, ~interiors.hold(*found[1:])

    first, free = points(arcs, inset)
    if free.all():
        return first
    pieces = [[x[free] for x in first]]
    lacking = np.bincount(first[0][free], minlength=count) == 0
    for farther in (x for x in FARTHER if x > inset):
        found, free = points(tuple(x[lacking[arcs[2]]] for x in arcs), farther)
        pieces.append([x[free] for x in found])
        lacking[found[0][free]] = False
    pieces.append([x[lacking[first[0]]] for x in first])
    return tuple(np.concatenate(x) for x in zip(*pieces, strict=True))


def corner_groups(scene: SceneArrays, obj: ObjectArrays) -> np.ndarray:
    """(3 nt,) int64 group 0, 1, ... of the corners of the object's triangles: same vertex and same corner normal.

    Normals are compared on two grids of cells shifted against each other, so that rounding at a cell's border parts nobody.
    """
    vertex = scene.triangles[obj.triangles].astype(np.int64).ravel()
    normal = np.asarray(scene.corner_normals[obj.triangles], np.float64).reshape(-1, 3)
    a, b = [], []
    for shift in (0.0, 0.5):
        cell = np.floor(normal / NORMAL_CELL + shift).astype(np.int64)
        key = ((vertex * 4099 + cell[:, 0]) * 4099 + cell[:, 1]) * 4099 + cell[:, 2]
        order = np.argsort(key, kind="stable")
        # The key may wrap around in huge meshes: equal keys are checked, so a collision cannot join two vertices.
        same = (key[order][1:] == key[order][:-1]) & (vertex[order][1:] == vertex[order][:-1])
        same &= (cell[order][1:] == cell[order][:-1]).all(axis=1)
        a.append(order[:-1][same])
        b.append(order[1:][same])
    return components(len(vertex), np.concatenate(a), np.concatenate(b))


def _arc_points(
    world: World, triangle: np.ndarray, corner: np.ndarray, receiver: np.ndarray, inset: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Receiver, triangle and barycentrics u, v of points on an arc around the given corner (0, 1, 2) of each triangle (n,)."""
    # Step 1: the two edges that leave the corner, their lengths and the angle between them.
    edge1, edge2 = world.rows[:, 3:6].astype(np.float64), world.rows[:, 6:9].astype(np.float64)
    points = np.stack([np.zeros_like(edge1), edge1, edge2], axis=1)
    here = points[triangle, corner]
    to1 = points[triangle, (corner + 1) % 3] - here
    to2 = points[triangle, (corner + 2) % 3] - here
    length1 = np.maximum(np.linalg.norm(to1, axis=1), 1e-300)
    length2 = np.maximum(np.linalg.norm(to2, axis=1), 1e-300)
    opposite = np.maximum(np.linalg.norm(to2 - to1, axis=1), 1e-300)
    sine = np.linalg.norm(np.cross(to1, to2), axis=1) / (length1 * length2)
    angle = np.arctan2(sine, np.einsum("ij,ij->i", to1, to2) / (length1 * length2))

    # Step 2: a point at the middle of each equal part of the angle, at a distance that stays inside the triangle.
    many = np.maximum(1, np.rint(angle / STEP)).astype(np.int64)
    item = np.repeat(np.arange(len(triangle)), many)
    k = np.arange(len(item)) - np.repeat(np.cumsum(many) - many, many)
    part = (k + 0.5) / many[item]
    radius = (inset * length1 * length2 * sine / opposite)[item]
    phi, thin = angle[item], sine[item] < 1e-6
    divide = np.where(thin, 1.0, sine[item])
    weight1 = np.where(thin, 1 - part, np.sin(phi * (1 - part)) / divide) * radius / length1[item]
    weight2 = np.where(thin, part, np.sin(phi * part) / divide) * radius / length2[item]

    # Step 3: barycentrics with respect to the triangle's own first corner.
    weights = np.zeros((len(item), 3))
    rows, first = np.arange(len(item)), corner[item]
    weights[rows, first] = 1 - weight1 - weight2
    weights[rows, (first + 1) % 3] = weight1
    weights[rows, (first + 2) % 3] = weight2
    return receiver[item], triangle[item].astype(np.int32), weights[:, 1].astype(np.float32), weights[:, 2].astype(np.float32)
