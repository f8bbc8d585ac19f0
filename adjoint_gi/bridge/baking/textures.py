# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes to textures: one lightmap image for each object, or one for all of them."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...core.base.errors import AdjointError, Notice, Refusals
from ...core.base.steps import Steps, within
from ...core.base.text import json_text
from ...core.denoise.ground import Ground, texel_ground
from ...core.denoise.step import PARTS as NOISY_PARTS
from ...core.flux.density import Given, given, seen
from ...core.flux.facing import baked_sides
from ...core.images.exr import write_exr
from ...core.images.png import write_png
from ...core.images.rows import LazyRows, with_alpha
from ...core.method.solution import Solution
from ...core.receivers.margin import FilledImage
from ...core.receivers.seams import find_seams
from ...core.receivers.texels import Lightmap, join, rasterize
from ...core.receivers.unwrap import Unwrapped
from ...core.scene.world import World
from ..engine.pictures import exposure
from ..extract.depsgraph import extract
from ..host import changes, files
from ..host.preparation import Aside, Stages, Turn, finish_stages, once
from ..props.request import BakeRequest, raise_first
from ..results import links, preview
from ..results.image import linked_image, write_image
from ..results.lightmap_uv import (
    PlanCopy,
    UvPlan,
    check_uv_layer,
    copy_for_plan,
    find_uv_layer,
    in_one_square,
    notices,
    own_layer,
    plan_of,
    shares_square,
    take_back,
    write_plan,
)
from ..results.show import unhidden
from . import outputs
from .instances import make
from .preflight import receiving, resolutions, resolve
from .sides import multiplier, note, side_of, unfits, unwrapping_to_density
from .writer import Prepared, Writer, find_objects

COMPONENTS = ("emitted", "direct", "indirect", "albedo")  # layers of the file with all parts


@dataclass(frozen=True, eq=False)
class Sheet:
    """One lightmap image: the objects that share it, in Blender and by index in the scene, its texels and its stretch of the receivers."""

    name: str
    uids: tuple[int, ...]
    objects: tuple[int, ...]
    lightmap: Lightmap
    part: slice
    uv_layers: tuple[str, ...]

    def filled(self, weight: np.ndarray, margin: int) -> FilledImage:
        """What its image shows in each pixel, by `weight` (n,) of all receivers: texels without a sample yet count as not covered."""
        shape = self.lightmap.height, self.lightmap.width
        return FilledImage.of(shape, self.lightmap.pixel, weight[self.part] > 0, margin)

    def coverage(self, filled: FilledImage) -> LazyRows:
        """(h, w) float32 share of each texel that lies on a surface, where it has a sample."""
        return LazyRows(filled.sampled.shape, lambda rows: np.where(filled.sampled[rows], self.lightmap.share[rows], np.float32(0)))

    def closed(self, world: World, solution: Solution, margin: int) -> dict[str, np.ndarray]:
        """Direct and indirect light of its texels, with the seams between charts closed."""
        layers = dict(zip(self.objects, self.uv_layers, strict=True))
        seams = find_seams(world, self.objects, layers, self.lightmap, self.filled(solution.weight, margin))
        return {name: seams.closed(getattr(solution, name)[self.part]) for name in NOISY_PARTS}

    def given(self, world: World, group: list[int]) -> tuple[Given, ...]:
        """What each object of `group` (indices) got of the image."""
        receivers = self.lightmap.receivers
        return given(world, group, receivers.triangle[receivers.start[:-1]])


@dataclass(frozen=True, eq=False)
class Made:
    """New layers for objects that share a square: `uvs` of all corners of each, texels a side, and what there is to say."""

    unwrapped: Unwrapped
    uvs: list[np.ndarray]
    side: int
    notices: list[Notice]


class TextureWriter(Writer):
    """One image for each sheet; with a folder also its EXR, an EXR of all components, and a PNG to look at."""

    @classmethod
    def preparing(cls, request: BakeRequest, world: World, same: Callable[[], None]) -> Stages[Prepared | None]:
        """Make our UV layer for the objects that receive and lack it, or have one that does not fit any more, where no layer is named.

        Those of an atlas share one square, so all of them get new layers where one does. All of them get one, or none.
        """
        if request.uv_layer:
            return None
        indices = receiving(world.scene, request)
        return (yield from _preparing(request, world, indices, same))

    def placing(self) -> Stages[None]:
        """The texels of all sheets, one sheet after the other."""
        indices = receiving(self.world.scene, self.request)
        groups = [indices] if self.request.atlas else [[i] for i in indices]
        owners = find_objects(tuple(self.world.scene.objects[g[0]].uid for g in groups), self.scene_name) if indices else []
        sides = resolutions(self.world, indices, self.request)
        sides = np.array([side_of(obj, self.request, int(side)) for obj, side in zip(owners, sides, strict=True)])
        self.notices += _told(self.request, sides)
        layers = yield from self._layers(groups)
        yield Aside("Placing texels", self._sheets(groups, layers, sides))

    def _layers(self, groups: list[list[int]]) -> Stages[list[list[str]]]:
        """The UV layers of the objects `groups`, in slices; says what is wrong with them."""
        objects = [self.world.scene.objects[i] for group in groups for i in group]
        layers: list[str] = []
        refused = Refusals()
        while len(layers) < len(objects):
            rest, turn = objects[len(layers) :], Turn()
            depsgraph = bpy.context.evaluated_depsgraph_get()
            found = find_objects(tuple(o.uid for o in rest), rest[0].source)
            turn.back()
            for obj in found:
                layers.append("")
                with refused.each():
                    layers[-1] = self._layer(obj, depsgraph)
                if turn.over():
                    break
            if len(layers) < len(objects):
                yield "Placing texels"
        refused.raise_all()
        in_order = iter(layers)
        return [list(itertools.islice(in_order, len(group))) for group in groups]

    def _layer(self, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> str:
        """The UV layer of `obj`; says what is wrong with it."""
        request, layer = self.request, find_uv_layer(obj, self.request.uv_layer)
        self.notices += check_uv_layer(obj, layer, depsgraph)
        if not request.uv_layer and not request.atlas and shares_square(obj):
            self.notices.append(_in_part(obj))
        return layer

    def _sheets(self, groups: list[list[int]], layers: list[list[str]], sides: np.ndarray) -> Steps[None]:
        """The sheets of all groups of objects, with their UV `layers` and texels a side, and all receivers. Needs no Blender."""
        facing = baked_sides(self.world, [i for group in groups for i in group]).facing
        sheets: list[Sheet] = []
        refused = Refusals()
        for k, (group, names, side) in enumerate(zip(groups, layers, sides, strict=True)):
            with refused.each():
                sheets.append(self._sheet(group, names, int(side), facing))
            yield (k + 1) / len(groups)
        refused.raise_all()
        self.given = [part for group, sheet in zip(groups, sheets, strict=True) for part in sheet.given(self.world, group)]
        self.receivers, parts = join([sheet.lightmap.receivers for sheet in sheets])
        self.sheets: Sequence[Sheet] = [replace(sheet, part=part) for sheet, part in zip(sheets, parts, strict=True)]

    def _sheet(self, group: list[int], layers: list[str], resolution: int, facing: np.ndarray | None) -> Sheet:
        """The texels of the objects `group`, which share one image of `resolution`. Needs no Blender."""
        request, world = self.request, self.world
        objects = [world.scene.objects[i] for i in group]
        uv_layers = dict(zip(group, layers, strict=True))
        lightmap = rasterize(world, group, uv_layers, resolution, request.subsamples, facing=facing, ours=not request.uv_layer)
        self.notices += lightmap.warnings
        name = outputs.title(request, self.scene_name, objects[0].source)
        return Sheet(name, tuple(o.uid for o in objects), tuple(group), lightmap, slice(0), tuple(layers))

    def ground(self, solution: Solution) -> Ground:
        """The texels of all sheets."""
        return texel_ground(self.world, self.receivers, [sheet.lightmap for sheet in self.sheets])

    def seamless(self, solution: Solution) -> Solution:
        """The charts of each sheet meet."""
        parts = [sheet.closed(self.world, solution, self.request.margin) for sheet in self.sheets]
        return replace(solution, **{name: np.concatenate([part[name] for part in parts]) for name in NOISY_PARTS})

    def write(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """Every sheet: see the class."""
        datablocks, paths = [], []
        for sheet in self.sheets:
            file = files.output_file(folder, outputs.stem(self.request, sheet.name, solution.partial), ".exr") if folder else None
            filled = sheet.filled(solution.weight, self.request.margin)
            datablocks.append(f"image {self._write_datablock(sheet, filled, solution, file).name}")
            if folder:
                paths += [file, *self._write_files(sheet, filled, solution, folder)]
        return datablocks, paths

    def _write_datablock(self, sheet: Sheet, filled: FilledImage, solution: Solution, file: Path | None) -> bpy.types.Image:
        """The image of the .blend file, which shows `file` where there is one; the objects' previews follow."""
        objects, quantity = find_objects(sheet.uids, sheet.name), self.request.quantity
        name = f"{sheet.name} {quantity}"
        before = linked_image(objects[0], quantity)
        made = write_image(
            objects,
            quantity,
            filled.image(solution.quantity(quantity)[sheet.part]),
            sheet.coverage(filled),
            name=name,
            uv_layer=sheet.uv_layers[0],
            file=file,
            folder=file.parent if file else None,
        )
        made[links.ABOUT] = json_text(self.metadata(solution))
        for obj, layer in zip(objects, sheet.uv_layers, strict=True):
            links.link(obj, quantity)["uv_layer"] = layer  # in an atlas they may have other names
        preview.follow(objects, quantity)
        if made != before and bpy.data.images.get(name, made) != made:
            self.notices.append(Notice(sheet.name, f'another image is called "{name}", so the result is in "{made.name}"', "", "info"))
        return made

    def _write_files(self, sheet: Sheet, filled: FilledImage, solution: Solution, folder: Path) -> list[Path]:
        """The EXR of all components, and the PNG to look at."""
        stem = outputs.stem(self.request, sheet.name, solution.partial)
        values, coverage = solution.quantity(self.request.quantity)[sheet.part], sheet.coverage(filled)
        image = filled.image(values)
        layers = {"coverage": coverage} | {name: filled.image(getattr(solution, name)[sheet.part]) for name in COMPONENTS}
        parts = files.output_file(folder, stem + outputs.COMPONENTS, ".exr")
        write_exr(parts, with_alpha(image, coverage), layers, folder=folder, metadata=self.metadata(solution))
        picture, factor = files.output_file(folder, stem, ".png"), exposure(values[solution.weight[sheet.part] > 0])
        write_png(picture, LazyRows(image.shape, lambda rows: image[rows] * factor), folder=folder)
        return [parts, picture]


def renew(context: bpy.types.Context, request: BakeRequest) -> tuple[int, list[Notice]]:
    """Make our UV layers of what `request` means anew, without a bake, also of the instances and curves that a bake makes objects of.

    Returns the number of objects and what there is to say.
    Objects that show a result get their materials back, because it does not fit the new layers. Raises `AdjointError`.
    """
    request, found = resolve(context, request)
    raise_first(found)
    with contextlib.ExitStack() as undo:
        real = make(context, request)
        undo.push(real.undo)
        world = World(extract(context.evaluated_depsgraph_get(), context.scene, real=real.objects))
        indices = receiving(world.scene, request)
        made = finish_stages(_preparing(replace(request, renew_uvs=True), world, indices, lambda: None))
        undo.pop_all()
    real.settle()
    preview.restore([_object(world, i) for i in indices])
    return len(indices), made.notices if made is not None else []


def _preparing(request: BakeRequest, world: World, indices: list[int], same: Callable[[], None]) -> Stages[Prepared | None]:
    """New layers for those of the objects `indices` that need them; None where none does. `same`: see `Writer.preparing`."""
    # Step 1: read the meshes.
    objects = find_objects(tuple(world.scene.objects[i].uid for i in indices), "An object")
    with unhidden(bpy.context.view_layer):
        groups, why = _to_unwrap(objects, request, bpy.context.evaluated_depsgraph_get())
    if not groups:
        return None
    place = {obj: k for k, obj in enumerate(objects)}
    parts = [[place[obj] for obj in group] for group in groups]
    names, uids = [obj.name for obj in objects], [obj.session_uid for obj in objects]
    sides = np.broadcast_to(resolutions(world, indices, request), len(objects))
    factors = np.array([multiplier(obj) for obj in objects])
    copies = yield from _copying([uids[i] for part in parts for i in part], same)

    def planning() -> Steps[list[UvPlan]]:
        out: list[UvPlan] = []
        rest, refused = iter(copies), Refusals()
        for k, part in enumerate(parts):
            own = list(itertools.islice(rest, len(part)))
            with refused.each():
                out.append(plan_of((), own))
            yield (k + 1) / len(parts)
        refused.raise_all()
        return out

    plans = yield Aside("Reading the faces", planning())

    # Step 2: what is seen of them, and unwrapping, aside.
    density = yield Aside("Looking from the camera and inside", once(lambda: _densities(world, indices, factors, request)))

    def unwrapping() -> Steps[list[Made]]:
        out: list[Made] = []
        refused = Refusals()
        for k, (part, plan) in enumerate(zip(parts, plans, strict=True)):
            own = [names[i] for i in part]
            steps = unwrapping_to_density(own, factors[part], plan.faces, request, int(sides[part[0]]), density[part])
            with refused.each():
                found, side, told = yield from within(steps, k / len(parts), (k + 1) / len(parts))
                out.append(Made(found, plan.spread(found), side, told))
        refused.raise_all()
        return out

    unwrapped = yield Aside("Unwrapping", unwrapping())

    # Step 3: write the layers. The objects are those that were read, but an undo may have given them other places in memory.
    same()
    found = iter(find_objects(tuple(uids[i] for part in parts for i in part), "Object"))
    plans = [replace(plan, objects=tuple(itertools.islice(found, len(part)))) for plan, part in zip(plans, parts, strict=True)]
    with unhidden(bpy.context.view_layer):
        made = _write_layers(plans, unwrapped, request)
    made.notices[:0] = why
    bpy.context.view_layer.update()
    return made


def _copying(uids: list[int], same: Callable[[], None]) -> Stages[list[PlanCopy]]:
    """Copy the meshes of the objects of these session_uids, in slices; `same` raises when they are not as they were, and is to be asked
    again in the end for what changes without a sign."""
    copies: list[PlanCopy | None] = []
    seen, refused = changes.count(), Refusals()
    while len(copies) < len(uids):
        if changes.count() != seen:
            same()
        turn = Turn()
        objects = find_objects(tuple(uids[len(copies) :]), "Object")
        with unhidden(bpy.context.view_layer):
            turn.back()
            for obj in objects:
                copies.append(None)
                with refused.each():
                    copies[-1] = copy_for_plan(obj, bpy.context.view_layer)
                if turn.over():
                    break
        if len(copies) < len(uids):
            yield "Reading the faces"
    refused.raise_all()
    return [copy for copy in copies if copy is not None]


def _object(world: World, index: int) -> bpy.types.Object:
    """The object of Blender behind that of the scene; raises `TargetError` when it is gone."""
    return find_objects((world.scene.objects[index].uid,), world.scene.objects[index].source)[0]


def _to_unwrap(
    objects: list[bpy.types.Object], request: BakeRequest, depsgraph: bpy.types.Depsgraph
) -> tuple[list[list[bpy.types.Object]], list[Notice]]:
    """Objects that need new layers, in groups that share a square, and notices on those whose present layers do not fit any more."""
    why = unfits(objects, request, depsgraph)
    told = [Notice(obj.name, f"{reason}; they are made anew", "", "info") for obj, reason in why.items() if reason]
    lacking = [obj for obj, reason in why.items() if reason or request.renew_uvs or not own_layer(obj)]
    if not request.atlas:
        return [[obj] for obj in lacking], told
    if not objects:
        return [], told
    together = not lacking and (len(objects) == 1 or in_one_square(objects))
    return [] if together else [objects], told


def _write_layers(plans: list[UvPlan], unwrapped: list[Made], request: BakeRequest) -> Prepared:
    """Give all objects of `plans` their layers, or none."""
    made, restoring = Prepared([]), []
    made.undo.callback(take_back, restoring)
    refused = Refusals()
    try:
        for plan, new in zip(plans, unwrapped, strict=True):
            with refused.each():
                restoring.append(write_plan(plan, new.unwrapped, new.uvs))
                note(plan.objects, request, new.side)
                made.notices += [*notices(plan.objects, new.unwrapped, bool(request.texels_per_metre)), *new.notices]
        refused.raise_all()
    except AdjointError:
        made.undo.close()
        raise
    return made


def _densities(world: World, indices: list[int], factors: np.ndarray, request: BakeRequest) -> np.ndarray:
    """(n,) float64 how densely the objects `indices` lie beside one another: in an atlas by what is seen of them, if no texels a metre are
    asked for, times the user's `factors`. Needs no Blender."""
    by_view = request.atlas and len(indices) > 1 and not request.texels_per_metre
    return factors * (seen(world).weight[indices] if by_view else 1.0)


def _told(request: BakeRequest, sides: np.ndarray) -> list[Notice]:
    """A notice where images follow the size of their objects."""
    if (sides == request.resolution).all() or request.texels_per_metre:
        return []
    texels = ", ".join(f"{count} of {side}" for side, count in zip(*np.unique(sides, return_counts=True), strict=True))
    return [
        Notice(
            "Lightmaps", f"follow the sizes of {len(sides)} objects, in texels a side: {texels}", "Bake an atlas, or fewer objects", "info"
        )
    ]


def _in_part(obj: bpy.types.Object) -> Notice:
    """A notice about a layer that was packed with others and is used without them."""
    layer = find_uv_layer(obj, "")
    reason = f'its UV layer "{layer}" was made for an atlas with other objects, so it fills only a part of the image'
    return Notice(obj.name, reason, "Bake all of them in one atlas, or delete the layer to have one made that fills the image", "info")
