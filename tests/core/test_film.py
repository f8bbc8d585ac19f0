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
