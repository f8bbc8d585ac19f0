"""Where light ends on coarse smooth meshes: heights over triangles, and shadow rays that start on them."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.solving import scattered, solve

SUN = (0.6, 0.0, 0.8)  # towards it


def ball(level=1, terminator=0.1):
    """A coarse smooth ball of radius 1 in the sun, and random receivers on it."""
    b = SceneBuilder()
    vertices, triangles = scenes.icosphere(level)
    b.mesh("Ball", vertices, triangles, diffuse("White", 0.5), smooth_normals=vertices)
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0), axis_x=(0.8, 0, -0.6), axis_z=SUN))
    scene = b.build()
    scene = dataclasses.replace(scene, objects=tuple(dataclasses.replace(o, terminator=terminator) for o in scene.objects))
    world = World(scene)
    return world, scattered(world, 1500, seed=1)


def test_heights_are_those_of_the_ball():
    """Over a triangle of a sphere they lie between half of the way to it and its tangent planes, and are nothing at the corners."""
    world, receivers = ball(2)
    k, u, v = receivers.triangle, receivers.u, receivers.v
    at = world.surface(k, u, v)
    lifted = at.position + world.terminator.heights(k, u, v, at.ng.T).T
    gap, left = 1 - np.linalg.norm(at.position, axis=1), 1 - np.linalg.norm(lifted, axis=1)
    assert gap.max() > 0.015 and (left < 0.75 * gap + 1e-6).all() and (left > -1.5 * gap - 1e-3).all()
    corners = world.terminator.heights(np.int32([5, 5, 5]), np.float32([0, 1, 0]), np.float32([0, 0, 1]), np.tile(at.ng[:1].T, 3))
    assert np.abs(corners).max() < 1e-6
    # Inside, where the ball is hollow, rays are lifted into it.
    inside = world.terminator.heights(k, u, v, -at.ng.T).T
    assert (np.einsum("ij,ij->i", inside, at.ng) < 1e-6).all()


@pytest.mark.parametrize("name", ["path_tracing", "local_illumination", "distribution", "irradiance_cache"])
def test_a_coarse_smooth_ball_is_lit_as_far_as_its_normals_see_the_sun(name):
    """The irradiance of a sphere is the cosine to the sun. Without the lift jags of the triangles' shadows cut into it."""
    options = {"path_tracing": {"samples": 4}, "distribution": {"samples": 4}}.get(name, {})

    def off(terminator):
        world, receivers = ball(1, terminator)
        normal = world.surface(receivers.triangle, receivers.u, receivers.v).ns
        want = np.maximum(normal @ np.float32(SUN), 0)
        found = solve(name, world, receivers, seed=1, **options, max_length=1).direct[:, 0]
        return np.mean(np.abs(found - want) > 0.2 * want + 0.02), found.mean() / want.mean() - 1

    jags, loss = off(0.0)
    smooth, rest = off(0.1)
    assert jags > 0.02 and loss < -0.005
    assert smooth < 0.01 and abs(rest) < 0.005


def test_a_wall_still_shades_what_is_lifted():
    """Shadow rays end where they ended: a lamp behind a wall stays hidden, and one before it is seen at the same point."""
    b = SceneBuilder()
    vertices, triangles = scenes.icosphere(1)
    b.mesh("Ball", vertices, triangles, diffuse("White", 0.5), smooth_normals=vertices)
    b.quad("Wall", (1.5, -5, -5), (0, 10, 0), (0, 0, 10), diffuse("Wall", 0.0))
    b.light(Light("Behind", "point", (1.0, 0.0, 0.0), position=(3, 0, 0), radius=0.0))
    b.light(Light("Before", "point", (0.0, 1.0, 0.0), position=(-3, 0, 0), radius=0.0))
    world = World(b.build())
    ball_only = np.arange(world.triangle_count) < len(triangles)
    receivers = scattered(world, 500, triangles=ball_only)
    at = world.surface(receivers.triangle, receivers.u, receivers.v)
    found = solve("path_tracing", world, receivers, samples=256, max_length=1).direct
    assert not found[:, 0].any()
    to = np.float32([-3, 0, 0]) - at.position - np.float32(world.center)
    distance = np.linalg.norm(to, axis=1)
    want = np.maximum(np.einsum("ij,ij->i", at.ns, to), 0) / distance**3
    bright = want > 0.3 * want.max()
    assert found[bright, 1] == pytest.approx(want[bright], rel=0.2)
    assert found[:, 1].mean() == pytest.approx(want.mean(), rel=0.02)


def test_flat_scenes_have_no_terminator():
    assert World(scenes.cube()).terminator is None
    world, _ = ball(0, 0.0)
    assert world.terminator is None


def test_shadow_rays_that_are_lifted_end_where_they_ended():
    world, receivers = ball()
    surface = world.surface(receivers.triangle, receivers.u, receivers.v)
    start, lamp = world.leave(surface).T.copy(), np.float32([[3.0], [0.5], [2.0]])
    way = lamp - start
    distance = np.linalg.norm(way, axis=0)
    wi = way / distance
    before = start.copy()
    world.edge(surface).lift(start, wi, distance)
    assert np.abs(start - before).max() > 0.01
    np.testing.assert_allclose(start + wi * distance, np.broadcast_to(lamp, start.shape), atol=1e-5)
