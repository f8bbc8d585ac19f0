"""What methods on elements share: one solve with its clock, notices, history and steps, and its `Solution` from light on element sides.

The counterpart of `walks.gathering.Run`. A method sets `find` whenever it knows more; a step keeps the one of its moment, and calls it
only when its result is asked for, as that may cost much.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..base.errors import Notice
from ..base.settings import NO_LIMIT, Settings
from ..elements.answer import ElementAnswer, Parts, elements_for
from ..lights.emitters import Emitters
from ..method import noise
from ..method.clock import Clock
from ..method.registry import Solver
from ..method.solution import EnergyBalance, Solution, Step
from ..receivers.base import Receivers
from ..scene.world import World
from ..walks import path_limit
from ..walks.gathering import lights_of
from .lamp_light import LampLight, light_notices, receiver_light
from .settings import RadiositySettings


@dataclass(frozen=True, eq=False)
class Found:
    """What a method on elements knows at one moment: answers at the receivers, rays cast, energy balance, more arrays."""

    parts: Parts
    rays: int
    balance: EnergyBalance | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)


class ElementRun:
    """One solve of a method on elements.

    find       what is known now, for a partial result or not; set by the method
    """

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: Settings, lobes: frozenset[str] | None = None) -> None:
        """`lobes` that are solved as they are, where they depend on the settings; None: those of the method."""
        self.spec, self.world, self.receivers, self.settings = solver.spec, world, receivers, settings
        self.clock = Clock()
        self.elements = elements_for(world, receivers, settings.max_edge, solver.element_target(settings))
        self.emitters = Emitters(world)
        self.warnings = world.scene.warnings + world.shading.substitutions(solver.spec.lobes if lobes is None else lobes)
        self.find: Callable[[bool], Found]

    @property
    def emitted(self) -> np.ndarray:
        """(2 ne, 3) float64 W m-2: radiosity that the element sides emit themselves, E(i) of Eq. 11."""
        return self.elements.held.emitted

    # ---- steps

    def step(self, fraction: float, text: str) -> Iterator[Step]:
        """One step; the clock stands still until the next one is asked for."""
        yield from self.clock.pause(self._step(fraction, text, True))

    def pause(self, fraction: float, text: str) -> Iterator[Step]:
        """A step where it is time for one: for work in small pieces."""
        if self.clock.due():
            yield from self.step(fraction, text)

    def stage(self, shares: Iterable[float], start: float, end: float, text: str, step: Callable | None = None) -> Iterator[Step]:
        """Work through one stage of a method: a step for each of the `shares` done, from `start` to `end` of the whole.

        "{}" in `text` stands for the share. `step` is `self.pause` for work in small pieces.
        """
        for share in shares:
            yield from (step or self.step)(start + (end - start) * share, text.format(f"{share:.0%}"))

    def finish(self, text: str) -> Iterator[Step]:
        """The last step, with the finished result."""
        yield from self.clock.last(self._step(1.0, text, False))

    def relaxed(self, residual: float, start: float) -> float:
        """Share of the whole that is done when relaxation, which begins at `start`, has come to `residual`: on a logarithmic scale."""
        tolerance = self.settings.tolerance
        done = np.log(max(residual, 1e-300)) / np.log(max(tolerance, 1e-16)) if tolerance < 1 else 1.0
        return start + (1 - start) * float(np.clip(done, 0, 0.99))

    # ---- notices

    def warn(self, reason: str, remedy: str) -> None:
        """Add a notice about the method."""
        self.warnings += (Notice(self.spec.label, reason, remedy),)

    def check_converged(self, residual: float, remedy: str = "Raise max_iterations or the tolerance") -> None:
        """Say so where the iterations were used up before the tolerance was reached."""
        if residual > self.settings.tolerance:
            self.warn(f"stopped after {self.settings.max_iterations} iterations at a relative change of {residual:.1e}", remedy)

    def check_lit(self, arriving: np.ndarray) -> None:
        """Say so where nothing emits and nothing arrives from outside the elements, `arriving` (2 ne, ..)."""
        self.warnings += light_notices(self.elements, self.emitters, arriving)

    # ---- results

    def _step(self, fraction: float, text: str, partial: bool) -> Step:
        find, warnings = self.find, self.warnings

        def solution() -> Solution:
            found, flux = find(partial), self.emitters.flux
            noisy = () if partial else self._noise(found.parts)
            longest = getattr(self.settings, "max_length", NO_LIMIT)
            left_out = None if partial else path_limit.left_unshot(found.balance, longest)
            return Solution(
                self.spec.id,
                self.receivers.measure,
                **{**found.parts.arrays(), "extra": {**found.parts.extra, **found.extra}},
                rays=found.rays,
                balance=found.balance and found.balance.with_passing(flux.passing),
                emitted_flux=flux.emitted,
                entering_flux=flux.entering,
                left_out=left_out,
                warnings=warnings + path_limit.notices(left_out, longest) + noisy,
                settings=self.settings.as_dict(),
                partial=partial,
            )

        return Step(fraction, text, solution)

    def _noise(self, parts: Parts) -> tuple[Notice, ...]:
        """Says how noisy direct light is that was evaluated at the receivers, as elements have no noise of texels; or that all is dark."""
        about = self.settings, self.spec.label, self.receivers.measure
        told = noise.notices(parts.noise, *about, lights_of(self.emitters), part="direct light", lowered_by="light_samples")
        flux = self.emitters.flux
        # Where nothing reaches any surface, `check_lit` has said so.
        return told + noise.darkness((parts.direct, parts.indirect), flux.emitted if flux.entering > 0 else 0.0, *about)


class RadiosityRun(ElementRun):
    """One solve on diffuse elements: with irradiance of element sides, and direct light where the settings want it.

    answer   from the elements to the receivers; lamps: light of lamps and background on the elements
    seed     begins the random numbers of both; empty for deterministic methods, which have always the same
    """

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: RadiositySettings, seed: Sequence[int] = ()) -> None:
        super().__init__(solver, world, receivers, settings)
        self.seed = seed
        self.lamps = LampLight(self.elements, self.emitters, settings.light_samples, seed=seed)
        self.answer = self.answer_at(receivers)
        self.find = self._lamps_alone

    def answer_at(self, receivers: Receivers) -> ElementAnswer:
        """Answers of the elements at other receivers."""
        s = self.settings
        gather = receiver_light(self.world, self.emitters, s)
        return ElementAnswer(self.elements, receivers, gather, s.min_length, s.max_length, self.seed)

    def _lamps_alone(self, partial: bool) -> Found:
        """Before anything is solved: what lamps and background give, which is of length 1."""
        none = np.zeros_like(self.lamps.irradiance)
        counts = self.settings.min_length <= 1 <= self.settings.max_length
        parts = self.answer.parts(self.lamps.irradiance if counts else none, none)
        return Found(parts, self.lamps.rays + parts.rays)
