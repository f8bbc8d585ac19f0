"""How many samples a method is given, so that it is its budget that ends a run.

A method marks the setting that a budget may scale by `effort=True` (`core.base.settings.setting`); only random samples go on improving
a result. Where a method has none, it ends by itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

from ..base.errors import Notice
from ..base.settings import Settings
from ..method.registry import Nature, Solver
from ..receivers.base import Receivers
from ..scene.world import World
from .budget import Budget, Meter

FINER = ("rays", "max_edge", "light_samples")  # settings named to the user that make a method that ends by itself more exact
SPARE = 0.9  # share of a budget below which such a method has not used it
MARGIN = 2.0  # so many times the samples that fit the budget by a trial run: it must be the budget that ends the run
PILOT = 2.0  # most seconds spent to find how many samples fit a budget


def effort_field(solver: Solver) -> dataclasses.Field | None:
    """The setting that a budget scales, None where a method ends by itself."""
    fields = (f for f in dataclasses.fields(solver.Settings) if f.metadata.get("effort"))
    return next(fields, None) if is_random(solver) else None


def is_random(solver: Solver) -> bool:
    """Whether another seed gives another result that is as good."""
    return Nature.NONDETERMINISTIC in solver.spec.natures


@dataclass(frozen=True)
class Effort:
    """Settings that let the budget end a run. A method that solves something before its samples come in takes about `seconds` for that, and
    `rays` with the first sample: before these its result is not what it promises. `endless`: whether samples are all that is added then."""

    settings: Settings
    endless: bool
    seconds: float = 0.0
    rays: int = 0


def with_effort(solver: Solver, world: World, receivers: Receivers, settings: Settings, budget: Budget) -> Iterator[Effort | None]:
    """Find settings with so many samples that the budget ends the run. Yields None after every step of a trial run, which is not counted,
    and the effort last."""
    field = effort_field(solver)
    if field is None:
        yield Effort(settings, False)
        return
    find = _samples_that_fit if solver.spec.natures == (Nature.NONDETERMINISTIC,) else _after_first_pass
    yield from find(field, solver, world, receivers, settings, budget)


def _after_first_pass(
    field: dataclasses.Field, solver: Solver, world: World, receivers: Receivers, settings: Settings, budget: Budget
) -> Iterator[Effort | None]:
    """The same for methods that solve something first: a trial run with one sample measures how long that takes. These draw every sample
    alike, so that any number will do, and the highest possible lets the budget end the run."""
    trial = Meter(solver, world, receivers, dataclasses.replace(settings, **{field.name: 1}), None)
    with closing(trial):
        while trial.seconds <= budget.seconds and trial.advance():
            yield None
        if not trial.ended:
            # Not one sample within the whole budget: its own settings are as good as any, and its result is partial.
            yield Effort(settings, False)
            return
        most = field.metadata["max"]
        yield Effort(dataclasses.replace(settings, **{field.name: most}), True, trial.seconds, int(trial.solution().rays))


def _samples_that_fit(
    field: dataclasses.Field, solver: Solver, world: World, receivers: Receivers, settings: Settings, budget: Budget
) -> Iterator[Effort | None]:
    """The same for methods that only add samples: a short trial run measures how fast they come. A number of samples that is much too high
    would cost evenness (strata) and memory (elements by the number of particles), so the next power of two is taken."""
    trial = Meter(solver, world, receivers, settings, None)
    longest = min(PILOT, 0.15 * budget.seconds)
    first = None
    with closing(trial):
        # What comes before the first sample, such as elements and receivers, has no part in the speed of samples.
        while trial.seconds < (longest if first is None else min(first[0] + longest, budget.seconds)) or first is None:
            if trial.seconds > budget.seconds or not trial.advance():
                break
            first = first or ((trial.seconds, trial.step.fraction) if trial.step.fraction > 0 else None)
            yield None
        fraction = 1.0 if trial.ended else (trial.step.fraction if trial.step else 0.0)
        rays = trial.solution().rays if trial.step is not None else 0
    if fraction <= 0:
        # Not one sample within the whole budget: its own settings are as good as any.
        yield Effort(settings, True)
        return
    start, begun = first or (0.0, 0.0)
    if fraction > begun and trial.seconds > start:
        rate = (fraction - begun) / (trial.seconds - start)
    else:
        rate = max(fraction, 1e-6) / max(trial.seconds, 1e-3)
    share = rate * budget.seconds
    if budget.kind == "rays" and rays and fraction:
        share = min(share, budget.value / (rays / fraction))
    wanted = 2 ** math.ceil(math.log2(max(1.0, MARGIN * share * getattr(settings, field.name))))
    top = field.metadata["max"]
    yield Effort(dataclasses.replace(settings, **{field.name: int(min(wanted, top) if top is not None else wanted)}), True)


def unused_budget(label: str, settings: Settings, seconds: float, budget: Budget) -> Notice | None:
    """A notice about a method that has ended by itself, None where it has used the time."""
    if budget.kind != "time" or seconds >= SPARE * budget.seconds:
        return None
    names = [f"{name} (now {getattr(settings, name):,})" for name in FINER if hasattr(settings, name)]
    reason = f"ended by itself after {seconds:.2g} of {budget.seconds:g} s: more time changes nothing at its settings"
    remedy = f"To let it use the time, choose finer settings: {', '.join(names)}" if names else "Read its error as one at less time"
    return Notice(label, reason, remedy, "info")
