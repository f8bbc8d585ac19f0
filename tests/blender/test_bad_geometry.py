# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad geometry: numbers 1 to 28 of the verification page's hostile inputs, each through the command line, as a table.

Every case also checks that the user's data are as before, that earlier results are kept, and that results are numbers; see
`tests/hostile.py`. What extraction does in detail stands in test_extract_mesh.py.
"""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import preflight as module
from adjgi.adjoint_gi.bridge.baking.bake import preflight
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.tests import baking
from adjgi.tests.baking import make_lightmap_uv
from adjgi.tests.cycles_patch import add_light, diffuse_material
from adjgi.tests.hostile import CUBE, SQUARE, Case, camera, good, mesh, play, put, room
from mathutils import Matrix

NAN, INF = float("nan"), float("inf")


def only_lights(_):
    camera()
    add_light("POINT", energy=10.0)


def beside_good(points, faces, **values):
    """A builder: the bad mesh beside a good one."""

    def build(_):
        good()
        made = mesh(points, faces)
        for key, value in values.items():
            setattr(made, key, value)

    return build


def cube_with_vertex(position):
    return beside_good([position, *CUBE[0][1:]], CUBE[1])


def sheared(_):
    good()
    child = mesh(*SQUARE)
    child.parent = put(None, "parent")
    child.matrix_parent_inverse = Matrix(((1, 0.8, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)))


def twisted(_):
    good()
    mesh([(-1, -1, 0), (1, -1, 0.8), (1, 1, 0), (-1, 1, 0.8)], [(0, 1, 2, 3)], "quad")
    mesh([(2, 0, 0), (3, 0.9, 0), (4, 0, 0), (3, 3, 0)], [(0, 1, 2, 3)], "concave")


def big_polygon(_):
    good()
    angle = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)
    mesh(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), [tuple(range(10_000))])


def opposite_faces(_):
    add_light("SUN", energy=2.0, angle=0.0)
    mesh([*SQUARE[0], *SQUARE[0]], [(0, 1, 2, 3), (7, 6, 5, 4)])


def twice(_):
    good()
    mesh(*SQUARE, name="one")
    put(bpy.data.objects["one"].data.copy(), "two")


def open_box(_):
    points, faces = CUBE
    add_light("POINT", location=(0.5, 0.5, 0.5), energy=10.0)
    mesh(points, [f[::-1] for f in faces if not all(points[i][2] == 1 for i in f)], "Box").data.materials.append(diffuse_material("w", 0.5))


def fans(_):
    """Three faces on one edge, and one face through another."""
    good()
    mesh(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0.5), (0, 0, 1), (0.5, -1, -1), (0.5, 1, 1)], [(0, 1, 2), (0, 1, 3), (0, 1, 4), (4, 5, 6)]
    )


def turned_room(_):
    room(diffuse_material("wall", 0.5), inward=False)
    add_light("POINT", location=(0.5, 0.5, 0.5), energy=10.0)


def two_thousand_instances(_):
    good()
    points = [(x, y, 0) for x in range(50) for y in range(40)]
    parent = mesh(points, [], "parent")
    mesh(*CUBE, name="child").parent = parent
    parent.instance_type = "VERTS"


def nodes_without_mesh(_):
    good()
    tree = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, points, end = (tree.nodes.new(k) for k in ("NodeGroupInput", "GeometryNodeMeshToPoints", "NodeGroupOutput"))
    tree.links.new(start.outputs[0], points.inputs[0])
    tree.links.new(points.outputs[0], end.inputs[0])
    mesh(*CUBE).modifiers.new("nodes", "NODES").node_group = tree


def no_meshes(_):
    good()
    put(bpy.data.curves.new("wire", "CURVE"), "wire")
    text = bpy.data.curves.new("text", "FONT")
    text.body = "a"
    put(text, "text").location.x = 6.0
    ball = bpy.data.metaballs.new("ball")
    ball.elements.new()
    put(ball, "ball")
    put(None, "empty")
    put(bpy.data.volumes.new("volume"), "volume")


def hidden(_):
    good()
    mesh(*SQUARE, name="hidden").hide_render = True
    mesh(*SQUARE, name="off").hide_viewport = True
    out = bpy.data.collections.new("out")
    bpy.context.scene.collection.children.link(out)
    bad = mesh(*SQUARE, name="excluded")
    bpy.context.scene.collection.objects.unlink(bad)
    out.objects.link(bad)
    bpy.context.view_layer.layer_collection.children["out"].exclude = True


# ---- what results must be

SUN = 2.0


def lit(*names):
    """Only these objects were baked, and the sun falls on them."""

    def check(outcome):
        assert sorted(outcome.images) == sorted(names)
        for name in names:
            assert outcome.mean(name).min() > 0.1, name

    return check


def facing_up(outcome):
    """Neither of the two faces shadows the other: the one that faces the sun has all of it, the other none."""
    pixels = outcome.images["bad"]
    values = np.round(pixels[pixels[..., 3] > 0][:, 0], 3)
    assert set(np.unique(values)) == {0.0, SUN}
    assert 0.4 < (values == SUN).mean() < 0.6


def equal_twins(outcome):
    np.testing.assert_allclose(outcome.mean("one"), SUN, rtol=1e-5)
    np.testing.assert_allclose(outcome.mean("two"), SUN, rtol=1e-5)


def some_escapes(outcome):
    balance = outcome.report["energy_balance"]
    assert 0.05 < balance["escaped"] / balance["emitted"] < 0.5 and balance["gap"] < 1e-6


def black_picture(outcome):
    assert not any(outcome.report["mean"]["radiance"])
    assert any(p.suffix == ".exr" and p.name != "earlier.exr" for p in outcome.folder.iterdir())


WITHOUT = ("bad", "has no faces and is left out")
NO_AREA = ("bad", "has no face with an area and is left out")
OUT_OF_BOUNDS = ("bad", "triangles have coordinates that are not numbers or exceed")
NO_SIZE = ("bad", "has a scale of zero or a matrix that is not a number and is left out")
NO_MESHES = (*((n, "left out") for n in ("wire", "volume")), *((n, "result is on an object of its own") for n in ("text", "ball")))
HIDDEN = (("hidden", "is hidden in render"), ("off", "is disabled in the viewport"))
NAMED = ("--objects", "bad")
PICTURE = ("--target", "render", "--size", "16x16")
PARTICLES = ("--method", "particle_tracing", "--set", "particles=20000")

CASES = [
    Case(1, "empty scene", lambda _: None, refused=("Scene", "has no faces and no lights")),
    Case(2, "only lights, to textures", only_lights, refused=("Scene", "has no mesh object with faces to bake")),
    Case(2, "only lights, to a picture", only_lights, None, (("Scene", "every result is black"),), PICTURE, black_picture),
    Case(3, "no vertices", beside_good([], []), told=(WITHOUT,), check=lit("Good")),
    Case(3, "no vertices, alone", lambda _: mesh([], []), refused=("Scene", "has no faces and no lights")),
    Case(4, "no faces", beside_good([(0, 0, 0), (1, 0, 0)], []), told=(WITHOUT,), check=lit("Good")),
    Case(4, "no faces, asked for", beside_good([(0, 0, 0), (1, 0, 0)], []), refused=("bad", "has no faces"), options=NAMED),
    Case(5, "three equal vertices", beside_good([(0, 0, 0)] * 3, [(0, 1, 2)]), told=(NO_AREA,), check=lit("Good")),
    Case(6, "vertices on a line", beside_good([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)]), told=(NO_AREA,), check=lit("Good")),
    Case(6, "vertices on a line, asked for", beside_good([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)]), ("bad", "area"), options=NAMED),
    Case(7, "sliver", beside_good([(0, 0, 0), (1, 0, 0), (0, 2e-20, 0)], [(0, 1, 2)]), told=(NO_AREA,), check=lit("Good")),
    Case(8, "vertex that is no number", cube_with_vertex((NAN, 0, 0)), told=(OUT_OF_BOUNDS,), check=lit("Good", "bad")),
    Case(9, "infinite vertex", cube_with_vertex((0, INF, 0)), told=(OUT_OF_BOUNDS,), check=lit("Good", "bad")),
    Case(10, "vertex at 1e20", cube_with_vertex((0, 0, 1e20)), told=(OUT_OF_BOUNDS,), check=lit("Good", "bad")),
    Case(12, "scale of zero", beside_good(*SQUARE, scale=(1, 0, 1)), told=(NO_SIZE,), check=lit("Good")),
    Case(12, "scale of zero, asked for", beside_good(*SQUARE, scale=(1, 0, 1)), ("bad", "has a scale of zero"), options=NAMED),
    Case(14, "scale that is no number", beside_good(*SQUARE, scale=(1, NAN, 1)), told=(NO_SIZE,), check=lit("Good")),
    Case(15, "sheared parent", sheared, check=lit("Good", "bad")),
    Case(16, "quad that is not flat, concave face", twisted, check=lit("Good", "quad", "concave")),
    Case(17, "face of 10,000 corners", big_polygon, check=lit("Good", "bad")),
    Case(18, "two faces in one place", opposite_faces, check=facing_up),
    Case(19, "two objects in one place", twice, check=equal_twins),
    Case(20, "open box", open_box, options=PARTICLES, check=some_escapes),
    Case(21, "faces that cross and meet in one edge", fans, check=lit("Good", "bad")),
    Case(22, "room with its normals outward", turned_room, told=(("Room", "so their backs are baked"),), check=lit("Room")),
    Case(24, "instances", two_thousand_instances, check=lit("Good")),
    Case(25, "geometry nodes without a mesh", nodes_without_mesh, told=(("bad", "left out"),), check=lit("Good")),
    Case(26, "curve, text, metaball, empty, volume", no_meshes, told=NO_MESHES, check=lit("Good", "text GI", "ball GI")),
    Case(26, "text, asked for", no_meshes, check=lit("text GI"), options=("--objects", "text")),
    Case(26, "empty, asked for", no_meshes, ("empty", "is an empty, not a mesh"), options=("--objects", "empty")),
    Case(28, "hidden objects", hidden, told=HIDDEN, check=lit("Good")),
    Case(28, "hidden object, asked for", hidden, ("hidden", "is hidden in render"), options=("--objects", "hidden")),
    Case(28, "excluded object, asked for", hidden, ("excluded", "its collection is excluded"), options=("--objects", "excluded")),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=str)
def test_bad_geometry(case, tmp_path, capsys):
    play(case, tmp_path, capsys)


def test_06_a_corner_on_a_line_is_unwrapped_with_its_face():
    """It belongs to a flat triangle only, until a modifier cuts the face along the other diagonal (seen on zdm2)."""
    points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0.5, 1, 0)]
    bad = mesh(points, [(0, 1, 2, 3)])
    bpy.context.view_layer.update()
    name = make_lightmap_uv(bad, resolution=64)
    uv = np.array([x.vector for x in bad.data.uv_layers[name].uv])
    flat = np.column_stack([np.array(points)[:, :2], np.ones(4)])
    fitted, *_ = np.linalg.lstsq(flat, uv, rcond=None)
    np.testing.assert_allclose(flat @ fitted, uv, atol=1e-5)
    assert abs(np.linalg.det(fitted[:2])) > 0.01


# ---- 11, 13, 15: the same result as from a scene without the trouble


def bent(name="bent"):
    """A sheet bent by 90 degrees, with a UV layer of two charts."""
    made = mesh([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (0, 2, 1), (2, 2, 1)], [(0, 1, 2, 3), (3, 2, 5, 4)], name)
    uv = [0, 0, 0.5, 0, 0.5, 1, 0, 1, 0.5, 0, 1, 0, 1, 1, 0.5, 1]
    made.data.uv_layers.new(name="UVMap").uv.foreach_set("vector", np.array(uv, np.float32))
    made.data.materials.append(diffuse_material("grey", 0.5))
    return made


def baked(name="bent"):
    bpy.context.view_layer.update()
    values = {"samples": 16, "max_length": 3}
    return baking.lightmaps(baking.request(values=values, resolution=16, uv_layer="UVMap", objects=(name,)))[name].values


def test_11_a_million_metres_from_the_origin():
    def build(offset):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        bent().location = (offset, 0, 0)
        add_light("AREA", location=(offset + 1, 1, 3), energy=100.0, size=1.0)
        return baked()

    here, there = build(0.0), build(1e6)
    assert here.max() > 1.0
    # Single paths may go another way by a rounding; in no texel this comes to more.
    np.testing.assert_allclose(there.mean(), here.mean(), rtol=1e-4)
    np.testing.assert_allclose(there, here, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("number", ["13 negative scale", "15 sheared parent"])
def test_the_matrix_of_an_object_is_as_good_as_moved_vertices(number):
    change = Matrix.Scale(-1, 4, (1, 0, 0)) if "13" in number else Matrix(((1, 0.6, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)))

    def build(apply):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        made = bent()
        if apply:
            made.data.transform(change)
            if change.determinant() < 0:
                made.data.flip_normals()
        else:
            made.parent = put(None, "parent")
            made.matrix_parent_inverse = change  # an object's own matrix cannot be sheared
        add_light("AREA", location=(0, 1, 3), energy=100.0, size=1.0)
        return baked()

    moved, applied = build(False), build(True)
    assert applied.max() > 1.0
    # Corners start elsewhere after a flip, so the points in a texel differ by rounding, and the noise of a few paths with them.
    np.testing.assert_allclose(moved.mean(), applied.mean(), rtol=2e-3)
    np.testing.assert_allclose(moved, applied, rtol=0.1, atol=0.1)


# ---- 23, 24: limits, reached by smaller numbers


def test_23_many_triangles_are_estimated_then_refused(monkeypatch):
    """10 million triangles: the panel's check counts them without reading them, and says the memory; too much of it is refused."""
    good()
    dense = mesh(*SQUARE, name="dense")
    dense.modifiers.new("array", "ARRAY").count = 1000
    bpy.context.view_layer.update()
    before = baking.fingerprint()
    request = baking.request(resolution=16)
    monkeypatch.setattr(module, "QUICK", 1000)
    found = [str(n) for n in preflight(bpy.context, request)]
    assert any("has about 2,002 triangles; they are looked at when the bake starts" in n for n in found)
    assert any("of memory" in n for n in found)

    monkeypatch.setattr(module, "available_memory", lambda: 1_000_000)
    errors = [n for n in preflight(bpy.context, request) if n.severity == "error"]
    assert len(errors) == 1 and "needs about" in errors[0].reason and "free" in errors[0].reason and errors[0].remedy
    with pytest.raises(baking.AdjointError, match="of memory for .* and 1 MB are free"):
        baking.Bake(bpy.context, request)
    assert baking.fingerprint() == before

    # What 10 million would need, by the same rule.
    assert 8e9 < 10_000_000 * module.BYTES_A_TRIANGLE < 10e9


def test_24_instances_receive_nothing_and_cast_shadows(tmp_path):
    """100,000 of them are read in linear time: test_extract_mesh.py, marked slow. Here: how they are baked."""
    two_thousand_instances(tmp_path)
    bpy.context.view_layer.update()
    found = baking.request(resolution=16, objects=("child",))
    with pytest.raises(baking.AdjointError, match="child: .*seen only as an instance.*Make its instances real"):
        baking.Bake(bpy.context, found)
    made = baking.Bake(bpy.context, baking.request(resolution=16, values={"samples": 1}))
    assert len(made.driver.world.scene.objects) == 2001 and math.isclose(made.driver.world.scene.vertices[:, 0].max(), 50.0)


# ---- 27: edit mode


def edited():
    bad = mesh(*SQUARE)
    bad.data.uv_layers.new(name="Mine")
    bpy.context.view_layer.objects.active = bad
    bpy.ops.object.mode_set(mode="EDIT")
    add_light("SUN", energy=SUN, angle=0.0)
    bpy.context.view_layer.update()
    return bad


def test_27_edit_mode_is_refused_where_a_user_can_leave_it():
    bad = edited()
    before = baking.fingerprint()
    with pytest.raises(baking.AdjointError, match="bad: .*is in edit mode. Leave edit mode first"):
        baking.Bake(bpy.context, baking.request(resolution=16))
    assert baking.fingerprint() == before and bad.mode == "EDIT"


def test_27_edit_mode_is_left_where_no_user_is(tmp_path, capsys):
    bad = edited()
    code = cli.main(["bake", "--resolution", "16", "--set", "samples=1", "--output", str(tmp_path)], in_blender=True)
    assert code == 0 and "info: bad: was in edit mode, which has been left" in capsys.readouterr().err
    assert bad.mode == "OBJECT" and bad.data.uv_layers["Mine"].active_render
