"""Which triangles in UV space own which places of the texels: the exact test behind `texels`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .runs import Runs, UvTriangles, blocks, expand, runs_of_rows, shared

PLACES_PER_CHUNK = 1 << 20  # places of texels looked at in one go
INSIDE = 1e-5  # barycentric distance that points keep from the edges: a ray must not start inside the wall at the end of a floor
STRICT = 1e-3  # barycentric distance from the edges at which a point counts as inside two triangles at once


@dataclass(frozen=True, eq=False)
class Shapes:
    """Where the triangles of the layout lie in space: `rows` (n, 12) float32 v0, e1, e2, unit normal, as in `World`."""

    rows: np.ndarray

    @property
    def near(self) -> float:
        """Points closer than this are one: a part of their own extent, and of what float32 rounds them by."""
        first = self.rows[:, 0:3] if len(self.rows) else np.zeros((1, 3))
        return 1e-5 * float(np.ptp(first, axis=0).max() / 2) + 1e-6 * float(np.abs(first).max())

    def apart(self, i: np.ndarray, at_i: np.ndarray, j: np.ndarray, at_j: np.ndarray) -> np.ndarray:
        """(k,) bool: whether points `at_i`, `at_j` (2, k) barycentric, of triangles i and j (k,) are of different surfaces.

        They are where they lie apart or face another way.
        """
        distance = np.linalg.norm(self._point(i, at_i) - self._point(j, at_j), axis=1)
        return (distance > self.near) | (np.einsum("ij,ij->i", self.rows[i, 9:12], self.rows[j, 9:12]) < 0.99)

    def _point(self, triangle: np.ndarray, at: np.ndarray) -> np.ndarray:
        row = self.rows[triangle]
        return row[:, 0:3] + at[0][:, None] * row[:, 3:6] + at[1][:, None] * row[:, 6:9]


@dataclass(frozen=True, eq=False)
class Claims:
    """Who owns the places of texels that lie in a triangle, by texel and number of the place.

    item (p,) int32 the triangle's position in the list; u, v (p,) float32 barycentrics there; many (texels,) uint16 places of each
    texel; overlapping the number of texels claimed by different surfaces; clashing (k,) the positions of triangles that claim the
    same place for different surfaces.
    """

    item: np.ndarray
    u: np.ndarray
    v: np.ndarray
    many: np.ndarray
    overlapping: int
    clashing: np.ndarray


def claim_places(shapes: Shapes, layout: UvTriangles, width: int, height: int, offsets: np.ndarray) -> Claims:
    """Find the places `offsets` (m, 2) of every texel that lie in a triangle; the lowest triangle keeps a place that two claim."""
    places, maps = len(offsets), layout.maps()
    parts: list[tuple[np.ndarray, ...]] = []
    many = np.zeros(width * height, np.uint16)
    clashes = Clashes.none(maps.shape[1])
    for (low, high), runs in row_blocks(layout, width, height, offsets):
        # Step 1: places are painted from the last triangle to the first, so that the lowest stays: of equal indices numpy keeps the last.
        holder = np.full((high - low) * width * places, -1, np.int32)
        claimed = 0
        for part in reversed(list(blocks(runs.last - runs.first + 1, PLACES_PER_CHUNK))):
            which, column = expand(np.arange(part.stop - 1, part.start - 1, -1), runs.first[part][::-1], runs.last[part][::-1] + 1)
            holder[((runs.row[which] - low) * width + column) * places + runs.place[which]] = runs.triangle[which]
            claimed += len(which)
        filled = np.flatnonzero(holder >= 0)
        # Step 2: what was painted twice clashes, unless both mean the same surface.
        if claimed > len(filled):
            clashes.look(shapes, maps, runs, low, width, offsets)
        # Step 3: barycentrics where they are needed.
        item = holder[filled]
        a, b = _barycentric(maps, item, filled // places % width, low + filled // places // width, offsets[filled % places])
        parts.append((item, *(x.astype(np.float32) for x in kept_inside(a, b))))
        many[low * width : high * width] = (holder >= 0).reshape(-1, places).sum(axis=1)
    item, u, v = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Claims(item, u, v, many, clashes.texels, np.flatnonzero(clashes.triangle))


def row_blocks(layout: UvTriangles, width: int, height: int, offsets: np.ndarray) -> Iterator[tuple[tuple[int, int], Runs]]:
    """The image in blocks of rows, (first row, row after the last), of about PLACES_PER_CHUNK places, each with the runs in it."""
    edges = layout.edges()
    work = np.flatnonzero(layout.usable & layout.has_area)
    bottom, top = edges[work, 0], edges[work, 2]
    step = max(1, PLACES_PER_CHUNK // (width * len(offsets)))
    for low in range(0, height, step):
        high = min(low + step, height)
        yield (low, high), runs_of_rows(edges, work[(bottom < high) & (top >= low)], (low, high), width, offsets)


@dataclass(eq=False)
class Clashes:
    """What different surfaces claim: `triangle` (n,) bool take part, `texels` is the number of texels."""

    triangle: np.ndarray
    texels: int

    @classmethod
    def none(cls, count: int) -> Clashes:
        """Of `count` triangles none yet."""
        return cls(np.zeros(count, bool), 0)

    def look(self, shapes: Shapes, maps: np.ndarray, runs: Runs, low: int, width: int, offsets: np.ndarray) -> None:
        """Add those of `runs`, all that there are in some rows from `low` on."""
        run, other, first, last = shared(runs, width, len(offsets))
        texels = [np.zeros(0, np.int64)]
        for part in blocks(last - first + 1, PLACES_PER_CHUNK):
            which, column = expand(np.arange(part.start, part.stop), first[part], last[part] + 1)
            late, holder = runs.triangle[run[which]], runs.triangle[other[which]]
            row, place = runs.row[run[which]], runs.place[run[which]]
            mine = np.stack(_barycentric(maps, late, column, row, offsets[place]))
            inner = np.flatnonzero(np.minimum(mine.min(axis=0), 1 - mine.sum(axis=0)) > STRICT)
            late, holder, column, row, place, mine = late[inner], holder[inner], column[inner], row[inner], place[inner], mine[:, inner]
            theirs = np.stack(_barycentric(maps, holder, column, row, offsets[place]))
            differ = shapes.apart(late, mine, holder, theirs)
            self.triangle[late[differ]] = self.triangle[holder[differ]] = True
            texels.append(np.unique((row[differ] - low) * width + column[differ]))
        self.texels += len(np.unique(np.concatenate(texels)))


def kept_inside(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentrics moved off the edges of the triangle by at least INSIDE, where they are closer."""
    a, b = np.clip(a, INSIDE, 1 - 2 * INSIDE), np.clip(b, INSIDE, 1 - 2 * INSIDE)
    excess = 0.5 * np.maximum(a + b - (1 - INSIDE), 0)
    return a - excess, b - excess


def _barycentric(
    maps: np.ndarray, triangle: np.ndarray, column: np.ndarray, row: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Second and third barycentric coordinate (k,) float64 of the places `offset` (k, 2) of texels in triangles of `maps`."""
    x0, y0, ax, ay, bx, by = (row.take(triangle) for row in maps)
    px, py = column - x0 + offset[:, 0], row - y0 + offset[:, 1]
    return px * ax + py * ay, px * bx + py * by
