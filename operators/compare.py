# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare methods, stop comparing, show the pictures, forget them."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.comparison import records
from ..adjoint_gi.bridge.comparison.job import COMPARISONS
from ..adjoint_gi.bridge.comparison.request import CompareRequest
from .background import Clears, Starts, Stops


class ADJOINTGI_OT_compare(Starts, bpy.types.Operator):
    """Solve the scene by all ticked methods with the same budget, and compare the results"""

    bl_idname = "adjoint_gi.compare"
    bl_label = "Compare"
    runner = COMPARISONS

    def request(self, context: bpy.types.Context) -> CompareRequest:
        """What the panel asks for."""
        return records.request_of(context.scene, context.view_layer)

    def summary(self, scene: bpy.types.Scene) -> str:
        """Which method is best."""
        return scene.adjoint_gi_compare.result.headline


class ADJOINTGI_OT_stop_comparing(Stops, bpy.types.Operator):
    """Stop comparing and keep what there is"""

    bl_idname = "adjoint_gi.stop_comparing"
    bl_label = "Stop"
    runner = COMPARISONS


class ADJOINTGI_OT_show_comparison(bpy.types.Operator):
    """Show this picture in an image editor; a window is opened for it where there is none"""

    bl_idname = "adjoint_gi.show_comparison"
    bl_label = "Show Picture"
    bl_options = {"REGISTER"}

    picture: bpy.props.StringProperty(name="Picture", description="Which one of the last comparison")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Find or open an image editor."""
        entry = context.scene.adjoint_gi_compare.result.pictures.get(self.picture)
        if entry is None or entry.image is None:
            self.report({"WARNING"}, f"There is no picture {self.picture!r}; compare again")
            return {"CANCELLED"}
        area = next((a for w in context.window_manager.windows for a in w.screen.areas if a.type == "IMAGE_EDITOR"), None)
        if area is None:
            if bpy.app.background:
                self.report({"WARNING"}, "There is no window to show it in")
                return {"CANCELLED"}
            bpy.ops.wm.window_new()
            area = context.window_manager.windows[-1].screen.areas[0]
            area.type = "IMAGE_EDITOR"
        area.spaces.active.image = entry.image
        return {"FINISHED"}


class ADJOINTGI_OT_clear_comparison(Clears, bpy.types.Operator):
    """Forget the table and the pictures of the last comparison"""

    bl_idname = "adjoint_gi.clear_comparison"
    bl_label = "Clear Comparison"
    runner = COMPARISONS

    def clear(self, scene: bpy.types.Scene) -> None:
        """The table and the pictures."""
        records.clear(scene.adjoint_gi_compare.result)


classes = (ADJOINTGI_OT_compare, ADJOINTGI_OT_stop_comparing, ADJOINTGI_OT_show_comparison, ADJOINTGI_OT_clear_comparison)
