"""Colour attributes: smooth and hard, back to the original mesh, and clear refusals."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.mesh import read_mesh
from adjgi.adjoint_gi.bridge.host.notices import Notices
from adjgi.adjoint_gi.bridge.results.attribute import (
    WrittenAttribute,
    check_attribute_target,
    linked_attribute,
    remove_attributes,
    remove_result_object,
    result_object,
    write_attribute,
)
from adjgi.adjoint_gi.core.base.errors import TargetError, WriteError
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.arrays import Material, ObjectArrays, SceneArrays
from adjgi.adjoint_gi.core.scene.world import World


def cube(smooth=False, name="Cube"):
    bpy.ops.mesh.primitive_cube_add()
    obj = bpy.context.view_layer.objects.active
    obj.name = name
    if smooth:
        obj.data.shade_smooth()
    return obj


def depsgraph():
    return bpy.context.evaluated_depsgraph_get()


def world_of(obj) -> World:
    """The world of one object's evaluated mesh alone, in object space."""
    evaluated = obj.evaluated_get(depsgraph())
    m = read_mesh(evaluated.to_mesh(), obj.name, Notices())
    n = len(m.triangles)
    arrays = ObjectArrays(
        obj.name, obj.name, triangle_count=n, vertex_count=len(m.vertices), corner_count=m.corner_count, polygon_count=m.polygon_count
    )
    zero = np.zeros(n, np.int32)
    return World(SceneArrays(m.vertices, m.triangles, m.normals, m.smooth, zero, zero, m.polygon, m.corners, (Material("w"),), (arrays,)))


def read(obj, name):
    data = obj.data.attributes[name].data
    out = np.empty(len(data) * 4, np.float32)
    data.foreach_get("color", out)
    return out.reshape(-1, 4)


@pytest.mark.parametrize(("smooth", "domain", "receivers"), [(False, "CORNER", 24), (True, "CORNER", 8), (False, "POINT", 8)])
def test_hard_edges_are_hard_and_smooth_ones_smooth(smooth, domain, receivers):
    obj = cube(smooth)
    world = world_of(obj)
    m = vertex_receivers(world, [0], domain)
    assert m.receivers.count == receivers
    # The value of a receiver is its mean normal: one side's on hard corners, a diagonal on smooth ones and on points.
    normal = world.surface(m.receivers.triangle, m.receivers.u, m.receivers.v).ng
    value = np.add.reduceat(normal, m.receivers.start[:-1]) / np.diff(m.receivers.start)[:, None]
    written = write_attribute(obj, "irradiance", domain, m.spread(0, value), m.covered(0))
    got = read(obj, written.attribute)
    assert np.all(got[:, 3] == 1)
    mesh = obj.data
    vertex = np.arange(8) if domain == "POINT" else np.array([x.vertex_index for x in mesh.loops])
    if smooth or domain == "POINT":
        want = np.array([mesh.vertices[v].co for v in vertex]) / 3
    else:
        want = np.array([p.normal for p in mesh.polygons for _ in p.loop_indices])
    assert np.allclose(got[:, :3], want, atol=1e-6)


def test_values_survive_saving_bit_for_bit(tmp_path):
    obj = cube()
    value = (np.random.default_rng(0).random((24, 3)) * 10.0 ** np.arange(-12, 12)[:, None]).astype(np.float32)
    write_attribute(obj, "irradiance", "CORNER", value, np.ones(24), name="Light")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    obj = bpy.data.objects["Cube"]
    assert linked_attribute(obj, "irradiance") == "Light"
    assert obj.data.attributes["Light"].data_type == "FLOAT_COLOR" and obj.data.attributes["Light"].domain == "CORNER"
    assert np.array_equal(read(obj, "Light")[:, :3].view(np.uint32), value.view(np.uint32))


def test_a_foreign_attribute_of_our_name_is_never_touched():
    obj = cube()
    for name, kind, domain in (("Light", "FLOAT", "POINT"), ("Other", "FLOAT_COLOR", "CORNER")):
        obj.data.attributes.new(name, kind, domain)
    ones = np.ones((24, 3), np.float32)
    first = write_attribute(obj, "irradiance", "CORNER", ones, np.ones(24), name="Light").attribute
    second = write_attribute(obj, "direct", "CORNER", ones * 2, np.ones(24), name="Other").attribute
    assert first == "Light.001" and second == "Other.001"
    assert obj.data.attributes["Light"].data_type == "FLOAT" and np.all(read(obj, "Other") == 1)  # Blender starts with white
    # Baked again, the same ones are updated.
    assert write_attribute(obj, "irradiance", "CORNER", ones * 3, np.ones(24), name="Light").attribute == first
    assert np.all(read(obj, first)[:, :3] == 3) and len(obj.data.color_attributes) == 3


def test_another_name_makes_another_attribute_and_each_is_found_again():
    obj = cube()
    ones = np.ones((24, 3), np.float32)

    def write(value, name):
        return write_attribute(obj, "irradiance", "CORNER", ones * value, np.ones(24), name=name)

    assert [write(1, "Full").attribute, write(2, "DirectOnly").attribute] == ["Full", "DirectOnly"]
    assert linked_attribute(obj, "irradiance") == "DirectOnly"
    assert read(obj, "Full")[0, 0] == 1 and read(obj, "DirectOnly")[0, 0] == 2
    assert write(3, "Full") == WrittenAttribute(obj, "Full") and linked_attribute(obj, "irradiance") == "Full"
    assert read(obj, "Full")[0, 0] == 3 and read(obj, "DirectOnly")[0, 0] == 2 and len(obj.data.color_attributes) == 2
    # Renamed by the user, it is still the one for that name.
    obj.data.attributes["Full"].name = "Mine"
    assert linked_attribute(obj, "irradiance") == "Mine"
    assert write(4, "Full") == WrittenAttribute(obj, "Mine") and read(obj, "Mine")[0, 0] == 4
    assert write_attribute(obj, "irradiance", "POINT", ones[:8], np.ones(8), name="Full").attribute == "Mine"
    assert remove_attributes(obj) == 2 and not obj.data.color_attributes


def test_a_number_that_is_added_to_the_name_is_told_once():
    obj = cube()
    obj.data.attributes.new("Light", "FLOAT", "POINT")
    ones = np.ones((24, 3), np.float32)
    taken = write_attribute(obj, "irradiance", "CORNER", ones, np.ones(24), name="Light").taken
    assert taken.object == "Cube" and '"Light", so the attribute of the result gets a number' in taken.reason and taken.remedy
    assert write_attribute(obj, "irradiance", "CORNER", ones, np.ones(24), name="Light").taken is None


def test_changing_the_domain_replaces_our_attribute():
    obj = cube()
    write_attribute(obj, "irradiance", "CORNER", np.ones((24, 3)), np.ones(24))
    name = write_attribute(obj, "irradiance", "POINT", np.ones((8, 3)), np.ones(8)).attribute
    assert [(a.name, a.domain) for a in obj.data.color_attributes] == [(name, "POINT")]


def test_the_users_choice_of_colors_stays():
    obj = cube()
    colors = obj.data.color_attributes
    for name in ("Paint", "Bake"):
        obj.data.attributes.new(name, "BYTE_COLOR", "CORNER")
    colors.active_color_name, colors.default_color_name = "Bake", "Paint"
    write_attribute(obj, "irradiance", "CORNER", np.ones((24, 3)), np.ones(24))
    assert (colors.active_color_name, colors.default_color_name) == ("Bake", "Paint")
    assert remove_attributes(obj) == 1
    assert [a.name for a in colors] == ["Paint", "Bake"] and not obj.data.keys()
    assert (colors.active_color_name, colors.default_color_name) == ("Bake", "Paint")


def test_deforming_modifiers_are_fine_and_others_are_named():
    obj = cube()
    obj.modifiers.new("Bend it", "SIMPLE_DEFORM")
    check_attribute_target(obj, depsgraph())
    obj.modifiers.new("More faces", "SUBSURF").levels = 1
    with pytest.raises(TargetError, match="Cube: modifier More faces changes .* Apply the modifier") as info:
        check_attribute_target(obj, depsgraph())
    assert "Bend it" not in str(info.value)
    obj.modifiers["More faces"].show_viewport = False
    check_attribute_target(obj, depsgraph())


def test_equal_counts_in_another_order_are_noticed():
    """Flipped faces have the same number of corners, but in another order."""
    obj = cube()
    tree = bpy.data.node_groups.new("Flip", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, flip, end = (tree.nodes.new(x) for x in ("NodeGroupInput", "GeometryNodeFlipFaces", "NodeGroupOutput"))
    tree.links.new(start.outputs[0], flip.inputs[0])
    tree.links.new(flip.outputs[0], end.inputs[0])
    obj.modifiers.new("Nodes", "NODES").node_group = tree
    with pytest.raises(TargetError, match="modifier Nodes changes"):
        check_attribute_target(obj, depsgraph())


def test_new_object_takes_the_evaluated_mesh_and_is_found_again():
    obj = cube()
    obj.location = (3, 4, 5)
    obj.modifiers.new("More faces", "SUBSURF").levels = 1
    count = len(obj.evaluated_get(depsgraph()).data.vertices)
    before = len(obj.data.vertices)
    written = write_attribute(obj, "irradiance", "POINT", np.full((count, 3), 2), np.ones(count), new_object=True)
    made = written.object
    assert made != obj and result_object(obj) == made and made.hide_render
    assert len(made.data.vertices) == count == 26 and len(obj.data.vertices) == before
    assert np.all(read(made, written.attribute)[:, :3] == 2) and not obj.data.color_attributes
    assert np.allclose(made.matrix_world.translation, obj.matrix_world.translation)
    meshes = len(bpy.data.meshes)
    again = write_attribute(obj, "irradiance", "POINT", np.full((count, 3), 3), np.ones(count), new_object=True)
    assert again.object == made and len(bpy.data.meshes) == meshes
    assert np.all(read(made, again.attribute)[:, :3] == 3)
    copy = obj.copy()
    assert result_object(copy) is None
    bpy.data.objects.remove(copy)
    assert remove_result_object(obj) and len(bpy.data.meshes) == meshes - 1 and not obj.keys()


def test_shared_meshes_are_refused_by_name():
    obj = cube()
    other = bpy.data.objects.new("Twin", obj.data)
    bpy.context.scene.collection.objects.link(other)
    with pytest.raises(TargetError, match='Cube: shares its mesh "Cube" with Twin.*single user'):
        check_attribute_target(obj, depsgraph())
    check_attribute_target(obj, depsgraph(), new_object=True)


def test_edit_mode_is_refused():
    obj = cube()
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(TargetError, match="edit mode"):
        check_attribute_target(obj, depsgraph())


def test_a_mesh_edited_meanwhile_is_noticed():
    obj = cube()
    with pytest.raises(TargetError, match="24 values .* has 20.*edited"):
        write_attribute(obj, "irradiance", "CORNER", np.ones((20, 3)), np.ones(20))
    assert not obj.data.color_attributes


def test_bad_values_are_refused():
    obj = cube()
    value = np.ones((24, 3))
    value[3, 1] = np.inf
    with pytest.raises(WriteError, match="not finite"):
        write_attribute(obj, "irradiance", "CORNER", value, np.ones(24))
    with pytest.raises(TargetError, match="POINT or CORNER"):
        write_attribute(obj, "irradiance", "FACE", np.ones((6, 3)), np.ones(6))
    assert not obj.data.color_attributes


def test_linked_mesh_is_refused(tmp_path):
    cube()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.meshes = ["Cube"]
    obj = bpy.data.objects.new("Local", bpy.data.meshes["Cube"])
    bpy.context.scene.collection.objects.link(obj)
    with pytest.raises(TargetError, match='Local: its mesh "Cube" is linked from another file'):
        check_attribute_target(obj, depsgraph())
