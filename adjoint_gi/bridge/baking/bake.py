# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from Blender's scene to Blender's data and files: the same for the panel, the command line and scripts.

    bake = Bake(context, request)      # refuses, or extracts, places receivers and makes the driver
    bake.driver.run()                  # or start(), stop(), resume() in the background
    bake.write(bake.driver.solution())
    report.of_bake(bake)

Everything here belongs on the main thread; only the driver's own thread computes, on copied arrays.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ...core.base.errors import AdjointError, Notice, TargetError
from ...core.elements.elements import Elements
from ...core.elements.mesh import ElementNodes, mesh_solution
from ...core.images.exr import write_exr
from ...core.images.png import write_png
from ...core.method.driver import Driver
from ...core.method.solution import Solution
from ...core.receivers.base import CameraReceivers, Receivers
from ...core.receivers.margin import fill_margin
from ...core.receivers.pack import place_objects
from ...core.receivers.texels import Lightmap, Placement, join, rasterize
from ...core.receivers.vertices import VertexMap, vertex_receivers
from ...core.scene.arrays import SceneArrays
from ...core.scene.world import World
from ..engine.pictures import exposure, write_picture
from ..extract.depsgraph import extract
from ..host import files
from ..props.request import BakeRequest, raise_first
from ..results import links as targets
from ..results import preview
from ..results.attribute import write_attribute
from ..results.elements import write_elements
from ..results.image import linked_image, write_image
from ..results.lightmap_uv import (
    check_uv_layer,
    find_uv_layer,
    in_one_square,
    make_lightmap_uvs,
    paddings,
    remove_lightmap_uv,
    shares_square,
)
from . import outputs
from .preflight import has_own_layer, inspect, look, ordered, picture_size, preflight, receiving

__all__ = ["Bake", "BakeRequest", "preflight"]

ABOUT = "adjoint_gi_about"  # custom property of images and meshes that says what a result is


@dataclass(frozen=True, eq=False)
class Sheet:
    """One lightmap image: the objects that share it, its texels and its stretch of the receivers."""

    name: str
    uids: tuple[int, ...]
    lightmap: Lightmap
    part: slice
    uv_layers: tuple[str, ...]
    placement: dict[str, Placement]


class Bake:
    """See the head of this file.

    notices   everything that was found before the solve, errors excluded, for they refuse it
    written   what `write` has written last: names of datablocks and files
    files     paths of the files among them
    """

    def __init__(self, context: bpy.types.Context, request: BakeRequest) -> None:
        """Raises `AdjointError` with object, reason and remedy when the bake is refused; then nothing has been changed."""
        self.request = request
        self.written: list[str] = []
        self.files: list[str] = []
        self.scene_name = context.scene.name

        # Step 1: refuse what cannot work, before anything is touched.
        notices = look(context, request)
        raise_first(notices)
        arrays = self._extract(context)
        world = World(arrays)
        taken = outputs.problems(request, arrays, receiving(arrays, request), self.scene_name)
        notices = ordered([*notices, *inspect(world, request), *taken])
        raise_first(notices)
        if request.output:
            files.output_folder(request.output)  # only writing there tells whether it can be done

        # Step 2: UV layers that are missing are made; then the scene has to be read again.
        self._made: list[Notice] = []
        if request.target == "texture" and not request.uv_layer and self._make_layers(context, world):
            world = World(self._extract(context))

        # Step 3: receivers and the driver.
        self.notices = [n for n in notices if n.severity != "error"] + self._made
        self._sheets: list[Sheet] = []
        self._vertices: VertexMap | None = None
        self._nodes: ElementNodes | None = None
        self.transparent = bool(context.scene.render.film_transparent)
        receivers = self._receivers(context, world)
        self.notices = ordered(self.notices)
        self.driver = Driver(request.solver, world, receivers, request.settings)

    @property
    def world(self) -> World:
        """The world that is solved."""
        return self.driver.world

    def write(self, solution: Solution) -> list[str]:
        """Write `solution` where it was asked for and read it back; returns the names of datablocks and paths of files.

        While the driver runs, only datablocks are refreshed. A partial result is labelled so, in file names too. Raises
        `TargetError` or `WriteError`; where only the files failed, the datablocks are written all the same, and `written` names them.
        """
        live = self.driver.state == "running"
        write = {"texture": self._write_textures, "attribute": self._write_attributes, "render": self._write_picture}[self.request.target]
        wanted = not live and (self.request.output or self.request.target == "render")
        self.written, self.files = [], []
        try:
            folder = files.output_folder(self.request.output) if wanted else None
            datablocks, paths = write(solution, folder)
        except AdjointError:
            if wanted:
                with contextlib.suppress(AdjointError):  # the first error is the one that is told
                    self.written = write(solution, None)[0]
            raise
        self.files = [str(p) for p in paths]
        self.written = [*datablocks, *self.files]
        return self.written

    # ---- before the solve

    def _extract(self, context: bpy.types.Context) -> SceneArrays:
        depsgraph = context.evaluated_depsgraph_get()
        return extract(depsgraph, context.scene, picture_size(context.scene, self.request))

    def _make_layers(self, context: bpy.types.Context, world: World) -> bool:
        """Make our UV layer on the meshes that receive and lack it; whether any mesh changed. All of them get one, or none.

        Those of an atlas share one square, unless some objects share a mesh or have a layer from before: then each has its own.
        """
        group = receiving(world.scene, self.request)
        objects = [find_objects((world.scene.objects[i].uid,), world.scene.objects[i].source)[0] for i in group]
        first = {obj.data: (i, obj) for i, obj in reversed(list(zip(group, objects, strict=True)))}
        lacking = [pair for mesh, pair in first.items() if not has_own_layer(mesh)]
        size = self.request.resolution
        if self.request.atlas and len(lacking) == len(objects):
            self._made += make_lightmap_uvs(objects, size, paddings(size))
        else:
            sides = {i: size for i in group}
            if self.request.atlas:
                sides = {i: round(place.scale[0] * size) for i, place in self._squares(world, group).items()}
            made: list[bpy.types.Object] = []
            for index, obj in lacking:
                try:
                    self._made += make_lightmap_uvs([obj], sides[index], paddings(sides[index]))
                except AdjointError:
                    for other in made:
                        remove_lightmap_uv(other)
                    raise
                made.append(obj)
        if lacking:
            context.view_layer.update()
        return bool(lacking)

    def _squares(self, world: World, group: list[int]) -> dict[int, Placement]:
        """A square of the atlas for each object of `group`, by its area."""
        area = {i: float(world.area[world.scene.objects[i].triangles].sum()) for i in group}
        return place_objects(area, (self.request.resolution, self.request.resolution), max(1, min(8, self.request.margin)))

    def _receivers(self, context: bpy.types.Context, world: World) -> Receivers:
        request = self.request
        if request.target == "render":
            return CameraReceivers(world)
        indices = receiving(world.scene, request)
        if request.target == "attribute" and request.new_object and request.solver.spec.uses_elements:
            elements = Elements(world, request.settings.max_edge, request.solver.element_target(request.settings))
            self._nodes = ElementNodes(elements, indices)
            return self._nodes
        if request.target == "attribute":
            self._vertices = vertex_receivers(world, indices, request.domain)
            return self._vertices.receivers
        groups = [indices] if request.atlas else [[i] for i in indices]
        self._sheets = [self._sheet(context, world, group) for group in groups]
        receivers, parts = join([sheet.lightmap.receivers for sheet in self._sheets])
        self._sheets = [replace(sheet, part=part) for sheet, part in zip(self._sheets, parts, strict=True)]
        return receivers

    def _sheet(self, context: bpy.types.Context, world: World, group: list[int]) -> Sheet:
        """The texels of the objects `group`, which share one image."""
        request = self.request
        objects = [world.scene.objects[i] for i in group]
        uids = tuple(o.uid for o in objects)
        depsgraph = context.evaluated_depsgraph_get()
        layers = []
        found = find_objects(uids, objects[0].source)
        for obj in found:
            layers.append(find_uv_layer(obj, request.uv_layer))
            self.notices += check_uv_layer(obj, layers[-1], depsgraph)
        placement: dict[int, Placement] = {}
        if not request.uv_layer and not (request.atlas and in_one_square(found)):
            self.notices += [_in_part(obj) for obj in found if shares_square(obj)]
            # A layer that the user names is taken as packed for the atlas already.
            placement = self._squares(world, group) if request.atlas else {}
        layer_of = dict(zip(group, layers, strict=True))
        lightmap = rasterize(world, group, layer_of, request.resolution, request.subsamples, placement)
        self.notices += lightmap.warnings
        name = outputs.title(request, self.scene_name, objects[0].source)
        by_name = {world.scene.objects[i].source: p for i, p in placement.items()}
        return Sheet(name, uids, lightmap, slice(0), tuple(layers), by_name)

    # ---- after the solve

    def _write_textures(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """One image for each sheet; with a folder also its EXR, an EXR of all components, and a PNG to look at."""
        quantity = self.request.quantity
        values = solution.quantity(quantity)
        datablocks, paths = [], []
        for sheet in self._sheets:
            objects = find_objects(sheet.uids, sheet.name)
            image, coverage = sheet_image(sheet, values, solution.weight, self.request.margin)
            wanted = f"{sheet.name} {quantity}"
            stem = outputs.stem(self.request, sheet.name, solution.partial)
            file = files.output_file(folder, stem, ".exr") if folder else None
            before = linked_image(objects[0], quantity)
            made = write_image(
                objects,
                quantity,
                image,
                coverage,
                name=wanted,
                uv_layer=sheet.uv_layers[0],
                placement=sheet.placement,
                file=file,
                folder=folder,
            )
            made[ABOUT] = self._about(solution)
            for obj, layer in zip(objects, sheet.uv_layers, strict=True):
                targets.link(obj, quantity)["uv_layer"] = layer  # in an atlas they may have other names
                preview.follow(obj, quantity)
            if made != before and bpy.data.images.get(wanted, made) != made:
                self._tell(Notice(sheet.name, f'another image is called "{wanted}", so the result is in "{made.name}"', "", "info"))
            datablocks.append(f"image {made.name}")
            if folder:
                layers = {"coverage": coverage}
                for name in ("emitted", "direct", "indirect", "albedo"):
                    layers[name] = sheet_image(sheet, getattr(solution, name), solution.weight, self.request.margin)[0]
                parts = files.output_file(folder, stem + outputs.COMPONENTS, ".exr")
                write_exr(
                    parts, np.concatenate([image, coverage[..., None]], axis=2), layers, folder=folder, metadata=self._metadata(solution)
                )
                picture = files.output_file(folder, stem, ".png")
                write_png(picture, image * exposure(image[coverage > 0]), folder=folder)
                paths += [file, parts, picture]
        return datablocks, paths

    def _write_attributes(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """One colour attribute on each object, or on the object made of its elements. Files cannot hold it; the .blend does."""
        mesh = None
        if self._nodes is not None:
            mesh, solution = mesh_solution(self._nodes, solution)
        values = solution.quantity(self.request.quantity)
        valid = (solution.weight > 0).astype(np.float32)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        datablocks = []
        for index in receiving(self.world.scene, self.request):
            obj = self.world.scene.objects[index]
            target = find_objects((obj.uid,), obj.source)[0]
            where = (target, self.request.quantity, self.request.domain)
            how = {"name": self.request.attribute, "depsgraph": depsgraph}
            if mesh is not None:
                written = write_elements(*where, self.world.scene, index, mesh, values, valid, **how)
            else:
                found = self._vertices.spread(index, values), self._vertices.spread(index, valid)[:, 0]
                written = write_attribute(*where, *found, **how, new_object=self.request.new_object)
            written.object.data[ABOUT] = self._about(solution)
            self._tell(written.taken)
            preview.follow(written.object, self.request.quantity, written.attribute)
            datablocks.append(f"attribute {written.attribute} of {written.object.name}")
        return datablocks, []

    def _write_picture(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """An EXR with all passes and a PNG to look at; while the solve runs there is nowhere to write to."""
        if folder is None:
            return [], []
        stem = outputs.stem(self.request, self.scene_name, solution.partial)
        return [], write_picture(self.driver, solution, self.transparent, folder, stem, self._metadata(solution))

    def _tell(self, notice: Notice | None) -> None:
        """Add what was found while writing; once, however often a partial result is written."""
        if notice is not None and notice not in self.notices:
            self.notices.append(notice)

    def _about(self, solution: Solution) -> str:
        return json.dumps(self._metadata(solution))

    def _metadata(self, solution: Solution) -> dict[str, str]:
        """What a result says of itself."""
        return {
            "method": solution.method,
            "quantity": solution.whole if self.request.target == "render" else self.request.quantity,
            "partial": "yes" if solution.partial else "no",
            "seconds": f"{solution.seconds:.3f}",
            "settings": json.dumps(solution.settings, sort_keys=True),
        }


def sheet_image(sheet: Sheet, values: np.ndarray, weight: np.ndarray, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Image (h, w, 3) float32 of `values` (n, 3) of all receivers, with its margin filled, and coverage (h, w) float32.

    Texels without a sample yet (`weight` 0) count as not covered.
    """
    lightmap = sheet.lightmap
    has = lightmap.image((weight[sheet.part] > 0).astype(np.float32))[..., 0] > 0
    image, _ = fill_margin(lightmap.image(values[sheet.part]), has, margin)
    return image, np.where(has, lightmap.share, np.float32(0))


def _in_part(obj: bpy.types.Object) -> Notice:
    """Said of a layer that was packed with others and is used without them."""
    layer = find_uv_layer(obj, "")
    reason = f'its UV layer "{layer}" was made for an atlas with other objects, so it fills only a part of the image'
    return Notice(obj.name, reason, "Bake all of them in one atlas, or delete the layer to have one made that fills the image", "info")


def find_objects(uids: tuple[int, ...], name: str) -> list[bpy.types.Object]:
    """The objects of these session_uids; raises `TargetError` when one is gone."""
    present = {o.session_uid: o for o in bpy.data.objects}
    if any(uid not in present for uid in uids):
        raise TargetError(name, "was deleted while it was baked", "Bake again")
    return [present[uid] for uid in uids]


def run(context: bpy.types.Context, request: BakeRequest, on_step: Callable[[Driver], None] | None = None) -> tuple[Bake, list[Notice]]:
    """Bake in the foreground and write; returns the bake and its notices. Raises `AdjointError` as `Bake` and `write` do."""
    bake = Bake(context, request)
    solution = bake.driver.run(on_step)
    if solution is None:
        raise TargetError("Bake", "was stopped before the first result", "Let it run longer")
    bake.write(solution)
    return bake, bake.notices
