"""What is read of receivers without any light: albedo, emission, normals, depths and weights of pixels that see a part of a wall."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.receivers.film import read_surfaces
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World


def wall(width=9.0, **options):
    """A wall of albedo 0.6 and emission 2 across the left of an orthographic picture of 9 x 1 pixels, 2 m before the camera."""
    b = SceneBuilder()
    b.quad("Wall", (-9, 2, -9), (width, 0, 0), (0, 0, 18), diffuse("Wall", 0.6, 2.0))
    b.camera = Camera("orthographic", (0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-9, 9, -1, 1), 9, 1, **options)
    b.background = (5.0,) * 3
    return CameraReceivers(World(b.build()))


def test_pixels_that_see_a_part_of_a_wall():
    """The middle one sees half: means over all of its rays, but for normal and depth, which only surfaces have."""
    receivers, out = wall(), {}
    for _ in read_surfaces(receivers.world, receivers, out):
        pass
    share = np.array([1, 1, 1, 1, 0.5, 0, 0, 0, 0])
    assert out["weight"] == pytest.approx(share)
    assert out["albedo"][:, 0] == pytest.approx(0.6 * share)
    assert out["emission"][:, 0] == pytest.approx(2 * share + 5 * (1 - share))
    assert out["depth"][:5] == pytest.approx(2.0) and np.isinf(out["depth"][5:]).all()
    assert out["normal"][:5] == pytest.approx(np.tile([0, -1, 0], (5, 1))) and not out["normal"][5:].any()


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_clipping_planes_count_from_the_camera(kind):
    """A wall at 2 m is seen with the far plane beyond it, wherever the near one is."""
    for end, seen in ((1.9, False), (2.1, True)):
        receivers = wall(18.0, clip_start=1.0, clip_end=end)
        object.__setattr__(receivers.camera, "kind", kind)
        assert all((points.triangle >= 0).any() == seen for points in receivers.sites())


@pytest.mark.parametrize("grid", [1, 2, 3])
def test_the_fixed_rays_of_a_pixel_lie_evenly_about_its_middle(grid):
    """Pixels are 2 m wide and high: rays of the first one from x = -9, of all from z = -1 to 1."""
    receivers = CameraReceivers(wall(18.0).world, grid=grid)
    (points,) = receivers.sites()
    surface = receivers.world.surface(points.triangle, points.u, points.v)
    x, _, z = (surface.position[points.receiver == 0] + receivers.world.center).T
    even = 2 * (np.arange(grid) + 0.5) / grid
    for at, corner in ((x, -9), (z, -1)):
        assert sorted(set(np.round(at, 3))) == pytest.approx(corner + even, abs=1e-3)
    assert len(x) == grid**2


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_rays_through_a_lens_begin_at_the_near_plane_and_meet_in_that_of_focus(kind):
    """And pass the plane of the camera within its aperture, uniformly: the mean square of the radius is half of that of the rim."""
    receivers = wall(18.0, clip_start=0.5, aperture_radius=0.4, focus_distance=1.7)
    object.__setattr__(receivers.camera, "kind", kind)
    n = 4000
    pixel, offset = np.full(n, 7), np.full(n, 0.3)
    origin, direction = receivers.lens_rays(pixel, offset, offset, np.random.default_rng(1).random((2, n), np.float32))
    origin = origin + receivers.world.center
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(origin[:, 1], 0.5, atol=1e-5)

    def across(depth):
        """Where the rays pass the plane at a distance along the view, from where the sharp ray does."""
        at, way = receivers.rays(pixel[:1], offset[:1], offset[:1])
        at = at + receivers.world.center
        points = [o + w * ((depth - o[:, 1]) / w[:, 1])[:, None] for o, w in ((origin, direction), (at, way))]
        return points[0] - points[1]

    np.testing.assert_allclose(across(1.7), 0, atol=1e-5)
    square = (across(0.0) ** 2).sum(axis=1)
    assert square.max() < 0.4**2 * 1.001 and square.mean() == pytest.approx(0.5 * 0.4**2, rel=0.05)
