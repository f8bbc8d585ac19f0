# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes of constants: what every operation comes to equals what Cycles shows, all of them in one picture."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract import materials, world
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.tests.blender.test_extract_colors import Graph, silent
from adjgi.tests.cycles_patch import render_patch, white_plane

# Math of constants, where its definition can be got wrong: operation and inputs. Results are above -6.
MATH = [
    ("MODULO", -5.5, 2.0),
    ("MODULO", 5.5, -2.0),
    ("TRUNC", -1.5),
    ("ROUND", 2.5),
    ("ROUND", -1.5),
    ("FLOOR", -1.5),
    ("CEIL", -1.5),
    ("FRACT", -1.25),
    ("COMPARE", 1.0, 1.3, 0.3),
    ("COMPARE", 1.0, 1.0, 0.0),
    ("LOGARITHM", 8.0, 2.0),
    ("POWER", -2.0, 2.0),
    ("POWER", -2.0, 0.5),
    ("DIVIDE", 1.0, 0.0),
    ("SIGN", -3.0),
    ("INVERSE_SQRT", 4.0),
    ("DEGREES", 0.1),
    ("RADIANS", 90.0),
    ("LESS_THAN", 1.0, 1.0),
    ("GREATER_THAN", 1.0, 1.0),
    ("EXPONENT", 1.0),
    ("TANGENT", 1.0),
]
BLENDS = ("DARKEN", "LIGHTEN", "DIFFERENCE", "EXCLUSION", "DIVIDE", "OVERLAY")
BELOW, ABOVE = (0.2, 0.6, 0.4, 1), (0.9, 0.3, 0.45, 1)


def shown_constants():
    """One graph for each way to compute a constant: its output, plus 6 where it may be negative, is what it emits."""
    graphs = []

    def new():
        graphs.append(Graph())
        return graphs[-1]

    for operation, *values in MATH:
        g = new()
        node = g.add("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, values, strict=False):
            socket.default_value = value
        above = g.add("ShaderNodeMath", operation="ADD")
        above.inputs[1].default_value = 6.0
        g.link(node.outputs[0], above.inputs[0])
        g.show(above.outputs[0])
    for kind in BLENDS:
        g = new()
        mix = g.add("ShaderNodeMixRGB", blend_type=kind)
        for socket, value in zip(mix.inputs, (0.7, BELOW, ABOVE), strict=True):
            socket.default_value = value
        g.show(mix.outputs[0])
    for interpolation in ("CONSTANT", "LINEAR"):
        g = new()
        ramp = g.add("ShaderNodeValToRGB")
        ramp.color_ramp.interpolation = interpolation
        ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = BELOW, ABOVE
        ramp.inputs[0].default_value = 0.7
        g.show(ramp.outputs[0])
    for kind in ("MINMAX", "RANGE"):
        g = new()
        g.show(g.add("ShaderNodeClamp", values={"Value": 0.5, "Min": 0.8, "Max": 0.3}, clamp_type=kind).outputs[0])
    # A vector, and a colour, as a number.
    g = new()
    vector = g.add("ShaderNodeMix", values={"Factor": 0.25, "A": (0.3, 0.6, 0.0), "B": (0.1, 0.2, 0.9)}, data_type="VECTOR")
    number = g.add("ShaderNodeMath", values={"Value": next(o for o in vector.outputs if o.enabled)}, operation="ADD")
    number.inputs[1].default_value = 0.0
    g.show(number.outputs[0])
    g = new()
    color = g.add("ShaderNodeRGB")
    color.outputs[0].default_value = ABOVE
    g.show(g.add("ShaderNodeMath", values={"Value": color.outputs[0]}, operation="ABSOLUTE").outputs[0])
    return graphs


def test_constants_of_every_node_equal_cycles():
    """A strip of a plane for each."""
    graphs = shown_constants()
    n = len(graphs)
    mesh = bpy.data.meshes.new("strips")
    x = np.linspace(-1, 1, n + 1)
    mesh.from_pydata([(a, b, 0) for b in (-1, 1) for a in x], [], [(i, i + 1, i + n + 2, i + n + 1) for i in range(n)])
    for g in graphs:
        mesh.materials.append(g.material)
    mesh.polygons.foreach_set("material_index", np.arange(n))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("strips", mesh))
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    ours = [arrays.materials[arrays.material[2 * i]].total("emission").constant for i in range(n)]
    theirs = render_patch(width=2.0, pixels=n, samples=1)[n // 2]
    np.testing.assert_allclose(ours, theirs, atol=6e-3)
    assert silent(arrays)


@pytest.mark.parametrize("owner", ["material", "world"])
def test_what_has_no_nodes_has_the_colour_that_is_typed(monkeypatch, owner):
    """Blender 5 gives nodes to all of them; there it is asked as if these were off."""
    color = (0.2, 0.4, 0.8)
    for module in (materials, world):
        monkeypatch.setattr(module, "uses_nodes", lambda owner: False)
    if owner == "world":
        made = bpy.data.worlds.new("typed")
        made.color, bpy.context.scene.world = color, made
        assert extract(bpy.context.evaluated_depsgraph_get()).background == pytest.approx(color)
        return
    made = bpy.data.materials.new("typed")
    made.diffuse_color = (*color, 0.5)
    white_plane(2.0, made)
    assert extract(bpy.context.evaluated_depsgraph_get()).materials[0].total("diffuse").constant == pytest.approx(color)
