# SPDX-License-Identifier: GPL-3.0-or-later
"""The one comparison that may run in the background: its thread never touches `bpy`, a timer looks after it, and stopping it takes a
second at most. It writes nothing into the scene before its end, and then its table and pictures as one undo step.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.comparison.run import Result
from ..baking import jobs
from ..host import files, preferences
from . import records as compare_records
from .files import check_files, write_files
from .request import Compare, CompareRequest

POLL = jobs.POLL
STOP = jobs.STOP


class CompareJob:
    """`state` is "running", "stopping", "stopped", "finished", "failed" or "cancelled"; `notices` says what went wrong."""

    def __init__(self, context: bpy.types.Context, request: CompareRequest, folder: str = "") -> None:
        self.scene = context.scene.session_uid
        self.folder = files.output_folder(folder) if folder else None
        if self.folder is not None:
            check_files(request, self.folder)
        layers = sum(len(m.uv_layers) for m in bpy.data.meshes)
        self.made = Compare(context, request)
        if sum(len(m.uv_layers) for m in bpy.data.meshes) != layers:
            jobs.push_undo("Adjoint GI Lightmap UVs")
        self.state = "running"
        self.notices: list[Notice] = []

    @property
    def active(self) -> bool:
        """Whether its thread may still be computing."""
        return self.state in ("running", "stopping")

    def poll(self) -> None:
        """Look at the driver once, and finish when it has."""
        driver = self.made.driver
        if driver.state == "running":
            return
        if driver.state == "failed":
            self.fail(driver.error)
            return
        self.state = "finished" if driver.state == "finished" else "stopped"
        result = driver.solution()
        if result is None or not (result.entries or result.refused):
            self.notices = [Notice("", "Stopped before the first result", "", "info")]
            return
        self.write(result)

    def write(self, result: Result) -> None:
        """Table and pictures into the scene that it was started in, and files where a folder is set."""
        scene = next((s for s in bpy.data.scenes if s.session_uid == self.scene), None)
        paths: list[str] = []
        try:
            if self.folder is not None and result.entries:
                paths = [str(p) for p in write_files(self.made, result, self.folder)]
        except AdjointError as error:  # the scene gets the result all the same
            self.notices = [error.notice]
        try:
            if scene is None:
                raise AdjointError("Scene", "was deleted while methods were compared", "Compare again")
            record = scene.adjoint_gi_compare.result
            compare_records.store(record, result, self.made.notices, paths)
            compare_records.store_pictures(record, self.made.pictures(result))
        except AdjointError as error:
            self.notices = [*self.notices, error.notice]
        if scene is not None:
            jobs.push_undo("Adjoint GI Comparison")

    def fail(self, error: BaseException | None) -> None:
        """The comparison raised: say so."""
        self.state = "failed"
        notice = error.notice if isinstance(error, AdjointError) else Notice("", f"{type(error).__name__}: {error}", "", "error")
        self.notices = [notice]


_job: CompareJob | None = None


def current() -> CompareJob | None:
    """The job that runs, or the last one of this session."""
    return _job


def running() -> bool:
    """Whether methods are being compared."""
    return _job is not None and _job.active


def start(context: bpy.types.Context, request: CompareRequest, folder: str = "") -> CompareJob:
    """Start in the background; raises `AdjointError` when something runs already or the scene cannot be compared."""
    job = _new(context, request, folder)
    job.made.driver.start()
    # Persistent: a timer that a file load drops would leave the job without anyone to finish it.
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=POLL, persistent=True)
    return job


def run(context: bpy.types.Context, request: CompareRequest, progress: Callable[[float], None], folder: str = "") -> CompareJob:
    """Compare to the end in the foreground, for scripts; raises `AdjointError` as `start` does."""
    job = _new(context, request, folder)
    try:
        job.made.driver.run(lambda driver: progress(driver.fraction))
        job.poll()
    except AdjointError as error:
        job.fail(error)
    return job


def _new(context: bpy.types.Context, request: CompareRequest, folder: str) -> CompareJob:
    global _job
    if running() or jobs.running():
        raise AdjointError("Compare", "a bake or comparison is running", "Stop it or wait for its end")
    preferences.apply_threads()
    _job = CompareJob(context, request, folder)
    return _job


def stop(wait: float = STOP) -> None:
    """Stop the running comparison and keep what it has; the next tick writes it."""
    job = _job
    if job is not None and job.state == "running":
        job.state = "stopping"
        job.made.driver.stop(wait)
        jobs.redraw()


def forget() -> None:
    """Cancel what runs, join its thread within a second, and forget it. Does nothing when there is no job."""
    global _job
    job, _job = _job, None
    if job is not None and job.active:
        job.made.driver.cancel(STOP)
        job.state = "cancelled"
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def tick() -> None:
    """Look at the job once; this is what the timer does."""
    job = _job
    if job is None or not job.active:
        return
    try:
        job.poll()
    except Exception as error:  # whatever happens in a timer must reach the user, or the run would seem to go on for ever
        job.made.driver.stop(STOP)
        job.fail(error)
    jobs.redraw()


def _tick() -> float | None:
    tick()
    return POLL if running() else None


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    forget()


@bpy.app.handlers.persistent
def _after_undo(*_: object) -> None:
    """Undo may have taken back the scene that is being compared; inside an undo nothing may be written, so the next tick does."""
    if running() and not any(s.session_uid == _job.scene for s in bpy.data.scenes):
        stop(wait=0)


HANDLERS = (("load_pre", _before_load), ("undo_post", _after_undo), ("redo_post", _after_undo))


def register() -> None:
    """Listen to file loads and undo, and make sure that quitting ends the thread."""
    jobs.listen(HANDLERS)
    atexit.register(_at_exit)


def unregister() -> None:
    """End the job, its timer and the handlers; doing it twice changes nothing."""
    forget()
    jobs.stop_listening(HANDLERS)
    atexit.unregister(_at_exit)


def _at_exit() -> None:
    """Quitting: only the thread is ended, for Blender's data is going or gone."""
    if _job is not None and _job.active:
        _job.made.driver.cancel(STOP)
