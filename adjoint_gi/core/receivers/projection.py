"""Charts by projection: a mesh is cut into pieces that face one way, and each is laid flat along its mean normal.

Distances on a flat piece are kept, on a curved one shortened by at most the cosine of the angle between a face and the direction of
projection.
"""

from __future__ import annotations

import numpy as np

from ..scene.topology import edge_pairs, weld
from .charts import CREASE, Charts, Mesh, area_vectors, joined, mean_normal, numbered

FLAT = np.cos(np.radians(3))  # how far faces of one flat piece may turn from its mean
STEEP = 0.5  # cosine: a face that turns further from the direction of projection is projected along the main axis instead
LEAST_STEP = 1e-3  # share of its border that a side of a polygon has at least when it is opened
ANGLES = 24  # directions in which the tightest rectangle around a chart is sought


def pieces(mesh: Mesh) -> np.ndarray:
    """(nt,) int64: label of the piece of each triangle: neighbours that look along the same main axis, with no crease between them."""
    polygon = numbered(mesh.polygon)
    vector = area_vectors(mesh.corners())
    normal = mean_normal(vector, polygon)[polygon]

    # Step 1: flat pieces, as far as they stay flat: their faces get one direction together, so rounding cannot part them.
    a, b = edge_pairs(weld(mesh.vertices)[mesh.triangles])
    within = polygon[a] == polygon[b]
    turn = np.einsum("ij,ij->i", normal[a], normal[b])
    flat = joined(polygon, a[within | (turn > FLAT)], b[within | (turn > FLAT)])
    mean = mean_normal(vector, flat)
    direction = np.where((worst_cosine(mean, normal, flat) > FLAT)[flat][:, None], mean[flat], normal)

    # Step 2: the main axis each face looks along; neighbours with the same one and no crease between them make a chart.
    rounded = np.round(direction, 5)
    axis = np.argmax(np.concatenate([rounded, -rounded], axis=1), axis=1)
    same = within | ((axis[a] == axis[b]) & (turn > CREASE))
    return joined(polygon, a[same], b[same])


def project(mesh: Mesh, label: np.ndarray) -> Charts:
    """One chart for each `label` (nt,): laid flat along its direction and turned into its tightest rectangle, the long side along x."""
    chart = numbered(label)
    corner = mesh.corners()
    x, y = _plane(_direction(mesh, chart))
    xy = np.stack([np.einsum("tij,tj->ti", corner, x[chart]), np.einsum("tij,tj->ti", corner, y[chart])], axis=2)
    return tightest(Charts(xy, chart))


def opened(mesh: Mesh) -> Charts:
    """One chart for each polygon, its corners on a circle, as far apart as along its border: triangles of crossed or folded ones, which lie
    over one another in any projection, lie side by side. As corners have one place each, triangles cannot be parted.

    A polygon whose border is not one ring is projected.
    """
    flat = project(mesh, mesh.polygon)
    xy = flat.xy.copy()
    for own in np.split(np.argsort(flat.chart, kind="stable"), np.cumsum(np.bincount(flat.chart))[:-1]):
        ring = _ring(mesh.triangles[own])
        if ring is not None:
            step = np.linalg.norm(mesh.vertices[np.roll(ring, -1)] - mesh.vertices[ring], axis=1)
            step = np.maximum(step, LEAST_STEP * step.sum())
            arc = np.cumsum(step)
            angle = dict(zip(ring.tolist(), 2 * np.pi * (arc - step) / arc[-1], strict=True))
            turn = np.array([angle[k] for k in mesh.triangles[own].ravel().tolist()]).reshape(-1, 3)
            xy[own] = arc[-1] / (2 * np.pi) * np.stack([np.cos(turn), np.sin(turn)], axis=2)
    return tightest(Charts(xy, flat.chart))


def _ring(triangles: np.ndarray) -> np.ndarray | None:
    """(n,) int64 vertices along the border of `triangles` (nt, 3); None where it is not one ring that meets every vertex once."""
    edges = {(a, b) for t in triangles.tolist() for a, b in zip(t, t[1:] + t[:1], strict=True)}
    border = [(a, b) for a, b in edges if (b, a) not in edges]
    after, ring = dict(border), [min(border)[0]] if border else []
    while ring and after.get(ring[-1], ring[0]) != ring[0] and len(ring) <= len(border):
        ring.append(after[ring[-1]])
    once = len(ring) == len(border) == len(after) == len(np.unique(triangles))
    return np.array(ring, np.int64) if ring and once else None


def tightest(charts: Charts) -> Charts:
    """The charts, each turned into its tightest rectangle, the long side along x, the lower left corner at the origin."""
    order = np.argsort(charts.chart, kind="stable")
    x, y = np.ascontiguousarray(charts.xy[order].reshape(-1, 2).T)
    start = 3 * np.searchsorted(charts.chart[order], np.arange(charts.count))
    best, turn = np.full(charts.count, np.inf), np.zeros(charts.count)
    for angle in np.linspace(0, np.pi / 2, ANGLES, endpoint=False):
        c, s = np.cos(angle), np.sin(angle)
        wide, high = _extent(x * c - y * s, start), _extent(x * s + y * c, start)
        space = (wide + 1e-9) * (high + 1e-9)
        better = space < best * (1 - 1e-6)
        best[better] = space[better]
        turn[better] = (angle + np.where(high > wide * (1 + 1e-6), np.pi / 2, 0))[better]
    charts = _turned(charts, turn)
    return Charts(charts.xy - charts.bounds()[0][charts.chart][:, None], charts.chart)


def _extent(values: np.ndarray, start: np.ndarray) -> np.ndarray:
    """(n,) differences between the largest and the smallest of the values from each `start` on."""
    return np.maximum.reduceat(values, start) - np.minimum.reduceat(values, start)


def worst_cosine(mean: np.ndarray, normal: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(n,) smallest cosine between the `mean` (n, 3) of a label and the normals of its triangles."""
    worst = np.ones(len(mean))
    np.minimum.at(worst, label, np.einsum("ij,ij->i", mean[label], normal))
    return worst


def _direction(mesh: Mesh, chart: np.ndarray) -> np.ndarray:
    """(n, 3) direction of projection of each chart: the mean normal, or the main axis where that leaves a face too steep."""
    vector = area_vectors(mesh.corners())
    polygon = numbered(mesh.polygon)
    normal = mean_normal(vector, polygon)[polygon]
    mean = mean_normal(normal * np.linalg.norm(vector, axis=1)[:, None], chart)
    largest = np.argmax(np.abs(mean), axis=1)
    row = np.arange(len(mean))
    main = np.zeros_like(mean)
    main[row, largest] = np.sign(mean[row, largest])
    return np.where((worst_cosine(mean, normal, chart) > STEEP)[:, None], mean, main)


def _plane(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) of x and y in the plane across `normal` (n, 3); x is as horizontal as can be."""
    # Charts are seen by users, so walls must stand upright: not `maps.frame`, whose x turns with the normal.
    x = np.cross(np.where(np.abs(normal[:, 2:]) > 0.9, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]), normal)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x, np.cross(normal, x)


def _turned(charts: Charts, angle: np.ndarray) -> Charts:
    """The charts, each turned about the origin by its `angle` (count,) in radians."""
    c, s = np.cos(angle)[charts.chart][:, None], np.sin(angle)[charts.chart][:, None]
    x, y = charts.xy[..., 0], charts.xy[..., 1]
    return Charts(np.stack([x * c - y * s, x * s + y * c], axis=2), charts.chart)
