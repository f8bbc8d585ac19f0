"""Meshes and the flat charts they are cut into: what every way of unwrapping reads and makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.topology import components, edge_pairs, uv_corner_ids, weld

LONG = 1.25  # times as long as there is room for is what charts are cut or squeezed for: less costs the others a fifth at most
PIECE = 0.5  # share of the room that the pieces of a long chart are as long as
CREASE = np.cos(np.radians(60))  # a sharper edge parts charts, so that light does not bleed around it
EDGES = 64  # longest edges of a long chart that are looked at for its direction


@dataclass(frozen=True, eq=False)
class Mesh:
    """What is unwrapped: `vertices` (nv, 3) float64 in metres, `triangles` (nt, 3) int64, and the `polygon` (nt,) of each triangle.

    Every triangle has an area, every coordinate is finite. Triangles of one polygon come into one chart.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    polygon: np.ndarray

    def corners(self) -> np.ndarray:
        """(nt, 3, 3) float64 positions of the corners."""
        return self.vertices[self.triangles]

    def part(self, which: np.ndarray) -> Mesh:
        """The triangles `which` (nt,) bool alone."""
        return Mesh(self.vertices, self.triangles[which], self.polygon[which])


@dataclass(frozen=True, eq=False)
class Charts:
    """Triangles laid flat: `xy` (nt, 3, 2) float64 in metres, about any origin, and the `chart` (nt,) int64 0, 1, ... of each."""

    xy: np.ndarray
    chart: np.ndarray

    @property
    def count(self) -> int:
        """Number of charts."""
        return int(self.chart.max(initial=-1)) + 1

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest x and y (count, 2) of every chart."""
        order = np.argsort(self.chart, kind="stable")
        start = np.searchsorted(self.chart[order], np.arange(self.count))
        return np.minimum.reduceat(self.xy.min(axis=1)[order], start), np.maximum.reduceat(self.xy.max(axis=1)[order], start)


def join(parts: Sequence[Charts], scale: np.ndarray) -> Charts:
    """The charts of several meshes behind one another, those of each multiplied by its `scale` (n,)."""
    first = np.cumsum([0, *(part.count for part in parts)])
    chart = [part.chart + start for part, start in zip(parts, first, strict=False)]
    xy = [part.xy * factor for part, factor in zip(parts, scale, strict=True)]
    return Charts(np.concatenate(xy), np.concatenate(chart))


def islands(mesh: Mesh, xy: np.ndarray, chart: np.ndarray | None = None) -> np.ndarray:
    """(nt,) int64 0, 1, ...: triangles that hang together by corners at one place in space and in `xy` (nt, 3, 2), and in `chart` (nt,)."""
    corner = uv_corner_ids(weld(mesh.vertices)[mesh.triangles], xy.astype(np.float32)).ravel()
    key = corner if chart is None else corner * (int(chart.max()) + 1) + np.repeat(chart, 3)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    return components(len(xy), order[:-1][same] // 3, order[1:][same] // 3)


def room(charts: Charts, full: float) -> float:
    """The side in metres of a square image of which all `charts` together cover the share `full`: how long a chart there is room for."""
    return float(np.sqrt(np.abs(signed_areas(charts.xy)).sum() / full))


def parted(mesh: Mesh, charts: Charts, side: float) -> Charts:
    """`charts` with those cut across that are LONG times as long as an image of `side` metres: one long kerb would make all others small.

    Faces stay whole, so that one that is as long itself is left to `shortened`.
    """
    low, high = charts.bounds()
    size = high - low
    parts = np.where(size.max(axis=1) > LONG * side, np.ceil(size.max(axis=1) / (PIECE * side)), 1)[charts.chart]
    if not (parts > 1).any():
        return charts
    # The middle of each face along the longer side of its chart tells its part.
    face = numbered(mesh.polygon)
    middle = charts.xy.mean(axis=1)
    middle = np.stack([np.bincount(face, middle[:, k]) for k in (0, 1)], axis=1) / np.bincount(face)[:, None]
    share = ((middle[face] - low[charts.chart]) / np.maximum(size[charts.chart], 1e-300))[
        np.arange(len(face)), size.argmax(axis=1)[charts.chart]
    ]
    part = np.minimum((share * parts).astype(np.int64), parts.astype(np.int64) - 1)
    return Charts(charts.xy, islands(mesh, charts.xy, numbered(charts.chart * (int(part.max()) + 1) + part)))


def shortened(charts: Charts, side: float, full: float, scale: float = np.inf) -> tuple[Charts, np.ndarray]:
    """`charts` with those squeezed along their lengths that are more than LONG times as long as there is room for, which is the side of
    an image of `side` texels of which all together cover the share `full`; one would make all others small. Where they cover less than
    that at `scale` texels a metre, the most that they may have, there is room for the side of an image at that scale, and no more.

    Also (count,) float64 the share of its length that each has left, 1 where it is as it was.
    """
    xy, left = charts.xy.copy(), np.ones(charts.count)
    for _ in range(charts.count):
        # Step 1: the longest that an image has room for, m. Each round finds more, as the others grow by what those leave.
        filled = room(Charts(xy, charts.chart), full)
        most, too = (filled, LONG) if filled > side / scale else (side / scale, 1.0)
        low, high = Charts(xy, charts.chart).bounds()
        more = np.flatnonzero((high - low).max(axis=1) > most * too)
        if not len(more):
            break
        for chart in more:
            # Step 2: turned so that the axes follow it: as one of its longest edges, or as it is.
            own = charts.chart == chart
            points = xy[own].reshape(-1, 2)
            edge = (xy[own] - np.roll(xy[own], 1, axis=1)).reshape(-1, 2)
            length = np.linalg.norm(edge, axis=1)
            best = np.argsort(-length, kind="stable")[:EDGES]
            c, s = np.append(edge[best] / np.maximum(length[best], 1e-300)[:, None], [[1.0, 0.0]], axis=0).T
            ways = np.einsum("kij,nj->kni", np.array([[c, s], [-s, c]]).transpose(2, 0, 1), points - points.mean(axis=0))
            turned = ways[np.argmin(np.prod(np.ptp(ways, axis=1), axis=1))]
            # Step 3: only as wide as before, and as long as there is room.
            size = np.ptp(turned, axis=0)
            share = np.minimum(1.0, (1 - 2 / side) * most / np.maximum(size, 1e-300))
            xy[own] = (turned * share).reshape(-1, 3, 2)
            left[chart] *= share.min()
    return Charts(xy, charts.chart), left


def numbered(labels: np.ndarray) -> np.ndarray:
    """`labels` (n,) as int64 0, 1, ... in their order."""
    return np.unique(labels, return_inverse=True)[1].reshape(-1).astype(np.int64)


def area_vectors(corner: np.ndarray) -> np.ndarray:
    """(nt, 3) normals of triangles `corner` (nt, 3, 3), as long as their areas."""
    return 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def signed_areas(xy: np.ndarray) -> np.ndarray:
    """(nt,) areas of flat triangles, negative where they lie the other way around."""
    e1, e2 = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    return 0.5 * (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])


def mean_normal(vector: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(n, 3) unit sum of area vectors for each label; z where they cancel out."""
    total = np.stack([np.bincount(label, vector[:, k]) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-20, total / np.maximum(length, 1e-20), [0.0, 0.0, 1.0])


def joined(polygon: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(nt,) labels of pieces: triangles a[k] and b[k] belong together, and so do all triangles of one `polygon` (nt,)."""
    order = np.argsort(polygon, kind="stable")
    same = polygon[order][1:] == polygon[order][:-1]
    return components(len(polygon), np.concatenate([a, order[:-1][same]]), np.concatenate([b, order[1:][same]]))


def smooth_regions(mesh: Mesh) -> np.ndarray:
    """(nt,) int64 0, 1, ...: triangles that hang together over edges that are no creases."""
    polygon = numbered(mesh.polygon)
    normal = mean_normal(area_vectors(mesh.corners()), polygon)[polygon]
    a, b = edge_pairs(weld(mesh.vertices)[mesh.triangles])
    same = (polygon[a] == polygon[b]) | (np.einsum("ij,ij->i", normal[a], normal[b]) > CREASE)
    return joined(polygon, a[same], b[same])


def carry(corner: np.ndarray, xy: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(n, k, 2): where the affine maps of triangles `corner` (n, 3, 3) to `xy` (n, 3, 2) carry the points `point` (n, k, 3)."""
    e1, e2, d = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], point - corner[:, :1]
    # Barycentric coordinates (s, t) of the points in the triangle, by the normal equations.
    a, b, c = (np.einsum("ij,ij->i", x, y)[:, None] for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    u, v = np.einsum("ikj,ij->ik", d, e1), np.einsum("ikj,ij->ik", d, e2)
    det = np.maximum(a * c - b * b, 1e-300)
    s, t = (c * u - b * v) / det, (a * v - b * u) / det
    return xy[:, None, 0] + s[..., None] * (xy[:, 1] - xy[:, 0])[:, None] + t[..., None] * (xy[:, 2] - xy[:, 0])[:, None]
