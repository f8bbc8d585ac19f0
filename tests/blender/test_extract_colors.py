# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour nodes: the extracted polynomial, evaluated at pixel centres, equals what Cycles shows of an emitting plane."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.core.scene.shading import evaluate
from adjgi.tests.cycles_patch import empty_material, render_patch, white_plane

PIXELS = 16


class Graph:
    """Builds the colour that a plane emits."""

    def __init__(self):
        self.material = empty_material("graph")
        self.tree = self.material.node_tree
        self.emission = self.add("ShaderNodeEmission")
        self.link(self.emission.outputs[0], self.tree.nodes["Material Output"].inputs["Surface"])

    def add(self, kind, tree=None, values=None, **attributes):
        node = (tree or self.tree).nodes.new(kind)
        for key, value in attributes.items():
            setattr(node, key, value)
        for key, value in (values or {}).items():
            socket = next(s for s in node.inputs if s.enabled and s.name == key)
            if hasattr(value, "is_output"):
                node.id_data.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def link(self, a, b):
        a.id_data.links.new(a, b)

    def show(self, output):
        self.link(output, self.emission.inputs["Color"])

    def image(self, data=None, **attributes):
        return self.add("ShaderNodeTexImage", image=data or pattern(), **attributes)


def pattern(size=(6, 4), is_float=False, alpha=False, space=None, seed=1):
    """A generated image of random values that fit in a byte."""
    image = bpy.data.images.new("pattern", *size, alpha=True, float_buffer=is_float)
    if space:
        image.colorspace_settings.name = space
    values = np.random.default_rng(seed).integers(20, 236, (size[0] * size[1], 4)).astype(np.float32) / np.float32(255)
    if not alpha:
        values[:, 3] = 1.0
    image.pixels.foreach_set(values.ravel())
    image.pack()
    return image


def color_at_pixels(arrays, pixels=PIXELS):
    """(pixels, pixels, 3) emitted radiance of the plane from -1 to 1 at pixel centres."""
    s = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    x, y = (a.ravel() for a in np.meshgrid(s, s))
    out = np.full((len(x), 3), np.nan, np.float32)
    for t, (a, b, c) in enumerate(arrays.vertices[arrays.triangles][:, :, :2]):
        m = np.linalg.inv(np.stack([b - a, c - a], axis=1))
        u, v = m @ (np.stack([x, y]) - a[:, None])
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        color = arrays.materials[arrays.material[t]].total("emission")
        tri = np.full(int(inside.sum()), t)
        out[inside] = evaluate(color, arrays, tri, u[inside].astype(np.float32), v[inside].astype(np.float32))
    return out.reshape(pixels, pixels, 3)


def both(graph, atol=2e-3):
    """Compare ours with Cycles; returns the arrays."""
    if not bpy.data.objects.get("plane"):
        white_plane(2.0, graph.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    theirs = render_patch(width=2.0, pixels=PIXELS, samples=4)
    ours = color_at_pixels(arrays)
    assert theirs.std() > 0.01 or ours.std() < 1e-4
    off = np.abs(ours - theirs).max(axis=2)
    # Cycles takes a sample somewhere in the pixel: now and then one lies away from the centre.
    assert np.sort(off.ravel())[-3] <= atol, f"{(off > atol).sum()} pixels differ, by up to {off.max():.4f}"
    return arrays


def silent(arrays):
    return [str(n) for n in arrays.warnings if n.severity != "info"] == []


def test_byte_image_is_decoded():
    g = Graph()
    g.show(g.image(interpolation="Closest").outputs["Color"])
    assert silent(both(g))


def test_linear_interpolation():
    g = Graph()
    g.show(g.image(pattern(is_float=True), interpolation="Linear").outputs["Color"])
    assert silent(both(g, atol=6e-3))


@pytest.mark.parametrize(("is_float", "space"), [(True, None), (False, "Non-Color"), (True, "Non-Color"), (True, "sRGB")])
def test_colour_spaces(is_float, space):
    g = Graph()
    g.show(g.image(pattern(is_float=is_float, space=space), interpolation="Closest").outputs["Color"])
    assert silent(both(g))


@pytest.mark.parametrize("extension", ["REPEAT", "EXTEND", "CLIP", "MIRROR"])
@pytest.mark.parametrize("kind", ["POINT", "TEXTURE", "VECTOR"])
def test_mapping_and_extension(kind, extension):
    g = Graph()
    uv = g.add("ShaderNodeTexCoord")
    mapping = g.add("ShaderNodeMapping", vector_type=kind)
    g.link(uv.outputs["UV"], mapping.inputs["Vector"])
    if kind != "VECTOR":
        mapping.inputs["Location"].default_value = (0.3, -0.2, 0.5)
    mapping.inputs["Rotation"].default_value = (0.2, -0.3, 0.6)
    mapping.inputs["Scale"].default_value = (1.7, 0.8, 1.2)
    image = g.image(interpolation="Closest", extension=extension)
    g.link(mapping.outputs[0], image.inputs["Vector"])
    g.show(image.outputs["Color"])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert silent(arrays)
    # A turned grid of texels has edges through pixels: almost all pixels agree, not all.
    off = np.abs(color_at_pixels(arrays) - render_patch(width=2.0, pixels=PIXELS, samples=1)).max(axis=2) > 3e-3
    assert off.mean() < 0.02


def test_uv_map_node_chooses_the_layer():
    g = Graph()
    image = g.image(interpolation="Closest")
    g.link(g.add("ShaderNodeUVMap", uv_map="second").outputs[0], image.inputs["Vector"])
    g.show(image.outputs["Color"])
    plane = white_plane(2.0, g.material)
    layer = plane.data.uv_layers.new(name="second")
    layer.uv.foreach_set("vector", np.array([0.5, 0, 0.5, 1, 0, 1, 0, 0], np.float32))
    assert silent(both(g))


# Float images have associated alpha. Marked as straight, Blender's pixels stay as they are, and Cycles 5.2 alone multiplies them again.
ALPHA = [(False, m) for m in ("STRAIGHT", "CHANNEL_PACKED", "NONE")] + [(True, m) for m in ("PREMUL", "CHANNEL_PACKED", "NONE")]


@pytest.mark.parametrize(("is_float", "mode"), ALPHA)
@pytest.mark.parametrize("linked", [False, True])
def test_alpha(is_float, mode, linked):
    g = Graph()
    data = pattern(alpha=True, is_float=is_float)
    data.alpha_mode = mode
    image = g.image(data, interpolation="Closest")
    g.show(image.outputs["Color"])
    if linked:
        g.link(image.outputs["Alpha"], g.emission.inputs["Strength"])
    # Cycles rounds byte colours times alpha to bytes.
    assert silent(both(g, atol=2e-3 if is_float or mode != "STRAIGHT" else 1e-2))


@pytest.mark.parametrize("kind", ["FLOAT_COLOR", "BYTE_COLOR"])
@pytest.mark.parametrize("domain", ["POINT", "CORNER"])
@pytest.mark.parametrize("node", ["ShaderNodeVertexColor", "ShaderNodeAttribute", "default"])
def test_color_attributes(kind, domain, node):
    g = Graph()
    if node == "ShaderNodeAttribute":
        reader = g.add(node, attribute_name="paint")
    else:
        reader = g.add("ShaderNodeVertexColor", layer_name="" if node == "default" else "paint")
    g.show(reader.outputs["Color"])
    mesh = white_plane(2.0, g.material).data
    paint = mesh.color_attributes.new(name="paint", type=kind, domain=domain)
    paint.data.foreach_set("color", np.array([1, 0, 0, 1, 0, 0.5, 0, 1, 0.2, 0.1, 1, 1, 0.6, 0.6, 0.6, 1], np.float32))
    assert silent(both(g))


@pytest.mark.parametrize("kind", ["MIX", "ADD", "MULTIPLY", "SUBTRACT", "SCREEN"])
@pytest.mark.parametrize("node", ["ShaderNodeMix", "ShaderNodeMixRGB"])
@pytest.mark.parametrize("sourced", [False, True])
def test_mix(kind, node, sourced):
    g = Graph()
    a, b = g.image(pattern(seed=1), interpolation="Closest"), g.image(pattern(seed=2), interpolation="Closest")
    factor = g.image(pattern(seed=3, space="Non-Color"), interpolation="Closest").outputs["Color"] if sourced else 0.3
    mix = g.add(node, blend_type=kind, **({"data_type": "RGBA"} if node == "ShaderNodeMix" else {}))
    out, sockets = next(o for o in mix.outputs if o.enabled), [s for s in mix.inputs if s.enabled]
    for socket, value in zip(sockets, (factor, a.outputs["Color"], b.outputs["Color"]), strict=True):
        if isinstance(value, float):
            socket.default_value = value
        else:
            g.link(value, socket)
    g.show(out)
    assert silent(both(g))


def test_mix_of_constants_beyond_polynomials():
    g = Graph()
    mix = g.add("ShaderNodeMixRGB", blend_type="DIFFERENCE")
    for socket, value in zip(mix.inputs, (0.7, (0.9, 0.1, 0.4, 1), (0.2, 0.8, 0.4, 1)), strict=True):
        socket.default_value = value
    g.show(mix.outputs[0])
    assert silent(both(g))


FUNCTIONS = {
    "invert": ("ShaderNodeInvert", {}, {"Fac": 0.7}),
    "gamma": ("ShaderNodeGamma", {}, {"Gamma": 2.2}),
    "contrast": ("ShaderNodeBrightContrast", {}, {"Bright": 0.1, "Contrast": 0.3}),
    "hue": ("ShaderNodeHueSaturation", {}, {"Hue": 0.3, "Saturation": 0.6, "Value": 1.2, "Fac": 0.8}),
    "grey": ("ShaderNodeRGBToBW", {}, {}),
    "ramp": ("ShaderNodeValToRGB", {}, {}),
    "curve": ("ShaderNodeRGBCurve", {}, {"Fac": 0.9}),
}


@pytest.mark.parametrize("case", FUNCTIONS)
@pytest.mark.parametrize("textured", [True, False])
def test_functions_of_constants_and_of_one_image(case, textured):
    kind, attributes, values = FUNCTIONS[case]
    g = Graph()
    node = g.add(kind, **attributes)
    for key, value in values.items():
        names = {"Fac": ("Fac", "Factor"), "Bright": ("Bright", "Brightness")}.get(key, (key,))
        next(s for s in node.inputs if s.name in names).default_value = value
    if case == "ramp":
        node.color_ramp.elements[0].color, node.color_ramp.elements[1].color = (0.1, 0.5, 0.2, 1), (1, 0.2, 0.7, 1)
        node.color_ramp.elements[0].position = 0.25
    if case == "curve":
        node.mapping.curves[0].points.new(0.5, 0.8)
        node.mapping.curves[3].points.new(0.3, 0.4)
        node.mapping.update()
    source = g.image(interpolation="Closest").outputs["Color"] if textured else g.add("ShaderNodeRGB").outputs[0]
    if not textured:
        source.default_value = (0.7, 0.3, 0.1, 1.0)
    main = next(s for s in node.inputs if s.name == "Color") if any(s.name == "Color" for s in node.inputs) else node.inputs[0]
    g.link(source, main)
    g.show(node.outputs[0])
    assert silent(both(g, atol=6e-3))


def test_math_and_luminance():
    g = Graph()
    first = g.image(pattern(seed=4), interpolation="Closest").outputs["Color"]
    scaled = g.add("ShaderNodeMath", operation="MULTIPLY_ADD")
    g.link(first, scaled.inputs[0])
    scaled.inputs[1].default_value, scaled.inputs[2].default_value = 0.6, 0.1
    power = g.add("ShaderNodeMath", operation="POWER")
    power.inputs[0].default_value, power.inputs[1].default_value = 0.5, 3.0
    total = g.add("ShaderNodeMath", operation="ADD")
    g.link(scaled.outputs[0], total.inputs[0])
    g.link(power.outputs[0], total.inputs[1])
    g.show(total.outputs[0])
    assert silent(both(g))


def shuffled(space, channels):
    """An image whose red goes to blue, green to red and blue to green, by the nodes for `space`."""
    red, green, blue = channels
    g = Graph()
    split, join = g.add(f"ShaderNodeSeparate{space}"), g.add(f"ShaderNodeCombine{space}")
    g.link(g.image(interpolation="Closest").outputs["Color"], split.inputs[0])
    for a, b in ((red, blue), (green, red), (blue, green)):
        g.link(split.outputs[a], join.inputs[b])
    g.show(join.outputs[0])
    return g


def test_separate_and_combine():
    assert silent(both(shuffled("Color", ("Red", "Green", "Blue"))))


@pytest.mark.skipif(not hasattr(bpy.types, "ShaderNodeCombineRGB"), reason="Separate RGB and Combine RGB exist in Blender 4.2 only")
def test_separate_and_combine_rgb():
    assert silent(both(shuffled("RGB", "RGB")))


@pytest.mark.parametrize("kelvin", [300, 930, 1000, 1250, 1600, 2050, 2700, 3500, 4700, 5800, 7200, 10000, 15000])
def test_blackbody(kelvin):
    g = Graph()
    node = g.add("ShaderNodeBlackbody", values={"Temperature": kelvin})
    g.show(node.outputs[0])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    theirs = render_patch(pixels=4, samples=1).mean(axis=(0, 1))
    np.testing.assert_allclose(arrays.materials[0].total("emission").constant, theirs, rtol=0.01, atol=0.002)
    assert silent(arrays)


NUMBERS = {"FLOAT": "value", "INT": "value", "FLOAT_VECTOR": "vector", "FLOAT2": "vector", "BOOLEAN": "value"}


@pytest.mark.parametrize("kind", NUMBERS)
@pytest.mark.parametrize("domain", ["POINT", "CORNER", "FACE"])
def test_attributes_that_are_no_colours(kind, domain):
    g = Graph()
    g.show(g.add("ShaderNodeAttribute", attribute_name="level").outputs["Color"])
    mesh = white_plane(2.0, g.material).data
    level = mesh.attributes.new("level", kind, domain)
    for k, item in enumerate(level.data):
        value = {"INT": k + 1, "BOOLEAN": True, "FLOAT": 0.1 + 0.2 * k}.get(
            kind, (0.1 + 0.2 * k, 0.5 - 0.1 * k, 0.3)[: 2 if kind == "FLOAT2" else 3]
        )
        setattr(item, NUMBERS[kind], value)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(
        color_at_pixels(arrays), render_patch(width=2.0, pixels=PIXELS, samples=1), atol=0.08 if kind == "INT" else 0.03
    )
    assert silent(arrays)


def test_a_uv_map_as_a_colour():
    g = Graph()
    g.show(g.add("ShaderNodeAttribute", attribute_name="UVMap").outputs["Color"])
    assert silent(both(g, atol=0.05))


def test_attributes_of_other_kinds_are_named():
    g = Graph()
    g.show(g.add("ShaderNodeAttribute", attribute_name="level").outputs["Color"])
    white_plane(2.0, g.material).data.attributes.new("level", "FLOAT", "EDGE")
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert any(
        n.object == "plane" and 'no attribute "level" of colours, numbers or vectors on points, corners' in n.reason
        for n in arrays.warnings
    )


@pytest.mark.parametrize("kind", ["Cubic", "Smart"])
def test_smoother_interpolation_is_named(kind):
    g = Graph()
    g.show(g.image(interpolation=kind).outputs["Color"])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert any(f"{kind.lower()} interpolation; it is computed as linear" in n.reason and n.severity == "info" for n in arrays.warnings)


def nested(depth, inner):
    """Node groups around a group that gives a constant colour through its input."""
    tree = bpy.data.node_groups.new("g", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    if depth == 0:
        inner(tree, start.outputs[0], end.inputs[0])
    else:
        node = tree.nodes.new("ShaderNodeGroup")
        node.node_tree = nested(depth - 1, inner)
        tree.links.new(start.outputs[0], node.inputs[0])
        tree.links.new(node.outputs[0], end.inputs[0])
    return tree


def test_groups_reroutes_and_muted_nodes():
    g = Graph()

    def inner(tree, start, end):
        gamma = g.add("ShaderNodeGamma", tree, {"Gamma": 2.0})
        muted = g.add("ShaderNodeInvert", tree, mute=True)
        reroute = g.add("NodeReroute", tree)
        g.link(start, reroute.inputs[0])
        g.link(reroute.outputs[0], gamma.inputs[0])
        g.link(gamma.outputs[0], next(s for s in muted.inputs if s.name == "Color"))
        g.link(muted.outputs[0], end)

    group = g.add("ShaderNodeGroup")
    group.node_tree = nested(3, inner)
    g.link(g.image(interpolation="Closest").outputs["Color"], group.inputs[0])
    g.show(group.outputs[0])
    assert silent(both(g))


def test_group_input_default_value():
    g = Graph()
    group = g.add("ShaderNodeGroup")
    group.node_tree = nested(1, lambda tree, start, end: g.link(start, end))
    group.inputs[0].default_value = (0.1, 0.6, 0.3, 1.0)
    g.show(group.outputs[0])
    assert silent(both(g))


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("mapped", [False, True])
def test_image_at_the_value_of_a_group_input(hidden, mapped):
    """A constant place from 5.0 on, UV coordinates in 4.2 and where the value is hidden; behind a mapping always a constant."""
    g = Graph()

    def inner(tree, start, end):
        image = g.add("ShaderNodeTexImage", tree, image=pattern(), interpolation="Closest")
        if mapped:
            mapping = g.add("ShaderNodeMapping", tree, {"Location": (0.1, 0.2, 0.0)})
            g.link(start, mapping.inputs["Vector"])
            start = mapping.outputs[0]
        g.link(start, image.inputs["Vector"])
        g.link(image.outputs["Color"], end)

    tree = nested(0, inner)
    place = next(i for i in tree.interface.items_tree if i.in_out == "INPUT")
    place.socket_type, place.hide_value = "NodeSocketVector", hidden
    group = g.add("ShaderNodeGroup")
    group.node_tree = tree
    group.inputs[0].default_value = (0.3, 0.6, 0.0)
    g.show(group.outputs[0])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    theirs = render_patch(width=2.0, pixels=PIXELS, samples=1)
    assert (np.abs(color_at_pixels(arrays) - theirs).max(axis=2) > 3e-3).mean() < 0.02
    assert silent(arrays)


def test_groups_nested_too_deep_are_refused():
    g = Graph()
    group = g.add("ShaderNodeGroup")
    group.node_tree = nested(200, lambda tree, start, end: g.link(start, end))
    g.show(group.outputs[0])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    assert any("nested deeper" in n.reason and "graph" in n.object for n in arrays.warnings)


SUBSTITUTES = {
    "noise": ("ShaderNodeTexNoise", {}, "not understood"),
    "layer weight": ("ShaderNodeLayerWeight", {}, "not understood"),
    "object attribute": ("ShaderNodeAttribute", {"attribute_type": "OBJECT", "attribute_name": "x"}, "attribute of the object"),
}


@pytest.mark.parametrize("case", SUBSTITUTES)
def test_unknown_nodes_are_named(case):
    kind, attributes, word = SUBSTITUTES[case]
    g = Graph()
    g.emission.inputs["Color"].default_value = (0.2, 0.4, 0.6, 1.0)
    g.show(g.add(kind, **attributes).outputs[0])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(arrays.materials[0].total("emission").constant, (0.2, 0.4, 0.6), rtol=1e-6)
    assert any(word in n.reason and 'Material "graph"' in n.object and "default value" in n.reason for n in arrays.warnings)


@pytest.mark.parametrize("case", ["generated", "box", "linked mapping"])
def test_other_coordinates_give_the_mean(case):
    g = Graph()
    image = g.image(pattern(is_float=True))
    if case == "generated":
        g.link(g.add("ShaderNodeTexCoord").outputs["Generated"], image.inputs["Vector"])
    elif case == "box":
        image.projection = "BOX"
    else:
        mapping = g.add("ShaderNodeMapping")
        g.link(g.add("ShaderNodeValue").outputs[0], mapping.inputs["Scale"])
        g.link(mapping.outputs[0], image.inputs["Vector"])
    g.show(image.outputs["Color"])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    pixels = np.array(image.image.pixels[:]).reshape(-1, 4)
    np.testing.assert_allclose(arrays.materials[0].total("emission").constant, pixels[:, :3].mean(axis=0), rtol=1e-5)
    assert any("mean of the image" in n.reason for n in arrays.warnings)


def test_a_tinted_image_as_a_number_is_its_luminance():
    g = Graph()
    tint = g.add("ShaderNodeMixRGB", blend_type="MULTIPLY")
    tint.inputs[0].default_value, tint.inputs[2].default_value = 1.0, (0.9, 0.1, 0.5, 1.0)
    g.link(g.image(interpolation="Closest").outputs["Color"], tint.inputs[1])
    g.link(tint.outputs[0], g.emission.inputs["Strength"])
    assert silent(both(g))


def test_the_mean_of_alpha_stands_for_a_number_that_varies():
    g = Graph()
    image = g.image(pattern(alpha=True), interpolation="Closest")
    shader = g.add("ShaderNodeBsdfAnisotropic" if hasattr(bpy.types, "ShaderNodeBsdfAnisotropic") else "ShaderNodeBsdfGlossy")
    g.link(image.outputs["Alpha"], shader.inputs["Roughness"])
    g.link(shader.outputs[0], g.tree.nodes["Material Output"].inputs["Surface"])
    white_plane(2.0, g.material)
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    pixels = np.empty(6 * 4 * 4, np.float32)
    image.image.pixels.foreach_get(pixels)
    assert arrays.materials[0].lobes[0].roughness == pytest.approx(pixels[3::4].mean(), abs=1e-5)
    assert any("roughness varies" in n.reason for n in arrays.warnings)
