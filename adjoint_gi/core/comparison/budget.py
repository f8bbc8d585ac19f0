"""Comparing methods: each solves the same world for the same receivers, within one budget, against one reference.

A budget is an equal time, an equal number of rays, or an equal error. Every generator is driven step by step; a run ends at the
first step at which its budget is used up, or by itself. The clock of a run counts only the time inside of its generator: neither
the snapshots from which its error is measured nor the other methods. So the load of the machine matters, but not what is recorded.

Errors are relative root mean square errors over receivers and colours: sqrt(mean (x - r)^2) / mean r.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import AdjointError, Notice, SettingsError
from ..base.resources import require_memory
from ..base.settings import Settings
from ..flux.agreement import EVERY_LENGTH
from ..method.registry import Solver
from ..method.solution import Solution, Step
from ..receivers.base import Receivers
from ..scene.world import World

BUDGET_KINDS = {"time": "s", "rays": "rays", "error": "relative RMSE"}
SPACING = 1.35  # ratio of the times of two snapshots
FIRST_SNAPSHOT = 0.02  # seconds before which no second snapshot is made
EVERYWHERE = 0.99  # share of receivers that must have got an answer
STATES = {
    "finished": "finished by itself",
    "budget": "ended by the budget",
    "reached": "reached the error",
    "limit": "ended by the time limit",
    "partial": "not ended",
}


@dataclass(frozen=True)
class Budget:
    """What every method may use: `value` seconds, rays, or the relative RMSE to reach; `limit` seconds end every run at the latest."""

    kind: str = "time"
    value: float = 10.0
    limit: float = 300.0

    def __post_init__(self) -> None:
        if self.kind not in BUDGET_KINDS:
            raise SettingsError("budget", f"{self.kind!r} is not possible", "Choose one of: " + ", ".join(BUDGET_KINDS))
        if not (math.isfinite(self.value) and self.value > 0 and math.isfinite(self.limit) and self.limit > 0):
            raise SettingsError("budget", f"{self.value} with a limit of {self.limit} s is not possible", "Give numbers above 0")

    @classmethod
    def parse(cls, text: str, limit: float = 300.0) -> Budget:
        """From "time=30", "rays=1e7" or "error=0.02"; raises SettingsError."""
        kind, equals, value = text.partition("=")
        try:
            return cls(kind.strip(), float(value), limit)
        except ValueError:
            pass
        raise SettingsError("--budget", f"cannot read {text!r}", "Write, for example, time=30, rays=1e7 or error=0.02")

    @property
    def seconds(self) -> float:
        """Most seconds that a run may take."""
        return min(self.value, self.limit) if self.kind == "time" else self.limit

    @property
    def text(self) -> str:
        """In words."""
        if self.kind == "time":
            return f"equal time, {self.seconds:g} s each" + (", the time limit" if self.seconds < self.value else "")
        if self.kind == "rays":
            return f"equal rays, {self.value:,.0f} each"
        return f"equal error, relative RMSE {100 * self.value:g} %"

    def scaled(self, share: float, seconds: float = 0.0, rays: int = 0) -> Budget:
        """A share of what is left of it after so many seconds or rays, on top of these; an error cannot be shared, so then it is a share of
        the time limit."""
        if self.kind == "rays":
            return Budget("rays", rays + share * max(self.value - rays, 0.0), self.limit)
        return Budget("time", seconds + share * max(self.seconds - seconds, 0.0), self.limit)


@dataclass(frozen=True, eq=False)
class Reference:
    """What results are measured against: values (n, 3) of the receivers, `valid` (n,) bool where they are known.

    noise   relative RMSE of the reference itself, None where it is not known; 0 for a closed form
    """

    label: str
    values: np.ndarray
    valid: np.ndarray
    noise: float | None = None
    seconds: float = 0.0
    notices: tuple[Notice, ...] = ()

    @property
    def mean(self) -> float:
        """Mean value."""
        return float(self.values[self.valid].mean()) if self.valid.any() else 0.0


def constant_reference(value: Sequence[float], count: int) -> Reference:
    """A closed form: the same one value or three colours for all receivers."""
    values = np.broadcast_to(np.asarray(value, np.float64), (3,))
    text = f"{values[0]:g}" if (values == values[0]).all() else " ".join(f"{v:g}" for v in values)
    return Reference(f"closed form {text}", np.tile(values, (count, 1)), np.ones(count, bool), 0.0)


@dataclass(frozen=True)
class Point:
    """A snapshot of a run: seconds and rays so far, relative RMSE (None without a reference)."""

    seconds: float
    rays: int
    error: float | None


@dataclass(frozen=True, eq=False)
class Entry:
    """The outcome of one method.

    state     one of STATES
    bias      relative difference of its mean to the reference's
    notices   its own warnings, replaced lobes among them
    random    another seed gives another result that is as good
    endless   more samples would go on improving it, so that its result means the same at any time after its first sample
    fluxes    (k, g) W, of k independent runs; None where there were none
    first     rays after which its first samples are in
    lengths   shortest and longest path that it counts
    """

    method: str
    label: str
    state: str
    solution: Solution
    seconds: float
    rays: int
    error: float | None
    bias: float | None
    curve: tuple[Point, ...]
    settings: dict[str, Any]
    notices: tuple[Notice, ...] = ()
    random: bool = False
    endless: bool = False
    fluxes: np.ndarray | None = None
    first: int = 0
    lengths: tuple[int, int] = EVERY_LENGTH

    @property
    def complete(self) -> bool:
        """Whether the result is what the method promises."""
        return is_complete(self.solution, self.endless, self.first)


def is_complete(solution: Solution, endless: bool, first: int) -> bool:
    """Whether a result is what its method promises: when it has ended, or any time after the `first` rays where samples are all that is
    added then; and there is a value (almost) everywhere."""
    everywhere = bool(len(solution.weight)) and float((solution.weight > 0).mean()) > EVERYWHERE
    return everywhere and (not solution.partial or (endless and solution.rays >= first))


def quantity(solution: Solution) -> np.ndarray:
    """(n, 3) what is compared: irradiance, or radiance for a camera."""
    return solution.quantity(solution.measure)


def error_of(solution: Solution, reference: Reference) -> tuple[float, float] | None:
    """(relative RMSE, relative difference of the means) over receivers that both know; None where there are none."""
    use = reference.valid & (solution.weight > 0)
    if not use.any():
        return None
    r = reference.values[use].astype(np.float64)
    d = quantity(solution)[use].astype(np.float64) - r
    scale = r.mean()
    if not scale > 0:
        return None
    # Receivers without a sample are wrong by their whole value: leaving them out would reward a run for starting.
    missing = reference.valid & ~(solution.weight > 0)
    squares = (d**2).sum() + (reference.values[missing].astype(np.float64) ** 2).sum()
    total = 3 * int(reference.valid.sum())
    whole = reference.values[reference.valid].astype(np.float64).mean()
    return float(math.sqrt(squares / total) / whole), float(d.mean() / scale)


class Meter:
    """Drives one solver and keeps its clock; what is done between two steps costs it nothing."""

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: Settings, reference: Reference | None) -> None:
        self.solver, self.settings, self.reference = solver, settings, reference
        self._steps = iter(solver.solve(world, receivers, settings, np.random.default_rng(settings.seed)))
        self.step: Step | None = None
        self.ended = False
        self.state = "partial"
        self.seconds = 0.0
        self.curve: list[Point] = []
        self._next = 0.0
        self._seen: Step | None = None

    def advance(self) -> bool:
        """Make one step; False when there is none left."""
        began = time.perf_counter()
        step = next(self._steps, None)
        self.seconds += time.perf_counter() - began
        self.ended = step is None
        self.step = step or self.step
        return not self.ended

    def solution(self) -> Solution:
        """Of the last step."""
        found = self.step.solution()
        return dataclasses.replace(found, seconds=self.seconds, partial=found.partial and not self.ended)

    def look(self, now: bool = False) -> Point | None:
        """A snapshot, if its time has come or when asked for `now`; else None."""
        if self.step is None or self.step is self._seen or not (now or self.seconds >= self._next):
            return None
        self._seen = self.step
        self._next = max(FIRST_SNAPSHOT, SPACING * self.seconds)
        found = self.solution()
        judged = error_of(found, self.reference) if self.reference is not None else None
        point = Point(self.seconds, int(found.rays), judged[0] if judged else None)
        self.curve.append(point)
        return point

    def predicted_rays(self) -> float:
        """Rays by now, from the last snapshot and the time since then."""
        if not self.curve or not self.curve[-1].seconds:
            return math.inf
        return self.curve[-1].rays * self.seconds / self.curve[-1].seconds

    def run(self, budget: Budget) -> Iterator[None]:
        """Step until the budget is used up, or to the end; yields after every step and leaves the outcome in `state`."""
        while self.advance():
            self.look(now=budget.kind == "rays" and self.predicted_rays() >= budget.value)
            if self._met(budget):
                self.state = "reached" if budget.kind == "error" else "budget"
                return
            if self.seconds >= budget.seconds:
                self.look(now=True)
                self.state = "limit" if budget.kind != "time" else "budget"
                return
            yield
        self.look(now=True)
        self.state = "reached" if budget.kind == "error" and self._met(budget) else "finished"

    def _met(self, budget: Budget) -> bool:
        """Whether the last snapshot has the rays, or the error, of the budget."""
        if not self.curve or budget.kind == "time":
            return False
        last = self.curve[-1]
        return last.rays >= budget.value if budget.kind == "rays" else last.error is not None and last.error <= budget.value

    def close(self) -> None:
        """Let the generator end its threads."""
        self._steps.close()


def reason_not_to(solver: Solver, world: World, receivers: Receivers, settings: Settings) -> Notice | None:
    """Why a method cannot take part, None when it can."""
    spec = solver.spec
    if spec.answers != "light":
        return Notice(spec.label, f"answers {spec.answers}, not light, so there is nothing to compare", "", "info")
    if receivers.kind not in spec.receivers:
        return Notice(spec.label, f"does not answer {receivers.kind}", "Compare it on other receivers", "info")
    try:
        needed = solver.memory(world, receivers, settings)
        limit = getattr(settings, "memory_limit", None)
        if limit is not None and needed > limit << 20:
            reason = f"could need {needed / 2**20:,.0f} MB, over its limit of {limit:,} MB"
            return Notice(spec.label, reason, "Raise max_edge or memory_limit", "warning")
        require_memory(spec.label, needed)
    except AdjointError as error:
        return dataclasses.replace(error.notice, severity="warning")
    return None


@dataclass(frozen=True)
class Plan:
    """What a comparison does. `settings` of methods that are not named are their defaults. `reference` names a method, or is "" where
    the reference is given or not wanted. `repeats` runs with other seeds, each with a `1 / repeats` share of the budget, give the noise of
    random methods."""

    methods: tuple[str, ...]
    budget: Budget = Budget()
    reference: str = ""
    reference_seconds: float = 40.0
    settings: Mapping[str, Settings] = field(default_factory=dict)
    repeats: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.methods:
            raise SettingsError("methods", "none is chosen", "Choose at least one method")
        if len(set(self.methods)) < len(self.methods):
            raise SettingsError("methods", "one is named twice", "Name each method once")
        if self.repeats < 0 or self.repeats == 1:
            raise SettingsError("repeats", f"{self.repeats} is not possible", "Choose 0 for none, or at least 2")
        if not (math.isfinite(self.reference_seconds) and self.reference_seconds > 0):
            raise SettingsError("reference", f"{self.reference_seconds} s are not possible", "Give a number above 0")

    def as_dict(self) -> dict[str, Any]:
        """All fields, ready for JSON."""
        out = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return out | {"budget": dataclasses.asdict(self.budget), "settings": {k: v.as_dict() for k, v in self.settings.items()}}


def lengths_counted(settings: Settings, measure: str) -> tuple[int, int]:
    """The shortest and longest path that a method counts; own emission is no part of irradiance."""
    return (max(settings.min_length, int(measure == "irradiance")), min(settings.max_length, EVERY_LENGTH[1]))


def known_above_zero(reference: Reference) -> Reference:
    """`reference`, or SettingsError where no relative error can be computed from it."""
    if not reference.valid.any():
        raise SettingsError("reference", f"{reference.label} is known at no receiver", "Choose another reference, or none")
    if not reference.mean > 0:
        reason = f"the mean of {reference.label} is {reference.mean:g}, but a relative error needs a mean above 0"
        raise SettingsError("reference", reason, "Choose another reference, or none to see fluxes and agreement only")
    return reference


def winner(entries: Sequence[Entry], budget: Budget) -> Entry | None:
    """Least error at equal time or rays; least time among those that reached an equal error. None where none did, or nothing is known."""
    if budget.kind == "error":
        reached = [e for e in entries if e.state == "reached"]
        return min(reached, key=lambda e: e.seconds, default=None)
    return min((e for e in entries if e.error is not None), key=lambda e: e.error, default=None)
