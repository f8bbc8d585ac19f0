"""Faces that are seen from behind are baked from behind, by every method that answers texels and vertices."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.flux.facing import baked_sides
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import openness
from adjgi.tests import scenes
from adjgi.tests.solving import look, solve

WHITE, PANEL = diffuse("White", 0.5), diffuse("Panel", 0.0, 3.0)
INSIDE = look((0.4, 2, 1.3), (1, 0, 0))
BESIDE = look((-6, 2, 1.3), (1, 0, 0))
OPTIONS = {
    "path_tracing": {"samples": 1024},
    "distribution": {"samples": 16},
    "irradiance_cache": {"rays": 128},
    "local_illumination": {"light_points": 64, "ambient": 0.0},
    "particle_tracing": {"particles": 60_000, "score": "receivers"},
    "progressive_radiosity": {"rays": 60_000},
    "stochastic_jacobi": {"rays": 60_000, "max_edge": 0.7},
    "matrix_radiosity": {"rays": 64, "max_edge": 0.7},
    "two_pass": {"samples": 16, "rays": 64, "particles": 20_000},
    "multi_pass": {"samples": 16, "max_edge": 1.0},
    "spherical_harmonics": {"rays": 60_000},
    "directional_radiosity": {"max_edge": 1.0},
}


def a_room(turned: bool, camera: Camera | None = INSIDE) -> World:
    """A room with a panel below the ceiling and a box in it; `turned`: the normals of the wall at the left point out of it."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), WHITE)
    b.quad("Ceiling", (0, 0, 2.6), (0, 4, 0), (4, 0, 0), WHITE)
    b.quad("Back", (0, 4, 0), (4, 0, 0), (0, 0, 2.6), WHITE)
    b.quad("Front", (0, 0, 0), (0, 0, 2.6), (4, 0, 0), WHITE)
    b.quad("Right", (4, 0, 0), (0, 0, 2.6), (0, 4, 0), WHITE)
    edges = ((0, 4, 0), (0, 0, 2.6))
    b.quad("Left", (0, 0, 0), *(edges[::-1] if turned else edges), WHITE)
    b.quad("Panel", (1.5, 1.5, 2.2), (0, 1, 0), (1, 0, 0), PANEL)
    b.camera = camera
    return World(b.build())


def left(world: World) -> int:
    return [o.name for o in world.scene.objects].index("Left")


def test_a_wall_that_is_seen_from_behind_is_turned_and_said():
    right, wrong = a_room(False), a_room(True)
    everything = range(len(right.scene.objects))
    assert baked_sides(right, everything).facing is None
    found = baked_sides(wrong, everything)
    front = np.einsum("ij,ij->i", found.facing, wrong.rows[:, 9:12]) > 0
    assert np.array_equal(~front, wrong.scene.object == left(wrong))
    assert [(n.object, n.severity) for n in found.notices] == [("Left", "info")]
    assert baked_sides(wrong, [0, 1, 2]).facing is None  # it is not baked
    assert baked_sides(a_room(True, None), everything).facing is not None  # without a camera light decides


@pytest.mark.parametrize("size", (0.06, 0.02))
def test_a_small_body_turned_inside_out_is_baked_outside_though_hardly_a_particle_meets_it(size):
    """A pillow and a box on a shelf came out black: 49 and 3 arrivals, all of them at backs. What faces the right way stays."""
    vertices, triangles = scenes.icosphere(1)
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), WHITE)
    b.quad("Panel", (1.5, 1.5, 2.2), (0, 1, 0), (1, 0, 0), PANEL)
    b.mesh("Wrong", (3, 1.9, 1.2) + size * vertices, triangles[:, ::-1], WHITE)
    b.mesh("Right", (3, 2.5, 1.2) + size * vertices, triangles, WHITE)
    b.camera = INSIDE
    world = World(b.build())
    found = baked_sides(world, range(len(world.scene.objects)))
    turned = np.einsum("ij,ij->i", found.facing, world.rows[:, 9:12]) < 0
    wrong = [o.name for o in world.scene.objects].index("Wrong")
    assert np.array_equal(turned, world.scene.object == wrong)


def test_a_wall_that_is_seen_from_the_front_keeps_it_although_it_is_dark():
    """A camera beside the room sees the dark front of the turned wall, and so does the bake."""
    world = a_room(True, BESIDE)
    found = baked_sides(world, [left(world)])
    assert found.facing is None or (np.einsum("ij,ij->i", found.facing, world.rows[:, 9:12]) > 0).all()


@pytest.mark.parametrize("name", OPTIONS)
def test_every_method_bakes_the_side_that_is_seen(name):
    """The wall has the same light whichever way its normals point."""
    means = []
    for turned in (False, True):
        world = a_room(turned)
        index = [left(world)]
        receivers = vertex_receivers(world, index, "CORNER", 0.25, facing=baked_sides(world, index).facing).receivers
        means.append(solve(name, world, receivers, **OPTIONS[name]).quantity("irradiance").mean())
    assert means[0] > 0.05
    assert means[1] == pytest.approx(means[0], rel=0.06)


@pytest.mark.parametrize("emission", [0.2, 10.0])
def test_of_a_closed_body_that_glows_the_outside_is_baked(emission):
    """All the light within it is its own, and nobody sees it; more of it arrives there than outside."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.01, 1.01)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    b = SceneBuilder()
    b.quad("Floor", (-5, -5, 0), (10, 0, 0), (0, 10, 0), diffuse("Grey", 0.5))
    b.mesh("Cube", corners, np.array([t for a, c, d, e in quads for t in ((a, c, d), (a, d, e))]), diffuse("Glow", 0.5, emission))
    b.light(Light("Lamp", "point", (10, 10, 10), (0, 0, 4), radius=0.1))
    sides = baked_sides(World(b.build()), [0, 1])
    assert sides.facing is None and not sides.notices


def a_column(flip: bool = False, floor: bool = False, turned: tuple[int, ...] = (), camera: Camera | None = None) -> World:
    """An open column of eight smooth sides below a slanting sun, its normals outward; `flip`: inward, `turned`: those of some triangles."""
    b, angle = SceneBuilder(), np.arange(8) * np.pi / 4
    ring = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0 * angle], axis=1)
    k, after = np.arange(8), (np.arange(8) + 1) % 8
    triangles = np.stack([k, after, after + 8, k, after + 8, k + 8], axis=1).reshape(16, 3)
    other = np.isin(np.arange(16), turned) ^ flip
    triangles[other] = triangles[other, ::-1]
    b.mesh("Column", np.concatenate([ring, ring + (0, 0, 2)]), triangles, WHITE)
    if floor:
        b.quad("Floor", (-5, -5, 0), (10, 0, 0), (0, 10, 0), WHITE)
    b.light(Light("Sun", "sun", (3, 3, 3), axis_x=(1, 0, 0), axis_y=(0, 0.62, 0.78), axis_z=(0, -0.78, 0.62)))
    b.camera = camera
    return World(b.build())


OUTSIDE, DOWN_INTO_IT = look((0, -6, 1), (0, 1, 0)), look((0, 0, 6), (0.01, 0, -1))


@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize(("flip", "camera"), [(False, None), (True, None), (False, OUTSIDE), (True, DOWN_INTO_IT)])
def test_a_surface_that_is_open_at_both_sides_shows_the_side_of_its_normals(flip, camera, floor):
    """Half of the column was baked from within, 29 % too bright in the sun: its far half has light there alone. Nor is it asked to turn."""
    world = a_column(flip, floor, camera=camera)
    assert baked_sides(world, [0]).facing is None
    assert not openness.notices(world, {0})


@pytest.mark.parametrize(("flip", "camera"), [(True, OUTSIDE), (False, DOWN_INTO_IT)])
def test_a_surface_of_which_only_backs_are_seen_is_turned_as_a_whole(flip, camera):
    world = a_column(flip, camera=camera)
    assert np.allclose(baked_sides(world, [0]).facing, -world.rows[:, 9:12])


def test_of_a_surface_only_what_is_turned_against_the_rest_is_turned_back():
    """A side of the column whose normals do not agree with its neighbours is a surface of its own."""
    lit = (12, 13)  # towards the sun, and dark within: the sun comes from -y
    found = baked_sides(a_column(turned=lit, floor=True, camera=OUTSIDE), [0])
    world = a_column(turned=lit)
    assert np.array_equal(np.flatnonzero(np.einsum("ij,ij->i", found.facing[:16], world.rows[:, 9:12]) < 0), lit)
