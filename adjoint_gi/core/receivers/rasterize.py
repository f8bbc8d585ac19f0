"""Which triangles in UV space own which places of the texels: the exact test behind `texels`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..scene.world import World

TEXELS_PER_CHUNK = 1 << 20  # candidate texels looked at in one go
INSIDE = 1e-5  # barycentric distance that points keep from the edges: a ray must not start inside the wall at the end of a floor
STRICT = 1e-3  # barycentric distance from the edges at which a point counts as inside two triangles at once


@dataclass(frozen=True, eq=False)
class UvTriangles:
    """Triangles in units of texels: xy (n, 3, 2) float64, doubled (n,) their signed area times two; and which of them are usable
    (finite), inside the image, and have an area, (n,) bool."""

    xy: np.ndarray
    doubled: np.ndarray
    usable: np.ndarray
    inside: np.ndarray
    has_area: np.ndarray

    @classmethod
    def of(cls, uv: np.ndarray, width: int, height: int) -> UvTriangles:
        """From UVs (n, 3, 2) of an image of `width` x `height` texels."""
        xy = uv.astype(np.float64) * (width, height)
        usable = np.isfinite(xy).all(axis=(1, 2)) & (np.abs(np.nan_to_num(xy)) < 2**40).all(axis=(1, 2))
        xy[~usable] = 0.0
        inside = (xy >= -1e-3).all(axis=(1, 2)) & (xy <= np.array([width, height]) + 1e-3).all(axis=(1, 2))
        e1, e2 = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
        doubled = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
        has_area = np.abs(doubled) > 1e-9 * np.maximum((e1**2).sum(1), (e2**2).sum(1)) + 1e-15
        return cls(xy, doubled, usable, inside, has_area)

    def slopes(self) -> np.ndarray:
        """(4, n) float64 ax, ay, bx, by: barycentrics are a = px ax + py ay and b = px bx + py by, (px, py) from the first corner."""
        e1, e2 = self.xy[:, 1] - self.xy[:, 0], self.xy[:, 2] - self.xy[:, 0]
        safe = np.where(self.has_area, self.doubled, 1.0)
        return np.stack([e2[:, 1] / safe, -e2[:, 0] / safe, -e1[:, 1] / safe, e1[:, 0] / safe])


@dataclass(eq=False)
class Claims:
    """Who owns each place of each texel: holder (texels * places,) int32 is 1 + the triangle's position in the list, 0 is free;
    u, v (texels * places,) float32 barycentrics there; overlapping (texels,) bool: claimed by different surfaces;
    clashing (k,) the positions of triangles that claim the same place for different surfaces."""

    holder: np.ndarray
    u: np.ndarray
    v: np.ndarray
    overlapping: np.ndarray
    clashing: np.ndarray


def claim_places(world: World, triangle: np.ndarray, layout: UvTriangles, width: int, height: int, offsets: np.ndarray) -> Claims:
    """Test the places `offsets` (m, 2) of every texel that a triangle may touch; the lowest triangle keeps a place that two claim.

    triangle (n,): the world's triangle of each one in `layout`.
    """
    texels, places = width * height, len(offsets)
    claim = np.zeros(texels * places, np.int32)
    u, v = np.zeros((2, texels * places), np.float32)
    overlapping = np.zeros(texels, bool)
    clash: list[np.ndarray] = []
    slopes = layout.slopes()
    for which, row, column in candidates(layout.xy, np.flatnonzero(layout.usable & layout.has_area), width, height):
        px, py = column - layout.xy[which, 0, 0], row - layout.xy[which, 0, 1]
        ax, ay, bx, by = slopes[:, which]
        base_a, base_b = px * ax + py * ay, px * bx + py * by
        for k, (dx, dy) in enumerate(offsets):
            # Step 1: which candidates cover this place of the texel.
            a, b = base_a + (dx * ax + dy * ay), base_b + (dx * bx + dy * by)
            hit = np.flatnonzero((a >= -1e-9) & (b >= -1e-9) & (a + b <= 1 + 1e-9))
            if not len(hit):
                continue
            place = (row[hit] * width + column[hit]) * places + k
            mine, a, b = which[hit] + 1, a[hit], b[hit]
            # Step 2: free places are taken. Assigned backwards, as of equal indices numpy keeps the last: the lowest triangle stays.
            free = np.flatnonzero(claim[place] == 0)[::-1]
            claim[place[free]] = mine[free]
            own = claim[place] == mine
            u[place[own]], v[place[own]] = kept_inside(a[own], b[own])
            # Step 3: who came too late clashes with the holder, unless both mean the same surface.
            lost = np.flatnonzero(~own & (np.minimum(np.minimum(a, b), 1 - a - b) > STRICT))
            if len(lost):
                at = place[lost]
                differ = elsewhere(world, triangle, claim[at] - 1, u[at], v[at], mine[lost] - 1, a[lost], b[lost])
                overlapping[at[differ] // places] = True
                clash.append(np.unique(np.concatenate([mine[lost[differ]] - 1, claim[at[differ]] - 1])))
    return Claims(claim, u, v, overlapping, np.unique(np.concatenate(clash)) if clash else np.zeros(0, int))


def candidates(xy: np.ndarray, work: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Chunks of (triangle, row, column), each (m,) int64, that hold every texel touched by the triangles `work` of `xy` (nt, 3, 2).

    A triangle is cut into rows and each row into the texels between its leftmost and rightmost point there, so a large triangle
    costs what it covers and not what its bounding box holds. In order of the triangles.
    """
    # Float rounding must not lose a texel at a border: a little slack, and the exact test follows anyway.
    slack = 1e-6
    low = np.clip(np.floor(xy[work, :, 1].min(axis=1) - slack), 0, height).astype(np.int64)
    high = np.clip(np.floor(xy[work, :, 1].max(axis=1) + slack) + 1, 0, height).astype(np.int64)
    for some in blocks(np.maximum(high - low, 0), TEXELS_PER_CHUNK):
        which, row = expand(work[some], low[some], high[some])
        left, right = row_extent(xy, which, row)
        first = np.clip(np.floor(left - slack), 0, width).astype(np.int64)
        last = np.where(right < left, first, np.clip(np.floor(right + slack) + 1, 0, width).astype(np.int64))
        for part in blocks(np.maximum(last - first, 0), TEXELS_PER_CHUNK):
            index, column = expand(np.arange(part.start, part.stop), first[part], last[part])
            yield which[index], row[index], column


def kept_inside(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentrics moved off the edges of the triangle by at least INSIDE, where they are closer."""
    a, b = np.clip(a, INSIDE, 1 - 2 * INSIDE), np.clip(b, INSIDE, 1 - 2 * INSIDE)
    excess = 0.5 * np.maximum(a + b - (1 - INSIDE), 0)
    return a - excess, b - excess


def row_extent(xy: np.ndarray, which: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest x (m,) of triangles `which` inside the slab row <= y <= row + 1."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for k in range(3):
        p, q = xy[which, k], xy[which, (k + 1) % 3]
        dy = q[:, 1] - p[:, 1]
        level = np.abs(dy) < 1e-12
        safe = np.where(level, 1.0, dy)
        t0, t1 = (row - 1e-6 - p[:, 1]) / safe, (row + 1 + 1e-6 - p[:, 1]) / safe
        t0, t1 = np.minimum(t0, t1), np.maximum(t0, t1)
        # The ends of a level edge are those of the other two, which have an extent in y, as the triangle has an area.
        misses = level | (t1 < 0) | (t0 > 1)
        dx = q[:, 0] - p[:, 0]
        x0, x1 = p[:, 0] + np.clip(t0, 0, 1) * dx, p[:, 0] + np.clip(t1, 0, 1) * dx
        left = np.minimum(left, np.where(misses, np.inf, np.minimum(x0, x1)))
        right = np.maximum(right, np.where(misses, -np.inf, np.maximum(x0, x1)))
    return left, right


def expand(items: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each of `items` repeated for the numbers first..last-1 that belong to it, and these numbers."""
    count = np.maximum(last - first, 0)
    total = np.cumsum(count)
    run = np.arange(int(total[-1]) if len(total) else 0) - np.repeat(total - count, count)
    return np.repeat(items, count), np.repeat(first, count) + run


def blocks(count: np.ndarray, limit: int) -> Iterator[slice]:
    """Slices of about `limit` (a single item may have more) summed `count`."""
    total = np.cumsum(count)
    at = 0
    while at < len(count):
        done = total[at - 1] if at else 0
        stop = max(at + 1, int(np.searchsorted(total, done + limit, side="right")))
        yield slice(at, stop)
        at = stop


def elsewhere(
    world: World, triangle: np.ndarray, i: np.ndarray, ui: np.ndarray, vi: np.ndarray, j: np.ndarray, uj: np.ndarray, vj: np.ndarray
) -> np.ndarray:
    """(n,) bool: whether two claims of one place are different surfaces: apart by 1e-5 of the scene, or facing another way."""
    first = world.surface(triangle[i], ui.astype(np.float32), vi.astype(np.float32))
    second = world.surface(triangle[j], uj.astype(np.float32), vj.astype(np.float32))
    apart = np.linalg.norm(first.position - second.position, axis=1) > 1e-5 * world.extent
    return apart | (np.einsum("ij,ij->i", first.ng, second.ng) < 0.99)
