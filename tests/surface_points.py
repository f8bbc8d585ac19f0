"""Receivers at chosen points of surfaces, for tests that compare single values with closed forms."""

from __future__ import annotations

import numpy as np
from adjgi.adjoint_gi.core.receivers.base import SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import RayKind
from adjgi.adjoint_gi.core.scene.world import World


def receivers_at(world: World, points, normal=(0, 0, 1), copies=1) -> SurfaceReceivers:
    """Receivers of one point each: where rays from just above `points` (n, 3) against `normal` meet the scene; each `copies` times."""
    normal = np.asarray(normal, float)
    start = np.asarray(points, float).reshape(-1, 3) + 1e-3 * normal - world.center
    direction = np.tile(-normal, (len(start), 1))
    triangle, u, v, t = world.intersect(start.astype(np.float32), direction.astype(np.float32), RayKind.CAMERA)
    assert (t < 2e-3).all(), "there is no surface at some of the points"
    return SurfaceReceivers("texels", np.arange(len(start) * copies + 1), *(np.repeat(a, copies) for a in (triangle, u, v)))
