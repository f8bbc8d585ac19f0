"""Work in steps: generators that yield the share done and return a result, so that a caller can show progress and stop between any two."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")

Steps = Generator[float, None, T]


def finish(steps: Steps[T]) -> T:
    """Run `steps` to their end and return their result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def within(steps: Steps[T], start: float, stop: float) -> Steps[T]:
    """The same steps as a part of longer work, whose shares done run from `start` to `stop`."""
    while True:
        try:
            share = next(steps)
        except StopIteration as end:
            return end.value
        yield start + share * (stop - start)
