"""The world that solvers see: immutable, recentred triangles in Embree with the shading of every point on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from typing import TypeVar, TypeVarTuple
from weakref import WeakKeyDictionary

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from ..sampling.maps import ONE, columns
from .arrays import RayKind, SceneArrays
from .normals import shading_normals
from .passing import MOST_LAYERS, Passing
from .precision import STEP, clearance, near_box
from .shading import Shading
from .terminator import Edge, Terminator

# Shadow rays end this share of their length, and the clearance of the triangle, before the triangle that they are cast to: Embree rounds
# corners relative to the ray's origin.
SHORT = np.float32(4 * STEP)
GRAZING = np.float32(1e-3)  # cosine below which rays go on behind a surface no farther from where they met it than at this one


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

    def take(self, which: np.ndarray) -> Surface:
        """Some of the points."""
        return Surface(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


class World:
    """A scene ready to be solved. All its positions are relative to `center`; nothing in it changes after construction.

    scene       the arrays it was made from
    center      (3,) float64 of the recentred origin in world space
    size        largest coordinate of a vertex, metres
    extent      the same of what is near the centre, without backdrops and what is lost far away: the measure for what is small
    offset      (nt,) float32 how far rays start off each triangle, metres. Embree's `tnear` is fixed at 0 in embreex, so it is the only
                guard against hitting the surface just left
    area        (nt,) float64 triangle areas
    passing     what lets light straight through, None where nothing does
    """

    def __init__(self, scene: SceneArrays) -> None:
        self.scene = scene
        vertices = np.asarray(scene.vertices, np.float64)
        triangles = np.asarray(scene.triangles, np.int32)
        used = vertices[np.unique(triangles)] if len(triangles) else np.zeros((1, 3))
        low, high = near_box(vertices[triangles], np.asarray(scene.object))
        self.center, self.extent = 0.5 * (low + high), float(0.5 * (high - low).max()) or 1.0
        self.size = float(np.abs(used - self.center).max()) or 1.0

        # Everything a hit needs lies in one row, so that a batch of hits is one gather: v0, e1, e2, ng.
        corners = (vertices - self.center)[triangles]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(e1, e2)
        length = np.linalg.norm(cross, axis=1)
        self.area = 0.5 * length
        normal = cross / np.maximum(length, 1e-300)[:, None]
        self.offset = clearance(corners[:, 0], e1, e2, normal)
        self.rows = np.ascontiguousarray(np.concatenate([corners[:, 0], e1, e2, normal], axis=1), np.float32)
        self.corner_normals = np.asarray(scene.corner_normals, np.float32)
        self.smooth = np.asarray(scene.smooth, bool)
        self.any_smooth = bool(self.smooth.any())
        cutoff = np.array([x.terminator for x in scene.objects] or [0.0], np.float32)[np.asarray(scene.object, np.int64)] * self.smooth
        self.terminator = Terminator(corners, self.corner_normals, cutoff) if cutoff.any() else None

        self._embree = None
        if len(triangles):
            self._embree = EmbreeScene()
            points = np.ascontiguousarray(vertices - self.center, np.float32)
            TriangleMesh(self._embree, points, np.ascontiguousarray(triangles, np.int32))
            # The first query commits (builds) the scene, which must not happen in two threads at once.
            self._embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
        self.shading = Shading(scene)
        self._meets = self._visibility()
        self.passing = Passing.of(scene)

    @property
    def tints(self) -> bool:
        """Whether anything that lets light straight through colours it."""
        return self.passing is not None and self.passing.tinted

    @property
    def triangle_count(self) -> int:
        """Number of triangles."""
        return len(self.rows)

    def _visibility(self) -> np.ndarray | None:
        """(nt + 1,) uint8 kinds of rays that meet each triangle, the last entry for rays that hit nothing; None where all meet all."""
        bits = self.scene.visibility
        if bits is None or (np.asarray(bits) & RayKind.ALL == RayKind.ALL).all():
            return None
        return np.append(np.asarray(bits, np.uint8)[self.scene.object], RayKind.ALL)

    def intersect(
        self, origin: np.ndarray, direction: np.ndarray, kind: np.uint8 | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nearest hits of rays (n, 3) float32 of `kind`, one of `RayKind` or (n,) of them, among what is visible to them.

        Returns triangle (n,) int32 (-1 where none), barycentric u, v and distance t in lengths of the direction, (n,) float32.
        """
        hit = self._nearest(origin, direction)
        return hit if self._meets is None else self._past_invisible(origin, direction, kind, hit)

    def occluded(self, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray, kind: np.uint8 | np.ndarray) -> np.ndarray:
        """(n,) bool: whether anything visible to rays of `kind` lies on the ray closer than `distance` (n,) float32, in lengths of the
        direction."""
        if self._embree is None or len(origin) == 0:
            return np.zeros(len(origin), bool)
        if self._meets is not None:
            return self.intersect(origin, direction, kind)[3] < distance
        return self._embree.run(origin, direction, dists=distance, query="OCCLUDED") == 0

    def _past_invisible(self, origin: np.ndarray, direction: np.ndarray, kind: np.uint8 | np.ndarray, hit: tuple) -> tuple:
        """`hit` with rays that hit what their kind does not meet followed on from its other side: the one place of ray visibility."""
        hit = tuple(np.array(a) for a in hit)
        kind = np.broadcast_to(kind, len(hit[0]))
        rows = np.flatnonzero(self._meets[hit[0]] & kind == 0)
        while len(rows):
            self._behind(origin, direction, hit, rows, self._nearest)
            rows = rows[self._meets[hit[0][rows]] & kind[rows] == 0]
        return hit

    def onward(self, origin: np.ndarray, direction: np.ndarray, kind: np.uint8 | np.ndarray, hit: tuple, rows: np.ndarray) -> None:
        """Replace `hit`, writable arrays as from `intersect`, in `rows` (m,) by what those rays meet next, behind what they have hit.

        The distance still counts from `origin`.
        """
        kind = kind if np.ndim(kind) == 0 else kind[rows]
        self._behind(origin, direction, hit, rows, lambda o, d: self.intersect(o, d, kind))

    def pass_on(
        self,
        origin: np.ndarray,
        direction: np.ndarray,
        kind: np.uint8 | np.ndarray,
        hit: tuple,
        weight: np.ndarray,
        rng: np.random.Generator,
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Decide at random where rays stay that have met surfaces which let light straight through, surface by surface.

        `hit`, writable as for `onward`, becomes where they stay, and `weight` (3, n) takes what they carry. Yields after every surface the
        rows (m,) of the rays that have gone on and the distance (m,) of what they have passed.
        """
        if self.passing is None:
            return
        rows = np.flatnonzero(self.passing.lets[hit[0]])
        for _ in range(MOST_LAYERS):
            if not len(rows):
                return
            go, factor = self.passing.draw(*(a[rows] for a in hit[:3]), rng)
            weight[:, rows] *= factor.T
            rows = rows[go]
            passed = hit[3][rows]
            self.onward(origin, direction, kind, hit, rows)
            yield rows, passed
            rows = rows[self.passing.lets[hit[0][rows]]]

    def _behind(self, origin: np.ndarray, direction: np.ndarray, hit: tuple, rows: np.ndarray, query: Callable) -> None:
        triangle, u, v, t = hit
        d = np.ascontiguousarray(direction[rows])
        # On along the ray until as far off the triangle as other rays start. Lifted straight off it they would run beside the ray, a little
        # more behind each surface, and meet what a light point lies on before `short_of` ends them.
        s = self.surface(triangle[rows], u[rows], v[rows])
        off = self.offset[triangle[rows]] / np.maximum(np.abs(np.einsum("ij,ij->i", s.ng, d)), GRAZING * np.linalg.norm(d, axis=1))
        start = s.position + d * off[:, None]
        triangle[rows], u[rows], v[rows], t[rows] = query(start, d)
        t[rows] += np.einsum("ij,ij->i", start - origin[rows], d) / np.einsum("ij,ij->i", d, d)

    def shadows(
        self, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray, kind: np.uint8 = RayKind.SHADOW
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """What shadow rays find before `distance` (n,) float32: (n,) bool whether all light is held back, and the share (n, 3) float32 that
        comes straight through the surfaces in between; None where nothing in the scene lets light through."""
        if self.passing is None:
            return self.occluded(origin, direction, distance, kind), None
        share = np.ones((len(origin), 3), np.float32)
        hit = tuple(np.array(a) for a in self.intersect(origin, direction, kind))
        rows = np.flatnonzero((hit[0] >= 0) & (hit[3] < distance))
        for _ in range(MOST_LAYERS):
            share[rows] *= self.passing.through(*(a[rows] for a in hit[:3]))
            rows = rows[share[rows].max(axis=1) > 0]
            if not len(rows):
                break
            self.onward(origin, direction, kind, hit, rows)
            rows = rows[(hit[0][rows] >= 0) & (hit[3][rows] < distance[rows])]
        share[rows] = 0
        return share.max(axis=1) <= 0, share

    def _nearest(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `intersect`, among all triangles."""
        n = len(origin)
        if self._embree is None or n == 0:
            return np.full(n, -1, np.int32), np.zeros(n, np.float32), np.zeros(n, np.float32), np.full(n, np.inf, np.float32)
        hit = self._embree.run(origin, direction, output=1)
        return hit["primID"], hit["u"], hit["v"], hit["tfar"]

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
        corners = self.corner_normals[triangle[which]].reshape(-1, 9).T
        ns = ng.copy()
        ns[which] = shading_normals(corners, u[which], v[which], ng[which].T, side[which]).T
        return ns

    def leave(self, surface: Surface, through: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) float32 origins of rays that leave `surface` on the side of its `ng`, or on the other where `through` (n,) bool."""
        side = ONE if through is None else np.where(through, -ONE, ONE)
        return self.lifted(surface.position, surface.ng, surface.triangle, side)

    def edge(self, surface: Surface, ng: np.ndarray | None = None) -> Edge | None:
        """Where light ends on the points of `surface`, on the side of `ng` (n, 3) or that of its own; None where no face is smooth."""
        if self.terminator is None:
            return None
        ng = surface.ng if ng is None else ng
        return Edge(self.terminator, surface.triangle, surface.u, surface.v, columns(ng), columns(surface.ns))

    def lifted(self, position: np.ndarray, normal: np.ndarray, triangle: np.ndarray, side: np.ndarray | np.float32 = ONE) -> np.ndarray:
        """`position` (..., 3) moved off its `triangle` (...) along `normal`, against it where `side` (...) is -1: the one place where rays
        are offset, together with `Faces.lifted` for columns."""
        return position + normal * (side * self.offset[triangle])[..., None]

    def short_of(self, distance: np.ndarray, triangle: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """(n,) float32 length of shadow rays of `distance` (n,) to points on `triangle` (n,), met at `cosine` (n,), that end before it."""
        return np.maximum(distance - (self.offset.take(triangle) + SHORT * distance) / np.maximum(cosine, np.float32(1e-6)), 0)

    def albedo(self, surface: Surface) -> np.ndarray:
        """(n, 3) float32 diffuse reflectance, between 0 and 1."""
        return self.shading.albedo(surface.triangle, surface.u, surface.v)

    def emission(self, surface: Surface) -> np.ndarray:
        """(n, 3) float32 emitted radiance, the same from both sides, W m-2 sr-1."""
        return self.shading.emission(surface.triangle, surface.u, surface.v)


More, Found = TypeVarTuple("More"), TypeVar("Found")


def once_a_world(find: Callable[[World, *More], Found]) -> Callable[[World, *More], Found]:
    """`find(world, *more)`, computed once for each world and `more`: a world does not change after it is made."""
    known: WeakKeyDictionary[World, dict[tuple, Found]] = WeakKeyDictionary()

    @wraps(find)
    def found(world: World, *more: *More) -> Found:
        of = known.setdefault(world, {})
        if more not in of:
            of[more] = find(world, *more)
        return of[more]

    return found
