"""From UV coordinates to texels: which surface points each texel of a lightmap stands for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import MemoryRefused, Notice, TargetError
from ..sampling.additive import STEPS, additive
from ..scene.topology import uv_charts, weld
from ..scene.world import World
from .base import SurfaceReceivers, turned
from .inside import Interiors
from .rasterize import PLACES_PER_CHUNK, Claims, Shapes, claim_places
from .runs import UvTriangles

MAX_RESOLUTION = 16384  # texels a side
MEMORY_LIMIT = 16 << 30  # bytes


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

    @property
    def whole(self) -> np.ndarray:
        """(n,) bool: receivers whose texels lie on surfaces with all their places, none of which is inside a body."""
        many = np.diff(self.receivers.start)
        return (self.share.reshape(-1)[self.pixel] == 1) & (many == many.max())

    def image(self, values: np.ndarray) -> np.ndarray:
        """(h, w, c) float32 image of one value for each receiver, `values` (n, c); 0 where no texel is covered."""
        values = np.asarray(values, np.float32).reshape(self.receivers.count, -1)
        out = np.zeros((self.height * self.width, values.shape[1]), np.float32)
        out[self.pixel] = values
        return out.reshape(self.height, self.width, -1)


def memory(width: int, height: int, subsamples: int) -> int:
    """Bytes `rasterize` needs at most: the points and a copy of one array of them, what is kept for each texel, and one chunk."""
    return width * height * (20 * subsamples + 40) + PLACES_PER_CHUNK * 300


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
    facing: np.ndarray | None = None,
    ours: bool = False,
) -> Lightmap:
    """Find the surface points of every texel of an image shared by `objects` (indices into `world.scene.objects`).

    `uv_layer` is one name for all, or one for each object; "" is the layer used for rendering. `resolution` is (width, height).
    A texel is covered if any of its `subsamples` places lies inside a triangle; a place that two triangles claim goes to the one
    with the lower index. `facing` as in `SurfaceReceivers`. Places inside bodies that stand on the surface are left out, and texels
    that have no others are not covered. `ours`: the layers were made for this, so warnings name no remedy that is the user's.
    Raises TargetError for a missing layer or when no texel is covered, MemoryRefused above `memory_limit`.
    """
    width, height = _checked(resolution, subsamples, memory_limit)

    # Step 1: one list of UV triangles, in units of texels.
    triangle, uv, chart, charts = placed_triangles(world, objects, uv_layer, placement or {})
    layout = UvTriangles.of(uv, width, height)

    # Step 2: who owns which places of the texels.
    claims = claim_places(Shapes(world.rows[triangle]), layout, width, height, sample_offsets(subsamples))

    # Step 3: texels that have any outside of bodies are receivers. What lies inside is black, and would bleed into its neighbours.
    pixel = np.flatnonzero(claims.many)
    if not len(pixel):
        names = ", ".join(world.scene.objects[i].name for i in objects)
        raise TargetError(names, "no texel of the lightmap lies on the surface", "Unwrap into the unit square, or raise the resolution")
    first = (np.cumsum(claims.many, dtype=np.int64) - claims.many)[pixel]
    item, u, v, many = _outside(world, triangle, claims, facing)
    pixel = np.flatnonzero(many)
    start = np.concatenate([[0], np.cumsum(many[pixel], dtype=np.int64)])
    chart_map = np.full(width * height, -1, np.int32)
    chart_map[pixel] = chart[item[start[:-1]]]
    receivers = SurfaceReceivers("texels", start, triangle[item], u, v, facing)

    # Step 4: what is wrong with the layout.
    owned = np.bincount(chart[claims.item[first]], minlength=charts)
    problems = {"overlap": claims.clashing} | _unfit(layout, (owned < 2)[chart])
    owner = world.scene.object[triangle] if len(triangle) else triangle
    counts = {name: len(found) for name, found in problems.items()}
    counts |= {"overlap": claims.overlapping, "tiny": len(np.unique(chart[problems["tiny"]]))}
    told = _at_stake(world, triangle, layout, chart, problems, counts, len(pixel)) if ours else (problems, counts)
    return Lightmap(
        receivers=receivers,
        pixel=pixel,
        covered=(chart_map >= 0).reshape(height, width),
        share=np.where(many > 0, claims.many / np.float32(subsamples), np.float32(0)).reshape(height, width),
        chart=chart_map.reshape(height, width),
        charts=charts,
        overlapping=counts["overlap"],
        clashing=triangle[problems["overlap"]],
        tiny_charts=counts["tiny"],
        outside=counts["outside"],
        unusable=counts["unusable"],
        no_area=counts["no_area"],
        warnings=_warnings(world, owner, *told, len(pixel), ours),
    )


def _checked(resolution: int | tuple[int, int], subsamples: int, memory_limit: int) -> tuple[int, int]:
    """Width and height; raises TargetError where an image cannot be so, MemoryRefused where `rasterize` needs more than the limit."""
    width, height = (resolution, resolution) if isinstance(resolution, int) else resolution
    if not (1 <= width <= MAX_RESOLUTION and 1 <= height <= MAX_RESOLUTION):
        raise TargetError("Lightmap", f"{width} x {height} texels are not possible", f"Choose 1 to {MAX_RESOLUTION}")
    if subsamples < 1:
        raise TargetError("Lightmap", f"{subsamples} sub-samples are not possible", "Choose at least 1")
    need = memory(width, height, subsamples)
    if need > memory_limit:
        sizes = f"{need / 2**30:.1f} GiB, allowed are {memory_limit / 2**30:.1f} GiB"
        reason = f"{width} x {height} texels with {subsamples} sub-samples need {sizes}"
        raise MemoryRefused("Lightmap", reason, "Lower the resolution or the sub-samples")
    return width, height


def _outside(
    world: World, triangle: np.ndarray, claims: Claims, facing: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`item`, `u`, `v` and `many` of the claims without points that lie inside bodies; an object that is inside as a whole keeps them."""
    on = triangle[claims.item]
    inside = Interiors(world).hold(on, claims.u, claims.v)
    inside &= ~turned(world, facing)[on]  # bodies stand on fronts
    if not inside.any():
        return claims.item, claims.u, claims.v, claims.many
    owner = world.scene.object[on]
    has_outside = np.zeros(len(world.scene.objects), bool)
    has_outside[owner[~inside]] = True
    keep = ~inside | ~has_outside[owner]
    del on, owner, inside  # as long as the places themselves, of which an atlas of 4096 has 67 million
    end = np.cumsum(claims.many, dtype=np.int64)
    kept = np.concatenate([np.zeros(1, np.int32), np.cumsum(keep, dtype=np.int32)])
    many = kept[end] - kept[end - claims.many]
    return claims.item[keep], claims.u[keep], claims.v[keep], many


def _at_stake(
    world: World,
    triangle: np.ndarray,
    layout: UvTriangles,
    chart: np.ndarray,
    problems: dict[str, np.ndarray],
    counts: dict[str, int],
    texels: int,
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """The `problems` and their `counts` without triangles and charts that are so small that at the density of their object, or of all
    where that has none, they would get no texel, or fewer than two, in any layout, and without the odd texel at which two faces meet."""
    area, owner, flat = world.area[triangle].astype(np.float64), world.scene.object[triangle], 0.5 * np.abs(layout.doubled)
    whole, laid = (np.bincount(owner, x, len(world.scene.objects)) for x in (area, flat))
    density = np.where(laid > 0, laid / np.maximum(whole, 1e-300), laid.sum() / max(float(whole.sum()), 1e-300))[owner]
    due = area * density
    large = {"no_area": due >= 1, "tiny": (np.bincount(chart, due) >= 2)[chart]}
    problems = problems | {name: problems[name][which[problems[name]]] for name, which in large.items()}
    shared = counts["overlap"] if counts["overlap"] >= SHARED * texels else 0
    return problems, counts | {"overlap": shared, "no_area": len(problems["no_area"]), "tiny": len(np.unique(chart[problems["tiny"]]))}


def _unfit(layout: UvTriangles, tiny: np.ndarray) -> dict[str, np.ndarray]:
    """UV triangles that get no texel or too few, by what is wrong with them; `tiny` (n,) bool: those of charts with hardly a texel."""
    return {
        "outside": np.flatnonzero(~layout.inside & layout.usable),
        "unusable": np.flatnonzero(~layout.usable),
        "no_area": np.flatnonzero(layout.usable & ~layout.has_area),
        "tiny": np.flatnonzero(tiny & layout.usable & layout.has_area),
    }


def join(parts: Sequence[SurfaceReceivers]) -> tuple[SurfaceReceivers, list[slice]]:
    """All receivers of `parts` behind one another, so that one solve answers several images, and the stretch of each part."""
    starts, stretches, points, count = [np.zeros(1, np.int64)], [], 0, 0
    for part in parts:
        starts.append(part.start[1:] + points)
        stretches.append(slice(count, count + part.count))
        points, count = points + len(part.triangle), count + part.count
    kind = parts[0].kind
    merged = [np.concatenate([getattr(p, name) for p in parts]) for name in ("triangle", "u", "v")]
    return SurfaceReceivers(kind, np.concatenate(starts), *merged, parts[0].facing), stretches


def placed_triangles(
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


SHARED = 1e-3  # share of the texels from which on it is said of our own layers that faces share them
RENEW = "Renew the lightmap UVs (--renew-uvs)"
# Of each problem: what is said, what helps a layer of the user's, and what helps one of ours.
SENTENCES = {
    "overlap": (
        "{n} texels ({share:.1f} %) are claimed by faces at different places, which then share one value",
        "Unwrap without overlaps, or make a lightmap layer",
        f"{RENEW}; faces whose sides cross share texels in any layout",
    ),
    "outside": ("{n} triangles reach out of the unit square and are cut off there", "Move the UVs into the unit square", RENEW),
    "unusable": ("{n} triangles have UV coordinates that are not numbers and get no texel", "Unwrap these faces again", RENEW),
    "no_area": (
        "{n} triangles have no area in UV space and get no texel",
        "Unwrap these faces",
        "Merge by distance, then renew the lightmap UVs (--renew-uvs)",
    ),
    "tiny": (
        "{n} UV islands own fewer than two texels",
        "Raise the resolution or unwrap into larger islands",
        "Raise the resolution",
    ),
}


def _warnings(
    world: World, owner: np.ndarray, problems: dict[str, np.ndarray], counts: dict[str, int], texels: int, ours: bool
) -> tuple[Notice, ...]:
    """One notice for each kind of problem, naming the objects it concerns."""
    out = []
    for kind, (reason, remedy, renewal) in SENTENCES.items():
        if counts[kind]:
            names = [world.scene.objects[i].name for i in np.unique(owner[problems[kind]])]
            label = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
            out.append(Notice(label, reason.format(n=counts[kind], share=100 * counts[kind] / texels), renewal if ours else remedy))
    return tuple(out)
