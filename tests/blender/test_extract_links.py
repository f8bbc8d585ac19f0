# SPDX-License-Identifier: GPL-3.0-or-later
"""Which links of a node tree count: those that Cycles follows."""

from __future__ import annotations

import bpy
import pytest
from adjgi.tests.blender.test_extract_colors import Graph, both, silent


def emitted(graph):
    """The constant colour that the graph emits by Cycles and by ours."""
    arrays = both(graph)
    assert silent(arrays)
    return arrays.materials[arrays.material[0]].total("emission").constant


def test_a_muted_link_leaves_the_value_that_was_typed():
    g = Graph()
    rgb = g.add("ShaderNodeRGB")
    rgb.outputs[0].default_value = (0.9, 0.1, 0.1, 1.0)
    g.show(rgb.outputs[0])
    g.emission.inputs["Color"].default_value = (0.2, 0.3, 0.4, 1.0)
    g.emission.inputs["Color"].links[0].is_muted = True
    assert emitted(g) == pytest.approx((0.2, 0.3, 0.4), abs=1e-5)


@pytest.mark.parametrize("active", [0, 1])
def test_of_two_outputs_of_a_group_the_active_one_counts(active):
    g = Graph()
    tree = bpy.data.node_groups.new("g", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    ends = [tree.nodes.new("NodeGroupOutput") for _ in range(2)]
    for end, color in zip(ends, ((0.2, 0.3, 0.4, 1), (0.7, 0.6, 0.5, 1)), strict=True):
        end.inputs[0].default_value = color
    ends[active].is_active_output = True
    group = g.add("ShaderNodeGroup")
    group.node_tree = tree
    g.show(group.outputs[0])
    assert emitted(g) == pytest.approx(((0.2, 0.3, 0.4), (0.7, 0.6, 0.5))[active], abs=1e-5)
