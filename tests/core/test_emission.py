"""Particles from every kind of light: power, distribution of directions, and the irradiance they bring, against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import mesh
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.lights.outgoing import cone_directions, reject
from adjgi.adjoint_gi.core.lights.patches import Patches, radiance
from adjgi.adjoint_gi.core.sampling.maps import cosine_directions, disk
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, RayKind, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.world import World

# Standard deviations that a sound generator exceeds once in a thousand runs of the 40 z-tests and chi-square tests here (Sidak).
Z = 4.2
COLOR = (3.0, 1.5, 0.5)


def tilt(angle):
    """Axes of a lamp turned by `angle` about x: x, y, z."""
    c, s = math.cos(angle), math.sin(angle)
    return {"axis_x": (1.0, 0.0, 0.0), "axis_y": (0.0, c, s), "axis_z": (0.0, -s, c)}


def lamp(kind, tilted=0.0, **options):
    """A lamp one metre above the origin that shines down, or tilted."""
    return Light("Lamp", kind, COLOR, (0.0, 0.0, 1.0), **tilt(tilted), **options)


def flat_spot(n=2000):
    """Solid angle of the flattened spot below, weighted by its falloff, by a sum over all directions."""
    c = (np.arange(n) + 0.5) / n
    phi = 2 * math.pi * (np.arange(720) + 0.5) / 720
    r = np.sqrt(1 - c * c)
    x, y = np.outer(r, np.cos(phi)) / 0.5, np.outer(r, np.sin(phi)) / 1.5
    edge = math.cos(math.radians(50))
    t = np.clip((c[:, None] / np.sqrt(x * x + y * y + c[:, None] ** 2) - edge) / ((1 - edge) * 0.4), 0, 1)
    return 2 * math.pi * (t * t * (3 - 2 * t)).mean()


FLAT = flat_spot()
LAMPS = {
    "point": (lamp("point"), 4 * math.pi),
    "sphere": (lamp("point", radius=0.4), 4 * math.pi),
    "spot": (lamp("spot", spot_angle=math.radians(80)), 2 * math.pi * (1 - math.cos(math.radians(40)))),
    "blended spot": (lamp("spot", spot_angle=math.radians(120), spot_blend=0.6, radius=0.2), 2 * math.pi * 0.5 * 0.7),
    "soft point": (lamp("point", radius=0.4, soft_falloff=True), 4 * math.pi),
    "flat spot": (lamp("spot", spot_angle=math.radians(100), spot_blend=0.4, spot_scale=(0.5, 1.5)), FLAT),
    "rectangle": (lamp("area", size_x=2.0, size_y=0.5), math.pi),
    "ellipse": (lamp("area", shape="ELLIPSE", size_x=2.0, size_y=0.5), math.pi * math.pi / 4),
    "spread": (lamp("area", size_x=1.0, size_y=1.0, spread=math.radians(60)), math.pi),
    "sun": (lamp("sun"), None),
    "sun disk": (lamp("sun", angle=math.radians(60)), None),
}


def target(light=None, background=(0.0, 0.0, 0.0), size=2.0):
    """A square of the plane z = 0 around the origin, with one lamp."""
    b = SceneBuilder()
    b.quad("Floor", (-size / 2, -size / 2, 0), (size, 0, 0), (0, size, 0), diffuse("Black", 0.0))
    if light:
        b.light(light)
    b.background = background
    return World(b.build())


def on_plane(particles):
    """x, y where particles that fly down cross z = 0, and which do."""
    o, d = particles.origin.astype(float), particles.direction.astype(float)
    t = -o[:, 2] / np.where(d[:, 2] == 0, -1, d[:, 2])
    return o[:, 0] + t * d[:, 0], o[:, 1] + t * d[:, 1], (t > 0) & (d[:, 2] < 0)


def mean_power(world, inside, batches=128, n=4096, seed=7):
    """Mean and standard error of the power (first colour) of the particles for which `inside(particles)`."""
    emission, rng = Emission(world), np.random.default_rng(seed)
    values = []
    for _ in range(batches):
        p = emission.draw(n, rng)
        values.append(p.weight[inside(p), 0].sum(dtype=float))
    return np.mean(values), np.std(values, ddof=1) / math.sqrt(batches)


@pytest.mark.parametrize("name", LAMPS)
def test_power_of_a_lamp_is_the_closed_form_and_the_draw_sums_to_it(name):
    light, solid = LAMPS[name]
    emission = Emission(target(light))
    if solid is None:
        # Through a disk over the sphere around the square; a wide sun adds the tilt of its rim, 2 / (1 + cos 30).
        solid = math.pi * 2.0 * (2 / (1 + math.cos(light.angle / 2)))
    assert emission.names == ("Lamp",)
    np.testing.assert_allclose(emission.flux[0], np.multiply(COLOR, solid), rtol=1e-4)
    p = emission.draw(1000, np.random.default_rng(1))
    np.testing.assert_allclose(p.weight.sum(axis=0, dtype=float), emission.flux[0], rtol=1e-6)
    assert np.ptp(p.weight.sum(axis=1)) <= 1e-6 * p.weight.sum(axis=1).mean()
    np.testing.assert_allclose(np.linalg.norm(p.direction, axis=1), 1, atol=1e-5)
    assert p.origin.dtype == p.direction.dtype == p.weight.dtype == np.float32


@pytest.mark.parametrize("blend", [0.0, 0.6])
@pytest.mark.parametrize("scale", [1e-5, 0.3, 30.0, 1e3, 1e5])
def test_power_of_a_spot_scaled_alike_on_both_sides_is_that_of_a_round_cone(scale, blend):
    """Its edge lies at tan = scale tan(h), and so does every step of its falloff, which is integrated here by parts."""
    light = lamp("spot", spot_angle=1.2, spot_blend=blend, spot_scale=(scale, scale))
    t = (np.arange(20_000) + 0.5) / 20_000 if blend else np.zeros(1)
    edge = math.cos(0.6)
    e = edge + (1 - edge) * blend * t
    x = scale**2 * (1 / e**2 - 1)
    solid = 2 * math.pi * (x / (1 + x + np.sqrt(1 + x)) * (6 * t * (1 - t) if blend else 1)).mean()
    np.testing.assert_allclose(Emission(target(light)).flux[0], np.multiply(COLOR, solid), rtol=1e-5)


@pytest.mark.parametrize("angle", [0.3, 2.0])
def test_a_spot_stretched_without_end_fills_a_wedge(angle):
    light = lamp("spot", spot_angle=angle, spot_scale=(1e6, 1.0))
    np.testing.assert_allclose(Emission(target(light)).flux[0], np.multiply(COLOR, 2 * angle), rtol=1e-4)


SCALES = [(1e3, 1e3), (1e5, 1.0), (1.0, 1e-5), (1e-3, 1e3)]


@pytest.mark.parametrize("angle, blend", [(0.8, 0.15), (math.pi, 1.0), (math.pi, 0.0)])
@pytest.mark.parametrize("scale", SCALES)
def test_a_spot_of_any_scale_costs_few_random_numbers(scale, angle, blend):
    world = target(lamp("spot", spot_angle=angle, spot_blend=blend, spot_scale=scale))
    rng = CountingGenerator(9)
    particles = Emission(world).draw(4000, rng)
    assert np.isfinite(particles.direction).all() and particles.direction[:, 2].max() <= 1e-6
    assert rng.numbers < 4000 * 20


class CountingGenerator(np.random.Generator):
    """Counts the numbers that `random` has given."""

    def __init__(self, seed):
        super().__init__(np.random.PCG64(seed))
        self.numbers = 0

    def random(self, size=None, *args, **kwargs):
        self.numbers += 1 if size is None else int(np.prod(size))
        return super().random(size, *args, **kwargs)


def test_rejection_comes_to_an_end_where_nothing_passes_and_repeats_what_has_passed():
    rng, rows = np.random.default_rng(0), np.zeros((8, 3))
    reject(rows, lambda d: np.zeros(len(d)), lambda n: np.ones((n, 3)), rng)
    assert (rows == 1).all()
    rows[0] = 5
    reject(rows, lambda d: (d[:, 0] == 5) * 1.0, lambda n: np.ones((n, 3)), rng)
    assert (rows == 5).all()


def expected_share(light, low, high):
    """Share of a lamp's power whose direction has a cosine to the axis between low and high, from the definition of the lamp."""
    c = np.linspace(low, high, 20001)
    c = 0.5 * (c[1:] + c[:-1])
    if light.kind == "point":
        density = np.ones_like(c)
    elif light.kind == "spot":
        edge = math.cos(light.spot_angle / 2)
        x = np.clip((c - edge) / ((1 - edge) * max(light.spot_blend, 1e-9)), 0, 1)
        density = x * x * (3 - 2 * x)
    elif light.kind == "area":
        density = c * (c > 0)
        if light.spread < math.pi:
            tangent = np.sqrt(1 - c * c) / np.maximum(c, 1e-9)
            density = density * np.maximum(0, math.tan(light.spread / 2) - tangent)
    else:
        density = (c >= math.cos(light.angle / 2)) * 1.0
    return density.mean() * (high - low)


@pytest.mark.parametrize("name", [n for n in LAMPS if n not in ("sun", "flat spot")])
def test_directions_follow_the_lamp(name):
    """Pearson chi-square of the cosine to a tilted axis and the angle around it."""
    light = dataclasses.replace(LAMPS[name][0], **tilt(0.7))
    emission, rng = Emission(target(light)), np.random.default_rng(3)
    d = np.concatenate([emission.draw(4096, rng).direction for _ in range(16)]).astype(float)
    axis = -np.array(light.axis_z)
    cosine = d @ axis
    low = {"point": -1.0, "area": 0.0, "spot": math.cos(light.spot_angle / 2), "sun": math.cos(light.angle / 2)}[light.kind]
    if light.kind == "area":
        low = math.cos(min(light.spread, math.pi) / 2)
    edges = np.linspace(low, 1, 13)
    around = np.arctan2(d @ np.array(light.axis_y), d @ np.array(light.axis_x))
    assert cosine.min() > low - 1e-5
    counts = np.histogram2d(np.clip(cosine, low, 1), around, bins=[edges, np.linspace(-np.pi, np.pi, 9)])[0]
    share = np.array([expected_share(light, a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)])
    expected = np.repeat((share / share.sum() * len(d) / 8)[:, None], 8, axis=1)
    used = expected >= 5
    chi = (((counts - expected) ** 2)[used] / expected[used]).sum()
    freedom = used.sum() - 1
    assert chi < freedom + Z * math.sqrt(2 * freedom) + Z**2


def test_directions_of_a_mesh_are_cosine_distributed_on_both_sides():
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 0), (1, 0, 0), (0, 1, 1), diffuse("Lamp", 0, 1.0))
    emission, rng = Emission(World(b.build())), np.random.default_rng(5)
    d = np.concatenate([emission.draw(4096, rng).direction for _ in range(16)]).astype(float)
    normal = np.cross((1, 0, 0), (0, 1, 1)) / math.sqrt(2)
    along = d @ normal
    # The square of the cosine is uniform, with each sign half of the time.
    counts = np.histogram(np.sign(along) * along**2, bins=np.linspace(-1, 1, 33))[0]
    expected = len(d) / 32
    assert ((counts - expected) ** 2 / expected).sum() < 31 + Z * math.sqrt(62) + Z**2


def test_cosine_directions_of_a_fine_grid_have_the_moments_of_a_cosine():
    s, t = (a.ravel() for a in np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(64) + 0.5) / 64))
    normal = np.broadcast_to(np.array([0.6, 0.0, 0.8], np.float32), (len(s), 3))
    d = cosine_directions(normal, s, t).astype(float)
    cosine = d @ normal[0]
    assert cosine.min() >= -1e-6
    np.testing.assert_allclose([cosine.mean(), (cosine**2).mean(), (cosine**4).mean()], [2 / 3, 1 / 2, 1 / 3], rtol=2e-3)
    np.testing.assert_allclose(d.mean(axis=0), np.array([0.6, 0, 0.8]) * 2 / 3, atol=1e-3)


def test_the_direction_opposite_the_normal_is_not_a_nan():
    normal = np.array([[0, 0, -1]], np.float32)
    assert np.isfinite(cosine_directions(normal, np.zeros(1), np.zeros(1))).all()


@pytest.mark.parametrize("name", ["point", "sphere", "spot", "blended spot"])
@pytest.mark.parametrize("radius", [0.5, 1.0])
def test_power_on_a_disk_under_a_point_is_intensity_times_solid_angle(name, radius):
    """A sphere of uniform radiance above the horizon lights like a point; the share of a coaxial disk is (1 - cos) / 2."""
    light = LAMPS[name][0]
    if name == "blended spot":
        light = dataclasses.replace(light, radius=0.0)  # with a radius the falloff is seen from different points

    def inside(p):
        x, y, down = on_plane(p)
        return down & (x * x + y * y < radius**2)

    mean, error = mean_power(target(light), inside)
    edge = 1 / math.sqrt(1 + radius**2)
    expected = COLOR[0] * 2 * math.pi * (1 - edge)
    if light.kind == "spot":
        expected = COLOR[0] * 2 * math.pi * expected_share(light, edge, 1)
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error + 1e-4 * expected


def test_soft_falloff_is_a_disk_that_faces_each_receiver():
    """On a sphere of radius R around it, where all receivers face it, irradiance is intensity / (R^2 + r^2)."""
    light = Light("Lamp", "point", COLOR, (0.1, 0.2, 1.0), radius=0.4, soft_falloff=True)
    world = target(light)

    def inside(p):
        o = p.origin + world.center - np.array(light.position)
        b = np.einsum("ij,ij->i", o, p.direction)
        t = -b + np.sqrt(b * b - (o * o).sum(axis=1) + 0.5**2)
        return t > p.dark

    mean, error = mean_power(world, inside)
    expected = COLOR[0] * 4 * math.pi * 0.5**2 / (0.5**2 + 0.4**2)
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error + 1e-4 * expected


def test_directions_of_a_flattened_spot():
    """Shares of two angles around the axis and of a narrow middle, against a sum over all directions."""
    light = LAMPS["flat spot"][0]
    emission, rng = Emission(target(light)), np.random.default_rng(3)
    d = np.concatenate([emission.draw(4096, rng).direction for _ in range(16)]).astype(float)
    x, y, z = abs(d[:, 0]), abs(d[:, 1]), -d[:, 2]
    n = 400
    c = (np.arange(n) + 0.5) / n
    phi = (np.arange(n) + 0.5) / n * math.pi / 2
    r = np.sqrt(1 - c * c)
    gx, gy, gz = np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(c[:, None], n, 1)
    edge = math.cos(math.radians(50))
    t = np.clip((gz / np.sqrt((gx / 0.5) ** 2 + (gy / 1.5) ** 2 + gz**2) - edge) / ((1 - edge) * 0.4), 0, 1)
    density = t * t * (3 - 2 * t)
    for got, expected in ((x > 0.5 * y, gx > 0.5 * gy), (z > 0.8, gz > 0.8), (y > 0.5, gy > 0.5)):
        share = (density * expected).sum() / density.sum()
        assert 0.05 < share < 0.95
        assert abs(got.mean() - share) < Z * math.sqrt(share * (1 - share) / len(d)) + 2e-3


def square_power(light, n=36):
    """Power (first colour) an area lamp sends to the unit square of z = 0 around the origin, by quadrature over both."""
    x, y = (a.ravel() for a in np.meshgrid(*((np.arange(n) + 0.5) / n - 0.5,) * 2))
    dx = x[:, None] - x * light.size_x
    dy = y[:, None] - y * light.size_y
    d2 = dx**2 + dy**2 + 1
    tangent = np.sqrt(d2 - 1)
    kernel = 1 / d2**2
    if light.spread < math.pi:
        half = light.spread / 2
        kernel = kernel * np.maximum(0, math.tan(half) - tangent) / (math.tan(half) - half)
    return COLOR[0] * kernel.mean() * light.size_x * light.size_y


@pytest.mark.parametrize("name", ["rectangle", "spread"])
def test_power_on_a_square_under_an_area_lamp(name):
    light = LAMPS[name][0]

    def inside(p):
        x, y, down = on_plane(p)
        return down & (abs(x) < 0.5) & (abs(y) < 0.5)

    mean, error = mean_power(target(light), inside)
    expected = square_power(light)
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error + 1e-3 * expected


def test_power_on_a_disk_under_a_disk_lamp_is_the_form_factor():
    light = lamp("area", shape="ELLIPSE", size_x=2.0, size_y=2.0)

    def inside(p):
        x, y, down = on_plane(p)
        return down & (x * x + y * y < 1)

    mean, error = mean_power(target(light), inside)
    expected = COLOR[0] * math.pi * math.pi * 0.3819660112501051
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_power_between_parallel_mesh_squares_is_the_form_factor(size):
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 1), (1, 0, 0), (0, 1, 0), diffuse("Lamp", 0, COLOR))

    def inside(p):
        x, y, down = on_plane(p)
        x, y = x + world.center[0], y + world.center[1]
        return down & (x > 0) & (y > 0) & (x < size) & (y < 1)

    b.quad("Below", (0, 0, -1), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))
    world = World(b.build())  # centred between the squares' planes
    mean, error = mean_power(world, inside, batches=192)
    factor = {1.0: 0.19982489569838746, 2.0: 0.19982489569838746 + 0.08605048915232733}[size]
    assert error < 0.003 * math.pi * COLOR[0] * factor
    assert abs(mean - math.pi * COLOR[0] * factor) < Z * error


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_a_tilted_sun_lights_a_plane_by_the_cosine(angle):
    """A disk of the sky that is wholly above the horizon gives E cos(tilt), whatever its size."""
    world = target(lamp("sun", tilted=0.8, angle=angle))

    def inside(p):
        x, y, down = on_plane(p)
        return down & (abs(x) < 1) & (abs(y) < 1)

    mean, error = mean_power(world, inside)
    expected = 4 * COLOR[0] * math.cos(0.8)
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error + 1e-4 * expected


def test_a_constant_background_gives_pi_times_radiance_on_each_side():
    world = target(background=COLOR)
    triangles = []

    def inside(p):
        hit = world.intersect(p.origin, p.direction, RayKind.CAMERA)[0]
        triangles.append((p.direction[hit >= 0, 2] < 0).mean())
        return hit >= 0

    mean, error = mean_power(world, inside)
    expected = 2 * 4 * math.pi * COLOR[0]
    assert error < 0.003 * expected
    assert abs(mean - expected) < Z * error + 1e-4 * expected
    assert abs(np.mean(triangles) - 0.5) < 0.01
    np.testing.assert_allclose(Emission(world).flux[0], np.multiply(COLOR, 4 * math.pi**2 * 2), rtol=1e-4)


def test_particles_of_a_picture_finer_than_its_cells_have_its_own_values(monkeypatch):
    """Stripes of 1 and 3 within each of the 64 cells: each gives its own power, 4 pi A for both sides at emission 2 times the pixel."""
    monkeypatch.setattr(mesh, "CELLS", 1)
    pixels = np.ones((1, 64, 4), np.float32)
    pixels[:, 1::2, :3] = 3
    world = textured_panel(pixels)

    def bright(p):
        return np.floor((p.origin[:, 0] + world.center[0]) * 64).astype(int) % 2 == 1

    mean, error = mean_power(world, bright, batches=32)
    expected = 4 * math.pi * 0.5 * 3
    assert error < 0.01 * expected and abs(mean - expected) < Z * error + 1e-4 * expected


def textured_panel(pixels):
    """A unit square that emits an image, closest sampling."""
    color = Color((Term((2.0, 2.0, 2.0), (Source("image", "UVMap", 0),)),))
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Screen", (Lobe("emission", color),)))
    return World(dataclasses.replace(b.build(), textures=(Texture("Image", pixels, "EXTEND", "Closest"),)))


def test_textured_emission_is_exact_for_every_texel():
    """Each texel's power, also of a texel far brighter than the rest and of a black one."""
    pixels = np.ones((4, 4, 4), np.float32)
    pixels[..., :3] = np.random.default_rng(2).random((4, 4, 3)) + 0.1
    pixels[1, 2, :3] = 40
    pixels[3, 3, :3] = 0
    world = textured_panel(pixels)
    emission, rng = Emission(world), np.random.default_rng(4)
    batches = []
    for _ in range(32):
        p = emission.draw(4096, rng)
        x, y = (p.origin[:, :2] + world.center[:2]).T
        cell = np.clip((y * 4).astype(int), 0, 3) * 4 + np.clip((x * 4).astype(int), 0, 3)
        batches.append([np.bincount(cell, p.weight[:, c], minlength=16) for c in range(3)])
    mean = np.mean(batches, axis=0).T
    error = np.std(batches, axis=0, ddof=1).T / math.sqrt(32)
    expected = 2 * math.pi * 2 * pixels[..., :3].reshape(16, 3) / 16
    assert mean[15].max() == 0
    assert (np.abs(mean - expected) <= 4.5 * error + 1e-5 * expected).all()
    assert error[6].max() < 0.003 * expected[6].max()
    np.testing.assert_allclose(emission.flux[0], expected.sum(axis=0), rtol=0.05)


def test_cells_of_a_textured_triangle_cover_it_once():
    """Uniform emission through a texture: origins fill the square evenly and the flux is exact."""
    world = textured_panel(np.ones((2, 2, 4), np.float32))
    emission = Emission(world)
    np.testing.assert_allclose(emission.flux[0], 4 * math.pi, rtol=1e-6)
    p = emission.draw(1 << 16, np.random.default_rng(6))
    xy = p.origin[:, :2] + world.center[:2]
    counts = np.histogram2d(xy[:, 0], xy[:, 1], bins=16, range=[[0, 1], [0, 1]])[0]
    expected = len(xy) / 256
    assert ((counts - expected) ** 2 / expected).sum() < 255 + Z * math.sqrt(510) + Z**2


def test_no_part_of_a_picture_is_left_out_for_being_dark_where_it_was_looked_at():
    """Rounding or a product of pictures may hide light, so dark cells get a few particles; triangles that are dark for sure get none."""
    pixels = np.zeros((8, 8, 4), np.float32)
    pixels[0, 7, :3] = 1  # in the first of both triangles
    emission = Emission(textured_panel(pixels))
    assert emission.mesh.triangles.tolist() == [0] and (emission.mesh.density > 0).tolist() == [True, False]
    (cells,) = emission.mesh.objects
    radiance = cells.power / cells.full
    assert (cells.flux.sum(axis=1) == 0).any() and radiance.min() > 0.04 * np.average(radiance, weights=cells.full)


def test_several_lights_get_particles_by_power():
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Lamp", 0, 2.0))
    b.quad("Floor", (0, 0, -1), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.light(Light("Off", "point", (0.0, 0.0, 0.0)))
    b.light(Light("Red", "point", (1.0, 0.0, 0.0)))
    emission = Emission(World(b.build()))
    assert emission.names == ("Panel", "Red")
    p = emission.draw(10000, np.random.default_rng(1))
    share = np.array([12 * math.pi, 4 * math.pi])
    np.testing.assert_allclose(np.bincount(p.light) / 10000, share / share.sum(), atol=2e-4)
    for c in range(3):
        np.testing.assert_allclose(np.bincount(p.light, p.weight[:, c]), emission.flux[:, c], rtol=1e-3)


def test_a_scene_without_light_draws_nothing():
    emission = Emission(target())
    assert emission.is_dark
    assert len(emission.draw(100, np.random.default_rng(1)).origin) == 0
    assert emission.total.tolist() == [0, 0, 0]


def test_the_same_seed_draws_the_same_particles():
    emission = Emission(target(LAMPS["spread"][0]))
    a, b = (emission.draw(1000, np.random.default_rng(9)) for _ in range(2))
    assert np.array_equal(a.direction, b.direction) and np.array_equal(a.origin, b.origin)


def test_a_lamp_far_from_the_origin_is_placed_relative_to_the_scene():
    b = SceneBuilder()
    b.quad("Floor", (1e6, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.light(Light("Lamp", "point", COLOR, (1e6 + 0.5, 0.5, 1.0)))
    p = Emission(World(b.build())).draw(10, np.random.default_rng(1))
    np.testing.assert_allclose(p.origin, np.broadcast_to([0, 0, 1], (10, 3)), atol=1e-6)


def test_helpers_stay_in_their_domain():
    s = np.array([0.0, 1.0])
    assert np.isfinite(cone_directions(1.0, s, s)).all()
    x, y = disk(s, s)
    assert (x * x + y * y <= 1 + 1e-12).all()


def test_light_points_on_pictures_know_their_density():
    """Points drawn on a picture have the density that is told for them; dark parts, which may hide a bright spot, are drawn, too."""
    pixels = np.zeros((8, 8, 4), np.float32)
    pixels[5, 2:4] = 1
    world, rng, side = textured_panel(pixels), np.random.default_rng(1), np.full(2, 64)
    patches = Patches(side, radiance(world, np.arange(2), side).sum(axis=1))
    k = rng.integers(0, 2, 20_000)
    u, v, density = patches.sample(k, rng.random(len(k)), rng.random(len(k), np.float32))
    assert (np.abs(patches.density(k, u, v) / density - 1) < 1e-5).mean() > 0.999  # but for points on the edge of two parts
    assert 0.04 < patches.density(k, *(0.5 * rng.random((2, len(k))))).min() < 0.06
