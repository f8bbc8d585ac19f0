"""Runs a solver: in the background or in the foreground, stopped between two steps, continued, and never without its last result.

    idle -> running -> finished
              |  ^  \\-> failed      (the last partial result is kept)
              v  |
            stopped                 (resume() goes on from the same generator)

Partial results are copied by the thread that advances the generator, because between two steps is the only moment at which the
solver's arrays belong together.
"""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from ..base.errors import AdjointError
from ..base.parallel import settle
from ..base.resources import require_memory
from ..base.settings import Settings
from ..receivers.base import Receivers
from ..scene.world import World
from .registry import Solver
from .solution import Solution, Step

INTERRUPTS = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C, what ends programs, and a terminal that was closed
REFRESH = 0.5  # seconds between two copies of the partial result
SHARE = 0.05  # largest share of the time that these copies may take


class Driver:
    """One solve of one problem.

    state     "idle", "running", "stopped", "finished" or "failed"
    fraction  0 to 1, what the solver says; `text` its words
    rays      cast up to the last copy of the result
    error     what ended a failed solve
    version   grows whenever there is a newer partial result
    longest   longest time in seconds between two steps, which is how long a stop may take
    """

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: Settings) -> None:
        """Raises `MemoryRefused` when the solve needs more memory than is free."""
        self.needed = solver.memory(world, receivers, settings)
        require_memory(solver.spec.label, self.needed)
        self.solver = solver
        self.world = world
        self.receivers = receivers
        self.settings = settings
        self.state = "idle"
        self.fraction = 0.0
        self.text = ""
        self.error: BaseException | None = None
        self.version = 0
        self.longest = 0.0
        self._steps: Iterator[Step] | None = None
        self._step: Step | None = None
        self._copy: Solution | None = None
        self._copy_step: Step | None = None
        self._stop = threading.Event()
        self._cancelled = False
        self._thread: threading.Thread | None = None
        self._spent = 0.0  # seconds of finished stretches
        self._since: float | None = None  # start of the present stretch
        self._next_copy = 0.0

    # ---- what is known at any time, from any thread

    @property
    def seconds(self) -> float:
        """Time spent computing, without pauses."""
        since = self._since
        return self._spent + (time.perf_counter() - since if since is not None else 0.0)

    @property
    def seconds_left(self) -> float | None:
        """Estimate by the share that is done; None as long as nothing can be said."""
        if self.state == "finished":
            return 0.0
        return self.seconds * (1 - self.fraction) / self.fraction if self.fraction > 0.001 else None

    @property
    def rays(self) -> int:
        """Rays cast up to the last copy of the result."""
        copy = self._copy
        return int(copy.rays) if copy is not None else 0

    def solution(self) -> Solution | None:
        """The latest result; partial unless the solve is finished. None before the first step."""
        copy = self._copy
        return None if copy is None else dataclasses.replace(copy, partial=self.state != "finished")

    # ---- background

    def start(self) -> None:
        """Compute in a thread of its own; raises `AdjointError` when it has been started before."""
        self._require("idle")
        self._launch()

    def resume(self) -> None:
        """Go on after a stop, from exactly where it was; raises `AdjointError` when it is not stopped."""
        self._require("stopped")
        self._launch()

    def stop(self, timeout: float = 1.0) -> bool:
        """Ask for a stop between two steps and wait for it up to `timeout` seconds; returns whether nothing runs any more."""
        self._stop.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout)
        return self.state != "running"

    def cancel(self, timeout: float = 1.0) -> bool:
        """Stop and drop everything; the thread closes the generator itself if it ends later. Returns whether it has ended."""
        self._cancelled = True
        if not self.stop(timeout):
            return False
        self._drop()
        return True

    # ---- foreground

    def run(self, on_step: Callable[[Driver], None] | None = None) -> Solution | None:
        """Compute here to the end, calling `on_step(self)` after every step; returns the result.

        Ctrl-C stops between two steps and keeps the partial result (state "stopped", None before the first step); a second
        Ctrl-C interrupts at once. So do the signals by which a system ends programs. Raises what the solver raised.
        """
        if self.state not in ("idle", "stopped"):
            self._require("idle")
        self._begin()
        with _interrupts(self._stop):
            self._work(on_step)
        if self.state == "failed":
            raise self.error
        return self.solution()

    # ---- inside

    def _require(self, state: str) -> None:
        if self.state != state:
            raise AdjointError(self.solver.spec.label, f"is {self.state}, not {state}", "Start a new bake")

    def _launch(self) -> None:
        self._begin()
        # A daemon: an interpreter that ends must not wait for a long step.
        self._thread = threading.Thread(target=self._work, name="adjoint_gi_driver", daemon=True)
        self._thread.start()

    def _begin(self) -> None:
        self._stop.clear()
        self.error = None
        self.state = "running"
        self._since = time.perf_counter()

    def _work(self, on_step: Callable[[Driver], None] | None = None) -> None:
        """Advance the generator until it ends, fails or is asked to stop."""
        state = "failed"
        try:
            if self._steps is None:
                rng = np.random.default_rng(self.settings.seed)
                self._steps = iter(self.solver.solve(self.world, self.receivers, self.settings, rng))
            state = self._advance(on_step)
        except BaseException as error:  # the user must learn what has ended the thread, and the last result is kept
            self.error = error
        finally:
            self._spent, self._since = self.seconds, None
            if self._cancelled:
                self._drop()
            else:
                self.state = state

    def _advance(self, on_step: Callable[[Driver], None] | None) -> str:
        """Steps until the end or a stop; returns the new state."""
        while not self._stop.is_set():
            began = time.perf_counter()
            step = next(self._steps, None)
            self.longest = max(self.longest, time.perf_counter() - began)
            if step is None:
                if self._step is None:
                    raise AdjointError(self.solver.spec.label, "gave no result", "Report this with the scene")
                self._keep()
                self.fraction = 1.0
                return "finished"
            self._step = step
            self.fraction, self.text = float(min(max(step.fraction, 0.0), 1.0)), step.text
            if time.perf_counter() >= self._next_copy:
                self._keep()
            if on_step is not None:
                try:
                    on_step(self)
                except KeyboardInterrupt:  # between two steps, so the generator can go on later
                    self._stop.set()
        if self._step is not None:
            self._keep()
        settle()
        return "stopped"

    def _keep(self) -> None:
        """Copy the result of the last step; seconds without pauses, and the settings it was made with."""
        if self._copy_step is self._step:
            return
        began = time.perf_counter()
        solution = self._step.solution()
        settings = solution.settings or self.settings.as_dict()
        self._copy = dataclasses.replace(solution, partial=True, seconds=self.seconds, settings=settings)
        self._copy_step = self._step
        self.version += 1
        now = time.perf_counter()
        self._next_copy = now + max(REFRESH, (now - began) / SHARE)

    def _drop(self) -> None:
        """Let go of everything that holds memory."""
        steps, self._steps, self._step, self._copy, self._copy_step = self._steps, None, None, None, None
        if steps is not None and hasattr(steps, "close"):
            steps.close()
        self.state = "idle"
        self._cancelled = False


@contextlib.contextmanager
def _interrupts(stop: threading.Event) -> Iterator[None]:
    """Let the first Ctrl-C set `stop` and the second one raise."""

    def interrupt(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    with answering(interrupt):
        yield


@contextlib.contextmanager
def answering(interrupt: Callable[..., None], signals: Iterable[str] = INTERRUPTS) -> Iterator[None]:
    """Have `interrupt` called when one of `signals` comes; only the main thread can listen, others pass through.

    A signal that is ignored stays so: that is how `nohup` keeps a program going.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in signals if hasattr(signal, name)]
    before = {n: signal.signal(n, interrupt) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None: the handler was not set by Python (Blender sets its own), and cannot be put back from here.
            default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            signal.signal(number, handler if handler is not None else default)
