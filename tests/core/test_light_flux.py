"""What a scene emits and what enters its surfaces, against closed forms: one definition for all methods."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import flux as light_flux
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.particles import walk

PI = math.pi
WHITE = (1.0, 1.0, 1.0)


def closed(emission=0.0):
    """A closed unit room; its floor may emit, from both sides."""
    b = SceneBuilder()
    materials = [diffuse("Grey", 0.5)] * 4 + [diffuse("Floor", 0.5, emission), diffuse("Grey", 0.5)]
    b.box("Room", (0, 0, 0), (1, 1, 1), materials, inward=True)
    return b


def sheet(emission=0.0):
    """A unit square."""
    b = SceneBuilder()
    b.quad("Sheet", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5, emission))
    return b


def lit(b, *lights, background=0.0):
    for light in lights:
        b.light(light)
    b.background = (background,) * 3
    return b


def point(z):
    return Light("Point", "point", WHITE, (0.5, 0.5, z))


def tilted(tilt, **options):
    c, s = math.cos(tilt), math.sin(tilt)
    return Light("Sun", "sun", WHITE, axis_y=(0, c, s), axis_z=(0, -s, c), **options)


# Share of a point lamp's light that falls on a square of side 1, half a metre below its middle.
BELOW = 1 / 6
SPOT = Light("Spot", "spot", WHITE, (0.5, 0.5, 0.5), spot_angle=2.0, spot_scale=(1e6, 1.0))
# Scene, emitted and entering W of one colour.
CASES = {
    "sun on a room": (lit(closed(), tilted(0.0)), 1.0, 1.0),
    "tilted sun on a room": (lit(closed(), tilted(0.6)), math.cos(0.6) + math.sin(0.6), math.cos(0.6) + math.sin(0.6)),
    "sun on a sheet": (lit(sheet(), tilted(0.6)), math.cos(0.6), math.cos(0.6)),
    "sun of an angle on a sheet": (lit(sheet(), tilted(0.3, angle=0.5)), math.cos(0.3), math.cos(0.3)),
    "background on a room": (lit(closed(), background=1.0), 6 * PI, 6 * PI),
    "background on a sheet": (lit(sheet(), background=1.0), 2 * PI, 2 * PI),
    "lamp in a room": (lit(closed(), point(0.4)), 4 * PI, 4 * PI),
    "lamp over a sheet": (lit(sheet(), point(0.5)), 4 * PI, 4 * PI * BELOW),
    "stretched spot in a room": (lit(closed(), SPOT), 4.0, 4.0),
    "emitting floor of a room": (closed(1.0), 2 * PI, PI),
    "emitting sheet": (sheet(1.0), 2 * PI, 0.0),
    "all in a room": (lit(closed(1.0), point(0.4), tilted(0.0), background=1.0), 12 * PI + 1, 11 * PI + 1),
    "nothing": (SceneBuilder(), 0.0, 0.0),
}


@pytest.mark.parametrize("case", CASES)
def test_emitted_and_entering(case):
    scene, emitted, entering = CASES[case]
    flux = Emitters(World(scene.build())).flux
    assert flux.emitted == pytest.approx(3 * emitted, rel=0.004, abs=1e-9)
    assert flux.entering == pytest.approx(3 * entering, rel=0.01, abs=1e-9)


@pytest.mark.parametrize("case", [c for c in CASES if c != "nothing"])
def test_particles_carry_what_is_emitted(case):
    """Energy of suns and the background that misses the scene is no energy of theirs."""
    scene, emitted, entering = CASES[case]
    world = World(scene.build())
    met = []
    ends = walk(world, Emission(world).draw(50_000, np.random.default_rng(0)), 64, np.random.default_rng(1), met.append)
    first = sum(float(h.arriving.sum(dtype=float)) for h in met if h.length == 1)
    assert ends.emitted_energy == pytest.approx(3 * emitted, rel=0.02)
    assert first == pytest.approx(3 * entering, rel=0.02)
    assert ends.emitted_energy == pytest.approx(ends.absorbed_energy + ends.escaped_energy + ends.cut_energy, rel=1e-6)


def boxes(places, *lights, background=0.0):
    """Unit cubes at these places."""
    b = SceneBuilder()
    for k, place in enumerate(places):
        b.box(f"Box {k}", tuple(place), tuple(np.add(place, 1)), diffuse("Grey", 0.5), inward=False)
    return World(lit(b, *lights, background=background).build())


SKIES = {"sun": (tilted(0.6), 0.0), "soft sun": (tilted(0.6, angle=0.2), 0.0), "sky": (None, 1.0), "sun and sky": (tilted(0.6), 1.0)}
SHOWN = math.cos(0.6) + math.sin(0.6)
RIM = (0.2 - math.sin(0.2)) / PI / math.sin(0.1) ** 2  # on both sides of a cube that see half of the soft sun's disk


@pytest.mark.parametrize(("count", "far"), [(2, 30.0), (2, 200.0), (2, 2e3), (2, 4e4), (12, 2e3), (12, 4e4), (200, 4e3), (200, 4e4)])
@pytest.mark.parametrize("sky", SKIES)
def test_how_far_apart_things_stand_does_not_matter(sky, far, count, monkeypatch):
    """Neither to what falls on them nor to the number of rays that find it. They stand in a line along x, which no sun looks along."""
    sun, background = SKIES[sky]
    world = boxes([(x, 0, 0) for x in np.linspace(0, far, count)], *([sun] if sun else []), background=background)
    rays, intersect = [], World.intersect
    monkeypatch.setattr(World, "intersect", lambda self, o, *more: rays.append(len(o)) or intersect(self, o, *more))
    flux = Emitters(world).flux
    # What they hide of the sky from each other is below a thousandth.
    expected = 3 * count * ((SHOWN if sun else 0) + (RIM if sky == "soft sun" else 0) + 6 * PI * background)
    assert flux.emitted == pytest.approx(expected, rel=0.004)
    assert flux.entering == pytest.approx(expected, rel=0.004)
    assert sum(rays) < 1 << 17


def test_objects_that_throw_shadows_on_each_other_from_afar_count_once():
    """Cubes in a row along the sun: what falls on all is what falls on one."""
    flux = Emitters(boxes([(0, 0, -500.0 * k) for k in range(7)], tilted(0.0))).flux
    assert flux.entering == pytest.approx(3, rel=0.004)


def test_points_of_triangles_and_particles_find_the_same(monkeypatch):
    """Whatever is cheaper is taken: a heap of boxes by both."""
    rng = np.random.default_rng(1)
    found = []
    for most in (0.0, 1e9):
        world = boxes(rng.permutation(np.random.default_rng(2).uniform(0, 9, (40, 3))), tilted(0.6, angle=0.3), background=1.0)
        monkeypatch.setattr(light_flux, "LEAST", most)
        found.append(Emitters(world).flux.entering)
    assert found[0] == pytest.approx(found[1], rel=0.01) and found[0] != found[1]


def test_a_soft_lamp_lights_nothing_where_its_disk_is_out_of_the_way():
    """Its rays begin to light at a distance; what enters is what particles bring to a sheet that reaches into the lamp."""
    lamp = Light("Soft", "point", WHITE, (0.5, 0.5, 0.15), radius=0.4, soft_falloff=True)
    world = World(lit(sheet(), lamp).build())
    met = []
    walk(world, Emission(world).draw(50_000, np.random.default_rng(0)), 1, np.random.default_rng(1), met.append)
    first = sum(float(h.arriving.sum(dtype=float)) for h in met)
    assert Emitters(world).flux.entering == pytest.approx(first, rel=0.02)


# A small sheet in the middle of a cube sends so much of the light of one side to the wall that it faces, the rest evenly to four others.
FACED = 4 / PI * math.atan(1 / math.sqrt(2)) / math.sqrt(2)
WALLS = np.concatenate([np.eye(3), -np.eye(3)])


def one_wall(towards):
    """One wall of a cube of side 2 around the origin, `towards` (3,) where it stands."""
    a, b = np.roll(towards, 1), np.roll(towards, 2)
    scene = SceneBuilder()
    scene.quad("Wall", towards - a - b, 2 * a, 2 * b, diffuse("Black", 0.0))
    return scene


@pytest.mark.parametrize("axis", range(3))
def test_light_goes_out_from_sheets_to_all_sides_by_the_cosine(axis):
    normal = np.eye(3)[axis]
    x, y = 0.01 * np.roll(normal, 1), 0.01 * np.roll(normal, 2)
    shares = []
    for towards in WALLS:
        scene = one_wall(towards)
        scene.quad("Sheet", -x / 2 - y / 2, x, y, diffuse("Light", 0.0, 1.0))
        flux = Emitters(World(scene.build())).flux
        shares.append(flux.entering / flux.emitted)
        assert flux.passing == 0  # of lamps alone
    np.testing.assert_allclose(shares, np.where(np.abs(WALLS[:, axis]) > 0, FACED / 2, (1 - FACED) / 4), atol=0.004)


@pytest.mark.parametrize("towards", WALLS)
def test_light_of_a_lamp_that_meets_nothing_is_known(towards):
    flux = Emitters(World(lit(one_wall(towards), Light("Point", "point", WHITE, (0, 0, 0))).build())).flux
    assert (flux.entering / flux.emitted, flux.passing / flux.emitted) == pytest.approx((1 / 6, 5 / 6), rel=0.02)
