# SPDX-License-Identifier: GPL-3.0-or-later
"""What the command line prints while it works: a bar on a terminal, plain lines elsewhere; all of it on standard error."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from ...core.base.text import printable
from ...core.method.driver import Driver

BAR = 24
LINE_SECONDS = 5.0  # between two plain lines


class Progress:
    """Call it with the driver after every step, `end()` afterwards."""

    def __init__(self, label: str, stream: TextIO | None = None) -> None:
        self.label = label
        self.stream = stream or sys.stderr
        self.terminal = self.stream.isatty()
        self._next = 0.0
        self._width = 0

    def __call__(self, driver: Driver) -> None:
        """Show how far it is, ten times a second on a terminal."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (0.1 if self.terminal else LINE_SECONDS)
        if self.terminal:
            done = round(BAR * driver.fraction)
            text = f"[{'#' * done}{' ' * (BAR - done)}] {self.line(driver)}"
            self.stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
            self.stream.flush()
        else:
            print(self.line(driver), file=self.stream, flush=True)

    def line(self, driver: Driver) -> str:
        """How far, in words."""
        left = driver.seconds_left
        rest = f", {seconds_text(left)} left" if left is not None else ""
        return printable(f"{self.label}: {100 * driver.fraction:3.0f} %, {driver.text}, {seconds_text(driver.seconds)}{rest}")

    def end(self) -> None:
        """Take the bar away."""
        if self.terminal and self._width:
            self.stream.write("\r" + " " * self._width + "\r")
            self.stream.flush()


def seconds_text(seconds: float) -> str:
    """ "4.2 s", "3:05 min" or "2:10 h"."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(round(seconds)), 60)
    return f"{minutes}:{rest:02d} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02d} h"
