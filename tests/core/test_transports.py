"""Transports and schemes: duality, reciprocity, closure, and exact solutions of small systems."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SceneError
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.elements.rays import ElementRays
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.radiosity.factor_matrix import FactorMatrix
from adjgi.adjoint_gi.core.radiosity.relaxation import System, gauss_seidel, jacobi, lengths
from adjgi.adjoint_gi.core.radiosity.southwell import DiffuseShooting
from adjgi.adjoint_gi.core.radiosity.transports import FreshRayTransport, MatrixTransport, RayTransport
from adjgi.adjoint_gi.core.radiosity.trapped import Trap, trapped
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import closed_forms, scenes


def matrix_of(scene, edge=10.0, rays=256, closed_forms=True):
    """Matrix of everything that front sides reach; returns the builder."""
    elements = Elements(World(scene), edge)
    matrix = FactorMatrix(elements, rays, closed_forms)
    for _ in matrix.discover(np.arange(0, 2 * elements.count, 2)):
        pass
    # Worlds hold colours in float32; the tests want the numbers that were written.
    for _ in matrix.build(np.round(elements.albedo[matrix.sides >> 1], 6)):
        pass
    return matrix


def solved(transport, emitted, scheme=jacobi):
    """Radiosity (n, 3)."""
    *_, last = scheme(transport, emitted, np.zeros_like(emitted), 1e-16, 2000)
    return emitted + transport.rho * last.irradiance


def grey(values):
    return np.repeat(np.asarray(values, float)[:, None], 3, axis=1)


def shot_out(state, at_most=100_000):
    """Shoot one side at a time until nothing is left; yields after every shot."""
    for _ in range(at_most):
        index, flux = state.largest(1)
        if flux.sum() <= 1e-16:
            return
        state.shoot(index, np.ones(len(index), np.int64))
        yield state


# ---- duality


def inner(transport, x, y):
    """<x, y> = sum over sides and channels of A x y."""
    return float((transport.area[:, None] * x * y).sum())


@pytest.mark.parametrize("kind", ["matrix", "matrix by rays", "rays"])
def test_apply_and_adjoint_are_dual(kind):
    scene = scenes.cornell()
    if kind == "rays":
        transport = RayTransport.cast(ElementRays(Elements(World(scene), 0.2)), 64)
    else:
        transport = matrix_of(scene, 0.2, 64, kind == "matrix").transport
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(2, len(transport.area), 3))
    size = np.sqrt(inner(transport, x, x) * inner(transport, y, y))
    assert abs(inner(transport, transport.apply(x), y) - inner(transport, x, transport.adjoint(y))) <= 1e-12 * size


def test_the_identity_with_unequal_areas():
    """<g, B> = <W, E> in the 4 x 4 x 3 room: light on one wall, sensor on the floor."""
    transport = matrix_of(scenes.room()).transport
    emitted, sensor = np.zeros((6, 3)), np.zeros((6, 3))
    emitted[0], sensor[4] = 1.0, 1.0
    radiosity = solved(transport, emitted)
    # W = g + T* W.
    potential, term = sensor.copy(), sensor
    for _ in range(300):
        term = transport.adjoint(term)
        potential += term
    assert inner(transport, sensor, radiosity) / 3 == pytest.approx(1.06264137633323, rel=1e-12)
    assert inner(transport, potential, emitted) / 3 == pytest.approx(1.06264137633323, rel=1e-12)


def test_shooting_with_unequal_areas_is_not_the_printed_equation():
    transport = matrix_of(scenes.room()).transport
    emitted = np.zeros((6, 3))
    emitted[0] = 1.0
    *_, state = shot_out(DiffuseShooting(transport, emitted, 0 * emitted))
    floor = transport.rho[4, 0] * (state.direct + state.indirect)[4, 0]
    assert floor == pytest.approx(1.06264137633323 / 16, rel=1e-12)
    # The first shot alone: rho F_ij A_i / A_j and not rho F_ij.
    first = DiffuseShooting(transport, emitted, 0 * emitted)
    first.shoot(np.array([0]), np.ones(1, np.int64))
    assert first.direct[4, 0] == pytest.approx(0.17931680315063253, rel=1e-12)


# ---- factors


@pytest.mark.parametrize("edge", [10.0, 1.01])
def test_exact_rows_close_and_are_reciprocal(edge):
    matrix = matrix_of(scenes.room(), edge)
    t = matrix.transport
    assert np.abs(t.factors.sum(axis=1) - 1).max() <= 1e-12
    exchange = t.area[:, None] * t.factors
    assert np.abs(exchange - exchange.T).max() <= 1e-12 * exchange.max()
    assert matrix.report.cast == 0
    assert matrix.report.closure <= 1e-12
    if edge > 4:
        wanted = [0.1628242326414444, 0.17949881281176777, 0.23908907086751005]
        assert np.allclose(t.factors[0, [1, 2, 4]], wanted, rtol=1e-12)


@pytest.mark.parametrize("scene", [scenes.cornell, lambda: scenes.two_zone_sphere(1)])
def test_ray_cast_rows_close_with_their_sky_and_are_reciprocal(scene):
    matrix = matrix_of(scene(), 0.25, 256)
    t = matrix.transport
    assert np.abs(t.factors.sum(axis=1) + t.sky - 1).max() <= 1e-12
    exchange = t.area[:, None] * t.factors
    assert np.abs(exchange - exchange.T).max() <= 1e-14 * exchange.max()
    assert (t.factors >= 0).all()
    assert matrix.report.cast > 0
    assert 0 < matrix.report.reciprocity < 1
    assert 0 < matrix.report.closure < 0.2


def test_ray_cast_factors_are_within_binomial_error():
    n = 40_000
    transport = RayTransport.cast(ElementRays(Elements(World(scenes.room()), 10)), n, np.arange(0, 12, 2))
    wanted = matrix_of(scenes.room()).transport.factors
    for i in range(6):
        target, weight = transport.row(2 * i)
        row = np.bincount(target // 2, weight, 6)
        assert (np.abs(row - wanted[i]) <= 3 * np.sqrt(wanted[i] * (1 - wanted[i]) / n)).all()
        assert (target % 2 == 0).all()


def test_open_squares_keep_their_closed_form_and_the_sky_takes_the_rest():
    b = SceneBuilder()
    b.quad("Low", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("High", (0, 0, 1), (0, 1, 0), (1, 0, 0), diffuse("Grey", 0.5))
    t = matrix_of(b.build(), 10.0, 64).transport
    assert np.allclose(t.factors, [[0, 0.19982489569838746], [0.19982489569838746, 0]], rtol=1e-12)
    assert np.allclose(t.sky, 1 - 0.19982489569838746, rtol=1e-12)


# ---- schemes on exact systems


def cube_matrix(rho):
    rho = np.broadcast_to(np.asarray(rho, float), 6)
    f = np.full((6, 6), closed_forms.adjacent_rectangles(1, 1, 1))
    for i in range(6):
        f[i, i], f[i, i ^ 1] = 0, closed_forms.parallel_rectangles(1, 1, 1)
    return MatrixTransport(np.ones(6), grey(rho), f)


def sphere(emission, rho):
    """T3: parts of the inside of a sphere."""
    area = np.full(len(rho), 4 * np.pi / len(rho))
    t = MatrixTransport(area, grey(rho), closed_forms.sphere_parts(area, 1.0))
    return t, solved(t, grey(emission))[:, 0]


def test_two_zones_and_octants_of_a_sphere():
    assert np.allclose(sphere((1, 0), (0.2, 0.8))[1], [1.2, 0.8], rtol=1e-12)
    e, rho = np.array([1, 0, 0, 2, 0, 0, 0, 0.5]), np.array([0.1, 0.9, 0.5, 0.3, 0.7, 0.2, 0.8, 0.6])
    assert np.allclose(sphere(e, rho)[1], e + rho * 0.897435897435897, rtol=1e-12)


def test_dome_over_disk_concentric_spheres_and_snowman():
    def answer(area, rho, e, f):
        return solved(MatrixTransport(np.array(area, float), grey(rho), np.array(f, float)), grey(e))[:, 0]

    # T5b: disk (area pi), dome (2 pi).
    assert np.allclose(answer([1, 2], [0.3, 0.6], [1, 0], [[0, 1], [0.5, 0.5]]), [1.147540983607, 0.491803278689], rtol=1e-11)
    # T5: radii 1 and 2.
    assert np.allclose(answer([1, 4], [0.3, 0.6], [1, 0], [[0, 1], [0.25, 0.75]]), [1.089108910891, 0.297029702970], rtol=1e-11)
    # T6: each room sees itself but for the door, through which it sees the other.
    for c, rho in ((0.1, (0.5, 0.5)), (0.05, (0.8, 0.8)), (0.1, (0.7, 0.4))):
        got = answer([1, 1], rho, [1, 0], [[1 - c, c], [c, 1 - c]])
        assert np.allclose(got, scenes.snowman_answer(c, rho, (1, 0)), rtol=1e-12)


@pytest.mark.parametrize("scheme", [jacobi, gauss_seidel])
def test_schemes_agree_with_a_direct_solve(scheme):
    rng = np.random.default_rng(2)
    n = 150  # more than two blocks of Gauss-Seidel
    area = rng.random(n) + 0.1
    symmetric = rng.random((n, n))
    exchange = symmetric + symmetric.T
    exchange *= 0.9 / (exchange.sum(axis=1) / area).max()
    rho = 0.9 * rng.random((n, 3))
    t = MatrixTransport(area, rho, exchange / area[:, None], 1 - exchange.sum(axis=1) / area)
    emitted, arriving = rng.random((2, n, 3))
    *_, last = scheme(t, emitted, arriving, 1e-16, 2000)
    for c in range(3):
        want = np.linalg.solve(np.eye(n) - t.factors * rho[:, c], t.factors @ emitted[:, c] + arriving[:, c])
        assert np.allclose(last.irradiance[:, c], want, rtol=1e-12)
    # Shooting has the same limit.
    state = DiffuseShooting(t, emitted, arriving)
    while state.unshot_flux().sum() > 1e-13 * state.total:
        state.shoot(state.largest(n)[0], np.ones(n, np.int64))
    assert np.allclose(state.direct + state.indirect, last.irradiance, rtol=1e-10)


def test_jacobi_iterates_are_partial_sums():
    t = matrix_of(scenes.cube(0.8)).transport
    emitted = np.ones((6, 3))
    for bounces, iterate in enumerate(jacobi(t, emitted, 0 * emitted, 0.0, 9), 1):
        got = emitted + t.rho * iterate.irradiance
        assert np.allclose(got, (1 - 0.8 ** (bounces + 1)) / 0.2, rtol=1e-12)


@pytest.mark.parametrize(("low", "high"), [(0, 0), (0, 1), (1, 1), (2, 2), (1, 3), (3, 5), (2, NO_LIMIT), (4, NO_LIMIT), (0, 90)])
def test_path_lengths_are_exact_in_every_scheme(low, high):
    t = cube_matrix([0.5, 0.5, 0.63, 0.14, 0.2, 0.8])
    emitted, arriving = np.zeros((6, 3)), np.zeros((6, 3))
    emitted[5], arriving[0] = 1.0, 0.3
    terms = [t.gather(emitted) + arriving]
    for _ in range(200):
        terms.append(t.gather(t.rho * terms[-1]))
    wanted = sum(terms[max(low, 1) - 1 : high], np.zeros((6, 3)))
    *_, last = gauss_seidel(t, emitted, arriving, 1e-16, 500)
    direct, indirect = lengths(t, emitted, arriving, last.irradiance, low, high)
    assert np.allclose(direct + indirect, wanted, atol=1e-14)
    assert np.allclose(direct, terms[0] if low <= 1 <= high else 0.0, atol=1e-15)
    state = DiffuseShooting(t, emitted, arriving, low, high)
    for _ in shot_out(state):
        pass
    assert np.allclose(state.direct + state.indirect, wanted, atol=1e-14)
    assert np.allclose(state.direct, direct, atol=1e-15)


def test_shooting_stays_below_the_solution_and_loses_nothing():
    t = cube_matrix([0.5, 0.5, 0.63, 0.14, 0.2, 0.8])
    emitted = np.zeros((6, 3))
    emitted[5] = 1.0
    want = solved(t, emitted)
    state = DiffuseShooting(t, emitted, 0 * emitted)
    before = state.total
    ambient = []
    for s in shot_out(state):
        got = emitted + t.rho * (s.direct + s.indirect)
        assert (got <= want + 1e-14).all()
        left = s.remaining()
        assert np.allclose(s.absorbed + s.escaped + left, s.emitted, rtol=1e-12)
        assert left.sum() <= before
        before = left.sum()
        ambient.append(s.ambient().max())
    assert np.allclose(got, want, rtol=1e-10)
    assert got[:, 0] == pytest.approx([0.155936360493] * 2 + [0.191955473047, 0.046719809960, 0.065934152332, 1.098647189394], rel=1e-9)
    assert ambient[-1] < 1e-14 < ambient[0]
    # Sweeps: each takes away at least the share that is absorbed.
    sweep = DiffuseShooting(t, emitted, 0 * emitted)
    for k in range(1, 20):
        sweep.shoot(np.arange(6), np.ones(6, np.int64))
        assert sweep.remaining().sum() <= sweep.total * 0.8**k + 1e-15


def test_overshooting_has_the_same_limit_in_fewer_shots():
    # High albedo and many elements: there it pays.
    t = matrix_of(scenes.lit_cube(0.9), 0.26).transport
    emitted = np.zeros((len(t.area), 3))
    emitted[-1] = 1.0
    counts, answers = [], []
    for overshoot in (False, True):
        state = DiffuseShooting(t, emitted, 0 * emitted, overshoot=overshoot)
        while state.unshot_flux().sum() > 1e-12 * state.total:
            state.shoot(state.largest(1)[0], np.ones(1, np.int64))
        counts.append(state.shots)
        answers.append(state.direct + state.indirect)
        assert np.allclose(state.absorbed + state.escaped + state.remaining(), state.emitted, rtol=1e-12)
    assert np.allclose(*answers, rtol=1e-9)
    assert counts[1] < 0.8 * counts[0]


def test_light_that_cannot_leave_is_found():
    assert trapped(cube_matrix(1.0)).all()
    assert not trapped(cube_matrix([1, 1, 1, 1, 1, 0.99])).any()
    open_ = cube_matrix(1.0)
    open_.sky = np.array([0, 0, 0, 0, 0, 0.1])
    assert not trapped(open_).any()


@pytest.mark.parametrize("absorbed, escaped, caught", [(0.0, 0.0, True), (1e-4, 1e-4, True), (0.01, 0.0, False), (0.0, 0.01, False)])
def test_light_that_is_sent_on_and_on_is_caught_unless_it_is_absorbed_or_escapes(absorbed, escaped, caught):
    """10 W were sent for 1 W that is left, of which a thousandth of a watt must have been lost."""
    scene = SceneBuilder()
    scene.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Snow", 1.0))
    elements = Elements(World(scene.build()), 1.0)
    zero, sides = np.zeros(3), 2 * elements.count
    state = SimpleNamespace(overshoot=False, sent=zero, absorbed=zero, escaped=zero, cut=zero, remaining=lambda: np.ones(3))
    state.transport, state.unshot = SimpleNamespace(area=np.ones(sides)), np.ones((1, sides, 3))
    trap = Trap(state)
    trap.check(elements)
    state.sent, state.absorbed, state.escaped = zero + 10, zero + absorbed, zero + escaped
    if caught:
        with pytest.raises(SceneError, match="Material Snow: reflects all light"):
            trap.check(elements)
    else:
        trap.check(elements)


@pytest.mark.parametrize(
    "low, high, counted", [(1, NO_LIMIT, 0.5), (2, NO_LIMIT, 0.5), (3, NO_LIMIT, 0), (4, NO_LIMIT, 0), (4, 9, 0), (2, 9, 0.5)]
)
def test_light_that_has_died_out_counts_at_no_greater_length(low, high, counted):
    """A black lamp sees a grey plate alone: light comes back to it by two segments, and goes no farther."""
    transport = MatrixTransport(np.ones(2), np.repeat([[0.0], [0.5]], 3, axis=1), np.array([[0.0, 1.0], [1.0, 0.0]]), np.zeros(2))
    emitted, none = np.array([[1.0] * 3, [0.0] * 3]), np.zeros((2, 3))
    direct, indirect = lengths(transport, emitted, none, np.array([[0.5] * 3, [1.0] * 3]), low, high)
    np.testing.assert_allclose(direct, [[0.0] * 3, [float(low <= 1)] * 3])
    np.testing.assert_allclose(indirect, [[counted] * 3, [0.0] * 3])


@pytest.mark.parametrize("low", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("tint", [None, (1.0, 0.5, 0.2)])
def test_flux_is_accounted_for_whatever_counts_and_lies_on_the_way(low, tint):
    """Two plates with a tinted sheet between them, whose light escapes by two fifths at most."""
    factors, sky = np.array([[0.0, 0.6], [0.6, 0.0]]), np.full(2, 0.4)
    if tint is not None:
        factors, sky = np.array(tint)[:, None, None] * factors, np.full((2, 3), 0.4)
    transport, emitted = MatrixTransport(np.array([1.0, 1.0]), np.full((2, 3), 0.5), factors, sky), np.array([[1.0] * 3, [0.0] * 3])
    *_, last = jacobi(transport, emitted, np.zeros((2, 3)), 1e-14, 200)
    balance = System(transport, emitted, np.zeros((2, 3)), low, NO_LIMIT).counted(last.irradiance)[2]
    radiosity = emitted + 0.5 * last.irradiance
    assert balance.escaped == pytest.approx(0.4 * radiosity.sum())
    assert balance.absorbed == pytest.approx(3 - balance.escaped) and abs(balance.unshot) < 1e-9 and balance.emitted == 3


def test_light_that_arrives_later_has_flown_before():
    transport = MatrixTransport(np.ones(2), np.full((2, 3), 0.5), np.array([[0.0, 1.0], [1.0, 0.0]]), np.zeros(2))
    state = DiffuseShooting(transport, np.zeros((2, 3)), np.array([[1.0] * 3, [0.0] * 3]))
    state.arrive_later(np.array([[0.0] * 3, [4.0] * 3]), np.full(3, -4.5), np.full(3, 0.5))
    assert state.direct[:, 0].tolist() == state.first[:, 0].tolist() == [1, 0] and state.indirect[:, 0].tolist() == [0, 4]
    # It has arrived before, so it is no more flux: a mirror has sent on 4.5 W of what arrived there, and half a watt of these escaped.
    assert state.emitted.tolist() == [1] * 3 and state.escaped.tolist() == [0.5] * 3
    assert state.absorbed.tolist() == [-2.0] * 3 and state.remaining().tolist() == [2.5] * 3
    state.has_passed(np.full(3, 0.25))
    assert state.emitted.tolist() == [0.75] * 3 and state.absorbed.tolist() == [-2.25] * 3


# ---- rays as transports


def test_fresh_rays_lose_no_flux_and_come_to_the_factors():
    elements = Elements(World(scenes.room()), 10)
    fresh = FreshRayTransport(ElementRays(elements))
    radiosity = np.array([[1.0, 2.0, 3.0], [0.5, 0.5, 0.5]])
    index = np.array([0, 9])  # the first wall, and the back of the floor, which sees nothing
    arrived, escaped = fresh.shoot(index, radiosity, np.array([100_000, 1000]))
    assert fresh.count == 101_000
    out = (fresh.area[index, None] * radiosity).sum(axis=0)
    assert np.allclose((fresh.area[:, None] * arrived).sum(axis=0) + escaped, out, rtol=1e-12)
    assert np.allclose(escaped, 16 * 0.5, rtol=1e-12)
    assert np.allclose(arrived[8], 12 * 0.23908907086751005 / 16 * radiosity[0], rtol=3e-3)
    # The second shot uses other rays, and the same calls give the same numbers.
    again, _ = fresh.shoot(index, radiosity, np.array([100_000, 1000]))
    assert not np.array_equal(again, arrived)
    assert np.array_equal(FreshRayTransport(ElementRays(elements)).shoot(index, radiosity, np.array([100_000, 1000]))[0], arrived)


def test_kept_rays_shoot_what_they_spread():
    transport = RayTransport.cast(ElementRays(Elements(World(scenes.cornell()), 0.3)), 32)
    rng = np.random.default_rng(3)
    index = np.array([3, 10, 50])
    radiosity = rng.random((3, 3))
    arrived, escaped = transport.shoot(index, radiosity, np.ones(3, np.int64))
    x = np.zeros((len(transport.area), 3))
    x[index] = radiosity
    assert np.allclose(arrived, transport.spread(x), rtol=1e-13)
    out = (transport.area[index, None] * radiosity).sum(axis=0)
    assert np.allclose((transport.area[:, None] * arrived).sum(axis=0) + escaped, out, rtol=1e-12)


def test_threads_do_not_change_rays(monkeypatch):
    elements = Elements(World(scenes.cornell()), 0.2)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        results.append(RayTransport.cast(ElementRays(elements), 100).target)
    assert np.array_equal(*results)


def test_the_residual_is_a_mean_by_area():
    """Two sides of areas 1 and 3, of which only the large one gets light, and then only the small one."""
    transport = MatrixTransport(np.array([1.0, 3.0]), np.full((2, 3), 0.5), np.array([[0.0, 0.3], [0.1, 0.0]]))
    first, second, *_ = jacobi(transport, np.zeros((2, 3)), np.array([[0.0] * 3, [1.0] * 3]), 0.0, 2)
    assert first.residual == 1
    assert second.residual == pytest.approx(0.15 / (3 + 0.15))


def test_light_that_sheets_take_on_the_way_is_not_trapped():
    """Two white sides that see nothing but each other: through a sheet that takes half of blue alone, blue has a limit, red has none."""
    between = np.array([[0.0, 1.0], [1.0, 0.0]])
    for shares, caught in (((1.0, 1.0, 0.5), True), ((0.9, 0.9, 0.5), False)):
        factors = np.array(shares)[:, None, None] * between
        assert trapped(MatrixTransport(np.ones(2), np.ones((2, 3)), factors, np.zeros((2, 3)))).tolist() == [caught] * 2
