# SPDX-License-Identifier: GPL-3.0-or-later
"""The one bake that may run in the background: it shows its partial results, writes, and can be continued or written again."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import traceback
from pathlib import Path

import bpy

from ...core.base.errors import AdjointError, MemoryRefused, Notice, SceneError
from ...core.method.solution import Solution
from ..host import background, preferences
from ..host.prepared import PreparedJob
from ..props import properties
from ..props.request import BakeRequest
from ..results import kept
from ..results.lightmap_uv import find_uv_layer
from .bake import Bake
from .preflight import ordered, target_objects
from .watch import Targets

SHARE = 0.1  # largest share of the main thread's time that partial writes may take


class BakeJob(PreparedJob):
    """One bake, the objects it is for, and the result that could not be written yet."""

    def __init__(self, context: bpy.types.Context, request: BakeRequest) -> None:
        """Raises `AdjointError` when the scene cannot be baked."""
        self.request = request
        self.bake = Bake(context, request, now=False)
        super().__init__(context.scene.session_uid, self.bake.preparing())
        self.targets = Targets(())  # those it is for, once it is prepared
        self.solution: Solution | None = None  # kept while it could not be written
        self._kept = ""  # the file that it is kept in
        self._written = 0  # version of the driver's partial result that was written last
        self._next_write = 0.0

    @property
    def complete(self) -> bool:
        """Whether it has ended and its whole result was written."""
        return self.state == "finished" and self.solution is None

    @property
    def remarks(self) -> list[Notice]:
        """Also what was found before the solve."""
        return [notice for notice in (*self.notices, *self.bake.notices) if notice.severity != "info"]

    def take_driver(self) -> None:
        """The driver takes the place of what prepared it; from now on its objects are watched."""
        context = bpy.context
        self.request = request = self.bake.request
        objects = target_objects(context, request) if request.target != "render" else ()
        layers = {o.session_uid: find_uv_layer(o, request.uv_layer) for o in objects} if request.target == "texture" else {}
        self.targets, self.driver = Targets(objects, layers), self.bake.driver
        self._next_write = time.monotonic() + preferences.refresh_seconds()

    @property
    def resumable(self) -> bool:
        """Whether the solve can go on: it was stopped, by the user or because something else than the method failed."""
        return self.state in ("stopped", "failed") and self.driver.state == "stopped"

    def resume(self) -> None:
        """Go on from the partial result; raises `AdjointError` when that is not possible."""
        for problem in ordered(self.targets.problems()):
            raise AdjointError(problem.object, problem.reason, problem.remedy)
        self.state, self.notices = "running", []
        preferences.apply_threads()
        self.driver.resume()
        self._next_write = time.monotonic() + preferences.refresh_seconds()

    def conclude(self, state: str) -> None:
        """Write what the driver has, note its numbers on the scene, and make one undo step of it."""
        self.state = state
        self.solution, self._kept = self.driver.solution(), ""
        if self.solution is None:
            self.notices = [Notice("", "Stopped before the first result", "Continue, or bake again", "info")]
            return
        self.write()

    def write_again(self) -> None:
        """Write the kept result, now that what stood in the way is gone; files go to the folder that the panel has now."""
        scene = self.find_scene()
        if scene is not None:
            self.request = self.bake.request = dataclasses.replace(self.request, output=properties.folder_of(scene, self.request.target))
        self.write()

    def write(self) -> None:
        """Write the final or stopped result to its objects, or to a file of its own when they have changed."""
        solution, files = self.solution, []
        scene = self.find_scene()
        self.notices = ordered(self.targets.problems())
        if scene is None:
            self.notices = [Notice("Scene", "was deleted while it was baked", "", "error")]
        applied = not self.notices
        if applied:
            try:
                self.bake.write(solution)
                files = self.bake.files
            except Exception as error:  # whatever it was: the work is not lost
                if not isinstance(error, AdjointError | OSError):
                    traceback.print_exc()
                # Images are in the .blend file even where their files could not be written.
                self.notices, applied = [background.notice_of(error)], bool(self.bake.written)
        complete, problems = not self.notices, list(self.notices)
        if not applied:
            files = self._keep(solution)
        elif not complete:
            remedy = "Choose a folder in Output, or none, and press Write Result"
            self.notices.append(Notice("", "The images are in the .blend file; their files are missing", remedy, "warning"))
        if scene is not None:
            # Where a result is kept stands in the record's files already.
            problems = self.notices if applied else problems
            self.bake.remember(scene, solution, [*problems, *self.bake.notices], files, applied)
        if complete:
            self.solution = None
        if applied:
            background.push_undo("Adjoint GI Bake" if self.state == "finished" else "Adjoint GI Partial Bake")

    def _keep(self, solution: Solution) -> list[str]:
        """Keep the result as a file, once, and say so; returns its path. Where there is no room for it, it stays in memory."""
        try:
            if not Path(self._kept).is_file():
                self._kept = kept.save(solution)
        except AdjointError as error:
            remedy = "Make room, then press Write Result before you close Blender or bake again"
            self.notices += [error.notice, Notice("", "The result is kept in memory and was not written to the objects", remedy, "warning")]
            return []
        self.notices.append(Notice("", f"The result is kept in {self._kept} and was not written to the objects", "", "warning"))
        return [self._kept]

    def fail(self, error: BaseException | None) -> None:
        """The solver or a write raised: also keep the last partial result if there is one."""
        super().fail(error)
        if not self.preparing and isinstance(error, SceneError | MemoryRefused) and self.driver.solution() is None:
            self.bake.take_back()
        self.solution, self._kept = self.driver.solution(), ""

    def has_lost_targets(self) -> bool:
        """Whether its scene or objects are gone, or others."""
        return super().has_lost_targets() or bool(self.targets.problems(thorough=False))

    def show_partial(self) -> None:
        """Show how far it is, at most once in the refresh time, and never for more than a small share of the time."""
        driver, now = self.driver, time.monotonic()
        if self.undone or driver.version == self._written or now < self._next_write:
            return
        self._written = driver.version
        solution = driver.solution()
        if solution is not None and self.find_scene() is not None and not self.targets.problems(thorough=False):
            # What cannot be written now may be at the end, or the result is kept then: the solve goes on.
            with background.undo_step_of_additions("Adjoint GI Bake Under Way"), contextlib.suppress(AdjointError, OSError):
                self.bake.write(solution)
        spent = time.monotonic() - now
        self._next_write = time.monotonic() + max(preferences.refresh_seconds(), spent / SHARE)


BAKES = background.Runner("bake", BakeJob)


def resume() -> None:
    """Continue the stopped bake; raises `AdjointError` when there is none or its objects have changed."""
    if BAKES.job is None or not BAKES.job.resumable:
        raise AdjointError("Continue", "there is no stopped bake", "Press Bake to start one")
    BAKES.job.resume()
    background.ensure_timer()
