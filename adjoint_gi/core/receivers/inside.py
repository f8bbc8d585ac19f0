"""Points of a surface that lie inside a body: below a wall that stands on the floor, where no light is and none is meant to be seen.

A body is a piece of a mesh that is closed, or open only towards the plane that the point lies in, turned outward and opaque. From inside,
rays meet the backs of its faces. What holds a lamp, an emitting face or the camera is a room and no body, and so is what emits itself, a
dome or a lantern, and holds an object. A body that hovers by GAP of its width, or stands open in the floor down to SUNK of its extent,
counts as if it stood on the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..base.parallel import in_order
from ..sampling.additive import STEPS, additive
from ..sampling.maps import cosine_directions
from ..scene.arrays import ObjectArrays, RayKind
from ..scene.topology import components, edge_pairs, weld
from ..scene.world import Surface, World

CHUNK = 1 << 16  # points looked at in one go
RAYS = 8  # from each point whose first ray met a back
MOST = 6  # of them that meet backs of bodies from a point inside one
FLAT = 1e-3  # how far from a plane its points may lie, of the extent of the body
GAP = 0.01  # how far above a point a body may begin, of its width: so little light comes in there that none is meant
SUNK = 0.05  # how far below a point the opening of a body may lie, of its extent: the surface closes it
LEVEL = 0.999  # cosine between the plane of an opening and the surface that closes it
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
        above = list(in_order(lambda part: self._above(triangle[part], u[part], v[part]), parts))
        over = np.concatenate(above) if above else np.zeros(0, np.int32)
        out = over >= 0
        if not out.any():
            return out
        # Step 2: of those that a body may be around, a few rays all around.
        bodies = self._bodies(over[out])
        some = np.flatnonzero(out)
        some = some[bodies.label[over[some]] >= 0]
        out[:] = False
        for a in range(0, len(some), CHUNK):
            at = some[a : a + CHUNK]
            out[at] = _mostly_inside(self.world, bodies, triangle[at], u[at], v[at])
        return out

    def _above(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) int32 what a ray along the normal meets first, if that is a back, or a front so near that its object may hover; else -1."""
        ray = _up(self.world, triangle, u, v, around=False)
        width = _across(self._extent[self.world.scene.object[ray.hit]], ray.surface.ng)
        return np.where((ray.hit >= 0) & (ray.gap <= GAP * width), ray.hit, np.int32(-1))

    @cached_property
    def _extent(self) -> np.ndarray:
        """(objects, 3) float32 size of the boxes around the objects, m."""
        scene = self.world.scene
        of = [scene.vertices[o.first_vertex : o.first_vertex + o.vertex_count] for o in scene.objects]
        return np.array([np.ptp(v, axis=0) if len(v) else np.zeros(3) for v in of], np.float32).reshape(-1, 3)

    def _bodies(self, triangle: np.ndarray) -> Bodies:
        """Those of the objects that `triangle` (n,) are of."""
        objects = tuple(np.unique(self.world.scene.object[triangle]).tolist())
        if objects not in self._known:
            self._known[objects] = Bodies.of(self.world, objects)
        return self._known[objects]


@dataclass(frozen=True, eq=False)
class _Up:
    """Rays along the normals of `surface`: hit (n,) int32 triangle, -1 for none; gap (n,) float32 m to a front that is met, 0 to a back;
    origin (n, 3) float32 of rays that look around from there: behind a front that is met, where that was asked for."""

    surface: Surface
    hit: np.ndarray
    gap: np.ndarray
    origin: np.ndarray


def _up(world: World, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, around: bool) -> _Up:
    surface = world.surface(triangle, u, v)
    origin = world.leave(surface)
    hit, hit_u, hit_v, t = world.intersect(origin, surface.ng, RayKind.DIFFUSE)
    front = (hit >= 0) & (np.einsum("ij,ij->i", world.rows[hit, 9:12], surface.ng) < 0)
    gap = np.where(front, t, np.float32(0))
    at = np.flatnonzero(front & around)  # below a ceiling all rays meet fronts
    origin[at] = world.leave(world.surface(hit[at], hit_u[at], hit_v[at], -surface.ng[at]), np.ones(len(at), bool))
    return _Up(surface, hit, gap, origin)


def _across(extent: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) the smaller size of boxes `extent` (n, 3) across the axis that `normal` (n, 3) follows most."""
    along = np.argmax(np.abs(normal), axis=1)
    return np.where(np.arange(3) == along[:, None], np.inf, extent).min(axis=1)


def _mostly_inside(world: World, bodies: Bodies, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n,) bool: whether MOST of RAYS rays from the points meet backs of bodies first."""
    up = _up(world, triangle, u, v, around=True)
    ng, point = up.surface.ng, up.surface.position.astype(np.float64)
    square = additive(np.arange(RAYS), STEPS[2], 0.5)
    count = np.zeros(len(triangle), np.int64)
    for k in range(RAYS):
        direction = cosine_directions(ng, np.full(len(triangle), square[0, k]), np.full(len(triangle), square[1, k]))
        hit = world.intersect(up.origin, direction, RayKind.DIFFUSE)[0]
        count += bodies.back(world, hit, direction) & bodies.open_towards(hit, point, ng)
    return (count >= MOST) & (up.gap <= GAP * _across(bodies.extent[bodies.label[up.hit]], ng))


@dataclass(frozen=True, eq=False)
class Bodies:
    """label (nt,) int32 the body of each triangle, -1 where it is of none; plane (k, 4) float64 unit normal and offset of the plane that
    the edges of body k lie in, the normal into the body, and near (k,) how far from it a point may lie, infinite for one that is closed;
    extent (k, 3) float64 size of the box around each, m."""

    label: np.ndarray
    plane: np.ndarray
    near: np.ndarray
    extent: np.ndarray

    @classmethod
    def of(cls, world: World, objects: Sequence[int]) -> Bodies:
        """Those of `objects`, except where a lamp, an emitting face or the camera is inside."""
        label, found = np.full(world.triangle_count, -1, np.int32), []
        passing = np.array([not material.total(*PASSING).is_black for material in world.scene.materials])
        emits = world.shading.emissive()
        for index in objects:
            obj = world.scene.objects[index]
            for triangles, *body in _pieces(world, obj):
                lantern = emits[triangles].any() and _holds_an_object(world, triangles)
                if not (lantern or passing[world.scene.material[triangles]].any()):
                    label[triangles] = len(found)
                    found.append(body)
        plane, near, extent = (np.array([body[k] for body in found]) for k in range(3))
        bodies = cls(label, plane.reshape(-1, 4), near, extent.reshape(-1, 3))
        if not found:
            return bodies
        rooms = bodies._with_sources(world)
        return replace(bodies, label=np.where(rooms[label] & (label >= 0), -1, label))

    def back(self, world: World, hit: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """(n,) bool: whether rays that met `hit` (n,), -1 for none, met the back of a body."""
        return (hit >= 0) & (self.label[hit] >= 0) & (np.einsum("ij,ij->i", world.rows[hit, 9:12], direction) > 0)

    def open_towards(self, hit: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n,) bool: whether the body of `hit` is closed, or open only in a plane that `point` (n, 3) lies in, or that lies a little
        below the surface around the point, whose `normal` (n, 3) it has: the surface closes it."""
        body = self.label[hit]
        plane = self.plane[body]
        depth = np.einsum("ij,ij->i", plane[:, :3], point) - plane[:, 3]
        below = (np.einsum("ij,ij->i", plane[:, :3], normal) > LEVEL) & (depth > 0) & (depth < SUNK * self.extent[body].max(axis=1))
        return (np.abs(depth) <= self.near[body]) | below

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


def _holds_an_object(world: World, triangles: np.ndarray) -> bool:
    """Whether the box around `triangles` holds that around an object, not of theirs, with all its faces."""
    scene = world.scene
    corners = scene.vertices[scene.triangles[triangles]]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    within = ((scene.vertices > low) & (scene.vertices < high)).all(axis=1)
    own = scene.object[triangles[0]]
    others = (o for k, o in enumerate(scene.objects) if k != own and o.vertex_count)
    return any(within[o.first_vertex : o.first_vertex + o.vertex_count].all() for o in others)


def _pieces(world: World, obj: ObjectArrays) -> list[tuple[np.ndarray, np.ndarray, float, np.ndarray]]:
    """Triangles, plane, `near` and extent (3,) of the connected pieces of `obj` that enclose a volume, turned outward."""
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
        middle = rim.mean(axis=0) if len(rim) else 0.5 * (low + high)
        around = points - middle
        volume = np.einsum("ij,ij->i", around[:, 0], np.cross(around[:, 1], around[:, 2])).sum() / 6
        if volume > 1e-9 * extent**3:
            inward = 1.0 if (0.5 * (low + high) - middle) @ plane[:3] >= 0 else -1.0
            out.append((obj.first_triangle + part, inward * plane, near, high - low))
    return out


def _plane(points: np.ndarray) -> np.ndarray:
    """(4,) unit normal and offset of the plane through `points` (n, 3) that lies nearest to them."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(np.cov((points - middle).T))[2][2]
    return np.append(normal, normal @ middle)
