"""Packing rectangles into an image: shelves of falling height, at the largest common scale that fits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..base.errors import TargetError
from .texels import Placement

STEPS = 24  # of the search for the scale: 1 part in 16 million


def shelves(size: np.ndarray, width: int, height: int, gap: int) -> np.ndarray | None:
    """(n, 2) int64 lower left texel of rectangles `size` (n, 2) int64 with `gap` texels between them, None when they do not fit.

    The rectangles are taken by falling height; each shelf takes as many as its width holds.
    """
    if not len(size):
        return np.zeros((0, 2), np.int64)
    if size[:, 0].max() > width or size[:, 1].max() > height:
        return None
    order = np.lexsort((np.arange(len(size)), -size[:, 0], -size[:, 1]))
    wide = size[order, 0] + gap
    total = np.concatenate([[0], np.cumsum(wide)])
    place = np.empty((len(size), 2), np.int64)
    at, y = 0, 0
    while at < len(order):
        tall = size[order[at], 1]
        if y + tall > height:
            return None
        stop = int(np.searchsorted(total, total[at] + width + gap, side="right")) - 1
        place[order[at:stop], 0] = total[at:stop] - total[at]
        place[order[at:stop], 1] = y
        at, y = stop, y + tall + gap
    return place


def pack_charts(extent: np.ndarray, resolution: tuple[int, int], gap: int, least: int = 2) -> tuple[np.ndarray, np.ndarray, float]:
    """Lower left corner (n, 2) and size (n, 2) in texels, float64, for charts of `extent` (n, 2) metres, and the texels a metre.

    All charts have the same scale, except that none is smaller than `least` texels (1 where that does not fit), so that each one
    gets a texel. Charts start at whole texels; `gap` texels stay free between them. Raises TargetError when there are too many.
    """
    width, height = resolution
    border = min(gap // 2, (min(resolution) - 1) // 4)
    inner = width - 2 * border, height - 2 * border
    top = float(np.sqrt(inner[0] * inner[1] / max(float((extent[:, 0] * extent[:, 1]).sum()), 1e-30)))
    top = min(top, max(inner) / max(float(extent.max(initial=0)), 1e-30))
    for smallest in dict.fromkeys((least, 1)):
        best, low, high = None, 0.0, top
        for step in range(STEPS):
            scale = top if step == 0 else 0.5 * (low + high)
            exact = np.maximum(extent * scale, smallest)
            place = shelves(np.ceil(exact - 1e-6).astype(np.int64), *inner, gap)
            if place is None:
                high = scale
            else:
                best, low = (place + border, exact, scale), scale
                if step == 0:
                    break
        if best is not None:
            return best[0].astype(np.float64), best[1], best[2]
    raise TargetError(
        "Lightmap", f"{len(extent)} UV islands do not fit into {width} x {height} texels", "Raise the resolution or lower the padding"
    )


def place_objects(area: Mapping[int, float], resolution: tuple[int, int], gap: int) -> dict[int, Placement]:
    """Where the unit square of each object goes in a common image: squares with sides as the square root of the surface `area`.

    The UV layers stay as they are, so objects that share a mesh can stand in one atlas.
    """
    numbers = list(area)
    side = np.sqrt(np.maximum(np.array([area[i] for i in numbers], np.float64), 1e-12))
    place, size, _ = pack_charts(np.stack([side, side], axis=1), resolution, gap)
    size = np.floor(size + 1e-6)  # whole texels, so that texels of an object are texels of the atlas
    out = {}
    for k, number in enumerate(numbers):
        scale, offset = size[k] / resolution, place[k] / resolution
        out[number] = Placement((float(scale[0]), float(scale[1])), (float(offset[0]), float(offset[1])))
    return out
