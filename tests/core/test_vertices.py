"""Receivers of vertices and corners: shared where smooth, apart where hard, weighted by angle."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.vertices import INSET, vertex_receivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.scenes import icosphere

WHITE = diffuse("White", 0.5)
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def world_of(*meshes) -> World:
    b = SceneBuilder()
    for k, (vertices, triangles, normals) in enumerate(meshes):
        b.mesh(f"Mesh{k}", vertices, triangles, WHITE, smooth_normals=normals)
    return World(b.build())


def test_hard_cube_has_one_receiver_for_each_vertex_and_side():
    world = world_of((CUBE, TRIANGLES, None))
    m = vertex_receivers(world, [0], "CORNER")
    assert m.receivers.count == 24
    # All points of a receiver lie on one side of the cube.
    normal = world.surface(m.receivers.triangle, m.receivers.u, m.receivers.v).ng
    for i in range(24):
        some = normal[m.receivers.start[i] : m.receivers.start[i + 1]]
        assert np.allclose(some, some[0])
    # Corners of the two triangles of one quad at the same vertex share the receiver.
    corner = m.index[0].reshape(12, 3)
    assert corner[0, 0] == corner[1, 0] and corner[0, 2] == corner[1, 1]


def test_smooth_cube_shares_corners_and_points_have_one_receiver_a_vertex():
    smooth = world_of((CUBE, TRIANGLES, CUBE * 2 - 1))
    corner = vertex_receivers(smooth, [0], "CORNER")
    assert corner.receivers.count == 8
    assert np.array_equal(corner.index[0], corner.index[0][0] + corner.index[0] - corner.index[0][0])
    point = vertex_receivers(world_of((CUBE, TRIANGLES, None)), [0], "POINT")
    assert point.receivers.count == 8 and np.array_equal(point.index[0], np.arange(8))


def test_point_on_a_hard_edge_averages_its_sides_by_angle():
    """Each vertex of a cube has 90 degrees on each of three sides, however the sides are triangulated."""
    world = world_of((CUBE, TRIANGLES, None))
    m = vertex_receivers(world, [0], "POINT")
    normal = world.surface(m.receivers.triangle, m.receivers.u, m.receivers.v).ng
    for i in range(8):
        some = np.abs(normal[m.receivers.start[i] : m.receivers.start[i + 1]])
        assert np.allclose(some.mean(axis=0), 1 / 3)


def test_points_lie_inside_their_faces_and_near_their_vertex():
    vertices, triangles = icosphere(2)
    world = world_of((vertices, triangles, vertices))
    m = vertex_receivers(world, [0], "POINT")
    r = m.receivers
    assert r.u.min() > 0 and r.v.min() > 0 and (r.u + r.v).max() < 1
    where = world.surface(r.triangle, r.u, r.v).position + world.center
    vertex_of = np.empty(r.count, int)
    vertex_of[m.index[0]] = np.arange(len(vertices))
    far = np.linalg.norm(where - vertices[vertex_of[np.repeat(np.arange(r.count), np.diff(r.start))]], axis=1)
    edge = np.linalg.norm(vertices[triangles[:, 0]] - vertices[triangles[:, 1]], axis=1).max()
    assert far.max() <= INSET * edge and far.min() > 0.2 * INSET * edge
    # A linear function of the position comes out as its value at the vertex, up to the inset and the symmetry of the arcs.
    mean = np.add.reduceat(where, r.start[:-1]) / np.diff(r.start)[:, None]
    assert np.abs(mean - vertices[vertex_of]).max() < INSET * edge * 0.5


def test_needle_and_obtuse_triangles_keep_their_points_inside():
    v = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0], [0, 1, 0], [1e-4, 2, 0]], float)
    world = world_of((v, np.array([[0, 1, 2], [0, 3, 4]]), None))
    for domain in ("POINT", "CORNER"):
        r = vertex_receivers(world, [0], domain).receivers
        assert np.isfinite(r.u).all() and r.u.min() >= 0 and r.v.min() >= 0 and (r.u + r.v).max() <= 1


def test_spread_gives_every_vertex_its_value_and_loose_ones_the_fill():
    vertices = np.concatenate([CUBE, [[9, 9, 9]]])
    world = world_of((CUBE, TRIANGLES, None), (vertices, TRIANGLES, None))
    m = vertex_receivers(world, [0, 1], "POINT")
    assert m.receivers.count == 16
    values = np.arange(16.0)[:, None]
    assert np.array_equal(m.spread(0, values)[:, 0], np.arange(8))
    assert np.array_equal(m.spread(1, values, fill=-1)[:, 0], [*range(8, 16), -1])
    assert list(m.covered(1)) == [True] * 8 + [False]


def test_rounding_of_normals_does_not_split_a_smooth_surface():
    vertices, triangles = icosphere(3)
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles, WHITE, smooth_normals=vertices)
    scene = b.build()
    noise = np.random.default_rng(0).normal(0, 1e-7, scene.corner_normals.shape)
    scene.corner_normals[:] += noise.astype(np.float32)
    assert vertex_receivers(World(scene), [0], "CORNER").receivers.count == len(vertices)


def test_wrong_domain_is_refused():
    with pytest.raises(TargetError, match="POINT or CORNER"):
        vertex_receivers(world_of((CUBE, TRIANGLES, None)), [0], "FACE")


def test_points_of_uneven_triangles_lie_on_arcs_about_the_corner():
    """At INSET times the height above the opposite edge, one in the middle of each equal part of the angle."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (0.4, 3, 0)], float)
    world = world_of((corners, np.array([[0, 1, 2]]), None))
    m = vertex_receivers(world, [0], "POINT")
    r = m.receivers
    where = world.surface(r.triangle, r.u, r.v).position + world.center
    for i in range(3):
        some = where[r.start[m.index[0][i]] : r.start[m.index[0][i] + 1]] - corners[i]
        to1, to2 = corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i]
        height = np.linalg.norm(np.cross(to1, to2)) / np.linalg.norm(to2 - to1)
        np.testing.assert_allclose(np.linalg.norm(some, axis=1), INSET * height, rtol=1e-4)
        length = [np.linalg.norm(x) for x in (to1, to2)]
        whole = np.arccos(to1 @ to2 / (length[0] * length[1]))
        turn = np.arccos(some @ to1 / (np.linalg.norm(some, axis=1) * length[0]))
        np.testing.assert_allclose(turn, whole * (np.arange(len(some)) + 0.5) / len(some), atol=2e-3)
