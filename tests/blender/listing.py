# SPDX-License-Identifier: GPL-3.0-or-later
"""A render engine that notes what Blender gives it, and scenes to compare: what `extract` takes is what a render is given."""

from __future__ import annotations

import bpy
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract


class Listing(bpy.types.RenderEngine):
    """An engine that notes the faces it is given, and what `extract` makes of the same depsgraph."""

    bl_idname, bl_label = "ADJOINT_GI_LISTING", "Listing"
    given: list[tuple[str, int]] = []
    extracted: list[tuple[str, int]] = []

    def render(self, depsgraph):
        Listing.given = sorted(
            (i.object.name, len(i.object.data.polygons))
            for i in depsgraph.object_instances
            if i.show_self and i.object.type == "MESH" and i.object.data.polygons
        )
        Listing.extracted = listed(extract(depsgraph))


@pytest.fixture(scope="module")
def engine():
    """The engine, registered while the tests of a module run; imported by them."""
    bpy.utils.register_class(Listing)
    yield
    bpy.utils.unregister_class(Listing)


def listed(arrays):
    return sorted((o.source, o.polygon_count) for o in arrays.objects)


def given_to_a_render():
    scene = bpy.context.scene
    scene.camera = linked(bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera")))
    scene.render.engine, scene.render.resolution_x, scene.render.resolution_y = Listing.bl_idname, 8, 8
    Listing.given = Listing.extracted = None
    bpy.ops.render.render()
    assert Listing.given is not None and Listing.extracted == Listing.given, "the depsgraph of a render"
    return Listing.given


def seen():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get())


def told(arrays, name, words, severity="warning"):
    return [n for n in arrays.warnings if name in n.object and words in n.reason and n.severity == severity]


def linked(obj, collection=None):
    (collection or bpy.context.scene.collection).objects.link(obj)
    return obj


def plane(name, collection=None):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
    return linked(bpy.data.objects.new(name, mesh), collection)


def points(name, collection=None):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 1), (3, 0, 1)], [], [])
    return linked(bpy.data.objects.new(name, mesh), collection)


def collection(name, parent=None, in_scene=True):
    made = bpy.data.collections.new(name)
    if parent is not None or in_scene:
        (parent or bpy.context.scene.collection).children.link(made)
    return made


def empty(name, of, within=None):
    made = bpy.data.objects.new(name, None)
    made.instance_type, made.instance_collection = "COLLECTION", of
    return linked(made, within)


def nodes(host, obj=None, of=None, separate=False, scatter=False, by_modifier=False, join=False):
    """Geometry nodes on `host` that show an object, a collection or, without both, a square of their own instead of its mesh, on its
    points with `scatter`; with `join` beside it."""
    tree = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    if obj is not None:
        info, value = tree.nodes.new("GeometryNodeObjectInfo"), obj
        info.inputs["As Instance"].default_value = True
        out, wanted, kind = info.outputs["Geometry"], info.inputs["Object"], "NodeSocketObject"
    elif of is None:
        info = tree.nodes.new("GeometryNodeMeshGrid")
        info.inputs["Vertices X"].default_value = info.inputs["Vertices Y"].default_value = 2
        out, by_modifier = info.outputs["Mesh"], None
    else:
        info, value = tree.nodes.new("GeometryNodeCollectionInfo"), of
        info.inputs["Separate Children"].default_value = separate
        out, wanted, kind = info.outputs[0], info.inputs["Collection"], "NodeSocketCollection"
    if scatter:
        place = tree.nodes.new("GeometryNodeInstanceOnPoints")
        tree.links.new(start.outputs[0], place.inputs["Points"])
        tree.links.new(out, place.inputs["Instance"])
        out = place.outputs["Instances"]
    if join:
        both = tree.nodes.new("GeometryNodeJoinGeometry")
        for part in (out, start.outputs[0]):
            tree.links.new(part, both.inputs[0])
        out = both.outputs[0]
    tree.links.new(out, end.inputs[0])
    modifier = host.modifiers.new("nodes", "NODES")
    if by_modifier is None:
        modifier.node_group = tree
        return
    if not by_modifier:
        wanted.default_value = value
        modifier.node_group = tree
        return
    socket = tree.interface.new_socket("What", in_out="INPUT", socket_type=kind)
    tree.links.new(start.outputs["What"], wanted)
    modifier.node_group = tree
    group = getattr(getattr(modifier, "properties", None), "inputs", None)
    if group is None:
        modifier[socket.identifier] = value
    else:
        getattr(group, socket.identifier).value = value
    host.update_tag()


def particles(host, **settings):
    host.modifiers.new("particles", "PARTICLE_SYSTEM")
    made = host.particle_systems[0].settings
    made.count, made.frame_end = 4, 1
    for name, value in settings.items():
        setattr(made, name, value)
    bpy.context.scene.frame_set(2)
