"""UV layers for lightmaps: choosing the one the user names, or making one without touching anything else of the mesh.

Blender's own unwrapping needs edit mode, a selection and a context, and leaves traces in all three; so the layer is computed from
the mesh's arrays (`core.receivers.unwrap`) and written in one go. It is the same in every version, with or without a window.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.base.errors import Notice, SceneError, TargetError
from ...core.receivers.charts import Mesh, carry
from ...core.receivers.unwrap import Unwrapped, unwrap
from . import links as targets
from . import stored
from .stored import SHARED

STORED = stored.UV  # custom property of the mesh: name of the layer made by us
NAME = "Lightmap"  # what such a layer is called where nothing else is
MOST = 8  # UV layers of a Blender mesh
MULTIPLIES = {"ARRAY", "MIRROR", "SCREW", "SOLIDIFY", "BOOLEAN", "NODES", "REMESH", "SKIN", "BEVEL", "EXPLODE", "BUILD"}


def find_uv_layer(obj: bpy.types.Object, name: str) -> str:
    """`name`, checked; for an empty name the layer made by us, else the one used for rendering. Raises TargetError naming all layers."""
    if obj.type != "MESH":
        raise TargetError(obj.name, f"is a {obj.type.lower()} and has no UV layers", "Convert it to a mesh")
    layers = obj.data.uv_layers
    if name:
        if name not in layers:
            have = ", ".join(f'"{x.name}"' for x in layers) or "none"
            raise TargetError(obj.name, f'there is no UV layer "{name}" (layers: {have})', "Choose one of them or make a lightmap layer")
        return name
    made = stored.read(obj.data, STORED)
    if made is not None and made in layers:
        return made
    chosen = next((x.name for x in layers if x.active_render), "")
    if not chosen:
        raise TargetError(obj.name, "has no UV layer", "Unwrap it or make a lightmap layer")
    return chosen


def make_lightmap_uvs(objects: Sequence[bpy.types.Object], resolution: int, paddings: Sequence[int], name: str = NAME) -> list[Notice]:
    """Make (or renew) our UV layers on the original meshes of `objects`, packed into one square that all of them share.

    Charts do not overlap and lie as many texels apart in an image of `resolution` as the first of `paddings` that fits. Objects that share
    a mesh share the layer; each mesh may be given once. The active and the render layer, the selection and everything else stay as they
    are. All meshes get their layer, or none. Returns what there is to say. Raises TargetError for a linked mesh, edit mode, a ninth
    layer, or more charts than fit; SceneError for a mesh that has no usable face.
    """
    for obj in objects:
        targets.check_mesh(obj)
        if not _own(obj.data) and len(obj.data.uv_layers) >= MOST:
            reason = f"has {MOST} UV layers already, the most a mesh can hold"
            raise TargetError(obj.name, reason, "Remove one, or choose one for the lightmap")
    faces = [read_faces(obj) for obj in objects]
    try:
        unwrapped = unwrap([face.mesh for face in faces], resolution, paddings)
    except TargetError as error:
        raise TargetError(_listed(objects), error.notice.reason, error.notice.remedy) from error
    written: list[bpy.types.Object] = []
    try:
        for obj, face, uv in zip(objects, faces, unwrapped.uvs, strict=True):
            written.append(obj)
            _write_layer(obj, name, face.spread(uv))
    except TargetError:
        for obj in written:
            remove_lightmap_uv(obj)
        raise
    _mark_shared(objects, unwrapped)
    return _notices(objects, unwrapped)


def paddings(resolution: int) -> tuple[int, ...]:
    """Texels to keep free between charts, the most first: as many as there is room for in an image of `resolution`, four at most."""
    return tuple(padding for padding in (4, 2, 1, 0) if padding <= max(1, resolution // 128))


def in_one_square(objects: Sequence[bpy.types.Object]) -> bool:
    """Whether the layers made by us on `objects` were packed together, so that no two of them lie on one another."""
    places = [(stored.read(obj.data, SHARED) or "").split("/") for obj in objects]
    return (
        all(len(place) == 2 for place in places)
        and len({square for square, _ in places}) == 1
        and len({n for _, n in places}) == len(places)
    )


def shares_square(obj: bpy.types.Object) -> bool:
    """Whether the layer made by us on `obj` was packed with those of other objects, so that it fills only a part of the image."""
    return stored.read(obj.data, SHARED) is not None


def remove_lightmap_uv(obj: bpy.types.Object) -> bool:
    """Remove the layer made by us; returns whether there was one. The user's active and render layers stay."""
    mesh = obj.data
    name = stored.read(mesh, STORED)
    if name is None:
        return False
    if name in mesh.uv_layers:
        active = mesh.uv_layers.active.name if mesh.uv_layers.active else ""
        render = next((x.name for x in mesh.uv_layers if x.active_render), "")
        mesh.uv_layers.remove(mesh.uv_layers[name])
        if active in mesh.uv_layers:
            mesh.uv_layers.active = mesh.uv_layers[active]
        if render in mesh.uv_layers:
            mesh.uv_layers[render].active_render = True
    del mesh[STORED]
    if SHARED in mesh:
        del mesh[SHARED]
    return True


def check_uv_layer(obj: bpy.types.Object, name: str, depsgraph: bpy.types.Depsgraph) -> tuple[Notice, ...]:
    """Warnings about what modifiers do to the layer; raises TargetError when the evaluated mesh does not have it."""
    evaluated = obj.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        if mesh is None or name not in mesh.uv_layers:
            cause = ", ".join(m.name for m in obj.modifiers) or "evaluation"
            raise TargetError(obj.name, f'UV layer "{name}" does not survive {cause}', "Apply the modifiers, then make the layer again")
        more = len(mesh.polygons) > len(obj.data.polygons)
    finally:
        evaluated.to_mesh_clear()
    guilty = [m.name for m in obj.modifiers if m.type in MULTIPLIES and (m.show_viewport or m.show_render)]
    if more and guilty:
        reason = f"modifier {', '.join(guilty)} adds faces, which may lie on the same texels as the original ones"
        return (Notice(obj.name, reason, "Apply the modifier and make the layer again, or bake to a color attribute"),)
    return ()


def _own(mesh: bpy.types.Mesh) -> str:
    """Name of the layer made by us, empty where there is none."""
    name = stored.read(mesh, STORED)
    return name if name is not None and name in mesh.uv_layers else ""


def _write_layer(obj: bpy.types.Object, name: str, uv: np.ndarray) -> None:
    """Write `uv` (corners, 2) float32 to our layer, made as `name` where there is none. Raises TargetError."""
    mesh = obj.data
    active, render = mesh.uv_layers.active_index, next((i for i, x in enumerate(mesh.uv_layers) if x.active_render), -1)
    old = _own(mesh)
    layer = mesh.uv_layers[old] if old else mesh.uv_layers.new(name=name, do_init=False)
    if layer is None:
        raise TargetError(obj.name, f'UV layer "{name}" could not be added', "Remove another UV layer")
    made = layer.name
    layer.uv.foreach_set("vector", uv.ravel())
    mesh[STORED] = made
    if render >= 0:
        mesh.uv_layers.active_index = active
        mesh.uv_layers[render].active_render = True
    mesh.update()


def _mark_shared(objects: Sequence[bpy.types.Object], unwrapped: Unwrapped) -> None:
    """Note on the meshes that their layers lie in one square; a single object has its own."""
    square = zlib.crc32(b"".join(uv.tobytes() for uv in unwrapped.uvs))
    for number, obj in enumerate(objects):
        if len(objects) > 1:
            obj.data[SHARED] = f"{square:08x}/{number}"
        elif SHARED in obj.data:
            del obj.data[SHARED]


def _listed(objects: Sequence[bpy.types.Object]) -> str:
    names = [obj.name for obj in objects]
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")


def _notices(objects: Sequence[bpy.types.Object], unwrapped: Unwrapped) -> list[Notice]:
    """What the user should know of how it was unwrapped."""
    if not unwrapped.projected:
        return []
    reason = f"the lightmap UVs are made by projection, which fills less of the image, because {unwrapped.projected}"
    return [Notice(_listed(objects), reason, "Raise the resolution, or unwrap it yourself and name the UV layer", "info")]


@dataclass(frozen=True, eq=False)
class MeshFaces:
    """The triangles of a Blender mesh, in the object's size in the world so that texels are as large on all sides.

    mesh        what is unwrapped: the triangles that have an area and a position
    point       (nt, 3, 3) float64 positions of the corners of all triangles
    corners     (nt, 3) int32 corners (loops) of the Blender mesh
    polygon     (nt,) int32 face of each triangle
    area, good  (nt,) float64 and bool: twice the area, and whether it is a triangle of `mesh`
    count       number of corners of the Blender mesh
    """

    mesh: Mesh
    point: np.ndarray
    corners: np.ndarray
    polygon: np.ndarray
    area: np.ndarray
    good: np.ndarray
    count: int

    def spread(self, uv: np.ndarray) -> np.ndarray:
        """(count, 2) float32 UV of all corners from `uv` (n, 3, 2) of the triangles of `mesh`.

        Faces without an area or a position get the corner of the image and no texel, as in the extraction.
        """
        out = np.zeros((self.count, 2), np.float32)
        out[self.corners[self.good]] = uv
        self._carry_on(out)
        return out

    def _carry_on(self, out: np.ndarray) -> None:
        """Give corners that only flat triangles have the place to which the largest triangle of their face maps them.

        A modifier may cut the face along another diagonal, and then these corners are those of triangles with an area.
        """
        own = np.zeros(len(out), bool)
        own[self.corners[self.good]] = True
        which, k = np.nonzero(~self.good[:, None] & ~own[self.corners] & np.isfinite(self.point).all(axis=2))
        order = np.flatnonzero(self.good)[np.argsort(self.area[self.good], kind="stable")]
        largest = np.full(int(self.polygon.max(initial=-1)) + 1, -1)
        largest[self.polygon[order]] = order  # the last of equal indices stays
        base = largest[self.polygon[which]]
        which, k, base = which[base >= 0], k[base >= 0], base[base >= 0]
        uv = out[self.corners[base]].astype(np.float64)
        out[self.corners[which, k]] = carry(self.point[base], uv, self.point[which, k][:, None])[:, 0]


def read_faces(obj: bpy.types.Object) -> MeshFaces:
    """The faces of the original mesh of `obj`; raises SceneError where none can be unwrapped."""
    mesh = obj.data
    if not mesh.polygons:
        raise SceneError(obj.name, "has no faces to unwrap", "Give it faces")
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", vertices)
    vertices = vertices.reshape(-1, 3).astype(np.float64) @ np.array(obj.matrix_world.to_3x3(), np.float64).T
    loops = mesh.loop_triangles
    count = len(loops)
    triangles, corners, polygon = np.empty(count * 3, np.int32), np.empty(count * 3, np.int32), np.empty(count, np.int32)
    loops.foreach_get("vertices", triangles)
    loops.foreach_get("loops", corners)
    loops.foreach_get("polygon_index", polygon)
    triangles, corners = triangles.reshape(-1, 3), corners.reshape(-1, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        point = vertices[triangles]
        good = np.isfinite(point).all(axis=(1, 2)) & (np.abs(np.nan_to_num(point)).max(axis=(1, 2)) <= 1e12)
        area = np.linalg.norm(np.cross(point[:, 1] - point[:, 0], point[:, 2] - point[:, 0]), axis=1)
        good &= area > 0
    if not good.any():
        raise SceneError(obj.name, "has no face with an area", "Give it faces with an area, and no scale of 0")
    flat = Mesh(np.where(np.isfinite(vertices), vertices, 0.0), triangles[good].astype(np.int64), polygon[good])
    return MeshFaces(flat, point, corners, polygon, area, good, len(mesh.loops))
