"""Stochastic Jacobi radiosity (Neumann, Feda, Kopp and Purgathofer 1994): all sides shoot at once, along rays drawn anew by their power.

Not in the review; a nondeterministic relative of progressive radiosity, its section 7.

Shooting, nondeterministic. Of the power P = sum_i A(i) dB(i) that is unshot, N P / P0 rays are drawn, with P0 what was emitted and N rays
for it: so every ray of every iteration carries P0 / N. A side draws its share of them, and a ray that meets side j leaves there

    B(j) += rho(j) dB',  dB(j) = rho(j) dB',  dB' = P0 / (N A(j))  in the colours of the unshot light of its source (13, in the mean)

which in the mean over the rays is one Jacobi step of the shooting iteration dB <- T dB, for all sides together: no form factor is ever
found, and a step costs time in proportion to sides and rays, not to pairs of sides. Reflection is by albedo, survival by power: what is
too little for a ray is drawn with the chance of its share, so that the mean is right and the iteration ends by itself.

All rays are divided over independent runs; their mean is the answer, and their spread its standard error.

L. Neumann, M. Feda, M. Kopp and W. Purgathofer, "A New Stochastic Radiosity Method for Highly Complex Scenes", Fifth Eurographics Workshop
on Rendering, 1994. As the incremental shooting iteration: P. Bekaert, "Hierarchical and Stochastic Algorithms for Radiosity", Ph.D. thesis,
Katholieke Universiteit Leuven, 1999.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.bsdf.lobes import DIFFUSE_LOBES
from ..adjoint_gi.core.elements.answer import element_count
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method import noise
from ..adjoint_gi.core.method.registry import NONDETERMINISTIC, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Step
from ..adjoint_gi.core.radiosity.element_run import Found, RadiosityRun
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.radiosity.southwell import MOST_RAYS_PER_GROUP, DiffuseShooting, balance, length_classes
from ..adjoint_gi.core.radiosity.transports import FreshRayTransport
from ..adjoint_gi.core.radiosity.trapped import Trap
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

RUNS = 8  # independent runs, at least


@dataclass(frozen=True)
class StochasticJacobiSettings(RadiositySettings):
    """Settings of stochastic Jacobi radiosity."""

    rays: int = common.shooting_rays(
        1_000_000, "Rays that carry all emitted flux, over all runs; each reflection takes rays by the flux that is left", effort=True
    )


@register
class StochasticJacobi(Solver):
    """Shoots from all sides at once, along random rays, until no ray is drawn any more; the mean of independent runs."""

    spec = MethodSpec(
        id="stochastic_jacobi",
        number=14,
        label="Stochastic Jacobi Radiosity",
        strategies=SHOOTING,
        natures=NONDETERMINISTIC,
        year=1994,
        authors="L. Neumann, M. Feda, M. Kopp, W. Purgathofer",
        title="A New Stochastic Radiosity Method for Highly Complex Scenes",
        equation="B(j) += rho(j) P0 / (N A(j)) for each ray that meets j, N P / P0 rays drawn by dB(i) A(i) / P  (13, in the mean)",
        section="7 (related, not in the review)",
        idea="All elements shoot at once, along random rays in proportion to their unshot power, so that no form factor is ever needed.",
        lobes=DIFFUSE_LOBES,
        limits=lines("""
            Diffuse surfaces only: other lobes are taken as diffuse
            Indirect shadows are as sharp as the elements are small
            Noise of each element falls with the root of the rays that it meets, so small and dark elements are uneven
        """),
        elements=8000,
    )
    Settings = StochasticJacobiSettings

    def memory(self, world: World, receivers: Receivers, settings: StochasticJacobiSettings) -> int:
        """Elements, unshot light by path length, rays under way and receivers; it grows linearly with the elements."""
        count = element_count(world, receivers, settings.max_edge, self.element_target(settings))
        classes = length_classes(settings.min_length, settings.max_length)
        return count * (700 + 2 * 3 * 8 * (6 * classes + 12)) + 600 * MOST_RAYS_PER_GROUP + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: StochasticJacobiSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every iteration of every run; the fraction is the flux delivered, over the runs."""
        run = JacobiRun(self, world, receivers, settings, rng)

        # 1. Where the receivers lie on the elements, and direct light at them.
        yield from run.stage(run.answer.prepare(), 0.0, 0.0, "Receivers and direct light, {}")

        # 2. Light of lamps and background on the elements.
        yield from run.stage(run.lamps.run(), 0.0, 0.0, "Light of lamps and background, {}")
        run.check_lit(run.lamps.irradiance)

        # 3. Runs of as many iterations as it takes for all light to be absorbed, to escape or to be too long (Eq. 13, in the mean).
        done = 0.0
        for number in range(1, run.count + 1):
            state = run.begin()
            trap, quantum = Trap(state), state.total * run.count / settings.rays
            while shoot(state, quantum, rng):
                trap.check(run.elements)
                left = float(state.unshot_flux().sum()) / state.total
                done = max(done, min((number - left) / run.count, 0.999))
                yield from run.step(done, f"Run {number} of {run.count}, {left:.2%} of the light unshot")
            run.mean.add(state)
            run.clock.note(run.mean.relative_error())

        run.warnings += noise.notices(run.mean.relative_error(), settings, self.spec.label, receivers.measure, 0)

        # 4. Their mean.
        yield from run.finish(f"{run.count} runs")


class JacobiRun(RadiosityRun):
    """One solve: `count` independent runs, their `mean` so far, and the `state` of the present one."""

    def __init__(
        self, solver: Solver, world: World, receivers: Receivers, settings: StochasticJacobiSettings, rng: np.random.Generator
    ) -> None:
        super().__init__(solver, world, receivers, settings, rng.integers(0, 1 << 63, 4).tolist())
        self.count = max(RUNS, -(-settings.rays // MOST_RAYS_PER_GROUP))
        self.transport = FreshRayTransport(ElementRays(self.elements), rng)
        self.mean = Mean(self.transport.area)

    def begin(self) -> DiffuseShooting:
        """Nothing shot yet: own emission, and what lamps and background have brought."""
        s = self.settings
        self.state = DiffuseShooting(self.transport, self.emitted, self.lamps.irradiance, s.min_length, s.max_length)
        self.find = self._find
        return self.state

    def _find(self, partial: bool) -> Found:
        """The mean of the runs that are done, or the first run as it is."""
        mean = self.mean
        if mean.runs:
            direct, indirect, flux = mean.direct / mean.runs, mean.indirect / mean.runs, mean.balance()
        else:
            direct, indirect, flux = self.state.direct, self.state.indirect, balance(self.state)
        parts = self.answer.parts(direct, indirect)
        return Found(parts, self.transport.count + self.lamps.rays + parts.rays, flux)


def shoot(state: DiffuseShooting, quantum: float, rng: np.random.Generator) -> int:
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

    def add(self, state: DiffuseShooting) -> None:
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
