"""Pairs of element sides whose form factor has a closed form: rectangles with common axes that nothing hides from each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base.parallel import in_order
from ..elements.elements import Elements
from ..sampling.additive import STEPS, additive
from ..scene.arrays import RayKind
from ..scene.world import SHORT
from .form_factors import parallel_exchange, perpendicular_exchange

ALIGNED = 1e-6  # sine of the largest angle between axes that count as common
PAIRS = 1 << 15  # pairs in one piece of work
TEST_RAYS = 1 << 22  # rays spent on visibility where there are few pairs
# Where test rays end on the two elements: the more rays, the more of these are used, so they are spread evenly from the start.
_POINTS = 64


@dataclass(frozen=True, eq=False)
class ExactPairs:
    """Pairs i < j (m,) int64 of the given sides and their exchange area A_i F_ij (m,) float64, m2; `rays` were cast."""

    i: np.ndarray
    j: np.ndarray
    exchange: np.ndarray
    rays: int


class AlignedSides:
    """Sides in axis-aligned coordinates of a frame that they share, ready for closed forms."""

    def __init__(self, elements: Elements, sides: np.ndarray) -> None:
        self.elements = elements
        self.sides = sides
        patch_frame, frames = rectangle_frames(elements)
        element = sides >> 1
        self.frame = patch_frame[elements.patch[element]]
        rotation = frames[np.maximum(self.frame, 0)]
        sign = np.where(sides & 1, -1.0, 1.0)
        self.normal = elements.normal[element] * sign[:, None]
        corners = np.einsum("nij,nkj->nki", rotation, elements.corners(element))
        local_normal = np.einsum("nij,nj->ni", rotation, self.normal)
        self.low, self.high = corners.min(axis=1), corners.max(axis=1)
        self.axis = np.abs(local_normal).argmax(axis=1)
        row = np.arange(len(sides))
        self.sign = np.sign(local_normal[row, self.axis])
        # The plane's own coordinate is the same at all corners but for rounding.
        self.plane = corners[row, :, self.axis].mean(axis=1) if len(sides) else np.zeros(0)
        self.low[row, self.axis] = self.high[row, self.axis] = self.plane
        self.tiny = 1e-7 * elements.world.extent

    def facing(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """(n,) bool: some of j lies in front of i and some of i in front of j, and both are rectangles of one frame."""
        good = (self.frame[i] == self.frame[j]) & (self.frame[i] >= 0)
        return good & self._before(i, j) & self._before(j, i)

    def _before(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        axis, sign, plane = self.axis[i], self.sign[i], self.plane[i]
        return np.maximum(sign * (self.low[j, axis] - plane), sign * (self.high[j, axis] - plane)) > self.tiny

    def exchange(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """A_i F_ij (n,) of facing pairs that see each other freely; parts behind the other's plane do not count."""
        out = np.zeros(len(i))
        same = self.axis[i] == self.axis[j]
        p, q = i[same], j[same]
        x, y = (self.axis[p] + 1) % 3, (self.axis[p] + 2) % 3
        out[same] = parallel_exchange(
            self._range(p, x), self._range(p, y), self._range(q, x), self._range(q, y), np.abs(self.plane[p] - self.plane[q])
        )
        p, q = i[~same], j[~same]
        line = 3 - self.axis[p] - self.axis[q]
        out[~same] = perpendicular_exchange(self._before_range(p, q), self._range(p, line), self._before_range(q, p), self._range(q, line))
        return out

    def _range(self, i: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return np.stack([self.low[i, axis], self.high[i, axis]], axis=1)

    def _before_range(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """(n, 2) range of distances of rectangle i from the plane of j, on the front of j."""
        distance = self.sign[j, None] * (self._range(i, self.axis[j]) - self.plane[j, None])
        distance = np.sort(np.maximum(distance, 0), axis=1)
        # Along an edge that lies in the other's plane the distance is 0; rounding must not open a gap there.
        return np.where(distance < self.tiny, 0.0, distance)


def rectangle_frames(elements: Elements) -> tuple[np.ndarray, np.ndarray]:
    """For every patch the frame (np,) int64 whose axes its edges follow, -1 where it is no rectangle; and the frames (k, 3, 3)."""
    s, t = elements.edge_s, elements.edge_t
    length = np.maximum(np.linalg.norm(s, axis=1) * np.linalg.norm(t, axis=1), 1e-300)
    rectangle = elements.quad & (np.abs(np.einsum("ij,ij->i", s, t)) <= ALIGNED * length)
    unit_s = s / np.maximum(np.linalg.norm(s, axis=1), 1e-300)[:, None]
    normal = np.cross(s, t) / length[:, None]
    frame = np.full(len(s), -1, np.int64)
    frames = []
    left = np.flatnonzero(rectangle)
    while len(left):
        first = left[0]
        axes = np.stack([unit_s[first], np.cross(normal[first], unit_s[first]), normal[first]])
        axes /= np.linalg.norm(axes, axis=1)[:, None]

        def along(d: np.ndarray, axes: np.ndarray = axes) -> np.ndarray:
            # Sines, not cosines: 1 - cos of a small angle is lost in rounding.
            return (np.sort(np.abs(d @ axes.T), axis=1)[:, 1] <= ALIGNED).astype(bool)

        same = along(unit_s[left]) & along(normal[left])
        same[0] = True
        frame[left[same]] = len(frames)
        frames.append(axes)
        left = left[~same]
    return frame, np.array(frames).reshape(-1, 3, 3) if frames else np.eye(3)[None]


def exact_pairs(elements: Elements, sides: np.ndarray) -> Iterator[ExactPairs]:
    """All pairs of `sides` with a closed form and free sight along every test ray, in pieces of some thousand pairs."""
    aligned = AlignedSides(elements, sides)
    n = len(sides)
    in_frame = np.flatnonzero(aligned.frame >= 0)
    if len(in_frame) < 2:
        return
    possible = max(1, len(in_frame) * (len(in_frame) - 1) // 2)
    tests = int(np.clip(TEST_RAYS // possible, 4, _POINTS))
    k = np.arange(tests)
    # Two even sets of points in the square, the second in another order, so that the rays cross.
    a, b = (k + 0.5) / tests, additive(k, STEPS[1], 0.35)[0]

    def points(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        at = [aligned.elements.position(sides >> 1, np.full(n, x), np.full(n, y)) for x, y in zip(p, q, strict=True)]
        return np.stack(at, axis=1)

    near, far = points(a, b), points(b[::-1], a)
    world = elements.world
    triangle = elements.patch_triangle[elements.patch[sides >> 1]]
    start, end = (world.lifted(place, aligned.normal[:, None], triangle[:, None]).astype(np.float32) for place in (near, far))
    short = np.float32(1) - SHORT  # of the way, so that rays end before their target
    normal = aligned.normal.astype(np.float32)

    def work(rows: np.ndarray) -> ExactPairs:
        i, j = np.repeat(rows, n), np.tile(np.arange(n), len(rows))
        later = j > i
        i, j = i[later], j[later]
        keep = aligned.facing(i, j)
        i, j = i[keep], j[keep]
        rays = 0
        seen = np.zeros(len(i), bool)
        for test in range(tests):
            origin = start[i, test]
            direction = end[j, test] - origin
            # A point behind the other's plane is in the part that does not count.
            front = (np.einsum("ij,ij->i", direction, normal[i]) > 0) & (np.einsum("ij,ij->i", direction, normal[j]) < 0)
            hidden = world.occluded(origin, direction, np.full(len(i), short), RayKind.DIFFUSE) & front
            rays += len(i)
            seen |= front
            if hidden.any():
                i, j, seen = i[~hidden], j[~hidden], seen[~hidden]
        i, j = i[seen], j[seen]
        return ExactPairs(i, j, aligned.exchange(i, j), rays)

    block = max(1, PAIRS // n)
    yield from in_order(work, [in_frame[a : a + block] for a in range(0, len(in_frame), block)])
