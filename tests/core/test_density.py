"""What of a lightmap goes to what: by what the camera and the inside of the scene see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.flux.density import FULL_IMAGES, LEAST, _from_inside, given, own_resolutions, seen, weights
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World

WHITE = diffuse("White", 0.7)
CLOSE_UP = Camera("perspective", (2, 0.3, 1.4), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.4, 0.4, -0.3, 0.3), 32, 24)
OUTSIDE = Camera("perspective", (2, -12, 4), (1, 0, 0), (0, 0.3, 0.954), (0, 0.954, -0.3), (-0.4, 0.4, -0.3, 0.3), 32, 24)


def a_room(ground=29.0, camera=None):
    """A room of 4 x 4 x 2.6 m with a shelf, open to the front, on a ground plane."""
    b = SceneBuilder()
    b.quad("Ground", (2 - ground / 2, 2 - ground / 2, -0.1), (ground, 0, 0), (0, ground, 0), WHITE)
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), WHITE)
    b.quad("Ceiling", (0, 0, 2.6), (0, 4, 0), (4, 0, 0), WHITE)
    b.quad("Back", (0, 4, 0), (4, 0, 0), (0, 0, 2.6), WHITE)
    b.quad("Left", (0, 0, 0), (0, 4, 0), (0, 0, 2.6), WHITE)
    b.quad("Right", (4, 0, 0), (0, 0, 2.6), (0, 4, 0), WHITE)
    b.quad("Shelf", (1, 3, 1), (2, 0, 0), (0, 0.9, 0), WHITE)
    b.camera = camera
    return World(b.build())


def share_of_texels(world):
    """(objects,) of an image that is packed by the weights."""
    found = seen(world)
    texels = found.area * found.weight**2
    return {obj.name: part for obj, part in zip(world.scene.objects, texels / texels.sum(), strict=True)}, found


@pytest.mark.parametrize("camera", [None, CLOSE_UP, OUTSIDE], ids=["no camera", "inside", "outside"])
def test_no_backdrop_starves_a_room(camera):
    share, found = share_of_texels(a_room(camera=camera))
    plain = found.area[0] / found.area.sum()
    assert plain > 0.9 and share["Ground"] < 0.5
    # The room's surfaces are about as dense as one another, and nothing goes empty.
    assert found.weight[1:].min() > 0.4 and found.weight.min() >= LEAST and found.weight.max() == 1
    assert found.importance.sum() == pytest.approx(1)


def test_a_much_larger_backdrop_still_leaves_the_room_its_texels():
    """They follow what is seen of it, and not its area."""
    world = a_room(ground=100.0)
    share, found = share_of_texels(world)
    assert found.area[0] > 0.99 * found.area.sum() and share["Ground"] < 0.25


def test_weights_are_those_of_the_potential():
    importance, area = np.array([0.5, 0.3, 0.2, 0.0]), np.array([1.0, 0.6, 6.4, 1.0])
    assert weights(importance, area) == pytest.approx([1, 1, 0.25, LEAST])
    assert np.all(weights(np.zeros(3), np.ones(3)) == 1)


def test_a_landscape_behind_a_window_leaves_the_room_its_texels():
    """Of a motel room mountains and desert got 95 % of the image and the room 66 texels: they have half of the importance, and its area
    5,000 times. What is not seen at all gets no more than a tenth, however large it is."""
    importance, area = np.array([0.37, 0.16, 0.29, 0.18]), np.array([193_000.0, 303_000.0, 91.0, 60.0])
    texels = area * weights(importance, area) ** 2
    assert texels[2] > 0.25 * texels.sum() > 0.4 * texels[0]
    texels = np.array([1e6, 10, 10]) * weights(np.array([0, 0.5, 0.5]), np.array([1e6, 10, 10])) ** 2
    assert 0 < texels[0] < 0.1 * texels.sum()


def test_the_same_whatever_the_number_of_threads(monkeypatch):
    world, all_weights = a_room(camera=CLOSE_UP), []
    for threads in ("1", "3"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        all_weights.append(seen(world).weight)
    assert np.array_equal(*all_weights)


def test_light_and_units_of_the_camera_do_not_matter():
    """Scaling the scene with its camera changes nothing; a scene without light is seen all the same."""
    b = a_room(camera=CLOSE_UP)
    factor = 100.0
    scene = replace(
        b.scene, vertices=b.scene.vertices * factor, camera=replace(CLOSE_UP, position=tuple(factor * x for x in CLOSE_UP.position))
    )
    assert seen(World(scene)).weight == pytest.approx(seen(b).weight, rel=0.05)


def test_what_each_object_was_given():
    world = a_room()
    triangle = np.repeat(np.array([0, 2, 3]), [100, 300, 100])
    ground, floor, ceiling = given(world, [0, 1, 2], triangle)
    assert (ground.object, ground.texels, floor.texels, ceiling.texels) == ("Ground", 100, 400, 0)
    assert floor.texels_per_metre == pytest.approx(5) and ceiling.texels_per_metre == 0
    assert (ground.share, floor.share, floor.weight) == pytest.approx((0.2, 0.8, 1.0))
    assert ground.weight == pytest.approx(10 / 29 / 5)


def test_images_of_many_objects_follow_their_size():
    """As many texels as sixteen whole images have: 600 props took 79 GB."""
    assert np.all(own_resolutions(np.ones(FULL_IMAGES), 512) == 512)
    props = own_resolutions(np.ones(600), 1024)
    assert np.all(props == 128)
    mixed = own_resolutions(np.append(np.geomspace(0.01, 4, 600), [900.0, 400.0]), 1024)
    assert mixed[-1] == mixed[-2] == 1024 and np.all(np.diff(mixed) >= 0) and mixed.min() >= 16
    assert 0.5 * FULL_IMAGES < (mixed / 1024.0).dot(mixed / 1024.0) < 2 * FULL_IMAGES
    assert np.all(own_resolutions(np.zeros(20), 1024) >= 16) and np.all(own_resolutions(np.ones(4000), 64) == 16)


def test_images_of_a_resolution_below_the_smallest_keep_it():
    assert np.all(own_resolutions(np.ones(40), 8) == 8)


def test_particles_leave_each_object_by_the_root_of_its_area_and_none_by_more_than_half():
    b = SceneBuilder()
    b.quad("Small", (0, 0, 0), (1, 0, 0), (0, 1, 0), WHITE)
    b.quad("Large", (10, 0, 0), (4, 0, 0), (0, 4, 0), WHITE)
    b.quad("Third", (20, 0, 0), (3, 0, 0), (0, 3, 0), WHITE)
    for share in (1 / 8, 0.5 / 8):
        world = World(b.build())
        start = _from_inside(world, 20_000, np.random.default_rng(1))
        small = (start.origin[:, 0] + world.center[0] < 5) & (start.origin[:, 1] + world.center[1] < 2)
        assert small.mean() == pytest.approx(share, abs=0.01)  # four standard errors
        assert start.weight.sum(axis=0, dtype=float) == pytest.approx(1)
        b.quad("Ground", (0, 9, -5), (40, 0, 0), (0, 40, 0), WHITE)


@pytest.mark.parametrize("camera", [None, OUTSIDE], ids=["no camera", "camera"])
@pytest.mark.parametrize("ground", [30.0, 100.0, 1000.0])
def test_props_in_the_open_are_not_starved_by_the_ground_that_all_see(ground, camera):
    """Of an image of 512 x 512 they get tens of texels a metre, however large it is, and equal ones about as many as one another."""
    b = SceneBuilder()
    b.quad("Ground", (-ground / 2, -ground / 2, 0), (ground, 0, 0), (0, ground, 0), WHITE)
    for i in range(20):
        x, y = i % 5 - 2, i // 5 - 2
        for name, at, u, v in (("Top", (x, y, 0.3), (0.3, 0, 0), (0, 0.3, 0)), ("Side", (x, y, 0), (0.3, 0, 0), (0, 0, 0.3))):
            b.quad(f"{name} {i}", at, u, v, WHITE)
    b.camera = camera
    _, found = share_of_texels(World(b.build()))
    per_metre = found.weight * 512 / np.sqrt((found.area * found.weight**2).sum())
    sides = per_metre[2::2]
    assert np.median(sides) > 50 and sides.min() > 0.3 * sides.max(), sides
