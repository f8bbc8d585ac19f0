"""Distribution ray tracing (Cook, Porter and Carpenter 1984; Cook 1986; review, section 6.1).

Gathering, nondeterministic. Recursive ray tracing whose rays are distributed. The integral of Eq. 5 is estimated in two stages,

    Lo = Le + 1/n sum fr Le cos theta / p_light  +  1/m sum fr Lr cos theta / p_brdf                                  (5)

(i) n rays towards points of the lights, drawn by what the lights emit: soft shadows; (ii) m rays drawn by the BRDF, whose radiance
is found in the same way: gloss, translucency and interreflection. Rays also start from points of the camera's lens: depth of field.
The numbers behind all of them are jittered or from a low-discrepancy sequence, for every pixel and every use together.

With `joined`, BRDF rays count emission that they meet too, and the two stages weigh each other (Veach and Guibas 1995).

R. L. Cook, T. Porter, L. Carpenter, "Distributed Ray Tracing", SIGGRAPH 1984, 137-145.
R. L. Cook, "Stochastic Sampling in Computer Graphics", ACM TOG 5(1), 1986, 51-72.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.parallel import thread_count
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf import table as bsdf
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import GATHERING, NONDETERMINISTIC, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Points, Receivers
from ..adjoint_gi.core.sampling.sets import SAMPLERS, Sampler
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks import unmet_lamps
from ..adjoint_gi.core.walks.gathering import SAMPLES_PER_BATCH, Estimate, Run
from ..adjoint_gi.core.walks.paths import NEVER, Gathered, Paths, Walk, follow
from ..adjoint_gi.core.walks.radiance import LobeVertices, start

PLACE, LENS, FIRST_SURFACE = 0, 1, 2  # streams of the sampler; from FIRST_SURFACE on two for every surface on the way


@dataclass(frozen=True)
class DistributionSettings(base.Settings):
    """Settings of distribution ray tracing."""

    samples: int = common.samples(
        16, "Primary rays of each pixel, or points of each texel; squares and powers of two are best", max=1 << 20, soft_max=1024
    )
    light_samples: int = common.light_samples(4, "Rays towards the lights from each surface that splits")
    brdf_samples: int = setting(4, "BRDF Samples", "Reflected rays from each surface that splits", min=1, max=4096, soft_max=64)
    split_depth: int = setting(
        1,
        "Split Depth",
        "Surfaces from the receiver on that send as many rays as set; each multiplies the number of rays. Later ones send one of each",
        min=0,
        max=4,
    )
    sampling: str = setting("jittered", "Sampling", "Where the random numbers come from", choices=SAMPLERS)
    joined: bool = setting(
        True,
        "Join Light and BRDF Rays",
        "BRDF rays count lights they meet, weighted against the light rays: less noise in gloss. Off: the two stages of the paper",
    )
    roulette: bool = common.roulette("weak rays at random beyond the surfaces that split")
    depth_of_field: bool = setting(True, "Depth of Field", "Start rays from the lens of the camera where it has one")


@register
class Distribution(Solver):
    """Splits rays at the first surfaces and follows single ones from there."""

    spec = MethodSpec(
        id="distribution",
        number=6,
        label="Distribution Ray Tracing",
        strategies=GATHERING,
        natures=NONDETERMINISTIC,
        year=1984,
        authors="R. L. Cook, T. Porter, L. Carpenter",
        title="Distributed Ray Tracing",
        equation="Lo = Le + 1/n sum fr Le cos theta / p_light + 1/m sum fr Lr cos theta / p_brdf  (5)",
        section="6.1",
        idea="Recursive ray tracing with bundles of rays: over the lights, over the BRDF and over the lens.",
        lobes=ALL_LOBES,
        limits=lines("""
            The number of rays grows with the power of the split depth
            Noise falls only with the square root of the time where the numbers are independent
            Caustics of small lights are noisy: only BRDF rays find them
            Depth of field has a round aperture; motion blur is not computed
        """),
    )
    Settings = DistributionSettings

    def memory(self, world: World, receivers: Receivers, settings: DistributionSettings) -> int:
        """Sums in float64, one copy of the result, and the rays of every thread."""
        slots = bsdf.BsdfTable(world.scene).count
        ray = 300 + 60 * slots
        return receivers.count * 500 + thread_count() * SAMPLES_PER_BATCH * ray * (2 + settings.split_depth)

    def solve(self, world: World, receivers: Receivers, settings: DistributionSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every few batches of samples."""
        emitters = Emitters(world)
        paths = settings.samples * settings.brdf_samples**settings.split_depth
        rare = unmet_lamps.notices(emitters, paths, measure=receivers.measure, longest=settings.max_length)
        run = Run(self.spec, world, receivers, settings, emitters, rare)
        tracer = DistributionTracer(world, emitters, receivers, settings, int(rng.integers(0, 1 << 32)))
        # Lo = Le + light points + BRDF rays (Eq. 5), at the points of every sample.
        yield from run.random_samples(settings.samples, rng, place=tracer.place, batch=tracer.batch)


@dataclass(frozen=True, eq=False)
class Rows:
    """Which sample each row belongs to: receiver (n,) and number (n,) in its set of `total` at this depth."""

    receiver: np.ndarray
    number: np.ndarray
    total: int

    def split(self, many: int, j: int) -> Rows:
        """The j-th of `many` rays of every row."""
        return Rows(self.receiver, self.number * many + j, self.total * many)

    def take(self, which: np.ndarray) -> Rows:
        """Some of the rows."""
        return Rows(self.receiver[which], self.number[which], self.total)


class DistributionTracer:
    """The two stages, in a world."""

    def __init__(self, world: World, emitters: Emitters, receivers: Receivers, settings: DistributionSettings, seed: int) -> None:
        self.receivers, self.settings = receivers, settings
        self.sampler = Sampler(settings.sampling, seed)
        self.table = bsdf.BsdfTable(world.scene)
        roulette = 1 + settings.split_depth if settings.roulette else NEVER
        lengths = (settings.min_length, settings.max_length)
        self.walk = Walk(world, emitters, self.table, *lengths, max(2, roulette), meet_lights=settings.joined)
        # Rays that each sample may cost, about six on each path after the surfaces that split: batches take about the same time.
        s = settings
        rays = 6 * s.brdf_samples**s.split_depth
        rays += sum(s.brdf_samples**d * (s.light_samples + s.brdf_samples) for d in range(s.split_depth))
        self.batch = max(256, min(SAMPLES_PER_BATCH, (1 << 16) // rays))

    def place(self, owner: np.ndarray, number: np.ndarray, rng: np.random.Generator) -> tuple[Points, Callable]:
        """Points of samples `number` (n,) of receivers `owner` (n,), and what gives the estimate at those rows of them."""
        s, rows = self.settings, Rows(owner, number, self.settings.samples)
        options = {}
        if self.receivers.takes_uniform:
            options["uniform"] = self._draw(PLACE, rows, 2, rng)
        if self.receivers.kind == "camera" and s.depth_of_field and self.receivers.camera.aperture_radius > 0:
            options["lens"] = self._draw(LENS, rows, 2, rng)
        points = self.receivers.sample(owner, rng, **options)

        def bind(on: np.ndarray) -> Estimate:
            return lambda surface, wo, rng: self._estimate(surface, wo, rows.take(on), rng)

        return points, bind

    def _estimate(self, surface: Surface, wo: np.ndarray | None, rows: Rows, rng: np.random.Generator) -> Gathered:
        if self.settings.max_length < 1:
            nothing = np.zeros((len(surface.triangle), 3), np.float32)
            return Gathered(nothing, nothing, 0)
        vertices, factor = start(self.walk, surface, wo)
        return self.trace(vertices, rows, 1, rng).times(factor)

    def trace(self, vertices: LobeVertices, rows: Rows, length: int, rng: np.random.Generator) -> Gathered:
        """Eq. 5 at `vertices`, Le left out; `length` is the path length of light that reaches them directly.

        Beyond the surfaces that split, n = m = 1.
        """
        s = self.settings
        if length > s.split_depth:
            return follow(Paths(self.walk, vertices, rng, length))
        stream = FIRST_SURFACE + 2 * (length - 1)
        # (i) The source term: 1/n sum fr Le cos theta / p_light, over rays distributed over the emission of the lights.
        lights = Paths(self.walk, vertices, rng, length, np.float32(1 / s.light_samples))
        for j in range(s.light_samples):
            lights.light_points(self._draw(stream, rows.split(s.light_samples, j), 3, rng))
        total = lights.gathered()
        # (ii) The interreflection term: 1/m sum fr Lr cos theta / p_brdf, over rays distributed by the BRDF.
        for j in range(s.brdf_samples):
            mine = rows.split(s.brdf_samples, j)
            paths = Paths(self.walk, vertices, rng, length, np.float32(1 / s.brdf_samples))
            if paths.scatter(self._draw(stream + 1, mine, 4, rng)):
                paths.emission_met()
                paths.arrive()
                if paths.alive:
                    paths.collect_from(self.trace(paths.vertices, mine.take(paths.row), length + 1, rng))
            total = total.plus(paths.gathered())
        return total

    def _draw(self, stream: int, rows: Rows, dimensions: int, rng: np.random.Generator) -> np.ndarray:
        return self.sampler.draw(stream, rows.total, rows.receiver, rows.number, dimensions, rng)
