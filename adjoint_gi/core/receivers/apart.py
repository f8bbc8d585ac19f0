"""Bodies apart from one another: layers of those whose boxes do not meet, so that no ray from within one meets another first."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from ..scene.world import World

LAYERS = 64  # at most, one bit each
APART = 4096  # bodies that are told apart, the largest; the others share one layer
CELLS = 64  # along each axis of the grid that says which layers are near


class BodyLayer:
    """Some triangles of a world alone."""

    def __init__(self, world: World, triangles: np.ndarray) -> None:
        """`triangles` (m,) indices, at least one."""
        used, corner = np.unique(world.scene.triangles[triangles], return_inverse=True)
        points = np.asarray(world.scene.vertices, np.float64)[used] - world.center
        self._index, self._embree = np.asarray(triangles, np.int32), EmbreeScene()
        TriangleMesh(self._embree, points.astype(np.float32), corner.reshape(-1, 3).astype(np.int32))
        # The first query commits the scene, which must not happen in two threads at once.
        self._embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `World.intersect`, whatever the kind of the rays."""
        hit = self._embree.run(np.ascontiguousarray(origin), np.ascontiguousarray(direction), output=1)
        which = hit["primID"]
        return np.where(which >= 0, self._index[which], np.int32(-1)), hit["u"], hit["v"], hit["tfar"]


def spread(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(k,) int64 a layer for each of the boxes `low`, `high` (k, 3), such that those of one layer do not meet: the first that is free,
    the larger boxes first."""
    layer = np.full(len(low), LAYERS - 1)
    order = np.argsort(-np.prod(high - low, axis=1), kind="stable")[:APART]
    low, high, given = low[order], high[order], layer[order]
    for k in range(len(order)):
        meets = ((low[:k] <= high[k]) & (high[:k] >= low[k])).all(axis=1)
        taken = np.zeros(LAYERS, bool)
        taken[given[:k][meets]] = True
        given[k] = min(int(np.argmin(taken)), LAYERS - 1)
    layer[order] = given
    return layer


class BodyGrid:
    """Which layers have a box near a point."""

    def __init__(self, low: np.ndarray, high: np.ndarray, layer: np.ndarray) -> None:
        """Boxes `low`, `high` (k, 3) of `layer` (k,), at least one."""
        size = 1.01 * np.ptp(np.concatenate([low, high]), axis=0)
        self._low, self._scale = low.min(axis=0) - 0.004 * size, CELLS / np.maximum(size, 1e-30)
        # The outermost cells are for what lies outside, and remain empty.
        self._bits = np.zeros((CELLS + 2,) * 3, np.uint64)
        first, last = self._cell(low), self._cell(high)
        for (x, y, z), (xx, yy, zz), k in zip(first, last, layer, strict=True):
            self._bits[x : xx + 1, y : yy + 1, z : zz + 1] |= np.uint64(1 << int(k))

    def _cell(self, point: np.ndarray) -> np.ndarray:
        return (np.floor((point - self._low) * self._scale).clip(-1, CELLS) + 1).astype(np.int64)

    def near(self, point: np.ndarray) -> np.ndarray:
        """(n,) uint64, bit k where a box of layer k may hold `point` (n, 3)."""
        return self._bits[tuple(self._cell(point).T)]
