# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Adjoint GI" of the 3D View."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.props.properties import chosen
from . import draw


class Tab:
    """Where these panels stand."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Adjoint GI"


class ADJOINTGI_PT_main(Tab, bpy.types.Panel):
    """Choice of the method"""

    bl_label = "Adjoint GI"

    def draw(self, context: bpy.types.Context) -> None:
        """Strategy, nature, method."""
        draw.choice(self.layout, context)


class ADJOINTGI_PT_bake(Tab, bpy.types.Panel):
    """Bake, stop, continue"""

    bl_label = "Bake"
    bl_parent_id = "ADJOINTGI_PT_main"
    bl_options = {"HIDE_HEADER"}

    def draw(self, context: bpy.types.Context) -> None:
        """Check, buttons, progress."""
        draw.bake(self.layout, context)


class ADJOINTGI_PT_result(Tab, bpy.types.Panel):
    """Numbers of the last bake"""

    bl_label = "Result"
    bl_parent_id = "ADJOINTGI_PT_main"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(context.scene.adjoint_gi.result.method)

    def draw(self, context: bpy.types.Context) -> None:
        """Numbers, warnings, files, buttons."""
        draw.result(self.layout, context)


class ADJOINTGI_PT_settings(Tab, bpy.types.Panel):
    """Settings of the chosen method"""

    bl_label = "Settings"
    bl_parent_id = "ADJOINTGI_PT_main"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen(context.scene) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Its own fields."""
        draw.settings(self.layout, context)


class ADJOINTGI_PT_paths(Tab, bpy.types.Panel):
    """Path lengths and seed, which every method has"""

    bl_label = "Paths and Seed"
    bl_parent_id = "ADJOINTGI_PT_settings"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """The common fields."""
        draw.common_settings(self.layout, context)


class ADJOINTGI_PT_output(Tab, bpy.types.Panel):
    """What is written, and where"""

    bl_label = "Output"
    bl_parent_id = "ADJOINTGI_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """Target and what it needs."""
        draw.output(self.layout, context)


class ADJOINTGI_PT_texels(Tab, bpy.types.Panel):
    """How texels are covered"""

    bl_label = "Texels"
    bl_parent_id = "ADJOINTGI_PT_output"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.adjoint_gi.target == "texture"

    def draw(self, context: bpy.types.Context) -> None:
        """Margin and points."""
        draw.texels(self.layout, context)


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
