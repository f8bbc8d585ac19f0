# SPDX-License-Identifier: GPL-3.0-or-later
"""Show results on the objects, put the user's materials back, forget the numbers."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.baking.jobs import BAKES
from ..adjoint_gi.bridge.props import records
from ..adjoint_gi.bridge.props.records import AdjointError
from ..adjoint_gi.bridge.results import show as results
from ..adjoint_gi.bridge.results.remove import remove_results
from .background import Clears, Guarded, report


class ADJOINTGI_OT_show_result(Guarded, bpy.types.Operator):
    """Show the baked light on the objects; Restore Materials takes it back"""

    bl_idname = "adjoint_gi.show_result"
    bl_label = "Show Result"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Nothing to show."""
        baked = context.scene.adjoint_gi.result.target in ("texture", "attribute")
        return "" if baked else "Nothing was baked to a texture or attribute"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Give the objects a material that emits the result."""
        try:
            count = results.show(context.scene, context.view_layer)
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        self.report({"INFO"}, f"Showing the result on {count} object{'s' if count != 1 else ''}")
        left = results.not_exported(context.scene)
        if left is not None:
            report(self, left)
        return {"FINISHED"}


class ADJOINTGI_OT_restore(bpy.types.Operator):
    """Put the materials back as they were before Show Result"""

    bl_idname = "adjoint_gi.restore"
    bl_label = "Restore Materials"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them back."""
        count = results.restore(context.scene)
        self.report({"INFO"}, f"Restored the materials of {count} object{'s' if count != 1 else ''}")
        return {"FINISHED"}


class ADJOINTGI_OT_clear_results(Clears, bpy.types.Operator):
    """Put the materials back and forget the numbers of the last bake; baked images and attributes stay unless they are removed, too"""

    bl_idname = "adjoint_gi.clear_results"
    bl_label = "Clear Results"
    runner = BAKES

    remove: bpy.props.BoolProperty(
        name="Remove Baked Data",
        description="Also remove the images, attributes, UV layers and objects that bakes have made in this scene; files stay",
        default=False,
        options={"SKIP_SAVE"},
    )

    def clear(self, scene: bpy.types.Scene) -> None:
        """Restore, then remove what was asked for, then clear."""
        results.restore(scene)
        if self.remove:
            counts = remove_results(scene)
            what = ", ".join(f"{n} {kind}{'s' if n != 1 else ''}" for kind, n in counts.items() if n)
            self.report({"INFO"}, f"Removed {what or 'nothing: no bake has left anything in this scene'}")
        records.clear(scene.adjoint_gi.result)


classes = (ADJOINTGI_OT_show_result, ADJOINTGI_OT_restore, ADJOINTGI_OT_clear_results)
