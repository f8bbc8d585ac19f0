"""Seconds and history mean the same for every method: seconds of work, without the time in which its consumer held a step."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.method import clock, registry
from adjgi.adjoint_gi.core.method.solution import Solution, Step
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.counting import FakeTime

solvers.load()

ROOT = Path(__file__).resolve().parents[2]
TICK = 0.125  # a sum of these is exact
SAMPLES = 48  # several batches, so that there are steps in the middle of sampling
SMALL = {"samples": SAMPLES, "rays": 16, "particles": 2000, "max_edge": 0.5, "light_samples": 2, "max_length": 4, "receivers": "objects"}


def solve(solver, monkeypatch, sleep):
    """All steps of a small solve, and their solutions, whose consumer sleeps so many seconds before and after it looks at each."""
    time = FakeTime(TICK)
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=time.perf_counter))
    scene = scenes.cornell()
    elements = Elements(World(scene), 0.5)
    names = {f.name for f in dataclasses.fields(solver.Settings)}
    small = {k: v for k, v in SMALL.items() if k in names}
    if "objects" in names:
        small["objects"] = scene.objects[0].name
    steps, out = [], []
    for step in solver.solve(elements.world, ElementReceivers(elements), solver.Settings(**small), np.random.default_rng(1)):
        time.now += sleep
        steps.append(step)
        out.append(step.solution())
        time.now += sleep
    time.now += sleep
    return steps, [*out, step.solution()]


@pytest.mark.parametrize("solver", registry.methods(), ids=lambda s: s.spec.id)
def test_the_time_in_which_a_step_is_held_does_not_count(solver, monkeypatch):
    (steps, at_once), (_, slowly) = (solve(solver, monkeypatch, sleep) for sleep in (0.0, 1024.0))
    if steps[-1].text == f"{SAMPLES} samples":
        assert sum(s.text.endswith(f" of {SAMPLES} samples") for s in steps) >= 2, "no step in the middle of sampling"
    assert len(at_once) == len(slowly)
    for a, b in zip(at_once, slowly, strict=True):
        assert a.seconds == b.seconds > 0
        assert a.history == b.history
    seconds = [s.seconds for s in at_once]
    assert seconds == sorted(seconds) and seconds[-1] == seconds[-2]
    times = [t for t, _ in at_once[-1].history]
    assert times == sorted(times) and all(0 < t <= seconds[-1] for t in times)


@pytest.mark.parametrize("solver", registry.methods(), ids=lambda s: s.spec.id)
def test_a_step_keeps_the_seconds_and_the_history_of_the_moment_it_was_made_at(solver, monkeypatch):
    steps, solutions = solve(solver, monkeypatch, 0.0)
    assert len(steps) >= 2 and solutions[0].seconds < solutions[-1].seconds
    for step, then in zip(steps, solutions[:-1], strict=True):
        now = step.solution()
        assert (now.seconds, now.history) == (then.seconds, then.history)


def clocks(source: str) -> list[str]:
    """What a file uses of Python's `time` to read a clock: everything but `sleep`, which tells nobody what time it is."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "time":
            found.append(node.attr)
        elif isinstance(node, ast.ImportFrom) and node.module == "time" and not node.level:
            found += [a.name for a in node.names]
        elif isinstance(node, ast.Import):
            found += [f"{a.name} as {a.asname}" for a in node.names if a.name == "time" and a.asname]
    return [name for name in found if name != "sleep"]


def test_methods_have_no_other_clock():
    """Only what drives the generators from outside measures time itself."""
    core = ROOT / "adjoint_gi/core"
    files = [p for p in (*core.rglob("*.py"), *(ROOT / "solvers").glob("*.py")) if clocks(p.read_text(encoding="utf-8"))]
    inside = {p.relative_to(core).as_posix() for p in files if p.parent != core / "comparison"}
    assert inside == {"method/clock.py", "method/driver.py"}
    assert clocks("from time import monotonic, sleep\nimport time\ntime.sleep(1)\ntime.time()") == ["monotonic", "time"]
    assert clocks("import time as t") == ["time as t"]


def test_the_clock_stands_still_while_a_step_is_held_and_after_the_last(monkeypatch):
    time = FakeTime(TICK)
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=time.perf_counter))

    def solution():
        return Solution("method", "irradiance", *np.zeros((4, 1, 3), np.float32), np.ones(1, np.float32))

    watch = clock.Clock()
    watch.note(0.5)
    held = watch.pause(Step(0.5, "step", solution))
    step = next(held)
    assert (step.fraction, step.text) == (0.5, "step")
    worked = watch.seconds
    time.now += 100
    assert watch.seconds == worked > 0
    assert list(held) == [] and worked < watch.seconds < 2
    assert watch.due() == (2 * TICK >= clock.PAUSE)
    watch.note(0.25)
    (end,) = watch.last(Step(1.0, "end", solution))
    assert end.text == "end"
    whole = watch.seconds
    time.now += 100
    assert watch.seconds == whole == end.solution().seconds
    assert step.solution().seconds == worked
    assert [[value for _, value in s.solution().history] for s in (step, end)] == [[0.5], [0.5, 0.25]]
    watch.go()
    assert whole < watch.seconds < whole + 1
