# SPDX-License-Identifier: GPL-3.0-or-later
"""Work counted instead of timed: the same on every machine, however busy it is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def counted(run: Callable[[], Result]) -> tuple[Result, int]:
    """The result of `run` and the Python and built-in functions called for it in this thread: few where numpy does the loops."""
    calls = 0

    def profile(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        return run(), calls
    finally:
        sys.setprofile(before)


class FakeTime:
    """Stands in for the module `time`: a clock that moves only by its `sleep` and by `look` seconds whenever it is looked at."""

    def __init__(self, look: float = 0.0) -> None:
        self.now = 0.0
        self.look = look

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def perf_counter(self) -> float:
        self.now += self.look
        return self.now
