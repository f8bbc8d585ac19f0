"""Irradiance caching: exact where irradiance is constant, converging with its accuracy, indifferent to threads."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.sampling.maps import frame_rows
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.irradiance_records import RecordIndex, Records, gradients, hemisphere
from adjgi.adjoint_gi.core.walks.paths import Walk
from adjgi.solvers.irradiance_cache import CacheRun
from adjgi.tests import scenes, solving
from adjgi.tests.solving import grid, quad_points

bake = partial(solving.solve, "irradiance_cache", light_samples=64)


def points_on(world, per_triangle, seed=0):
    """Receivers of one point each, spread over all triangles."""
    rng = np.random.default_rng(seed)
    triangle = np.repeat(np.arange(world.triangle_count), per_triangle)
    a, b = rng.random((2, len(triangle)))
    s = np.sqrt(a)
    return SurfaceReceivers("texels", np.arange(len(triangle) + 1), triangle, 1 - s, b * s)


@pytest.mark.parametrize("accuracy", [1.0, 0.3])
@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_furnace_is_exact_whatever_the_accuracy(rho, accuracy):
    world = World(scenes.cube(rho, 1.0))
    out = bake(world, points_on(world, 20), rays=1024, accuracy=accuracy)
    indirect = out.indirect[:, 0].astype(float)
    # T1: H = E / (1 - rho), of which E comes straight from the emitters.
    assert indirect.mean() == pytest.approx(1 / (1 - rho) - 1, rel=0.01)
    assert out.direct[:, 0].mean() == pytest.approx(1.0, rel=0.01)


def test_two_zone_sphere():
    scene = scenes.two_zone_sphere(level=3)
    world = World(scene)
    emitted = np.array([1.0, 0.0])
    rho = np.array([0.2, 0.8])
    zone = scene.material - scene.material.min()
    share = world.area / world.area.sum()
    expected = (share * emitted[zone]).sum() / (1 - (share * rho[zone]).sum())
    out = bake(world, points_on(world, 1), rays=512, accuracy=0.5)
    total = out.quantity("irradiance")[:, 0].astype(float)
    assert np.average(total, weights=world.area) == pytest.approx(expected, rel=0.015)


def test_error_falls_with_accuracy_and_gradients_help():
    world = World(scenes.cornell(boxes=False))
    receivers = quad_points(*grid(12))
    truth = solving.solve("path_tracing", world, receivers, seed=5, samples=4096).indirect.astype(float)

    def error(**settings):
        out = bake(world, receivers, rays=8000, min_spacing=1e-4, light_samples=1, **settings).indirect.astype(float)
        return float(np.sqrt(((out - truth) ** 2).mean()) / truth.mean())

    coarse_flat, coarse = error(accuracy=1.0, gradients=False), error(accuracy=1.0)
    fine = error(accuracy=0.1, gradients=False)
    assert coarse < 0.8 * coarse_flat
    assert fine < 0.5 * coarse_flat
    # What is left is the noise of 8000 rays: the lamp lights the ceiling from a centimetre away.
    assert fine < 0.06


def test_same_bits_for_any_number_of_threads(monkeypatch):
    world = World(scenes.cornell(boxes=False))
    receivers = points_on(world, 10)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        results.append(bake(world, receivers, rays=64, accuracy=0.5, light_samples=2).indirect)
    assert np.array_equal(*results)


def test_order_of_records_does_not_matter():
    rng = np.random.default_rng(2)
    n = 200
    position = rng.random((n, 3)).astype(np.float32) * [1, 1, 0]
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    values = rng.random((n, 3)).astype(np.float32)
    zero = np.zeros((n, 3, 3), np.float32)
    records = Records(position.astype(np.float32), up, values, values, np.full(n, 0.5, np.float32), zero, zero)
    order = rng.permutation(n)
    shuffled = Records(*(getattr(records, f.name)[order] for f in dataclasses.fields(Records)))
    query = (rng.random((50, 3)) * [1, 1, 0]).astype(np.float32)
    a, _, known = RecordIndex(records, 0.4, 1.5).irradiance(query, up[:50], True)
    b, _, _ = RecordIndex(shuffled, 0.4, 1.5).irradiance(query, up[:50], True)
    assert known.all() and np.allclose(a, b, rtol=1e-5)


def test_index_finds_every_record_that_serves():
    rng = np.random.default_rng(4)
    n = 300
    position = (rng.random((n, 3)) * 2 - 1).astype(np.float32)
    normal = rng.normal(size=(n, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    radius = (10 ** rng.uniform(-2, 0.5, n)).astype(np.float32)
    zero = np.zeros((n, 3, 3), np.float32)
    index = RecordIndex(Records(position, normal, zero[:, 0], zero[:, 0], radius, zero, zero), 0.5, 1.01)
    query, facing = (rng.random((80, 3)) * 2 - 1).astype(np.float32), normal[:80]
    point, record, weight = index.pairs(query, facing)
    found = set(zip(point.tolist(), record.tolist(), strict=True))
    to = query[:, None] - position
    error = np.linalg.norm(to, axis=2) / radius + np.sqrt(np.maximum(1 - facing @ normal.T, 0))
    ahead = np.einsum("pra,pra->pr", to, facing[:, None] + normal) < -0.02 * radius
    expected = {(int(p), int(r)) for p, r in zip(*np.nonzero((error < 0.5 - 1e-5) & ~ahead), strict=True)}
    allowed = {(int(p), int(r)) for p, r in zip(*np.nonzero((error < 0.5 + 1e-5) & ~ahead), strict=True)}
    assert expected and expected <= found <= allowed and len(found) == len(point)
    near = error[point, record] > 1e-3
    np.testing.assert_allclose(weight[near], 1 / error[point, record][near], rtol=0.01)


@pytest.fixture(scope="module")
def picture():
    """The Cornell box, its camera, and indirect light by path tracing."""
    world = World(scenes.cornell(96, 96))
    receivers = CameraReceivers(world)
    return world, receivers, solving.solve("path_tracing", world, receivers, seed=5, samples=32).indirect.astype(float)


@pytest.mark.parametrize("accuracy", [0.3, 0.1])
def test_gradients_are_not_extrapolated_into_fireflies(picture, accuracy):
    """Close to corners gradients are steep and their records must still reach over the least spacing."""
    world, receivers, expected = picture
    got = bake(world, receivers, rays=64, accuracy=accuracy).indirect.astype(float)
    assert got.max() < 2 * expected.max()
    assert got.mean() == pytest.approx(expected.mean(), rel=0.03)


def test_camera_and_path_lengths():
    world = World(scenes.cornell(12, 12))
    out = bake(world, CameraReceivers(world, grid=2), rays=64, accuracy=0.5, light_samples=2, max_length=1)
    assert not out.indirect.any() and out.direct.any() and out.emitted.any()


def seen_from(normal, look, rows=20, cols=50, count=100):
    """Mean gradients (3,) by rotation and translation of points with one normal; `look` gives radiance and distance along directions."""
    rng = np.random.default_rng(1)
    n = np.tile(np.float32(normal) / np.linalg.norm(normal).astype(np.float32), (count, 1))
    x, y = frame_rows(n)
    local, _ = hemisphere(rows, cols, rng, count)
    w = local[..., :1] * x[:, None, None] + local[..., 1:2] * y[:, None, None] + local[..., 2:] * n[:, None, None]
    radiance, distance = look(w)
    found = gradients(np.repeat(radiance[..., None], 3, axis=3).astype(np.float32), distance.astype(np.float32), local, x, y)
    return tuple(g[:, 0].mean(axis=0) for g in found)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (-0.3, 0.5, -0.7)])
def test_rotation_gradient_in_radiance_that_varies_with_direction(normal):
    """Radiance 1 + a . w gives irradiance pi + 2 pi / 3 a . n, whose slope over a turn r = n x n' is 2 pi / 3 n x a."""
    a = np.array([0.6, -0.2, 0.3])
    turn, move = seen_from(normal, lambda w: (1 + w @ a, np.full(w.shape[:3], 1e9)))
    n = np.array(normal) / np.linalg.norm(normal)
    assert turn == pytest.approx(2 * np.pi / 3 * np.cross(n, a), abs=0.01)
    assert np.abs(move).max() < 1e-6


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_translation_gradient_below_half_a_ceiling(tilt):
    """A ceiling of radiance 1 at height 1 over x > 0.2. On a level floor E = pi / 2 (1 + s / sqrt(1 + s^2)) at s = x - 0.2; on a floor that
    is tilted in x, moving by d is moving level by d cos and up by d sin, and what is seen is cut off at angles alone."""

    def look(w):
        t = 1 / np.maximum(w[..., 2], 1e-6)
        return np.where((w[..., 2] > 0) & (w[..., 0] * t > 0.2), 1.0, 0.0), np.where(w[..., 2] > 0, t, 1e9)

    def irradiance(x, z):
        # A strip at infinity in y: E = pi / 2 (sin b - sin a) over its angles from the normal (Hottel).
        edge, far = np.arctan2(0.2 - x, 1 - z) + tilt, np.pi / 2
        return np.pi / 2 * (np.sin(min(far + tilt, np.pi / 2)) - np.sin(edge))

    d = 1e-4
    along = np.array([np.cos(tilt), 0, np.sin(tilt)]) * d
    want = (irradiance(along[0], along[2]) - irradiance(-along[0], -along[2])) / (2 * d)
    _, move = seen_from((-np.sin(tilt), 0, np.cos(tilt)), look)
    assert move @ along / d == pytest.approx(want, rel=0.02)
    assert abs(move[1]) < 0.01


def ball_in_a_room(a):
    """A smooth black ball, small in a big round room of emission 1 / pi whose albedo is (1 + a . w) / 2 in direction w: receivers on the
    ball, and their irradiance of one reflection, (1 + 2 / 3 a . n) / 2."""
    vertices, triangles = scenes.icosphere(4)
    middle = vertices[triangles].mean(axis=1)
    albedo = np.round(100 * (1 + middle @ a / np.linalg.norm(middle, axis=1))).astype(int)
    values, which = np.unique(albedo, return_inverse=True)
    b = SceneBuilder()
    b.mesh("Room", vertices, triangles[:, ::-1], [diffuse(f"Wall{k}", k / 200, 1 / np.pi) for k in values], which=which.ravel())
    vertices, small = scenes.icosphere(3)
    b.mesh("Ball", 0.01 * vertices, small, diffuse("Ball", 0.0), smooth_normals=vertices)
    world = World(b.build())
    ball = np.arange(world.triangle_count) >= len(triangles)
    receivers = solving.scattered(world, 600, seed=3, triangles=ball)
    normal = world.surface(receivers.triangle, receivers.u, receivers.v).ns
    return world, receivers, 0.5 * (1 + 2 / 3 * normal @ a)


def test_gradients_on_a_ball_follow_its_normal():
    world, receivers, want = ball_in_a_room(np.array([0.6, 0.3, -0.5]))

    def error(**settings):
        found = bake(world, receivers, rays=1024, min_spacing=1e-5, light_samples=1, max_length=2, seed=1, **settings).indirect[:, 0]
        return float(np.sqrt(((found - want) ** 2).mean()) / want.mean())

    flat, bent = error(gradients=False), error()
    assert bent < 0.02 and bent < 0.5 * flat


def test_the_seed_reaches_direct_light_and_the_error_that_is_stated_is_that_of_repeats():
    world = World(scenes.cornell())
    receivers = quad_points(*grid(12), each=4)
    runs = [solving.solve("irradiance_cache", world, receivers, seed=k, rays=64, light_samples=3) for k in range(6)]
    assert len({r.direct.tobytes() for r in runs}) == len({r.indirect.tobytes() for r in runs}) == len(runs)
    total = np.array([r.quantity("irradiance").sum(axis=1) for r in runs], float)
    true = np.sqrt(total.var(axis=0, ddof=1).mean()) / total.mean()
    stated = np.sqrt(np.mean([r.history[-1][1] ** 2 for r in runs]))
    assert stated == pytest.approx(true, rel=0.3)


def cache(world, **options):
    """A cache that is empty, of rays over 4 x 4 cells."""
    solver = method("irradiance_cache")
    settings = solver.Settings(rays=16, **options)
    return CacheRun(world, settings, Walk(world, Emitters(world), BsdfTable(world.scene), 0, NO_LIMIT), [1])


@pytest.mark.parametrize(("distance", "radius"), [(1e-4, 0.01 / 0.2), (0.3, 0.3), (50.0, 2.0)], ids=["corner", "room", "open"])
def test_records_reach_as_far_as_what_they_see_within_bounds(monkeypatch, distance, radius):
    """No less than the least spacing over the accuracy, by which their reach is multiplied, no farther than the scene."""
    world = World(scenes.cube())
    state = cache(world, accuracy=0.2, min_spacing=0.01)
    flat = np.ones((1, state.rows, state.cols, 3), np.float32)
    monkeypatch.setattr(state, "_look", lambda *_: (flat, np.full(flat.shape[:3], distance * world.extent), 16, np.zeros(2)))
    records = state._make(world.surface(*(np.zeros(1, t) for t in (int, np.float32, np.float32))), np.random.default_rng(0))[0]
    assert records.radius[0] == pytest.approx(radius * world.extent) and records.irradiance[0, 0] == pytest.approx(np.pi)


@pytest.mark.parametrize("distance", [1e-4, 0.3])
def test_nothing_is_extrapolated_to_below_zero_within_its_reach(monkeypatch, distance):
    world, n = World(scenes.cube()), 40
    state, rng = cache(world, accuracy=0.2, min_spacing=0.05), np.random.default_rng(2)
    radiance = (rng.random((n, state.rows, state.cols, 1)) ** 8).astype(np.float32) * np.ones(3, np.float32)
    monkeypatch.setattr(state, "_look", lambda *_: (radiance, np.full(radiance.shape[:3], distance), 16, np.zeros(2)))
    records = state._make(world.surface(*(np.zeros(n, t) for t in (int, np.float32, np.float32))), rng)[0]
    fall = np.linalg.norm(records.translation.sum(axis=1), axis=1) * records.radius
    assert (fall <= 1.001 * records.irradiance.sum(axis=1)).all() and fall.max() > 0


def test_rays_that_meet_nothing_see_far():
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    world = World(b.build())
    state = cache(world)
    surface = world.surface(*(np.zeros(1, t) for t in (int, np.float32, np.float32)))
    records = state._make(surface, np.random.default_rng(0))[0]
    assert records.radius[0] == pytest.approx(2 * world.extent)
    local, _ = hemisphere(state.rows, state.cols, np.random.default_rng(0), 1)
    assert (state._look(surface, local, *frame_rows(surface.ns), np.random.default_rng(0))[1] == 4 * world.extent).all()


@pytest.mark.parametrize("name", ["irradiance_cache", "path_tracing", "distribution"])
def test_a_flat_sheet_with_bent_normals_gives_itself_no_light(name):
    """Its shading normals lean by 45 degrees: rays below the sheet itself bring nothing, though they would meet its lit front."""
    b, lean = SceneBuilder(), np.sqrt(0.5)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    b.mesh("Sheet", corners, [[0, 1, 2], [0, 2, 3]], diffuse("White", 0.8), smooth_normals=np.tile([lean, 0, lean], (4, 1)))
    b.light(Light("Sun", "sun", (3.0, 3.0, 3.0)))
    out = solving.solve(name, World(b.build()), quad_points(*grid(6)))
    assert not out.indirect.any()
    assert out.direct == pytest.approx(3 * lean, rel=1e-4)
