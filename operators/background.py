# SPDX-License-Identifier: GPL-3.0-or-later
"""What the operators of bakes and comparisons have in common: start a job, stop it, clear what it has left; and the undo step of a job."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.host import background
from ..adjoint_gi.bridge.props.records import AdjointError, Notice


def report(operator: bpy.types.Operator, notice: Notice) -> None:
    """Report a notice. Without a window an ERROR would become a RuntimeError in the calling script, which has the return value instead."""
    kind = {"info": "INFO", "warning": "WARNING", "error": "ERROR"}[notice.severity]
    operator.report({"WARNING" if kind == "ERROR" and bpy.app.background else kind}, str(notice))


class Guarded:
    """Can be pressed unless `refusal` gives a reason why not, which is shown with the greyed button."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Why it cannot be pressed now; empty when it can."""
        return ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Asked by Blender whenever it draws the button, and before it is pressed."""
        reason = cls.refusal(context)
        if reason:
            cls.poll_message_set(reason)
        return not reason


class Starts(Guarded):
    """Starts a job of `runner`: `request` makes what it is asked for, `summary` the sentence about its result."""

    # Not UNDO: the job makes its own undo step when it writes, and the redo panel of an UNDO operator would start another job.
    bl_options = {"REGISTER"}
    runner: background.Runner

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """A job that runs, or a scene that cannot keep a result."""
        return background.busy() or ("The scene is linked from another file" if context.scene.library else "")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """With a window: start in the background."""
        if bpy.app.background:
            return self.execute(context)
        try:
            self.runner.start(context, self.request(context))
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """From a script: run to the end."""
        manager = context.window_manager
        manager.progress_begin(0, 100)
        try:
            job = self.runner.run(context, self.request(context), lambda fraction: manager.progress_update(100 * fraction))
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        finally:
            manager.progress_end()
        for notice in job.remarks:
            report(self, notice)
        if not job.complete:
            return {"CANCELLED"}
        self.report({"INFO"}, self.summary(context.scene))
        return {"FINISHED"}


class Stops(Guarded):
    """Stops the running job of `runner`."""

    bl_options = {"INTERNAL"}
    runner: background.Runner

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Nothing to stop."""
        return "" if cls.runner.running else f"No {cls.runner.noun} is running"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Stop within a second."""
        self.runner.stop()
        return {"FINISHED"}


class Clears(Guarded):
    """Clears what jobs of `runner` have left, by `clear`, and forgets the last one; not while one is running."""

    bl_options = {"REGISTER", "UNDO"}
    runner: background.Runner

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """A job that runs."""
        return f"A {cls.runner.noun} is running" if cls.runner.running else ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Clear the record."""
        try:
            self.clear(context.scene)
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        self.runner.forget()
        return {"FINISHED"}


class ADJOINTGI_OT_undo_step(bpy.types.Operator):
    """Make an undo step of what a job has written"""

    bl_idname = "adjoint_gi.undo_step"
    bl_label = "Adjoint GI"
    bl_options = {"INTERNAL", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Nothing: Blender makes the step after it."""
        return {"FINISHED"}


classes = (ADJOINTGI_OT_undo_step,)
