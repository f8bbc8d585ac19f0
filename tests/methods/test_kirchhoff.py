"""T8, the Kirchhoff cavity: closed walls of any reciprocal BRDF with directional albedo a(theta) that emit 1 - a(theta) have radiance 1
at every point and in every direction. Rough lobes, by the walks that path tracing, distribution ray tracing and second passes share.

Mirrors are in test_path_lobes.py and test_whitted.py, direction bins and harmonics in their methods' own files.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder
from adjgi.adjoint_gi.core.lights.emission import Particles
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.sampling.maps import frame_rows
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import radiance
from adjgi.adjoint_gi.core.walks.particles import walk
from adjgi.solvers import load
from adjgi.solvers.distribution import DistributionSettings, DistributionTracer, Rows
from adjgi.tests.cie171 import receivers_at

load()
C = Color.of
WALLS = {
    "glossy": (Lobe("glossy", C(0.9), 0.4),),
    "sharp": (Lobe("glossy", C(0.8), 0.15),),
    "metal": (Lobe("metallic", C(0.8, 0.5, 0.3), 0.5),),
    "rough metal, many bounces": (Lobe("metallic", C(0.7, 0.5, 0.3), 0.7, multiscatter=True),),
    "coated": (Lobe("diffuse", C(0.6)), Lobe("specular", C(1.0), 0.3, 1.5)),
    "rough diffuse": (Lobe("rough diffuse", C(0.8, 0.5, 0.3), 0.8),),
    "rough diffuse, many bounces": (Lobe("rough diffuse", C(0.8, 0.5, 0.3), 1.0, multiscatter=True),),
    "mixed": (Lobe("diffuse", C(0.3)), Lobe("glossy", C(0.5), 0.3)),
}


@pytest.fixture(scope="module")
def filled(request):
    """One cavity for both tests of it, which pytest runs one after the other."""
    return cavity(WALLS[request.param])


every_wall = pytest.mark.parametrize("filled", WALLS, indirect=True)


def cavity(lobes):
    """A cube of one material and its directional emission, (n, 3) radiance towards directions (n, 3)."""
    b = SceneBuilder()
    b.box("Cavity", (0, 0, 0), (1, 1, 1), Material("Wall", (*lobes, Lobe("emission", C(1.0)))), inward=True)
    world = World(b.build())
    table = bsdf.BsdfTable(world.scene)
    albedo = albedo_table(table)

    def emission(triangle, u, v, towards):
        cosine = np.einsum("ij,ij->i", world.rows[triangle, 9:12], towards)
        at = np.clip(cosine * len(albedo) - 0.5, 0, len(albedo) - 1)
        low = np.minimum(at.astype(int), len(albedo) - 2)
        share = (at - low)[:, None]
        return (1 - albedo[low] * (1 - share) - albedo[low + 1] * share).astype(np.float32)

    return world, table, emission


def albedo_table(table, entries=64):
    """(entries, 3) directional albedo over the cosine, by quadrature over a hemisphere: no random numbers, no sampling of the lobe."""
    t = (np.arange(100) + 0.5) / 100
    z, weight = 1 - t**4, 4 * t**3 / 100  # dense near the pole, where narrow lobes are
    phi = 2 * np.pi * (np.arange(120) + 0.5) / 120
    zz, pp = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - zz**2)
    fixed = np.stack([r * np.cos(pp), r * np.sin(pp), zz], 1)
    out = np.empty((entries, 3))
    for i, mu in enumerate((np.arange(entries) + 0.5) / entries):
        wo = np.array([np.sqrt(1 - mu * mu), 0, mu])
        # Directions about the mirror direction, where the lobe is: the hemisphere's grid turned there; what falls below is left out.
        mirror = wo * (-1, -1, 1)
        x, y = frame_rows(mirror[None].astype(np.float32))
        wi = fixed[:, :1] * x + fixed[:, 1:2] * y + fixed[:, 2:] * mirror
        below = -fixed[:, :1] * x - fixed[:, 1:2] * y - fixed[:, 2:] * mirror
        total = np.zeros(3)
        for directions in (wi, below):
            n = len(directions)
            up = np.tile(np.float32([0, 0, 1]), (n, 1))
            zero = np.zeros(n, np.float32)
            at = table.at(np.zeros(n, np.int32), zero, zero, up, np.ones(n, np.float32), np.tile(wo, (n, 1)).astype(np.float32))
            value = bsdf.evaluate(at, directions.astype(np.float32))[0].astype(float)
            total += (value * np.repeat(weight, 120)[:, None]).sum(axis=0) / 120 * 2 * np.pi
        out[i] = total
    return out


def start(world, count, rng):
    """Points on the walls with directions all over the hemisphere."""
    points = receivers_at(world, np.array([(0.3, 0.4, 0.0), (0.0, 0.7, 0.2), (0.9, 0.5, 1.0), (0.02, 0.03, 0.0)]))
    pick = rng.integers(0, points.count, count)
    surface = world.surface(points.triangle[pick], points.u[pick], points.v[pick])
    z, phi = rng.random(count) * 0.95 + 0.05, 2 * np.pi * rng.random(count)
    r = np.sqrt(1 - z * z)
    x, y = frame_rows(surface.ng)
    wo = (r * np.cos(phi))[:, None] * x + (r * np.sin(phi))[:, None] * y + z[:, None] * surface.ng
    return surface, wo.astype(np.float32)


def check(total):
    mean, error = total.mean(axis=0), total.std(axis=0, ddof=1) / np.sqrt(len(total))
    # The quadrature of the albedo is good to a thousandth; the walk must know radiance 1 to better than half a percent.
    assert (error < 0.004).all(), f"too noisy to tell: {error}"
    assert (np.abs(mean - 1) < 4 * error + 0.002).all(), f"radiance {mean} +- {error}, not 1"


@every_wall
def test_walks_find_radiance_one(filled):
    world, table, emission = filled
    paths = radiance.Walk(world, Emitters(world), table, 0, 200, roulette_from=8, draw_lights=False, emission=emission)
    rng = np.random.default_rng(1)
    surface, wo = start(world, 40_000, rng)
    found = radiance.gather(paths, surface, radiance.lobes_of(paths, surface, wo), rng)
    own = emission(surface.triangle, surface.u, surface.v, wo)
    check((own + found.direct + found.indirect).astype(float))


def test_distributed_rays_find_radiance_one():
    world, table, emission = cavity(WALLS["mixed"])
    rng = np.random.default_rng(2)
    surface, wo = start(world, 8000, rng)
    receivers = receivers_at(world, np.array([(0.3, 0.4, 0.0)]))
    settings = DistributionSettings(brdf_samples=4, split_depth=2, sampling="independent", max_length=200)
    tracer = DistributionTracer(world, Emitters(world), receivers, settings, 1)
    tracer.walk = dataclasses.replace(tracer.walk, draw_lights=False, emission=emission)
    rows = Rows(np.zeros(len(wo), np.int64), np.arange(len(wo)), len(wo))
    vertices = radiance.LobeVertices(tracer.walk, surface, radiance.lobes_of(tracer.walk, surface, wo))
    found = tracer.trace(vertices, rows, 1, rng)
    own = emission(surface.triangle, surface.u, surface.v, wo)
    check((own + found.direct + found.indirect).astype(float))


@every_wall
def test_particles_bring_the_irradiance_of_radiance_one(filled):
    """T8 by shooting: particles that leave the walls as 1 - a(theta) bring the irradiance pi to every wall."""
    world, table, emission = filled
    rng = np.random.default_rng(3)
    n = 60_000
    # Points uniform on the walls, directions by the cosine: each stands for an equal share of pi times area, times what is emitted there.
    triangle = rng.choice(world.triangle_count, n, p=world.area / world.area.sum()).astype(np.int32)
    a, b = rng.random((2, n))
    s = np.sqrt(a)
    surface = world.surface(triangle, (1 - s).astype(np.float32), (b * s).astype(np.float32))
    x, y = frame_rows(surface.ng)
    r, phi = np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    z = np.sqrt(1 - r * r)
    direction = ((r * np.cos(phi))[:, None] * x + (r * np.sin(phi))[:, None] * y + z[:, None] * surface.ng).astype(np.float32)
    weight = emission(triangle, surface.u, surface.v, direction) * np.float32(np.pi * world.area.sum() / n)
    particles = Particles(world.leave(surface), direction, weight, np.zeros(n, np.int32), np.zeros(n, np.float32))
    arrived = np.zeros((world.triangle_count, 3))

    def visit(hits):
        for c in range(3):
            arrived[:, c] += np.bincount(hits.surface.triangle, hits.arriving[:, c], world.triangle_count)

    walk(world, particles, 200, rng, visit, table)
    # Two triangles a wall; the standard error of a wall's flux is about 1 %, of all walls together 0.4 %.
    walls = arrived.reshape(6, 2, 3).sum(axis=1)
    assert np.abs(walls / np.pi - 1).max() < 0.06
    assert np.abs(walls.mean(axis=0) / np.pi - 1).max() < 0.015
