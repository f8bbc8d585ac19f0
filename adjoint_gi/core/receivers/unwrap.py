"""Unwrapping for lightmaps: meshes in, UV coordinates of one common square out, without overlap and at one scale.

Charts and packing are those of xatlas, checked by the raster of the bake itself. What fails is mended: charts that lie over themselves
are cut, too narrow a packing is padded more. What still fails is unwrapped by projection and packed on shelves. The result depends on
the arrays alone: the same meshes give the same UVs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import TargetError
from .charts import Charts, Mesh, islands, join
from .conformal import cut_off, make_charts
from .pack import pack_again, pack_on_shelves, pack_tightly
from .projection import pieces, project
from .uv_check import Faults, check

TRIES = 4  # packings that are checked before the other way of unwrapping is taken


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """UV layers of several meshes that share one square.

    uvs              (nt, 3, 2) float32 for each mesh
    texels_per_metre scale of all charts, in an image of the resolution that was asked for
    padding          texels that are free between charts
    charts           number of charts
    covered          share of the texels that are covered
    projected        why the charts are our own projections; empty where they are those of xatlas
    """

    uvs: tuple[np.ndarray, ...]
    texels_per_metre: float
    padding: int
    charts: int
    covered: float
    projected: str


def unwrap(meshes: Sequence[Mesh], resolution: int, paddings: Sequence[int]) -> Unwrapped:
    """Unwrap `meshes` into one square image of `resolution` texels, with the first of `paddings` (texels between charts) that fits.

    Raises TargetError when there are more charts than fit.
    """
    try:
        return _first_that_fits(meshes, [make_charts(mesh) for mesh in meshes], resolution, paddings, "")
    except _Unfit as failure:
        reason = str(failure)
    except TargetError as error:
        reason = error.notice.reason
    return by_projection(meshes, resolution, paddings, reason)


def by_projection(meshes: Sequence[Mesh], resolution: int, paddings: Sequence[int], reason: str) -> Unwrapped:
    """The same by our own projections on shelves, taken for a `reason`, which is not empty."""
    charts = [project(mesh, pieces(mesh)) for mesh in meshes]
    # Apart what does not hang together, so that it is packed with space between.
    charts = [Charts(part.xy, islands(mesh, part.xy, part.chart)) for mesh, part in zip(meshes, charts, strict=True)]
    return _first_that_fits(meshes, charts, resolution, paddings, reason)


class _Unfit(Exception):
    """Charts that did not pass the check after TRIES packings; says what is wrong with them."""


def _first_that_fits(meshes: Sequence[Mesh], charts: list[Charts], resolution: int, paddings: Sequence[int], projected: str) -> Unwrapped:
    """The charts packed with the first padding that fits. Raises TargetError or, for charts of xatlas, _Unfit."""
    for padding in paddings[:-1]:
        try:
            return _checked(meshes, charts, resolution, padding, projected)
        except TargetError:
            continue
    return _checked(meshes, charts, resolution, paddings[-1], projected)


def _checked(meshes: Sequence[Mesh], charts: list[Charts], resolution: int, padding: int, projected: str) -> Unwrapped:
    """Pack, check and mend, a few times. Raises TargetError or, for charts of xatlas, _Unfit."""
    gap, scale = padding, 0.0
    for _ in range(TRIES):
        flat = join(charts)
        if projected:
            uv, scale = pack_on_shelves(flat, resolution, gap)
        elif scale:
            uv, scale = pack_again(flat, resolution, gap, scale)
        else:
            uv, scale = pack_tightly(flat, resolution, gap)
        faults = check(meshes, uv, resolution, padding, flat.chart)
        if not faults:
            break
        charts = _mended(meshes, charts, faults)
        gap += 1 if faults.close else 0
    else:
        if not projected:
            raise _Unfit(f"the charts of xatlas have {faults}")
        projected = f"{projected}; what is left is {faults}"
    stops = np.cumsum([len(mesh.triangles) for mesh in meshes])[:-1]
    return Unwrapped(tuple(np.split(uv, stops)), scale, padding, faults.charts, faults.covered / resolution**2, projected)


def _mended(meshes: Sequence[Mesh], charts: list[Charts], faults: Faults) -> list[Charts]:
    """The charts with those cut that lie over themselves or have lost a triangle."""
    broken = np.union1d(faults.clashing, faults.lost)
    first = np.cumsum([0, *(len(mesh.triangles) for mesh in meshes)])
    own = [broken[(broken >= a) & (broken < b)] - a for a, b in zip(first[:-1], first[1:], strict=True)]
    return [cut_off(mesh, part, triangles) for mesh, part, triangles in zip(meshes, charts, own, strict=True)]
