# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake, stop, continue, write and check."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.baking import check, jobs, textures
from ..adjoint_gi.bridge.host import background
from ..adjoint_gi.bridge.props.properties import request_of
from ..adjoint_gi.bridge.props.records import AdjointError, plain
from ..adjoint_gi.bridge.props.request import BakeRequest
from .background import Guarded, Starts, Stops, report


class ADJOINTGI_OT_bake(Starts, bpy.types.Operator):
    """Solve the scene with the chosen method and write the result"""

    bl_idname = "adjoint_gi.bake"
    bl_label = "Bake"
    runner = jobs.BAKES

    def request(self, context: bpy.types.Context) -> BakeRequest:
        """What the panel asks for; a check under way makes room."""
        check.stop()
        return request_of(context.scene, context.view_layer)

    def summary(self, scene: bpy.types.Scene) -> str:
        """The numbers of the bake."""
        result = scene.adjoint_gi.result
        text = f"{'Partial result' if result.partial else 'Baked'} in {result.seconds:.1f} s with {int(result.rays or 0):,} rays"
        return f"{text}, energy gap {plain(100 * result.gap)} %" if result.has_balance else text


class ADJOINTGI_OT_stop(Stops, bpy.types.Operator):
    """Stop the bake and keep what it has"""

    bl_idname = "adjoint_gi.stop"
    bl_label = "Stop"
    runner = jobs.BAKES


class ADJOINTGI_OT_resume(Guarded, bpy.types.Operator):
    """Go on from the partial result"""

    bl_idname = "adjoint_gi.resume"
    bl_label = "Continue"
    bl_options = {"INTERNAL"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Nothing to continue."""
        job = jobs.BAKES.job
        return "" if job is not None and job.resumable else "No bake was stopped"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the thread again."""
        try:
            jobs.resume()
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        return {"FINISHED"}


class ADJOINTGI_OT_write(Guarded, bpy.types.Operator):
    """Write the kept result to its objects, now that what stood in the way is gone"""

    bl_idname = "adjoint_gi.write"
    bl_label = "Write Result"
    bl_options = {"INTERNAL"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """Nothing to write."""
        job = jobs.BAKES.job
        return "Every result has been written" if job is None or job.active or job.solution is None else ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Try again."""
        job = jobs.BAKES.job
        job.write_again()
        for notice in job.notices:
            report(self, notice)
        return {"CANCELLED"} if job.notices else {"FINISHED"}


class ADJOINTGI_OT_renew_uvs(Guarded, bpy.types.Operator):
    """Make the lightmap UVs of what is to be baked anew, also where they fit; images of earlier bakes do not fit them"""

    bl_idname = "adjoint_gi.renew_uvs"
    bl_label = "Renew Lightmap UVs"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        """A job that runs, or a target without UVs of ours."""
        state = context.scene.adjoint_gi
        own = (
            "" if state.target == "texture" and not state.uv_layer else "Lightmap UVs are made for image textures without a named UV layer"
        )
        return background.busy() or own

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the user's materials back, which show the old ones, and unwrap."""
        try:
            objects, notices = textures.renew(context, request_of(context.scene, context.view_layer))
        except AdjointError as error:
            report(self, error.notice)
            return {"CANCELLED"}
        for notice in notices:
            report(self, notice)
        self.report({"INFO"}, f"Made the lightmap UVs of {objects} object{'s' if objects != 1 else ''}; bake again")
        return {"FINISHED"}


class ADJOINTGI_OT_check(bpy.types.Operator):
    """Look for what would prevent the bake"""

    bl_idname = "adjoint_gi.check"
    bl_label = "Check"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """With a window: look in slices; the panel shows what is found."""
        if bpy.app.background:
            return self.execute(context)
        check.look_again()
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """From a script: report what is found."""
        check.refresh()
        check.stop(background.STOP)
        notices = check.now(context)
        for notice in notices:
            report(self, notice)
        if not notices:
            self.report({"INFO"}, "Nothing is missing")
        return {"FINISHED"}


class ADJOINTGI_OT_stop_check(bpy.types.Operator):
    """Stop looking for what would prevent the bake; what is known at once stays"""

    bl_idname = "adjoint_gi.stop_check"
    bl_label = "Stop Check"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Stop after the part that runs."""
        check.stop()
        return {"FINISHED"}


classes = (
    ADJOINTGI_OT_bake,
    ADJOINTGI_OT_stop,
    ADJOINTGI_OT_resume,
    ADJOINTGI_OT_write,
    ADJOINTGI_OT_renew_uvs,
    ADJOINTGI_OT_check,
    ADJOINTGI_OT_stop_check,
)
