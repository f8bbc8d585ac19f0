"""Spheres around what lies together: where light from far away has something to meet.

One sphere around a whole scene is mostly empty where things lie far apart, and nearly all rays across it miss. Some few spheres, around
parts that a k-d tree finds, leave out what is empty between them; seen from any direction they are disks of always the same area.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from ..sampling.maps import dot_rows, frame_rows
from .world import World, once_a_world

MOST = 64  # spheres: every ray is compared with all of them
KEEP = 0.75  # two parts stay apart whose spheres have together less than this share of the area of the sphere around both,
GAIN = 0.5  # where all have together less than this share of the area of the one around everything
THIN = 8.0  # a triangle is cut whose sphere has more than this many times its area,
LARGE = 1 / 256  # and at least this share of the area of all
ROWS = 512  # rays that are compared at a time
BINS = 64  # along a side, among which gaps are looked for
ROUNDS = 24  # of cutting in halves


@dataclass(frozen=True, eq=False)
class Clusters:
    """center (k, 3) float64 recentred and radius (k,) float64 of spheres that hold all of the scene between them, metres; one around the
    origin where there is nothing."""

    center: np.ndarray
    radius: np.ndarray

    @property
    def areas(self) -> np.ndarray:
        """(k,) float64 cross-sections, m2."""
        return math.pi * self.radius**2

    @property
    def area(self) -> float:
        """Their sum, m2: what lies in the shadow of another sphere counts again."""
        return float(self.areas.sum())

    def before(self, at: np.ndarray, direction: np.ndarray, own: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Where rays along unit `direction` (n, 3) through `at` (n, 3) start so as to meet all that they can meet, (n, 3) float64, as close
        to it as may be: float32 has few digits far away. And how many of the spheres each meets, (n,); `own` (n,) are some for sure."""
        if len(self.radius) == 1:
            return at - (dot_rows(at - self.center, direction) + self.radius)[:, None] * direction, np.ones(len(at))
        origin, many = np.empty_like(at), np.empty(len(at))
        for first in range(0, len(at), ROWS):
            part = slice(first, first + ROWS)
            origin[part], many[part] = self._before(at[part], direction[part], None if own is None else own[part])
        return origin, many

    def _before(self, at: np.ndarray, direction: np.ndarray, own: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """`before` of rows that are few enough for the cache."""
        x, y = (dot_rows(at, a)[:, None] - a @ self.center.T for a in frame_rows(direction))
        x *= x
        y *= y
        x += y
        met = x <= self.radius**2
        if own is not None:
            met[np.arange(len(at)), own] = True  # points of the rim
        along = dot_rows(at, direction)
        start = np.where(met, direction @ self.center.T - self.radius, np.inf).min(axis=1)
        return at + (np.minimum(start, along) - along)[:, None] * direction, np.count_nonzero(met, axis=1)


@once_a_world
def clusters(world: World) -> Clusters:
    """At most `MOST` spheres; one unless much of it would be empty."""
    if not world.triangle_count:
        return Clusters(np.zeros((1, 3)), np.ones(1))
    corners, offset = _pieces(world)
    order, parts = _parts(corners)
    center, radius = np.zeros((len(parts), 3)), np.zeros(len(parts))
    for k, (first, last) in enumerate(parts):
        rows = order[first:last]
        points = corners[rows].reshape(-1, 3).astype(np.float64)
        center[k] = 0.5 * (points.min(axis=0) + points.max(axis=0))
        # Rays must start clear of what lies on the sphere itself.
        radius[k] = math.sqrt(((points - center[k]) ** 2).sum(axis=1).max()) * (1 + 1e-5) + 4 * float(offset[rows].max())
    return Clusters(center, radius)


def _pieces(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Corners (m, 3, 3) float32 of the triangles, long thin ones that are large for the scene cut in pieces (no sphere around a whole road
    leaves out what is beside it), and the offset of rays from each, (m,)."""
    rows = world.rows
    corners = np.stack([rows[:, :3], rows[:, :3] + rows[:, 3:6], rows[:, :3] + rows[:, 6:9]], axis=1)
    offset, area = world.offset, world.area
    square = _edges(corners).max(axis=1)
    for _ in range(ROUNDS):
        disk = 0.25 * math.pi * square
        thin = (disk > THIN * area) & (disk > LARGE * disk.sum())
        if not thin.any():
            break
        # The longest edge is cut in the middle.
        cut, half = corners[thin], 0.5 * area[thin]
        longest, row = _edges(cut).argmax(axis=1), np.arange(len(cut))
        middle = 0.5 * (cut[row, longest] + cut[row, (longest + 1) % 3])
        one, other = cut.copy(), cut
        one[row, longest], other[row, (longest + 1) % 3] = middle, middle
        halves = np.concatenate([one, other])
        corners = np.concatenate([corners[~thin], halves])
        area = np.concatenate([area[~thin], half, half])
        offset = np.concatenate([offset[~thin], offset[thin], offset[thin]])
        square = np.concatenate([square[~thin], _edges(halves).max(axis=1)])
    return corners, offset


def _edges(corners: np.ndarray) -> np.ndarray:
    """(m, 3) squared lengths of the edges that start at each corner."""
    edges = np.roll(corners, -1, axis=1) - corners
    return np.einsum("ijk,ijk->ij", edges, edges)


class _Node:
    """A part of the pieces: those from first to last in the order of the tree."""

    def __init__(self, first: int, last: int, low: np.ndarray, high: np.ndarray) -> None:
        self.first, self.last = first, last
        step = high[:, first:last].max(axis=1).astype(np.float64) - low[:, first:last].min(axis=1)
        self.area = 0.25 * math.pi * float(step @ step)  # of the sphere around the box
        self.halves: tuple[_Node, _Node] | None = None

    def settle(self) -> tuple[float, list[tuple[int, int]]]:
        """Area and ranges of what it is best divided into."""
        if self.halves is not None:
            (a, one), (b, other) = (half.settle() for half in self.halves)
            if a + b < KEEP * self.area:
                return a + b, one + other
        return self.area, [(self.first, self.last)]


def _parts(corners: np.ndarray) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """An order (m,) of the pieces and the ranges of it that are parts. The largest part is divided first, across its longest side, whether
    that helps by itself or not; what has not helped in the end is taken back."""
    order = np.arange(len(corners))
    low, high = (np.ascontiguousarray(x.T) for x in (corners.min(axis=1), corners.max(axis=1)))
    root = _Node(0, len(order), low, high)
    queue, number = [(-root.area, 0, root)], 1
    leaves = 1
    while queue and leaves < MOST:
        _, _, node = heapq.heappop(queue)
        part = slice(node.first, node.last)
        middle = low[:, part] + high[:, part]
        least, most = middle.min(axis=1), middle.max(axis=1)
        axis = int((most - least).argmax())
        if not most[axis] - least[axis] > 1e-30:
            continue  # all have the same middle
        after = _behind(middle[axis], least[axis], most[axis])
        count = int(np.count_nonzero(~after))
        for values in (order, *low, *high):
            values[part] = np.concatenate([values[part][~after], values[part][after]])
        cut = node.first + count
        node.halves = _Node(node.first, cut, low, high), _Node(cut, node.last, low, high)
        for half in node.halves:
            heapq.heappush(queue, (-half.area, number, half))
            number += 1
        leaves += 1
    area, parts = root.settle()
    return order, parts if area < GAIN * root.area else [(0, len(order))]


def _behind(x: np.ndarray, least: float, most: float) -> np.ndarray:
    """(m,) bool: which of `x` (m,) in least..most lie behind the widest gap, of several the most central, or behind the middle if there is
    none. Neither side is empty."""
    step = np.minimum(((x - least) * (BINS / (most - least))).astype(np.int64), BINS - 1)
    filled = np.flatnonzero(np.bincount(step, minlength=BINS))
    wide = np.diff(filled)
    if wide.max() == 1:
        return step >= BINS // 2
    widest = np.flatnonzero(wide == wide.max())
    return step > filled[widest[np.abs(filled[widest] + filled[widest + 1] - BINS).argmin()]]
