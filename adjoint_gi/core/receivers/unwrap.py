"""Unwrapping for lightmaps: a mesh is cut into pieces that face one way, each is laid flat, and all are packed without overlap.

Distances on a flat piece are kept, on a curved one shortened by at most the cosine of the angle between a face and the direction of
projection. The result depends on the arrays alone: the same mesh gives the same UVs in every version.
"""

from __future__ import annotations

import numpy as np

from ..scene.arrays import Material, ObjectArrays, SceneArrays
from ..scene.topology import components, edge_pairs, weld
from ..scene.world import World
from .pack import pack_charts
from .texels import rasterize

CREASE = np.cos(np.radians(60))  # a sharper edge parts charts, so that light does not bleed around it
FLAT = np.cos(np.radians(3))  # how far faces of one flat piece may turn from its mean
STEEP = 0.5  # cosine: a face that turns further from the direction of projection is projected along the main axis instead
CHECKED = 2048  # texels a side at which pieces that lie over themselves are looked for
ANGLES = 24  # directions in which the tightest rectangle around a chart is sought


def unwrap(
    vertices: np.ndarray, triangles: np.ndarray, polygon: np.ndarray, resolution: tuple[int, int], padding: int
) -> tuple[np.ndarray, int]:
    """(nt, 3, 2) float32 UV coordinates for `triangles` (nt, 3) of `vertices` (nv, 3) and the number of charts.

    Triangles of one `polygon` (nt,) stay together. `padding` texels of an image of `resolution` stay free between charts. Raises
    TargetError when there are more charts than fit.
    """
    vertices = np.asarray(vertices, np.float64)
    pieces, normal, area = _pieces(vertices, np.asarray(triangles), np.asarray(polygon))
    for attempt in range(3):
        uv, chart = _lay_out(vertices, triangles, pieces, normal, area, resolution, padding)
        clashing = _clashing(vertices, triangles, uv, resolution) if attempt < 2 else np.zeros(0, int)
        if not len(clashing):
            break
        # A piece that lies over itself (a spiral stair, say) is cut: into its polygons.
        broken = np.isin(chart, np.unique(chart[clashing]))
        _, single = np.unique(polygon, return_inverse=True)
        pieces = np.where(broken, pieces.max() + 1 + single.reshape(-1), pieces)
    return uv, int(chart.max(initial=-1)) + 1


def _pieces(vertices: np.ndarray, triangles: np.ndarray, polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chart label (nt,) of each triangle, its polygon's unit normal (nt, 3), and its own area (nt,)."""
    p = vertices[triangles]
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    _, poly = np.unique(polygon, return_inverse=True)
    poly = poly.reshape(-1)
    normal = _mean_normal(cross, poly)[poly]

    # Step 1: flat pieces, as far as they stay flat: their faces get one direction together, so rounding cannot part them.
    a, b = edge_pairs(weld(vertices)[triangles])
    within = poly[a] == poly[b]
    turn = np.einsum("ij,ij->i", normal[a], normal[b])
    flat = components(len(triangles), *_joined(poly, a[within | (turn > FLAT)], b[within | (turn > FLAT)]))
    mean = _mean_normal(cross, flat)
    worst = np.ones(len(mean))
    np.minimum.at(worst, flat, np.einsum("ij,ij->i", mean[flat], normal))
    direction = np.where((worst > FLAT)[flat][:, None], mean[flat], normal)

    # Step 2: the main axis each face looks along; neighbours with the same one and no crease between them make a chart.
    rounded = np.round(direction, 5)
    axis = np.argmax(np.concatenate([rounded, -rounded], axis=1), axis=1)
    same = within | ((axis[a] == axis[b]) & (turn > CREASE))
    return components(len(triangles), *_joined(poly, a[same], b[same])), normal, area


def _joined(poly: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs a - b, and pairs that tie the triangles of each polygon together."""
    order = np.argsort(poly, kind="stable")
    same = poly[order][1:] == poly[order][:-1]
    return np.concatenate([a, order[:-1][same]]), np.concatenate([b, order[1:][same]])


def _mean_normal(cross: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(n, 3) unit sum of area vectors for each label; z where they cancel out."""
    total = np.stack([np.bincount(label, cross[:, k]) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-20, total / np.maximum(length, 1e-20), [0.0, 0.0, 1.0])


def _lay_out(
    vertices: np.ndarray,
    triangles: np.ndarray,
    pieces: np.ndarray,
    normal: np.ndarray,
    area: np.ndarray,
    resolution: tuple[int, int],
    padding: int,
) -> tuple[np.ndarray, np.ndarray]:
    """UV (nt, 3, 2) float32 and chart (nt,) 0, 1, ... of all pieces, projected, turned and packed."""
    _, chart = np.unique(pieces, return_inverse=True)
    chart = chart.reshape(-1)
    # Step 1: the direction of projection: the mean normal, or the main axis where that leaves a face too steep.
    mean = _mean_normal(normal * area[:, None], chart)
    worst = np.ones(len(mean))
    np.minimum.at(worst, chart, np.einsum("ij,ij->i", mean[chart], normal))
    main = np.zeros_like(mean)
    largest = np.argmax(np.abs(mean), axis=1)
    main[np.arange(len(mean)), largest] = np.sign(mean[np.arange(len(mean)), largest])
    mean = np.where((worst > STEEP)[:, None], mean, main)

    # Step 2: flat coordinates in metres, about a local origin; x is as horizontal as can be.
    side = np.cross(np.where(np.abs(mean[:, 2:]) > 0.9, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]), mean)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(mean, side)
    corner = vertices[triangles]
    xy = np.stack([np.einsum("tij,tj->ti", corner, side[chart]), np.einsum("tij,tj->ti", corner, up[chart])], axis=2)

    # Step 3: turn every chart into its tightest rectangle, with the long side along x.
    best = np.full(len(mean), np.inf)
    turn = np.zeros(len(mean))
    for angle in np.linspace(0, np.pi / 2, ANGLES, endpoint=False):
        low, high = _bounds(_rotate(xy, np.full(len(mean), angle), chart), chart, len(mean))
        space = np.prod(high - low + 1e-9, axis=1)
        better = space < best * (1 - 1e-6)
        best[better], turn[better] = space[better], angle
    low, high = _bounds(_rotate(xy, turn, chart), chart, len(mean))
    upright = (high - low)[:, 1] > (high - low)[:, 0] * (1 + 1e-6)
    xy = _rotate(xy, turn + np.where(upright, np.pi / 2, 0), chart)
    low, high = _bounds(xy, chart, len(mean))

    # Step 4: pack, and put every corner where its chart went.
    extent = high - low
    place, size, _ = pack_charts(extent, resolution, padding)
    stretch = size / np.maximum(extent, 1e-30)
    texel = (xy - low[chart][:, None]) * np.where(extent > 1e-30, stretch, 0.0)[chart][:, None] + place[chart][:, None]
    return (texel / resolution).astype(np.float32), chart


def _rotate(xy: np.ndarray, angle: np.ndarray, chart: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle)[chart][:, None], np.sin(angle)[chart][:, None]
    return np.stack([xy[..., 0] * c - xy[..., 1] * s, xy[..., 0] * s + xy[..., 1] * c], axis=2)


def _bounds(xy: np.ndarray, chart: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x and y (count, 2) of every chart."""
    order = np.argsort(chart, kind="stable")
    start = np.searchsorted(chart[order], np.arange(count))
    return np.minimum.reduceat(xy.min(axis=1)[order], start), np.maximum.reduceat(xy.max(axis=1)[order], start)


def _clashing(vertices: np.ndarray, triangles: np.ndarray, uv: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """Triangles that lie over others at different places of the mesh, found by rasterizing once."""
    resolution = (min(resolution[0], CHECKED), min(resolution[1], CHECKED))
    n = len(triangles)
    none = np.zeros(n, np.int32)
    obj = ObjectArrays("mesh", "mesh", triangle_count=n, vertex_count=len(vertices), uvs={"uv": uv}, render_uv="uv")
    normals = np.zeros((n, 3, 3), np.float32)
    scene = SceneArrays(
        vertices, np.asarray(triangles, np.int32), normals, none.astype(bool), none, none, none, none, (Material("none"),), (obj,)
    )
    return rasterize(World(scene), [0], "uv", resolution, 4).clashing
