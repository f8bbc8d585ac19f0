"""Particle tracing (Pattanaik and Mudur 1992; review, section 8, Eq. 15): random walks of light particles from the sources.

Shooting, nondeterministic. The flux of a set of points and directions g is <W, Le>, with W the potential of g. Sampling the emission
Le, normalised by its total E, and following each sample by the probabilities of absorption and reflection, estimates it by

    Phi = E / n  sum_i [ g(x_i0) + sum_k g(x_ik) ]                                                                    (15)

Here g is one element side at a time, or the surroundings of one receiver: all are estimated by the same walks. A particle that arrives
adds its power to the place's; power over area is irradiance. A surface scatters a particle by any of its lobes, so light that mirrors
and glass throw on other surfaces (caustics) is found; absorption is the event that ends a walk, and escape the other one.

Between elements the answer is interpolated, so shadows are as sharp as the elements are small; receivers that count for themselves
see them blurred over a kernel (`core.walks.particle_density`). What is counted is irradiance: a camera sees glossy surfaces as diffuse.

S. N. Pattanaik and S. P. Mudur, "Computation of Global Illumination by Monte Carlo Simulation of the Particle Model of Light",
Eurographics Workshop on Rendering, 1992, 71-83.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.parallel import in_order, thread_count
from ..adjoint_gi.core.base.settings import choice
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES
from ..adjoint_gi.core.bsdf.table import LOBE_KINDS, BsdfTable
from ..adjoint_gi.core.elements import closeness
from ..adjoint_gi.core.elements.answer import elements_for
from ..adjoint_gi.core.flux.tally import Batch, ElementScore, ReceiverScore, Tally
from ..adjoint_gi.core.lights.emission import Emission
from ..adjoint_gi.core.lights.flux import light_flux
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method import noise
from ..adjoint_gi.core.method.clock import Clock
from ..adjoint_gi.core.method.registry import NONDETERMINISTIC, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Solution, Step
from ..adjoint_gi.core.receivers.base import Receivers, SurfaceReceivers
from ..adjoint_gi.core.scene.world import World
from ..adjoint_gi.core.walks import path_limit
from ..adjoint_gi.core.walks.particles import Hits, walk

MIN_PARTICLES_PER_BATCH, MAX_PARTICLES_PER_BATCH = 1 << 10, 1 << 15  # particles in a batch
BATCHES = 32  # at least, where batches do not become too small: the standard error is estimated from their differences
FEW_BATCHES = 8  # where there are so many elements that summing over them takes longer than the walks
PER_ELEMENT = 250  # particles shot for each element that is made when the elements' size is chosen automatically
MIN_ELEMENTS, MAX_ELEMENTS = 500, 50_000  # elements chosen automatically


@dataclass(frozen=True)
class ParticleSettings(base.Settings):
    """Settings of particle tracing."""

    particles: int = common.particles(1_000_000, "Particles shot from all lights together; four times as many halve the noise")
    max_edge: float = common.max_edge("Longest edge of the elements that collect particles; 0 chooses it by the number of particles")
    score: str = choice(
        "elements",
        "Count Particles",
        "Where particles are counted",
        elements=("On Elements", "On elements of the surfaces, with the answer interpolated between them"),
        receivers=("At Receivers", "Around every texel or vertex, by density over area; a camera takes elements"),
    )
    radius: float = common.distance(
        "Radius", "Within which particles count for a receiver, when they are counted at receivers; 0 chooses it by their number"
    )


@register
class ParticleTracing(Solver):
    """Shoots particles in batches and counts their power on element sides."""

    spec = MethodSpec(
        id="particle_tracing",
        number=11,
        label="Particle Tracing",
        strategies=SHOOTING,
        natures=NONDETERMINISTIC,
        year=1992,
        authors="S. N. Pattanaik, S. P. Mudur",
        title="Computation of Global Illumination by Monte Carlo Simulation of the Particle Model of Light",
        equation="Phi = <W, Le> = E / n sum_i [ g(x_i0) + sum_k g(x_ik) ]  (15)",
        section="8",
        idea="Particles of equal power leave the lights, are absorbed or reflected at random, and are counted where they arrive.",
        lobes=ALL_LOBES,
        limits=lines("""
            What is found is irradiance: to a camera, glossy and mirror surfaces reflect it as diffuse ones would
            Shadows and caustics are as sharp as the elements are small, or as the radius at receivers
            Noise is highest where few particles arrive, such as small and dark corners
        """),
        elements=1_000_000 // PER_ELEMENT,
    )
    Settings = ParticleSettings

    def element_target(self, settings: ParticleSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return automatic(settings.particles)

    def memory(self, world: World, receivers: Receivers, settings: ParticleSettings) -> int:
        """Elements, their sums in float64, the batches under way and the receivers' points."""
        if at_receivers(receivers, settings):
            points = len(receivers.triangle)
            return points * (250 + (2 * 7 + 2 * thread_count() * 2 * 7) * 8) + (1 << 20) * 100 * thread_count()
        own = getattr(receivers, "elements", None)
        if own is not None:
            count = own.count
        elif settings.max_edge:
            count = world.triangle_count + int(2 * world.area.sum() / settings.max_edge**2)
        else:
            count = world.triangle_count + automatic(settings.particles)
        batches = 2 * thread_count()
        return count * (400 + 2 * 7 * 8 + batches * 2 * 6 * 8) + batches * MAX_PARTICLES_PER_BATCH * 600 + receivers.count * 1500

    def solve(self, world: World, receivers: Receivers, settings: ParticleSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every batch; the fraction is particles done."""
        shot = ParticleRun(self.spec, world, receivers, settings, rng)

        # Step 1: where the receivers lie on the elements, or what they are made of: the places g whose flux is wanted.
        for share in shot.score.prepare():
            yield from shot.clock.pause(Step(0.0, f"Finding receivers, {share:.0%}", shot.solution))

        # Step 2: Phi = <W, Le> of all of them by the same particles (Eq. 15), batch by batch.
        with closing(in_order(shot.batch, range(len(shot.sizes)))) as batches:
            for batch in batches:
                shot.tally.add(batch)
                shot.clock.note(shot.tally.relative_error())
                done = shot.tally.count
                if done < settings.particles:
                    yield from shot.clock.pause(
                        Step(done / settings.particles, f"{done:,} of {settings.particles:,} particles", shot.solution)
                    )
        if at_receivers(receivers, settings):
            shot.warnings += empty_notices(self.spec.label, shot.tally)
        shot.warnings += shot.close_notices()
        shot.left_out = path_limit.left_out(shot.tally.ends.tail, shot.tally.ends.arrived)
        shot.warnings += path_limit.notices(shot.left_out, settings.max_length)
        error = shot.clock.history[-1][1] if shot.clock.history else None
        shot.warnings += noise.notices(error, settings, self.spec.label, receivers.measure, len(shot.emission.names))
        shot.partial = False
        yield from shot.clock.last(Step(1.0, f"{shot.tally.count:,} particles", shot.solution))


class ParticleRun:
    """One solve: what emits, where particles are counted, and what was counted so far."""

    def __init__(self, spec: MethodSpec, world: World, receivers: Receivers, settings: ParticleSettings, rng: np.random.Generator) -> None:
        self.spec, self.world, self.receivers, self.settings = spec, world, receivers, settings
        self.clock = Clock()
        self.emission, table = Emission(world), BsdfTable(world.scene)
        self.flux = light_flux(world, self.emission.mesh, self.emission.lamps, self.emission.background)
        self.table = None if table.only_diffuse else table
        if at_receivers(receivers, settings):
            self.score = ReceiverScore(world, receivers, settings, settings.particles, settings.radius)
        else:
            elements = elements_for(world, receivers, settings.max_edge, automatic(settings.particles))
            self.score = ElementScore(elements, receivers, settings)
        self.tally = Tally(self.score.count, len(self.emission.names))
        self.warnings = world.scene.warnings + notices(world, self.emission) + camera_notices(world, receivers, settings)
        self.partial = True
        self.left_out: float | None = None
        # Each batch has random numbers of its own.
        self.sizes = batch_sizes(0 if self.emission.is_dark else settings.particles, self.score.count)
        self.seeds = rng.integers(0, 1 << 63, 4).tolist()

    def batch(self, index: int) -> Batch:
        """E / n sum_i [ g(x_i0) + sum_k g(x_ik) ] (15) over the particles of one batch, for every place g."""
        count, s = self.sizes[index], self.settings
        rng = np.random.Generator(np.random.SFC64([*self.seeds, index]))
        first: list[tuple] = []
        later: list[tuple] = []

        def visit(hits: Hits) -> None:
            # g(x_i0): particles that arrive straight from a light; g(x_ik): after k reflections.
            if hits.length >= s.min_length:
                (first if hits.length == 1 else later).append(self.score.note(hits))

        # Le normalised by its total E: each particle starts with the power E / n.
        particles = self.emission.draw(count, rng)
        # x_i0, x_i1, ...: it is absorbed or reflected where it arrives, until it is absorbed or escapes.
        ends = walk(self.world, particles, s.max_length, rng, visit, self.table)
        lights = [np.bincount(particles.light, particles.weight[:, c], len(self.emission.names)) for c in range(3)]
        area = self.score.area(count, rng)
        return Batch(count, self.score.power(first), self.score.power(later), area, np.stack(lights, axis=1), ends)

    def close_notices(self) -> tuple[Notice, ...]:
        """Lights that are closer to surfaces than what counts particles there is wide: its noise does not know how it blurs them."""
        e = self.emission
        sources = e.mesh.sources() + e.lamps.sources() + e.background.sources()
        close = closeness.spots(self.world, sources, lambda *at: (self.score.width(*at), 1.0))
        if at_receivers(self.receivers, self.settings):
            words = "the kernels that count particles are wide", "blurred", "Radius (radius)"
        else:
            words = "two of the elements that count particles are wide", "blurred", "Max Element Edge (max_edge)"
        return closeness.told(self.world, close, *words, 0.4, "which needs none; more particles keep the noise down")

    def solution(self) -> Solution:
        """The result as it stands: power over area is irradiance. The clock adds the seconds and the history."""
        tally = self.tally
        arrays, rays = self.score.arrays(tally.per_particle(tally.direct), tally.per_particle(tally.indirect), tally.area)
        lights = {"light_flux": tally.per_particle(tally.lights).astype(np.float32), "light_names": np.array(self.emission.names, np.str_)}
        arrays["extra"] = arrays["extra"] | lights
        dark = ()
        if not self.partial and not at_receivers(self.receivers, self.settings):  # of which it is said how many have counted nothing
            about = self.settings, self.spec.label, self.receivers.measure
            dark = noise.darkness((arrays["direct"], arrays["indirect"]), self.flux.emitted, *about)
        return Solution(
            self.spec.id,
            self.receivers.measure,
            **arrays,
            rays=tally.ends.rays + rays,
            balance=tally.balance(),
            left_out=self.left_out,
            emitted_flux=self.flux.emitted,
            entering_flux=self.flux.entering,
            warnings=self.warnings + dark,
            settings=self.settings.as_dict(),
            partial=self.partial,
        )


def automatic(particles: int) -> int:
    """Elements wanted for a number of particles, so that each gets some hundred hits."""
    return min(max(particles // PER_ELEMENT, MIN_ELEMENTS), MAX_ELEMENTS)


def batch_sizes(particles: int, sides: int) -> list[int]:
    """Particles of each batch; they differ by one at most. A batch has at least half as many as there are element sides."""
    if particles == 0:
        return []
    wanted = max(particles // BATCHES, min(sides // 2, particles // FEW_BATCHES))
    size = min(max(wanted, MIN_PARTICLES_PER_BATCH), MAX_PARTICLES_PER_BATCH)
    many = -(-particles // size)
    return [particles // many + (i < particles % many) for i in range(many)]


def at_receivers(receivers: Receivers, settings: ParticleSettings) -> bool:
    """Whether particles are counted at the receivers themselves, which must be points on surfaces."""
    return settings.score == "receivers" and isinstance(receivers, SurfaceReceivers)


def camera_notices(world: World, receivers: Receivers, settings: ParticleSettings) -> tuple[Notice, ...]:
    """What the method cannot do for a camera."""
    if receivers.measure != "radiance":
        return ()
    out = []
    if settings.score == "receivers":
        out.append(Notice("Camera", "has no area to count particles in, so they are counted on elements", "Bake to texels or vertices"))
    for index in np.unique(world.scene.material):
        material = world.scene.materials[index]
        if any(x.kind in LOBE_KINDS and not x.is_black for x in material.lobes):
            reason = "scatters particles by all its lobes, but is seen as diffuse, since elements hold irradiance"
            out.append(Notice(f"Material {material.name}", reason, "Choose path tracing or two-pass for pictures of it"))
    return tuple(dict.fromkeys(out))


def empty_notices(label: str, tally: Tally) -> tuple[Notice, ...]:
    """Said where most receivers have counted nothing, which looks like darkness."""
    empty = float(np.mean(~(tally.direct + tally.indirect).any(axis=1))) if tally.count and len(tally.direct) else 0.0
    if empty < 0.5:
        return ()
    reason = f"{empty:.0%} of the receivers have counted no particle"
    return (Notice(label, reason, "Raise radius or set it to 0, send more particles, or accept that no light arrives there"),)


def notices(world: World, emission: Emission) -> tuple[Notice, ...]:
    """What the user must know of the lights."""
    out = []
    if emission.is_dark:
        out.append(Notice("Scene", "nothing emits light, so the result is black", "Add a lamp, an emissive material or a background"))
    for light in world.scene.lights:
        if not light.shadow and any(light.color):
            out.append(Notice(light.name, "casts shadows in this method, as particles stop where they hit", "Choose a gathering method"))
    return tuple(out)
