"""Southwell's scheme over any state: which sides shoot next, along how many rays, and when it ends."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.method.solution import EnergyBalance
from adjgi.adjoint_gi.core.radiosity.relaxation import jacobi
from adjgi.adjoint_gi.core.radiosity.southwell import (
    MOST_RAYS_PER_GROUP,
    RAYS_PER_GROUP,
    DiffuseShooting,
    Grouping,
    Southwell,
    balance,
    most_first,
)
from adjgi.adjoint_gi.core.radiosity.transports import MatrixTransport

AREA = np.array([1.0, 2.0, 1.0])
# Reciprocal, and closed but for what escapes.
EXCHANGE = np.array([[0.0, 0.5, 0.2], [0.5, 0.6, 0.6], [0.2, 0.6, 0.0]])


def state(emitted=(1.0, 0.0, 0.0), rho=0.5, **options):
    factors = EXCHANGE / AREA[:, None]
    transport = MatrixTransport(AREA, np.full((3, 3), rho), factors, 1 - factors.sum(axis=1))
    return DiffuseShooting(transport, np.repeat(np.array(emitted)[:, None], 3, axis=1), np.zeros((3, 3)), **options)


def test_the_largest_come_first_and_equals_by_their_index():
    index, flux = most_first(np.array([2.0, 0.0, 3.0, 2.0, 1.0]), 3)
    assert index.tolist() == [2, 0, 3] and flux.tolist() == [3, 2, 2]
    assert most_first(np.zeros(4), 9)[0].tolist() == []


def test_a_group_fits_into_a_batch_and_takes_rays_by_flux():
    s = state((1.0, 2.0, 0.001))
    grouping = Grouping(carriers=1000, batch=1005, fewest=8)
    index, rays = grouping.next(s)
    # Fluxes 1, 4 and 0.001 of 5.001 in each channel: side 1 first, and side 0 with it, but not one more.
    assert index.tolist() == [1, 0] and rays.tolist() == [800, 200]
    assert grouping.next(s, shots_left=1)[0].tolist() == [1]
    # The first one shoots even where it alone is too much for a batch.
    assert Grouping(1000, batch=10).next(s)[0].tolist() == [1]
    index, rays = Grouping(1000, 1 << 20, fewest=lambda index: 100 + index, most=500).next(s)
    assert index.tolist() == [1, 0, 2] and rays.tolist() == [500, 200, 102]


def test_batches_grow_with_the_sides():
    assert [Grouping.for_sides(n, 1).batch for n in (10, 1 << 18, 1 << 30)] == [RAYS_PER_GROUP, 1 << 17, MOST_RAYS_PER_GROUP]
    assert Grouping.for_sides(10, 1, least=100).batch == 100


def test_shooting_ends_at_its_tolerance_and_equals_gathering():
    s = state()
    shooting = Southwell(s, Grouping(1, 1 << 20), 1e-12)
    shares = list(shooting.run())
    assert shares == sorted(shares, reverse=True) and shares[-1] <= 1e-12 < shares[-2]
    assert not shooting.unfinished and shooting.done == pytest.approx(0.999)
    *_, want = jacobi(s.transport, np.repeat(np.array([[1.0], [0], [0]]), 3, axis=1), np.zeros((3, 3)), 1e-15, 1000)
    assert np.allclose(s.direct + s.indirect, want.irradiance, rtol=1e-10)
    found = balance(s)
    assert found == EnergyBalance(s.total, s.absorbed.sum(), s.escaped.sum(), pytest.approx(0, abs=1e-11))
    assert found.gap < 1e-12


def test_shooting_ends_with_its_shots_and_says_what_is_left():
    shooting = Southwell(state(), Grouping(1, 1 << 20), 1e-3, max_shots=2)
    shares = list(shooting.run())
    assert shooting.state.shots == 2 and shooting.unfinished
    assert shooting.shortfall == f"stopped after 2 shots with {shares[-1]:.2%} of the light unshot"
    assert shooting.text == f"2 shots, {shares[-1]:.2%} of the light unshot"
    assert shooting.done == pytest.approx((1 - shares[-1]) / 0.999)


def test_shooting_gives_up_where_nothing_becomes_less():
    closed = MatrixTransport(np.ones(2), np.ones((2, 3)), np.array([[0.0, 1], [1, 0]]))
    s = DiffuseShooting(closed, np.ones((2, 3)), np.zeros((2, 3)))
    shooting = Southwell(s, Grouping(1, 1 << 20), 1e-3, patience=20)
    assert 10 <= len(list(shooting.run())) <= 12 and shooting.unfinished


def test_refining_sides_keeps_their_unshot_flux_and_moves_it_to_where_more_light_arrived():
    """By class of segments: light that has arrived follows `factor`; what sides emit themselves is even on them."""
    s = state(high=4)
    s.shoot(np.array([0]), np.array([1]))  # class 1 of the unshot light: once reflected
    s.unshot[0] = 0.25  # own emission, unshot
    # Side 1 becomes two of area 1, of which the first got 1.5 of the mean light and the second 0.5.
    root, factor = np.array([0, 1, 1, 2]), np.repeat([[1.0], [1.5], [0.5], [1.0]], 3, axis=1)
    fine = MatrixTransport(np.ones(4), np.full((4, 3), 0.5), np.zeros((4, 4)))
    new = s.refined(fine, root, factor)
    once = s.unshot[1, 1]
    assert (once > 0).all()
    assert np.array_equal(new.unshot[0], np.full((4, 3), 0.25))
    assert np.allclose(new.unshot[1, 1:3], [1.5 * once, 0.5 * once], rtol=1e-15)
    assert np.allclose(new.direct[1:3], [1.5 * s.direct[1], 0.5 * s.direct[1]], rtol=1e-15)
    assert np.allclose(new.unshot_flux()[1:3].sum(), s.unshot_flux()[1], rtol=1e-15)
    assert np.allclose(new.remaining(), s.remaining(), rtol=1e-15) and new.absorbed is not s.absorbed


def test_the_ambient_estimate_is_that_of_a_scene_which_loses_the_share_that_shots_have_lost():
    """A = area x unshot radiosity x stays / area / (1 - rho stays): the series of Cohen 1988 in which a share escapes each time."""
    rho, stays = 0.5, 0.75
    open_box = MatrixTransport(np.ones(2), np.full((2, 3), rho), np.array([[0.0, stays], [stays, 0.0]]), np.full(2, 1 - stays))
    s = DiffuseShooting(open_box, np.repeat([[1.0], [0.0]], 3, axis=1), np.zeros((2, 3)))
    assert not s.ambient().any()  # no shot has shown yet what escapes
    s.shoot(np.array([0]), np.array([1]))
    # Unshot is rho stays on one of two equal sides, both of them reached.
    assert np.allclose(s.ambient(), rho * stays * stays / 2 / (1 - rho * stays), rtol=1e-14)
    # What it estimates is the mean of the light that is still to come.
    before = s.indirect.mean()
    for _ in Southwell(s, Grouping(1, 1 << 20), 1e-14).run():
        pass
    assert np.isclose(s.indirect.mean() - before, rho * stays * stays / 2 / (1 - rho * stays), rtol=1e-12)


def test_what_the_longest_path_cuts_off_is_no_light_to_come():
    s = state(high=2)
    for _ in Southwell(s, Grouping(1, 1 << 20), 1e-14).run():
        assert (s.ambient() >= 0).all()
    assert (s.cut > 0.01 * s.emitted).all() and not s.ambient().any()
    assert s.remaining() == pytest.approx(s.cut)


def test_nothing_to_shoot_ends_at_once():
    shooting = Southwell(state((0.0, 0.0, 0.0)), Grouping(1, 1 << 20), 1e-3)
    assert list(shooting.run()) == [] and not shooting.unfinished and shooting.share == 0
