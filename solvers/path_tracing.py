"""Path tracing (Kajiya 1986; review, section 6.2, Eq. 12): random walks on the radiance equation.

Gathering, nondeterministic. A path starts at a receiver, goes on in one direction drawn at each surface, and adds up the emission
it comes upon:

    <Lo(x)> = Le(x) + Le(x') + Le(x'') + ...                                                                          (12)

The mean over many paths is the solution. With Kajiya, the emission of the next surface is estimated by light points as well; the two
estimates are joined by multiple importance sampling (Veach and Guibas 1995). Paths end at random once they carry little (roulette).

J. T. Kajiya, "The Rendering Equation", SIGGRAPH 1986, 143-150.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core import settings as base
from ..adjoint_gi.core.errors import Notice
from ..adjoint_gi.core.film import Film, read_surfaces
from ..adjoint_gi.core.parallel import in_order, thread_count
from ..adjoint_gi.core.paths import DIMENSIONS, PathBatch, PathTracer, Walk
from ..adjoint_gi.core.receivers import Receivers
from ..adjoint_gi.core.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.settings import setting
from ..adjoint_gi.core.solution import Solution, Step
from ..adjoint_gi.core.world import World

BATCH = 1 << 14  # paths in a batch
MOST_SAMPLES = 16  # of one receiver in a batch
PAUSE = 0.1  # seconds between steps, about


@dataclass(frozen=True)
class PathSettings(base.Settings):
    """Settings of path tracing."""

    samples: int = setting(
        256,
        label="Samples",
        help="Paths from each texel, vertex or pixel; four times as many halve the noise. Powers of two are best",
        min=1,
        max=1 << 24,
        soft_max=4096,
    )
    roulette: bool = setting(True, label="Russian Roulette", help="End paths at random once they carry little; the result stays unbiased")
    roulette_length: int = setting(
        3,
        label="Roulette From",
        help="Path length from which paths may end at random; shorter paths never do",
        min=1,
        max=1024,
        soft_max=16,
    )


@register
class PathTracing(Solver):
    """Traces passes over all receivers, each with twice as many samples as the one before, up to a limit."""

    spec = MethodSpec(
        id="path_tracing",
        number=8,
        label="Path Tracing",
        strategies=(Strategy.GATHERING,),
        natures=(Nature.NONDETERMINISTIC,),
        year=1986,
        authors="J. T. Kajiya",
        title="The Rendering Equation",
        equation="<Lo(x)> = Le(x) + Le(x') + Le(x'') + ...  (12)",
        section="6.2",
        idea="A path takes one random direction at each surface and adds up the emission it meets; the mean of many is the solution.",
        limits=(
            "Diffuse surfaces only: other lobes are taken as diffuse",
            "Noise falls only with the square root of the time, and is highest where light arrives through small openings",
        ),
        lobes=frozenset({"diffuse", "emission"}),
    )
    Settings = PathSettings

    def memory(self, world: World, receivers: Receivers, settings: PathSettings) -> int:
        """Sums in float64, one copy of the result, the tables of the triangles, and the batches under way."""
        batches = 2 * thread_count() * BATCH * (DIMENSIONS * 8 + 60 * 12)
        return receivers.count * 500 + world.triangle_count * 200 + batches

    def solve(self, world: World, receivers: Receivers, settings: PathSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield about ten times a second; the fraction is samples done."""
        clock = Clock()
        seed = tuple(int(x) for x in rng.integers(0, 2**32, 4))
        walk = Walk(settings.min_length, settings.max_length, settings.roulette_length if settings.roulette else 0)
        tracer = PathTracer(world, receivers, walk, seed)
        film = Film(receivers)
        surfaces: dict[str, np.ndarray] = {}
        state = _State(self.spec.id, world, receivers, settings, film, surfaces, clock)
        state.warnings = world.scene.warnings + world.shading.substitutions(self.spec.lobes)

        # Step 1: passes over all receivers, in batches that run in any order of time but are added up in their own. What the receivers
        # are made of is read in between, so that light shows at once; camera samples find that out by themselves.
        reading = read_surfaces(world, receivers, surfaces)
        total = receivers.count * settings.samples
        paths = 0
        with closing(in_order(lambda item: tracer.batch(*item), batches(receivers.count, settings.samples))) as results:
            for batch in results:
                state.add(batch)
                paths += batch.samples * (batch.last - batch.first)
                if receivers.measure == "irradiance":
                    next(reading, None)
                if batch.last == receivers.count:
                    state.measure()
                if clock.due() and paths < total:
                    text = f"{paths / receivers.count:.0f} of {settings.samples} samples"
                    yield from clock.pause(Step(paths / total, text, state.solution))

        # Step 2: the rest of it, and for a camera the passes that only a finished picture gets.
        for done in reading:
            if clock.due():
                yield from clock.pause(Step(1.0, f"Reading surfaces, {done:.0%}", state.solution))
        state.partial = False
        yield Step(1.0, f"{settings.samples} samples", state.solution)


def batches(count: int, samples: int) -> Iterator[tuple[int, int, int, int]]:
    """(first receiver, last, samples, index of the first sample) of every batch, pass by pass; independent of the machine.

    Few receivers start with several samples at once, many with one, so that the first pass is quick and full.
    """
    size = 1
    while size < MOST_SAMPLES and count * size * 2 <= BATCH:
        size *= 2
    index = 0
    while index < samples:
        # Sample counts stay at powers of two until the limit, where Sobol points are most even.
        now = min(size if index == 0 else min(index, MOST_SAMPLES), samples - index)
        block = max(1, BATCH // now)
        for first in range(0, count, block):
            yield first, min(first + block, count), now, index
        index += now


class Clock:
    """Seconds of work, without the time in which nobody asked for the next step."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._last = self._began

    @property
    def seconds(self) -> float:
        """Worked so far."""
        return time.perf_counter() - self._began

    def due(self) -> bool:
        """Whether it is time for a step."""
        return time.perf_counter() - self._last >= PAUSE

    def pause(self, step: Step) -> Iterator[Step]:
        """Yield `step` and leave out the time until the generator is continued."""
        left = time.perf_counter()
        yield step
        self._last = time.perf_counter()
        self._began += self._last - left


class _State:
    """What a solution is made of at any moment."""

    def __init__(
        self,
        method: str,
        world: World,
        receivers: Receivers,
        settings: PathSettings,
        film: Film,
        surfaces: dict[str, np.ndarray],
        clock: Clock,
    ) -> None:
        self.method, self.world, self.receivers, self.settings = method, world, receivers, settings
        self.film, self.surfaces, self.clock = film, surfaces, clock
        self.rays = self.spoiled = 0
        self.history: list[tuple[float, float]] = []
        self.warnings: tuple[Notice, ...] = ()
        self.partial = True

    def add(self, batch: PathBatch) -> None:
        """Add a batch to the film."""
        part = slice(batch.first, batch.last)
        self.film.add(part, batch.samples, batch.direct, batch.indirect)
        if batch.emitted is not None:
            self.film.emitted[part] += batch.emitted
            self.film.albedo[part] += batch.albedo
        self.rays += batch.rays
        self.spoiled += batch.spoiled

    def measure(self) -> None:
        """Note the relative standard error after a pass."""
        error = self.film.relative_error()
        if error is not None:
            self.history.append((self.clock.seconds, error))

    def solution(self) -> Solution:
        """A copy of the result as it stands; reflectance and own emission of surfaces are 0 until they have been read."""
        film, surfaces, n = self.film, self.surfaces, self.receivers.count
        weight = (film.count > 0).astype(np.float32)
        extra = {}
        if self.receivers.kind == "camera":
            emitted, albedo = film.mean(film.emitted), film.mean(film.albedo)
            extra = {k: surfaces[k] for k in ("normal", "depth") if k in surfaces}
        elif surfaces:
            albedo, emitted = surfaces["albedo"], surfaces["emission"] * np.float32(np.pi)
            if self.settings.min_length > 0:
                emitted = np.zeros_like(emitted)
            weight = weight * (surfaces["weight"] > 0)
        else:
            emitted = albedo = np.zeros((n, 3), np.float32)
        warnings = self.warnings
        if self.spoiled:
            text = f"{self.spoiled} samples were not numbers and count as 0"
            warnings = (*warnings, Notice("", text, "Look for extreme values in lights and materials"))
        return Solution(
            self.method,
            self.receivers.measure,
            emitted,
            film.mean(film.direct),
            film.mean(film.indirect),
            albedo,
            weight,
            rays=self.rays,
            seconds=self.clock.seconds,
            history=tuple(self.history),
            warnings=warnings,
            settings=self.settings.as_dict(),
            partial=self.partial,
            extra=extra,
        )
