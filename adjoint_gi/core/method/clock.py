"""Seconds of work and the history: what `Solution.seconds` and `Solution.history` mean for every method."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from .solution import Solution, Step

PAUSE = 0.1  # seconds between steps, about


class Clock:
    """Seconds that a solver has worked. It stands still while a step is held by the consumer of the generator, and after the last one.

    Every step that it yields has the seconds and the history of the moment it was made at, whenever its result is asked for.
    history   (seconds of work, residual, unshot share or relative standard error)
    """

    def __init__(self) -> None:
        self._worked = 0.0  # up to the last step
        self._since: float | None = time.perf_counter()  # start of the present stretch; None while the clock stands still
        self._last = self._since
        self.history: list[tuple[float, float]] = []

    @property
    def seconds(self) -> float:
        """Worked so far."""
        return self._worked + (time.perf_counter() - self._since if self._since is not None else 0.0)

    def due(self) -> bool:
        """Whether it is time for a step."""
        return time.perf_counter() - self._last >= PAUSE

    def note(self, residual: float) -> None:
        """Add to the history."""
        self.history.append((self.seconds, residual))

    def pause(self, step: Step) -> Iterator[Step]:
        """Yield `step` and stand still until the generator is continued."""
        self.stop()
        yield self._dated(step)
        self.go()

    def last(self, step: Step) -> Iterator[Step]:
        """Yield the last step and stand still for good."""
        self.stop()
        yield self._dated(step)

    def go(self) -> None:
        """Go on."""
        self._since = self._last = time.perf_counter()

    def stop(self) -> None:
        """Stand still from now on."""
        self._worked, self._since = self.seconds, None

    def _dated(self, step: Step) -> Step:
        """The step with the seconds and the history of now."""
        seconds, history = self.seconds, tuple(self.history)

        def solution() -> Solution:
            return replace(step.solution(), seconds=seconds, history=history)

        return replace(step, solution=solution)
