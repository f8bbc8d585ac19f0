"""Stochastic Jacobi radiosity (Neumann, Feda, Kopp and Purgathofer 1994): all sides shoot at once, along rays drawn anew by their power.

Shooting, nondeterministic. Of the power P = sum_i A(i) dB(i) that is unshot, N P / P0 rays are drawn, with P0 what was emitted and N rays
for it: so every ray of every iteration carries P0 / N. A side draws its share of them, and a ray that meets side j leaves there

    B(j) += rho(j) dB',  dB(j) = rho(j) dB',  dB' = P0 / (N A(j))  in the colours of the unshot light of its source         (13)

which in the mean over the rays is one Jacobi step of the shooting iteration dB <- T dB, for all sides together: no form factor is ever
found, and a step costs time in proportion to sides and rays, not to pairs of sides. Reflection is by albedo, survival by power: what is
too little for a ray is drawn with the chance of its share, so that the mean is right and the iteration ends by itself.

All rays are divided over independent runs; their mean is the answer, and their spread its standard error.

L. Neumann, M. Feda, M. Kopp and W. Purgathofer, "A New Stochastic Radiosity Method for Highly Complex Scenes", Fifth Eurographics Workshop
on Rendering, 1994. As the incremental shooting iteration: P. Bekaert, "Hierarchical and Stochastic Algorithms for Radiosity", Ph.D. thesis,
Katholieke Universiteit Leuven, 1999.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.elements.answer import ElementAnswer, element_count, elements_for
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.radiosity.schemes import LARGEST_BATCH, NO_LIMIT, Southwell, balance
from ..adjoint_gi.core.radiosity.shared import LampLight, RadiositySettings, dark_notices, receiver_light
from ..adjoint_gi.core.radiosity.transports import FreshRayTransport
from ..adjoint_gi.core.radiosity.trapped import Trap
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

TARGET = 8000  # elements where max_edge is chosen
RUNS = 8  # independent runs, at least


@dataclass(frozen=True)
class StochasticJacobiSettings(RadiositySettings):
    """Settings of stochastic Jacobi radiosity."""

    rays: int = setting(
        1_000_000,
        label="Rays",
        help="Rays that carry all emitted flux, over all runs; each reflection takes rays by the flux that is left",
        min=1,
        max=2_000_000_000,
        soft_max=100_000_000,
    )


@register
class StochasticJacobi(Solver):
    """Shoots from all sides at once, along random rays, until no ray is drawn any more; the mean of independent runs."""

    spec = MethodSpec(
        id="stochastic_jacobi",
        number=14,
        label="Stochastic Jacobi Radiosity",
        strategies=(Strategy.SHOOTING,),
        natures=(Nature.NONDETERMINISTIC,),
        year=1994,
        authors="L. Neumann, M. Feda, M. Kopp, W. Purgathofer",
        title="A New Stochastic Radiosity Method for Highly Complex Scenes",
        equation="B(j) += rho(j) P / (N A(j)) for each of N rays, drawn from side i by dB(i) A(i) / P  (13)",
        section="7",
        idea="All elements shoot at once, along random rays in proportion to their unshot power, so that no form factor is ever needed.",
        limits=(
            "Diffuse surfaces only: other lobes are taken as diffuse",
            "Indirect shadows are as sharp as the elements are small",
            "Noise of each element falls with the root of the rays that it meets, so small and dark elements are uneven",
        ),
        lobes=frozenset({"diffuse", "emission"}),
        uses_elements=True,
    )
    Settings = StochasticJacobiSettings

    def element_target(self, settings: StochasticJacobiSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return TARGET

    def memory(self, world: World, receivers: Receivers, settings: StochasticJacobiSettings) -> int:
        """Elements, unshot light by path length, rays under way and receivers; it grows linearly with the elements."""
        count = element_count(world, receivers, settings.max_edge, TARGET)
        classes = max(1, settings.max_length) if settings.max_length < NO_LIMIT else max(2, settings.min_length)
        return count * (700 + 2 * 3 * 8 * (6 * classes + 12)) + 600 * LARGEST_BATCH + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: StochasticJacobiSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every iteration of every run."""
        yield from _Solve(self, world, receivers, settings, rng).steps()


class _Solve:
    """The state of one solve."""

    def __init__(
        self, solver: Solver, world: World, receivers: Receivers, settings: StochasticJacobiSettings, rng: np.random.Generator
    ) -> None:
        self.solver, self.receivers, self.settings, self.rng = solver, receivers, settings, rng
        self.started = time.monotonic()
        self.elements = elements_for(world, receivers, settings.max_edge, TARGET)
        emitters = Emitters(world)
        gather = receiver_light(world, emitters, settings)
        self.answer = ElementAnswer(self.elements, receivers, gather, settings.min_length, settings.max_length)
        self.lamps = LampLight(self.elements, emitters, settings.light_samples)
        self.transport = FreshRayTransport(ElementRays(self.elements), rng)
        self.mean = Mean(self.transport.area)
        self.runs = max(RUNS, -(-settings.rays // LARGEST_BATCH))
        self.warnings = world.scene.warnings + world.shading.substitutions(solver.spec.lobes)
        self.history: list[tuple[float, float]] = []
        self.state = self._start()

    def _start(self) -> Southwell:
        """Nothing shot yet: own emission, and what lamps and background have brought."""
        s = self.settings
        return Southwell(self.transport, np.repeat(self.elements.emitted, 2, axis=0), self.lamps.irradiance, s.min_length, s.max_length)

    def steps(self) -> Iterator[Step]:
        # 1. Where the receivers lie on the elements, and direct light at them.
        for share in self.answer.prepare():
            yield self._step(0.0, f"Receivers and direct light, {share:.0%}")
        # 2. Lamps and background.
        for share in self.lamps.run():
            yield self._step(0.0, f"Light of lamps and background, {share:.0%}")
        self.warnings += dark_notices(self.elements, self.lamps.irradiance)
        # 3. Independent runs, each of as many iterations as it takes for all light to be absorbed, to escape or to be too long.
        done = 0.0
        for run in range(self.runs):
            self.state = self._start()
            trap = Trap(self.state)
            quantum = self.state.total * self.runs / self.settings.rays
            while shoot(self.state, quantum, self.rng):
                trap.check(self.elements)
                left = float(self.state.unshot_flux().sum()) / self.state.total
                done = max(done, min((run + 1 - left) / self.runs, 0.999))
                yield self._step(done, f"Run {run + 1} of {self.runs}, {left:.2%} of the light unshot")
            self.mean.add(self.state)
            self.history.append((time.monotonic() - self.started, self.mean.relative_error()))
        yield self._step(1.0, f"{self.runs} runs", partial=False)

    def _step(self, fraction: float, text: str, partial: bool = True) -> Step:
        return Step(fraction, text, lambda: self._solution(partial))

    def _solution(self, partial: bool) -> Solution:
        mean = self.mean
        if mean.runs:
            direct, indirect, flux = mean.direct / mean.runs, mean.indirect / mean.runs, mean.balance()
        else:
            direct, indirect, flux = self.state.direct, self.state.indirect, balance(self.state)
        parts = self.answer.parts(direct, indirect)
        return Solution(
            self.solver.spec.id,
            self.receivers.measure,
            **parts.arrays(),
            rays=self.transport.count + self.lamps.rays + parts.rays,
            seconds=time.monotonic() - self.started,
            balance=flux,
            history=tuple(self.history),
            warnings=self.warnings,
            settings=self.settings.as_dict(),
            partial=partial,
        )


def shoot(state: Southwell, quantum: float, rng: np.random.Generator) -> int:
    """One iteration: every side draws rays of `quantum` W (sum of the channels) for its unshot flux; returns how many were drawn.

    One random number draws them all: as many for a side as multiples of the quantum fall into its part of the summed flux, so that their
    mean is exact. Sides that draw none lose their unshot light, and the others carry it.
    """
    flux = state.unshot_flux()
    if not flux.any():
        return 0
    upto = np.floor(np.cumsum(flux) / quantum + rng.random())
    rays = np.diff(upto, prepend=0.0).astype(np.int64)
    state.unshot *= (rays * quantum / np.where(flux > 0, flux, 1.0))[:, None]
    index = np.flatnonzero(rays)
    if len(index):
        state.shoot(index, rays[index])
    return len(index)


class Mean:
    """Sums over independent runs. area (n,) of the sides, m2."""

    def __init__(self, area: np.ndarray) -> None:
        n = len(area)
        self.area = area
        self.runs = 0
        self.direct, self.indirect = np.zeros((n, 3)), np.zeros((n, 3))
        self.total, self.squares = np.zeros(n), np.zeros(n)  # of the irradiance, channels summed
        self.flux = np.zeros(4)  # emitted, absorbed, escaped, unshot

    def add(self, state: Southwell) -> None:
        """One more run, at its end."""
        self.runs += 1
        self.direct += state.direct
        self.indirect += state.indirect
        irradiance = (state.direct + state.indirect).sum(axis=1)
        self.total += irradiance
        self.squares += irradiance**2
        flux = balance(state)
        self.flux += (flux.emitted, flux.absorbed, flux.escaped, flux.unshot)

    def balance(self) -> EnergyBalance:
        """Mean flux in W; its gap is noise of less than one ray an iteration."""
        return EnergyBalance(*(float(x) for x in self.flux / self.runs))

    def relative_error(self) -> float:
        """Relative standard error of the irradiance, root mean square by area, from the spread of the runs."""
        if self.runs < 2:
            return float("inf")
        spread = np.maximum(self.squares - self.total**2 / self.runs, 0) * (self.runs / (self.runs - 1))
        power = self.area @ self.total**2
        return float(np.sqrt((self.area @ spread) / power)) if power > 0 else 0.0
