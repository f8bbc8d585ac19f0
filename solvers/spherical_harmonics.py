"""Directional radiance in spherical harmonics, shot progressively (Sillion, Arvo, Westin and Greenberg 1991; review, section 7).

Shooting, deterministic. Each side of an element keeps the radiance it has still to send as coefficients of harmonics h_a over its
hemisphere. The side with most to send shoots it along rays; a BRDF is a matrix M between what arrives and what leaves:

    q(j, b) += sum over rays of dPhi h_b(wi) / A(j),   L(j, wo) += sum_ab h_a(wo) M_ab dq(j, b),   dL(j) likewise,  dL(i) = 0

the directional form of Eq. 13 and 14, which are its case l = 0. M is the cosine-weighted projection of f(wo, wi) on both directions; for
isotropic lobes only equal m couple. It keeps the flux of evenly lit surfaces at every order.

F. X. Sillion, J. R. Arvo, S. H. Westin and D. P. Greenberg, "A Global Illumination Solution for General Reflectance Distributions",
Computer Graphics (SIGGRAPH '91 Proceedings), 25(4), 1991, 187-196.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf import table as bsdf
from ..adjoint_gi.core.directional.answer import DirectionalAnswer, Light
from ..adjoint_gi.core.directional.harmonic_shooting import HarmonicShooting
from ..adjoint_gi.core.directional.harmonics import MOST, HemisphereHarmonics, harmonic_count
from ..adjoint_gi.core.directional.rays import ArrivingLight, DirectionalRays
from ..adjoint_gi.core.directional.scattering import Scattering
from ..adjoint_gi.core.elements.answer import element_count, elements_for
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.radiosity.schemes import NO_LIMIT
from ..adjoint_gi.core.radiosity.shared import RadiositySettings, dark_notices
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

TARGET = 2000  # elements where max_edge is chosen
BATCH = 1 << 16  # rays of the sides that shoot together
FEWEST, MOST_RAYS = 16, 1 << 16  # rays of one shot
ENOUGH = 8  # rays for every coefficient, in shots of sides that are not plainly diffuse
AT_ONCE = 1 << 13  # sides that shoot together at most
PATIENCE = 8  # times that all sides may shoot before the unshot light must have become less: in narrow lobes ringing is passed on for ever


@dataclass(frozen=True)
class HarmonicSettings(RadiositySettings):
    """Settings of directional radiance in harmonics."""

    order: int = setting(
        4, label="Order", help="Highest l of the harmonics; 0 is diffuse light only, 8 resolves lobes of about 20 degrees", min=0, max=MOST
    )
    window: float = setting(
        0.0,
        label="Windowing",
        help="Damps high orders of what lobes reflect, so that less rings and more is blurred; 1 is Lanczos's window",
        min=0.0,
        max=4.0,
    )
    rays: int = setting(
        1_000_000,
        label="Rays",
        help="Rays that carry all emitted flux; a shot takes its share by its flux, at least 16, or 8 for each coefficient if shiny",
        min=1,
        max=2_000_000_000,
        soft_max=100_000_000,
    )
    tolerance: float = setting(1e-3, label="Tolerance", help="Unshot share of the emitted flux at which the method ends", min=0.0, max=1.0)
    max_shots: int = setting(
        10_000_000, label="Max Shots", help="The method ends, and says so, after this many shots", min=1, max=2_000_000_000
    )


@register
class SphericalHarmonics(Solver):
    """Shoots radiance by direction from the sides that have most of it to send."""

    spec = MethodSpec(
        id="spherical_harmonics",
        number=10,
        label="Spherical Harmonics",
        strategies=(Strategy.SHOOTING,),
        natures=(Nature.DETERMINISTIC,),
        year=1991,
        authors="F. X. Sillion, J. R. Arvo, S. H. Westin, D. P. Greenberg",
        title="A Global Illumination Solution for General Reflectance Distributions",
        equation="L(j, wo) += sum_ab h_a(wo) M_ab dq(j, b)  (13 and 14 by direction)",
        section="7",
        idea="Elements shoot radiance that depends on direction, kept in a few spherical harmonics, brightest first.",
        limits=(
            "Lobes narrower than the order resolves are blurred to it and ring: bright reflections have dark rims, windowing weakens them",
            "Radiance that rings below 0 is shot as it is, so that flux is kept, and is shown as 0",
            "Mirrors and glass are taken at the resolution of the harmonics",
            "Elements are flat: shading normals change only the camera's direct light",
            "Lamps are no geometry, and shadow rays stop at glass",
            "Ringing between mirror-like surfaces may never die away; shooting ends, and says so, when no less is left to send",
            "Sides shoot in groups, brightest first, instead of one by one",
        ),
        lobes=bsdf.ALL_LOBES | {"emission"},
        uses_elements=True,
    )
    Settings = HarmonicSettings

    def element_target(self, settings: HarmonicSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return TARGET

    def memory(self, world: World, receivers: Receivers, settings: HarmonicSettings) -> int:
        """Coefficients of element sides by path length, rays under way, the pairs that lobes are projected from, receivers."""
        count = element_count(world, receivers, settings.max_edge, TARGET)
        classes = max(1, settings.max_length) if settings.max_length < NO_LIMIT else max(2, settings.min_length)
        size = harmonic_count(settings.order)
        return 2 * count * size * 24 * (3 * classes + 8) + BATCH * 8 * (60 + 4 * size) + (128 << 20) + 700 * count + 1200 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: HarmonicSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every group of shots; the fraction is the flux delivered."""
        started = time.monotonic()
        elements = elements_for(world, receivers, settings.max_edge, TARGET)
        emitters = Emitters(world)
        caster = DirectionalRays(elements)
        basis = HemisphereHarmonics(settings.order, settings.window)
        scattering = Scattering(elements, bsdf.BsdfTable(world.scene), basis)
        answer = DirectionalAnswer(caster, receivers, emitters, settings, scattering)
        light = ArrivingLight(caster, emitters, settings.light_samples, background=True)
        state = HarmonicShooting(caster, basis, scattering, settings.min_length, settings.max_length)
        state.emit(elements_radiance(elements, basis))
        warnings = world.scene.warnings + world.shading.substitutions(self.spec.lobes)
        history: list[tuple[float, float]] = []

        def step(fraction: float, text: str, partial: bool = True) -> Step:
            return Step(fraction, text, lambda: solution(partial))

        def solution(partial: bool) -> Solution:
            parts = answer.parts(*(arrived(scattering, basis, x) for x in (state.direct, state.indirect)))
            return Solution(
                self.spec.id,
                receivers.measure,
                **parts.arrays(),
                rays=state.count + light.rays + parts.rays,
                seconds=time.monotonic() - started,
                balance=balance(state),
                history=tuple(history),
                warnings=warnings,
                settings=settings.as_dict(),
                partial=partial,
            )

        # 1. BRDFs in harmonics; where the receivers lie on the elements, and direct light at them.
        for share in scattering.prepare():
            yield step(0.0, f"Materials in harmonics, {share:.0%}")
        for share in answer.prepare():
            yield step(0.0, f"Receivers and direct light, {share:.0%}")
        # 2. Lamps and background are shot first.
        moments = np.zeros_like(state.direct)

        def sink(side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
            first = int(side.min(initial=0))
            h = basis.values(w)
            for c in range(3):
                for a in range(basis.size):
                    sums = np.bincount(side - first, value[:, c] * h[:, a])
                    moments[first : first + len(sums), a, c] += sums

        for share in light.run(sink):
            yield step(0.0, f"Light of lamps and background, {share:.0%}")
        state.illuminate(moments)
        warnings += dark_notices(elements, moments)
        # 3. Groups of sides, most unshot flux first.
        left = least = float(state.strength().sum())
        progress = 0  # shots at which the least was found
        while left > settings.tolerance * state.total and state.shots < settings.max_shots:
            index, rays = group(state, settings)
            if not len(index):
                break
            state.shoot(index, rays)
            left = float(state.strength().sum())
            if left < 0.98 * least:
                least, progress = left, state.shots
            share = left / state.total
            history.append((time.monotonic() - started, share))
            done = (1 - share) / (1 - settings.tolerance) if settings.tolerance < 1 else 1.0
            yield step(float(np.clip(done, 0, 0.999)), f"{state.shots:,} shots, {share:.2%} of the light unshot")
            if state.shots - progress > PATIENCE * len(state.area):
                break
        if left > settings.tolerance * state.total:
            reason = f"stopped after {state.shots:,} shots with {left / state.total:.2%} of the light unshot"
            warnings += (Notice(self.spec.label, reason, "Raise rays, max_shots, windowing or the tolerance, or lower albedos close to 1"),)
        yield step(1.0, f"{state.shots:,} shots", partial=False)


def elements_radiance(elements: Elements, basis: HemisphereHarmonics) -> np.ndarray:
    """(n, size, 3) coefficients of the emission, which is the same in all directions."""
    return np.repeat(elements.emitted / np.pi, 2, axis=0)[:, None] * basis.constant()[:, None]


def group(state: HarmonicShooting, settings: HarmonicSettings) -> tuple[np.ndarray, np.ndarray]:
    """The sides that shoot next and the rays of each: in the order of what they have to send, as many as fit into one batch of rays."""
    index, strength = state.largest(min(AT_ONCE, settings.max_shots - state.shots))
    # Noise: a narrow lobe makes of one ray a radiance whose mean square is about `size` times that of an even one. Sent on along
    # fewer rays than this, each of which may hit another mirror, it would grow from bounce to bounce.
    fewest = np.where(state.scattering.shiny[index >> 1], max(FEWEST, ENOUGH * state.basis.size), FEWEST)
    rays = np.clip(np.ceil(settings.rays * strength / max(state.total, 1e-300)), fewest, MOST_RAYS).astype(np.int64)
    fits = max(1, int(np.searchsorted(np.cumsum(rays), BATCH, side="right")))
    return index[:fits], rays[:fits]


def arrived(scattering: Scattering, basis: HemisphereHarmonics, moments: np.ndarray) -> Light:
    """What moments (n, size, 3) mean to receivers."""
    shine = scattering.apply(moments, diffuse=False)
    exitance = np.einsum("a,nac->nc", basis.flux, scattering.apply(moments))
    return Light(np.sqrt(2 * np.pi) * moments[:, 0], scattering.below_coat(moments), shine, exitance)


def balance(state: HarmonicShooting) -> EnergyBalance:
    """Flux summed over the channels; light cut off by the path length counts as unshot."""
    return EnergyBalance(state.total, float(state.absorbed.sum()), float(state.escaped.sum()), float(state.remaining().sum()))
