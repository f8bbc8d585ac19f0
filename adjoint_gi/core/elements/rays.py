"""Rays between element sides: cosine-distributed from points all over a side, from fixed low-discrepancy sets."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..base.parallel import in_order
from ..sampling.additive import STEPS, additive
from ..sampling.maps import TWO_PI, polar
from ..scene.arrays import RayKind
from ..scene.passing import MOST_LAYERS
from .elements import Elements

RAYS_PER_TASK = 1 << 15  # rays in one piece of work

# Every side and every shot shifts the set by its own vector, itself from an additive sequence.
BETA = np.sqrt([2.0, 3.0, 5.0, 7.0])
MIXER = np.uint64(0x9E3779B97F4A7C15)  # odd, of no pattern: the golden ratio (Knuth, volume 3, section 6.4)
STREAMS = 1 << 24  # shifts of the set; more would not differ in float64


def shifted_points(number: np.ndarray, stream: np.ndarray) -> np.ndarray:
    """(4, n) float64 in 0..1: point `number` (n,) of the set, shifted for `stream` (n,) int64. The same every time."""
    return additive(number, STEPS[4], (stream % STREAMS) * BETA[:, None], 0.5)


class ElementRays:
    """Casts rays from element sides and says which sides they meet. `cast` counts rays; same arguments, same answer."""

    def __init__(self, elements: Elements) -> None:
        self.elements = elements
        self.world = elements.world
        self.tinted = self.world.tints
        # One row an element: corner, the edges along local a and b, and the frame t1, t2, n for directions. t1 lies along an edge and is
        # not that of `maps.frame`, so that the fixed sets of rays lie in the same way on elements that are alike.
        index = np.arange(elements.count)
        zero, one = np.zeros(elements.count), np.ones(elements.count)
        corner = elements.position(index, zero, zero)
        along = elements.position(index, one, zero) - corner
        across = elements.position(index, zero, one) - corner
        t1 = along / np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
        t2 = np.cross(elements.normal, t1)
        self._rows = np.concatenate([corner, along, across, t1, t2, elements.normal], axis=1).astype(np.float32)
        self._triangle = elements.patch_triangle[elements.patch]
        self._normals = np.ascontiguousarray(self.world.rows[:, 9:12])

    def start(self, side: np.ndarray, number: np.ndarray, stream: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins, directions and the sides' normals, (n, 3) float32, of rays from `side` (n,). `number` and `stream` pick the ray."""
        u = shifted_points(number, stream).astype(np.float32)
        element = side >> 1
        rows = self._rows[element]
        sign = np.where(side & 1, np.float32(-1), np.float32(1))
        a, b = u[0], u[1]
        fold = ~self.elements.is_quad[element] & (a + b > 1)
        a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
        normal = rows[:, 15:18] * sign[:, None]
        position = rows[:, 0:3] + a[:, None] * rows[:, 3:6] + b[:, None] * rows[:, 6:9]
        origin = self.world.lifted(position, normal, self._triangle[element])
        x, y, z = polar(u[2], TWO_PI * u[3])[:, :, None]
        direction = x * rows[:, 9:12] + y * rows[:, 12:15]
        direction += z * normal
        return origin, direction, normal

    def cast(self, side: np.ndarray, number: np.ndarray, stream: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """(n,) int64 sides met by rays from `side` (n,), -1 where they escape, and their colour as of `meet`. `number` and `stream` pick
        the ray."""
        origin, direction, normal = self.start(side, number, stream)
        triangle, tu, tv, color = self.meet(origin, direction, normal)
        hit = np.flatnonzero(triangle >= 0)
        out = np.full(len(side), -1, np.int64)
        met = triangle[hit]
        behind = np.einsum("ij,ij->i", self._normals[met], direction[hit]) > 0
        out[hit] = 2 * self.elements.locate(met, tu[hit], tv[hit]) + behind
        return out, color

    def meet(
        self, origin: np.ndarray, direction: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Triangle (n,) int32, -1 where none, and barycentrics u, v (n,) where rays from points with `normal` stay, all (n, 3) float32.

        Where surfaces let light straight through, a ray stays or goes on as a whole: to rays such a surface is the part of itself that
        `Elements.held` describes. Last, the colour (n, 3) float32 that rays have taken from what they passed, over the chance of passing;
        None where no surface of the scene tints.
        """
        hit = triangle, u, v, _ = self.world.intersect(origin, direction, RayKind.DIFFUSE)
        # A ray can slip through exactly at an edge: misses get a second chance a hair beside.
        missed = np.flatnonzero(triangle < 0)
        if len(missed):
            nudged = direction[missed] + np.float32(1e-4) * normal[missed]
            triangle[missed], u[missed], v[missed], _ = self.world.intersect(origin[missed], nudged, RayKind.DIFFUSE)
        passing = self.world.passing
        color = np.ones((len(origin), 3), np.float32) if self.tinted else None
        rows = np.flatnonzero(passing.lets[triangle]) if passing is not None else missed[:0]
        for layer in range(MOST_LAYERS):
            if not len(rows):
                break
            chance = passing.grey(triangle[rows], u[rows], v[rows])
            rows = rows[_luck(origin[rows], direction[rows], layer) < chance]
            if color is not None:
                color[rows] *= passing.color(triangle[rows], u[rows], v[rows])
            self.world.onward(origin, direction, RayKind.DIFFUSE, hit, rows)
            rows = rows[passing.lets[triangle[rows]]]
        return triangle, u, v, color

    def rows(self, sides: np.ndarray, rays: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        """Rays 0..`rays` from each of the sides, over threads, in order: pieces of (sides (m,), sides met (m, rays) int32, colour of the
        rays (m rays, 3) float32 or None)."""
        block = max(1, RAYS_PER_TASK // rays)

        def work(first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
            part = sides[first : first + block]
            owner = np.repeat(part, rays)
            met, color = self.cast(owner, np.tile(np.arange(rays), len(part)), owner)
            return part, met.reshape(len(part), rays).astype(np.int32), color

        yield from in_order(work, range(0, len(sides), block))


def _luck(origin: np.ndarray, direction: np.ndarray, layer: int) -> np.ndarray:
    """(n,) float64 in 0..1 that depends on the bits of rays (n, 3) float32 alone: the same rays pass the same surfaces every time."""
    bits = np.concatenate([origin, direction], axis=1).view(np.uint32).astype(np.uint64)
    out = np.full(len(bits), layer + 1, np.uint64)
    for column in bits.T:
        out = (out ^ column) * MIXER
        out ^= out >> np.uint64(29)
    return (out >> np.uint64(11)) * 2.0**-53
