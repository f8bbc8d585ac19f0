"""What is wrong with a lightmap layer, found by rasterizing it as a bake does: shared texels, charts that come too close, lost faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.arrays import Material, ObjectArrays, SceneArrays
from ..scene.world import World
from .charts import Mesh, area_vectors, islands, signed_areas
from .texels import rasterize

FINEST = 4096  # texels a side of the raster
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
    lightmap = rasterize(_world(meshes, uv), [0], "uv", size, 4)
    chart = _islands(meshes, uv) if chart is None else chart
    texel = np.full(size * size, -1, np.int64)
    texel[lightmap.pixel] = chart[lightmap.receivers.triangle[lightmap.receivers.start[:-1]]]
    factor = np.ones(len(meshes)) if density is None else density**2
    area = np.concatenate([np.linalg.norm(area_vectors(mesh.corners()), axis=1) * f for mesh, f in zip(meshes, factor, strict=True)])
    flat = np.abs(signed_areas(uv.astype(np.float64))) * size**2
    scale = flat.sum() / max(float(area.sum()), 1e-300)
    return Faults(
        clashing=lightmap.clashing.astype(np.int64),
        overlapping=lightmap.overlapping,
        close=_close(texel.reshape(size, size), padding * size // resolution),
        lost=np.flatnonzero((flat <= 0) & (area * scale > SEEN)),
        outside=lightmap.outside,
        charts=int(chart.max()) + 1,
        covered=len(lightmap.pixel),
    )


def _vertex_ids(meshes: Sequence[Mesh]) -> np.ndarray:
    """(nt, 3) int64 vertices of all triangles, numbered through."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, first, strict=False)])


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
    highest, lowest = texel, np.where(free, np.iinfo(np.int64).max, texel)
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


def _world(meshes: Sequence[Mesh], uv: np.ndarray) -> World:
    """All meshes as one object, each as large as one unit and in a cell of its own, so that places of two are never one."""
    side = int(np.ceil(len(meshes) ** (1 / 3)))
    points = []
    for k, mesh in enumerate(meshes):
        corner = mesh.corners()
        low, high = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
        points.append(
            (mesh.vertices - low) / max(float((high - low).max()), 1e-300) + 1.5 * np.array([k % side, k // side % side, k // side**2])
        )
    vertices, triangles = np.concatenate(points), _vertex_ids(meshes).astype(np.int32)
    n = len(triangles)
    none = np.zeros(n, np.int32)
    obj = ObjectArrays("mesh", "mesh", triangle_count=n, vertex_count=len(vertices), uvs={"uv": uv}, render_uv="uv")
    normals = np.zeros((n, 3, 3), np.float32)
    return World(SceneArrays(vertices, triangles, normals, none.astype(bool), none, none, none, none, (Material("none"),), (obj,)))
