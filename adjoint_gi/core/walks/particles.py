"""The random walk of particles: fly, hit, be absorbed or scattered (review, section 8; Pattanaik and Mudur 1992)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..bsdf import table as bsdf
from ..lights.emission import Particles
from ..sampling.maps import cosine_directions
from ..scene.arrays import RayKind
from ..scene.world import Surface, World
from .radiance import leaving


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
    emitted + gained = absorbed + escaped + cut.

    What is absorbed is what does not go on, whatever ended the walk: lobes whose sampled share exceeds 1 make a particle stronger, and
    then it is negative. `gained` is what shading normals added, or took where it is negative: they bend the cosine law, which keeps
    the result right but not the power of a particle.
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
    rays: int = 0

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
    proportion, so that each colour is right in expectation. A particle that would fly on after `max_length` segments is cut.

    `table` scatters by all lobes of the scene; without it every surface is diffuse with the albedo of `world.albedo`.
    `importance`: the particles come from a receiver, against the light: shading normals act as they do on a path of radiance, and
    not as on light (Veach 1997, section 5.3).
    """
    origin, direction, weight = particles.origin, particles.direction, particles.weight
    row, kind = np.arange(len(weight)), particles.kind
    ends = Ends(emitted=len(weight), emitted_energy=_energy(weight))
    for length in range(1, max_length + 1):
        if not len(origin):
            return ends
        # Step 1: fly to the nearest surface, or escape.
        ends.rays += len(origin)
        triangle, u, v, t = world.intersect(origin, direction, kind)
        met = triangle >= 0
        if length == 1:
            # What is hit where a particle still lights nothing, or beyond its reach, stays dark: the particle counts as escaped.
            met &= t >= particles.dark
            if particles.reach is not None:
                met &= t <= particles.reach
        hit = np.flatnonzero(met)
        if len(hit) < len(triangle):
            ends.escaped += len(triangle) - len(hit)
            ends.escaped_energy += _energy(weight) - _energy(weight := weight[hit])
            triangle, u, v, direction, row = triangle[hit], u[hit], v[hit], direction[hit], row[hit]
        surface = world.surface(triangle, u, v, -direction)

        # Step 2: the receiver measures by the cosine to its shading normal, light arrives by that to the geometric one.
        arriving = weight
        if world.any_smooth and not importance:
            arriving = weight * shading_factor(surface, direction)[:, None]

        # Step 3: the power that it would go on with.
        if table is None:
            scattered = _diffuse(world, surface, arriving, world.albedo(surface), importance, rng)
        else:
            scattered = _sampled(world, surface, table, direction, arriving, importance, rng)
        visit(Hits(length, surface, arriving, scattered.power, row))

        # Step 4: absorbed or not. One particle cannot become two, so a share above 1 makes it stronger.
        share = scattered.power.sum(axis=1) / np.maximum(weight.sum(axis=1), np.float32(1e-37))
        alive = np.flatnonzero(rng.random(len(share), np.float32) < share)
        ends.absorbed += len(share) - len(alive)
        before = _energy(weight)
        if world.any_smooth and not importance:
            bent = scattered.bent if scattered.bent is not None else np.float32(1)
            factor = shading_factor(surface, direction) * bent
            gained = _energy(scattered.power * (1 - 1 / np.maximum(factor, np.float32(1e-7)))[:, None])
        else:
            gained = 0.0
        weight, row = scattered.power[alive] / np.minimum(share[alive], np.float32(1))[:, None], row[alive]
        ends.gained += gained
        ends.absorbed_energy += before - _energy(weight) + gained
        origin, direction, kind = scattered.departure(world, surface, alive, rng)
    ends.cut += len(origin)
    ends.cut_energy += _energy(weight)
    return ends


@dataclass(frozen=True, eq=False)
class _Scattered:
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
) -> _Scattered:
    """Light leaves a diffuse surface by the cosine to the geometric normal, as its radiance is the same in all directions.

    Importance leaves by that to the shading normal, and what would go below the surface is lost, as on a path of radiance.
    """
    power = arriving * albedo
    if not (importance and world.any_smooth):
        return _Scattered(power, surface.ng)
    n = len(power)
    towards = cosine_directions(surface.ns, rng.random(n, np.float32), rng.random(n, np.float32))
    power[np.einsum("ij,ij->i", towards, surface.ng) <= 0] = 0
    none = np.zeros(n, bool)
    return _Scattered(power, surface.ng, none, towards, none, np.full(n, RayKind.DIFFUSE))


def _sampled(
    world: World,
    surface: Surface,
    table: bsdf.BsdfTable,
    direction: np.ndarray,
    arriving: np.ndarray,
    importance: bool,
    rng: np.random.Generator,
) -> _Scattered:
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
    return _Scattered(out.power, out.normal, plain, towards, through, kind, bent)


def shading_factor(surface: Surface, direction: np.ndarray) -> np.ndarray:
    """(n,) float32 |wi . ns| / |wi . ng| for particles arriving along `direction`, 0 from behind the shading normal.

    The adjoint of shading with interpolated normals (Veach 1997, section 5.3), exactly 1 where both normals are the same.
    """
    to_ns = np.maximum(-np.einsum("ij,ij->i", surface.ns, direction), np.float32(0))
    to_ng = -np.einsum("ij,ij->i", surface.ng, direction)
    return to_ns / np.maximum(to_ng, np.float32(1e-7))


def _energy(weight: np.ndarray) -> float:
    return float(weight.sum(dtype=np.float64))
