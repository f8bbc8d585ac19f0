"""Spheres around what lies together: that they hold everything, leave out what is empty, and change nothing in the mean of what is shot."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.sampling import maps
from adjgi.adjoint_gi.core.scene.arrays import Light, RayKind
from adjgi.adjoint_gi.core.scene.clusters import MOST, clusters
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes

# Standard deviations that a sound generator exceeds once in a thousand runs of the about 300 comparisons here (Sidak).
Z = 4.7
BLACK = diffuse("Black", 0.0)
WHITE = (1.0, 1.0, 1.0)


def boxes(*places, size=1.0, builder=None):
    """Cubes of side `size` with these low corners."""
    b = builder or SceneBuilder()
    for k, place in enumerate(places):
        b.box(f"Box {k}", place, tuple(np.add(place, size)), BLACK, inward=False)
    return b


def road():
    """A room beside a road of one face, 2 km by 4 m, that runs askew."""
    b = boxes((0, 0, 0), size=4.0)
    b.quad("Road", (-1000, -300, -1), (2000, 600, 0), (-1.2, 3.8, 0), BLACK)
    return b


def field(count=300):
    """Boxes that lie about, all of them far apart."""
    return boxes(*map(tuple, np.random.default_rng(2).uniform(-500, 500, (count, 3))))


def one_mesh():
    """Two squares 5 km apart in one object."""
    v = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    b = SceneBuilder()
    b.mesh("Both", np.concatenate([v, v + (5000, 0, 0)]), np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]), BLACK)
    return b


ROW = [(20.0 * k, 0, 0) for k in range(12)]
# Scene, and the least and the most spheres it may take.
SCENES = {
    "box": (boxes((0, 0, 0)), 1, 1),
    "sheet": (scenes.cornell_builder(), 1, 1),
    "two near boxes": (boxes((0, 0, 0), (1.5, 0, 0)), 1, 1),
    "two far boxes": (boxes((0, 0, 0), (2000, 900, 0)), 2, 2),
    "very far boxes": (boxes((0, 0, 0), (2e6, 0, 0)), 2, 2),
    "three": (boxes((0, 0, 0), (300, 0, 0), (0, 20_000, 0)), 3, 3),
    "row": (boxes(*ROW), 12, 24),
    "road": (road(), 16, MOST),
    "field": (field(), 1, MOST),
    "one mesh": (one_mesh(), 2, 2),
}


@pytest.mark.parametrize("name", SCENES)
def test_spheres_hold_everything_and_are_few(name):
    scene, least, most = SCENES[name]
    world = World(scene.build())
    found = clusters(world)
    assert least <= len(found.radius) <= most
    rng, n = np.random.default_rng(0), 4000
    which = rng.integers(0, world.triangle_count, n)
    at = world.surface(which, *(x.astype(np.float32) for x in maps.triangle(*rng.random((2, n))))).position.astype(float)
    apart = np.linalg.norm(at[:, None] - found.center, axis=2) - found.radius
    assert apart.min(axis=1).max() < 0


def test_what_is_empty_is_left_out():
    """The area of all spheres is about that of the boxes', however far apart they are, and a road's is cut."""
    box = math.pi * 0.75
    for name, count in (("two far boxes", 2), ("three", 3), ("row", 12)):
        area = clusters(World(SCENES[name][0].build())).area
        assert area == pytest.approx(count * box, rel=0.05)
    assert clusters(World(SCENES["one mesh"][0].build())).area == pytest.approx(2 * math.pi / 2, rel=0.01)
    assert clusters(World(road().build())).area < 0.05 * math.pi * 1044**2


def test_a_scene_without_surfaces_has_a_sphere():
    found = clusters(World(SceneBuilder().build()))
    assert found.center.tolist() == [[0, 0, 0]] and found.radius.tolist() == [1]


@pytest.mark.parametrize("name", SCENES)
def test_rays_start_before_all_that_they_can_meet_and_know_how_many_spheres(name):
    world = World(SCENES[name][0].build())
    found, rng, n = clusters(world), np.random.default_rng(1), 3000
    own = rng.integers(0, len(found.radius), n)
    # Half of the rays go along the line between two spheres, where one may stand before the other.
    direction = maps.sphere(*rng.random((2, n))).T.astype(float)
    other = found.center[rng.integers(0, len(found.radius), n)] - found.center[own]
    length = np.linalg.norm(other, axis=1)
    direction = np.where(((np.arange(n) % 2 == 0) & (length > 0))[:, None], other / np.maximum(length, 1e-9)[:, None], direction)
    x, y = maps.frame_rows(direction)
    a, b = maps.disk(*rng.random((2, n)))
    at = found.center[own] + found.radius[own, None] * (a[:, None] * x + b[:, None] * y)
    origin, many = found.before(at, direction, own)
    to = found.center - at[:, None]
    along = np.einsum("ijk,ik->ij", to, direction)
    apart = np.linalg.norm(to - along[..., None] * direction[:, None], axis=2)
    clear = np.abs(apart - found.radius).min(axis=1) > 1e-6 * found.radius.max()
    inside = apart < found.radius
    assert clear.mean() > 0.9 and (many[clear] == inside.sum(axis=1)[clear]).all() and many.min() >= 1
    # On the same line, as far ahead as the farthest of these spheres begins and no farther.
    start = np.einsum("ij,ij->i", origin - at, direction)
    np.testing.assert_allclose(origin, at + start[:, None] * direction, atol=1e-6 * max(1.0, np.abs(at).max()))
    first = np.where(inside, along - found.radius, np.inf).min(axis=1)
    np.testing.assert_allclose(start[clear], first[clear], rtol=1e-6, atol=1e-6 * found.radius.max())


def lit(b, light):
    b.light(light)
    return World(b.build())


def sun(towards, angle=0.0):
    z = np.asarray(towards, float) / np.linalg.norm(towards)
    x = np.cross(z, (0.0, 0.0, 1.0) if abs(z[2]) < 0.9 else (1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    return Light("Sun", "sun", WHITE, axis_x=tuple(x), axis_y=tuple(np.cross(z, x)), axis_z=tuple(z), angle=angle)


def landed(world, batches=48, many=8192, seed=3):
    """Mean and standard error of the power (first colour) that lands on each triangle."""
    emission, rng = Emission(world), np.random.default_rng(seed)
    power = np.zeros((batches, world.triangle_count))
    for row in power:
        p = emission.draw(many, rng)
        triangle = world.intersect(p.origin, p.direction, p.kind)[0]
        met = triangle >= 0
        row += np.bincount(triangle[met], p.weight[met, 0], world.triangle_count)
    return power.mean(axis=0), power.std(axis=0, ddof=1) / math.sqrt(batches)


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_a_sun_lights_boxes_by_the_cosine_wherever_they_stand(angle):
    """The sun stands where no box throws a shadow on another."""
    towards = np.array([0.2, 0.6, 0.8]) / math.sqrt(1.04)
    world = lit(boxes((0, 0, 0), (300, 0, 0), (2000, 0, 0), (40_000, 0, 0)), sun(towards, angle))
    assert len(clusters(world).radius) == 4
    mean, error = landed(world)
    expected = np.maximum(world.rows[:, 9:12] @ towards, 0) * 0.5
    shown = expected > 0
    assert error[shown].max() < 0.02 and (mean[~shown] == 0).all()
    assert (np.abs(mean - expected) < Z * error + 2e-3 * expected)[shown].all()


def test_a_sky_lights_boxes_wherever_they_stand():
    b = boxes((0, 0, 0), (300, 0, 0), (2000, 0, 0), (40_000, 0, 0))
    b.background = WHITE
    mean, error = landed(World(b.build()))
    assert error.max() < 0.02 * math.pi
    assert (np.abs(mean - math.pi / 2) < Z * error + 2e-3).all()  # the others hide next to nothing of the sky


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.2, 1.9], ids="{:.1f}".format)
def test_where_spheres_lie_before_each_other_nothing_counts_twice(shift):
    """Squares one behind the other along the sun, each moved aside: what is not in the shadow of those before is lit, each place alike."""
    b = SceneBuilder()
    for k in range(4):
        b.quad(f"Square {k}", (shift * k, 0, -50.0 * k), (1, 0, 0), (0, 1, 0), BLACK)
    world = lit(b, sun((0, 0, 1)))
    assert len(clusters(world).radius) == 4
    emission, rng, rows = Emission(world), np.random.default_rng(5), []
    for _ in range(64):
        p = emission.draw(8192, rng)
        triangle = world.intersect(p.origin, p.direction, p.kind)[0]
        met = triangle >= 0
        # Eight strips of each square.
        x = p.origin[met, 0] + world.center[0] - shift * (triangle[met] // 2)
        rows.append(np.bincount(triangle[met] // 2 * 8 + np.clip((x * 8).astype(int), 0, 7), p.weight[met, 0], 32))
    mean, error = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / 8
    edges = np.arange(9) / 8
    seen = np.diff(np.maximum(edges, 1 - shift)) if shift < 1 else np.full(8, 1 / 8)
    expected = np.concatenate([np.full(8, 1 / 8), seen, seen, seen])
    assert error.max() < 0.02 / 8 * 2
    assert (np.abs(mean - expected) < Z * error + 1e-4 / 8).all()
    # Which is Pearson's chi-square over strips that do not depend on each other.
    chi = (((mean - expected) / np.maximum(error, 1e-9)) ** 2)[expected > 0].sum()
    freedom = (expected > 0).sum()
    assert chi < freedom + Z * math.sqrt(2 * freedom) + Z**2


def test_what_enters_the_spheres_is_what_is_drawn():
    """In the mean the weights are the power through all that the spheres cover, each place once: of three that stand in a row along the sun
    that through one."""
    world = lit(boxes((0, 0, 0), (0, 0, -90), (0, 0, -4000)), sun((0, 0, 1)))
    p = Emission(world).draw(4096, np.random.default_rng(0))
    assert len(clusters(world).radius) == 3
    assert p.weight[:, 0].sum(dtype=float) == pytest.approx(clusters(world).areas.max(), rel=0.005)
    assert (p.origin[:, 2] + world.center[2] > 1).mean() > 0.9  # they begin above the uppermost, but where only lower ones are
    assert (world.intersect(p.origin, p.direction, RayKind.SHADOW)[0] < 12).all()


def test_many_objects_are_divided_in_little_time():
    """Ten thousand objects and a hundred thousand triangles: no more comparisons than spheres."""
    world = World(field(8000).build())
    start = time.process_time()
    assert len(clusters.__wrapped__(world).radius) <= MOST
    assert time.process_time() - start < 2
