# SPDX-License-Identifier: GPL-3.0-or-later
"""Remembers the objects a bake is for, without holding them, and reports later whether they are still the same."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.base.errors import AdjointError, Notice
from ..host.meshes import corner_vertices, positions
from ..results.lightmap_uv import layer_values


@dataclass(frozen=True)
class Print:
    """What is remembered of one object: counts and a checksum of its mesh, and a checksum of the UV layer that is baked into."""

    name: str
    counts: tuple[int, int, int]
    shape: int
    uv: int


class Targets:
    """The prints of some objects by session_uid. An object may be renamed meanwhile; it may not be deleted or edited.

    `layers` names, by session_uid, the UV layer that an object is baked into, if any.
    """

    def __init__(self, objects: Iterable[bpy.types.Object], layers: Mapping[int, str] | None = None) -> None:
        self._layers = layers or {}
        self._prints = {o.session_uid: Print(o.name, _counts(o.data), _shape(o.data), self._uv(o)) for o in objects}

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
            elif not self._same_layer(now, seen, thorough):
                out.append(Notice(now.name, "had the UV layer changed that it is baked into", "Undo that or bake again", "error"))
        return out

    def _same_layer(self, now: bpy.types.Object, seen: Print, thorough: bool) -> bool:
        name = self._layers.get(now.session_uid, "")
        return not name or (layer_values(now, name) is not None and (not thorough or self._uv(now) == seen.uv))

    def _uv(self, obj: bpy.types.Object) -> int:
        """Checksum of the UV layer, 0 where there is none."""
        values = layer_values(obj, self._layers.get(obj.session_uid, ""))
        return 0 if values is None else zlib.crc32(values.tobytes())


def unchanged() -> Callable[[], None]:
    """What raises `AdjointError` when the scene of the context is another one than now."""
    seen = fingerprint(bpy.context)

    def same() -> None:
        if fingerprint(bpy.context) != seen:
            raise AdjointError("Scene", "was changed while the bake was prepared", "Bake again")

    return same


def fingerprint(context: bpy.types.Context) -> tuple:
    """What tells whether objects have come, gone, moved or been edited in the scene of `context` between two looks, cheap to take."""
    scene, layer = context.scene, context.view_layer
    layer.update()  # after a removal its list of objects has a hole until then
    # In Edit Mode the mesh stays as it was until that is left; the mode is seen.
    meshes = {obj.data for obj in layer.objects if obj.type == "MESH"}
    shapes = tuple(sorted((mesh.session_uid, *_counts(mesh), _shape(mesh)) for mesh in meshes))
    return (scene.session_uid, layer.name, scene.frame_current, tuple(_seen(obj) for obj in layer.objects), shapes)


def _seen(obj: bpy.types.Object) -> tuple:
    data = obj.data
    modifiers = tuple((m.name, m.type, m.show_viewport, m.show_render) for m in obj.modifiers)
    place = np.array(obj.matrix_world, np.float32).tobytes()  # bytes: what is no number is equal to itself, too
    return (obj.session_uid, data.session_uid if data else 0, obj.mode, obj.hide_render, modifiers, place)


def _counts(mesh: bpy.types.Mesh) -> tuple[int, int, int]:
    return len(mesh.vertices), len(mesh.loops), len(mesh.polygons)


def _shape(mesh: bpy.types.Mesh) -> int:
    """Checksum of vertex positions and of the vertices of all corners."""
    return zlib.crc32(corner_vertices(mesh), zlib.crc32(positions(mesh)))
