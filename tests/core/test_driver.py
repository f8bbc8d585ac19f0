# SPDX-License-Identifier: GPL-3.0-or-later
"""The job around a solver: states, stop, continue, failure, cancel, and the last result in each of them."""

from __future__ import annotations

import signal
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base import resources
from adjgi.adjoint_gi.core.base.errors import AdjointError, MemoryRefused
from adjgi.adjoint_gi.core.base.settings import Settings
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method import driver as driver_module
from adjgi.adjoint_gi.core.method.driver import Driver
from adjgi.adjoint_gi.core.method.registry import Solver
from adjgi.adjoint_gi.core.method.solution import Solution, Step
from adjgi.adjoint_gi.core.receivers.base import SurfaceReceivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.counting import FakeTime

STEPS = 40
TICK = 0.125  # a sum of these is exact


class Spec:
    label = "Counting"


class Counting(Solver):
    """Adds one random number to every receiver in each step; a partial copy taken inside a step would be seen."""

    spec = Spec()

    def __init__(self, seconds=0.01, fail_at=None, steps=STEPS, wait=None, sleep=time.sleep):
        self.seconds, self.fail_at, self.steps, self.wait, self.sleep = seconds, fail_at, steps, wait, sleep
        self.done = 0
        self.closed = self.waits = False
        self.threads = set()
        self.inside = False

    def solve(self, world, receivers, settings, rng):
        total = np.zeros((receivers.count, 3), np.float32)

        def solution(k):
            assert not self.inside, "copied while the arrays were being changed"
            zero = np.zeros_like(total)
            return Solution("counting", "irradiance", zero, total.copy(), zero, zero, np.ones(len(total), np.float32), 10 * k)

        try:
            for k in range(1, self.steps + 1):
                self.inside = True
                self.threads.add(threading.get_ident())
                if self.fail_at == k:
                    raise ZeroDivisionError("in the middle")
                total += rng.random(total.shape, np.float32)
                if self.wait is not None:
                    self.waits = True
                    self.wait.wait(10)
                self.sleep(self.seconds)
                self.inside = False
                self.done = k
                yield Step(k / self.steps, f"step {k}", lambda k=k: solution(k))
        finally:
            self.closed = True


class Nothing(Solver):
    spec = Spec()

    def solve(self, world, receivers, settings, rng):
        yield from ()


@pytest.fixture(scope="module")
def world():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("White", 0.5))
    return World(b.build())


def driver(world, solver, seed=3):
    receivers = SurfaceReceivers("texels", [0, 1, 2], [0, 1], [0.3, 0.3], [0.3, 0.3])
    return Driver(solver, world, receivers, Settings(seed=seed))


def until(reached, seconds=60.0):
    """Wait for another thread; the seconds only keep a test that fails from waiting for ever."""
    end = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def wait(d, state):
    until(lambda: d.state == state)


def test_background_and_foreground_give_the_same_result(world):
    first, second = driver(world, Counting(0.002)), driver(world, Counting(0))
    assert (first.state, first.solution(), first.seconds_left) == ("idle", None, None)
    first.start()
    wait(first, "finished")
    result = second.run()
    assert second.state == "finished" and first.fraction == second.fraction == 1.0
    assert np.array_equal(first.solution().direct, result.direct)
    assert result.partial is False and first.solution().partial is False
    assert result.settings == Settings(seed=3).as_dict()
    assert first.rays == 10 * STEPS and first.seconds_left == 0.0
    assert threading.get_ident() not in first.solver.threads


def test_stop_keeps_the_partial_result_and_continue_ends_where_an_unstopped_run_ends(world, monkeypatch):
    clock, gate = FakeTime(), threading.Semaphore(10)
    monkeypatch.setattr(driver_module, "time", clock)
    d = driver(world, Counting(TICK, wait=SimpleNamespace(wait=lambda seconds: gate.acquire(timeout=seconds)), sleep=clock.sleep))
    d.start()
    until(lambda: d.solver.done == 10)
    assert not d.stop(0.0) and d.state == "running"  # the step under way waits at the gate
    gate.release()
    assert d.stop(60.0)
    assert d.solver.done == 11
    assert d.state == "stopped" and d.fraction == 11 / STEPS
    partial = d.solution()
    assert partial.partial and partial.rays == 11 * 10
    assert d.seconds == partial.seconds == 11 * TICK
    clock.sleep(100)
    assert d.seconds == 11 * TICK, "a pause counts as computing"
    gate.release(STEPS)
    d.resume()
    wait(d, "finished")
    assert not d.solution().partial
    assert np.array_equal(d.solution().direct, driver(world, Counting(0)).run().direct)
    assert np.all(d.solution().direct >= partial.direct)
    assert d.seconds == STEPS * TICK and d.longest == TICK  # the pause does not count


@pytest.mark.parametrize("steps", [1, STEPS // 2, STEPS - 1])
def test_stop_from_on_step_at_the_start_the_middle_and_the_end(world, steps):
    seen = []

    def on_step(d):
        seen.append(d.text)
        if len(seen) == steps:
            raise KeyboardInterrupt

    d = driver(world, Counting(0))
    result = d.run(on_step)
    assert d.state == "stopped" and result.partial and seen[-1] == f"step {steps}"
    assert result.rays == 10 * steps
    assert not d.run().partial
    assert np.array_equal(d.solution().direct, driver(world, Counting(0)).run().direct)


@pytest.fixture
def ctrl_c():
    """Ctrl-C as in a terminal: a shell starts what runs in the background with its signal ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_interrupt_signal_stops_between_two_steps(world, ctrl_c):
    slept = []

    def sleep(_):
        slept.append(solver.inside)
        if len(slept) == STEPS // 2:
            signal.raise_signal(signal.SIGINT)

    solver = Counting(0, sleep=sleep)
    d = driver(world, solver)
    result = d.run()
    assert len(slept) == STEPS // 2 and slept[-1] and result.rays == 10 * len(slept)
    assert d.state == "stopped" and result.partial and not solver.closed
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_failure_keeps_the_last_partial_result(world):
    d = driver(world, Counting(0.3, fail_at=4))
    d.start()
    wait(d, "failed")
    assert isinstance(d.error, ZeroDivisionError)
    assert d.solution().partial and d.solution().rays == 30
    with pytest.raises(AdjointError, match="is failed, not stopped"):
        d.resume()
    with pytest.raises(ZeroDivisionError):
        driver(world, Counting(0, fail_at=4)).run()


def test_cancel_drops_everything(world):
    solver = Counting(0.02)
    d = driver(world, solver)
    d.start()
    time.sleep(0.1)
    assert d.cancel()
    assert d.state == "idle" and d.solution() is None and solver.closed
    assert driver(world, Counting()).cancel()


def test_cancel_of_a_long_step_returns_and_the_thread_ends_by_itself(world):
    solver = Counting(0.0, wait=threading.Event())
    d = driver(world, solver)
    d.start()
    until(lambda: solver.waits)
    assert not d.cancel(0.05)
    assert not solver.closed and d.state == "running"
    solver.wait.set()
    wait(d, "idle")
    assert solver.closed and d.solution() is None


def test_version_grows_with_partial_results(world):
    d = driver(world, Counting(0.05))
    d.start()
    versions = set()
    while d.state == "running":
        if d.version:
            assert d.solution() is not None
        versions.add(d.version)
        time.sleep(0.02)
    assert len(versions) >= 3 and d.version == max(versions | {d.version})
    assert d.longest >= 0.05


def test_start_twice_and_resume_before_start(world):
    d = driver(world, Counting(0.01))
    with pytest.raises(AdjointError, match="is idle, not stopped"):
        d.resume()
    d.start()
    with pytest.raises(AdjointError, match="not idle"):
        d.start()
    assert d.stop()


def test_a_solver_without_a_result_fails(world):
    d = driver(world, Nothing())
    with pytest.raises(AdjointError, match="gave no result"):
        d.run()
    assert d.state == "failed"


def test_memory_is_refused_before_the_start(world, monkeypatch):
    solver = Counting()
    monkeypatch.setattr(resources, "available_memory", lambda: 1000)
    solver.memory = lambda *_: 900
    assert driver(world, solver).needed == 900
    solver.memory = lambda *_: 5_000_000_000
    with pytest.raises(MemoryRefused, match=r"Counting: needs 5 GB of memory and 1 kB are free\. \w+"):
        driver(world, solver)


def test_memory_that_is_free_is_read_in_bytes(monkeypatch, tmp_path):
    told = tmp_path / "meminfo"
    told.write_text("MemTotal:       9000 kB\nMemFree:         500 kB\nMemAvailable:   3000 kB\n", encoding="ascii")
    monkeypatch.setattr(resources, "Path", lambda _: told)
    monkeypatch.setattr(resources.sys, "platform", "linux")
    assert resources.available_memory() == 3000 * 1024


def test_a_limit_of_memory_is_in_binary_megabytes():
    """As the system counts it; what just fits is not refused."""
    resources.require_within("Bake", 300 << 20, 300, "Lower it")
    resources.require_memory("Bake", 900, 1000)
    with pytest.raises(MemoryRefused, match="could need 300 MB, over its limit of 300 MB") as refused:
        resources.require_within("Bake", (300 << 20) + 1, 300, "Lower it")
    assert refused.value.notice.remedy == "Lower it"
    with pytest.raises(MemoryRefused, match="needs 901 B of memory and 1 kB are free"):
        resources.require_memory("Bake", 901, 1000)


def test_sizes_in_words():
    assert [resources.size_text(n) for n in (12, 1500, 123456, 2.5e9, 3e13)] == ["12 B", "1.5 kB", "123 kB", "2.5 GB", "30,000 GB"]
    assert resources.available_memory() > 0 and resources.peak_memory() > 0


def test_the_time_left_is_that_of_the_share_that_is_not_done(world):
    d = driver(world, Counting(0))
    d._spent = 30.0
    for d.fraction, left in ((0.25, 90.0), (0.75, 10.0), (0.0, None)):
        assert d.seconds_left == left
