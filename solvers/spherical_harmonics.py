"""Directional radiance in spherical harmonics, shot progressively (Sillion, Arvo, Westin and Greenberg 1991; review, section 7).

Shooting, deterministic. Each side of an element keeps its unshot radiance as coefficients of harmonics h_a over its
hemisphere. The side with the most shoots it along rays; a BRDF is a matrix M between what arrives and what leaves:

    q(j, b) += sum over rays of dPhi h_b(wi) / A(j),   L(j, wo) += sum_ab h_a(wo) M_ab dq(j, b),   dL(j) likewise,  dL(i) = 0

the directional form of the shot of Eq. 13, which is its case l = 0. M is the cosine-weighted projection of f(wo, wi) on both
directions; for isotropic lobes only equal m couple. It keeps the flux of evenly lit surfaces at every order.

F. X. Sillion, J. R. Arvo, S. H. Westin and D. P. Greenberg, "A Global Illumination Solution for General Reflectance Distributions",
Computer Graphics (SIGGRAPH '91 Proceedings), 25(4), 1991, 187-196.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES, LOBE_KINDS, LOBES
from ..adjoint_gi.core.directional.harmonic_shooting import HarmonicShooting
from ..adjoint_gi.core.directional.harmonics import MAX_ORDER, ODD, HemisphereHarmonics, harmonic_count
from ..adjoint_gi.core.directional.run import DirectionalRun, leaving
from ..adjoint_gi.core.elements.answer import element_count
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.radiosity.southwell import RAYS_PER_GROUP, Grouping, Southwell, balance, length_classes
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

# A side keeps many coefficients: other bounds than those of diffuse shooting (`core.radiosity.southwell`).
MIN_RAYS_PER_HARMONIC_SHOT, MAX_RAYS_PER_HARMONIC_SHOT = 16, 1 << 16  # rays of one shot
RAYS_PER_COEFFICIENT = 8  # in shots of sides that are not plainly diffuse
MAX_HARMONIC_SIDES_PER_GROUP = 1 << 13  # sides that shoot together at most
PATIENCE = 8  # times that all sides may shoot before the unshot light must have become less: in narrow lobes ringing is passed on for ever


@dataclass(frozen=True)
class HarmonicSettings(RadiositySettings):
    """Settings of directional radiance in harmonics."""

    order: int = setting(
        4, "Order", "Highest l of the harmonics; 0 is diffuse light only, 8 resolves lobes of about 20 degrees", min=0, max=MAX_ORDER
    )
    window: float = setting(
        0.0,
        "Windowing",
        "Damps high orders of what lobes reflect, so that less rings and more is blurred; 1 is Lanczos's window",
        min=0.0,
        max=4.0,
    )
    rays: int = common.shooting_rays(
        1_000_000,
        "Rays that carry all emitted flux; a shot takes its share by its flux, at least 16, or 8 for each coefficient if shiny",
    )
    tolerance: float = common.unshot(1e-3)
    max_shots: int = common.max_shots(10_000_000)


@register
class SphericalHarmonics(Solver):
    """Shoots radiance by direction from the sides that have most of it unshot."""

    spec = MethodSpec(
        id="spherical_harmonics",
        number=10,
        label="Spherical Harmonics",
        strategies=SHOOTING,
        natures=DETERMINISTIC,
        year=1991,
        authors="F. X. Sillion, J. R. Arvo, S. H. Westin, D. P. Greenberg",
        title="A Global Illumination Solution for General Reflectance Distributions",
        equation="L(j, wo) += sum_ab h_a(wo) M_ab dq(j, b)  (one shot; 13 by direction)",
        section="7",
        idea="Elements shoot radiance that depends on direction, kept in a few spherical harmonics, brightest first.",
        lobes=ALL_LOBES,
        limits=lines("""
            Lobes narrower than the order resolves are blurred to it and ring: bright reflections have dark rims, windowing weakens them
            Radiance that rings below 0 is shot as it is, so that flux is kept, and is shown as 0
            Mirrors and glass are taken at the resolution of the harmonics: beams spread behind panes, one pane's flux was within 4 %
            Elements are flat: shading normals change only the camera's direct light
            Lamps are not geometry, and shadow rays stop at glass
            Ringing between mirror-like surfaces may never die away; shooting stops with a warning when the unshot light falls no more
            Sides shoot in groups, brightest first, instead of one by one
        """),
        elements=2000,
    )
    Settings = HarmonicSettings

    def memory(self, world: World, receivers: Receivers, settings: HarmonicSettings) -> int:
        """Coefficients of element sides by path length, rays under way, the pairs that lobes are projected from, receivers."""
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        classes = length_classes(settings.min_length, settings.max_length)
        size = harmonic_count(settings.order)
        if any(x.kind in LOBE_KINDS and LOBES[LOBE_KINDS[x.kind]].refracts for m in world.scene.materials for x in m.lobes):
            size = 2 * (size + len(ODD))
        return (
            2 * count * size * 24 * (3 * classes + 8)
            + RAYS_PER_GROUP * 8 * (60 + 4 * size)
            + (128 << 20)
            + 700 * count
            + 1200 * receivers.count
        )

    def solve(self, world: World, receivers: Receivers, settings: HarmonicSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots; the fraction is the flux delivered."""
        s = settings
        run = DirectionalRun(self, world, receivers, s, HemisphereHarmonics(s.order, s.window), background=True)
        state = HarmonicShooting(run.caster, run.scattering, s.min_length, s.max_length)
        run.find = lambda partial: run.found((state.direct, state.indirect), state.count, balance(state))

        # 1. M_ab of every material; where the receivers lie on the elements, and direct light at them. What elements emit is unshot.
        state.emit(leaving(run.elements, run.basis))
        yield from run.stage(run.scattering.prepare(), 0.0, 0.0, "Materials in harmonics, {}")
        yield from run.stage(run.answer.prepare(), 0.0, 0.0, "Receivers and direct light, {}")

        # 2. Lamps and background are shot first.
        moments = run.field()
        yield from run.stage(run.lamps.run(run.into(moments)), 0.0, 0.0, "Light of lamps and background, {}")
        state.illuminate(moments)
        run.check_lit(moments)

        # 3. Groups of sides, most unshot flux first: L(j, wo) += sum_ab h_a(wo) M_ab dq(j, b) (Eq. 13 by direction).
        shooting = Southwell(state, grouping(state, s.rays), s.tolerance, s.max_shots, PATIENCE * len(state.area))
        for share in shooting.run():
            run.clock.note(share)
            yield from run.step(shooting.done, shooting.text)
        if shooting.unfinished:
            run.warn(shooting.shortfall, "Raise rays, max_shots, windowing or the tolerance, or lower albedos close to 1")
        if run.glass_is_lit((state.direct, state.indirect)):
            blurred = f"light that refracts is blurred by harmonics of order {s.order}"
            reason = f"{blurred}: one pane's flux was within 4 %, a floor below it got up to 10 % too little at order 4, 2 % at 8"
            run.warn(reason, "Raise order, or take Particle Tracing where light comes through glass")
        yield from run.finish(f"{state.shots:,} shots")


def grouping(state: HarmonicShooting, carriers: int) -> Grouping:
    """Groups of sides, in which `carriers` rays carry all emitted flux."""

    def fewest(index: np.ndarray) -> np.ndarray:
        # Noise: a narrow lobe makes of one ray a radiance whose mean square is about `size` times that of an even one. Sent on along
        # fewer rays than this, each of which may hit another mirror, it would grow from bounce to bounce.
        narrow = max(MIN_RAYS_PER_HARMONIC_SHOT, RAYS_PER_COEFFICIENT * state.basis.size)
        return np.where(state.scattering.shiny[index >> 1], narrow, MIN_RAYS_PER_HARMONIC_SHOT)

    return Grouping(carriers, RAYS_PER_GROUP, MAX_HARMONIC_SIDES_PER_GROUP, fewest, MAX_RAYS_PER_HARMONIC_SHOT)
