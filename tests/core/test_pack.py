"""Packing of rectangles and unwrapping of meshes, without Blender."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.receivers.pack import pack_charts, place_objects, shelves
from adjgi.adjoint_gi.core.receivers.unwrap import unwrap
from adjgi.tests.scenes import icosphere


def painted(place, size, width, height, gap):
    """How often each texel is taken when every rectangle also takes its gap to the right and above."""
    count = np.zeros((height + gap, width + gap), int)
    for (x, y), (w, h) in zip(place, size, strict=True):
        count[y : y + h + gap, x : x + w + gap] += 1
    return count


@pytest.mark.parametrize("gap", [0, 1, 4])
def test_shelves_never_overlap_and_stay_inside(gap):
    rng = np.random.default_rng(gap)
    size = rng.integers(1, 20, (60, 2))
    place = shelves(size, 150, 170, gap)
    assert place is not None and place.min() >= 0
    assert np.all(place + size <= [150, 170]) and painted(place, size, 150, 170, gap).max() == 1


def test_shelves_say_when_nothing_fits():
    assert shelves(np.array([[10, 3]]), 9, 9, 0) is None
    assert shelves(np.array([[3, 10]]), 9, 9, 0) is None
    assert shelves(np.full((10, 2), 3), 9, 9, 0) is None
    assert len(shelves(np.full((9, 2), 3), 9, 9, 0)) == 9
    assert shelves(np.full((9, 2), 3), 9, 9, 1) is None


def test_charts_have_one_scale_and_small_ones_a_least_size():
    extent = np.array([[4.0, 2.0], [1.0, 1.0], [1e-5, 1e-5], [3.0, 1e-9]])
    place, size, scale = pack_charts(extent, (64, 64), 2)
    assert np.allclose(size[:2], extent[:2] * scale) and np.allclose(size[2], 2) and size[3, 1] == 2
    assert painted(place.astype(int), np.ceil(size - 1e-6).astype(int), 64, 64, 2).max() == 1
    assert scale > 10


def test_four_equal_squares_fill_the_image():
    _, size, _ = pack_charts(np.ones((4, 2)), (64, 64), 0)
    assert np.allclose(size, 32, atol=1e-3)


def test_too_many_charts_are_refused():
    with pytest.raises(TargetError, match="100 UV islands do not fit into 16 x 16"):
        pack_charts(np.ones((100, 2)), (16, 16), 4)


def test_objects_of_an_atlas_stand_apart_on_whole_texels():
    area = {3: 1.0, 7: 4.0, 9: 1.0, 12: 0.0}
    placed = place_objects(area, (128, 64), 2)
    place = np.array([np.array(placed[k].offset) * (128, 64) for k in area])
    size = np.array([np.array(placed[k].scale) * (128, 64) for k in area])
    assert np.allclose(place, np.round(place)) and np.allclose(size, np.round(size))
    assert painted(np.round(place).astype(int), np.round(size).astype(int), 128, 64, 2).max() == 1
    assert size[1, 0] == pytest.approx(2 * size[0, 0], abs=1) and size[3].min() >= 1


def test_a_flat_sheet_of_many_triangles_is_one_chart_without_distortion():
    n = 30
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0)))
    turn = np.array([[0.6, 0.0, 0.8], [0.48, 0.8, -0.36]])  # orthonormal rows
    vertices = np.stack([x, y], 1) @ turn
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    tri = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    uv, charts = unwrap(vertices, tri, np.tile(np.arange(n * n), 2), (256, 256), 2)
    assert charts == 1
    length = np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1) / np.linalg.norm(vertices[tri[:, 1]] - vertices[tri[:, 0]], axis=1)
    assert np.ptp(length) / length.mean() < 1e-4
    assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv[..., 0]) > 0.95


def test_a_sphere_has_few_charts_and_the_same_every_time():
    vertices, triangles = icosphere(3)
    first, charts = unwrap(vertices, triangles, np.arange(len(triangles)), (512, 512), 4)
    assert charts <= 12
    assert np.array_equal(first, unwrap(vertices, triangles, np.arange(len(triangles)), (512, 512), 4)[0])
