"""Connected pieces: which triangles hang together in UV space, and the label propagation behind it."""

from __future__ import annotations

import numpy as np


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(count,) int64 labels 0, 1, ... of the connected components of a graph with edges a[k] - b[k], numbered by their first node.

    Every round hooks the larger root of each edge onto the smaller one, then shortens all paths, so the number of rounds is
    about logarithmic and no loop over nodes is needed.
    """
    root = np.arange(count, dtype=np.int64)
    a, b = np.asarray(a, np.int64), np.asarray(b, np.int64)
    while len(a):
        ra, rb = root[a], root[b]
        open_ = ra != rb
        if not open_.any():
            break
        a, b, ra, rb = a[open_], b[open_], ra[open_], rb[open_]
        root[np.maximum(ra, rb)] = np.minimum(ra, rb)
        while True:
            shorter = root[root]
            if np.array_equal(shorter, root):
                break
            root = shorter
    _, labels = np.unique(root, return_inverse=True)
    return labels.reshape(-1)


def edge_pairs(corner_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles (k,), (k,) that share an edge, where `corner_id` (nt, 3) int64 is equal for equal corners.

    An edge of three or more triangles gives a chain of pairs, which is all that connected components need.
    """
    n = len(corner_id)
    low = np.minimum(corner_id, np.roll(corner_id, -1, axis=1)).ravel()
    high = np.maximum(corner_id, np.roll(corner_id, -1, axis=1)).ravel()
    key = low * (int(corner_id.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    owner = np.repeat(np.arange(n), 3)[order]
    return owner[:-1][same], owner[1:][same]


def oriented_pieces(corner_id: np.ndarray) -> np.ndarray:
    """(nt,) int64 labels of pieces of surface over which the normals agree: triangles `corner_id` (nt, 3), as for `edge_pairs`, that share
    an edge with no third one and run along it in opposite directions."""
    start, end = corner_id.ravel(), np.roll(corner_id, -1, axis=1).ravel()
    key = np.minimum(start, end) * (int(corner_id.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, first, many = np.unique(key[order], return_index=True, return_counts=True)
    one, other = order[first[many == 2]], order[first[many == 2] + 1]
    agree = start[one] == end[other]
    return components(len(corner_id), one[agree] // 3, other[agree] // 3)


def weld(vertices: np.ndarray) -> np.ndarray:
    """(nv,) int64: equal for vertices (nv, 3) at exactly the same place, so that split vertices do not part a surface."""
    place = np.ascontiguousarray(np.asarray(vertices, np.float64) + 0.0).view(np.uint64)  # + 0 turns -0 into 0
    ids = np.zeros(len(place), np.int64)
    for k in range(3):
        _, column = np.unique(place[:, k], return_inverse=True)
        column = column.reshape(-1)
        _, ids = np.unique(ids * (int(column.max(initial=0)) + 1) + column, return_inverse=True)
        ids = ids.reshape(-1).astype(np.int64)
    return ids


def weld_near(vertices: np.ndarray, distance: float) -> np.ndarray:
    """(nv,) int64: equal for vertices (nv, 3) much closer than `distance`, such as corners of objects that were put beside one another.

    They share a cell of one of two grids, the second half a cell aside, but for one in some hundred that lie on borders of both.
    """
    cells = [weld(np.floor(vertices / distance + aside)) for aside in (0.0, 0.5)]
    ids = np.arange(len(vertices))
    for cell in (*cells, cells[0]):
        least = np.full(len(ids), len(ids))
        np.minimum.at(least, cell, ids)
        ids = least[cell]
    return ids


def uv_corner_ids(triangles: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(nt, 3) int64: equal for corners with the same vertex of `triangles` (nt, 3) and the same UV in `uv` (nt, 3, 2) float32."""
    bits = np.ascontiguousarray(uv + np.float32(0), np.float32).view(np.uint32).astype(np.uint64)  # + 0 turns -0 into 0
    _, place = np.unique((bits[..., 0] << np.uint64(32) | bits[..., 1]).ravel(), return_inverse=True)
    place = place.reshape(-1).astype(np.int64)
    key = np.asarray(triangles, np.int64).ravel() * (int(place.max(initial=0)) + 1) + place
    _, ids = np.unique(key, return_inverse=True)
    return ids.reshape(-1, 3).astype(np.int64)


def uv_charts(triangles: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(nt,) int64 chart of each triangle: triangles that share an edge both on the mesh and in UV space are of one chart.

    `triangles` (nt, 3) holds vertex indices, welded where split vertices shall not part a surface.
    """
    return components(len(triangles), *edge_pairs(uv_corner_ids(triangles, uv)))
