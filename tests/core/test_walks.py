"""The walks that gather and that shoot: strategies agree, what paths carry stays with them, and emission is shared out once."""

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.flux.detectors import CameraDetector
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import direct
from adjgi.adjoint_gi.core.lights.direct import INF, LEAST
from adjgi.adjoint_gi.core.lights.emission import Emission, Particles
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.sampling.maps import PI, columns
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, RayKind
from adjgi.adjoint_gi.core.scene.faces import Faces
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.diffuse_paths import STRATIFIED, VERTEX, DiffuseVertices, Numbers
from adjgi.adjoint_gi.core.walks.particles import walk as particle_walk
from adjgi.adjoint_gi.core.walks.paths import Gathered, Paths, Walk, by_root, by_weight, follow
from adjgi.adjoint_gi.core.walks.radiance import start
from adjgi.adjoint_gi.core.walks.shooting import Departed, Flight, shoot
from adjgi.tests import scenes
from adjgi.tests.surface_points import receivers_at

N = 40_000
Z = 4.3


def floor_of_cornell():
    """World and N points on its floor."""
    world = World(scenes.cornell())
    points = receivers_at(world, [(0.2, 0.3, 0), (0.8, 0.8, 0), (0.5, 0.1, 0)])
    pick = np.arange(N) % 3
    return world, world.surface(points.triangle[pick], points.u[pick], points.v[pick])


def mean_and_error(found):
    values = (found.direct + found.indirect).astype(float)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


@pytest.mark.parametrize("survival", [by_weight, by_root])
def test_diffuse_vertices_and_those_with_lobes_find_the_same(survival):
    world, surface = floor_of_cornell()
    walk = Walk(world, Emitters(world), BsdfTable(world.scene), max_length=6, survival=survival)
    vertices, factor = start(walk, surface, None)
    general = follow(Paths(walk, vertices, np.random.default_rng(1))).times(factor)
    rng = np.random.default_rng(2)
    numbers = Numbers(rng.random((sum(VERTEX) * STRATIFIED, N), np.float32))
    ng, weight = columns(surface.ng), np.full((3, N), PI)
    plain = DiffuseVertices(walk, columns(world.leave(surface)), ng, ng, numbers.at(np.arange(N), rng), numbers)
    fast = follow(Paths(walk, plain, rng, weight=weight, unit=1 / PI))
    (a, da), (b, db) = mean_and_error(general), mean_and_error(fast)
    assert (np.hypot(da, db) < 0.02 * a).all()
    assert (np.abs(a - b) < Z * np.hypot(da, db)).all()


def test_what_paths_carry_stays_with_them():
    """Each path carries its own number; after every step it is still that of its row."""
    world, surface = floor_of_cornell()
    walk = Walk(world, Emitters(world), BsdfTable(world.scene), max_length=8, roulette_from=1)
    paths = Paths(walk, start(walk, surface, None)[0], np.random.default_rng(3))
    paths.carried = {"number": np.arange(N)}
    lengths = []
    while paths.alive and paths.step():
        assert (paths.carried["number"] == paths.row).all()
        assert paths.weight.shape == (3, len(paths.row)) and (not len(paths.row) or paths.vertices.count == len(paths.row))
        lengths.append(len(paths.row))
    assert 2 < len(lengths) <= 8 and (np.diff(lengths) <= 0).all()


def test_the_same_weight_for_all_scales_everything():
    world, surface = floor_of_cornell()
    walk = Walk(world, Emitters(world), BsdfTable(world.scene), max_length=3)
    one, half = (follow(Paths(walk, start(walk, surface, None)[0], np.random.default_rng(4), weight=np.float32(w))) for w in (1.0, 0.5))
    assert (half.direct == one.direct / 2).all() and (half.indirect == one.indirect / 2).all()


def test_emission_met_is_shared_with_light_points_by_the_density_of_the_rays():
    """INF takes everything, LEAST leaves it to light points, and what lies between takes the share of the power heuristic."""
    b = scenes.cornell_builder()
    b.light(Light("Ball", "point", (1.0, 1.0, 1.0), position=(0.5, 0.5, 0.5), radius=0.2))
    b.background = (0.3, 0.2, 0.1)
    world = World(b.build())
    emitters, faces = Emitters(world), Faces(world)
    rng = np.random.default_rng(5)
    w = rng.normal(size=(3, 20_000)).astype(np.float32)
    w /= np.sqrt((w * w).sum(axis=0))
    origin = np.repeat(np.float32([[0.0], [-0.3], [0.45]]), w.shape[1], axis=1)
    hit = world.intersect(origin.T, w.T, RayKind.DIFFUSE)

    def met(pdf):
        out = np.zeros_like(w)
        for rows, value in direct.from_hits(emitters, faces, origin, w, hit, np.full(w.shape[1], pdf, np.float32)):
            out[:, rows] += value
        return out

    full, none, some = met(INF), met(LEAST), met(0.5)
    escaped = hit[0] < 0
    assert np.allclose(none[:, ~escaped], 0) and np.allclose(none[:, escaped].T, (0.3, 0.2, 0.1))
    assert (some <= full * (1 + 1e-6)).all() and ((some > 0) & (some < full))[:, ~escaped].any()
    own = world.shading.emission(*(a[~escaped] for a in hit[:3])).T + 0
    assert (full[:, ~escaped] >= own - 1e-6).all() and (full[:, ~escaped] > own + 1e-3).any(), "the ball is not seen before the walls"


def test_a_walk_that_shoots_keeps_rows_and_ends_where_told():
    """Mirrors on all walls: nothing escapes a closed box, each row flies every segment, and weights are what the strategy says."""
    world = World(scenes.cube())
    n, most = 500, 5
    rng = np.random.default_rng(6)
    direction = rng.normal(size=(n, 3))
    direction = (direction / np.linalg.norm(direction, axis=1)[:, None]).astype(np.float32)
    flight = Flight(np.zeros((n, 3), np.float32), direction, RayKind.DIFFUSE, np.ones((n, 3), np.float32))

    def reflect(at, rng):
        keep = np.arange(len(at.weight))[::2] if at.segments == 2 else np.arange(len(at.weight))
        normal, d = at.surface.ng[keep], at.direction[keep]
        d = d - 2 * (d * normal).sum(axis=1)[:, None] * normal
        origin = world.leave(at.surface.take(keep))
        return Departed(keep, Flight(origin, d, RayKind.GLOSSY, at.weight[keep] / 2))

    rows = []
    for segment in shoot(world, flight, most, reflect, rng):
        assert not len(segment.away) and segment.rays == len(segment.row)
        assert np.allclose(segment.arrived.weight, 0.5 ** (segment.arrived.segments - 1))
        assert (np.einsum("ij,ij->i", segment.arrived.surface.ng, segment.arrived.direction) < 0).all()
        rows.append(segment.row)
    assert len(rows) == most
    assert (rows[1] == np.arange(n)).all() and all((r == np.arange(n)[::2]).all() for r in rows[2:])


def test_what_is_met_too_near_or_too_far_on_the_first_segment_escapes():
    world = World(scenes.cube())
    origin, direction = np.zeros((3, 3), np.float32), np.repeat(np.float32([[0, 0, 1]]), 3, axis=0)
    flight = Flight(origin, direction, RayKind.SHADOW, np.ones((3, 3), np.float32))
    none = np.zeros(0, np.int64)

    def absorb(at, rng):
        return Departed(none, Flight(origin[none], direction[none], RayKind.DIFFUSE, flight.weight[none]))

    dark, reach = np.float32([0, 0.6, 0]), np.float32([2, 2, 0.4])
    (segment,) = shoot(world, flight, 3, absorb, np.random.default_rng(0), dark, reach)
    assert segment.row.tolist() == [0] and segment.away.tolist() == [1, 2] and segment.lost.shape == (2, 3)


def test_what_bent_normals_add_is_in_the_balance():
    """Inside a coarse smooth ball: what was emitted and what shading normals have added is absorbed, cut or escapes."""
    vertices, triangles = scenes.icosphere(1)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles[:, ::-1], diffuse("Grey", 0.7), smooth_normals=-vertices)
    b.light(Light("Lamp", "point", (1.0, 2.0, 3.0), (0.5, 0.3, 0.1)))
    world, rng = World(b.build()), np.random.default_rng(3)
    ends = particle_walk(world, Emission(world).draw(4000, rng), 6, rng, lambda hits: None)
    assert abs(ends.gained) > 1e-3 * ends.emitted_energy and ends.cut_energy > 0
    accounted = ends.absorbed_energy + ends.escaped_energy + ends.cut_energy
    assert ends.emitted_energy + ends.gained == pytest.approx(accounted, rel=1e-5)


def bent_sheet(material, lean):
    """A flat sheet about the origin whose shading normals lean by an angle towards +x."""
    b = SceneBuilder()
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    normal = (math.sin(lean), 0, math.cos(lean))
    b.mesh("Sheet", corners, [[0, 1, 2], [0, 2, 3]], material, smooth_normals=np.tile(normal, (4, 1)))
    return World(b.build())


@pytest.mark.parametrize("lobe", ["diffuse", "glossy"])
def test_white_surfaces_with_bent_normals_absorb_nothing(lobe):
    """Light at 40 degrees is measured, and leaves a mirror at 20, by other cosines than it has: what they add is `gained`, all of it."""
    world = bent_sheet(Material("White", (Lobe(lobe, Color.of(1.0), 0.0),)), math.radians(10))
    n, angle = 1000, math.radians(40)
    way = np.tile(np.float32([-math.sin(angle), 0, -math.cos(angle)]), (n, 1))
    start = Particles(-way, way, np.ones((n, 3), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32))
    table = None if lobe == "diffuse" else BsdfTable(world.scene)
    ends = particle_walk(world, start, 5, np.random.default_rng(1), lambda hits: None, table)
    # Of a mirror: the cosine of the reflected direction over that of the arriving one. The diffuse lobe leaves as a flat one does.
    cosine = math.cos(math.radians(20 if lobe == "glossy" else 30)) / math.cos(angle)
    assert ends.gained == pytest.approx(3 * n * (cosine - 1), rel=1e-4)
    assert ends.absorbed_energy == pytest.approx(0, abs=1e-3 * n) and ends.escaped == n


@pytest.mark.parametrize("table", [False, True])
def test_importance_leaves_bent_normals_only_above_the_surface(table):
    """As on a path of radiance: what would go below a sheet is lost, and does not meet it again."""
    world, lengths, n = bent_sheet(diffuse("White", 1.0), math.radians(45)), [], 2000
    way = np.tile(np.float32([0, 0, -1]), (n, 1))
    start = Particles(-way, way, np.ones((n, 3), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32))
    lobes = BsdfTable(world.scene) if table else None
    ends = particle_walk(world, start, 5, np.random.default_rng(1), lambda hits: lengths.append((hits.length, len(hits.row))), lobes, True)
    assert [k for length, k in lengths if length > 1 and k] == []
    # Of directions by the cosine about a normal at 45 degrees (1 - cos 45) / 2 lie below.
    assert ends.escaped / n == pytest.approx(1 - 0.5 * (1 - math.sqrt(0.5)), abs=0.03)


def test_light_from_far_away_that_misses_the_scene_is_no_light_of_it():
    """A sun over a black square, and a background around it: what is emitted is what arrives."""
    b = SceneBuilder()
    b.quad("Black", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0.0))
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0)))
    b.background = (0.5, 0.5, 0.5)
    world, rng = World(b.build()), np.random.default_rng(3)
    ends = particle_walk(world, Emission(world).draw(4000, rng), 6, rng, lambda hits: None)
    assert ends.escaped > 1000 and ends.escaped_energy == 0
    assert ends.emitted_energy == pytest.approx(ends.absorbed_energy, rel=1e-5) and ends.absorbed_energy > 0


CLEAR = Material("Clear", (Lobe("transparent", Color.of(1.0)),))


@pytest.mark.parametrize("lamp", [{"radius": 0.3, "soft_falloff": True}, {}], ids=["soft", "point"])
def test_what_is_too_near_to_be_lit_is_measured_from_the_lamp_not_from_a_sheet_on_the_way(lamp):
    """A clear sheet 5 cm over a floor changes nothing: rays of a soft lamp light only what is farther than some distance from it."""
    power = []
    for sheets in (0, 1):
        b = SceneBuilder()
        b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
        for _ in range(sheets):
            b.quad("Sheet", (-1.5, -1.5, 0.05), (3, 0, 0), (0, 3, 0), CLEAR)
        b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.0, 0.0, 1.0), **lamp))
        world, arrived = World(b.build()), []
        particles = Emission(world).draw(4000, np.random.default_rng(1))
        particle_walk(world, particles, 1, np.random.default_rng(2), lambda hits, to=arrived: to.append(_on_floor(hits)))
        power.append(sum(arrived))
    assert power[0] > 0 and power[1] == pytest.approx(power[0], rel=0.01)


def _on_floor(hits):
    return float(hits.arriving[hits.surface.triangle < 2].sum(dtype=float))


def test_the_far_plane_counts_from_the_camera_for_importance_that_passes_a_sheet():
    """A sheet on the way does not let the camera see farther: what lies beyond the far plane gets nothing, what lies before it all."""
    for end, seen in ((1.9, 0), (2.1, 1000)):
        b = SceneBuilder()
        b.quad("Wall", (-9, 2, -9), (18, 0, 0), (0, 0, 18), diffuse("Wall", 0.5))
        b.quad("Sheet", (-9, 1, -9), (18, 0, 0), (0, 0, 18), CLEAR)
        b.camera = Camera("orthographic", (0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.5, 0.5, -0.4, 0.4), 50, 40, clip_end=end)
        world, arrived = World(b.build()), []
        particles = CameraDetector(world).particles(1000, np.random.default_rng(1))
        rng = np.random.default_rng(2)
        particle_walk(world, particles, 1, rng, lambda hits, to=arrived: to.append(int((hits.surface.triangle < 2).sum())), importance=True)
        assert sum(arrived) == seen


def test_light_in_a_tail_is_dimmed_by_the_mean_of_the_colours():
    """Its channels are summed: of a white light of 3 a surface that reflects red alone leaves 1."""
    white = np.ones((1, 3), np.float32)
    found = Gathered(white, white, 5, tail=np.full((2, 1), 3.0, np.float32))
    dimmed = found.times(np.array([[1.0, 0.0, 0.0]], np.float32))
    np.testing.assert_array_equal(dimmed.tail, [[1.0], [1.0]])
    np.testing.assert_array_equal(found.times(np.float32(2)).tail, [[6.0], [6.0]])
    both = dimmed.plus(found)
    assert both.rays == 10 and both.tail.tolist() == [[4.0], [4.0]] and both.direct.tolist() == [[2.0, 1.0, 1.0]]
