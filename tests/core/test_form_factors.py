"""Closed-form factors against the table of the verification page (2.1, 2.2) and against each other."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.radiosity.aligned import exact_pairs
from adjgi.adjoint_gi.core.radiosity.form_factors import parallel_exchange, perpendicular_exchange
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import closed_forms, scenes


def near(value, tolerance=1e-13):
    return pytest.approx(value, rel=tolerance, abs=0)


def spans(*pairs):
    """Ranges (1, 2) for the exchange functions."""
    return [np.array([p], float) for p in pairs]


@pytest.mark.parametrize(
    ("a", "b", "c", "factor"),
    [
        (1, 1, 1, 0.19982489569838746),
        (1, 1, 0.5, 0.41525328357714675),
        (1, 1, 2, 0.0685895888185526),
        (1, 1, 5, 0.01240397731324307),
        (1, 1, 10, 0.0031620568387544677),
        (2, 1, 1, 0.2858753848507147),
    ],
)
def test_parallel(a, b, c, factor):
    assert closed_forms.parallel_rectangles(a, b, c) == near(factor, 1e-12)
    x, y = spans((0, a), (0, b))
    assert parallel_exchange(x, y, x, y, np.array([float(c)]))[0] / (a * b) == near(factor, 1e-11)


@pytest.mark.parametrize(
    ("w", "length", "h", "factor"),
    [(1, 1, 1, 0.20004377607540316), (1, 1, 2, 0.2328526027953619), (2, 1, 1, 0.11642630139768095), (1, 2, 1, 0.24063600617696168)],
)
def test_perpendicular(w, length, h, factor):
    assert closed_forms.adjacent_rectangles(w, length, h) == near(factor)
    x, y, xi = spans((0, w), (0, length), (0, h))
    assert perpendicular_exchange(x, y, xi, y)[0] / (w * length) == near(factor)


def test_general_positions():
    unit, gap, beside = spans((0, 1), (0.5, 1.5), (1, 2))
    assert perpendicular_exchange(unit, unit, gap, unit)[0] == near(0.07613664042267773)
    offset = parallel_exchange(unit, unit, beside, unit, np.ones(1))[0]
    assert offset == near(0.08605048915232733)
    # T11: one square sees the square ahead and its mirror image.
    assert offset + closed_forms.parallel_rectangles(1, 1, 1) == near(0.2858753848507147)


def test_strips():
    assert closed_forms.parallel_rectangles(1000, 1, 1) == near(0.413934, 2e-6)
    assert closed_forms.adjacent_rectangles(1, 1000, 1) == near(0.292783, 2e-6)


def test_room_by_formulas():
    floor_ceiling = closed_forms.parallel_rectangles(4, 4, 3)
    floor_wall = closed_forms.adjacent_rectangles(4, 4, 3)
    wall_floor, wall_wall = closed_forms.adjacent_rectangles(3, 4, 4), closed_forms.adjacent_rectangles(4, 3, 4)
    across = closed_forms.parallel_rectangles(4, 3, 4)
    assert floor_ceiling == near(0.2827327873974698)
    assert floor_wall == near(0.17931680315063253)
    assert wall_floor == near(0.23908907086751005)
    assert across == near(0.1628242326414444)
    assert wall_wall == near(0.17949881281176777)
    assert floor_ceiling + 4 * floor_wall == near(1.0)
    assert 2 * wall_floor + across + 2 * wall_wall == near(1.0)
    assert 16 * floor_wall == near(12 * wall_floor)


def test_disks():
    assert closed_forms.disks(1, 1, 1) == near((3 - 5**0.5) / 2)
    assert closed_forms.disks(1, 2, 1) == near(0.7639320225002102)
    assert closed_forms.disks(2, 1, 1) == near(0.19098300562505255)
    assert closed_forms.disks(0.5, 0.5, 1) == near(0.1715728752538097)


def square(z=1.0, low=0.0):
    return np.array([[[low, low, z], [1, low, z], [1, 1, z], [low, 1, z]]], float)


UP, ALONG, ORIGIN = np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0]]), np.zeros((1, 3))


def test_points_see_polygons():
    assert closed_forms.point_to_polygon(ORIGIN, UP, square())[0] == near(0.13853160599489298)
    assert closed_forms.point_to_polygon(np.array([[0.5, 0.5, 0]]), UP, square())[0] == near(0.23945647046077354)
    assert closed_forms.point_to_polygon(ORIGIN, ALONG, square())[0] == near(0.05573419700255351)
    assert closed_forms.point_to_polygon(ORIGIN, -UP, square())[0] == 0
    # A disk on the axis, as a polygon of 2,000 corners: r^2 / (r^2 + h^2).
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    disk = np.stack([np.cos(angle), np.sin(angle), np.full(2000, 2.0)], axis=1)[None]
    assert closed_forms.point_to_polygon(ORIGIN, UP, disk)[0] == near(0.2, 5e-6)


def test_what_lies_below_the_horizon_does_not_count():
    rng = np.random.default_rng(1)
    for _ in range(20):
        corner, a, b = rng.normal(size=(3, 3))
        corner[2] = 0.0
        a[2] = 0.0
        half = np.array([[corner, corner + a, corner + a + b, corner + b]])
        whole = np.array([[corner - 2 * b, corner + a - 2 * b, corner + a + b, corner + b]])
        sign = UP * np.sign(b[2])
        assert closed_forms.point_to_polygon(ORIGIN, sign, whole)[0] == near(closed_forms.point_to_polygon(ORIGIN, sign, half)[0], 1e-9)


def test_area_integrals_and_triangle_halves():
    assert closed_forms.polygon_to_polygon(square(0.0), UP, square(), 8)[0] == near(0.19982489569838746, 1e-10)
    halves = np.array([[(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 0)], [(0, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 0)]], float)
    to = np.repeat(square(), 2, axis=0)
    parts = closed_forms.polygon_to_polygon(halves, np.repeat(UP, 2, axis=0), to, 8)
    assert parts.mean() == near(0.19982489569838746, 1e-9)
    # Halves of the target add up to the target.
    targets = halves + [0, 0, 1]
    split = closed_forms.polygon_to_polygon(np.repeat(square(0.0), 2, axis=0), np.repeat(UP, 2, axis=0), targets, 8)
    assert split.sum() == near(0.19982489569838746, 1e-10)


def test_sphere_parts_close():
    area = np.array([1.0, 2.0, 4 * np.pi * 9 - 3])
    f = closed_forms.sphere_parts(area, 3.0)
    assert np.allclose(f.sum(axis=1), 1, atol=1e-15)


def pairs_of(scene, edge=10.0):
    elements = Elements(World(scene), edge)
    sides = np.arange(2 * elements.count)
    found = {}
    for piece in exact_pairs(elements, sides):
        found |= {(int(i), int(j)): x for i, j, x in zip(piece.i, piece.j, piece.exchange, strict=True)}
    return found


def test_aligned_pairs_of_a_real_mesh():
    found = pairs_of(scenes.room())
    # Six walls see each other with their fronts only: 15 pairs.
    assert len(found) == 15
    assert all(i % 2 == 0 and j % 2 == 0 for i, j in found)
    assert found[8, 10] == near(16 * 0.2827327873974698)
    assert found[0, 8] == near(2.86906885041012, 1e-9)


def two(second):
    b = SceneBuilder()
    grey = diffuse("Grey", 0.5)
    b.quad("A", (0, 0, 0), (1, 0, 0), (0, 1, 0), grey)
    b.quad("B", *second, grey)
    return b


def test_turned_together_they_keep_their_factor_turned_apart_they_have_none():
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    b = SceneBuilder()
    grey = diffuse("Grey", 0.5)
    b.quad("A", (0, 0, 0), turn[0], turn[1], grey)
    up = np.cross(turn[0], turn[1])
    b.quad("B", up, turn[1], turn[0], grey)
    assert pairs_of(b.build())[0, 2] == near(0.19982489569838746, 1e-10)
    assert pairs_of(two(((0, 0, 1), (0.6, 0.8, 0), (0.8, -0.6, 0))).build()) == {}


def test_only_the_part_in_front_counts():
    # A wall that stands half below the floor: the floor's front sees the upper half, its back the lower.
    found = pairs_of(two(((0, 0, -1), (0, 1, 0), (0, 0, 2))).build())
    assert found[0, 2] == near(0.20004377607540316, 1e-12)
    assert found[1, 2] == near(0.20004377607540316, 1e-12)


def test_what_is_hidden_has_no_closed_form():
    b = two(((0, 0, 1), (0, 1, 0), (1, 0, 0)))
    b.quad("Between", (0.25, 0.25, 0.5), (0.5, 0, 0), (0, 0.5, 0), diffuse("Black", 0.0))
    found = pairs_of(b.build())
    assert (0, 2) not in found
    # Each of the two does see the plate between them.
    assert (0, 5) in found
    assert (2, 4) in found
