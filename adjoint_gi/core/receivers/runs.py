"""Runs of places in the rows of an image that triangles in UV space cover: as many as the triangles are high, however wide they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

SLACK = 1e-9  # texels: a place on the edge of two triangles lies in both


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

    def maps(self) -> np.ndarray:
        """(6, n) float64 x0, y0, ax, ay, bx, by: the point (x, y) has barycentrics a = (x - x0) ax + (y - y0) ay, and b likewise."""
        e1, e2 = self.xy[:, 1] - self.xy[:, 0], self.xy[:, 2] - self.xy[:, 0]
        safe = np.where(self.has_area, self.doubled, 1.0)
        return np.stack([*self.xy[:, 0].T, *(x / safe for x in (e2[:, 1], -e2[:, 0], -e1[:, 1], e1[:, 0]))])

    def edges(self) -> np.ndarray:
        """(n, 8) float64: y of the corners from below, x of the lower two; dx/dy from the lowest to the highest, to the middle one, and
        from there to the highest. What two triangles share is computed alike in both."""
        xy = np.take_along_axis(self.xy, np.argsort(self.xy[..., 1], axis=1, kind="stable")[..., None], axis=1)
        x, y = xy[..., 0], xy[..., 1]
        slopes = [_slope(x[:, b] - x[:, a], y[:, b] - y[:, a]) for a, b in ((0, 2), (0, 1), (1, 2))]
        return np.column_stack([y, x[:, :2], *slopes])


@dataclass(frozen=True, eq=False)
class Runs:
    """Run i: the places number `place` of the texels `first` to `last` of `row`, all of them in `triangle`; (n,) int64 each."""

    triangle: np.ndarray
    row: np.ndarray
    place: np.ndarray
    first: np.ndarray
    last: np.ndarray

    def __len__(self) -> int:
        return len(self.triangle)


def runs_of_rows(edges: np.ndarray, work: np.ndarray, rows: tuple[int, int], width: int, offsets: np.ndarray) -> Runs:
    """The runs, in rows from `rows[0]` up to before `rows[1]`, of the places `offsets` (m, 2) of texels.

    edges: of `UvTriangles.edges`. In the order of the triangles `work`.
    """
    # Step 1: the rows in which a place of each number lies between the lowest and the highest corner.
    low, high = edges[work, 0, None], edges[work, 2, None]
    first = np.clip(np.ceil(low - offsets[:, 1] - SLACK), rows[0], rows[1]).astype(np.int64)
    last = np.clip(np.floor(high - offsets[:, 1] + SLACK) + 1, rows[0], rows[1]).astype(np.int64)
    index, row = expand(np.arange(first.size), first.ravel(), last.ravel())
    triangle, place = work[index // len(offsets)], index % len(offsets)

    # Step 2: from the edge between the lowest and the highest corner to one of the others.
    bottom, middle, top, x0, x1, slope, lower, upper = edges[triangle].T
    y = np.clip(row + offsets[place, 1], bottom, top)
    one = x0 + (y - bottom) * slope
    other = np.where(y < middle, x0 + (y - bottom) * lower, x1 + (y - middle) * upper)
    dx = offsets[place, 0]
    start = np.maximum(np.ceil(np.minimum(one, other) - dx - SLACK), 0).astype(np.int64)
    stop = np.minimum(np.floor(np.maximum(one, other) - dx + SLACK), width - 1).astype(np.int64)
    some = np.flatnonzero(stop >= start)
    return Runs(triangle[some], row[some], place[some], start[some], stop[some])


def shared(runs: Runs, width: int, places: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places that two of `runs` cover, as pieces (k,): the run, another one that covers all of the piece, its first and last column.

    Every further claim of a place is paired with one of those before it in its row.
    """
    line = (runs.row * places + runs.place) * width
    start, stop = line + runs.first, line + runs.last
    order = np.argsort(start, kind="stable")
    # The run that reaches farthest of all before: it began before and so covers whatever of this one lies before its end.
    reach = np.maximum.accumulate(stop[order])
    late = np.flatnonzero(start[order[1:]] <= reach[:-1])
    new = np.append(True, stop[order[1:]] > reach[:-1])
    farthest = order[np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))] if len(order) else order
    run, other = order[1:][late], farthest[:-1][late]
    return run, other, runs.first[run], np.minimum(runs.last[run], runs.last[other])


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


def _slope(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """dx/dy, 0 where dy is."""
    return np.where(dy > 0, dx / np.where(dy > 0, dy, 1.0), 0.0)
