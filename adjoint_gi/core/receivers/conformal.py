"""Charts by xatlas (J. Young, after I. Castano's Thekla Atlas): grown over smooth regions, laid flat by least-squares conformal maps.

B. Levy, S. Petitjean, N. Ray, J. Maillot, Least Squares Conformal Maps for Automatic Texture Atlas Generation, 2002. xatlas is given
what it can bear: finite coordinates about the origin, each smooth region on its own, and none that is too large; flat ones need no map
but a projection. What it answers is mended: polygons are put together again, lengths are measured anew, and a chart that is bent too far
is laid flat by projection.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xatlas

from ..base.steps import Steps, finish, within
from .atlas import generate
from .charts import Charts, Mesh, area_vectors, carry, islands, mean_normal, numbered, signed_areas, smooth_regions
from .projection import FLAT, opened, pieces, project, tightest, worst_cosine

NONE = np.uint32(0xFFFFFFFF)  # the chart of what xatlas left out
MAX_REGION_TRIANGLES = 5000  # triangles of a region that xatlas is given: its time grows with the square, 0.4 s here
EXTENT = 1e4  # largest extent of what xatlas sees: it ignores triangles of less than 1.2e-7 square units, which float32 cannot hold then
COARSE = 128  # texels a side of the packing xatlas does along with the charts of a region, which nothing comes of
WIDEST = 4096  # texels of a chart there: one that a bad map has drawn out must not become an image of that width
STRETCH = 3.0  # how much an edge may be longer or shorter in a chart than in space
LEAST = 1e-3  # share of the area that a triangle must keep in its chart


def make_charts(mesh: Mesh) -> Charts:
    """The charts of `mesh`, each with the area in UV space that its surface has."""
    return finish(making_charts(mesh))


def making_charts(mesh: Mesh) -> Steps[Charts]:
    """The same in steps."""
    region = smooth_regions(mesh)
    xy, chart = np.full((len(region), 3, 2), np.nan), np.full(len(region), -1, np.int64)
    flat = _flat(mesh, region)
    if flat.any():
        laid = project(mesh.part(flat), region[flat])
        xy[flat], chart[flat] = laid.xy, laid.chart
    yield 0.1
    yield from within(_grow(mesh, np.where(flat, -1, region), xy, chart), 0.1, 0.9)
    xy, chart = _whole_polygons(mesh, xy, chart)
    missing = ~np.isfinite(xy).all(axis=(1, 2))
    charts = _measured(mesh, Charts(np.where(missing[:, None, None], 0.0, xy), numbered(np.where(missing, -1, chart))))
    charts = _relaid(mesh, charts, missing, lambda part: project(part, pieces(part)))
    return cut_off(mesh, charts, np.flatnonzero(_bent(mesh, charts)))


def cut_off(mesh: Mesh, charts: Charts, triangles: np.ndarray) -> Charts:
    """The charts with those that hold `triangles` replaced by projections: of pieces, or of polygons where these were pieces already.

    A polygon that is a chart of its own is crossed or folded: it is laid out as a convex one. What does not hang together is a chart of
    its own.
    """
    bad = np.isin(charts.chart, charts.chart[triangles])
    single = bad & ~_several(numbered(mesh.polygon), charts.chart)[charts.chart]
    charts = _relaid(mesh, charts, single, opened)
    charts = _relaid(mesh, charts, bad & ~single, lambda part: project(part, _finer(part, numbered(charts.chart[bad & ~single]))))
    return Charts(charts.xy, islands(mesh, charts.xy, charts.chart))


def _relaid(mesh: Mesh, charts: Charts, which: np.ndarray, lay: Callable[[Mesh], Charts]) -> Charts:
    """The charts with the triangles `which` (nt,) bool laid flat by `lay`."""
    if not which.any():
        return charts
    flat = lay(mesh.part(which))
    xy, chart = charts.xy.copy(), charts.chart.copy()
    xy[which], chart[which] = flat.xy, charts.count + flat.chart
    return Charts(xy, numbered(chart))


def _finer(mesh: Mesh, chart: np.ndarray) -> np.ndarray:
    """(nt,) labels that cut every `chart` (nt,) of 0, 1, ...: into our own pieces where there are several, else into polygons."""
    piece, polygon = numbered(pieces(mesh)), numbered(mesh.polygon)
    both = numbered(piece * (int(chart.max()) + 1) + chart)
    return np.where(_several(piece, chart)[chart], both, both.max() + 1 + polygon)


def _several(label: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """(charts,) bool: charts whose triangles have more than one `label` (nt,)."""
    one = np.zeros(int(chart.max(initial=-1)) + 1, np.int64)
    one[chart] = label
    several = np.zeros(len(one), bool)
    several[chart[label != one[chart]]] = True
    return several


def _flat(mesh: Mesh, region: np.ndarray) -> np.ndarray:
    """(nt,) bool: triangles of a `region` (nt,) that a projection lays flat as well as any map."""
    normal = mean_normal(area_vectors(mesh.corners()), np.arange(len(region)))
    mean = mean_normal(area_vectors(mesh.corners()), region)
    return (worst_cosine(mean, normal, region) > FLAT)[region]


def _grow(mesh: Mesh, region: np.ndarray, xy: np.ndarray, chart: np.ndarray) -> Steps[None]:
    """Put flat corners in units of xatlas into `xy` (nt, 3, 2) and its charts into `chart` (nt,), for regions that are not -1.

    Triangles that xatlas leaves out or is not given stay as they are.
    """
    order = np.argsort(region, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(region[order])) + 1)
    parts = [part for part in parts if len(part) <= MAX_REGION_TRIANGLES and region[part[0]] >= 0]
    low, high = mesh.corners().min(axis=(0, 1)), mesh.corners().max(axis=(0, 1))
    scale = EXTENT / max(float((high - low).max()), 1e-300)
    place = ((mesh.vertices - 0.5 * (low + high)) * scale).astype(np.float32)
    count = int(chart.max(initial=-1)) + 1
    for number, part in enumerate(parts):
        xy[part], label = _grown(place, mesh.triangles[part])
        chart[part] = np.where(label >= 0, count + label, -1)
        count += int(label.max(initial=-1)) + 1
        yield (number + 1) / len(parts)


def _grown(place: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat corners (n, 3, 2) and charts (n,) int64 of one region of `triangles`; NaN and -1 for those that xatlas leaves out.

    Each region has an atlas of its own: while a second mesh is added, xatlas 0.0.11 moves the list from which its threads take the first.
    """
    atlas = xatlas.Atlas()
    used, index = np.unique(triangles, return_inverse=True)
    atlas.add_mesh(place[used], index.reshape(-1, 3).astype(np.uint32))
    area = float(np.linalg.norm(area_vectors(place[triangles].astype(np.float64)), axis=1).sum())
    options = xatlas.PackOptions()
    options.bilinear = False
    options.texels_per_unit = COARSE / max(area, 1.0) ** 0.5
    options.max_chart_size = WIDEST
    generate(atlas, options)
    _, corner, uv = atlas.get_mesh(0)
    label = atlas.get_mesh_vertex_assignment(0)[1][corner[:, 0]]
    known = label != NONE
    flat = uv[corner].astype(np.float64) * (atlas.width, atlas.height)
    return np.where(known[:, None, None], flat, np.nan), np.where(known, label.astype(np.int64), -1)


def _whole_polygons(mesh: Mesh, xy: np.ndarray, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same with each polygon in the chart of its largest triangle.

    A corner comes to where that chart has its vertex already, else to where the map of the largest triangle carries it; several
    polygons that carry a vertex into one chart meet in the mean.
    """
    known = np.isfinite(xy).all(axis=(1, 2))
    area = np.where(known, np.linalg.norm(area_vectors(mesh.corners()), axis=1), -1.0)
    polygon = numbered(mesh.polygon)
    order = np.argsort(area, kind="stable")
    largest = np.zeros(int(polygon.max()) + 1, np.int64)
    largest[polygon[order]] = order  # the last of equal indices stays
    base = largest[polygon]
    home = chart[base]
    moved = np.flatnonzero(known[base] & (~known | (chart != home)))
    if not len(moved):
        return xy, chart
    # Step 1: places of vertices in charts, as far as these have them; vertex and chart as one number.
    many = int(chart.max()) + 2
    have, at = np.unique(mesh.triangles[known].ravel() * many + chart[known].repeat(3), return_index=True)
    place = xy[known].reshape(-1, 2)[at]
    # Step 2: the others are carried there.
    want = mesh.triangles[moved] * many + home[moved][:, None]
    found = np.minimum(np.searchsorted(have, want), len(have) - 1)
    carried = carry(mesh.corners()[base[moved]], xy[base[moved]], mesh.corners()[moved])
    new, which = np.unique(want, return_inverse=True)
    which = which.reshape(-1)
    mean = np.stack([np.bincount(which, carried[..., k].ravel()) for k in range(2)], axis=1) / np.bincount(which)[:, None]
    xy, chart = xy.copy(), chart.copy()
    xy[moved] = np.where((have[found] == want)[..., None], place[found], mean[which].reshape(-1, 3, 2))
    chart[moved] = home[moved]
    return xy, chart


def _measured(mesh: Mesh, charts: Charts) -> Charts:
    """The charts in metres: x and y of each scaled so that its edges are as long as in space, then both to the area of its surface.

    xatlas has stretched x and y to whole texels. The squares of the scales solve a least-squares problem of two unknowns a chart.
    """
    corner, chart, n = mesh.corners(), charts.chart, charts.count
    edge = (np.roll(charts.xy, -1, axis=1) - charts.xy) ** 2
    length = ((np.roll(corner, -1, axis=1) - corner) ** 2).sum(axis=2)
    xx, yy, long = edge[..., 0], edge[..., 1], length
    a, b, c, p, q = (np.bincount(chart, s.sum(axis=1), n) for s in (xx * xx, xx * yy, yy * yy, xx * long, yy * long))
    det = a * c - b * b
    safe = np.where(det > 1e-6 * a * c, det, 1.0)
    square = np.stack([(p * c - q * b) / safe, (q * a - p * b) / safe], axis=1)
    total = np.bincount(chart, (xx + yy).sum(axis=1), n)
    even = np.bincount(chart, long.sum(axis=1), n) / np.where(total > 0, total, 1.0)
    usable = (det > 1e-6 * a * c) & (square > 0.04 * even[:, None]).all(axis=1)
    scale = np.sqrt(np.where(usable[:, None], square, even[:, None]))
    xy = charts.xy * scale[chart][:, None]
    surface = np.bincount(chart, np.linalg.norm(area_vectors(corner), axis=1), n)
    flat = np.bincount(chart, np.abs(signed_areas(xy)), n)
    usable = flat > LEAST * surface
    grown = np.sqrt(np.where(usable, surface / np.where(usable, flat, 1.0), 1.0))
    return tightest(Charts(xy * grown[chart][:, None, None], chart))


def _bent(mesh: Mesh, charts: Charts) -> np.ndarray:
    """(nt,) bool: triangles that are stretched, squeezed, or turned over against the rest of their chart."""
    corner = mesh.corners()
    length = np.linalg.norm(np.roll(corner, -1, axis=1) - corner, axis=2)
    flat = np.linalg.norm(np.roll(charts.xy, -1, axis=1) - charts.xy, axis=2)
    signed, area = signed_areas(charts.xy), np.linalg.norm(area_vectors(corner), axis=1)
    side = np.sign(np.bincount(charts.chart, signed, charts.count))[charts.chart]
    longest = np.maximum(length.max(axis=1), 1e-300)
    stretch = flat.max(axis=1) / longest
    return (signed * side < LEAST * area) | (stretch > STRETCH) | (stretch < 1 / STRETCH)
