"""UV raster: which texels are covered, by which points, and what is said about bad UVs."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import MemoryRefused, TargetError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers import rasterize as raster
from adjgi.adjoint_gi.core.receivers import runs
from adjgi.adjoint_gi.core.receivers import texels as lightmap
from adjgi.adjoint_gi.core.receivers.texels import Placement, rasterize
from adjgi.adjoint_gi.core.scene import topology as charts
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.counting import counted
from adjgi.tests.scenes import icosphere

WHITE = diffuse("White", 0.5)


def flat_world(*uvs, z=None, names=None) -> World:
    """One object in the plane z for each array of UV triangles (nt, 3, 2); position is the UV itself."""
    b = SceneBuilder()
    for k, uv in enumerate(uvs):
        uv = np.asarray(uv, np.float32)
        flat = np.where(np.abs(uv) < 1e6, uv, 7).reshape(-1, 2)
        points = np.concatenate([flat, np.full((len(flat), 1), k if z is None else z[k])], axis=1)
        # Welded, so that triangles that touch share vertices.
        welded, index = np.unique(points, axis=0, return_inverse=True)
        b.mesh(names[k] if names else f"Object{k}", welded, index.reshape(-1, 3), WHITE, uv=uv)
    return World(b.build())


def rectangle(x0, y0, x1, y1):
    return [[[x0, y0], [x1, y0], [x1, y1]], [[x0, y0], [x1, y1], [x0, y1]]]


def point_uv(world, layer, receivers):
    """(n, 2) UV of every point of the receivers, from the world's own arrays."""
    corner = layer[receivers.triangle]
    u, v = receivers.u[:, None], receivers.v[:, None]
    return corner[:, 0] * (1 - u - v) + corner[:, 1] * u + corner[:, 2] * v


@pytest.mark.parametrize("subsamples", [1, 4, 9])
def test_aligned_rectangle_covers_exactly_its_texels(subsamples):
    world = flat_world(rectangle(0.25, 0.125, 0.75, 0.5))
    lm = rasterize(world, [0], resolution=16, subsamples=subsamples)
    want = np.zeros((16, 16), bool)
    want[2:8, 4:12] = True
    assert np.array_equal(lm.covered, want)
    assert np.array_equal(lm.pixel, np.flatnonzero(want.ravel()))
    assert np.all(lm.share[want] == 1) and np.all(lm.share[~want] == 0)
    assert np.all(np.diff(lm.receivers.start) == subsamples)
    assert lm.charts == 1 and np.all(lm.chart[want] == 0) and np.all(lm.chart[~want] == -1)
    assert lm.warnings == ()


def test_first_point_is_the_texel_centre_and_all_points_lie_in_their_texel():
    world = flat_world(rectangle(0.1, 0.1, 0.83, 0.77))
    lm = rasterize(world, [0], resolution=(32, 20), subsamples=6)
    r = lm.receivers
    uv = point_uv(world, world.scene.objects[0].uvs["UVMap"], r) * (32, 20)
    owner = np.repeat(np.arange(r.count), np.diff(r.start))
    row, column = lm.pixel // 32, lm.pixel % 32
    low = np.stack([column, row], 1)[owner]
    assert np.all(uv >= low - 1e-4) and np.all(uv <= low + 1 + 1e-4)
    centre = np.stack([column, row], 1) + 0.5
    inside = np.all((centre > np.array([3.2, 2.0])) & (centre < np.array([0.83 * 32, 0.77 * 20])), axis=1)
    assert inside.sum() > 100
    assert np.allclose(uv[r.start[:-1]][inside], centre[inside], atol=1e-4)
    # The surface point is where the UV says (position is the UV itself in this world).
    s = world.surface(r.triangle, r.u, r.v)
    assert np.allclose((s.position + world.center)[:, :2] * (32, 20), uv, atol=1e-4)


def test_partial_coverage_counts_the_sub_samples_inside():
    lm = rasterize(flat_world([[[0, 0], [1, 0], [0, 1]]]), [0], resolution=8, subsamples=64)
    assert lm.share.sum() == pytest.approx(32, abs=0.6)  # area of the triangle in texels
    assert lm.covered.sum() == 36  # the diagonal texels count as well
    assert not rasterize(flat_world([[[0, 0], [1, 0], [0.01, 0.98]]]), [0], resolution=8, subsamples=1).covered[7, 7]


def test_every_point_of_a_mesh_without_overlap_is_claimed_once():
    """A grid of 800 skewed triangles that tile the square: every place of every texel is claimed, by the triangle it lies in."""
    rng = np.random.default_rng(4)
    n = 20
    grid = np.stack(np.meshgrid(np.arange(n + 1), np.arange(n + 1)), -1) / n
    grid[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, (n - 1, n - 1, 2)) / n
    g = grid.reshape(-1, 2)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    tri = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    lm = rasterize(flat_world(g[tri]), [0], resolution=100, subsamples=5)
    assert lm.covered.all() and np.all(lm.share == 1)
    assert lm.charts == 1 and lm.overlapping == 0


def test_results_do_not_depend_on_the_chunk_size(monkeypatch):
    vertices, triangles = icosphere(2)
    uv = (vertices[triangles][..., :2] * 0.4 + 0.5).astype(np.float32)  # upper and lower half overlap
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles, WHITE, uv=uv)
    world = World(b.build())
    whole = rasterize(world, [0], resolution=64, subsamples=3)
    monkeypatch.setattr(raster, "PLACES_PER_CHUNK", 100)
    parts = rasterize(world, [0], resolution=64, subsamples=3)
    assert np.array_equal(whole.receivers.triangle, parts.receivers.triangle)
    assert np.array_equal(whole.receivers.u, parts.receivers.u)
    assert whole.overlapping == parts.overlapping > 1000


def test_tiny_triangles_are_found_and_islands_without_texels_are_counted():
    around = [[[0.5, 0.5], [0.501, 0.5], [0.5, 0.501]]]  # far smaller than a texel, between the places of its texel
    centre = [[[0.53, 0.53], [0.533, 0.53], [0.53, 0.534]]]  # at 16 texels the centre of texel 8 is 0.53125
    lm = rasterize(flat_world(around, centre), [0, 1], resolution=16, subsamples=1)
    assert lm.covered.sum() == 1 and lm.covered[8, 8]
    assert lm.tiny_charts == 2
    assert [n.object for n in lm.warnings] == ["Object0, Object1"]


def test_overlap_is_counted_where_places_differ():
    left, right = rectangle(0, 0, 0.5, 1), rectangle(0.25, 0, 0.75, 1)
    lm = rasterize(flat_world(left, right), [0, 1], resolution=16, subsamples=1)
    assert lm.overlapping == 4 * 16
    assert lm.covered.sum() == 12 * 16
    assert "Object0, Object1" in lm.warnings[0].object and "25" not in lm.warnings[0].object


def test_stacked_faces_at_the_same_place_do_not_count_as_overlap():
    same = flat_world(rectangle(0, 0, 1, 1), rectangle(0, 0, 1, 1), z=[0, 0])
    assert rasterize(same, [0, 1], resolution=8).overlapping == 0
    apart = flat_world(rectangle(0, 0, 1, 1), rectangle(0, 0, 1, 1), z=[0, 1])
    assert rasterize(apart, [0, 1], resolution=8).overlapping == 64


def test_sheets_at_one_place_that_face_apart_overlap():
    up = rectangle(0, 0, 1, 1)
    down = [[a, c, b] for a, b, c in up]
    assert rasterize(flat_world(up, down, z=[0, 0]), [0, 1], resolution=8).overlapping == 64


@pytest.mark.parametrize("turn", range(3))
@pytest.mark.parametrize("flip", [False, True])
def test_rows_of_an_axis_aligned_triangle_reach_from_edge_to_edge(turn, flip):
    """Its level edge bounds the first of its rows; from whichever corner it begins, a row is as wide as the triangle there."""
    corners = np.roll(np.array([[1.0, 1.0], [7.0, 1.0], [1.0, 4.0]]), turn, axis=0) / 8
    layout = runs.UvTriangles.of(corners[::-1][None] if flip else corners[None], 8, 8)
    found = runs.runs_of_rows(layout.edges(), np.array([0]), (0, 8), 8, np.array([[0.5, 0.5], [0.0, 0.0]]))
    centres, lower = found.place == 0, found.place == 1
    assert np.array_equal(found.row[centres], [1, 2, 3]) and np.array_equal(found.row[lower], [1, 2, 3, 4])
    assert np.all(found.first == 1) and np.array_equal(found.last[centres], [5, 3, 1]) and np.array_equal(found.last[lower], [7, 5, 3, 1])


def test_pieces_that_two_runs_share_are_found_once_for_each_further_claim():
    n = np.zeros(5, int)
    lines = runs.Runs(np.arange(5), np.array([0, 0, 0, 0, 1]), n, np.array([0, 2, 4, 9, 0]), np.array([5, 3, 9, 12, 12]))
    run, other, first, last = runs.shared(lines, 16, 1)
    assert np.array_equal(run, [1, 2, 3]) and np.array_equal(other, [0, 0, 2])
    assert np.array_equal(first, [2, 4, 9]) and np.array_equal(last, [3, 5, 9])


def test_touching_islands_do_not_overlap():
    lm = rasterize(flat_world(rectangle(0, 0, 0.5, 1) + rectangle(0.5, 0, 1, 1)), [0], resolution=7, subsamples=4)
    assert lm.covered.all() and lm.overlapping == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_uvs_that_are_not_numbers_are_counted_and_get_nothing(bad):
    uv = np.array(rectangle(0, 0, 1, 1), float)
    uv[1, 2, 0] = bad
    lm = rasterize(flat_world(uv), [0], resolution=8, subsamples=1)
    assert lm.unusable == 1
    assert set(lm.receivers.triangle) == {0}
    assert any("not numbers" in n.reason for n in lm.warnings)


def test_uvs_outside_are_cut_off_and_counted():
    lm = rasterize(flat_world(rectangle(0.5, 0.5, 1.5, 1.5)), [0], resolution=8, subsamples=1)
    assert lm.covered.sum() == 16 and lm.outside == 2
    with pytest.raises(TargetError, match="no texel"):
        rasterize(flat_world(rectangle(1.5, 0, 2.5, 1)), [0], resolution=8)


def test_faces_without_uv_area_are_counted():
    uv = [*rectangle(0, 0, 1, 1), [[0.2, 0.2], [0.4, 0.4], [0.3, 0.3]], [[0.5, 0.5]] * 3]
    lm = rasterize(flat_world(uv), [0], resolution=8, subsamples=1)
    assert lm.no_area == 2 and lm.covered.all() and set(lm.receivers.triangle) == {0, 1}


def test_layers_of_ours_tell_of_what_is_at_stake_with_remedies_that_fit():
    """Nobody can unwrap such a layer better, and slivers and specks have no texels in any layout."""
    speck = (2 * np.array([[[0.02, 0.02], [0.03, 0.02], [0.02, 0.03]]])).tolist()
    world = flat_world([*rectangle(0, 0.1, 1, 1), *speck], z=[0])
    uv = world.scene.objects[0].uvs["UVMap"]

    def said(ours):
        return [f"{n.reason} {n.remedy}" for n in rasterize(world, [0], resolution=8, subsamples=1, ours=ours).warnings]

    uv[2] = uv[2, 0]
    assert "1 triangles have no area in UV space and get no texel Unwrap these faces" in said(False) and not said(True)
    uv[0] = uv[0, 0]
    remedy = "Merge by distance, then renew the lightmap UVs (--renew-uvs)"
    assert said(True) == [f"1 triangles have no area in UV space and get no texel {remedy}"]


def test_the_odd_texel_that_faces_of_our_layers_share_is_not_told():
    world = flat_world(rectangle(0, 0, 1, 0.5), rectangle(0.97, 0.49, 1, 0.6))
    theirs, ours = (rasterize(world, [0, 1], resolution=128, subsamples=1, ours=made) for made in (False, True))
    assert 0 < ours.overlapping < 16 and theirs.warnings and not ours.warnings
    half = flat_world(rectangle(0, 0, 1, 0.5), rectangle(0, 0.4, 1, 1))
    assert "claimed by faces" in rasterize(half, [0, 1], resolution=8, subsamples=1, ours=True).warnings[0].reason


def test_missing_layer_names_the_object_and_lists_the_others():
    with pytest.raises(TargetError, match=r'Object0.*"Bake".*"UVMap"'):
        rasterize(flat_world(rectangle(0, 0, 1, 1)), [0], "Bake", resolution=8)


@pytest.mark.parametrize("resolution", [0, -1, 16385])
def test_impossible_resolution_is_refused(resolution):
    with pytest.raises(TargetError, match="texels are not possible"):
        rasterize(flat_world(rectangle(0, 0, 1, 1)), [0], resolution=resolution)


def test_too_much_memory_is_refused_with_both_numbers():
    with pytest.raises(MemoryRefused, match=r"need 90.3 GiB, allowed are 16.0 GiB"):
        rasterize(flat_world(rectangle(0, 0, 1, 1)), [0], resolution=16384, subsamples=16)


def test_points_on_the_edge_of_a_face_keep_off_it():
    """Texel centres on the edges: a ray from there would start inside whatever stands on the edge."""
    lm = rasterize(flat_world(rectangle(0.125, 0.125, 0.875, 0.875)), [0], resolution=4, subsamples=1)
    assert lm.covered.all()
    r = lm.receivers
    assert min(r.u.min(), r.v.min(), (1 - r.u - r.v).min()) > 0.9e-5


def test_one_texel_is_enough():
    lm = rasterize(flat_world(rectangle(0, 0, 1, 1)), [0], resolution=1, subsamples=2)
    assert lm.receivers.count == 1 and lm.covered.shape == (1, 1)


def test_atlas_places_objects_side_by_side():
    world = flat_world(rectangle(0, 0, 1, 1), rectangle(0, 0, 1, 1))
    half = {0: Placement((0.5, 1), (0, 0)), 1: Placement((0.5, 1), (0.5, 0))}
    lm = rasterize(world, [0, 1], resolution=8, subsamples=1, placement=half)
    assert lm.overlapping == 0
    owner = world.scene.object[lm.receivers.triangle].reshape(8, 8)
    assert np.all(owner[:, :4] == 0) and np.all(owner[:, 4:] == 1)


def test_mirrored_uvs_are_the_same_texels():
    uv = np.array(rectangle(0.25, 0.25, 0.75, 1), float)
    uv[..., 0] = 1 - uv[..., 0]
    lm = rasterize(flat_world(uv), [0], resolution=8, subsamples=1)
    assert lm.covered.sum() == 24 and lm.covered[2:, 2:6].all()


def test_charts_follow_mesh_and_uv_together():
    """Two quads that touch in UV but not on the mesh are two islands, and so are two that touch on the mesh but not in UV."""
    one = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    uv = np.array(rectangle(0, 0, 0.5, 1) + rectangle(0.5, 0, 1, 1), np.float32)
    assert len(np.unique(charts.uv_charts(one, uv))) == 1
    split = np.array([[0, 1, 2], [0, 2, 3], [6, 4, 5], [6, 5, 7]])
    assert len(np.unique(charts.uv_charts(split, uv))) == 2
    uv[2:] += np.float32(0.125)
    assert len(np.unique(charts.uv_charts(one, uv))) == 2


def test_components_of_a_long_chain_and_of_single_nodes():
    n = 5000
    order = np.random.default_rng(1).permutation(n)
    labels = charts.components(n + 2, order[:-1], order[1:])
    assert len(np.unique(labels)) == 3 and len(np.unique(labels[:n])) == 1


def test_image_puts_values_back():
    lm = rasterize(flat_world(rectangle(0, 0, 0.5, 0.5)), [0], resolution=4, subsamples=1)
    image = lm.image(np.arange(12).reshape(4, 3))
    assert image.shape == (4, 4, 3)
    assert np.array_equal(image[0, 1], [3, 4, 5]) and np.array_equal(image[1, 0], [6, 7, 8]) and not image[2:].any()


def test_join_keeps_every_point():
    world = flat_world(rectangle(0, 0, 0.5, 0.5), rectangle(0, 0, 1, 0.5))
    parts = [rasterize(world, [k], resolution=8).receivers for k in (0, 1)]
    both, stretches = lightmap.join(parts)
    assert both.count == parts[0].count + parts[1].count
    for part, stretch in zip(parts, stretches, strict=True):
        a, b = both.start[stretch.start], both.start[stretch.stop]
        assert np.array_equal(both.triangle[a:b], part.triangle)
        assert np.array_equal(both.start[stretch.start : stretch.stop + 1] - a, part.start)


def test_many_triangles_are_rasterized_together(monkeypatch):
    """82,000 triangles into 512 x 512 texels: 0.6 s alone on two cores, because no Python function is called for each."""
    monkeypatch.setenv("ADJOINT_GI_THREADS", "1")
    vertices, triangles = icosphere(6)
    b = SceneBuilder()
    uv = (vertices[triangles][..., :2] * 0.49 + 0.5).astype(np.float32)
    b.mesh("Sphere", vertices, triangles, WHITE, uv=uv)
    world = World(b.build())
    lm, calls = counted(lambda: rasterize(world, [0], resolution=512, subsamples=4))
    assert lm.covered.sum() > 0.7 * 512 * 512
    assert calls < world.triangle_count / 10, calls


def test_zeros_of_both_signs_are_one_place():
    """Vertices that are split at the origin do not part a surface, nor does a corner whose UVs are rounded to -0."""
    assert len(set(charts.weld(np.array([[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, 1.0]])))) == 1
    uv = np.array([[[0, 0], [1, 0], [0, 1]], [[-0.0, 1], [1, -0.0], [1, 1]]], np.float32)
    assert charts.uv_charts(np.array([[0, 1, 2], [2, 1, 3]]), uv).tolist() == [0, 0]


def test_texels_that_two_faces_claim_are_told_as_a_share():
    b = SceneBuilder()
    for z in (0, 1):
        b.quad(f"Quad {z}", (0, 0, z), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    notice, *_ = rasterize(World(b.build()), [0, 1], "", 4, 1).warnings
    assert "12 texels (75.0 %) are claimed" in notice.reason  # the centres of the others lie on an edge
    assert notice.object == "Quad 0, Quad 1"
