"""The two equations are adjoint: <g, L> = <W, Le>, for every pair of methods, between surfaces of unequal area (review, Eq. 1 to 4).

With a uniform diffuse g on one surface and a uniform Le on another, <g, L> is the power that arrives on the one from the other, and W is
what g as a source would give: exchanging source and receiver must not change the power. A gathering method and a shooting
method may stand on the two sides.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

load()
RUNS = 16
T = 5.0  # standard errors, of 16 runs
OPTIONS = {
    "path_tracing": {"samples": 40},
    "particle_tracing": {"particles": 80_000},
    "matrix_radiosity": {"tolerance": 1e-6},
    "progressive_radiosity": {"tolerance": 1e-5, "rays": 4_000_000},
}
RANDOM = ("path_tracing", "particle_tracing")
WALL, FLOOR = 0, 4  # 12 and 16 m2


def room(source):
    """A 4 x 4 x 3 room of six albedos with a block in it; one face has radiosity 1."""
    rho = (0.3, 0.5, 0.6, 0.14, 0.2, 0.7)
    mats = [diffuse(f"Face{i}", r, 1 / math.pi if i == source else 0.0) for i, r in enumerate(rho)]
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), mats, inward=True)
    b.box("Block", (1.25, 1.0, 0.5), (2.0, 2.5, 1.5), diffuse("Block", 0.4), inward=False)
    return World(b.build())


def power(name, source, receiver, seed=1):
    """Power (first colour) that arrives on the front of one face of the room from another."""
    world = room(source)
    elements = Elements(world, max_edge=0.5)
    solver = method(name)
    settings = solver.Settings(**OPTIONS[name])
    *_, last = solver.solve(world, ElementReceivers(elements), settings, np.random.default_rng(seed))
    own = world.scene.object[elements.patch_triangle[elements.patch]] == receiver
    irradiance = last.solution().quantity("irradiance")[::2, 0].astype(float)
    return (elements.area * irradiance)[own].sum()


def estimate(name, source, receiver):
    """Power and its standard error; 0 for methods without noise."""
    if name not in RANDOM:
        return power(name, source, receiver), 0.0
    values = [power(name, source, receiver, seed) for seed in range(RUNS)]
    return np.mean(values), np.std(values, ddof=1) / math.sqrt(RUNS)


@pytest.fixture(scope="module")
def estimates():
    return {(name, way): estimate(name, *way) for name in OPTIONS for way in ((WALL, FLOOR), (FLOOR, WALL))}


@pytest.mark.parametrize("gathering", RANDOM)
@pytest.mark.parametrize("shooting", RANDOM)
def test_source_and_receiver_may_be_exchanged(estimates, gathering, shooting):
    """Monte Carlo form: a two-sample test of <g, L> by one method against <W, Le> by the other."""
    (a, sa), (b, sb) = estimates[gathering, (WALL, FLOOR)], estimates[shooting, (FLOOR, WALL)]
    error = math.hypot(sa, sb)
    assert error < 0.005 * a
    assert abs(a - b) < T * error


def test_a_matrix_is_its_own_adjoint(estimates):
    """Form factors in closed form are reciprocal; those past the block are counted rays."""
    a, b = (estimates["matrix_radiosity", way][0] for way in ((WALL, FLOOR), (FLOOR, WALL)))
    assert a == pytest.approx(b, rel=1e-3)


def test_shots_by_rays_obey_the_exchange_within_their_noise(estimates):
    a, b = (estimates["progressive_radiosity", way][0] for way in ((WALL, FLOOR), (FLOOR, WALL)))
    assert a == pytest.approx(b, rel=0.005)


@pytest.mark.parametrize("name", ["matrix_radiosity", "progressive_radiosity"])
def test_elements_come_close_to_the_walks(estimates, name):
    """Half-metre elements in this room are off by about a percent."""
    a, b = estimates[name, (WALL, FLOOR)][0], estimates["path_tracing", (WALL, FLOOR)][0]
    assert a == pytest.approx(b, rel=0.02)
