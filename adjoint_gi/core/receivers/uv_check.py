"""What is wrong with a lightmap layer, found in the texels of a bake: shared texels, charts that come too close, lost faces.

Rows of texels are compared as runs from border to border, so what takes time is how high triangles are and not how many texels they hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .charts import Mesh, area_vectors, islands, signed_areas
from .rasterize import Clashes, Shapes, row_blocks
from .runs import Runs, UvTriangles
from .texels import sample_offsets

FINEST = 4096  # texels a side of the raster
PLACES = 4  # looked at in each texel
SEEN = 1e-2  # texels: a triangle of less area need not have one in UV space


@dataclass(frozen=True, eq=False)
class Faults:
    """What was found.

    clashing    (k,) int64 triangles that share texels with others at another place
    overlapping number of these texels
    close       number of texels that have one of another chart within the padding
    lost        (k,) int64 triangles with an area and none in UV space
    outside     number of triangles that reach out of the unit square
    charts      number of charts: triangles that hang together in UV space, were it by a corner
    covered     number of texels
    """

    clashing: np.ndarray
    overlapping: int
    close: int
    lost: np.ndarray
    outside: int
    charts: int
    covered: int

    def __bool__(self) -> bool:
        return bool(self.overlapping or self.close or len(self.lost) or self.outside)

    def __str__(self) -> str:
        found = {
            "texels claimed twice": self.overlapping,
            "texels too close to another chart": self.close,
            "faces without an area in UV space": len(self.lost),
            "faces out of the unit square": self.outside,
        }
        return ", ".join(f"{count} {what}" for what, count in found.items() if count)


def check(
    meshes: Sequence[Mesh],
    uv: np.ndarray,
    resolution: int,
    padding: int,
    chart: np.ndarray | None = None,
    density: np.ndarray | None = None,
) -> Faults:
    """Rasterize `uv` (nt, 3, 2) float32 of all triangles of `meshes` into one square image and report what is wrong.

    `padding` texels should be free between charts: those of `chart` (nt,), or else pieces that hang together in UV space. An image of
    more than FINEST texels a side is looked at in less detail. `density` (n,) is that of `unwrap`.
    """
    size = min(resolution, FINEST)
    layout, shapes, offsets = UvTriangles.of(uv, size, size), _shapes(meshes), sample_offsets(PLACES)
    chart = _islands(meshes, uv) if chart is None else chart
    texel, clashes, maps = np.full((size, size), -1, np.int32), Clashes.none(len(uv)), layout.maps()
    for (low, high), runs in row_blocks(layout, size, size, offsets):
        clashes.look(shapes, maps, runs, low, size, offsets)
        texel[low:high] = _charts_of_texels(runs, chart, low, high, size)
    factor = np.ones(len(meshes)) if density is None else density**2
    area = np.concatenate([np.linalg.norm(area_vectors(mesh.corners()), axis=1) * f for mesh, f in zip(meshes, factor, strict=True)])
    flat = np.abs(signed_areas(uv.astype(np.float64))) * size**2
    scale = flat.sum() / max(float(area.sum()), 1e-300)
    return Faults(
        clashing=np.flatnonzero(clashes.triangle),
        overlapping=clashes.texels,
        close=_close(texel, padding * size // resolution),
        lost=np.flatnonzero((flat <= 0) & (area * scale > SEEN)),
        outside=int((~layout.inside & layout.usable).sum()),
        charts=int(chart.max()) + 1,
        covered=int((texel >= 0).sum()),
    )


def _charts_of_texels(runs: Runs, chart: np.ndarray, low: int, high: int, width: int) -> np.ndarray:
    """(rows, width) int64: the chart of every texel in rows from `low` to before `high`, -1 where none; one of its own where there are
    several."""
    # Sums over the runs that cover a texel, from what each adds at its first texel and takes away behind its last.
    label = chart[runs.triangle].astype(np.float64)
    start = (runs.row - low) * (width + 1) + runs.first
    stop = (runs.row - low) * (width + 1) + runs.last + 1
    texels = (high - low) * (width + 1)
    many, once, squared = (
        np.rint(np.cumsum(np.bincount(start, w, texels) - np.bincount(stop, w, texels))).astype(np.int64)
        for w in (np.ones(len(runs)), label, label**2)
    )
    out = np.where(many > 0, once // np.maximum(many, 1), -1)
    out[many * squared != once**2] = int(chart.max(initial=-1)) + 1
    return out.reshape(high - low, width + 1)[:, :width]


def _islands(meshes: Sequence[Mesh], uv: np.ndarray) -> np.ndarray:
    """(nt,) int64 pieces that hang together by corners: they may touch in the image, for they touch on the surface."""
    out, count = [], 0
    for mesh, part in zip(meshes, np.split(uv, np.cumsum([len(mesh.triangles) for mesh in meshes])[:-1]), strict=True):
        out.append(count + islands(mesh, part))
        count = int(out[-1].max()) + 1
    return np.concatenate(out)


def _close(texel: np.ndarray, padding: int) -> int:
    """Number of texels of the image `texel` (h, w), chart or -1, that have another chart in the square of `padding` texels around them."""
    free = texel < 0
    highest, lowest = texel, np.where(free, np.iinfo(texel.dtype).max, texel)
    for axis in (0, 1):
        highest, lowest = _spread(highest, padding, axis, np.maximum), _spread(lowest, padding, axis, np.minimum)
    return int((~free & (highest != lowest)).sum())


def _spread(image: np.ndarray, width: int, axis: int, combine: np.ufunc) -> np.ndarray:
    """The image with each pixel combined with those up to `width` pixels away along `axis`."""
    out = image.copy()
    source, target = np.moveaxis(image, axis, 0), np.moveaxis(out, axis, 0)
    for step in range(1, min(width, len(source) - 1) + 1):
        combine(target[step:], source[:-step], out=target[step:])
        combine(target[:-step], source[step:], out=target[:-step])
    return out


def _shapes(meshes: Sequence[Mesh]) -> Shapes:
    """The triangles of all meshes, each as large as one unit and in a cell of its own, so that places of two are never one."""
    side = int(np.ceil(len(meshes) ** (1 / 3)))
    rows = []
    for k, mesh in enumerate(meshes):
        corner = mesh.corners()
        low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
        corner = (corner - low) / max(float((high - low).max()), 1e-300)
        cell = 1.5 * np.array([k % side, k // side % side, k // side**2])
        normal = area_vectors(corner)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        rows.append(np.concatenate([corner[:, 0] + cell, corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], normal], axis=1))
    return Shapes(np.concatenate(rows).astype(np.float32))
