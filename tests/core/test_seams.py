"""Seams between charts are closed: a cylinder's seam, a floor in two charts, and nothing over sharp edges."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.margin import FilledImage
from adjgi.adjoint_gi.core.receivers.seams import find_seams
from adjgi.adjoint_gi.core.receivers.texels import rasterize
from adjgi.adjoint_gi.core.scene.topology import weld_near
from adjgi.adjoint_gi.core.scene.world import World

AROUND, SIDE = 32, 64


def cylinder(smooth: bool = True) -> World:
    """A tube of height 2 whose UVs are unrolled over the image but for a border, one chart with one seam."""
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(AROUND, z)]) for z in (0.0, 2.0)])
    k = np.arange(AROUND)
    n = (k + 1) % AROUND
    triangles = np.concatenate([np.column_stack([k, n, n + AROUND]), np.column_stack([k, n + AROUND, k + AROUND])])
    left, right = k / AROUND, (k + 1) / AROUND
    zero, one = np.zeros(AROUND), np.ones(AROUND)
    first = np.stack([np.stack(x, axis=1) for x in ((left, zero), (right, zero), (right, one))], axis=1)
    second = np.stack([np.stack(x, axis=1) for x in ((left, zero), (right, one), (left, one))], axis=1)
    uv = 0.1 + 0.8 * np.concatenate([first, second])
    b = SceneBuilder()
    normals = {"smooth_normals": np.tile(np.column_stack([ring, np.zeros(AROUND)]), (2, 1))} if smooth else {}
    b.mesh("Tube", vertices, triangles, diffuse("Grey", 0.5), uv=uv, **normals)
    return World(b.build())


def seams_of(world: World, objects=(0,), side: int = SIDE, sampled: slice = slice(None)):
    lightmap = rasterize(world, list(objects), "", side, 4)
    has = np.zeros(len(lightmap.pixel), bool)
    has[sampled] = True
    filled = FilledImage.of((side, side), lightmap.pixel, has, 8)
    return lightmap, find_seams(world, list(objects), "", lightmap, filled)


def place_of(world: World, lightmap) -> np.ndarray:
    r = lightmap.receivers
    first = r.start[:-1]
    return world.surface(r.triangle[first], r.u[first], r.v[first]).position + world.center


def test_the_seam_of_a_cylinder_is_closed():
    world = cylinder()
    lightmap, seams = seams_of(world)
    place = place_of(world, lightmap)
    # Light that is even around the tube, but as a denoiser would leave it: brighter on one side of the seam than on the other.
    column = lightmap.pixel % SIDE
    light = np.repeat((1 + 0.1 * (column - column.min()) / np.ptp(column))[:, None], 3, axis=1).astype(np.float32)
    before, after = np.abs(seams.steps(light)), np.abs(seams.steps(seams.closed(light)))
    assert before.min() > 0.09 and after.max() < 0.01 and len(before) >= 45
    moved = np.abs(seams.closed(light) - light).max(axis=1)
    assert moved.max() < 0.08 and moved[place[:, 0] < 0].max() == 0  # the far side of the tube stays as it is
    # It is no step next to the seam instead.
    image = lightmap.image(seams.closed(light) - light)[:, :, 0]
    inside = lightmap.covered[:, 1:] & lightmap.covered[:, :-1]
    assert np.abs(np.diff(image, axis=1))[inside].max() < 0.02
    assert seams.closed(light).mean() == pytest.approx(light.mean(), rel=1e-3)


def test_a_facetted_cylinder_and_a_closed_seam_stay_as_they_are():
    assert seams_of(cylinder(smooth=False))[1].count == 0
    lightmap, seams = seams_of(cylinder())
    even = np.ones((len(lightmap.pixel), 3), np.float32)
    np.testing.assert_allclose(seams.closed(even), even, atol=1e-6)


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_two_halves_of_a_floor_that_lie_anyhow_in_the_image_meet(turn):
    """Objects beside each other are one surface, however their charts are turned."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    b = SceneBuilder()
    for x, corner, k in ((0, (0.05, 0.05), 0), (1, (0.55, 0.45), turn)):
        vertices = np.column_stack([square + [x, 0], np.zeros(4)])
        uv = np.roll(square, k, axis=0) * 0.4 + corner
        b.mesh(f"Half {x}", vertices, np.array([[0, 1, 2], [0, 2, 3]]), diffuse("Grey", 0.5), uv=uv[[[0, 1, 2], [0, 2, 3]]])
    world = World(b.build())
    lightmap, seams = seams_of(world, (0, 1))
    place = place_of(world, lightmap)
    light = np.repeat((1 + place[:, 1] + 0.2 * (place[:, 0] > 1))[:, None], 3, axis=1).astype(np.float32)
    steps = seams.steps(light)
    np.testing.assert_allclose(steps, -0.2, atol=0.03)  # the same point on both sides, so only what was made a step is one
    assert seams.count >= 20 and np.abs(seams.steps(seams.closed(light))).max() < 0.02


def test_over_a_sharp_edge_light_may_differ():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    for tilt, count in ((0.5 * np.pi, 0), (0.25, 0), (0.05, 20)):
        b = SceneBuilder()
        for k, (c, s) in enumerate(((1, 0), (-np.cos(tilt), np.sin(tilt)))):
            vertices = np.column_stack([c * square[:, 0], square[:, 1], s * square[:, 0]])
            faces = np.array([[0, 1, 2], [0, 2, 3]])[:, :: 1 - 2 * k]
            b.mesh(f"Leaf {k}", vertices, faces, diffuse("Grey", 0.5), uv=(0.4 * square + 0.05 + 0.5 * k)[faces])
        assert (seams_of(World(b.build()), (0, 1))[1].count >= count) if count else seams_of(World(b.build()), (0, 1))[1].count == 0


def test_dark_stays_dark_enough():
    """No correction makes light negative, or more."""
    lightmap, seams = seams_of(cylinder())
    light = np.where(lightmap.pixel % SIDE < SIDE // 2, 0.0, 1.0)[:, None] * np.ones(3, np.float32)
    closed = seams.closed(light.astype(np.float32))
    assert closed.min() >= 0
    assert closed.mean() == pytest.approx(light.mean(), rel=1e-6)
    # A few bright texels among black ones, as few samples leave them: no light is made where black ones cannot give any.
    light = np.repeat(np.random.default_rng(1).random((len(lightmap.pixel), 1)) < 0.2, 3, axis=1).astype(np.float32)
    closed = seams.closed(light)
    assert closed.min() >= 0 and not np.array_equal(closed, light)
    assert closed.mean(dtype=np.float64) == pytest.approx(light.mean(dtype=np.float64), rel=1e-5)


def floors(places=((0.05, 0.05), (0.55, 0.45)), wall: bool = False, gap: float = 0.0) -> World:
    """Two squares beside each other at x = 1, whose charts begin at these places; a wall may stand between them, and reach below."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    b = SceneBuilder()
    for x, corner in enumerate(places):
        vertices = np.column_stack([square + [x + gap * x, gap * x], np.zeros(4)])
        b.mesh(f"Floor {x}", vertices, faces, diffuse("Grey", 0.5), uv=(square * 0.4 + corner)[faces])
    if wall:
        b.quad("Wall", (1, -1, -0.5), (0, 3, 0), (0, 0, 3), diffuse("White", 0.8))
    return World(b.build())


def test_light_does_not_leak_below_a_wall():
    """A dark room stays dark beside a bright one, though the floor goes on below the wall between them."""
    assert seams_of(floors(), (0, 1))[1].count > 20
    world = floors(wall=True)
    lightmap, seams = seams_of(world, (0, 1))
    light = np.repeat((place_of(world, lightmap)[:, :1] > 1), 3, axis=1).astype(np.float32)
    np.testing.assert_array_equal(seams.closed(light), light)


def test_faces_that_share_texels_do_not_close_what_is_no_seam_of_theirs():
    """The second floor shows the texels of the first, whose light on its far side has nothing to do with the edge between them."""
    assert seams_of(floors(((0.05, 0.05), (0.05, 0.05))), (0, 1))[1].count == 0


def test_texels_without_a_sample_yet_are_no_darkness():
    """In a partial result a seam is closed where both sides have samples, and nothing flows to or from what has none."""
    world = floors()
    for sampled in (slice(None, None, 2), slice(0, 600), slice(0, 0)):
        lightmap, seams = seams_of(world, (0, 1), sampled=sampled)
        light = np.zeros((len(lightmap.pixel), 3), np.float32)
        light[sampled] = 1.0
        np.testing.assert_allclose(seams.closed(light), light, atol=1e-6)
    world = floors(((0.05, 0.05), (0.55, 0.05)))
    _, seams = seams_of(world, (0, 1), sampled=slice(0, 400))
    assert 0 < seams.count < seams_of(world, (0, 1))[1].count


def test_blocks_of_a_wall_are_one_surface():
    """Where two boxes touch four faces meet at an edge: of these the fronts go on in one another, and the sides are shut in."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 0.2) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    square = 0.15 * np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    b = SceneBuilder()
    for k in range(2):
        uv = np.concatenate([square + [0.05 + 0.17 * side % 0.51, 0.05 + 0.5 * k + 0.2 * (side // 3)] for side in range(6)])
        b.mesh(f"Block {k}", corners + [k, 0, 0], faces, diffuse("Grey", 0.5), uv=uv)
    world = World(b.build())
    lightmap, seams = seams_of(world, (0, 1), 2 * SIDE)
    place = place_of(world, lightmap)
    across = [place[r[np.arange(seams.count), w.argmax(axis=1)]] for r, w in zip(seams.receiver, seams.weight, strict=True)]
    assert seams.count >= 40 and np.abs(across[0] - across[1]).max() < 0.2
    assert (np.sign(across[0][:, 0] - 1) == -np.sign(across[1][:, 0] - 1)).all()


@pytest.mark.parametrize("gap", [1e-9, -1e-9, 1e-7, -1e-7, 2e-7])
def test_objects_that_were_put_beside_one_another_meet(gap):
    """Their matrices leave a rounding between corners that are one."""
    assert seams_of(floors(gap=gap), (0, 1))[1].count == seams_of(floors(), (0, 1))[1].count > 20
    assert seams_of(floors(gap=1e-3), (0, 1))[1].count == 0


def test_ends_of_edges_are_one_by_distance():
    rng = np.random.default_rng(1)
    place = rng.uniform(-5, 5, (3000, 3))
    ids = weld_near(np.concatenate([place, place + rng.uniform(-1, 1, place.shape) * 2e-6]), 1e-4)
    assert (ids[:3000] == ids[3000:]).mean() > 0.99 and len(np.unique(ids)) >= 2950


def test_a_correction_goes_on_in_charts_and_not_over_their_borders():
    """The last floor lies far away, and its texels beside those of the first."""
    world = floors(np.array([(4, 4), (36, 4), (36, 36), (4, 30)]) / SIDE)
    lightmap, seams = seams_of(world, (0, 1, 3))
    x = place_of(world, lightmap)[:, 0]
    light = np.repeat(0.5 + 0.5 * (x > 1)[:, None], 3, axis=1).astype(np.float32)
    moved = np.abs(seams.closed(light) - light).max(axis=1)
    assert seams.count > 20 and moved[x < 1].max() > 0.1 and moved[x > 2].max() == 0


def test_normals_of_both_sides_are_those_of_one_place():
    """The edges of two floors run against one another, and the surface bends along them."""
    square, faces = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), np.array([[0, 1, 2], [0, 2, 3]])
    b = SceneBuilder()
    for x, corner in enumerate((0.05, 0.55)):
        vertices = np.column_stack([square + [x, 0], np.zeros(4)])
        bent = np.column_stack([np.zeros(4), square[:, 1] - 0.5, np.ones(4)])
        b.mesh(f"Floor {x}", vertices, faces, diffuse("Grey", 0.5), uv=(square * 0.4 + corner)[faces], smooth_normals=bent)
    assert seams_of(World(b.build()), (0, 1))[1].count == seams_of(floors(((0.05, 0.05), (0.55, 0.55))), (0, 1))[1].count
