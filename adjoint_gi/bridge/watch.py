# SPDX-License-Identifier: GPL-3.0-or-later
"""Remembers the objects a bake is for, without holding them, and tells later whether they are still the same."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.errors import Notice


@dataclass(frozen=True)
class Print:
    """What is remembered of one object; `shape` is a checksum of the positions and faces of its mesh."""

    name: str
    counts: tuple[int, int, int]
    shape: int


class Targets:
    """The prints of some objects by session_uid. An object may be renamed meanwhile; it may not be deleted or edited."""

    def __init__(self, objects: Iterable[bpy.types.Object]) -> None:
        self._prints = {o.session_uid: Print(o.name, _counts(o.data), _shape(o.data)) for o in objects}

    def problems(self, thorough: bool = True) -> list[Notice]:
        """Why a result can no longer be written to its objects; empty when it can. Without `thorough`, positions are not compared."""
        present = {o.session_uid: o for o in bpy.data.objects}
        out = []
        for uid, seen in self._prints.items():
            now = present.get(uid)
            if now is None:
                out.append(Notice(seen.name, "was deleted while it was baked", "Undo the deletion or bake again", "error"))
            elif now.mode == "EDIT":
                out.append(Notice(now.name, "is in Edit Mode", "Leave Edit Mode, then press Write Result", "error"))
            elif _counts(now.data) != seen.counts or (thorough and _shape(now.data) != seen.shape):
                out.append(Notice(now.name, "had its mesh edited while it was baked", "Undo the edit or bake again", "error"))
        return out


def mesh_objects(names: Iterable[str], view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """The mesh objects called `names`, or all that are rendered when no name is given."""
    wanted = set(names)
    return [o for o in view_layer.objects if o.type == "MESH" and (o.name in wanted if wanted else not o.hide_render)]


def _counts(mesh: bpy.types.Mesh) -> tuple[int, int, int]:
    return len(mesh.vertices), len(mesh.loops), len(mesh.polygons)


def _shape(mesh: bpy.types.Mesh) -> int:
    """Checksum of vertex positions and of the vertices of all corners."""
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", positions)
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    return zlib.crc32(corners.tobytes(), zlib.crc32(positions.tobytes()))
