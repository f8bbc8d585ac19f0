"""UV layers for lightmaps: no overlap, even density, and nothing else of the mesh is changed."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.bridge.extract.mesh import read_mesh
from adjgi.adjoint_gi.bridge.host.notices import Notices
from adjgi.adjoint_gi.bridge.results import lightmap_uv as module
from adjgi.adjoint_gi.bridge.results.faces import copy_faces
from adjgi.adjoint_gi.bridge.results.lightmap_uv import (
    check_uv_layer,
    find_uv_layer,
    make_lightmap_uvs,
    paddings,
    remove_lightmap_uv,
    shares_square,
)
from adjgi.adjoint_gi.core.base.errors import SceneError, TargetError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers import unwrap as module_unwrap
from adjgi.adjoint_gi.core.receivers.texels import rasterize
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.baking import make_lightmap_uv
from adjgi.tests.blender.test_extract_colors import Graph
from adjgi.tests.counting import counted
from adjgi.tests.hostile import SQUARE, mesh

SHAPES = {
    "cube": lambda: bpy.ops.mesh.primitive_cube_add(),
    "sphere": lambda: bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24),
    "torus": lambda: bpy.ops.mesh.primitive_torus_add(major_segments=64, minor_segments=32),
    "monkey": lambda: bpy.ops.mesh.primitive_monkey_add(),
    "cylinder": lambda: bpy.ops.mesh.primitive_cylinder_add(vertices=40),
    "cone": lambda: bpy.ops.mesh.primitive_cone_add(vertices=33),
    "turned": lambda: bpy.ops.mesh.primitive_cube_add(rotation=(0.7854, 0.3, 0.7854)),
}


def add(shape="cube"):
    SHAPES[shape]()
    return bpy.context.view_layer.objects.active


def test_faces_are_as_large_as_the_object_is_in_the_world():
    """Turned and of another size along each axis: edges of the box are unwrapped with the lengths that they have there."""
    obj = add("cube")
    obj.rotation_euler, obj.scale = (0.3, 0.5, 0.7), (1.0, 3.0, 0.25)
    bpy.context.view_layer.update()
    faces = copy_faces(obj, obj.data).faces()
    at = np.array([obj.matrix_world @ v.co - obj.matrix_world.translation for v in obj.data.vertices])
    np.testing.assert_allclose(faces.mesh.vertices, at, atol=1e-6)
    assert 0.5 * faces.area.sum() == pytest.approx(8 * (1 * 3 + 1 * 0.25 + 3 * 0.25), rel=1e-6)


def spiral():
    """A ramp of three turns around the z axis: seen from above it lies over itself."""
    mesh = bpy.data.meshes.new("Spiral")
    t = np.linspace(0, 6 * np.pi, 97)
    inner = np.stack([np.cos(t), np.sin(t), 0.1 * t], 1)
    outer = np.stack([2 * np.cos(t), 2 * np.sin(t), 0.1 * t], 1)
    mesh.from_pydata(np.concatenate([inner, outer]).tolist(), [], [(i, 97 + i, 98 + i, i + 1) for i in range(96)])
    obj = bpy.data.objects.new("Spiral", mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def raster(obj, layer, resolution, subsamples=4):
    m = read_mesh(obj.data, obj.name, Notices())
    b = SceneBuilder()
    b.mesh(obj.name, m.vertices, m.triangles, diffuse("White", 0.5), uv=m.uvs[layer])
    return m, rasterize(World(b.build()), [0], "UVMap", resolution, subsamples)


@pytest.mark.parametrize("shape", [*SHAPES, "spiral"])
def test_no_overlap_every_face_has_texels_and_charts_are_apart(shape):
    obj = spiral() if shape == "spiral" else add(shape)
    padding = 3
    name = make_lightmap_uv(obj, resolution=256, padding=padding)
    m, lm = raster(obj, name, 256)
    assert lm.overlapping == 0 and lm.outside == 0 and lm.no_area == 0 and lm.tiny_charts == 0 and lm.unusable == 0
    assert len(np.unique(lm.receivers.triangle)) > 0.97 * len(m.triangles)
    assert lm.covered.mean() > 0.3
    # No texel has one of another chart within the padding, along rows and columns.
    for axis in (0, 1):
        for step in range(1, padding + 1):
            a = np.roll(lm.chart, step, axis=axis)
            keep = np.ones_like(lm.covered)
            keep[(slice(step),) if axis == 0 else (slice(None), slice(step))] = False
            assert not np.any(keep & (a >= 0) & (lm.chart >= 0) & (a != lm.chart))


@pytest.mark.slow
def test_a_game_level_is_unwrapped_and_rasterized_without_a_loop_over_its_faces(monkeypatch):
    """58,737 triangles with tiled UVs, in some 12,000 charts."""
    monkeypatch.setenv("ADJOINT_GI_THREADS", "1")
    path = Path(__file__).resolve().parents[3] / "shared" / "scenes" / "zdm2.blend"
    if not path.exists():
        pytest.skip(f"{path.name} is not in ../shared/scenes")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    obj = next(o for o in bpy.data.objects if o.type == "MESH")
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode="OBJECT")  # the file was saved in edit mode
    obj.modifiers.clear()  # else the evaluated mesh would carry the layer, and not this one
    assert make_lightmap_uvs([obj], 1024, (1,)) == []
    (m, lm), calls = counted(lambda: raster(obj, obj.data[module.STORED], 1024))
    assert calls < 5 * len(m.triangles)  # batches of texels; a loop over faces calls at least ten functions for each
    assert lm.overlapping == 0 and lm.outside == 0 and lm.covered.mean() > 0.45
    assert len(np.unique(lm.receivers.triangle)) > 0.65 * len(m.triangles)


def density(obj, layer):
    """UV area over area of every triangle."""
    m = read_mesh(obj.data, obj.name, Notices())
    p, uv = m.vertices[m.triangles], m.uvs[layer].astype(float)
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / area


def test_texels_are_equally_large_everywhere():
    for shape, least in (("cube", 0.999), ("turned", 0.999), ("cylinder", 0.6), ("sphere", 0.49)):
        d = density(*(lambda o: (o, make_lightmap_uv(o)))(add(shape)))
        assert d.min() / d.max() > least, shape


def test_scale_of_the_object_counts():
    obj = add("cube")
    obj.scale = (4, 1, 1)
    bpy.context.view_layer.update()
    d = density(obj, make_lightmap_uv(obj))
    # In object space the faces along x must be four times as dense.
    assert np.allclose(np.sort(np.unique(np.round(d / d.min(), 2))), [1, 4], atol=0.02)


def snapshot(obj):
    mesh = obj.data
    corner = [tuple(np.round(x.vector, 6)) for layer in mesh.uv_layers if layer.name != "Lightmap" for x in layer.uv]
    return (
        [x.name for x in mesh.uv_layers if x.name != "Lightmap"],
        mesh.uv_layers.active.name,
        [x.name for x in mesh.uv_layers if x.active_render],
        corner,
        [p.select for p in mesh.polygons],
        [v.select for v in mesh.vertices],
        [tuple(v.co) for v in mesh.vertices],
        obj.mode,
        obj.select_get(),
        bpy.context.view_layer.objects.active.name,
        len(bpy.data.meshes),
        len(bpy.data.objects),
        len(bpy.data.scenes),
        sorted(a.name for a in mesh.attributes if a.name != "Lightmap"),
    )


def test_nothing_else_changes_and_removal_leaves_no_trace():
    obj = add("monkey")
    mesh = obj.data
    mesh.uv_layers.new(name="Second")
    mesh.uv_layers.active = mesh.uv_layers["Second"]
    mesh.polygons[3].select = False
    before = snapshot(obj)
    assert make_lightmap_uv(obj) == "Lightmap"
    assert snapshot(obj) == before
    assert make_lightmap_uv(obj, resolution=128) == "Lightmap" and len(mesh.uv_layers) == 3
    assert snapshot(obj) == before
    assert remove_lightmap_uv(obj) and not remove_lightmap_uv(obj)
    assert snapshot(obj) == before and not mesh.keys() and len(mesh.uv_layers) == 2


def test_the_layer_is_the_same_every_time():
    got = []
    for _ in range(2):
        obj = add("monkey")
        name = make_lightmap_uv(obj)
        got.append(read_mesh(obj.data, "m", Notices()).uvs[name])
    assert np.array_equal(*got)


def test_a_users_layer_called_lightmap_is_left_alone():
    obj = add("cube")
    obj.data.uv_layers["UVMap"].name = "Lightmap"
    before = read_mesh(obj.data, "m", Notices()).uvs["Lightmap"]
    assert make_lightmap_uv(obj) == "Lightmap.001"
    assert np.array_equal(read_mesh(obj.data, "m", Notices()).uvs["Lightmap"], before)
    assert find_uv_layer(obj, "") == "Lightmap.001" and find_uv_layer(obj, "Lightmap") == "Lightmap"


def test_layers_are_found_or_refused_by_name():
    obj = add("cube")
    obj.data.uv_layers.new(name="Other")
    assert find_uv_layer(obj, "") == "UVMap"
    with pytest.raises(TargetError, match=r'no UV layer "Bake" \(layers: "UVMap", "Other"\)'):
        find_uv_layer(obj, "Bake")
    while obj.data.uv_layers:
        obj.data.uv_layers.remove(obj.data.uv_layers[0])
    with pytest.raises(TargetError, match="has no UV layer"):
        find_uv_layer(obj, "")
    assert make_lightmap_uv(obj) == "Lightmap"  # a mesh without any layer gets its first


def test_a_ninth_layer_is_carried():
    obj = add("cube")
    while len(obj.data.uv_layers) < 8:
        obj.data.uv_layers.new(name="More")
    name = make_lightmap_uv(obj)
    bpy.context.view_layer.update()
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert len(obj.data.uv_layers) == 8 and name in evaluated.uv_layers and name not in obj.data.uv_layers


def test_too_many_charts_edit_mode_and_empty_meshes_are_refused():
    obj = add("monkey")
    with pytest.raises(TargetError, match="do not fit into 8 x 8"):
        make_lightmap_uv(obj, resolution=8)
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(TargetError, match="edit mode"):
        make_lightmap_uv(obj)
    bpy.ops.object.mode_set(mode="OBJECT")
    empty = bpy.data.objects.new("Empty", bpy.data.meshes.new("Empty"))
    with pytest.raises(SceneError, match="no faces"):
        make_lightmap_uv(empty)
    flat = add("cube")
    flat.scale = (0, 0, 1)
    bpy.context.view_layer.update()
    with pytest.raises(SceneError, match="no face with an area"):
        make_lightmap_uv(flat)


def test_degenerate_faces_do_not_stop_the_others():
    obj = add("cube")
    obj.data.vertices[0].co = (float("nan"), 0, 0)
    name = make_lightmap_uv(obj)
    uv = read_mesh(obj.data, "m", Notices()).uvs[name]
    assert np.isfinite(uv).all() and uv.min() >= 0 and uv.max() <= 1


def test_modifiers_that_add_faces_to_a_layer_of_the_user_are_named():
    obj = add("cube")
    name = "UVMap"
    assert check_uv_layer(obj, name, bpy.context.evaluated_depsgraph_get()) == ()
    obj.modifiers.new("Many", "ARRAY")
    (notice,) = check_uv_layer(obj, name, bpy.context.evaluated_depsgraph_get())
    assert notice.object == obj.name and "Many" in notice.reason
    tree = bpy.data.node_groups.new("Drop", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    start, drop, end = (tree.nodes.new(x) for x in ("NodeGroupInput", "GeometryNodeRemoveAttribute", "NodeGroupOutput"))
    drop.inputs["Name"].default_value = name
    tree.links.new(start.outputs[0], drop.inputs[0])
    tree.links.new(drop.outputs[0], end.inputs[0])
    obj.modifiers.new("Nodes", "NODES").node_group = tree
    with pytest.raises(TargetError, match="does not survive"):
        check_uv_layer(obj, name, bpy.context.evaluated_depsgraph_get())


def test_objects_that_share_a_mesh_have_their_own_layers():
    first = add("cube")
    second = bpy.data.objects.new("Second", first.data)
    bpy.context.scene.collection.objects.link(second)
    make_lightmap_uvs([first, second], 128, (2,))
    assert [x.name for x in first.data.uv_layers] == ["UVMap"] and module.in_one_square([first, second])
    values = [module.layer_values(obj, module.own_layer(obj)) for obj in (first, second)]
    assert values[0].shape == values[1].shape and not np.array_equal(*values)


def row_of_objects():
    made = []
    for k, shape in enumerate(("cube", "monkey", "cone")):
        obj = add(shape)
        obj.location.x = 4 * k
        made.append(obj)
    bpy.context.view_layer.update()
    return made


def test_several_objects_share_one_square_without_overlap():
    objects = row_of_objects()
    assert make_lightmap_uvs(objects, 256, paddings(256)) == []
    assert module.in_one_square(objects) and module.in_one_square(objects[1:]) and all(shares_square(obj) for obj in objects)
    b = SceneBuilder()
    for obj in objects:
        m = read_mesh(obj.data, obj.name, Notices())
        b.mesh(obj.name, m.vertices + 9 * np.array([len(obj.name), 0, 0]), m.triangles, diffuse("White", 0.5), uv=m.uvs["Lightmap"])
    lm = rasterize(World(b.build()), [0, 1, 2], "UVMap", 256)
    assert lm.overlapping == 0 and lm.outside == 0 and lm.no_area == 0 and lm.covered.mean() > 0.5
    scale = [np.sqrt(np.median(density(obj, "Lightmap"))) for obj in objects]
    assert max(scale) / min(scale) < 1.1


def test_layers_of_one_square_are_told_from_others():
    first, second, third = row_of_objects()
    make_lightmap_uvs([first, second], 128, (2,))
    make_lightmap_uv(third)
    assert not module.in_one_square([first, second, third]) and not shares_square(third)
    copy = bpy.data.objects.new("Copy", first.data.copy())  # has the same place of the square
    assert not module.in_one_square([first, copy]) and module.in_one_square([second, copy])
    make_lightmap_uv(first)
    assert not shares_square(first) and not module.in_one_square([first, second])
    assert remove_lightmap_uv(second) and not second.data.keys()


def test_no_layer_is_made_when_one_object_cannot_have_it():
    objects = row_of_objects()
    bpy.context.view_layer.objects.active = objects[1]
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(TargetError, match="edit mode"):
        make_lightmap_uvs(objects, 128, (2,))
    bpy.ops.object.mode_set(mode="OBJECT")
    assert all("Lightmap" not in obj.data.uv_layers and not obj.data.keys() for obj in objects)


def test_projected_layers_are_told(monkeypatch):
    obj = add("cube")
    monkeypatch.setattr(module, "unwrap", lambda *a: module_unwrap.by_projection(*a, "the charts have 3 texels claimed twice"))
    (notice,) = make_lightmap_uvs([obj], 128, (2,))
    assert notice.object == obj.name and "projection" in notice.reason and "3 texels claimed twice" in notice.reason


def test_padding_is_as_wide_as_the_image_allows():
    assert [paddings(n) for n in (64, 128, 256, 512, 4096)] == [(1, 0), (1, 0), (2, 1, 0), (4, 2, 1, 0), (4, 2, 1, 0)]


@pytest.mark.parametrize("solid", [False, True], ids=["plain", "carried"])
def test_images_do_not_lie_on_a_layer_of_ours(solid):
    """An object without UVs has none for its images after a bake, either: what check has said, the bake says."""
    obj = mesh(*SQUARE)
    graph = Graph()
    graph.show(graph.image().outputs["Color"])
    obj.data.materials.append(graph.material)
    if solid:
        obj.modifiers.new("Solid", "SOLIDIFY")

    def found():
        bpy.context.view_layer.update()
        arrays = extract(bpy.context.evaluated_depsgraph_get())
        return arrays.objects[0], [str(n) for n in arrays.warnings]

    _, before = found()
    make_lightmap_uvs([obj], 64, (2,))
    owner, after = found()
    assert owner.uvs and owner.render_uv == "" and after == before and any("has no UV layer for the images" in n for n in after)


@pytest.mark.parametrize("chosen", ["UVMap", "Later"])
@pytest.mark.parametrize("shown", ["UVMap", "Later"])
def test_layers_chosen_by_the_user_stay_chosen(chosen, shown):
    """Also one that was made after ours, which takes another place in the list when ours goes."""
    obj = add("cube")
    make_lightmap_uv(obj)
    layers = obj.data.uv_layers
    layers.new(name="Later")
    layers.active, layers[shown].active_render = layers[chosen], True

    def now():
        return layers.active.name, [x.name for x in layers if x.active_render]

    make_lightmap_uv(obj)
    assert now() == (chosen, [shown]) and len(layers) == 3
    assert remove_lightmap_uv(obj)
    assert now() == (chosen, [shown]) and len(layers) == 2
    make_lightmap_uv(obj)
    assert now() == (chosen, [shown]) and len(layers) == 3
