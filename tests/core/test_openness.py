"""What a few particles say of a scene before a bake: light that leaves it, and faces that are lit from the back only."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.flux import facing
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import openness
from adjgi.adjoint_gi.core.walks.openness import ENOUGH, measure
from adjgi.tests.scenes import icosphere
from adjgi.tests.solving import look

WHITE = diffuse("White", 0.8)


def lamp(*position):
    return Light("Lamp", "point", (1.0, 1.0, 1.0), position)


def test_light_that_meets_nothing_is_no_leak():
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), WHITE, inward=True)
    b.light(lamp(0.5, 0.5, 0.5))
    closed = measure(World(b.build()), 2000)
    b.light(lamp(0.5, 0.5, 40.0))
    both = measure(World(b.build()), 2000)
    assert closed.escaped == 0 and both.escaped < 0.02 and closed.lost[0] == 0


def test_lights_and_camera_are_followed_once_for_each_world(monkeypatch):
    """Whoever asks which side of a face is lit or seen, and how often: the check, the receivers, the notices."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), WHITE, inward=True)
    b.light(lamp(0.5, 0.5, 0.5))
    b.camera = look((0.5, 0.5, 0.5), (1, 0, 0))
    worlds = [World(b.build()), World(b.build())]
    began = []
    for module in (openness, facing):
        real = module.walk
        monkeypatch.setattr(
            module,
            "walk",
            lambda world, start, *more, real=real, **options: began.append(len(start.origin)) or real(world, start, *more, **options),
        )
    for world in worlds:
        for _ in range(3):
            facing.baked_sides(world, [0])
            openness.notices(world, {0})
    assert began == 2 * [facing.PARTICLES, openness.PARTICLES]


@pytest.mark.parametrize(("inward", "lost"), [(True, 0.0), (False, 1.0)])
def test_objects_of_tiny_faces_count_as_one(inward, lost):
    """A lamp in a ball, each of whose faces gets too few particles to say which of its sides is lit."""
    vertices, triangles = icosphere(5)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles[:, ::-1] if inward else triangles, diffuse("Black", 0.0))
    b.light(lamp(0.0, 0.0, 0.0))
    world = World(b.build())
    found = measure(world, 2000)
    assert found.arrivals[0] == 2000 < ENOUGH * world.triangle_count
    assert found.lost == pytest.approx(np.array([lost]), abs=0.01)
