"""From UV coordinates to texels: which surface points each texel of a lightmap stands for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import MemoryRefused, Notice, TargetError
from ..sampling.additive import STEPS, additive
from ..scene.topology import uv_charts, weld
from ..scene.world import World
from .base import SurfaceReceivers

TEXELS_PER_CHUNK = 1 << 20  # candidate texels looked at in one go
LARGEST = 16384  # texels a side
MEMORY_LIMIT = 16 << 30  # bytes
INSIDE = 1e-5  # barycentric distance that points keep from the edges: a ray must not start inside the wall at the end of a floor
STRICT = 1e-3  # barycentric distance from the edges at which a point counts as inside two triangles at once


@dataclass(frozen=True)
class Placement:
    """Where the unit square of an object's UV layer goes in the image: uv * scale + offset."""

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Lightmap:
    """The texels of one image, row 0 at the bottom.

    receivers   one receiver for each covered texel, ordered by row and column; its first point is the texel's centre if that is inside
    pixel       (n,) int64, row * width + column of each receiver
    covered     (h, w) bool, true where a texel has a receiver
    share       (h, w) float32, share of a texel's sub-samples that lie on a surface
    chart       (h, w) int32, chart of the texel's first point, -1 outside of all charts
    charts      number of charts (connected UV islands) of all objects
    overlapping number of texels claimed by two triangles at different places of the scene
    clashing    (k,) int32 world triangles that take part in this
    tiny_charts number of charts that own fewer than two texels
    outside     number of triangles that reach out of the image
    unusable    number of triangles whose UV coordinates are not numbers
    no_area     number of triangles that have no area in UV space
    warnings    the same as sentences that name the objects
    """

    receivers: SurfaceReceivers
    pixel: np.ndarray
    covered: np.ndarray
    share: np.ndarray
    chart: np.ndarray
    charts: int
    overlapping: int
    clashing: np.ndarray
    tiny_charts: int
    outside: int
    unusable: int
    no_area: int
    warnings: tuple[Notice, ...]

    @property
    def height(self) -> int:
        """Rows of the image."""
        return self.covered.shape[0]

    @property
    def width(self) -> int:
        """Columns of the image."""
        return self.covered.shape[1]

    def image(self, values: np.ndarray) -> np.ndarray:
        """(h, w, c) float32 image of one value for each receiver, `values` (n, c); 0 where no texel is covered."""
        values = np.asarray(values, np.float32).reshape(self.receivers.count, -1)
        out = np.zeros((self.height * self.width, values.shape[1]), np.float32)
        out[self.pixel] = values
        return out.reshape(self.height, self.width, -1)


def memory(width: int, height: int, subsamples: int) -> int:
    """Bytes `rasterize` needs at most: dense points while it works, their compact copy, and one chunk of candidates."""
    return width * height * (25 * subsamples + 60) + TEXELS_PER_CHUNK * 300


def sample_offsets(subsamples: int) -> np.ndarray:
    """(n, 2) float64 places inside a texel: the centre, then an additive sequence, which fills it evenly."""
    return np.ascontiguousarray(additive(np.arange(subsamples), STEPS[2], 0.5).T)


def rasterize(
    world: World,
    objects: Sequence[int],
    uv_layer: str | Mapping[int, str] = "",
    resolution: int | tuple[int, int] = 512,
    subsamples: int = 4,
    placement: Mapping[int, Placement] | None = None,
    memory_limit: int = MEMORY_LIMIT,
) -> Lightmap:
    """Find the surface points of every texel of an image shared by `objects` (indices into `world.scene.objects`).

    `uv_layer` is one name for all, or one for each object; "" is the layer used for rendering. `resolution` is (width, height).
    A texel is covered if any of its `subsamples` places lies inside a triangle; a place that two triangles claim goes to the one
    with the lower index. Raises TargetError for a missing layer or when no texel is covered, MemoryRefused above `memory_limit`.
    """
    width, height = (resolution, resolution) if isinstance(resolution, int) else resolution
    if not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
        raise TargetError("Lightmap", f"{width} x {height} texels are not possible", f"Choose 1 to {LARGEST}")
    if subsamples < 1:
        raise TargetError("Lightmap", f"{subsamples} sub-samples are not possible", "Choose at least 1")
    need = memory(width, height, subsamples)
    if need > memory_limit:
        sizes = f"{need / 2**30:.1f} GiB, allowed are {memory_limit / 2**30:.1f} GiB"
        reason = f"{width} x {height} texels with {subsamples} sub-samples need {sizes}"
        raise MemoryRefused("Lightmap", reason, "Lower the resolution or the sub-samples")

    # Step 1: one list of UV triangles, in units of texels.
    triangle, uv, chart, charts = _gather(world, objects, uv_layer, placement or {})
    xy = uv.astype(np.float64) * (width, height)
    usable = np.isfinite(xy).all(axis=(1, 2)) & (np.abs(np.nan_to_num(xy)) < 2**40).all(axis=(1, 2))
    xy[~usable] = 0.0
    inside = (xy >= -1e-3).all(axis=(1, 2)) & (xy <= np.array([width, height]) + 1e-3).all(axis=(1, 2))
    e1, e2 = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    doubled = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    has_area = np.abs(doubled) > 1e-9 * np.maximum((e1**2).sum(1), (e2**2).sum(1)) + 1e-15

    # Step 2: test the places of every candidate texel; `claim` holds 1 + position in the list, 0 is free.
    offsets = sample_offsets(subsamples)
    texels = width * height
    claim = np.zeros(texels * subsamples, np.int32)
    u = np.zeros(texels * subsamples, np.float32)
    v = np.zeros(texels * subsamples, np.float32)
    overlapping = np.zeros(texels, bool)
    clash: list[np.ndarray] = []
    work = np.flatnonzero(usable & has_area)
    # Barycentrics are a = px * ax + py * ay and b = px * bx + py * by, with (px, py) from the triangle's first corner.
    safe = np.where(has_area, doubled, 1.0)
    slope = np.stack([e2[:, 1] / safe, -e2[:, 0] / safe, -e1[:, 1] / safe, e1[:, 0] / safe])
    for which, row, column in _candidates(xy, work, width, height):
        px, py = column - xy[which, 0, 0], row - xy[which, 0, 1]
        ax, ay, bx, by = slope[:, which]
        base_a, base_b = px * ax + py * ay, px * bx + py * by
        for k, (dx, dy) in enumerate(offsets):
            a, b = base_a + (dx * ax + dy * ay), base_b + (dx * bx + dy * by)
            hit = np.flatnonzero((a >= -1e-9) & (b >= -1e-9) & (a + b <= 1 + 1e-9))
            if not len(hit):
                continue
            place = (row[hit] * width + column[hit]) * subsamples + k
            mine, a, b = which[hit] + 1, a[hit], b[hit]
            # Assigned backwards, because of several equal indices numpy keeps the last: the lowest triangle stays.
            free = np.flatnonzero(claim[place] == 0)[::-1]
            claim[place[free]] = mine[free]
            own = claim[place] == mine
            u[place[own]], v[place[own]] = _kept_inside(a[own], b[own])
            lost = np.flatnonzero(~own & (np.minimum(np.minimum(a, b), 1 - a - b) > STRICT))
            if len(lost):
                at = place[lost]
                differ = _elsewhere(world, triangle, claim[at] - 1, u[at], v[at], mine[lost] - 1, a[lost], b[lost])
                overlapping[at[differ] // subsamples] = True
                clash.append(np.unique(np.concatenate([mine[lost[differ]] - 1, claim[at[differ]] - 1])))

    # Step 3: keep the places that are claimed, in the order of texels.
    filled = claim > 0
    many = filled.reshape(texels, subsamples).sum(axis=1, dtype=np.uint32)
    pixel = np.flatnonzero(many)
    if not len(pixel):
        names = ", ".join(world.scene.objects[i].name for i in objects)
        raise TargetError(names, "no texel of the lightmap lies on the surface", "Unwrap into the unit square, or raise the resolution")
    start = np.concatenate([[0], np.cumsum(many[pixel], dtype=np.int64)])
    item = claim[filled]
    del claim
    item -= 1
    u = u[filled]
    v = v[filled]
    del filled
    chart_map = np.full(texels, -1, np.int32)
    chart_map[pixel] = chart[item[start[:-1]]]
    receivers = SurfaceReceivers("texels", start, triangle[item], u, v)

    owned = np.bincount(chart_map[pixel], minlength=charts)
    tiny = owned < 2
    owner = world.scene.object[triangle] if len(triangle) else triangle
    problems = {
        "overlap": np.unique(np.concatenate(clash)) if clash else np.zeros(0, int),
        "outside": np.flatnonzero(~inside & usable),
        "unusable": np.flatnonzero(~usable),
        "no_area": np.flatnonzero(usable & ~has_area),
        "tiny": np.flatnonzero(tiny[chart] & usable & has_area),
    }
    counts = {
        "overlap": int(overlapping.sum()),
        "tiny": len(np.unique(chart[problems["tiny"]])),
        **{k: len(problems[k]) for k in ("outside", "unusable", "no_area")},
    }
    return Lightmap(
        receivers=receivers,
        pixel=pixel,
        covered=(chart_map >= 0).reshape(height, width),
        share=(many / np.float32(subsamples)).astype(np.float32).reshape(height, width),
        chart=chart_map.reshape(height, width),
        charts=charts,
        overlapping=counts["overlap"],
        clashing=triangle[problems["overlap"]],
        tiny_charts=counts["tiny"],
        outside=counts["outside"],
        unusable=counts["unusable"],
        no_area=counts["no_area"],
        warnings=_warnings(world, owner, problems, counts, len(pixel)),
    )


def join(parts: Sequence[SurfaceReceivers]) -> tuple[SurfaceReceivers, list[slice]]:
    """All receivers of `parts` behind one another, so that one solve answers several images, and the stretch of each part."""
    starts, stretches, points, count = [np.zeros(1, np.int64)], [], 0, 0
    for part in parts:
        starts.append(part.start[1:] + points)
        stretches.append(slice(count, count + part.count))
        points, count = points + len(part.triangle), count + part.count
    kind = parts[0].kind
    merged = [np.concatenate([getattr(p, name) for p in parts]) for name in ("triangle", "u", "v")]
    return SurfaceReceivers(kind, np.concatenate(starts), *merged), stretches


def _gather(
    world: World, objects: Sequence[int], uv_layer: str | Mapping[int, str], placement: Mapping[int, Placement]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """World triangle (n,), placed UV (n, 3, 2) float64 and chart (n,) of all triangles of `objects`, and the number of charts."""
    triangle, uv, chart, charts = [np.zeros(0, np.int32)], [np.zeros((0, 3, 2))], [np.zeros(0, np.int64)], 0
    for index in objects:
        obj = world.scene.objects[index]
        name = (uv_layer if isinstance(uv_layer, str) else uv_layer.get(index, "")) or obj.render_uv
        if name not in obj.uvs:
            have = ", ".join(f'"{n}"' for n in obj.uvs) or "none"
            raise TargetError(
                obj.name, f'there is no UV layer "{name}" (layers: {have})', "Choose one of these layers or make a lightmap layer"
            )
        layer = np.asarray(obj.uvs[name])
        place = placement.get(index, Placement())
        mesh = world.scene.triangles[obj.triangles] - obj.first_vertex
        labels = uv_charts(weld(world.scene.vertices[obj.first_vertex : obj.first_vertex + obj.vertex_count])[mesh], layer)
        triangle.append(np.arange(obj.first_triangle, obj.first_triangle + obj.triangle_count, dtype=np.int32))
        uv.append(layer.astype(np.float64) * place.scale + place.offset)
        chart.append(labels + charts)
        charts += int(labels.max(initial=-1)) + 1
    return np.concatenate(triangle), np.concatenate(uv), np.concatenate(chart), charts


def _candidates(xy: np.ndarray, work: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Chunks of (triangle, row, column), each (m,) int64, that hold every texel touched by the triangles `work` of `xy` (nt, 3, 2).

    A triangle is cut into rows and each row into the texels between its leftmost and rightmost point there, so a large triangle
    costs what it covers and not what its bounding box holds. In order of the triangles.
    """
    # Float rounding must not lose a texel at a border: a little slack, and the exact test follows anyway.
    slack = 1e-6
    low = np.clip(np.floor(xy[work, :, 1].min(axis=1) - slack), 0, height).astype(np.int64)
    high = np.clip(np.floor(xy[work, :, 1].max(axis=1) + slack) + 1, 0, height).astype(np.int64)
    for some in _blocks(np.maximum(high - low, 0), TEXELS_PER_CHUNK):
        which, row = _expand(work[some], low[some], high[some])
        left, right = _row_extent(xy, which, row)
        first = np.clip(np.floor(left - slack), 0, width).astype(np.int64)
        last = np.where(right < left, first, np.clip(np.floor(right + slack) + 1, 0, width).astype(np.int64))
        for part in _blocks(np.maximum(last - first, 0), TEXELS_PER_CHUNK):
            index, column = _expand(np.arange(part.start, part.stop), first[part], last[part])
            yield which[index], row[index], column


def _kept_inside(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentrics moved off the edges of the triangle by at least INSIDE, where they are closer."""
    a, b = np.clip(a, INSIDE, 1 - 2 * INSIDE), np.clip(b, INSIDE, 1 - 2 * INSIDE)
    excess = 0.5 * np.maximum(a + b - (1 - INSIDE), 0)
    return a - excess, b - excess


def _row_extent(xy: np.ndarray, which: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest x (m,) of triangles `which` inside the slab row <= y <= row + 1."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for k in range(3):
        p, q = xy[which, k], xy[which, (k + 1) % 3]
        dy = q[:, 1] - p[:, 1]
        level = np.abs(dy) < 1e-12
        safe = np.where(level, 1.0, dy)
        t0, t1 = (row - 1e-6 - p[:, 1]) / safe, (row + 1 + 1e-6 - p[:, 1]) / safe
        t0, t1 = np.minimum(t0, t1), np.maximum(t0, t1)
        t0, t1 = np.where(level, 0.0, t0), np.where(level, 1.0, t1)
        misses = (t1 < 0) | (t0 > 1) | (level & ((p[:, 1] < row - 1e-6) | (p[:, 1] > row + 1 + 1e-6)))
        dx = q[:, 0] - p[:, 0]
        x0, x1 = p[:, 0] + np.clip(t0, 0, 1) * dx, p[:, 0] + np.clip(t1, 0, 1) * dx
        left = np.minimum(left, np.where(misses, np.inf, np.minimum(x0, x1)))
        right = np.maximum(right, np.where(misses, -np.inf, np.maximum(x0, x1)))
    return left, right


def _expand(items: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each of `items` repeated for the numbers first..last-1 that belong to it, and these numbers."""
    count = np.maximum(last - first, 0)
    total = np.cumsum(count)
    run = np.arange(int(total[-1]) if len(total) else 0) - np.repeat(total - count, count)
    return np.repeat(items, count), np.repeat(first, count) + run


def _blocks(count: np.ndarray, limit: int) -> Iterator[slice]:
    """Slices of about `limit` (a single item may have more) summed `count`."""
    total = np.cumsum(count)
    at = 0
    while at < len(count):
        done = total[at - 1] if at else 0
        stop = max(at + 1, int(np.searchsorted(total, done + limit, side="right")))
        yield slice(at, stop)
        at = stop


def _elsewhere(
    world: World, triangle: np.ndarray, i: np.ndarray, ui: np.ndarray, vi: np.ndarray, j: np.ndarray, uj: np.ndarray, vj: np.ndarray
) -> np.ndarray:
    """(n,) bool: whether two claims of one place are different surfaces: apart by 1e-5 of the scene, or facing another way."""
    first = world.surface(triangle[i], ui.astype(np.float32), vi.astype(np.float32))
    second = world.surface(triangle[j], uj.astype(np.float32), vj.astype(np.float32))
    apart = np.linalg.norm(first.position - second.position, axis=1) > 1e-5 * world.size
    return apart | (np.einsum("ij,ij->i", first.ng, second.ng) < 0.99)


SENTENCES = {
    "overlap": (
        "{n} texels ({share:.1f} %) are claimed by faces at different places, which then share one value",
        "Unwrap without overlaps, or make a lightmap layer",
    ),
    "outside": ("{n} triangles reach out of the unit square and are cut off there", "Move the UVs into the unit square"),
    "unusable": ("{n} triangles have UV coordinates that are not numbers and get no texel", "Unwrap these faces again"),
    "no_area": ("{n} triangles have no area in UV space and get no texel", "Unwrap these faces"),
    "tiny": ("{n} UV islands own fewer than two texels", "Raise the resolution or unwrap into larger islands"),
}


def _warnings(world: World, owner: np.ndarray, problems: dict[str, np.ndarray], counts: dict[str, int], texels: int) -> tuple[Notice, ...]:
    """One notice for each kind of problem, naming the objects it concerns."""
    out = []
    for kind, (reason, remedy) in SENTENCES.items():
        if counts[kind]:
            names = [world.scene.objects[i].name for i in np.unique(owner[problems[kind]])]
            label = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
            out.append(Notice(label, reason.format(n=counts[kind], share=100 * counts[kind] / texels), remedy))
    return tuple(out)
