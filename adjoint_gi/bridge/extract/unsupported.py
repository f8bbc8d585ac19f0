"""Where the viewport evaluates an object in another way than a render does; Cycles bakes what a render evaluates."""

from __future__ import annotations

import bpy

from ..host.notices import Notices
from .members import node_trees

# Modifiers with a level for the viewport and one for renders (measured: tests/blender/test_extract_viewport.py).
LEVELS = {
    "SUBSURF": ("levels", "render_levels"),
    "MULTIRES": ("levels", "render_levels"),
    "SCREW": ("steps", "render_steps"),
    "OCEAN": ("viewport_resolution", "resolution"),
}
SIMPLIFIED = ("SUBSURF", "MULTIRES")  # those that Simplify limits


def name_viewport(obj: bpy.types.Object, scene: bpy.types.Scene, notices: Notices) -> None:
    """A warning when a render would give `obj` (original) another shape or other particles than a depsgraph of the viewport does."""
    found = [text for modifier in obj.modifiers for text in _modifier(modifier, scene)]
    if any(node.bl_idname == "GeometryNodeIsViewport" for tree in node_trees(obj) for node in tree.nodes):
        found.append("geometry nodes that ask whether this is the viewport")
    for system in obj.particle_systems:
        settings = system.settings
        if settings.display_percentage != 100 and settings.render_type in ("OBJECT", "COLLECTION"):
            found.append(f'particles "{system.name}" ({settings.display_percentage} % in the viewport)')
    if obj.type in ("CURVE", "SURFACE", "FONT"):
        found += _pair("resolution", obj.data.resolution_u, obj.data.render_resolution_u or obj.data.resolution_u)
    elif obj.type == "META":
        found += _pair("resolution", obj.data.resolution, obj.data.render_resolution)
    if found:
        reason = f"is computed as the viewport has it, and a render differs: {', '.join(found)}"
        notices.add(obj.name, reason, "Make viewport and render the same")


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
    return _pair(name, viewport, render)


def _pair(what: str, viewport: float, render: float) -> list[str]:
    return [] if viewport == render else [f"{what} ({viewport:.3g} in the viewport, {render:.3g} in renders)"]
