"""The normals that surfaces are shaded with: the one place where corner normals are interpolated."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import ONE, dot


def shading_normals(corners: np.ndarray, u: np.ndarray, v: np.ndarray, ng: np.ndarray, side: np.ndarray | None) -> np.ndarray:
    """(3, n) float32 unit normals at barycentrics u, v (n,) of triangles with corner normals (9, n), corner by corner.

    `ng` (3, n) are the geometric normals on the side that is seen; `side` (n,) is -1 where that is the back, None where it is nowhere.
    """
    ns = corners[0:3] * (ONE - u - v)
    ns += corners[3:6] * u
    ns += corners[6:9] * v
    if side is not None:
        ns *= side
    length = np.sqrt(dot(ns, ns))
    # Custom normals that cancel out or point into the surface are no use for shading: the face's own is taken.
    good = (length > np.float32(1e-6)) & (dot(ns, ng) > 0)
    ns /= np.maximum(length, np.float32(1e-6))
    return np.where(good, ns, ng)
