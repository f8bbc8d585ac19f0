"""The comparison itself, as a generator like that of a method, so that the same driver runs, stops and cancels it.

Stages: the reference, the flux by Eq. 4, then method by method one full run and, for random ones, repeats with other seeds. Errors of
a method (memory refused, a scene that it does not take) are part of the result; the others go on.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..base.errors import AdjointError, Notice
from ..base.settings import Settings
from ..flux.agreement import EVERY_LENGTH, Agreement, Groups, Measured, ShotFlux, agreement, allowance_of, groups_of, shoot
from ..method.registry import Solver, method
from ..method.solution import Solution, Step
from ..receivers.base import Receivers
from ..scene.world import World
from ..walks.path_limit import TOLD
from .budget import (
    Budget,
    Entry,
    Meter,
    Plan,
    Reference,
    error_of,
    is_complete,
    known_above_zero,
    lengths_counted,
    quantity,
    reason_not_to,
    winner,
)
from .effort import Effort, is_random, unused_budget, with_effort

HALVES = 2  # independent runs of a random reference, whose difference gives its noise
SHOT = 0.25  # share of a budget's time that the flux by Eq. 4 may take, but no more than SHOT_MOST seconds
SHOT_MOST = 10.0
LEAST = 16  # batches of particles


@dataclass(frozen=True, eq=False)
class Result:
    """A comparison as far as it has come. `partial`, `seconds`, `rays` and `settings` are what a driver asks of any result."""

    entries: tuple[Entry, ...]
    refused: tuple[Notice, ...]
    reference: Reference | None
    agreement: Agreement | None
    groups: Groups | None
    budget: Budget
    measure: str
    seconds: float = 0.0
    rays: int = 0
    partial: bool = True
    settings: dict[str, Any] = field(default_factory=dict)
    lengths: tuple[int, int] = EVERY_LENGTH  # of the paths that Eq. 4 counts

    @property
    def winner(self) -> Entry | None:
        """See `budget.winner`; None while some methods have not run, or not to their ends."""
        return None if self.partial else winner(self.entries, self.budget)

    def gathered(self, entry: Entry) -> float:
        """<L, g> of one method over all receivers, W (for a camera the mean radiance)."""
        return float(self.groups.flux(quantity(entry.solution)).sum())

    @property
    def shot(self) -> tuple[float, float] | None:
        """<W, Le> over all receivers and its standard error, W. Errors of objects are added as if they went together."""
        s = self.agreement.shot if self.agreement is not None else None
        return None if s is None else (float(s.value.sum()), float(s.error.sum()))


class Comparison:
    """In place of a solver. `reference` is one that is known already; else `plan.reference` names the method that makes it.

    Raises SettingsError for a reference from which no relative error can be computed."""

    spec = SimpleNamespace(label="Comparison")

    def __init__(self, reference: Reference | None = None) -> None:
        self.reference = known_above_zero(reference) if reference is not None else None

    def memory(self, world: World, receivers: Receivers, plan: Plan) -> int:
        """What is kept of every method: its solution and the copies of one."""
        return receivers.count * 80 * (len(plan.methods) + 4)

    def solve(self, world: World, receivers: Receivers, plan: Plan, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every step of every method. `rng` is not used: every run has the seed of its settings."""
        yield from _Stages(world, receivers, plan, self.reference).steps()


class _Stages:
    """The state of one comparison."""

    def __init__(self, world: World, receivers: Receivers, plan: Plan, reference: Reference | None) -> None:
        self.world, self.receivers, self.plan, self.reference = world, receivers, plan, reference
        self.began = time.perf_counter()
        self.groups: Groups | None = None
        self.shot: ShotFlux | None = None
        self.entries: list[Entry] = []
        self.refused: list[Notice] = []
        self.running: tuple[Solver, Effort, Meter] | None = None  # the full run that is under way
        counted = [self._lengths(method(id)) for id in plan.methods]
        self.lengths = Counter(counted).most_common(1)[0][0]  # of the paths that Eq. 4 counts
        self.reference_lengths: tuple[int, int] | None = None
        self.rays = 0
        self.done = False
        self._report: tuple[int, Agreement] | None = None
        each = plan.budget.seconds
        self._stages = [(plan.reference_seconds if plan.reference else 0.0) + min(SHOT * each, SHOT_MOST)] + [2 * each] * len(plan.methods)
        self._stage = 0

    def steps(self) -> Iterator[Step]:
        """All stages."""
        yield self._step(0.0, "Receivers")
        self.groups = groups_of(self.world, self.receivers)
        if self.reference is None and self.plan.reference:
            yield from self._make_reference()
        if self.receivers.measure == "irradiance":
            yield from self._shoot()
        for id in self.plan.methods:
            self._stage += 1
            yield from self._method(method(id))
        self.done = True
        yield self._step(1.0, f"{len(self.entries)} methods")

    # ---- stages

    def _make_reference(self) -> Iterator[Step]:
        """The reference method, in independent halves where it is random."""
        solver = method(self.plan.reference)
        settings = self._settings(solver)
        self._require_reference(solver, settings)
        halves = HALVES if is_random(solver) else 1
        seconds = self.plan.reference_seconds / halves
        budget = Budget("time", seconds, seconds)
        for effort in with_effort(solver, self.world, self.receivers, settings, budget):
            if effort is None:
                yield self._step(0.0, "Reference: finding how many samples fit its time")
        self._require_reference(solver, effort.settings)  # more samples may need more memory
        found: list[Solution] = []
        for half in range(halves):
            # Seeds far from those of the runs, so that nothing is measured against itself.
            at = dataclasses.replace(effort.settings, seed=(settings.seed + 1_000_003 * (half + 1)) % (2**31))
            meter = yield from self._drive(solver, at, budget, None, f"Reference {half + 1} of {halves}: ")
            found.append(meter.solution())
            self.rays += found[-1].rays
        notices: list[Notice] = list(found[0].warnings)
        if found[0].partial and not effort.endless:
            notices.append(Notice(solver.spec.label, "did not end in the time of the reference", "Give the reference more time"))
        values = np.mean([quantity(s).astype(np.float64) for s in found], axis=0)
        valid = np.all([s.weight > 0 for s in found], axis=0)
        noise = None
        if halves > 1 and valid.any() and values[valid].mean() > 0:
            half = 0.5 * (quantity(found[0]).astype(np.float64) - quantity(found[1]))[valid]
            noise = float(np.sqrt((half**2).mean()) / values[valid].mean())
        total = sum(s.seconds for s in found)
        label = f"{solver.spec.label}, {total:.3g} s"
        self.reference = known_above_zero(Reference(label, values, valid, noise, total, tuple(notices)))
        self.reference_lengths = self._lengths(solver)

    def _require_reference(self, solver: Solver, settings: Settings) -> None:
        """Raise AdjointError where the reference's method cannot run with these settings, for want of memory among others."""
        problem = reason_not_to(solver, self.world, self.receivers, settings)
        if problem is not None:
            raise AdjointError(f"Reference {problem.object}", problem.reason, problem.remedy or "Choose another reference")

    def _shoot(self) -> Iterator[Step]:
        """Flux by Eq. 4: particles, for a share of the time."""
        longest, spent = min(SHOT * self.plan.budget.seconds, SHOT_MOST), 0.0
        alike = [s for s in map(method, self.plan.methods) if self._lengths(s) == self.lengths]
        most = max(self._settings(s).max_length for s in alike)
        source = shoot(self.world, self.groups, self.receivers.kind == "elements", self.lengths[0], most, self.plan.seed)
        while True:
            began = time.perf_counter()
            found = next(source)
            spent += time.perf_counter() - began
            self.shot = found or self.shot
            if found is not None and found.batches >= LEAST and spent >= longest:
                break
            yield self._step(min(1.0, spent / longest), "Flux by Eq. 4")
        self.rays += self.shot.rays

    def _method(self, solver: Solver) -> Iterator[Step]:
        """One full run, and repeats where it is random."""
        settings = self._settings(solver)
        label = solver.spec.label
        problem = reason_not_to(solver, self.world, self.receivers, settings)
        if problem is not None:
            self.refused.append(problem)
            return
        budget = self.plan.budget
        try:
            for effort in with_effort(solver, self.world, self.receivers, settings, budget):
                if effort is None:
                    yield self._step(0.0, f"{label}: finding how many samples fit the budget")
            problem = reason_not_to(solver, self.world, self.receivers, effort.settings)
            if problem is not None:
                self.refused.append(problem)
                return
            meter = yield from self._drive(solver, effort.settings, budget, self.reference, f"{label}: ", 0.5, effort)
            entry = self._entry(solver, effort, meter)
            self.rays += entry.rays
            self.entries.append(entry)
            if entry.random and entry.complete and self.plan.repeats:
                yield from self._repeat(solver, effort, entry)
        except AdjointError as error:
            self.refused.append(dataclasses.replace(error.notice, severity="warning"))
        except Exception as error:  # a bug of one method must not cost the results of the others, but has to be seen
            self.refused.append(Notice(label, f"failed with {type(error).__name__}: {error}", "Report this with the scene", "error"))
        finally:
            self.running = None

    def _repeat(self, solver: Solver, effort: Effort, entry: Entry) -> Iterator[Step]:
        """Independent runs with a share of the budget each, or of the time in which the error was reached. A method that had ended by
        itself may do so again. What is solved first is not shared: twice the time that it took, as the machine may be busy."""
        k, budget = self.plan.repeats, self.plan.budget
        if entry.state in ("finished", "reached") and not entry.solution.partial and entry.seconds < budget.seconds:
            budget = Budget("time", 2 * budget.seconds, 2 * budget.seconds)
        else:
            budget = Budget("time", entry.seconds, budget.limit) if entry.state == "reached" else budget
            budget = budget.scaled(1 / k, 2 * effort.seconds, effort.rays)
        fluxes, settings = [], effort.settings
        for run in range(k):
            at = dataclasses.replace(settings, seed=(settings.seed + 7919 * (run + 1)) % (2**31))
            text = f"{entry.label}, other seeds, {run + 1} of {k}: "
            meter = yield from self._drive(solver, at, budget, None, text, 0.5 / k, at=0.5 + 0.5 * run / k)
            found = meter.solution()
            self.rays += found.rays
            if not is_complete(found, effort.endless, effort.rays):
                within = f"within {budget.seconds:.3g} s"
                reason = f"its runs with other seeds did not come to an answer everywhere {within}: its noise is not known"
                notice = Notice(entry.label, reason, "Give it a larger budget, or ask for fewer repeats")
                self.entries[-1] = dataclasses.replace(entry, notices=(*entry.notices, notice))
                return
            fluxes.append(self.groups.flux(quantity(found)))
        self.entries[-1] = dataclasses.replace(entry, fluxes=np.array(fluxes))

    def _drive(
        self,
        solver: Solver,
        settings: Settings,
        budget: Budget,
        reference: Reference | None,
        text: str,
        share: float = 1.0,
        full: Effort | None = None,
        at: float = 0.0,
    ) -> Iterator[Step]:
        """One run to its end, from `at` of this stage on and for a `share` of it; returns its meter. `full`: of a full run."""
        meter = Meter(solver, self.world, self.receivers, settings, reference)
        with closing(meter):
            for _ in meter.run(budget):
                self.running = (solver, full, meter) if full else None
                yield self._step(at + share * min(1.0, meter.seconds / budget.seconds), text + meter.step.text)
            self.running = None
        if meter.step is None:
            raise AdjointError(solver.spec.label, "gave no result", "Report this with the scene")
        return meter

    # ---- results

    def _settings(self, solver: Solver) -> Settings:
        given = self.plan.settings.get(solver.spec.id)
        if given is not None:
            return given
        return dataclasses.replace(solver.Settings(), seed=self.plan.seed)

    def _lengths(self, solver: Solver) -> tuple[int, int]:
        return lengths_counted(self._settings(solver), self.receivers.measure)

    def _entry(self, solver: Solver, effort: Effort, meter: Meter) -> Entry:
        found = meter.solution()
        judged = error_of(found, self.reference) if self.reference is not None else None
        notices = [n for n in found.warnings if n not in self.world.scene.warnings]
        if not is_complete(found, effort.endless, effort.rays) and meter.state != "finished":
            reason = f"did not end within {meter.seconds:.3g} s: its result is partial"
            notices.append(Notice(solver.spec.label, reason, "Give it a larger budget or coarser settings"))
        if meter.state == "finished":
            notices += filter(None, [unused_budget(solver.spec.label, effort.settings, meter.seconds, self.plan.budget)])
        lengths = self._lengths(solver)
        if found.left_out is not None and found.left_out < TOLD and lengths[1] > 2:
            lengths = (lengths[0], EVERY_LENGTH[1])  # it has all the light there is
        if self.reference_lengths not in (None, lengths):
            (a, b), (c, d) = lengths, self.reference_lengths
            reason = f"counts path lengths {_range(a, b)}, the reference {_range(c, d)}: its error holds that difference"
            notices.append(Notice(solver.spec.label, reason, "Give both methods the same min_length and max_length"))
        return Entry(
            solver.spec.id,
            solver.spec.label,
            meter.state,
            found,
            meter.seconds,
            int(found.rays),
            judged[0] if judged else None,
            judged[1] if judged else None,
            tuple(meter.curve),
            effort.settings.as_dict(),
            tuple(notices),
            is_random(solver),
            effort.endless,
            first=effort.rays,
            lengths=lengths,
        )

    def _step(self, share: float, text: str) -> Step:
        total = sum(self._stages)
        before = sum(self._stages[: self._stage])
        fraction = 1.0 if self.done else min(0.999, (before + share * self._stages[self._stage]) / total)
        return Step(fraction, text, self._result)

    def _result(self) -> Result:
        report = None
        if self.groups is not None:
            # Of all that is copied only this takes time, so it is kept until there is something new.
            key = sum(2 + (e.fluxes is not None) for e in self.entries)
            if self._report is None or self._report[0] != key:
                measured = [m for e in self.entries if (m := self._measured(e))]
                self._report = (key, agreement(self.groups, measured, self.shot, self.lengths))
            report = self._report[1]
        now = [self._entry(*self.running)] if self.running is not None else []
        return Result(
            (*self.entries, *now),
            tuple(self.refused),
            self.reference,
            report,
            self.groups,
            self.plan.budget,
            self.receivers.measure,
            time.perf_counter() - self.began,
            self.rays,
            not self.done,
            self.plan.as_dict(),
            self.lengths,
        )

    def _measured(self, entry: Entry) -> Measured | None:
        """Fluxes with errors; None for a result that is not complete, or a random one whose noise is not known."""
        if not entry.complete:
            return None
        spec = method(entry.method).spec
        notes = tuple(n.object + " " + n.reason for n in self.world.shading.substitutions(spec.lobes))
        stated = spec.leaves_out, notes, entry.lengths
        if not entry.random:
            value = self.groups.flux(quantity(entry.solution))
            return Measured(entry.method, entry.label, value, np.zeros(len(value)), 0, allowance_of(spec), *stated)
        if entry.fluxes is None or len(entry.fluxes) < 2:
            return None
        k = len(entry.fluxes)
        error = entry.fluxes.std(axis=0, ddof=1) / math.sqrt(k)
        value = entry.fluxes.mean(axis=0)
        return Measured(entry.method, entry.label, value, error, k - 1, allowance_of(spec), *stated)


def _range(low: int, high: int) -> str:
    """Path lengths in words."""
    return f"{low} to {high}" if high < EVERY_LENGTH[1] else f"{low} and more"
