"""What Blender stores of a mesh, copied in one call each, in the quickest way that there is.

Attributes are copied as they lie in memory; the same values by `vertices`, `loops` and `polygons` take a call for each of them, a hundred
times as long (measured on 4.2, 5.0 and 5.2). In edit mode attributes are empty, and the slow way is left.
"""

from __future__ import annotations

import bpy
import numpy as np


def copied(collection: bpy.types.bpy_prop_collection, name: str, width: int, dtype: type) -> np.ndarray:
    """(n,) or (n, width) array of one property of all items."""
    out = np.empty(len(collection) * width, dtype)
    collection.foreach_get(name, out)
    return out if width == 1 else out.reshape(-1, width)


def positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """(nv, 3) float32 places of the vertices."""
    stored = _stored(mesh, "position", "POINT", "FLOAT_VECTOR", len(mesh.vertices))
    return copied(mesh.vertices, "co", 3, np.float32) if stored is None else copied(stored.data, "vector", 3, np.float32)


def corner_vertices(mesh: bpy.types.Mesh) -> np.ndarray:
    """(nc,) int32 vertex of each corner (loop)."""
    stored = _stored(mesh, ".corner_vert", "CORNER", "INT", len(mesh.loops))
    return copied(mesh.loops, "vertex_index", 1, np.int32) if stored is None else copied(stored.data, "value", 1, np.int32)


def material_slots(mesh: bpy.types.Mesh) -> np.ndarray:
    """(np,) int32 material slot of each polygon as it is stored."""
    return _of_polygons(mesh, "material_index", "INT", "material_index", np.int32)


def selected(mesh: bpy.types.Mesh) -> np.ndarray:
    """(np,) bool: whether each polygon is selected."""
    return _of_polygons(mesh, ".select_poly", "BOOLEAN", "select", bool)


def first_corners(mesh: bpy.types.Mesh) -> np.ndarray:
    """(np,) int32 first corner of each polygon."""
    return copied(mesh.polygons, "loop_start", 1, np.int32)


def triangle_corners(mesh: bpy.types.Mesh) -> np.ndarray:
    """(nt, 3) int32 corners of the triangles that Blender cuts the polygons into."""
    if len(mesh.loops) == 3 * len(mesh.polygons) and (first_corners(mesh) == np.arange(0, len(mesh.loops), 3)).all():
        return np.arange(len(mesh.loops), dtype=np.int32).reshape(-1, 3)
    return copied(mesh.loop_triangles, "loops", 3, np.int32)


def triangle_polygons(mesh: bpy.types.Mesh) -> np.ndarray:
    """(nt,) int32 polygon of each of these triangles. They lie in the order of the polygons, two fewer than each has corners."""
    sizes = np.diff(first_corners(mesh), append=len(mesh.loops))
    if (sizes >= 3).all() and int(sizes.sum()) - 2 * len(sizes) == len(mesh.loop_triangles):
        return np.repeat(np.arange(len(sizes), dtype=np.int32), sizes - 2)
    return copied(mesh.loop_triangles, "polygon_index", 1, np.int32)


def _of_polygons(mesh: bpy.types.Mesh, attribute: str, kind: str, name: str, dtype: type) -> np.ndarray:
    """(np,) of an attribute, or where it cannot be read so, of the property `name`."""
    stored = _stored(mesh, attribute, "FACE", kind, len(mesh.polygons))
    if stored is not None:
        return copied(stored.data, "value", 1, dtype)
    if mesh.attributes.get(attribute) is None and _stored(mesh, ".corner_vert", "CORNER", "INT", len(mesh.loops)) is not None:
        return np.zeros(len(mesh.polygons), dtype)  # what is not stored is 0 for all
    return copied(mesh.polygons, name, 1, dtype)


def _stored(mesh: bpy.types.Mesh, name: str, domain: str, kind: str, count: int) -> bpy.types.Attribute | None:
    """The attribute `name` if it is of this kind and can be read."""
    found = mesh.attributes.get(name)
    fits = found is not None and (found.domain, found.data_type, len(found.data)) == (domain, kind, count)
    return found if fits else None
