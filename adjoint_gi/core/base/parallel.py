"""Work in batches over threads, with results in order, so that the number of threads never changes the answer."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


_under_way: set[Future] = set()  # what the threads of all `in_order` still compute


def settle() -> None:
    """Wait until what is under way at this moment has been computed, so that a stopped solve runs no Python any more."""
    wait(tuple(_under_way))


def thread_count() -> int:
    """Threads to use: ADJOINT_GI_THREADS where set (1 to 256), else one for each core."""
    text = os.environ.get("ADJOINT_GI_THREADS", "")
    wanted = int(text) if text.isdigit() else (os.cpu_count() or 1)
    return max(1, min(256, wanted))


def in_order(function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None) -> Iterator[Result]:
    """Yield `function(item)` for every item, computed in several threads, in the order of the items.

    At most two items a thread are under way, and closing the generator waits for just these, so a stop is quick.
    """
    threads = threads or thread_count()
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="adjoint_gi") as pool:
        waiting: deque = deque()
        try:
            for item in items:
                future = pool.submit(function, item)
                _under_way.add(future)
                future.add_done_callback(_under_way.discard)
                waiting.append(future)
                if len(waiting) >= 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
