# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Adjoint GI" of the 3D View."""

from __future__ import annotations

import bpy

from . import draw
from .base import Tab, has_method


class ADJOINTGI_PT_main(Tab, bpy.types.Panel):
    """Choice of the method"""

    bl_label = "Adjoint GI"
    parts = (draw.choice,)


class ADJOINTGI_PT_bake(Tab, bpy.types.Panel):
    """Bake, stop, continue"""

    bl_label = "Bake"
    bl_parent_id = "ADJOINTGI_PT_main"
    bl_options = {"HIDE_HEADER"}
    parts = (draw.bake,)


class ADJOINTGI_PT_result(Tab, bpy.types.Panel):
    """Numbers of the last bake"""

    bl_label = "Result"
    bl_parent_id = "ADJOINTGI_PT_main"
    parts = (draw.result,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether something was baked."""
        return bool(context.scene.adjoint_gi.result.method)


class ADJOINTGI_PT_settings(Tab, bpy.types.Panel):
    """Settings of the chosen method"""

    bl_label = "Settings"
    bl_parent_id = "ADJOINTGI_PT_main"
    parts = (draw.settings,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a method is chosen."""
        return has_method(context)


class ADJOINTGI_PT_paths(Tab, bpy.types.Panel):
    """Path lengths and seed, which every method has"""

    bl_label = "Paths and Seed"
    bl_parent_id = "ADJOINTGI_PT_settings"
    bl_options = {"DEFAULT_CLOSED"}
    parts = (draw.common_settings,)


class ADJOINTGI_PT_output(Tab, bpy.types.Panel):
    """What is written, and where"""

    bl_label = "Output"
    bl_parent_id = "ADJOINTGI_PT_main"
    parts = (draw.output,)


class ADJOINTGI_PT_texels(Tab, bpy.types.Panel):
    """How texels are covered"""

    bl_label = "Texels"
    bl_parent_id = "ADJOINTGI_PT_output"
    bl_options = {"DEFAULT_CLOSED"}
    parts = (draw.texels,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether texels are baked."""
        return context.scene.adjoint_gi.target == "texture"


CLASSES = (
    ADJOINTGI_PT_main,
    ADJOINTGI_PT_bake,
    ADJOINTGI_PT_result,
    ADJOINTGI_PT_settings,
    ADJOINTGI_PT_paths,
    ADJOINTGI_PT_output,
    ADJOINTGI_PT_texels,
)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
