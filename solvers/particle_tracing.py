"""Particle tracing (Pattanaik and Mudur 1992; review, section 8, Eq. 15): random walks of light particles from the sources.

Shooting, nondeterministic. The flux of a set of points and directions g is <W, Le>, with W the potential of g. Sampling the emission
Le, normalised by its total E, and following each sample by the probabilities of absorption and reflection, estimates it by

    Phi = E / n  sum_i [ g(x_i0) + sum_k g(x_ik) ]                                                                    (15)

Here g is one element side at a time: all are estimated by the same walks. A particle that arrives adds its power to the side's; power
over area is irradiance. Between elements the answer is interpolated, so shadows are as sharp as the elements are small.

S. N. Pattanaik and S. P. Mudur, "Computation of Global Illumination by Monte Carlo Simulation of the Particle Model of Light",
Eurographics Workshop on Rendering, 1992, 71-83.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core import settings as base
from ..adjoint_gi.core.answer import ElementAnswer, elements_for
from ..adjoint_gi.core.elements import Elements
from ..adjoint_gi.core.emission import Emission
from ..adjoint_gi.core.errors import Notice
from ..adjoint_gi.core.parallel import in_order, thread_count
from ..adjoint_gi.core.receivers import Receivers
from ..adjoint_gi.core.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.settings import setting
from ..adjoint_gi.core.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.walks import Ends, walk
from ..adjoint_gi.core.world import Surface, World

SMALLEST, LARGEST = 1 << 10, 1 << 15  # particles in a batch
BATCHES = 32  # at least, where batches do not become too small: the standard error is estimated from their differences
FEW_BATCHES = 8  # where there are so many elements that summing over them takes longer than the walks
PER_ELEMENT = 250  # particles shot for each element that is made when the elements' size is chosen automatically
FEWEST, MOST = 500, 50_000  # elements chosen automatically


@dataclass(frozen=True)
class ParticleSettings(base.Settings):
    """Settings of particle tracing."""

    particles: int = setting(
        1_000_000,
        label="Particles",
        help="Particles shot from all lights together; four times as many halve the noise",
        min=1,
        max=2_000_000_000,
        soft_max=100_000_000,
    )
    max_edge: float = setting(
        0.0,
        label="Max Element Edge",
        help="Longest edge of the elements that collect particles; 0 chooses it by the number of particles",
        min=0.0,
        max=1e6,
        unit="distance",
    )


@dataclass(frozen=True, eq=False)
class _Batch:
    """What one batch of particles brought: power on element sides (2 ne, 3) float64 in W, power shot by each light (k, 3), ends."""

    count: int
    direct: np.ndarray
    indirect: np.ndarray
    lights: np.ndarray
    ends: Ends


@register
class ParticleTracing(Solver):
    """Shoots particles in batches and counts their power on element sides."""

    spec = MethodSpec(
        id="particle_tracing",
        number=11,
        label="Particle Tracing",
        strategies=(Strategy.SHOOTING,),
        natures=(Nature.NONDETERMINISTIC,),
        year=1992,
        authors="S. N. Pattanaik, S. P. Mudur",
        title="Computation of Global Illumination by Monte Carlo Simulation of the Particle Model of Light",
        equation="Phi = <W, Le> = E / n sum_i [ g(x_i0) + sum_k g(x_ik) ]  (15)",
        section="8",
        idea="Particles of equal power leave the lights, are absorbed or reflected at random, and are counted where they arrive.",
        limits=(
            "Diffuse surfaces only: other lobes are taken as diffuse",
            "Shadows are as sharp as the elements are small",
            "Noise is highest where few particles arrive, such as small and dark corners",
        ),
        lobes=frozenset({"diffuse", "emission"}),
        uses_elements=True,
    )
    Settings = ParticleSettings

    def memory(self, world: World, receivers: Receivers, settings: ParticleSettings) -> int:
        """Elements, their sums in float64, the batches under way and the receivers' points."""
        own = getattr(receivers, "elements", None)
        if own is not None:
            count = own.count
        elif settings.max_edge:
            count = world.triangle_count + int(2 * world.area.sum() / settings.max_edge**2)
        else:
            count = world.triangle_count + automatic(settings.particles)
        batches = 2 * thread_count()
        return count * (400 + 2 * 7 * 8 + batches * 2 * 6 * 8) + batches * LARGEST * 600 + receivers.count * 1500

    def solve(self, world: World, receivers: Receivers, settings: ParticleSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every batch; the fraction is particles done."""
        clock = _Clock()
        emission = Emission(world)
        elements = elements_for(world, receivers, settings.max_edge, automatic(settings.particles))
        answer = ElementAnswer(elements, receivers, None, settings.min_length, settings.max_length)
        tally = _Tally(elements, emission, settings)
        warnings = world.scene.warnings + world.shading.substitutions(self.spec.lobes) + notices(world, emission)

        def solution(partial: bool = True) -> Solution:
            parts = answer.parts(tally.irradiance(tally.direct), tally.irradiance(tally.indirect))
            return Solution(
                self.spec.id,
                receivers.measure,
                **{**parts.arrays(), "extra": {**parts.extra, "light_flux": tally.per_particle(tally.lights).astype(np.float32)}},
                rays=tally.ends.rays + parts.rays,
                seconds=clock.seconds,
                balance=tally.balance(),
                history=tuple(tally.history),
                warnings=warnings,
                settings=settings.as_dict(),
                partial=partial,
            )

        # Step 1: where the receivers lie on the elements.
        for share in answer.prepare():
            yield from clock.pause(Step(0.0, f"Finding receivers, {share:.0%}", solution))

        # Step 2: batches of particles, each with random numbers of its own.
        sizes = batch_sizes(0 if emission.is_dark else settings.particles, 2 * elements.count)
        seeds = rng.integers(0, 1 << 63, 4).tolist()

        def shoot(index: int) -> _Batch:
            generator = np.random.Generator(np.random.SFC64([*seeds, index]))
            return shoot_batch(world, elements, emission, sizes[index], settings, generator)

        with closing(in_order(shoot, range(len(sizes)))) as batches:
            for batch in batches:
                tally.add(batch)
                tally.history.append((clock.seconds, tally.relative_error()))
                if tally.count < settings.particles:
                    text = f"{tally.count:,} of {settings.particles:,} particles"
                    yield from clock.pause(Step(tally.count / settings.particles, text, solution))
        yield Step(1.0, f"{tally.count:,} particles", lambda: solution(False))


class _Clock:
    """Seconds of work, without the time in which nobody asked for the next step."""

    def __init__(self) -> None:
        self._began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Worked so far."""
        return time.perf_counter() - self._began

    def pause(self, step: Step) -> Iterator[Step]:
        """Yield `step` and leave out the time until the generator is continued."""
        left = time.perf_counter()
        yield step
        self._began += time.perf_counter() - left


class _Tally:
    """Sums over batches."""

    def __init__(self, elements: Elements, emission: Emission, settings: ParticleSettings) -> None:
        sides = 2 * elements.count
        self.area = np.repeat(elements.area, 2)
        self.count = 0
        self.batches = 0
        self.direct, self.indirect = np.zeros((sides, 3)), np.zeros((sides, 3))
        self.squares = np.zeros(sides)  # of the power that each batch brought, colours summed
        self.lights = np.zeros((len(emission.names), 3))
        self.ends = Ends()
        self.history: list[tuple[float, float]] = []

    def add(self, batch: _Batch) -> None:
        """A batch weighs as much as it has particles."""
        self.count += batch.count
        self.batches += 1
        for mine, other in ((self.direct, batch.direct), (self.indirect, batch.indirect), (self.lights, batch.lights)):
            mine += batch.count * other
        self.squares += (batch.count * (batch.direct + batch.indirect).sum(axis=1)) ** 2
        self.ends.add(batch.ends, batch.count)

    def per_particle(self, sums: np.ndarray) -> np.ndarray:
        """Mean over all particles so far."""
        return sums / max(1, self.count)

    def irradiance(self, sums: np.ndarray) -> np.ndarray:
        """(2 ne, 3) float64, W m-2."""
        return self.per_particle(sums) / np.maximum(self.area, 1e-300)[:, None]

    def relative_error(self) -> float:
        """Relative standard error of the elements' irradiance, root mean square by area, from the spread of the batches."""
        if self.batches < 2:
            return float("inf")
        total = (self.direct + self.indirect).sum(axis=1)
        weight = 1 / np.maximum(self.area, 1e-300)
        spread = np.maximum(self.squares - total**2 / self.batches, 0) * (self.batches / (self.batches - 1))
        power = weight @ total**2
        return float(np.sqrt((weight @ spread) / power)) if power > 0 else 0.0

    def balance(self) -> EnergyBalance:
        """Where the power went. With smooth shading the gap is what bent normals added, see `Ends`."""
        e, n = self.ends, max(1, self.count)
        energies = (e.emitted_energy, e.absorbed_energy, e.escaped_energy, e.cut_energy)
        return EnergyBalance(*(x / n for x in energies), (e.emitted, e.absorbed, e.escaped, e.cut))


def shoot_batch(
    world: World, elements: Elements, emission: Emission, count: int, settings: ParticleSettings, rng: np.random.Generator
) -> _Batch:
    """Draw `count` particles, follow them to their ends, and sum the power that arrives on every element side."""
    first: list[tuple[np.ndarray, np.ndarray]] = []
    later: list[tuple[np.ndarray, np.ndarray]] = []

    def visit(length: int, surface: Surface, arriving: np.ndarray) -> None:
        if length >= settings.min_length:
            side = elements.side(surface.triangle, surface.u, surface.v, surface.side)
            (first if length == 1 else later).append((side, arriving))

    particles = emission.draw(count, rng)
    ends = walk(world, particles, settings.max_length, rng, visit)
    lights = np.stack([np.bincount(particles.light, particles.weight[:, c], len(emission.names)) for c in range(3)], axis=1)
    sides = 2 * elements.count
    return _Batch(count, deposit(first, sides), deposit(later, sides), lights, ends)


def deposit(hits: list[tuple[np.ndarray, np.ndarray]], sides: int) -> np.ndarray:
    """(sides, 3) float64 sums of the weights of `hits`, pairs of element sides (n,) and weights (n, 3)."""
    out = np.zeros((sides, 3))
    if hits:
        side = np.concatenate([s for s, _ in hits])
        weight = np.concatenate([w for _, w in hits])
        for c in range(3):
            out[:, c] = np.bincount(side, weight[:, c], sides)
    return out


def automatic(particles: int) -> int:
    """Elements wanted for a number of particles, so that each gets some hundred hits."""
    return min(max(particles // PER_ELEMENT, FEWEST), MOST)


def batch_sizes(particles: int, sides: int) -> list[int]:
    """Particles of each batch; they differ by one at most. A batch has at least half as many as there are element sides."""
    if particles == 0:
        return []
    wanted = max(particles // BATCHES, min(sides // 2, particles // FEW_BATCHES))
    size = min(max(wanted, SMALLEST), LARGEST)
    many = -(-particles // size)
    return [particles // many + (i < particles % many) for i in range(many)]


def notices(world: World, emission: Emission) -> tuple[Notice, ...]:
    """What the user must know of the lights."""
    out = []
    if emission.is_dark:
        out.append(Notice("Scene", "nothing emits light, so the result is black", "Add a lamp, an emissive material or a background"))
    for light in world.scene.lights:
        if not light.shadow and any(light.color):
            out.append(Notice(light.name, "casts shadows in this method, as particles stop where they hit", "Choose a gathering method"))
    return tuple(out)
