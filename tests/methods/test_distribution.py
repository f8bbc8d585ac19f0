"""Distribution ray tracing against closed forms: direct light, truncated furnaces, gloss, lens; and against plain walks."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import microfacet
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.sampling.sets import SAMPLERS, Sampler
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.radiance import Walk, gather, lobes_of
from adjgi.solvers import distribution  # noqa: F401
from adjgi.tests import scenes, solving
from adjgi.tests.solving import view
from adjgi.tests.surface_points import receivers_at

Z = 4.0  # standard deviations that a sound method exceeds once in three hundred runs of the 50 z-tests here
SAMPLING = [kind for kind, _, _ in SAMPLERS]
solve = partial(solving.solve, "distribution", seed=1)
agrees = partial(solving.agrees, z=Z)


# ---- direct light (verification page, 2.2)


def above_floor(kind):
    """A scene, a point on its floor and the irradiance there."""
    b = SceneBuilder()
    b.quad("Floor", (-4, -4, 0), (8, 0, 0), (0, 8, 0), diffuse("Floor", 0.5))
    if kind == "square":
        b.light(Light("Lamp", "area", (2, 2, 2), (0.5, 0.5, 1), size_x=1, size_y=1))
        return b, (0.5, 0.5, 0), 2 * math.pi * 0.23945647046077354
    if kind == "corner of a mesh":
        b.quad("Lamp", (0, 0, 1), (0, 1, 0), (1, 0, 0), diffuse("Lamp", 0, 2))
        return b, (0, 0, 0), 2 * math.pi * 0.13853160599489298
    if kind == "disk":
        b.light(Light("Lamp", "area", (3, 3, 3), (0, 0, 2), size_x=2, size_y=2, shape="ELLIPSE"))
        return b, (0, 0, 0), 3 * math.pi / 5
    if kind == "sphere":
        b.light(Light("Lamp", "point", (math.pi,) * 3, (0, 0, 3), radius=1.0))
        return b, (0, 0, 0), math.pi / 9
    if kind == "point":
        b.light(Light("Lamp", "point", (4, 4, 4), (0, 0, 2)))
        return b, (1, 0, 0), 4 * 2 / 5**1.5
    b.background = (0.7, 0.7, 0.7)
    return b, (0, 0, 0), 0.7 * math.pi


@pytest.mark.parametrize("joined", [True, False])
@pytest.mark.parametrize("kind", ["square", "corner of a mesh", "disk", "sphere", "point", "world"])
@pytest.mark.parametrize("sampling", SAMPLING)
def test_direct_light(kind, sampling, joined):
    b, point, expected = above_floor(kind)
    world = World(b.build())
    found = solve(world, receivers_at(world, [point], copies=600), samples=16, sampling=sampling, joined=joined, max_length=1)
    assert (found.indirect == 0).all()
    values = found.direct[:, 0]
    if np.ptp(values) < 1e-4 * expected:
        np.testing.assert_allclose(values, expected, rtol=2e-4)
    else:
        agrees(values, expected, bias=1e-5 * expected)


@pytest.mark.parametrize("split_depth", [0, 1])
def test_light_rays_alone_leave_the_world_to_brdf_rays(split_depth):
    b, point, expected = above_floor("world")
    world = World(b.build())
    found = solve(world, receivers_at(world, [point], copies=9), joined=False, split_depth=split_depth)
    np.testing.assert_allclose(found.direct, expected, rtol=2e-4)


@pytest.mark.parametrize("split_depth", [0, 1])
@pytest.mark.parametrize("joined", [True, False])
def test_a_mirror_in_the_coat_does_not_count_lamps_twice(split_depth, joined):
    """Diffuse light of a large lamp, whose image lies elsewhere."""
    b = SceneBuilder()
    mixed = Material("Mixed", (Lobe("diffuse", Color.of(0.5)), Lobe("glossy", Color.of(0.4), 0.0)))
    b.quad("Floor", (-4, -4, 0), (8, 0, 0), (0, 8, 0), mixed)
    b.light(Light("Lamp", "area", (2, 2, 2), (0, 0, 1), size_x=1, size_y=1))
    world, camera = view(b, (-0.8, 0, 0.8), (1, 0, -1), 1e-3, 20)
    found = solve(world, camera, samples=16, joined=joined, split_depth=split_depth).quantity("radiance")[:, 0]
    agrees(found, 0.5 * 2 * 0.23945647046077354)


@pytest.mark.parametrize("sampling", ["jittered", "sobol"])
@pytest.mark.parametrize("samples", [9, 16])
def test_even_numbers_have_no_more_variance(sampling, samples):
    """Soft shadow and penumbra: fewer errors than independent numbers; in an open place many fewer."""
    b, _, _ = above_floor("square")
    b.quad("Blocker", (0.2, -1, 0.5), (0.8, 0, 0), (0, 3, 0), diffuse("Black", 0))
    world = World(b.build())
    for x, most in ((0.3, 0.9), (3.0, 0.5)):
        receivers = receivers_at(world, [(x, 0.5, 0)], copies=1500)
        options = {"samples": samples, "max_length": 1, "light_samples": 1, "joined": False}
        plain = solve(world, receivers, sampling="independent", **options).direct[:, 0]
        even = solve(world, receivers, sampling=sampling, **options).direct[:, 0]
        assert even.var() < most * plain.var()
        assert abs(even.mean() - plain.mean()) < Z * math.sqrt((even.var() + plain.var()) / 1500)


# ---- interreflection


@pytest.mark.parametrize("split_depth", [0, 1, 2])
@pytest.mark.parametrize("joined", [True, False])
def test_partial_sums_of_the_furnace(split_depth, joined):
    """T1, rho = 0.5, cut off after n reflections: 1, 1.5, 1.75, 1.875, 1.9375 ..., and 2 without a limit."""
    # Light rays alone are too noisy in the corners of a cube, where walls that shine touch: a ball of triangles is as exact.
    world = World(scenes.cube(0.5, 1.0) if joined else scenes.two_zone_sphere(3, (1.0, 1.0), (0.5, 0.5)))
    rng = np.random.default_rng(3)
    n = ((1200, 400, 300) if joined else (1200, 400, 800))[split_depth]  # for a standard error of 0.35 % at most
    u, v = rng.random((2, n))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    triangle = rng.choice(world.triangle_count, n, p=world.area / world.area.sum())
    receivers = SurfaceReceivers("texels", np.arange(n + 1), triangle, u, v)
    for length, expected in enumerate((1, 1.5, 1.75, 1.875, 1.9375)):
        found = solve(
            world, receivers, samples=(9, 9, 4)[split_depth], split_depth=split_depth, joined=joined, max_length=length, light_samples=2
        )
        if length == 0:
            np.testing.assert_allclose(found.quantity("radiosity"), 1.0, rtol=1e-6)
        else:
            agrees(found.quantity("radiosity")[:, 0], expected)
    found = solve(world, receivers, samples=16, split_depth=split_depth, joined=joined, light_samples=2, brdf_samples=2)
    agrees(found.quantity("radiosity")[:, 0], 2.0)


def test_two_zone_sphere():
    """T3: irradiance 1 everywhere, which uniform instead of cosine directions miss by far."""
    world = World(scenes.two_zone_sphere(4))
    n = world.triangle_count
    third = np.full(n, 1 / 3, np.float32)
    found = solve(world, SurfaceReceivers("texels", np.arange(n + 1), np.arange(n), third, third), samples=4)
    # Flat triangles lie inside the ball: their share of what they see of each other leaves a bias of a quarter percent.
    agrees(found.quantity("irradiance")[:, 0] * world.area / world.area.mean(), 1.0, bias=0.003)


@pytest.mark.parametrize("joined", [True, False])
def test_cavity_of_mirrors_and_diffuse_walls(joined):
    """T8: every wall emits what it does not reflect, mirrors too, so that the radiance is 1 everywhere."""
    mirror = Material("Mirror", (Lobe("glossy", Color.of(0.7), 0.0), Lobe("emission", Color.of(0.3))))
    wall = diffuse("Wall", 0.6, 0.4)
    # A ball of triangles, one in three a mirror: light rays alone are too noisy in corners where walls that shine touch.
    vertices, triangles = scenes.icosphere(2)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles[:, ::-1], [mirror, wall], which=np.minimum(np.arange(len(triangles)) % 3, 1))
    found = solve(*view(b, (0.4, 0.3, 0.1), (-1, 0.3, -0.4), 1.0, 24), samples=16, joined=joined)
    agrees(found.quantity("radiance").mean(axis=1), 1.0)


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
def test_gloss_reflects_its_albedo(roughness):
    """A glossy plate in a uniform world sends back the albedo of its lobe, the integral of the BRDF, at 45 degrees."""
    b = SceneBuilder()
    b.quad("Plate", (-1, -1, 0), (2, 0, 0), (0, 2, 0), Material("Gloss", (Lobe("glossy", Color.of(1), roughness),)))
    b.background = (1, 1, 1)
    found = solve(*view(b, (-1, 0, 1), (1, 0, -1), 1e-3, 16), samples=64)
    rng = np.random.default_rng(0)
    n = 400_000
    wo = np.tile(np.array((math.sqrt(0.5), 0, math.sqrt(0.5)), np.float32), (n, 1))
    alpha = np.full(n, roughness**2, np.float32)
    # An estimate of its own: directions uniform over the hemisphere, D G / (4 cos cos) cos 2 pi.
    z, phi = rng.random(n), 2 * np.pi * rng.random(n)
    s = np.sqrt(1 - z * z)
    wi = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1).astype(np.float32)
    h = (wo + wi) / np.linalg.norm(wo + wi, axis=1)[:, None]
    value = microfacet.distribution(h, alpha) * microfacet.masking(wo, wi, alpha) / (4 * wo[:, 2]) * 2 * np.pi
    ours = found.quantity("radiance")[:, 0]
    error = math.hypot(value.std() / math.sqrt(n), ours.std() / math.sqrt(len(ours)))
    assert error < 0.02
    assert abs(value.mean() - ours.mean()) < Z * error


def glossy_cornell(size, roughness=0.3):
    """The Cornell box with a glossy and a coated box. The lamp hangs lower: light rays alone are too noisy on a ceiling close to it."""
    scene = scenes.cornell(size, size)
    vertices = scene.vertices.copy()
    lamp = next(o for o in scene.objects if o.name == "Lamp")
    vertices[lamp.first_vertex : lamp.first_vertex + lamp.vertex_count, 2] = 0.8
    materials = list(scene.materials)
    for o in scene.objects:
        m = scene.material[o.first_triangle]
        if o.name.startswith("Tall"):
            materials[m] = Material("Gloss", (Lobe("glossy", Color.of(0.8), roughness),))
        if o.name.startswith("Short"):
            materials[m] = Material("Coat", (Lobe("diffuse", Color.of(0.4, 0.4, 0.7)), Lobe("specular", Color.of(1), roughness + 0.1, 1.5)))
    return World(dataclasses.replace(scene, vertices=vertices, materials=tuple(materials)))


def single_walks(world, camera):
    """Six pictures of the glossy Cornell box, (6, 400, 3), by walks that never split, up to path length 5."""
    walk = Walk(world, Emitters(world), BsdfTable(world.scene), 0, 5, 1 << 30)
    rng = np.random.default_rng(8)
    others = []
    for _ in range(6):
        owner = np.repeat(np.arange(camera.count), 144)
        points = camera.sample(owner, rng)
        on = np.flatnonzero(points.triangle >= 0)
        s = world.surface(points.triangle[on], points.u[on], points.v[on], points.towards[on])
        found = gather(walk, s, lobes_of(walk, s, points.towards[on]), rng)
        value = np.zeros((len(owner), 3))
        value[on] = found.direct + found.indirect + world.emission(s)
        others.append(value.reshape(camera.count, 144, 3).mean(axis=1))
    return np.array(others)


@pytest.mark.parametrize(
    ("roughness", "options"),
    [(0.3, {}), (0.7, {"joined": False, "sampling": "sobol"}), (0.3, {"split_depth": 2, "brdf_samples": 2})],
)
def test_agrees_with_single_walks(roughness, options):
    """Blocks of the picture of a glossy Cornell box agree with walks that never split, within noise.

    Light rays alone find a sharp gloss so seldom that no test of means holds; there the gloss is rougher.
    """
    world = glossy_cornell(20, roughness)
    camera = CameraReceivers(world)
    runs = [solve(world, camera, seed=seed, samples=9, max_length=5, **options).quantity("radiance") for seed in range(6)]

    def blocks(pictures):
        return np.array(pictures).reshape(6, 4, 5, 4, 5, 3).mean(axis=(2, 4, 5))

    a, b = blocks(runs), blocks(single_walks(world, camera))
    # Sixteen blocks, standard errors of six runs each: t of 10 degrees of freedom exceeds 6.2 in one of ten thousand.
    t = (a.mean(axis=0) - b.mean(axis=0)) / np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 6)
    assert np.abs(t).max() < 6.2
    whole_a, whole_b = a.mean(axis=(1, 2)), b.mean(axis=(1, 2))
    error = math.sqrt((whole_a.var(ddof=1) + whole_b.var(ddof=1)) / 6)
    assert error < 0.015 * whole_b.mean()
    assert abs(whole_a.mean() - whole_b.mean()) < 5 * error


# ---- depth of field


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize(("distance", "focus"), [(2.0, 4.0), (6.0, 4.0), (4.0, 4.0)])
def test_blur_of_a_small_light(kind, distance, focus):
    """A small light at `distance` spreads over a disk of radius R |f - d| / d on the plane of focus (R |f - d| / f without perspective)."""
    radius, side, size = 0.3, 0.06, 48
    b = SceneBuilder()
    # As large from the camera as a square of `side` in the plane of focus.
    half = 0.5 * side * (distance / focus if kind == "perspective" else 1)
    b.quad("Light", (-half, -half, -distance), (2 * half, 0, 0), (0, 2 * half, 0), diffuse("Light", 0, 1.0))
    window = 0.4 / (focus if kind == "perspective" else 1)
    world, camera = view(b, (0, 0, 0), (0, 0, -1), window, size, kind, aperture_radius=radius, focus_distance=focus, clip_start=0.1)
    found = solve(world, camera, samples=400, max_length=0).quantity("radiance")[:, 0].astype(float).reshape(size, size)
    x = (np.arange(size) + 0.5) / size * 0.8 - 0.4
    xx, yy = np.meshgrid(x, x)
    blur = radius * abs(focus - distance) / (distance if kind == "perspective" else focus)
    # Step 1: no light is lost; in perspective the sum over the plane of focus is the light's area there.
    assert found.sum() * (0.8 / size) ** 2 == pytest.approx(side**2, rel=0.05)
    # Step 2: the second moment of a disk is half its radius squared, that of the square a sixth of its side's, of a pixel likewise.
    second = (found * (xx**2 + yy**2)).sum() / found.sum()
    assert second == pytest.approx(blur**2 / 2 + side**2 / 6 + (0.8 / size) ** 2 / 6, rel=0.05, abs=3e-5)
    # Step 3: nothing lies outside.
    assert np.hypot(xx, yy)[found > 0].max() < blur + side + 0.8 / size


def test_focus_is_sharp_and_can_be_switched_off():
    b = SceneBuilder()
    b.quad("Light", (-0.1, -0.1, -2), (0.2, 0, 0), (0, 0.2, 0), diffuse("Light", 0, 1.0))
    world, camera = view(b, (0, 0, 0), (0, 0, -1), 0.2, 16, aperture_radius=0.3, focus_distance=4.0)
    sharp = solve(world, camera, samples=16, max_length=0, depth_of_field=False).quantity("radiance")[:, 0]
    assert set(np.round(sharp, 6)) == {0.0, 1.0}
    blurred = solve(world, camera, samples=16, max_length=0).quantity("radiance")[:, 0]
    assert ((blurred > 0.02) & (blurred < 0.98)).sum() > 60
    # Fixed sites, and so the other methods, see through a pinhole.
    sites = np.concatenate([p.triangle for p in camera.sites()])
    assert (sites >= 0).mean() == pytest.approx(sharp.mean(), abs=1e-6)


# ---- bits and edges


@pytest.mark.parametrize("sampling", SAMPLING)
def test_a_seed_gives_the_same_bits_for_any_number_of_threads(monkeypatch, sampling):
    world = glossy_cornell(40)
    found = []
    for threads, seed in (("1", 1), ("2", 1), ("2", 2)):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        found.append(solve(world, CameraReceivers(world), seed=seed, samples=4, sampling=sampling).quantity("radiance"))
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[1], found[2])


def test_lengths_add_up():
    """Direct light and what is longer, run apart, make the whole."""
    world = World(scenes.cube(0.5, 1.0))
    receivers = SurfaceReceivers("texels", np.arange(401), np.zeros(400), *np.full((2, 400), 0.3, np.float32))
    parts = [solve(world, receivers, min_length=a, max_length=b, samples=16) for a, b in ((0, 0), (1, 1), (2, 3))]
    total = sum(np.float64(p.quantity("radiosity")[:, 0]) for p in parts)
    agrees(total, 1.875)
    assert (parts[1].emitted == 0).all()
    assert (parts[2].direct == 0).all()


def test_every_surface_that_splits_has_random_numbers_of_its_own(monkeypatch):
    """Lights and BRDF rays at each of two surfaces, and the place in the pixel: five streams, each of sets of one size."""
    asked, draw = set(), Sampler.draw

    def noted(self, stream, total, receiver, index, dimensions, rng):
        asked.add((stream, total, dimensions))
        return draw(self, stream, total, receiver, index, dimensions, rng)

    monkeypatch.setattr(Sampler, "draw", noted)
    b, place, _ = above_floor("square")
    b.box("Room", (-4, -4, 0), (4, 4, 4), diffuse("Grey", 0.5), inward=True)
    world = World(b.build())
    solve(world, receivers_at(world, [place]), samples=2, light_samples=3, brdf_samples=5, split_depth=2, sampling="jittered")
    found = sorted((total, dimensions) for _, total, dimensions in asked)
    assert found == [(2, 2), (6, 3), (10, 4), (30, 3), (50, 4)] and len({stream for stream, *_ in asked}) == 5
