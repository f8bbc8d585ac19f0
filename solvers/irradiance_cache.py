"""Irradiance caching (Ward, Rubinstein and Clear 1988; review, section 6.1): distribution ray tracing that remembers.

Gathering, nondeterministic. On diffuse surfaces the interreflected part of Eq. 5 (the review says 9) is reflectance times irradiance,

    int fr Lr cos dw = fd int Lr cos dw = fd * irradiance,

and the irradiance changes slowly. It is computed by stratified rays at a few points only and interpolated in between; the accuracy
setting says how far a value may be used. Direct light is computed at every point. Gradients: G. Ward and P. Heckbert 1992.

G. J. Ward, F. M. Rubinstein, R. D. Clear, "A Ray Tracing Solution for Diffuse Interreflection", SIGGRAPH 1988, 85-92.
G. Ward, P. Heckbert, "Irradiance Gradients", Eurographics Workshop on Rendering 1992, 85-98.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.parallel import in_order
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import DIFFUSE_LOBES
from ..adjoint_gi.core.bsdf.table import BsdfTable
from ..adjoint_gi.core.lights.direct import halved_irradiance
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import GATHERING, NONDETERMINISTIC, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.sampling.maps import frame_rows
from ..adjoint_gi.core.scene.arrays import RayKind
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks import unmet_lamps
from ..adjoint_gi.core.walks.gathering import Run, sliced
from ..adjoint_gi.core.walks.irradiance_records import RecordIndex, Records, gradients, halves, hemisphere
from ..adjoint_gi.core.walks.paths import Gathered, Walk
from ..adjoint_gi.core.walks.radiance import gather, lobes_of

RECORDS_PER_BLOCK = 64  # records made together
RECORDS_PER_ROUND = 512  # records made before the cache is asked again
POINTS_PER_PIECE = 1 << 13  # receiver points that ask it at once


@dataclass(frozen=True)
class CacheSettings(base.Settings):
    """Settings of irradiance caching."""

    accuracy: float = setting(
        0.25,
        "Accuracy",
        "Largest error a cached value may have where it is used; the error falls with it",
        min=0.001,
        max=2.0,
        soft_max=0.5,
    )
    rays: int = setting(512, "Rays", "Rays over the hemisphere of each cached value", min=16, max=65536, soft_max=4096)
    gradients: bool = setting(True, "Gradients", "Extrapolate each value by its rotation and translation gradients (Ward and Heckbert)")
    light_samples: int = common.light_samples(8, "Light points for direct light at each point, two at least: their noise is measured")
    min_spacing: float = setting(
        0.01, "Min Spacing", "Smallest radius of a cached value, as a share of the scene's size", min=1e-6, max=1.0, soft_max=0.1
    )


@register
class IrradianceCache(Solver):
    """First fills the cache for all receiver points, coarse to fine, then reads it."""

    spec = MethodSpec(
        id="irradiance_cache",
        number=7,
        label="Irradiance Caching",
        strategies=GATHERING,
        natures=NONDETERMINISTIC,
        year=1988,
        authors="G. J. Ward, F. M. Rubinstein, R. D. Clear",
        title="A Ray Tracing Solution for Diffuse Interreflection",
        equation="int fr Lr cos dw = fd * irradiance, interpolated between cached points",
        section="6.1",
        idea="Indirect irradiance is computed at a few points, as far apart as their surroundings allow, and interpolated between them.",
        lobes=DIFFUSE_LOBES,
        limits=lines("""
            Receivers are diffuse: other lobes there are taken as diffuse; paths beyond them see all lobes
            Interpolation leaves smooth blotches where rays are few; they fall with Accuracy and Rays together
        """),
        allowance=0.02,
    )
    Settings = CacheSettings

    def memory(self, world: World, receivers: Receivers, settings: CacheSettings) -> int:
        """The receivers' points, and the rays of one round of records."""
        return receivers.count * 600 + RECORDS_PER_ROUND * settings.rays * 400

    def solve(self, world: World, receivers: Receivers, settings: CacheSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every round of records, then as the receivers are read."""
        emitters = Emitters(world)
        rare = unmet_lamps.notices(emitters, settings.rays, measure=receivers.measure, longest=settings.max_length)
        run = Run(self.spec, world, receivers, settings, emitters, rare)
        walk = Walk(world, emitters, BsdfTable(world.scene), settings.min_length, settings.max_length)
        seed = rng.integers(0, 1 << 63, 4).tolist()
        state = CacheRun(world, settings, walk, seed)

        # Step 1: fill the cache with the irradiance at some points. Every 64th first, so that records spread out before they fill in.
        if settings.max_length >= 2:
            done = 0.0
            for stride, start in ((64, 0), (8, 4), (1, 0)):
                for share in state.cover(receivers, stride, start, run):
                    if run.clock.due():
                        text = f"{len(state.records.radius):,} cached values, pass of every {stride}"
                        yield from run.clock.pause(Step(0.8 * (done + (1 / stride - done) * share), text, run.solution))
                done = 1 / stride

        run.indirect_tail = state.tail / max(state.seen, 1e-300)

        # Step 2: fd * irradiance at every receiver. The index does not change any more, so threads may share it.
        def estimate(surface: Surface, wo: np.ndarray | None, generator: np.random.Generator) -> Gathered:
            direct, noise, rays = state.direct(surface, generator)
            indirect, spread = state.indirect(surface)
            found = Gathered(direct, indirect, rays, noise + spread)
            return found if wo is None else found.times(world.albedo(surface) / np.float32(np.pi))

        for step in run.fixed_points(estimate, seed=seed):
            yield Step(0.8 + 0.2 * step.fraction, step.text, step.solution)


class CacheRun:
    """The cache while it grows; only the thread that drives the solver changes it."""

    def __init__(self, world: World, settings: CacheSettings, walk: Walk, seed: list[int]) -> None:
        self.world, self.settings, self.walk, self.seed = world, settings, walk, seed
        self.rows = max(4, round((settings.rays / np.pi) ** 0.5))
        self.cols = max(4, round(settings.rays / self.rows))
        self.records = Records.empty()
        self.seen, self.tail = 0.0, np.zeros(2)  # radiance that records have seen, summed, and of it that in the blocks of `path_limit`
        self.index = RecordIndex(self.records, settings.accuracy, 1.01 * world.size)

    def direct(self, surface: Surface, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int]:
        """(n, 3) irradiance straight from the lights, which is not cached, half of what its two halves differ by, and the rays cast."""
        s = self.settings
        if not s.min_length <= 1 <= s.max_length:
            nothing = np.zeros((len(surface.triangle), 3), np.float32)
            return nothing, nothing, 0
        return halved_irradiance(self.world, self.walk.emitters, surface, max(2, s.light_samples), rng)

    def indirect(self, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) int Lr cos dw, interpolated, and its spread."""
        if self.settings.max_length < 2:
            nothing = np.zeros((len(surface.triangle), 3), np.float32)
            return nothing, nothing
        return self.index.irradiance(surface.position, surface.ns, self.settings.gradients)[:2]

    def cover(self, receivers: Receivers, stride: int, start: int, run: Run) -> Iterator[float]:
        """Make records until every `stride`-th receiver point has one; yields the share done, which never falls."""
        share = 0.0
        for points in sliced(receivers.sites(), POINTS_PER_PIECE):
            at = np.flatnonzero(points.triangle >= 0)[start::stride]
            towards = None if points.towards is None else points.towards[at]
            surface = self.world.surface(points.triangle[at], points.u[at], points.v[at], towards)
            while True:
                bare = np.flatnonzero(~self.index.covered(surface.position, surface.ns))
                if not len(bare):
                    break
                # Points that lie far apart in the receivers' order, so that one round does not crowd one place.
                pick = bare[:: max(1, len(bare) // RECORDS_PER_ROUND)][:RECORDS_PER_ROUND]
                for _ in self._add(surface, pick, run):
                    yield share
            share = max(share, (int(points.receiver.max()) + 1) / receivers.count)
            yield share

    def _add(self, surface: Surface, pick: np.ndarray, run: Run) -> Iterator[None]:
        blocks = [pick[a : a + RECORDS_PER_BLOCK] for a in range(0, len(pick), RECORDS_PER_BLOCK)]
        first = len(self.records.radius)

        def make(item: tuple[int, np.ndarray]) -> tuple[Records, int, np.ndarray]:
            index, block = item
            generator = np.random.Generator(np.random.SFC64([*self.seed, first + index * RECORDS_PER_BLOCK]))
            return self._make(surface.take(block), generator)

        for records, rays, tail in in_order(make, enumerate(blocks)):
            self.records = self.records.joined(records)
            run.rays += rays
            self.tail += tail
            self.seen += float(records.irradiance.sum(dtype=np.float64)) / np.pi * self.rows * self.cols
            yield
        self.index = RecordIndex(self.records, self.settings.accuracy, 1.01 * self.world.size)

    def _make(self, surface: Surface, rng: np.random.Generator) -> tuple[Records, int, np.ndarray]:
        """Records at some points, the rays cast for them, and the tail (2,) of the radiance that these see."""
        s, size = self.settings, self.world.extent
        x, y = frame_rows(surface.ns)
        local, _ = hemisphere(self.rows, self.cols, rng, len(x))
        radiance, distance, rays, tail = self._look(surface, local, x, y, rng)
        # int Lr cos dw: directions are drawn by the cosine, so it is pi times the mean. It holds as far as the harmonic mean distance.
        irradiance, spread = radiance.mean(axis=(1, 2)) * np.float32(np.pi), halves(radiance) * np.float32(np.pi)
        radius = 1 / (1 / distance).mean(axis=(1, 2))
        rotation, translation = gradients(radiance, distance, local, x, y)
        if s.gradients:
            # Nothing may be extrapolated to below zero within its reach.
            slope = np.sqrt((translation.sum(axis=1) ** 2).sum(axis=1))
            within = irradiance.sum(axis=1) / np.maximum(slope, np.float32(1e-20))
            radius = np.where(slope > 0, np.minimum(radius, within), radius)  # where all is dark, nothing falls
        bound = radius
        radius = np.clip(radius, s.min_spacing * size / s.accuracy, 2 * size).astype(np.float32)
        # Where the least spacing makes records reach further than that, they are extrapolated less.
        translation = translation * np.minimum(1, bound / radius)[:, None, None].astype(np.float32)
        return Records(surface.position, surface.ns, irradiance.astype(np.float32), spread, radius, rotation, translation), rays, tail

    def _look(
        self, surface: Surface, local: np.ndarray, x: np.ndarray, y: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        """What points see along directions `local` (n, rows, cols, 3) of their frames: reflected radiance (n, rows, cols, 3) by a random
        walk, distance (n, rows, cols), the rays cast, and the tail (2,) of the radiance."""
        world, shape = self.world, local.shape[:3]
        d = local[..., :1] * x[:, None, None] + local[..., 1:2] * y[:, None, None] + local[..., 2:] * surface.ns[:, None, None]
        direction = np.ascontiguousarray(d.reshape(-1, 3), np.float32)
        many = self.rows * self.cols
        origin = np.repeat(world.leave(surface), many, axis=0)
        # Rays below the geometric surface bring nothing.
        up = np.einsum("ij,ij->i", direction, np.repeat(surface.ng, many, axis=0)) > 0
        triangle, u, v, t = met = world.intersect(origin, direction, RayKind.DIFFUSE)
        weight, passed = np.ones((3, len(direction)), np.float32), 0
        if world.passing is not None:
            triangle, u, v, t = met = tuple(np.array(a) for a in met)
            passed = sum(len(rows) for rows, _ in world.pass_on(origin, direction, RayKind.DIFFUSE, met, weight, rng))
        hit = np.flatnonzero((triangle >= 0) & up)
        there = world.surface(triangle[hit], u[hit], v[hit], -direction[hit])
        found = gather(self.walk, there, lobes_of(self.walk, there, -direction[hit]), rng, first_length=2)
        radiance, distance = np.zeros((len(direction), 3), np.float32), np.full(len(direction), 4 * world.extent, np.float32)
        radiance[hit] = found.indirect * weight.T[hit]
        distance[hit] = np.maximum(t[hit], np.float32(1e-6 * world.extent))
        tail = np.zeros(2) if found.tail is None else found.tail.sum(axis=1, dtype=np.float64)
        return radiance.reshape(*shape, 3), distance.reshape(shape), len(direction) + passed + found.rays, tail
