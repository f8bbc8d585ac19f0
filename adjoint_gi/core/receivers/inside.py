"""Points of a surface that lie inside a body: below a wall that stands on the floor, where no light is and none is meant to be seen.

A body is a piece of a mesh that is closed, or open only towards the plane that the point lies in, turned outward and opaque. From inside,
rays meet the backs of its faces, whatever else runs through it: bodies are looked at apart from those that they meet. What holds a lamp,
an emitting face or the camera is a room and no body, and so is what emits itself, a dome or a lantern, and holds an object. A room or a
sheet that lies wholly within a body is a cavity of it. A body that hovers by GAP of its width, or stands open in the floor down to SUNK
of its extent, counts as if it stood on the surface.
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
from ..scene.world import Surface, World, once_a_world
from .apart import BodyGrid, BodyLayer, spread

CHUNK = 1 << 16  # points looked at in one go
RAYS = 8  # from each point whose first ray met a back
MOST = 6  # of them that meet backs of a body from a point inside it
FLAT = 1e-3  # how far from a plane its points may lie, of the extent of the body
GAP = 0.01  # how far above a point a body may begin, of its width: so little light comes in there that none is meant
SUNK = 0.05  # how far below a point the opening of a body may lie, of its extent: the surface closes it
LEVEL = 0.999  # cosine between the plane of an opening and the surface that closes it
LOOSE = 0.35  # share of its edges that an open body may have along its opening: a tetrahedron has a third
CROSSINGS = 64  # faces that are counted along a ray
SOURCES = 1024  # emitting faces that are looked for inside bodies
PASSING = ("transparent", "refraction", "glass")
SOLID = RayKind.DIFFUSE | RayKind.SHADOW  # rays that a body must hold back


class Interiors:
    """The bodies of a world, found as far as points are asked about."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._near: tuple[int, ...] = ()
        self._asked = np.zeros(len(world.scene.objects), bool)
        self._bodies: Bodies | None = None

    def hold(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) bool: whether points of the fronts of `triangle` (n,) lie inside a body."""
        bodies = self._around(triangle)
        if bodies is None or not bodies.layers or not len(triangle):
            return np.zeros(len(triangle), bool)
        parts = [slice(a, a + CHUNK) for a in range(0, len(triangle), CHUNK)]
        return np.concatenate(list(in_order(lambda part: _inside(self.world, bodies, triangle[part], u[part], v[part]), parts)))

    def _around(self, triangle: np.ndarray) -> Bodies | None:
        """Those of all objects whose boxes meet that of an object asked about, now or before, of which `triangle` (n,) are."""
        of, asked = np.zeros(self.world.triangle_count, bool), np.zeros(len(self._asked), bool)
        of[triangle] = True  # points are many, so no array of theirs is made
        asked[self.world.scene.object[of]] = True
        if (asked & ~self._asked).any():
            self._asked |= asked
            low, high = self._boxes
            meets = np.zeros(len(low), bool)
            for k in np.flatnonzero(self._asked):
                meets |= ((low <= high[k]) & (high >= low[k])).all(axis=1)
            near = tuple(np.flatnonzero(meets).tolist())
            if near != self._near:
                self._near, self._bodies = near, Bodies.of(self.world, near)
        return self._bodies

    @cached_property
    def _boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """(objects, 3) float64 corners of the boxes around the objects, larger by what a body may hover; empty ones meet nothing."""
        scene = self.world.scene
        of = [scene.vertices[o.first_vertex : o.first_vertex + o.vertex_count] for o in scene.objects]
        low, high = (np.array([f(v, axis=0) if len(v) else np.full(3, np.nan) for v in of]).reshape(-1, 3) for f in (np.min, np.max))
        return _grown(low, high)


def _grown(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (k, 3), larger by what a body may hover."""
    by = GAP * (high - low).max(axis=1, keepdims=True, initial=0)
    return low - by, high + by


def _across(extent: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) the smaller size of boxes `extent` (n, 3) across the axis that `normal` (n, 3) follows most."""
    along = np.argmax(np.abs(normal), axis=1)
    return np.where(np.arange(3) == along[:, None], np.inf, extent).min(axis=1)


def _inside(world: World, bodies: Bodies, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n,) bool: whether the points lie inside one of `bodies`: layer by layer, so that no body hides the backs of another."""
    surface, out = world.surface(triangle, u, v), np.zeros(len(triangle), bool)
    near = bodies.grid.near(surface.position)
    for k, layer in enumerate(bodies.layers):
        some = np.flatnonzero((near >> np.uint64(k) & np.uint64(1)).astype(bool) & ~out)
        if len(some):
            out[some] = _mostly_inside(world, bodies, layer, surface.take(some))
    return out


def _mostly_inside(world: World, bodies: Bodies, layer: BodyLayer, surface: Surface) -> np.ndarray:
    """(n,) bool: whether MOST of RAYS rays from the points of `surface` meet backs of bodies of `layer` first."""
    # Step 1: one ray along the normal, which costs little where nothing stands on anything. It meets a back, or a front so near that the
    # body may hover.
    origin = world.leave(surface)
    hit, u, v, t = layer.intersect(origin, surface.ng)
    front = (hit >= 0) & (np.einsum("ij,ij->i", world.rows[hit, 9:12], surface.ng) < 0)
    gap = np.where(front, t, np.float32(0))
    out = (hit >= 0) & (bodies.label[hit] >= 0) & (gap <= GAP * _across(bodies.extent[bodies.label[hit]], surface.ng))
    some = np.flatnonzero(out)
    if not len(some):
        return out

    # Step 2: a few rays all around, from behind a front that was met.
    at = np.flatnonzero(out & front)
    origin[at] = world.leave(world.surface(hit[at], u[at], v[at], -surface.ng[at]), np.ones(len(at), bool))
    origin, ng, point = origin[some], surface.ng[some], surface.position[some].astype(np.float64)
    square = additive(np.arange(RAYS), STEPS[2], 0.5)
    count = np.zeros(len(some), np.int64)
    for k in range(RAYS):
        direction = cosine_directions(ng, np.full(len(some), square[0, k]), np.full(len(some), square[1, k]))
        hit = layer.intersect(origin, direction)[0]
        count += bodies.back(world, hit, direction) & bodies.open_towards(hit, point, ng)
    out[some] = count >= MOST
    return out


@dataclass(frozen=True, eq=False)
class Bodies:
    """label (nt,) int32 the body of each triangle, -1 where it is of none; plane (k, 4) float64 unit normal and offset of the plane that
    the edges of body k lie in, the normal into the body, and near (k,) how far from it a point may lie, infinite for one that is closed;
    extent (k, 3) float64 size of the box around each, m; layers and grid: where they are met one by one."""

    label: np.ndarray
    plane: np.ndarray
    near: np.ndarray
    extent: np.ndarray
    layers: tuple[BodyLayer, ...] = ()
    grid: BodyGrid | None = None

    @classmethod
    def of(cls, world: World, objects: Sequence[int]) -> Bodies:
        """Those of `objects`, except where a lamp, an emitting face or the camera is inside."""
        label, found = np.full(world.triangle_count, -1, np.int32), []
        passing = np.array([not material.total(*PASSING).is_black for material in world.scene.materials])
        emits = world.shading.emissive()
        pieces = [_pieces(world, index) for index in objects]
        for body in (body for of_object in pieces for body in of_object.bodies):
            lantern = emits[body.triangles].any() and _holds_an_object(world, body.triangles)
            if not (lantern or passing[world.scene.material[body.triangles]].any()):
                label[body.triangles] = len(found)
                found.append(body)
        plane, near = (np.array([getattr(body, name) for body in found]) for name in ("plane", "near"))
        low, high = (np.array([getattr(body, name) for body in found]).reshape(-1, 3) for name in ("low", "high"))
        bodies = cls(label, plane.reshape(-1, 4), near, high - low)
        if not found:
            return bodies
        grown = _grown(low, high)
        used, layer = np.unique(spread(*grown), return_inverse=True)
        bodies = replace(bodies, layers=bodies._apart(world, found, layer, len(used), pieces))
        solid = ~bodies._with_sources(world)
        if not solid.any():
            return replace(bodies, layers=())
        grid = BodyGrid(*(corner[solid] for corner in grown), layer[solid])
        return replace(bodies, label=np.where(solid[label] & (label >= 0), label, -1), grid=grid)

    def _apart(self, world: World, found: list[Body], layer: np.ndarray, many: int, pieces: list[Pieces]) -> tuple[BodyLayer, ...]:
        """`many` layers, `layer` (k,) of each body that was `found`."""
        parts: list[list[np.ndarray]] = [[] for _ in range(many)]
        rooms = _Rooms.of(pieces, self.label)
        for body, which in zip(found, layer, strict=True):
            parts[which] += [body.triangles, *rooms.within(body.low, body.high)]
        return tuple(BodyLayer(world, np.concatenate(part)) for part in parts)

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
        keys, turns, many = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], len(self.plane)
        for layer in self.layers:
            origin, rows = places, np.arange(len(places))
            for _ in range(CROSSINGS):
                hit, u, v, _t = layer.intersect(origin, direction[rows])
                rows, hit, u, v = (a[hit >= 0] for a in (rows, hit, u, v))
                if not len(rows):
                    break
                # A ray that leaves a body turns once around it more than one that has entered.
                surface = world.surface(hit, u, v, -direction[rows])
                known = self.label[hit] >= 0
                keys.append(rows[known] * many + self.label[hit[known]])
                turns.append(np.where(surface.side[known] < 0, 1, -1))
                origin = world.leave(surface, np.ones(len(rows), bool))
        key, which = np.unique(np.concatenate(keys), return_inverse=True)
        place, body = np.divmod(key[np.bincount(which.reshape(-1), np.concatenate(turns), len(key)) > 0], many)
        mine = np.where(own >= 0, self.label[own], -1)
        out = np.zeros(many, bool)
        out[body[mine[place] != body]] = True
        return out


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


@dataclass(frozen=True, eq=False)
class Body:
    """A connected piece that encloses a volume, turned outward: its triangles, plane and `near` as of `Bodies`, and box (3,), m."""

    triangles: np.ndarray
    plane: np.ndarray
    near: float
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class Pieces:
    """The connected pieces of an object: triangles ordered by piece, the first of each (p,), their boxes (p, 3), and those that are
    bodies."""

    triangles: np.ndarray
    start: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bodies: tuple[Body, ...]


@dataclass(frozen=True, eq=False)
class _Rooms:
    """What is no body: triangles (list of arrays) and boxes low, high (r, 3) of pieces, which are cavities of bodies that hold them."""

    triangles: list[np.ndarray]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, pieces: list[Pieces], label: np.ndarray) -> _Rooms:
        """Those of `pieces` that have no `label` (nt,)."""
        triangles, low, high = [], [np.zeros((0, 3))], [np.zeros((0, 3))]
        for p in pieces:
            which = np.flatnonzero(label[p.triangles[p.start]] < 0)
            end = np.append(p.start[1:], len(p.triangles))
            triangles += [p.triangles[p.start[k] : end[k]] for k in which]
            low.append(p.low[which])
            high.append(p.high[which])
        return cls(triangles, np.concatenate(low), np.concatenate(high))

    def within(self, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
        """The triangles of those that lie within the box of corners (3,) and do not touch it."""
        edge = FLAT * (high - low).max()
        return [self.triangles[k] for k in np.flatnonzero(((self.low > low + edge) & (self.high < high - edge)).all(axis=1))]


@once_a_world
def _pieces(world: World, index: int) -> Pieces:
    """Of object `index`."""
    obj = world.scene.objects[index]
    place = world.scene.vertices[obj.first_vertex : obj.first_vertex + obj.vertex_count].astype(np.float64) - world.center
    index = world.scene.triangles[obj.triangles].astype(np.int64) - obj.first_vertex
    if not len(index):
        return Pieces(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), ())
    piece, loose = _connected(index, place)
    order = np.argsort(piece, kind="stable")
    first = np.concatenate([[0], np.flatnonzero(np.diff(piece[order])) + 1])
    points = place[index[order]]
    low, high = np.minimum.reduceat(points.min(axis=1), first), np.maximum.reduceat(points.max(axis=1), first)
    many = np.diff(np.append(first, len(order)))
    # Leaves and sheets have more edges along their openings.
    may = (many > 2) & (np.add.reduceat(loose[order].sum(axis=1), first) <= LOOSE * 3 * many)
    bodies = []
    for k in np.flatnonzero(may & _holds_back(world, obj)):
        part = order[first[k] : first[k] + many[k]]
        found = _closing_plane(points[first[k] : first[k] + many[k]], loose[part], low[k], high[k])
        if found is not None:
            bodies.append(Body(obj.first_triangle + part, *found, low[k], high[k]))
    return Pieces(obj.first_triangle + order, first, low, high, tuple(bodies))


def _connected(index: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) int64 the piece of triangles `index` (n, 3) of vertices `place` (nv, 3), and (n, 3) bool their edges that lie at an opening.

    What is closed by its own vertices is a piece, although another has vertices at the same places. The rest hangs together where its
    places do, so that split vertices do not part a surface.
    """
    piece = components(len(index), *edge_pairs(index))
    loose = _loose(index)
    rest = np.flatnonzero((np.bincount(piece, loose.any(axis=1)) > 0)[piece])
    if len(rest):
        corner = weld(place)[index[rest]]
        piece[rest] = components(len(rest), *edge_pairs(corner)) + len(index)
        loose[rest] = _loose(corner)
    return piece, loose


def _loose(corner: np.ndarray) -> np.ndarray:
    """(n, 3) bool: edges of triangles `corner` (n, 3) that their triangles do not run along as often one way as the other."""
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    key = np.minimum(start, end) * (int(corner.max()) + 1) + np.maximum(start, end)
    _, which = np.unique(key, return_inverse=True)
    net = np.bincount(which.reshape(-1), np.where(start < end, 1.0, -1.0))
    return (net != 0)[which.reshape(-1)].reshape(-1, 3)


def _holds_back(world: World, obj: ObjectArrays) -> bool:
    """Whether light meets the object at all."""
    bits = world.scene.visibility
    return bits is None or np.asarray(bits)[world.scene.object[obj.first_triangle]] & SOLID == SOLID


def _closing_plane(points: np.ndarray, loose: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float] | None:
    """`plane` and `near` of a piece with corners `points` (m, 3, 3), edges `loose` (m, 3) and box `low`, `high`; None if it is no body."""
    extent = float((high - low).max())
    rim = np.concatenate([points[loose], np.roll(points, -1, axis=1)[loose]]) if loose.any() else np.zeros((0, 3))
    plane, near = (_plane(rim), FLAT * extent) if len(rim) else (np.zeros(4), np.inf)
    if len(rim) and np.abs(rim @ plane[:3] - plane[3]).max() > near:
        return None
    # Cones from a point of the plane have no volume over the opening.
    middle = rim.mean(axis=0) if len(rim) else 0.5 * (low + high)
    around = points - middle
    volume = np.einsum("ij,ij->i", around[:, 0], np.cross(around[:, 1], around[:, 2])).sum() / 6
    inward = 1.0 if (0.5 * (low + high) - middle) @ plane[:3] >= 0 else -1.0
    return (inward * plane, near) if volume > 1e-9 * extent**3 else None


def _plane(points: np.ndarray) -> np.ndarray:
    """(4,) unit normal and offset of the plane through `points` (n, 3) that lies nearest to them."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(np.cov((points - middle).T))[2][2]
    return np.append(normal, normal @ middle)
