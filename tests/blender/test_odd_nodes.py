# SPDX-License-Identifier: GPL-3.0-or-later
"""Every node of this Blender in every setting, fed with what is hard to read: nothing may raise, and nothing be read by accident.

What a node comes to where it is understood stands in test_extract_materials.py and test_extract_colors.py.
"""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.materials import Materials
from adjgi.adjoint_gi.bridge.host.notices import Notices
from adjgi.tests.cycles_patch import shader_material

NAN = float("nan")
NODES = sorted(name for name in dir(bpy.types) if name.startswith("ShaderNode"))


def value(tree, number):
    node = tree.nodes.new("ShaderNodeValue")
    node.outputs[0].default_value = number
    return node


def huge(tree):
    """A number whose square leaves float32 and whose ninth power leaves float64."""
    node = tree.nodes.new("ShaderNodeMath")
    node.operation = "MULTIPLY"
    for socket in node.inputs[:2]:
        socket.default_value = 1e30
    return node


def circle(tree):
    """A reroute that feeds itself, which Blender takes for a valid link."""
    node = tree.nodes.new("NodeReroute")
    tree.links.new(node.outputs[0], node.inputs[0])
    return node


def picture(tree):
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.get("two") or bpy.data.images.new("two", 2, 2)
    return node


def attribute(tree):
    node = tree.nodes.new("ShaderNodeAttribute")
    node.attribute_name = "any"
    return node


FEEDS = (
    huge,
    circle,
    picture,
    attribute,
    lambda tree: value(tree, NAN),
    lambda tree: value(tree, -float("inf")),
    lambda tree: tree.nodes.new("ShaderNodeEmission"),
    lambda tree: None,  # what is typed is no number
)


def settings(node):
    """(property, item) of all that menus of a node offer, None first."""
    own = [
        p for p in node.bl_rna.properties if p.type == "ENUM" and not p.is_readonly and p.identifier not in bpy.types.Node.bl_rna.properties
    ]
    return [None, *((p.identifier, item.identifier) for p in own for item in p.enum_items)]


def feed(tree, node, make):
    """Link what `make` gives to all inputs of a node, or type NaN into them."""
    source = make(tree)
    for socket in list(node.inputs):
        if source is not None and socket.enabled:
            tree.links.new(source.outputs[0], socket)
        elif source is None and hasattr(socket, "default_value") and socket.type in ("VALUE", "RGBA", "VECTOR"):
            socket.default_value = NAN if socket.type == "VALUE" else [NAN] * len(socket.default_value)


def read(material):
    """The material as extraction has it, with its notices."""
    notices = Notices()
    found = Materials(bpy.context.evaluated_depsgraph_get(), notices)._read(material)
    for lobe in found.lobes:
        shape = [x for x in (lobe.roughness, lobe.ior) if isinstance(x, float)]
        assert np.isfinite([*shape, *(c for term in lobe.color.terms for c in term.constant)]).all()
    said = [str(n) for n in notices.result()]
    assert not [text for text in said if "cannot be read" in text]
    return found, said


def test_every_node_in_every_setting_can_be_read():
    """One material for each node, setting and feed: its output goes to a shader's every input, or to every input of the output node."""
    material = shader_material("m", "ShaderNodeBsdfDiffuse")
    tree, count = material.node_tree, 0
    for name in NODES:
        tree.nodes.clear()
        try:
            menus = settings(tree.nodes.new(name))
        except RuntimeError:  # a base class, or a node of another kind of tree
            continue
        # Every link makes Blender update the tree, so only the first setting has all feeds.
        pairs = [(None, make) for make in FEEDS] + [(setting, FEEDS[k % len(FEEDS)]) for k, setting in enumerate(menus[1:])]
        for setting, make in pairs:
            tree.nodes.clear()
            node = tree.nodes.new(name)
            if setting is not None:
                try:
                    setattr(node, *setting)
                except TypeError:  # an item that only other places offer
                    continue
            feed(tree, node, make)
            use(tree, node, all_inputs=make is huge)
            read(material)
            count += 1
    assert count > 400


def use(tree, node, all_inputs):
    """Link the first output of `node` to a shader, that to the surface, and the output to all else that the material has."""
    shader, add, end = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("BsdfPrincipled", "AddShader", "OutputMaterial"))
    tree.links.new(add.outputs[0], end.inputs["Surface"])
    tree.links.new(shader.outputs[0], add.inputs[0])
    output = next((s for s in node.outputs if s.enabled), None)
    if output is None:
        return
    names = [s.name for s in shader.inputs if s.enabled and (all_inputs or s.name in ("Base Color", "Roughness"))]
    for target in [add.inputs[1]] if output.type == "SHADER" else [shader.inputs[n] for n in names]:
        tree.links.new(output, target)
    for target in list(end.inputs)[1:]:
        tree.links.new(output, target)


@pytest.mark.parametrize("socket", ["Coat Weight", "Normal", "Roughness", "Base Color", "Volume", "Displacement", "Surface"])
def test_a_circle_of_links_feeds_nothing(socket):
    material = shader_material("m", "ShaderNodeBsdfPrincipled")
    tree = material.node_tree
    shader = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
    end = next(n for n in tree.nodes if n.bl_idname == "ShaderNodeOutputMaterial")
    tree.links.new(circle(tree).outputs[0], (shader if socket in shader.inputs else end).inputs[socket])
    found, said = read(material)
    assert not [text for text in said if "coat" in text or "bump" in text or "volume" in text or "displacement" in text]
    assert found.total("diffuse").constant == pytest.approx((0.8,) * 3)


def test_a_metal_given_by_its_index_of_refraction_has_that_reflectance():
    node = "ShaderNodeBsdfMetallic"
    if not hasattr(bpy.types, node):
        pytest.skip("this Blender has no Metallic BSDF")
    material = shader_material("m", node)
    metal = next(n for n in material.node_tree.nodes if n.bl_idname == node)
    metal.fresnel_type = "PHYSICAL_CONDUCTOR"
    metal.inputs["IOR"].default_value, metal.inputs["Extinction"].default_value = (0.2, 1.0, 1.5), (3.4, 0.0, 1.0)
    found, _ = read(material)
    right = ((0.8**2 + 3.4**2) / (1.2**2 + 3.4**2), 0.0, (0.5**2 + 1) / (2.5**2 + 1))
    assert found.total("glossy", "metallic").constant == pytest.approx(right)


def test_a_number_that_leaves_float32_into_a_color_ramp():
    material = shader_material("m", "ShaderNodeBsdfDiffuse")
    tree = material.node_tree
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    tree.links.new(huge(tree).outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], next(n for n in tree.nodes if n.bl_idname == "ShaderNodeBsdfDiffuse").inputs["Color"])
    found, said = read(material)
    assert found.total("diffuse").constant == pytest.approx((1, 1, 1))  # the end of the ramp
    assert [text for text in said if "not a number or too large" in text]
