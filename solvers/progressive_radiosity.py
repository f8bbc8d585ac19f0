"""Progressive radiosity (Cohen, Chen, Wallace and Greenberg 1988; review, section 7, Eq. 13 and 14).

Shooting, deterministic. The element with the most unshot flux sends it to all others; they keep what they reflect of it to send on:

    B(j) += rho(j) dB(i) F(ij) A(i) / A(j),  dB(j) likewise,  dB(i) = 0                                           (13, 14)

which by reciprocity is rho(j) dB(i) F(ji); the F of the printed Eq. 13 is right for fluxes, or for equal areas. Flux is what is counted
here, along rays from the shooting element, so none is lost: emitted = absorbed + escaped + unshot at every step.

M. F. Cohen, S. E. Chen, J. R. Wallace and D. P. Greenberg, "A Progressive Refinement Approach to Fast Radiosity Image Generation",
Computer Graphics (SIGGRAPH '88 Proceedings), 22(4), 1988, 75-84. Overshooting: M. Feda and W. Purgathofer, "Accelerating Radiosity by
Overshooting", Eurographics Workshop on Rendering, 1992, 21-32.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.answer import ElementAnswer, elements_for
from ..adjoint_gi.core.element_rays import ElementRays
from ..adjoint_gi.core.elements import Elements
from ..adjoint_gi.core.emitters import Emitters
from ..adjoint_gi.core.errors import Notice
from ..adjoint_gi.core.radiosity import LampLight, RadiositySettings, dark_notices, receiver_light
from ..adjoint_gi.core.receivers import Receivers
from ..adjoint_gi.core.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.schemes import NO_LIMIT, Southwell
from ..adjoint_gi.core.settings import setting
from ..adjoint_gi.core.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.transports import FreshRayTransport
from ..adjoint_gi.core.world import World

TARGET = 8000  # elements where max_edge is chosen
BATCH = 1 << 16  # rays of the sides that shoot together, at least; more where there are more sides, as each group costs a look at all
LARGEST_BATCH = 1 << 18
FEWEST, MOST = 8, 1 << 17  # rays of one shot
AT_ONCE = 1 << 14  # sides that shoot together at most


@dataclass(frozen=True)
class ProgressiveSettings(RadiositySettings):
    """Settings of progressive radiosity."""

    rays: int = setting(
        2_000_000,
        label="Rays",
        help="Rays that carry all emitted flux; a shot takes its share of them by its flux, and never fewer than 8",
        min=1,
        max=2_000_000_000,
        soft_max=100_000_000,
    )
    tolerance: float = setting(1e-3, label="Tolerance", help="Unshot share of the emitted flux at which the method ends", min=0.0, max=1.0)
    max_shots: int = setting(
        10_000_000, label="Max Shots", help="The method ends, and says so, after this many shots", min=1, max=2_000_000_000
    )
    ambient: bool = setting(
        True,
        label="Ambient Estimate",
        help="Partial results show the unshot light spread evenly, as an estimate; the finished result never has it",
    )
    overshoot: bool = setting(
        False,
        label="Overshooting",
        help="Shots carry what their element is expected to receive later, too; not with bounded path lengths",
    )


@register
class ProgressiveRadiosity(Solver):
    """Shoots from the sides with the most unshot flux, many sides together, until little is left."""

    spec = MethodSpec(
        id="progressive_radiosity",
        number=9,
        label="Progressive Radiosity",
        strategies=(Strategy.SHOOTING,),
        natures=(Nature.DETERMINISTIC,),
        year=1988,
        authors="M. F. Cohen, S. E. Chen, J. R. Wallace, D. P. Greenberg",
        title="A Progressive Refinement Approach to Fast Radiosity Image Generation",
        equation="B(j) += rho(j) dB(i) F(ij) A(i) / A(j)  (13, 14)",
        section="7",
        idea="The element with the most unshot light sends it to all it sees, again and again, so that the brightest light comes first.",
        limits=(
            "Diffuse surfaces only: other lobes are taken as diffuse",
            "Indirect shadows are as sharp as the elements are small",
            "Sides shoot in groups, brightest first, instead of one by one",
            "Form factors are shares of rays: elements that few rays meet are uneven",
        ),
        lobes=frozenset({"diffuse", "emission"}),
        uses_elements=True,
    )
    Settings = ProgressiveSettings

    def memory(self, world: World, receivers: Receivers, settings: ProgressiveSettings) -> int:
        """Elements, unshot light by path length, rays under way and receivers; it grows linearly with the elements."""
        own = getattr(receivers, "elements", None)
        count = own.count if own is not None else Elements.planned(world, settings.max_edge, TARGET)
        classes = max(1, settings.max_length) if settings.max_length < NO_LIMIT else max(2, settings.min_length)
        return count * (700 + 2 * 3 * 8 * (6 * classes + 8)) + 600 * LARGEST_BATCH + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: ProgressiveSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots; the fraction is the flux delivered."""
        started = time.monotonic()
        elements = elements_for(world, receivers, settings.max_edge, TARGET)
        emitters = Emitters(world)
        gather = receiver_light(world, emitters, settings)
        answer = ElementAnswer(elements, receivers, gather, settings.min_length, settings.max_length)
        lamps = LampLight(elements, emitters, settings.light_samples)
        transport = FreshRayTransport(ElementRays(elements))
        emitted = np.repeat(elements.emitted, 2, axis=0)
        warnings = world.scene.warnings + world.shading.substitutions(self.spec.lobes)
        history: list[tuple[float, float]] = []

        def shooter() -> Southwell:
            return Southwell(transport, emitted, lamps.irradiance, settings.min_length, settings.max_length, settings.overshoot)

        def step(state: Southwell, fraction: float, text: str, partial: bool = True) -> Step:
            return Step(fraction, text, lambda: solution(state, partial))

        def solution(state: Southwell, partial: bool) -> Solution:
            indirect = state.indirect
            if partial and settings.ambient and settings.max_length >= 2:
                indirect = indirect + state.reached[:, None] * state.ambient()
            parts = answer.parts(state.direct, indirect)
            return Solution(
                self.spec.id,
                receivers.measure,
                **parts.arrays(),
                rays=transport.count + lamps.rays + parts.rays,
                seconds=time.monotonic() - started,
                balance=balance(state),
                history=tuple(history),
                warnings=warnings,
                settings=settings.as_dict(),
                partial=partial,
            )

        # 1. Where the receivers lie on the elements, and direct light at them.
        state = shooter()
        for share in answer.prepare():
            yield step(state, 0.0, f"Receivers and direct light, {share:.0%}")
        # 2. Lamps and background are shot first.
        for share in lamps.run():
            yield step(state, 0.0, f"Light of lamps and background, {share:.0%}")
        state = shooter()
        warnings += dark_notices(elements, lamps.irradiance)
        if settings.overshoot and not state.overshoot:
            warnings += (Notice(self.spec.label, "overshooting is off, as path lengths are bounded", "Set the lengths to 0 and 1024"),)

        # 3. Groups of sides, most unshot flux first.
        flux = state.unshot_flux()
        left = float(flux.sum())
        while left > settings.tolerance * state.total and state.shots < settings.max_shots:
            index, rays = group(state, settings)
            if not len(index):
                break
            state.shoot(index, rays)
            left = float(state.unshot_flux().sum())
            share = left / state.total
            history.append((time.monotonic() - started, share))
            done = (1 - share) / (1 - settings.tolerance) if settings.tolerance < 1 else 1.0
            yield step(state, float(np.clip(done, 0, 0.999)), f"{state.shots:,} shots, {share:.2%} of the light unshot")
        if left > settings.tolerance * state.total:
            reason = f"stopped after {state.shots:,} shots with {left / state.total:.2%} of the light unshot"
            warnings += (Notice(self.spec.label, reason, "Raise max_shots or the tolerance, or lower albedos that are close to 1"),)
        yield step(state, 1.0, f"{state.shots:,} shots", partial=False)


def group(state: Southwell, settings: ProgressiveSettings) -> tuple[np.ndarray, np.ndarray]:
    """The sides that shoot next and the rays of each: in the order of their unshot flux, as many as fit into one batch of rays."""
    many = min(AT_ONCE, settings.max_shots - state.shots)
    index, flux = state.largest(many)
    rays = np.clip(np.ceil(settings.rays * flux / max(state.total, 1e-300)), FEWEST, MOST).astype(np.int64)
    batch = int(np.clip(len(state.direct) // 2, BATCH, LARGEST_BATCH))
    fits = max(1, int(np.searchsorted(np.cumsum(rays), batch, side="right")))
    return index[:fits], rays[:fits]


def balance(state: Southwell) -> EnergyBalance:
    """Flux summed over the channels; light cut off by the path length counts as unshot."""
    return EnergyBalance(state.total, float(state.absorbed.sum()), float(state.escaped.sum()), float(state.remaining().sum()))
