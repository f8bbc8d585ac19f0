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
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes

solvers.load()

ROOT = Path(__file__).resolve().parents[2]
TICK = 0.125  # a sum of these is exact
SMALL = {"samples": 3, "rays": 16, "particles": 2000, "max_edge": 0.5, "light_samples": 2, "max_length": 4, "receivers": "objects"}


class Time:
    """A clock on which every look takes a tick."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += TICK
        return self.now


def solve(solver, monkeypatch, sleep):
    """All solutions of a small solve whose consumer sleeps so many seconds before and after it looks at each step."""
    time = Time()
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=time.perf_counter))
    scene = scenes.cornell()
    elements = Elements(World(scene), 0.5)
    names = {f.name for f in dataclasses.fields(solver.Settings)}
    small = {k: v for k, v in SMALL.items() if k in names}
    if "objects" in names:
        small["objects"] = scene.objects[0].name
    out = []
    for step in solver.solve(elements.world, ElementReceivers(elements), solver.Settings(**small), np.random.default_rng(1)):
        time.now += sleep
        out.append(step.solution())
        time.now += sleep
    time.now += sleep
    return [*out, step.solution()]


@pytest.mark.parametrize("solver", registry.methods(), ids=lambda s: s.spec.id)
def test_the_time_in_which_a_step_is_held_does_not_count(solver, monkeypatch):
    at_once, slowly = (solve(solver, monkeypatch, sleep) for sleep in (0.0, 1024.0))
    assert len(at_once) == len(slowly)
    for a, b in zip(at_once, slowly, strict=True):
        assert a.seconds == b.seconds > 0
        assert a.history == b.history
    seconds = [s.seconds for s in at_once]
    assert seconds == sorted(seconds) and seconds[-1] == seconds[-2]
    times = [t for t, _ in at_once[-1].history]
    assert times == sorted(times) and all(0 < t <= seconds[-1] for t in times)


def clocks(source: str) -> list[str]:
    """What a file imports of Python's `time`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name == "time"]
        elif isinstance(node, ast.ImportFrom) and node.module == "time" and not node.level:
            found += [a.name for a in node.names]
    return found


def test_methods_have_no_other_clock():
    """Only what drives the generators from outside measures time itself."""
    core = ROOT / "adjoint_gi/core"
    files = [p for p in (*core.rglob("*.py"), *(ROOT / "solvers").glob("*.py")) if clocks(p.read_text(encoding="utf-8"))]
    inside = {p.relative_to(core).as_posix() for p in files if p.parent != core / "comparison"}
    assert inside == {"method/clock.py", "method/driver.py"}
    assert clocks("from time import monotonic\nimport time") == ["monotonic", "time"]


def test_the_clock_stands_still_while_a_step_is_held_and_after_the_last(monkeypatch):
    time = Time()
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=time.perf_counter))
    watch = clock.Clock()
    held = watch.pause("step")
    assert next(held) == "step"
    worked = watch.seconds
    time.now += 100
    assert watch.seconds == worked > 0
    assert list(held) == [] and worked < watch.seconds < 1
    assert watch.due() == (2 * TICK >= clock.PAUSE)
    assert list(watch.last("end")) == ["end"]
    worked = watch.seconds
    time.now += 100
    assert watch.seconds == worked
    watch.go()
    assert worked < watch.seconds < worked + 1
