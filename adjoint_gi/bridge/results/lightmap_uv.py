"""UV layers for lightmaps: choosing the one the user names, or making one without touching anything else of the mesh.

Blender's own unwrapping needs edit mode, a selection and a context, and leaves traces in all three; so the layer is computed from
the mesh's arrays (`core.receivers.unwrap`) and written in one go. It is the same in every version, with or without a window.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...core.base.errors import Notice, SceneError, TargetError
from ...core.receivers.unwrap import unwrap
from . import links as targets

STORED = "adjoint_gi_uv"  # custom property of the mesh: name of the layer made by us
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
    made = obj.data.get(STORED)
    if isinstance(made, str) and made in layers:
        return made
    chosen = next((x.name for x in layers if x.active_render), "")
    if not chosen:
        raise TargetError(obj.name, "has no UV layer", "Unwrap it or make a lightmap layer")
    return chosen


def make_lightmap_uv(obj: bpy.types.Object, name: str = NAME, resolution: int | tuple[int, int] = 512, padding: int = 4) -> str:
    """Make (or renew) our UV layer on the original mesh of `obj` and return its name.

    Charts do not overlap and lie `padding` texels apart in an image of `resolution`. Objects that share the mesh share the layer; each
    of them gets its own image. The active and the render layer, the selection and everything else stay as they are. Raises
    TargetError for a linked mesh, edit mode, a ninth layer, or more charts than fit; SceneError for a mesh that has no usable face.
    """
    targets.check_mesh(obj)
    mesh = obj.data
    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    old = mesh.get(STORED)
    renew = isinstance(old, str) and old in mesh.uv_layers
    if not renew and len(mesh.uv_layers) >= MOST:
        raise TargetError(obj.name, f"has {MOST} UV layers already, the most a mesh can hold", "Remove one, or choose one for the lightmap")
    uv = _unwrapped(obj, size, padding)

    active, render = mesh.uv_layers.active_index, next((i for i, x in enumerate(mesh.uv_layers) if x.active_render), -1)
    layer = mesh.uv_layers[old] if renew else mesh.uv_layers.new(name=name, do_init=False)
    if layer is None:
        raise TargetError(obj.name, f'UV layer "{name}" could not be added', "Remove another UV layer")
    made = layer.name
    layer.uv.foreach_set("vector", uv.ravel())
    mesh[STORED] = made
    if render >= 0:
        mesh.uv_layers.active_index = active
        mesh.uv_layers[render].active_render = True
    mesh.update()
    return made


def remove_lightmap_uv(obj: bpy.types.Object) -> bool:
    """Remove the layer made by us; returns whether there was one. The user's active and render layers stay."""
    mesh = obj.data
    name = mesh.get(STORED)
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


def _unwrapped(obj: bpy.types.Object, resolution: tuple[int, int], padding: int) -> np.ndarray:
    """(corners, 2) float32 UV of the original mesh, in the object's size in the world so that texels are as large on all sides."""
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

    # Faces without an area or a position get the corner of the image and no texel, as in the extraction.
    with np.errstate(invalid="ignore", over="ignore"):
        p = vertices[triangles]
        good = np.isfinite(p).all(axis=(1, 2)) & (np.abs(np.nan_to_num(p)).max(axis=(1, 2)) <= 1e12)
        area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
        good &= area > 0
    if not good.any():
        raise SceneError(obj.name, "has no face with an area", "Give it faces with an area, and no scale of 0")
    uv, _ = unwrap(np.where(np.isfinite(vertices), vertices, 0.0), triangles[good], polygon[good], resolution, padding)
    out = np.zeros((len(mesh.loops), 2), np.float32)
    out[corners[good]] = uv
    _carry_on(out, vertices[triangles], corners, polygon, area, good)
    return out


def _carry_on(out: np.ndarray, p: np.ndarray, corners: np.ndarray, polygon: np.ndarray, area: np.ndarray, good: np.ndarray) -> None:
    """Give corners that only flat triangles have the place in `out` (corners, 2) to which the largest triangle of their face maps them.

    A modifier may cut the face along another diagonal, and then these corners are those of triangles with an area.
    """
    own = np.zeros(len(out), bool)
    own[corners[good]] = True
    which, k = np.nonzero(~good[:, None] & ~own[corners] & np.isfinite(p).all(axis=2))
    order = np.flatnonzero(good)[np.argsort(area[good], kind="stable")]
    largest = np.full(int(polygon.max(initial=-1)) + 1, -1)
    largest[polygon[order]] = order  # the last of equal indices stays
    base = largest[polygon[which]]
    which, k, base = which[base >= 0], k[base >= 0], base[base >= 0]
    # Barycentric coordinates (s, t) of the corner in that triangle, by the normal equations.
    e1, e2, d = p[base, 1] - p[base, 0], p[base, 2] - p[base, 0], p[which, k] - p[base, 0]
    a, b, c = (np.einsum("ij,ij->i", x, y) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    u, v = np.einsum("ij,ij->i", d, e1), np.einsum("ij,ij->i", d, e2)
    det = np.maximum(a * c - b * b, 1e-300)
    s, t = (c * u - b * v) / det, (a * v - b * u) / det
    uv = out[corners[base]].astype(np.float64)
    out[corners[which, k]] = uv[:, 0] + s[:, None] * (uv[:, 1] - uv[:, 0]) + t[:, None] * (uv[:, 2] - uv[:, 0])
