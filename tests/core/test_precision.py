# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays leave triangles far enough not to meet them again, and no farther than their own rounding asks: nothing far away matters."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.sampling.maps import columns
from adjgi.adjoint_gi.core.scene.arrays import Light, RayKind
from adjgi.adjoint_gi.core.scene.faces import Faces
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.solving import quad_points, solve

N = 60_000
GREY = diffuse("Grey", 0.5)


def soup(rng, size, spread, middle=(0.0, 0.0, 0.0), thin=1.0):
    """Corners (300, 3) of 100 random triangles of about `size` within `spread` of a point; slivers of thickness `thin`."""
    e = rng.normal(size=(100, 3, 3)) * size
    if thin < 1:
        e[:, 2] = e[:, 1] + rng.normal(size=(100, 3)) * size * thin
    return (rng.uniform(-spread, spread, (100, 1, 3)) + e + np.asarray(middle)).reshape(-1, 3)


SOUPS = {
    "room": [(1, 5)],
    "crumbs": [(0.01, 5)],
    "large": [(100, 5)],
    "dust in a hall": [(0.001, 1000)],
    "slivers": [(1, 5, (0, 0, 0), 1e-3)],
    "thin slivers": [(1, 5, (0, 0, 0), 1e-5)],
    "two places": [(1, 5), (1, 5, (2e4, 1.3e4, -1e4))],
    "far away": [(1, 5, (1e6, -2e6, 3e6))],
}


def leaving(world, rng, through=False):
    """Random points of all triangles, and directions from them (n, 3), down to a ten-thousandth of grazing."""
    triangle = rng.integers(0, world.triangle_count, N).astype(np.int32)
    u, v = rng.random((2, N), np.float32)
    fold = u + v > 1
    u[fold], v[fold] = 1 - u[fold], 1 - v[fold]
    surface = world.surface(triangle, u, v)
    ng = surface.ng.astype(float)
    along = np.cross(ng, rng.normal(size=(N, 3)))
    along /= np.linalg.norm(along, axis=1)[:, None]
    z = 10.0 ** rng.uniform(-4, 0, N)[:, None]
    return surface, ((-z if through else z) * ng + np.sqrt(1 - z * z) * along).astype(np.float32)


@pytest.mark.parametrize("name", SOUPS)
@pytest.mark.parametrize("through", [False, True])
def test_rays_do_not_meet_the_triangle_they_leave(name, through):
    rng = np.random.default_rng(1)
    b = SceneBuilder()
    for i, place in enumerate(SOUPS[name]):
        points = soup(rng, *place)
        b.mesh(f"Soup {i}", points, np.arange(len(points)).reshape(-1, 3), GREY)
    world = World(b.build())
    surface, direction = leaving(world, rng, through)
    origin = world.leave(surface, np.full(N, through))
    triangle, u, v, t = world.intersect(origin, direction, RayKind.DIFFUSE)
    assert not (triangle == surface.triangle).any()
    # Where they arrive, they go on along the mirror direction from the place that the length of the ray gives, as diffuse paths do.
    hit = np.flatnonzero(triangle >= 0)
    faces, w = Faces(world), columns(direction[hit])
    ng, _ = faces.normals(triangle[hit], u[hit], v[hit], w)
    at = faces.lifted(columns(origin[hit]) + w * t[hit], ng, triangle[hit], t[hit])
    mirrored = w - 2 * (w * ng).sum(axis=0) * ng
    again = world.intersect(at.T, mirrored.T, RayKind.DIFFUSE)[0]
    assert not (again == triangle[hit]).any()


def under_a_plate(far, tilted, edge=4.0):
    """A floor 1 cm under a larger plate, with the sun above both, and a square of 1 m `far` away."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] if tilted else np.eye(3)
    turn *= np.sign(np.linalg.det(turn))
    b = SceneBuilder()
    for name, low, size in (("Floor", (-edge / 2, -edge / 2, 0), edge), ("Plate", (-0.6 * edge, -0.6 * edge, 0.01), 1.2 * edge)):
        b.quad(name, turn @ low, turn @ (size, 0, 0), turn @ (0, size, 0), GREY)
    if far:
        b.quad("Far", np.array((0.6, 0.5, 0.6)) * far, (1, 0, 0), (0, 1, 0), GREY)
    b.light(Light("Sun", "sun", (2.58, 2.58, 2.58), axis_z=tuple(turn @ (0, 0, 1))))
    return World(b.build())


@pytest.mark.parametrize("far", [0, 2e3, 2e4, 2e5])
@pytest.mark.parametrize("tilted", [False, True])
def test_a_floor_under_a_plate_is_dark_whatever_lies_far_away(far, tilted):
    world = under_a_plate(far, tilted)
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 2000), np.float32) * np.float32(0.5)
    surface = world.surface(np.arange(2000, dtype=np.int32) % 2, u, v)
    found, _ = direct_irradiance(world, Emitters(world), surface, 1, rng)
    assert (found == 0).all()
    if far:
        alone = under_a_plate(0, tilted)
        assert np.allclose(world.center, alone.center) and np.allclose(world.offset[:4], alone.offset) and world.extent == alone.extent


def test_a_large_ground_under_a_plate_is_dark():
    """A ground of 20 km, whose plane float32 holds exactly, and a plate over its middle."""
    world = under_a_plate(0, False, edge=2e4)
    assert world.offset[:2].max() < 0.002
    rng = np.random.default_rng(0)
    u, v = 0.5 + rng.uniform(-1e-5, 1e-5, (2, 500))
    at = quad_points(u, v)
    surface = world.surface(at.triangle.astype(np.int32), at.u.astype(np.float32), at.v.astype(np.float32))
    assert (direct_irradiance(world, Emitters(world), surface, 1, rng)[0] == 0).all()


ROOM = {
    "path_tracing": {"samples": 256},
    "matrix_radiosity": {"max_edge": 1.0},
    "particle_tracing": {"particles": 200_000},
    "irradiance_cache": {},
}


@pytest.mark.parametrize("name", ROOM)
def test_a_room_stays_as_it_is_when_something_is_lost_far_away(name):
    """A furnace: albedo and emission of one half everywhere, so radiance 1 and irradiance pi, with a cube 20 km away."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 5, 3), diffuse("Wall", 0.5, 0.5), inward=True)
    b.box("Lost", (2e4, 1e4, -1e4), (2e4 + 1, 1e4 + 1, -1e4 + 1), GREY, inward=False)
    receivers = quad_points(*(np.full(16, 0.4),) * 2, first=8)
    found = solve(name, World(b.build()), receivers, **ROOM[name]).quantity("irradiance")
    assert found.mean() == pytest.approx(np.pi, rel=0.05)


@pytest.mark.parametrize("distance", [10.0, 2e4, 2e5])
def test_an_emitter_does_not_hide_itself(distance):
    """A square of radiance 1 and a tenth of its distance wide, seen from below: E = 0.01 but for its cosines."""
    b, a = SceneBuilder(), distance / 10
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    b.quad("Lamp", (-a / 2, -a / 2, distance), (a, 0, 1e-3 * a), (0, a, 2e-3 * a), diffuse("Lamp", 0.0, 1.0))
    world = World(b.build())
    u = np.full(4000, 0.3, np.float32)
    found, _ = direct_irradiance(world, Emitters(world), world.surface(np.zeros(4000, np.int32), u, u), 1, np.random.default_rng(0))
    assert found.mean() == pytest.approx(0.01, rel=0.01)


def test_shadow_rays_end_before_the_face_that_they_look_at():
    """By its clearance along its normal, whatever the angle at which it is met."""
    world = World(scenes.room())
    triangle = np.zeros(4, np.int32)
    distance, cosine = np.full(4, 5.0, np.float32), np.array([1.0, 0.5, 0.1, 0.01], np.float32)
    height = (distance - world.short_of(distance, triangle, cosine)).astype(float) * cosine
    assert (height > 0.99 * world.offset[0]).all()
    np.testing.assert_allclose(height, height[0], rtol=0.02)


def test_a_finely_cut_object_far_away_does_not_take_the_origin():
    """Objects count, not triangles: ten sheets of a room outweigh one lost object of a thousand faces."""
    b = SceneBuilder()
    for k in range(10):
        b.quad(f"Sheet {k}", (0, 0, 0.1 * k), (1, 0, 0), (0, 1, 0), GREY)
    far = np.tile([[5000.0, 0, 0], [5001, 0, 0], [5000, 1, 0]], (1000, 1)) + np.repeat(np.arange(1000), 3)[:, None] * [0, 0, 1e-3]
    b.mesh("Lost", far, np.arange(3000).reshape(-1, 3), GREY)
    assert np.linalg.norm(World(b.build()).center) < 10
