"""Path tracing against exact solutions: furnaces, two-zone sphere, snowman, lamps in a sphere, path lengths, statistics, bits."""

from __future__ import annotations

import math
import warnings
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.receivers.film import read_surfaces
from adjgi.adjoint_gi.core.scene.arrays import Camera, Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import path_tracing as module
from adjgi.tests import scenes, solving
from adjgi.tests.solving import bits, scattered

# Standard deviations that a sound method exceeds once in a thousand runs of the 50 z-tests here (Sidak).
Z = 4.3
PI = math.pi
solve = partial(solving.solve, "path_tracing", seed=1, samples=64)


def check(values, exact, bias=0.0, resolution=0.003):
    """Assert the mean over receivers of independent estimates, all of the same exact value, which the test must know to `resolution`."""
    values = np.asarray(values, float)
    mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))
    exact = np.asarray(exact, float)
    assert (error <= resolution * exact).all(), f"too noisy to tell: {error} of {exact}"
    assert (np.abs(mean - exact) <= Z * error + (bias + 2e-6) * exact).all(), f"{mean} +- {error}, not {exact}"


# ---- T1: furnaces


@pytest.mark.parametrize(("rho", "roulette"), [(0.5, True), (0.5, False), (0.8, True), (0.8, False)])
def test_furnace(rho, roulette):
    world = World(scenes.cube(rho, 1.0))
    count, longest = (2000, 200) if roulette else (800, 50)
    s = solve(world, scattered(world, count), roulette=roulette, max_length=longest)
    check(s.quantity("radiosity"), [1 / (1 - rho)] * 3, resolution=0.002)
    check(s.direct, [1.0] * 3)
    check(s.indirect, [1 / (1 - rho) - 1] * 3)
    assert np.allclose(s.emitted, 1, rtol=1e-5) and np.allclose(s.albedo, rho, rtol=1e-5)


@pytest.mark.parametrize("longest", range(6))
def test_partial_sums_by_path_length(longest):
    world = World(scenes.cube(0.5, 1.0))
    s = solve(world, scattered(world, 2000), samples=32, max_length=longest)
    check(s.quantity("radiosity"), [2 * (1 - 0.5 ** (longest + 1))] * 3)


def test_single_path_lengths():
    """The light of paths of length k only is rho^(k - 1) of irradiance; together they are everything."""
    world = World(scenes.cube(0.5, 1.0))
    for k in range(1, 5):
        s = solve(world, scattered(world, 2000), samples=64, min_length=k, max_length=k)
        check(s.quantity("irradiance"), [0.5 ** (k - 1)] * 3, resolution=0.005)
        assert (s.emitted == 0).all() and ((s.indirect if k == 1 else s.direct) == 0).all()


def test_path_lengths_partition_the_sum():
    """In an uneven scene, paths up to length 2 and from length 3 on add up to all paths."""
    world = World(scenes.cornell())
    receivers = scattered(world, 500, triangles=np.arange(world.triangle_count) < 2)
    parts = [
        solve(world, receivers, samples=256, min_length=a, max_length=b, seed=s) for s, (a, b) in enumerate(((0, 2), (3, 40), (0, 40)))
    ]
    low, high, every = (p.quantity("radiosity").astype(float).mean(axis=0) for p in parts)
    assert (low > 0.1).all() and (high > 0.01).all()
    assert np.allclose(low + high, every, rtol=0.01)
    assert np.allclose(parts[0].direct.mean(axis=0), parts[2].direct.mean(axis=0), rtol=0.01)
    assert (parts[1].direct == 0).all() and (parts[1].emitted == 0).all()


def test_nothing_but_own_emission():
    world = World(scenes.cube(0.5, 3.0))
    s = solve(world, scattered(world, 50), max_length=0)
    assert np.allclose(s.emitted, 3, rtol=1e-5) and not s.direct.any() and not s.indirect.any()


def test_perfectly_white_walls_end():
    """Albedo 1 in a closed box: bounded by the path length, n times the emission after n segments."""
    world = World(scenes.cube(1.0, 1.0))
    s = solve(world, scattered(world, 500), samples=16, max_length=20)
    check(s.quantity("irradiance"), [20.0] * 3)


def test_paths_that_are_lost_in_closed_white_bodies_end():
    """No light is there, no albedo ends them: 4,096 segments of each otherwise, for nothing."""
    b = SceneBuilder()
    b.box("Body", (0, 0, 0), (1, 1, 1), diffuse("White", 1.0), inward=True)
    b.box("Lantern", (4, 4, 4), (5, 5, 5), diffuse("Grey", 0.5, 1.0), inward=True)
    world = World(b.build())
    s = solve(world, scattered(world, 100), samples=16)
    dark = s.emitted[:, 0] == 0
    assert dark.sum() > 30 and not s.quantity("irradiance")[dark].any()
    assert s.rays < 2 * 100 * 100 * 16  # each vertex casts two


def test_light_that_paths_find_late_is_not_lost():
    """A sphere with a small bright cap, which only rays meet: after a hundred dark vertices as after one, H = mean(E) / (1 - rho)."""
    vertices, triangles = scenes.icosphere(3)
    triangles = triangles[:, ::-1]
    bright = vertices[triangles].mean(axis=1)[:, 2] > 0.97
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles, [diffuse("Wall", 0.97), diffuse("Cap", 0.97, 1 / PI)], which=bright.astype(int))
    world = World(b.build())
    share = world.area[bright].sum() / world.area.sum()
    s = solve(world, scattered(world, 1000), samples=16, light_importance=False)
    check(s.quantity("irradiance"), [share / 0.03] * 3, bias=0.003, resolution=0.03)


# ---- exact solutions that are not uniform


def test_two_zone_sphere():
    """T3: irradiance 1 everywhere, though the halves differ in emission and albedo."""
    scene = scenes.two_zone_sphere(5)
    world = World(scene)
    # The equator cuts through triangles, so the halves of the polyhedron are not quite equal: H = mean(E) / (1 - mean(rho)).
    share = world.area[scene.material == 0].sum() / world.area.sum()
    h = share / (1 - 0.2 * share - 0.8 * (1 - share))
    assert abs(h - 1) < 0.01
    s = solve(world, scattered(world, 4000), samples=128)
    check(s.quantity("irradiance"), [h] * 3, bias=0.001)  # its faces are flat
    # Directions drawn uniformly instead of by the cosine would give 0.71 on the dark half (verification page).
    dark = s.emitted[:, 0] == 0
    check(s.quantity("radiosity")[dark], [0.8 * h] * 3, bias=0.001)
    check(s.quantity("radiosity")[~dark], [1 + 0.2 * h] * 3, bias=0.001)


@pytest.mark.parametrize(("c", "rho"), [(0.1, (0.5, 0.5)), (0.05, (0.8, 0.8)), (0.1, (0.7, 0.4))])
def test_snowman(c, rho):
    """T6: two rooms joined by a door, exact at every point."""
    scene = scenes.snowman(5, c, rho)
    world = World(scene)
    a, b = scenes.snowman_answer(c, rho, (1.0, 0.0))
    lower = scene.object == 0
    room = solve(world, scattered(world, 1500, triangles=lower), samples=64, max_length=200)
    check(room.quantity("radiosity"), [a] * 3, bias=0.002)
    other = solve(world, scattered(world, 1500, triangles=~lower), samples=96, max_length=200)
    check(other.quantity("radiosity"), [b] * 3, bias=0.003, resolution=0.006)


def test_point_light_in_a_sphere():
    """T12: radiosity everywhere is I / R^2 times rho / (1 - rho)."""
    vertices, triangles = scenes.icosphere(4)
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles[:, ::-1], diffuse("Wall", 0.5))
    b.light(Light("Lamp", "point", (1.0, 2.0, 3.0)))
    world = World(b.build())
    s = solve(world, scattered(world, 2000), max_length=100)
    check(s.quantity("irradiance"), np.array([2.0, 4.0, 6.0]), bias=0.003)
    check(s.direct, np.array([1.0, 2.0, 3.0]), bias=0.003)


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (2.0, 1.0, 0.5)])
def test_open_plane_under_the_sky(background):
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.background = background
    world = World(b.build())
    s = solve(world, scattered(world, 50), samples=4)
    assert np.allclose(s.direct, PI * np.array(background), rtol=1e-5) and not s.indirect.any()


def test_white_convex_object_is_invisible_in_a_uniform_sky():
    """Reflectance 1 under constant radiance 1 gives radiance 1, on a smooth sphere as on a box."""
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (1, 1, 1), diffuse("White", 1.0), inward=False)
    b.background = (1.0, 1.0, 1.0)
    b.camera = Camera("perspective", (2.0, 3.0, 2.5), *_look((2.0, 3.0, 2.5), (0.5, 0.5, 0.5)), (-0.4, 0.4, -0.4, 0.4), 16, 16)
    world = World(b.build())
    s = solve(world, CameraReceivers(world), samples=4)
    assert np.allclose(s.quantity("radiance"), 1, rtol=1e-5)
    assert s.emitted.min() == 0 and s.emitted.max() == 1


def _look(eye, at):
    forward = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    return tuple(right), tuple(np.cross(right, forward)), tuple(forward)


def test_open_box_with_grey_walls_keeps_a_share_of_the_sky():
    """A deep shaft: paths that escape after several bounces count the sky once each. Checked by radiosity balance on the sphere.

    A unit sphere with a hole of area share f under radiance 1: the walls' irradiance is pi f / (1 - rho (1 - f)) (T7).
    """
    f, rho = 0.1, 0.6
    vertices, triangles = scenes.sphere_wall(5, 1 - 2 * f)
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles, diffuse("Wall", rho))
    b.background = (1.0, 1.0, 1.0)
    world = World(b.build())
    s = solve(world, scattered(world, 4000), samples=128, max_length=100)
    check(s.quantity("irradiance"), [PI * f / (1 - rho * (1 - f))] * 3, bias=0.003)


# ---- agreement of receivers and of emitters


def test_camera_sees_the_furnace():
    scene = scenes.cube(0.5, 1.0)
    camera = Camera("perspective", (0.5, 0.5, 0.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.7, 0.7, -0.7, 0.7), 32, 24)
    scene = scene.__class__(**{**scene.__dict__, "camera": camera})
    world = World(scene)
    s = solve(world, CameraReceivers(world))
    check(s.quantity("radiance") * PI, [2.0] * 3)
    assert s.measure == "radiance" and np.allclose(s.emitted, 1 / PI, rtol=1e-5) and np.allclose(s.albedo, 0.5)
    assert np.allclose(np.linalg.norm(s.extra["normal"], axis=1), 1, atol=1e-5)
    facing = s.extra["normal"][:, 1] < -0.999  # pixels that see nothing but the back wall, half a metre away
    assert facing.any() and s.extra["depth"][facing].min() >= 0.5 and s.extra["depth"].max() < 0.9


def test_faces_work_from_behind():
    """A furnace whose walls all face outward, seen from inside: emission and reflection are those of the other side."""
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (1, 1, 1), diffuse("Wall", 0.5, 1 / PI), inward=False)
    b.camera = Camera("perspective", (0.5, 0.5, 0.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.7, 0.7, -0.7, 0.7), 32, 24)
    world = World(b.build())
    s = solve(world, CameraReceivers(world))
    check(s.quantity("radiance") * PI, [2.0] * 3)
    assert s.extra["normal"][:, 1].min() < -0.999


def test_camera_sees_lamps_and_the_sky():
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    b.light(Light("Lamp", "point", (PI / 16, 0.0, 0.0), (0.0, 0.0, 1.0), radius=0.25))
    b.background = (0.0, 0.0, 0.5)
    b.camera = Camera("orthographic", (0.0, 0.0, 3.0), (1, 0, 0), (0, 1, 0), (0, 0, -1), (-2, 2, -2, 2), 40, 40)
    world = World(b.build())
    s = solve(world, CameraReceivers(world), samples=64)
    image = s.quantity("radiance").reshape(40, 40, 3)
    assert np.isclose(image[..., 0].mean(), PI * 0.25**2 / 16, rtol=0.02)  # radiance 1 over its disk
    assert np.allclose(image[0, 0], (0, 0, 0.5)) and not image[20, 28].any()
    assert not solve(world, CameraReceivers(world), samples=4, min_length=1).quantity("radiance").any()


def test_camera_agrees_with_texels():
    """Radiance of the floor through an orthographic camera is albedo / pi times its irradiance."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Wall", (0.7, 0.5, 0.3)), inward=True)
    b.light(Light("Lamp", "area", (3.0, 3.0, 3.0), (0.5, 0.5, 0.99), size_x=0.3, size_y=0.3))
    b.camera = Camera("orthographic", (0.5, 0.5, 0.5), (1, 0, 0), (0, 1, 0), (0, 0, -1), (-0.25, 0.25, -0.25, 0.25), 16, 16)
    world = World(b.build())
    camera = solve(world, CameraReceivers(world), samples=256).quantity("radiance").astype(float)
    floor = np.flatnonzero(world.rows[:, 11] > 0.5)
    rng = np.random.default_rng(3)
    x, y = 0.25 + 0.5 * rng.random((2, 512))
    lower = x >= y
    r = SurfaceReceivers("texels", np.arange(513), np.where(lower, *floor[:2]), np.where(lower, x - y, x), np.where(lower, y, y - x))
    texels = solve(world, r, samples=128)
    position = world.surface(r.triangle, r.u, r.v).position
    assert (np.abs(position[:, :2]) < 0.2501).all()  # the points lie where the camera looks
    radiance = texels.quantity("radiosity").astype(float) / PI
    error = np.hypot(camera.std(axis=0) / 16, radiance.std(axis=0) / math.sqrt(512))
    assert (np.abs(camera.mean(axis=0) - radiance.mean(axis=0)) < Z * error).all() and (error < 0.01 * radiance.mean(axis=0)).all()


def test_elements_as_receivers():
    world = World(scenes.cube(0.5, 1.0))
    elements = Elements(world, target=60)
    s = solve(world, ElementReceivers(elements), samples=128)
    front = s.quantity("radiosity")[0::2]
    check(front, [2.0] * 3, resolution=0.005)


@pytest.mark.parametrize("angle", [0.0, 2.5])
def test_lamp_and_emitting_face_of_one_size_agree(angle):
    """The same light as a one-sided lamp and as a mesh, in a closed room; also when the lamp is large enough for rays to meet."""
    size = 0.3 + 0.2 * angle

    def room(mesh):
        b = SceneBuilder()
        b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Wall", (0.7, 0.5, 0.3)), inward=True)
        low = 0.5 - size / 2
        # A black plate hides the back of the mesh light and takes what comes down between.
        if mesh:
            b.quad("Light", (low, low, 0.98), (0, size, 0), (size, 0, 0), diffuse("Light", 0.0, 3.0))
        else:
            b.light(Light("Lamp", "area", (3.0, 3.0, 3.0), (0.5, 0.5, 0.98), size_x=size, size_y=size))
        b.quad("Plate", (low - 0.01, low - 0.01, 0.981), (0, size + 0.02, 0), (size + 0.02, 0, 0), diffuse("Black", 0.0))
        return World(b.build())

    values = []
    for mesh in (True, False):
        world = room(mesh)
        floor = world.scene.object == 4
        values.append(solve(world, scattered(world, 1500, triangles=floor), samples=64, seed=7 + mesh).quantity("irradiance").astype(float))
    a, b = values
    error = np.hypot(a.std(axis=0), b.std(axis=0)) / math.sqrt(1500)
    assert (error < 0.012 * a.mean(axis=0)).all()
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < Z * error).all()


# ---- statistics


def test_error_falls_at_least_with_the_root_of_samples():
    scene = scenes.lit_cube(0.7)
    world = World(scene)
    receivers = scattered(world, 400, triangles=scene.object == 4)
    exact = solve(world, receivers, samples=2048, seed=99).quantity("irradiance").astype(float)
    n = 2 ** np.arange(2, 9)
    errors = [np.sqrt(np.mean((solve(world, receivers, samples=int(k), seed=5).quantity("irradiance") - exact) ** 2)) for k in n]
    slope = np.polyfit(np.log(n), np.log(errors), 1)[0]
    assert -1.0 < slope < -0.45


def test_reported_error_is_about_the_true_one():
    scene = scenes.lit_cube(0.7)
    world = World(scene)
    receivers = scattered(world, 600)
    exact = solve(world, receivers, samples=1024, seed=99).quantity("irradiance").astype(float)
    s = solve(world, receivers, samples=128)
    true = np.sqrt(np.mean((s.quantity("irradiance") - exact).sum(axis=1) ** 2)) / exact.sum(axis=1).mean()
    seconds, reported = s.history[-1]
    assert 0.8 < reported / true < 2.0  # stratified samples are better than independent ones, which it supposes
    assert 0 < seconds <= s.seconds
    assert all(a[0] <= b[0] for a, b in zip(s.history, s.history[1:], strict=False))


def test_stratified_numbers_are_better_than_random_ones(monkeypatch):
    scene = scenes.lit_cube(0.5)
    world = World(scene)
    receivers = scattered(world, 400, triangles=scene.object == 4)
    exact = solve(world, receivers, samples=4096, max_length=1, seed=99).direct.astype(float)

    def error():
        return np.sqrt(np.mean((solve(world, receivers, samples=64, max_length=1).direct - exact) ** 2))

    stratified = error()
    monkeypatch.setattr("adjgi.adjoint_gi.core.walks.diffuse_paths.STRATIFIED", 0)
    assert stratified < 0.5 * error()


# ---- bits, steps, hostile input


def test_same_seed_same_bits_on_one_and_two_threads(monkeypatch):
    world = World(scenes.cornell(24, 20))
    for receivers in (scattered(world, 5000), CameraReceivers(world)):
        runs = []
        for threads in ("1", "2", "3"):
            monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
            runs.append(bits(solve(world, receivers, samples=9)))
        assert runs[0] == runs[1] == runs[2]
        assert bits(solve(world, receivers, samples=9, seed=2)) != runs[0]


@pytest.mark.parametrize("even", [False, True])
def test_batches_cover_every_sample_once(even):
    for count, samples in ((1, 1), (1, 100), (1500, 37), (40_000, 5), (7, 16)):
        done = np.zeros((count, samples), int)
        for first, last, now, index in module.batches(count, samples, even=even):
            assert 0 < (last - first) * now <= module.SAMPLES_PER_BATCH
            # From a power of two to the next, as far as there are so many samples.
            assert not even or index + now == samples or index + now in (1, 2, 4, 8) or (index + now) % 16 == 0
            done[first:last, index : index + now] += 1
        assert (done == 1).all()


def test_partial_results_come_soon_and_may_be_the_last():
    world = World(scenes.cornell())
    receivers = scattered(world, 20_000)
    solver = method("path_tracing")
    steps = solver.solve(world, receivers, solver.Settings(samples=4096), np.random.default_rng(0))
    fractions = []
    for step, _ in zip(steps, range(8), strict=False):
        fractions.append(step.fraction)
        last = step.solution()
    steps.close()
    assert fractions == sorted(fractions) and 0 < fractions[-1] < 1
    assert last.partial and last.weight.any() and np.isfinite(last.direct).all() and (last.direct[last.weight == 0] == 0).all()


def test_a_stopped_and_continued_run_gives_the_same_bits():
    world = World(scenes.cornell())
    receivers = scattered(world, 9000)
    solver = method("path_tracing")
    steps = solver.solve(world, receivers, solver.Settings(samples=40, seed=1), np.random.default_rng(1))
    first = next(steps).solution()
    *_, last = steps
    assert first.partial and not last.solution().partial
    assert bits(last.solution()) == bits(solve(world, receivers, samples=40))


def test_no_negative_values_and_no_nan():
    """Lamps in surfaces, slivers, huge and tiny emission, normals that point away: results stay numbers, not negative."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Wall", 0.9), inward=True)
    b.light(Light("In the floor", "point", (1.0, 1.0, 1.0), (0.5, 0.5, 0.0)))
    b.light(Light("Ball in the wall", "point", (1.0, 1.0, 1.0), (0.0, 0.5, 0.5), radius=0.1))
    b.light(Light("Disk", "point", (1.0, 1.0, 1.0), (0.3, 0.5, 0.5), radius=0.1, soft_falloff=True))
    b.light(Light("Thin", "area", (1.0, 1.0, 1.0), (0.5, 0.5, 0.5), size_x=1e-6, size_y=0.5, spread=0.1))
    b.light(Light("Needle", "spot", (1.0, 1.0, 1.0), (0.5, 0.5, 0.5), spot_angle=0.01, spot_blend=1.0, spot_scale=(1e-3, 1.0)))
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0), angle=1e-6))
    sliver = np.array([(0.2, 0.2, 0.5), (0.8, 0.2, 0.5), (0.5, 0.2 + 1e-7, 0.5), (0.2, 0.2, 0.5)])
    b.mesh("Sliver", sliver, np.array([[0, 1, 2], [0, 1, 3]]), diffuse("Hot", 0.5, 1e6), smooth_normals=-np.ones((4, 3)))
    world = World(b.build())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        s = solve(world, scattered(world, 2000), samples=32)
    for part in (s.emitted, s.direct, s.indirect, s.albedo):
        assert np.isfinite(part).all() and (part >= 0).all()
    assert s.direct.any() and s.indirect.any()


def test_samples_that_are_not_numbers_are_counted():
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Wall", 0.5), inward=True)
    b.light(Light("Too bright", "point", (3e38, 1.0, 1.0), (0.5, 0.5, 0.9)))
    world = World(b.build())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # np.errstate does not reach the worker threads
        s = solve(world, scattered(world, 100), samples=4)
    assert np.isfinite(s.direct).all() and np.isfinite(s.indirect).all()
    assert any("not numbers" in str(w) for w in s.warnings)


def test_smooth_normals_lose_what_falls_below_the_face():
    """A smooth floor under a uniform sky, its normals tilted by t: a share (1 - cos t) / 2 of the cosine lies below the face."""
    t = 0.5
    b = SceneBuilder()
    tilted = np.tile([math.sin(t), 0, math.cos(t)], (4, 1))
    p = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    b.mesh("Floor", p, np.array([[0, 1, 2], [0, 2, 3]]), diffuse("Grey", 0.5), smooth_normals=tilted)
    b.background = (1.0, 1.0, 1.0)
    world = World(b.build())
    s = solve(world, scattered(world, 500), samples=256)
    check(s.direct, [PI * (1 + math.cos(t)) / 2] * 3)


def test_surfaces_of_a_camera():
    world = World(scenes.cornell(20, 20))
    out = {}
    assert list(read_surfaces(world, CameraReceivers(world), out))[-1] == 1.0
    assert out["albedo"].shape == (400, 3) and 0.04 < out["albedo"].max() <= 0.7301
    assert np.isfinite(out["depth"][out["weight"] > 0]).all() and (out["depth"][out["weight"] == 0] == np.inf).all()
    assert (out["weight"] <= 1).all() and out["emission"].max() > 5
