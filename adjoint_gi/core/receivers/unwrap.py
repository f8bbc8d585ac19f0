"""Unwrapping for lightmaps: meshes in, UV coordinates of one common square out, without overlap and at one scale.

Charts and packing are those of xatlas, checked by the raster of the bake itself. What fails is mended: charts that lie over themselves
are cut, too narrow a packing is padded more. What still fails is unwrapped by projection and packed on shelves. The result depends on
the arrays alone: the same meshes give the same UVs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import TargetError
from ..base.steps import Steps, finish, within
from .charts import Charts, Mesh, islands, join, parted, room, shortened
from .conformal import cut_off, making_charts
from .pack import FULL, pack_again, pack_on_shelves, pack_tightly
from .projection import pieces, project
from .uv_check import Faults, check

TRIES = 5  # packings that are checked before the other way of unwrapping is taken: charts, pieces, polygons, polygons opened, and one more
CHARTS = 0.6  # share of the work that making charts is thought to be


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """UV layers of several meshes that share one square.

    uvs              (nt, 3, 2) float32 for each mesh
    texels_per_metre scale of all charts of density 1, in an image of the resolution that was asked for
    padding          texels that are free between charts
    charts           number of charts
    length           (n,) float64 share of its density that each mesh has along the length of a chart at least: below 1 where one is so
                     long that it has fewer texels along its length than the others
    covered          share of the texels that are covered
    projected        why the charts are our own projections; empty where they are those of xatlas
    """

    uvs: tuple[np.ndarray, ...]
    texels_per_metre: float
    padding: int
    charts: int
    length: np.ndarray
    covered: float
    projected: str


def unwrap(
    meshes: Sequence[Mesh],
    resolution: int,
    paddings: Sequence[int],
    density: np.ndarray | None = None,
    squeeze: bool = True,
    most: float = np.inf,
) -> Unwrapped:
    """Unwrap `meshes` into one square image of `resolution` texels, with the first of `paddings` (texels between charts) that fits.

    density (n,) float64: how large the charts of each mesh are beside those of the others, along an edge; all alike where it is None.
    squeeze: whether charts of great length may get fewer texels along it, so that the others do not.
    most: texels a metre that charts of density 1 have at most; then the image is not filled.
    Raises TargetError when there are more charts than fit.
    """
    return finish(unwrapping(meshes, resolution, paddings, density, squeeze, most))


def unwrapping(
    meshes: Sequence[Mesh],
    resolution: int,
    paddings: Sequence[int],
    density: np.ndarray | None = None,
    squeeze: bool = True,
    most: float = np.inf,
) -> Steps[Unwrapped]:
    """The same in steps, each a call into xatlas or about a tenth of a second; it may run in any thread.

    xatlas holds Python's lock: 0.1 s for 2,000 triangles, 0.4 s for the largest region that it is given.
    """
    density = np.ones(len(meshes)) if density is None else np.asarray(density, np.float64)
    try:
        charts = yield from within(_all_charts(meshes, making_charts), 0.0, CHARTS)
        return (yield from within(_first_that_fits(meshes, charts, resolution, paddings, density, "", squeeze, most), CHARTS, 1.0))
    except _Unfit as failure:
        reason = str(failure)
    except TargetError as error:
        reason = error.notice.reason
    return (yield from within(projecting(meshes, resolution, paddings, reason, density, squeeze, most), CHARTS, 1.0))


def by_projection(meshes: Sequence[Mesh], resolution: int, paddings: Sequence[int], reason: str) -> Unwrapped:
    """The same by our own projections on shelves, taken for a `reason`, which is not empty."""
    return finish(projecting(meshes, resolution, paddings, reason, np.ones(len(meshes)), True, np.inf))


def projecting(
    meshes: Sequence[Mesh], resolution: int, paddings: Sequence[int], reason: str, density: np.ndarray, squeeze: bool, most: float
) -> Steps[Unwrapped]:
    """`by_projection` in steps, with `density`, `squeeze` and `most` of `unwrap`."""
    charts = yield from within(_all_charts(meshes, _projected), 0.0, CHARTS)
    return (yield from within(_first_that_fits(meshes, charts, resolution, paddings, density, reason, squeeze, most), CHARTS, 1.0))


def _all_charts(meshes: Sequence[Mesh], make: Callable[[Mesh], Steps[Charts]]) -> Steps[list[Charts]]:
    """The charts of every mesh, by `make`."""
    done = np.cumsum([0, *(len(mesh.triangles) for mesh in meshes)]) / max(sum(len(mesh.triangles) for mesh in meshes), 1)
    charts = []
    for k, mesh in enumerate(meshes):
        charts.append((yield from within(make(mesh), done[k], done[k + 1])))
        yield done[k + 1]
    return charts


def _projected(mesh: Mesh) -> Steps[Charts]:
    """The charts of `mesh` by projection."""
    flat = project(mesh, pieces(mesh))
    yield 0.5
    # Apart what does not hang together, so that it is packed with space between.
    return Charts(flat.xy, islands(mesh, flat.xy, flat.chart))


class _Unfit(Exception):
    """Charts that did not pass the check after TRIES packings; says what is wrong with them."""


def _first_that_fits(
    meshes: Sequence[Mesh],
    charts: list[Charts],
    resolution: int,
    paddings: Sequence[int],
    density: np.ndarray,
    projected: str,
    squeeze: bool,
    most: float,
) -> Steps[Unwrapped]:
    """The charts packed with the first padding that fits. Raises TargetError or, for charts of xatlas, _Unfit."""
    for padding in paddings[:-1]:
        try:
            return (yield from _checked(meshes, charts, resolution, padding, density, projected, squeeze, most))
        except TargetError:
            continue
    return (yield from _checked(meshes, charts, resolution, paddings[-1], density, projected, squeeze, most))


def _checked(
    meshes: Sequence[Mesh],
    charts: list[Charts],
    resolution: int,
    padding: int,
    density: np.ndarray,
    projected: str,
    squeeze: bool,
    most: float,
) -> Steps[Unwrapped]:
    """Pack, check and mend, a few times. Raises TargetError or, for charts of xatlas, _Unfit."""
    gap, scale = padding, 0.0
    side = room(join(charts, density), FULL)
    charts = [parted(mesh, part, side / factor) for mesh, part, factor in zip(meshes, charts, density, strict=True)]
    for number in range(TRIES):
        flat = join(charts, density)
        flat, left = shortened(flat, resolution, FULL, most) if squeeze else (flat, np.ones(flat.count))
        if projected:
            uv, scale = pack_on_shelves(flat, resolution, gap, most)
        elif scale:
            uv, scale = pack_again(flat, resolution, gap, scale, most)
        else:
            uv, scale = pack_tightly(flat, resolution, gap, most)
        yield (number + 0.5) / TRIES
        faults = check(meshes, uv, resolution, padding, flat.chart, density)
        if not faults:
            break
        charts = _mended(meshes, charts, faults)
        gap += 1 if faults.close else 0
        yield (number + 1.0) / TRIES
    else:
        if not projected:
            raise _Unfit(f"the charts of xatlas have {faults}")
        projected = f"{projected}; what is left is {faults}"
    stops = np.cumsum([len(mesh.triangles) for mesh in meshes])[:-1]
    length = np.array([part.min(initial=1.0) for part in np.split(left[flat.chart], stops)])
    return Unwrapped(tuple(np.split(uv, stops)), scale, padding, faults.charts, length, faults.covered / resolution**2, projected)


def _mended(meshes: Sequence[Mesh], charts: list[Charts], faults: Faults) -> list[Charts]:
    """The charts with those cut that lie over themselves or have lost a triangle."""
    broken = np.union1d(faults.clashing, faults.lost)
    first = np.cumsum([0, *(len(mesh.triangles) for mesh in meshes)])
    own = [broken[(broken >= a) & (broken < b)] - a for a, b in zip(first[:-1], first[1:], strict=True)]
    return [cut_off(mesh, part, triangles) for mesh, part, triangles in zip(meshes, charts, own, strict=True)]
