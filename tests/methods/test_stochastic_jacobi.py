"""Stochastic Jacobi radiosity: unbiased, with an error that it knows and that falls with the root of its rays, and dual to itself."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SceneError
from adjgi.adjoint_gi.core.elements.rays import ElementRays
from adjgi.adjoint_gi.core.radiosity.southwell import DiffuseShooting
from adjgi.adjoint_gi.core.radiosity.transports import FreshRayTransport
from adjgi.solvers.stochastic_jacobi import Mean, shoot
from adjgi.tests import scenes
from adjgi.tests.solving import front_means, on_elements, solve, steps

NAME = "stochastic_jacobi"


def mean_and_error(receivers, runs, **options):
    """(2 ne,) mean irradiance over seeds, its standard error, and the relative standard errors that the runs state."""
    found = [solve(NAME, receivers, seed=100 + k, **options) for k in range(runs)]
    values = np.array([s.quantity("irradiance")[:, 0] for s in found], float)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(runs), [s.history[-1][1] for s in found]


def difference(receivers, solution, exact):
    """Root mean square difference by area, relative to the root mean square of `exact`."""
    area = np.repeat(receivers.elements.area, 2)
    x, y = (s.quantity("irradiance").astype(float).sum(axis=1) for s in (solution, exact))
    return math.sqrt((area @ (x - y) ** 2) / (area @ y**2))


def test_it_is_unbiased_for_every_element():
    """Against the full matrix of closed forms, in a room of unequal walls: z-tests of every element side, all with the right spread."""
    receivers = on_elements(scenes.room(), 1.0)
    exact = solve("matrix_radiosity", receivers, tolerance=1e-12).quantity("irradiance")[0::2, 0]
    mean, error, _ = mean_and_error(receivers, 48, rays=20_000)
    z = (mean[0::2] - exact) / error[0::2]
    assert error[0::2].max() < 0.03 * exact.min()
    assert np.abs(z).max() < 4.5 and 0.8 < math.sqrt((z**2).mean()) < 1.25
    assert abs(z.mean()) < 0.4


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 2), (0, 3), (2, 2), (2, 3)])
def test_one_every_bounce(low, high):
    """T1: bounded paths hold the partial sums of the Neumann series, in the mean over elements."""
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    s = solve(NAME, receivers, rays=200_000, min_length=low, max_length=high)
    want = sum(0.5**k for k in range(low, high + 1))
    assert np.average(s.quantity("radiosity")[0::2, 0], weights=receivers.elements.area) == pytest.approx(want, rel=1e-3)
    assert s.emitted.any() == s.direct.any() == (low == 0)


def test_error_falls_with_the_root_of_the_rays():
    receivers = on_elements(scenes.room(), 0.5)
    exact = solve("matrix_radiosity", receivers, tolerance=1e-12)
    counts = [2**k for k in (13, 15, 17, 19)]
    errors = [
        math.sqrt(np.mean([difference(receivers, solve(NAME, receivers, seed=seed, rays=n), exact) ** 2 for seed in range(4)]))
        for n in counts
    ]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.1)


def test_it_agrees_with_the_full_matrix_within_the_error_it_states():
    """On the Cornell box. Both find visibility by rays: the matrix casts many more of them."""
    receivers = on_elements(scenes.cornell(), 0.2)
    exact = solve("matrix_radiosity", receivers, rays=8192)
    s = solve(NAME, receivers, rays=400_000, seed=3)
    stated = s.history[-1][1]
    assert 0.5 * stated < difference(receivers, s, exact) < 1.5 * stated
    assert stated < 0.05
    found, want = (front_means(receivers, x.quantity("irradiance")) for x in (s, exact))
    assert np.abs(found - want).max() < 0.01 * want.max()


def test_the_error_it_states_is_the_spread_over_seeds():
    receivers = on_elements(scenes.room(), 1.0)
    mean, error, stated = mean_and_error(receivers, 32, rays=20_000)
    area = np.repeat(receivers.elements.area, 2)
    spread = math.sqrt((area @ (error**2 * 32)) / (area @ mean**2))
    assert math.sqrt(np.mean(np.square(stated))) == pytest.approx(spread, rel=0.15)


def test_source_and_receiver_may_be_exchanged():
    """<g, L> = <W, Le> between a wall and the floor, of 12 and 16 m2: the power that comes from the one to the other."""
    power = []
    for source, receiver in ((0, 4), (4, 0)):
        receivers = on_elements(scenes.room(emission=[float(face == source) for face in range(6)]), 0.5)
        mean, error, _ = mean_and_error(receivers, 16, rays=50_000)
        e = receivers.elements
        own = (e.patch == receiver) * e.area
        power.append((own @ mean[0::2], math.sqrt((own**2) @ error[0::2] ** 2)))
    (a, sa), (b, sb) = power
    assert math.hypot(sa, sb) < 0.005 * a
    assert abs(a - b) < 4 * math.hypot(sa, sb)


def test_cost_is_by_power_and_not_by_pairs():
    """Each reflection takes as many rays as it takes light: 1 / (1 - rho) times the rays for all of it, whatever the elements."""
    for edge in (0.5, 0.125):
        s = solve(NAME, on_elements(scenes.cube(0.5, 1.0), edge), rays=100_000)
        # The backs, which nothing meets, send as much as the fronts; their light is not reflected.
        assert s.rays == pytest.approx(100_000 * (0.5 * 2 + 0.5), rel=0.01)


def test_light_is_accounted_for_but_for_less_than_a_ray_an_iteration():
    rays = 50_000
    s = solve(NAME, on_elements(scenes.cornell(), 0.2), rays=rays)
    iterations = sum(1 for _ in steps(NAME, on_elements(scenes.cornell(), 0.2), rays=rays))
    assert s.balance.unshot == 0 and s.balance.gap < iterations / rays
    assert s.balance.escaped > 0.1 * s.balance.emitted


def test_survival_is_fair():
    """Light of half a ray is sent every second time, and then as the light of a whole one."""
    receivers = on_elements(scenes.lit_cube(0.5))
    rng = np.random.default_rng(0)
    sent, drawn = [], 0
    for _ in range(400):
        transport = FreshRayTransport(ElementRays(receivers.elements), rng)
        emitted = np.repeat(receivers.elements.emitted, 2, axis=0) * np.tile([1.0, 0.0], receivers.elements.count)[:, None]
        state = DiffuseShooting(transport, emitted, np.zeros_like(emitted))
        count = shoot(state, 2 * state.total, rng)
        assert count in (0, 1)
        drawn += count
        sent.append(float(state.sent.sum()) / state.total)
    assert set(np.round(sent, 9)) == {0.0, 2.0}
    assert abs(drawn - 200) < 4 * 10


def test_nothing_is_drawn_where_nothing_is_unshot():
    receivers = on_elements(scenes.cube(0.5))
    transport = FreshRayTransport(ElementRays(receivers.elements), np.random.default_rng(0))
    dark = np.zeros((2 * receivers.elements.count, 3))
    assert shoot(DiffuseShooting(transport, dark, dark), 1.0, np.random.default_rng(0)) == 0
    assert Mean(transport.area).relative_error() == math.inf


def test_light_that_is_caught_is_refused_by_name():
    with pytest.raises(SceneError, match="Wall"):
        solve(NAME, on_elements(scenes.cube(1.0, 1.0), 0.5), rays=20_000)


def test_a_dark_scene_says_so():
    s = solve(NAME, on_elements(scenes.cube()))
    assert any("nothing emits light" in str(w) for w in s.warnings)


def test_the_stated_error_is_that_of_the_mean_by_area():
    """Two runs on two sides of areas 1 and 9: sums of channels 3 and 9 on the one, 6 and 6 on the other; both have 6 in the mean."""
    mean = Mean(np.array([1.0, 9.0]))
    for first in (1.0, 3.0):
        light = np.array([[first] * 3, [2.0] * 3])
        flux = {"total": 10 * first, "absorbed": np.full(3, first), "escaped": np.full(3, 2 * first), "remaining": lambda: np.zeros(3)}
        mean.add(SimpleNamespace(direct=light / 4, indirect=light * 3 / 4, **flux))
    # The standard error of the mean on the first side is 3: of 6 there, and of 6 on nine times the area, where it is 0.
    assert mean.relative_error() == pytest.approx(math.sqrt(3**2 / (10 * 6**2)))
    found = mean.balance()
    assert (found.emitted, found.absorbed, found.escaped, found.unshot) == (20, 6, 12, 0)
