"""Elements: cutting, locating, colours, smooth values, and answers at receivers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import MemoryRefused
from adjgi.adjoint_gi.core.elements.answer import ElementAnswer
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements, parallelograms
from adjgi.adjoint_gi.core.elements.mesh import INSET, ElementNodes, element_mesh
from adjgi.adjoint_gi.core.elements.refinement import RefinedElements, contrast, longest_edge, over_base, smoothed
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, RayKind, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.solving import scattered

CASES = {
    "cube whole": (scenes.cube, 1.0),
    "cube fine": (scenes.cube, 0.13),
    "turned boxes": (scenes.cornell, 0.07),
    "triangles": (lambda: scenes.two_zone_sphere(2), 0.07),
    "grid of triangles": (lambda: scenes.snowman(2), 0.2),
}


def answer_at(receivers, elements, direct, indirect, min_length=0):
    """`ElementAnswer` in one call, for a result that is wanted once."""
    answer = ElementAnswer(elements, receivers, min_length=min_length)
    for _ in answer.prepare():
        pass
    return answer.parts(direct, indirect)


def interpolate(elements, values, triangle, u, v, side):
    """(n, 3) smooth values at points on the given side (+1 or -1) from one value a side, `values` (2 count, 3)."""
    element, a, b = elements.cell(triangle, u, v)
    return elements.nodes.at(elements.nodes.values(values), 2 * element + (side < 0), a, b)


@pytest.fixture(params=[*CASES, "refined quads", "refined triangles"])
def elements(request):
    if request.param.startswith("refined"):
        return refined(scenes.cornell() if "quads" in request.param else scenes.two_zone_sphere(0))
    scene, edge = CASES[request.param]
    return Elements(World(scene()), edge)


def refined(scene):
    """Elements of which some have been cut, and of these some again, at random."""
    rng = np.random.default_rng(11)
    elements = Elements(World(scene), 0.7)
    for _ in range(3):
        elements = RefinedElements(elements, rng.random(elements.count) < 0.4)
    return elements


def test_a_sample_is_found_again_in_its_element(elements):
    rng = np.random.default_rng(1)
    index = rng.integers(0, elements.count, 20_000)
    assert np.array_equal(elements.locate(*elements.sample(index, rng)), index)


def test_points_positions_and_cells_agree(elements):
    rng = np.random.default_rng(2)
    index = rng.integers(0, elements.count, 5000)
    a, b = rng.random((2, 5000))
    at = elements.point(index, a, b)
    position = elements.position(index, a, b)
    scale = elements.world.size
    assert np.abs(elements.world.surface(*at).position - position).max() < 1e-6 * scale
    assert np.abs(elements.position(*elements.cell(*at)) - position).max() < 1e-6 * scale


def test_areas_centroids_and_corners(elements):
    assert elements.area.sum() == pytest.approx(elements.world.area.sum(), rel=1e-12)
    corners = elements.corners(np.arange(elements.count))
    # The area of each element from its corners.
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cross += np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 0])
    assert np.allclose(0.5 * np.linalg.norm(cross, axis=1), elements.area, rtol=1e-9)
    assert (np.einsum("ij,ij->i", cross, elements.normal) > 0).all()
    quad = elements.is_quad
    assert np.allclose(corners[quad].mean(axis=1), elements.centroid[quad], atol=1e-12)
    assert np.allclose(corners[~quad][:, :3].mean(axis=1), elements.centroid[~quad], atol=1e-12)


def test_no_edge_is_longer_than_asked(elements):
    corners = elements.corners(np.arange(elements.count))
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    assert edges.max() <= elements.max_edge * (1 + 1e-5)


def test_samples_are_uniform():
    elements = Elements(World(scenes.two_zone_sphere(0)), 10.0)
    rng = np.random.default_rng(3)
    n = 40_000
    triangle, u, v = elements.sample(np.zeros(n, int), rng)
    assert (triangle == 0).all()
    # Each of the nine sub-triangles of a 3 x 3 division gets its share; 5 standard deviations.
    a, b = np.minimum((3 * u).astype(int), 2), np.minimum((3 * v).astype(int), 2)
    upper = (3 * u - a) + (3 * v - b) > 1
    counts = np.unique(100 * a + 10 * b + upper, return_counts=True)[1]
    assert len(counts) == 9
    assert np.abs(counts - n / 9).max() < 5 * np.sqrt(n / 9)


def mesh(vertices, triangles, polygon, **options):
    b = SceneBuilder()
    b.mesh("Mesh", np.array(vertices, float), np.array(triangles), diffuse("Grey", 0.5), polygon=np.array(polygon), **options)
    return b.build()


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.mark.parametrize("first", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
@pytest.mark.parametrize("second", [(0, 2, 3), (2, 3, 0), (3, 0, 2)])
def test_parallelograms_are_found_whatever_corner_comes_first(first, second):
    scene = mesh(SQUARE, [first, second], [0, 0])
    assert parallelograms(scene).tolist() == [1, -1]
    elements = Elements(World(scene), 0.26)
    assert elements.count == 16
    rng = np.random.default_rng(4)
    index = rng.integers(0, 16, 2000)
    assert np.array_equal(elements.locate(*elements.sample(index, rng)), index)


def test_what_is_no_parallelogram_stays_two_triangles():
    kite = [(0, 0, 0), (1, 0, 0), (2, 2, 0), (0, 1, 0)]
    bent = [(0, 0, 0), (1, 0, 0), (1, 1, 0.1), (0, 1, 0)]
    for vertices, triangles, polygon in (
        (kite, [(0, 1, 2), (0, 2, 3)], [0, 0]),
        (bent, [(0, 1, 2), (0, 2, 3)], [0, 0]),
        (SQUARE, [(0, 1, 2), (0, 2, 3)], [0, 1]),  # two polygons
        (SQUARE, [(0, 1, 2), (0, 3, 2)], [0, 0]),  # wound against each other
    ):
        scene = mesh(vertices, triangles, polygon)
        assert (parallelograms(scene) == -1).all()
        assert Elements(World(scene), 10.0).count == 2


def test_halves_of_two_materials_stay_two_triangles():
    scene = mesh(SQUARE, [(0, 1, 2), (0, 2, 3)], [0, 0])
    assert parallelograms(scene)[0] == 1
    assert (parallelograms(dataclasses.replace(scene, material=np.array([0, 1]))) == -1).all()


def test_a_sliver_does_not_explode():
    elements = Elements(World(mesh([(0, 0, 0), (1000, 0, 0), (500, 0.001, 0)], [(0, 1, 2)], [0])), 0.1)
    assert elements.count < 1000


def test_automatic_edge_comes_near_the_target():
    for scene in (scenes.cube(), scenes.cornell(), scenes.two_zone_sphere(1)):
        world = World(scene)
        count = Elements(world, 0, 3000).count
        assert 1500 < count <= 3000
        assert Elements.planned(world, 0, 3000) == count
    # More triangles than wanted: one element each.
    assert Elements(World(scenes.two_zone_sphere(3)), 0, 100).count == 1280


def test_too_many_elements_are_refused_with_both_numbers():
    with pytest.raises(MemoryRefused, match=r"6,000,000,000,000 elements; the limit is 20,000,000"):
        Elements(World(scenes.cube()), 1e-6)


def test_textured_colours_are_means():
    pixels = np.zeros((2, 2, 4), np.float32)
    pixels[0, 0, :3] = pixels[1, 1, :3] = 0.8
    color = Color((Term((1.0, 0.5, 0.25), (Source("image", "UVMap", 0),)),))
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Tiles", (Lobe("diffuse", color), Lobe("emission", color))))
    scene = b.build()
    scene = type(scene)(**{**scene.__dict__, "textures": (Texture("Tiles", pixels, interpolation="Closest"),)})
    whole = Elements(World(scene), 1.0)
    assert np.allclose(whole.albedo, [[0.4, 0.2, 0.1]])
    assert np.allclose(whole.emitted, np.pi * whole.albedo)
    halves = Elements(World(scene), 0.5)
    assert np.allclose(sorted(halves.albedo[:, 0]), [0, 0, 0.8, 0.8])


def test_smooth_values_keep_constants_and_follow_slopes(elements):
    rng = np.random.default_rng(5)
    index = rng.integers(0, elements.count, 3000)
    at = elements.sample(index, rng)
    one = np.ones(3000)
    values = np.zeros((2 * elements.count, 3))
    values[0::2], values[1::2] = 2.0, 3.0
    assert np.allclose(interpolate(elements, values, *at, one), 2.0, rtol=1e-6)
    assert np.allclose(interpolate(elements, values, *at, -one), 3.0, rtol=1e-6)
    # Values that are linear in space come back to within an element's size.
    slope = np.repeat(elements.centroid, 2, axis=0)
    error = interpolate(elements, slope, *at, one) - elements.world.surface(*at).position
    assert np.abs(error).max() < elements.max_edge


def test_hard_edges_stay_hard_and_flat_neighbours_join():
    b = SceneBuilder()
    grey = diffuse("Grey", 0.5)
    b.quad("Floor A", (0, 0, 0), (1, 0, 0), (0, 1, 0), grey)
    b.quad("Floor B", (1, 0, 0), (1, 0, 0), (0, 1, 0), grey)
    b.quad("Wall", (2, 0, 0), (0, 0, 1), (0, 1, 0), grey)
    elements = Elements(World(b.build()), 0.5)
    values = np.repeat(elements.patch[:, None] * np.ones(3), 2, axis=0)

    def right(patch):  # the middle of the edge of largest x, in barycentrics of the builder's quads
        return interpolate(elements, values, np.array([2 * patch]), np.array([0.5]), np.array([0.5]), np.ones(1))[0, 0]

    def left(patch):
        return interpolate(elements, values, np.array([2 * patch + 1]), np.array([0.0]), np.array([0.5]), np.ones(1))[0, 0]

    assert left(0) == pytest.approx(0.0)
    assert right(0) == left(1) == pytest.approx(0.5)
    assert right(1) == pytest.approx(1.0)  # the wall's value does not bleed in
    wall = np.flatnonzero(elements.patch == 2)
    assert np.allclose(interpolate(elements, values, *elements.point(wall, np.full(4, 0.1), np.full(4, 0.1)), np.ones(4)), 2.0)


def test_smooth_shading_joins_across_an_edge_that_flat_shading_keeps():
    vertices, triangles = scenes.icosphere(1)
    for normals, joined in ((vertices, True), (None, False)):
        b = SceneBuilder()
        b.mesh("Ball", vertices, triangles, diffuse("Grey", 0.5), smooth_normals=normals)
        elements = Elements(World(b.build()), 10.0)
        assert elements.nodes.count == (len(vertices) if joined else 3 * len(triangles))


def test_corners_of_quads_have_the_normals_of_their_own_triangles():
    """Normals that no first triangle of a quad foretells are those of its neighbours all the same, so four quads share their corners."""
    place = np.array([(x, y, 0) for y in range(3) for x in range(3)], float)
    bent = np.column_stack([0.3 * place[:, 0] * place[:, 1], np.zeros(9), np.ones(9)])
    first = np.array([0, 1, 3, 4])
    triangles = np.stack([np.stack([first, first + 1, first + 4], axis=1), np.stack([first, first + 4, first + 3], axis=1)], axis=1)
    scene = mesh(place, triangles.reshape(-1, 3), np.repeat(np.arange(4), 2), smooth_normals=bent)
    elements = Elements(World(scene), 10.0)
    assert elements.is_quad.all() and elements.count == 4 and elements.nodes.count == 9


def test_element_receivers_lie_on_their_own_side(elements):
    receivers = ElementReceivers(elements)
    seen = np.zeros(receivers.count)
    for points in receivers.sites():
        surface = elements.world.surface(points.triangle, points.u, points.v, points.towards)
        assert np.array_equal(elements.side(points.triangle, points.u, points.v, surface.side), points.receiver)
        seen += np.bincount(points.receiver, minlength=receivers.count)
    assert (seen == 4).all()
    points = receivers.sample(np.arange(receivers.count), np.random.default_rng(6))
    surface = elements.world.surface(points.triangle, points.u, points.v, points.towards)
    assert np.array_equal(elements.side(points.triangle, points.u, points.v, surface.side), points.receiver)


def camera_scene():
    b = SceneBuilder()
    b.background = (0.25, 0.5, 1.0)
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Warm", (0.5, 0.25, 0.125), 0.5))
    b.camera = Camera("orthographic", (1, 0.5, 2), (1, 0, 0), (0, 1, 0), (0, 0, -1), (-1, 1, -0.5, 0.5), 4, 2)
    return b


def test_answers_for_a_camera():
    world = World(camera_scene().build())
    elements = Elements(world, 1.0)
    direct, indirect = np.zeros((2, 3)), np.zeros((2, 3))
    direct[0], indirect[0], direct[1] = 4.0, 2.0, 99.0  # the back is not seen
    parts = answer_at(CameraReceivers(world), elements, direct, indirect)
    left = np.arange(8) % 4 < 2
    albedo = np.array([0.5, 0.25, 0.125])
    assert np.allclose(parts.emitted[left], 0.5)
    assert np.allclose(parts.direct[left], 4 * albedo / np.pi, rtol=1e-6)
    assert np.allclose(parts.indirect[left], 2 * albedo / np.pi, rtol=1e-6)
    assert np.allclose(parts.albedo[left], albedo)
    assert np.allclose(parts.extra["elements"][left], np.pi * 0.5 + 6 * albedo, rtol=1e-6)
    assert np.allclose(parts.emitted[~left], [0.25, 0.5, 1.0])
    assert not parts.direct[~left].any() and not parts.albedo[~left].any()
    assert (parts.weight == 1).all()


@pytest.mark.parametrize("shortest", [0, 1])
def test_emission_is_in_no_part_of_an_answer_that_does_not_count_it(shortest):
    world = World(camera_scene().build())
    elements, light = Elements(world, 1.0), np.ones((2, 3))  # of the floor, whose back is not seen
    for receivers in (CameraReceivers(world), SurfaceReceivers("texels", [0, 1], [0], [0.2], [0.2]), ElementReceivers(elements)):
        parts = answer_at(receivers, elements, light, light, shortest)
        assert parts.emitted.any() == (shortest == 0)
        if receivers.kind == "camera":
            albedo = np.array([0.5, 0.25, 0.125])
            np.testing.assert_allclose(parts.extra["elements"][0], (shortest == 0) * np.pi * 0.5 + 2 * albedo, rtol=1e-6)


def test_a_lamp_with_a_size_is_seen_by_the_camera():
    b = camera_scene()
    b.light(Light("Lamp", "area", (3.0, 3.0, 3.0), position=(1.5, 0.5, 0.5), axis_z=(0, 0, -1), axis_x=(-1, 0, 0), size_x=1.0, size_y=1.0))
    world = World(b.build())
    parts = answer_at(CameraReceivers(world), Elements(world, 1.0), np.zeros((2, 3)), np.zeros((2, 3)))
    right = np.arange(8) % 4 >= 2
    assert np.allclose(parts.emitted[right], [3.25, 3.5, 4.0])


def test_answers_for_texels_and_for_elements():
    world = World(camera_scene().build())
    elements = Elements(world, 0.5)
    side = np.zeros((8, 3))
    side[0::2] = 1.5
    texels = SurfaceReceivers("texels", [0, 1, 3], [0, 0, 1], [0.1, 0.2, 0.3], [0.2, 0.3, 0.4])
    parts = answer_at(texels, elements, side, 2 * side)
    assert np.allclose(parts.direct, 1.5)
    assert np.allclose(parts.indirect, 3.0)
    assert np.allclose(parts.emitted, np.pi * 0.5)
    own = answer_at(ElementReceivers(elements), elements, side, 2 * side)
    assert np.array_equal(own.direct, side.astype(np.float32))
    assert own.albedo.shape == (8, 3)


def test_direct_light_at_receivers_replaces_that_of_elements_and_lengths_rule_it():
    world = World(camera_scene().build())
    elements = Elements(world, 0.5)
    texels = SurfaceReceivers("texels", [0, 1, 2], [0, 1], [0.1, 0.3], [0.2, 0.4])

    def gather(surface, rng):
        light = np.full((len(surface.triangle), 3), 7.0, np.float32)
        # Of one sign at one receiver and of the other at the other: errors do not cancel between receivers.
        differ = np.where(surface.position[:, :1] < surface.position[:, :1].mean(), 1.0, -1.0) * np.ones(3) * (0.5, 0.25, 0.0)
        return light, differ, 5 * len(surface.triangle)

    for low, high, direct, emitted in ((0, 9, 7.0, np.pi / 2), (2, 9, 1.0, 0.0), (0, 0, 1.0, np.pi / 2)):
        answer = ElementAnswer(elements, texels, gather, low, high)
        assert list(answer.prepare())[-1] == 1.0
        parts = answer.parts(np.ones((8, 3)), np.zeros((8, 3)))
        assert np.allclose(parts.direct, direct)
        assert np.allclose(parts.emitted, emitted)
        assert parts.rays == (10 if direct == 7.0 else 0)
        # Sum of the channels: 0.75 of 21.
        assert parts.noise == (pytest.approx(0.75 / 21) if direct == 7.0 else None)
        assert answer.parts(np.ones((8, 3)), np.full((8, 3), 14.0)).noise == (pytest.approx(0.75 / 63) if direct == 7.0 else None)


@pytest.mark.parametrize("scene", [scenes.cornell, lambda: scenes.two_zone_sphere(0)])
def test_smooth_values_do_not_crack_where_large_elements_meet_small_ones(scene):
    elements = refined(scene())
    node, low, high, share = elements.nodes.hanging
    assert len(node) > 20
    values = elements.nodes.values(np.random.default_rng(12).random((2 * elements.count, 1)))
    # Look at both sides of points along edges, a hair apart.
    rng = np.random.default_rng(13)
    index = rng.integers(0, elements.count, 4000)
    edge = elements.position(index, rng.random(4000), np.zeros(4000))
    found = []
    for step in (-1e-4, 1e-4):
        up = elements.normal[index]
        origin = (edge + step * (edge - elements.centroid[index]) + 1e-3 * up).astype(np.float32)
        triangle, u, v, t = elements.world.intersect(origin, np.ascontiguousarray(-up, np.float32), RayKind.CAMERA)
        on = (triangle >= 0) & (t < 2e-3) & (elements.patch_of[triangle] == elements.patch[index])
        element, a, b = elements.cell(np.maximum(triangle, 0), u, v)
        found.append((elements.nodes.at(values, 2 * element, a, b)[:, 0], on))
    both = found[0][1] & found[1][1]
    assert both.sum() > 1000
    assert np.abs(found[0][0] - found[1][0])[both].max() < 1e-3


def test_refined_elements_know_where_they_come_from():
    base = Elements(World(scenes.cornell()), 0.5)
    split = np.arange(base.count) % 2 == 0
    fine = RefinedElements(base, split)
    assert fine.count == base.count + 3 * split.sum()
    assert np.array_equal(np.bincount(fine.root, fine.area, base.count), base.area)
    rng = np.random.default_rng(14)
    points = fine.sample(rng.integers(0, fine.count, 2000), rng)
    assert np.array_equal(fine.root[fine.locate(*points)], base.locate(*points))
    values = rng.random((2 * base.count, 2))
    repeated = values.reshape(-1, 2, 2)[fine.root].reshape(-1, 2)
    assert np.allclose(over_base(fine, base, repeated), values)
    assert np.allclose(smoothed(fine, base, np.ones((2 * fine.count, 1))), 1)


@pytest.mark.parametrize("scene", [scenes.cornell, lambda: scenes.two_zone_sphere(0)])
def test_an_answer_that_goes_over_to_smaller_elements_is_that_of_the_smaller_ones(scene):
    """Whatever light they have, on fronts and on backs, and however often they were cut."""
    rng, base = np.random.default_rng(15), Elements(World(scene()), 0.7)
    facing = base.world.rows[:, 9:12] * np.where(rng.random(base.world.triangle_count) < 0.5, np.float32(-1), np.float32(1))[:, None]
    points = scattered(base.world, 500, seed=16)
    receivers = SurfaceReceivers("texels", points.start, points.triangle, points.u, points.v, facing)
    answer = ElementAnswer(base, receivers)
    for _ in answer.prepare():
        pass
    for _ in range(2):
        base = RefinedElements(base, rng.random(base.count) < 0.4)
        answer.refine(base)
        light = rng.random((2, 2 * base.count, 3))
        moved, anew = answer.parts(*light), answer_at(receivers, base, *light)
        for name in ("direct", "indirect"):
            np.testing.assert_allclose(getattr(moved, name), getattr(anew, name), atol=1e-4, err_msg=name)


def test_contrast_is_high_at_a_step_and_none_where_light_is_even():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    elements = Elements(World(b.build()), 0.125)
    light = np.zeros((2 * elements.count, 3))
    light[0::2] = (elements.centroid[:, :1] > 0).astype(float)
    change = contrast(elements, light)
    near = np.abs(elements.centroid[:, 0]) < 0.1
    assert (change[near] > 0.4).all() and (change[~near] < 1e-6).all()


@pytest.mark.parametrize("polygon", [[0], [0, 0]], ids=["triangle", "square"])
def test_light_that_is_smoothed_over_the_base_keeps_its_slopes(polygon):
    """Triangles that stand upside down in their patch look themselves up as they lie."""
    scene = mesh(SQUARE, [(0, 1, 2), (0, 2, 3)][: len(polygon)], polygon)
    base = Elements(World(scene), 0.1)
    fine = RefinedElements(base, np.ones(base.count, bool))
    found = smoothed(fine, base, np.repeat(fine.centroid[:, :2], 2, axis=0))[::2]
    inner = np.abs(fine.centroid[:, :2] - fine.centroid[:, :2].mean(axis=0)).max(axis=1) < 0.08
    assert inner.sum() >= 8
    np.testing.assert_allclose(found[inner], fine.centroid[inner, :2], atol=1e-4)


def two_quads(second, edge):
    """Elements of a square of side 1 and a rectangle of `second` x 1 beside it."""
    b = SceneBuilder()
    b.quad("Left", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Right", (1, 0, 0), (second, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    return Elements(World(b.build()), edge)


def values_at(elements, x, values):
    """(k,) node values of the fronts at `x`, from `values` (2 count,) of the sides."""
    nodes = elements.nodes
    at = np.abs(nodes.position[:, 0] + elements.world.center[0] - x) < 1e-6
    return nodes.values(values[:, None])[::2, 0][at]


def test_nodes_are_means_by_area():
    elements = two_quads(3.0, 5.0)
    assert elements.count == 2
    values = np.repeat(np.where(elements.area > 2, 5.0, 1.0), 2)
    np.testing.assert_allclose(values_at(elements, 1.0, values), (1 * 1 + 5 * 3) / 4, rtol=1e-6)


def test_nodes_of_refined_elements_follow_the_smaller_ones():
    """Weights fall with an element's width: a corner between a square and a quarter of one is two thirds of the quarter's."""
    elements = two_quads(1.0, 5.0)
    middle = elements.position(np.arange(2), np.full(2, 0.5), np.full(2, 0.5))[:, 0] + elements.world.center[0]
    fine = RefinedElements(elements, middle > 1)
    values = np.repeat((fine.area < 0.5).astype(float), 2)
    found = values_at(fine, 1.0, values)
    # The two ends of the edge, and its middle, which hangs in the longer edge.
    np.testing.assert_allclose(found, 2 / 3, rtol=1e-6)


def test_the_longest_edge_is_the_longest():
    elements = two_quads(3.0, 5.0)
    np.testing.assert_allclose(np.sort(longest_edge(elements)), [1, 3], rtol=1e-6)


def test_the_mesh_of_the_elements_has_the_values_of_their_fronts():
    elements = two_quads(2.0, 0.4)
    mesh = element_mesh(elements, np.tile([[1.0], [2.0]], (elements.count, 1)))
    assert (mesh.values == 1).all()


def test_receivers_of_element_corners_lie_a_tenth_of_the_way_to_the_middle():
    for scene in (scenes.cube(), scenes.two_zone_sphere(0)):
        elements = Elements(World(scene), 0.6)
        nodes = ElementNodes(elements, range(len(scene.objects)))
        element, _, _ = elements.cell(nodes.triangle, nodes.u, nodes.v)
        at = elements.world.surface(nodes.triangle, nodes.u, nodes.v).position + elements.world.center
        corner = nodes.vertices[np.repeat(np.arange(nodes.count), np.diff(nodes.start))]
        middle = elements.centroid[element] + elements.world.center
        np.testing.assert_allclose(at, corner + INSET * (middle - corner), atol=1e-5)


@pytest.mark.parametrize("second, count", [("Grey", 6), ("Other", 8)])
def test_elements_share_corners_within_a_material(second, count):
    place = np.array([(x, y, 0) for y in range(2) for x in range(3)], float)
    b = SceneBuilder()
    materials = [diffuse("Grey", 0.5), diffuse("Other", 0.2)]
    triangles = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)])
    which = np.array([0, 0, 1, 1]) * (second == "Other")
    b.mesh("Strip", place, triangles, materials, polygon=np.array([0, 0, 1, 1]), which=which)
    assert ElementNodes(Elements(World(b.build()), 10.0), [0]).count == count
