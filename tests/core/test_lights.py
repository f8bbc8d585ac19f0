"""Every kind of light against its interface: one table, one row for each form of each kind.

What a light answers is held against what it answers elsewhere, so that a row needs no closed form: densities of drawn directions and of
given ones, radiance drawn and seen, and what the light puts on a plane and on a sphere when it is gathered from and when it shoots.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.area import AreaLights
from adjgi.adjoint_gi.core.lights.background import Background
from adjgi.adjoint_gi.core.lights.base import FAR, LampKind, LightKind
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.lights.mesh import MeshLights
from adjgi.adjoint_gi.core.lights.point import PointLights, near
from adjgi.adjoint_gi.core.lights.spot import SpotLights
from adjgi.adjoint_gi.core.lights.sun import SunLights
from adjgi.adjoint_gi.core.sampling import maps
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, RayKind, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.clusters import clusters
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.particles import walk

# Standard deviations that sound lights exceed once in a thousand runs of the about 400 comparisons here (Sidak).
Z = 4.8
COLOR = (3.0, 1.5, 0.5)
CELLS = 4  # the plane is compared in CELLS x CELLS squares
N = 200_000


def lamp(kind, **options):
    """Adds a tilted lamp about one metre above the origin."""
    c, s = math.cos(0.4), math.sin(0.4)
    axes = {"axis_y": (0.0, c, s), "axis_z": (0.0, -s, c)}
    return lambda b: b.light(Light("Light", kind, COLOR, (0.1, 0.2, 1.0), **axes, **options))


def mesh(*lobes):
    """Adds a tilted square, which emits what is given or a picture of four colours."""
    color = Color((Term((1.0, 1.0, 1.0), (Source("image", "UVMap", 0),)),))
    material = Material("Screen", (Lobe("emission", color),)) if not lobes else diffuse("Light", 0.0, COLOR)
    return lambda b: b.quad("Light", (-0.3, -0.2, 0.9), (0.6, 0, 0), (0, 0.5, 0.2), material)


def sky(b):
    """Sets the background."""
    b.background = COLOR


# Every form of every kind: what adds it to a scene, and its class.
LIGHTS = {
    "point": (lamp("point"), PointLights),
    "sphere": (lamp("point", radius=0.3), PointLights),
    "soft point": (lamp("point", radius=0.3, soft_falloff=True), PointLights),
    "spot": (lamp("spot", spot_angle=1.6), SpotLights),
    "blended spot": (lamp("spot", spot_angle=1.8, spot_blend=0.6), SpotLights),
    "elliptic spot": (lamp("spot", spot_angle=1.4, spot_blend=0.5, spot_scale=(0.6, 1.4)), SpotLights),
    "thin spot": (lamp("spot", spot_angle=2.0, spot_blend=0.4, spot_scale=(0.2, 20.0)), SpotLights),
    "wide spot": (lamp("spot", spot_angle=0.3, spot_blend=1.0, spot_scale=(300.0, 3.0)), SpotLights),
    "spot sphere": (lamp("spot", spot_angle=2.0, spot_blend=0.5, radius=0.2), SpotLights),
    "soft spot": (lamp("spot", spot_angle=2.0, spot_blend=0.5, radius=0.2, soft_falloff=True), SpotLights),
    "rectangle": (lamp("area", size_x=0.8, size_y=0.4), AreaLights),
    "ellipse": (lamp("area", size_x=0.8, size_y=0.4, shape="ELLIPSE"), AreaLights),
    "spread rectangle": (lamp("area", size_x=0.8, size_y=0.4, spread=1.4), AreaLights),
    "spread ellipse": (lamp("area", size_x=0.8, size_y=0.4, shape="ELLIPSE", spread=2.0), AreaLights),
    "sun": (lamp("sun"), SunLights),
    "sun disk": (lamp("sun", angle=0.8), SunLights),
    "background": (sky, Background),
    "mesh": (mesh("constant"), MeshLights),
    "picture": (mesh(), MeshLights),
}
# Those that no ray meets.
UNSIZED = ("point", "spot", "blended spot", "elliptic spot", "thin spot", "wide spot", "sun")


def scene(name):
    """A world with one light over a black square of side 2, and the light's kind."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    LIGHTS[name][0](b)
    pixels = np.array([[(1, 2, 3, 1), (4, 3, 2, 1)], [(2, 2, 2, 1), (0.5, 1, 0.5, 1)]], np.float32)
    world = World(replace(b.build(), textures=(Texture("Picture", pixels, "EXTEND", "Closest"),)))
    emitters = Emitters(world)
    (kind,) = (k for k in (emitters.mesh, *emitters.lamps.kinds, emitters.background) if k.sources())
    return world, kind


def drawn(kind, p, rng):
    """Samples for points `p` (3, n), picked by importance where there are several parts, and their density with the pick's."""
    n, total = p.shape[1], kind.importance.sum()
    i = rng.choice(len(kind.importance), n, p=kind.importance / total) if total > 0 else np.zeros(n, int)
    return kind.sample(i, p, *rng.random((2, n), np.float32))


def look(world, kind, o, w):
    """Radiance (3, n) that rays see of the light and the density of their directions (n,), 0 where they do not meet it."""
    n = w.shape[1]
    radiance, pdf = np.zeros((3, n), np.float32), np.zeros(n, np.float32)
    triangle, u, v, t = world.intersect(np.ascontiguousarray(o.T), np.ascontiguousarray(w.T), RayKind.CAMERA)
    if isinstance(kind, LampKind):
        # Samples are taken without shadows, so what stands in the way does not count.
        found = kind.seen(0, o, w, np.full(n, np.inf, np.float32))
        radiance[:, found.rows], pdf[found.rows] = found.radiance, found.pdf_w
    elif isinstance(kind, MeshLights):
        rows = np.flatnonzero((triangle >= 0) & np.isin(triangle, kind.triangles))
        radiance[:, rows] = kind.radiance(triangle[rows], u[rows], v[rows])
        pdf[rows] = kind.pdf_w(triangle[rows], w[:, rows], t[rows], u[rows], v[rows])
    else:
        radiance, pdf = kind.radiance(w), kind.pdf_w(w)
    return radiance, pdf


def eye(world, n):
    """The point (0.3, 0.4, 0.05) just above the plane, n times."""
    return np.repeat((np.array([0.3, 0.4, 0.05]) - world.center)[:, None], n, axis=1).astype(np.float32)


def agree(a, b, what):
    """Assert that two means (with their standard errors), (n,) each, agree within Z errors, and that the test could see 2 %."""
    (mean, error), (other, other_error) = a, b
    noise = np.hypot(error, other_error)
    assert noise.max() < 0.02 * np.abs(other).max(), f"{what}: too noisy to tell"
    far = np.abs(mean - other) > Z * noise + 2e-4 * np.abs(other).max()
    assert not far.any(), f"{what}: {mean[far]} +- {error[far]}, not {other[far]} +- {other_error[far]}"


def statistics(values):
    """Mean and standard error over the last axis."""
    return values.mean(axis=-1, dtype=float), values.std(axis=-1, dtype=float) / math.sqrt(values.shape[-1])


def test_every_kind_has_a_row():
    def below(cls):
        return {cls}.union(*map(below, cls.__subclasses__()))

    kinds = {c for c in below(LightKind) if c not in (LightKind, LampKind)}
    # Those of the product, whatever name it is loaded under; tests make others.
    home = LightKind.__module__.rpartition(".")[0]
    assert {cls for _, cls in LIGHTS.values()} == {c for c in kinds if c.__module__.startswith(home)}


@pytest.mark.parametrize("name", LIGHTS)
def test_of_its_class_with_one_name_and_power(name):
    world, kind = scene(name)
    assert type(kind) is LIGHTS[name][1] and kind.sized == (name not in UNSIZED)
    assert kind.names == (("Background" if name == "background" else "Light"),)
    assert kind.flux.shape == (1, 3) and (kind.flux > 0).all()
    np.testing.assert_allclose(kind.cells(0).sum(), kind.flux.sum(), rtol=1e-6)
    assert len(kind.shadow) == len(kind.importance) and kind.shadow.all()
    assert Emission(world).names == kind.names
    np.testing.assert_array_equal(Emission(world).flux, kind.flux)


@pytest.mark.parametrize("name", LIGHTS)
def test_radiance_and_density_of_a_direction_are_those_of_the_sample(name):
    world, kind = scene(name)
    o = eye(world, 20_000)
    s = drawn(kind, o, np.random.default_rng(1))
    np.testing.assert_allclose(np.linalg.norm(s.wi, axis=0), 1, atol=1e-5)
    assert all(x.dtype == np.float32 for x in s[:3]) and (s.pdf_w > 0).all() and (s.distance >= 0).all()
    lit = np.flatnonzero(s.radiance.max(axis=0) > 0)
    assert len(lit) > 500
    if not kind.sized:
        assert (s.pdf_w == 1).all()
        return
    radiance, pdf = look(world, kind, o[:, lit], np.ascontiguousarray(s.wi[:, lit]))
    met = pdf > 0
    assert met.mean() > 0.995  # the very rim is missed by rounding
    for a, b in ((pdf[met], s.pdf_w[lit][met]), (radiance[0, met], s.radiance[0, lit][met])):
        # A factor of the cosine at the rim of a sphere is ill conditioned, and so is the edge of a texel: all but 1 %.
        assert np.quantile(np.abs(a - b) / np.abs(b).max(), 0.99) < 1e-3


@pytest.mark.parametrize("name", [n for n in LIGHTS if n not in UNSIZED])
def test_densities_of_directions_integrate_to_the_samples(name):
    """Share and moments of drawn directions that are lit, against the integral of the density over all directions."""
    world, kind = scene(name)
    rng = np.random.default_rng(2)
    s = drawn(kind, eye(world, N), rng)
    w = maps.sphere(*rng.random((2, 4 * N), np.float32))
    radiance, pdf = look(world, kind, eye(world, 4 * N), w)
    pdf = pdf * (radiance.max(axis=0) > 0) * 4 * np.pi

    def moments(w, weight):
        return np.stack([weight, *(weight * w), *(weight * w * w)])

    agree(statistics(moments(s.wi, s.radiance.max(axis=0) > 0)), statistics(moments(w, pdf)), name)


@pytest.mark.parametrize("name", LIGHTS)
def test_gathering_and_shooting_put_the_same_light_on_a_plane(name):
    world, kind = scene(name)
    rng = np.random.default_rng(3)
    # Gathered: the irradiance at uniform points of each square, times its area.
    x, y = rng.random((2, N)) * 2 - 1
    p = (np.stack([x, y, np.zeros(N)]) - world.center[:, None]).astype(np.float32)
    s = drawn(kind, p, rng)
    value = s.radiance * (np.maximum(s.wi[2], 0) / s.pdf_w) * 4
    gathered = statistics(by_cell(x, y, value))
    # Shot: the power of the particles that cross it on their way down.
    emission, batches, many = Emission(world), 96, 8192
    shot = []
    for _ in range(batches):
        q = emission.draw(many, rng)
        o, d = q.origin + world.center, q.direction.astype(float)
        t = -o[:, 2] / np.where(d[:, 2] < 0, d[:, 2], -1)
        x, y = o[:, 0] + t * d[:, 0], o[:, 1] + t * d[:, 1]
        lands = (d[:, 2] < 0) & (t > q.dark) & (np.abs(x) < 1) & (np.abs(y) < 1)
        shot.append(by_cell(x[lands], y[lands], q.weight[lands].T).sum(axis=-1))
    agree(gathered, statistics(np.stack(shot, axis=-1)), name)


def surroundings(kind, options):
    """A world with black sheets below, within and across a lamp of radius 0.5."""
    b = SceneBuilder()
    black = diffuse("Black", 0.0)
    b.quad("Floor", (-0.6, -0.5, 0), (1, 0, 0), (0, 1, 0), black)
    b.quad("Within", (-0.2, -0.1, 0.9), (0.4, 0, 0), (0, 0.3, 0.05), black)
    b.quad("Across", (0.1, -0.1, 1.3), (0.5, 0, 0), (0, 0.3, 0.15), black)
    b.light(Light("Light", kind, COLOR, (0.05, 0.0, 1.1), radius=0.5, **options))
    return World(b.build())


@pytest.mark.parametrize("soft", [False, True], ids=["sphere", "soft"])
@pytest.mark.parametrize("kind, options", [("point", {}), ("spot", {"spot_angle": 2.0, "spot_blend": 0.5})], ids=["point", "spot"])
def test_gathering_and_shooting_put_the_same_light_on_what_lies_within_a_lamp(kind, options, soft):
    """With shadows: power on both sides of each sheet."""
    world = surroundings(kind, options | {"soft_falloff": soft})
    rng, n, batches = np.random.default_rng(6), 20_000, 24
    gathered, emitters = [], Emitters(world)
    for sheet in range(3):
        triangle, (u, v) = 2 * sheet + rng.integers(0, 2, n).astype(np.int32), maps.triangle(*rng.random((2, n), np.float32))
        normal = world.surface(triangle, u, v).ng
        for side in (1, -1):
            found, _ = direct_irradiance(world, emitters, world.surface(triangle, u, v, side * normal), 2, rng)
            gathered.append(statistics(found.T * world.area[2 * sheet : 2 * sheet + 2].sum()))
    emission, shot = Emission(world), np.zeros((6, 2, 3, batches))
    for batch in range(batches):

        def visit(hits, batch=batch):
            np.add.at(shot[..., batch], (hits.surface.triangle, (hits.surface.side < 0).astype(int)), hits.arriving)

        walk(world, emission.draw(8192, rng), 1, rng, visit)
    mean, error = statistics(shot.reshape(3, 2, 2, 3, batches).sum(axis=1))
    agree([np.concatenate(x) for x in zip(*gathered, strict=True)], (mean.ravel(), error.ravel()), kind)


@pytest.mark.parametrize("tip", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_face_is_near_a_lamp_whichever_of_its_corners_is(tip, sign):
    """A face whose tip alone lies in the sphere of the lamp, which is up, down or to a side of all the rest."""
    corners = np.roll(sign * np.array([(0, 0, 0), (-1, -2, -3), (-2, -1, -3)], float), tip, axis=0)
    b = SceneBuilder()
    b.mesh("Face", corners, [[0, 1, 2]], diffuse("Black", 0.0))
    world = World(b.build())
    beyond = sign * np.array([0.05, 0.05, 0.05])
    assert near(world, beyond - world.center, 0.2)
    assert not near(world, 10 * beyond - world.center, 0.2)


def even_directions(n, rng):
    """(3, n) unit directions: a golden-ratio lattice on the sphere, shifted at random."""
    k = np.arange(n)
    u, v = (k + rng.random()) / n, (k * 0.6180339887498949 + rng.random()) % 1
    return maps.sphere(u.astype(np.float32), v.astype(np.float32))


def by_cell(x, y, value):
    """(3 cells, n) values (3, n), each in the row of the square that (x, y) lies in, 0 in the others."""
    cell = ((x + 1) / 2 * CELLS).astype(int) * CELLS + ((y + 1) / 2 * CELLS).astype(int)
    out = np.zeros((CELLS**2, *value.shape))
    out[cell, :, np.arange(value.shape[1])] = value.T
    return out.reshape(-1, value.shape[1])


@pytest.mark.parametrize("name", LIGHTS)
def test_gathering_and_shooting_agree_about_power(name):
    """The irradiance on a sphere: a large one around a light, or the one around the scene that light from far away enters."""
    world, kind = scene(name)
    rng = np.random.default_rng(4)
    far = (drawn(kind, np.zeros((3, 1), np.float32), rng).distance >= FAR).all()
    radius, sign = (float(clusters(world).radius[0]), 1) if far else (30.0, -1)
    middle = np.zeros(3) if far else np.array([0.1, 0.2, 1.0]) - world.center
    gathered = []
    for _ in range(32):
        outward = even_directions(N // 32, rng)
        s = drawn(kind, (middle[:, None] + radius * outward).astype(np.float32), rng)
        cosine = np.maximum(sign * maps.dot(s.wi, outward), 0)
        gathered.append((s.radiance * (cosine / s.pdf_w)).mean(axis=1, dtype=float) * (4 * np.pi * radius**2))
    gathered = np.stack(gathered, axis=-1)
    emission = Emission(world)
    shot = np.stack([emission.draw(4096, rng).weight.sum(axis=0, dtype=float) for _ in range(16)], axis=-1)
    agree(statistics(gathered), statistics(shot), name)
    agree(statistics(gathered), (kind.flux[0], np.zeros(3)), name)


def test_a_background_that_varies_is_one_class(monkeypatch):
    """Blue above and red below, by replacing the two functions that know the radiance: the plane is lit by its half on each side."""
    top, bottom = np.array([[0.0], [0.0], [2.0]], np.float32), np.array([[1.0], [0.0], [0.0]], np.float32)
    monkeypatch.setattr(Background, "radiance", lambda self, w: np.where(w[2] > 0, top, bottom))
    world, kind = scene("background")
    emitters = Emitters(world)
    w = np.array([[0, 0, 1], [0, 0.6, -0.8]], np.float32)
    np.testing.assert_array_equal(emitters.escaping(w), [(0, 0, 2), (1, 0, 0)])
    for side, expected in ((1, (0, 0, 2)), (-1, (1, 0, 0))):
        triangle = np.zeros(64, np.int32)
        surface = world.surface(triangle, *np.full((2, 64), 0.3, np.float32), towards=np.tile([[0, 0, float(side)]], (64, 1)))
        found, _ = direct_irradiance(world, emitters, surface, 4, np.random.default_rng(0))
        np.testing.assert_allclose(found, np.tile(np.pi * np.array(expected), (64, 1)), rtol=1e-5)


@pytest.mark.parametrize("mesh_lights", [True, False])
@pytest.mark.parametrize("others", [[], ["point"], ["mesh", "sphere"]], ids="-".join)
def test_a_background_that_light_points_find_lights_the_same(others, mesh_lights, monkeypatch):
    """With an importance it joins the table, and rays that escape are weighted for it."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    for name in ["background", *others]:
        LIGHTS[name][0](b)
    world = World(b.build())
    surface = world.surface(np.zeros(N, np.int32), *np.full((2, N), 0.3, np.float32))
    found = []
    for importance in (0.0, 20.0):
        monkeypatch.setattr(Background, "importance", np.full(1, importance))
        emitters = Emitters(world)
        assert emitters.draws_background == (importance > 0)
        value, _ = direct_irradiance(world, emitters, surface, 4, np.random.default_rng(5), mesh_lights)
        found.append(statistics(value.T))
    agree(*found, "background")
    if not others:
        agree(found[1], (np.pi * np.array(COLOR), np.zeros(3)), "closed form")


def test_a_background_below_zero_is_black_in_that_channel():
    found = []
    for color in ((-1.0, 0.5, 0.0), (-1.0, -0.5, 0.0)):
        b = SceneBuilder()
        b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
        b.background = color
        found.append(Background(World(b.build())))
    assert [f.any for f in found] == [True, False]
    assert found[0].radiance(np.array([[0.0], [0.0], [1.0]], np.float32))[:, 0].tolist() == [0, 0.5, 0]
    assert found[0].flux[0, 0] == 0 and found[0].flux[0, 1] > 0 and not found[1].flux.any()


def test_rays_see_a_sun_where_they_look_into_it_and_nothing_hides_it():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
    suns = SunLights([Light("Sun", "sun", (1.0, 1.0, 1.0), angle=1.0)], World(b.build()))
    tilt = np.array([0.0, 0.0, 0.49, 0.51, np.pi])
    w = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)]).astype(np.float32)
    distance = np.array([np.inf, 3.0, np.inf, np.inf, np.inf], np.float32)
    assert suns.seen(0, np.zeros((3, 5), np.float32), w, distance).rows.tolist() == [0, 2]
    assert suns.color[:, 0] == pytest.approx(np.full(3, 1 / (np.pi * np.sin(0.5) ** 2)), rel=1e-5), (
        "a facing surface gets an irradiance of 1"
    )
