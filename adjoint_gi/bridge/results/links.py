"""What may be written to: checks of objects and meshes before a bake, and the stored links by which results are found again.

Links live in a custom property of the object, `adjoint_gi_results`: one group for each key (usually the quantity) with the image,
the name of the owner and the placement in an atlas. Names of datablocks are never used to find a result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import bpy

from ...core.base.errors import TargetError
from . import real, stored
from .stored import ABOUT, MADE, RESULTS

__all__ = ["ABOUT", "MADE", "RESULTS"]

OBJECT = "object"  # key of the link to the separate object that holds the result


def check_object(obj: bpy.types.Object) -> None:
    """Raise TargetError unless `obj` is a mesh object of this file."""
    if obj.type != "MESH":
        raise TargetError(obj.name, f"is a {obj.type.lower()} and has no mesh to write to", "Convert it to a mesh")
    error = linked(obj, False)
    if error is not None:
        raise error


def check_mesh(obj: bpy.types.Object) -> None:
    """`check_object`, and that the mesh itself may be changed: not linked, and in edit mode on no object."""
    check_object(obj)
    error = linked(obj, True)
    if error is not None:
        raise error
    check_edit_mode(obj)


def check_edit_mode(obj: bpy.types.Object) -> None:
    """Raise TargetError where the mesh of `obj` is in edit mode, on whatever object."""
    if obj.data.is_editmode:
        raise TargetError(obj.name, "its mesh is in edit mode", "Leave edit mode first")


def linked(obj: bpy.types.Object, mesh: bool) -> TargetError | None:
    """Why a mesh object (with `mesh`, or its mesh) belongs to another file and cannot keep a result; None when it can."""
    if not obj.is_editable or obj.library is not None:
        return TargetError(obj.name, "is linked from another file and cannot keep a result", "Make it local, or bake in its own file")
    if obj.override_library is not None:
        return TargetError(obj.name, "is a library override and cannot keep a result", "Make it local, or bake in its own file")
    data = obj.data
    if mesh and (not data.is_editable or data.library is not None or data.override_library is not None):
        reason = f'its mesh "{data.name}" is linked from another file, where changes would be lost'
        return TargetError(obj.name, reason, "Make the mesh local (Make Single User)")
    return None


def missing(obj: bpy.types.Object) -> tuple[str, str]:
    """Reason and remedy for an empty that stands for an object that could not be linked."""
    library = obj.library
    if library is None or not library.is_missing:
        return "is not in its library file any more and is left out", "Link it again, or remove it"
    return f'is left out: its library file is missing ("{library.filepath}")', "Put the file back, or relocate it in the outliner"


def results() -> set[bpy.types.Object]:
    """All objects that bakes have made to hold their results: nothing is baked to these.

    One holds the result of the object that has a link to it, or was made of an instance or a curve. A mark alone makes no result: a copy
    has that of its original, and is the user's.
    """
    marked = {o for o in bpy.data.objects if stored.read(o, MADE) is not None}
    if not marked:
        return marked
    return {o for o in marked if real.is_real(o)} | (marked & set(originals()))


def originals() -> dict[bpy.types.Object, bpy.types.Object]:
    """By every object that holds the result of another, whose it is."""
    entries = {o: link(o, OBJECT) for o in bpy.data.objects if RESULTS in o}
    return {entry["made"]: o for o, entry in entries.items() if entry is not None and entry.get("made") is not None}


def sharing(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """The other objects that use the same mesh."""
    return list(_sharing(obj))


def shares(obj: bpy.types.Object) -> bool:
    """Whether another object uses the same mesh: of thousands that do, the first that is met answers."""
    return next(_sharing(obj), None) is not None


def _sharing(obj: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """`sharing`, one after another."""
    return (other for other in bpy.data.objects if other.data == obj.data and other != obj) if obj.data.users > 1 else iter(())


def link(obj: bpy.types.Object, key: str) -> Any | None:
    """The stored group of `key` if `obj` owns it; a copy of an object carries links that are its original's."""
    entry = stored.entry(obj, RESULTS, key)
    if entry is None or entry["owner"] == obj.name:
        return entry
    # Renamed: no other object has this datablock, so it is still ours. Copied: the original has it.
    made = _datablocks(obj, key)
    shared = any(made & _datablocks(other, key) for other in bpy.data.objects if other != obj)
    return None if shared else entry


def store(obj: bpy.types.Object, key: str, **values: Any) -> None:
    """Replace the stored group of `key`."""
    if stored.read(obj, RESULTS) is None:
        obj[RESULTS] = {}
    entry = {k: v for k, v in values.items() if not isinstance(v, bpy.types.ID)}
    obj[RESULTS][key] = {"owner": obj.name, **entry}
    for k, v in values.items():
        if isinstance(v, bpy.types.ID):
            obj[RESULTS][key][k] = v  # an ID inside a dict literal is refused by older versions


def forget(obj: bpy.types.Object, keys: Sequence[str] | None = None) -> None:
    """Drop the links of `keys` (all when None), and the property itself when nothing is left in it."""
    group = stored.read(obj, RESULTS)
    if group is None:
        return
    for key in list(group.keys()) if keys is None else keys:
        if key in group:
            del group[key]
    if not group.keys():
        del obj[RESULTS]


def keys(obj: bpy.types.Object) -> list[str]:
    """Keys of all stored results."""
    return stored.keys(obj, RESULTS)


def _datablocks(obj: bpy.types.Object, key: str) -> set[bpy.types.ID]:
    entry = stored.entry(obj, RESULTS, key)
    return {v for v in entry.values() if isinstance(v, bpy.types.ID)} if entry is not None else set()
