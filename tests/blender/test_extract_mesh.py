# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry: modifiers, instances, mirrored and sheared matrices, layers, bad input."""

from __future__ import annotations

import bpy  # isort: split

import bmesh  # importable only after bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.tests.counting import counted
from adjgi.tests.cycles_patch import diffuse_material
from mathutils import Matrix

CUBE = (
    [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)],
    [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)],
)


def new_mesh(vertices, faces, name="mesh"):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    mesh.update()
    return mesh


def add(mesh, name="object", matrix=None, collection=None):
    obj = bpy.data.objects.new(name, mesh)
    if matrix is not None:
        obj.matrix_world = matrix
    (collection or bpy.context.scene.collection).objects.link(obj)
    return obj


def arrays():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get())


def face_normals(a):
    p = a.vertices[a.triangles]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def signed_volume(a):
    p = a.vertices[a.triangles]
    return np.einsum("ij,ij->i", p[:, 0], np.cross(p[:, 1], p[:, 2])).sum() / 6


def notice(a, name, *words):
    return any(name in n.object and all(w in n.reason for w in words) for n in a.warnings)


MATRICES = {
    "moved": Matrix.Translation((3, 4, 5)),
    "mirrored": Matrix.Diagonal((-1, 1, 1, 1)),
    "mirrored twice": Matrix.Diagonal((-1, -2, 1, 1)),
    "mirrored thrice": Matrix.Diagonal((-1, -2, -3, 1)),
    "stretched": Matrix.Rotation(0.7, 4, "X") @ Matrix.Diagonal((1, 5, 0.2, 1)),
    "sheared": Matrix.Shear("XY", 4, (0.5, 0.9)) @ Matrix.Rotation(0.4, 4, "Y"),
    "sheared mirrored": Matrix.Shear("XY", 4, (0.5, 0.9)) @ Matrix.Diagonal((1, -1, 1, 1)),
    "small": Matrix.Diagonal((1e-4, 1e-4, 1e-4, 1)),
}


@pytest.mark.parametrize("case", MATRICES)
def test_outward_normals_and_corners_under_any_matrix(case):
    mesh = new_mesh(*CUBE)
    layer = mesh.uv_layers.new(name="uv")
    # A UV that tells the vertex apart: permuting corners must carry it along.
    for loop in mesh.loops:
        layer.uv[loop.index].vector = (loop.vertex_index, 0.5)
    # So do colours, of corners and of vertices.
    for name, domain, owners in (("corners", "CORNER", [loop.vertex_index for loop in mesh.loops]), ("points", "POINT", range(8))):
        paint = mesh.color_attributes.new(name, "FLOAT_COLOR", domain)
        paint.data.foreach_set("color", np.array([(v, 0, 0, 1) for v in owners], np.float32).ravel())
    parent = bpy.data.objects.new("parent", None)
    parent.matrix_world = MATRICES[case]
    bpy.context.scene.collection.objects.link(parent)
    obj = add(mesh)
    obj.parent = parent
    obj.matrix_parent_inverse = Matrix.Identity(4)
    bpy.context.view_layer.update()
    # Blender splits objects into location, rotation and scale: a sheared parent gives a matrix only a child can have.
    a = arrays()
    world = np.array(obj.matrix_world)
    np.testing.assert_allclose(a.vertices, np.array(CUBE[0]) @ world[:3, :3].T + world[:3, 3], atol=1e-6)
    assert signed_volume(a) == pytest.approx(abs(np.linalg.det(world[:3, :3])), rel=1e-4)
    n = face_normals(a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    np.testing.assert_allclose(np.einsum("tj,tcj->tc", n, a.corner_normals), 1.0, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(a.corner_normals, axis=2), 1.0, atol=1e-5)
    o = a.objects[0]
    for carried in (o.uvs["uv"], o.colors["corners"], o.colors["points"]):
        np.testing.assert_array_equal(carried[:, :, 0].astype(int), a.triangles - o.first_vertex)
    loop_vertex = np.array([loop.vertex_index for loop in mesh.loops])
    np.testing.assert_array_equal(loop_vertex[a.corners], a.triangles - o.first_vertex)


def test_sheared_parent_matrix():
    """A rotated child of an unevenly scaled parent is sheared; its normals stay at right angles to its faces."""
    parent = bpy.data.objects.new("parent", None)
    parent.scale = (1.0, 4.0, -0.5)
    bpy.context.scene.collection.objects.link(parent)
    obj = add(new_mesh(*CUBE))
    obj.parent, obj.rotation_euler = parent, (0.3, 0.5, 0.7)
    bpy.context.view_layer.update()
    m = np.array(obj.matrix_world)[:3, :3]
    assert abs((m.T @ m)[0, 1]) > 0.1
    a = arrays()
    n = face_normals(a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    np.testing.assert_allclose(np.einsum("tj,tcj->tc", n, a.corner_normals), 1.0, atol=1e-4)
    assert signed_volume(a) == pytest.approx(abs(np.linalg.det(m)), rel=1e-4)


def test_negative_scale_equals_applied_mirror():
    sphere = bpy.data.meshes.new("sphere")
    bm = bmesh.new()
    bmesh.ops.create_uvsphere(bm, u_segments=8, v_segments=6, radius=1.0)
    for f in bm.faces:
        f.smooth = True
    bm.to_mesh(sphere)
    bm.free()
    add(sphere, "mirrored", Matrix.Diagonal((-1, 1, 1, 1)))
    a = arrays()
    inside = np.einsum("tcj,tcj->tc", a.vertices[a.triangles], a.corner_normals)
    assert inside.min() > 0.9  # on a sphere around the origin normals point along the position
    assert a.smooth.all()
    centre = a.vertices[a.triangles].mean(axis=1)
    assert (np.einsum("tj,tj->t", face_normals(a), centre) > 0).all()


def test_triangulation_is_blenders():
    """A non-planar quad and a concave polygon."""
    mesh = new_mesh(
        [(0, 0, 0), (2, 0, 0), (2, 2, 1), (0, 2, 0), (5, 0, 0), (7, 0, 0), (5.5, 0.5, 0), (5, 2, 0)], [(0, 1, 2, 3), (4, 5, 6, 7)]
    )
    add(mesh)
    a = arrays()
    expected = np.array([t.vertices for t in mesh.loop_triangles])
    np.testing.assert_array_equal(a.triangles, expected)
    np.testing.assert_array_equal(a.polygon, [0, 0, 1, 1])
    assert not a.smooth.any()


def test_polygon_of_ten_thousand_corners():
    angle = np.linspace(0, 2 * np.pi, 10000, endpoint=False)
    add(new_mesh([(np.cos(t), np.sin(t), 0) for t in angle], [tuple(range(10000))]))
    a = arrays()
    area = np.linalg.norm(face_normals(a), axis=1).sum() / 2
    assert area == pytest.approx(np.pi, rel=1e-4)


def test_modifiers_count():
    obj = add(new_mesh(*CUBE))
    obj.modifiers.new("array", "ARRAY").count = 3
    assert len(arrays().triangles) == 36


def test_custom_normals_make_a_flat_face_smooth():
    mesh = new_mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2, 3)])
    mesh.polygons[0].use_smooth = False
    add(mesh)
    assert not arrays().smooth.any()
    mesh.normals_split_custom_set([(0.6, 0, 0.8)] * 4)
    mesh.update()
    a = arrays()
    assert a.smooth.all()
    np.testing.assert_allclose(a.corner_normals, np.broadcast_to((0.6, 0, 0.8), (2, 3, 3)), atol=2e-4)


def test_all_layers_per_corner():
    mesh = new_mesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2, 3)])
    for i in range(3):
        mesh.uv_layers.new(name=f"uv{i}").uv.foreach_set("vector", np.arange(8, dtype=np.float32) + i)
    mesh.uv_layers["uv1"].active_render = True
    for domain, n in (("POINT", 4), ("CORNER", 4)):
        for kind in ("FLOAT_COLOR", "BYTE_COLOR"):
            layer = mesh.color_attributes.new(name=f"{domain} {kind}", type=kind, domain=domain)
            layer.data.foreach_set("color", np.repeat(np.linspace(0.1, 0.7, n, dtype=np.float32), 4))
    add(mesh)
    a = arrays()
    o = a.objects[0]
    assert list(o.uvs) == ["uv0", "uv1", "uv2"] and o.render_uv == "uv1"
    np.testing.assert_array_equal(o.uvs["uv2"][0, 0], [2 + 2 * a.corners[0, 0], 3 + 2 * a.corners[0, 0]])
    assert len(o.colors) == 4
    expected = np.linspace(0.1, 0.7, 4, dtype=np.float32)
    for name, values in o.colors.items():
        index = a.triangles if name.startswith("POINT") else a.corners
        assert values.shape == (2, 3, 4) and values.dtype == np.float32
        np.testing.assert_allclose(values[..., 0], expected[index], atol=1e-6 if "FLOAT" in name else 5e-3)


def test_nan_uvs_become_zero_with_a_notice():
    mesh = new_mesh(*CUBE)
    mesh.uv_layers.new(name="uv").uv[3].vector = (float("nan"), 1.0)
    add(mesh, "broken")
    a = arrays()
    assert np.isfinite(a.objects[0].uvs["uv"]).all()
    assert notice(a, "broken", 'UV layer "uv"')


def test_materials_per_face_and_slots():
    """Faces out of range take the last slot, empty slots and objects without slots Cycles' grey; slots may belong to the object."""
    mesh = new_mesh(*CUBE)
    red, blue = diffuse_material("red", 0.1), diffuse_material("blue", 0.2)
    for m in (red, None, blue):
        mesh.materials.append(m)
    mesh.polygons.foreach_set("material_index", [0, 1, 2, 7, 0, 1])
    first, second = add(mesh, "first"), add(mesh, "second")
    second.material_slots[0].link = "OBJECT"
    second.material_slots[0].material = blue
    add(new_mesh(*CUBE), "bare")
    a = arrays()
    by_name = {o.name: [a.materials[m].name for m in a.material[o.triangles][::2]] for o in a.objects}
    assert by_name["first"] == ["red", "Default", "blue", "blue", "red", "Default"]
    assert by_name["second"] == ["blue", "Default", "blue", "blue", "blue", "Default"]
    assert by_name["bare"] == ["Default"] * 6
    default = next(m for m in a.materials if m.name == "Default")
    assert default.total("diffuse").constant == (0.8, 0.8, 0.8)
    assert first.name == "first"


def test_linked_duplicates_share_layers():
    mesh = new_mesh(*CUBE)
    mesh.uv_layers.new()
    add(mesh, "a")
    add(mesh, "b", Matrix.Translation((5, 0, 0)))
    add(mesh, "c", Matrix.Diagonal((-1, 1, 1, 1)))
    a = arrays()
    o = {x.name: x for x in a.objects}
    assert o["a"].uvs["UVMap"] is o["b"].uvs["UVMap"]
    assert o["a"].uvs["UVMap"] is not o["c"].uvs["UVMap"]
    assert len({x.uid for x in a.objects}) == 3


def test_collection_instances_have_unique_stable_names():
    inner = bpy.data.collections.new("inner")
    add(new_mesh(*CUBE), "part", collection=inner)
    add(new_mesh(*CUBE), "other", collection=inner)
    for i in range(2):
        empty = bpy.data.objects.new(f"E{i}", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", inner, (i * 10, 0, 0)
        bpy.context.scene.collection.objects.link(empty)
    first, second = arrays(), arrays()
    names = [o.name for o in first.objects]
    assert len(names) == len(set(names)) == 4
    assert names == [o.name for o in second.objects]
    assert {o.source for o in first.objects} == {"part", "other"}
    assert all(o.instance and o.name.startswith(f"{o.source}[E") for o in first.objects)
    np.testing.assert_allclose(first.vertices[first.triangles].max(), 11.0)


def geometry_nodes(obj, build):
    tree = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    build(tree, start.outputs[0], end.inputs[0])
    obj.modifiers.new("nodes", "NODES").node_group = tree


def test_geometry_nodes_instances_and_materials():
    green = diffuse_material("green", 0.3)

    def build(tree, geometry, out):
        cube = tree.nodes.new("GeometryNodeMeshCube")
        paint = tree.nodes.new("GeometryNodeSetMaterial")
        paint.inputs["Material"].default_value = green
        place = tree.nodes.new("GeometryNodeInstanceOnPoints")
        tree.links.new(cube.outputs["Mesh"], paint.inputs["Geometry"])
        tree.links.new(geometry, place.inputs["Points"])
        tree.links.new(paint.outputs["Geometry"], place.inputs["Instance"])
        tree.links.new(place.outputs["Instances"], out)

    obj = add(new_mesh([(i * 5, 0, 0) for i in range(4)], []), "scatter")
    geometry_nodes(obj, build)
    a = arrays()
    assert len(a.objects) == 4 and len(a.triangles) == 48
    assert len({o.name for o in a.objects}) == 4
    assert {a.materials[i].name for i in a.material} == {"green"}
    centres = sorted(round(float(a.vertices[a.triangles[o.triangles]].reshape(-1, 3)[:, 0].mean())) for o in a.objects)
    assert centres == [0, 5, 10, 15]


def test_geometry_nodes_without_mesh_is_listed():
    def build(tree, geometry, out):
        node = tree.nodes.new("GeometryNodeMeshToPoints")
        tree.links.new(geometry, node.inputs[0])
        tree.links.new(node.outputs[0], out)

    geometry_nodes(add(new_mesh(*CUBE), "points"), build)
    a = arrays()
    assert len(a.triangles) == 0
    assert notice(a, "points", "left out")


def test_curves_texts_metaballs_and_what_has_no_faces():
    scene = bpy.context.scene
    text = bpy.data.curves.new("text", "FONT")
    text.body = "a"
    tube, wire = bpy.data.curves.new("tube", "CURVE"), bpy.data.curves.new("wire", "CURVE")
    for curve in (tube, wire):
        curve.splines.new("POLY").points.add(3)
        for i, p in enumerate(curve.splines[0].points):
            p.co = (i, i % 2, 0, 1)
    tube.bevel_depth = 0.1
    ball = bpy.data.metaballs.new("ball")
    ball.elements.new()
    volume = bpy.data.volumes.new("volume")
    things = {"text": text, "tube": tube, "wire": wire, "ball": ball, "empty": None, "volume": volume}
    for name, data in things.items():
        scene.collection.objects.link(bpy.data.objects.new(name, data))
    a = arrays()
    assert sorted(o.name for o in a.objects) == ["ball", "text", "tube"]
    assert all(o.instance == () for o in a.objects)
    for name in ("wire", "volume"):
        assert notice(a, name, "left out"), name
    assert not [w for w in a.warnings if w.object == "empty"]  # no renderer shows one


def test_hidden_objects_follow_the_render_rule():
    scene = bpy.context.scene
    add(new_mesh(*CUBE), "shown")
    add(new_mesh(*CUBE), "no render").hide_render = True
    add(new_mesh(*CUBE), "no viewport").hide_viewport = True
    closed, excluded = bpy.data.collections.new("closed"), bpy.data.collections.new("excluded")
    for c in (closed, excluded):
        scene.collection.children.link(c)
    closed.hide_render = True
    add(new_mesh(*CUBE), "in closed", collection=closed)
    add(new_mesh(*CUBE), "in excluded", collection=excluded)
    bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
    a = arrays()
    assert [o.name for o in a.objects] == ["shown"]
    assert notice(a, "no render", "hidden in render")
    assert notice(a, "in closed", "hidden in render")
    assert notice(a, "no viewport", "disabled in the viewport")
    assert not notice(a, "in excluded")


def test_children_on_vertices_count_as_instances_only():
    parent = add(new_mesh([(0, 0, 0), (5, 0, 0)], []), "parent")
    add(new_mesh(*CUBE), "child").parent = parent
    parent.instance_type = "VERTS"
    a = arrays()
    assert sorted(o.name for o in a.objects) == ["child[parent.0]", "child[parent.1]"]


def test_edit_mode_counts_with_its_edits():
    mesh = new_mesh(*CUBE)
    mesh.uv_layers.new(name="uv")
    obj = add(mesh, "edited")
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="EDIT")
    bm = bmesh.from_edit_mesh(mesh)
    bmesh.ops.translate(bm, verts=bm.verts, vec=(100, 0, 0))
    bmesh.ops.subdivide_edges(bm, edges=bm.edges, cuts=1, use_grid_fill=True)
    bmesh.update_edit_mesh(mesh)
    a = arrays()
    assert len(a.triangles) == 48
    assert a.vertices.min(axis=0)[0] == 100.0
    assert a.objects[0].uvs["uv"].shape == (48, 3, 2)
    assert obj.mode == "EDIT"
    bpy.ops.object.mode_set(mode="OBJECT")


BAD = {
    "nan": ((float("nan"), 0, 0), 8, "not numbers"),
    "inf": ((0, float("inf"), 0), 8, "not numbers"),
    "huge": ((0, 0, 1e20), 8, "not numbers or exceed"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_vertices_drop_their_triangles(case):
    position, _, word = BAD[case]
    mesh = new_mesh(*CUBE)
    mesh.vertices[0].co = position
    before = [tuple(v.co) for v in mesh.vertices[1:]]
    add(mesh, "bad")
    a = arrays()
    assert 0 < len(a.triangles) < 12
    assert np.isfinite(a.vertices).all() and np.isfinite(a.corner_normals).all()
    assert not (a.triangles == a.objects[0].first_vertex).any()
    assert notice(a, "bad", word)
    assert [tuple(v.co) for v in mesh.vertices[1:]] == before and not np.isclose(mesh.vertices[0].co, 0).all()


def test_degenerate_faces_are_dropped_and_told_once():
    vertices = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 0), (1, 1e-12, 0)]
    mesh = new_mesh(vertices, [(0, 1, 3), (0, 1, 2), (0, 4, 1), (0, 1, 5)])
    add(mesh, "slivers")
    add(new_mesh(vertices, [(0, 1, 3), (0, 1, 2)]), "another")
    a = arrays()
    assert a.polygon.tolist() == [0, 0]
    assert notice(a, "slivers, another", "has triangles without an area")


def test_small_triangles_are_kept():
    add(new_mesh([(0, 0, 0), (1e-9, 0, 0), (0, 1e-9, 0)], [(0, 1, 2)]))
    assert len(arrays().triangles) == 1


@pytest.mark.parametrize("scale", [(0, 1, 1), (0, 0, 0), (1, float("nan"), 1), (1, float("inf"), 1)])
def test_flat_and_broken_matrices_drop_the_object(scale):
    add(new_mesh(*CUBE), "good")
    add(new_mesh(*CUBE), "flat").scale = scale
    a = arrays()
    assert [o.name for o in a.objects] == ["good"]
    assert notice(a, "flat", "scale of zero")


def test_far_objects():
    add(new_mesh(*CUBE), "far", Matrix.Translation((1e6, 0, 0)))
    add(new_mesh(*CUBE), "too far", Matrix.Translation((1e13, 0, 0)))
    a = arrays()
    assert [o.name for o in a.objects] == ["far"]
    assert a.vertices.dtype == np.float64 and a.vertices[:, 0].max() == 1e6 + 1
    assert notice(a, "too far", "further out")


def test_no_vertices_no_faces_and_empty_scene():
    add(new_mesh([], []), "nothing")
    add(new_mesh([(0, 0, 0), (1, 0, 0)], []), "wires")
    a = arrays()
    assert len(a.triangles) == 0 and a.vertices.shape == (0, 3) and a.objects == ()
    assert notice(a, "nothing, wires", "no faces")
    assert any(n.severity == "error" for n in a.warnings)


def test_duplicates_and_opposite_faces_are_kept():
    mesh = new_mesh(*CUBE)
    add(mesh, "a")
    add(mesh, "b")
    add(new_mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2), (3, 5, 4)]), "c")
    assert len(arrays().triangles) == 26


def test_names_of_any_kind():
    names = ["a/b", "..", "c:d", "e\nf", "x" * 63, "\U0001f600", "\u05d0\u05d1", "   ", "CON"]
    for name in names:
        add(new_mesh(*CUBE), name)
    a = arrays()
    assert [o.name for o in a.objects] == names


def test_arrays_own_their_memory_and_the_scene_is_untouched():
    mesh = new_mesh(*CUBE)
    mesh.uv_layers.new()
    obj = add(mesh)
    counts = {k: len(getattr(bpy.data, k)) for k in ("meshes", "objects", "images", "materials", "node_groups")}
    a = arrays()
    copy = a.vertices.copy(), a.objects[0].uvs["UVMap"].copy()
    obj.location = (9, 9, 9)
    mesh.vertices[0].co = (5, 5, 5)
    mesh.uv_layers[0].uv[0].vector = (7, 7)
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(a.vertices, copy[0])
    np.testing.assert_array_equal(a.objects[0].uvs["UVMap"], copy[1])
    assert counts == {k: len(getattr(bpy.data, k)) for k in counts}


@pytest.mark.slow
def test_hundred_thousand_instances_take_linear_time():
    """Twice the instances take twice the calls, and so do fifty times as many."""
    add(new_mesh(*CUBE), "child").parent = parent = add(new_mesh([], []), "parent")
    parent.instance_type = "VERTS"
    calls = []
    for rows in (8, 16, 400):
        parent.data = new_mesh([(x, y, 0) for x in range(rows) for y in range(250)], [])
        depsgraph = bpy.context.evaluated_depsgraph_get()
        a, count = counted(lambda depsgraph=depsgraph: extract(depsgraph))
        assert len(a.objects) == 250 * rows and len(a.triangles) == 12 * 250 * rows
        assert a.objects[250 * rows - 1].triangles.stop == 12 * 250 * rows
        calls.append(count)
    assert calls[1] < 2.02 * calls[0] and calls[2] < 50.5 * calls[0]
