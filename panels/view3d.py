# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Adjoint GI" of the 3D View."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.properties import chosen
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


class ADJOINTGI_PT_settings(Tab, bpy.types.Panel):
    """Settings of the chosen method"""

    bl_label = "Settings"
    bl_parent_id = "ADJOINTGI_PT_main"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return chosen(context.scene) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """All fields of its settings."""
        draw.settings(self.layout, context)


class ADJOINTGI_PT_output(Tab, bpy.types.Panel):
    """What is written, and where"""

    bl_label = "Output"
    bl_parent_id = "ADJOINTGI_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """Target and what it needs."""
        draw.output(self.layout, context)


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


register, unregister = bpy.utils.register_classes_factory(
    (ADJOINTGI_PT_main, ADJOINTGI_PT_settings, ADJOINTGI_PT_output, ADJOINTGI_PT_bake, ADJOINTGI_PT_result)
)
