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
