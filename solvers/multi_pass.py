"""Progressive multi-pass method (Chen, Rushmeier, Miller and Turner 1991; review, sections 5.2.1 (i) and 7).

Both strategies, both natures. First progressive radiosity shoots the light of all sources among the elements, via mirrors as well
(extended form factors), which shows a complete picture almost at once. Then Monte Carlo passes refine it, sample by sample:

    high frequencies    direct light, and all that mirrors and glossy surfaces show, by path tracing from the receivers
    caustics            light of lamps by particles on the elements; that of the background and of emitting faces by those paths
    low frequencies     diffuse surfaces are sampled, and the known radiosity is read only at the next diffuse surface, or later

Receivers pass from the first answer to the second as their samples come in; the finished result holds the second alone.

S. E. Chen, H. E. Rushmeier, G. Miller and D. Turner, "A Progressive Multi-Pass Method for Global Illumination", Computer Graphics
(SIGGRAPH '91 Proceedings), 25(4), 1991, 165-174.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.parallel import thread_count
from ..adjoint_gi.core.base.settings import NO_LIMIT, setting
from ..adjoint_gi.core.bsdf.lobes import FIRST_PASS_LOBES
from ..adjoint_gi.core.elements.answer import ElementAnswer, Parts, element_count, elements_for
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import BOTH_NATURES, SHOOTING_THEN_GATHERING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.radiosity.lamp_light import light_notices, receiver_light
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.radiosity.southwell import MOST_RAYS_PER_GROUP, DiffuseShooting, Grouping, Southwell, balance
from ..adjoint_gi.core.radiosity.trapped import Trap
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World
from ..adjoint_gi.core.two_pass.extended_factors import ExtendedShots
from ..adjoint_gi.core.two_pass.known_light import KnownLight
from ..adjoint_gi.core.two_pass.outside_light import OutsideLight
from ..adjoint_gi.core.two_pass.view_pass import View, estimator
from ..adjoint_gi.core.walks import unmet_lamps
from ..adjoint_gi.core.walks.gathering import SAMPLES_PER_BATCH, Run
from ..adjoint_gi.core.walks.mirror_chains import Chains
from ..adjoint_gi.core.walks.paths import Walk

FIRST_PASS_SHARE = 0.3  # share of the progress that radiosity takes
MIN_RAYS_PER_GROUP = 1 << 14  # rays of the sides that shoot together, at least; each may become a chain of many
PRIOR_SAMPLES = 4.0  # samples that the first answer is worth at the start of the second pass


@dataclass(frozen=True)
class MultiPassSettings(RadiositySettings):
    """Settings of the multi-pass method; the seed matters only to the second pass."""

    direct_light: str = common.direct_light(
        "At every texel, vertex or pixel: sharp shadows from the start, which is then a little later",
        "On the elements: the first picture comes soonest",
        "Partial Direct Light",
        "Where partial results have their direct light from until samples come in; the finished result has it from the receivers",
    )
    rays: int = common.shooting_rays(
        1_000_000, "Rays that carry all emitted flux in the first pass; a shot takes its share of them, and never fewer than 8"
    )
    tolerance: float = common.unshot(1e-3, "the first pass")
    max_shots: int = common.max_shots(1_000_000, "The first pass")
    depth: int = common.mirror_depth("Most mirrors in a row on the way of first-pass light")
    particles: int = common.caustic_particles(200_000)
    samples: int = common.samples(64, "Second-pass samples of each texel, vertex or pixel")
    hops: int = setting(
        1,
        "Traced Bounces",
        "Diffuse or rough surfaces in a row that are sampled before the known radiosity is read; more is slower and nearer to exact",
        min=1,
        max=64,
        soft_max=4,
    )


@register
class MultiPass(Solver):
    """Progressive radiosity, refined by path tracing."""

    spec = MethodSpec(
        id="multi_pass",
        number=12,
        label="Progressive Multi-Pass",
        strategies=SHOOTING_THEN_GATHERING,
        natures=BOTH_NATURES,
        year=1991,
        authors="S. E. Chen, H. E. Rushmeier, G. Miller, D. Turner",
        title="A Progressive Multi-Pass Method for Global Illumination",
        equation="B = E + rho F B shot first, then L = Le + T L  (13, then 1)",
        section="5.2.1 (i) and 7",
        idea="Progressive radiosity gives a picture at once; path tracing then replaces what it cannot resolve, and reads it further off.",
        lobes=FIRST_PASS_LOBES,
        limits=lines("""
            Radiosity read at later surfaces is as exact as the elements are small: a small bias, less with more traced bounces
            Caustics of lamps are as sharp as the elements are small
            With bounded path lengths the second pass traces whole paths and reads no radiosity
            Partial results of the first pass show mirrors as diffuse
        """),
        elements=4000,
    )
    Settings = MultiPassSettings

    def memory(self, world: World, receivers: Receivers, settings: MultiPassSettings) -> int:
        """Elements, rays under way, receivers in both passes and their points."""
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        sides = 2 * 3 * 8 * (30 + settings.depth)
        return count * (700 + sides) + 900 * MOST_RAYS_PER_GROUP + 1200 * receivers.count + 600 * SAMPLES_PER_BATCH * thread_count()

    def solve(self, world: World, receivers: Receivers, settings: MultiPassSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots, then about ten times a second."""
        emitters = Emitters(world)
        rare = unmet_lamps.notices(emitters, settings.samples, measure=receivers.measure, by_particles=True, longest=settings.max_length)
        run = Run(self.spec, world, receivers, settings, emitters, rare)
        passes = MultiPassRun(run, elements_for(world, receivers, settings.max_edge, self.spec.elements), emitters)

        # 1. B = E + rho F B (Eq. 11), shot (Eq. 13): progressive radiosity.
        for share, text in passes.radiosity():
            yield from run.clock.pause(Step(FIRST_PASS_SHARE * share, text, lambda: passes.joined(run.solution())))

        # 2. L = Le + T L (Eq. 1): path tracing that reads the radiosity further off.
        walk = Walk(world, emitters, passes.chains.table, settings.min_length, settings.max_length)
        unmet = passes.outside.caustics.unmet_light(settings.min_length, settings.max_length)
        view = View(walk, passes.known(), settings.hops if passes.reads else settings.max_length + 1, False, unmet)
        for step in run.random_samples(settings.samples, rng, estimator(view)):
            fraction = FIRST_PASS_SHARE + (1 - FIRST_PASS_SHARE) * step.fraction
            yield dataclasses.replace(step, fraction=fraction, solution=lambda step=step: passes.joined(step.solution()))


class MultiPassRun:
    """The first pass, and its answer joined with that of the second."""

    def __init__(self, run: Run, elements: Elements, emitters: Emitters) -> None:
        self.run, self.elements, self.settings = run, elements, run.settings
        s = run.settings
        # Whole paths are traced where their length is bounded, as radiosity has all lengths together.
        self.reads = s.max_length >= NO_LIMIT and s.min_length <= 2
        self.chains = Chains(run.world, s.depth)
        self.outside = OutsideLight(elements, emitters, self.chains, s.light_samples, s.particles)
        self.transport = ExtendedShots(ElementRays(elements), self.chains)
        gather = receiver_light(run.world, emitters, s)
        self.answer = ElementAnswer(elements, run.receivers, gather, s.min_length, s.max_length)
        self.emitted = np.repeat(elements.emitted, 2, axis=0)
        # For partial results while light of lamps and background is found; `radiosity` begins with that light in a state of its own.
        self.state = DiffuseShooting(self.transport, self.emitted, np.zeros_like(self.emitted))
        self.parts: Parts | None = None

    @property
    def rays(self) -> int:
        """Cast by the first pass so far."""
        return self.outside.rays + self.transport.count + self.answer.rays

    def radiosity(self) -> Iterator[tuple[float, str]]:
        """Yield the share of the first pass done and what is being done."""
        s, run = self.settings, self.run
        yield from self.outside.run(0.2)
        run.warnings += light_notices(self.elements, self.outside.lamps.emitters, self.outside.straight)
        for share in self.answer.prepare():
            yield 0.2 + 0.1 * share, f"Receivers, {share:.0%}"
        # Light of lamps via mirrors is indirect; it comes in after the state has begun, as its second class.
        self.state = state = DiffuseShooting(self.transport, self.emitted, self.outside.straight)
        state.has_passed(self.outside.passed)
        caustics = self.outside.caustics
        state.arrive_later(caustics.total, caustics.other, caustics.escaped)
        shooting = Southwell(state, Grouping.for_sides(len(state.direct), s.rays, MIN_RAYS_PER_GROUP), s.tolerance, s.max_shots)
        trap = Trap(state)
        for share in shooting.run():
            trap.check(self.elements)
            run.clock.note(share)
            yield 0.3 + 0.7 * float(np.clip(1 - share, 0, 0.999)), shooting.text
        if shooting.unfinished:
            remedy = "Raise max_shots or the tolerance, or lower albedos that are close to 1"
            run.warnings += (Notice(run.spec.label, f"radiosity {shooting.shortfall}", remedy),)
        # The second pass has an error of its own.
        run.clock.history.clear()
        run.balance = balance(state)
        run.rays += self.rays
        self.parts = self.answer.parts(state.direct, state.indirect)

    def known(self) -> KnownLight:
        """Irradiance of the elements for the second pass."""
        light = self.state.direct, self.state.indirect
        known = KnownLight(self.elements, lambda _: light, 0)
        known.prepare()
        return known

    def joined(self, second: Solution) -> Solution:
        """The result as it stands: the first answer, weighed against the `second` one by the samples that have come in."""
        if not second.partial:
            return second
        parts = self.parts or self._now()
        count = self.run.film.count.astype(np.float32)
        prior = PRIOR_SAMPLES * (1 - count / self.settings.samples)
        share = (prior / np.maximum(prior + count, 1e-6))[:, None]

        def mix(name: str) -> np.ndarray:
            a, b = getattr(parts, name), getattr(second, name)
            return (share * a + (1 - share) * b).astype(np.float32)

        arrays = {name: mix(name) for name in ("emitted", "direct", "indirect", "albedo")}
        weight = np.maximum(parts.weight, second.weight)
        rays, extra = second.rays if self.parts else self.rays, parts.extra | second.extra
        return dataclasses.replace(second, **arrays, weight=weight, rays=rays, balance=self._balance(), extra=extra)

    def _balance(self) -> EnergyBalance:
        return balance(self.state).with_passing(self.run.emitters.flux.passing)

    def _now(self) -> Parts:
        """The first answer with an estimate for the light that has not been shot yet."""
        state = self.state
        direct = state.direct if state.total else self.outside.straight
        return self.answer.parts(direct, state.indirect + state.reached[:, None] * state.ambient())
