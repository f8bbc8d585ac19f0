"""What gathering methods share: go over all receivers in batches, estimate what arrives or leaves there, and add it up.

A method gives `estimate(surface, wo, rng) -> Gathered`: the radiance that surface points send towards `wo` (n, 3), or, where
`wo` is None, the irradiance on the points. Everything else - emission, background and lamps that a camera sees, albedo, normals,
partial results, error history - is the same for all and done here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, fields

import numpy as np

from ..base.errors import Notice
from ..base.parallel import in_order
from ..base.settings import Settings
from ..lights.emitters import Emitters
from ..method import noise
from ..method.clock import Clock
from ..method.registry import MethodSpec
from ..method.solution import EnergyBalance, Solution, Step
from ..receivers.base import Points, Receivers
from ..receivers.film import Film, read_surfaces
from ..scene.world import Surface, World
from . import path_limit
from .paths import Gathered
from .sight import SightLayer, see

SAMPLES_PER_BATCH = 1 << 14  # samples in a batch
MOST_SAMPLES = 16  # of one receiver in a batch

Estimate = Callable[[Surface, np.ndarray | None, np.random.Generator], Gathered]
# Draws the points of samples (receiver (n,), number of the sample (n,)) and gives the estimate of the surfaces of those rows (m,) of them.
Place = Callable[[np.ndarray, np.ndarray, np.random.Generator], tuple[Points, Callable[[np.ndarray], Estimate]]]


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the samples of receivers `first` to `last`, each (m, 3); emitted and albedo only of camera receivers.

    samples: of each receiver, one number or (m,). spoiled: how many were not numbers and count as 0. spread (m, 3): of one half of the
    random numbers less both, where it is known. tail (2,): of all of them in the blocks of `path_limit`.
    """

    first: int
    last: int
    samples: int | np.ndarray
    direct: np.ndarray
    indirect: np.ndarray
    emitted: np.ndarray | None
    albedo: np.ndarray | None
    rays: int
    spoiled: int = 0
    spread: np.ndarray | None = None
    tail: np.ndarray | None = None


# Makes the sums of (first receiver, last, samples, index of the first sample).
Work = Callable[[tuple[int, int, int, int]], Sums]


@dataclass
class Run:
    """One solve of a gathering method: what it is about, its clock, and what it has found so far."""

    spec: MethodSpec
    world: World
    receivers: Receivers
    settings: Settings
    emitters: Emitters
    warnings: tuple[Notice, ...] = ()
    rays: int = 0
    partial: bool = True
    balance: EnergyBalance | None = None

    def __post_init__(self) -> None:
        self.clock = Clock()
        self.film = Film(self.receivers)
        self.surfaces: dict[str, np.ndarray] = {}
        self._spoiled = 0
        self.tail = np.zeros(2)  # of the sums of direct and indirect light, that in the blocks of `path_limit`
        self.indirect_tail = np.zeros(2)  # the same as shares of indirect light, for methods that know only these
        self.left_out: float | None = None  # by methods that know it otherwise
        self.extra: dict[str, np.ndarray] = {}
        self.warnings = self.world.scene.warnings + self.world.shading.substitutions(self.spec.lobes) + self.warnings

    @property
    def is_camera(self) -> bool:
        """Whether radiance is wanted, not irradiance."""
        return self.receivers.measure == "radiance"

    def random_samples(
        self,
        samples: int,
        rng: np.random.Generator,
        estimate: Estimate | None = None,
        *,
        place: Place | None = None,
        batch: int = SAMPLES_PER_BATCH,
    ) -> Iterator[Step]:
        """Random samples of every receiver, pass by pass, with a generator for each batch of `batch` samples, then the finished result.

        Either `estimate` is given, or `place` by methods that choose the random numbers of every sample themselves.
        """
        seed = rng.integers(0, 1 << 63, 4).tolist()

        def work(item: tuple[int, int, int, int]) -> Sums:
            first, last, many, index = item
            generator = np.random.Generator(np.random.SFC64([*seed, first, index]))
            owner = np.repeat(np.arange(first, last), many)
            if place is None:
                points, here = self.receivers.sample(owner, generator), lambda rows: estimate
            else:
                points, here = place(owner, np.tile(np.arange(index, index + many), last - first), generator)
            return self._evaluate(points, first, last, many, here, generator)

        yield from self.sample_batches(work, samples, batches(self.receivers.count, samples, batch))

    def sample_batches(self, work: Work, samples: int, items: Iterator[tuple[int, int, int, int]]) -> Iterator[Step]:
        """`work` on all `items` of `batches`, over threads but added up in order, then the finished result.

        What receivers are made of is read in between, so that light shows at once; camera samples find that out by themselves.
        """
        total, done = self.receivers.count * samples, 0
        reading = self._reading(not self.is_camera)
        with closing(in_order(work, items)) as results:
            for sums in results:
                self._add(sums)
                done += sums.samples * (sums.last - sums.first)
                next(reading, None)
                if sums.last == self.receivers.count:
                    self.measure()
                if self.clock.due() and done < total:
                    text = f"{done / self.receivers.count:.0f} of {samples} samples"
                    yield from self.clock.pause(Step(done / total, text, self.solution))
        yield from self._rest(reading, 1.0)
        yield from self.finish(f"{samples} samples")

    def fixed_points(self, estimate: Estimate, batch: int = SAMPLES_PER_BATCH, seed: Sequence[int] = ()) -> Iterator[Step]:
        """Every receiver's fixed points once, `batch` at a time: for methods that need no random places.

        `estimate` gets a generator of its own for each batch; `seed` begins them all.
        """

        def work(item: tuple[int, Points]) -> Sums:
            index, points = item
            generator = np.random.default_rng([*seed, 11, index])
            first, last = int(points.receiver.min()), int(points.receiver.max()) + 1
            many = np.bincount(points.receiver - first, minlength=last - first)
            return self._evaluate(points, first, last, many, lambda rows: estimate, generator, split=True)

        yield from self._rest(self._reading(not self.is_camera), 0.0)
        with closing(in_order(work, enumerate(sliced(self.receivers.sites(), batch)))) as results:
            spread = False
            for sums in results:
                self._add(sums)
                spread |= sums.spread is not None
                if self.clock.due():
                    share = sums.last / self.receivers.count
                    yield from self.clock.pause(Step(min(share, 0.999), f"{share:.0%} of the receivers", self.solution))
        if spread:
            self.measure()
        yield from self.finish("all receivers")

    def measure(self) -> None:
        """Note the relative standard error after a pass over all receivers."""
        error = self.film.relative_error()
        if error is not None:
            self.clock.note(error)

    def finish(self, text: str) -> Iterator[Step]:
        """Read what only a finished picture gets, and yield the last step."""
        yield from self._rest(self._reading(self.is_camera), 1.0)
        if self.left_out is None:
            self.left_out = self._left_out()
        self.warnings += path_limit.notices(self.left_out, self.settings.max_length)
        error = self.clock.history[-1][1] if self.clock.history else None
        about = self.settings, self.spec.label, self.receivers.measure
        self.warnings += noise.notices(error, *about, lights_of(self.emitters))
        self.warnings += noise.darkness((self.film.direct, self.film.indirect), self.emitters.flux.emitted, *about)
        self.partial = False
        yield from self.clock.last(Step(1.0, text, self.solution))

    def _left_out(self) -> float:
        """The share of the light that the longest path leaves out."""
        film = self.film
        return path_limit.left_out(self.tail + self.indirect_tail * film.indirect.sum(), float((film.direct + film.indirect).sum()))

    def _reading(self, wanted: bool) -> Iterator[float]:
        """Reads what receivers are made of, where `wanted`: of a camera that is normals and depths, which only a finished picture gets."""
        return read_surfaces(self.world, self.receivers, self.surfaces) if wanted else iter(())

    def _rest(self, reading: Iterator[float], fraction: float) -> Iterator[Step]:
        """Read on to the end, with `fraction` of the work done."""
        for done in reading:
            if self.clock.due():
                yield from self.clock.pause(Step(fraction, f"Reading surfaces, {done:.0%}", self.solution))

    def _evaluate(
        self,
        points: Points,
        first: int,
        last: int,
        many: int | np.ndarray,
        bind: Callable[[np.ndarray], Estimate],
        rng: np.random.Generator,
        split: bool = False,
    ) -> Sums:
        """Sums over the receivers `first` to `last` with `many` samples each; `split`: camera rays that surfaces let pass stay, too."""
        owner, rays = points.receiver - first, points.rays
        layers, emitted = [SightLayer(np.arange(len(owner)), points, None)], None
        if self.is_camera:
            sight = see(self.emitters, self.receivers, points, rng, self.settings.min_length == 0, split)
            layers, emitted, rays = sight.layers, sight.emitted, sight.rays
        direct, indirect, albedo, spread = np.zeros((4, len(owner), 3), np.float32)
        spreads, tail, spoiled = False, None, np.zeros(len(owner), bool)
        for layer in layers:
            at = np.flatnonzero(layer.points.triangle >= 0)
            if not len(at):
                continue
            there, rows = layer.points.take(at), layer.rows[at]
            surface = self.world.surface(there.triangle, there.u, there.v, there.towards)
            found = bind(rows)(surface, there.towards if self.is_camera else None, rng)
            weight = np.float32(1) if layer.weight is None else layer.weight[at]
            # Nothing that is not a number may get out.
            good = (np.isfinite(found.direct) & np.isfinite(found.indirect)).all(axis=1)[:, None]
            direct[rows] += weight * np.where(good, found.direct, 0)
            indirect[rows] += weight * np.where(good, found.indirect, 0)
            spoiled[rows] |= ~good[:, 0]
            if self.is_camera:
                albedo[rows] += weight * self.world.albedo(surface)
            if found.spread is not None:
                spread[rows] += weight * np.where(np.isfinite(found.spread), found.spread, 0)
                spreads = True
            if found.tail is not None:
                left = np.where(np.isfinite(found.tail), found.tail, 0) * (1 if layer.weight is None else weight.mean(axis=1))
                tail = left.sum(axis=1, dtype=np.float64) + (0 if tail is None else tail)
            rays += found.rays

        def total(values: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(owner, values[:, c], last - first) for c in range(3)], axis=1)

        seen = [total(emitted), total(albedo)] if self.is_camera else [None, None]
        spread_sum, bad = total(spread) if spreads else None, int(spoiled.sum())
        return Sums(first, last, many, total(direct), total(indirect), *seen, rays, bad, spread=spread_sum, tail=tail)

    def _add(self, sums: Sums) -> None:
        part = slice(sums.first, sums.last)
        self.film.add(part, sums.samples, sums.direct, sums.indirect, sums.spread)
        if self.is_camera:
            self.film.emitted[part] += sums.emitted
            self.film.albedo[part] += sums.albedo
        self.rays += sums.rays
        if sums.tail is not None:
            self.tail += sums.tail
        if sums.spoiled:
            self._spoiled += sums.spoiled
            text = f"{self._spoiled} samples were not numbers and count as 0"
            others = tuple(w for w in self.warnings if not w.reason.endswith("were not numbers and count as 0"))
            self.warnings = (*others, Notice("", text, "Look for extreme values in lights and materials"))

    def solution(self) -> Solution:
        """A copy of the result as it stands; the clock adds the seconds and the history."""
        film, surfaces, flux = self.film, self.surfaces, self.emitters.flux
        weight = (film.count > 0).astype(np.float32)
        extra = self.extra | film.errors()
        if self.is_camera:
            emitted, albedo = film.mean(film.emitted), film.mean(film.albedo)
            extra |= {k: surfaces[k] for k in ("normal", "depth") if k in surfaces}
        elif surfaces:
            albedo, emitted = surfaces["albedo"], surfaces["emission"] * np.float32(np.pi * (self.settings.min_length == 0))
            weight = weight * (surfaces["weight"] > 0)
        else:
            emitted = albedo = np.zeros((self.receivers.count, 3), np.float32)
        return Solution(
            self.spec.id,
            self.receivers.measure,
            emitted,
            film.mean(film.direct),
            film.mean(film.indirect),
            albedo,
            weight,
            rays=self.rays,
            left_out=self.left_out,
            balance=self.balance and self.balance.with_passing(flux.passing),
            emitted_flux=flux.emitted,
            entering_flux=flux.entering,
            warnings=self.warnings,
            settings=self.settings.as_dict(),
            partial=self.partial,
            extra=extra,
        )


def lights_of(emitters: Emitters) -> int:
    """Lamps that give light, and objects that emit."""
    owner = emitters.world.scene.object[emitters.triangles]
    return int((emitters.lamps.importance > 0).sum()) + len(np.unique(owner))


def sliced(chunks: Iterator[Points], batch: int) -> Iterator[Points]:
    """The points of `chunks` in groups of at most `batch`."""
    for points in chunks:
        for a in range(0, len(points.receiver), batch):
            some = {f.name: getattr(points, f.name) for f in fields(points)}
            some = {name: x[a : a + batch] if isinstance(x, np.ndarray) else x for name, x in some.items()}
            yield Points(**(some | {"rays": points.rays if a == 0 else 0}))


def batches(count: int, samples: int, batch: int = SAMPLES_PER_BATCH, even: bool = False) -> Iterator[tuple[int, int, int, int]]:
    """(first receiver, last, samples, index of the first sample) of every batch, pass by pass; independent of the machine.

    A quick full pass first, of several samples at once where receivers are few, then passes of up to `MOST_SAMPLES`. `even`: the number
    of samples stays at powers of two until the limit, where Sobol points are most even.
    """
    index = 0
    # Noise is measured from the differences between passes: two at least.
    size = max(1, min(MOST_SAMPLES, batch // max(1, count), samples // 2))
    if even:
        size = 1 << (size.bit_length() - 1)
    while index < samples:
        now = min(size if index == 0 else min(index, MOST_SAMPLES), samples - index)
        block = max(1, batch // now)
        for first in range(0, count, block):
            yield first, min(first + block, count), now, index
        index += now
