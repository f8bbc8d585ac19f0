# SPDX-License-Identifier: GPL-3.0-or-later
"""Mixed shaders to lobes: mixing changes weights, never the colours of which Fresnel's terms are computed; coats keep their bases."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.tests import baking
from adjgi.tests.blender.test_extract_colors import Graph, both, pattern, silent
from adjgi.tests.cycles_patch import empty_material, rendered, white_plane

PRINCIPLED, DIFFUSE = "ShaderNodeBsdfPrincipled", "ShaderNodeBsdfDiffuse"
WHITE, BLACK, GOLD = (1, 1, 1, 1), (0, 0, 0, 1), (0.9, 0.6, 0.3, 1)


def shader(material, kind, **values):
    node = material.node_tree.nodes.new(kind)
    for key, value in values.items():
        node.inputs[key.replace("_", " ")].default_value = value
    return node.outputs[0]


def joined(material, first, second, factor=None):
    """The output of a Mix Shader, or without a factor of an Add Shader."""
    node = material.node_tree.nodes.new("ShaderNodeAddShader" if factor is None else "ShaderNodeMixShader")
    sockets = list(node.inputs)[-2:]
    if factor is not None:
        node.inputs[0].default_value = factor
    for source, socket in zip((first, second), sockets, strict=True):
        material.node_tree.links.new(source, socket)
    return node.outputs[0]


def arrays_of(material, output):
    material.node_tree.links.new(output, material.node_tree.nodes["Material Output"].inputs["Surface"])
    white_plane(2.0, material)
    return extract(bpy.context.evaluated_depsgraph_get())


def albedo(arrays, degrees, n=100_000):
    """(3,) share of uniform light that is sent towards an angle from the normal, and its standard error."""
    angle = np.radians(degrees)
    up, wo = (np.tile(np.float32(w), (n, 1)) for w in ((0, 0, 1), (np.sin(angle), 0, np.cos(angle))))
    at = np.zeros(n, np.int32), np.full(n, 0.3, np.float32), np.full(n, 0.3, np.float32)
    weight = bsdf.sample(
        bsdf.BsdfTable(arrays, straight=True).at(*at, up, np.ones(n, np.float32), wo), np.random.default_rng(1)
    ).weight.astype(float)
    return weight.mean(axis=0), weight.std(axis=0) / np.sqrt(n)


def test_nested_mixes_multiply_weights_and_leave_colours():
    m = empty_material("m")
    metal = shader(m, PRINCIPLED, Base_Color=GOLD, Metallic=1.0, Roughness=0.3)
    inner = joined(m, shader(m, DIFFUSE, Color=WHITE), metal, 0.5)
    outer = joined(m, inner, metal, 0.2)
    found = {x.kind: x for x in arrays_of(m, outer).materials[0].lobes}
    assert set(found) == {"diffuse", "metallic"}
    assert found["metallic"].color.constant == pytest.approx(GOLD[:3]) and found["metallic"].weight == pytest.approx(0.4 + 0.2)
    assert found["diffuse"].share.constant == pytest.approx((0.4,) * 3)


@pytest.mark.parametrize("degrees", [0, 60, 87])
@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_half_diffuse_half_metal_makes_no_light(degrees, roughness):
    """In a furnace of 1; it was 1.39 and 1.17 at 3 degrees from the surface."""
    m = empty_material("m")
    metal = shader(m, PRINCIPLED, Base_Color=WHITE, Metallic=1.0, Roughness=roughness)
    found, error = albedo(arrays_of(m, joined(m, shader(m, DIFFUSE, Color=WHITE), metal, 0.5)), degrees)
    assert (np.abs(found - 1.0) < 5 * error + 0.01).all()


def test_black_metal_is_kept():
    m = empty_material("m")
    (lobe,) = arrays_of(m, shader(m, PRINCIPLED, Base_Color=BLACK, Metallic=1.0, Roughness=0.3)).materials[0].lobes
    assert lobe.kind == "metallic" and lobe.color.is_black and lobe.weight == 1.0


METALLIC = "ShaderNodeBsdfMetallic"
TINTED = {
    "principled": (PRINCIPLED, {"Base_Color": GOLD, "Metallic": 1.0, "Specular_Tint": (0.2, 0.4, 0.9, 1)}),
    "metallic": (METALLIC, {"Base_Color": GOLD, "Edge_Tint": (0.2, 0.4, 0.9, 1)}),
    "dark": (METALLIC, {"Base_Color": (0.02, 0.0, 0.1, 1), "Edge_Tint": (0.0, 0.0, 0.2, 1)}),
    "beyond white": (PRINCIPLED, {"Base_Color": (0.3, 0.3, 0.3, 1), "Metallic": 1.0, "Specular_Tint": (1.5, 3.0, 0.5, 1)}),
    "half": (PRINCIPLED, {"Base_Color": GOLD, "Metallic": 0.5, "Specular_Tint": (0.2, 0.4, 0.9, 1), "Specular_IOR_Level": 0.0}),
}


@pytest.mark.parametrize("degrees", [0, 60, 75, 82])
@pytest.mark.parametrize("name", TINTED)
def test_metals_with_tinted_edges_reflect_what_they_do_in_cycles(name, degrees):
    """A plane in an even white world: mirrors to four digits, rough metals within noise and what multiple bounces are apart."""
    kind, values = TINTED[name]
    if not hasattr(bpy.types, kind):
        pytest.skip("this Blender has no Metallic BSDF node (4.3 and later)")
    for roughness, distribution, apart in ((0.0, "GGX", 1e-4), (0.3, "GGX", 2e-3), (0.5, "MULTI_GGX", 0.02)):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        m = empty_material("m")
        output = shader(m, kind, **values, Roughness=roughness)
        output.node.distribution = distribution
        arrays = arrays_of(m, output)
        assert not [n for n in arrays.warnings if "Material" in n.object]
        found, error = albedo(arrays, degrees)
        theirs, spread = seen_by_cycles(degrees, 512 if roughness else 4)
        limit = apart + 5 * np.hypot(error, spread)
        assert (np.abs(found - theirs) < limit).all(), (roughness, found, theirs, limit)


def seen_by_cycles(degrees, samples):
    """(3,) radiance of the plane in a white world, and the standard error of that."""
    scene, angle = bpy.context.scene, np.radians(degrees)
    scene.world = bpy.data.worlds.new("white")
    demo.black_world(scene.world, (1.0, 1.0, 1.0))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (0.5 * np.sin(angle), 0, 0.5 * np.cos(angle)), (0, angle, 0)
    camera.data.type, camera.data.ortho_scale, camera.data.clip_start = "ORTHO", 1e-3, 1e-3
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.resolution_percentage = 100
    baking.use_cycles(scene, 3)
    scene.cycles.samples, scene.cycles.blur_glossy = samples, 0.0
    scene.cycles.caustics_reflective = True
    pixels = rendered(8).astype(np.float64).reshape(-1, 3)
    return pixels.mean(axis=0), pixels.std(axis=0) / 8


def test_a_white_tint_leaves_a_metal_as_it_was():
    """Of Principled, which has it by default; and the Metallic node with a white edge is that metal, too."""
    m = empty_material("m")
    (lobe,) = arrays_of(m, shader(m, PRINCIPLED, Base_Color=GOLD, Metallic=1.0, Roughness=0.3)).materials[0].lobes
    assert lobe.kind == "metallic" and lobe.edge.constant == (1.0, 1.0, 1.0)
    if hasattr(bpy.types, METALLIC):
        m = empty_material("n")
        (same,) = arrays_of(m, shader(m, METALLIC, Base_Color=GOLD, Edge_Tint=WHITE, Roughness=0.3)).materials[-1].lobes
        assert dataclasses.replace(same, multiscatter=lobe.multiscatter) == lobe


def test_a_tint_may_be_an_image():
    g = Graph()
    image = g.image(interpolation="Closest")
    white_plane(2.0, g.material)
    metal = g.add(PRINCIPLED, None, {"Specular Tint": image.outputs["Color"]})
    metal.inputs["Base Color"].default_value, metal.inputs["Metallic"].default_value = GOLD, 1.0
    g.link(metal.outputs[0], g.tree.nodes["Material Output"].inputs["Surface"])
    (lobe,) = extract(bpy.context.evaluated_depsgraph_get()).materials[0].lobes
    assert lobe.kind == "tinted metallic" and [s.kind for t in lobe.edge.terms for s in t.sources] == ["image"]


@pytest.mark.parametrize("name", ["Alpha", "Metallic", "Transmission_Weight"])
@pytest.mark.parametrize("degrees", [30, 80])
def test_white_principled_loses_and_makes_nothing_whatever_its_parts(name, degrees):
    m = empty_material("m")
    values = {"Base_Color": WHITE, "Roughness": 0.0, name: 0.5}
    found, error = albedo(arrays_of(m, shader(m, PRINCIPLED, **values)), degrees)
    assert (np.abs(found - 1.0) < 5 * error + 0.004).all()


def test_two_principled_keep_their_coats_apart():
    """A tenth of one below a coat: the rest, bare, stays as it is."""
    m = empty_material("m")
    first = shader(m, PRINCIPLED, Base_Color=GOLD, Roughness=0.5, Specular_IOR_Level=0.0)
    second = shader(m, PRINCIPLED, Base_Color=WHITE, Roughness=0.0, IOR=1.5)
    arrays = arrays_of(m, joined(m, first, second, 0.1))
    stacks = {x.kind: x.stack for x in arrays.materials[0].lobes if x.color.constant == (1.0, 1.0, 1.0)}
    assert stacks["specular"] > 0
    below = [x for x in arrays.materials[0].lobes if x.kind == "diffuse" and x.stack == stacks["specular"]]
    assert [x.share.constant for x in below] == [pytest.approx((0.1,) * 3)]
    found, error = albedo(arrays, 80)
    assert (np.abs(found - (0.9 * np.array(GOLD[:3]) + 0.1)) < 5 * error + 0.002).all()


def test_added_shaders_are_scaled_down_with_their_coats():
    """Two white Principled nodes would send back twice what arrives."""
    m = empty_material("m")
    nodes = [shader(m, PRINCIPLED, Base_Color=WHITE, Roughness=r) for r in (0.2, 0.4)]
    found, error = albedo(arrays_of(m, joined(m, *nodes)), 75)
    assert (np.abs(found - 1.0) < 5 * error + 0.01).all()


@pytest.mark.parametrize("user", ["ShaderNodeMixShader", "ShaderNodeMix", "ShaderNodeBsdfPrincipled"])
@pytest.mark.parametrize(("factor", "added"), [(0.0, 1.5), (0.0, -0.5), (3.0, -1.0), (-2.0, 1.3)])
def test_shares_beyond_0_and_1_are_clamped(user, factor, added):
    """A constant, and a texture times a number plus another, as the factor of two colours or as the alpha of one that is emitted."""
    g = Graph()
    image = g.image(interpolation="Closest")
    share = g.add("ShaderNodeMath", None, {"Value": image.outputs["Color"]}, operation="MULTIPLY_ADD")
    share.inputs[1].default_value, share.inputs[2].default_value = factor, added
    kinds = {"ShaderNodeMixShader": {}, "ShaderNodeMix": {"data_type": "RGBA"}, "ShaderNodeBsdfPrincipled": {}}
    made = g.add(user, **kinds[user])
    g.link(share.outputs[0], made.inputs["Alpha"] if "Principled" in user else made.inputs[0])
    colors = (0.9, 0.5, 0.1, 1), (0.1, 0.3, 0.8, 1)
    if user == "ShaderNodeMix":
        for socket, color in zip([s for s in made.inputs if s.type == "RGBA"], colors, strict=True):
            socket.default_value = color
        g.show(next(s for s in made.outputs if s.type == "RGBA"))
    elif user == "ShaderNodeMixShader":
        for socket, color in zip(list(made.inputs)[1:], colors, strict=True):
            g.link(g.add("ShaderNodeEmission", values={"Color": color}).outputs[0], socket)
        g.link(made.outputs[0], g.tree.nodes["Material Output"].inputs["Surface"])
    else:
        made.inputs["Base Color"].default_value, made.inputs["Specular IOR Level"].default_value = (0, 0, 0, 1), 0.0
        made.inputs["Emission Color"].default_value, made.inputs["Emission Strength"].default_value = colors[0], 1.0
        g.link(made.outputs[0], g.tree.nodes["Material Output"].inputs["Surface"])
    assert silent(both(g, atol=6e-3))


@pytest.mark.parametrize(("gain", "told"), [(1.0, False), (3.0, True)])
def test_a_share_of_two_images_is_told_only_where_it_leaves_0_to_1(gain, told):
    """Neither that nor a mix of both by a third one can be clamped; one that needs it not is as in Cycles."""
    g = Graph()
    first, second = (g.image(pattern(seed=seed), interpolation="Closest").outputs["Color"] for seed in (2, 3))
    product = g.add("ShaderNodeMath", operation="MULTIPLY")
    for source, socket in zip((first, second), product.inputs, strict=False):
        g.link(source, socket)
    scaled = g.add("ShaderNodeMath", None, {"Value": product.outputs[0]}, operation="MULTIPLY_ADD")
    scaled.inputs[1].default_value, scaled.inputs[2].default_value = gain, 0.0
    mix = g.add("ShaderNodeMix", None, {"Factor": scaled.outputs[0], "A": first, "B": second}, data_type="RGBA")
    g.show(next(s for s in mix.outputs if s.type == "RGBA"))
    if not told:
        assert silent(both(g, atol=6e-3))
        return
    white_plane(2.0, g.material)
    (notice,) = [n for n in extract(bpy.context.evaluated_depsgraph_get()).warnings if n.severity != "info"]
    assert "beyond 0 to 1" in notice.reason and "not clamped" in notice.reason
