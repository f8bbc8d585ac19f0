# SPDX-License-Identifier: GPL-3.0-or-later
"""What counts is what a render is given: every case is compared with the instances that a render engine gets from Blender."""

from __future__ import annotations

import bpy
import pytest
from adjgi.tests.blender.listing import (
    collection,
    empty,
    engine,
    given_to_a_render,
    linked,
    listed,
    nodes,
    particles,
    plane,
    points,
    seen,
    told,
)

__all__ = ["engine"]
pytestmark = pytest.mark.usefixtures("engine")


def on_vertices(parent, child):
    """`child`, which `parent` shows on each of its vertices."""
    child.parent, parent.instance_type = parent, "VERTS"
    return child


# ---- what can be decided in the viewport: each case builds a scene that a render lists as it is extracted


def hidden_child_collection():
    outer = collection("outer")
    inner = collection("inner", outer)
    plane("a", outer), plane("b", inner)
    inner.hide_render = True
    empty("instance", outer)


def hidden_collection():
    plane("shown")
    closed = collection("closed", in_scene=False)
    plane("a", closed)
    closed.hide_render = True
    empty("instance", closed)


def hidden_member_between_members():
    outer = collection("outer", in_scene=False)
    plane("a", outer).hide_render = True
    plane("b", outer)
    plane("c", collection("inner", outer)).hide_render = True
    plane("d", outer)
    empty("instance", outer)


def member_of_a_hidden_and_a_shown_collection():
    outer = collection("outer", in_scene=False)
    one, two = collection("one", outer), collection("two", outer)
    two.objects.link(plane("a", one))
    one.hide_render = True
    plane("b", one)
    empty("instance", outer)


def instances_within_instances():
    inner, outer = collection("inner", in_scene=False), collection("outer", in_scene=False)
    plane("a", inner), plane("b", collection("closed", inner)), plane("c", outer)
    inner.children["closed"].hide_render = True
    plane("first", outer), empty("on", inner, outer), empty("off", inner, outer)
    bpy.data.objects["off"].hide_render = True
    empty("instance", outer)


def source_hidden_beside_its_host_in_a_collection():
    asset = collection("asset", in_scene=False)
    source = plane("source", asset)
    source.hide_render = True
    nodes(points("host", asset), obj=source, scatter=True)
    empty("instance", asset)


def nodes_of_a_hidden_object():
    source = plane("source")
    source.hide_render = True
    nodes(points("host"), obj=source)


def nodes_that_scatter_a_hidden_object():
    source = plane("source")
    source.hide_render = True
    nodes(points("host"), obj=source, scatter=True)


def nodes_of_a_hidden_object_by_modifier():
    source = plane("source")
    source.hide_render = True
    nodes(points("host"), obj=source, scatter=True, by_modifier=True)


def nodes_of_a_collection_with_a_hidden_object(separate=False, **how):
    group = collection("group")
    plane("a", group).hide_render = True
    plane("b", group)
    nodes(points("host"), of=group, separate=separate, **how)


def nodes_of_a_collection_by_modifier():
    nodes_of_a_collection_with_a_hidden_object(scatter=True, by_modifier=True)


def nodes_of_a_collection_in_parts():
    nodes_of_a_collection_with_a_hidden_object(True, scatter=True)


def nodes_of_a_hidden_collection():
    plane("shown")
    group = collection("group")
    plane("a", group)
    group.hide_render = True
    nodes(points("host"), of=group, scatter=True)


def hidden_host_of_nodes():
    host = points("host")
    nodes(host, obj=plane("source"))
    host.hide_render = True


def quiet_host_of_nodes():
    host = plane("host")
    host.show_instancer_for_render = False
    tree_source = plane("source")
    nodes(host, obj=tree_source)
    join = host.modifiers[0].node_group
    both = join.nodes.new("GeometryNodeJoinGeometry")
    end = next(n for n in join.nodes if n.bl_idname == "NodeGroupOutput")
    info = next(n for n in join.nodes if n.bl_idname == "GeometryNodeObjectInfo")
    join.links.new(info.outputs["Geometry"], both.inputs[0])
    join.links.new(next(n for n in join.nodes if n.bl_idname == "NodeGroupInput").outputs[0], both.inputs[0])
    join.links.new(both.outputs[0], end.inputs[0])


def quiet_emitter_of_hair():
    plane("shown")
    emitter = plane("emitter")
    particles(emitter, type="HAIR")
    emitter.show_instancer_for_render = False


def quiet_emitter_in_the_viewport():
    emitter = plane("emitter")
    particles(emitter, type="HAIR")
    emitter.show_instancer_for_viewport = False


def quiet_without_instances():
    plane("plain").show_instancer_for_render = False


def particles_of_a_hidden_object():
    source = plane("source")
    source.hide_render = True
    particles(plane("emitter"), render_type="OBJECT", instance_object=source)


def particles_of_a_hidden_collection():
    group = collection("group")
    plane("a", group)
    group.hide_render = True
    particles(plane("emitter"), render_type="COLLECTION", instance_collection=group)


def hidden_child_on_vertices():
    on_vertices(points("parent"), plane("child")).hide_render = True
    plane("shown")


def hidden_child_on_vertices_in_a_collection():
    group = collection("group", in_scene=False)
    on_vertices(plane("parent", group), plane("child", group)).hide_render = True
    empty("instance", group)


def hidden_empty():
    group = collection("group", in_scene=False)
    plane("a", group), plane("shown")
    empty("instance", group).hide_render = True


def text_in_a_hidden_collection():
    group = collection("group", in_scene=False)
    text = bpy.data.curves.new("text", "FONT")
    text.body = "a"
    linked(bpy.data.objects.new("text", text), group)
    linked(bpy.data.objects.new("other", text), collection("closed", group))
    group.children["closed"].hide_render = True
    empty("instance", group)


def hidden_collection_beside_an_excluded_one():
    plane("shown")
    closed, out = collection("closed"), collection("out")
    out.objects.link(plane("a", closed))
    closed.hide_render = True
    bpy.context.view_layer.layer_collection.children["out"].exclude = True


def excluded_collection_beside_a_shown_one():
    shown, out = collection("open"), collection("out")
    out.objects.link(plane("a", shown))
    bpy.context.view_layer.layer_collection.children["out"].exclude = True


def shown_collection_in_a_hidden_one():
    plane("shown")
    outer = collection("outer")
    plane("a", collection("inner", outer))
    outer.hide_render = True


DECIDED = [
    shown_collection_in_a_hidden_one, hidden_collection_beside_an_excluded_one, excluded_collection_beside_a_shown_one,
    hidden_child_collection, hidden_collection, hidden_member_between_members, member_of_a_hidden_and_a_shown_collection,
    instances_within_instances, source_hidden_beside_its_host_in_a_collection, nodes_of_a_hidden_object, nodes_that_scatter_a_hidden_object,
    nodes_of_a_hidden_object_by_modifier, nodes_of_a_collection_with_a_hidden_object, nodes_of_a_collection_by_modifier,
    nodes_of_a_collection_in_parts, nodes_of_a_hidden_collection, hidden_host_of_nodes, quiet_host_of_nodes, quiet_emitter_of_hair,
    quiet_emitter_in_the_viewport, quiet_without_instances, particles_of_a_hidden_object, particles_of_a_hidden_collection,
    hidden_child_on_vertices, hidden_child_on_vertices_in_a_collection, hidden_empty, text_in_a_hidden_collection,
]  # fmt: skip


@pytest.mark.parametrize("build", DECIDED, ids=lambda f: f.__name__)
def test_the_viewport_gives_what_a_render_shows(build):
    build()
    arrays = seen()
    found = listed(arrays)
    if build is particles_of_a_hidden_collection:
        assert told(arrays, "a", "hidden in render in a collection", "info")
    # A member that is hidden leaves a hole in the viewport's turns through a collection, so only which are there is compared.
    same = given_to_a_render()
    assert found and (found == same or (build is particles_of_a_hidden_collection and set(found) == set(same)))
    assert not [n for n in arrays.warnings if n.severity == "warning"]


# ---- what only a render evaluates: a warning names it


def nested_collection_off():
    outer = collection("outer", in_scene=False)
    inner = collection("inner", outer)
    plane("a", outer), plane("lost", inner)
    inner.hide_viewport = True
    empty("instance", outer)


def member_off_two_levels_down():
    outer, deep = collection("outer", in_scene=False), collection("deep", in_scene=False)
    plane("lost", deep).hide_viewport = True
    plane("a", outer), empty("inner", deep, outer), empty("instance", outer)


def object_of_nodes_off():
    source = plane("lost")
    source.hide_viewport = True
    nodes(points("host"), obj=source)


def collection_of_nodes_with_a_member_off():
    group = collection("group", in_scene=False)
    plane("a", group), plane("lost", group)
    bpy.data.objects["lost"].hide_viewport = True
    nodes(points("host"), of=group)


def instancer_off():
    group = collection("group", in_scene=False)
    plane("a", group), plane("shown")
    empty("lost", group).hide_viewport = True


def child_on_vertices_off():
    on_vertices(points("parent"), plane("lost")).hide_viewport = True
    plane("shown")


def quiet_host_off_in_the_viewport():
    host = plane("lost")
    nodes(host, obj=plane("source"))
    host.show_instancer_for_viewport = False


LOST = [
    nested_collection_off, member_off_two_levels_down, object_of_nodes_off, collection_of_nodes_with_a_member_off, instancer_off,
    child_on_vertices_off, quiet_host_off_in_the_viewport,
]  # fmt: skip


@pytest.mark.parametrize("build", LOST, ids=lambda f: f.__name__)
def test_what_the_viewport_lacks_is_named(build):
    build()
    arrays = seen()
    (notice,) = told(arrays, "lost", "disabled in the viewport")
    assert "a render shows" in notice.reason and "in the viewport" in notice.remedy
    given = given_to_a_render()
    assert build is quiet_host_off_in_the_viewport or (len(given) > len(arrays.objects) and set(listed(arrays)) <= set(given))


def test_what_is_not_known_is_kept_and_named():
    """A link decides whether the collection is shown as a whole, as which it would lack the hidden object."""
    nodes_of_a_collection_with_a_hidden_object(True, scatter=True)
    tree = bpy.data.objects["host"].modifiers[0].node_group
    value = tree.nodes.new("FunctionNodeInputBool")
    value.boolean = True
    info = next(n for n in tree.nodes if n.bl_idname == "GeometryNodeCollectionInfo")
    tree.links.new(value.outputs[0], info.inputs["Separate Children"])
    arrays = seen()
    (notice,) = told(arrays, "a", "is not known here")
    assert "host" in notice.reason and notice.remedy
    assert listed(arrays) == given_to_a_render()


def test_notices_of_hidden_objects_do_not_contradict_their_instances():
    nodes_of_a_hidden_object()
    arrays = seen()
    assert told(arrays, "source", "only its instances count", "info") and not told(arrays, "source", "left out", "info")
