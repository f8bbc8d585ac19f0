"""Packing of rectangles and of charts, without Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.receivers import pack
from adjgi.adjoint_gi.core.receivers.charts import Charts
from adjgi.adjoint_gi.core.receivers.pack import pack_again, pack_charts, pack_on_shelves, pack_tightly, place_objects, shelves


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


def rectangles(extent):
    """Charts of two triangles each, as large as `extent` (n, 2) metres."""
    corner = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    xy = corner[None] * np.asarray(extent)[:, None, None]
    return Charts(xy.reshape(-1, 3, 2), np.repeat(np.arange(len(extent)), 2))


def spaces(uv, chart, size):
    """Chebyshev distances in texels between the bounding boxes of all pairs of rectangular charts."""
    low = np.array([uv[chart == k].min(axis=(0, 1)) for k in range(chart.max() + 1)]) * size
    high = np.array([uv[chart == k].max(axis=(0, 1)) for k in range(chart.max() + 1)]) * size
    apart = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)
    return apart[np.triu_indices(len(low), 1)]


@pytest.mark.parametrize("pack", [pack_on_shelves, pack_tightly, lambda *a: pack_again(*a, pack_tightly(*a)[1])])
@pytest.mark.parametrize("gap", [0, 1, 3, 4])
def test_packed_charts_stand_apart_at_one_scale_inside_the_square(pack, gap):
    extent = np.random.default_rng(5).uniform(0.5, 3, (30, 2))
    charts = rectangles(extent)
    uv, scale = pack(charts, 256, gap)
    assert uv.dtype == np.float32 and uv.min() >= 0 and uv.max() <= 1
    assert spaces(uv, charts.chart, 256).min() > gap - 1e-3
    size = np.array([np.ptp(uv[charts.chart == k].reshape(-1, 2), axis=0) for k in range(30)]) * 256
    # Whole texels: up to one more than the scale says. A chart may lie on its side.
    assert np.all(np.abs(np.sort(size, axis=1) - np.sort(extent, axis=1) * scale) < 1.01)


def test_shapes_are_packed_closer_than_their_rectangles():
    triangles = np.random.default_rng(3).uniform(0, 2, (60, 3, 2))
    charts = Charts(triangles, np.arange(60))
    assert pack_tightly(charts, 512, 2)[1] > 1.15 * pack_on_shelves(charts, 512, 2)[1]


def test_corners_and_edges_of_shapes_keep_an_odd_gap_too():
    """Half of an odd gap is rounded up: charts that are no rectangles touch with corners, which no texel of their rims keeps apart."""
    triangles = np.random.default_rng(3).uniform(0, 2, (24, 3, 2))
    corner = pack_tightly(Charts(triangles, np.arange(24)), 256, 1)[0].astype(float) * 256
    edge = np.roll(corner, -1, axis=1) - corner
    off = corner[:, None, :, None] - corner[None, :, None]  # of corners of one chart to starts of edges of another
    along = np.clip((off * edge[None, :, None]).sum(-1) / (edge**2).sum(-1)[None, :, None], 0, 1)
    distance = np.linalg.norm(off - along[..., None] * edge[None, :, None], axis=-1).min(axis=(2, 3))
    assert distance[~np.eye(24, dtype=bool)].min() >= 1


@pytest.mark.parametrize("pack", [pack_on_shelves, pack_tightly])
def test_too_many_charts_do_not_fit(pack):
    with pytest.raises(TargetError, match="100 UV islands do not fit into 16 x 16"):
        pack(rectangles(np.ones((100, 2))), 16, 4)


def test_atlases_are_taken_apart_with_care():
    """The binding alone would hang one bake in a thousand: `receivers.atlas.generate` says why."""
    core = Path(pack.__file__).parents[1]
    assert [path.name for path in core.rglob("*.py") if "atlas.generate(" in path.read_text()] == ["atlas.py"]
