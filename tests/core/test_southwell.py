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


def test_nothing_to_shoot_ends_at_once():
    shooting = Southwell(state((0.0, 0.0, 0.0)), Grouping(1, 1 << 20), 1e-3)
    assert list(shooting.run()) == [] and not shooting.unfinished and shooting.share == 0
