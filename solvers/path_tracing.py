"""Path tracing (Kajiya 1986; review, section 6.2, Eq. 12): random walks on the radiance equation.

Gathering, nondeterministic. A path starts at a receiver, goes on in one direction drawn at each surface, and adds up the emission
it meets:

    <Lo(x)> = Le(x) + Le(x') + Le(x'') + ...                                                                          (12)

The mean over many paths is the solution. Kajiya asks for variance reduction by hierarchical and nonuniform sampling. Each kind has a
switch, so that its effect can be seen: directions drawn by the BRDF instead of evenly (`lobe_importance`), points drawn on the lights by
their power (`light_importance`), both joined by weights (`joined`; Veach and Guibas 1995), and even numbers over the first surfaces
(`stratified`). Paths end at random once they carry little (roulette), which keeps the mean.

Receivers of irradiance, and all surfaces of scenes that are diffuse alone, have cheaper vertices (`core.walks.diffuse_paths`) than surfaces
with other lobes (`core.walks.radiance`).

J. T. Kajiya, "The Rendering Equation", SIGGRAPH 1986, 143-150.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.errors import Notice
from ..adjoint_gi.core.base.parallel import thread_count
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES
from ..adjoint_gi.core.bsdf.table import BsdfTable
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import GATHERING, NONDETERMINISTIC, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks import unmet_lamps
from ..adjoint_gi.core.walks.diffuse_paths import USES, PathTracer
from ..adjoint_gi.core.walks.gathering import SAMPLES_PER_BATCH, Run, batches
from ..adjoint_gi.core.walks.paths import NEVER, Gathered, Paths, Walk, by_root, by_weight
from ..adjoint_gi.core.walks.radiance import start


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
        True,
        "Stratified",
        "Sobol numbers for the first surfaces of paths in diffuse scenes, in others for receivers. Off: independent numbers",
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
        batches = 2 * thread_count() * SAMPLES_PER_BATCH * (sum(USES) * 8 + 60 * 12)
        return receivers.count * 500 + world.triangle_count * 200 + batches

    def solve(self, world: World, receivers: Receivers, settings: PathSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield about ten times a second; the fraction is samples done."""
        emitters = Emitters(world)
        walk = walk_of(world, emitters, settings)
        told = notices(emitters, settings) + unmet_lamps.notices(
            emitters, settings.samples, measure=receivers.measure, longest=settings.max_length
        )
        run = Run(self.spec, world, receivers, settings, emitters, told)
        if settings.plain and (walk.table.only_diffuse or not run.is_camera):
            tracer = PathTracer(walk, receivers, trace, tuple(int(x) for x in rng.integers(0, 2**32, 4)))
            yield from run.sample_batches(tracer.batch, settings.samples, batches(receivers.count, settings.samples, even=True))
        else:

            def estimate(surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
                vertices, factor = start(walk, surface, wo)
                return trace(Paths(walk, vertices, rng)).times(factor)

            yield from run.random_samples(settings.samples, rng, estimate)


def trace(paths: Paths) -> Gathered:
    """Eq. 12: <Lo(x)> = Le(x) + Le(x') + Le(x'') + ..., for many paths side by side, until the last has ended.

    Le(x) of the receiver itself is added elsewhere. A path's weight is the product of fr cos / pdf over its vertices.
    """
    while paths.alive:
        # Le(y) of a point y on the lights, drawn by their power; it stands for Le(x') where the ray would meet a light.
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
        draw_lights=s.light_importance,
        meet_lights=s.joined or not s.light_importance,
        uniform=not s.lobe_importance,
        survival=by_root if table.only_diffuse and s.plain else by_weight,
    )


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
