# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials to lobes, their limits, images that cannot be used, and the world."""

from __future__ import annotations

import struct
import zlib

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.cycles_patch import add_light, diffuse_material, empty_material, render_patch, shader_material, white_plane


def lobes_of(material):
    """({kind: lobe}, arrays) of a material on a plane."""
    white_plane(2.0, material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    found = arrays.materials[0].lobes
    assert len({lobe.kind for lobe in found}) == len(found)
    return {lobe.kind: lobe for lobe in found}, arrays


def told(arrays, *words):
    return any(all(w in str(n) for w in words) for n in arrays.warnings)


def principled(**values):
    return shader_material("p", "ShaderNodeBsdfPrincipled", **values)


def approx(*rgb):
    return pytest.approx(rgb if len(rgb) == 3 else rgb * 3, rel=1e-5, abs=1e-7)


def test_principled_default():
    lobes, arrays = lobes_of(principled())
    assert set(lobes) == {"diffuse", "specular"}
    assert lobes["diffuse"].color.constant == approx(0.8)
    assert lobes["specular"].roughness == pytest.approx(0.5) and lobes["specular"].color.constant == approx(1.0)
    assert not [n for n in arrays.warnings if n.severity == "warning"]


def test_principled_weights():
    values = {"Base_Color": (0.5, 0.4, 0.3, 1), "Metallic": 0.25, "Transmission_Weight": 0.5, "Alpha": 0.8}
    lobes, _ = lobes_of(principled(**values, Roughness=0.3, IOR=1.6, Emission_Color=(1, 0.5, 0, 1), Emission_Strength=10.0))
    assert lobes["transparent"].color.constant == approx(0.2)
    assert lobes["metallic"].color.constant == approx(0.5, 0.4, 0.3)
    assert lobes["glass"].color.constant == approx(0.5**0.5, 0.4**0.5, 0.3**0.5)
    assert lobes["dielectric"].color.constant == approx(*(1 - c**0.5 for c in (0.5, 0.4, 0.3)))
    assert lobes["diffuse"].share.constant == approx(0.5 * 0.3, 0.4 * 0.3, 0.3 * 0.3)
    assert lobes["specular"].color.constant == approx(1.0) and lobes["specular"].stack == lobes["diffuse"].stack
    assert [lobes[kind].weight for kind in ("metallic", "glass", "dielectric", "specular")] == pytest.approx([0.2, 0.3, 0.3, 0.3])
    assert lobes["emission"].color.constant == approx(8.0, 4.0, 0.0)
    assert lobes["glass"].ior == pytest.approx(1.6) and lobes["metallic"].roughness == pytest.approx(0.3)


@pytest.mark.parametrize(("level", "ior"), [(0.0, None), (0.5, 1.5), (1.0, 1.7888543)])
def test_principled_specular_level_changes_the_index(level, ior):
    lobes, _ = lobes_of(principled(IOR=1.5, Specular_IOR_Level=level))
    if ior is None:
        assert "specular" not in lobes
    else:
        f0 = ((1.5 - 1) / (1.5 + 1)) ** 2 * 2 * level
        assert lobes["specular"].ior == pytest.approx((1 + f0**0.5) / (1 - f0**0.5), rel=1e-5)


def test_principled_without_coat_equals_cycles_diffuse():
    """Albedo seen under a uniform sky: the convex plane reflects albedo times radiance."""
    world = bpy.data.worlds.new("w")
    bpy.context.scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    lobes, arrays = lobes_of(principled(Base_Color=(0.6, 0.3, 0.1, 1), Specular_IOR_Level=0.0))
    assert arrays.background == approx(1.0)
    np.testing.assert_allclose(render_patch(samples=256).mean(axis=(0, 1)), lobes["diffuse"].color.constant, rtol=5e-3)


@pytest.mark.parametrize("name", ["Sheen_Weight", "Coat_Weight", "Subsurface_Weight", "Anisotropic", "Thin_Film_Thickness"])
def test_principled_names_what_it_leaves_out(name):
    _, arrays = lobes_of(principled(**{name: 0.5}))
    assert told(arrays, 'Material "p"', "the rest is used", name.replace("_", " "))


@pytest.mark.parametrize(
    ("kind", "lobe"),
    [
        ("ShaderNodeBsdfDiffuse", "diffuse"),
        ("ShaderNodeEmission", "emission"),
        ("ShaderNodeBsdfAnisotropic", "glossy"),
        ("ShaderNodeBsdfGlass", "glass"),
        ("ShaderNodeBsdfRefraction", "refraction"),
        ("ShaderNodeBsdfTransparent", "transparent"),
        ("ShaderNodeBsdfTranslucent", "diffuse"),
        ("ShaderNodeSubsurfaceScattering", "diffuse"),
    ],
)
def test_each_shader(kind, lobe):
    lobes, arrays = lobes_of(shader_material("m", kind, Color=(0.5, 0.25, 0.125, 1)))
    assert set(lobes) == {lobe}
    assert lobes[lobe].color.constant == approx(0.5, 0.25, 0.125)
    assert told(arrays, "ideal diffuser") == (kind in ("ShaderNodeBsdfTranslucent", "ShaderNodeSubsurfaceScattering"))


@pytest.mark.parametrize("kind", ["ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfGlass", "ShaderNodeBsdfPrincipled"])
@pytest.mark.parametrize("distribution", ["GGX", "MULTI_GGX"])
def test_the_distribution_says_whether_all_bounces_between_facets_count(kind, distribution):
    values = {"Metallic": 1.0} if kind == "ShaderNodeBsdfPrincipled" else {}
    material = shader_material("m", kind, Roughness=0.5, **values)
    next(n for n in material.node_tree.nodes if n.bl_idname == kind).distribution = distribution
    lobes, _ = lobes_of(material)
    assert [x.multiscatter for x in lobes.values() if x.kind != "diffuse"] == [distribution == "MULTI_GGX"]


def test_other_distributions_are_named():
    material = shader_material("m", "ShaderNodeBsdfRefraction", Roughness=0.5)
    next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfRefraction").distribution = "BECKMANN"
    _, arrays = lobes_of(material)
    assert told(arrays, "BECKMANN", "computed as GGX")


def mixed(kind, factor=None):
    """Red diffuse and emission through Mix or Add Shader."""
    material = empty_material("mixed")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    diffuse, emission, mix = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeEmission"), nodes.new(kind)
    diffuse.inputs["Color"].default_value = (0.8, 0.2, 0.2, 1)
    emission.inputs["Strength"].default_value = 4.0
    first = 1 if kind == "ShaderNodeMixShader" else 0
    links.new(diffuse.outputs[0], mix.inputs[first])
    links.new(emission.outputs[0], mix.inputs[first + 1])
    if isinstance(factor, float):
        mix.inputs[0].default_value = factor
    elif factor is not None:
        image = nodes.new("ShaderNodeTexImage")
        image.image = factor
        links.new(image.outputs["Color"], mix.inputs[0])
    links.new(mix.outputs[0], nodes["Material Output"].inputs["Surface"])
    return material


def test_mix_and_add():
    lobes, _ = lobes_of(mixed("ShaderNodeMixShader", 0.25))
    assert lobes["diffuse"].color.constant == approx(0.6, 0.15, 0.15)
    assert lobes["emission"].color.constant == approx(1.0)


def test_add_shader():
    lobes, _ = lobes_of(mixed("ShaderNodeAddShader"))
    assert lobes["diffuse"].color.constant == approx(0.8, 0.2, 0.2)
    assert lobes["emission"].color.constant == approx(4.0)


def test_mix_by_an_image_keeps_the_polynomial():
    image = bpy.data.images.new("mask", 2, 1, is_data=True)
    image.pixels.foreach_set(np.array([0.2, 0.2, 0.2, 1, 1, 1, 1, 1], np.float32))
    lobes, arrays = lobes_of(mixed("ShaderNodeMixShader", image))
    mean = np.array([arrays.textures[s.texture].pixels.mean(axis=(0, 1)) for t in lobes["emission"].color.terms for s in t.sources])
    assert len(lobes["emission"].color.terms) == 1 and len(lobes["diffuse"].color.terms) == 2
    np.testing.assert_allclose(mean[0, :3], 0.6, atol=2e-3)


@pytest.mark.parametrize(("value", "expected"), [((2.0, 0.5, -1.0), (1.0, 0.5, 0.0)), ((float("nan"), 0.5, 0.5), (0.0, 0.5, 0.5))])
def test_albedo_is_kept_between_zero_and_one(value, expected):
    lobes, arrays = lobes_of(shader_material("m", "ShaderNodeBsdfDiffuse", Color=(*value, 1)))
    assert lobes["diffuse"].color.constant == approx(*expected)
    assert told(arrays, 'Material "m"', "clamped") or told(arrays, 'Material "m"', "not a number")


@pytest.mark.parametrize(("strength", "expected"), [(-3.0, None), (float("nan"), None), (1e30, 1e9), (float("inf"), 1e9)])
def test_emission_that_cannot_be_computed_with(strength, expected):
    lobes, arrays = lobes_of(shader_material("m", "ShaderNodeEmission", Strength=strength))
    if expected is None:
        assert "emission" not in lobes
    else:
        assert max(lobes["emission"].color.constant) == pytest.approx(expected)
    assert told(arrays, 'Material "m"', "clamped") or told(arrays, 'Material "m"', "not a number")


def test_sums_over_one_are_scaled_down():
    material = empty_material("m")
    nodes, links = material.node_tree.nodes, material.node_tree.links
    add = nodes.new("ShaderNodeAddShader")
    for i, kind in enumerate(("ShaderNodeBsdfDiffuse", "ShaderNodeBsdfTransparent")):
        node = nodes.new(kind)
        node.inputs[0].default_value = (0.8, 0.8, 0.8, 1)
        links.new(node.outputs[0], add.inputs[i])
    links.new(add.outputs[0], nodes["Material Output"].inputs["Surface"])
    lobes, arrays = lobes_of(material)
    assert lobes["diffuse"].color.constant == approx(0.5) and lobes["transparent"].color.constant == approx(0.5)
    assert told(arrays, "1.6 times")


def test_bright_images_are_clamped_as_albedo():
    image = bpy.data.images.new("bright", 2, 1, float_buffer=True)
    image.pixels.foreach_set(np.array([3, 0.5, 0.5, 1, 0.25, 0.5, 0.5, 1], np.float32))
    material = shader_material("m", "ShaderNodeBsdfDiffuse")
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    diffuse = next(n for n in material.node_tree.nodes if n.type == "BSDF_DIFFUSE")
    material.node_tree.links.new(node.outputs[0], diffuse.inputs["Color"])
    lobes, arrays = lobes_of(material)
    source = lobes["diffuse"].color.terms[0].sources[0]
    np.testing.assert_allclose(arrays.textures[source.texture].pixels[0, :, 0], [1.0, 0.25])
    assert told(arrays, "albedo", "clamped")


@pytest.mark.parametrize("kind, value, top", [("Emission", 1e38, 1e9), ("Emission", 2.0, None), ("BsdfDiffuse", 3.0, 1.0)])
def test_bright_colour_attributes_are_clamped_and_named(kind, value, top):
    material = shader_material("m", f"ShaderNode{kind}")
    node = material.node_tree.nodes.new("ShaderNodeAttribute")
    node.attribute_name = "paint"
    shader = next(n for n in material.node_tree.nodes if n.bl_idname == f"ShaderNode{kind}")
    material.node_tree.links.new(node.outputs[0], shader.inputs["Color"])
    plane = white_plane()
    plane.data.materials.clear()
    plane.data.materials.append(material)
    paint = plane.data.color_attributes.new(name="paint", type="FLOAT_COLOR", domain="CORNER")
    paint.data.foreach_set("color", [value] * (4 * len(paint.data)))
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    shading, at = World(arrays).shading, (np.zeros(1, np.int32), *np.full((2, 1), 0.3, np.float32))
    read = (shading.emission if kind == "Emission" else shading.albedo)(*at)
    np.testing.assert_allclose(read, top or value, rtol=1e-6)
    assert bool(told(arrays, plane.name, "paint", "clamped")) == bool(top)


def test_slots_are_chosen_as_in_cycles():
    """Four strips: in range, empty slot (grey 0.8), out of range (last slot), first again."""
    red = shader_material("red", "ShaderNodeEmission", Color=(1, 0, 0, 1))
    blue = shader_material("blue", "ShaderNodeEmission", Color=(0, 0, 1, 1))
    mesh = bpy.data.meshes.new("strips")
    x = np.linspace(-1, 1, 5)
    mesh.from_pydata([(a, b, 0) for b in (-1, 1) for a in x], [], [(i, i + 1, i + 6, i + 5) for i in range(4)])
    for m in (red, None, blue):
        mesh.materials.append(m)
    mesh.polygons.foreach_set("material_index", [0, 1, 9, 2])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("strips", mesh))
    world = bpy.data.worlds.new("w")
    bpy.context.scene.world = world
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    seen = render_patch(width=2.0, pixels=8, samples=64)[4, [1, 3, 5, 7]]
    ours = [arrays.materials[arrays.material[t]] for t in (0, 2, 4, 6)]
    expected = [np.add(m.total("emission").constant, m.total("diffuse").constant) for m in ours]
    np.testing.assert_allclose(expected, seen, atol=0.05)
    assert [m.name for m in ours] == ["red", "Default", "blue", "blue"]


def test_material_without_nodes():
    material = bpy.data.materials.new("plain")
    material.diffuse_color = (0.1, 0.2, 0.3, 1.0)
    if bpy.app.version >= (5, 0):  # nodes are always on there
        material.node_tree.nodes.clear()
        lobes, arrays = lobes_of(material)
        assert lobes == {} and told(arrays, "no output node")
    else:
        lobes, _ = lobes_of(material)
        assert lobes["diffuse"].color.constant == approx(0.1, 0.2, 0.3)


def diamonds(tree, kind, source, count):
    """The output of a chain of mixing nodes whose two inputs both come from the one before."""
    for _ in range(count):
        node = tree.nodes.new(kind)
        for socket in list(node.inputs)[1:3]:
            tree.links.new(source, socket)
        source = node.outputs[0]
    return source


@pytest.mark.parametrize("textured", [False, True])
def test_shaders_that_feed_two_inputs_are_read_once(textured):
    """2^40 lobes otherwise. A factor by a texture makes t and 1 - t of each, which come to 1 again."""
    material = shader_material("chain", "ShaderNodeBsdfDiffuse", Color=(0.2, 0.5, 0.7, 1.0))
    tree = material.node_tree
    last = diamonds(tree, "ShaderNodeMixShader", tree.nodes["Diffuse BSDF"].outputs[0], 40)
    tree.links.new(last, tree.nodes["Material Output"].inputs["Surface"])
    if textured:
        image = tree.nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.new("factor", 2, 2)
        for node in tree.nodes:
            if node.type == "MIX_SHADER":
                tree.links.new(image.outputs[0], node.inputs[0])
    lobes, arrays = lobes_of(material)
    assert list(lobes) == ["diffuse"] and lobes["diffuse"].color.is_constant
    assert lobes["diffuse"].color.constant == approx(0.2, 0.5, 0.7)
    assert not told(arrays, "chain")


def test_colours_that_feed_two_inputs_are_read_once():
    material = shader_material("chain", "ShaderNodeBsdfDiffuse")
    tree = material.node_tree
    image = tree.nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.new("colour", 2, 2)
    last = diamonds(tree, "ShaderNodeMixRGB", image.outputs[0], 40)
    tree.links.new(last, tree.nodes["Diffuse BSDF"].inputs["Color"])
    lobes, arrays = lobes_of(material)
    (term,) = lobes["diffuse"].color.terms
    assert term.constant == approx(1.0) and len(term.sources) == 1
    assert not told(arrays, "chain")


@pytest.mark.parametrize("kind", ["material", "world", "lamp"])
def test_an_output_for_eevee_is_none_for_cycles(kind):
    """Cycles is black then, and so are we; Cycles' radiance of the plane says so."""
    if kind == "material":
        owner = shader_material("only", "ShaderNodeEmission")
        white_plane(2.0, owner)
    else:
        white_plane(2.0)
        owner = new_world(Strength=2.0) if kind == "world" else add_light("SUN", energy=3.0).data
        if owner.node_tree is None or kind == "lamp":
            owner.use_nodes = True
    assert render_patch(samples=4).mean() > 0.05
    next(n for n in owner.node_tree.nodes if n.type.startswith("OUTPUT")).target = "EEVEE"
    owner.node_tree.update_tag()
    assert render_patch(samples=4).max() == 0.0
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert not any(arrays.background) and not arrays.lights and arrays.materials[0].total("emission").is_black
    assert told(arrays, "output node for Cycles")


def test_normal_maps_and_displacement_are_named():
    material = principled()
    nodes, links = material.node_tree.nodes, material.node_tree.links
    links.new(nodes.new("ShaderNodeBump").outputs[0], nodes["Principled BSDF"].inputs["Normal"])
    links.new(nodes.new("ShaderNodeDisplacement").outputs[0], nodes["Material Output"].inputs["Displacement"])
    _, arrays = lobes_of(material)
    assert told(arrays, "bump or normal map") and told(arrays, "displacement")


def textured(image):
    """An emitter of an image."""
    material = shader_material("t", "ShaderNodeEmission")
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    emission = next(n for n in material.node_tree.nodes if n.type == "EMISSION")
    material.node_tree.links.new(node.outputs["Color"], emission.inputs["Color"])
    return material


def png(path, width, height, pixels=b""):
    """A PNG whose header promises this size."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b""))
    return path


def test_missing_layers_are_named():
    material = textured(bpy.data.images.new("i", 2, 2))
    plane = white_plane(2.0, material)
    plane.data.uv_layers.remove(plane.data.uv_layers[0])
    paint = shader_material("paint", "ShaderNodeEmission")
    node = paint.node_tree.nodes.new("ShaderNodeVertexColor")
    node.layer_name = "nowhere"
    emission = next(n for n in paint.node_tree.nodes if n.type == "EMISSION")
    paint.node_tree.links.new(node.outputs["Color"], emission.inputs["Color"])
    white_plane(2.0, paint).name = "unpainted"
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert told(arrays, "plane", "no UV layer")
    assert told(arrays, "unpainted", 'no attribute "nowhere" of colours, numbers or vectors')


def test_missing_and_corrupt_images(tmp_path):
    missing = bpy.data.images.new("missing", 4, 4)
    missing.source, missing.filepath = "FILE", str(tmp_path / "nothing.png")
    lobes, arrays = lobes_of(textured(missing))
    assert lobes["emission"].color.constant == approx(0.8)
    assert told(arrays, 'Image "missing"', "missing or cannot be read", "0.8")
    (tmp_path / "bad.exr").write_bytes(b"\x76\x2f\x31\x01" + b"garbage" * 9)
    bpy.data.objects.remove(bpy.data.objects["plane"])
    lobes, arrays = lobes_of(textured(bpy.data.images.load(str(tmp_path / "bad.exr"))))
    assert lobes["emission"].color.constant == approx(0.8)
    assert told(arrays, 'Image "bad.exr"', "cannot be read safely", "damaged")


@pytest.mark.parametrize("packed", [False, True])
def test_huge_images_are_refused_before_they_are_decoded(tmp_path, packed):
    image = bpy.data.images.load(str(png(tmp_path / "bomb.png", 30000, 30000)))
    if packed:
        image.pack()
    lobes, arrays = lobes_of(textured(image))
    assert lobes["emission"].color.constant == approx(0.8)
    assert told(arrays, 'Image "bomb.png"', "30000 x 30000", "0.8")
    assert not image.has_data


def test_images_on_disk_packed_and_generated_agree(tmp_path):
    rows = bytes([0, 200, 100, 50, 10, 20, 30]) + bytes([0, 1, 2, 3, 250, 128, 64])
    disk = bpy.data.images.load(str(png(tmp_path / "a.png", 2, 2, rows)))
    packed = bpy.data.images.load(str(tmp_path / "a.png"), check_existing=False)
    packed.pack()
    generated = bpy.data.images.new("g", 2, 2)
    generated.pixels.foreach_set(
        np.array([1, 2, 3, 255, 250, 128, 64, 255, 200, 100, 50, 255, 10, 20, 30, 255], np.float32) / np.float32(255)
    )
    for image in (disk, packed, generated):
        white_plane(2.0, textured(image))
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    a, b, c = (t.pixels for t in arrays.textures)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(a, c, atol=1e-6)
    assert a[1, 0, 0] == pytest.approx(((200 / 255 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    assert not disk.has_data  # what was not loaded before is not left in memory


def test_udim_uses_one_picture():
    image = bpy.data.images.new("tiles", 4, 4, tiled=True)
    lobes, arrays = lobes_of(textured(image))
    assert told(arrays, 'Image "tiles"', "UDIM")
    assert len(arrays.textures) == 1 or lobes["emission"].color.is_constant


def test_nan_pixels_become_zero():
    image = bpy.data.images.new("nan", 1, 1, float_buffer=True)
    image.pixels.foreach_set(np.array([np.nan, 0.5, np.inf, 1], np.float32))
    _, arrays = lobes_of(textured(image))
    np.testing.assert_array_equal(arrays.textures[0].pixels[0, 0], [0, 0.5, 0, 1])
    assert told(arrays, 'Image "nan"', "not numbers")


def new_world(**values):
    world = bpy.data.worlds.new("world")
    if world.node_tree is None:
        world.use_nodes = True
    for key, value in values.items():
        world.node_tree.nodes["Background"].inputs[key].default_value = value
    bpy.context.scene.world = world
    return world


def test_world_is_colour_times_strength():
    assert extract(bpy.context.evaluated_depsgraph_get()).background == (0.0, 0.0, 0.0)
    new_world(Color=(0.5, 0.7, 1.0, 1.0), Strength=2.0)
    assert extract(bpy.context.evaluated_depsgraph_get()).background == approx(1.0, 1.4, 2.0)


def test_world_light_equals_cycles():
    new_world(Color=(0.5, 0.7, 1.0, 1.0), Strength=2.0)
    white_plane(2.0)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(render_patch(samples=256).mean(axis=(0, 1)), arrays.background, rtol=5e-3)


def test_environment_texture_gives_its_mean_radiance():
    """The rows of a latitude-longitude image weigh as much as they see of the sphere."""
    world = new_world()
    image = bpy.data.images.new("sky", 8, 64, float_buffer=True)
    height = (np.arange(64) + 0.5) / 64
    pixels = np.ones((64, 8, 4), np.float32)
    pixels[:, :, 0] = (height > 0.9)[:, None] * 10.0
    image.pixels.foreach_set(pixels.ravel())
    node = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    world.node_tree.links.new(node.outputs[0], world.node_tree.nodes["Background"].inputs["Color"])
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    cap = pixels[:, 0, 0] @ np.sin(np.pi * height) / np.sin(np.pi * height).sum()
    assert arrays.background == approx(float(cap), 1.0, 1.0)
    assert told(arrays, "mean radiance")


def test_sky_texture_is_named():
    world = new_world(Color=(0.1, 0.2, 0.3, 1.0))
    node = world.node_tree.nodes.new("ShaderNodeTexSky")
    world.node_tree.links.new(node.outputs[0], world.node_tree.nodes["Background"].inputs["Color"])
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert arrays.background == approx(0.1, 0.2, 0.3)
    assert told(arrays, 'World "world"', "not understood", "default value")


def test_one_material_is_read_once():
    material = diffuse_material("shared", 0.5)
    for _ in range(3):
        white_plane(2.0, material)
    assert len(extract(bpy.context.evaluated_depsgraph_get()).materials) == 1


@pytest.mark.parametrize("ior", [0.8, 1.0 / 1.5])
def test_principled_specular_level_keeps_the_side_of_an_index_below_one(ior):
    """The reflectance at normal incidence is twice that of the index, which stays below 1."""
    lobes, _ = lobes_of(principled(IOR=ior, Specular_IOR_Level=1.0))
    adjusted = lobes["specular"].ior
    assert adjusted < 1
    assert ((adjusted - 1) / (adjusted + 1)) ** 2 == pytest.approx(2 * ((ior - 1) / (ior + 1)) ** 2, rel=1e-5)
