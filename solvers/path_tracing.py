"""Path tracing (Kajiya 1986; review, section 6.2, Eq. 12): random walks on the radiance equation.

Gathering, nondeterministic. A path starts at a receiver, goes on in one direction drawn at each surface, and adds up the emission
it comes upon:

    <Lo(x)> = Le(x) + Le(x') + Le(x'') + ...                                                                          (12)

The mean over many paths is the solution. Kajiya asks for variance reduction by hierarchical and nonuniform sampling. Each kind has a
switch, so that its effect can be seen: directions drawn by the BRDF instead of evenly (`lobe_importance`), points drawn on the lights by
their power (`light_importance`), both joined by weights (`joined`; Veach and Guibas 1995), and even numbers over the first surfaces
(`stratified`). Paths end at random once they carry little (roulette), which keeps the mean.

Scenes of diffuse surfaces alone have cheaper vertices (`core.walks.diffuse_paths`) than scenes with other lobes (`core.walks.radiance`).

J. T. Kajiya, "The Rendering Equation", SIGGRAPH 1986, 143-150.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.parallel import in_order, thread_count
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES
from ..adjoint_gi.core.bsdf.table import BsdfTable
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import GATHERING, NONDETERMINISTIC, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.receivers.film import read_surfaces
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks.diffuse_paths import DIMENSIONS, PathTracer
from ..adjoint_gi.core.walks.gathering import Run
from ..adjoint_gi.core.walks.paths import NEVER, Gathered, Paths, Walk, by_root, by_weight
from ..adjoint_gi.core.walks.radiance import lobes_of, paths_from, white

BATCH = 1 << 14  # paths in a batch
MOST_SAMPLES = 16  # of one receiver in a batch


@dataclass(frozen=True)
class PathSettings(base.Settings):
    """Settings of path tracing."""

    samples: int = common.samples(256, "Paths from each texel, vertex or pixel; four times as many halve the noise. Powers of two are best")
    roulette: bool = common.roulette("paths at random once they carry little")
    roulette_length: int = setting(
        3, "Roulette From", "Path length from which paths may end at random; shorter paths never do", min=1, max=1024, soft_max=16
    )
    light_importance: bool = setting(
        True, "Importance over Lights", "Draw points on the lights by their power. Off: paths meet lights by chance"
    )
    lobe_importance: bool = setting(True, "Importance over Lobes", "Draw directions by the BRDF. Off: evenly over all")
    joined: bool = setting(
        True, "Join Both", "Weigh light points against lights that paths meet. Off: light points alone, where they are on"
    )
    stratified: bool = setting(
        True, "Stratified", "Sobol numbers for the first surfaces of paths in diffuse scenes. Off: independent numbers"
    )

    @property
    def plain(self) -> bool:
        """Whether every variance reduction is on, as the fast kernel has it."""
        return self.light_importance and self.lobe_importance and self.joined and self.stratified


@register
class PathTracing(Solver):
    """Traces passes over all receivers, each with twice as many samples as the one before, up to a limit."""

    spec = MethodSpec(
        id="path_tracing",
        number=8,
        label="Path Tracing",
        strategies=GATHERING,
        natures=NONDETERMINISTIC,
        year=1986,
        authors="J. T. Kajiya",
        title="The Rendering Equation",
        equation="<Lo(x)> = Le(x) + Le(x') + Le(x'') + ...  (12)",
        section="6.2",
        idea="A path takes one random direction at each surface and adds up the emission it meets; the mean of many is the solution.",
        lobes=ALL_LOBES,
        limits=lines("""
            Caustics of small lights are noisy: only paths that meet the light find them
            Noise falls only with the square root of the time, and is highest where light arrives through small openings
        """),
    )
    Settings = PathSettings

    def memory(self, world: World, receivers: Receivers, settings: PathSettings) -> int:
        """Sums in float64, one copy of the result, the tables of the triangles, and the batches under way."""
        batches = 2 * thread_count() * BATCH * (DIMENSIONS * 8 + 60 * 12)
        return receivers.count * 500 + world.triangle_count * 200 + batches

    def solve(self, world: World, receivers: Receivers, settings: PathSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield about ten times a second; the fraction is samples done."""
        emitters = Emitters(world)
        walk = walk_of(world, emitters, settings)
        run = Run(self.spec, world, receivers, settings, emitters, notices(emitters, settings))
        if walk.table.only_diffuse and settings.plain:
            yield from diffuse_steps(run, walk, settings, rng)
        else:
            yield from run.steps(lambda *at: estimate(walk, *at), settings.samples, rng)


def trace(paths: Paths) -> Gathered:
    """Eq. 12: <Lo(x)> = Le(x) + Le(x') + Le(x'') + ..., for many paths side by side, until the last has ended.

    Le(x) of the receiver itself is added elsewhere. A path's weight is the product of fr cos / pdf over its vertices.
    """
    while paths.alive:
        # Le(x') of a point x' on the lights, drawn by their power.
        paths.light_points()
        # A direction drawn by the BRDF at x; the weight takes fr cos / pdf.
        if not paths.scatter():
            break
        # Le(x') where the ray arrives, weighted against the light point.
        paths.emission_met()
        # x' is the next x. Weak paths end at random.
        paths.arrive()
    return paths.gathered()


def walk_of(world: World, emitters: Emitters, settings: PathSettings) -> Walk:
    """The walk with or without each variance reduction."""
    s, table = settings, BsdfTable(world.scene)
    return Walk(
        world,
        emitters,
        table,
        s.min_length,
        s.max_length,
        s.roulette_length if s.roulette else NEVER,
        lights=s.light_importance,
        lobes=s.joined or not s.light_importance,
        uniform=not s.lobe_importance,
        survival=by_root if table.only_diffuse and s.plain else by_weight,
    )


def estimate(walk: Walk, surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
    """One path from each surface point: radiance towards `wo`, or irradiance where it is None."""
    if wo is not None:
        return trace(paths_from(walk, surface, lobes_of(walk, surface, wo), rng))
    return trace(paths_from(walk, surface, white(walk, surface), rng)).times(np.float32(np.pi))


def diffuse_steps(run: Run, walk: Walk, settings: PathSettings, rng: np.random.Generator) -> Iterator[Step]:
    """The fast kernel for diffuse surfaces, with all variance reduction."""
    world, receivers, film, clock = run.world, run.receivers, run.film, run.clock
    tracer = PathTracer(walk, receivers, trace, tuple(int(x) for x in rng.integers(0, 2**32, 4)))

    # Step 1: passes over all receivers, in batches that run in any order of time but are added up in their own. What the receivers
    # are made of is read in between, so that light shows at once; camera samples find that out by themselves.
    reading = read_surfaces(world, receivers, run.surfaces)
    total = receivers.count * settings.samples
    paths = spoiled = 0
    warnings = run.warnings
    with closing(in_order(lambda item: tracer.batch(*item), batches(receivers.count, settings.samples))) as results:
        for batch in results:
            part = slice(batch.first, batch.last)
            film.add(part, batch.samples, batch.direct, batch.indirect)
            if batch.emitted is not None:
                film.emitted[part] += batch.emitted
                film.albedo[part] += batch.albedo
            run.rays += batch.rays
            if batch.spoiled:
                spoiled += batch.spoiled
                text = f"{spoiled} samples were not numbers and count as 0"
                run.warnings = (*warnings, Notice("", text, "Look for extreme values in lights and materials"))
            paths += batch.samples * (batch.last - batch.first)
            if receivers.measure == "irradiance":
                next(reading, None)
            if batch.last == receivers.count:
                run.measure()
            if clock.due() and paths < total:
                text = f"{paths / receivers.count:.0f} of {settings.samples} samples"
                yield from clock.pause(Step(paths / total, text, run.solution))

    # Step 2: the rest of it, and for a camera the passes that only a finished picture gets.
    for done in reading:
        if clock.due():
            yield from clock.pause(Step(1.0, f"Reading surfaces, {done:.0%}", run.solution))
    run.partial = False
    yield from clock.last(Step(1.0, f"{settings.samples} samples", run.solution))


def notices(emitters: Emitters, settings: PathSettings) -> tuple[Notice, ...]:
    """Lamps that no path can meet, where light points are off."""
    if settings.light_importance:
        return ()
    names = [
        x.name
        for x, sized, power in zip(emitters.world.scene.lights, emitters.lamps.sized, emitters.lamps.importance, strict=True)
        if power and not sized
    ]
    return tuple(Notice(n, "has no size, so no path meets it", "Turn on Importance over Lights, or give it a size") for n in names)


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
