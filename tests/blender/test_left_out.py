# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake of everything never fails for one object: it is left out, or its result goes to an object of its own, and a line names it.

`check` says what `bake` says, because it does the same and takes it back; a refused bake has changed nothing.
"""

from __future__ import annotations

import bpy
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake, rehearse
from adjgi.adjoint_gi.bridge.baking.preflight import SEPARATE, preflight
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.results import show
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute, result_object
from adjgi.adjoint_gi.bridge.results.image import linked_image
from adjgi.adjoint_gi.bridge.results.remove import remove_results
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.tests import baking
from adjgi.tests.cycles_patch import add_light, shader_material
from adjgi.tests.hostile import CUBE, SQUARE, mesh

QUICK = {"samples": 1, "max_length": 2}


def scene(count=3):
    """Good objects and a sun."""
    add_light("SUN", energy=2.0, angle=0.0)
    made = [mesh(*SQUARE, name=f"good {k}") for k in range(count)]
    for k, obj in enumerate(made):
        obj.location.x = 3.0 * k
    return made


def request(target="texture", **more):
    return baking.request(target=target, values=QUICK, **{"resolution": 16, **more})


def without_layer(_):
    """Has no UV layer of the name that the bake asks for."""
    mesh(*SQUARE, name="bad").location.y = 3


def in_edit_mode(_):
    bad = mesh(*SQUARE, name="bad")
    bpy.context.view_layer.objects.active = bad
    bpy.ops.object.mode_set(mode="EDIT")


def too_many_islands(_):
    """Has more islands than an image of 16 texels a side can keep apart."""
    points, faces = [], []
    for k in range(400):
        points += [(k % 20 * 2 + x, k // 20 * 2 + y, k % 7) for x, y, _ in SQUARE[0]]
        faces.append(tuple(range(4 * k, 4 * k + 4)))
    mesh(points, faces, "bad")


@pytest.mark.parametrize(("spoil", "more"), [(without_layer, {"uv_layer": "Mine"}), (in_edit_mode, {}), (too_many_islands, {})])
def test_one_object_that_cannot_receive_is_left_out_and_named(spoil, more):
    for obj in (objects := scene()):
        if "uv_layer" in more:
            obj.data.uv_layers.new(name=more["uv_layer"])
    spoil(objects)
    bpy.context.view_layer.update()
    before = baking.fingerprint()
    said = rehearse(bpy.context, request(**more))
    assert baking.fingerprint() == before and not [n for n in said if n.severity == "error"]
    lines = [n for n in said if "in the light, but not baked" in n.reason]
    assert [n.object for n in lines] == ["bad"] and lines[0].severity == "warning"
    made = baking.bake(request(**more))
    assert [n for n in made.notices if n.severity == "warning"] == [n for n in said if n.severity == "warning"]
    assert all(linked_image(o, "irradiance") for o in objects) and linked_image(bpy.data.objects["bad"], "irradiance") is None
    with pytest.raises(AdjointError, match="bad: "):
        Bake(bpy.context, request(objects=("bad",), **more))


def test_attributes_that_meshes_cannot_hold_go_to_objects_of_their_own(registered):
    """Modifiers that add vertices, linked duplicates; and Show Result finds all of them."""
    plain, array, one = scene()
    array.modifiers.new("Array", "ARRAY").count = 3
    twin = one.copy()
    bpy.context.scene.collection.objects.link(twin)
    twin.name, twin.location.y = "twin", 3
    bpy.context.view_layer.update()
    before = baking.fingerprint()
    made = baking.bake(request("attribute"))
    told = [n for n in made.notices if "goes to an object of its own" in n.reason]
    assert {name for n in told for name in n.names} == {array.name, one.name, "twin"} and made.request.separate
    assert linked_attribute(plain, "irradiance") and result_object(plain) is None
    for obj in (array, one, twin):
        held = result_object(obj)
        assert linked_attribute(obj, "irradiance") is None and linked_attribute(held, "irradiance")
    assert len(result_object(array).data.vertices) == 12 and len(array.data.vertices) == 4
    record = bpy.context.scene.adjoint_gi.result
    record.target, record.quantity = "attribute", "irradiance"
    assert show.show(bpy.context.scene) == 4
    show.restore(bpy.context.scene)
    remove_results(bpy.context.scene)
    assert baking.fingerprint() == before


def test_a_bake_that_the_method_refuses_leaves_no_layer_behind(tmp_path, capsys):
    """Matrix radiosity sees how much memory it needs only when it has made its elements."""
    add_light("SUN", energy=2.0)
    mesh([(10 * x, 10 * y, 10 * z) for x, y, z in CUBE[0]], CUBE[1])
    bpy.context.view_layer.update()
    before = baking.fingerprint()
    common = ["--method", "matrix_radiosity", "--set", "max_edge=0.2", "--set", "memory_limit=1", "--resolution", "16"]
    codes = [cli.main([command, *common, "--output", str(tmp_path)], in_blender=True) for command in ("check", "bake")]
    assert codes == [2, 2] and "over its limit" in capsys.readouterr().err
    assert baking.fingerprint() == before and not bpy.data.objects["bad"].data.uv_layers and not bpy.data.objects["bad"].modifiers


@pytest.mark.parametrize("by", ("UV layer", "vertex group", "byte colour"))
def test_check_and_bake_say_the_same_of_a_name_that_is_taken(by, registered):
    """The result is there under another name, and the next bake says it no more, nor makes another."""
    obj = mesh(*SQUARE, name="floor")
    add_light("SUN", energy=2.0)
    if by == "UV layer":
        obj.data.uv_layers.new(name="AdjointGI")
    elif by == "vertex group":
        obj.vertex_groups.new(name="AdjointGI")
    else:
        obj.data.color_attributes.new("AdjointGI", "BYTE_COLOR", "POINT")
    ask = baking.request(target="attribute", values={"samples": 1})
    for count in (1, 0):
        checked = rehearse(bpy.context, ask)
        made = baking.bake(ask)
        for told in (checked, made.notices):
            assert [(n.object, n.severity) for n in told if 'something else called "AdjointGI"' in n.reason] == count * [
                ("floor", "warning")
            ]
        assert made.written == ["attribute AdjointGI.001 of floor"]


def test_objects_with_modifiers_of_any_name_are_one_line():
    for k, obj in enumerate(scene()):
        obj.modifiers.new(f"Thick {k}", "SOLIDIFY")
    (told,) = [n for n in preflight(bpy.context, request("attribute")) if "change its vertices" in n.reason]
    assert told.names == ("good 0", "good 1", "good 2") and SEPARATE in told.reason


NAN = float("nan")


def bevelled(name):
    """A curve with faces."""
    data = bpy.data.curves.new(name, "CURVE")
    data.dimensions, data.bevel_depth = "3D", 0.1
    line = data.splines.new("POLY")
    line.points.add(1)
    line.points[1].co = (1, 0, 0, 1)
    made = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(made)
    return made


def flat(obj):
    obj.scale.z = 0


def nowhere(obj):
    obj.location.x = NAN


def mist(obj):
    material = shader_material("mist", "ShaderNodeVolumeScatter")
    tree = material.node_tree
    volume, output = (next(n for n in tree.nodes if n.type == kind) for kind in ("VOLUME_SCATTER", "OUTPUT_MATERIAL"))
    tree.links.clear()
    tree.links.new(volume.outputs[0], output.inputs["Volume"])
    obj.data.materials.append(material)


def no_numbers(obj):
    if obj.type == "MESH":
        obj.data.vertices.foreach_set("co", [NAN] * 3 * len(obj.data.vertices))
        obj.data.update()
    else:
        obj.data.splines[0].points[1].co.x = NAN


@pytest.mark.parametrize("target", ("texture", "attribute"))
@pytest.mark.parametrize("kind", ("mesh", "full mesh", "curve"))
@pytest.mark.parametrize("spoil", (flat, nowhere, mist, no_numbers))
def test_what_is_left_out_is_told_why_and_nothing_of_what_would_be_made(spoil, kind, target, registered):
    """No lightmap layer, no object of its own, no other reason: that a curve with a bevel needs one, for example."""
    scene(1)
    bad = bevelled("bad") if kind == "curve" else mesh(*SQUARE, name="bad")
    for k in range(8 if kind == "full mesh" else 0):
        bad.data.uv_layers.new(name=f"theirs {k}")
        bad.data.attributes.new(f"AdjointGI {k}" if k else "AdjointGI", "FLOAT", "POINT")
    spoil(bad)
    bpy.context.view_layer.update()
    for look in (preflight, rehearse):
        said = look(bpy.context, request(target))
        reasons = [n.reason for n in said if "bad" in (n.names or (n.object,))]
        assert [r for r in reasons if "left out" in r] and len(reasons) <= 2, reasons
        made = (SEPARATE, "is made", "made anew", "gets a number", "gives no faces")
        assert not [r for r in reasons if any(words in r for words in made)], reasons
        assert not [n for n in said if "bevel" in n.remedy]
        assert target == "attribute" or [n for n in said if "one is made" in n.reason and "good 0" in (n.names or (n.object,))]
