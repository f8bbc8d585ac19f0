"""Finite elements: faces cut into small pieces by a maximum edge length, and the O(1) way from a hit to its piece.

Surfaces are two-sided, as in Cycles, so the unknowns of the element methods are element sides: index 2 * element, plus 1 for the back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.errors import MemoryRefused
from ..receivers.base import POINTS_PER_CHUNK, Points, Receivers
from ..receivers.inside import Interiors
from ..sampling.additive import STEPS, additive
from ..scene.arrays import SceneArrays
from ..scene.mean_emission import mean_emission
from ..scene.passing import MOST_GREY, Passing
from ..scene.world import Surface, World
from .smooth import Nodes

MAX_ELEMENTS = 20_000_000  # about 4 GB of element arrays
LOOKS = 16, 256  # points of an element that show how much of it lies inside bodies: of each, and of those in part inside
COLOR_GRID = 4  # textured colours are averaged over COLOR_GRID^2 points of an element
LEAST_HELD = 1e-9  # share of an element that is held at least: one that lets all light through is lit like any other
SLIVER = 8.0  # a triangle gets at most SLIVER * area / max_edge^2 elements, so that long slivers do not explode


@dataclass(frozen=True, eq=False)
class Held:
    """The part of element sides that does not let light straight through, with all that the whole reflects and emits.

    Irradiance is the same on it as on the whole, and nothing is lost or counted twice when rays meet it as often as its area asks.
    area (2 ne,) float64 m2; albedo, emitted (2 ne, 3) float64 as of `Elements`, over the share that is held; share (2 ne,): 1 over it.
    """

    area: np.ndarray
    albedo: np.ndarray
    emitted: np.ndarray
    share: np.ndarray


class Elements:
    """The elements of a world and what is constant on each.

    A polygon of two triangles that form a parallelogram is one patch with an n x m grid of cells; every other triangle is a
    patch of k x k sub-triangles. A point of a patch is origin + s edge_s + t edge_t, with s, t in 0..1.

    count      number of elements; there are 2 * count sides
    area       (count,) float64, m2, of one side
    albedo     (count, 3) float64, mean over the element
    emitted    (count, 3) float64, emitted radiosity of each side, W m-2
    centroid   (count, 3) float64, recentred
    normal     (count, 3) float64 of the front side
    """

    def __init__(self, world: World, max_edge: float = 0.0, target: int = 4000) -> None:
        """Cut so that no edge is longer than `max_edge` metres; 0 chooses it so that there are about `target` elements.

        Raises `MemoryRefused` when there would be more than `MAX_ELEMENTS`.
        """
        self.world = world
        n, m = self._plan(max_edge, target)
        total = self._total(n, m)
        if total > MAX_ELEMENTS:
            reason = f"{self.max_edge:.3g} m would make {total:,.0f} elements; the limit is {MAX_ELEMENTS:,}"
            raise MemoryRefused("max_edge", reason, "Raise max_edge, or set it to 0 to have it chosen")
        self._divide(n.astype(np.int64), m.astype(np.int64))

    @classmethod
    def planned(cls, world: World, max_edge: float = 0.0, target: int = 4000) -> int:
        """How many elements there would be, without making them."""
        plan = cls.__new__(cls)
        plan.world = world
        return int(plan._total(*plan._plan(max_edge, target)))

    def _plan(self, max_edge: float, target: int) -> tuple[np.ndarray, np.ndarray]:
        self._find_patches()
        self.max_edge = float(max_edge) or self._choose_edge(target)
        return self._divisions(self.max_edge)

    # ---- patches

    def _find_patches(self) -> None:
        world = self.world
        nt = world.triangle_count
        second = parallelograms(world.scene)
        is_second = np.zeros(nt, bool)
        is_second[second[second >= 0]] = True
        self.patch_triangle = np.flatnonzero(~is_second)
        self.patch_second = second[self.patch_triangle]
        self.quad = self.patch_second >= 0
        patch_of = np.empty(nt, np.int64)
        patch_of[self.patch_triangle] = np.arange(len(self.patch_triangle))
        patch_of[self.patch_second[self.quad]] = np.flatnonzero(self.quad)
        self.patch_of = patch_of

        # (s, t) of the three corners of every triangle: the identity, except for the two triangles of a parallelogram.
        st = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (nt, 1, 1))
        triangles = np.asarray(world.scene.triangles, np.int64)
        a, b = self.patch_triangle[self.quad], self.patch_second[self.quad]
        if len(a):
            # Roll corners so that the one which is not shared comes first: a = (q, s1, s2), b = (p, s2, s1).
            roll_a, roll_b = _lonely(triangles[a], triangles[b]), _lonely(triangles[b], triangles[a])
            first = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
            other = np.array([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
            corner = np.arange(3)
            st[a] = first[(corner - roll_a[:, None]) % 3]
            st[b] = other[(corner - roll_b[:, None]) % 3]
        m = np.stack([st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]], axis=2)
        # Two by two, with the adjugate: LAPACK, called for each of many small matrices, takes seconds.
        determinant = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
        adjugate = np.stack([m[:, 1, 1], -m[:, 0, 1], -m[:, 1, 0], m[:, 0, 0]], axis=1)
        inverse = (adjugate / determinant[:, None]).reshape(nt, 2, 2)
        self._to_st = np.concatenate([m.reshape(nt, 4), st[:, 0]], axis=1).astype(np.float32)
        self._to_uv = np.concatenate([inverse.reshape(nt, 4), st[:, 0]], axis=1)

        # The affine frame of every patch, in float64, from its first triangle.
        points = (np.asarray(world.scene.vertices, np.float64) - world.center)[triangles[self.patch_triangle]]
        inv = inverse[self.patch_triangle]
        e1, e2 = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
        self.edge_s = inv[:, :1, 0] * e1 + inv[:, 1:, 0] * e2
        self.edge_t = inv[:, :1, 1] * e1 + inv[:, 1:, 1] * e2
        corner0 = st[self.patch_triangle, 0]
        self.origin = points[:, 0] - corner0[:, :1] * self.edge_s - corner0[:, 1:] * self.edge_t
        second_area = np.where(self.quad, world.area[self.patch_second], 0.0) if nt else np.zeros(0)
        self.patch_area = world.area[self.patch_triangle] + second_area

    def _choose_edge(self, target: int) -> float:
        """The longest max_edge that gives at least about `target` elements, by bisection of its logarithm.

        Where a scene is finer than that already, half of `target` is left to cut its large faces, or a ground would be one element.
        """
        target = max(target, len(self.patch_triangle) + target // 2)
        low, high = np.log(1e-6 * self.world.extent), np.log(8.0 * self.world.size)
        for _ in range(30):
            middle = 0.5 * (low + high)
            if self._total(*self._divisions(np.exp(middle))) > target:
                low = middle
            else:
                high = middle
        return float(np.exp(high))

    def _divisions(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Cells along s and t of every patch, as floats (they may be too many to hold)."""
        s, t = np.linalg.norm(self.edge_s, axis=1), np.linalg.norm(self.edge_t, axis=1)
        third = np.linalg.norm(self.edge_t - self.edge_s, axis=1)

        def cells(length: np.ndarray) -> np.ndarray:
            return np.maximum(1.0, np.ceil(length / h - 1e-6))

        k = np.minimum(cells(np.maximum(np.maximum(s, t), third)), cells(np.sqrt(SLIVER * self.patch_area)))
        return np.where(self.quad, cells(s), k), np.where(self.quad, cells(t), k)

    def _total(self, n: np.ndarray, m: np.ndarray) -> float:
        return float((n * m).sum())

    # ---- elements

    def _divide(self, n: np.ndarray, m: np.ndarray) -> None:
        self.n, self.m = n, m
        per = n * m
        self.first = np.cumsum(per) - per
        self.count = int(per.sum())
        self.patch = np.repeat(np.arange(len(per)), per)
        local = np.arange(self.count) - self.first[self.patch]
        k = n[self.patch]
        quad = self.quad[self.patch]
        # Sub-triangles are numbered in rows of t; row j of k starts at j (2 k - j).
        row = np.where(quad, local // k, k - np.ceil(np.sqrt(np.maximum(k * k - local, 0)) - 1e-9).astype(np.int64))
        rest = local - row * (2 * k - row)
        self.j = row.astype(np.int32)
        self.i = np.where(quad, local % k, rest // 2).astype(np.int32)
        self.upper = ~quad & (rest % 2 == 1)
        self.is_quad = quad
        self.columns, self.rows = n[self.patch].astype(np.int32), m[self.patch].astype(np.int32)
        self.area = (self.patch_area / per)[self.patch]
        # One row a triangle for `locate`: the map to (s, t), the grid and the first element.
        p = self.patch_of
        self._grid = np.stack([n[p], m[p], self.first[p], self.quad[p]], axis=1) if len(p) else np.zeros((0, 4), np.int64)
        self._finish()

    def _finish(self) -> None:
        """What follows from the cells: normals, centroids and colours."""
        cross = np.cross(self.edge_s, self.edge_t)
        unit = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
        self.normal = unit[self.patch]
        middle = np.where(self.is_quad, 0.5, 1 / 3)
        self.centroid = self.position(np.arange(self.count), middle, middle)
        shading = self.world.shading
        self.albedo = self.mean(shading.albedo, shading.albedo_varies)
        self.emitted = np.pi * (self._mean_emission() if shading.emission_varies else self.mean(shading.emission, False))
        passing = self.world.passing
        self.stays = None if passing is None else self._stays(passing)

    def _stays(self, passing: Passing) -> np.ndarray:
        """(count,) float64 chance that rays stay. Where all looks fall into holes of a cut-out a little is left, for rays that do not."""
        out = 1 - self.mean(lambda *at: passing.grey(*at)[:, None], True)[:, 0]
        return np.where(passing.full[self.patch_triangle[self.patch]], out, np.maximum(out, 1 - MOST_GREY))

    @cached_property
    def held(self) -> Held:
        """The sides as rays meet them that pass at random what lets light straight through."""
        area, albedo, emitted = np.repeat(self.area, 2), np.repeat(self.albedo, 2, axis=0), np.repeat(self.emitted, 2, axis=0)
        if self.stays is None:
            return Held(area, albedo, emitted, np.ones(len(area)))
        stays = np.maximum(np.repeat(self.stays, 2), LEAST_HELD)
        share = 1 / stays
        return Held(area * stays, albedo * share[:, None], emitted * share[:, None], share)

    def mean(self, field: Callable, varies: bool) -> np.ndarray:
        """(count, 3) float64 mean of `field(triangle, u, v)`, (n, 3), over each element: of several points where it `varies` inside."""
        out = np.zeros((self.count, 3))
        steps = (np.arange(COLOR_GRID) + 0.5) / COLOR_GRID if varies else np.array([0.25])
        for a in range(0, self.count, POINTS_PER_CHUNK):
            index = np.arange(a, min(a + POINTS_PER_CHUNK, self.count))
            for x in steps:
                for y in steps:
                    out[index] += field(*self.point(index, np.full(len(index), x), np.full(len(index), y)))
        return out / len(steps) ** 2

    def _mean_emission(self) -> np.ndarray:
        """(count, 3) float64 W m-2 sr-1: of triangles as they are, of cells of a parallelogram in each of its two triangles."""
        out = np.zeros((self.count, 3))
        glows = self.world.shading.emissive()[self.patch_triangle[self.patch]]
        glows[self.is_quad] |= self.world.shading.emissive()[self.patch_second[self.patch[self.is_quad]]]
        every = np.flatnonzero(glows & ~self.is_quad)
        s, t = (np.stack(x, axis=1) for x in zip(*(self._st(every, a, b) for a, b in ((0, 0), (1, 0), (0, 1))), strict=True))
        out[every] = self._over(self.patch_triangle[self.patch[every]], s, t)
        every = np.flatnonzero(glows & self.is_quad)
        p, (s0, t0), (s1, t1) = self.patch[every], self._st(every, 0, 0), self._st(every, 1, 1)
        for second, cell in ((False, (s0, t0, s1, t1)), (True, (1 - s1, 1 - t1, 1 - s0, 1 - t0))):
            s, t, share = _below_diagonal(*cell)
            some = np.flatnonzero(share > 0)
            which = (self.patch_second if second else self.patch_triangle)[p[some]]
            s, t = (1 - s[some], 1 - t[some]) if second else (s[some], t[some])
            out[every[some]] += share[some, None] * self._over(which, s, t)
        return out

    def _over(self, triangle: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """(n, 3) mean radiance over polygons with corners at patch coordinates s, t (n, k)."""
        m = self._to_uv[triangle][..., None]
        ds, dt = s - m[:, 4], t - m[:, 5]
        return mean_emission(self.world.shading, triangle, m[:, 0] * ds + m[:, 1] * dt, m[:, 2] * ds + m[:, 3] * dt)

    def _st(self, element: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Patch coordinates of local coordinates a, b in 0..1; a triangle folds the half beyond its long edge back."""
        fold = ~self.is_quad[element] & (a + b > 1)
        a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
        upper = self.upper[element]
        a, b = np.where(upper, 1 - a, a), np.where(upper, 1 - b, b)
        return (self.i[element] + a) / self.columns[element], (self.j[element] + b) / self.rows[element]

    def position(self, element: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(n, 3) float64 positions at local coordinates a, b in 0..1, uniform in area."""
        s, t = self._st(element, a, b)
        p = self.patch[element]
        return self.origin[p] + s[:, None] * self.edge_s[p] + t[:, None] * self.edge_t[p]

    def corners(self, element: np.ndarray) -> np.ndarray:
        """(n, 4, 3) float64 corners in order around the front side; a triangle repeats its last one."""
        p = self.patch[element]
        quad, upper = self.is_quad[element], self.upper[element]
        i = np.stack([upper, ~upper, np.where(quad, 1, upper), np.where(quad, 0, upper)], axis=1) + self.i[element][:, None]
        j = np.stack([upper, upper, np.where(quad, 1, ~upper), np.where(quad, 1, ~upper)], axis=1) + self.j[element][:, None]
        s, t = (i / self.columns[element, None])[..., None], (j / self.rows[element, None])[..., None]
        return self.origin[p][:, None] + s * self.edge_s[p][:, None] + t * self.edge_t[p][:, None]

    def point(self, element: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Triangle (n,) int32 and barycentrics u, v (n,) float32 of local coordinates, as `world.surface` takes them."""
        s, t = self._st(element, a, b)
        p = self.patch[element]
        triangle = np.where(self.quad[p] & (s + t > 1), self.patch_second[p], self.patch_triangle[p])
        m = self._to_uv[triangle]
        ds, dt = s - m[:, 4], t - m[:, 5]
        u, v = m[:, 0] * ds + m[:, 1] * dt, m[:, 2] * ds + m[:, 3] * dt
        return triangle.astype(np.int32), np.clip(u, 0, 1).astype(np.float32), np.clip(v, 0, 1).astype(np.float32)

    def sample(self, element: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A uniform random point on each of the elements (n,): triangle, u, v."""
        r = rng.random((2, len(element)))
        return self.point(element, r[0], r[1])

    def surface(self, side: np.ndarray, a: np.ndarray, b: np.ndarray) -> Surface:
        """The surface at local coordinates of element sides (n,), oriented to that side."""
        front = self.world.surface(*self.point(side >> 1, a, b))
        sign = np.where(side & 1, np.float32(-1), np.float32(1))
        ng = front.ng * sign[:, None]
        ns = ng if front.ns is front.ng else front.ns * sign[:, None]
        return Surface(front.triangle, front.u, front.v, front.position, ng, ns, sign)

    def locate(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) int64 element that holds each point."""
        return self.cell(triangle, u, v)[0]

    def cell(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Element (n,) int64 that holds each point, and the point's local coordinates a, b in 0..1, (n,) float32."""
        m = self._to_st[triangle]
        grid = self._grid[triangle]
        n, rows, quad = grid[:, 0], grid[:, 1], grid[:, 3] == 1
        s = (m[:, 0] * u + m[:, 1] * v + m[:, 4]) * n.astype(np.float32)
        t = (m[:, 2] * u + m[:, 3] * v + m[:, 5]) * rows.astype(np.float32)
        j = np.clip(t.astype(np.int64), 0, rows - 1)
        last = np.where(quad, n - 1, n - 1 - j)
        i = np.clip(s.astype(np.int64), 0, last)
        a = np.clip(s - i, 0, 1).astype(np.float32)
        b = np.clip(t - j, 0, 1).astype(np.float32)
        upper = ~quad & (a + b > 1) & (i < last)
        element = grid[:, 2] + np.where(quad, j * n + i, j * (2 * n - j) + 2 * i + upper)
        return element, np.where(upper, 1 - a, a), np.where(upper, 1 - b, b)

    def side(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, side: np.ndarray) -> np.ndarray:
        """(n,) int64 element side of points on the side (n,), +1 front or -1 back, of their triangles."""
        return 2 * self.locate(triangle, u, v) + (side < 0)

    @cached_property
    def outside(self) -> np.ndarray:
        """(count,) float64 share of each element's front that no body stands on: what arrives on the whole arrived there."""
        interiors, every = Interiors(self.world), np.arange(self.count)
        share = self._outside(interiors, every, LOOKS[0])
        part = np.flatnonzero((share > 0) & (share < 1))
        share[part] = self._outside(interiors, part, LOOKS[1])
        return share

    def _outside(self, interiors: Interiors, element: np.ndarray, looks: int) -> np.ndarray:
        """(n,) float64 share of `looks` points of each of `element` (n,) that lie inside no body."""
        a, b = additive(np.arange(looks), STEPS[2], 0.5)
        share, block = np.ones(len(element)), max(1, 32 * POINTS_PER_CHUNK // looks)
        for first in range(0, len(element), block):
            some = element[first : first + block]
            point = self.point(np.repeat(some, looks), np.tile(a, len(some)), np.tile(b, len(some)))
            share[first : first + block] -= interiors.hold(*point).reshape(-1, looks).mean(axis=1)
        return share

    @cached_property
    def nodes(self) -> Nodes:
        """The grid vertices, shared where the surface is smooth; made at the first use."""
        return Nodes(self)


class ElementReceivers(Receivers):
    """The element sides themselves as receivers: receiver index is 2 * element, plus 1 for the back."""

    kind = "elements"

    def __init__(self, elements: Elements) -> None:
        self.elements = elements
        self.count = 2 * elements.count

    def _points(self, receiver: np.ndarray, a: np.ndarray, b: np.ndarray) -> Points:
        surface = self.elements.surface(receiver, a, b)
        return Points(receiver, surface.triangle, surface.u, surface.v, surface.ng)

    def sample(self, receiver: np.ndarray, rng: np.random.Generator) -> Points:
        """A uniform random point on each side."""
        r = rng.random((2, len(receiver)))
        return self._points(receiver, r[0], r[1])

    def sites(self) -> Iterator[Points]:
        """Four points a side, none of them on the edge of a sub-triangle."""
        quad_a, quad_b = np.array([0.25, 0.75, 0.25, 0.75]), np.array([0.25, 0.25, 0.75, 0.75])
        triangle_a, triangle_b = np.array([1 / 6, 2 / 3, 1 / 6, 1 / 3]), np.array([1 / 6, 1 / 6, 2 / 3, 1 / 3])
        for first in range(0, self.count, POINTS_PER_CHUNK // 4):
            receiver = np.repeat(np.arange(first, min(first + POINTS_PER_CHUNK // 4, self.count)), 4)
            quad = self.elements.is_quad[receiver[::4] >> 1, None]
            yield self._points(receiver, np.where(quad, quad_a, triangle_a).ravel(), np.where(quad, quad_b, triangle_b).ravel())


def _lonely(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) which corner 0..2 of triangles a (n, 3) is not a corner of triangles b (n, 3)."""
    shared = (a[:, :, None] == b[:, None, :]).any(axis=2)
    return np.argmin(shared, axis=1)


def parallelograms(scene: SceneArrays) -> np.ndarray:
    """(nt,) int64: for the first triangle of a polygon of two that form a parallelogram, the second triangle; else -1."""
    triangles = np.asarray(scene.triangles, np.int64)
    nt = len(triangles)
    partner = np.full(nt, -1, np.int64)
    if nt < 2:
        return partner
    order = np.lexsort((np.arange(nt), scene.polygon, scene.object))
    key = np.stack([np.asarray(scene.object)[order], np.asarray(scene.polygon)[order]])
    new = np.r_[True, (key[:, 1:] != key[:, :-1]).any(axis=0)]
    start = np.flatnonzero(new)
    pair = start[np.diff(np.r_[start, nt]) == 2]
    a, b = order[pair], order[pair + 1]
    # Two triangles that share exactly an edge and run along it in opposite directions.
    ta, tb = triangles[a], triangles[b]
    two = (ta[:, :, None] == tb[:, None, :]).any(axis=2).sum(axis=1) == 2
    a, b, ta, tb = a[two], b[two], ta[two], tb[two]
    three, row = np.arange(3), np.arange(len(a))[:, None]
    ta = ta[row, (_lonely(ta, tb)[:, None] + three) % 3]
    tb = tb[row, (_lonely(tb, ta)[:, None] + three) % 3]
    opposite = (ta[:, 1] == tb[:, 2]) & (ta[:, 2] == tb[:, 1])
    # The diagonals of a parallelogram bisect each other; float32 input is only that exact.
    p = np.asarray(scene.vertices, np.float64)
    gap = np.linalg.norm(p[ta[:, 0]] + p[tb[:, 0]] - p[ta[:, 1]] - p[ta[:, 2]], axis=1)
    length = np.linalg.norm(p[ta[:, 1]] - p[ta[:, 2]], axis=1)
    good = opposite & (gap <= 1e-5 * length) & (np.asarray(scene.material)[a] == np.asarray(scene.material)[b])
    partner[a[good]] = b[good]
    return partner


def _below_diagonal(s0: np.ndarray, t0: np.ndarray, s1: np.ndarray, t1: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners s, t (n, 5) in order of what rectangles have below s + t = 1, and its share (n,) of them, 0 where there is none."""
    right, top = np.minimum(s1, 1 - t0), np.minimum(t1, 1 - s0)
    s = np.stack([s0, right, right, np.maximum(s0, np.minimum(s1, 1 - t1)), s0], axis=1)
    t = np.stack([t0, t0, np.minimum(t1, np.maximum(t0, 1 - s1)), top, top], axis=1)
    area = (s * np.roll(t, -1, axis=1) - t * np.roll(s, -1, axis=1)).sum(axis=1) / 2
    return s, t, np.where(s0 + t0 < 1 - 1e-9, area / ((s1 - s0) * (t1 - t0)), 0)
