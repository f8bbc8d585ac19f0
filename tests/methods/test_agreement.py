"""The four methods that solve all light transport between diffuse surfaces agree on the Cornell box, direct and indirect apart."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load
from adjgi.tests import scenes

load()
RUNS = 16
# 160 comparisons of means over 16 runs each: Student's t with 30 degrees of freedom exceeds this once in 200 such suites.
T = 5.0
# Elements of 5 cm: their radiosities may be off by this share of the irradiance of an object, and this much where it is dark, W m-2.
# The lamp hangs 1 cm below the ceiling, which is what makes it hard.
SHARE, FLOOR = 0.04, 0.01


class Box:
    """The Cornell box cut into elements, and means over its objects."""

    def __init__(self, max_edge):
        self.world = World(scenes.cornell())
        self.receivers = ElementReceivers(Elements(self.world, max_edge=max_edge))
        e = self.receivers.elements
        owner = self.world.scene.object[e.patch_triangle[e.patch]]
        self.group = np.stack([2 * owner, 2 * owner + 1], axis=1).ravel()
        self.area = np.repeat(e.area, 2)

    def means(self, name, seed=1, **options):
        """(2, g, 3) mean direct and indirect irradiance of every side of every object."""
        solver = method(name)
        *_, last = solver.solve(self.world, self.receivers, solver.Settings(**options), np.random.default_rng(seed))
        solution = last.solution()
        total = np.bincount(self.group, self.area)
        parts = [solution.direct.astype(float), solution.indirect.astype(float)]
        return np.array([[np.bincount(self.group, self.area * p[:, c]) / total for c in range(3)] for p in parts]).transpose(0, 2, 1)

    def runs(self, name, **options):
        """Mean and standard error over independent runs."""
        values = np.array([self.means(name, seed, **options) for seed in range(RUNS)])
        return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(RUNS)


@pytest.fixture(scope="module")
def particles():
    return Box(0.1).runs("particle_tracing", particles=150_000)


@pytest.fixture(scope="module")
def paths():
    return Box(0.1).runs("path_tracing", samples=64)


def test_particles_agree_with_paths(particles, paths):
    """Both are unbiased: the difference is noise, for direct and indirect light, each object, side and colour."""
    (a, sa), (b, sb) = particles, paths
    error = np.sqrt(sa**2 + sb**2)
    # A ray that starts within the offset of an edge may slip through: a millionth of the brightest.
    assert (np.abs(a - b) <= T * error + 1e-5 * b.max()).all()
    # The comparison can see what matters: the error of the whole box, by the median object, is below one percent.
    lit = b > 0.05
    assert np.median((error / np.maximum(b, 1e-9))[lit]) < 0.02
    assert lit[0].sum() > 20 and lit[1].sum() > 40


# Many rays for the finest: what is left is the error of the elements.
RADIOSITIES = {"matrix_radiosity": {"rays": 512}, "progressive_radiosity": {"rays": 4_000_000}}


@pytest.fixture(scope="module")
def fine():
    """Means by both radiosities with elements of 5 cm."""
    box = Box(0.05)
    return {name: box.means(name, **options) for name, options in RADIOSITIES.items()}


@pytest.mark.parametrize("name", RADIOSITIES)
def test_radiosity_agrees_with_particles(name, particles, fine):
    """Within the stated error of the elements, which is far smaller than with elements of twice the size."""
    mean, error = particles
    seen = mean.sum(axis=0) > 0.01  # an element of the floor that a block stands on shines a little inside the block, where it is dark
    assert seen[::2].all()
    allowed = (SHARE * mean.sum(axis=0) + FLOOR + T * error)[:, seen]
    off = np.abs(fine[name] - mean)[:, seen]
    assert (off <= allowed).all()
    coarse = np.abs(Box(0.1).means(name) - mean)[:, seen]
    assert off.max() < 0.5 * coarse.max()


def test_the_two_radiosities_agree(fine):
    """They solve the same equations with form factors found in two ways."""
    a, b = fine.values()
    assert (np.abs(a - b) <= 0.02 * b.sum(axis=0) + FLOOR).all()


@pytest.mark.parametrize("longest", [1, 2, 3])
def test_path_lengths_mean_the_same_to_all(longest):
    """Light of paths up to a length, over all front sides of a room with unequal walls."""
    world = World(scenes.room())
    receivers = ElementReceivers(Elements(world, max_edge=0.5))
    means = {}
    options = {"particle_tracing": {"particles": 400_000}, "path_tracing": {"samples": 256}}
    for name in ("path_tracing", "particle_tracing", "matrix_radiosity", "progressive_radiosity"):
        solver = method(name)
        settings = solver.Settings(max_length=longest, **options.get(name, {}))
        *_, last = solver.solve(world, receivers, settings, np.random.default_rng(1))
        area = receivers.elements.area
        means[name] = (area[:, None] * last.solution().quantity("irradiance")[::2]).sum(axis=0) / area.sum()
    expected = means["matrix_radiosity"]
    assert expected[0] > 0.1
    for name, mean in means.items():
        np.testing.assert_allclose(mean, expected, rtol=0.01, err_msg=name)
