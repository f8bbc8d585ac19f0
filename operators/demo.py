# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds the demonstration scene."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.props.records import AdjointError
from .background import report


class ADJOINTGI_OT_add_demo_scene(bpy.types.Operator):
    """Add a scene with a Cornell box: two boxes, an area light and colored walls, ready to bake"""

    bl_idname = "adjoint_gi.add_demo_scene"
    bl_label = "Add Cornell Box"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Build it in a scene of its own."""
        from ..adjoint_gi.bridge.cli import cornell as demo

        try:
            scene = demo.build_cornell()
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        if context.window:
            context.window.scene = scene
        return {"FINISHED"}


classes = (ADJOINTGI_OT_add_demo_scene,)
