"""Kernels around receivers: how wide they are, which side they look at, and what a receiver on several faces is a mean of."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.base import SurfaceReceivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.particle_density import HITS, ParticleDensity


def sheet(side=2.0):
    b = SceneBuilder()
    b.quad("Sheet", (0, 0, 0), (side, 0, 0), (0, side, 0), diffuse("Grey", 0.5))
    return World(b.build())


def at_middle(world, *triangles):
    """One receiver of points in the middles of triangles."""
    n = len(triangles)
    return SurfaceReceivers("vertices", np.array([0, n]), np.array(triangles), np.full(n, 1 / 3), np.full(n, 1 / 3))


def test_a_kernel_holds_so_many_particles_where_they_are_spread_evenly():
    world = sheet()
    density = ParticleDensity(world, at_middle(world, 0), 10_000)
    assert np.pi * density.radius[0] ** 2 / world.area.sum() * 10_000 == pytest.approx(HITS)


def test_only_what_lands_on_faces_turned_alike_counts():
    """Within sixty degrees: neither round the corner of a box nor on the other side of a sheet."""
    world = sheet()
    density = ParticleDensity(world, at_middle(world, 0), 1000, radius=0.5)
    for degrees, counts in ((0, True), (50, True), (70, False), (100, False), (180, False)):
        normal = np.array([[0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))]], np.float32)
        found = density.sum(np.zeros(1, np.int64), density.position, normal, np.ones((1, 3)))
        assert found == pytest.approx(np.full((1, 3), float(counts)))


def test_a_receiver_is_the_mean_of_its_points_by_their_number():
    """Two points on one face and one on the other, which alone gets light: a third of it."""
    world = sheet()
    density = ParticleDensity(world, at_middle(world, 0, 0, 1), 1000, radius=0.5)
    assert density.count == 2
    value, known = density.values(np.array([[0.0] * 3, [6.0] * 3]), np.array([1.0, 2.0]))
    assert value[0] == pytest.approx(1.0) and known[0] == pytest.approx(1)
    # Where no area could be measured, the others stand for it.
    value, known = density.values(np.array([[0.0] * 3, [6.0] * 3]), np.array([0.0, 2.0]))
    assert value[0] == pytest.approx(3.0) and known[0] == pytest.approx(1 / 3)


@pytest.mark.parametrize("baked, free", [(1, 0.0), (-1, 1.0)])
def test_area_is_left_out_where_the_side_that_is_baked_lies_in_a_body(baked, free):
    """A body stands on a sheet: below it is no area of the front, and all area of the back."""
    b = SceneBuilder()
    b.quad("Sheet", (-2, -2, 0), (4, 0, 0), (0, 4, 0), diffuse("Grey", 0.5))
    corners = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0), (0, 0, 1)], float)
    b.mesh("Body", corners, np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]), diffuse("Grey", 0.5))
    world = World(b.build())
    facing = baked * world.rows[:, 9:12]
    # On the diagonal of the sheet: in its middle, and far from the body.
    u = np.array([0.0, 0.0], np.float32)
    receivers = SurfaceReceivers("vertices", np.arange(3), np.zeros(2, np.int64), u, np.float32([0.5, 0.1]), facing)
    density = ParticleDensity(world, receivers, 1000, radius=0.2)
    area = density.area(400_000, np.random.default_rng(0))
    np.testing.assert_allclose(area / (np.pi * 0.2**2 / 2), [free, 1.0], atol=0.1)
