"""Results as a float colour attribute on the vertices or corners of a mesh."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...core.base.atomic import require_finite
from ...core.base.errors import Notice, TargetError, WriteError
from ..host.meshes import copied, corner_vertices
from . import links as targets
from . import stored
from .stored import ADDED

# Custom property of the mesh: key -> JSON list of our attributes, the one written last at the end. Each has the name that was wanted,
# the name it has, and a checksum of what was written, by which it is found after the user has renamed it.
STORED = stored.ATTRIBUTES
OBJECT = targets.OBJECT
# Modifiers that move vertices or change data but never add, remove or reorder any.
KEEPS_TOPOLOGY = {
    "ARMATURE",
    "CAST",
    "CLOTH",
    "CORRECTIVE_SMOOTH",
    "CURVE",
    "DATA_TRANSFER",
    "DISPLACE",
    "HOOK",
    "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH",
    "LATTICE",
    "MESH_CACHE",
    "MESH_DEFORM",
    "NORMAL_EDIT",
    "SHRINKWRAP",
    "SIMPLE_DEFORM",
    "SMOOTH",
    "SOFT_BODY",
    "SURFACE_DEFORM",
    "UV_PROJECT",
    "UV_WARP",
    "VERTEX_WEIGHT_EDIT",
    "VERTEX_WEIGHT_MIX",
    "VERTEX_WEIGHT_PROXIMITY",
    "WARP",
    "WAVE",
    "WEIGHTED_NORMAL",
}


@dataclass(frozen=True)
class WrittenAttribute:
    """Where a result went: the object (another one for `new_object`) and the name of the attribute.

    `taken` says that a new attribute got another name than was wanted, because something else has that one.
    """

    object: bpy.types.Object
    attribute: str
    taken: Notice | None = None


class NotOnMesh(TargetError):
    """A result cannot go to the object's own mesh; `kind` says why in words that are the same for many objects."""

    def __init__(self, object: str, reason: str, remedy: str, kind: str) -> None:
        super().__init__(object, reason, remedy)
        self.kind = kind


def check_attribute_target(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, new_object: bool = False) -> None:
    """Raise TargetError, or NotOnMesh, unless a result for the evaluated mesh of `obj` can be written to its own mesh (or to a new object).

    Called before the bake, because an answer after it would come too late.
    """
    targets.check_object(obj)
    if new_object:
        return
    targets.check_mesh(obj)
    others = targets.sharing(obj)
    if others:
        names = ", ".join(o.name for o in others[:4]) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
        raise NotOnMesh(
            obj.name, f'shares its mesh "{obj.data.name}" with {names}, and an attribute can hold one result only',
            "Make it a single user, bake to textures, or make a new object",
            "shares its mesh with other objects, and an attribute can hold one result only",
        )  # fmt: skip
    if not same_topology(obj, depsgraph):
        active = [m.name for m in obj.modifiers if _enabled(m) and m.type not in KEEPS_TOPOLOGY]
        cause = "modifier " + ", ".join(active) if active else "its evaluation"
        raise NotOnMesh(
            obj.name, f"{cause} changes its vertices or faces, so values cannot go back to the original mesh",
            "Apply the modifier, bake to a texture, or make a new object",
            "has modifiers that change its vertices or faces, so values cannot go back to the original mesh",
        )  # fmt: skip


def same_topology(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Whether the evaluated mesh has the vertices and corners of the original in the same order."""
    original, evaluated = obj.data, obj.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        if mesh is None or len(mesh.vertices) != len(original.vertices) or len(mesh.loops) != len(original.loops):
            return False
        return np.array_equal(corner_vertices(mesh), corner_vertices(original))
    finally:
        evaluated.to_mesh_clear()


def write_attribute(
    obj: bpy.types.Object,
    key: str,
    domain: str,
    values: np.ndarray,
    covered: np.ndarray,
    *,
    name: str = "Adjoint GI",
    depsgraph: bpy.types.Depsgraph | None = None,
    new_object: bool = False,
) -> WrittenAttribute:
    """Write `values` (n, 3) for the POINT or CORNER `domain` of the evaluated mesh, with `covered` (n,) as alpha.

    Our own attribute for `key` that was made for this `name` is updated, also when the user has renamed it; otherwise a new one is
    made, which gets a number if something else has the name already.
    With `new_object` the evaluated mesh becomes the mesh of a separate object "NAME GI", hidden from renders so that it does not
    take part in the next bake. Raises TargetError when the mesh has changed since it was read, WriteError on a failed read-back.
    """
    depsgraph = depsgraph or bpy.context.evaluated_depsgraph_get()
    colors = checked_colors(obj, domain, name, values, covered)
    check_attribute_target(obj, depsgraph, new_object)
    if new_object:
        mesh = bpy.data.meshes.new_from_object(obj.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph)
    else:
        mesh = obj.data
    expected = len(mesh.vertices) if domain == "POINT" else len(mesh.loops)
    if len(colors) != expected:
        if new_object:
            bpy.data.meshes.remove(mesh)
        raise TargetError(
            obj.name, f"has {expected} values to fill but the result has {len(colors)}: it was edited meanwhile", "Bake again"
        )
    target = place_result_object(obj, mesh) if new_object else obj
    return fill_attribute(target, key, domain, name, colors)


def write_to_copy(
    obj: bpy.types.Object, key: str, domain: str, values: np.ndarray, covered: np.ndarray, *, name: str, reason: TargetError
) -> WrittenAttribute:
    """The same on the separate object "NAME GI" with a copy of the mesh as it is without modifiers; raises `reason`, why `obj` itself
    cannot hold the values, where they do not fit that mesh either."""
    colors = checked_colors(obj, domain, name, values, covered)
    if obj.type != "MESH" or len(colors) != (len(obj.data.vertices) if domain == "POINT" else len(obj.data.loops)):
        raise reason
    return fill_attribute(place_result_object(obj, obj.data.copy()), key, domain, name, colors)


def checked_colors(obj: bpy.types.Object, domain: str, name: str, values: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """(n, 4) float32 of `values` (n, 3) with `covered` (n,) as alpha, for the attribute `name`.

    Raises TargetError for an unknown domain, WriteError for shapes that do not fit together and values that are not finite.
    """
    if domain not in ("POINT", "CORNER"):
        raise TargetError(obj.name, f"{domain!r} is not a domain of color attributes", "Choose POINT or CORNER")
    values, covered = np.asarray(values, np.float32), np.asarray(covered, np.float32)
    if values.ndim != 2 or values.shape[1] != 3 or covered.shape != values.shape[:1]:
        raise WriteError(obj.name, f"values {values.shape} and coverage {covered.shape} do not fit together", "Give (n, 3) and (n,)")
    require_finite(f"{obj.name} {name}", values)
    return np.concatenate([values, covered[:, None]], axis=1)


def fill_attribute(obj: bpy.types.Object, key: str, domain: str, name: str, colors: np.ndarray) -> WrittenAttribute:
    """Write `colors` (n, 4) float32 to our attribute for `key` and `name` on `obj`, new or reused. Raises TargetError, WriteError."""
    mesh = obj.data
    attribute, is_new = _attribute(mesh, key, domain, name)
    data = np.ascontiguousarray(colors, np.float32)
    attribute.data.foreach_set("color", data.ravel())
    mesh.update()
    made = attribute.name
    if not np.array_equal(_values(attribute).ravel().view(np.uint32), data.ravel().view(np.uint32)):
        raise WriteError(obj.name, f'attribute "{made}" does not hold the values that were written', "Bake again")
    others = [e for e in _entries(mesh, key) if made != e["name"] and name != e["wanted"]]
    if stored.read(mesh, STORED) is None:
        mesh[STORED] = {}
    mesh[STORED][key] = json.dumps([*others, {"wanted": name, "name": made, "sum": zlib.crc32(data.tobytes())}])
    return WrittenAttribute(obj, made, _taken(obj, name) if is_new and made != name else None)


def name_taken(obj: bpy.types.Object, key: str, name: str) -> Notice | None:
    """That a new attribute `name` on the mesh of `obj` will get a number, because something else is called so; None where it does not."""
    if any(entry["wanted"] == name and _find(obj.data, entry) is not None for entry in _entries(obj.data, key)):
        return None
    return _taken(obj, name) if name in obj.data.attributes or name in obj.vertex_groups else None


def _taken(obj: bpy.types.Object, name: str) -> Notice:
    """The words about that, the same before the bake and after it."""
    reason = f'has something else called "{name}", so the attribute of the result gets a number'
    return Notice(obj.name, reason, "Rename one of them, or choose another name in Output", "warning")


def linked_attribute(obj: bpy.types.Object, key: str) -> str | None:
    """Name of our attribute for `key` on the object's mesh, the one written last if there are several, or None."""
    found = [_find(obj.data, entry) for entry in _entries(obj.data, key)[-1:]] if obj.type == "MESH" else []
    return found[0].name if found and found[0] is not None else None


def result_object(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The separate object that holds the result of `obj`, or None."""
    entry = targets.link(obj, OBJECT)
    return entry.get("made") if entry is not None else None


def remove_attributes(obj: bpy.types.Object) -> int:
    """Remove all our attributes from the object's mesh; returns how many."""
    mesh, removed = obj.data, 0
    if stored.read(mesh, STORED) is None:
        return 0
    for key in stored.keys(mesh, STORED):
        for entry in _entries(mesh, key):
            attribute = _find(mesh, entry)
            if attribute is not None:
                mesh.attributes.remove(attribute)
                removed += 1
    for name in (STORED, targets.ABOUT):
        if name in mesh:
            del mesh[name]
    return removed


def remove_result_object(obj: bpy.types.Object) -> bool:
    """Remove the separate object that holds the result of `obj`, with its mesh; returns whether there was one."""
    made = result_object(obj)
    targets.forget(obj, [OBJECT])
    if made is None:
        return False
    mesh = made.data
    bpy.data.objects.remove(made)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    return True


def _entries(mesh: bpy.types.Mesh, key: str) -> list[dict[str, Any]]:
    """What is stored of our attributes for `key`, the one written last at the end."""
    return stored.entry(mesh, STORED, key) or []


def _find(mesh: bpy.types.Mesh, entry: dict[str, Any]) -> bpy.types.Attribute | None:
    """The attribute of a stored entry: by its name, or, where none has that, the one that still holds what was written."""
    found = mesh.attributes.get(entry["name"])
    if found is not None:
        return found if found.data_type == "FLOAT_COLOR" else None
    # Attributes have no identity but their name.
    colors = [a for a in mesh.color_attributes if a.data_type == "FLOAT_COLOR"]
    return next((a for a in colors if zlib.crc32(_values(a).tobytes()) == entry["sum"]), None)


def _values(attribute: bpy.types.Attribute) -> np.ndarray:
    """(n, 4) float32 of a colour attribute."""
    return copied(attribute.data, "color", 4, np.float32)


def _attribute(mesh: bpy.types.Mesh, key: str, domain: str, name: str) -> tuple[bpy.types.Attribute, bool]:
    """Our attribute for `key` and `name`, and whether it is new; which colours are active and rendered stays as chosen by the user."""
    colors = mesh.color_attributes
    chosen = colors.active_color_name, colors.default_color_name
    old = next((_find(mesh, entry) for entry in _entries(mesh, key) if entry["wanted"] == name), None)
    if old is not None and old.domain == domain:
        return old, False
    was_chosen, title = False, name
    if old is not None:  # from a bake to the other domain
        was_chosen, title = old.name in chosen, old.name
        mesh.attributes.remove(old)
    # Where a vertex group has the name, Blender adds none.
    titles = (title, *(f"{title}.{k:03}" for k in range(1, 1000)))
    made = next((made for made in (mesh.attributes.new(t, "FLOAT_COLOR", domain) for t in titles) if made is not None), None)
    if made is None:
        raise TargetError(mesh.name, f'no attribute "{name}" could be added', "Remove another attribute or choose another name")
    made_name = made.name
    if chosen[0] and not was_chosen:
        colors.active_color_name = chosen[0]
    if chosen[1] and not was_chosen:
        colors.default_color_name = chosen[1]
    return mesh.attributes[made_name], old is None


def place_result_object(obj: bpy.types.Object, mesh: bpy.types.Mesh) -> bpy.types.Object:
    """The separate object of `obj`, new or reused, with `mesh` as its mesh and the place of `obj`."""
    mesh.name = obj.name + " GI"
    made = result_object(obj)
    if made is None:
        made = bpy.data.objects.new(obj.name + " GI", mesh)
        made.hide_render = True
        made[targets.MADE] = True
        targets.store(obj, OBJECT, made=made)
    else:
        old = made.data
        if stored.read(old, ADDED) is not None and not mesh.materials:  # the preview goes on
            mesh.materials.append(None)
            mesh[ADDED] = True
        made.data = mesh
        if old != mesh and old.users == 0:
            bpy.data.meshes.remove(old)
    if not made.users_collection:  # new, or deleted by the user, when the link alone keeps it
        for collection in obj.users_collection:
            collection.objects.link(made)
    made.matrix_world = obj.matrix_world.copy()
    return made


def _enabled(modifier: bpy.types.Modifier) -> bool:
    return modifier.show_viewport or modifier.show_render
