# SPDX-License-Identifier: GPL-3.0-or-later
"""Lightmap UVs of the evaluated mesh, carried by a modifier of ours, so that nothing is applied and no mesh of the user is changed.

A hidden object has one loose vertex for each corner of the evaluated mesh: x and y are the corner's UV, z is the vertex it belongs to.
A geometry-nodes modifier, whose node group all objects share, samples them by index and stores them as a named attribute on corners,
which is a UV map to everything behind it. Where count or vertices of the corners are others by now, every corner gets `NO_PLACE`.

Where renders have other faces than the viewport (levels of subdivision, modifiers that are on in one of them), the hidden object
also has the triangles of the mesh, and an attribute `PLACE` of where they lie: faces of a render take the UV of the nearest of them.

The modifier is the last one and is kept there. Only subdivision behind everything else stays behind it: it carries UVs on by itself,
and has other levels in renders than in the viewport.
"""

from __future__ import annotations

import contextlib
import functools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ..host.meshes import copied, corner_vertices, positions
from ..host.versions import modifier_input, set_modifier_input, version_text
from . import links as targets
from . import stored
from .attribute import KEEPS_TOPOLOGY
from .real import remove_objects
from .stored import HOLDER, NODES, TREE

KIND = "carry"  # value of our custom property of node groups that says which group this is
GROUP = "Adjoint GI Lightmap UV"
PLACE = "adjoint_gi_place"  # attribute of hidden objects: places of the corners on the mesh
SLOPES, ORIGIN = ("adjoint_gi_u", "adjoint_gi_v"), "adjoint_gi_uv_origin"  # of its triangles: u is slope . place + origin
AHEAD = 4.0  # times the distance to the nearest triangle: how far before a face another one is looked for
NO_PLACE = (-1.0, -1.0, 0.0)  # the UV of a mesh that the layer was not made for; no texel lies there
SUBDIVIDES = {"SUBSURF", "MULTIRES"}
# Modifiers behind which UVs of the mesh before them are still without overlap: those of others would lie on the same texels.
KEEPS_UVS = KEEPS_TOPOLOGY | SUBDIVIDES | {"TRIANGULATE", "EDGE_SPLIT", "PARTICLE_SYSTEM", "COLLISION", "SURFACE"}
CHANGED = "The mesh has changed since its lightmap UVs were made. Renew them and bake again"


@dataclass(frozen=True, eq=False)
class CarriedUvs:
    """What the hidden object has of n corners: `uv` (n, 2) float32 and the `vertex` (n,) int32 of each; and, where renders have other
    faces, the corners of the `triangles` (nt, 3) int32 and the `places` (n, 3) float32 of all; else these two are empty."""

    uv: np.ndarray
    vertex: np.ndarray
    triangles: np.ndarray
    places: np.ndarray


def must_carry(obj: bpy.types.Object) -> bool:
    """Whether UVs on the mesh itself would not do: modifiers make faces, other objects use the mesh, or it belongs to another file."""
    return any(m.type not in KEEPS_UVS for m in _enabled(obj)) or targets.linked(obj, True) is not None or targets.shares(obj)


def carrier(obj: bpy.types.Object) -> bpy.types.Modifier | None:
    """Our modifier on `obj`."""
    return next((m for m in obj.modifiers if is_ours(m)), None)


def is_ours(modifier: bpy.types.Modifier) -> bool:
    """Whether it is one that carries lightmap UVs."""
    return modifier.type == "NODES" and modifier.node_group is not None and stored.read(modifier.node_group, TREE) == KIND


def layer_name(obj: bpy.types.Object) -> str:
    """Name of the UV map that is carried, empty where there is none."""
    modifier = carrier(obj)
    return str(modifier_input(modifier, "Name") or "") if modifier is not None else ""


def holder(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The hidden object whose vertices are the UVs of `obj`; None where it is lost."""
    modifier = carrier(obj)
    found = modifier_input(modifier, "UVs") if modifier is not None else None
    return found if isinstance(found, bpy.types.Object) and is_holder(found) else None


def is_holder(obj: bpy.types.Object) -> bool:
    """Whether a bake has made `obj` to hold UVs, whatever a damaged file says: it is of vertices only, or these have places elsewhere."""
    fits = obj.type == "MESH" and (not obj.data.polygons or PLACE in obj.data.attributes)
    return fits and stored.read(obj, HOLDER) is not None


def belongs_to(obj: bpy.types.Object) -> bool:
    """Whether what `obj` carries is its alone: a copy of an object carries the layer of its original."""
    own = holder(obj)
    if own is None or own.users == 1:
        return own is not None
    return not any(holder(other) == own for other in bpy.data.objects if other != obj and other.type == "MESH")


def edited(tree: bpy.types.NodeTree) -> bool:
    """Whether users have made another one of a node group of ours. Of many objects it is to be asked once: it takes over 1 ms."""
    made = stored.read(tree, NODES) or ""
    return made.split("/")[0] == version_text() and made != _print(tree)


def fault(obj: bpy.types.Object, edited: Callable[[bpy.types.NodeTree], bool] = edited) -> str:
    """What users have done to our modifier of `obj` so that it does not carry its layer, as words after the object's name, or nothing.

    `carry` puts all of that right.
    """
    modifier = carrier(obj)
    if modifier is None:
        return ""
    if not modifier.show_viewport:
        return f'has lightmap UVs whose modifier "{modifier.name}" is off in the viewport, which is turned on'
    if edited(modifier.node_group):
        return f'has lightmap UVs whose node group "{modifier.node_group.name}" was edited, which is put right'
    return "has lost the hidden object that held its lightmap UVs" if holder(obj) is None else ""


@contextlib.contextmanager
def stage(objects: Sequence[bpy.types.Object], view_layer: bpy.types.ViewLayer) -> Iterator[None]:
    """The evaluated meshes of `objects` are, for a while, those that our modifier gets: without subdivision that comes after it."""
    behind = [m for obj in objects for m in _behind(obj) if m.show_viewport]
    try:
        for modifier in behind:
            modifier.show_viewport = False
        view_layer.update()
        yield
    finally:
        for modifier in behind:
            modifier.show_viewport = True
        if behind:
            view_layer.update()


def subdivided(obj: bpy.types.Object, count: int, view_layer: bpy.types.ViewLayer) -> np.ndarray | None:
    """(count, 3) float32 places to which subdivision takes the vertices of the mesh that it gets, which are the first of its own; None
    where nothing is subdivided.

    Faces that were extruded and left in place have no area before it, and one behind it: unwrapped by these places they have texels.
    """
    if not any(m.type in SUBDIVIDES and m.show_viewport for m in _behind(obj)):
        return None
    evaluated = obj.evaluated_get(view_layer.depsgraph)
    mesh = evaluated.to_mesh()
    try:
        return positions(mesh)[:count].copy() if len(mesh.vertices) >= count else None
    finally:
        evaluated.to_mesh_clear()


def carry(obj: bpy.types.Object, name: str, held: CarriedUvs, tree: bpy.types.NodeTree | None = None) -> None:
    """Have `obj` carry what is `held` of the corners of its evaluated mesh at our `stage`, as a UV map called `name`.

    What it carried before is replaced. tree: what `node_group` has given, by which many objects get theirs sooner.
    """
    modifier, old = carrier(obj), holder(obj)
    own = old if belongs_to(obj) else None
    if own is None:
        own = bpy.data.objects.new(f"{obj.name} {name}", bpy.data.meshes.new(f"{obj.name} {name}"))
        own[HOLDER] = True
    _fill(own.data, held)
    if modifier is None:
        modifier = obj.modifiers.new(GROUP, "NODES")
        modifier.show_expanded = False
    before, tree = modifier.node_group, tree or node_group()
    modifier.show_viewport = modifier.show_render = True
    modifier.node_group = tree
    set_modifier_input(modifier, "UVs", own)
    set_modifier_input(modifier, "Name", name)
    modifier.node_group = tree  # only so the depsgraph learns of another object
    if before is not None and before.users == 0:
        bpy.data.node_groups.remove(before)
    _place(obj, modifier)
    obj.update_tag()
    if old is not None and old.users == 0:
        _remove([old])


def carried(obj: bpy.types.Object) -> CarriedUvs | None:
    """What was given to `carry`; None where there is nothing."""
    own = holder(obj)
    if own is None:
        return None
    points, places = positions(own.data), np.empty((0, 3), np.float32)
    if PLACE in own.data.attributes:
        places = copied(own.data.attributes[PLACE].data, "vector", 3, np.float32)
    return CarriedUvs(points[:, :2].copy(), points[:, 2].astype(np.int32), corner_vertices(own.data).reshape(-1, 3), places)


def drop(obj: bpy.types.Object) -> bool:
    """Remove our modifier from `obj`, and what only it needs; returns whether there was one."""
    modifier = carrier(obj)
    if modifier is None:
        return False
    own, tree = holder(obj), modifier.node_group
    set_modifier_input(modifier, "UVs", None)  # Blender 5.2 does not count a user less when the modifier goes
    obj.modifiers.remove(modifier)
    if own is not None and own.users == 0:
        _remove([own])
    if tree.users == 0:
        bpy.data.node_groups.remove(tree)
    return True


def drop_orphans() -> None:
    """Remove hidden objects, and the node group, that nothing needs any more because objects or modifiers were deleted."""
    needed = {holder(o) for o in bpy.data.objects if o.type == "MESH"}
    _remove([o for o in bpy.data.objects if is_holder(o) and o not in needed])
    for tree in [t for t in bpy.data.node_groups if stored.read(t, TREE) == KIND and t.users == 0]:
        bpy.data.node_groups.remove(tree)


def node_group() -> bpy.types.NodeTree:
    """Our node group, made once for each file, and again where users, another version of Blender or of ours made it another one: see
    the head of this file."""
    for tree in bpy.data.node_groups:
        if stored.read(tree, TREE) == KIND and tree.library is None and stored.read(tree, NODES) == _print(tree):
            return tree
    tree = bpy.data.node_groups.new(GROUP, "GeometryNodeTree")
    tree[TREE] = KIND
    for name, kind in (("Geometry", "Geometry"), ("UVs", "Object"), ("Name", "String")):
        tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = _node(tree, "NodeGroupInput"), _node(tree, "NodeGroupOutput")
    mesh = start.outputs["Geometry"]
    held = _node(tree, "GeometryNodeObjectInfo", Object=start.outputs["UVs"]).outputs["Geometry"]

    # Step 1: what is held for each corner.
    here = _node(tree, "GeometryNodeInputIndex").outputs["Index"]
    sample = _node(tree, "GeometryNodeSampleIndex", data_type="FLOAT_VECTOR", domain="POINT", Geometry=held, Index=here)
    tree.links.new(_node(tree, "GeometryNodeInputPosition").outputs["Position"], _socket(sample.inputs, "Value"))
    point = _socket(sample.outputs, "Value")

    # Step 2: whether it is for this mesh: as many corners, each of the same vertex.
    corners = _node(tree, "GeometryNodeAttributeDomainSize", Geometry=mesh).outputs["Face Corner Count"]
    points = _node(tree, "GeometryNodeAttributeDomainSize", Geometry=held).outputs["Point Count"]
    others = _node(tree, "FunctionNodeCompare", data_type="INT", operation="NOT_EQUAL", A=corners, B=points)
    vertex = _node(tree, "GeometryNodeVertexOfCorner").outputs["Vertex Index"]
    expected = _node(tree, "ShaderNodeSeparateXYZ", Vector=point).outputs["Z"]
    differs = _node(tree, "FunctionNodeCompare", data_type="FLOAT", operation="NOT_EQUAL", A=vertex, B=expected)
    _socket(differs.inputs, "Epsilon").default_value = 0.5
    most = _node(tree, "GeometryNodeAttributeStatistic", domain="CORNER", Geometry=mesh, Attribute=differs.outputs["Result"])
    changed = _logic(tree, "OR", others.outputs["Result"], _socket(most.outputs, "Max"))

    # Step 3: a mesh that is another one in renders has that of the nearest point on the one that the viewport shows.
    nearest, found = _nearest(tree, held)
    here = _node(tree, "GeometryNodeIsViewport").outputs["Is Viewport"]
    instead = _node(tree, "GeometryNodeSwitch", input_type="VECTOR", Switch=_logic(tree, "OR", here, found), False_=nearest)
    _socket(instead.inputs, "True").default_value = NO_PLACE

    # Step 4: the UV map.
    elsewhere = _socket(instead.outputs, "Output")
    choice = _node(tree, "GeometryNodeSwitch", input_type="VECTOR", Switch=changed, False_=point, True_=elsewhere)
    uv = _socket(choice.outputs, "Output")
    store = _node(tree, "GeometryNodeStoreNamedAttribute", data_type="FLOAT2", domain="CORNER", Geometry=mesh, Value=uv)
    tree.links.new(start.outputs["Name"], store.inputs["Name"])
    tree.links.new(store.outputs["Geometry"], end.inputs["Geometry"])
    _warn(tree, changed)
    tree[NODES] = _print(tree)
    return tree


def _print(tree: bpy.types.NodeTree) -> str:
    """The version of Blender, and a checksum of what `tree` does: its sockets, nodes, links, and values where nothing is linked."""
    found = [f"{item.item_type} {item.name} {getattr(item, 'in_out', '')}" for item in tree.interface.items_tree]
    for node in tree.nodes:
        values = [getattr(socket, "default_value", None) for socket in node.inputs if not socket.is_linked]
        plain = [x if isinstance(x, float | int | str | None) else tuple(x) if hasattr(x, "__len__") else "" for x in values]
        found.append(f"{node.name} {node.bl_idname} {node.mute} {[getattr(node, name) for name in _choices(node.bl_idname)]} {plain}")
    for link in tree.links:
        ends = [f"{socket.node.name} {socket.identifier}" for socket in (link.from_socket, link.to_socket)]
        found.append(f"{ends} {link.is_muted}")
    return f"{version_text()}/{zlib.crc32(repr(sorted(found)).encode()):08x}"


@functools.cache
def _choices(kind: str) -> tuple[str, ...]:
    """Names of what is chosen on nodes of this kind; to ask Blender for them takes longer than all else of `_print`."""
    own, all_have = getattr(bpy.types, kind).bl_rna.properties, bpy.types.Node.bl_rna.properties
    return tuple(x.identifier for x in own if x.type in ("ENUM", "BOOLEAN") and x.identifier not in all_have and not x.is_readonly)


def _nearest(tree: bpy.types.NodeTree, held: bpy.types.NodeSocket) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """UVs by the triangle that is nearest to each face, of those `held` in their places, and whether there are none.

    A face takes all its corners from one triangle, whose UV goes on evenly beyond it: charts lie far apart. Where the nearest one faces the
    other way, as the far side of a thin wall does, one that faces the same way is looked for from a little before the face.
    """
    faces = _node(tree, "GeometryNodeAttributeDomainSize", Geometry=held).outputs["Face Count"]
    none = _node(tree, "FunctionNodeCompare", data_type="INT", operation="EQUAL", A=faces).outputs["Result"]
    triangles = _node(tree, "GeometryNodeSetPosition", Geometry=held, Position=_named(tree, PLACE)).outputs["Geometry"]
    position = _node(tree, "GeometryNodeInputPosition").outputs["Position"]
    middle, normal = (_of_face(tree, x) for x in (position, _node(tree, "GeometryNodeInputNormal").outputs["Normal"]))

    def at(start: bpy.types.NodeSocket, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """`value` of the triangles at the point on them that is nearest to `start`."""
        inputs = {"Mesh": triangles, "Value": value, "Sample_Position": start}
        return _of_face(tree, _socket(_node(tree, "GeometryNodeSampleNearestSurface", data_type="FLOAT_VECTOR", **inputs).outputs, "Value"))

    def facing(start: bpy.types.NodeSocket, operation: str) -> bpy.types.NodeSocket:
        """Whether the triangle nearest to `start` has a normal whose product with that of the face is less or greater than 0."""
        product = _vector(tree, "DOT_PRODUCT", at(start, normal), normal).outputs["Value"]
        return _node(tree, "FunctionNodeCompare", data_type="FLOAT", operation=operation, A=product).outputs["Result"]

    distance = _vector(tree, "DISTANCE", at(middle, position), middle).outputs["Value"]
    ahead = _node(tree, "ShaderNodeMath", operation="MULTIPLY", Value=distance)
    ahead.inputs[1].default_value = AHEAD
    step = _node(tree, "ShaderNodeVectorMath", operation="SCALE", Vector=normal, Scale=ahead.outputs["Value"]).outputs["Vector"]
    before = _vector(tree, "ADD", middle, step).outputs["Vector"]
    better = _logic(tree, "AND", facing(middle, "LESS_THAN"), facing(before, "GREATER_THAN"))
    choice = _node(tree, "GeometryNodeSwitch", input_type="VECTOR", Switch=better, False_=middle, True_=before)
    start = _socket(choice.outputs, "Output")

    along = [_vector(tree, "DOT_PRODUCT", at(start, _named(tree, name)), position).outputs["Value"] for name in SLOPES]
    uv = _node(tree, "ShaderNodeCombineXYZ", X=along[0], Y=along[1]).outputs["Vector"]
    return _vector(tree, "ADD", uv, at(start, _named(tree, ORIGIN))).outputs["Vector"], none


def _named(tree: bpy.types.NodeTree, name: str) -> bpy.types.NodeSocket:
    """A vector attribute."""
    node = _node(tree, "GeometryNodeInputNamedAttribute", data_type="FLOAT_VECTOR")
    node.inputs["Name"].default_value = name
    return _socket(node.outputs, "Attribute")


def _vector(tree: bpy.types.NodeTree, operation: str, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.Node:
    """The node that does this with two vectors."""
    node = _node(tree, "ShaderNodeVectorMath", operation=operation)
    for socket, value in zip(node.inputs, (a, b), strict=False):
        tree.links.new(value, socket)
    return node


def _of_face(tree: bpy.types.NodeTree, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The vector `value` that the face has."""
    return _socket(_node(tree, "GeometryNodeFieldOnDomain", data_type="FLOAT_VECTOR", domain="FACE", Value=value).outputs, "Value")


def _logic(tree: bpy.types.NodeTree, operation: str, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """What AND or OR makes of two truths."""
    node = _node(tree, "FunctionNodeBooleanMath", operation=operation)
    for socket, value in zip(node.inputs, (a, b), strict=False):
        tree.links.new(value, socket)
    return node.outputs[0]


def _warn(tree: bpy.types.NodeTree, changed: bpy.types.NodeSocket) -> None:
    """Have the modifier say so where the mesh has `changed`; Blender 4.2 knows no such node."""
    if hasattr(bpy.types, "GeometryNodeWarning"):
        warning = _node(tree, "GeometryNodeWarning", Show=changed)
        _socket(warning.inputs, "Message").default_value = CHANGED
        if hasattr(warning, "warning_type"):
            warning.warning_type = "WARNING"


def _node(tree: bpy.types.NodeTree, kind: str, **values: str | bpy.types.NodeSocket) -> bpy.types.Node:
    """A new node with properties, and links from sockets to its inputs of these names (`False_`, `Sample_Position`)."""
    node = tree.nodes.new(kind)
    node.location = (180 * (len(tree.nodes) // 3), -220 * (len(tree.nodes) % 3))
    for name, value in values.items():
        if not isinstance(value, bpy.types.NodeSocket):
            setattr(node, name, value)
    for name, value in values.items():
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, _socket(node.inputs, name.rstrip("_").replace("_", " ")))
    return node


def _socket(sockets: Sequence[bpy.types.NodeSocket], name: str) -> bpy.types.NodeSocket:
    """The one called `name` that is in use: before Blender 5.2 a node has one of each name for every type of data."""
    return next(s for s in sockets if s.name == name and s.enabled)


def _fill(mesh: bpy.types.Mesh, held: CarriedUvs) -> None:
    """Make `mesh` one vertex for each corner, and triangles of them. The datablock stays: an undo step may know pointers to it."""
    mesh.clear_geometry()
    mesh.vertices.add(len(held.uv))
    mesh.vertices.foreach_set("co", np.column_stack([held.uv, held.vertex]).astype(np.float32).ravel())
    if len(held.places):
        mesh.loops.add(held.triangles.size)
        mesh.loops.foreach_set("vertex_index", held.triangles.ravel())
        mesh.polygons.add(len(held.triangles))
        mesh.polygons.foreach_set("loop_start", np.arange(0, held.triangles.size, 3, dtype=np.int32))
        mesh.attributes.new(PLACE, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", held.places.ravel())
        for name, values in zip((*SLOPES, ORIGIN), _slopes(held), strict=True):
            mesh.attributes.new(name, "FLOAT_VECTOR", "FACE").data.foreach_set("vector", values.astype(np.float32).ravel())
    mesh.update(calc_edges=bool(len(held.places)))


def _slopes(held: CarriedUvs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each triangle the slopes of u and v over its plane and (u, v, 0) at the object's origin, (nt, 3) float64."""
    place, uv = held.places[held.triangles].astype(np.float64), held.uv[held.triangles].astype(np.float64)
    along, flat = place[:, 1:] - place[:, :1], uv[:, 1:] - uv[:, :1]
    # The slope s of u has along @ s = flat, and lies in the plane: the solution of least length.
    slope = np.linalg.pinv(along, rcond=1e-6) @ flat
    origin = uv[:, 0] - np.einsum("ti,tic->tc", place[:, 0], slope)
    return slope[:, :, 0], slope[:, :, 1], np.pad(origin, ((0, 0), (0, 1)))


_waiting: list[list[int]] = []  # session_uids of what `removing_together` will remove, by the one inside which others are


@contextlib.contextmanager
def removing_together() -> Iterator[None]:
    """Hidden objects that nothing needs any more go at once in the end: for each removal Blender looks through all datablocks."""
    _waiting.append([])
    try:
        yield
    finally:
        remove_objects(_waiting.pop())


def _remove(objects: Sequence[bpy.types.Object]) -> None:
    """Remove hidden objects, now or with those that go together."""
    uids = [obj.session_uid for obj in objects]
    if _waiting:
        _waiting[-1].extend(uids)
    else:
        remove_objects(uids)


def _enabled(obj: bpy.types.Object) -> list[bpy.types.Modifier]:
    """The user's modifiers that do something."""
    return [m for m in obj.modifiers if (m.show_viewport or m.show_render) and not is_ours(m)]


def _behind(obj: bpy.types.Object) -> list[bpy.types.Modifier]:
    """The user's modifiers that belong behind ours: from the first subdivision on after which nothing makes faces."""
    theirs = [m for m in obj.modifiers if not is_ours(m)]
    first = len(theirs)
    for k in range(len(theirs) - 1, -1, -1):
        if theirs[k].type not in KEEPS_UVS and (theirs[k].show_viewport or theirs[k].show_render):
            break
        if theirs[k].type in SUBDIVIDES:
            first = k
    return theirs[first:]


def _place(obj: bpy.types.Object, modifier: bpy.types.Modifier) -> None:
    """Move our modifier where it belongs; Blender keeps it last where nothing comes after it."""
    behind = len(_behind(obj))
    modifier.use_pin_to_last = False
    obj.modifiers.move(list(obj.modifiers).index(modifier), len(obj.modifiers) - 1 - behind)
    modifier.use_pin_to_last = not behind


def out_of_place(obj: bpy.types.Object) -> bool:
    """Whether modifiers have been added behind ours that do not belong there."""
    modifiers = list(obj.modifiers)
    at = next((k for k, m in enumerate(modifiers) if is_ours(m)), None)
    return at is not None and [m.name for m in modifiers[at + 1 :]] != [m.name for m in _behind(obj)]
