# SPDX-License-Identifier: GPL-3.0-or-later
"""Results on objects made of what was solved: of elements, walls cut into pieces with a colour wherever pieces meet; or of the faces of an
object that was edited during its bake."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ...core.base.errors import TargetError, WriteError
from ...core.elements.mesh import ElementMesh
from ...core.scene.arrays import ObjectArrays, SceneArrays
from ..host.meshes import corner_vertices, first_corners, material_slots
from . import links as targets
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
    edited: bool = False,
) -> WrittenAttribute:
    """Make or update the object "NAME GI" of `obj` from the faces of `mesh` that lie on object `index` of `scene`.

    `values` (nv, 3) and `covered` (nv,), which becomes alpha, are those of all vertices of `mesh`; `domain` is POINT or CORNER.
    The object stands where `obj` stands, has its materials, is hidden from renders and is found by the link stored on `obj`.
    Raises TargetError when the mesh has changed since it was read, unless it is known to be `edited`; WriteError on a failed read-back.
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
    triangle = mesh.triangle[face]
    polygon = np.asarray(scene.polygon)[triangle]
    slots = _slots_by_name(obj, scene, triangle) if edited else _slots(obj, depsgraph, scene.objects[index], polygon)

    # Step 2: the faces of elements are wound as they are seen in the world.
    if np.linalg.det(_matrix(obj)[0]) < 0:
        corners = corners[_turned(start, size)]
    # Vertices are double along hard edges, so smooth shading is right everywhere.
    faces = ResultFaces(mesh.vertices[used], corners, start, slots, np.ones(len(start), bool))
    colors = colors[used]
    return _write_faces(obj, key, domain, name, faces, colors if domain == "POINT" else colors[corners])


def write_as_baked(
    obj: bpy.types.Object, key: str, domain: str, scene: SceneArrays, index: int, values: np.ndarray, covered: np.ndarray, *, name: str
) -> WrittenAttribute:
    """The same from the faces that object `index` of `scene` had when it was read, whatever it has now.

    `values` (n, 3) and `covered` (n,) are those of its vertices or corners then. Faces without an area are left out.
    """
    targets.check_object(obj)
    colors, own = checked_colors(obj, domain, name, values, covered), scene.objects[index]
    # Step 1: corners as the mesh had them, those of a face one after another.
    triangle, corner = scene.triangles[own.triangles].astype(np.int64), scene.corners[own.triangles].astype(np.int64)
    vertex, first = np.full(own.corner_count, -1, np.int64), np.full(own.corner_count, -1, np.int64)
    vertex[corner] = triangle - own.first_vertex
    first[corner] = np.arange(len(corner))[:, None]  # any triangle of the face
    there = np.flatnonzero(vertex >= 0)
    polygon, of = np.asarray(scene.polygon)[own.triangles], first[there]
    start = np.flatnonzero(np.diff(polygon[of], prepend=-1))
    # Step 2: the faces.
    vertices, chosen = scene.vertices[own.first_vertex : own.first_vertex + own.vertex_count], own.first_triangle + of[start]
    slots, smooth = _slots_by_name(obj, scene, chosen), np.asarray(scene.smooth)[chosen]
    faces = ResultFaces(vertices, vertex[there].astype(np.int32), start, slots, smooth)
    return _write_faces(obj, key, domain, name, faces, colors if domain == "POINT" else colors[there])


@dataclass(frozen=True, eq=False)
class ResultFaces:
    """Faces in world space: `vertices` (nv, 3), the vertices of the `corners` (nc,) int32 of faces that begin at `start` (nf,), their
    material `slots` (nf,) int32, and whether they are `smooth` (nf,) bool."""

    vertices: np.ndarray
    corners: np.ndarray
    start: np.ndarray
    slots: np.ndarray
    smooth: np.ndarray


def _matrix(obj: bpy.types.Object) -> tuple[np.ndarray, bool]:
    """The matrix of `obj`, and whether it is flat and has no inverse; then that of the world."""
    matrix = np.array(obj.matrix_world, np.float64)
    flat = not np.linalg.cond(matrix[:3, :3]) < 1e10
    return np.eye(4) if flat else matrix, flat


def _write_faces(obj: bpy.types.Object, key: str, domain: str, name: str, faces: ResultFaces, colors: np.ndarray) -> WrittenAttribute:
    """The object "NAME GI" of `obj` with `faces`, and `colors` (n, 4) on its vertices or corners."""
    # Step 1: vertices in the space of the object, so that it can be moved like the original.
    matrix, flat = _matrix(obj)
    inverse = np.linalg.inv(matrix)
    vertices = faces.vertices @ inverse[:3, :3].T + inverse[:3, 3]

    # Step 2: the mesh that is there already if it has the same faces; other results stay on it then.
    old = result_object(obj)
    data = old.data if old is not None and _same(old.data, len(vertices), faces.corners, faces.start) else None
    if data is None:
        data = _new_mesh(obj, len(vertices), faces.corners, faces.start)
    data.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    data.polygons.foreach_set("material_index", faces.slots)
    data.polygons.foreach_set("use_smooth", faces.smooth)
    data.update(calc_edges=True)

    # Step 3: the object, and the colours.
    target = place_result_object(obj, data)
    if flat:
        target.matrix_world = Matrix.Identity(4)
    return fill_attribute(target, key, domain, name, colors)


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


def _slots_by_name(obj: bpy.types.Object, scene: SceneArrays, triangle: np.ndarray) -> np.ndarray:
    """(n,) int32 slots of `obj` that have the materials which these triangles of `scene` were read with, the first where none has."""
    own = [own_material(obj, i, s.material, obj.data.materials[i])[0] for i, s in enumerate(obj.material_slots)]
    slot = {material.name: k for k, material in reversed(list(enumerate(own))) if material is not None}
    return np.array([slot.get(m.name, 0) for m in scene.materials] or [0], np.int32)[np.asarray(scene.material)[triangle]]


def _same(mesh: bpy.types.Mesh, vertices: int, corners: np.ndarray, start: np.ndarray) -> bool:
    """Whether `mesh` has just these faces."""
    if (len(mesh.vertices), len(mesh.loops), len(mesh.polygons)) != (vertices, len(corners), len(start)):
        return False
    return np.array_equal(corner_vertices(mesh), corners) and np.array_equal(first_corners(mesh), start)
