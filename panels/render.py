# SPDX-License-Identifier: GPL-3.0-or-later
"""The method and its settings in the render properties, and Blender's own panels that make sense with our engine."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..adjoint_gi.bridge.engine.render_engine import ENGINE
from . import draw
from .base import Properties, has_method

# Stock panels for settings that this engine does not read.
EXCLUDED = {
    "DATA_PT_area",
    "DATA_PT_camera_dof",
    "DATA_PT_falloff_curve",
    "DATA_PT_light",
    "DATA_PT_shadow",
    "DATA_PT_spot",
    "RENDER_PT_context",
    "RENDER_PT_freestyle",
    "RENDER_PT_gpencil",
    "RENDER_PT_simplify",
    "SCENE_PT_audio",
    "VIEWLAYER_PT_filter",
    "VIEWLAYER_PT_freestyle",
    "VIEWLAYER_PT_layer_passes",
}
# Panels of EEVEE that show what this engine reads: material and world nodes, the power and size of lights.
BORROWED = {"DATA_PT_EEVEE_light", "EEVEE_MATERIAL_PT_context_material", "EEVEE_MATERIAL_PT_surface", "EEVEE_WORLD_PT_surface"}


class ADJOINTGI_PT_render_method(Properties, bpy.types.Panel):
    """Choice of the method"""

    bl_label = "Method"
    parts = (draw.choice,)


class ADJOINTGI_PT_render_settings(Properties, bpy.types.Panel):
    """Settings of the chosen method: its own fields, then the common ones"""

    bl_label = "Settings"
    bl_parent_id = "ADJOINTGI_PT_render_method"
    parts = (draw.settings, draw.common_settings)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether it is our engine and a method is chosen."""
        return super().poll(context) and has_method(context)


class ADJOINTGI_PT_render_film(Properties, bpy.types.Panel):
    """The picture's background"""

    bl_label = "Film"
    bl_options = {"DEFAULT_CLOSED"}
    parts = (draw.film,)


def stock_panels() -> Iterator[type[bpy.types.Panel]]:
    """Blender's panels for any engine that does not bring its own, and the borrowed ones."""
    for panel in bpy.types.Panel.__subclasses__():
        usual = "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ()) and panel.__name__ not in EXCLUDED
        if usual or panel.__name__ in BORROWED:
            yield panel


CLASSES = (ADJOINTGI_PT_render_method, ADJOINTGI_PT_render_settings, ADJOINTGI_PT_render_film)


def register() -> None:
    """Add ours and opt into the stock ones."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for panel in stock_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    """Take both back."""
    for panel in bpy.types.Panel.__subclasses__():
        getattr(panel, "COMPAT_ENGINES", set()).discard(ENGINE)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
