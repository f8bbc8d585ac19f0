"""Geometry: one evaluated Blender mesh as arrays in object space, with unusable triangles removed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..host.notices import Notices

LARGEST_COORDINATE = 1e12  # squares of longer edges leave float32
SLIVER = 1e-9  # height over length below which a triangle has no usable normal
NUMBERS = {  # attributes that are no colours: where their values are, how many, of which type
    "FLOAT": ("value", 1, np.float32),
    "INT": ("value", 1, np.int32),
    "BOOLEAN": ("value", 1, bool),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT2": ("vector", 2, np.float32),
}
FLAT_NORMAL = 0.9999995  # cosine of 1e-3 rad: a corner normal further from its polygon's was set on purpose


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """An evaluated mesh in object space, triangulated as Blender triangulates it.

    vertices        (nv, 3) float64, as in the mesh; those that are not numbers are set to 0 and not used
    triangles       (nt, 3) int32 vertex indices, wound outward
    corners         (nt, 3) int32 corner (loop) indices
    polygon         (nt,) int32
    normals         (nt, 3, 3) float32 unit corner normals
    smooth          (nt,) bool
    slot            (nt,) int32 material slot as stored, which may be out of range
    selected        (nt,) bool, whether its polygon is selected
    uvs, colors     per layer (nt, 3, 2) and (nt, 3, 4) float32 per triangle corner
    render_color    the colour attribute that nodes without a name read
    """

    vertices: np.ndarray
    triangles: np.ndarray
    corners: np.ndarray
    polygon: np.ndarray
    normals: np.ndarray
    smooth: np.ndarray
    slot: np.ndarray
    selected: np.ndarray
    uvs: dict[str, np.ndarray]
    render_uv: str
    colors: dict[str, np.ndarray]
    render_color: str
    corner_count: int
    polygon_count: int

    def taken(self, keep: np.ndarray) -> MeshArrays:
        """The same mesh with only the triangles `keep` (nt,) bool."""
        per_triangle = {
            name: getattr(self, name)[keep] for name in ("triangles", "corners", "polygon", "normals", "smooth", "slot", "selected")
        }
        layers = {name: {k: a[keep] for k, a in getattr(self, name).items()} for name in ("uvs", "colors")}
        return replace(self, **per_triangle, **layers)

    def mirrored(self) -> MeshArrays:
        """The same mesh with the second and third corner of each triangle exchanged, for matrices of negative determinant."""
        swap = [0, 2, 1]
        return MeshArrays(
            vertices=self.vertices,
            triangles=np.ascontiguousarray(self.triangles[:, swap]),
            corners=np.ascontiguousarray(self.corners[:, swap]),
            polygon=self.polygon,
            normals=np.ascontiguousarray(self.normals[:, swap]),
            smooth=self.smooth,
            slot=self.slot,
            selected=self.selected,
            uvs={name: np.ascontiguousarray(a[:, swap]) for name, a in self.uvs.items()},
            render_uv=self.render_uv,
            colors={name: np.ascontiguousarray(a[:, swap]) for name, a in self.colors.items()},
            render_color=self.render_color,
            corner_count=self.corner_count,
            polygon_count=self.polygon_count,
        )


def read_mesh(mesh: bpy.types.Mesh, name: str, notices: Notices, numbers: frozenset[str] = frozenset()) -> MeshArrays | None:
    """Copy `mesh` into arrays; None (with a notice about `name`) when it has no usable face.

    Colour attributes are copied always, attributes of numbers and vectors when their name is in `numbers`.
    """
    if not mesh.polygons:
        notices.add(name, "has no faces and is left out", "", "info")
        return None
    vertices = _get(mesh.vertices, "co", 3, np.float32).astype(np.float64)
    loops = mesh.loop_triangles
    triangles = _get(loops, "vertices", 3, np.int32)
    corners = _get(loops, "loops", 3, np.int32)
    polygon = _get(loops, "polygon_index", 1, np.int32)

    # Remove what has no area or no position; the mesh itself stays untouched.
    keep = _usable(vertices, triangles, name, notices)
    if not keep.all():
        triangles, corners, polygon = triangles[keep], corners[keep], polygon[keep]
    if not len(triangles):
        notices.add(name, "has no face with an area and is left out", "Dissolve its degenerate faces or give them an area")
        return None
    vertices[~_sound(vertices)] = 0.0

    normals, smooth = _normals(mesh, vertices, triangles, corners, polygon)
    slot = _get(mesh.polygons, "material_index", 1, np.int32)[polygon]
    selected = _get(mesh.polygons, "select", 1, bool)[polygon]
    uvs = {layer.name: _uv_layer(layer, corners, name, notices) for layer in mesh.uv_layers}
    return MeshArrays(
        vertices=vertices,
        triangles=triangles,
        corners=corners,
        polygon=polygon,
        normals=normals,
        smooth=smooth,
        slot=slot,
        selected=selected,
        uvs=uvs,
        render_uv=next((layer.name for layer in mesh.uv_layers if layer.active_render), ""),
        colors=_colors(mesh, triangles, corners, polygon, name, notices, numbers),
        render_color=_render_color(mesh),
        corner_count=len(mesh.loops),
        polygon_count=len(mesh.polygons),
    )


def _get(collection: bpy.types.bpy_prop_collection, attribute: str, width: int, dtype: type) -> np.ndarray:
    """(n,) or (n, width) array of one attribute of all items."""
    out = np.empty(len(collection) * width, dtype)
    collection.foreach_get(attribute, out)
    return out if width == 1 else out.reshape(-1, width)


def _sound(vertices: np.ndarray) -> np.ndarray:
    """(nv,) bool: finite and of a size that can be computed with."""
    with np.errstate(invalid="ignore"):
        return (np.abs(vertices) <= LARGEST_COORDINATE).all(axis=1)


def _usable(vertices: np.ndarray, triangles: np.ndarray, name: str, notices: Notices) -> np.ndarray:
    """(nt,) bool: triangles with sound vertices and an area; notices tell of the others."""
    sound = _sound(vertices)[triangles].all(axis=1)
    if not sound.all():
        notices.add(
            name,
            f"{int((~sound).sum())} triangles have coordinates that are not numbers or exceed {LARGEST_COORDINATE:.0e} and are left out",
            "Delete or move these vertices",
        )
    p = vertices[np.where(sound[:, None], triangles, triangles[sound][:1] if sound.any() else 0)]
    with np.errstate(invalid="ignore", over="ignore"):
        e0, e1 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        doubled = np.linalg.norm(np.cross(e0, e1), axis=1)
        longest = np.maximum(np.einsum("ij,ij->i", e0, e0), np.einsum("ij,ij->i", e1, e1))
        longest = np.maximum(longest, np.einsum("ij,ij->i", e1 - e0, e1 - e0))
        flat = ~(doubled > SLIVER * longest)
    flat &= sound
    if flat.any():
        notices.add(name, "has triangles without an area, which are left out", "Merge by distance removes them", "info")
    return sound & ~flat


def _normals(
    mesh: bpy.types.Mesh, vertices: np.ndarray, triangles: np.ndarray, corners: np.ndarray, polygon: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit corner normals (nt, 3, 3) float32 and whether to shade with them (nt,) bool.

    A triangle is smooth when its polygon is marked so, or when custom normals turn a corner away from the polygon's normal.
    """
    normals = _get(mesh.corner_normals, "vector", 3, np.float32)[corners]
    p = vertices[triangles]
    doubled = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    face = doubled / np.linalg.norm(doubled, axis=1, keepdims=True)

    # Normals that cannot be used (zero on loose or folded geometry, not a number) become the face's own.
    length = np.linalg.norm(normals, axis=2)
    bad = ~((length > 1e-6) & np.isfinite(length))
    normals[bad] = np.broadcast_to(face[:, None, :], normals.shape)[bad]
    length[bad] = 1.0
    normals /= length[:, :, None]

    sharp = mesh.attributes.get("sharp_face")
    smooth = np.ones(len(mesh.polygons), bool)
    if sharp is not None and sharp.domain == "FACE":
        smooth = ~_get(sharp.data, "value", 1, bool)
    # The area vectors of its triangles add up to a polygon's normal; Blender 5's `polygon_normals` follow the custom normals instead.
    count = len(mesh.polygons)
    of_polygon = np.stack([np.bincount(polygon, doubled[:, i], count) for i in range(3)], axis=1)
    length = np.linalg.norm(of_polygon, axis=1, keepdims=True)
    of_polygon = (of_polygon / np.where(length > 0.0, length, 1.0))[polygon]
    turned = np.einsum("tij,tj->ti", normals, of_polygon).min(axis=1) < FLAT_NORMAL
    turned &= ~bad.any(axis=1) & (np.einsum("tj,tj->t", of_polygon, of_polygon) > 0.5)
    return normals.astype(np.float32, copy=False), smooth[polygon] | turned


def _uv_layer(layer: bpy.types.MeshUVLoopLayer, corners: np.ndarray, name: str, notices: Notices) -> np.ndarray:
    """(nt, 3, 2) float32 UV coordinates; those that are not numbers become 0."""
    uv = _get(layer.uv, "vector", 2, np.float32)[corners]
    return _finite(uv, name, f'UV layer "{layer.name}" holds coordinates that are not numbers; they count as 0', notices)


def _colors(
    mesh: bpy.types.Mesh,
    triangles: np.ndarray,
    corners: np.ndarray,
    polygon: np.ndarray,
    name: str,
    notices: Notices,
    numbers: frozenset[str],
) -> dict[str, np.ndarray]:
    """Every colour attribute, and what is in `numbers`, as (nt, 3, 4) float32; Blender hands out byte colours already scene-linear."""
    out = {}
    for attribute in mesh.attributes:
        if attribute.domain not in ("POINT", "CORNER", "FACE"):
            continue
        if attribute.data_type in ("FLOAT_COLOR", "BYTE_COLOR"):
            values = _get(attribute.data, "color", 4, np.float32)
        elif attribute.data_type in NUMBERS and attribute.name in numbers:
            values = _as_color(_get(attribute.data, *NUMBERS[attribute.data_type]))
        else:
            continue
        if attribute.domain == "POINT":
            color = values[triangles]
        elif attribute.domain == "CORNER":
            color = values[corners]
        else:
            color = np.repeat(values[polygon][:, None, :], 3, axis=1)
        out[attribute.name] = _finite(
            color, name, f'attribute "{attribute.name}" holds values that are not numbers; they count as 0', notices
        )
    return out


def _as_color(values: np.ndarray) -> np.ndarray:
    """(n, 4) float32 from numbers (n,), which are grey, or vectors (n, 2) or (n, 3), as Cycles does it."""
    out = np.zeros((len(values), 4), np.float32)
    columns = values.reshape(len(values), -1)
    out[:, : 3 if columns.shape[1] == 1 else columns.shape[1]] = columns
    out[:, 3] = 1.0
    return out


def _render_color(mesh: bpy.types.Mesh) -> str:
    """Name of the colour attribute used in rendering, "" without any."""
    attributes, index = mesh.color_attributes, mesh.color_attributes.render_color_index
    return attributes[index].name if 0 <= index < len(attributes) else ""


def _finite(values: np.ndarray, name: str, reason: str, notices: Notices) -> np.ndarray:
    """`values` with everything that is not a number replaced by 0, and a notice if there was any."""
    good = np.isfinite(values)
    if not good.all():
        notices.add(name, reason, "Unwrap or paint it again")
        values = np.where(good, values, np.float32(0.0))
    return np.ascontiguousarray(values)
