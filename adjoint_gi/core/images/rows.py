# SPDX-License-Identifier: GPL-3.0-or-later
"""Images a few rows at a time: what is written never has to be in memory as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

PIXELS = 1 << 18  # in one block of rows


class RowSource(Protocol):
    """What rows can be asked of: a numpy array, or `LazyRows`."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w) or (h, w, c)."""

    def __getitem__(self, rows: slice) -> np.ndarray:
        """Some rows, which have a beginning and an end inside the image."""


@dataclass(frozen=True, eq=False)
class LazyRows:
    """An image of `shape` (h, w, c) whose rows are made by `make` whenever they are asked for, in any order and from any thread."""

    shape: tuple[int, ...]
    make: Callable[[slice], np.ndarray]

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.make(rows)


def blocks_of_rows(shape: tuple[int, ...]) -> Iterator[slice]:
    """The rows of an image in blocks of about PIXELS pixels."""
    step = max(1, PIXELS // max(1, shape[1]))
    return (slice(a, min(a + step, shape[0])) for a in range(0, shape[0], step))


def with_alpha(color: RowSource, alpha: RowSource) -> LazyRows:
    """(h, w, 4) of `color` (h, w, 3) and `alpha` (h, w)."""
    return LazyRows((*color.shape[:2], 4), lambda rows: np.concatenate([color[rows], alpha[rows][..., None]], axis=2))
