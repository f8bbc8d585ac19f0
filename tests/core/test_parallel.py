# SPDX-License-Identifier: GPL-3.0-or-later
"""Work over threads: order, stopping, and knowing when nothing is under way any more."""

import threading

import pytest
from adjgi.adjoint_gi.core.base.parallel import in_order, settle


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_the_order_of_the_items(threads):
    first = threading.Event()

    def square(n):
        if n == 0:
            first.wait(5 if threads > 1 else 0)  # the first item ends after the second one
        first.set()
        return n * n

    assert list(in_order(square, range(20), threads)) == [n * n for n in range(20)]


def test_settle_waits_for_what_a_suspended_generator_has_under_way():
    ended = []
    gate = threading.Event()

    def work(n):
        if n:
            gate.wait(5)
        ended.append(n)
        return n

    results = in_order(work, range(10), threads=2)
    assert next(results) == 0
    threading.Timer(0.2, gate.set).start()
    settle()
    assert sorted(ended) == [0, 1, 2, 3]  # two items a thread, and none after these
    results.close()


def test_an_error_reaches_whoever_asks_for_the_result():
    def fail(n):
        raise ValueError(str(n))

    with pytest.raises(ValueError, match="0"):
        list(in_order(fail, range(5), threads=2))
    settle()
