"""Receiver sets: which faces they hold, how cameras weigh what they see, and flux by particles against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SettingsError
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.flux import detectors
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.scene.arrays import Camera, Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes

Z = 4.0


def view(kind="perspective", **options):
    """A camera at the origin that looks along +y, with a frame of 1 x 0.8."""
    return Camera(kind, (0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.5, 0.5, -0.4, 0.4), 50, 40, **options)


def wall(camera, distance=2.0):
    """A large wall before the camera."""
    b = SceneBuilder()
    b.quad("Wall", (-9, distance, -9), (18, 0, 0), (0, 0, 18), diffuse("Wall", 0.5))
    b.camera = camera
    return World(b.build())


CAMERAS = [view(), view("orthographic"), view(aperture_radius=0.2, focus_distance=1.5)]


@pytest.mark.parametrize("camera", CAMERAS, ids=["perspective", "orthographic", "lens"])
def test_particles_of_importance_weigh_as_much_as_the_camera_sees(camera):
    """Sum of the weights times pi = integral of the cosine over the view's solid angle, or the window's area."""
    world = wall(camera)
    detect = detectors.CameraDetector(world)
    particles = detect.particles(20_000, np.random.default_rng(1))
    if camera.kind == "orthographic":
        expected = 0.8
    else:
        k = [(np.arange(400) + 0.5) / 400 * size - size / 2 for size in (1.0, 0.8)]
        expected = 0.8 * ((1 + k[0][:, None] ** 2 + k[1] ** 2) ** -2.0).mean()
    found = math.pi * particles.weight[:, 0].sum(dtype=float)
    # Through points of a lens the view is turned a little, which matters only to the second order.
    assert found == pytest.approx(expected, rel=0.02 if camera.aperture_radius else 1e-3)
    elements = Elements(world, max_edge=1.0)
    seen = np.repeat(elements.area, 2) @ detect.on_elements(elements)
    assert math.pi * seen == pytest.approx(expected, rel=0.02 if camera.aperture_radius else 1e-3)


def test_importance_does_not_go_beyond_the_far_plane():
    detect = detectors.CameraDetector(wall(view(clip_end=1.9)))
    assert not detect.on_elements(Elements(detect.world, max_edge=1.0)).any()
    particles = detect.particles(1000, np.random.default_rng(1))
    assert (particles.reach * particles.direction[:, 1] < 1.91).all()
    detect = detectors.CameraDetector(wall(view(clip_end=2.1)))
    assert detect.on_elements(Elements(detect.world, max_edge=1.0)).any()


def test_only_the_side_that_is_seen_has_a_potential():
    """The wall's normal points to -y, towards the camera: fronts (even sides) only."""
    world = wall(view())
    g = detectors.CameraDetector(world).on_elements(Elements(world, max_edge=1.0))
    assert g[::2].any() and not g[1::2].any()


def test_names_are_found_and_instances_follow_their_source():
    scene = scenes.room()
    objects = list(scene.objects)
    objects[1] = dataclasses.replace(objects[1], name="Wall[a.1]", source="Wall")
    objects[2] = dataclasses.replace(objects[2], name="Wall[a.2]", source="Wall")
    world = World(dataclasses.replace(scene, objects=tuple(objects)))
    assert detectors.objects_named(world, ["Wall"]).tolist() == [1, 2]
    assert detectors.objects_named(world, ["Wall[a.2]", "Room -x", "Wall[a.2]"]).tolist() == [0, 2]
    assert detectors.names_in(" Wall , ,Room -x") == ["Wall", "Room -x"]
    with pytest.raises(SettingsError, match="Wall\\[a.1\\]"):
        detectors.objects_named(world, ["Roof"])


def test_faces_are_receivers_on_their_front_or_on_both_sides():
    world = World(scenes.room())
    elements = Elements(world, max_edge=1.0)
    for both in (False, True):
        detect = detectors.detector(world, "objects", "Room -z, Room +z", both)
        g = detect.on_elements(elements)
        assert set(np.unique(g)) == {0.0, 1.0}
        assert np.repeat(elements.area, 2) @ g == pytest.approx((1 + both) * 32)
        assert g[1::2].any() == both
        triangle, side = np.array([8, 8, 0, -1]), np.array([1.0, -1.0, 1.0, 1.0])
        assert detect.holds(triangle, side).tolist() == [True, both, False, False]
    assert detect.unit == "W" and detect.name == "Room -z, Room +z"


def test_flux_by_particles_of_a_point_lamp_over_a_floor():
    """Part 1 is what the floor reflects of the light that arrives directly; nothing comes back, so part 2 is 0."""
    b = SceneBuilder()
    b.quad("Floor", (-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", (0.8, 0.4, 0.2)))
    b.light(Light("Lamp", "point", (3.0, 2.0, 1.0), (0.0, 0.0, 0.7)))
    world = World(b.build())
    detect = detectors.detector(world, "objects", "Floor")
    flux = detectors.flux_by_particles(world, detect, 200_000, 64, np.random.default_rng(3))
    x = 0.5
    solid = 4 * math.atan(x * x / (0.7 * math.sqrt(2 * x * x + 0.49)))
    expected = solid * np.array([2.4, 0.8, 0.2])
    assert (np.abs(flux.value[1] - expected) < Z * flux.error[1] + 1e-6).all()
    assert (flux.error[1] < 0.01 * expected).all()
    assert not flux.value[0].any() and not flux.value[2].any()
    np.testing.assert_allclose(flux.total, flux.value[1])


def test_flux_by_particles_counts_what_the_faces_emit_themselves():
    """Emission leaves both sides: A E of each in part 0; in the furnace parts 1 and 2 are half of what is inside."""
    world = World(scenes.cube(0.5, 1.0))
    names = ",".join(o.name for o in world.scene.objects)
    for both in (False, True):
        detect = detectors.detector(world, "objects", names, both)
        flux = detectors.flux_by_particles(world, detect, 50_000, 64, np.random.default_rng(3))
        np.testing.assert_allclose(flux.value[0], 6 * (1 + both), rtol=1e-6)
    np.testing.assert_allclose(flux.value[1], 3, rtol=0.01)
    np.testing.assert_allclose(flux.value[2], 3, rtol=0.02)


def test_a_scene_without_light_has_no_flux():
    world = World(scenes.cube(0.5, 0.0))
    detect = detectors.detector(world, "objects", "Cube -z")
    flux = detectors.flux_by_particles(world, detect, 1000, 64, np.random.default_rng(3))
    assert not flux.value.any() and not flux.error.any()


def test_the_far_plane_lies_as_far_from_the_camera_with_a_near_one():
    """Rays start at the near plane: their reach is what is left from there."""
    for end, seen in ((1.9, False), (2.1, True)):
        detect = detectors.CameraDetector(wall(view(clip_start=1.0, clip_end=end)))
        assert detect.on_elements(Elements(detect.world, max_edge=1.0)).any() == seen
        particles = detect.particles(1000, np.random.default_rng(1))
        np.testing.assert_allclose(particles.origin[:, 1] + particles.reach * particles.direction[:, 1], end - 2, rtol=1e-5)


def test_the_error_of_a_flux_by_particles_is_the_spread_of_repeats():
    b = SceneBuilder()
    b.quad("Floor", (-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.8))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.0, 0.0, 0.7)))
    world = World(b.build())
    detect = detectors.detector(world, "objects", "Floor")
    found = [detectors.flux_by_particles(world, detect, 1600, 2, np.random.default_rng(k)) for k in range(40)]
    spread = np.std([f.value[1, 0] for f in found], ddof=1)
    stated = math.sqrt(np.mean([f.error[1, 0] ** 2 for f in found]))
    assert stated == pytest.approx(spread, rel=0.4)
