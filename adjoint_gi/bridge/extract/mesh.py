"""Geometry: one evaluated Blender mesh as arrays in object space, with unusable triangles removed."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ...core.base.digest import digest
from ..host.meshes import copied, corner_vertices, material_slots, positions, selected, triangle_corners, triangle_polygons
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


class MeshCopy:
    """A mesh as Blender hands it out, copied a piece at a time, each by a few calls; the rest is computed without Blender.

    `name` is what notices call it. Attributes of numbers and vectors are copied when their name is in `numbers`, colour attributes always.
    Images do not lie on the layers `ours`: where there is no other one they have none.
    """

    def __init__(self, name: str, numbers: frozenset[str] = frozenset(), ours: Set[str] = frozenset()) -> None:
        self.name, self._numbers, self._ours = name, numbers, ours
        self._pieces: dict[str, Any] = {}

    @property
    def complete(self) -> bool:
        """Whether all was copied."""
        return len(self._pieces) == len(PIECES)

    def go_on(self, mesh: bpy.types.Mesh, over: Callable[[], bool]) -> bool:
        """Copy the pieces that are missing, at least one and no more than until `over`; returns whether it has all of them."""
        for name, read in PIECES.items():
            if name not in self._pieces:
                self._pieces[name] = read(mesh, self._numbers)
                if over():
                    break
        return self.complete

    def key(self) -> bytes:
        """A digest of all that `arrays` depends on."""
        return digest((self.name, self._ours, self._pieces))

    def arrays(self, notices: Notices) -> MeshArrays | None:
        """What was copied as `MeshArrays`; None (with a notice) where it has no usable face. The copy is empty then."""
        got, self._pieces, name = self._pieces, {}, self.name
        if not len(got["slot"]):
            notices.add(name, "has no faces and is left out", "", "info")
            return None
        vertices = got["vertices"].astype(np.float64)
        corners, polygon = got["corners"], got["polygon"]
        triangles = got["corner_vertices"][corners]

        # Remove what has no area or no position; the mesh itself stays untouched.
        keep = _usable(vertices, triangles, name, notices)
        if not keep.all():
            triangles, corners, polygon = triangles[keep], corners[keep], polygon[keep]
        if not len(triangles):
            notices.add(name, "has no face with an area and is left out", "Dissolve its degenerate faces or give them an area")
            return None
        vertices[~_sound(vertices)] = 0.0

        normals, smooth = _normals(got["normals"], got["smooth"], vertices, triangles, corners, polygon)
        at = {"POINT": triangles, "CORNER": corners, "FACE": np.broadcast_to(polygon[:, None], corners.shape)}
        return MeshArrays(
            vertices=vertices,
            triangles=triangles,
            corners=corners,
            polygon=polygon,
            normals=normals,
            smooth=smooth,
            slot=got["slot"][polygon],
            selected=got["selected"][polygon],
            uvs={layer: _finite(uv[corners], name, f'UV layer "{layer}" holds coordinates', notices) for layer, uv in got["uvs"].items()},
            render_uv="" if got["render_uv"] in self._ours else got["render_uv"],
            colors={
                layer: _finite(values[at[domain]], name, f'attribute "{layer}" holds values', notices)
                for layer, (domain, values) in got["colors"].items()
            },
            render_color=got["render_color"],
            corner_count=len(got["corner_vertices"]),
            polygon_count=len(got["slot"]),
        )


def read_mesh(mesh: bpy.types.Mesh, name: str, notices: Notices, numbers: frozenset[str] = frozenset()) -> MeshArrays | None:
    """Copy `mesh` into arrays at once; see `MeshCopy`."""
    copy = MeshCopy(name, numbers)
    copy.go_on(mesh, lambda: False)
    return copy.arrays(notices)


def _smooth(mesh: bpy.types.Mesh) -> np.ndarray:
    """(np,) bool: polygons that are marked as smooth."""
    sharp = mesh.attributes.get("sharp_face")
    if sharp is not None and sharp.domain == "FACE":
        return ~copied(sharp.data, "value", 1, bool)
    return np.ones(len(mesh.polygons), bool)


def _uvs(mesh: bpy.types.Mesh) -> dict[str, np.ndarray]:
    """(nc, 2) float32 of every UV layer."""
    return {layer.name: copied(layer.uv, "vector", 2, np.float32) for layer in mesh.uv_layers}


def _colors(mesh: bpy.types.Mesh, numbers: frozenset[str]) -> dict[str, tuple[str, np.ndarray]]:
    """Domain and (n, 4) float32 values of every colour attribute, and of what is in `numbers`; Blender hands out byte colours already
    scene-linear."""
    out = {}
    for attribute in mesh.attributes:
        if attribute.domain not in ("POINT", "CORNER", "FACE"):
            continue
        if attribute.data_type in ("FLOAT_COLOR", "BYTE_COLOR"):
            out[attribute.name] = attribute.domain, copied(attribute.data, "color", 4, np.float32)
        elif attribute.data_type in NUMBERS and attribute.name in numbers:
            out[attribute.name] = attribute.domain, _as_color(copied(attribute.data, *NUMBERS[attribute.data_type]))
    return out


def _render_color(mesh: bpy.types.Mesh) -> str:
    """Name of the colour attribute used in rendering, "" without any."""
    attributes, index = mesh.color_attributes, mesh.color_attributes.render_color_index
    return attributes[index].name if 0 <= index < len(attributes) else ""


PIECES: dict[str, Callable[[bpy.types.Mesh, frozenset[str]], Any]] = {
    "vertices": lambda mesh, _: positions(mesh),
    "corner_vertices": lambda mesh, _: corner_vertices(mesh),
    "corners": lambda mesh, _: triangle_corners(mesh),
    "polygon": lambda mesh, _: triangle_polygons(mesh),
    "normals": lambda mesh, _: copied(mesh.corner_normals, "vector", 3, np.float32),
    "smooth": lambda mesh, _: _smooth(mesh),
    "slot": lambda mesh, _: material_slots(mesh),
    "selected": lambda mesh, _: selected(mesh),
    "uvs": lambda mesh, _: _uvs(mesh),
    "render_uv": lambda mesh, _: next((layer.name for layer in mesh.uv_layers if layer.active_render), ""),
    "colors": _colors,
    "render_color": lambda mesh, _: _render_color(mesh),
}


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
    of_corners: np.ndarray, smooth: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, corners: np.ndarray, polygon: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit corner normals (nt, 3, 3) float32 and whether to shade with them (nt,) bool, of those that Blender has for each corner.

    A triangle is smooth when its polygon is marked so, or when custom normals turn a corner away from the polygon's normal.
    """
    normals = of_corners[corners]
    p = vertices[triangles]
    doubled = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    face = doubled / np.linalg.norm(doubled, axis=1, keepdims=True)

    # Normals that cannot be used (zero on loose or folded geometry, not a number) become the face's own.
    length = np.linalg.norm(normals, axis=2)
    bad = ~((length > 1e-6) & np.isfinite(length))
    normals[bad] = np.broadcast_to(face[:, None, :], normals.shape)[bad]
    length[bad] = 1.0
    normals /= length[:, :, None]

    # The area vectors of its triangles add up to a polygon's normal; Blender 5's `polygon_normals` follow the custom normals instead.
    count = len(smooth)
    of_polygon = np.stack([np.bincount(polygon, doubled[:, i], count) for i in range(3)], axis=1)
    length = np.linalg.norm(of_polygon, axis=1, keepdims=True)
    of_polygon = (of_polygon / np.where(length > 0.0, length, 1.0))[polygon]
    turned = np.einsum("tij,tj->ti", normals, of_polygon).min(axis=1) < FLAT_NORMAL
    turned &= ~bad.any(axis=1) & (np.einsum("tj,tj->t", of_polygon, of_polygon) > 0.5)
    return normals.astype(np.float32, copy=False), smooth[polygon] | turned


def _as_color(values: np.ndarray) -> np.ndarray:
    """(n, 4) float32 from numbers (n,), which are grey, or vectors (n, 2) or (n, 3), as Cycles does it."""
    out = np.zeros((len(values), 4), np.float32)
    columns = values.reshape(len(values), -1)
    out[:, : 3 if columns.shape[1] == 1 else columns.shape[1]] = columns
    out[:, 3] = 1.0
    return out


def _finite(values: np.ndarray, name: str, what: str, notices: Notices) -> np.ndarray:
    """`values` with everything that is not a number replaced by 0, and a notice if there was any: `what` says what holds them."""
    good = np.isfinite(values)
    if not good.all():
        notices.add(name, f"{what} that are not numbers; they count as 0", "Unwrap or paint it again")
        values = np.where(good, values, np.float32(0.0))
    return np.ascontiguousarray(values)
