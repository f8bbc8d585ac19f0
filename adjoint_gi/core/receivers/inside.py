"""Points of a surface that lie inside a body: below a wall that stands on the floor, where no light is and none is meant to be seen.

A body is a piece of a mesh that is closed, or open only towards the plane that the point lies in, turned outward and opaque. From inside,
rays meet the backs of its faces. What holds a lamp, an emitting face or the camera is a room and no body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.parallel import in_order
from ..sampling.additive import STEPS, additive
from ..sampling.maps import cosine_directions
from ..scene.arrays import ObjectArrays, RayKind
from ..scene.topology import components, edge_pairs, weld
from ..scene.world import World

CHUNK = 1 << 16  # points looked at in one go
RAYS = 8  # from each point whose first ray met a back
MOST = 6  # of them that meet backs of bodies from a point inside one
FLAT = 1e-3  # how far from a plane its points may lie, of the extent of the body
CROSSINGS = 64  # faces that are counted along a ray
SOURCES = 1024  # emitting faces that are looked for inside bodies
PASSING = ("transparent", "refraction", "glass")


class Interiors:
    """The bodies of a world, found as far as points are asked about."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._known: dict[tuple[int, ...], Bodies] = {}

    def hold(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) bool: whether points of the fronts of `triangle` (n,) lie inside a body."""
        # Step 1: one ray along the normal, which costs little where nothing stands on anything.
        parts = [slice(a, a + CHUNK) for a in range(0, len(triangle), CHUNK)]
        backs = list(in_order(lambda part: _back_above(self.world, triangle[part], u[part], v[part]), parts))
        back = np.concatenate(backs) if backs else np.zeros(0, np.int32)
        out = back >= 0
        if not out.any():
            return out
        # Step 2: of those that met the back of a body, a few rays all around.
        bodies = self._bodies(back[out])
        some = np.flatnonzero(out)
        some = some[bodies.label[back[some]] >= 0]
        out[:] = False
        for a in range(0, len(some), CHUNK):
            at = some[a : a + CHUNK]
            out[at] = _mostly_inside(self.world, bodies, triangle[at], u[at], v[at])
        return out

    def _bodies(self, triangle: np.ndarray) -> Bodies:
        """Those of the objects that `triangle` (n,) are of."""
        objects = tuple(np.unique(self.world.scene.object[triangle]).tolist())
        if objects not in self._known:
            self._known[objects] = Bodies.of(self.world, objects)
        return self._known[objects]


def _back_above(world: World, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n,) int32 triangle whose back a ray along the normal meets first; -1 where it meets a front or nothing."""
    surface = world.surface(triangle, u, v)
    hit = world.intersect(world.leave(surface), surface.ng, RayKind.DIFFUSE)[0]
    facing = np.einsum("ij,ij->i", world.rows[hit, 9:12], surface.ng)
    return np.where((hit >= 0) & (facing > 0), hit, -1)


def _mostly_inside(world: World, bodies: Bodies, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n,) bool: whether MOST of RAYS rays from the points meet backs of bodies first."""
    surface = world.surface(triangle, u, v)
    origin, point = world.leave(surface), surface.position.astype(np.float64)
    square = additive(np.arange(RAYS), STEPS[2], 0.5)
    count = np.zeros(len(triangle), np.int64)
    for k in range(RAYS):
        direction = cosine_directions(surface.ng, np.full(len(triangle), square[0, k]), np.full(len(triangle), square[1, k]))
        hit = world.intersect(origin, direction, RayKind.DIFFUSE)[0]
        count += bodies.back(world, hit, direction) & bodies.open_towards(hit, point)
    return count >= MOST


@dataclass(frozen=True, eq=False)
class Bodies:
    """label (nt,) int32 the body of each triangle, -1 where it is of none; plane (k, 4) float64 unit normal and offset of the plane that
    the edges of body k lie in, and near (k,) how far from it a point may lie, infinite for one that is closed."""

    label: np.ndarray
    plane: np.ndarray
    near: np.ndarray

    @classmethod
    def of(cls, world: World, objects: Sequence[int]) -> Bodies:
        """Those of `objects`, except where a lamp, an emitting face or the camera is inside."""
        label, planes, nears = np.full(world.triangle_count, -1, np.int32), [], []
        passing = np.array([not material.total(*PASSING).is_black for material in world.scene.materials])
        for index in objects:
            obj = world.scene.objects[index]
            for triangles, plane, near in _pieces(world, obj):
                if not passing[world.scene.material[triangles]].any():
                    label[triangles] = len(planes)
                    planes.append(plane)
                    nears.append(near)
        bodies = cls(label, np.array(planes).reshape(-1, 4), np.array(nears))
        rooms = bodies._with_sources(world)
        return cls(np.where(rooms[label] & (label >= 0), -1, label), bodies.plane, bodies.near) if len(planes) else bodies

    def back(self, world: World, hit: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """(n,) bool: whether rays that met `hit` (n,), -1 for none, met the back of a body."""
        return (hit >= 0) & (self.label[hit] >= 0) & (np.einsum("ij,ij->i", world.rows[hit, 9:12], direction) > 0)

    def open_towards(self, hit: np.ndarray, point: np.ndarray) -> np.ndarray:
        """(n,) bool: whether the body of `hit` is closed, or open only in a plane that `point` (n, 3) lies in."""
        body = self.label[hit]
        plane = self.plane[body]
        return np.abs(np.einsum("ij,ij->i", plane[:, :3], point) - plane[:, 3]) <= self.near[body]

    def _with_sources(self, world: World) -> np.ndarray:
        """(k,) bool: bodies that hold a lamp, an emitting face of something else, or the camera."""
        places, own = _sources(world)
        direction = np.broadcast_to(np.float32([0.36, 0.48, 0.8]), places.shape)
        turns = np.zeros((len(places), len(self.plane)), np.int64)
        origin, rows = places, np.arange(len(places))
        for _ in range(CROSSINGS):
            hit, u, v, _t = world.intersect(origin, direction[rows], RayKind.DIFFUSE)
            rows, hit, u, v = (a[hit >= 0] for a in (rows, hit, u, v))
            if not len(rows):
                break
            # A ray that leaves a body turns once around it more than one that has entered.
            surface = world.surface(hit, u, v, -direction[rows])
            known = self.label[hit] >= 0
            at = rows[known] * len(self.plane) + self.label[hit[known]]
            turns += np.bincount(at, np.where(surface.side[known] < 0, 1, -1), turns.size).astype(np.int64).reshape(turns.shape)
            origin = world.leave(surface, np.ones(len(rows), bool))
        mine = np.where(own >= 0, self.label[own], -1)
        turns[np.flatnonzero(mine >= 0), mine[mine >= 0]] = 0
        return (turns > 0).any(axis=0)


def _sources(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Where lamps, some emitting faces and the camera are (m, 3) float32, and the triangles of the faces (m,), -1 for the others."""
    scene = world.scene
    places = [light.position for light in scene.lights if light.kind != "sun"] + ([scene.camera.position] if scene.camera else [])
    emitting = np.flatnonzero(world.shading.emissive())
    emitting = emitting[:: max(1, len(emitting) // SOURCES)]
    middle = world.surface(emitting, np.full(len(emitting), 1 / 3, np.float32), np.full(len(emitting), 1 / 3, np.float32))
    points = np.concatenate([np.array(places, np.float64).reshape(-1, 3) - world.center, world.leave(middle)])
    return points.astype(np.float32), np.concatenate([np.full(len(places), -1), emitting]).astype(np.int64)


def _pieces(world: World, obj: ObjectArrays) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Triangles, plane and `near` of the connected pieces of `obj` that enclose a volume, turned outward."""
    place = world.scene.vertices[obj.first_vertex : obj.first_vertex + obj.vertex_count].astype(np.float64) - world.center
    index = world.scene.triangles[obj.triangles].astype(np.int64) - obj.first_vertex
    corner = weld(place)[index]
    piece = components(len(index), *edge_pairs(corner))
    # Edges that their two triangles do not run along both ways are those of openings.
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    key = np.minimum(start, end) * (int(corner.max()) + 1) + np.maximum(start, end)
    _, which = np.unique(key, return_inverse=True)
    net = np.bincount(which.reshape(-1), np.where(start < end, 1.0, -1.0))
    loose = (net != 0)[which.reshape(-1)].reshape(-1, 3)

    out = []
    order = np.argsort(piece, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):
        points = place[index[part]]
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        extent = float((high - low).max())
        edges = loose[part]
        rim = np.concatenate([points[edges], np.roll(points, -1, axis=1)[edges]]) if edges.any() else np.zeros((0, 3))
        plane, near = (_plane(rim), FLAT * extent) if len(rim) else (np.zeros(4), np.inf)
        if len(rim) and np.abs(rim @ plane[:3] - plane[3]).max() > near:
            continue
        # Cones from a point of the plane have no volume over the opening.
        around = points - (rim.mean(axis=0) if len(rim) else 0.5 * (low + high))
        volume = np.einsum("ij,ij->i", around[:, 0], np.cross(around[:, 1], around[:, 2])).sum() / 6
        if volume > 1e-9 * extent**3:
            out.append((obj.first_triangle + part, plane, near))
    return out


def _plane(points: np.ndarray) -> np.ndarray:
    """(4,) unit normal and offset of the plane through `points` (n, 3) that lies nearest to them."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(np.cov((points - middle).T))[2][2]
    return np.append(normal, normal @ middle)
