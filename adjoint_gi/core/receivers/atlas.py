"""xatlas, taken apart with care."""

from __future__ import annotations

import time

import xatlas

NAP = 1e-3  # s; without it one of some 30,000 small atlases ends in a wait for ever on a busy machine, with a third of it none of 120,000


def generate(atlas: xatlas.Atlas, options: xatlas.PackOptions) -> None:
    """Chart and pack what was added to `atlas`, and let its threads fall asleep.

    When an atlas is taken apart, xatlas 0.0.11 wakes its threads without the lock by which they fall asleep: one that is just about to
    misses that, and the program waits for it for ever.
    """
    atlas.generate(xatlas.ChartOptions(), options)
    time.sleep(NAP)
