"""Progressive radiosity (Cohen, Chen, Wallace and Greenberg 1988; review, section 7, Eq. 13).

Shooting, deterministic. The element with the most unshot flux sends it to all others; what they reflect of it is unshot there:

    B(j) += rho(j) dB(i) F(ij) A(i) / A(j),  dB(j) likewise,  dB(i) = 0                                   (before 13)

This is the review's shot dB(i) = rho(i) F(ij) B(j) with i and j exchanged (here i shoots), as A(i) F(ij) = A(j) F(ji); Eq. 13 is the sum of
all shots, and its printed F, from the side that shoots, is right for fluxes, or for equal areas. Flux is what is counted here, along rays
from the shooting element, so none is lost: emitted = absorbed + escaped + unshot at every step.

M. F. Cohen, S. E. Chen, J. R. Wallace and D. P. Greenberg, "A Progressive Refinement Approach to Fast Radiosity Image Generation",
Computer Graphics (SIGGRAPH '88 Proceedings), 22(4), 1988, 75-84. Overshooting: M. Feda and W. Purgathofer, "Accelerating Radiosity by
Overshooting", Eurographics Workshop on Rendering, 1992, 21-32.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import DIFFUSE_LOBES
from ..adjoint_gi.core.elements.answer import ElementAnswer, element_count
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.elements.mesh import ElementNodes, element_mesh
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.elements.refinement import RefinedElements, smoothed
from ..adjoint_gi.core.flux.detectors import detector
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.radiosity.element_run import Found, RadiosityRun
from ..adjoint_gi.core.radiosity.importance import GROWTH, PER_SIDE, Subdivision, importance, shoot_emitters
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.radiosity.southwell import (
    MOST_RAYS_PER_GROUP,
    RAYS_PER_GROUP,
    DiffuseShooting,
    Grouping,
    Southwell,
    balance,
    length_classes,
)
from ..adjoint_gi.core.radiosity.transports import FreshRayTransport
from ..adjoint_gi.core.radiosity.trapped import Trap
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World


@dataclass(frozen=True)
class ProgressiveSettings(RadiositySettings):
    """Settings of progressive radiosity."""

    rays: int = common.shooting_rays(
        2_000_000, "Rays that carry all emitted flux; a shot takes its share of them by its flux, and never fewer than 8"
    )
    tolerance: float = common.unshot(1e-3)
    max_shots: int = common.max_shots(10_000_000)
    ambient: bool = setting(
        True, "Ambient Estimate", "Partial results show the unshot light spread evenly, as an estimate; the finished result never has it"
    )
    adaptive: bool = setting(
        False, "Adaptive Subdivision", "Cut elements into four where direct light changes too much over them, such as at shadow boundaries"
    )
    contrast: float = setting(
        0.25,
        "Contrast",
        "Change of direct light over an element, as a share of its brightest corner, over which it is cut",
        min=0.001,
        max=1.0,
    )
    min_edge: float = common.distance("Min Element Edge", "No element is cut to edges shorter than this; 0 takes an eighth of the longest")
    important: str = setting(
        "",
        "Important Objects",
        "Names, separated by commas: subdivision cuts first where light matters to these, by their potential. Empty: everywhere alike",
    )
    overshoot: bool = setting(
        False, "Overshooting", "Shots carry what their element is expected to receive later, too; not with bounded path lengths"
    )


@register
class ProgressiveRadiosity(Solver):
    """Shoots from the sides with the most unshot flux, many sides together, until little is left."""

    spec = MethodSpec(
        id="progressive_radiosity",
        number=9,
        label="Progressive Radiosity",
        strategies=SHOOTING,
        natures=DETERMINISTIC,
        year=1988,
        authors="M. F. Cohen, S. E. Chen, J. R. Wallace, D. P. Greenberg",
        title="A Progressive Refinement Approach to Fast Radiosity Image Generation",
        equation="B(j) += rho(j) dB(i) F(ij) A(i) / A(j)  (one shot; 13 is the sum)",
        section="7",
        idea="The element with the most unshot light sends it to all it sees, again and again, so that the brightest light comes first.",
        lobes=DIFFUSE_LOBES,
        limits=lines("""
            Diffuse surfaces only: other lobes are taken as diffuse
            Indirect shadows are as sharp as the elements are small
            Sides shoot in groups, brightest first, instead of one by one
            Form factors are shares of rays: elements that few rays meet are uneven
            Subdivision follows direct light; pieces of an element share its indirect light, smoothly
        """),
        elements=8000,
    )
    Settings = ProgressiveSettings

    def element_target(self, settings: ProgressiveSettings) -> int:
        """Fewer where they will be cut."""
        return self.spec.elements // 4 if settings.adaptive else self.spec.elements

    def memory(self, world: World, receivers: Receivers, settings: ProgressiveSettings) -> int:
        """Elements, unshot light by path length, rays under way and receivers; it grows linearly with the elements."""
        count = element_count(world, receivers, settings.max_edge, self.element_target(settings))
        count *= GROWTH if settings.adaptive else 1
        classes = length_classes(settings.min_length, settings.max_length)
        return count * (700 + 2 * 3 * 8 * (6 * classes + 8)) + 600 * MOST_RAYS_PER_GROUP + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: ProgressiveSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots; the fraction is the flux delivered."""
        s = settings
        run = ProgressiveRun(self, world, receivers, s)

        # 1. Where the receivers lie on the elements, and direct light at them.
        yield from run.stage(run.answer.prepare(), 0.0, 0.0, "Receivers and direct light, {}")

        # 2. Lamps and background are shot first.
        yield from run.stage(run.lamps.run(), 0.0, 0.0, "Light of lamps and background, {}")
        run.begin()

        # 3. Shadow boundaries: emitters shoot, elements are cut.
        if s.adaptive and s.max_length >= 1:
            yield from run.subdivide()

        # 4. Groups of sides, most unshot flux first: B(j) += rho(j) dB(i) F(ij) A(i) / A(j) (Eq. 13 is the sum).
        state, trap = run.state, Trap(run.state)
        shooting = Southwell(state, Grouping.for_sides(len(state.direct), s.rays), s.tolerance, s.max_shots)
        for share in shooting.run():
            trap.check(run.elements)
            run.clock.note(share)
            yield from run.step(shooting.done, shooting.text)
        if shooting.unfinished:
            run.warn(shooting.shortfall, "Raise max_shots or the tolerance, or lower albedos that are close to 1")
        yield from run.finish(f"{state.shots:,} shots")


class ProgressiveRun(RadiosityRun):
    """One solve. `base` are the elements before subdivision, `state` is what has been shot and what has not."""

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: ProgressiveSettings) -> None:
        super().__init__(solver, world, receivers, settings)
        self.base = self.elements
        self.fine: ElementAnswer | None = None  # at the corners of the elements that subdivision has made
        self.transport = FreshRayTransport(ElementRays(self.elements))
        self.rays = 0  # of transports that are no longer used, and of subdivision
        self._start()

    def _start(self) -> None:
        """The state before any shot, with the light of lamps and background as far as it is known.

        Made twice: at first so that there are partial results while that light is found, and in `begin` with all of it.
        """
        s = self.settings
        self._become(DiffuseShooting(self.transport, self.emitted, self.lamps.irradiance, s.min_length, s.max_length, s.overshoot))

    def _become(self, state: DiffuseShooting) -> None:
        self.state, elements = state, self.elements
        self.find = lambda partial: self._find(state, elements, partial)

    def begin(self) -> None:
        """All light is unshot: that of the elements, and what they reflect of that of lamps and background."""
        self._start()
        self.check_lit(self.lamps.irradiance)
        if self.settings.overshoot and not self.state.overshoot:
            self.warn("overshooting is off, as path lengths are bounded", "Set the lengths to 0 and 1024")

    def subdivide(self) -> Iterator[Step]:
        """Shoot the emitters, then cut elements round by round and go on with the finer ones; no flux is gained or lost."""
        s, start = self.settings, self.state
        flux = start.unshot_flux()
        rays = Grouping(s.rays, RAYS_PER_GROUP).rays(np.arange(len(flux)), flux, start.total)
        for _ in shoot_emitters(start, rays, RAYS_PER_GROUP):
            yield from self.step(0.0, "Light of emitting surfaces")
        limit = s.min_edge or self.base.max_edge / 8
        matters = None
        if s.important:
            yield from self.step(0.0, "What matters to the important objects")
            matters = importance(self.base, detector(self.world, "objects", s.important))
            self.rays += 2 * self.base.count * PER_SIDE
        division = Subdivision(self.base, self.emitters, s.light_samples, s.contrast, limit, matters)
        for text in division.run(start.first):
            if division.elements is not self.elements:
                self.elements = division.elements
                self.rays += self.transport.count
                self.transport = FreshRayTransport(ElementRays(self.elements))
                self._become(start.refined(self.transport, division.root, division.factor))
                self.answer.refine(self.elements)
            yield from self.step(0.0, text)
        self.rays += division.rays
        if division.full:
            reason = f"subdivision stopped at {self.elements.count:,} elements, {GROWTH} times as many as before"
            self.warn(reason, "Raise min_edge or contrast, or lower max_edge")
        # The mesh that was asked for has got more vertices.
        if isinstance(self.receivers, ElementNodes) and isinstance(self.elements, RefinedElements):
            fine = self.answer_at(ElementNodes(self.elements, self.receivers.objects))
            yield from self.stage(fine.prepare(), 0.0, 0.0, "Direct light on the new elements, {}")
            self.fine = fine
            self.rays += fine.rays

    def _find(self, state: DiffuseShooting, elements: Elements, partial: bool) -> Found:
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
                extra = element_mesh(elements, direct + indirect).arrays()
        parts = self.answer.parts(direct, indirect)
        return Found(parts, self.rays + self.transport.count + self.lamps.rays + parts.rays, balance(state), extra)
