# SPDX-License-Identifier: GPL-3.0-or-later
"""Curves, texts, surfaces and metaballs are baked on objects of ours with their evaluated mesh, and leave no trace."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import report
from adjgi.adjoint_gi.bridge.baking.bake import Bake, preflight, rehearse
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.comparison.request import Compare, CompareRequest, ReferenceChoice
from adjgi.adjoint_gi.bridge.results import real, stored
from adjgi.adjoint_gi.bridge.results import show as results
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute
from adjgi.adjoint_gi.bridge.results.image import linked_image
from adjgi.adjoint_gi.bridge.results.lightmap_uv import own_layer
from adjgi.adjoint_gi.bridge.results.remove import remove_results
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.tests import baking, room
from adjgi.tests.blender.fakes import quick
from adjgi.tests.blender.listing import collection, empty, linked, nodes
from adjgi.tests.cycles_patch import add_light
from adjgi.tests.fuzz import user_data
from adjgi.tests.hostile import SQUARE, mesh

SUN = 2.0
WHOLE = ("Text", "Cable", "Twin", "Ball", "Sheet")  # what is to be baked of `build`


def curve(name, kind="CURVE", **values):
    data = bpy.data.curves.new(name, kind)
    for key, value in values.items():
        setattr(data, key, value)
    return linked(bpy.data.objects.new(name, data))


def strip(name="Cable", **values):
    """A straight curve that is extruded to a level strip."""
    made = curve(name, dimensions="3D", extrude=0.5, **values)
    spline = made.data.splines.new("POLY")
    spline.points.add(1)
    for k, point in enumerate(spline.points):
        point.co, point.tilt = (2.0 * k, 0, 0, 1), np.pi / 2
    return made


def balls():
    """Three metaballs, which form one surface."""
    for k in range(3):
        data = bpy.data.metaballs.new("Ball")
        data.elements.new()
        data.resolution = data.render_resolution = 0.6
        linked(bpy.data.objects.new("Ball" if k == 0 else f"Ball.{k:03}", data)).location = (10.0 + k, 0, 0)


def sheet():
    """A level NURBS surface."""
    bpy.ops.surface.primitive_nurbs_surface_surface_add(location=(0, 6, 0))
    bpy.context.object.name = "Sheet"
    bpy.context.object.data.splines[0].resolution_u = bpy.context.object.data.splines[0].resolution_v = 2


def build():
    """One of each kind and a twin that shares its curve, in the sun from straight above; a wire without faces; a floor."""
    curve("Text", "FONT", body="GI").location.y = 4.0
    twin = strip().copy()
    twin.name, twin.location.y = "Twin", -3.0
    linked(twin)
    curve("Wire").data.splines.new("POLY").points.add(1)
    balls()
    sheet()
    mesh(*SQUARE, name="floor").location = (0, 0, -5)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()


def asked(target="texture", **more):
    return baking.request("path_tracing", target, **{"resolution": 16, "values": {"samples": 1, "max_length": 1}, **more})


def made_of():
    """Our objects by the name of what they were made of."""
    return {real.maker_name(o): o for o in real.objects_of(bpy.context.scene)}


def visible():
    bpy.context.view_layer.update()
    return {o.name for o in bpy.context.view_layer.objects if o.visible_get()}


def faces(world):
    return sorted(map(tuple, np.round(world.scene.vertices[world.scene.triangles].reshape(-1, 9), 5).tolist()))


def clear():
    results.restore(bpy.context.scene)
    remove_results(bpy.context.scene)


def counts():
    return len(bpy.data.objects), len(bpy.data.meshes), len(bpy.data.images)


@pytest.mark.parametrize("target", ["texture", "atlas", "attribute", "new object"])
def test_each_is_baked_shown_in_its_place_renewed_and_taken_back(registered, target):
    build()
    scene, before, seen = bpy.context.scene, user_data(), visible()
    state = quick(scene, "path_tracing")
    state.target = "texture" if target in ("texture", "atlas") else "attribute"
    state.atlas, state.new_object, state.selection_only = target == "atlas", target == "new object", False
    state.resolution = 64 if target == "atlas" else 16
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    made, bake = made_of(), BAKES.job.bake
    beside = {"floor GI"} if target == "new object" else set()
    assert set(made) == set(WHOLE) and visible() == seen | beside, "hidden until it is shown"
    assert {n for notice in bake.notices if "an object of its own" in notice.reason for n in notice.names} == set(WHOLE)
    if state.target == "attribute":
        assert all(linked_attribute(o, "irradiance") for o in made.values())
    if state.target == "texture":
        assert len({linked_image(o, "irradiance") for o in made.values()}) == (1 if target == "atlas" else len(WHOLE))
        assert {row["object"] for row in report.of_bake(bake)["lightmaps"]} == {*WHOLE, "floor"}
    plain, count = faces(bake.driver.world), counts()
    assert results.show(scene) == len(WHOLE) + 1
    assert not visible() & set(WHOLE) and len(visible() - seen) >= len(WHOLE)
    assert not [i for i in bpy.context.evaluated_depsgraph_get().object_instances if i.is_instance], "nothing is seen twice"
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    assert counts() == count and faces(BAKES.job.bake.driver.world) == plain, "renewed while it is shown, not piled up"
    results.restore(scene)
    assert visible() == seen | beside
    clear()
    BAKES.forget()
    assert user_data() == before


def test_light_is_that_of_the_sun_and_of_the_shade():
    """From straight above: its irradiance on all that is level, none below a black roof."""
    build()
    roof = mesh(*SQUARE, name="roof")
    roof.location, roof.scale = (1, -3, 3), (1.5, 0.6, 1)
    found = {
        name: baked.values[baked.share > 0].mean()
        for name, baked in baking.lightmaps(asked(values={"samples": 4, "max_length": 1})).items()
    }
    assert found["Text"] == pytest.approx(SUN, rel=1e-3) == found["Cable"] and found["Twin"] == 0.0
    assert 0.7 * SUN < found["Sheet"] < SUN and 0.1 * SUN < found["Ball"] < 0.7 * SUN


def test_the_cable_of_the_test_room_is_baked():
    room.build(extras=False)
    made = baking.lightmaps(asked(objects=("Cable",), values={"samples": 8, "max_length": 3}))
    covered = made["Cable"].share > 0
    assert covered.sum() > 40 and made["Cable"].values[covered].mean() > 0.05


def test_what_has_changed_is_renewed_and_what_is_gone_goes():
    build()
    baking.bake(asked())
    known = {name: o.session_uid for name, o in made_of().items()}
    bpy.data.objects["Cable"].name = "Rope"
    bpy.data.objects["Rope"].location.z = 1.0
    bpy.data.objects.remove(bpy.data.objects["Sheet"])
    bpy.data.objects["Text"].data.body = "Adjoint"
    bpy.context.view_layer.update()
    baking.bake(asked())
    now = made_of()
    assert set(now) == {"Rope", "Twin", "Text", "Ball"} and now["Rope"].session_uid == known["Cable"]
    assert now["Rope"].matrix_world.translation.z == 1.0 and len(now["Text"].data.polygons) > 40
    assert len(bpy.data.meshes) == 5, "what is gone leaves no orphans"
    bpy.data.objects.remove(bpy.data.objects["Rope"])
    converted = bpy.data.objects.new("Twin Mesh", bpy.data.meshes.new_from_object(bpy.data.objects["Twin"]))
    bpy.data.objects.remove(bpy.data.objects["Twin"])
    linked(converted)
    bpy.context.view_layer.update()
    assert len(baking.lightmaps(asked())) == 4 and set(made_of()) == {"Text", "Ball"}


def test_a_saved_file_knows_them_again(tmp_path):
    build()
    baking.bake(asked())
    before = counts()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    baking.bake(asked())
    assert set(made_of()) == set(WHOLE) and counts() == before


def test_a_refused_bake_and_a_check_leave_nothing(monkeypatch):
    build()
    before = user_data()
    checked, said = preflight(bpy.context, asked()), rehearse(bpy.context, asked())
    assert user_data() == before
    ours = [{(name, n.reason) for n in notices if "an object of its own" in n.reason for name in n.names} for notices in (checked, said)]
    assert ours[0] == ours[1] and len(ours[0]) == len(WHOLE)
    with monkeypatch.context() as patch, pytest.raises(AdjointError, match="do not fit"):
        patch.setattr("adjgi.adjoint_gi.bridge.baking.textures.rasterize", refuse)
        Bake(bpy.context, asked())
    assert user_data() == before


def refuse(*args, **more):
    raise AdjointError("Texels", "do not fit", "")


def test_named_ones_are_baked_alone_a_metaball_by_any_of_its_family(tmp_path):
    build()
    assert sorted(baking.lightmaps(asked(objects=("Ball.002", "Ball", "Cable")))) == ["Ball", "Cable"]
    with pytest.raises(AdjointError, match="gives no faces"):
        Bake(bpy.context, asked(objects=("Wire",)))
    clear()
    arguments = ["bake", "--objects", "Text", "--resolution", "8", "--set", "samples=1", "--output", str(tmp_path)]
    assert cli.main(arguments, in_blender=True) == 0
    assert list(tmp_path.glob("Text_irradiance-*.exr"))


def test_a_scene_of_nothing_else_is_checked_and_baked():
    strip()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    assert not [n for n in preflight(bpy.context, asked()) if n.severity == "error"]
    assert list(baking.lightmaps(asked())) == ["Cable"]


def test_selected_ones_are_baked_also_when_they_are_shown(registered):
    build()
    scene = bpy.context.scene
    state = quick(scene, "path_tracing")
    state.resolution, state.target, state.selection_only = 8, "attribute", True
    for obj in scene.objects:
        obj.select_set(obj.name in ("Ball.001", "Cable", "Wire"))
    assert results.selected(bpy.context.view_layer) == ("Cable", "Wire", "Ball")
    bpy.data.objects["Wire"].select_set(False)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    assert set(made_of()) == {"Cable", "Ball"}
    assert results.show(scene) == 2
    for obj in scene.objects:
        obj.select_set(obj == made_of()["Cable"])
    assert results.selected(bpy.context.view_layer) == ("Cable",)
    BAKES.forget()


def test_a_density_of_a_curve_counts_for_what_is_made_of_it(registered):
    build()
    bpy.data.objects["Cable"].adjoint_gi_density = 2.0
    bake = baking.bake(asked(texels_per_metre=16.0, resolution=256))
    got = {row["object"]: row["texels_per_metre"] for row in report.of_bake(bake)["lightmaps"]}
    assert got["Cable"] == pytest.approx(2.0 * got["Twin"], rel=0.1)


def test_instances_of_a_text_are_instances():
    """They are baked on request, and the text itself, which is not in the scene, is not."""
    props = collection("words", in_scene=False)
    word = bpy.data.curves.new("word", "FONT")
    word.body = "I"
    props.objects.link(bpy.data.objects.new("word", word))
    for k in range(2):
        empty(f"place {k}", props).location.x = 5.0 * k
    strip()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    assert list(baking.lightmaps(asked())) == ["Cable"]
    assert [name[:12] for name in sorted(baking.lightmaps(asked(instances=True)))] == ["Cable", "word[place 0", "word[place 1"]
    assert list(baking.lightmaps(asked())) == ["Cable"] and len(real.objects_of(bpy.context.scene)) == 3


def test_a_curve_that_makes_instances_stays_where_only_it_is_baked(registered):
    """Hiding it would hide what it makes."""
    host = strip("Host")
    nodes(host, obj=mesh(*SQUARE, name="leaf"), scatter=True, join=True)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    assert "Host" in baking.lightmaps(asked())
    bpy.context.scene.adjoint_gi.result.target, bpy.context.scene.adjoint_gi.result.quantity = "texture", "irradiance"
    results.show(bpy.context.scene)
    assert "Host" in visible() and "Host GI" not in visible()


def test_what_nodes_of_a_curve_make_is_no_curve():
    """Baked again and again the curve is one object; with Bake Instances each square of its nodes is another."""
    nodes(strip("Host"), scatter=True, join=True)
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    bpy.context.view_layer.update()
    for _ in range(2):
        assert list(baking.lightmaps(asked())) == ["Host"] and len(real.objects_of(bpy.context.scene)) == 1
    made = baking.lightmaps(asked(instances=True))
    assert sorted(made) == ["Host", *(f"Host[Host.0.{k}.1]" for k in range(4))]
    assert [len(o.data.polygons) for o in real.objects_of(bpy.context.scene) if not real.is_whole(o)] == [1] * 4


def test_a_comparison_has_them_baked_by_cycles():
    """Where each stands in for what it was made of, which would shadow it."""
    if not hasattr(bpy.types.Scene, "cycles"):
        pytest.skip("this Blender has no Cycles")
    build()
    paint = bpy.data.materials.new("Paint")
    if paint.node_tree is None:
        paint.use_nodes = True
    for name in (*WHOLE, "floor"):
        bpy.data.objects[name].data.materials.append(paint)
    bpy.context.view_layer.update()
    before = user_data()
    made = Compare(bpy.context, CompareRequest(("path_tracing",), reference=ReferenceChoice("cycles", samples=8), resolution=16))
    reference = made.driver.solver.reference
    mean = {s.name: reference.values[s.part][reference.valid[s.part]].mean() for s in made.sheets}
    assert set(mean) == {*WHOLE, "floor"} and not [n for n in made.notices if n.severity != "info"]
    assert all(mean[name] == pytest.approx(SUN, rel=0.01) for name in ("Text", "Cable", "Twin"))
    assert 0.1 * SUN < mean["Ball"] < 0.7 * SUN < mean["Sheet"] < SUN
    clear()
    assert user_data() == before


@pytest.mark.parametrize("instances", [False, True])
def test_renew_makes_the_uvs_of_what_a_bake_makes_objects_of(registered, instances):
    props = collection("props", in_scene=False)
    leaf = bpy.data.objects.new("leaf", bpy.data.meshes.new("leaf"))
    leaf.data.from_pydata(*SQUARE[:1], [], SQUARE[1])
    props.objects.link(leaf)
    empty("place", props).location.x = 9.0
    strip()
    add_light("SUN", energy=SUN, angle=0.0, location=(0, 0, 9))
    state = quick(bpy.context.scene, "path_tracing")
    state.resolution, state.selection_only, state.instances = 16, False, instances
    names = {"Cable GI", "leaf[place.0]"} if instances else {"Cable GI"}
    assert bpy.ops.adjoint_gi.renew_uvs() == {"FINISHED"}
    made = real.objects_of(bpy.context.scene)
    assert {o.name for o in made} == names and all(own_layer(o) for o in made)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    for obj in made:
        obj.data.uv_layers[own_layer(obj)].uv.foreach_set("vector", np.zeros(2 * len(obj.data.loops), np.float32))
    bpy.data.objects["Cable"].data.bevel_depth *= 2
    leaf.data.vertices[0].co.z = 0.5
    bpy.context.view_layer.update()
    assert bpy.ops.adjoint_gi.renew_uvs() == {"FINISHED"}
    assert real.objects_of(bpy.context.scene) == made
    assert not [block for kind in (bpy.data.meshes, bpy.data.objects) for block in kind if not block.users], "what is replaced goes"
    assert all(np.ptp([tuple(x.vector) for x in o.data.uv_layers[own_layer(o)].uv]) > 0.3 for o in made)
    BAKES.forget()


def test_damaged_properties_of_ours_count_as_absent():
    build()
    baking.bake(asked())
    made_of()["Cable"][stored.REAL]["kind"] = 3
    baking.bake(asked())
    assert set(made_of()) == set(WHOLE)


@pytest.mark.parametrize("hidden", (False, True))
def test_a_copy_of_what_was_made_of_a_curve_is_the_users(hidden, registered):
    """Once renders show it, it is baked with its own mesh; the curve keeps its object, and Clear Results takes only that."""
    strip()
    add_light("SUN", energy=SUN, angle=0.0)
    ask = baking.request(resolution=16, values={"samples": 1})
    baking.bake(ask)
    (made,) = real.objects_of(bpy.context.scene)
    copy = made.copy()
    copy.data, copy.name, copy.location.y, copy.hide_render, copy.hide_viewport = made.data.copy(), "mine", 5.0, hidden, False
    made.users_collection[0].objects.link(copy)
    told = baking.bake(ask).notices
    assert real.objects_of(bpy.context.scene) == [made]
    assert hidden or linked_image(copy, "irradiance") not in (None, linked_image(made, "irradiance"))
    assert not hidden or linked_image(copy, "irradiance") is None
    assert [n.object for n in told if "on an object of its own" in n.reason] == ["Cable"]
    remove_results(bpy.context.scene)
    assert {o.name for o in bpy.data.objects if o.type == "MESH"} == {"mine"}


@pytest.mark.parametrize("kind", ("mesh", "nodes", "line"))
def test_what_gives_no_faces_gets_a_remedy_that_fits(kind, registered):
    """A bevel is for curves, and not for a mesh or a curve whose nodes make a curve."""
    add_light("SUN", energy=SUN)
    mesh(*SQUARE, name="good")
    host = mesh(*SQUARE, name="Odd") if kind == "mesh" else strip("Odd")
    if kind == "line":
        host.data.extrude = 0.0
    else:
        tree = bpy.data.node_groups.new("wire", "GeometryNodeTree")
        for way in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
        start, end, line = (tree.nodes.new(k) for k in ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeCurvePrimitiveLine"))
        tree.links.new(line.outputs[0], end.inputs[0])
        host.modifiers.new("wire", "NODES").node_group = tree
    told = [n for n in preflight(bpy.context, asked()) if n.object == "Odd" and "gives no faces" in n.reason]
    assert [n.remedy.split()[0] for n in told] == ["Give" if kind == "line" else "Have"]


def test_a_curve_whose_instances_are_baked_is_not_said_to_have_no_faces(registered):
    source = collection("source", in_scene=False)
    made = strip()
    bpy.context.scene.collection.objects.unlink(made)
    source.objects.link(made)
    empty("host", source)
    add_light("SUN", energy=SUN)
    for told in (rehearse(bpy.context, asked(instances=True)), baking.bake(asked(instances=True)).notices):
        assert any("baked as an object of its own" in n.reason for n in told)
        assert not any("no faces" in n.reason for n in told)
