"""Packing charts into an image at the largest common scale that fits: closely by their shapes, or as rectangles on shelves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xatlas

from ..base.errors import TargetError
from .atlas import generate
from .charts import Charts, carry, signed_areas
from .texels import Placement

STEPS = 24  # of the search for the scale of shelves: 1 part in 16 million
FULL = 0.65  # share of the image that charts are first thought to fill
GROWTH = 1.08  # step of the search upwards, until a scale does not fit
SMALL = 32  # texels of a chart: if they are smaller in the mean, little is gained over shelves and much time lost
CLOSE = 1.01  # step at which the search ends
AGAIN = 6  # such steps down when much the same charts are packed again
THIN = 1e-2  # texels that a chart is wide at least
FINE = 32.0  # units of xatlas in a texel: it ignores triangles of less than 1.2e-7 square units
NONE = np.uint32(0xFFFFFFFF)  # the chart of what xatlas left out


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


def pack_charts(
    extent: np.ndarray, resolution: tuple[int, int], gap: int, least: int = 2, most: float = np.inf
) -> tuple[np.ndarray, np.ndarray, float]:
    """Lower left corner (n, 2) and size (n, 2) in texels, float64, for charts of `extent` (n, 2) metres, and the texels a metre.

    All charts have the same scale, `most` at most, except that none is smaller than `least` texels (1 where that does not fit), so that
    each one gets a texel. Charts start at whole texels; `gap` texels stay free between them. Raises TargetError when there are too many.
    """
    width, height = resolution
    border = min(gap // 2, (min(resolution) - 1) // 4)
    inner = width - 2 * border, height - 2 * border
    top = float(np.sqrt(inner[0] * inner[1] / max(float((extent[:, 0] * extent[:, 1]).sum()), 1e-30)))
    top = min(top, max(inner) / max(float(extent.max(initial=0)), 1e-30), most)
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
    raise _too_many(len(extent), resolution)


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


def pack_on_shelves(charts: Charts, resolution: int, gap: int, most: float = np.inf) -> tuple[np.ndarray, float]:
    """UV (nt, 3, 2) float32 of `charts` packed as rectangles with `gap` texels between them, and the texels a metre, `most` at most.

    Raises TargetError when there are too many.
    """
    low, high = charts.bounds()
    extent = high - low
    place, size, scale = pack_charts(extent, (resolution, resolution), gap, most=most)
    stretch = np.where(extent > 1e-30, size / np.maximum(extent, 1e-30), 0.0)
    texel = (charts.xy - low[charts.chart][:, None]) * stretch[charts.chart][:, None] + place[charts.chart][:, None]
    return (texel / resolution).astype(np.float32), scale


def pack_tightly(charts: Charts, resolution: int, gap: int, most: float = np.inf) -> tuple[np.ndarray, float]:
    """UV (nt, 3, 2) float32 of `charts` packed by their shapes with `gap` texels or more between them, and the texels a metre.

    All charts are scaled alike, but for parts of a texel up to whole ones. xatlas takes a scale and fills as many images as that needs,
    so the largest scale that needs one image, `most` at most, is searched for, above that of shelves. Raises TargetError when there are
    too many charts.
    """
    best, fits = pack_on_shelves(charts, resolution, gap, most)
    if charts.count * SMALL > FULL * resolution**2:
        return best, fits
    low, high = charts.bounds()
    full = resolution / max(float(np.abs(signed_areas(charts.xy)).sum()), 1e-300) ** 0.5
    # Above the second of these xatlas would shrink the largest chart alone.
    limit, failed = min(full, (resolution - 1.5) / max(float((high - low).max()), 1e-300), most), np.inf
    scale = min(limit, max(FULL**0.5 * full, GROWTH * fits))
    while scale > CLOSE * fits:
        uv = _packed(charts, scale, resolution, gap)
        if uv is None:
            failed = scale
        else:
            best, fits = uv, scale
        scale = min(limit, GROWTH * fits) if np.isinf(failed) else (fits * failed) ** 0.5
    return best, fits


def pack_again(charts: Charts, resolution: int, gap: int, scale: float, most: float = np.inf) -> tuple[np.ndarray, float]:
    """The same for charts that are much like some that were packed at `scale` texels a metre: there, or a little below."""
    best, fits = pack_on_shelves(charts, resolution, gap, most)
    if fits * CLOSE > scale:
        return best, fits
    for step in range(AGAIN):
        uv = _packed(charts, scale / CLOSE**step, resolution, gap)
        if uv is not None:
            return uv, scale / CLOSE**step
    return pack_tightly(charts, resolution, gap, most)


def _packed(charts: Charts, scale: float, resolution: int, gap: int) -> np.ndarray | None:
    """UV (nt, 3, 2) float32 at `scale` texels a metre, None when one image does not hold them.

    Both of two neighbours are given half of the gap.
    """
    # Step 1: the charts side by side in units of xatlas, which takes corners at one place for one corner; none may be without width.
    low, high = charts.bounds()
    extent = high - low
    size = np.maximum(extent * scale, THIN)
    wide = int(2 * max(np.sqrt(np.prod(np.ceil(size), axis=1).sum()), size.max())) + 2
    place = shelves(np.ceil(size).astype(np.int64), wide, 1 << 40, 1)
    stretch = size / np.maximum(extent, 1e-300)
    xy = (charts.xy - low[charts.chart][:, None]) * stretch[charts.chart][:, None] + place[charts.chart][:, None]
    corner = (xy * FINE).astype(np.float32).reshape(-1, 2)

    # Step 2: one packing. A second UV mesh could be taken for the first, as xatlas tells them apart by their addresses.
    options = xatlas.PackOptions()
    options.bilinear, options.rotate_charts_to_axis = False, False
    options.padding, options.resolution, options.texels_per_unit = (gap + 1) // 2, resolution, 1 / FINE
    atlas = xatlas.Atlas()
    index = np.arange(len(corner), dtype=np.uint32).reshape(-1, 3)
    atlas.add_uv_mesh(corner, index, charts.chart.astype(np.uint32)[:, None])
    generate(atlas, options)
    if atlas.atlas_count != 1:
        return None

    # Step 3: corners as they were; triangles without an area there follow the largest one of their chart.
    source, index, uv = atlas.get_mesh(0)
    known = atlas.get_mesh_vertex_assignment(0)[1][index[:, 0]] != NONE
    out = np.zeros((len(corner), 2))
    out[source[index]] = uv[index]
    return _followed(charts, xy, out.reshape(-1, 3, 2), known)


def _followed(charts: Charts, xy: np.ndarray, uv: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """`uv` (nt, 3, 2) as float32, in which triangles that are not `known` (nt,) follow the largest known one of their chart, if any."""
    if not known.all():
        area = np.where(known, np.abs(signed_areas(xy)), -1.0)
        order = np.argsort(area, kind="stable")
        largest = np.zeros(charts.count, np.int64)
        largest[charts.chart[order]] = order  # the last of equal indices stays
        lost = np.flatnonzero(~known)
        base = largest[charts.chart[lost]]
        if not known[base].all():
            return None
        uv[lost] = carry(xy[base], uv[base], xy[lost])
    return np.clip(uv, 0.0, 1.0).astype(np.float32)


def _too_many(count: int, resolution: tuple[int, int]) -> TargetError:
    reason = f"{count} UV islands do not fit into {resolution[0]} x {resolution[1]} texels"
    return TargetError("Lightmap", reason, "Raise the resolution or lower the padding")
