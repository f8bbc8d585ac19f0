# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake Instances: each instance has a lightmap of its own, in the light that the plain instance is in, and leaves no trace."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import bake
from adjgi.adjoint_gi.bridge.baking.bake import Bake, preflight, rehearse
from adjgi.adjoint_gi.bridge.baking.instances import make
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.props.properties import request_of
from adjgi.adjoint_gi.bridge.results import real, stored
from adjgi.adjoint_gi.bridge.results import show as results
from adjgi.adjoint_gi.bridge.results.image import linked_image
from adjgi.adjoint_gi.bridge.results.remove import remove_results
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.tests import baking
from adjgi.tests.blender.fakes import quick
from adjgi.tests.blender.listing import collection, empty, linked, nodes, plane, points
from adjgi.tests.cycles_patch import add_light
from adjgi.tests.fuzz import user_data
from adjgi.tests.hostile import SQUARE, mesh

SUN = 2.0


def roof(x, y=0.0):
    """A large square just above (x, y), which takes the sun from all that lies there."""
    made = mesh(*SQUARE, name="roof")
    made.location, made.scale = (x, y, 6.0), (1.3, 1.3, 1.3)
    return made


def aside(name):
    """A square that is in the scene by its instances only."""
    made = collection(name, in_scene=False)
    obj = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    obj.data.from_pydata(*SQUARE[:1], [], SQUARE[1])
    made.objects.link(obj)
    return made


def collections():
    """Three instances of one collection 5 m apart."""
    props = aside("chair")
    for k in range(3):
        empty(f"place {k}", props).location.x = 5.0 * k
    return {f"chair[place {k}.0]": 5.0 * k for k in range(3)}


def on_points():
    """Two instances on the points of a mesh, by geometry nodes."""
    host = points("host")
    nodes(host, obj=aside("leaf").objects[0], scatter=True)
    return {"leaf[host.0": 0.0, "leaf[host.1": 3.0}


def nested():
    """A collection that holds an instance of another one twice, turned by their instancer."""
    leaf, outer = aside("leaf"), collection("outer", in_scene=False)
    for k in range(2):
        empty(f"inner {k}", leaf, outer).location.x = 4.0 * k
    empty("top", outer).rotation_euler.z = np.pi / 2
    return {"leaf[top": None}


def vertices():
    """A child on the vertices of its parent."""
    host = points("host")
    plane("leaf").parent = host
    host.instance_type = "VERTS"
    return {"leaf[host.0": 0.0, "leaf[host.1": 3.0}


def of_nodes():
    """A mesh that nodes make, on the points of another one."""
    nodes(points("host"), scatter=True)
    return {"host[host.0": 0.0, "host[host.1": 3.0}


MADE = {
    "collections": (collections, 3),
    "on points": (on_points, 2),
    "nested": (nested, 2),
    "vertices": (vertices, 2),
    "of nodes": (of_nodes, 2),
}


def asked(**more):
    return baking.request(**{"resolution": 8, "values": {"samples": 1, "max_length": 2}, "instances": True, **more})


def light(made):
    """Mean irradiance of each object, by name."""
    return {name: baked.values[baked.share > 0].mean() for name, baked in made.items()}


def clear():
    results.restore(bpy.context.scene)
    remove_results(bpy.context.scene)


def faces(world):
    return sorted(map(tuple, np.round(world.scene.vertices[world.scene.triangles].reshape(-1, 9), 5).tolist()))


@pytest.mark.parametrize("kind", MADE)
def test_every_instance_is_baked_and_the_scene_holds_the_same_faces(kind):
    build, count = MADE[kind]
    places = build()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    mesh(*SQUARE, name="floor").location = (0, 0, -5)
    bpy.context.view_layer.update()
    before = user_data()
    plain = Bake(bpy.context, asked(instances=False)).driver.world
    clear()
    made = baking.lightmaps(asked())
    found = {name: mean for name, mean in light(made).items() if name != "floor"}
    assert len(found) == count and all(any(name.startswith(p) for p in places) for name in found)
    assert all(mean == pytest.approx(SUN, rel=1e-3) for mean in found.values())
    assert faces(made["floor"].world) == faces(plain), "no face twice, none lost"
    assert len({linked_image(o, "irradiance") for o in real.objects_of(bpy.context.scene)}) == count
    clear()
    assert user_data() == before


def test_a_mesh_that_nodes_make_is_not_taken_for_that_of_its_maker():
    """Two squares of 1 m and their maker, one of 2 m, each with its own faces and all of it told."""
    host = mesh(*SQUARE, name="host")
    nodes(host, scatter=True, join=True)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    before = baking.bake(asked(instances=False))
    assert "makes 4 instances of a mesh of its nodes, in the light but not baked" in [n.reason for n in before.notices]
    made = baking.bake(asked())
    sides = {o.name: max(o.dimensions) for o in real.objects_of(bpy.context.scene)}
    assert sides.pop("host[host]") == pytest.approx(max(host.data.vertices[0].co[:2], key=abs) * -2, rel=1e-5)
    assert sorted(sides) == [f"host[host.0.{k}]" for k in range(4)] and all(x == pytest.approx(1.0) for x in sides.values())
    assert "makes 4 instances of a mesh of its nodes, baked as objects of their own" in [n.reason for n in made.notices]


def test_one_in_the_sun_and_one_in_the_shade():
    """Lit by the sun from straight above: its irradiance, and nothing below a black roof."""
    collections()
    roof(5.0).data.materials.append(None)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    found = light(baking.lightmaps(asked(values={"samples": 4, "max_length": 1})))
    assert found["chair[place 0.0]"] == pytest.approx(SUN, rel=1e-3) == found["chair[place 2.0]"] and found["chair[place 1.0]"] == 0.0


def test_an_atlas_holds_each_at_its_own_place():
    collections()
    roof(5.0)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    made = baking.bake(asked(atlas=True, resolution=64, values={"samples": 1, "max_length": 1}))
    (sheet,) = made.writer.sheets
    assert sheet.lightmap.overlapping == 0 and len(sheet.uids) == 4
    owner = made.driver.world.scene.object[sheet.lightmap.receivers.triangle[sheet.lightmap.receivers.start[:-1]]]
    irradiance = made.driver.solution().quantity("irradiance")[:, 0]
    names = [o.name for o in made.driver.world.scene.objects]
    mean = {names[k]: irradiance[owner == k].mean() for k in np.unique(owner)}
    assert mean["chair[place 1.0]"] == 0.0 and mean["chair[place 0.0]"] == pytest.approx(SUN, rel=1e-3)


def test_a_sheared_mirrored_instance_is_where_it_was():
    """No object can have the matrix of a stretched instancer around a turned member: the mesh takes it."""
    props = aside("leaf")
    props.objects[0].rotation_euler.y, props.objects[0].scale.x = 0.5, -1.0
    empty("place", props).scale = (3, 1, 1)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    plain = Bake(bpy.context, baking.request("path_tracing", "attribute", resolution=8, objects=(), instances=True)).driver.world
    (obj,) = real.objects_of(bpy.context.scene)
    (matrix,) = [i.matrix_world.copy() for i in bpy.context.evaluated_depsgraph_get().object_instances if i.is_instance]
    corners = np.array([matrix @ v.co for v in props.objects[0].data.vertices])
    bpy.context.view_layer.update()
    shown = np.array([obj.matrix_world @ v.co for v in obj.data.vertices])
    assert stored.read(obj, stored.REAL)["sheared"] and np.allclose(shown, corners, atol=1e-5)
    assert np.allclose(np.sort(plain.scene.vertices + 0.0, axis=0), np.sort(corners, axis=0), atol=1e-5)
    normal = matrix.to_3x3().inverted().transposed() @ props.objects[0].data.polygons[0].normal
    assert np.dot(obj.data.polygons[0].normal, normal.normalized()) == pytest.approx(1.0, abs=1e-5)
    assert np.dot(plain.scene.corner_normals[0, 0], normal.normalized()) == pytest.approx(1.0, abs=1e-5)


def test_what_has_changed_is_renewed_and_what_has_not_keeps_its_lightmap():
    collections()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    scene = bpy.context.scene
    bpy.context.view_layer.update()
    baking.bake(asked())
    known = {real.instance_name(o): o.session_uid for o in real.objects_of(scene)}
    image = linked_image(bpy.data.objects["chair[place 1.0]"], "irradiance")
    bpy.data.objects["place 1"].location.z = 2.0
    bpy.data.objects.remove(bpy.data.objects["place 2"])
    empty("place 3", bpy.data.collections["chair"]).location.x = 15.0
    bpy.context.view_layer.update()
    world = baking.bake(asked()).driver.world
    now = {real.instance_name(o): o for o in real.objects_of(scene)}
    assert set(now) == {f"chair[place {k}.0]" for k in (0, 1, 3)} and len(world.scene.objects) == 3
    assert all(now[name].session_uid == uid for name, uid in known.items() if name in now)
    assert linked_image(now["chair[place 1.0]"], "irradiance") == image and now["chair[place 1.0]"].matrix_world.translation.z == 2.0
    assert not [o for o in bpy.data.objects if o.users == 0] and len(bpy.data.meshes) == 4, "what is gone leaves no orphans"
    bpy.data.collections["chair"].objects[0].data.vertices[0].co.z = 0.5
    bpy.context.view_layer.update()
    baking.bake(asked())
    assert now["chair[place 0.0]"].data.vertices[0].co.z == 0.5 and len(bpy.data.meshes) == 4


def test_a_refused_bake_leaves_nothing(monkeypatch):
    collections()
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    before = user_data()
    for again in (False, True):
        with monkeypatch.context() as patch, pytest.raises(AdjointError, match="do not fit"):
            patch.setattr("adjgi.adjoint_gi.bridge.baking.textures.rasterize", refuse)
            Bake(bpy.context, asked())
        assert user_data() == before, again
        if not again:  # with objects of an earlier bake, which the refused one had begun to renew
            baking.bake(asked())
            bpy.data.objects["place 1"].location.z = 2.0
            bpy.data.collections["chair"].objects[0].data.vertices[0].co.z = 0.5
            bpy.data.objects.remove(bpy.data.objects["place 2"])
            bpy.context.view_layer.update()
            before = user_data()


def refuse(*args, **more):
    raise AdjointError("Texels", "do not fit", "")


def test_check_says_what_the_bake_says_and_makes_nothing():
    collections()
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    before = user_data()
    said = rehearse(bpy.context, asked())
    assert user_data() == before
    assert [n for n in said if "1 instance of chair, baked as an object of its own" in n.reason]
    assert [n for n in preflight(bpy.context, asked()) if "which the bake makes objects of" in n.reason]
    (told,) = [n for n in preflight(bpy.context, asked(instances=False)) if "in the light but not baked" in n.reason]
    assert "--instances" in told.remedy
    assert [n for n in Bake(bpy.context, asked()).notices if "free" not in n.reason] == [n for n in said if "free" not in n.reason]


def test_the_panel_does_not_refuse_a_scene_of_instances():
    """Its check does not make the objects that will receive."""
    collections()
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    for request in (asked(), asked(objects=("place 1",))):
        assert not [n for n in preflight(bpy.context, request) if n.severity == "error"]
    for request in (asked(instances=False), asked(objects=("place 1",), instances=False)):
        assert [n for n in preflight(bpy.context, request) if n.severity == "error"]


def test_named_makers_mean_their_instances_alone(tmp_path):
    collections()
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    made = baking.lightmaps(asked(objects=("place 1",)))
    assert list(made) == ["chair[place 1.0]"] and sum(len(o.instance) > 0 for o in made["chair[place 1.0]"].world.scene.objects) == 2
    with pytest.raises(AdjointError, match="is an empty"):
        Bake(bpy.context, asked(objects=("place 1",), instances=False))
    clear()
    arguments = ["bake", "--instances", "--objects", "place 1", "--resolution", "8", "--set", "samples=1", "--output", str(tmp_path)]
    assert cli.main(arguments, in_blender=True) == 0
    assert [p for p in tmp_path.iterdir() if p.name.startswith("chair") and p.suffix == ".exr"]


@pytest.mark.parametrize("target", ["texture", "attribute"])
def test_show_result_shows_them_in_place_of_their_makers(registered, target):
    """Also where the instancer has faces of its own; what is shown changes no number, and Restore and Clear Results take all back."""
    floor = mesh(*SQUARE, name="floor")
    nodes(floor, obj=aside("leaf").objects[0], scatter=True)
    tree = floor.modifiers[0].node_group
    join = tree.nodes.new("GeometryNodeJoinGeometry")
    end = next(n for n in tree.nodes if n.type == "GROUP_OUTPUT")
    last, start = end.inputs[0].links[0].from_socket, next(n for n in tree.nodes if n.type == "GROUP_INPUT")
    tree.links.new(last, join.inputs[0])
    tree.links.new(start.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], end.inputs[0])
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    scene, layer = bpy.context.scene, bpy.context.view_layer
    layer.update()
    before = user_data()
    state = quick(scene, "path_tracing")
    state.resolution, state.target, state.instances, state.selection_only = 8, target, True, False
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    made = real.objects_of(scene)
    assert len(made) == 5 and not any(o.visible_get() for o in made) and floor.visible_get()
    plain = faces(BAKES.job.driver.world)
    assert results.show(scene, layer) == 5
    layer.update()
    assert all(o.visible_get() for o in made) and not floor.visible_get()
    assert not [i for i in bpy.context.evaluated_depsgraph_get().object_instances if i.is_instance], "nothing is seen twice"
    made[0].select_set(True)
    assert results.selected(layer) == ("floor",)
    made[0].select_set(False)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}, rehearse(bpy.context, request_of(scene))
    assert faces(BAKES.job.driver.world) == plain and all(o.visible_get() for o in made)
    results.restore(scene)
    layer.update()
    assert not any(o.visible_get() for o in made) and floor.visible_get()
    results.show(scene, layer)
    clear()
    BAKES.forget()
    assert user_data() == before


def test_selected_instancers_are_baked(registered):
    collections()
    add_light("SUN", energy=SUN)
    scene = bpy.context.scene
    state = quick(scene, "path_tracing")
    state.resolution, state.instances, state.selection_only = 8, True, True
    for obj in scene.objects:
        obj.select_set(obj.name == "place 2")
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    assert [real.maker_name(o) for o in real.objects_of(scene)] == ["place 2"]
    BAKES.forget()


def test_what_only_holds_instances_of_another_scene_stays_there():
    collections()
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    baking.bake(asked())
    other = bpy.data.scenes.new("other")
    other.collection.children.link(real.collection_of(bpy.context.scene))
    remove_results(bpy.context.scene)
    assert len(real.objects_of(other)) == 3 and real.collection_of(bpy.context.scene) is None


@pytest.mark.parametrize("what", ["object", "object in a collection", "copy"])
def test_what_the_user_keeps_among_the_objects_of_a_bake_stays_in_the_scene(what):
    """Whatever stands in the collection of a bake and is no work of it, when all of its work goes, twice."""
    collections()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    scene = bpy.context.scene
    bpy.context.view_layer.update()
    baking.bake(asked())
    ours, first = real.collection_of(scene), real.objects_of(scene)[0]
    own = first.copy() if what == "copy" else bpy.data.objects.new("own", None)
    (collection("drawer", ours) if what == "object in a collection" else ours).objects.link(own)
    own.hide_render = False
    made = {o.name for o in real.objects_of(scene)}
    wanted = {o.name for o in scene.objects} - made
    assert own.name in wanted and len(made) == 3
    for _ in range(2):
        clear()
        assert {o.name for o in scene.objects} == wanted and real.collection_of(scene) is None
        baking.bake(asked())


def test_nothing_is_made_for_a_picture():
    linked(bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))).location.z = 9
    bpy.context.scene.camera = bpy.data.objects["Camera"]
    collections()
    add_light("SUN", energy=SUN)
    rehearse(bpy.context, asked(target="render", width=4, height=4, output="//"))
    assert real.collection_of(bpy.context.scene) is None


def test_an_instance_that_cannot_receive_is_left_out_where_others_do():
    """Without the UV layer that is asked for; it stays a plain instance in the light, and is named."""
    collections()
    empty("other", aside("table")).location.y = 5.0
    for layer in (bpy.data.objects["chair"].data.uv_layers.new(name="Mine"),):
        layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    add_light("SUN", energy=SUN)
    bpy.context.view_layer.update()
    made = Bake(bpy.context, asked(uv_layer="Mine"))
    assert [n.object for n in made.notices if "not baked" in n.reason and n.severity == "warning"] == ["table[other.0]"]
    assert len(real.objects_of(bpy.context.scene)) == 3 and len(made.driver.world.scene.objects) == 4


def test_the_selection_goes_to_what_is_seen_of_an_instancer_and_comes_back(registered):
    """From the instancer to an object of its instances, and from there to the object with that one's attribute."""
    on_points()
    add_light("SUN", energy=SUN)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    for obj in scene.objects:
        obj.select_set(obj.name == "host")
    before = user_data()
    state = quick(scene, "path_tracing")
    state.target, state.new_object, state.instances, state.selection_only = "attribute", True, True, True
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    assert results.show(scene, layer) == 2
    (chosen,) = layer.objects.selected
    assert chosen.visible_get() and not real.is_real(chosen) and results.selected(layer) == ("host",)
    clear()
    BAKES.forget()
    assert user_data() == before


CHANGES = {
    "a corner": lambda m: setattr(m.vertices[0], "co", (9, 9, 9)),
    "the material of a face": lambda m: setattr(m.polygons[1], "material_index", 1),
    "a smooth face": lambda m: m.shade_smooth(),
    "a place in a UV layer": lambda m: setattr(m.uv_layers["Map"].uv[2], "vector", (0.25, 0.5)),
    "the name of a UV layer": lambda m: setattr(m.uv_layers["Map"], "name", "Other"),
    "a color": lambda m: setattr(m.color_attributes["Paint"].data[1], "color", (0, 0, 1, 1)),
}
ROOF = [(0, 0, 0), (1, 0, 0), (1, 1, 1), (0, 1, 1), (2, 0, 2)], [(0, 1, 2, 3), (1, 4, 2)]


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_light_could_depend_on_makes_another_mesh(change):
    def made():
        m = bpy.data.meshes.new("Roof")
        m.from_pydata(*ROOF[:1], [], ROOF[1])
        m.polygons.foreach_set("use_smooth", [False, False])
        m.uv_layers.new(name="Map")
        m.color_attributes.new("Paint", "FLOAT_COLOR", "CORNER")
        return m

    one, other = made(), made()
    assert real.checksum(one) == real.checksum(other)
    CHANGES[change](other)
    assert real.checksum(one) != real.checksum(other)


def test_what_was_made_is_taken_back_together(registered, monkeypatch):
    """8,000 instances took minutes to take back one by one: Blender looks through all objects for each."""
    collections()
    bpy.context.view_layer.update()
    calls, remove = [], real.remove_objects
    monkeypatch.setattr(real, "remove_objects", lambda uids: calls.append(list(uids)) or remove(uids))
    rehearse(bpy.context, baking.request(instances=True))
    assert [len(uids) for uids in calls if uids] == [3] and not real.objects_of(bpy.context.scene)


def test_all_that_cannot_receive_are_left_out_in_one_go(registered, monkeypatch):
    """Meshes without room for one more UV layer were found one by one, each by making all instances again."""
    collections()
    for k in range(8):
        bpy.data.objects["chair"].data.uv_layers.new(name=f"{k}")
    mesh(*SQUARE, name="floor").location = (0, 0, -5)
    bpy.context.view_layer.update()
    calls = []
    monkeypatch.setattr(bake, "make", lambda *args: calls.append(args) or make(*args))
    (found,) = [n for n in rehearse(bpy.context, asked()) if "it is in the light, but not baked" in n.reason]
    assert len(found.names) == 3 and "has 8 UV layers" in found.reason and not real.objects_of(bpy.context.scene)
    assert len(calls) == 2, "for all, and for what is left"
