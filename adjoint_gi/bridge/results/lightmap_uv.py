# SPDX-License-Identifier: GPL-3.0-or-later
"""UV layers for lightmaps: choosing the one the user names, or making one without touching anything else of the mesh.

A lightmap belongs to the evaluated mesh. Where that has the faces of the original one, which no other object uses, the layer stands on
the original mesh, where a game export finds it; else a modifier of ours carries it (`carried`).

Blender's own unwrapping needs edit mode, a selection and a context, and leaves traces in all three; so the layer is computed from
the mesh's arrays (`core.receivers.unwrap`) and written in one go. It is the same in every version, with or without a window.
"""

from __future__ import annotations

import contextlib
import functools
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ...core.base.errors import Notice, TargetError
from ...core.receivers.unwrap import Unwrapped, unwrap
from ..host.meshes import corner_vertices, first_corners
from ..host.viewport import differences
from . import carried, stored
from . import links as targets
from .faces import FacesCopy, MeshFaces, copy_faces, has_flat_faces
from .real import is_real
from .stored import ASKED, FACES, SHARED

STORED = stored.UV  # custom property of the mesh: name of the layer made by us
NOTED = (STORED, SHARED, FACES, ASKED)  # all that is noted of such a layer
NAME = "Lightmap"  # what such a layer is called where nothing else is
MOST = 8  # UV layers of a Blender mesh


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
    made = own_layer(obj)
    if made:
        return made
    chosen = next((x.name for x in layers if x.active_render), "")
    if not chosen:
        raise TargetError(obj.name, "has no UV layer", "Unwrap it or make a lightmap layer")
    return chosen


def own_layer(obj: bpy.types.Object) -> str:
    """Name of the layer made by us for `obj`, carried or on its mesh; empty where there is none."""
    return carried.layer_name(obj) or _on_mesh(obj.data)


def layer_values(obj: bpy.types.Object, name: str) -> np.ndarray | None:
    """(corners, 2) float32 of the layer `name`, as it is carried or stands on the mesh of `obj`; None where there is none."""
    if name and name == carried.layer_name(obj):
        held = carried.carried(obj)
        return held.uv if held is not None else None
    layer = obj.data.uv_layers.get(name)
    if layer is None:
        return None
    out = np.empty((len(obj.data.loops), 2), np.float32)
    layer.uv.foreach_get("vector", out.reshape(-1))
    return out


def outdated(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, edited: Callable[[bpy.types.NodeTree], bool] = carried.edited) -> str:
    """Why the layer made by us does not fit `obj` any more, as the words after its name; empty where it does, or where there is none."""
    if carried.carrier(obj) is None:
        if not _on_mesh(obj.data):
            return ""
        if carried.must_carry(obj):
            return "has got modifiers that make faces, or shares its mesh, since its lightmap UVs were made"
        now = _print(obj.data)
        return "has got other faces since its lightmap UVs were made" if (stored.read(obj.data, FACES) or now) != now else ""
    if not carried.must_carry(obj) and _room(obj):
        return "has lost the modifiers that its lightmap UVs were made for"
    if fault := carried.fault(obj, edited):
        return fault
    if not carried.belongs_to(obj):
        return "is a copy and has the lightmap UVs of its original"
    lost = carried.out_of_place(obj) or not _has_place(obj.evaluated_get(depsgraph).data, carried.layer_name(obj))
    return "has got other faces since its lightmap UVs were made" if lost else ""


def check_target(obj: bpy.types.Object) -> None:
    """Raise TargetError unless `obj` can have a layer of ours: not of another file, and its mesh in edit mode on no object.

    What a bake has made of an instance is in the light with its own mesh, to which no modifier adds a layer.
    """
    targets.check_object(obj)
    targets.check_edit_mode(obj)
    if is_real(obj) and not _room(obj):
        raise TargetError(obj.name, f"has {MOST} UV layers, as many as there can be", "Remove one from the mesh that it is made of")


@dataclass(frozen=True, eq=False)
class UvPlan:
    """What is unwrapped for some objects, read from Blender: `faces` of each, and whether its layer is to be `carried`."""

    objects: tuple[bpy.types.Object, ...]
    faces: tuple[MeshFaces, ...]
    carried: tuple[bool, ...]
    vertices: tuple[np.ndarray, ...]  # (corners,) int32 vertex of each corner
    names: tuple[frozenset[str], ...]  # attributes that the meshes have
    shapes: tuple[tuple[np.ndarray, np.ndarray], ...]  # `PlanCopy.shape`

    def spread(self, unwrapped: Unwrapped) -> list[np.ndarray]:
        """(corners, 2) float32 UV of each object. Needs no Blender."""
        return [face.spread(uv) for face, uv in zip(self.faces, unwrapped.uvs, strict=True)]


@dataclass(frozen=True, eq=False)
class PlanCopy:
    """What Blender says of one object for a plan: its faces, whether its layer is to be carried, what attributes its mesh has, and whether
    renders have other faces."""

    faces: FacesCopy
    carried: bool
    names: frozenset[str]
    differs: bool = False

    def shape(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles and places for `carried.CarriedUvs`, empty where renders have the same faces."""
        if not self.differs:
            return np.empty((0, 3), np.int32), np.empty((0, 3), np.float32)
        return self.faces.corners, self.faces.positions[self.faces.vertices]


def copy_for_plan(obj: bpy.types.Object, view_layer: bpy.types.ViewLayer) -> PlanCopy:
    """The mesh of `obj` as it is to be unwrapped: evaluated where the layer must be carried. Nothing is changed.

    Raises TargetError for an object of another file and for edit mode, SceneError for a mesh without faces.
    """
    check_target(obj)
    if not (carried.must_carry(obj) or not _room(obj)):
        moved = carried.subdivided(obj, len(obj.data.vertices), view_layer) if has_flat_faces(obj.data) else None
        return PlanCopy(copy_faces(obj, obj.data, moved), False, frozenset(a.name for a in obj.data.attributes))
    with carried.stage([obj], view_layer):
        mesh = obj.evaluated_get(view_layer.depsgraph).data
        names, differs = frozenset(a.name for a in mesh.attributes), bool(differences(obj, view_layer.id_data))
        copy, flat = PlanCopy(copy_faces(obj, mesh), True, names, differs), has_flat_faces(mesh)
    moved = carried.subdivided(obj, len(copy.faces.positions), view_layer) if flat else None
    return copy if moved is None else replace(copy, faces=replace(copy.faces, positions=moved))


def plan_of(objects: Sequence[bpy.types.Object], copies: Sequence[PlanCopy]) -> UvPlan:
    """What `copies` make of `objects`, at which nothing is looked here. Raises SceneError for a mesh that has no usable face."""
    faces, vertices = tuple(c.faces.faces() for c in copies), tuple(c.faces.vertices for c in copies)
    names, shapes = tuple(c.names for c in copies), tuple(c.shape() for c in copies)
    return UvPlan(tuple(objects), faces, tuple(c.carried for c in copies), vertices, names, shapes)


def write_plan(plan: UvPlan, unwrapped: Unwrapped, uvs: Sequence[np.ndarray], name: str = NAME) -> Callable[[], None]:
    """Give the objects of `plan` the layers `unwrapped`, spread to `uvs`; returns what takes that back. All get their layer, or none.

    Raises TargetError where a layer cannot be added.
    """
    carrying, tree = {obj for obj, carry in zip(plan.objects, plan.carried, strict=True) if carry}, functools.cache(carried.node_group)
    with contextlib.ExitStack() as back:
        for obj in plan.objects:
            back.callback(_snapshot(obj))
        for k, (obj, uv) in enumerate(zip(plan.objects, uvs, strict=True)):
            if plan.carried[k]:
                mine = _on_mesh(obj.data)
                taken = plan.names[k] - {mine} if _remove_from_mesh(obj, carrying) else plan.names[k]
                carried.carry(obj, _free(obj, name, taken), carried.CarriedUvs(uv, plan.vertices[k], *plan.shapes[k]), tree())
            else:
                carried.drop(obj)
                _write_layer(obj, name, uv)
        _mark_shared(plan.objects, unwrapped)
        return back.pop_all().close


def take_back(restoring: Sequence[Callable[[], None]]) -> None:
    """Call all that `write_plan` returned, the last first."""
    with carried.removing_together(), contextlib.ExitStack() as back:
        for restore in restoring:
            back.callback(restore)


def make_lightmap_uvs(
    objects: Sequence[bpy.types.Object], resolution: int, paddings: Sequence[int], name: str = NAME, density: np.ndarray | None = None
) -> list[Notice]:
    """Make (or renew) our UV layers of `objects`, packed into one square that all of them share.

    Charts do not overlap and lie as many texels apart in an image of `resolution` as the first of `paddings` that fits; `density` is
    that of `unwrap`. The active and the render layer, the selection and everything else stay as they are. All objects get their
    layer, or none. Returns what there is to say. Raises TargetError for an object of another file, edit mode, or more charts than fit;
    SceneError for a mesh that has no usable face.
    """
    plan = plan_of(objects, [copy_for_plan(obj, bpy.context.view_layer) for obj in objects])
    with listed_errors(objects):
        unwrapped = unwrap([face.mesh for face in plan.faces], resolution, paddings)
    write_plan(plan, unwrapped, plan.spread(unwrapped), name)
    return notices(objects, unwrapped)


@contextlib.contextmanager
def listed_errors(objects: Sequence[bpy.types.Object]) -> Iterator[None]:
    """Errors of unwrapping name `objects`."""
    try:
        yield
    except TargetError as error:
        raise TargetError(_listed(objects), error.notice.reason, error.notice.remedy) from error


def paddings(resolution: int) -> tuple[int, ...]:
    """Texels to keep free between charts, the most first: as many as there is room for in an image of `resolution`, four at most."""
    return tuple(padding for padding in (4, 2, 1, 0) if padding <= max(1, resolution // 128))


def in_one_square(objects: Sequence[bpy.types.Object]) -> bool:
    """Whether the layers made by us on `objects` were packed together, so that no two of them lie on one another."""
    places = [(stored.read(marked(obj), SHARED) or "").split("/") for obj in objects]
    return (
        all(len(place) == 2 for place in places)
        and len({square for square, _ in places}) == 1
        and len({n for _, n in places}) == len(places)
    )


def duplicated(objects: Sequence[bpy.types.Object]) -> set[bpy.types.Object]:
    """Those of `objects` whose layers made by us are in the same place of a square as that of another: one is a copy of the other."""
    places = [(obj, stored.read(marked(obj), SHARED)) for obj in objects if own_layer(obj)]
    counts = Counter(place for _, place in places if place is not None)
    return {obj for obj, place in places if counts[place] > 1}


def shares_square(obj: bpy.types.Object) -> bool:
    """Whether the layer made by us on `obj` was packed with those of other objects, so that it fills only a part of the image."""
    return stored.read(marked(obj), SHARED) is not None


def remove_lightmap_uv(obj: bpy.types.Object, going: Set[bpy.types.Object] = frozenset()) -> bool:
    """Remove the layer made by us; returns whether there was one. The user's active and render layers stay.

    One on a mesh that other objects use stays, unless they are among those that are `going` to lose it, too.
    """
    dropped = carried.drop(obj)
    return _remove_from_mesh(obj, going) or dropped


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
    guilty = [m.name for m in obj.modifiers if m.type not in carried.KEEPS_UVS and (m.show_viewport or m.show_render)]
    if more and guilty and name != own_layer(obj):
        reason = f"modifier {', '.join(guilty)} adds faces, which may lie on the same texels as the original ones"
        return (Notice(obj.name, reason, "Name no UV layer: then one is made for the mesh as the modifiers make it"),)
    return ()


def notices(objects: Sequence[bpy.types.Object], unwrapped: Unwrapped, long_told: bool = False) -> list[Notice]:
    """What the user should know of how it was unwrapped; not of long faces where that is `long_told` already."""
    long = [obj for obj, length in zip(objects, unwrapped.length, strict=True) if length < 1.0 and not long_told]
    told = []
    if long:
        reason = "has faces so long that they get fewer texels along their length, or the others would get few as well"
        told.append(Notice(_listed(long), reason, "Cut long faces into shorter ones for more texels", "info"))
    if not unwrapped.projected:
        return told
    reason = f"the lightmap UVs are made by projection, which fills less of the image, because {unwrapped.projected}"
    return [*told, Notice(_listed(objects), reason, "Raise the resolution, or unwrap it yourself and name the UV layer", "info")]


# ---- layers on meshes


def _on_mesh(mesh: bpy.types.Mesh) -> str:
    """Name of the layer on `mesh` made by us, empty where there is none."""
    name = stored.read(mesh, STORED)
    return name if name is not None and name in mesh.uv_layers else ""


def _room(obj: bpy.types.Object) -> bool:
    """Whether the mesh has a layer of ours, or can get one."""
    return bool(_on_mesh(obj.data)) or len(obj.data.uv_layers) < MOST


def _write_layer(obj: bpy.types.Object, name: str, uv: np.ndarray) -> None:
    """Write `uv` (corners, 2) float32 to our layer, made as `name` where there is none. Raises TargetError."""
    mesh = obj.data
    active, render = mesh.uv_layers.active_index, next((i for i, x in enumerate(mesh.uv_layers) if x.active_render), -1)
    old = _on_mesh(mesh)
    layer = mesh.uv_layers[old] if old else mesh.uv_layers.new(name=name, do_init=False)
    if layer is None:
        raise TargetError(obj.name, f'UV layer "{name}" could not be added', "Remove another UV layer")
    made = layer.name
    # By `layer.uv`, Blender 4.2 to 5.0 write into the memory that this mesh shares with its copies (measured), and change these, too.
    mesh.attributes[made].data.foreach_set("vector", uv.ravel())
    mesh[STORED], mesh[FACES] = made, _print(mesh)
    if render >= 0:
        mesh.uv_layers.active_index = active
        mesh.uv_layers[render].active_render = True
    mesh.update()


def _remove_from_mesh(obj: bpy.types.Object, going: Set[bpy.types.Object] = frozenset()) -> bool:
    """Remove our layer from the mesh, if that may be changed and nothing needs it but `obj` and those that are `going` to do without.

    Returns whether one went.
    """
    mesh = obj.data
    name = stored.read(mesh, STORED)
    others = [o for o in targets.sharing(obj) if o not in going and not carried.layer_name(o)]
    if name is None or others or targets.linked(obj, True) is not None:
        return False
    if name in mesh.uv_layers:
        active = mesh.uv_layers.active.name if mesh.uv_layers.active else ""
        render = next((x.name for x in mesh.uv_layers if x.active_render), "")
        mesh.uv_layers.remove(mesh.uv_layers[name])
        if active in mesh.uv_layers:
            mesh.uv_layers.active = mesh.uv_layers[active]
        if render in mesh.uv_layers:
            mesh.uv_layers[render].active_render = True
    for key in NOTED:
        if key in mesh:
            del mesh[key]
    return True


def _print(mesh: bpy.types.Mesh) -> str:
    """Checksum of the faces: the vertices of all corners, and where faces start."""
    return f"{zlib.crc32(first_corners(mesh), zlib.crc32(corner_vertices(mesh))):08x}"


# ---- layers of both kinds


def marked(obj: bpy.types.Object) -> bpy.types.ID:
    """Where things are noted of our layer of `obj`: the hidden object that holds it, or the mesh that has it."""
    return carried.holder(obj) or obj.data


def _free(obj: bpy.types.Object, name: str, taken: frozenset[str]) -> str:
    """The name that `obj` carries its layer by: its present one, else `name`, with a number where the mesh has something so called."""
    old = carried.layer_name(obj)
    if old:
        return old
    numbered = (f"{name}.{k:03d}" for k in range(1, 1000))
    return name if name not in taken else next(n for n in numbered if n not in taken)


def _has_place(mesh: bpy.types.Mesh, name: str) -> bool:
    """Whether the evaluated `mesh` has the carried layer, and not what stands for changed faces."""
    layer = mesh.uv_layers.get(name)
    if layer is None or not len(mesh.loops):
        return False
    return layer.uv[0].vector[0] > 0.5 * carried.NO_PLACE[0]  # subdivision behind our modifier rounds


def _snapshot(obj: bpy.types.Object) -> Callable[[], None]:
    """What puts our layer of `obj` back as it is now."""
    name, before = carried.layer_name(obj), carried.carried(obj)
    modifier, layer = carried.carrier(obj), _on_mesh(obj.data)
    on = (modifier.show_viewport, modifier.show_render) if modifier is not None else ()
    uv = layer_values(obj, layer) if layer else None
    beside, on_mesh = _marks(marked(obj)), _marks(obj.data)  # whatever they hold: what is damaged is put back, too

    def restore() -> None:
        own = carried.holder(obj)
        if before is None:
            carried.drop(obj)
        elif own is not None:
            for key in _marks(own):
                del own[key]
        _remove_from_mesh(obj)
        if before is not None:
            carried.carry(obj, name, before)
            carried.carrier(obj).show_viewport, carried.carrier(obj).show_render = on
        elif uv is not None:
            _write_layer(obj, layer, uv)
        for owner, values in ((marked(obj), beside), (obj.data, on_mesh)):
            for key, value in values.items():
                owner[key] = value

    return restore


def _marks(owner: bpy.types.ID) -> dict[str, Any]:
    """What is noted on `owner` of our layer; groups and arrays as copies, since what Blender hands out ends with the property."""
    values = {key: owner[key] for key in NOTED if key in owner}
    return {k: v.to_dict() if hasattr(v, "to_dict") else v.to_list() if hasattr(v, "to_list") else v for k, v in values.items()}


def _mark_shared(objects: Sequence[bpy.types.Object], unwrapped: Unwrapped) -> None:
    """Note beside the layers that they lie in one square; a single object has its own."""
    square = zlib.crc32(b"".join(uv.tobytes() for uv in unwrapped.uvs))
    for number, obj in enumerate(objects):
        beside = marked(obj)
        if len(objects) > 1:
            beside[SHARED] = f"{square:08x}/{number}"
        elif SHARED in beside:
            del beside[SHARED]


def _listed(objects: Sequence[bpy.types.Object]) -> str:
    names = [obj.name for obj in objects]
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
