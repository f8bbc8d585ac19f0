"""The random walk of particles: fly, hit, be absorbed or scattered (review, section 8; Pattanaik and Mudur 1992)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..bsdf import table as bsdf
from ..lights.emission import Particles
from ..sampling.maps import cosine_directions
from ..scene.arrays import RayKind
from ..scene.world import Surface, World
from .path_limit import block_of, longest
from .radiance import leaving
from .shooting import Arrived, Departed, Flight, shoot


@dataclass(frozen=True, eq=False)
class Hits:
    """What one flight of all particles still alive came to.

    length    segments flown, 1 at the first hit
    surface   where they hit, on the side that they came from
    arriving  (n, 3) float32 power they bring, W, weighted so that its density is the irradiance about the shading normal
    leaving   (n, 3) float32 power the surface scatters of it, before absorption is decided; in expectation over its directions
              this is what leaves the surface, and without other lobes than diffuse it is the albedo times `arriving`
    row       (n,) int64 which of the particles that set out
    """

    length: int
    surface: Surface
    arriving: np.ndarray
    leaving: np.ndarray
    row: np.ndarray


Visit = Callable[[Hits], None]


@dataclass
class Ends:
    """How walks ended. Counts add up: emitted = absorbed + escaped + cut. Energies in W, all colours summed, add up as
    emitted + gained = absorbed + escaped + cut. Particles of suns and the background that miss the scene are counted, as escaped, but
    have no energy.

    What is absorbed is what does not go on, whatever ended the walk: lobes whose sampled share exceeds 1 make a particle stronger, and
    then it is negative. `gained` is what shading normals added, or took where it is negative: they bend the cosine law, which keeps
    the result right but not the power of a particle. arrived: power that arrives, at all hits; tail: of it in the blocks of `path_limit`.
    """

    emitted: int = 0
    absorbed: int = 0
    escaped: int = 0
    cut: int = 0
    emitted_energy: float = 0.0
    absorbed_energy: float = 0.0
    escaped_energy: float = 0.0
    cut_energy: float = 0.0
    gained: float = 0.0
    arrived: float = 0.0
    tail: np.ndarray = field(default_factory=lambda: np.zeros(2))
    rays: int = 0

    def note(self, length: int, max_length: int, power: float) -> None:
        """Add what arrives after `length` segments."""
        self.arrived += power
        block = block_of(length, 1, max_length)
        if block is not None:
            self.tail[block] += power

    def add(self, other: Ends, factor: float = 1.0) -> None:
        """Add the walks of another batch, its energies times `factor`."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + (value if isinstance(value, int) else factor * value))


def walk(
    world: World,
    particles: Particles,
    max_length: int,
    rng: np.random.Generator,
    visit: Visit,
    table: bsdf.BsdfTable | None = None,
    importance: bool = False,
) -> Ends:
    """Follow all particles to their ends and report every hit to `visit`.

    The walk is analog: at a hit a particle is absorbed, or scattered with all its power. The probability to go on is the share of
    its power that the surface scatters (diffuse: the albedo averaged by the particle's colours), and its colours change in
    proportion, so that each colour is right in expectation. A particle that would fly on after `max_length` segments is cut, which does
    not bound them from NO_LIMIT on.

    `table` scatters by all lobes of the scene; without it every surface is diffuse with the albedo of `world.albedo`.
    `importance`: the particles come from a receiver, against the light: shading normals act as they do on a path of radiance, and
    not as on light (Veach 1997, section 5.3).
    """
    scatter = Analog(world, table, importance)
    flight = Flight(particles.origin, particles.direction, particles.kind, particles.weight)
    emitted, energy, most = len(particles.weight), _energy(particles.weight), longest(max_length)
    ends = Ends(emitted=emitted, emitted_energy=energy)
    if most < 1:
        ends.cut, ends.cut_energy = emitted, energy
    for segment in shoot(world, flight, most, scatter, rng, particles.dark, particles.reach):
        at, out = segment.arrived, segment.scattered
        visit(Hits(at.segments, at.surface, out.arriving, out.leaving, segment.row))
        ends.rays += segment.rays
        ends.escaped += len(segment.away)
        passed, passing = (0, 0.0) if segment.passed is None else (int(np.count_nonzero(at.stay == 0)), _energy(segment.passed))
        scattered, energy = len(out.rows), _energy(out.flight.weight)
        ends.absorbed += len(segment.row) - scattered - passed
        lost = segment.lost
        if at.segments == 1 and segment.layer == 0 and particles.far is not None:
            # Light from far away that misses the scene is no light of the scene.
            ends.emitted_energy -= _energy(lost[particles.far[segment.away]])
            lost = lost[~particles.far[segment.away]]
        ends.escaped_energy += _energy(lost)
        ends.absorbed_energy += _energy(at.weight) - energy - passing + out.gained
        ends.gained += out.gained
        ends.note(at.segments, max_length, _energy(out.arriving))
        if at.segments == most:
            ends.cut += scattered
            ends.cut_energy += energy
    return ends


@dataclass(frozen=True, eq=False)
class Decided(Departed):
    """Particles that go on; arriving, leaving (n, 3) as in `Hits`, and the power that shading normals added, W."""

    arriving: np.ndarray
    leaving: np.ndarray
    gained: float


class Analog:
    """Absorbs particles, or scatters them with all their power: what `walk` does where they arrive."""

    def __init__(self, world: World, table: bsdf.BsdfTable | None, importance: bool) -> None:
        self.world, self.table, self.importance = world, table, importance
        self.bends = world.any_smooth and not importance

    def __call__(self, at: Arrived, rng: np.random.Generator) -> Decided:
        """The particles that go on, and what it was decided by."""
        # Step 1: the receiver measures by the cosine to its shading normal, light arrives by that to the geometric one.
        surface, arriving = at.surface, at.weight
        if self.bends:
            arriving = arriving * shading_factor(surface, at.direction)[:, None]
        # Step 2: the power that each would go on with.
        if self.table is None:
            out = _diffuse(self.world, surface, arriving, self.world.albedo(surface), self.importance, rng)
        else:
            out = _sampled(self.world, surface, self.table, at.direction, arriving, self.importance, rng)
        if at.stay is not None:
            out.power[...] *= at.stay[:, None]
        # Step 3: absorbed or not. One particle cannot become two, so a share above 1 makes it stronger.
        share = out.power.sum(axis=1) / np.maximum(at.weight.sum(axis=1), np.float32(1e-37))
        alive = np.flatnonzero(rng.random(len(share), np.float32) < share)
        weight = out.power[alive] / np.minimum(share[alive], np.float32(1))[:, None]
        # Step 4: those that go on leave.
        flight = Flight(*out.departure(self.world, surface, alive, rng), weight=weight)
        return Decided(alive, flight, arriving, out.power, self._gained(at, out) if self.bends else 0.0)

    def _gained(self, at: Arrived, out: _Outgoing) -> float:
        factor = shading_factor(at.surface, at.direction) * (1 if out.bent is None else out.bent)
        return _energy(out.power * (1 - 1 / np.maximum(factor, np.float32(1e-7)))[:, None])


@dataclass(frozen=True, eq=False)
class _Outgoing:
    """Power (n, 3) that goes on. Where `by_cosine` (n,) bool, the direction is drawn about `normal` only for those that survive;
    elsewhere it is `direction`, on the other side of the surface where `through`, as a ray of `kind`. None: all by cosine.
    bent (n,): factor in `power` from departing by another cosine than that to the shading normal."""

    power: np.ndarray
    normal: np.ndarray
    by_cosine: np.ndarray | None = None
    direction: np.ndarray | None = None
    through: np.ndarray | None = None
    kind: np.ndarray | None = None
    bent: np.ndarray | None = None

    def departure(
        self, world: World, surface: Surface, alive: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | np.uint8]:
        """Origins and directions (m, 3) float32 of the survivors `alive` (m,), and the `RayKind` of their rays."""
        s, t = rng.random(len(alive), np.float32), rng.random(len(alive), np.float32)
        direction = cosine_directions(self.normal[alive], s, t)
        surface = surface.take(alive)
        if self.by_cosine is None:
            return world.leave(surface), direction, RayKind.DIFFUSE
        other = np.flatnonzero(~self.by_cosine[alive])
        direction[other] = self.direction[alive[other]]
        return world.leave(surface, self.through[alive]), direction, self.kind[alive]


def _diffuse(
    world: World, surface: Surface, arriving: np.ndarray, albedo: np.ndarray, importance: bool, rng: np.random.Generator
) -> _Outgoing:
    """Light leaves a diffuse surface by the cosine to the geometric normal, as its radiance is the same in all directions.

    Importance leaves by that to the shading normal, and what would go below the surface is lost, as on a path of radiance.
    """
    power = arriving * albedo
    if not (importance and world.any_smooth):
        return _Outgoing(power, surface.ng)
    n = len(power)
    towards = cosine_directions(surface.ns, rng.random(n, np.float32), rng.random(n, np.float32))
    power[np.einsum("ij,ij->i", towards, surface.ng) <= 0] = 0
    none = np.zeros(n, bool)
    return _Outgoing(power, surface.ng, none, towards, none, np.full(n, RayKind.DIFFUSE))


def _sampled(
    world: World,
    surface: Surface,
    table: bsdf.BsdfTable,
    direction: np.ndarray,
    arriving: np.ndarray,
    importance: bool,
    rng: np.random.Generator,
) -> _Outgoing:
    """Directions and power by the whole BSDF; points that have no other lobe than diffuse as in `_diffuse`."""
    wo = -direction
    lobes = table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, wo)
    plain = ~lobes.others()
    out = _diffuse(world, surface, arriving, lobes.diffuse, importance, rng)
    rest = np.flatnonzero(~plain)
    if out.direction is not None:
        towards, plain = out.direction, np.zeros(len(wo), bool)
    else:
        towards = np.zeros_like(direction)
    through = np.zeros(len(wo), bool)
    kind = np.full(len(wo), RayKind.DIFFUSE)
    bent = np.ones(len(wo), np.float32)
    if len(rest):
        drawn = bsdf.sample(lobes.take(rest), rng)
        ng, ns = surface.ng[rest], surface.ns[rest]
        weight = drawn.weight
        if world.any_smooth and not importance:
            # The BSDF holds the cosine to the shading normal; a particle leaves by that to the geometric one.
            leaves = np.abs(np.einsum("ij,ij->i", drawn.wi, ng)) / np.maximum(np.abs(np.einsum("ij,ij->i", drawn.wi, ns)), np.float32(1e-6))
            weight = weight * leaves[:, None]
            bent[rest] = leaves
        good = np.zeros(len(rest), bool)
        good[leaving(surface.take(rest), drawn)] = True
        out.power[rest] = np.where(good[:, None], arriving[rest] * weight, 0)
        towards[rest], through[rest], kind[rest] = drawn.wi, drawn.through, drawn.kind
    return _Outgoing(out.power, out.normal, plain, towards, through, kind, bent)


def shading_factor(surface: Surface, direction: np.ndarray) -> np.ndarray:
    """(n,) float32 |wi . ns| / |wi . ng| for particles arriving along `direction`, 0 from behind the shading normal.

    The adjoint of shading with interpolated normals (Veach 1997, section 5.3), exactly 1 where both normals are the same.
    """
    to_ns = np.maximum(-np.einsum("ij,ij->i", surface.ns, direction), np.float32(0))
    to_ng = -np.einsum("ij,ij->i", surface.ng, direction)
    return to_ns / np.maximum(to_ng, np.float32(1e-7))


def _energy(weight: np.ndarray) -> float:
    return float(weight.sum(dtype=np.float64))
