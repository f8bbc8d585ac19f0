"""Walking the depsgraph: objects and instances, what they are called, and their meshes placed in world space.

Curves, texts, surfaces and metaballs need no conversion: the depsgraph lists the mesh they evaluate to as an instance of themselves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ...core.scene.arrays import ObjectArrays
from ..host.notices import Notices
from ..host.versions import terminator_offset
from ..results import links as targets
from ..results import real as reals
from ..results import stored
from ..results.lightmap_uv import own_layer
from ..results.preview import own_material
from ..results.real import BECOMES_MESH
from .cycles_settings import name_bounces, name_object_settings
from .mesh import LARGEST_COORDINATE, MeshArrays, read_mesh
from .nodes import attributes_read
from .unsupported import name_rays, name_viewport
from .visibility import NO_ID, Visibility

FACELESS = {"CAMERA", "LIGHT", "LIGHT_PROBE", "SPEAKER", "ARMATURE", "LATTICE"}


@dataclass(eq=False)
class Group:
    """Instances that share mesh, handedness and materials."""

    mesh: MeshArrays
    materials: np.ndarray  # (ns,) int32: scene material of each slot, at least one
    names: list[str] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    makers: list[str] = field(default_factory=list)
    uids: list[int] = field(default_factory=list)
    instances: list[tuple[int, ...]] = field(default_factory=list)
    matrices: list[tuple[float, ...]] = field(default_factory=list)
    terminators: list[float] = field(default_factory=list)


@dataclass(eq=False)
class LightInstance:
    """A lamp as the depsgraph shows it."""

    name: str
    light: bpy.types.Light
    matrix: np.ndarray  # (4, 4) float64
    camera: bool  # whether camera rays see it


class InstanceWalk:
    """One pass over the instances of a depsgraph.

    `material_of` gives the index of a material, or of the default for None; faces with one of `bodiless`, filled by it, are no surface.
    An instance whose name is in `real` is taken as that object: it has the instance's faces, and UVs of its own. An object that is no
    mesh keeps its name then.
    """

    def __init__(
        self,
        material_of: Callable[[bpy.types.Material | None], int],
        bodiless: Set[int],
        notices: Notices,
        real: Mapping[str, bpy.types.Object] | None = None,
    ) -> None:
        self._material_of = material_of
        self._bodiless = bodiless
        self._notices = notices
        self._real = real or {}
        self._numbers = attributes_read()
        self._meshes: dict[int, MeshArrays | None] = {}
        self._groups: dict[tuple[int, bool, bytes], Group] = {}
        self._group_of: dict[tuple[int, int, bool], Group | None] = {}
        self._faceless: dict[str, tuple[str, str]] = {}  # reason and remedy, for objects without faces of their own
        self._makers: Counter[str] = Counter()  # how many instances with faces each object makes
        self._names: set[str] = set()
        self.lights: list[LightInstance] = []

    @property
    def groups(self) -> list[Group]:
        """All groups with at least one instance, in the order of first appearance."""
        return list(self._groups.values())

    def run(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Visit every object and instance once and copy what is needed of it."""
        visibility = Visibility(depsgraph, self._notices)
        described: set[bpy.types.Object] = set()
        for inst in depsgraph.object_instances:
            obj = inst.object
            original = obj.original
            if not visibility.shows(inst, original):
                continue
            if original not in described:
                described.add(original)
                self._describe(original, depsgraph)
            kind = obj.type
            if kind in BECOMES_MESH:
                self._faceless[original.name] = ("gives no faces and is left out", "Give it a bevel or an extrusion")
            if kind == "MESH":
                self._visit_mesh(inst, obj, original)
            elif kind == "LIGHT":
                self._visit_light(inst, obj, original)
            elif original.is_missing:
                self._notices.add(original.name, *targets.missing(original))
            elif kind not in FACELESS and kind not in BECOMES_MESH and not (kind == "EMPTY" and original.is_instancer):
                self._faceless[original.name] = (f"is of type {_words(kind)}, which has no faces, and is left out", "")
        visibility.name_missing(depsgraph)
        self._name_faceless()

    def _name_faceless(self) -> None:
        """Name objects without faces, by what is in the light of them."""
        made = {s for g in self.groups for s in g.sources}
        families = {s.split(".")[0] for s in made}
        for name, (reason, remedy) in self._faceless.items():
            # Metaballs of one name form one surface, which the first of them owns.
            meta = name in bpy.data.objects and bpy.data.objects[name].type == "META"
            if name in made or (meta and name.split(".")[0] in families):
                continue
            count = self._makers[name]
            if count:
                reason, remedy = f"has no faces of its own; what it makes ({count} instance{'s' * (count > 1)}) is in the light", ""
            self._notices.add(name, reason, remedy, "info")

    def _describe(self, original: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
        """Name what Cycles does with an object that counts, and is not done here."""
        if original.type != "MESH" and original.type != "LIGHT" and original.type not in BECOMES_MESH:
            return
        name_rays(original, self._notices)
        if original.type == "LIGHT":
            name_bounces(original.data, original.name, self._notices)
        else:
            name_object_settings(original, self._notices)
            self._hair(original)
        if depsgraph.mode == "VIEWPORT":
            name_viewport(original, depsgraph.scene, self._notices)

    def _hair(self, original: bpy.types.Object) -> None:
        """Name the hair of particle systems, which has no faces."""
        for system in original.particle_systems:
            if system.settings.type == "HAIR" and system.settings.render_type == "PATH":
                self._notices.add(original.name, f'has hair ("{system.name}"), which is not in the light', "", "info")

    def _visit_mesh(self, inst: bpy.types.DepsgraphObjectInstance, obj: bpy.types.Object, original: bpy.types.Object) -> None:
        matrix = [x for row in inst.matrix_world for x in row]
        name, source, ids = self._identify(inst, original)
        maker = inst.parent.original.name if ids and inst.parent else ""
        own = self._real.get(name)
        if own is not None:
            if not reals.is_whole(own):
                name, source, ids, maker = own.name, own.name, (), reals.maker_name(own)
            matrix = reals.placed(own, matrix)
        if is_flat(matrix):
            reason = "has a scale of zero or a matrix that is not a number and is left out"
            self._notices.add(name, reason, "Give it a scale other than zero on every axis")
            return
        group = self._group(obj, original, determinant_of(matrix) < 0.0, source, own.data if own is not None else obj.data)
        if group is None:
            return
        self._makers[maker] += 1
        group.makers.append(maker)
        group.names.append(name)
        group.sources.append(source)
        group.uids.append((own or original).session_uid)
        group.instances.append(ids)
        group.matrices.append(tuple(matrix))
        group.terminators.append(terminator_offset(original, "geometry"))

    def _visit_light(self, inst: bpy.types.DepsgraphObjectInstance, obj: bpy.types.Object, original: bpy.types.Object) -> None:
        matrix = np.array([x for row in inst.matrix_world for x in row], np.float64).reshape(4, 4)
        name, _, _ = self._identify(inst, original)
        if not np.isfinite(matrix).all():
            self._notices.add(name, "has a matrix that is not a number and is left out", "Clear its transform")
            return
        self.lights.append(LightInstance(name, obj.data, matrix, bool(obj.visible_camera)))

    def _identify(self, inst: bpy.types.DepsgraphObjectInstance, original: bpy.types.Object) -> tuple[str, str, tuple[int, ...]]:
        """Name, name of the owner of the mesh, instance path.

        An object has its own name. An instance is "Source[Instancer.2.0]": who makes it, and Blender's persistent id.
        A clash (the same name in two libraries) is settled by the order of the depsgraph, which is stable.
        """
        ids: tuple[int, ...] = ()
        name = original.name
        if inst.is_instance:
            parent = inst.parent.original if inst.parent else None
            if not (parent is not None and parent.as_pointer() == original.as_pointer() and original.type != "MESH"):
                ids = tuple(i for i in inst.persistent_id if i != NO_ID)
                maker = parent.name if parent is not None else ""
                name = f"{name}[{'.'.join([maker, *map(str, ids)])}]"
        unique = name
        count = 1
        while unique in self._names:
            count += 1
            unique = f"{name}#{count}"
        self._names.add(unique)
        return unique, original.name, ids

    def _group(self, obj: bpy.types.Object, original: bpy.types.Object, mirrored: bool, name: str, mesh: bpy.types.Mesh) -> Group | None:
        """The group of this mesh, object (slots may be linked to it) and handedness; None when the mesh has no faces."""
        pointer = mesh.as_pointer()
        key = (original.as_pointer(), pointer, mirrored)
        if key not in self._group_of:
            self._group_of[key] = self._make_group(obj, mesh, pointer, mirrored, name)
        return self._group_of[key]

    def _make_group(self, obj: bpy.types.Object, mesh: bpy.types.Mesh, pointer: int, mirrored: bool, name: str) -> Group | None:
        """The group that objects of this mesh, handedness and materials have in common."""
        if pointer not in self._meshes:
            self._meshes[pointer] = self._read(obj, mesh, name)
        arrays = self._meshes[pointer]
        if arrays is None:
            return None
        slots = self._slots(obj, obj.data)
        key = (pointer, mirrored, slots.tobytes())
        if key not in self._groups:
            solid = self._solid(self._mirrored(pointer, arrays) if mirrored else arrays, slots)
            if solid is None:
                self._notices.add(name, "has volumes only, no surface, and is left out: light passes through it", "", "info")
                return None
            self._groups[key] = Group(solid, slots)
        return self._groups[key]

    def _solid(self, arrays: MeshArrays, slots: np.ndarray) -> MeshArrays | None:
        """The mesh without the faces of materials that are no surface; None when nothing is left."""
        if not self._bodiless.intersection(slots.tolist()):
            return arrays
        keep = ~np.isin(slots[np.clip(arrays.slot, 0, len(slots) - 1)], list(self._bodiless))
        return arrays.taken(keep) if keep.any() else None

    def _read(self, obj: bpy.types.Object, mesh: bpy.types.Mesh, name: str) -> MeshArrays | None:
        """Copy a mesh. In edit mode its layers cannot be read (their length is 0), but those of a temporary copy can."""
        if not mesh.polygons and not mesh.is_editmode:
            self._faceless[name] = ("has no faces and is left out", "")
            return None
        if not mesh.is_editmode:
            return _without_own_layer(obj, mesh, read_mesh(mesh, name, self._notices, self._numbers))
        try:
            return _without_own_layer(obj, mesh, read_mesh(obj.to_mesh(), name, self._notices, self._numbers))
        finally:
            obj.to_mesh_clear()

    def _mirrored(self, pointer: int, arrays: MeshArrays) -> MeshArrays:
        """The mirrored copy of a mesh, made once."""
        if -pointer not in self._meshes:
            self._meshes[-pointer] = arrays.mirrored()
        found = self._meshes[-pointer]
        assert found is not None
        return found

    def _slots(self, obj: bpy.types.Object, mesh: bpy.types.Mesh) -> np.ndarray:
        """(ns,) int32 material index of each slot, at least one."""
        return np.array([self._material_of(m) for m in self.user_materials(obj, mesh) or [None]], np.int32)

    def user_materials(self, obj: bpy.types.Object, mesh: bpy.types.Mesh) -> list[bpy.types.Material | None]:
        """The material of each slot: the object's where the slot is linked to it, else the mesh's; never a preview's."""
        below = list(mesh.materials)
        materials = list(below)
        for i, slot in enumerate(obj.material_slots):
            if slot.link == "OBJECT" and i < len(materials):
                materials[i] = slot.material
        for i, material in enumerate(materials):
            materials[i], lost = own_material(obj, i, material, below[i])
            if lost:
                reason = "shows a result, and its own material was deleted, so its faces count as grey"
                self._notices.add(obj.original.name, reason, "Press Restore Materials and give it a material")
        return materials


@dataclass(eq=False)
class Placed:
    """All groups in world space, in the layout of `SceneArrays`."""

    vertices: np.ndarray
    triangles: np.ndarray
    corner_normals: np.ndarray
    smooth: np.ndarray
    material: np.ndarray
    object: np.ndarray
    polygon: np.ndarray
    corners: np.ndarray
    objects: tuple[ObjectArrays, ...]


def place(groups: list[Group], default_color: bool, notices: Notices) -> Placed:
    """Transform every instance to world space and join the arrays; per-mesh UV and colour arrays are shared by instances.

    With `default_color` the colour attribute used in rendering is entered under "" too, for nodes that name none.
    """
    objects: list[ObjectArrays] = []
    parts: list[tuple[np.ndarray, ...]] = []
    vertex_base = triangle_base = 0
    for group in groups:
        mesh = group.mesh
        matrices = np.array(group.matrices, np.float64).reshape(-1, 4, 4)
        vertices = mesh.vertices @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
        used = vertices[:, np.unique(mesh.triangles)] if len(matrices) == 1 else vertices
        near = (np.abs(used) <= LARGEST_COORDINATE).all(axis=(1, 2))
        for i in np.flatnonzero(~near):
            notices.add(group.names[i], f"lies further out than {LARGEST_COORDINATE:.0e} m and is left out", "Move it closer to the origin")
        kept = np.flatnonzero(near)
        k, nv, nt = len(kept), len(mesh.vertices), len(mesh.triangles)
        if not k:
            continue
        shift = vertex_base + nv * np.arange(k)[:, None, None]
        slots = group.materials[np.clip(mesh.slot, 0, len(group.materials) - 1)]
        first = len(objects)
        parts.append(
            (
                vertices[kept].reshape(-1, 3),
                (mesh.triangles[None] + shift).astype(np.int32).reshape(-1, 3),
                _world_normals(mesh.normals, matrices[kept]),
                np.tile(mesh.smooth, k),
                np.tile(slots, k),
                np.repeat(np.arange(first, first + k, dtype=np.int32), nt),
                np.tile(mesh.polygon, k),
                np.tile(mesh.corners, (k, 1)),
            )
        )
        objects += _objects(group, kept, triangle_base, vertex_base, default_color)
        vertex_base += nv * k
        triangle_base += nt * k
    empty = (
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 3, 3), np.float32),
        np.zeros(0, bool),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 3), np.int32),
    )
    columns = [np.concatenate([e, *(p[c] for p in parts)]) for c, e in enumerate(empty)]
    return Placed(*columns, tuple(objects))


def _objects(group: Group, kept: np.ndarray, first_triangle: int, first_vertex: int, default_color: bool) -> list[ObjectArrays]:
    """The instances `kept` (k,) of a group, whose triangles and vertices lie behind one another from the first ones on."""
    mesh, colors = group.mesh, group.mesh.colors
    nv, nt = len(mesh.vertices), len(mesh.triangles)
    if default_color and mesh.render_color in colors:
        colors = {**colors, "": colors[mesh.render_color]}
    return [
        ObjectArrays(
            name=group.names[i],
            source=group.sources[i],
            maker=group.makers[i],
            uid=group.uids[i],
            instance=group.instances[i],
            first_triangle=first_triangle + j * nt,
            triangle_count=nt,
            first_vertex=first_vertex + j * nv,
            vertex_count=nv,
            corner_count=mesh.corner_count,
            polygon_count=mesh.polygon_count,
            uvs=mesh.uvs,
            render_uv=mesh.render_uv,
            colors=colors,
            selected=mesh.selected,
            terminator=group.terminators[i],
        )
        for j, i in enumerate(kept.tolist())
    ]


def _without_own_layer(obj: bpy.types.Object, mesh: bpy.types.Mesh, arrays: MeshArrays | None) -> MeshArrays | None:
    """`arrays` of `mesh`. Images do not lie on the layer that a bake has made: where there is no other they have none, as before."""
    if arrays is None or not arrays.render_uv:
        return arrays
    ours = {stored.read(mesh, stored.UV), own_layer(obj.original) if obj.original.type == "MESH" else ""}
    return replace(arrays, render_uv="") if arrays.render_uv in ours else arrays


def _world_normals(normals: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Object-space unit normals (nt, 3, 3) by the inverse transpose of each matrix (k, 4, 4) -> (k * nt, 3, 3) float32 unit.

    The inverse transpose maps an outward normal to an outward normal for mirrored matrices too.
    """
    inverse = np.linalg.inv(matrices[:, :3, :3])
    # Only the direction counts: scaling keeps float32 in range for tiny and huge matrices.
    inverse /= np.abs(inverse).max(axis=(1, 2), keepdims=True)
    world = (normals.reshape(-1, 3) @ inverse.astype(np.float32)).reshape(-1, 3, 3)
    length = np.linalg.norm(world, axis=2, keepdims=True)
    return world / np.maximum(length, np.float32(1e-30))


def is_flat(matrix: list[float]) -> bool:
    """Whether a flat 4 x 4 matrix leaves no surface: a scale of zero, or a coefficient that is not a number."""
    determinant = determinant_of(matrix)
    return determinant is None or abs(determinant) < 1e-30 or _squashed(matrix, determinant)


def determinant_of(m: list[float]) -> float | None:
    """Determinant of the upper 3 x 3 of a flat 4 x 4 matrix; None when a coefficient is not a number."""
    total = sum(m)
    if total - total != 0.0:
        return None
    return m[0] * (m[5] * m[10] - m[6] * m[9]) - m[1] * (m[4] * m[10] - m[6] * m[8]) + m[2] * (m[4] * m[9] - m[5] * m[8])


def _squashed(m: list[float], determinant: float) -> bool:
    """Whether a matrix is flat within float32 precision: its volume is nothing beside the cube of its longest axis."""
    longest = max(m[i] * m[i] + m[i + 4] * m[i + 4] + m[i + 8] * m[i + 8] for i in range(3))
    return abs(determinant) < 1e-12 * longest**1.5


def _words(kind: str) -> str:
    return kind.lower().replace("_", " ")
