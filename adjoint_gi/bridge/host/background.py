# SPDX-License-Identifier: GPL-3.0-or-later
"""Work in the background of a Blender with a window: at most one job of a kind, polled by a timer, stopped, forgotten.

A job has a driver whose thread computes on copied arrays and never touches `bpy`; everything here runs on the main thread. Between two
ticks only session_uids are kept, so undo, renaming and deleting cannot leave a dead reference. Bakes and comparisons are its users.
"""

from __future__ import annotations

import abc
import atexit
import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.method.driver import Driver
from . import preferences

POLL = 0.1  # seconds between two looks at the drivers
STOP = 1.0  # seconds within which a driver must have stopped


class Job(abc.ABC):
    """One piece of work with its driver, started in the scene of session_uid `scene`.

    state     "running", "stopping", "stopped", "finished", "failed" or "cancelled"
    notices   what went wrong
    undone    the user has undone something since it was started
    """

    def __init__(self, scene: int, driver: Driver) -> None:
        self.scene, self.driver = scene, driver
        self.state = "running"
        self.notices: list[Notice] = []
        self.undone = False

    @property
    def active(self) -> bool:
        """Whether its thread may still be computing."""
        return self.state in ("running", "stopping")

    @property
    @abc.abstractmethod
    def complete(self) -> bool:
        """Whether it has ended and its whole result was written."""

    @property
    def remarks(self) -> list[Notice]:
        """What is reported to a script that waited for it: everything but infos."""
        return [notice for notice in self.notices if notice.severity != "info"]

    def start(self) -> None:
        """Let the driver compute in its thread."""
        self.driver.start()

    def ready(self) -> None:  # noqa: B027  most jobs are ready when they are made
        """Called in the foreground before the driver runs."""

    def poll(self) -> None:
        """Look at the driver once: show a partial result, or finish."""
        state = self.driver.state
        if state == "running":
            if self.state == "running":
                self.show_partial()
        elif state == "failed":
            self.fail(self.driver.error)
        else:
            self.conclude("finished" if state == "finished" else "stopped")

    def show_partial(self) -> None:  # noqa: B027  most jobs have nothing to show
        """Called by every poll while the driver computes."""

    @abc.abstractmethod
    def conclude(self, state: str) -> None:
        """Write what the driver has, as one undo step; `state` is "finished" or "stopped"."""

    def stop(self, wait: float = STOP) -> None:
        """Ask the driver to stop, and write what it has if it does so in `wait` seconds; otherwise a later `poll` writes it."""
        if self.state == "running":
            self.state = "stopping"
            if self.driver.stop(wait) and wait:
                self.poll()

    def cancel(self) -> None:
        """Drop the work: nothing more is written. The thread is joined, or left to end by itself after a second."""
        self.driver.cancel(STOP)
        self.state = "cancelled"

    def fail(self, error: BaseException | None) -> None:
        """The solver or a write raised: keep the error as a notice."""
        self.state = "failed"
        self.notices = [notice_of(error)]

    def find_scene(self) -> bpy.types.Scene | None:
        """The scene it was started in; None when it is gone."""
        return scene_of(self.scene)

    def has_lost_targets(self) -> bool:
        """Whether what its result is for is gone, as an undo may take it back."""
        return self.find_scene() is None


def notice_of(error: BaseException | None) -> Notice:
    """What is said of an error, whether it was raised on purpose or not."""
    if isinstance(error, AdjointError):
        return error.notice
    return Notice("", f"{type(error).__name__}: {error}", "", "error")


class Runner:
    """Runs at most one job of a kind at a time, and keeps the last one. `noun` is what such a job is called, `make` makes one of a context
    and a request and raises `AdjointError` when it is refused."""

    def __init__(self, noun: str, make: Callable[[bpy.types.Context, Any], Job]) -> None:
        self.noun, self.make = noun, make
        self.job: Job | None = None  # that runs, or the last one of this session
        RUNNERS.append(self)

    @property
    def running(self) -> bool:
        """Whether one is under way."""
        return self.job is not None and self.job.active

    def start(self, context: bpy.types.Context, request: Any) -> Job:
        """Start one in the background; raises `AdjointError` when a job of any kind is running, or this one is refused."""
        before, job = self.job, self._new(context, request)
        try:
            job.start()
        except AdjointError:
            self.job = before
            raise
        ensure_timer()
        return job

    def run(self, context: bpy.types.Context, request: Any, progress: Callable[[float], None]) -> Job:
        """Run one to its end in the foreground, for scripts and background mode; raises `AdjointError` as `start` does."""
        before, job = self.job, self._new(context, request)
        try:
            job.ready()
        except BaseException:
            self.job = before
            raise
        try:
            job.driver.run(lambda driver: progress(driver.fraction))
            job.poll()
        except AdjointError as error:
            job.fail(error)
        except Exception as error:
            job.fail(error)  # what it has can still be written
            raise
        return job

    def _new(self, context: bpy.types.Context, request: Any) -> Job:
        busy = next((runner for runner in RUNNERS if runner.running), None)
        if busy is not None:
            reason = f"{'another' if busy is self else 'a'} {busy.noun} is running"
            raise AdjointError(self.noun.title(), reason, "Stop it or wait for its end")
        preferences.apply_threads()
        self.job = self.make(context, request)
        return self.job

    def stop(self, wait: float = STOP) -> None:
        """Stop the running job and keep its partial result. With `wait` 0 the next tick writes it."""
        if self.running:
            self.job.stop(wait)
            redraw()

    def tick(self) -> None:
        """Look at the running job once."""
        job = self.job
        if job is None or not job.active:
            return
        try:
            job.poll()
        except Exception as error:  # whatever happens in a timer must reach the user, or the job would seem to run for ever
            job.driver.stop(STOP)
            job.fail(error)
        redraw()

    def forget(self) -> None:
        """Cancel what runs, join its thread within a second, and forget it. Does nothing when there is no job."""
        job, self.job = self.job, None
        if job is not None and job.active:
            job.cancel()
        if not busy() and bpy.app.timers.is_registered(_tick):
            bpy.app.timers.unregister(_tick)


RUNNERS: list[Runner] = []


def busy() -> str:
    """Which job is under way, as a sentence; empty when none is."""
    return next((f"A {runner.noun} is running" for runner in RUNNERS if runner.running), "")


def tick() -> None:
    """Look at every job once; this is what the timer does."""
    for runner in RUNNERS:
        runner.tick()


def forget_all() -> None:
    """Cancel whatever runs, and forget it."""
    for runner in RUNNERS:
        runner.forget()


def ensure_timer() -> None:
    """Have the timer look at the jobs."""
    # Persistent: a timer that a file load drops would leave a job without anyone to finish it.
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=POLL, persistent=True)


def _tick() -> float | None:
    tick()
    return POLL if busy() else None


def scene_of(uid: int) -> bpy.types.Scene | None:
    """The scene of this session_uid; None when it is gone."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def elsewhere(uid: int, scene: bpy.types.Scene) -> str:
    """Name of the scene of this session_uid where that is another one than `scene`; empty where it is not, or is gone."""
    own = scene_of(uid)
    return own.name if own is not None and own != scene else ""


def redraw() -> None:
    """Have the areas that show a job or its result drawn again."""
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


@contextlib.contextmanager
def undo_step_of_additions(message: str) -> Iterator[None]:
    """Makes an undo step at the end where what runs inside has added something to the file.

    An undo takes over unchanged datablocks as they are: one that has got a pointer to a new image, while the undo stack knows nothing
    of that image, would point to freed memory, and Blender crashes.
    """
    before = _counts()
    yield
    if _counts() != before:
        push_undo(message)


def _counts() -> tuple[int, ...]:
    """Counts of what a bake can add to a file."""
    meshes = bpy.data.meshes
    return len(bpy.data.images), len(bpy.data.objects), sum(len(m.uv_layers) for m in meshes), sum(len(m.attributes) for m in meshes)


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    forget_all()


@bpy.app.handlers.persistent
def _after_undo(*_: object) -> None:
    """Undo may have taken back what a job is for: then it stops and keeps what it has."""
    for runner in RUNNERS:
        if runner.running:
            runner.job.undone = True  # a partial write may need an undo step of its own, which would take the user's redo away
            if runner.job.has_lost_targets():
                runner.stop(wait=0)  # written by the next tick: inside an undo nothing may be written


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
    """Listen to file loads and undo, and make sure that quitting ends the threads."""
    listen(HANDLERS)
    atexit.register(_at_exit)


def unregister() -> None:
    """End all jobs, the timer and the handlers; doing it twice changes nothing."""
    forget_all()
    stop_listening(HANDLERS)
    atexit.unregister(_at_exit)


def _at_exit() -> None:
    """Quitting: only the threads are ended, for Blender's data is going or gone."""
    for runner in RUNNERS:
        if runner.running:
            runner.job.driver.cancel(STOP)
