"""Points inside bodies: what stands on a floor, and what only looks so."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.receivers.apart import BodyLayer
from adjgi.adjoint_gi.core.receivers.inside import Interiors
from adjgi.adjoint_gi.core.receivers.texels import rasterize
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.particle_density import ParticleDensity
from adjgi.tests.scenes import icosphere
from adjgi.tests.solving import solve

WHITE = diffuse("White", 0.5)
GLASS = Material("Glass", (Lobe("glass", Color.of(1.0), 0.0),))
QUADS = {"bottom": (0, 2, 3, 1), "top": (4, 5, 7, 6), "-y": (0, 1, 5, 4), "+y": (2, 6, 7, 3), "-x": (0, 4, 6, 2), "+x": (1, 3, 7, 5)}


def block(b, name, low, high, material=WHITE, without=(), flip=False):
    """A box of one mesh, turned outward."""
    corner = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) * (np.array(high) - low) + low
    faces = [[(p, q, r), (p, r, s)] for key, (p, q, r, s) in QUADS.items() if key not in without]
    triangles = np.array(faces).reshape(-1, 3)
    b.mesh(name, corner, triangles[:, ::-1] if flip else triangles, material)


def floor():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (10, 0, 0), (0, 10, 0), WHITE)
    return b


def found(b):
    """Points of the floor (n, 2) and which of them lie inside a body."""
    world = World(b.build())
    x, y = (a.ravel() for a in np.meshgrid((np.arange(50) + 0.5) / 50, (np.arange(50) + 0.5) / 50))
    upper = y > x
    # Triangle 0 is (0, 0), (1, 0), (1, 1), triangle 1 is (0, 0), (1, 1), (0, 1).
    u, v = np.where(upper, x, x - y).astype(np.float32), np.where(upper, y - x, y).astype(np.float32)
    return 10 * np.stack([x, y], axis=1), Interiors(world).hold(upper.astype(np.int32), u, v)


def within(point, low, high):
    return ((point > low[:2]) & (point < high[:2])).all(axis=1)


WALL = ((4.8, 1.0, 0.0), (5.6, 9.0, 2.5))


@pytest.mark.parametrize("sunk", [0.0, 0.05, -0.001, -0.004])
@pytest.mark.parametrize("without", [(), ("bottom",)])
def test_points_below_a_wall_that_stands_on_the_floor(sunk, without):
    """Or in it, or a little above it."""
    b = floor()
    block(b, "Wall", np.array(WALL[0]) - (0, 0, sunk), WALL[1], without=without)
    point, inside = found(b)
    assert np.array_equal(inside, within(point, *WALL)) and inside.sum() == 160


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize(("gap", "inside"), [(0.006, 160), (0.012, 0), (0.05, 0)])
def test_a_wall_hovers_by_a_share_of_its_thickness_and_not_of_its_length(along, gap, inside):
    """Of 0.8 m, not of 8 m: light comes in below a wall that hovers by more."""
    b = floor()
    low, high = (np.array(c)[[0, 1, 2] if along == "y" else [1, 0, 2]] for c in WALL)
    block(b, "Wall", low + (0, 0, gap), high)
    assert found(b)[1].sum() == inside


def test_several_bodies_and_round_ones():
    b = floor()
    block(b, "Wall", *WALL)
    block(b, "Board", (5.0, 0.4, 0.0), (6.6, 9.6, 0.1))  # runs through the wall
    vertices, triangles = icosphere(3)
    b.mesh("Stone", vertices + (2, 2, 0.3), triangles, WHITE)
    point, inside = found(b)
    round_ = np.linalg.norm(point - 2, axis=1)
    sure = within(point, *WALL) | within(point, np.array([5.0, 0.4]), np.array([6.6, 9.6])) | (round_ < 0.93)
    assert inside[sure].all() and not inside[~sure & (round_ > 0.97)].any()


def lamp(b):
    b.light(Light("Lamp", "point", (1, 1, 1), position=(5.3, 5, 1)))


def panel(b):
    b.quad("Panel", (5.2, 5, 2), (0, 0.2, 0), (0.2, 0, 0), diffuse("Panel", 0.0, 1.0))


def camera(b):
    b.camera = Camera("perspective", (5.3, 5, 1), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-1, 1, -1, 1), 8, 8)


@pytest.mark.parametrize("put", [lamp, panel, camera])
def test_a_room_turned_inside_out_is_no_body(put):
    """One box around a floor, its faces turned outward, with light or a view in it."""
    b = floor()
    block(b, "Room", (-0.1, -0.1, 0.0), (10.1, 10.1, 3.0))
    put(b)
    assert not found(b)[1].any()


GLOWING = diffuse("Glowing", 0.4, 1.0)


@pytest.mark.parametrize("name", ["path_tracing", "particle_tracing", "matrix_radiosity"])
def test_what_lies_in_a_lantern_has_its_light(name):
    """Radiance 1 / (1 - 0.4) all around a white sheet: pi / 0.6, which particles had as 0 and elements without what is reflected."""
    b = SceneBuilder()
    b.quad("Sheet", (-0.4, -0.4, 0.3), (0.8, 0, 0), (0, 0.8, 0), diffuse("White", 1.0))
    b.mesh("Lantern", *icosphere(1), GLOWING)
    world = World(b.build())
    options = {"particle_tracing": {"particles": 60_000}, "matrix_radiosity": {"max_edge": 1.0, "rays": 256}}
    found = solve(name, world, rasterize(world, [0], resolution=4).receivers, **options.get(name, {}))
    assert found.quantity("irradiance").mean() == pytest.approx(np.pi / 0.6, rel=0.05)


def test_a_glowing_block_on_the_floor_is_a_body_and_a_glowing_dome_is_none():
    b = floor()
    block(b, "Panel", *WALL, material=GLOWING)
    point, inside = found(b)
    assert np.array_equal(inside, within(point, *WALL))
    b = floor()
    block(b, "Sky", (-1, -1, -1), (11, 11, 9), material=GLOWING)
    assert not found(b)[1].any()


LOOKALIKES = {
    "a sheet of a decal": lambda b: b.quad("Decal", (2, 2, 1e-3), (3, 0, 0), (0, 3, 0), WHITE),
    "a sheet turned down": lambda b: b.quad("Decal", (2, 2, 1e-3), (0, 3, 0), (3, 0, 0), WHITE),
    "a pane": lambda b: block(b, "Vitrine", *WALL, material=GLASS),
    "a block turned inward": lambda b: block(b, "Room", *WALL, flip=True),
    "a shed that is open": lambda b: block(b, "Shed", *WALL, without=("-x",)),
    "a block not so near": lambda b: block(b, "Block", (2, 2, 0.05), (3, 6, 2.0)),
    "a shed far below": lambda b: block(b, "Shed", (2, 2, -2.0), (6, 6, 2.0), without=("bottom",)),
    "a table top": lambda b: block(b, "Top", (2, 2, 0.7), (6, 6, 0.75)),
    "a cover that hangs": lambda b: block(b, "Cover", (2, 2, 0.3), (6, 6, 0.75), without=("bottom",)),
}


@pytest.mark.parametrize("name", LOOKALIKES)
def test_what_is_no_body(name):
    b = floor()
    LOOKALIKES[name](b)
    assert not found(b)[1].any()


def test_texels_lose_the_points_inside_and_those_wholly_inside_are_not_covered():
    b = floor()
    block(b, "Wall", *WALL)
    plain, lm = (rasterize(World(x.build()), [0], resolution=16, subsamples=16) for x in (floor(), b))
    x = (np.arange(16) + 0.5) * 10 / 16
    low, high = x - 5 / 16, x + 5 / 16
    whole = ((low > 4.8) & (high < 5.6))[None] & ((low > 1) & (high < 9))[:, None]
    none = ((high < 4.8) | (low > 5.6))[None] | ((high < 1) | (low > 9))[:, None]
    assert not lm.covered[whole].any() and lm.covered[none].all()
    many = np.zeros(256)
    many[lm.pixel] = np.diff(lm.receivers.start)
    # A renderer that takes the mean over whole texels can be compared with those alone that lost none.
    assert np.array_equal(lm.whole, many[lm.pixel] == 16) and plain.whole.all()
    assert np.all(many.reshape(16, 16)[none] == 16) and many.sum() / 16 == pytest.approx(256 - 0.8 * 8 * 2.56, rel=0.03)
    # How much of a texel lies on the surface is not asked of what stands on it.
    assert np.all(plain.share == 1) and np.all(lm.share[lm.covered] == 1)


def test_what_lies_inside_as_a_whole_keeps_its_texels():
    b = SceneBuilder()
    b.quad("Board", (5.0, 2, 1), (0.3, 0, 0), (0, 4, 0), WHITE)
    block(b, "Wall", *WALL)
    assert rasterize(World(b.build()), [0], resolution=8).covered.all()


def test_a_floor_is_as_bright_beside_a_wall_as_the_closed_form_says():
    """64 texels over 10 m, a black wall of 0.4 m, height h, below a white sky: at distance d the floor gets pi (1 + d / sqrt(d2 + h2)) / 2.

    Texels that the wall stands on were up to 65 % too dark. Their mean is over the part that lies beside the wall.
    """
    b, h, low, high = floor(), 2.5, 4.85, 5.25
    block(b, "Wall", (low, -10.0, 0.0), (high, 20.0, h), material=diffuse("Black", 0.0))
    b.background = (1.0, 1.0, 1.0)
    world = World(b.build())
    lm = rasterize(world, [0], resolution=64, subsamples=16)
    value = solve("path_tracing", world, lm.receivers, max_length=1, samples=128).quantity("irradiance")
    got = lm.image(value)[8:-8, :, 0].mean(axis=0)
    want = []
    for k in range(64):
        x = (k + (np.arange(400) + 0.5) / 400) * 10 / 64
        d = np.maximum(low - x, x - high)
        want.append((0.5 * np.pi * (1 + d / np.hypot(d, h)))[d > 0].mean() if (d > 0).any() else 0.0)
    beside = np.array(want) > 0
    assert np.array_equal(lm.covered[10], beside)
    near = beside & (np.abs(np.arange(64) + 0.5 - 5.05 * 6.4) < 6)
    assert np.allclose(got[near], np.array(want)[near], rtol=0.04)


def test_particles_are_counted_over_the_same_area():
    """What lands around a texel beside the wall is divided by the kernel's integral over what it can land on."""
    b, low, high, h = floor(), 4.85, 5.25, 0.6
    block(b, "Wall", (low, -1.0, 0.0), (high, 11.0, 2.5))
    world = World(b.build())
    density = ParticleDensity(world, rasterize(world, [0], resolution=16, subsamples=4).receivers, 1000, radius=h)
    area = density.area(40_000, np.random.default_rng(1))
    at = density.position + world.center
    middle = (np.abs(at[:, :2] - 5) < 4).all(axis=1)
    # The Epanechnikov kernel over a strip at distance s: 4/3 (h2 - s2)^1.5 / h2.
    s = at[middle, 0, None] - (low + (high - low) * (np.arange(50) + 0.5) / 50)
    below = (4 / 3 * np.maximum(h * h - s * s, 0) ** 1.5 / h**2).mean(axis=1) * (high - low)
    beside = below > 0.05
    whole = 0.5 * np.pi * h * h
    assert area[middle][below == 0].mean() == pytest.approx(whole, rel=0.01)
    assert beside.sum() > 8 and area[middle][beside].mean() == pytest.approx(whole - below[beside].mean(), rel=0.02)


def sky_beside(x, low, high, h):
    """Irradiance at `x` beside a black wall from `low` to `high` of height `h` below a sky of radiance 1; nan below the wall."""
    d = np.maximum(low - x, x - high)
    return np.where(d > 0, 0.5 * np.pi * (1 + d / np.hypot(d, h)), np.nan)


def test_elements_that_a_wall_stands_on_are_as_bright_as_beside_it():
    """Their power is that of the part beside the wall: particles on elements were 26 % too dark there."""
    b, h, low, high = floor(), 2.5, 4.85, 5.25
    block(b, "Wall", (low, -2.0, 0.0), (high, 12.0, h), material=diffuse("Black", 0.0))
    b.background = (1.0, 1.0, 1.0)
    world = World(b.build())
    lm = rasterize(world, [0], resolution=64, subsamples=4)
    found = solve("particle_tracing", world, lm.receivers, particles=600_000, max_edge=0.3125, max_length=1)
    got = lm.image(found.quantity("irradiance"))
    near = np.array([c for c in range(22, 42) if lm.covered[10, c]])
    exact = [np.nanmean(sky_beside((c + (np.arange(400) + 0.5) / 400) * 10 / 64, low, high, h)) for c in near]
    ratio = got[16:-16, near, 0].mean(axis=0) / exact
    # The noise of a column is 5 %; it was 42 % too dark beside the wall.
    assert np.all(np.abs(ratio - 1) < 0.15) and abs(ratio[6:13].mean() - 1) < 0.06 and abs(ratio.mean() - 1) < 0.04


def test_vertices_below_a_wall_take_their_light_from_beside_it():
    """A floor of 10 x 10 squares whose middle line of vertices lies below a wall of 0.8 m."""
    b = SceneBuilder()
    x, y = (a.ravel() for a in np.meshgrid(np.arange(11.0), np.arange(11.0)))
    first = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.concatenate([np.stack([first, first + 1, first + 12], axis=1), np.stack([first, first + 12, first + 11], axis=1)])
    b.mesh("Floor", np.stack([x, y, 0 * x], axis=1), faces, WHITE)
    block(b, "Wall", (4.6, -1.0, 0.0), (5.4, 11.0, 2.5))
    world = World(b.build())
    vertices = vertex_receivers(world, [0], "POINT")
    r = vertices.receivers
    assert r.count == 121 and (np.diff(r.start) > 0).all()
    assert not Interiors(world).hold(r.triangle, r.u, r.v).any()
    place = world.surface(r.triangle, r.u, r.v).position + world.center
    owner = np.repeat(np.arange(r.count), np.diff(r.start))
    below = np.isin(owner, vertices.index[0][x == 5])
    away = np.abs(place[below, 0] - 5)
    assert (away > 0.4).all() and (away < 1).all()
    plain = np.hypot(*(place[~below, :2] - np.stack([x, y], axis=1)[np.argsort(vertices.index[0])][owner[~below]]).T)
    assert plain.max() < 0.06


# Boxes that run through one another, or touch: what stands on the floor is all of it, whatever a ray meets first.
OVERLAPS = {
    "a bookcase sunk into a wall": [WALL, ((5.4, 3.0, 0.0), (6.6, 6.0, 1.0))],
    "a shelf that hangs in a wall": [WALL, ((4.2, 1.6, 0.8), (5.2, 8.4, 1.0))],
    "a corner of two walls": [WALL, ((4.8, 1.0, 0.0), (9.6, 1.8, 2.5))],
    "a column half in a wall": [WALL, ((4.4, 4.0, 0.0), (5.2, 6.0, 2.5))],
    "two blocks that touch": [((3.0, 2.0, 0.0), (5.0, 6.0, 1.0)), ((5.0, 2.0, 0.0), (7.0, 6.0, 1.0))],
    "two blocks one on the other": [((3.0, 2.0, 0.0), (5.0, 6.0, 1.0)), ((3.0, 2.0, 1.0), (5.0, 6.0, 2.0))],
    "three through one place": [((3.0, 4.0, 0.0), (8.0, 6.0, 1.0)), ((4.0, 2.0, 0.0), (6.0, 8.0, 2.0)), ((4.2, 4.2, 0.0), (5.8, 5.8, 3.0))],
}


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("name", OVERLAPS)
def test_bodies_that_overlap_or_touch_are_told_one_by_one(name, joined):
    """As objects of their own, and as pieces of one mesh. A bookcase .2 m in a wall made the floor at its other side 75 % too dark."""
    b, boxes = floor(), OVERLAPS[name]
    for k, box in enumerate(boxes):
        block(b, f"Box {k}", *box)
    if joined:
        several = SceneBuilder()
        for k, box in enumerate(boxes):
            block(several, f"Box {k}", *box)
        arrays, b = several.build(), floor()
        b.mesh("Boxes", arrays.vertices, arrays.triangles, WHITE)
    point, inside = found(b)
    want = np.any([within(point, *box) for box in boxes if box[0][2] == 0], axis=0)
    assert np.array_equal(inside, want) and want.any()


def test_sheets_that_run_through_a_wall_or_end_on_it_do_not_open_it():
    """A ceiling as high as the wall, one that it runs through, and a room turned inward whose walls it runs through."""
    for height in (2.0, 2.5):
        b = floor()
        block(b, "Wall", *WALL)
        b.quad("Ceiling", (0, 0, height), (0, 10, 0), (10, 0, 0), WHITE)
        block(b, "Room", (0, 1.5, -0.2), (10, 8.5, 2.2), flip=True)
        point, inside = found(b)
        assert np.array_equal(inside, within(point, *WALL))


@pytest.mark.parametrize("put", [lamp, camera])
def test_furniture_through_the_wall_of_a_house(put):
    """A house and a room in it, each closed, a partition that ends within the wall between them and a block on the floor."""
    b = floor()
    block(b, "House", (-0.5, -0.5, -0.5), (10.5, 10.5, 3.5))
    block(b, "Room", (-0.1, 0.9, -0.1), (10.1, 9.3, 3.0), flip=True)
    partition, chest = ((7.0, 0.6, -0.1), (7.4, 5.0, 3.2)), ((7.2, 3.0, 0.0), (8.6, 4.0, 1.0))
    block(b, "Partition", *partition)
    block(b, "Chest", *chest)
    put(b)
    point, inside = found(b)
    assert np.array_equal(inside, within(point, *partition) | within(point, *chest))


def test_a_room_in_a_house_without_a_lamp_is_no_body():
    b = floor()
    block(b, "House", (-0.5, -0.5, -0.5), (10.5, 10.5, 3.5))
    block(b, "Room", (-0.1, -0.1, -0.1), (10.1, 10.1, 3.0), flip=True)
    assert not found(b)[1].any()


def test_a_lamp_behind_blocks_that_touch_is_in_none_of_them():
    """Its ray passes the face they share, of which only one is met."""
    step = np.float32([0.36, 0.48, 0.8])
    for shared in (3.0, 5.0):
        b = floor()
        b.light(Light("Lamp", "point", (1, 1, 1), position=tuple(np.array([shared, 4.0, 1.0]) - 2 * step)))
        boxes = [((shared - 1, 3.0, 0.0), (shared, 5.0, 2.0)), ((shared, 3.0, 0.0), (shared + 1, 5.0, 2.0))]
        for k, box in enumerate(boxes):
            block(b, f"Block {k}", *box)
        point, inside = found(b)
        assert np.array_equal(inside, within(point, *boxes[0]) | within(point, *boxes[1]))


def test_where_nothing_can_stand_no_ray_is_cast(monkeypatch):
    """The boxes of bodies tell; a floor without any asks nothing, one with a block asks for the points near it."""
    asked = []
    plain = BodyLayer.intersect
    monkeypatch.setattr(BodyLayer, "intersect", lambda self, origin, d: asked.append(len(origin)) or plain(self, origin, d))
    found(floor())
    assert not asked
    b = floor()
    block(b, "Block", (4.0, 4.0, 0.0), (5.0, 5.0, 1.0))
    assert found(b)[1].sum() == 25
    assert sum(asked) < 36 + 9 * 25 + 1 < 2500
