# SPDX-License-Identifier: GPL-3.0-or-later
"""The one bake that may run in the background of a Blender with a window: started, polled by a timer, written, stopped, continued.

The driver's thread computes on copied arrays and never touches `bpy`; everything here runs on the main thread. Between two ticks only
session_uids are kept, so undo, renaming and deleting cannot leave a dead reference.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.method.solution import Solution
from ..host import preferences
from ..props import properties, records
from ..results import kept
from ..results.lightmap_uv import find_uv_layer
from .preflight import ordered, target_objects
from .watch import Targets

if TYPE_CHECKING:
    from .bake import Bake, BakeRequest

POLL = 0.1  # seconds between two looks at the driver
STOP = 1.0  # seconds within which the driver must have stopped
SHARE = 0.1  # largest share of the main thread's time that partial writes may take


class Job:
    """One bake with its driver, the objects it is for, and what became of it.

    `state` is "running", "stopping", "stopped", "finished", "failed" or "cancelled"; `notices` says what went wrong.
    """

    def __init__(self, context: bpy.types.Context, request: BakeRequest) -> None:
        self.request = request
        self.scene = context.scene.session_uid
        before = _made()
        self.bake = new_bake(context, request)
        if _made() != before:
            push_undo("Adjoint GI Lightmap UVs")
        objects = target_objects(context, request) if request.target != "render" else ()
        layers = {o.session_uid: find_uv_layer(o, request.uv_layer) for o in objects} if request.target == "texture" else {}
        self.targets = Targets(objects, layers)
        self.state = "running"
        self.notices: list[Notice] = []
        self.solution: Solution | None = None  # kept while it could not be written
        self._kept = ""  # the file that it is kept in
        self.undone = False  # the user has undone something since it was started
        self._written = 0  # version of the driver's partial result that was written last
        self._next_write = 0.0

    @property
    def active(self) -> bool:
        """Whether its thread may still be computing."""
        return self.state in ("running", "stopping")

    def start(self) -> None:
        """Let the driver compute in its thread."""
        preferences.apply_threads()
        self.bake.driver.start()
        self._next_write = time.monotonic() + preferences.refresh_seconds()

    def poll(self) -> None:
        """Look at the driver once: write a partial result, or finish."""
        state = self.bake.driver.state
        if state == "running":
            if self.state == "running":
                self._write_partial()
        elif state == "failed":
            self.fail(self.bake.driver.error)
        else:
            self.conclude("finished" if state == "finished" else "stopped")

    def stop(self, wait: float = STOP) -> None:
        """Ask the driver to stop, and write what it has if it does so in `wait` seconds; otherwise a later `poll` writes it."""
        if self.state == "running":
            self.state = "stopping"
            if self.bake.driver.stop(wait) and wait:
                self.poll()

    def resume(self) -> None:
        """Go on from the partial result; raises `AdjointError` when that is not possible."""
        if self.state != "stopped":
            raise AdjointError("Continue", "there is no stopped bake", "Press Bake to start one")
        for problem in ordered(self.targets.problems()):
            raise AdjointError(problem.object, problem.reason, problem.remedy)
        self.state, self.notices = "running", []
        preferences.apply_threads()
        self.bake.driver.resume()
        self._next_write = time.monotonic() + preferences.refresh_seconds()

    def cancel(self) -> None:
        """Drop the work: nothing more is written. The thread is joined, or left to end by itself after a second."""
        self.bake.driver.cancel(STOP)
        self.state = "cancelled"

    def conclude(self, state: str) -> None:
        """Write what the driver has, note its numbers on the scene, and make one undo step of it."""
        self.state = state
        self.solution, self._kept = self.bake.driver.solution(), ""
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
            except AdjointError as error:
                # Images are in the .blend file even where their files could not be written.
                self.notices, applied = [error.notice], bool(self.bake.written)
        complete, told = not self.notices, list(self.notices)
        if not applied:
            if not Path(self._kept).is_file():
                self._kept = kept.save(solution)
            files = [self._kept]
            self.notices.append(Notice("", f"The result is kept in {self._kept} and was not written to the objects", "", "warning"))
        elif not complete:
            remedy = "Choose a folder in Output, or none, and press Write Result"
            self.notices.append(Notice("", "The images are in the .blend file; their files are missing", remedy, "warning"))
        if scene is not None:
            # Where a result is kept stands in the record's files already.
            told = self.notices if applied else told
            notices = dict.fromkeys([*told, *self.bake.notices, *solution.warnings])
            record = scene.adjoint_gi.result
            what = {name: getattr(self.request, name) for name in ("target", "quantity", "new_object")}
            records.store(record, solution, **what, applied=applied, files=files, notices=notices)
        if complete:
            self.solution = None
        if applied:
            push_undo("Adjoint GI Bake" if self.state == "finished" else "Adjoint GI Partial Bake")

    def fail(self, error: BaseException | None) -> None:
        """The solver or a write raised: say so, and keep the last partial result if there is one."""
        self.state = "failed"
        notice = error.notice if isinstance(error, AdjointError) else Notice("", f"{type(error).__name__}: {error}", "", "error")
        self.notices = [notice]
        self.solution, self._kept = self.bake.driver.solution(), ""

    def find_scene(self) -> bpy.types.Scene | None:
        """The scene it was started in."""
        return scene_of(self.scene)

    def _write_partial(self) -> None:
        """Show how far it is, at most once in the refresh time, and never for more than a small share of the time."""
        driver, now = self.bake.driver, time.monotonic()
        if self.undone or driver.version == self._written or now < self._next_write:
            return
        self._written = driver.version
        solution = driver.solution()
        if solution is not None and self.find_scene() is not None and not self.targets.problems(thorough=False):
            before = _made()
            self.bake.write(solution)
            if _made() != before:
                push_undo("Adjoint GI Bake Under Way")
        spent = time.monotonic() - now
        self._next_write = time.monotonic() + max(preferences.refresh_seconds(), spent / SHARE)


def scene_of(uid: int) -> bpy.types.Scene | None:
    """The scene of this session_uid; None when it is gone."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def elsewhere(uid: int, scene: bpy.types.Scene) -> str:
    """Name of the scene of this session_uid where that is another one than `scene`; empty where it is not, or is gone."""
    own = scene_of(uid)
    return own.name if own is not None and own != scene else ""


def new_bake(context: bpy.types.Context, request: BakeRequest) -> Bake:
    """The bake that a job drives: copies the scene and makes the driver."""
    from .bake import Bake

    return Bake(context, request)


_job: Job | None = None


def current() -> Job | None:
    """The job that runs, or the last one of this session."""
    return _job


def running() -> bool:
    """Whether a bake is under way."""
    return _job is not None and _job.active


def start(context: bpy.types.Context, request: BakeRequest) -> Job:
    """Start a bake in the background; raises `AdjointError` when one is running or the scene cannot be baked."""
    global _job
    if running():
        raise AdjointError("Bake", "another bake is running", "Stop it or wait for its end")
    job = Job(context, request)
    job.start()
    _job = job
    _ensure_timer()
    return job


def run(context: bpy.types.Context, request: BakeRequest, progress: Callable[[float], None]) -> Job:
    """Bake to the end in the foreground, for scripts and background mode; raises `AdjointError` as `start` does."""
    global _job
    if running():
        raise AdjointError("Bake", "another bake is running", "Stop it or wait for its end")
    job = Job(context, request)
    preferences.apply_threads()
    _job = job
    try:
        job.bake.driver.run(lambda driver: progress(driver.fraction))
        job.poll()
    except AdjointError as error:
        job.fail(error)
    return job


def stop() -> None:
    """Stop the running bake and keep its partial result."""
    if running():
        _job.stop()
        redraw()


def resume() -> None:
    """Continue the stopped bake; raises `AdjointError` when there is none or its objects have changed."""
    if _job is None:
        raise AdjointError("Continue", "there is no stopped bake", "Press Bake to start one")
    _job.resume()
    _ensure_timer()


def forget() -> None:
    """Cancel what runs, join its thread within a second, and forget it. Does nothing when there is no job."""
    global _job
    job, _job = _job, None
    if job is not None and job.active:
        job.cancel()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def tick() -> None:
    """Look at the job once; this is what the timer does."""
    job = _job
    if job is None or not job.active:
        return
    try:
        job.poll()
    except Exception as error:  # whatever happens in a timer must reach the user, or the bake would seem to run for ever
        job.bake.driver.stop(STOP)
        job.fail(error)
    redraw()


def redraw() -> None:
    """Have the areas that show the job or its result drawn again."""
    manager = bpy.context.window_manager
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PROPERTIES", "IMAGE_EDITOR"):
                area.tag_redraw()


def push_undo(message: str) -> None:
    """One undo step for what was just written.

    Without a window (Blender's undo operator wants one), an operator of ours that does nothing has the step made. Never inside
    `temp_override`: up to Blender 5.0 C code reads its dictionary without Python's lock while threads run, and crashes.
    """
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message=message)
    else:
        bpy.ops.adjoint_gi.undo_step("EXEC_DEFAULT", True)


def _made() -> tuple[int, ...]:
    """Counts of what a bake can add to a file. Whatever is added needs an undo step of its own.

    An undo takes over unchanged datablocks as they are: one that has got a pointer to a new image, while the undo stack knows nothing
    of that image, would point to freed memory, and Blender crashes.
    """
    meshes = bpy.data.meshes
    return len(bpy.data.images), len(bpy.data.objects), sum(len(m.uv_layers) for m in meshes), sum(len(m.attributes) for m in meshes)


def _tick() -> float | None:
    tick()
    return POLL if running() else None


def _ensure_timer() -> None:
    # Persistent: a timer that a file load drops would leave the job without anyone to finish it.
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=POLL, persistent=True)


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    forget()


@bpy.app.handlers.persistent
def _after_undo(*_: object) -> None:
    """Undo may have taken back the objects that are being baked: then the job stops and keeps what it has."""
    if not running():
        return
    _job.undone = True  # a partial write may need an undo step of its own, which would take the user's redo away
    if _job.find_scene() is None or _job.targets.problems(thorough=False):
        _job.stop(wait=0)  # written by the next tick: inside an undo nothing may be written


def listen(handlers: Iterable[tuple[str, Callable]]) -> None:
    """Add functions to the lists of `bpy.app.handlers` that are named with them."""
    for name, handler in handlers:
        getattr(bpy.app.handlers, name).append(handler)


def stop_listening(handlers: Iterable[tuple[str, Callable]]) -> None:
    """Take them out again; doing it twice changes nothing."""
    for name, handler in handlers:
        with contextlib.suppress(ValueError):
            getattr(bpy.app.handlers, name).remove(handler)


HANDLERS = (("load_pre", _before_load), ("undo_post", _after_undo), ("redo_post", _after_undo))


def register() -> None:
    """Listen to file loads and undo, and make sure that quitting ends the thread."""
    listen(HANDLERS)
    atexit.register(_at_exit)


def unregister() -> None:
    """End the job, its timer and the handlers; doing it twice changes nothing."""
    forget()
    stop_listening(HANDLERS)
    atexit.unregister(_at_exit)


def _at_exit() -> None:
    """Quitting: only the thread is ended, for Blender's data is going or gone."""
    if _job is not None and _job.active:
        _job.bake.driver.cancel(STOP)
