"""Budgets, clocks, errors and winners of comparisons, with a method whose answers are known."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import AdjointError, Notice, SceneError, SettingsError
from adjgi.adjoint_gi.core.base.settings import Settings, setting
from adjgi.adjoint_gi.core.comparison import budget as comparison
from adjgi.adjoint_gi.core.comparison import effort, page
from adjgi.adjoint_gi.core.comparison import run as running
from adjgi.adjoint_gi.core.comparison.budget import Budget, Meter, Plan, Reference, constant_reference, error_of, reason_not_to, winner
from adjgi.adjoint_gi.core.comparison.run import Comparison
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.agreement import groups_of
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.method.driver import Driver
from adjgi.adjoint_gi.core.method.registry import Nature, Solver, Strategy
from adjgi.adjoint_gi.core.method.solution import Solution, Step
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.counting import FakeTime
from adjgi.tests.specs import spec_of

STEP = 0.004  # seconds of a step
RAYS = 1000  # of a step


@dataclass(frozen=True)
class CountSettings(Settings):
    samples: int = setting(40, label="Samples", help="Steps", min=1, max=10**6, effort=True)
    bias: float = setting(0.0, label="Bias", help="Share by which it is wrong", min=-1.0, max=10.0)
    fails: bool = setting(False, label="Fails", help="Whether it refuses the scene")


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """The clock by which budgets end and the methods of this file work; a busy machine does not move it."""
    fake = FakeTime(STEP)
    for module in (comparison, running, sys.modules[__name__]):
        monkeypatch.setattr(module, "time", fake)
    return fake


class Counting(Solver):
    """Irradiance 1 + bias + noise / sqrt(steps) in every channel; the noise is +1 on even receivers and -1 on odd ones."""

    Settings = CountSettings
    spec = spec_of(
        "counting",
        901,
        Strategy.GATHERING,
        Nature.NONDETERMINISTIC,
        equation="E = 1",
        idea="Counts.",
        limits=("none",),
        lobes=frozenset({"diffuse", "emission"}),
    )

    def memory(self, world, receivers, settings):
        return 10

    def solve(self, world, receivers, settings, rng):
        if settings.fails:
            raise SceneError("Scene", "is not liked", "Choose another")
        n = receivers.count
        sign = np.where(np.arange(n) % 2 == 0, 1.0, -1.0)[:, None] * rng.choice((-1, 1))
        zero, one = np.zeros((n, 3), np.float32), np.ones(n, np.float32)
        for k in range(1, settings.samples + 1):
            time.sleep(STEP)
            value = np.tile(1 + settings.bias + sign / math.sqrt(k), (1, 3)).astype(np.float32)
            last = k == settings.samples

            def solution(value=value, k=k, last=last):
                return Solution("counting", "irradiance", zero, value, zero, zero + 0.5, one, rays=RAYS * k, partial=not last)

            yield Step(k / settings.samples, f"{k}", solution)


class Exact(Counting):
    """The same, deterministic."""

    spec = replace(Counting.spec, id="exact", number=902, label="Exact", natures=(Nature.DETERMINISTIC,))


class Other(Counting):
    """Answers something else."""

    spec = replace(Counting.spec, id="other", number=903, label="Other", answers="potential")


class Later(Counting):
    """The same after a first pass of so many steps, during which its answer is 9."""

    spec = replace(Counting.spec, id="later", number=904, label="Later", natures=(Nature.DETERMINISTIC, Nature.NONDETERMINISTIC))
    steps = 20

    def solve(self, world, receivers, settings, rng):
        n = receivers.count
        zero, first = np.zeros((n, 3), np.float32), np.full((n, 3), 9, np.float32)
        for k in range(1, self.steps + 1):
            time.sleep(STEP)

            def solution(k=k):
                return Solution("later", "irradiance", zero, first, zero, zero, np.ones(n, np.float32), rays=RAYS * k, partial=True)

            yield Step(0.3 * k / self.steps, "first", solution)
        for step in super().solve(world, receivers, settings, rng):
            at = step.solution()
            yield Step(0.3 + 0.7 * step.fraction, "then", lambda at=at: replace(at, rays=at.rays + RAYS * self.steps))


CLASSES = (Counting, Exact, Other, Later)


@pytest.fixture
def methods():
    for cls in CLASSES:
        registry.register(cls)
    yield
    for cls in CLASSES:
        del registry._METHODS[cls.spec.id]


@pytest.fixture(scope="module")
def place():
    world = World(scenes.room())
    return world, ElementReceivers(Elements(world, max_edge=1.0))


def run_meter(place, budget, settings=None, reference=None):
    world, receivers = place
    meter = Meter(Counting(), world, receivers, settings or CountSettings(), reference or constant_reference((1.0,), receivers.count))
    for _ in meter.run(budget):
        pass
    return meter


def compare(place, plan, reference=None):
    driver = Driver(Comparison(reference), *place, plan)
    return driver.run()


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [("time=30", "time", 30), ("rays=1e7", "rays", 1e7), ("error=0.02", "error", 0.02), (" time = 2 ", "time", 2)],
)
def test_budgets_are_read(text, kind, value):
    assert (Budget.parse(text).kind, Budget.parse(text).value) == (kind, value)


def test_a_budget_says_what_every_method_really_gets():
    assert Budget.parse("time=60").text == "equal time, 60 s each"
    assert Budget.parse("time=600").text == "equal time, 300 s each, the time limit"
    assert Budget.parse("time=600", 1000.0).text == "equal time, 600 s each"
    assert Budget.parse("rays=1e7", 5.0).text == "equal rays, 10,000,000 each"
    assert Budget.parse("error=0.02", 5.0).text == "equal error, relative RMSE 2 %"


@pytest.mark.parametrize("text", ["time", "time=", "time=x", "time=0", "time=-1", "time=nan", "rays=inf", "memory=3", "=3", ""])
def test_wrong_budgets_are_refused(text):
    with pytest.raises(SettingsError, match="budget"):
        Budget.parse(text)


def test_the_error_is_the_relative_rmse(place):
    n = 4
    zero = np.zeros((n, 3), np.float32)
    solution = Solution("x", "irradiance", zero, zero + np.float32(3), zero, zero, np.ones(n, np.float32))
    assert error_of(solution, constant_reference((2.0,), n)) == pytest.approx((0.5, 0.5))
    # A receiver without an answer is wrong by all of its value.
    some = replace(solution, weight=np.array([1, 1, 1, 0], np.float32))
    assert error_of(some, constant_reference((2.0,), n))[0] == pytest.approx(math.sqrt((3 * 1 + 4) / 4) / 2)
    # One that the reference does not know does not count.
    partly = Reference("", np.full((n, 3), 2.0), np.array([True, False, False, False]))
    assert error_of(some, partly)[0] == pytest.approx(0.5)
    assert error_of(replace(solution, weight=np.zeros(n, np.float32)), constant_reference((2.0,), n)) is None
    assert error_of(solution, constant_reference((0.0,), n)) is None


def test_time_ends_a_run_and_its_clock_leaves_out_what_is_done_between(place, clock):
    world, receivers = place
    meter = Meter(Counting(), world, receivers, CountSettings(samples=10**6), constant_reference((1.0,), receivers.count))
    for _ in meter.run(Budget("time", 0.1)):
        clock.sleep(0.01)  # someone draws a panel
    assert meter.state == "budget"
    assert 0.1 <= meter.seconds < 0.1 + 3 * STEP
    assert clock.now > 1.5 * meter.seconds
    assert meter.solution().seconds == meter.seconds and meter.solution().partial
    # Snapshots lie ever farther apart, and the error falls as the root of the steps.
    seconds = np.array([p.seconds for p in meter.curve])
    assert 3 <= len(seconds) < 12 and (np.diff(seconds) > 0).all()
    steps = np.array([p.rays / RAYS for p in meter.curve])
    np.testing.assert_allclose([p.error for p in meter.curve], 1 / np.sqrt(steps), rtol=1e-5)


def test_rays_end_a_run_at_the_first_step_beyond(place):
    meter = run_meter(place, Budget("rays", 12_500))
    assert meter.state == "budget"
    assert 12_500 <= meter.solution().rays <= 15_000


def test_an_error_ends_a_run_when_it_is_reached(place):
    meter = run_meter(place, Budget("error", 0.3))
    assert meter.state == "reached" and meter.curve[-1].error <= 0.3 < meter.curve[-2].error


def test_an_error_that_is_never_reached_ends_with_the_method_or_the_limit(place):
    assert run_meter(place, Budget("error", 1e-3), CountSettings(samples=3)).state == "finished"
    assert run_meter(place, Budget("error", 1e-3, limit=0.05), CountSettings(samples=1000)).state == "limit"


def test_the_budget_ends_methods_that_would_end_too_early(methods, place):
    """A trial run says how many samples fit: without it 2 samples would be done in a moment."""
    plan = Plan(("counting",), Budget("time", 0.4), settings={"counting": CountSettings(samples=2)}, repeats=0)
    entry = compare(place, plan, constant_reference((1.0,), place[1].count)).entries[0]
    assert entry.state == "budget" and entry.settings["samples"] > 40
    plan = Plan(("exact",), Budget("time", 0.4), settings={"exact": CountSettings(samples=2)}, repeats=0)
    entry = compare(place, plan, constant_reference((1.0,), place[1].count)).entries[0]
    assert entry.state == "finished" and entry.settings["samples"] == 2
    assert [n.severity for n in entry.notices] == ["info"] and "ended by itself after" in entry.notices[0].reason


def test_the_budget_ends_methods_that_solve_something_first(methods, place):
    """Their samples go on until the budget ends; before the first one their result is not what they promise."""
    known = constant_reference((1.0,), place[1].count)
    plan = Plan(("later",), Budget("time", 0.6), settings={"later": CountSettings(samples=2)}, repeats=2)
    entry = compare(place, plan, known).entries[0]
    assert entry.state == "budget" and entry.complete and entry.seconds > 0.6
    assert entry.rays > RAYS * (Later.steps + 20) and entry.error < 0.3
    # Runs with other seeds come to samples, too: no flux is that of the first pass.
    whole = 3 * result_area(place)
    np.testing.assert_allclose(entry.fluxes.sum(axis=1), whole, rtol=0.3)
    short = Plan(("later",), Budget("time", 0.05), settings={"later": CountSettings(samples=2)}, repeats=2)
    entry = compare(place, short, known).entries[0]
    assert not entry.complete and entry.fluxes is None and "did not end" in entry.notices[0].reason
    assert entry.settings["samples"] == 2


def result_area(place):
    return groups_of(*place).area.sum()


def test_runs_with_other_seeds_take_no_longer_than_the_error_took(methods, place, clock):
    plan = Plan(("counting",), Budget("error", 0.3, 3.0), repeats=2)
    sleeps = []
    sleep = clock.sleep
    clock.sleep = lambda seconds: sleeps.append(seconds) or sleep(seconds)
    result = compare(place, plan, constant_reference((1.0,), place[1].count))
    entry = result.entries[0]
    assert entry.state == "reached" and len(entry.fluxes) == 2
    steps = entry.curve[-1].rays / RAYS
    assert 10 < steps < 20 and len(sleeps) <= 5 * (steps + 1)  # the limit would have been 40 steps for each run


def test_a_reference_of_nothing_is_refused(methods, place):
    with pytest.raises(SettingsError, match="a relative error needs a mean above 0"):
        Comparison(constant_reference((0.0,), 3))
    with pytest.raises(SettingsError, match="known at no receiver"):
        Comparison(Reference("x", np.ones((3, 3)), np.zeros(3, bool)))
    plan = Plan(("exact",), Budget("time", 0.1), "counting", 0.1, {"counting": CountSettings(bias=-1.0)}, repeats=0)
    with pytest.raises(SettingsError, match="the mean of Counting"):
        compare(place, plan)


def test_path_lengths_that_differ_are_said(methods, place):
    settings = {"exact": CountSettings(samples=2, min_length=2), "counting": CountSettings(), "later": CountSettings(max_length=1024)}
    plan = Plan(("exact", "counting", "later"), Budget("time", 0.3), "counting", 0.2, settings, repeats=2)
    result = compare(place, plan)
    exact, counting, later = result.entries
    assert [e.lengths for e in result.entries] == [(2, 1024), (1, 1024), (1, 1024)]
    assert any("the reference 1 and more: its error holds that difference" in n.reason for n in exact.notices)
    assert not any("its error holds" in n.reason for n in (*counting.notices, *later.notices))
    assert page.gap_of(result, exact) is None
    data = json.loads(json.dumps(page.as_json(result), allow_nan=False))
    assert [m["lengths"] for m in data["methods"]] == [[2, 1024], [1, 1024], [1, 1024]]
    assert [m["gap"] is None for m in data["agreement"]["methods"]] == [True, False, False]
    text = page.page("x", result, {}, [])
    assert "Not compared: path lengths 2 and more (Exact) with" in text and "nan" not in text


def test_the_winner_has_the_least_error_at_equal_time_and_the_least_time_at_equal_error(methods, place):
    known = constant_reference((1.0,), place[1].count)
    settings = {"counting": CountSettings(bias=0.5), "exact": CountSettings(samples=9)}
    result = compare(place, Plan(("counting", "exact"), Budget("time", 0.2), settings=settings, repeats=0), known)
    assert result.winner.method == "exact" and "Exact has the least error" in page.best_text(result)
    result = compare(place, Plan(("counting", "exact"), Budget("error", 0.6, 1.0), settings=settings, repeats=0), known)
    by = {e.method: e for e in result.entries}
    assert all(e.state == "reached" for e in result.entries)
    assert result.winner is min(by.values(), key=lambda e: e.seconds)
    assert winner([replace(by["exact"], state="limit")], Budget("error", 0.6)) is None
    assert winner([replace(by["exact"], error=None)], Budget()) is None
    early, exact = replace(by["exact"], seconds=1.0, error=0.5), replace(by["exact"], seconds=2.0, error=0.1)
    assert winner([exact, early], Budget("error", 0.6)) is early and winner([early, exact], Budget("time", 2.0)) is exact


def test_a_method_that_cannot_take_part_is_listed_and_the_others_go_on(methods, place, monkeypatch):
    settings = {"counting": CountSettings(fails=True), "exact": CountSettings(samples=2)}
    plan = Plan(("counting", "other", "exact"), Budget("time", 0.1), settings=settings, repeats=0)
    result = compare(place, plan, constant_reference((1.0,), place[1].count))
    assert [e.method for e in result.entries] == ["exact"]
    assert [(n.object, n.reason) for n in result.refused][0] == ("Scene", "is not liked")
    assert "answers potential" in result.refused[1].reason
    monkeypatch.setattr(Counting, "memory", lambda *_: 10**18)
    assert "needs" in reason_not_to(Counting(), *place, CountSettings()).reason
    monkeypatch.setattr(Counting, "spec", replace(Counting.spec, receivers=("camera",)))
    assert "does not answer elements" in reason_not_to(Counting(), *place, CountSettings()).reason


def test_memory_is_asked_again_with_the_samples_that_fit_the_budget(methods, place, monkeypatch):
    """Of the methods and of the reference: what fits with the user's samples need not fit with more."""
    monkeypatch.setattr(Counting, "memory", lambda self, world, receivers, settings: 10**18 if settings.samples > 40 else 10)
    known = constant_reference((1.0,), place[1].count)
    result = compare(
        place, Plan(("counting", "exact"), Budget("time", 0.3), settings={"exact": CountSettings(samples=2)}, repeats=0), known
    )
    assert [e.method for e in result.entries] == ["exact"] and "needs" in result.refused[0].reason
    with pytest.raises(AdjointError, match="Reference Counting: needs"):
        compare(place, Plan(("exact",), Budget("time", 0.1), "counting", 0.6, {"exact": CountSettings(samples=2)}, repeats=0))


def test_the_setting_that_a_budget_scales_is_marked(methods):
    @dataclass(frozen=True)
    class Renamed(Settings):
        samples: int = setting(4, label="Samples", help="Not to be scaled", min=1)
        darts: int = setting(4, label="Darts", help="To be scaled", min=1, effort=True)

    class Throwing(Counting):
        Settings = Renamed

    assert effort.effort_field(Throwing()).name == "darts"
    assert effort.effort_field(Exact()) is None  # its samples are counted, not drawn


def test_a_method_that_crashes_is_an_error_and_the_others_go_on(methods, place, monkeypatch):
    def crash(self, world, receivers, settings, rng):
        raise ZeroDivisionError("by nothing")
        yield

    monkeypatch.setattr(Exact, "solve", crash)
    plan = Plan(("exact", "counting"), Budget("time", 0.1), settings={"counting": CountSettings(samples=2)}, repeats=0)
    result = compare(place, plan, constant_reference((1.0,), place[1].count))
    assert [e.method for e in result.entries] == ["counting"]
    assert (result.refused[0].object, result.refused[0].severity) == ("Exact", "error")
    assert "ZeroDivisionError: by nothing" in result.refused[0].reason


def test_a_random_reference_knows_its_noise_and_shares_no_seed(methods, place, monkeypatch):
    seeds = []
    solve = Counting.solve
    monkeypatch.setattr(Counting, "solve", lambda self, w, r, s, rng: seeds.append(s.seed) or solve(self, w, r, s, rng))
    result = compare(place, Plan(("counting",), Budget("time", 0.08), "counting", 0.2, repeats=3))
    assert result.reference.noise is not None and "Counting" in result.reference.label
    trial_reference, *halves, trial, full = seeds[:5]
    assert len({*halves, full, *seeds[5:]}) == 2 + 1 + 3 and trial_reference == trial == full
    assert result.entries[0].fluxes.shape == (3, len(result.groups.names))


def test_a_reference_is_known_where_both_of_its_halves_are(methods, place, monkeypatch):
    """Each half lacks another receiver: the mean of one value and none is no reference."""
    seeds, n = [], place[1].count
    solve = Counting.solve

    def lacking(self, world, receivers, settings, rng):
        seeds.append(settings.seed)
        k = len(set(seeds)) - 2  # -1: the trial run
        for step in solve(self, world, receivers, settings, rng):
            found = step.solution()
            found = replace(found, weight=found.weight * (np.arange(n) != k))
            yield replace(step, solution=lambda found=found: found)

    monkeypatch.setattr(Counting, "solve", lacking)
    reference = compare(place, Plan(("exact",), Budget("time", 0.08), "counting", 0.2, repeats=0)).reference
    np.testing.assert_array_equal(reference.valid, np.arange(n) >= 2)


def test_a_stopped_comparison_keeps_what_it_has(methods, place):
    settings = {m: CountSettings(samples=5000) for m in ("counting", "exact")}
    plan = Plan(("exact", "counting"), Budget("time", 1.0), settings=settings, repeats=0)
    driver = Driver(Comparison(constant_reference((1.0,), place[1].count)), *place, plan)
    seen = []

    def stop(driver):
        seen.append("Exact" in driver.text)
        if sum(seen) == 20:
            raise KeyboardInterrupt

    result = driver.run(stop)
    assert driver.state == "stopped" and result.partial and [e.method for e in result.entries] == ["exact"]
    assert (result.entries[0].state, result.entries[0].complete) == ("partial", False)
    assert result.entries[0].error is not None and result.winner is None  # others have not run
    assert page.best_text(result).startswith("There is no winner") and '<tr class="best">' not in page.page("x", result, {}, [])
    assert driver.cancel()


def test_the_page_escapes_what_users_write(methods, place):
    plan = Plan(("exact",), Budget("time", 0.1), settings={"exact": CountSettings(samples=2)}, repeats=0)
    result = compare(place, plan, constant_reference((1.0,), place[1].count))
    text = page.page("<script>alert(1)</script>", result, {}, [Notice("<b>", "is & bold", "")], [("a<", ">b")])
    assert "<script>" not in text and "&lt;b&gt;: is &amp; bold" in text and "a&lt;: &gt;b" in text


WRONG = [{"methods": ()}, {"methods": ("a", "a")}, {"repeats": 1}, {"repeats": -1}, {"reference_seconds": 0.0}]


@pytest.mark.parametrize("wrong", [*WRONG, {"reference_seconds": math.nan}])
def test_wrong_plans_are_refused(wrong):
    with pytest.raises(SettingsError):
        Plan(**({"methods": ("a",)} | wrong))


def test_every_state_has_words():
    assert {"finished", "budget", "reached", "limit", "partial"} == set(comparison.STATES)


def test_the_noise_of_a_reference_is_half_of_what_its_halves_differ_by(methods, place):
    """Both halves are off by noise of the same size: where its signs differ they cancel in the mean, and that size is the estimate."""

    def reference(differ):
        signs = [[np.random.default_rng(seed + 1_000_003 * half).choice((-1, 1)) for half in (1, 2)] for seed in range(100)]
        seed = next(seed for seed, (a, b) in enumerate(signs) if (a != b) == differ)
        plan = Plan(("exact",), Budget("time", 0.04), "counting", 0.4, {"counting": CountSettings(seed=seed)}, repeats=0)
        return compare(place, plan).reference

    alike, apart = reference(False), reference(True)
    assert alike.noise == 0 and np.allclose(apart.values, 1)
    assert apart.noise == pytest.approx(np.abs(alike.values - 1).mean(), rel=0.05)


def test_the_duality_gap_is_a_share_of_what_is_shot_and_above_zero_where_more_is_gathered():
    entry = SimpleNamespace(complete=True, lengths=(1, 9))
    result = SimpleNamespace(shot=(2.0, 0.1), lengths=(1, 9), gathered=lambda entry: 2.5)
    assert page.gap_of(result, entry) == pytest.approx(0.25)
    assert page.gap_of(result, SimpleNamespace(complete=True, lengths=(0, 9))) is None


def test_repeats_share_what_is_left_after_the_first_pass():
    assert Budget("rays", 1000.0).scaled(0.25, rays=200).value == pytest.approx(400)
    assert Budget("time", 10.0).scaled(0.25, seconds=2.0).seconds == pytest.approx(4)
    assert Budget("rays", 100.0).scaled(0.25, rays=200).value == pytest.approx(200)


def test_a_budget_of_rays_bounds_the_samples(methods, place):
    """Twice the steps that cast as many rays, as a power of two; time enough for many more."""
    *_, found = effort.with_effort(Counting(), *place, CountSettings(samples=40), Budget("rays", 5 * RAYS, 100.0))
    assert found.settings.samples == 16 and found.endless


@pytest.mark.parametrize("before", (0, 20))
def test_what_comes_before_the_first_sample_is_no_time_of_samples(place, before):
    """A sample takes 8 ms, and 20 steps before them a second: 250 samples fit 2 s, and twice as many, as a power of two, are asked for."""

    class Prepared(Counting):
        def solve(self, world, receivers, settings, rng):
            for _ in range(before):
                time.sleep(0.05)
                yield Step(0.0, "before", lambda: None)
            yield from super().solve(world, receivers, settings, rng)

    *_, found = effort.with_effort(Prepared(), *place, CountSettings(samples=40), Budget("time", 2.0))
    assert found.settings.samples == 512 and found.endless


def test_rays_by_now_follow_the_clock():
    meter = SimpleNamespace(curve=[comparison.Point(2.0, 100, None)], seconds=3.0)
    assert Meter.predicted_rays(meter) == 150
    assert Meter.predicted_rays(SimpleNamespace(curve=[], seconds=3.0)) == math.inf


def test_repeats_make_the_error_of_their_mean(methods):
    """Of 1, 3, 5 and 7: 4 with a standard deviation of sqrt(20 / 3), and half of that for the mean of four."""
    entry = SimpleNamespace(complete=True, method="counting", label="Counting", lengths=(0, 64), random=True)
    entry.fluxes = np.array([[1.0, 2.0], [3.0, 2.0], [5.0, 2.0], [7.0, 2.0]])
    world = SimpleNamespace(shading=SimpleNamespace(substitutions=lambda _: ()))
    found = running._Stages._measured(SimpleNamespace(world=world), entry)
    assert (found.value.tolist(), found.freedom) == ([4, 2], 3)
    assert found.error == pytest.approx([math.sqrt(20 / 3) / 2, 0])


def test_the_page_says_how_much_of_a_reference_is_known():
    known = Reference("Known", np.ones((4, 3)), np.array([True, False, False, False]), 0.0)
    text = page._first(SimpleNamespace(entries=[1, 2], budget=Budget("time", 2.0), reference=known))
    assert text == "2 methods, equal time, 2 s each. Reference: Known (exact), known for 25 % of the receivers."


@pytest.mark.parametrize("budget, told", [("time=10", True), ("rays=1e6", False), ("error=0.1", False)])
def test_only_a_budget_of_time_can_be_unused(budget, told):
    assert (effort.unused_budget("Exact", CountSettings(), 1.0, Budget.parse(budget)) is not None) == told
    assert effort.unused_budget("Exact", CountSettings(), 9.5, Budget.parse(budget)) is None
