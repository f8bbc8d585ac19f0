"""Every map from random numbers against its density (chi-square), picks by weight, and evenness of the low-discrepancy numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.sampling import maps as sampling
from adjgi.adjoint_gi.core.sampling import sobol as low_discrepancy
from adjgi.adjoint_gi.core.sampling.additive import STEPS, additive
from adjgi.adjoint_gi.core.sampling.maps import PowerTable, dot

# Standard deviations that a sound sampler exceeds once in a thousand runs of the 30 tests here (Sidak).
Z = 4.2
N = 200_000


def chi_square(cells, expected):
    """Normal deviate of Pearson's statistic of cell indices (n,) against probabilities (k,); cells of few are pooled."""
    n = len(cells)
    counts = np.bincount(cells, minlength=len(expected)).astype(float)
    order = np.argsort(expected)
    counts, wanted = counts[order], np.asarray(expected, float)[order] * n
    assert not counts[wanted == 0].any(), "a sample fell where the density is zero"
    few = wanted < 5
    if few.any():
        counts, wanted = np.append(counts[~few], counts[few].sum()), np.append(wanted[~few], wanted[few].sum())
        counts, wanted = counts[wanted > 0], wanted[wanted > 0]
    k = len(wanted) - 1
    x = ((counts - wanted) ** 2 / wanted).sum()
    # Wilson and Hilferty: the cube root of chi-square over its freedom is nearly normal.
    return ((x / k) ** (1 / 3) - (1 - 2 / (9 * k))) / math.sqrt(2 / (9 * k))


def uniform(seed, rows=2, n=N):
    """(rows, n) float32."""
    return np.random.default_rng(seed).random((rows, n), np.float32)


def grid(a, b, rows=12, columns=12):
    """Cells of two coordinates in 0..1."""
    i = np.clip((a * rows).astype(int), 0, rows - 1)
    return i * columns + np.clip((b * columns).astype(int), 0, columns - 1)


def turn(w, x, y, z):
    """Coordinates of directions in a frame: cosine to z, and azimuth in 0..1."""
    phi = np.arctan2(w.T @ y, w.T @ x) / (2 * np.pi) % 1.0
    return w.T @ z, phi


AXES = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.3, -0.5, -0.8), (1e-4, 2e-4, -1)]


def basis(axis):
    """Right-handed float64 frame about an axis."""
    z = np.array(axis, float) / np.linalg.norm(axis)
    x = np.cross(z, (0, 1, 0) if abs(z[1]) < 0.9 else (1, 0, 0))
    x /= np.linalg.norm(x)
    return x, np.cross(z, x), z


def test_sphere_is_uniform():
    w = sampling.sphere(*uniform(1))
    assert np.allclose(dot(w, w), 1, atol=1e-5)
    c, phi = turn(w.astype(float), *np.eye(3))
    assert abs(chi_square(grid(0.5 + 0.5 * c, phi), np.full(144, 1 / 144))) < Z


@pytest.mark.parametrize("axis", AXES)
def test_cosine_hemisphere(axis):
    x, y, z = basis(axis)
    normal = np.repeat(z[:, None], N, axis=1).astype(np.float32)
    w, cosine = sampling.cosine_hemisphere(normal, *uniform(2))
    assert np.allclose(dot(w, w), 1, atol=1e-5)
    assert np.allclose(dot(w, normal), cosine, atol=2e-5)
    c, phi = turn(w.astype(float), x, y, z)
    # The square of the cosine is uniform.
    assert abs(chi_square(grid(c * c, phi), np.full(144, 1 / 144))) < Z


def test_cosine_hemisphere_at_the_pole_opposite_the_normal():
    normal = np.array([[0, 0], [0, 0], [1, 1]], np.float32)
    w, cosine = sampling.cosine_hemisphere(normal, np.array([1, 1 - 2**-24], np.float32), np.zeros(2, np.float32))
    assert np.isfinite(w).all() and np.allclose(dot(w, w), 1, atol=1e-6)
    assert np.allclose(dot(w, normal), cosine, atol=1e-6) and cosine[0] == 1 and 0 <= cosine[1] < 1e-3


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("half", [0.004, 1.0])
def test_cone(axis, half):
    x, y, z = basis(axis)
    normal = np.repeat(z[:, None], N, axis=1).astype(np.float32)
    width = 2 * math.sin(half / 2) ** 2
    w, c = sampling.cone(normal, np.full(N, width, np.float32), *uniform(3))
    w = w.astype(float)
    across = w - z[:, None] * (z @ w)
    sine2 = (across**2).sum(axis=0)
    one_minus = sine2 / (1 + np.sqrt(np.maximum(0, 1 - sine2)))
    assert np.allclose(dot(w, w), 1, atol=1e-5) and np.allclose(z @ w, c, atol=1e-5)
    _, phi = turn(w, x, y, z)
    # The narrow cone's size is known to float32 only: 1 cell in 12 must not see that.
    assert abs(chi_square(grid(one_minus / width, phi), np.full(144, 1 / 144))) < Z


def test_disk():
    a, b = sampling.disk(*uniform(4))
    phi = np.arctan2(b, a) / (2 * np.pi) % 1
    assert abs(chi_square(grid(a * a + b * b, phi), np.full(144, 1 / 144))) < Z


def test_triangle():
    a, b = sampling.triangle(*uniform(5))
    assert a.min() >= 0 and b.min() >= 0 and (a + b).max() <= 1 + 1e-6
    # 1 - sqrt(1 - t) maps the first barycentric and b / (1 - a) the second to the unit square.
    assert abs(chi_square(grid(1 - (1 - a) ** 2, np.where(a < 1, b / (1 - a), 0)), np.full(144, 1 / 144))) < Z


@pytest.mark.parametrize(
    "weights", [[1.0], [0.0, 3.0, 0.0], [1, 1], [5, 1, 0.2, 0, 7, 1e-3], list(range(1, 50)), [1e-9, 1, 1e9]], ids=lambda w: str(len(w))
)
def test_picks_by_weight(weights):
    table = PowerTable(weights)
    expected = np.array(weights) / np.sum(weights)
    assert np.allclose(table.probability, expected, rtol=1e-12)
    for u in (uniform(6)[0], np.random.default_rng(7).random(N)):
        cells = table.pick(u)
        assert cells.min() >= 0 and cells.max() < len(weights)
        if np.count_nonzero(weights) > 1:
            assert chi_square(cells, expected) < Z
        else:
            assert (cells == np.argmax(weights)).all()


@pytest.mark.parametrize("count", [2, 3, 37, 1000])
@pytest.mark.parametrize("power", [0.1, 1, 4, 30])
def test_picks_exactly_what_the_table_says(count, power):
    table = PowerTable(np.random.default_rng(8).random(count) ** power)
    n = 1 << 20
    counts = np.bincount(table.pick((np.arange(n) + 0.5) / n), minlength=count)
    assert np.allclose(counts / n, table.probability, atol=(count + 1) / n)


def test_power_table_refuses_what_is_no_weight():
    for bad in ([1, -1], [1, np.nan], [np.inf, 1]):
        with pytest.raises(ValueError):
            PowerTable(bad)
    assert PowerTable([]).count == 0 and PowerTable([0, 0]).count == 0


def test_power_heuristic_weights_sum_to_one():
    a, b = np.exp(np.random.default_rng(9).normal(0, 8, (2, 1000))).astype(np.float32)
    assert np.allclose(sampling.power_heuristic(a, b) + sampling.power_heuristic(b, a), 1, atol=1e-5)
    one = np.float32(1)
    assert sampling.power_heuristic(np.array([1e-15], np.float32), np.array([1e15], np.float32))[0] < 1e-30
    assert sampling.power_heuristic(one, np.float32(0)) == 1


def test_sobol_numbers_are_stratified():
    n, d = 256, low_discrepancy.DIMENSIONS
    x = low_discrepancy.sobol_at(np.arange(n, dtype=np.uint32), d) / 2.0**32
    # One point in every 256th of every dimension; one in every elementary interval of the first two.
    assert (np.sort((x * n).astype(int), axis=1) == np.arange(n)).all()
    assert all(evenly(x[:2], bits, n) for bits in splits(8, 2))
    # No two dimensions are the same.
    assert (np.abs(np.corrcoef(x)) - np.eye(d)).max() < 0.5


def splits(bits, dimensions):
    """All ways to divide the bits among the dimensions."""
    if dimensions == 1:
        return [(bits,)]
    return [(k, *rest) for k in range(bits + 1) for rest in splits(bits - k, dimensions - 1)]


def evenly(x, bits, n):
    """Whether as many of the `n` points x (d, n) lie in each cell when dimension i is cut into 2^bits[i]."""
    cell = np.zeros(n, int)
    for row, many in zip(x, bits, strict=True):
        cell = (cell << many) + (row * 2**many).astype(int)
    return (np.bincount(cell, minlength=1 << sum(bits)) == n >> sum(bits)).all()


USES = (2, 2, 3, 1, 3)


@pytest.mark.parametrize("first", [0, 16, 3 << 20])
def test_each_use_has_even_numbers_from_a_few_points_on(first):
    """Two numbers are a net; the first three have a point in every octant of eight. With the dimensions of the sequence dealt out, four
    points of the third use were in two quadrants, and eight in four octants."""
    for receiver in range(20):
        x = low_discrepancy.shifted(np.array([receiver]), first, 16, USES, seed=3).astype(float)
        for use, at in zip(USES, np.cumsum((0, *USES)), strict=False):
            part = x[at : at + use]
            for count in (2, 4, 8, 16):
                m = count.bit_length() - 1
                assert all(evenly(part[i : i + 1, :count], (m,), count) for i in range(use))
                assert use == 1 or all(evenly(part[:2, :count], bits, count) for bits in splits(m, 2))
            assert use < 3 or evenly(part[:, :8], (1, 1, 1), 8)


def test_uses_are_joined_at_random():
    """Over receivers all pairs of quarters are alike; and the points of one fill the pairs no worse than independent ones would."""
    x = low_discrepancy.shifted(np.arange(4000), 0, 16, USES, seed=3).reshape(sum(USES), 4000, 16)
    cell = (x[2] * 4).astype(int) * 4 + (x[4] * 4).astype(int)
    assert abs(chi_square(cell[:, 5], np.full(16, 1 / 16))) < Z
    together = np.zeros((4000, 16))
    np.add.at(together, (np.repeat(np.arange(4000), 16), cell.ravel()), 1)
    # Sixteen points in sixteen cells: one in each at best; a variance of 15 / 16 where they are independent, of 3 where four have all.
    assert together.var() < 1.1


def test_shifted_numbers_do_not_depend_on_the_batch():
    receivers = np.arange(100, 140)
    whole = low_discrepancy.shifted(receivers, 0, 16, USES, seed=5).reshape(sum(USES), 40, 16)
    part = low_discrepancy.shifted(receivers[10:20], 4, 8, USES, seed=5).reshape(sum(USES), 10, 8)
    assert (whole[:, 10:20, 4:12] == part).all()
    assert (low_discrepancy.shifted(receivers, 0, 16, USES, seed=6) != whole.reshape(sum(USES), -1)).mean() > 0.99


@pytest.mark.parametrize("index", [0, 1, 1000])
def test_each_point_is_uniform_over_receivers(index):
    x = low_discrepancy.shifted(np.arange(100_000), index, 1, USES, seed=11).astype(float)
    assert x.min() >= 0 and x.max() < 1
    for a, b in ((0, 1), (2, 3), (4, 7)):
        assert abs(chi_square(grid(x[a], x[b]), np.full(144, 1 / 144))) < Z


@pytest.mark.parametrize("dimensions", STEPS)
def test_steps_are_powers_of_the_root(dimensions):
    x = 2.0
    for _ in range(200):
        x = (1 + x) ** (1 / (dimensions + 1))
    assert np.allclose(STEPS[dimensions], x ** -np.arange(1, dimensions + 1), rtol=4e-16, atol=0)


def test_additive_points_are_even_and_move_with_the_shift():
    n = 1 << 12
    points = additive(np.arange(n), STEPS[2], 0.5)
    assert points.shape == (2, n) and (points[:, 0] == 0.5).all() and (points >= 0).all() and (points < 1).all()
    cells = np.bincount((points * 16).astype(int).T @ np.array([16, 1]), minlength=256)
    assert cells.min() >= 13 and cells.max() <= 19  # 16 on average; independent points would spread by 4
    moved = additive(np.arange(n), STEPS[2], 0.5, np.array([[0.25], [0.75]]))
    assert np.allclose((moved - points - [[0.25], [0.75]]) % 1.0 % (1 - 1e-12), 0, atol=1e-9)


def test_polar_directions_are_unit_above_the_horizon_and_follow_the_cosine():
    u, v = uniform(9)
    w = sampling.polar(u, sampling.TWO_PI * v)
    assert np.allclose(dot(w, w), 1, atol=1e-5) and (sampling.polar(np.ones(1, np.float32), np.zeros(1, np.float32))[2] > 0).all()
    c, phi = turn(w.astype(float), *np.eye(3))
    assert abs(chi_square(grid(c * c, phi), np.full(144, 1 / 144))) < Z


def test_cosine_directions_are_the_same_in_rows():
    x = np.random.default_rng(3).normal(size=(3, 1000)).astype(np.float32)
    x /= np.sqrt(dot(x, x))
    u, v = (a[:1000] for a in uniform(4))
    assert (sampling.cosine_directions(x.T, u, v) == sampling.cosine_hemisphere(x, u, v)[0].T).all()
