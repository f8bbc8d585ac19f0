"""The random walk of light particles: fly, hit, be absorbed or reflected (review, section 8; Pattanaik and Mudur 1992)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .emission import Particles
from .mesh_emission import cosine_directions
from .world import Surface, World

# Called at the n-th hit of the particles still alive, with n, where they hit, and the irradiance-weighted power (m, 3) they bring, W.
Visit = Callable[[int, Surface, np.ndarray], None]


@dataclass
class Ends:
    """How walks ended. Counts add up: emitted = absorbed + escaped + cut. Energies in W, all colours summed.

    `gained` is what shading normals added: they bend the cosine law, which keeps the result right but not the power of a particle.
    It is 0 without smooth shading, and then the energies add up as the counts do.
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


def walk(world: World, particles: Particles, max_length: int, rng: np.random.Generator, visit: Visit) -> Ends:
    """Follow all particles to their ends on diffuse surfaces and report every hit to `visit`.

    The walk is analog: at a hit a particle is absorbed, or reflected with all its power. The probability of reflection is the
    albedo averaged by the particle's colours, and the colours of a reflected particle change in proportion to the albedo,
    so that each colour is right in expectation. A particle that would fly on after `max_length` segments is cut.
    """
    origin, direction, weight = particles.origin, particles.direction, particles.weight
    ends = Ends(emitted=len(weight), emitted_energy=_energy(weight))
    for length in range(1, max_length + 1):
        if not len(origin):
            return ends
        # Step 1: fly to the nearest surface, or escape.
        ends.rays += len(origin)
        triangle, u, v, t = world.intersect(origin, direction)
        # What is hit where a particle still lights nothing stays dark and casts a shadow: the particle counts as escaped.
        hit = np.flatnonzero((triangle >= 0) & (t >= particles.dark) if length == 1 else triangle >= 0)
        if len(hit) < len(triangle):
            ends.escaped += len(triangle) - len(hit)
            ends.escaped_energy += _energy(weight) - _energy(weight := weight[hit])
            triangle, u, v, direction = triangle[hit], u[hit], v[hit], direction[hit]
        surface = world.surface(triangle, u, v, -direction)

        # Step 2: the receiver measures by the cosine to its shading normal, the particle arrives by that to the geometric one.
        arriving = weight
        if world.any_smooth:
            arriving = weight * shading_factor(surface, direction)[:, None]
        visit(length, surface, arriving)

        # Step 3: absorbed or reflected. One particle cannot become two, so a share above 1 makes it stronger.
        reflected = arriving * world.albedo(surface)
        power = weight.sum(axis=1)
        share = reflected.sum(axis=1) / np.maximum(power, np.float32(1e-37))
        alive = np.flatnonzero(rng.random(len(share), np.float32) < share)
        ends.absorbed += len(share) - len(alive)
        before = _energy(weight[alive])
        ends.absorbed_energy += _energy(weight) - before
        weight = reflected[alive] / np.minimum(share[alive], np.float32(1))[:, None]
        ends.gained += _energy(weight) - before
        # A survivor leaves by the cosine to the geometric normal: a diffuse surface has the same radiance in all directions.
        surface = take(surface, alive)
        direction = cosine_directions(surface.ng, rng.random(len(alive), np.float32), rng.random(len(alive), np.float32))
        origin = world.leave(surface)
    ends.cut += len(origin)
    ends.cut_energy += _energy(weight)
    return ends


def shading_factor(surface: Surface, direction: np.ndarray) -> np.ndarray:
    """(n,) float32 |wi . ns| / |wi . ng| for particles arriving along `direction`, 0 from behind the shading normal.

    The adjoint of shading with interpolated normals (Veach 1997, section 5.3), exactly 1 where both normals are the same.
    """
    to_ns = np.maximum(-np.einsum("ij,ij->i", surface.ns, direction), np.float32(0))
    to_ng = -np.einsum("ij,ij->i", surface.ng, direction)
    return to_ns / np.maximum(to_ng, np.float32(1e-7))


def take(surface: Surface, which: np.ndarray) -> Surface:
    """Some of the points."""
    s = surface
    return Surface(s.triangle[which], s.u[which], s.v[which], s.position[which], s.ng[which], s.ns[which], s.side[which])


def _energy(weight: np.ndarray) -> float:
    return float(weight.sum(dtype=np.float64))
