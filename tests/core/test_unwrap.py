"""Unwrapping of meshes, without Blender: what every layer must be, good charts, and meshes that are meant to break it."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.base.steps import finish
from adjgi.adjoint_gi.core.receivers import conformal, uv_check
from adjgi.adjoint_gi.core.receivers import unwrap as module
from adjgi.adjoint_gi.core.receivers.charts import Charts, Mesh, area_vectors, carry, islands, signed_areas, smooth_regions
from adjgi.adjoint_gi.core.receivers.conformal import MAX_REGION_TRIANGLES, cut_off, make_charts
from adjgi.adjoint_gi.core.receivers.projection import opened, pieces, project
from adjgi.adjoint_gi.core.receivers.rasterize import row_blocks
from adjgi.adjoint_gi.core.receivers.runs import UvTriangles
from adjgi.adjoint_gi.core.receivers.unwrap import projecting, unwrap
from adjgi.adjoint_gi.core.receivers.uv_check import check
from adjgi.tests.scenes import icosphere


def test_a_long_face_shrinks_no_other():
    """A kerb of 200 m left its house front 7.6 of 154 texels a metre: only it gets fewer, along its length."""

    def sheet(x, y):
        return Mesh(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, np.int64))

    meshes = [sheet(200.0, 0.3), sheet(6.0, 3.0)]
    # With a limit, the image is not filled, and only what is longer than the image at that scale is squeezed: to its whole length.
    for projected in (False, True):
        steps = projecting(meshes, 256, (2,), "asked", np.ones(2), True, 8.0)
        capped = finish(steps) if projected else unwrap(meshes, 256, (2,), most=8.0)
        size = [np.sort(np.ptp(uv.reshape(-1, 2), axis=0)) * 256 for uv in capped.uvs]
        assert capped.texels_per_metre == pytest.approx(8.0) and size[1] == pytest.approx([24, 48], abs=0.5)
        assert size[0] == pytest.approx([2.4, 256], rel=0.03) and capped.length == pytest.approx([256 / 8 / 200, 1], rel=0.02)
    found, plain = (unwrap(meshes, 256, (2,), squeeze=squeeze) for squeeze in (True, False))
    size = [np.ptp(uv.reshape(-1, 2), axis=0) * 256 for uv in found.uvs]
    assert (found.length < 1).tolist() == [True, False] and (plain.length == 1).all() and plain.texels_per_metre < 1.3
    assert found.texels_per_metre > 19 and np.sort(size[1]) == pytest.approx(found.texels_per_metre * np.array([3, 6]), rel=0.05)
    assert size[0].max() > 100 and size[0].min() == pytest.approx(0.3 * found.texels_per_metre, rel=0.25)
    # Where its length is no great loss to others, nothing is squeezed.
    assert (unwrap([sheet(7.0, 3.0)], 256, (2,)).length == 1).all()


@pytest.mark.parametrize("faces", (10, 200))
def test_a_long_chart_of_several_faces_is_cut(faces):
    """Kerb and house front in one mesh: in pieces, neither loses texels to the other; where its faces are long as well, the kerb does."""
    x = np.linspace(0, 200, faces + 1)
    kerb = np.concatenate([np.stack([x, 0 * x + y, 0 * x], 1) for y in (0.0, 0.3)])
    i = np.arange(faces)
    tri = np.concatenate([np.stack([i, i + 1, i + faces + 2], 1), np.stack([i, i + faces + 2, i + faces + 1], 1)])
    front = np.array([[0, 1, 0], [6, 1, 0], [6, 1, 3], [0, 1, 3.0]])
    n = len(kerb)
    m = Mesh(
        np.concatenate([kerb, front]), np.concatenate([tri, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]), np.r_[np.tile(i, 2), faces, faces]
    )
    found = unwrap([m], 512, (2,))
    flat = np.abs(signed_areas(found.uvs[0].astype(float))) * 512**2
    density = np.sqrt(flat / np.linalg.norm(area_vectors(m.corners()), axis=1))
    even = np.sqrt(0.6 * 512**2 / 78)  # of all 78 m2 alike
    assert not found.projected and density[-1] > 0.9 * even
    assert (found.length[0] < 1) == (faces == 10) and (faces == 10 or density[0] > 0.9 * even)


def mesh(vertices, triangles, polygon=None):
    """A mesh as the bridge makes it: without triangles that have no area or lie nowhere."""
    vertices, triangles = np.asarray(vertices, np.float64), np.asarray(triangles, np.int64)
    polygon = np.arange(len(triangles)) if polygon is None else np.asarray(polygon)
    with np.errstate(all="ignore"):
        p = vertices[triangles]
        good = np.isfinite(p).all(axis=(1, 2)) & (np.abs(p).max(axis=(1, 2)) <= 1e12)
        good &= np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) > 0
    return Mesh(np.where(np.isfinite(vertices), vertices, 0.0), triangles[good], polygon[good])


def sheet(n, height=lambda x, y: 0 * x):
    """A square of n x n quads, (x, y, height), its triangles, and their quads."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    return np.stack([x.ravel(), y.ravel(), height(x, y).ravel()], 1), triangles, np.tile(np.arange(n * n), 2)


def box(size=(1, 1, 1), at=(0, 0, 0)):
    """A box of six quads."""
    corner = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) * size + at
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return mesh(corner, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.repeat(np.arange(6), 2))


def soup(n, points, seed=1):
    """n random triangles of a number of random points."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(points, 3)), rng.integers(0, points, (n, 3))


def spoilt(share, factor, seed=2):
    """A soup in which a share of the coordinates is multiplied."""
    vertices, triangles = soup(100, 300)
    return np.where(np.random.default_rng(seed).random(vertices.shape) < share, factor * vertices, vertices), triangles


SMALL = sheet(12)
FAN = np.concatenate([[[0, 0, 0], [0, 0, 1]], np.stack([np.cos(np.arange(50)), np.sin(np.arange(50)), np.zeros(50)], 1)])
# Quads whose sides cross, as bevels make them where they are wider than the faces: their two triangles lie over one another.
CROSSED = [[0, 0, 0], [2, 0.1, 0.0], [0.05, 0.5, 0.1], [1.9, -0.4, -0.1], [0, 0, 1], [2, 0, 1], [0, 1, 1], [1, -1, 1]]
HOSTILE = {
    "one triangle": ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    "far away": (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) + 1e6, [[0, 1, 2]]),
    "sliver": ([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]], [[0, 1, 2]]),
    "sliver beyond float32": ([[0, 0, 0], [1, 0, 0], [0.5, 1e-15, 0]], [[0, 1, 2]]),
    "soup": soup(200, 600),
    "shared points": soup(400, 40),
    "very much shared points": soup(800, 12),
    "1e-20": (soup(100, 300)[0] * 1e-20, soup(100, 300)[1]),
    "1e11": (soup(100, 300)[0] * 1e11, soup(100, 300)[1]),
    "some 1e20": spoilt(0.02, 1e20),
    "some 1e-20": spoilt(0.3, 1e-20),
    "some 1e11": spoilt(0.05, 1e11),
    "not a number": spoilt(0.05, np.nan),
    "faces three times": (SMALL[0], np.concatenate([SMALL[1], SMALL[1], SMALL[1][:, ::-1]])),
    "one edge of fifty faces": (FAN, np.stack([np.zeros(50, int), np.ones(50, int), np.arange(2, 52)], 1)),
    "points on a lattice": (np.round(np.random.default_rng(4).random((200, 3)) * 3), soup(400, 200)[1]),
    "ribbon": (SMALL[0] * [1, 1e-8, 1], SMALL[1]),
    "graded": (SMALL[0] ** 8, SMALL[1]),
    "crossed quads": (CROSSED, [[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]], [0, 0, 1, 1]),
    "faces in pieces": (*soup(120, 40), np.random.default_rng(6).integers(0, 40, 120)),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_meshes_are_unwrapped(name):
    m = mesh(*HOSTILE[name])
    u = unwrap([m], 256, (2, 1, 0))
    (uv,) = u.uvs
    assert uv.shape == (len(m.triangles), 3, 2) and np.isfinite(uv).all() and uv.min() >= 0 and uv.max() <= 1
    if name != "faces in pieces":  # such faces lie over themselves, whatever is done
        assert not u.projected and not check([m], uv, 256, u.padding)


@pytest.mark.slow
def test_a_hundred_thousand_triangles_are_unwrapped():
    m = mesh(*sheet(224, lambda x, y: 0.2 * np.sin(9 * x) * np.cos(7 * y)))
    assert len(m.triangles) > 100_000 > MAX_REGION_TRIANGLES
    u = unwrap([m], 512, (2,))
    assert not u.projected and u.charts < 50 and u.covered > 0.4


def test_a_flat_sheet_of_many_triangles_is_one_chart_without_distortion():
    flat, tri, quad = sheet(30)
    turn = np.array([[0.6, 0.0, 0.8], [0.48, 0.8, -0.36]])  # orthonormal rows
    m = mesh(flat[:, :2] @ turn, tri, quad)
    u = unwrap([m], 256, (2,))
    uv = u.uvs[0]
    length = np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1) / np.linalg.norm(m.corners()[:, 1] - m.corners()[:, 0], axis=1)
    assert u.charts == 1 and np.ptp(length) / length.mean() < 1e-4
    assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv[..., 0]) > 0.95
    assert length.mean() * 256 == pytest.approx(u.texels_per_metre, rel=0.01)


def test_a_sphere_has_few_charts_and_the_same_every_time():
    m = mesh(*icosphere(3))
    first = unwrap([m], 512, (4,))
    assert first.charts <= 12 and first.covered > 0.45
    assert np.array_equal(first.uvs[0], unwrap([m], 512, (4,)).uvs[0])


def test_several_meshes_share_the_square_at_one_scale():
    meshes = [box(), box((2, 1, 0.5)), box(), mesh(*icosphere(2))]  # equal places in space are no equal places of the image
    u = unwrap(meshes, 256, (4,))
    assert u.charts == 18 + islands(meshes[3], u.uvs[3]).max() + 1 and not u.projected and u.covered > 0.5
    assert not check(meshes, np.concatenate(u.uvs), 256, 4)
    for m, uv in zip(meshes[:3], u.uvs, strict=False):
        density = np.sqrt(np.abs(signed_areas(uv.astype(float))) / np.linalg.norm(area_vectors(m.corners()), axis=1)) * 256
        assert np.allclose(density, u.texels_per_metre, rtol=0.06)  # whole texels


def test_density_scales_the_charts_of_a_mesh_against_the_others():
    meshes = [box(), box(), mesh(*icosphere(2))]
    wanted = np.array([1.0, 0.25, 0.5])
    u = unwrap(meshes, 256, (4,), wanted)
    assert not check(meshes, np.concatenate(u.uvs), 256, 4, density=wanted)
    for m, uv, density in zip(meshes, u.uvs, wanted, strict=True):
        share = np.abs(signed_areas(uv.astype(float))).sum() / np.linalg.norm(area_vectors(m.corners()), axis=1).sum()
        assert share**0.5 * 256 == pytest.approx(density * u.texels_per_metre, rel=0.06)  # whole texels
    assert u.texels_per_metre > 1.2 * unwrap(meshes, 256, (4,)).texels_per_metre


def test_unwrapping_goes_in_steps_whose_shares_rise():
    """The caller can stop between them; a mesh of many regions is not one call into xatlas."""
    many = [mesh(*icosphere(3)), box(), mesh(*sheet(40, lambda x, y: np.where(np.floor(8 * x) % 2, 0.0, 1.0)))]
    steps = module.unwrapping(many, 128, (2, 1))
    shares = list(steps)
    assert len(shares) >= 8 and np.all(np.diff(shares) >= 0) and shares[0] >= 0 and shares[-1] <= 1
    assert np.array_equal(np.concatenate(finish(module.unwrapping(many, 128, (2, 1))).uvs), np.concatenate(unwrap(many, 128, (2, 1)).uvs))


def test_every_atlas_of_xatlas_is_given_one_mesh(monkeypatch):
    """A second one moves the list from which its threads take the first: a crash in one of twenty runs. Flat regions need none."""
    added = []

    class Counted(conformal.xatlas.Atlas):
        def add_mesh(self, *arguments):
            added.append(self)
            super().add_mesh(*arguments)

    monkeypatch.setattr(conformal.xatlas, "Atlas", Counted)
    ball = mesh(*icosphere(2))
    two = mesh(np.concatenate([ball.vertices, ball.vertices + 3]), np.concatenate([ball.triangles, ball.triangles + len(ball.vertices)]))
    assert make_charts(two).count >= 8 and len(added) == len(set(map(id, added))) == 2
    make_charts(box())
    assert len(added) == 2


def test_the_check_of_a_layer_costs_rows_and_not_texels():
    """Twice the resolution: twice the runs, and no list of the texels themselves."""
    meshes = [box() for _ in range(4)]
    uv = np.concatenate(unwrap(meshes, 256, (4,)).uvs)
    count = []
    for size in (256, 512):
        layout = UvTriangles.of(uv, size, size)
        count.append(sum(len(found) for _, found in row_blocks(layout, size, size, np.array([[0.5, 0.5]]))))
    assert count[1] < 2.1 * count[0] < 0.1 * 512**2


def test_faces_stay_whole_and_creases_part_charts():
    rough = mesh(*sheet(24, lambda x, y: 0.15 * np.sin(11 * x * y)))
    charts = make_charts(rough)
    quad = [np.unique(charts.chart[rough.polygon == k]) for k in range(24 * 24)]
    assert all(len(found) == 1 for found in quad) and charts.count < 60
    assert np.unique(smooth_regions(box())).size == 6 == make_charts(box()).count


def test_charts_keep_area_and_nearly_lengths():
    m = mesh(*icosphere(3))
    charts = make_charts(m)
    area = np.linalg.norm(area_vectors(m.corners()), axis=1)
    assert np.abs(signed_areas(charts.xy)).sum() == pytest.approx(area.sum(), rel=1e-6)
    ratio = np.abs(signed_areas(charts.xy)) / area
    assert ratio.min() > 0.5 and ratio.max() < 2


def test_affine_maps_carry_points():
    corner = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]]], float)
    flat = np.array([[[1, 1], [1, 2], [0, 1]]], float)
    assert np.allclose(carry(corner, flat, np.array([[[2, 3, 0], [1, 0, 0]]], float)), [[[0, 2], [1, 1.5]]])


def test_an_opened_face_has_its_corners_as_far_apart_as_along_its_border():
    """Of a face of 3 by 1 the long sides take 3/8 of the circle each: chords of 2.41 to 1."""
    corners = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0.0]])
    xy = opened(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, np.int64))).xy
    long, short = np.linalg.norm(xy[0, 1] - xy[0, 0]), np.linalg.norm(xy[0, 2] - xy[0, 1])
    assert long / short == pytest.approx(np.sin(3 * np.pi / 8) / np.sin(np.pi / 8), rel=1e-5)


def test_cut_charts_fall_into_pieces_and_then_into_faces_which_are_opened():
    m = mesh(*sheet(2))
    whole = Charts(m.corners()[..., :2], np.zeros(8, np.int64))
    assert cut_off(m, whole, np.zeros(0, int)).count == 1
    assert cut_off(m, whole, np.array([0])).count == 4  # one piece already, so its four faces
    faces = Charts(whole.xy, m.polygon)
    cut = cut_off(m, faces, np.array([0]))
    assert cut.count == 4 and np.ptp(np.linalg.norm(cut.xy[0] - cut.xy[m.polygon == 0].mean(axis=(0, 1)), axis=1)) < 0.1


def test_corners_of_a_crossed_face_have_one_place_each():
    """Blender keeps one UV for each corner of a face: its triangles cannot be parted, so crossed ones are laid out as convex ones."""
    m = mesh(*HOSTILE["crossed quads"])
    (uv,) = unwrap([m], 256, (2,)).uvs
    for k in (0, 2):
        assert np.array_equal(uv[k, 1], uv[k + 1, 0]) and np.array_equal(uv[k, 2], uv[k + 1, 2])


def test_a_box_as_one_chart_falls_into_its_faces():
    two = box()
    assert cut_off(two, Charts(np.zeros((12, 3, 2)), np.zeros(12, np.int64)), np.array([3])).count == 6


def square(x0, y0, x1, y1):
    """UV of a quad of two triangles."""
    return [[[x0, y0], [x1, y0], [x1, y1]], [[x0, y0], [x1, y1], [x0, y1]]]


PAIR = [mesh(*sheet(1)), mesh(*sheet(1))]
LAYERS = {
    "right": (square(0, 0, 0.5, 1) + square(0.5 + 3 / 32, 0, 1, 1), ""),
    "close": (square(0, 0, 0.5, 1) + square(0.5 + 2 / 32, 0, 1, 1), "too close"),
    "over one another": (square(0, 0, 0.5, 1) + square(0.3, 0, 1, 1), "claimed twice"),
    "without an area": (square(0, 0, 0.5, 1) + square(0.7, 0, 0.7, 1), "without an area"),
    "outside": (square(0, 0, 0.5, 1) + square(0.7, 0, 1.2, 1), "out of the unit square"),
}


@pytest.mark.parametrize("name", LAYERS)
def test_faults_are_found(name):
    uv, says = LAYERS[name]
    faults = check(PAIR, np.array(uv, np.float32), 32, 3)
    assert bool(faults) == bool(says) and says in str(faults)


def given(charts):
    """Steps that make `charts`."""
    yield 0.5
    return charts


def test_bad_charts_are_mended_and_hopeless_ones_projected(monkeypatch):
    """Charts that lie over themselves are cut; where that does not help, the meshes are projected and the reason is said."""
    m = mesh(*sheet(6))
    folded = Charts(np.abs(m.corners()[..., :2] - 0.5), np.zeros(len(m.triangles), np.int64))
    monkeypatch.setattr(module, "making_charts", lambda mesh: given(folded))
    mended = unwrap([m], 128, (2,))
    assert not mended.projected and mended.charts == 36 and not check([m], mended.uvs[0], 128, 2)
    monkeypatch.setattr(module, "cut_off", lambda mesh, charts, triangles: charts)
    projected = unwrap([m], 128, (2,))
    assert "claimed twice" in projected.projected and projected.charts == 1 and not check([m], projected.uvs[0], 128, 2)


def test_the_first_padding_that_fits_is_taken():
    boxes = [box() for _ in range(20)]
    assert unwrap(boxes, 64, (4, 2, 1, 0)).padding == 4
    assert unwrap(boxes, 32, (4, 2, 1, 0)).padding < 4
    with pytest.raises(TargetError, match="120 UV islands do not fit into 8 x 8"):
        unwrap(boxes, 8, (4, 2, 1, 0))


def two_quads(gap, size=1.0):
    """Two squares of one mesh whose UVs are `gap` of the image apart."""
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    place = np.concatenate([np.pad(corner + (2 * k, 0), ((0, 0), (0, 1))) for k in range(2)]) * size
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    flat = np.concatenate([corner * (0.5 - gap / 2, 1) + (k * (0.5 + gap / 2), 0) for k in range(2)])
    return Mesh(place, triangles, np.array([0, 0, 1, 1])), flat[triangles].astype(np.float32)


def test_padding_is_in_texels_of_the_image_where_it_is_looked_at_in_less_detail(monkeypatch):
    """Charts 12 texels apart in an image of 256: more than 8, less than 16, whatever the raster."""
    mesh, uv = two_quads(12 / 256)
    for finest in (256, 64):
        monkeypatch.setattr(uv_check, "FINEST", finest)
        assert [bool(check([mesh], uv, 256, padding).close) for padding in (8, 16)] == [False, True]


def test_faces_are_lost_by_the_density_of_their_object():
    """A face of 50 cm2 without UVs beside squares that fill the image: at a hundredth of their density it would be a 500th of a texel."""
    mesh, uv = two_quads(0.0)
    lost = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), np.array([[0, 1, 2]]), np.zeros(1, np.int64))
    uv = np.concatenate([uv, np.zeros((1, 3, 2), np.float32)])
    for density, found in ((1.0, [4]), (0.01, [])):
        assert check([mesh, lost], uv, 64, 1, density=np.array([1.0, density])).lost.tolist() == found


@pytest.mark.parametrize(("tilt", "parts"), [(20, 1), (40, 2)])
def test_a_roof_is_cut_along_its_ridge_where_that_is_sharp(tilt, parts):
    """Both sides look up more than aside; light must not bleed around an edge of more than 60 degrees."""
    h = np.tan(np.radians(tilt))
    place = np.array([[0, 0, 0], [0, 2, 0], [1, 0, -h], [1, 2, -h], [-1, 0, -h], [-1, 2, -h]])
    roof = Mesh(place, np.array([[0, 2, 3], [0, 3, 1], [0, 1, 5], [0, 5, 4]]), np.array([0, 0, 1, 1]))
    assert len(np.unique(pieces(roof))) == parts


def test_a_chart_whose_mean_leaves_a_face_too_steep_is_laid_along_its_main_axis():
    """Two faces turned by 40 degrees to either side, one of them small: both keep cos 40 of their area."""
    c, s = np.cos(np.radians(40)), np.sin(np.radians(40))
    edge = np.array([[0, 0, 0], [0, 1, 0]], float)
    vertices = np.concatenate([edge, edge + [-9 * c, 0, -9 * s], edge + [c, 0, -s]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5]]), np.array([0, 0, 1, 1]))
    area = np.linalg.norm(area_vectors(mesh.corners()), axis=1)
    flat = np.abs(signed_areas(project(mesh, np.zeros(4, np.int64)).xy))
    np.testing.assert_allclose(flat / flat.sum(), area / area.sum(), rtol=1e-6)


def test_a_texel_of_two_charts_is_too_close_to_both():
    """A tiny face below the border of a large one, within the texels of that border."""
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    meshes = [Mesh(size * triangle, np.array([[0, 1, 2]]), np.zeros(1, np.int64)) for size in (1.0, 0.02)]
    uv = np.array([[(6.4, 6.4), (40, 6.4), (6.4, 40)], [(12.1, 6.05), (12.9, 6.05), (12.1, 6.35)]], np.float32) / 64
    assert check(meshes, uv, 64, 1).close > 0
