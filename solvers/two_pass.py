"""Two-pass method (Wallace, Cohen and Greenberg 1987; Sillion and Puech 1989; review, section 5.2.1 (i), after Eq. 11).

Gathering, deterministic in its first pass and not in its second. First, the radiosity of the diffuse parts of all surfaces,

    B(i) = E(i) + rho(i) sum_j Fext(ij) B(j)                                                  (11, with extended form factors)

where Fext(ij) counts what i sees of j straight and via any number of mirrors, panes of glass and glossy surfaces. It is found by
tracing: rays of an element that meet such a surface go on by its BSDF. Light of lamps that comes via mirrors (caustics) is traced
from the lamps onto the elements. Second, a view pass: mirrors and glossy surfaces that a receiver sees, directly or via others, are
sampled by their BSDF, and the diffuse surfaces that these rays meet have the radiosity that the first pass found.

J. R. Wallace, M. F. Cohen and D. P. Greenberg, "A Two-Pass Solution to the Rendering Equation: A Synthesis of Ray Tracing and Radiosity
Methods", SIGGRAPH 1987, 311-320. F. X. Sillion and C. Puech, "A General Two-Pass Method Integrating Specular and Diffuse Reflection",
SIGGRAPH 1989, 335-344.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.parallel import thread_count
from ..adjoint_gi.core.base.settings import NO_LIMIT, setting
from ..adjoint_gi.core.bsdf.lobes import FIRST_PASS_LOBES, SHINY
from ..adjoint_gi.core.elements.answer import element_count, elements_for
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import BOTH_NATURES, GATHERING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.radiosity.lamp_light import light_notices
from ..adjoint_gi.core.radiosity.relaxation import jacobi
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World
from ..adjoint_gi.core.two_pass.extended_factors import ExtendedTransport
from ..adjoint_gi.core.two_pass.known_light import KnownLight, lengths_of
from ..adjoint_gi.core.two_pass.outside_light import OutsideLight
from ..adjoint_gi.core.two_pass.view_pass import View, estimator
from ..adjoint_gi.core.walks import path_limit
from ..adjoint_gi.core.walks.gathering import SAMPLES_PER_BATCH, Run
from ..adjoint_gi.core.walks.mirror_chains import Chains
from ..adjoint_gi.core.walks.paths import Walk

FIRST_PASS_SHARE = 0.4  # share of the progress that the first pass takes


@dataclass(frozen=True)
class TwoPassSettings(RadiositySettings):
    """Settings of the two-pass method; the seed matters only to the view pass."""

    rays: int = common.element_rays(256, "Rays that find the extended form factors of each element")
    depth: int = common.mirror_depth("Most mirrors, panes and glossy surfaces in a row on the way of first-pass light")
    rough: bool = setting(
        True,
        "Rough Lobes in First Pass",
        "First-pass light is followed via rough glossy lobes as well; off, only via perfect mirrors and clear glass",
    )
    particles: int = common.caustic_particles(200_000)
    tolerance: float = common.tolerance(1e-5, "Relative change of the irradiance at which the first pass is solved")
    max_iterations: int = common.max_iterations(500, "The first pass stops with a warning after this many")
    samples: int = common.samples(32, "View-pass samples of each texel, vertex or pixel", soft_max=1024)
    gather: bool = setting(
        False,
        "Gather Diffuse Light",
        "Diffuse surfaces that receivers see are sampled, too, instead of read from the elements: finer, but with noise",
    )


@register
class TwoPass(Solver):
    """Extended radiosity, then a view pass."""

    spec = MethodSpec(
        id="two_pass",
        number=5,
        label="Two-Pass",
        strategies=GATHERING,
        natures=BOTH_NATURES,
        year=1987,
        authors="J. R. Wallace, M. F. Cohen, D. P. Greenberg; F. X. Sillion, C. Puech",
        title="A Two-Pass Solution to the Rendering Equation: A Synthesis of Ray Tracing and Radiosity Methods",
        equation="B(i) = E(i) + rho(i) sum_j Fext(ij) B(j)  (11, extended)",
        section="5.2.1 (i)",
        idea="Radiosity with form factors that count mirrors, then rays from the eye via mirrors to the known diffuse surfaces.",
        lobes=FIRST_PASS_LOBES,
        limits=lines("""
            Indirect shadows and caustics are as sharp as the elements are small; caustics of lamps have the noise of their particles
            Extended form factors are shares of rays: each element has an error of its own
            Below a coat the light of the first pass is taken as coming from all sides alike
            Memory grows with elements times rays per element
        """),
        elements=3000,
    )
    Settings = TwoPassSettings

    def memory(self, world: World, receivers: Receivers, settings: TwoPassSettings) -> int:
        """Chains of all element sides, irradiance by length where lengths are bounded, receivers and batches under way."""
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        mirrors = any(x.kind in SHINY for m in world.scene.materials for x in m.lobes)
        kept = 2 if mirrors else 1  # chains meet about one diffuse surface; mixed surfaces more
        fields = (settings.max_length if settings.max_length < NO_LIMIT else settings.min_length) + 4
        chains = 2 * count * settings.rays * 36 * kept
        sums = 2 * count * 3 * 8 * (2 * fields + settings.depth + 12) + 700 * count + receivers.count * 400
        return chains + sums + 600 * SAMPLES_PER_BATCH * thread_count()

    def solve(self, world: World, receivers: Receivers, settings: TwoPassSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through both passes; pictures begin with the second."""
        s, emitters = settings, Emitters(world)
        run = Run(self.spec, world, receivers, s, emitters)

        # 1. First pass: B(i) = E(i) + rho(i) sum_j Fext(ij) B(j) (Eq. 11, with extended form factors).
        elements = elements_for(world, receivers, s.max_edge, self.spec.elements)
        first = FirstPass(elements, emitters, s, receivers.measure == "irradiance")
        for share, text in first.run():
            yield from run.clock.pause(Step(FIRST_PASS_SHARE * share, text, run.solution))
        run.rays += first.rays
        run.warnings += first.warnings
        run.left_out = first.left_out()
        known = first.known()

        # 2. View pass: L = Le + T L (Eq. 1), via mirrors and glossy surfaces to diffuse ones, whose B is known.
        unmet = first.outside.caustics.unmet_light(s.min_length, s.max_length) if s.gather else None
        walk = Walk(world, emitters, first.chains.table, s.min_length, s.max_length)
        view = View(walk, known, int(s.gather), s.direct_light == "receivers", unmet)
        for step in run.random_samples(s.samples, rng, estimator(view)):
            yield dataclasses.replace(step, fraction=FIRST_PASS_SHARE + (1 - FIRST_PASS_SHARE) * step.fraction)


class FirstPass:
    """Extended radiosity of the elements.

    chains, outside, transport; by_length: irradiance (2 ne, 3) of each length that is needed alone; total of all, or None
    """

    def __init__(self, elements: Elements, emitters: Emitters, settings: TwoPassSettings, all_sides: bool) -> None:
        self.elements, self.settings, self.all_sides = elements, settings, all_sides
        self.chains = Chains(elements.world, settings.depth, settings.rough)
        self.outside = OutsideLight(elements, emitters, self.chains, settings.light_samples, settings.particles)
        self.transport = ExtendedTransport(ElementRays(elements), self.chains, settings.rays)
        self.warnings: tuple[Notice, ...] = ()
        self.total: np.ndarray | None = None

    @property
    def rays(self) -> int:
        """Cast so far."""
        return self.outside.rays + self.transport.count

    def run(self) -> Iterator[tuple[float, str]]:
        """Yield the share done and what is being done."""
        # 1. Light of lamps and background, straight and via mirrors.
        yield from self.outside.run(0.4)
        self.warnings += light_notices(self.elements, self.outside.lamps.emitters, self.outside.straight)
        # 2. Fext(ij) of the sides that reflect diffusely, or that are asked for.
        t = self.transport
        sides = np.arange(len(t.area)) if self.all_sides else np.flatnonzero(t.rho.max(axis=1) > 0)
        for share in t.build(sides):
            yield 0.4 + 0.5 * share, f"Extended form factors of {len(sides):,} element sides"
        # 3. The system (Eq. 11): lengths that are needed alone, one after another; then all together.
        arriving = yield from self._arrive()
        yield from self._solve_lengths(arriving)
        if self.settings.max_length >= NO_LIMIT:
            yield from self._solve(sum(arriving))

    def _arrive(self) -> Generator[tuple[float, str], None, list[np.ndarray]]:
        """Returns, by length, irradiance (2 ne, 3) of light that no diffuse surface has reflected yet."""
        t, by_length = self.transport, self.outside.caustics.by_length
        arriving = [np.zeros_like(t.rho), self.outside.straight + t.through(t.emitted, t.rows[1], emitted=True)]
        for length in range(2, len(t.rows)):
            light = t.through(t.emitted, t.rows[length], emitted=True)
            arriving.append(light + by_length[length] if length < len(by_length) else light)
            yield 0.9, "Light via mirrors"
        self.first = arriving[1]
        return arriving

    def _solve_lengths(self, arriving: list[np.ndarray]) -> Iterator[tuple[float, str]]:
        """The lengths that are needed alone, by the convolution of shorter ones with the chains."""
        s, t = self.settings, self.transport
        self.by_length = [np.zeros_like(self.first)]
        for length in range(1, (s.max_length if s.max_length < NO_LIMIT else s.min_length - 1) + 1):
            light = arriving[length].copy() if length < len(arriving) else np.zeros_like(self.first)
            for segments in range(1, min(length - 1, len(t.rows) - 1) + 1):
                rows = t.rows[segments]
                if rows.stop > rows.start:
                    light += t.through(t.rho * self.by_length[length - segments], rows)
            self.by_length.append(light)
            yield 0.9, f"Paths of length {length}"

    def _solve(self, arriving: np.ndarray) -> Iterator[tuple[float, str]]:
        """All lengths together, by Jacobi."""
        s, residual = self.settings, 1.0
        scheme = jacobi(self.transport, np.zeros_like(arriving), arriving, s.tolerance, s.max_iterations)
        for number, iterate in enumerate(scheme, 1):
            self.total, residual = iterate.irradiance, iterate.residual
            yield 0.95, f"Iteration {number}, residual {residual:.1e}"
        if residual > s.tolerance:
            reason = f"the first pass stopped after {s.max_iterations} iterations at a relative change of {residual:.1e}"
            self.warnings += (Notice("Two-Pass", reason, "Raise max_iterations or the tolerance, or lower albedos that are close to 1"),)

    def left_out(self) -> float:
        """The share of the light that is longer than the longest path."""
        s, flux = self.settings, [float((self.transport.area @ h).sum()) for h in self.by_length]
        if self.total is not None:
            return 0.0
        tail = np.zeros(2)
        for length, light in enumerate(flux):
            block = path_limit.block_of(length, s.min_length, s.max_length)
            if block is not None:
                tail[block] += light
        return path_limit.left_out(tail, sum(flux[max(1, s.min_length) :]))

    def known(self) -> KnownLight:
        """What was found, for the view pass."""
        s = self.settings
        most = s.max_length if self.total is None else max(0, s.min_length - 1)
        known = KnownLight(self.elements, lengths_of(self.by_length, self.total, self.first, s.min_length, s.max_length), most)
        known.prepare()
        return known
