# SPDX-License-Identifier: GPL-3.0-or-later
"""Color Ramp and RGB Curves: the tables that Cycles makes of them, where they have steps and beyond their ends; nodes of clipped images."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.tests.blender.test_extract_colors import PIXELS, Graph, both, silent


def numbers(values):
    """A float image of these numbers from left to right."""
    image = bpy.data.images.new("numbers", len(values), 1, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(np.repeat(np.asarray(values, np.float32)[:, None], 4, axis=1).ravel())
    image.pack()
    return image


@pytest.mark.parametrize("position", [0.25, 0.6, 0.9])
def test_constant_steps_of_a_ramp_are_where_the_table_of_cycles_has_them(position):
    """At 64 / 256, 154 / 256 and 231 / 256: a table of 256 intervals."""
    g = Graph()
    ramp = g.add("ShaderNodeValToRGB")
    ramp.color_ramp.interpolation = "CONSTANT"
    ramp.color_ramp.elements[1].position = position
    g.link(g.image(numbers(position + (np.arange(PIXELS) - 7.5) / 1024), interpolation="Closest").outputs["Color"], ramp.inputs[0])
    g.show(ramp.outputs[0])
    assert silent(both(g))


@pytest.mark.parametrize(("extend", "first", "last"), [("EXTRAPOLATED", 0.2, 0.8), ("EXTRAPOLATED", -0.3, 1.4), ("HORIZONTAL", 0.2, 0.8)])
def test_curves_beyond_their_ends(extend, first, last):
    g = Graph()
    curve = g.add("ShaderNodeRGBCurve")
    curve.mapping.use_clip, curve.mapping.extend = False, extend
    ends = curve.mapping.curves[3].points
    ends[0].location, ends[1].location = (first, 0.2), (last, 0.7)
    curve.mapping.curves[0].points.new(0.5, 0.8)
    curve.mapping.update()
    g.link(g.image(numbers(np.linspace(0.0, 2.0, PIXELS)), interpolation="Closest").outputs["Color"], curve.inputs["Color"])
    g.show(curve.outputs[0])
    assert silent(both(g))


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("ShaderNodeInvert", {}),
        ("ShaderNodeBrightContrast", {"Contrast": 0.4}),
        ("ShaderNodeGamma", {"Gamma": 2.0}),
        ("ShaderNodeValToRGB", {}),
        ("ShaderNodeClamp", {"Min": 0.3, "Max": 0.6}),
        ("ShaderNodeMath", {}),
    ],
)
def test_outside_of_a_clipped_image_nodes_get_black(kind, values):
    """What they make of it there is seldom black; two of them in a row, of which the second gets what the first has made of black."""
    g = Graph()
    mapping = g.add("ShaderNodeMapping", None, {"Location": (-0.3, -0.2, 0.0), "Scale": (1.7, 1.8, 1.0)})
    g.link(g.add("ShaderNodeTexCoord").outputs["UV"], mapping.inputs["Vector"])
    image = g.image(interpolation="Closest", extension="CLIP")
    g.link(mapping.outputs[0], image.inputs["Vector"])
    node = g.add(kind, None, values)
    if kind == "ShaderNodeValToRGB":
        for element, color in zip(node.color_ramp.elements, ((0.2, 0.7, 0.4, 1), (0.9, 0.1, 0.3, 1)), strict=True):
            element.color = color
    if kind == "ShaderNodeMath":
        node.operation, node.use_clamp = "MULTIPLY_ADD", True
        node.inputs[1].default_value, node.inputs[2].default_value = -3.0, 1.4
    first = next(s for s in node.inputs if s.enabled and (s.name in ("Color", "Value") or kind == "ShaderNodeValToRGB"))
    g.link(image.outputs["Color"], first)
    second = g.add("ShaderNodeInvert", None, {"Color": node.outputs[0]})
    second.inputs[0].default_value = 0.8
    g.show(second.outputs[0])
    assert silent(both(g, atol=6e-3))
