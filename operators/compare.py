# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare methods, stop comparing, show the pictures, forget them."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.baking import jobs
from ..adjoint_gi.bridge.comparison import job as compare_job
from ..adjoint_gi.bridge.comparison import records as compare_records
from ..adjoint_gi.bridge.props.records import AdjointError
from .bake import tell


# Not UNDO: the job makes its own undo step when it writes, and the redo panel would start another comparison.
class ADJOINTGI_OT_compare(bpy.types.Operator):
    """Solve the scene by all ticked methods with the same budget, and compare the results"""

    bl_idname = "adjoint_gi.compare"
    bl_label = "Compare"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if jobs.running() or compare_job.running():
            cls.poll_message_set("A bake or comparison is running")
            return False
        if context.scene.library:
            cls.poll_message_set("The scene is linked from another file")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """With a window: start in the background."""
        if bpy.app.background:
            return self.execute(context)
        try:
            compare_job.start(
                context, compare_records.request_of(context.scene, context.view_layer), context.scene.adjoint_gi_compare.folder
            )
        except AdjointError as error:
            tell(self, error.notice)
            return {"CANCELLED"}
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """From a script: compare to the end."""
        manager = context.window_manager
        manager.progress_begin(0, 100)
        try:
            request = compare_records.request_of(context.scene, context.view_layer)
            job = compare_job.run(
                context, request, lambda fraction: manager.progress_update(100 * fraction), context.scene.adjoint_gi_compare.folder
            )
        except AdjointError as error:
            tell(self, error.notice)
            return {"CANCELLED"}
        finally:
            manager.progress_end()
        for notice in job.notices:
            tell(self, notice)
        if job.state != "finished" or job.notices:
            return {"CANCELLED"}
        self.report({"INFO"}, context.scene.adjoint_gi_compare.result.headline)
        return {"FINISHED"}


class ADJOINTGI_OT_stop_comparing(bpy.types.Operator):
    """Stop comparing and keep what there is"""

    bl_idname = "adjoint_gi.stop_comparing"
    bl_label = "Stop"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not compare_job.running():
            cls.poll_message_set("Nothing is being compared")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Stop within a second."""
        compare_job.stop()
        return {"FINISHED"}


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


class ADJOINTGI_OT_clear_comparison(bpy.types.Operator):
    """Forget the table and the pictures of the last comparison"""

    bl_idname = "adjoint_gi.clear_comparison"
    bl_label = "Clear Comparison"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if compare_job.running():
            cls.poll_message_set("A comparison is running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clear the record."""
        compare_records.clear(context.scene.adjoint_gi_compare.result)
        compare_job.forget()
        return {"FINISHED"}


classes = (ADJOINTGI_OT_compare, ADJOINTGI_OT_stop_comparing, ADJOINTGI_OT_show_comparison, ADJOINTGI_OT_clear_comparison)
