"""What float32 can hold: where a scene's origin lies best, and how far rays start off triangles so as not to meet them again.

Source: the bounds of Waechter and Binder, "A Fast and Robust Method for Avoiding Self-Intersection" (Ray Tracing Gems, chapter 6), and of
Higham, "Accuracy and Stability of Numerical Algorithms" (section 3.1), summed for each triangle instead of each hit.
"""

from __future__ import annotations

import numpy as np

STEP = 2.0**-23  # relative distance of float32 numbers
STEPS_OFF = 4.0  # rounding errors along the normal that a clearance covers; with one, rays meet their own triangle
LEAST_CLEARANCE = 2.0**-26  # of a triangle's longest edge, where its plane is exact
MOST_CLEARANCE = 1e-3  # of a triangle's longest edge: slivers have no normal to speak of
NEAR = 10.0  # times the middle distance from the middle: what lies within counts for the origin
HUGE = 100.0  # times the middle distance: longer triangles do not count, as a horizon has no middle


def near_box(corners: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) float64 of the box around most objects: triangles with `corners` (nt, 3, 3) of objects `owner` (nt,).

    Every object counts once, however finely it is cut. What lies far from most of them, a backdrop or one lost object, is left out: an
    origin far from the rest would cost the rest its digits, and lengths that follow the scene's would not fit it.
    """
    if not len(corners):
        return np.zeros(3), np.zeros(3)
    weight = 1.0 / np.bincount(owner)[owner]
    at = corners.mean(axis=1)
    middle = np.array([_median(x, weight) for x in at.T])
    distance = np.linalg.norm(at - middle, axis=1)
    length = np.linalg.norm(corners.max(axis=1) - corners.min(axis=1), axis=1)
    scale = _median(np.maximum(distance, 0.5 * length), weight)
    near = corners[(distance <= NEAR * scale + length) & (length <= HUGE * scale)]
    kept = near if len(near) else corners
    return kept.min(axis=(0, 1)), kept.max(axis=(0, 1))


def _median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def clearance(v0: np.ndarray, e1: np.ndarray, e2: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(nt,) float32 metres along its normal that a ray must start off each triangle, so as not to meet it again.

    v0, e1, e2, normal (nt, 3) float64: first corner, edges from there, unit normal. Rounding moves a point v0 + u e1 + v e2 off its plane
    by what it does to the coordinates along the normal, so an axis-aligned floor needs next to nothing however large it is. The other
    part is what Embree's own normal, a cross product in float32, is off by: it matters on slivers.
    """
    a, b = np.abs(e1), np.abs(e2)
    longest = np.sqrt(np.maximum((e1 * e1).sum(axis=1), (e2 * e2).sum(axis=1)))
    moved = (np.abs(normal) * (np.abs(v0) + a + b)).sum(axis=1)
    cross = np.roll(a, -1, axis=1) * np.roll(b, 1, axis=1) + np.roll(a, 1, axis=1) * np.roll(b, -1, axis=1)
    area = np.linalg.norm(np.cross(e1, e2), axis=1)
    turned = (np.maximum(a, b) * cross).sum(axis=1) / np.maximum(area, 1e-300)
    off = STEPS_OFF * STEP * moved + np.minimum(STEP * turned, MOST_CLEARANCE * longest)
    return np.maximum(off, LEAST_CLEARANCE * longest).astype(np.float32)
