# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake, stop, continue, write and check."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.baking import check, jobs
from ..adjoint_gi.bridge.comparison import job as compare_job
from ..adjoint_gi.bridge.props.properties import request_of
from ..adjoint_gi.bridge.props.records import AdjointError, Notice


def tell(operator: bpy.types.Operator, notice: Notice) -> None:
    """Report a notice. Without a window an ERROR would become a RuntimeError in the calling script, which has the return value instead."""
    kind = {"info": "INFO", "warning": "WARNING", "error": "ERROR"}[notice.severity]
    operator.report({"WARNING" if kind == "ERROR" and bpy.app.background else kind}, str(notice))


def summary(result: bpy.types.PropertyGroup) -> str:
    """One sentence with the numbers of a bake."""
    text = f"{'Partial result' if result.partial else 'Baked'} in {result.seconds:.1f} s with {int(result.rays or 0):,} rays"
    return f"{text}, energy gap {100 * result.gap:.2g} %" if result.has_balance else text


# Not UNDO: the job makes its own undo step when it writes, and the redo panel of an UNDO operator would start another bake.
class ADJOINTGI_OT_bake(bpy.types.Operator):
    """Solve the scene with the chosen method and write the result"""

    bl_idname = "adjoint_gi.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if jobs.running():
            cls.poll_message_set("A bake is running")
            return False
        if compare_job.running():
            cls.poll_message_set("Methods are being compared")
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
            jobs.start(context, request_of(context.scene, context.view_layer))
        except AdjointError as error:
            tell(self, error.notice)
            return {"CANCELLED"}
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """From a script: bake to the end."""
        manager = context.window_manager
        manager.progress_begin(0, 100)
        try:
            job = jobs.run(context, request_of(context.scene, context.view_layer), lambda fraction: manager.progress_update(100 * fraction))
        except AdjointError as error:
            tell(self, error.notice)
            return {"CANCELLED"}
        finally:
            manager.progress_end()
        for notice in (*job.notices, *job.bake.notices):
            if notice.severity != "info":
                tell(self, notice)
        if job.state != "finished" or job.solution is not None:  # a kept solution is one that was not written
            return {"CANCELLED"}
        self.report({"INFO"}, summary(context.scene.adjoint_gi.result))
        return {"FINISHED"}


class ADJOINTGI_OT_stop(bpy.types.Operator):
    """Stop the bake and keep what it has"""

    bl_idname = "adjoint_gi.stop"
    bl_label = "Stop"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not jobs.running():
            cls.poll_message_set("No bake is running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Stop within a second."""
        jobs.stop()
        return {"FINISHED"}


class ADJOINTGI_OT_resume(bpy.types.Operator):
    """Go on from the partial result"""

    bl_idname = "adjoint_gi.resume"
    bl_label = "Continue"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        job = jobs.current()
        if job is None or job.state != "stopped":
            cls.poll_message_set("No bake was stopped")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the thread again."""
        try:
            jobs.resume()
        except AdjointError as error:
            tell(self, error.notice)
            return {"CANCELLED"}
        return {"FINISHED"}


class ADJOINTGI_OT_write(bpy.types.Operator):
    """Write the kept result to its objects, now that what stood in the way is gone"""

    bl_idname = "adjoint_gi.write"
    bl_label = "Write Result"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        job = jobs.current()
        if job is None or job.active or job.solution is None:
            cls.poll_message_set("Every result has been written")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Try again."""
        job = jobs.current()
        job.write_again()
        for notice in job.notices:
            tell(self, notice)
        return {"CANCELLED"} if job.notices else {"FINISHED"}


class ADJOINTGI_OT_undo_step(bpy.types.Operator):
    """Make an undo step of what a bake has written"""

    bl_idname = "adjoint_gi.undo_step"
    bl_label = "Adjoint GI"
    bl_options = {"INTERNAL", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Nothing: Blender makes the step after it."""
        return {"FINISHED"}


class ADJOINTGI_OT_check(bpy.types.Operator):
    """Look for what would keep the bake from working"""

    bl_idname = "adjoint_gi.check"
    bl_label = "Check"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Report what is found."""
        check.refresh()
        notices = check.now(context)
        for notice in notices:
            tell(self, notice)
        if not notices:
            self.report({"INFO"}, "Nothing is missing")
        return {"FINISHED"}


classes = (ADJOINTGI_OT_bake, ADJOINTGI_OT_stop, ADJOINTGI_OT_resume, ADJOINTGI_OT_write, ADJOINTGI_OT_undo_step, ADJOINTGI_OT_check)
