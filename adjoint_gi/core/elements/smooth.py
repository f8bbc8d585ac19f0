"""Smooth answers from constant elements: values at the grid vertices, then bilinear or barycentric interpolation."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..scene.world import World

SAME_NORMAL = float(np.cos(np.radians(1.0)))  # nodes whose shading normals differ by more are a hard edge
SAME_PLACE = 2e-6  # relative to the extent of the world


class GriddedElements(Protocol):
    """What is read of `elements.Elements`: patches with their frames, and where each element lies in the grid of its patch."""

    world: World
    count: int
    patch: np.ndarray
    i: np.ndarray
    j: np.ndarray
    upper: np.ndarray
    is_quad: np.ndarray
    area: np.ndarray
    outside: np.ndarray
    quad: np.ndarray
    n: np.ndarray
    m: np.ndarray
    origin: np.ndarray
    edge_s: np.ndarray
    edge_t: np.ndarray
    patch_triangle: np.ndarray
    patch_second: np.ndarray
    _to_uv: np.ndarray


class Nodes:
    """Grid vertices of all patches. Patches share a node where its position and its shading normal agree.

    count         number of nodes; each has a value on the front and one on the back
    of_element    (ne, 4) int32 nodes of every element: local (0, 0), along a, along b, far corner; a triangle repeats its third
    position      (count, 3) float64, recentred
    weight        (ne, 4) float64 of an element's value at each of its nodes
    """

    def __init__(self, elements: GriddedElements) -> None:
        self.elements = elements
        local, first = self._grid()
        e = elements
        p, k = e.patch, e.n[e.patch]
        i, j = e.i.astype(np.int64), e.j.astype(np.int64)

        def node(di: np.ndarray | int, dj: np.ndarray | int) -> np.ndarray:
            a, b = i + di, j + dj
            return first[p] + np.where(e.is_quad, b * (k + 1) + a, b * (2 * k + 3 - b) // 2 + a)

        up = e.upper.astype(np.int64)
        # Order: the corner at local (0, 0), then along a, along b, and the far corner of a quad.
        nodes = np.stack([node(up, up), node(1 - up, up), node(up, 1 - up)], axis=1)
        far = np.where(e.is_quad, node(1, 1), nodes[:, 2])
        shared = self._shared(*local)
        self.of_element = shared[np.column_stack([nodes, far])].astype(np.int32)
        self.count = int(self.of_element.max(initial=-1)) + 1
        self.position = np.empty((self.count, 3))
        self.position[shared] = local[0]
        self.weight = np.repeat(e.area[:, None], 4, axis=1)
        self.weight[:, 3] *= e.is_quad

    def _grid(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Position and shading normal (n, 3) of every patch's own nodes, and each patch's first node."""
        e = self.elements
        per = np.where(e.quad, (e.n + 1) * (e.m + 1), (e.n + 1) * (e.n + 2) // 2)
        first = np.cumsum(per) - per
        patch = np.repeat(np.arange(len(per)), per)
        local = np.arange(int(per.sum())) - first[patch]
        n, quad = e.n[patch], e.quad[patch]
        # Rows of a triangle's nodes shrink by one; counted from the last node they are triangular numbers.
        from_end = np.where(quad, 0, per[patch] - 1 - local)
        row = np.floor((np.sqrt(8.0 * from_end + 1) - 1) / 2 + 1e-9).astype(np.int64)
        j = np.where(quad, local // (n + 1), n - row)
        i = np.where(quad, local % (n + 1), local - j * (2 * n + 3 - j) // 2)
        s, t = i / n, j / e.m[patch]
        position = e.origin[patch] + s[:, None] * e.edge_s[patch] + t[:, None] * e.edge_t[patch]
        triangle = np.where(quad & (s + t > 1), e.patch_second[patch], e.patch_triangle[patch])
        m = e._to_uv[triangle]
        ds, dt = s - m[:, 4], t - m[:, 5]
        u, v = m[:, 0] * ds + m[:, 1] * dt, m[:, 2] * ds + m[:, 3] * dt
        normal = e.world.surface(triangle, u.astype(np.float32), v.astype(np.float32)).ns
        return (position, np.asarray(normal, np.float64)), first

    def _shared(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n,) int64 shared number of every node."""
        if not len(position):
            return np.zeros(0, np.int64)
        # The odd shift keeps round coordinates away from the rounding limit.
        cell = np.round(position / (SAME_PLACE * self.elements.world.extent) + 0.3719).astype(np.int64)
        _, place = np.unique(cell, axis=0, return_inverse=True)
        place = place.reshape(-1)
        shared = np.full(len(place), -1, np.int64)
        left, count = np.arange(len(place)), 0
        while len(left):
            # The first node left at every place gathers all that point its way; the rest wait for the next round.
            _, leader, group = np.unique(place[left], return_index=True, return_inverse=True)
            group = group.reshape(-1)
            same = np.einsum("ij,ij->i", normal[left], normal[left[leader]][group]) >= SAME_NORMAL
            same[leader] = True
            shared[left[same]] = count + group[same]
            count += len(leader)
            left = left[~same]
        return shared

    def values(self, values: np.ndarray) -> np.ndarray:
        """(2 count, c) float32 node values: area-weighted means of the adjacent element sides' `values` (2 ne, c), of fronts over the
        area that no body stands on, since nothing arrives below."""
        e = self.elements
        flat = self.of_element.ravel()
        out = np.empty((self.count, 2, values.shape[1]), np.float32)
        by_side = values.reshape(e.count, 2, values.shape[1])
        for side, outside in enumerate((e.outside[:, None], np.ones((e.count, 1)))):
            total = np.maximum(np.bincount(flat, (self.weight * outside).ravel(), self.count), 1e-300)
            weight = self.weight * (outside > 0)
            for c in range(values.shape[1]):
                product = weight * by_side[:, side, c, None]
                out[:, side, c] = np.bincount(flat, product.ravel(), self.count) / total
        return out.reshape(2 * self.count, values.shape[1])

    def at(self, node_values: np.ndarray, side: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(n, c) float32 values at local coordinates a, b of element sides, from `values`."""
        element = side >> 1
        index = 2 * self.of_element[element].astype(np.int64) + (side & 1)[:, None]
        quad = self.elements.is_quad[element]
        ab = np.where(quad, a * b, np.float32(0))
        out = node_values[index[:, 0]] * (1 - a - b + ab)[:, None]
        out += node_values[index[:, 1]] * (a - ab)[:, None]
        out += node_values[index[:, 2]] * (b - ab)[:, None]
        out += node_values[index[:, 3]] * ab[:, None]
        return out
