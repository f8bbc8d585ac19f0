"""Particle tracing against exact solutions: counts, furnaces, two-zone sphere, snowman, lamps, statistics of the walk."""

from __future__ import annotations

import dataclasses
import math
import sys

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.tally import Tally
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.particles import walk
from adjgi.solvers.particle_tracing import empty_notices
from adjgi.tests import scenes
from adjgi.tests.particles import Z, agrees, by_material, front, on_elements, replicates, solve

module = sys.modules[type(method("particle_tracing")).__module__]


def box_with_lamp(rho=0.5, color=(1.0, 1.0, 1.0), **options):
    """A closed unit cube with a point lamp inside."""
    b = SceneBuilder()
    b.box("Cube", (0, 0, 0), (1, 1, 1), diffuse("Wall", rho), inward=True)
    b.light(Light("Lamp", "point", color, (0.4, 0.5, 0.6), **options))
    return b.build()


# ---- counts and energy


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_every_particle_is_accounted_for(rho):
    """T2 by count: emitted = absorbed + escaped + cut in integers; in a closed box none escapes."""
    world, receivers = on_elements(box_with_lamp(rho))
    solution = solve(world, receivers, 100_000)
    emitted, absorbed, escaped, cut = solution.balance.particles
    assert emitted == 100_000
    assert emitted == absorbed + escaped + cut
    # Only a hit within the ray offset (2e-6) of an edge can slip through.
    assert escaped <= 3
    assert solution.balance.emitted == pytest.approx(3 * 4 * math.pi, rel=1e-6)
    assert solution.balance.gap < 1e-6


def test_an_open_scene_counts_what_escapes():
    """A panel alone: every particle escapes; over a black floor those that hit it are absorbed."""
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 1), (1, 0, 0), (0, 1, 0), diffuse("Lamp", 0, 1.0))
    world, receivers = on_elements(b.build())
    assert solve(world, receivers, 10_000).balance.particles == (10_000, 0, 10_000, 0)
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))
    world, receivers = on_elements(b.build())
    emitted, absorbed, escaped, cut = solve(world, receivers, 100_000).balance.particles
    assert (emitted, cut) == (100_000, 0)
    assert absorbed + escaped == emitted
    # Half of the particles leave downwards, a share F of them meets the floor; binomial, if anything spread more evenly.
    share = 0.19982489569838746 / 2
    assert abs(absorbed - emitted * share) < Z * math.sqrt(emitted * share * (1 - share))


def test_each_colour_has_its_own_albedo():
    """T2 for each colour: mean irradiance = power / (area (1 - rho)), although the walk is chosen by all colours together."""
    rho, color = (0.8, 0.5, 0.1), (1.0, 2.0, 3.0)
    mean, error = replicates(box_with_lamp(rho, color), front, particles=20_000, max_length=200)
    expected = 4 * math.pi * np.array(color) / (6 * (1 - np.array(rho)))
    agrees(mean[0], error[0], expected, resolution=0.006)


def test_absorbed_power_is_what_was_emitted_for_unequal_areas():
    """T2 for any albedo: sum of area (1 - rho) irradiance = power."""
    b = SceneBuilder()
    rho = (0.5, 0.5, 0.63, 0.14, 0.2, 0.8)
    b.box("Room", (0, 0, 0), (4, 4, 3), [diffuse(f"Face{i}", r) for i, r in enumerate(rho)], inward=True)
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (1.0, 1.0, 2.0)))
    mean, error = replicates(b.build(), by_material, runs=24, particles=40_000)
    area = np.array([12, 12, 12, 12, 16, 16.0])
    weight = area * (1 - np.array(rho))
    total = (weight[:, None] * mean).sum(axis=0)
    agrees(total, np.sqrt(((weight[:, None] * error) ** 2).sum(axis=0)), np.full(3, 4 * math.pi))


# ---- exact solutions


@pytest.mark.parametrize("rho,particles", [(0.5, 30_000), (0.8, 15_000)])
def test_furnace(rho, particles):
    """T1: radiosity 1 / (1 - rho) everywhere; direct irradiance 1."""
    solution = {}
    for part in ("direct", "indirect"):
        solution[part] = replicates(scenes.cube(rho, 1.0), front, particles=particles, part=part, max_length=100)
    agrees(*(x[0] for x in solution["direct"]), np.ones(3))
    agrees(*(x[0] for x in solution["indirect"]), np.full(3, 1 / (1 - rho) - 1))


@pytest.mark.parametrize("longest", [0, 1, 2, 3, 4, 5])
def test_a_longest_path_gives_the_partial_sums(longest):
    """T1 with rho 0.5: radiosity 1, 1.5, 1.75, ... = 2 - 0.5^n; the rest is counted as cut."""
    world, receivers = on_elements(scenes.cube(0.5, 1.0))
    solution = solve(world, receivers, 200_000, max_length=longest)
    radiosity = solution.quantity("radiosity")[::2].astype(float)
    area = receivers.elements.area
    mean = (area[:, None] * radiosity).sum(axis=0) / area.sum()
    # Of the 100,000 that go inwards each further hit is binomial.
    assert np.abs(mean - (2 - 0.5**longest)).max() < Z * 0.5 * math.sqrt(2 / 100_000) + 1e-6
    emitted, absorbed, escaped, cut = solution.balance.particles
    assert emitted == absorbed + escaped + cut
    share = 0.5**longest if longest else 2.0  # nothing flies: also those that would have left the box
    assert abs(cut - 100_000 * share) <= Z * math.sqrt(100_000 * share) * (longest > 0)
    assert solution.balance.unshot == pytest.approx(cut * 36 / 200_000, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("shortest,direct,indirect,emitted", [(0, 1, 0.75, 1), (1, 1, 0.75, 0), (2, 0, 0.75, 0), (3, 0, 0.25, 0)])
def test_a_shortest_path_leaves_out_what_is_shorter(shortest, direct, indirect, emitted):
    world, receivers = on_elements(scenes.cube(0.5, 1.0))
    solution = solve(world, receivers, 100_000, min_length=shortest, max_length=3)
    for name, expected in (("direct", direct), ("indirect", indirect), ("emitted", emitted)):
        values = solution.quantity(name)[::2].mean(axis=0)
        np.testing.assert_allclose(values, expected, atol=0.02 if expected else 1e-12)


def test_two_zone_sphere():
    """T3: irradiance is 1 in both halves. It rejects directions that are not cosine distributed."""
    mean, error = replicates(scenes.two_zone_sphere(4), by_material, particles=40_000, runs=24, target=4000)
    # The sphere is a polyhedron of 5,120 faces: its area is 0.1 % smaller.
    agrees(mean, error, np.ones((2, 3)), bias=0.002)


@pytest.mark.parametrize("c,rho", [(0.1, (0.5, 0.5)), (0.1, (0.7, 0.4))])
def test_two_rooms_joined_by_a_door(c, rho):
    """T6: the radiosities of both rooms; only a sixth of the light gets through the door."""
    emission = (1.0, 0.0)
    mean, error = replicates(scenes.snowman(3, c, rho, emission), by_material, particles=50_000, runs=20, target=1000)
    radiosity = np.array(scenes.snowman_answer(c, rho, emission))
    irradiance = (radiosity - emission) / rho
    agrees(mean, error, np.repeat(irradiance[:, None], 3, axis=1), bias=0.004, resolution=0.008)


@pytest.mark.parametrize("options,share", [({}, 1.0), ({"radius": 0.5, "soft_falloff": True}, 1 / 1.25)])
def test_point_light_in_a_sphere(options, share):
    """T12: irradiance I / (1 - rho) at distance 1; with soft falloff a wall that faces the lamp sees I / (1 + radius^2)."""
    vertices, triangles = scenes.icosphere(4)
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles[:, ::-1], diffuse("Wall", 0.5))
    b.light(Light("Lamp", "point", (math.pi,) * 3, **options))
    mean, error = replicates(b.build(), front, particles=30_000, target=4000)
    agrees(mean[0], error[0], np.full(3, 2 * math.pi * share), bias=0.01)


def test_sun_and_background_on_an_open_floor():
    """A sun gives E cos, a background pi L, each particle counted on the side that it meets."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.light(Light("Sun", "sun", (2.0, 1.0, 0.5), axis_z=(0.6, 0.0, 0.8)))
    b.background = (0.1, 0.2, 0.4)
    both = lambda e: np.arange(2 * e.count) % 2  # noqa: E731
    mean, error = replicates(b.build(), both, particles=100_000)
    sky = math.pi * np.array([0.1, 0.2, 0.4])
    agrees(mean, error, [0.8 * np.array([2.0, 1.0, 0.5]) + sky, sky], resolution=0.006)


def test_shading_normals_are_used_as_their_adjoint_demands():
    """A floor with bent normals under a slanted sun: irradiance E cos(sun, ns); it reflects rho times that by the cosine to ng."""
    tilt = np.array([math.sin(0.5), 0, math.cos(0.5)])
    b = SceneBuilder()
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    b.mesh("Floor", corners, np.array([[0, 1, 2], [0, 2, 3]]), diffuse("Grey", 0.5), smooth_normals=np.tile(tilt, (4, 1)))
    b.quad("Ceiling", (0, 0, 1), (0, 1, 0), (1, 0, 0), diffuse("Black", 0))
    sun = (math.sin(1.05), 0.0, math.cos(1.05))  # slanted enough to come in below the ceiling
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0), axis_z=sun))
    mean, error = replicates(b.build(), by_material, particles=100_000, runs=24)
    bent = float(tilt @ sun)
    assert bent > 1.5 * sun[2]
    agrees(mean[0], error[0], np.full(3, bent))
    agrees(mean[1], error[1], np.full(3, 0.5 * bent * 0.19982489569838746), resolution=0.006)


# ---- the walk


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_length_of_walks_is_geometric(rho):
    """Hits of a walk in a closed box: mean 1 / (1 - rho), variance rho / (1 - rho)^2, and every probability (chi-square)."""
    world = World(box_with_lamp(rho))
    emission, rng = Emission(world), np.random.default_rng(8)
    n, alive = 100_000, []
    walk(world, emission.draw(n, rng), 1000, rng, lambda hits: alive.append(len(hits.row)))
    assert alive[0] == n
    ended = -np.diff([*alive, 0])
    k = np.arange(1, len(ended) + 1)
    mean = (ended * k).sum() / n
    variance = (ended * (k - mean) ** 2).sum() / n
    sigma2 = rho / (1 - rho) ** 2
    assert abs(mean - 1 / (1 - rho)) < Z * math.sqrt(sigma2 / n)
    # Excess kurtosis of a geometric distribution is 6 + 1 / sigma^2.
    assert abs(variance - sigma2) < Z * sigma2 * math.sqrt((8 + 1 / sigma2) / n)
    expected = n * (1 - rho) * rho ** (k - 1)
    used = expected >= 5
    chi = ((ended - expected) ** 2 / expected)[used].sum()
    assert chi < used.sum() + Z * math.sqrt(2 * used.sum()) + Z**2


def test_error_falls_with_the_square_root_of_particles():
    """Root mean square error of the elements of T1 over 2^12 .. 2^17 particles: slope -0.5, or steeper by even emission."""
    world, receivers = on_elements(scenes.cube(0.5, 1.0), target=24)
    counts = 2 ** np.arange(12, 18)
    rms = []
    for n in counts:
        errors = [solve(world, receivers, int(n), seed=s).quantity("irradiance")[::2] - 2.0 for s in range(4)]
        rms.append(np.sqrt(np.mean(np.square(errors))))
    slope = np.polyfit(np.log(counts), np.log(rms), 1)[0]
    assert -0.65 < slope < -0.4


def test_history_tells_the_error():
    """The relative standard error that is reported against the one that is known."""
    b = SceneBuilder()
    b.box("Cube", (0, 0, 0), (1, 1, 1), diffuse("Wall", 0.5), inward=True)
    b.light(Light("Lamp", "area", (1.0,) * 3, (0.5, 0.5, 0.9), size_x=0.5, size_y=0.5))
    world, receivers = on_elements(b.build(), target=400)
    runs = [solve(world, receivers, 64_000, seed=s) for s in range(12)]
    values = np.array([r.quantity("irradiance")[::2].sum(axis=1) for r in runs], float)
    known = math.sqrt(values.var(axis=0, ddof=1).mean() / (values.mean(axis=0) ** 2).mean())
    told = np.mean([r.history[-1][1] for r in runs])
    assert told == pytest.approx(known, rel=0.1)


# ---- receivers


def test_camera_sees_the_furnace_in_parts():
    """A camera in T1: emitted 1 / pi, direct and indirect half of that, for rho 0.5; unsmoothed elements beside it."""
    scene = scenes.cube(0.5, 1.0)
    camera = Camera("perspective", (0.5, 0.2, 0.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-1, 1, -1, 1), 16, 16)
    world = World(dataclasses.replace(scene, camera=camera))
    solution = solve(world, CameraReceivers(world), 200_000, max_edge=0.25)
    assert solution.measure == "radiance"
    for name, expected in (("emitted", 1), ("direct", 0.5), ("indirect", 0.5), ("radiance", 2)):
        values = np.pi * solution.quantity(name)
        assert abs(values.mean() - expected) < 0.02 * (name != "emitted") + 1e-6
        assert values.shape == (256, 3)
    np.testing.assert_allclose(solution.extra["elements"].mean(), 2, atol=0.05)
    assert solution.rays > 200_000


def test_texels_get_irradiance_between_elements():
    world = World(scenes.cube(0.5, 1.0))
    n = 50
    rng = np.random.default_rng(3)
    u, v = rng.random((2, 4 * n)) * 0.5
    receivers = SurfaceReceivers("texels", np.arange(n + 1) * 4, rng.integers(0, 12, 4 * n), u, v)
    solution = solve(world, receivers, 200_000, max_edge=0.5)
    assert solution.direct.shape == (n, 3) and solution.direct.dtype == np.float32
    np.testing.assert_allclose(solution.quantity("irradiance"), 2, atol=0.15)
    np.testing.assert_allclose(solution.emitted, 1, rtol=1e-6)
    np.testing.assert_allclose(solution.albedo, 0.5, rtol=1e-6)
    assert (solution.weight > 0).all()


# ---- running


def test_same_seed_same_bits_for_any_number_of_threads(monkeypatch):
    world, receivers = on_elements(scenes.cornell())
    results = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        results.append(solve(world, receivers, 60_000, seed=5))
    for other in results[1:]:
        for name in ("direct", "indirect"):
            assert np.array_equal(getattr(results[0], name), getattr(other, name))
        assert other.balance == results[0].balance
    assert not np.array_equal(results[0].direct, solve(world, receivers, 60_000, seed=6).direct)


def test_steps_tell_true_progress_and_can_be_kept():
    world, receivers = on_elements(scenes.cornell())
    solver = method("particle_tracing")
    steps = solver.solve(world, receivers, solver.Settings(particles=100_000), np.random.default_rng(1))
    seen = []
    for step in steps:
        seen.append(step.fraction)
        if step.fraction >= 0.5:
            break
    partial = step.solution()
    assert partial.partial
    assert partial.balance.particles[0] == pytest.approx(100_000 * step.fraction, abs=1)
    # Going on gives the same as never having stopped.
    *rest, last = steps
    assert [s.fraction for s in rest] == sorted(s.fraction for s in rest)
    assert last.fraction == 1.0
    final = last.solution()
    assert not final.partial
    assert np.array_equal(final.direct, solve(world, receivers, 100_000).direct)
    # The partial result is the finished one but for noise.
    assert np.abs(partial.direct.mean() / final.direct.mean() - 1) < 0.02


def test_a_stopped_solve_ends_its_threads():
    import threading

    world, receivers = on_elements(scenes.cornell())
    solver = method("particle_tracing")
    steps = solver.solve(world, receivers, solver.Settings(particles=10_000_000), np.random.default_rng(1))
    while next(steps).fraction == 0:
        pass
    steps.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("adjoint_gi")]


def test_power_of_each_light_is_recorded():
    scene = scenes.cornell()
    scene = dataclasses.replace(scene, lights=(Light("Bulb", "point", (1.0, 0.5, 0.25), (0.5, 0.5, 0.5)),))
    world, receivers = on_elements(scene)
    solution = solve(world, receivers, 50_000)
    assert Emission(world).names == ("Lamp", "Bulb")
    np.testing.assert_allclose(solution.extra["light_flux"], Emission(world).flux, rtol=2e-3)


def test_a_scene_without_light_is_black_and_says_so():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    world, receivers = on_elements(b.build())
    solution = solve(world, receivers)
    assert not solution.direct.any() and not solution.indirect.any()
    assert solution.balance.particles == (0, 0, 0, 0)
    assert any("nothing emits" in str(w) for w in solution.warnings)


def test_what_is_replaced_is_said():
    b = SceneBuilder()
    shiny = Material("Shiny", (Lobe("glossy", Color.of(0.5), 0.2),))
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), shiny)
    b.light(Light("Ghost", "point", (1.0, 1.0, 1.0), (0.5, 0.5, 1.0), shadow=False))
    world, receivers = on_elements(b.build())
    text = " ".join(str(w) for w in solve(world, receivers, 1000).warnings)
    assert "Ghost" in text and "Shiny" not in text


def test_batches_have_almost_equal_sizes_and_add_up():
    for n, sides in ((1, 4), (1000, 10**6), (1024, 0), (50_000, 20_000), (3_000_001, 10**6)):
        sizes = module.batch_sizes(n, sides)
        assert sum(sizes) == n and max(sizes) - min(sizes) <= 1 and max(sizes) <= module.MAX_PARTICLES_PER_BATCH
    assert module.batch_sizes(0, 100) == []
    assert len(module.batch_sizes(10**6, 10**7)) >= module.FEW_BATCHES


def test_memory_is_told_before_and_grows_with_elements():
    world, receivers = on_elements(scenes.cornell())
    solver = method("particle_tracing")
    coarse, fine = (solver.memory(world, CameraReceivers(world), solver.Settings(max_edge=e)) for e in (0.1, 0.001))
    assert 0 < coarse < fine
    assert fine > 4e6 * 400
    assert solver.memory(world, receivers, solver.Settings()) > 0


@pytest.mark.parametrize(("lit", "said"), [(6, False), (4, True)])
def test_receivers_that_count_nothing_are_said_from_half_of_them_on(lit, said):
    tally = Tally(10, 1)
    tally.count = 100
    tally.direct[: lit // 2], tally.indirect[lit // 2 : lit] = 1.0, 1.0
    found = empty_notices("Particles", tally)
    assert bool(found) == said and all("60% of the receivers" in n.reason for n in found)


# ---- things far apart


@pytest.mark.parametrize("far", [200.0, 2e3, 2e4])
@pytest.mark.parametrize("sky", ["sun", "sky"])
def test_a_floor_is_lit_whatever_lies_far_away(sky, far):
    """Both squares get 1 W m-2, and the noise that is told is the noise there is."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    b.quad("Far", (far, 0, 0), (2, 0, 0), (0, 2, 0), diffuse("Far", 0.5))
    if sky == "sun":
        b.light(Light("Sun", "sun", (1.0,) * 3, angle=0.00918))
    else:
        b.background = (1 / math.pi,) * 3
    world = World(b.build())
    receivers = ElementReceivers(Elements(world, 0.75))
    solution = solve(world, receivers, 100_000)
    area = receivers.elements.area
    got = solution.quantity("irradiance")[0::2, 0]
    assert np.average(got, weights=area) == pytest.approx(1, rel=0.02)
    told = solution.history[-1][1]
    assert 0.3 * told < np.sqrt(np.average((got - 1) ** 2, weights=area)) < 2 * told < 0.2
    assert solution.emitted_flux == pytest.approx(3 * 8 * (1 if sky == "sun" else 2), rel=0.004)
    assert solution.balance.emitted == pytest.approx(solution.emitted_flux, rel=0.02) and solution.balance.gap < 1e-6
