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

from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.elements.answer import ElementAnswer, element_count, elements_for
from ..adjoint_gi.core.elements.corners import ElementNodes
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.elements.mesh import element_mesh
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.elements.refinement import RefinedElements, smoothed
from ..adjoint_gi.core.flux.detectors import detector
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.method.solution import Solution, Step
from ..adjoint_gi.core.radiosity.importance import GROWTH, PER_SIDE, Subdivision, importance, shoot_emitters
from ..adjoint_gi.core.radiosity.schemes import BATCH, FEWEST, LARGEST_BATCH, MOST, NO_LIMIT, Southwell, balance, group
from ..adjoint_gi.core.radiosity.shared import LampLight, RadiositySettings, dark_notices, receiver_light
from ..adjoint_gi.core.radiosity.transports import FreshRayTransport
from ..adjoint_gi.core.radiosity.trapped import Trap
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

TARGET = 8000  # elements where max_edge is chosen


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
    adaptive: bool = setting(
        False,
        label="Adaptive Subdivision",
        help="Cut elements into four where direct light changes too much over them, such as at shadow boundaries",
    )
    contrast: float = setting(
        0.25,
        label="Contrast",
        help="Change of direct light over an element, as a share of its brightest corner, over which it is cut",
        min=0.001,
        max=1.0,
    )
    min_edge: float = setting(
        0.0,
        label="Min Element Edge",
        help="No element is cut to edges shorter than this; 0 takes an eighth of the longest",
        min=0.0,
        max=1e6,
        unit="distance",
    )
    important: str = setting(
        "",
        label="Important Objects",
        help="Names, separated by commas: subdivision cuts first where light matters to these, by their potential. Empty: everywhere alike",
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
            "Subdivision follows direct light; pieces of an element share its indirect light, smoothly",
        ),
        lobes=frozenset({"diffuse", "emission"}),
        uses_elements=True,
    )
    Settings = ProgressiveSettings

    def element_target(self, settings: ProgressiveSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return target(settings)

    def memory(self, world: World, receivers: Receivers, settings: ProgressiveSettings) -> int:
        """Elements, unshot light by path length, rays under way and receivers; it grows linearly with the elements."""
        count = element_count(world, receivers, settings.max_edge, target(settings))
        count *= GROWTH if settings.adaptive else 1
        classes = max(1, settings.max_length) if settings.max_length < NO_LIMIT else max(2, settings.min_length)
        return count * (700 + 2 * 3 * 8 * (6 * classes + 8)) + 600 * LARGEST_BATCH + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: ProgressiveSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots; the fraction is the flux delivered."""
        run = _Run(self, world, receivers, settings)
        yield from run.steps()


class _Run:
    """The state of one solve."""

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: ProgressiveSettings) -> None:
        self.solver, self.receivers, self.settings = solver, receivers, settings
        self.started = time.monotonic()
        self.base = self.elements = elements_for(world, receivers, settings.max_edge, target(settings))
        self.emitters = Emitters(world)
        self.gather = receiver_light(world, self.emitters, settings)
        self.answer = self._answer(receivers)
        self.fine: ElementAnswer | None = None  # at the corners of the elements that subdivision has made
        self.lamps = LampLight(self.elements, self.emitters, settings.light_samples)
        self.transport = FreshRayTransport(ElementRays(self.elements))
        self.warnings = world.scene.warnings + world.shading.substitutions(solver.spec.lobes)
        self.history: list[tuple[float, float]] = []
        self.rays = 0  # of transports that are no longer used, and of subdivision
        self.state = self._southwell()

    def _answer(self, receivers: Receivers) -> ElementAnswer:
        return ElementAnswer(self.elements, receivers, self.gather, self.settings.min_length, self.settings.max_length)

    def _southwell(self) -> Southwell:
        s = self.settings
        emitted = np.repeat(self.base.emitted, 2, axis=0)
        return Southwell(self.transport, emitted, self.lamps.irradiance, s.min_length, s.max_length, s.overshoot)

    def steps(self) -> Iterator[Step]:
        s = self.settings
        # 1. Where the receivers lie on the elements, and direct light at them.
        for share in self.answer.prepare():
            yield self._step(0.0, f"Receivers and direct light, {share:.0%}")
        # 2. Lamps and background are shot first.
        for share in self.lamps.run():
            yield self._step(0.0, f"Light of lamps and background, {share:.0%}")
        self.state = self._southwell()
        self.warnings += dark_notices(self.elements, self.lamps.irradiance)
        if s.overshoot and not self.state.overshoot:
            self._warn("overshooting is off, as path lengths are bounded", "Set the lengths to 0 and 1024")
        # 3. Shadow boundaries.
        if s.adaptive and s.max_length >= 1:
            yield from self._subdivide()
        # 4. Groups of sides, most unshot flux first.
        left = float(self.state.unshot_flux().sum())
        trap = Trap(self.state)
        while left > s.tolerance * self.state.total and self.state.shots < s.max_shots:
            index, rays = group(self.state, s.rays, s.max_shots)
            if not len(index):
                break
            self.state.shoot(index, rays)
            trap.check(self.elements)
            left = float(self.state.unshot_flux().sum())
            share = left / self.state.total
            self.history.append((time.monotonic() - self.started, share))
            done = (1 - share) / (1 - s.tolerance) if s.tolerance < 1 else 1.0
            yield self._step(float(np.clip(done, 0, 0.999)), f"{self.state.shots:,} shots, {share:.2%} of the light unshot")
        if left > s.tolerance * self.state.total:
            reason = f"stopped after {self.state.shots:,} shots with {left / self.state.total:.2%} of the light unshot"
            self._warn(reason, "Raise max_shots or the tolerance, or lower albedos that are close to 1")
        yield self._step(1.0, f"{self.state.shots:,} shots", partial=False)

    def _subdivide(self) -> Iterator[Step]:
        """Shoot the emitters, then cut elements round by round and go on with the finer ones; no flux is gained or lost."""
        s, start = self.settings, self.state
        flux = start.unshot_flux()
        rays = np.clip(np.ceil(s.rays * flux / max(start.total, 1e-300)), FEWEST, MOST).astype(np.int64)
        for _ in shoot_emitters(start, rays, BATCH):
            yield self._step(0.0, "Light of emitting surfaces")
        limit = s.min_edge or self.base.max_edge / 8
        matters = None
        if s.important:
            yield self._step(0.0, "What matters to the important objects")
            matters = importance(self.base, detector(self.base.world, "objects", s.important))
            self.rays += 2 * self.base.count * PER_SIDE
        division = Subdivision(self.base, self.emitters, s.light_samples, s.contrast, limit, matters)
        for text in division.run(start.first):
            if division.elements is not self.elements:
                self.elements = division.elements
                self.rays += self.transport.count
                self.transport = FreshRayTransport(ElementRays(self.elements))
                self.state = start.refined(self.transport, division.root, division.factor)
                self.answer.refine(self.elements)
            yield self._step(0.0, text)
        self.rays += division.rays
        if division.full:
            reason = f"subdivision stopped at {self.elements.count:,} elements, {GROWTH} times as many as before"
            self._warn(reason, "Raise min_edge or contrast, or lower max_edge")
        # The mesh that was asked for has got more vertices.
        if isinstance(self.receivers, ElementNodes) and isinstance(self.elements, RefinedElements):
            fine = self._answer(ElementNodes(self.elements, self.receivers.objects))
            for share in fine.prepare():
                yield self._step(0.0, f"Direct light on the new elements, {share:.0%}")
            self.fine = fine
            self.rays += fine.rays

    def _warn(self, reason: str, remedy: str) -> None:
        self.warnings += (Notice(self.solver.spec.label, reason, remedy),)

    def _step(self, fraction: float, text: str, partial: bool = True) -> Step:
        state, elements = self.state, self.elements
        return Step(fraction, text, lambda: self._solution(state, elements, partial))

    def _solution(self, state: Southwell, elements: Elements, partial: bool) -> Solution:
        s = self.settings
        direct, indirect = state.direct, state.indirect
        if partial and s.ambient and s.max_length >= 2:
            indirect = indirect + state.reached[:, None] * state.ambient()
        extra = {}
        if isinstance(elements, RefinedElements):
            if not self.answer.identity:
                indirect = smoothed(elements, self.base, indirect)
            if self.fine is not None and elements is self.fine.elements:
                extra = self.fine.receivers.wire(self.fine.parts(direct, indirect).arrays())
            elif not partial:
                extra = wire(elements, direct + indirect)
        parts = self.answer.parts(direct, indirect)
        return Solution(
            self.solver.spec.id,
            self.receivers.measure,
            **{**parts.arrays(), "extra": {**parts.extra, **extra}},
            rays=self.rays + self.transport.count + self.lamps.rays + parts.rays,
            seconds=time.monotonic() - self.started,
            balance=balance(state),
            history=tuple(self.history),
            warnings=self.warnings,
            settings=s.as_dict(),
            partial=partial,
        )


def target(settings: ProgressiveSettings) -> int:
    """Elements wanted where max_edge is chosen; fewer where they will be cut."""
    return TARGET // 4 if settings.adaptive else TARGET


def wire(elements: Elements, irradiance: np.ndarray) -> dict[str, np.ndarray]:
    """The mesh of the elements for `Solution.extra`, with irradiance at its corners; names as in `ElementMesh`."""
    mesh = element_mesh(elements, irradiance)
    return {f"mesh_{name}": getattr(mesh, name) for name in ("vertices", "corners", "start", "triangle", "values")}
