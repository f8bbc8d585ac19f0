# SPDX-License-Identifier: GPL-3.0-or-later
"""Modifiers and other settings that differ between viewport and render: a warning where a render is given something else."""

from __future__ import annotations

import bpy
import pytest
from adjgi.tests.blender.listing import engine, given_to_a_render, linked, listed, nodes, particles, plane, seen, told

__all__ = ["engine"]
pytestmark = pytest.mark.usefixtures("engine")


def modifier(kind, obj=None, **settings):
    made = (obj or plane("lost")).modifiers.new("Mod", kind)
    for name, value in settings.items():
        setattr(made, name, value)
    return made


def simplified():
    modifier("SUBSURF", levels=2, render_levels=2)
    render = bpy.context.scene.render
    render.use_simplify, render.simplify_subdivision, render.simplify_subdivision_render = True, 0, 1


def text_resolution():
    text = bpy.data.curves.new("lost", "FONT")
    text.body, text.render_resolution_u = "o", 30
    linked(bpy.data.objects.new("lost", text))


def metaball_resolution():
    ball = bpy.data.metaballs.new("lost")
    ball.elements.new()
    linked(bpy.data.objects.new("lost", ball))


def multires():
    plane("lost").modifiers.new("Mod", "MULTIRES")
    bpy.context.view_layer.objects.active = bpy.data.objects["lost"]
    for _ in range(2):
        bpy.ops.object.multires_subdivide(modifier="Mod")
    bpy.data.objects["lost"].modifiers["Mod"].levels = 1


def particles_displayed_in_part():
    particles(plane("lost"), render_type="OBJECT", instance_object=plane("source"), display_percentage=50)


def nodes_that_ask_for_the_viewport():
    host = plane("lost")
    nodes(host, obj=plane("source"))
    tree = host.modifiers[0].node_group
    ask = tree.nodes.new("GeometryNodeIsViewport")
    switch = tree.nodes.new("GeometryNodeSwitch")
    switch.input_type = "GEOMETRY"
    tree.links.new(ask.outputs[0], switch.inputs["Switch"])
    tree.links.new(next(n for n in tree.nodes if n.bl_idname == "GeometryNodeObjectInfo").outputs["Geometry"], switch.inputs["False"])
    tree.links.new(switch.outputs[0], next(n for n in tree.nodes if n.bl_idname == "NodeGroupOutput").inputs[0])


DIFFERENT = {
    "subdivision": (lambda: modifier("SUBSURF", levels=0, render_levels=2), '"Mod" (0 in the viewport, 2 in renders)'),
    "simplified": (simplified, '"Mod" (0 in the viewport, 1 in renders)'),
    "multires": (multires, '"Mod" (1 in the viewport, 2 in renders)'),
    "screw": (lambda: modifier("SCREW", steps=4, render_steps=8), '"Mod" (4 in the viewport, 8 in renders)'),
    "only in renders": (lambda: modifier("ARRAY", show_viewport=False), '"Mod" (on in renders only)'),
    "only in the viewport": (lambda: modifier("ARRAY", show_render=False), '"Mod" (on in the viewport only)'),
    "text": (text_resolution, "resolution (12 in the viewport, 30 in renders)"),
    "metaball": (metaball_resolution, "resolution (0.4 in the viewport, 0.2 in renders)"),
    "particles": (particles_displayed_in_part, "(50 % in the viewport)"),
    "nodes": (nodes_that_ask_for_the_viewport, "ask whether this is the viewport"),
}


@pytest.mark.parametrize("case", DIFFERENT)
def test_a_render_that_differs_is_named(case):
    build, words = DIFFERENT[case]
    build()
    arrays = seen()
    (notice,) = told(arrays, "lost", "a render differs")
    assert words in notice.reason and "the same" in notice.remedy
    assert given_to_a_render() != listed(arrays), "the warning is true"


SAME = {
    "levels": lambda: modifier("SUBSURF", levels=2, render_levels=2),
    "off": lambda: modifier("SUBSURF", levels=0, render_levels=2, show_viewport=False, show_render=False),
    "simplified": lambda: (modifier("SUBSURF", levels=1, render_levels=2), setattr(bpy.context.scene.render, "use_simplify", True),
                           setattr(bpy.context.scene.render, "simplify_subdivision", 1),
                           setattr(bpy.context.scene.render, "simplify_subdivision_render", 1)),
    "array": lambda: modifier("ARRAY"),
    "hair": lambda: particles(plane("lost"), type="HAIR", display_percentage=50),
}  # fmt: skip


@pytest.mark.parametrize("case", SAME)
def test_a_render_that_is_the_same_is_not_named(case):
    SAME[case]()
    arrays = seen()
    assert not told(arrays, "lost", "a render differs")
    assert given_to_a_render() == listed(arrays)


def test_nothing_is_said_of_objects_that_do_not_count():
    modifier("SUBSURF", levels=0, render_levels=2)
    bpy.data.objects["lost"].hide_render = True
    assert not told(seen(), "lost", "a render differs")
