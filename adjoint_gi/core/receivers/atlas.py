"""xatlas, taken apart with care."""

from __future__ import annotations

import os
import threading
import time
from collections import deque

import xatlas

# s; without it one of some 30,000 small atlases ended in a wait for ever on a busy machine; with it alone one of 18 runs of its tests
NAP = 1e-3
# Atlases that are kept until as many others have come, so that they rest for all their naps; each has a thread for every core but one.
MOST = min(64, max(8, 1024 // (os.cpu_count() or 1)))
REST = 2.0  # s after which all that are kept go

_kept: deque[xatlas.Atlas] = deque()
_come = 0  # atlases so far
_lock = threading.Lock()
_watched = False  # whether a thread waits for the rest to be over


def generate(atlas: xatlas.Atlas, options: xatlas.PackOptions) -> None:
    """Chart and pack what was added to `atlas`, and let its threads fall asleep before it is taken apart.

    When an atlas is taken apart, xatlas 0.0.11 wakes its threads without the lock by which they fall asleep: one that is just about to
    misses that, and the program waits for it for ever. On a busy machine a thread may stand at that point for many milliseconds.
    """
    global _come, _watched
    atlas.generate(xatlas.ChartOptions(), options)
    time.sleep(NAP)
    with _lock:
        _kept.append(atlas)
        _come += 1
        gone = [_kept.popleft() for _ in range(len(_kept) - MOST)]
        watch, _watched = not _watched, True
    del gone  # outside of the lock, as it takes a while
    if watch:
        threading.Thread(target=_let_go, name="adjoint_gi_atlases", daemon=True).start()


def _let_go() -> None:
    """Take apart what is kept once no other atlas has come for a while."""
    global _watched
    seen = 0
    while True:
        time.sleep(REST)
        with _lock:
            if seen != _come:
                seen = _come
                continue
            gone = list(_kept)
            _kept.clear()
            _watched = False
        del gone
        return
