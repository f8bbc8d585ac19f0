# SPDX-License-Identifier: GPL-3.0-or-later
"""How many texels a lightmap has: the resolution that is asked for, or as many as give each object its texels a metre."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import bpy
import numpy as np

from ...core.base.errors import Notice, TargetError
from ...core.base.steps import Steps
from ...core.receivers.unwrap import Unwrapped, unwrapping
from ...core.scene.world import World
from ..host.notices import listed
from ..props.request import BakeRequest
from ..results import carried, stored
from ..results.faces import MeshFaces
from ..results.lightmap_uv import duplicated, marked, outdated, own_layer, paddings
from ..results.real import standing_for

DENSITY = "adjoint_gi_density"  # property of objects: multiplies their texels a metre
FULL = 0.6  # share of the image that charts are first thought to fill
SMALLEST = 16  # texels a side
TWICE = "has the same lightmap UVs as its duplicate"
CLOSE = 1.03  # how near the texels a metre that are asked for must be met


def multiplier(obj: bpy.types.Object) -> float:
    """How many times more texels a metre than others `obj` is to have; what was made of a curve follows the curve."""
    return float(getattr(standing_for(obj), DENSITY, 1.0))


def asked(obj: bpy.types.Object, request: BakeRequest) -> str:
    """What is noted beside a layer of the density that was asked for; where it differs, the layer is made anew. Empty for the default."""
    if request.texels_per_metre:
        return f"{request.texels_per_metre:g} {multiplier(obj):g} {request.resolution}"
    return f"0 {multiplier(obj):g}" if request.atlas and multiplier(obj) != 1.0 else ""


def planned(world: World, indices: Sequence[int], request: BakeRequest) -> np.ndarray:
    """(n,) int64 about how many texels a side the images of the objects `indices` have for the texels a metre that are asked for."""
    present = {o.session_uid: o for o in bpy.data.objects}
    factor = np.array([multiplier(present[world.scene.objects[i].uid]) for i in indices])
    area = np.array([world.area[world.scene.objects[i].triangles].sum() for i in indices]) * factor**2
    parts = [area.sum()] if request.atlas and len(area) else area
    return np.array([_side(part, request) for part in parts], np.int64)


def unwrapping_to_density(
    names: Sequence[str], factors: np.ndarray, faces: Sequence[MeshFaces], request: BakeRequest, side: int, density: np.ndarray
) -> Steps[tuple[Unwrapped, int, list[Notice]]]:
    """The layers of the objects `names`, which share an image, its texels a side, and what there is to say of its density; without Blender.

    Where no texels a metre are asked for, the image has `side`. `density` (n,) is that of `unwrap`, `factors` (n,) are the `multiplier`s.
    """
    density = density if len(names) > 1 else np.ones(1)
    wanted = request.texels_per_metre * (float(factors[0]) if len(names) == 1 else 1.0)
    if not wanted:
        return (yield from _unwrapping(names, faces, side, density, squeeze=True)), side, []
    area = np.array([0.5 * face.area[face.good].sum() for face in faces])
    side = _side(float((area * factors**2).sum()), request)
    found = yield from _unwrapping(names, faces, side, density)
    if not 1 / CLOSE < found.texels_per_metre / wanted < CLOSE:
        better = _bounded(side * wanted / found.texels_per_metre, request.resolution)
        if better != side or found.texels_per_metre > wanted:
            side, found = better, (yield from _unwrapping(names, faces, better, density, most=wanted))
    if found.texels_per_metre * CLOSE < wanted:
        # The length of a few faces may be what keeps it from fitting.
        found = yield from _unwrapping(names, faces, side, density, squeeze=True, most=wanted)
    return found, side, _too_few(names, density, found, wanted, side)


def _too_few(names: Sequence[str], density: np.ndarray, found: Unwrapped, wanted: float, side: int) -> list[Notice]:
    """What there is to say where objects have fewer texels a metre than are `wanted`: all of them, or some along their lengths."""
    told, remedy = [], "Raise the resolution, or ask for fewer"
    if found.texels_per_metre * CLOSE < wanted:
        reason = f"only {found.texels_per_metre:.3g} texels a metre fit into {side} x {side}, not {wanted:.3g}"
        told.append(Notice(", ".join(names[:8]), reason, remedy))
    reason = f"has faces so long that only {{:.3g}} texels a metre fit into {side} x {side} along their length, not {{:.3g}}"
    for name, factor, share in zip(names, density, found.length, strict=True):
        if share * CLOSE < 1.0:
            text = reason.format(share * found.texels_per_metre * factor, wanted * factor)
            told.append(Notice(name, text, f"{remedy}, or cut long faces into shorter ones"))
    return told


def note(objects: Sequence[bpy.types.Object], request: BakeRequest, side: int) -> None:
    """Note beside the new layers of `objects` what was asked for, and the `side` of their image."""
    for obj in objects:
        text, beside = asked(obj, request), marked(obj)
        if text:
            beside[stored.ASKED] = f"{text}/{side}"
        elif stored.ASKED in beside:
            del beside[stored.ASKED]


def unfits(objects: Sequence[bpy.types.Object], request: BakeRequest, depsgraph: bpy.types.Depsgraph) -> dict[bpy.types.Object, str]:
    """Of each of `objects`, which are baked together: why the layer made by us does not fit, as words after its name, or nothing."""
    twice = duplicated(objects) if request.atlas else set()
    edited = functools.cache(carried.edited)
    return {obj: _unfit(obj, request, depsgraph, edited) or (TWICE if obj in twice else "") for obj in objects}


def _unfit(
    obj: bpy.types.Object, request: BakeRequest, depsgraph: bpy.types.Depsgraph, edited: Callable[[bpy.types.NodeTree], bool]
) -> str:
    """Why the layer made by us for `obj` does not fit the object or `request`, as words after its name; empty where it does or is none."""
    why = outdated(obj, depsgraph, edited)
    if why or not own_layer(obj) or (stored.read(marked(obj), stored.ASKED) or "/").split("/")[0] == asked(obj, request):
        return why
    return "has lightmap UVs of another density than is asked for"


def side_of(obj: bpy.types.Object, request: BakeRequest, side: int) -> int:
    """Texels a side of the image of `obj`: as its layer was made for where texels a metre are asked for, else `side`."""
    known = (stored.read(marked(obj), stored.ASKED) or "/").split("/")[1]
    return int(known) if known and request.texels_per_metre and not request.uv_layer else side


def _unwrapping(
    names: Sequence[str], faces: Sequence[MeshFaces], side: int, density: np.ndarray, squeeze: bool = False, most: float = np.inf
) -> Steps[Unwrapped]:
    try:
        return (yield from unwrapping([face.mesh for face in faces], side, paddings(side), density, squeeze, most))
    except TargetError as error:
        raise TargetError(listed(list(names)), error.notice.reason, error.notice.remedy) from error


def _side(area: float, request: BakeRequest) -> int:
    """Texels a side for surfaces of `area` m2, which counts those of twice the density four times."""
    return _bounded(request.texels_per_metre * float(np.sqrt(area / FULL)), request.resolution)


def _bounded(side: float, most: int) -> int:
    """Whole texels, a multiple of four where they are fewer than the `most`."""
    return int(min(most, max(min(SMALLEST, most), 4 * np.ceil(side / 4))))
