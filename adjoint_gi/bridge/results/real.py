# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that a bake has made of instances, and of curves and the like, so that each has texels of its own: found again, removed.

They stand in a collection of the scene and are in no light by themselves, because they are hidden in renders: in a bake the extraction
takes the instance that each was made of, and gives it the mesh of the object. In the viewport they are hidden too, until Show Result.
Which instance it is stands in a custom property: its name as extraction gives it, "Source[Maker.2.0]". What is no mesh, such as a curve,
is an instance of the mesh it evaluates to, made by itself; the property says what it was.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import bpy
import numpy as np

from ...core.base.errors import TargetError
from ..host.meshes import copied
from . import stored
from .stored import REAL, REALS

BECOMES_MESH = {"CURVE", "FONT", "SURFACE", "META"}  # what has faces once it is evaluated
WORDS = {"FONT": "text", "META": "metaball", "CURVES": "hair curves object", "POINTCLOUD": "point cloud"}


def is_real(obj: bpy.types.Object) -> bool:
    """Whether a bake has made `obj` of an instance, or of what is no mesh. One that renders show is the user's own, such as a copy."""
    return _state(obj) is not None


def _state(obj: bpy.types.Object) -> Any | None:
    """The stored group of an object that stands for something: such objects are hidden in renders."""
    return stored.read(obj, REAL) if obj.hide_render else None


def is_whole(obj: bpy.types.Object) -> bool:
    """Whether a bake has made `obj` of a whole object that is no mesh."""
    state = _state(obj)
    return state is not None and bool(state.get("kind"))


def standing_for(obj: bpy.types.Object) -> bpy.types.Object:
    """The user's object that `obj` was made of, where that is no mesh; else `obj` itself."""
    return (maker_of(obj) or obj) if is_whole(obj) else obj


def maker_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """Who made the instance that `obj` stands for; None where it was deleted."""
    state = _state(obj)
    return state.get("maker") if state is not None else None


def maker_name(obj: bpy.types.Object) -> str:
    """The name of `maker_of`, empty where there is none."""
    maker = maker_of(obj)
    return maker.name if maker is not None else ""


def instance_name(obj: bpy.types.Object) -> str:
    """The name that extraction has for the instance that `obj` was made of."""
    return stored.read(obj, REAL)["instance"]


def key(obj: bpy.types.Object) -> str | int:
    """By what it is found again: the session_uid of the whole object, which may have got another name, or the name of the instance."""
    maker = maker_of(obj)
    return maker.session_uid if is_whole(obj) and maker is not None else instance_name(obj)


def is_own(obj: bpy.types.Object) -> bool:
    """Whether it stands for the faces of the instancer itself."""
    return maker_of(obj) is not None and not is_whole(obj) and instance_name(obj) == maker_name(obj)


def placed(obj: bpy.types.Object, matrix: list[float]) -> list[float]:
    """The flat 4 x 4 matrix that brings the mesh of `obj` to where its instance is, whose matrix is `matrix`.

    Of a sheared one, which no object can have, the mesh is in world space already.
    """
    return np.eye(4).ravel().tolist() if stored.read(obj, REAL)["sheared"] else matrix


def collection_of(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The collection that holds them."""
    return next((c for c in scene.collection.children if stored.read(c, REALS)), None)


def collection_name(scene: bpy.types.Scene) -> str:
    """What it is called, or will be."""
    collection = collection_of(scene)
    return collection.name if collection is not None else f"{scene.name} GI Objects"


def objects_of(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """All of them in `scene`. Of several for the same thing it is the first: the others are copies that the user made of it."""
    collection = collection_of(scene)
    first = {key(o): o for o in reversed(collection.objects.values()) if o.type == "MESH" and is_real(o)} if collection is not None else {}
    return list(reversed(first.values()))


def of_makers(scene: bpy.types.Scene, names: Iterable[str]) -> list[bpy.types.Object]:
    """Those that stand for the makers `names` or for their instances, or all where there are no names."""
    wanted = set(names)
    return [o for o in objects_of(scene) if not wanted or maker_name(o) in wanted]


def may_become_mesh(obj: bpy.types.Object) -> bool:
    """Whether an object that is no mesh can have faces once it is evaluated."""
    return obj.type in BECOMES_MESH or (obj.type not in ("MESH", "EMPTY") and any(m.type == "NODES" for m in obj.modifiers))


def described(obj: bpy.types.Object) -> str:
    """What the kind of `obj` is called, with its article."""
    word = WORDS.get(obj.type, obj.type.lower().replace("_", " "))
    return f"an {word}" if word[0] in "aeiou" else f"a {word}"


def locked(obj: bpy.types.Object) -> TargetError | None:
    """Why `obj` cannot be hidden in favour of what is made of it, so that nothing is: it belongs to another file."""
    if obj.library is None and obj.override_library is None and obj.is_editable:
        return None
    return TargetError(obj.name, "is linked from another file, or overrides what is", "Make it local")


def surface_owner(obj: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.Object:
    """Of a metaball the one whose the surface is, which all of one name form together: the first by number. Else `obj` itself."""
    if obj.type != "META":
        return obj
    name = _name_and_number(obj)[0]
    family = [o for o in scene.objects if o.type == "META" and _name_and_number(o)[0] == name]
    return min([*family, obj], key=lambda o: _name_and_number(o)[1])


def _name_and_number(obj: bpy.types.Object) -> tuple[str, int]:
    head, _, tail = obj.name.rpartition(".")
    return (head, int(tail)) if head and tail.isdecimal() else (obj.name, 0)


def may_make(obj: bpy.types.Object) -> bool:
    """Whether an object that is no mesh can have instances."""
    return obj.is_instancer or any(m.type == "NODES" for m in obj.modifiers)


@contextlib.contextmanager
def in_place(objects: Sequence[bpy.types.Object], view_layer: bpy.types.ViewLayer) -> Iterator[None]:
    """Those of `objects` that were made of whole objects stand for these in renders for a while, as for a bake by Cycles."""
    whole = {o: maker_of(o) for o in objects if is_whole(o) and maker_of(o) is not None}
    shown = [(o, o.hide_render, o.hide_viewport) for o in (*whole, *whole.values())]
    try:
        for obj, maker in whole.items():
            obj.hide_render = obj.hide_viewport = False
            maker.hide_render = True
        view_layer.update()
        yield
    finally:
        for obj, render, viewport in shown:
            obj.hide_render, obj.hide_viewport = render, viewport
        view_layer.update()


def rest(scene: bpy.types.Scene) -> None:
    """Hide all of them."""
    for obj in objects_of(scene):
        obj.hide_viewport = True


def remove(scene: bpy.types.Scene) -> int:
    """Remove all of them with their meshes and the collection; returns their number. What another scene shows too stays there."""
    collection = collection_of(scene)
    if collection is None:
        return 0
    if any(c == collection for s in bpy.data.scenes if s != scene for c in s.collection.children_recursive):
        scene.collection.children.unlink(collection)
        return 0
    made = objects_of(scene)
    remove_objects([o.session_uid for o in made])
    if collection.objects or collection.children:
        del collection[REALS]  # the user has put something into it
    else:
        bpy.data.collections.remove(collection)
    return len(made)


def remove_objects(uids: Iterable[int]) -> None:
    """Remove the mesh objects of these session_uids that are still there, with their meshes."""
    wanted = set(uids)
    objects = [o for o in bpy.data.objects if o.session_uid in wanted] if wanted else []
    meshes = {o.data for o in objects}
    bpy.data.batch_remove(objects)
    bpy.data.batch_remove([m for m in meshes if m.users == 0])


def checksum(mesh: bpy.types.Mesh) -> str:
    """Of all that extraction reads of a mesh but its materials."""
    parts = [(mesh.vertices, "co", 3, np.float32), (mesh.loops, "vertex_index", 1, np.int32), (mesh.polygons, "loop_start", 1, np.int32)]
    parts += [(mesh.polygons, "material_index", 1, np.int32), (mesh.corner_normals, "vector", 3, np.float32)]
    parts += [(layer.uv, "vector", 2, np.float32) for layer in mesh.uv_layers]
    parts += [(layer.data, "color", 4, np.float32) for layer in mesh.color_attributes]
    names = [layer.name for layer in (*mesh.uv_layers, *mesh.color_attributes)]
    total = zlib.crc32(repr(names).encode())
    for part in parts:
        total = zlib.crc32(copied(*part), total)
    return f"{total:08x}"
