# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes to colour attributes: on the vertices or corners of each object, or of an object made of its elements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.base.errors import Notice, TargetError
from ...core.base.text import json_text
from ...core.denoise.ground import Ground, vertex_ground
from ...core.elements.elements import Elements
from ...core.elements.mesh import ElementNodes, mesh_solution
from ...core.flux.facing import baked_sides
from ...core.method.solution import Solution
from ...core.receivers.base import Receivers
from ...core.receivers.vertices import VertexMap, vertex_receivers
from ..host.preparation import Aside, Stages, once
from ..results import links, preview
from ..results.attribute import WrittenAttribute, write_attribute, write_to_copy
from ..results.elements import write_as_baked, write_elements
from ..results.real import is_whole
from .preflight import receiving
from .writer import Writer, find_objects


class AttributeWriter(Writer):
    """One colour attribute on each object, or on the object made of its elements. Files cannot hold it; the .blend does."""

    vertices: VertexMap | None = None
    nodes: ElementNodes | None = None  # of objects made of elements

    def placing(self) -> Stages[None]:
        """The corners of the elements where objects are made of them, else the vertices or corners of the meshes."""
        indices = receiving(self.world.scene, self.request)
        self.receivers = yield Aside("Placing vertices", once(lambda: self._place(indices)))

    def _place(self, indices: list[int]) -> Receivers:
        """The receivers on these objects. Needs no Blender."""
        request, world = self.request, self.world
        if request.new_object and request.solver.spec.uses_elements:
            elements = Elements(world, request.settings.max_edge, request.solver.element_target(request.settings))
            self.nodes = ElementNodes(elements, indices)
            return self.nodes
        facing = baked_sides(world, indices).facing
        self.vertices = vertex_receivers(world, indices, request.domain, facing=facing)
        return self.vertices.receivers

    def ground(self, solution: Solution) -> Ground | None:
        """The vertices or corners along the edges of their meshes."""
        return vertex_ground(self.world, self.vertices) if self.vertices is not None else None

    def write(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """Every object: see the class."""
        mesh = None
        if self.nodes is not None:
            mesh, solution = mesh_solution(self.nodes, solution)
        values = solution.quantity(self.request.quantity)
        valid = (solution.weight > 0).astype(np.float32)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        datablocks, followed = [], []
        for index in receiving(self.world.scene, self.request):
            obj = self.world.scene.objects[index]
            target = find_objects((obj.uid,), obj.source)[0]
            where = (target, self.request.quantity, self.request.domain)
            how = {"name": self.request.attribute, "depsgraph": depsgraph}
            if mesh is not None:
                written = self._write_elements(where, (self.world.scene, index, mesh, values, valid), how)
            else:
                found = self.vertices.spread(index, values), self.vertices.spread(index, valid)[:, 0]
                written = self._write_mesh(index, where, found, how)
            written.object.data[links.ABOUT] = json_text(self.metadata(solution))
            if written.taken is not None:
                self.notices.append(written.taken)
            followed.append(written.object)
            datablocks.append(f"attribute {written.attribute} of {written.object.name}")
        preview.follow(followed, self.request.quantity, attributes=True)
        return datablocks, []

    def _write_elements(self, where: tuple, found: tuple, how: dict[str, Any]) -> WrittenAttribute:
        """Onto an object of the elements, which are there however the user has edited the object meanwhile."""
        try:
            return write_elements(*where, *found, **how)
        except TargetError as error:
            if not self.is_last:
                raise
            written = write_elements(*where, *found, **how, edited=True)
            text = f'was edited since the bake was started; the object "{written.object.name}" has its elements as they were then'
            self.notices.append(Notice(error.notice.object, text, error.notice.remedy))
            return written

    def _write_mesh(self, index: int, where: tuple, found: tuple[np.ndarray, np.ndarray], how: dict[str, Any]) -> WrittenAttribute:
        """Onto the object's mesh, or onto an object of its own. Where the user has meanwhile made a linked duplicate, or has added or
        changed or removed modifiers, that has the mesh which was baked: the result is whole."""
        # What was made of a curve is an object of its own already.
        separate = (self.request.new_object or where[0].name in self.request.separate) and not is_whole(where[0])
        try:
            return write_attribute(*where, *found, **how, new_object=separate)
        except TargetError as error:
            if not self.is_last:
                raise
            try:
                written = write_to_copy(*where, *found, name=self.request.attribute, reason=error)
            except TargetError:
                written = write_as_baked(*where, self.world.scene, index, *found, name=self.request.attribute)
            text = f'{error.notice.reason}; that is new since the bake was started, so the result is on the object "{written.object.name}"'
            self.notices.append(Notice(error.notice.object, text, error.notice.remedy))
            return written
