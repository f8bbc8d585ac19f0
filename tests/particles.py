"""Runs of particle tracing on elements, and z-tests of their means."""

from __future__ import annotations

import math

import numpy as np
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

load()
# Standard deviations that a sound method exceeds once in a thousand runs of the 60 z-tests here (Sidak).
Z = 4.3


def solve(world, receivers, particles=50_000, seed=1, **options):
    """The finished solution."""
    solver = method("particle_tracing")
    settings = solver.Settings(particles=particles, **options)
    *_, last = solver.solve(world, receivers, settings, np.random.default_rng(seed))
    return last.solution()


def on_elements(scene, target=100):
    """World and its elements as receivers."""
    world = World(scene)
    return world, ElementReceivers(Elements(world, target=target))


def replicates(scene, groups, runs=16, target=100, part="irradiance", **options):
    """Mean and standard error (g, 3) over independent runs of the mean of each group of element sides, by area.

    `groups(elements)` gives (2 ne,) int group of every side, -1 for none.
    """
    world, receivers = on_elements(scene, target)
    group = groups(receivers.elements)
    area = np.repeat(receivers.elements.area, 2)
    used = group >= 0
    count = group.max() + 1
    total = np.bincount(group[used], area[used], count)
    values = []
    for seed in range(runs):
        q = solve(world, receivers, seed=100 + seed, **options).quantity(part).astype(float)
        values.append([np.bincount(group[used], (area * q[:, c])[used], count) / total for c in range(3)])
    values = np.transpose(values, (0, 2, 1))
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(runs)


def front(elements):
    """All front sides as one group."""
    return np.where(np.arange(2 * elements.count) % 2 == 0, 0, -1)


def by_material(elements):
    """Front sides by the material's number."""
    scene = elements.world.scene
    triangle = elements.patch_triangle[elements.patch]
    names = [m.name for m in scene.materials]
    first = np.array([names.index(n) for n in names])
    _, number = np.unique(first[scene.material[triangle]], return_inverse=True)
    return np.stack([number, np.full(elements.count, -1)], axis=1).ravel()


def agrees(mean, error, expected, bias=0.0, resolution=0.003):
    """A z-test that can see a difference of one percent."""
    expected = np.asarray(expected, float)
    assert (error <= resolution * np.abs(expected)).all(), f"standard error {error} cannot tell {expected}"
    assert (np.abs(mean - expected) <= Z * error + bias).all(), f"{mean} is not {expected}, standard error {error}"
