# SPDX-License-Identifier: GPL-3.0-or-later
"""What comes before a solve, in slices: a generator on the main thread, whose long parts without `bpy` run in a thread.

    def preparing() -> Stages[int]:
        yield "Reading the scene"                           # the window may draw now
        world = yield Aside("Building", once(lambda: ...))  # in a thread; its result comes back
        return 3

`finish_stages` runs one to its end at once, for scripts and the command line; `Preparation` runs it for the timer of a window, and can
be stopped. Between two slices the user may change anything: whoever goes on has to look (see `bridge.baking.bake.Bake.preparing`).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, TypeVar

from ...core.base.steps import Steps, finish
from ...core.method.solution import Solution

T = TypeVar("T")
SLICE = 0.05  # seconds of the main thread that one look may take, single parts excepted


@dataclass(frozen=True, eq=False)
class Aside:
    """A part that needs no Blender: `steps` run in a thread, and their result is sent back. `text` says what is done."""

    text: str
    steps: Steps[Any]


Stages = Generator[Aside | str, Any, T]


def once(function: Callable[[], T]) -> Steps[T]:
    """A single call as steps."""
    yield 0.0
    return function()


class Turn:
    """How long one slice of many goes on: `SLICE`, and as long as it took to come back to where the last one ended.

    So the way back, which grows with the number of objects and instances, is never more than half of the work.
    """

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._end = self._began + SLICE

    def back(self) -> None:
        """It has come back."""
        now = time.monotonic()
        self._end = now + SLICE + (now - self._began)

    def over(self) -> bool:
        """Whether it ends."""
        return time.monotonic() > self._end


def finish_stages(stages: Stages[T]) -> T:
    """Run `stages` here to their end and return their result."""
    answer, error = None, None
    with contextlib.closing(stages):
        while True:
            try:
                stage = stages.throw(error) if error is not None else stages.send(answer)
            except StopIteration as end:
                return end.value
            answer = error = None
            if isinstance(stage, Aside):
                try:
                    answer = finish(stage.steps)
                except Exception as found:
                    error = found


class Preparation:
    """Runs `stages` a slice at a time by `advance`; to whoever shows or stops a job it looks like the driver that will follow.

    state     "running", "finished", "dropped" (stopped) or "failed", with the `error`
    fraction  of the part that runs aside; `text` what is done
    """

    rays = version = 0
    seconds_left = None

    def __init__(self, stages: Stages[None], clock: Callable[[], float] = time.monotonic) -> None:
        self.state, self.text, self.fraction = "running", "Preparing", 0.0
        self.error: BaseException | None = None
        self._stages: Stages[None] | None = stages
        self._clock, self._began = clock, clock()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._answer: Any = None
        self._error: BaseException | None = None

    @property
    def seconds(self) -> float:
        """Since it was begun."""
        return self._clock() - self._began

    def solution(self) -> Solution | None:
        """None: there is no result yet."""
        return None

    def advance(self, wait: float = 0.0) -> None:
        """One slice on the main thread; returns at once, or after `wait` seconds, while a part runs aside."""
        end = self._clock() + max(SLICE, wait)
        while self.state == "running":
            if self._thread is not None:
                self._thread.join(min(wait, max(end - self._clock(), 0.0)))
                if self._thread.is_alive():
                    return
                self._thread = None
            self._next()
            if self._clock() >= end:
                return

    def finish(self) -> None:
        """Run the stages here to their end, without a thread; raises what they raise."""
        self.state = "failed"
        finish_stages(self._stages)
        self.state = "finished"

    def stop(self, timeout: float = 1.0) -> bool:
        """End it and take back what it has made; returns whether nothing runs any more, else a later call does the rest."""
        if self.state != "running":
            return True
        if not self._end_thread(timeout):
            return False
        self.state = "dropped"
        self._stages.close()
        return True

    def cancel(self, timeout: float = 1.0) -> bool:
        """End the thread alone: Blender's data is going or gone. Returns whether it has ended."""
        return self._end_thread(timeout)

    def _end_thread(self, timeout: float) -> bool:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _next(self) -> None:
        """Run the stages to their next yield."""
        answer, error, self._answer, self._error = self._answer, self._error, None, None
        try:
            stage = self._stages.throw(error) if error is not None else self._stages.send(answer)
        except StopIteration:
            self.state = "finished"
        except BaseException as found:
            self.state, self.error = "failed", found
        else:
            self.text = stage.text if isinstance(stage, Aside) else stage
            self.fraction = 0.0
            if isinstance(stage, Aside):
                self._thread = threading.Thread(target=self._work, args=(stage.steps,), name="adjoint_gi_preparation", daemon=True)
                self._thread.start()

    def _work(self, steps: Steps[Any]) -> None:
        """In the thread: the steps, until they end or a stop is wanted."""
        try:
            while not self._stop.is_set():
                self.fraction = float(next(steps))
        except StopIteration as end:
            self._answer = end.value
        except BaseException as error:
            self._error = error
