"""Local illumination against closed forms: points, areas, highlights, shadows, ambient light."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf.cook_torrance import coat_curve, cook_torrance, reflected_base
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.lights.light_points import LightPoints, exponent, phong_lobe
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import local_illumination  # noqa: F401
from adjgi.tests import scenes, solving
from adjgi.tests.surface_points import receivers_at

solve = partial(solving.solve, "local_illumination")


def floor(*lights, material=None, extra=None):
    b = SceneBuilder()
    b.quad("Floor", (-4, -4, 0), (8, 0, 0), (0, 8, 0), material or diffuse("Floor", 0.5))
    for light in lights:
        b.light(light)
    if extra:
        extra(b)
    return b


def irradiance(b, points, **options):
    world = World(b.build())
    return solve(world, receivers_at(world, points), **options).quantity("irradiance")[:, 0]


CIE_5_2 = {
    (0, 0): 111.1111,
    (0.5, 0): 105.1863,
    (1, 0): 90.0,
    (1.5, 0): 71.1111,
    (0.5, 0.5): 99.7230,
    (1, 0.5): 85.6633,
    (1.5, 0.5): 68.0529,
    (1, 1): 74.3802,
    (1.5, 1): 59.9750,
    (1.5, 1.5): 49.3827,
}


def test_cie_171_case_5_2():
    """A Lambertian point source of 1000 cd at 3 m, as a square of 1 cm: E = 1000 * 9 / d^4."""
    side = 0.01
    lamp = Light("Lamp", "area", (1000 / side**2,) * 3, (0, 0, 3), size_x=side, size_y=side)
    found = irradiance(floor(lamp), [(x, y, 0) for x, y in CIE_5_2], light_points=1)
    np.testing.assert_allclose(found, list(CIE_5_2.values()), rtol=1e-4)


def test_isotropic_point_lamp():
    """E = I cos / d^2 (Eq. 7)."""
    points = [(x, 0.3, 0) for x in (0, 0.7, 2.0, 3.5)]
    found = irradiance(floor(Light("Lamp", "point", (7, 7, 7), (0, 0, 2))), points)
    expected = [7 * 2 / (x * x + 0.09 + 4) ** 1.5 for x, _, _ in points]
    np.testing.assert_allclose(found, expected, rtol=2e-5)  # rays start 8e-6 m above the floor


@pytest.mark.parametrize(("at", "factor"), [((0.5, 0.5), 0.23945647046077354), ((0, 0), 0.13853160599489298)])
def test_area_lamp_within_the_error_of_the_sum(at, factor):
    """Unit square at distance 1: the error of the sum over light points falls, to half a percent at 256."""
    lamp = Light("Lamp", "area", (2, 2, 2), (0.5, 0.5, 1), size_x=1, size_y=1)
    errors = [abs(irradiance(floor(lamp), [(*at, 0)], light_points=k)[0] / (2 * math.pi * factor) - 1) for k in (1, 16, 256)]
    assert errors[0] < 0.5
    assert errors[1] < 0.15
    assert errors[2] < 0.005


def test_emissive_mesh_within_the_error_of_the_sum():
    """CIE 171 case 5.3: floor points below a ceiling panel of 1 x 1 m, 1000 cd/m2."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), diffuse("Black", 0))
    b.quad("Panel", (1.5, 1.5, 3), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0, 1000))
    found = irradiance(b, [(2, y, 0) for y in (0.25, 0.75, 1.25, 1.75)], light_points=256)
    np.testing.assert_allclose(found, [61.4241, 79.2552, 95.6673, 105.7782], rtol=0.005)


def test_shadows_on_and_off():
    blocker = lambda b: b.quad("Blocker", (-0.5, -0.5, 1), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))  # noqa: E731
    b = floor(Light("Lamp", "point", (5, 5, 5), (0, 0, 2)), extra=blocker)
    points = [(0.2, 0.1, 0), (3, 0, 0)]
    lit = irradiance(b, points, shadows=False)
    shaded = irradiance(b, points)
    assert shaded[0] == 0
    assert lit[0] == pytest.approx(5 * 2 / (0.05 + 4) ** 1.5, rel=1e-5)
    assert shaded[1] == lit[1] > 0


def looking_down(b, kind="orthographic"):
    """A camera of one pixel that sees the origin of the floor from (3, 0, 4), by one ray."""
    f = np.array((-0.6, 0, -0.8))
    b.camera = Camera(kind, (3, 0, 4), (0, 1, 0), tuple(np.cross((0, 1, 0), f)), tuple(f), (-1e-4, 1e-4, -1e-4, 1e-4), 1, 1)
    world = World(b.build())
    return world, CameraReceivers(world, grid=1)


def test_ambient_is_uniform_and_counts_as_indirect():
    b = floor()
    world = World(b.build())
    found = solve(world, receivers_at(world, [(1, 1, 0)]), ambient=0.3)
    np.testing.assert_allclose(found.indirect, math.pi * 0.3, rtol=1e-6)
    assert (found.direct == 0).all()
    world, camera = looking_down(b)
    np.testing.assert_allclose(solve(world, camera, ambient=0.3).quantity("radiance"), 0.5 * 0.3, rtol=1e-6)
    assert (solve(world, camera, ambient=0.3, max_length=1).quantity("radiance") == 0).all()


@pytest.mark.parametrize("method", ["local_illumination", "whitted"])
def test_ambient_light_has_a_colour(method):
    """L_a of Eq. 6 to 9 for each channel: radiance times colour, on a texel and in a picture."""
    world, camera = looking_down(floor())
    options = {"ambient": 0.3, "ambient_color": (1.0, 0.5, 0.0)}
    seen = solving.solve(method, world, camera, **options).quantity("radiance")
    np.testing.assert_allclose(seen[0], [0.15, 0.075, 0.0], rtol=1e-6)
    arrives = solving.solve(method, world, receivers_at(world, [(1, 1, 0)]), **options).indirect
    np.testing.assert_allclose(arrives[0], np.pi * np.array([0.3, 0.15, 0.0]), rtol=1e-6)


@pytest.mark.parametrize("model", ["bouknight", "phong", "cook", "cook_torrance"])
def test_reflection_models(model):
    """Eq. 7, 8, the review's form for Cook et al. and the model of 1982 by hand: lamp 20 degrees beside the mirror direction."""
    roughness, ks, kd, intensity = 0.5, 0.3, 0.4, 9.0
    shiny = Material("Shiny", (Lobe("diffuse", Color.of(kd)), Lobe("glossy", Color.of(ks), roughness)))
    wo = np.array((0.6, 0, 0.8))
    angle = math.acos(0.8) - math.radians(20)
    wi = np.array((-math.sin(angle), 0, math.cos(angle)))
    world, camera = looking_down(floor(Light("Lamp", "point", (intensity,) * 3, tuple(2.5 * wi)), material=shiny))
    found = solve(world, camera, model=model).quantity("radiance")[0, 0]
    n = (2 / roughness**4 - 2) / 4
    beam = intensity / 2.5**2
    alpha = math.acos(wo @ (wi * (-1, 1, 1)))
    assert math.degrees(alpha) == pytest.approx(20, abs=1e-4)
    highlight = ks * (n + 2) / (2 * math.pi) * math.cos(alpha) ** n
    # 1982: the half vector leans by 10 degrees; a lobe of one colour has it at all angles; nothing is masked here.
    lean, slope = math.radians(10), roughness**2
    beckmann = math.exp(-((math.tan(lean) / slope) ** 2)) / (math.pi * slope**2 * math.cos(lean) ** 4)
    facets = ks * beckmann / (4 * wi[2] * wo[2])
    expected = {
        "bouknight": kd / math.pi * beam * wi[2],
        "phong": beam * (kd / math.pi * wi[2] + highlight),
        "cook": beam * wi[2] * (kd / math.pi + highlight),
        "cook_torrance": beam * wi[2] * (kd / math.pi + facets),
    }
    assert found == pytest.approx(expected[model], rel=2e-4)


def test_phong_lobe_reflects_its_share():
    """The lobe (n + 2) / 2 pi cos^n alpha times the cosine, integrated at normal incidence, is k_s."""
    for roughness in (0.3, 0.6, 0.9):
        world = World(floor(material=Material("G", (Lobe("glossy", Color.of(0.7), roughness),))).build())
        z = (np.arange(20_000) + 0.5) / 20_000
        n = len(z)
        wi = np.stack([np.sqrt(1 - z * z), np.zeros(n), z], axis=1).astype(np.float32)
        up = np.tile(np.array((0, 0, 1), np.float32), (n, 1))
        at = np.zeros(n, np.int32), np.full(n, 0.2, np.float32), np.full(n, 0.2, np.float32)
        lobes = BsdfTable(world.scene).at(*at, up, np.ones(n, np.float32), up)
        total = 2 * math.pi * (phong_lobe(lobes, wi)[:, 0].astype(float) * z).mean()
        assert total == pytest.approx(0.7, rel=2e-3)


def test_the_highlight_of_a_coat_has_what_glass_reflects_straight_on():
    """((n - 1) / (n + 1))^2 of index 1.5 is 0.04, of 2 it is 1/9; mirrored, the lobe is (m + 2) / 2 pi times that."""
    for ior, expected in ((1.5, 0.04), (2.0, 1 / 9)):
        world = World(floor(material=Material("C", (Lobe("specular", Color.of(1.0), 0.5, ior=ior),))).build())
        up = np.array([(0, 0, 1)], np.float32)
        at = np.zeros(1, np.int32), np.full(1, 0.2, np.float32), np.full(1, 0.2, np.float32)
        lobes = BsdfTable(world.scene).at(*at, up, np.ones(1, np.float32), up)
        found = phong_lobe(lobes, up)[0, 0] * 2 * math.pi / (exponent(np.array([0.5]))[0] + 2)
        assert found == pytest.approx(expected, rel=1e-3)


def facets_of(lobe, wo, wi):
    """(n,) red of Cook and Torrance's Rs for directions (n, 3) over a floor of one lobe."""
    world = World(floor(material=Material("F", (lobe,))).build())
    n = len(wi)
    up = np.tile(np.array((0, 0, 1), np.float32), (n, 1))
    at = np.zeros(n, np.int32), np.full(n, 0.2, np.float32), np.full(n, 0.2, np.float32)
    return cook_torrance(BsdfTable(world.scene).at(*at, up, np.ones(n, np.float32), wo.astype(np.float32)), wi.astype(np.float32))[:, 0]


def slanted(degrees):
    angle = np.radians(np.atleast_1d(np.float64(degrees)))
    return np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)


def test_cook_and_torrance_mask_facets_at_grazing_angles():
    """G = 2 (n.h) (n.wo) / (wo.h) for wo at 80 and wi at 0 degrees on the other side of nothing: h leans by 40."""
    slope = 0.6**2
    found = facets_of(Lobe("glossy", Color.of(1.0), 0.6), slanted(80), slanted(0))[0]
    lean = math.radians(40)
    d = math.exp(-((math.tan(lean) / slope) ** 2)) / (math.pi * slope**2 * math.cos(lean) ** 4)
    g = 2 * math.cos(lean) * math.cos(math.radians(80)) / math.cos(lean)
    assert g < 0.4 and found == pytest.approx(d * g / (4 * math.cos(math.radians(80))), rel=1e-3)


@pytest.mark.parametrize(("kind", "ior"), [("metallic", 1.0), ("specular", 1.5)])
def test_cook_and_torrance_have_fresnels_equations(kind, ior):
    """In the mirror direction of 75 degrees: 0.2531 at index 1.5 by Fresnel; a metal of the reflectance 0.04 is taken for that index."""
    lobe = Lobe(kind, Color.of(0.04 if kind == "metallic" else 1.0), 0.3, ior)
    ratio = facets_of(lobe, slanted(75), slanted(-75)) / facets_of(Lobe("glossy", Color.of(1.0), 0.3), slanted(75), slanted(-75))
    assert ratio[0] == pytest.approx(0.2531, abs=2e-4)


@pytest.mark.parametrize("roughness", [0.3, 0.6])
def test_cook_and_torrances_facets_are_reciprocal_and_make_no_light(roughness):
    """At normal incidence white facets send back nearly all that they receive."""
    rng = np.random.default_rng(1)
    w = rng.normal(size=(2, 2000, 3))
    w[:, :, 2] = np.abs(w[:, :, 2]) + 0.02
    a, b = w / np.linalg.norm(w, axis=2, keepdims=True)
    lobe = Lobe("glossy", Color.of(1.0), roughness)
    assert np.allclose(facets_of(lobe, a, b), facets_of(lobe, b, a), rtol=2e-3, atol=1e-5)
    z = (np.arange(20_000) + 0.5) / 20_000
    phi = 2 * np.pi * ((np.arange(20_000) * 0.618034) % 1)
    wi = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    for degrees, least in ((0, 0.93), (60, 0.8), (85, 0.3)):
        total = 2 * math.pi * (facets_of(lobe, np.repeat(slanted(degrees), len(wi), axis=0), wi).astype(float) * z).mean()
        assert least < total < 1.005


COATS = {
    "0.3": [Lobe("diffuse", Color.of(1.0), stack=1), Lobe("specular", Color.of(1.0), 0.3, 1.5, stack=1)],
    "0.5, index 2.5": [Lobe("diffuse", Color.of(1.0), stack=1), Lobe("specular", Color.of(1.0), 0.5, 2.5, stack=1)],
    "1": [Lobe("diffuse", Color.of(1.0), stack=1), Lobe("specular", Color.of(1.0), 1.0, 1.5, stack=1)],
    "tinted": [Lobe("diffuse", Color.of(1.0), stack=1), Lobe("specular", Color.of(1.0, 0.5, 0.0), 0.5, 1.5, stack=1)],
    "half": [
        Lobe("diffuse", Color.of(1.0), stack=1, weight=0.5),
        Lobe("specular", Color.of(1.0), 0.5, 1.5, stack=1, weight=0.5),
        Lobe("diffuse", Color.of(1.0), weight=0.5),
    ],
}


@pytest.mark.parametrize("degrees", [0, 60, 80, 85, 89.5])
@pytest.mark.parametrize("name", COATS)
def test_cook_and_torrances_coat_over_a_white_base_loses_and_makes_no_light(name, degrees):
    """In a furnace of 1, by 200,000 directions; the base was not dimmed: 1.04, 1.08, 1.23 at 0, 60, 80 degrees. At 89.5 it may lose 5 %."""
    b = floor(material=Material("Coated", tuple(COATS[name])))
    world, n = World(b.build()), 200_000
    table = BsdfTable(world.scene)
    table.coats = table.coats.by(coat_curve)
    z = ((np.arange(n) + 0.5) / n) ** 2  # closer together at grazing angles
    phi, density = 2 * np.pi * ((np.arange(n) * 0.618034) % 1), 0.5 / np.sqrt(z)
    wi = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1).astype(np.float32)
    at, up = (np.zeros(n, np.int32), np.full(n, 0.2, np.float32), np.full(n, 0.2, np.float32)), np.tile(np.float32([0, 0, 1]), (n, 1))
    lobes = table.at(*at, up, np.ones(n, np.float32), np.repeat(slanted(degrees), n, axis=0).astype(np.float32))
    total = reflected_base(lobes, wi) / np.pi + cook_torrance(lobes, wi)
    sent = 2 * np.pi * (z[:, None] / density[:, None] * total).mean(axis=0)
    assert (sent < 1.003).all() and (sent > (0.997 if degrees <= 85 else 0.95)).all()


@pytest.mark.parametrize("degrees", [0, 60, 80])
def test_the_method_makes_no_light_of_a_coat(degrees):
    """The same through a picture under 400 suns."""
    n = 400
    z, phi = (np.arange(n) + 0.5) / n, 2.399963 * np.arange(n)
    b = floor(material=Material("Coated", tuple(COATS["1"])))
    for w in np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1):
        x = np.cross(w, (0, 1, 0.01))
        x /= np.linalg.norm(x)
        b.light(Light("Sun", "sun", (2 * np.pi / n,) * 3, axis_x=tuple(x), axis_y=tuple(np.cross(w, x)), axis_z=tuple(w)))
    d = -slanted(degrees)[0]
    b.camera = Camera("orthographic", tuple(-4 * d), (0, 1, 0), tuple(np.cross((0, 1, 0), d)), tuple(d), (-1e-4, 1e-4, -1e-4, 1e-4), 1, 1)
    world = World(b.build())
    found = solve(world, CameraReceivers(world, grid=1), model="cook_torrance").quantity("radiance")
    assert found == pytest.approx(np.ones((1, 3)), abs=0.01)


def test_emission_is_seen_and_lengths_choose():
    world = World(scenes.cornell(24, 24))
    camera = CameraReceivers(world)
    whole = solve(world, camera, ambient=0.2)
    assert whole.emitted.max() == pytest.approx(15, rel=1e-5)
    one = solve(world, camera, ambient=0.2, min_length=1, max_length=1)
    assert (one.emitted == 0).all()
    assert (one.indirect == 0).all()
    np.testing.assert_array_equal(one.direct, whole.direct)


def test_one_light_point_stands_in_the_middle_of_what_is_emitted():
    """Of panels side by side of powers 1, 6 and 2 the one that half of the power lies before; its sum is that of the whole."""
    b = SceneBuilder()
    for k, level in enumerate((1.0, 6.0, 2.0)):
        b.quad(f"Panel {k}", (k - 0.5, -0.5, 10), (0, 1, 0), (1, 0, 0), diffuse(f"Panel {k}", 0.0, level))
    b.quad("Floor", (-9, -9, 0), (18, 0, 0), (0, 18, 0), diffuse("Floor", 0.5))
    world = World(b.build())
    points = receivers_at(world, [(0.5, 0.5, 0)])
    surface = world.surface(points.triangle, points.u, points.v)
    ((wi, cosine, radiance, weight, cast),) = LightPoints(Emitters(world), 1).at(world, surface, True)
    assert 0 < 10 * wi[0, 0] / wi[0, 2] < 1 and cast == 1  # from x = 0.5 to the middle panel, which lies between 0.5 and 1.5
    assert (radiance * (cosine * weight)[:, None]).mean() == pytest.approx(0.09, rel=0.03)
