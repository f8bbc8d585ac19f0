"""Light between surfaces that lie closer together than their elements are wide, which elements cannot resolve.

An element is one number: what it gets from a panel a centimetre away is spread over its whole width, and reflected from there. How much of
the light is in such places is found by a few rays from each element that sends any: its middle distance to what they meet, against its
width.
"""

from __future__ import annotations

import numpy as np

from ..base.errors import Notice
from ..scene.arrays import RayKind
from .elements import Elements
from .rays import ElementRays

RAYS = 8  # from each side
MOST_SIDES = 8000  # that send most
CLOSE = 0.5  # of an element's width
TOLD = 0.02  # share of the light that is worth a notice
NAMED = 3  # objects


def middle_distances(elements: Elements, sides: np.ndarray) -> np.ndarray:
    """(m,) median distance of what rays of `sides` (m,) meet, inf where most escape."""
    owner = np.repeat(sides, RAYS)
    origin, direction, _ = ElementRays(elements).start(owner, np.tile(np.arange(RAYS), len(sides)), owner)
    triangle, _, _, t = elements.world.intersect(origin, direction, RayKind.DIFFUSE)
    return np.median(np.where(triangle >= 0, t, np.float32(np.inf)).reshape(-1, RAYS), axis=1)


def close_light(elements: Elements, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the `flux` (2 ne,) that sides send, W, the part sent where surfaces are closer than elements are wide: (objects,) by the object
    that sends it, and the least distance (objects,) found there, inf where there is none."""
    sides = np.argsort(-flux, kind="stable")[:MOST_SIDES]
    sides = np.sort(sides[flux[sides] > 0])
    objects = len(elements.world.scene.objects)
    nearest = np.full(objects, np.inf)
    if not len(sides):
        return np.zeros(objects), nearest
    distance, width = middle_distances(elements, sides), np.sqrt(elements.area[sides >> 1])
    near = np.flatnonzero(distance < CLOSE * width)
    owner = elements.world.scene.object[elements.patch_triangle[elements.patch[sides[near] >> 1]]]
    for index in np.unique(owner):
        nearest[index] = distance[near[owner == index]].min()
    return np.bincount(owner, flux[sides[near]], objects), nearest


def notices(elements: Elements, flux: np.ndarray) -> tuple[Notice, ...]:
    """Says which objects send light to surfaces too close for their elements, where that is much of the light."""
    total = float(flux.sum())
    if total <= 0:
        return ()
    part, nearest = close_light(elements, flux)
    share = float(part.sum()) / total
    if share < TOLD:
        return ()
    objects = elements.world.scene.objects
    most = np.argsort(-part, kind="stable")[: int((part > 0).sum())]
    names = tuple(objects[i].name for i in most)
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    closest = float(nearest[most].min())
    reason = f"lights surfaces {closest:.2g} m away, closer than elements are wide: {share:.0%} of the light begins so, and is wrong there"
    remedy = f"Set Max Element Edge (max_edge) to {closest:.1g} m or less, or take Path Tracing, which has no elements"
    return (Notice(listed, reason, remedy, names=names),)
