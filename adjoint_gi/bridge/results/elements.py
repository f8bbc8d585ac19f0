# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of element methods as objects made of the elements: walls cut into pieces, with a colour wherever pieces meet."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...core.base.errors import TargetError, WriteError
from ...core.elements.mesh import ElementMesh
from ...core.scene.arrays import ObjectArrays, SceneArrays
from ..host.meshes import corner_vertices, first_corners, material_slots
from .attribute import WrittenAttribute, check_attribute_target, checked_colors, fill_attribute, place_result_object, result_object
from .preview import own_material


def write_elements(
    obj: bpy.types.Object,
    key: str,
    domain: str,
    scene: SceneArrays,
    index: int,
    mesh: ElementMesh,
    values: np.ndarray,
    covered: np.ndarray,
    *,
    name: str = "Adjoint GI",
    depsgraph: bpy.types.Depsgraph | None = None,
) -> WrittenAttribute:
    """Make or update the object "NAME GI" of `obj` from the faces of `mesh` that lie on object `index` of `scene`.

    `values` (nv, 3) and `covered` (nv,), which becomes alpha, are those of all vertices of `mesh`; `domain` is POINT or CORNER.
    The object stands where `obj` stands, has its materials, is hidden from renders and is found by the link stored on `obj`.
    Raises TargetError when the mesh has changed since it was read, WriteError on a failed read-back.
    """
    depsgraph = depsgraph or bpy.context.evaluated_depsgraph_get()
    colors = checked_colors(obj, domain, name, values, covered)
    if len(colors) != len(mesh.vertices):
        raise WriteError(obj.name, f"{len(colors)} values do not fit the {len(mesh.vertices)} vertices of the elements", "Bake again")
    check_attribute_target(obj, depsgraph, new_object=True)

    # Step 1: the faces of this object, and its vertices from 0 on.
    face = np.flatnonzero(np.asarray(scene.object)[mesh.triangle] == index)
    size = np.diff(mesh.start)[face]
    start = np.cumsum(size) - size
    take = np.repeat(mesh.start[face] - start, size) + np.arange(int(size.sum()))
    used, corners = np.unique(mesh.corners[take], return_inverse=True)
    corners = corners.reshape(-1).astype(np.int32)
    slots = _slots(obj, depsgraph, scene.objects[index], np.asarray(scene.polygon)[mesh.triangle[face]])

    # Step 2: vertices in the space of the object, so that it can be moved like the original. A flat matrix has no inverse.
    matrix = np.array(obj.matrix_world, np.float64)
    flat = not np.linalg.cond(matrix[:3, :3]) < 1e10
    matrix = np.eye(4) if flat else matrix
    inverse = np.linalg.inv(matrix)
    vertices = mesh.vertices[used] @ inverse[:3, :3].T + inverse[:3, 3]
    if np.linalg.det(matrix) < 0:
        corners = corners[_turned(start, size)]

    # Step 3: the mesh that is there already if it has the same faces; other results stay on it then.
    old = result_object(obj)
    data = old.data if old is not None and _same(old.data, len(used), corners, start) else None
    if data is None:
        data = _new_mesh(obj, len(used), corners, start)
    data.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    data.polygons.foreach_set("material_index", slots)
    data.update(calc_edges=True)

    # Step 4: the object, and the colours.
    target = place_result_object(obj, data)
    if flat:
        target.matrix_world = Matrix.Identity(4)
    colors = colors[used]
    return fill_attribute(target, key, domain, name, colors if domain == "POINT" else colors[corners])


def _turned(start: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Order of the corners of faces that begin at `start` (nf,) and have `size` (nf,) of them, each face turned round.

    A mirrored object shows its faces the other way round. The first corner of each stays.
    """
    local = np.arange(int(size.sum())) - np.repeat(start, size)
    return np.repeat(start, size) + np.where(local > 0, np.repeat(size, size) - local, 0)


def _new_mesh(obj: bpy.types.Object, vertices: int, corners: np.ndarray, start: np.ndarray) -> bpy.types.Mesh:
    """A mesh of these faces with the materials of `obj`; its vertices have no place yet."""
    data = bpy.data.meshes.new(obj.name + " GI")
    data.vertices.add(vertices)
    data.loops.add(len(corners))
    data.polygons.add(len(start))
    data.loops.foreach_set("vertex_index", corners)
    data.polygons.foreach_set("loop_start", start.astype(np.int32))
    for i, slot in enumerate(obj.material_slots):
        data.materials.append(own_material(obj, i, slot.material, obj.data.materials[i])[0])
    # Vertices are double along hard edges, so smooth shading is right everywhere.
    data.polygons.foreach_set("use_smooth", np.ones(len(start), bool))
    return data


def _slots(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, arrays: ObjectArrays, polygon: np.ndarray) -> np.ndarray:
    """(nf,) int32 material slots of these polygons of the evaluated mesh of `obj`."""
    evaluated = obj.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        if mesh is None or len(mesh.polygons) != arrays.polygon_count:
            raise TargetError(obj.name, "was edited meanwhile, so its elements do not fit it", "Bake again")
        slots = material_slots(mesh)
    finally:
        evaluated.to_mesh_clear()
    return np.ascontiguousarray(slots[polygon])


def _same(mesh: bpy.types.Mesh, vertices: int, corners: np.ndarray, start: np.ndarray) -> bool:
    """Whether `mesh` has just these faces."""
    if (len(mesh.vertices), len(mesh.loops), len(mesh.polygons)) != (vertices, len(corners), len(start)):
        return False
    return np.array_equal(corner_vertices(mesh), corners) and np.array_equal(first_corners(mesh), start)
