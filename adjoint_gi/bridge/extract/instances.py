"""Walking the depsgraph: objects and instances, what they are called, and copies of their meshes.

Curves, texts, surfaces and metaballs need no conversion: the depsgraph lists the mesh they evaluate to as an instance of themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass

import bpy
import numpy as np

from ..host.notices import Notices
from ..host.versions import terminator_offset
from ..results import links as targets
from ..results import real as reals
from ..results import stored
from ..results.lightmap_uv import own_layer
from ..results.preview import own_material
from ..results.real import BECOMES_MESH
from .cycles_settings import name_bounces, name_object_settings
from .mesh import MeshCopy
from .nodes import attributes_read
from .placed import Visit, Walked
from .unsupported import name_rays, name_viewport
from .visibility import NO_ID, Visibility

MADE_BY_NODES = "a mesh of its nodes"  # what an instance is of whose mesh no object has: its source is its maker
# What gives faces to an object of each kind that can have some without modifiers.
FACES = {
    "CURVE": "Give it a bevel or an extrusion",
    "FONT": "Type a text, and fill or extrude it",
    "SURFACE": "Give it points in both directions",
    "META": "Give an element a larger radius, or lower the threshold",
}
# Kinds that no renderer shows, of which nothing need be said.
FACELESS = {"CAMERA", "LIGHT", "LIGHT_PROBE", "SPEAKER", "ARMATURE", "LATTICE", "EMPTY"}


@dataclass(eq=False)
class LightInstance:
    """A lamp as the depsgraph shows it."""

    name: str
    light: bpy.types.Light
    matrix: np.ndarray  # (4, 4) float64
    camera: bool  # whether camera rays see it


class InstanceWalk:
    """One pass over the instances of a depsgraph, in slices if it is long.

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
        self._visibility: Visibility | None = None
        self._done = 0  # items of the depsgraph's list that need no second look
        self._identity: tuple[str, str, tuple[int, ...]] | None = None  # of the item whose mesh is not copied to its end
        self._described: set[bpy.types.Object] = set()
        self._meshes: dict[int, MeshCopy | None] = {}
        self._slots_of: dict[tuple[int, int], np.ndarray] = {}
        self._visits: list[Visit] = []
        self._faceless: dict[str, tuple[str, str]] = {}  # reason and remedy, for objects without faces of their own
        self._metas: set[str] = set()
        # Who has faces all the same: in the light by the mesh of an object made of its instance, or left out, and told why.
        self._given: set[str] = set()
        self._names: set[str] = set()
        self.lights: list[LightInstance] = []

    def run(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Visit every object and instance once and copy what is needed of it."""
        self.go_on(depsgraph, lambda: False)

    def go_on(self, depsgraph: bpy.types.Depsgraph, over: Callable[[], bool], back: Callable[[], None] = lambda: None) -> bool:
        """`run`, until `over()`; returns whether it has come to the end. Nothing may have changed in the depsgraph between two calls.

        `back()` is called once the walk is back where it ended last, for which Blender has to go through its list again.
        """
        if self._visibility is None:
            self._visibility = Visibility(depsgraph, self._notices)
        first = self._done
        for number, inst in enumerate(depsgraph.object_instances):
            if number < first:
                continue
            if number == first:
                back()
            if not self._visit(inst, depsgraph, over):
                return False
            self._done = number + 1
            if over():
                return False
        self._visibility.name_missing(depsgraph)
        return True

    def walked(self) -> Walked:
        """What was copied, of which nothing refers to Blender any more."""
        meshes = {key: copy for key, copy in self._meshes.items() if copy is not None}
        faceless = {name: words for name, words in self._faceless.items() if name not in self._given}
        return Walked(meshes, self._visits, self._bodiless, faceless, self._metas)

    def _visit(self, inst: bpy.types.DepsgraphObjectInstance, depsgraph: bpy.types.Depsgraph, over: Callable[[], bool]) -> bool:
        """Look at one item; returns whether all is copied of it, else it is to be visited again."""
        obj = inst.object
        original, kind = obj.original, obj.type
        if self._identity is None:
            assert self._visibility is not None
            if not self._visibility.shows(inst, original):
                return True
            if original not in self._described:
                self._described.add(original)
                self._describe(original, depsgraph)
            if kind in BECOMES_MESH:
                by_nodes = original.type != kind or any(m.type == "NODES" for m in original.modifiers)
                remedy = "Have its geometry nodes make a mesh, as Curve to Mesh does" if by_nodes else FACES[kind]
                self._is_faceless(original.name, original, "gives no faces and is left out", remedy)
        if kind == "MESH":
            return self._visit_mesh(inst, obj, original, over)
        if kind == "LIGHT":
            self._visit_light(inst, obj, original)
        elif original.is_missing:
            self._notices.add(original.name, *targets.missing(original))
        elif kind not in FACELESS and kind not in BECOMES_MESH:
            self._is_faceless(original.name, original, f"is of type {_words(kind)}, which has no faces, and is left out")
        return True

    def _is_faceless(self, name: str, original: bpy.types.Object, reason: str, remedy: str = "") -> None:
        """Note that an object has no faces of its own, to be said unless what it makes is in the light."""
        self._faceless[name] = reason, remedy
        if original.type == "META":
            self._metas.add(name)

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

    def _visit_mesh(
        self,
        inst: bpy.types.DepsgraphObjectInstance,
        obj: bpy.types.Object,
        original: bpy.types.Object,
        over: Callable[[], bool] = lambda: False,
    ) -> bool:
        """As `_visit`, of what has a mesh."""
        name, source, ids = self._identity = self._identity or self._identify(inst, original)
        matrix = [x for row in inst.matrix_world for x in row]
        maker = inst.parent.original.name if ids and inst.parent else ""
        own = self._real.get(name)
        if own is not None:
            if not reals.is_whole(own):
                self._given.add(source)
                name, source, ids, maker = own.name, own.name, (), reals.maker_name(own)
            matrix = reals.placed(own, matrix)
        if is_flat(matrix):
            reason = "has a scale of zero or a matrix that is not a number and is left out"
            self._notices.add(name, reason, "Give it a scale other than zero on every axis")
            self._given.add(source)
        else:
            mesh = own.data if own is not None else obj.data
            if not self._is_copied(obj, mesh, source, over):
                return False
            pointer = mesh.as_pointer()
            if self._meshes[pointer] is not None:
                uid, terminator = (own or original).session_uid, terminator_offset(original, "geometry")
                mirrored, slots = determinant_of(matrix) < 0.0, self._slots(obj, original, pointer)
                self._visits.append(Visit(pointer, mirrored, slots, name, source, maker, uid, ids, tuple(matrix), terminator))
        self._identity = None
        return True

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
            path = tuple(i for i in inst.persistent_id if i != NO_ID)
            # What is no mesh and has faces lists these as an instance of itself, the first of its parts; what its nodes make lies deeper.
            own_faces = parent is not None and parent == original and original.type != "MESH" and len(path) == 1
            if not own_faces:
                ids, maker = path, parent.name if parent is not None else ""
                name = f"{name}[{'.'.join([maker, *map(str, ids)])}]"
        unique = name
        count = 1
        while unique in self._names:
            count += 1
            unique = f"{name}#{count}"
        self._names.add(unique)
        return unique, original.name, ids

    def _is_copied(self, obj: bpy.types.Object, mesh: bpy.types.Mesh, name: str, over: Callable[[], bool]) -> bool:
        """Copy a mesh, as far as `over()` lets it; returns whether it is done. What has no faces is None among the meshes.

        In edit mode its layers cannot be read (their length is 0), but those of a temporary copy can.
        """
        pointer = mesh.as_pointer()
        if pointer not in self._meshes:
            if not mesh.polygons and not mesh.is_editmode:
                self._is_faceless(name, obj.original, "has no faces and is left out")
                self._meshes[pointer] = None
                return True
            ours = {stored.read(mesh, stored.UV) or "", own_layer(obj.original) if obj.original.type == "MESH" else ""}
            self._meshes[pointer] = MeshCopy(name, self._numbers, ours)
        copy = self._meshes[pointer]
        if copy is None or copy.complete:
            return True
        if not mesh.is_editmode:
            return copy.go_on(mesh, over)
        try:
            return copy.go_on(obj.to_mesh(), lambda: False)
        finally:
            obj.to_mesh_clear()

    def _slots(self, obj: bpy.types.Object, original: bpy.types.Object, pointer: int) -> np.ndarray:
        """(ns,) int32 material index of each slot, at least one: those of the object count where they are linked to it."""
        key = original.as_pointer(), pointer
        if key not in self._slots_of:
            self._slots_of[key] = np.array([self._material_of(m) for m in self.user_materials(obj, obj.data) or [None]], np.int32)
        return self._slots_of[key]

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
