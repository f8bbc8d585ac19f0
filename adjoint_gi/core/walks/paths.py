"""The walk that gathers (review, Eq. 12): many paths side by side, from receivers to emitters, compacted as they end.

A path adds up emission: of a light point at each vertex, and of what the rays between vertices meet; the two are joined by multiple
importance sampling (Veach 1997, chapter 9). What a vertex does is a strategy: `radiance.LobeVertices` know any BSDF,
`diffuse_paths.DiffuseVertices` only diffuse surfaces, at less cost. Methods take the steps of `Paths` in the order they want.

Vectors are component first, (3, n) float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from ..base.settings import NO_LIMIT
from ..bsdf import table as bsdf
from ..lights import direct
from ..lights.direct import Emitted, Hit
from ..lights.emitters import Emitters
from ..sampling.maps import ONE
from ..scene.faces import Faces
from ..scene.world import World
from .path_limit import FAINT, block_of, longest

NEVER = 1 << 30  # as `Walk.roulette_from`: no path is as long, so roulette is off
LATE = 4  # segments from which vertices without light are counted
DARK = 32  # vertices without light in a row after which a path is taken for a lost one
FEW = 1 / 16  # of the paths; where no more are left, half of these vertices are enough, since steps cost as much for a few as for many


def by_weight(strength: np.ndarray) -> np.ndarray:
    """(n,) chance to go on with which every survivor carries as much; at least 5 %, so that no path becomes very strong."""
    return np.clip(strength, np.float32(0.05), ONE)


def by_root(strength: np.ndarray) -> np.ndarray:
    """(n,) chance to go on that lets weak paths live longer: less noise for cheap vertices."""
    return np.minimum(np.sqrt(strength), ONE)


def in_the_dark(dark: np.ndarray, most: np.ndarray, after: int, mirrored: np.ndarray | None) -> np.ndarray:
    """(n,) float32 chance to go on of paths that have found no light at the last `dark` (n,) vertices, after `most` (n,) at their worst.

    Between white walls of closed bodies nothing else ends paths. Of those that find no light at s vertices in a row, more than `after`,
    (after / s)^4 go on, with weights that grow as the inverse. Only a longest row so far costs anything, so a weight never grows by more
    than that power of the length: the estimate has a finite variance wherever light falls with length geometrically. Between mirrors, whose
    vertices are `mirrored` (n,) bool, it falls as slowly as the inverse cube of the length: there after / s go on, for the same reason.
    """
    row = np.maximum(dark, 1).astype(np.float32)
    chance = (row - 1) / row
    return np.where((dark > after) & (dark > most), chance**4 if mirrored is None else np.where(mirrored, chance, chance**4), ONE)


def russian_roulette(
    strength: np.ndarray, luck: np.ndarray, survival: Callable[[np.ndarray], np.ndarray] = by_weight
) -> tuple[np.ndarray, np.ndarray]:
    """Which of paths of `strength` (n,) go on, (k,) int, and the chance (k,) that each had; dividing their weights by it keeps the mean.

    luck (n,): random numbers. survival: the chance for a strength.
    """
    chance = survival(strength)
    survive = np.flatnonzero(luck < chance)
    return survive, chance.take(survive)


@dataclass(frozen=True, eq=False)
class Walk:
    """What a walk needs besides its start.

    min_length, max_length: path lengths that count, NO_LIMIT for all.
    roulette_from: segments after which paths end at random, with the chance `survival`.
    draw_lights, meet_lights: use light points; use what BSDF rays meet. With both, each is weighted; with one, it stands alone.
    uniform: draw directions evenly over the sphere instead of by the BSDF (mirrors still by theirs): what importance sampling saves.
    emission: emitted radiance of triangles, for emission that is not the same in all directions, as in a Kirchhoff cavity; light points
    know nothing of it, so `draw_lights` must be off.
    """

    world: World
    emitters: Emitters
    table: bsdf.BsdfTable
    min_length: int = 0
    max_length: int = NO_LIMIT
    roulette_from: int = 3
    draw_lights: bool = True
    meet_lights: bool = True
    uniform: bool = False
    emission: Emitted | None = None
    survival: Callable[[np.ndarray], np.ndarray] = by_weight

    @cached_property
    def faces(self) -> Faces:
        """Tables of the triangles."""
        return Faces(self.world)

    @cached_property
    def longest(self) -> int:
        """Segments of the longest path."""
        return longest(self.max_length)

    @cached_property
    def faintest(self) -> np.float32:
        """Weight at which paths end: 0, or next to nothing where neither roulette nor a length ends them."""
        return FAINT if self.roulette_from == NEVER and self.max_length >= NO_LIMIT else np.float32(0)

    def block(self, length: int) -> int | None:
        """Which block of `path_limit` light of `length` belongs to."""
        return block_of(length, self.min_length, self.max_length)

    @cached_property
    def draws(self) -> bool:
        """Whether there is anything to draw light points from."""
        return self.draw_lights and self.emitters.any_drawn()

    @cached_property
    def meets(self) -> bool:
        """Whether a ray can meet emission."""
        e = self.emitters
        return e.any_background or e.any_mesh or len(e.sized if self.table.count or not self.draw_lights else e.shared) > 0


@dataclass(frozen=True, eq=False)
class Gathered:
    """Radiance towards `wo`, (n, 3) float32: `direct` of path length 1, `indirect` of more; rays cast.

    spread (n, 3): the estimate by one half of the random numbers less that by both, where a method knows it. tail (2, n): of the light,
    channels summed, that in the blocks of `path_limit`; None where no path came near the limit.
    """

    direct: np.ndarray
    indirect: np.ndarray
    rays: int
    spread: np.ndarray | None = None
    tail: np.ndarray | None = None

    def times(self, factor: np.float32 | np.ndarray) -> Gathered:
        """The same light times `factor`, one or (n, 3)."""
        spread = None if self.spread is None else self.spread * factor
        tail = None if self.tail is None else self.tail * (np.mean(factor, axis=-1) if np.ndim(factor) else factor)
        return Gathered(self.direct * factor, self.indirect * factor, self.rays, spread, tail)

    def plus(self, other: Gathered) -> Gathered:
        """Both together, at the same points."""
        tail = self.tail if other.tail is None else other.tail if self.tail is None else self.tail + other.tail
        return Gathered(self.direct + other.direct, self.indirect + other.indirect, self.rays + other.rays, tail=tail)


@dataclass(frozen=True, eq=False)
class Ray:
    """Rays that leave vertices, one each at most.

    rows (n,): the vertices they leave, None for all. origin, wi (3, n); kind: `RayKind`, one for all or (n,)
    pdf (n,): the density by which they share emission with light points, INF where light points cannot find it
    weight (3, n): f |cos| over the density of wi; None where the next vertex has the reflectance
    delta (n,) bool: by a perfectly smooth lobe; None for none
    """

    rows: np.ndarray | None
    origin: np.ndarray
    wi: np.ndarray
    kind: np.ndarray | np.uint8
    pdf: np.ndarray
    weight: np.ndarray | None = None
    delta: np.ndarray | None = None


class Vertices(Protocol):
    """Where paths stand. `scale`: what a light point's value is multiplied by besides the weight of the path, or None."""

    count: int
    scale: np.float32 | None

    def light_points(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, int]:
        """One light point for each: rows (m,) that are lit, reflected light (3, m), shadow rays cast."""

    def scatter(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Ray:
        """A ray from each that goes on."""

    def reflectance(self, hit: Hit, rows: np.ndarray) -> np.ndarray | None:
        """(3, m) reflectance where rays `rows` (m,) hit; None where the weights of rays have it."""

    def arrive(self, ray: Ray, hit: Hit, rows: np.ndarray, path: np.ndarray, rng: np.random.Generator) -> Vertices:
        """The vertices where rays `rows` (m,) of the paths `path` (m,) hit."""


class Paths:
    """Paths on their way. The steps are taken in the order of their definition, vertex by vertex.

    row (n,): which start each path belongs to. weight (3, n): factor from radiance at the vertices, or along the rays, to the estimate.
    length: of paths to a light seen directly from the vertices. carried: more about each path, by name, (n,).
    direct, indirect (3, starts): what was gathered. rays: cast.
    """

    def __init__(
        self,
        walk: Walk,
        vertices: Vertices,
        rng: np.random.Generator,
        length: int = 1,
        weight: np.ndarray | np.float32 = ONE,
        unit: np.float32 = ONE,
    ) -> None:
        """One path from each of `vertices`. `weight`: one for all or (3, n). `unit`: 1 over the weight of a strong path, for roulette."""
        self.walk, self.vertices, self.rng, self.length, self.unit = walk, vertices, rng, length, unit
        self.weight = np.full((3, vertices.count), weight) if np.ndim(weight) == 0 else weight
        self.row = np.arange(vertices.count)
        self.direct, self.indirect = np.zeros((2, 3, vertices.count), np.float32)
        self.tail: np.ndarray | None = None
        self.carried: dict[str, np.ndarray] = {}
        self.rays = 0
        self.ray: Ray | None = None
        self.hit: Hit | None = None

    @property
    def alive(self) -> bool:
        """Whether any path goes on."""
        return len(self.row) > 0 and self.length <= self.walk.longest

    @property
    def counts(self) -> bool:
        """Whether light that arrives straight counts."""
        return self.length >= self.walk.min_length

    def light_points(self, uniform: np.ndarray | None = None) -> None:
        """Add the emission of one light point for each vertex."""
        if self.counts and self.walk.draws:
            rows, value, cast = self.vertices.light_points(self.rng, uniform)
            self.rays += cast
            self.collect(rows, value, self.vertices.scale)

    def scatter(self, uniform: np.ndarray | None = None) -> bool:
        """Draw a direction at each vertex and trace the rays. False at the end: where no path goes on, or none could meet anything."""
        self.ray = ray = self.vertices.scatter(self.rng, uniform)
        if ray.rows is not None:
            self.take(ray.rows)
        if ray.weight is not None:
            self.weight = self.weight * ray.weight
        last = self.length == self.walk.longest
        if not len(self.row) or (last and not (self.counts and self.walk.meets)):
            return False
        self.hit = self.walk.world.intersect(ray.origin.T, ray.wi.T, ray.kind)
        self.rays += len(self.row)
        return True

    def emission_met(self, lamps: np.ndarray | None = None) -> None:
        """Add the emission that the rays meet, those that surfaces let straight through on their way to the one where they stay, too.

        `lamps` (n,) bool: which rays by mirrors meet lamps; None for all.
        """
        walk, ray = self.walk, self.ray
        if self.counts:
            seen = (ray.origin, ray.wi, self.hit, ray.pdf)
            for rows, value in direct.from_hits(walk.emitters, walk.faces, *seen, emission=walk.emission, lamps=lamps):
                self.collect(rows, value)
        if walk.world.passing is not None:
            self._pass_on(lamps)

    def _pass_on(self, lamps: np.ndarray | None) -> None:
        """Decide where rays stay. Passing is no event: it leaves the length, the kind, the origin and the density of a ray as they are."""
        ray = self.ray
        self.hit, self.weight = tuple(np.array(a) for a in self.hit), np.array(self.weight)
        for rows, passed in self.walk.world.pass_on(ray.origin.T, ray.wi.T, ray.kind, self.hit, self.weight, self.rng):
            self.rays += len(rows)
            if self.counts:
                self._emission_behind(rows, passed, lamps if lamps is None else lamps[rows])

    def _emission_behind(self, rows: np.ndarray, beyond: np.ndarray, lamps: np.ndarray | None) -> None:
        """Add the emission that rays `rows` (m,) meet farther away than `beyond` (m,)."""
        walk, ray = self.walk, self.ray
        o, w, pdf = ray.origin.take(rows, axis=1), ray.wi.take(rows, axis=1), ray.pdf.take(rows)
        hit, options = tuple(a.take(rows) for a in self.hit), {"emission": walk.emission, "lamps": lamps, "beyond": beyond}
        for found, value in direct.from_hits(walk.emitters, walk.faces, o, w, hit, pdf, **options):
            self.collect(rows[found], value)

    def arrive(self) -> None:
        """Go on from the surfaces that were hit, as far as roulette lets paths: dividing by its chance keeps the estimate unbiased."""
        walk, hit = self.walk, self.hit
        rows = np.flatnonzero(hit[0] >= 0)
        luck = self.rng.random(len(rows), np.float32) if self.length >= walk.roulette_from else None
        if self.length == walk.longest:
            self.take(rows[:0])
            return
        weight = self.weight.take(rows, axis=1)
        reflectance = self.vertices.reflectance(hit, rows)
        if reflectance is not None:
            weight = weight * reflectance
        strength = weight.max(axis=0) * self.unit
        if luck is None:
            survive = np.flatnonzero(strength > walk.faintest)
            weight = weight.take(survive, axis=1)
        else:
            survive, chance = russian_roulette(strength, luck, self._survival(rows))
            weight = weight.take(survive, axis=1) / chance
        rows = rows.take(survive)
        self._keep(rows)
        self.weight = weight
        self.vertices = self.vertices.arrive(self.ray, hit, rows, self.row, self.rng)
        self.length += 1

    def _survival(self, rows: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """The chance to go on of paths `rows` (m,) for their strengths, and for the time that they have found no light."""
        if self.length < LATE:
            return self.walk.survival
        if "dark" not in self.carried:
            self.carried |= {name: np.zeros(len(self.row), np.int32) for name in ("dark", "darkest")}
        dark, most = self.carried["dark"], self.carried["darkest"]
        dark += 1
        few = len(rows) < FEW * self.direct.shape[1]
        mirrored = None if self.ray.delta is None else self.ray.delta.take(rows)
        chance = in_the_dark(dark.take(rows), most.take(rows), DARK // 2 if few else DARK, mirrored)
        np.maximum(most, dark, out=most)
        return lambda strength: np.minimum(self.walk.survival(strength), chance)

    def step(self) -> bool:
        """Take all steps at the vertices where the paths are; False at the end."""
        self.light_points()
        on = self.scatter()
        if on:
            self.emission_met()
            self.arrive()
        return on

    def take(self, rows: np.ndarray) -> None:
        """Keep only some paths; vertices and rays are left to the caller."""
        self._keep(rows)
        self.weight = self.weight.take(rows, axis=1)

    def _keep(self, rows: np.ndarray) -> None:
        self.row = self.row.take(rows)
        self.carried = {name: values[rows] for name, values in self.carried.items()}

    def collect(self, rows: np.ndarray, value: np.ndarray, scale: np.float32 | None = None, indirect: bool = False) -> None:
        """Add radiance `value` (3, m), used up, that paths `rows` (m,) found at the length where they are, or that is `indirect`."""
        value *= self.weight.take(rows, axis=1)
        if scale is not None:
            value *= scale
        add(self.indirect if indirect or self.length > 1 else self.direct, self.row.take(rows), value)
        if "dark" in self.carried:
            self.carried["dark"][rows[value.max(axis=0) > 0]] = -1  # of which the next vertex makes 0
        block = self.walk.block(self.length)
        if block is not None:
            self._note(block, self.row.take(rows), value.sum(axis=0))

    def _note(self, block: int, rows: np.ndarray, light: np.ndarray) -> None:
        """Add light (m,) of starts `rows` (m,), none of them twice, to a block of the tail."""
        if self.tail is None:
            self.tail = np.zeros((2, self.direct.shape[1]), np.float32)
        self.tail[block][rows] += light

    def collect_from(self, found: Gathered) -> None:
        """Add what other walks from the vertices of these paths have found there."""
        light = found.indirect.T * self.weight
        add(self.indirect, self.row, light)
        if found.tail is not None:
            for block, part in enumerate(found.tail):
                self._note(block, self.row, part * self.weight.mean(axis=0))
        self.rays += found.rays

    def gathered(self) -> Gathered:
        """What was found, in rows."""
        return Gathered(self.direct.T, self.indirect.T, self.rays, tail=self.tail)


def add(target: np.ndarray, rows: np.ndarray, value: np.ndarray) -> None:
    """Add `value` (3, m) to columns `rows` of `target` (3, n); no row comes twice."""
    if len(rows) == target.shape[1]:
        target += value
        return
    for c in range(3):
        channel = target[c]
        channel[rows] += value[c]


def follow(paths: Paths) -> Gathered:
    """Go on to the end of all paths: path tracing (Eq. 12) as a part of other methods."""
    while paths.alive and paths.step():
        pass
    return paths.gathered()
