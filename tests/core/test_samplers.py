"""Sample sets: uniform, even where they should be, the same however they are asked for, and no worse than independent numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.sampling.sets import SAMPLERS, Sampler, grid, shuffled

NAMES = [kind for kind, _, _ in SAMPLERS]
EVEN = [kind for kind in NAMES if kind != "independent"]


def sets(kind, total, receivers, dimensions, seed=5, stream=0):
    """(dimensions, receivers, total) numbers."""
    receiver = np.repeat(np.arange(receivers), total)
    index = np.tile(np.arange(total), receivers)
    u = Sampler(kind, seed).draw(stream, total, receiver, index, dimensions, np.random.default_rng([seed, stream]))
    return u.reshape(dimensions, receivers, total)


@pytest.mark.parametrize("total", [1, 2, 3, 7, 16, 100, 257])
def test_shuffled_is_a_permutation_and_not_always_the_same(total):
    keys = np.random.default_rng(1).integers(0, 2**32, 40, np.uint32)
    orders = [shuffled(np.arange(total, dtype=np.uint32), total, np.full(total, key)) for key in keys]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.arange(total))
    if total > 6:
        assert len({tuple(o) for o in orders}) == len(orders)


def test_shuffled_sends_every_index_everywhere():
    """Chi-square of the place of each index over many keys."""
    total, runs = 12, 24_000
    keys = np.random.default_rng(2).integers(0, 2**32, runs, np.uint32)
    index = np.repeat(np.arange(total, dtype=np.uint32), runs)
    place = shuffled(index, total, np.tile(keys, total))
    counts = np.bincount(index * total + place, minlength=total * total)
    expected = runs / total
    chi2 = ((counts - expected) ** 2 / expected).sum()
    freedom = (total - 1) ** 2
    assert abs(chi2 - freedom) < 5 * math.sqrt(2 * freedom)


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("total", [1, 7, 16])
def test_every_number_is_uniform(kind, total):
    """Chi-square in 20 bins of every dimension, for a fixed point of the set, over receivers."""
    u = sets(kind, total, 20_000, 5)
    assert u.dtype == np.float32
    assert (u >= 0).all()
    assert (u < 1).all()
    for d in range(5):
        for k in (0, total - 1):
            counts = np.bincount((u[d, :, k] * 20).astype(int), minlength=20)
            chi2 = ((counts - 1000) ** 2 / 1000).sum()
            assert chi2 < 55, (d, k, chi2)  # 19 degrees of freedom: exceeded once in 40,000


@pytest.mark.parametrize("kind", NAMES)
def test_dimensions_and_streams_are_independent(kind):
    """No pair of the dimensions of two streams is correlated over receivers and points."""
    u = np.concatenate([sets(kind, 16, 4000, 4), sets(kind, 16, 4000, 4, stream=1)]).reshape(8, -1)
    c = np.corrcoef(u) - np.eye(8)
    assert np.abs(c).max() < 5 / math.sqrt(u.shape[1])


@pytest.mark.parametrize("kind", EVEN)
@pytest.mark.parametrize("total", [16, 64])
def test_even_sets_put_one_point_in_every_cell(kind, total):
    side = math.isqrt(total)
    for pair in ((0, 1), (2, 3)) if kind == "jittered" else ((0, 1),):
        a, b = (sets(kind, total, 50, 4)[d] for d in pair)
        cell = (a * side).astype(int) * side + (b * side).astype(int)
        np.testing.assert_array_equal(np.sort(cell, axis=1), np.tile(np.arange(total), (50, 1)))


@pytest.mark.parametrize("total", [2, 5, 12, 13, 17, 100])
def test_grid_is_nearly_square_and_not_wasteful(total):
    columns, rows = grid(total)
    assert total <= columns * rows <= 1.35 * total + 1
    assert max(columns, rows) <= 4 * min(columns, rows)


@pytest.mark.parametrize("kind", EVEN)
def test_sobol_and_cells_do_not_depend_on_the_order_of_asking(kind):
    """A part of the rows, in another order, gives the same points (the place inside a jittered cell apart)."""
    receiver, index = np.repeat(np.arange(9), 16), np.tile(np.arange(16), 9)
    whole = Sampler(kind, 3).draw(2, 16, receiver, index, 6, np.random.default_rng(0))
    pick = np.random.default_rng(4).permutation(144)[:60]
    part = Sampler(kind, 3).draw(2, 16, receiver[pick], index[pick], 6, np.random.default_rng(1))
    if kind == "sobol":
        np.testing.assert_array_equal(part, whole[:, pick])
    else:
        np.testing.assert_array_equal((part * 4).astype(int), (whole[:, pick] * 4).astype(int))


@pytest.mark.parametrize("dimensions", [1, 2, 3, 18, 25, 40])
@pytest.mark.parametrize("kind", NAMES)
def test_any_number_of_dimensions(kind, dimensions):
    u = sets(kind, 8, 300, dimensions)
    assert u.shape == (dimensions, 300, 8)
    assert np.abs(u.mean(axis=(1, 2)) - 0.5).max() < 5 * math.sqrt(1 / 12 / 2400)


def smooth(u):
    return np.exp(-((u[0] - 0.3) ** 2)) * (1 + u[1])


def edge(u):
    return ((u[0] - 0.5) ** 2 + (u[1] - 0.4) ** 2 < 0.1).astype(float)


@pytest.mark.parametrize("function", [smooth, edge])
@pytest.mark.parametrize("kind", EVEN)
@pytest.mark.parametrize("total", [7, 16, 64])
def test_even_sets_have_less_variance_and_the_same_mean(kind, function, total):
    """Same mean within 4 standard errors of the independent estimate; never more variance; and much less where they are made for it."""
    plain = function(sets("independent", total, 4000, 2)).mean(axis=1)
    even = function(sets(kind, total, 4000, 2)).mean(axis=1)
    error = math.sqrt((plain.var() + even.var()) / 4000)
    assert abs(plain.mean() - even.mean()) < 4 * error
    assert even.var() < 0.9 * plain.var()
    if total >= 16:
        assert even.var() < (0.2 if function is smooth else 0.75) * plain.var()
