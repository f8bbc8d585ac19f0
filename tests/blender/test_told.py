# SPDX-License-Identifier: GPL-3.0-or-later
"""Nothing is absent without a word, and no message says what is not so: volumes, instances, hair, settings of Cycles, remedies."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import bpy
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import preflight
from adjgi.adjoint_gi.bridge.cli.arguments import make_parser
from adjgi.adjoint_gi.bridge.comparison.cycles_reference import coat_notices
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import baking
from adjgi.tests.cycles_patch import add_light, diffuse_material, empty_material, shader_material, white_plane
from adjgi.tests.hostile import CUBE, SQUARE, mesh, put

ROOT = Path(__file__).resolve().parents[2]


def arrays():
    bpy.context.view_layer.update()
    return extract(bpy.context.evaluated_depsgraph_get())


def told(name, words, found=None):
    """The notices about `name` with these words."""
    found = arrays().warnings if found is None else found
    return [n for n in found if words in n.reason and (name in n.names or name in n.object)]


def mist(also_surface=False):
    material = empty_material("mist")
    tree = material.node_tree
    end = tree.nodes["Material Output"]
    tree.links.new(tree.nodes.new("ShaderNodeVolumePrincipled").outputs[0], end.inputs["Volume"])
    if also_surface:
        tree.links.new(tree.nodes.new("ShaderNodeBsdfDiffuse").outputs[0], end.inputs["Surface"])
    return material


# ---- volumes


def test_light_passes_a_material_with_a_volume_and_no_surface():
    """A box of mist between a floor and the sun changes nothing, is named, and has no texels; the same box with a surface shades."""
    floor = mesh(*SQUARE, name="floor")
    floor.data.materials.append(diffuse_material("grey", 0.5))
    box = mesh([(4 * x - 2, 4 * y - 2, z + 0.5) for x, y, z in CUBE[0]], CUBE[1], name="box")
    add_light("SUN", energy=2.0, angle=0.0, location=(0, 0, 9))
    box.data.materials.append(mist())
    bpy.context.view_layer.update()
    request = baking.request(resolution=8, values={"samples": 4, "max_length": 3})
    found = preflight(bpy.context, request)
    assert told("box", "light passes through it", found) and told('Material "mist"', "a volume and no surface", found)
    baked = baking.lightmaps(request)
    assert list(baked) == ["floor"] and baked["floor"].values.mean() == pytest.approx(2.0, rel=1e-4)
    box.data.materials[0] = mist(also_surface=True)
    assert len(arrays().objects) == 2 and told('Material "mist.001"', "light passes inside it as through air")


def test_faces_of_mist_are_taken_from_a_mesh_with_others():
    box = mesh(*CUBE, name="box")
    box.data.materials.append(mist())
    box.data.materials.append(diffuse_material("grey", 0.5))
    box.data.polygons[0].material_index = 1
    a = arrays()
    assert len(a.triangles) == 2 and a.objects[0].corner_count == 24 and set(a.polygon.tolist()) == {0}
    box.scale.x = -1
    assert len(arrays().triangles) == 2


def test_a_volume_has_no_remedy_that_is_meant_for_displacement():
    made = mesh(*CUBE, name="box")
    made.data.materials.append(mist(also_surface=True))
    assert not any("isplace" in n.remedy for n in arrays().warnings)


# ---- instances, hair


def instanced(count=3):
    inner = bpy.data.collections.new("props")
    for name in ("chair", "table"):
        obj = bpy.data.objects.new(name, mesh(*SQUARE, name=name).data)
        bpy.data.objects.remove(bpy.data.objects[name])
        inner.objects.link(obj)
        obj.name = name
    for k in range(count):
        maker = put(None, f"place {k}")
        maker.instance_type, maker.instance_collection, maker.location.x = "COLLECTION", inner, 3.0 * k


def test_instances_are_named_with_their_number():
    mesh(*SQUARE, name="floor")
    add_light("SUN", energy=1.0)
    instanced()
    bpy.context.view_layer.update()
    found = preflight(bpy.context, baking.request(resolution=8))
    lines = told("place 0", "2 instances of chair, table, in the light but not baked", found)
    assert len(lines) == 1 and lines[0].names == ("place 0", "place 1", "place 2"), "equal sentences are one"


def test_what_makes_instances_and_has_no_faces_is_not_called_left_out():
    """Its instances are in the light."""
    points = mesh([(0, 0, 0), (3, 0, 0)], [], "points")
    mesh(*SQUARE, name="child").parent = points
    points.instance_type = "VERTS"
    assert told("points", "what it makes (2 instances) is in the light") and not told("points", "left out")


def test_hair_is_named():
    obj = mesh(*SQUARE, name="scalp")
    obj.modifiers.new("fur", "PARTICLE_SYSTEM")
    obj.particle_systems[0].settings.type = "HAIR"
    assert told("scalp", "has hair")
    put(bpy.data.hair_curves.new("curls"), "curls")
    assert told("curls", "which has no faces, and is left out")


# ---- settings of Cycles


def lamp_bounces():
    add_light("POINT").data.cycles.max_bounces = 0


def world_bounces():
    bpy.context.scene.world = bpy.data.worlds.new("sky")
    bpy.context.scene.world.color = (1, 1, 1)
    bpy.context.scene.world.cycles.max_bounces = 1


def shadow_catcher():
    bpy.data.objects["floor"].is_shadow_catcher = True


def indirect_only():
    bpy.context.scene.collection.children.link(bpy.data.collections.new("aside"))
    bpy.context.view_layer.layer_collection.children["aside"].indirect_only = True


def of_scene(**values):
    def build():
        for name, value in values.items():
            setattr(bpy.context.scene.cycles, name, value)

    return build


def culled():
    bpy.context.scene.render.use_simplify = bpy.context.scene.cycles.use_camera_cull = True


def no_sky():
    bpy.context.view_layer.use_sky = False


SETTINGS = {
    "has Max Bounces 0 in Cycles": lamp_bounces,
    "has Max Bounces 1 in Cycles": world_bounces,
    "a shadow catcher": shadow_catcher,
    "indirect only": indirect_only,
    "limits bounces in Cycles (Total 1, Diffuse 0)": of_scene(max_bounces=1, diffuse_bounces=0),
    "reflective caustics turned off": of_scene(caustics_reflective=False),
    "clamps samples": of_scene(sample_clamp_direct=1.0),
    "clamps samples in Cycles": of_scene(sample_clamp_indirect=1.0),
    "Fast GI": of_scene(use_fast_gi=True),
    "film exposure of 2": of_scene(film_exposure=2.0),
    "Simplify's culling": culled,
    "leaves its world out": no_sky,
}


@pytest.mark.parametrize("words", SETTINGS)
def test_settings_of_cycles_that_change_light_are_named(words):
    mesh(*SQUARE, name="floor")
    assert not [n for n in arrays().warnings if "Cycles" in n.reason or "renders" in n.reason], "nothing is said by default"
    SETTINGS[words]()
    found = [n for n in arrays().warnings if words in n.reason]
    assert len(found) == 1 and found[0].severity == "warning"


# ---- remedies


def texts():
    """All of the code that users get to read, as one."""
    files = [
        *(ROOT / "adjoint_gi").rglob("*.py"),
        *(ROOT / "operators").rglob("*.py"),
        *(ROOT / "panels").rglob("*.py"),
        *(ROOT / "solvers").rglob("*.py"),
    ]
    return "\n".join(path.read_text(encoding="utf-8") for path in files)


def test_flags_that_messages_name_exist():
    parser = make_parser(in_blender=False)
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices.values()
    known = {flag for command in commands for action in command._actions for flag in action.option_strings}
    blender = {"--command", "--python", "--python-expr", "--python-text"}  # Blender's own
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", texts()))
    assert named - known - blender == set()


def test_buttons_that_messages_name_exist(registered):
    """Whatever is to be pressed has an operator of that label."""
    labels = {getattr(bpy.ops.adjoint_gi, name).get_rna_type().name for name in dir(bpy.ops.adjoint_gi)}
    named = re.findall(r"[Pp]ress ((?:[A-Z][a-z]+ ?)+)", texts())
    assert named
    for text in named:
        assert any(text.strip() == label or text.strip().startswith(label) for label in labels), text


@pytest.mark.parametrize(("level", "metallic", "said"), [(0.5, 0.0, True), (0.0, 0.0, False), (0.5, 1.0, False)])
def test_comparisons_with_cycles_name_bases_below_coats(level, metallic, said):
    """Not those without a coat, or a metal's, which has no base."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    white_plane(2.0, shader_material("Paint", "ShaderNodeBsdfPrincipled", Specular_IOR_Level=level, Metallic=metallic))
    found = coat_notices(World(arrays()))
    assert [n.object for n in found] == ["Paint"] * said
