# SPDX-License-Identifier: GPL-3.0-or-later
"""What a render evaluates in another way than the viewport does."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

# Modifiers with a level for the viewport and one for renders (measured: tests/blender/test_extract_viewport.py).
LEVELS = {
    "SUBSURF": ("levels", "render_levels"),
    "MULTIRES": ("levels", "render_levels"),
    "SCREW": ("steps", "render_steps"),
    "OCEAN": ("viewport_resolution", "resolution"),
}
SIMPLIFIED = ("SUBSURF", "MULTIRES")  # those that Simplify limits
MADE_BY_US = "adjoint_gi"  # custom property of node groups that bakes make


def node_trees(host: bpy.types.Object) -> Iterator[bpy.types.NodeTree]:
    """The geometry node trees of an object's modifiers, with the groups inside them, each once."""
    waiting = [m.node_group for m in host.modifiers if m.type == "NODES" and m.node_group is not None]
    seen: set[bpy.types.NodeTree] = set()
    while waiting:
        tree = waiting.pop()
        if tree not in seen:
            seen.add(tree)
            yield tree
            waiting += [node.node_tree for node in tree.nodes if getattr(node, "node_tree", None) is not None]


def differences(obj: bpy.types.Object, scene: bpy.types.Scene) -> list[str]:
    """What makes the modifiers of `obj` (original) give a render another mesh: words for each. Node groups made by us do not."""
    ours = [tree for tree in node_trees(obj) if MADE_BY_US in tree]
    theirs = [m for m in obj.modifiers if m.type != "NODES" or m.node_group not in ours]
    found = [text for modifier in theirs for text in _modifier(modifier, scene)]
    if any(node.bl_idname == "GeometryNodeIsViewport" for tree in node_trees(obj) if tree not in ours for node in tree.nodes):
        found.append("geometry nodes that ask whether this is the viewport")
    return found


def _modifier(modifier: bpy.types.Modifier, scene: bpy.types.Scene) -> list[str]:
    """What differs of one modifier."""
    name = f'modifier "{modifier.name}"'
    if modifier.show_viewport != modifier.show_render:
        return [f"{name} (on in {'renders' if modifier.show_render else 'the viewport'} only)"]
    if not modifier.show_render or modifier.type not in LEVELS:
        return []
    viewport, render = (getattr(modifier, attribute) for attribute in LEVELS[modifier.type])
    if scene.render.use_simplify and modifier.type in SIMPLIFIED:
        viewport = min(viewport, scene.render.simplify_subdivision)
        render = min(render, scene.render.simplify_subdivision_render)
    return pair(name, viewport, render)


def pair(what: str, viewport: float, render: float) -> list[str]:
    """Words for two values where they differ."""
    return [] if viewport == render else [f"{what} ({viewport:.3g} in the viewport, {render:.3g} in renders)"]
