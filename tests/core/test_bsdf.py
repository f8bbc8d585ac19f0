"""Every lobe: `sample` follows its pdf (chi-square), energy is not made, reciprocity holds, delta lobes are exact."""

from dataclasses import dataclass

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import lobes as kinds
from adjgi.adjoint_gi.core.bsdf import microfacet
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.bsdf.curves import Mixture
from adjgi.adjoint_gi.core.bsdf.diffuse import local_cosine_directions
from adjgi.adjoint_gi.core.bsdf.lobe import LobeView
from adjgi.adjoint_gi.core.directional.bins import Bins
from adjgi.adjoint_gi.core.directional.scattering import Scattering
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, RayKind
from adjgi.adjoint_gi.core.scene.shading import Shading
from adjgi.adjoint_gi.core.scene.substitutes import as_diffuse
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.radiance import evenly

C = Color.of
ROUGH = {
    "diffuse": [Lobe("diffuse", C(0.5))],
    "glossy": [Lobe("glossy", C(0.9), 0.5)],
    "metallic": [Lobe("metallic", C(0.9, 0.6, 0.2), 0.4)],
    "coated": [Lobe("diffuse", C(0.8)), Lobe("specular", C(1), 0.4, 1.45)],
    "glass": [Lobe("glass", C(1), 0.5, 1.5)],
    "dielectric": [Lobe("dielectric", C(0.9), 0.5, 1.5)],
    "white and gold glass": [Lobe("glass", C(0.9, 0.6, 0.3), 0.4, 1.5), Lobe("dielectric", C(0.1, 0.4, 0.7), 0.4, 1.5)],
    "refraction": [Lobe("refraction", C(0.9), 0.4, 1.5)],
    "glossy, many bounces": [Lobe("glossy", C(0.9), 0.8, multiscatter=True)],
    "tinted metal": [Lobe("tinted metallic", C(0.9, 0.6, 0.2), 0.4, edge=C(0.2, 0.5, 1.0))],
    "tinted metal, many bounces": [Lobe("tinted metallic", C(0.9, 0.6, 0.0), 0.7, multiscatter=True, edge=C(0.0, 0.5, 0.1))],
    "metallic, many bounces": [Lobe("metallic", C(0.9, 0.6, 0.2), 0.7, multiscatter=True)],
    "glass, many bounces": [Lobe("glass", C(1), 0.8, 1.5, multiscatter=True)],
    "rough diffuse": [Lobe("rough diffuse", C(0.9), 0.8)],
    "rough diffuse, many bounces": [Lobe("rough diffuse", C(0.9, 0.6, 0.3), 1.0, multiscatter=True)],
    "coated rough diffuse": [Lobe("rough diffuse", C(0.8), 0.5, multiscatter=True), Lobe("specular", C(1), 0.4, 1.45)],
    "mix": [Lobe("diffuse", C(0.3)), Lobe("glossy", C(0.3), 0.6), Lobe("glass", C(0.3), 0.5, 1.3)],
}
CASES = [(name, mu, side) for name in ROUGH for mu in (0.9, 0.4) for side in (1.0, -1.0)]
ALPHA = 1e-3


def lobes_at(lobes, wo, side=1.0):
    b = SceneBuilder()
    b.quad("Quad", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("M", tuple(lobes)))
    table = bsdf.BsdfTable(b.build(), straight=True)
    n = len(wo)
    u = np.full(n, 0.2, np.float32)
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    return table.at(np.zeros(n, np.int32), u, u, up, np.full(n, side, np.float32), np.asarray(wo, np.float32))


def view(mu, n):
    return np.tile(np.float32([np.sqrt(1 - mu * mu), 0, mu]), (n, 1))


@dataclass(frozen=True)
class Measured:
    """A material seen from one direction: directions drawn of it, and its density and reflected light on a grid over the sphere."""

    samples: bsdf.Scattered
    pdf: np.ndarray  # (ROWS * SUB, COLUMNS * SUB)
    light: np.ndarray  # (ROWS * SUB * COLUMNS * SUB, 3)


N = 200_000
ROWS, COLUMNS, SUB = 16, 16, (37, 13)  # cells of the chi-square test, points in each; the limit of a smooth error of the density is 2 %


@pytest.fixture(scope="module")
def measured(request):
    """One case for all tests that need it: pytest runs these one after another."""
    name, mu, side = request.param
    if name == "refraction" and side < 0 and mu < 0.7:
        mu = 0.9  # beyond the critical angle nothing is transmitted
    z = 2 * (np.arange(ROWS * SUB[0]) + 0.5) / (ROWS * SUB[0]) - 1
    phi = 2 * np.pi * (np.arange(COLUMNS * SUB[1]) + 0.5) / (COLUMNS * SUB[1])
    zz, pp = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - zz**2)
    wi = np.stack([r * np.cos(pp), r * np.sin(pp), zz], 1).astype(np.float32)
    light, pdf = bsdf.evaluate(lobes_at(ROUGH[name], view(mu, len(wi)), side), wi)
    samples = bsdf.sample(lobes_at(ROUGH[name], view(mu, N), side), np.random.default_rng(7))
    return Measured(samples, pdf.reshape(len(z), len(phi)), light)


every_case = pytest.mark.parametrize("measured", CASES, indirect=True, ids=lambda case: "-".join(map(str, case)))


def chi_square(m):
    """Standard deviations by which sampled directions miss the integrated density, cells with few expected counts pooled."""
    w = m.samples.wi[m.samples.pdf_w > 0]
    i = np.clip(((w[:, 2] + 1) / 2 * ROWS).astype(int), 0, ROWS - 1)
    j = np.clip(((np.arctan2(w[:, 1], w[:, 0]) / (2 * np.pi)) % 1 * COLUMNS).astype(int), 0, COLUMNS - 1)
    seen = np.bincount(i * COLUMNS + j, minlength=ROWS * COLUMNS)
    cell = 4 * np.pi / (ROWS * COLUMNS)
    expected = m.pdf.reshape(ROWS, SUB[0], COLUMNS, SUB[1]).mean(axis=(1, 3), dtype=np.float64).ravel() * cell * N
    order = np.argsort(expected)
    pooled = expected[order] < 50
    keep = order[~pooled]
    e = np.append(expected[keep], expected[order[pooled]].sum())
    s = np.append(seen[keep], seen[order[pooled]].sum())
    e, s = (e[:-1], s[:-1]) if e[-1] < 50 else (e, s)
    statistic = ((s - e) ** 2 / e).sum()
    k = len(e) - 1
    # Wilson and Hilferty's normal form of chi-square, good for many degrees of freedom.
    return ((statistic / k) ** (1 / 3) - (1 - 2 / (9 * k))) / np.sqrt(2 / (9 * k))


@every_case
def test_samples_follow_their_density(measured):
    z = chi_square(measured)
    assert z < 4.4, f"chi-square is {z:.1f} standard deviations off"


@pytest.mark.parametrize("number", range(len(kinds.LOBES)), ids=[kind.name for kind in kinds.LOBES])
def test_every_kind_has_a_case_here_and_draws_nothing_without_a_density(number):
    """What the table says of a kind is what its samples do: it reflects or passes, and is smooth below the alpha that it names."""
    kind = kinds.LOBES[number]
    dense = kind.delta_below < np.inf
    assert dense == any(lobe.kind == kind.name for lobes in ROUGH.values() for lobe in lobes)
    n = 20_000
    for roughness in (0.0, 0.5):
        drawn = bsdf.sample(lobes_at([Lobe(kind.name, C(0.8), roughness, 1.5)], view(0.6, n)), np.random.default_rng(9))
        lit = drawn.weight.max(axis=1) > 0
        assert drawn.delta[lit].all() == (roughness**2 < kind.delta_below)
        assert drawn.through[lit].any() == kind.passes
        assert (~drawn.through[lit]).any() == (kind.reflects or not kind.passes)
        reflected = RayKind.DIFFUSE if kind.nearly_diffuse or kind.name == "diffuse" else RayKind.GLOSSY
        assert (drawn.kind[lit] == np.where(drawn.through[lit], RayKind.TRANSMISSION, reflected)).all()
        assert (drawn.pdf_w[lit] > 0).all() != drawn.delta[lit].all()


@every_case
def test_density_integrates_to_the_share_that_is_drawn(measured):
    """To 1, less what facets send into the surface; by a grid over the sphere."""
    density = measured.pdf.mean(dtype=float) * 4 * np.pi
    drawn = (measured.samples.pdf_w > 0).mean()
    assert density == pytest.approx(drawn, abs=4 * np.sqrt(drawn * (1 - drawn) / N) + 0.002)
    assert density < 1.002


@every_case
def test_albedo_by_sampling_equals_albedo_by_integration_and_makes_no_energy(measured):
    """The grid is exact to 0.05 % where random directions over the sphere had errors up to 2 %."""
    drawn = measured.samples.weight.astype(np.float64)
    integral = measured.light.mean(axis=0, dtype=np.float64) * 4 * np.pi
    mean, error = drawn.mean(axis=0), drawn.std(axis=0) / np.sqrt(N)
    assert (np.abs(mean - integral) < 4.5 * error + 5e-4 * integral + 1e-4).all()
    assert (mean < 1 + 4 * error + 1e-3).all()
    assert (drawn >= 0).all() and np.isfinite(drawn).all()


@pytest.mark.parametrize("name", [name for name in ROUGH if "glass" not in name and name != "refraction"])
def test_reflection_is_reciprocal(name):
    rng = np.random.default_rng(5)
    w = rng.normal(size=(2, 5000, 3))
    w[:, :, 2] = np.abs(w[:, :, 2]) + 0.05
    a, b = (w / np.linalg.norm(w, axis=2, keepdims=True)).astype(np.float32)
    forward = bsdf.evaluate(lobes_at(ROUGH[name], a), b)[0] / b[:, 2:]
    back = bsdf.evaluate(lobes_at(ROUGH[name], b), a)[0] / a[:, 2:]
    assert np.allclose(forward, back, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("name", ["glass", "glass, many bounces"])
def test_refraction_is_reciprocal_in_basic_radiance(name):
    rng = np.random.default_rng(6)
    w = rng.normal(size=(2, 5000, 3))
    w[0, :, 2] = np.abs(w[0, :, 2]) + 0.3
    w[1, :, 2] = -np.abs(w[1, :, 2]) - 0.3
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in w)
    flip = np.float32([1, 1, -1])
    out = bsdf.evaluate(lobes_at(ROUGH[name], a, 1.0), b.astype(np.float32))[0] / np.abs(b[:, 2:])
    # The same pair seen from the other side: the frame is turned over, so z changes sign.
    back = bsdf.evaluate(lobes_at(ROUGH[name], b * flip, -1.0), (a * flip).astype(np.float32))[0] / np.abs(a[:, 2:])
    # f(o, i) / n_i^2 is symmetric: with the index on the side of wi in the numerator the two differ by 1.5^2.
    good = out[:, 0] > 1e-3
    assert good.sum() > 100
    assert np.allclose(out[good, 0], back[good, 0] * 1.5**2, rtol=5e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("mu", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("lobe", [("glossy", 0.3), ("glossy", 1.0), ("metallic", 0.6), ("glass", 0.3), ("glass", 1.0)], ids=str)
def test_white_facets_lose_nothing_when_all_bounces_count(lobe, mu, side):
    kind, roughness = lobe
    n = 60_000
    once, many = (
        bsdf.sample(lobes_at([Lobe(kind, C(1), roughness, 1.5, m)], view(mu, k), side), np.random.default_rng(2)).weight[:, 0].astype(float)
        for m, k in ((False, 200_000), (True, n))
    )
    assert abs(many.mean() - 1) < 4 * many.std() / np.sqrt(n) + 0.006
    assert once.mean() < 0.999


def test_coloured_facets_absorb_at_every_bounce():
    """Grey facets of reflectance F that reflect a share E at once: F E + F m (1 - E), m = F E / (1 - F (1 - E)), in the mean."""
    n = 400_000
    mu = np.sqrt((np.arange(n) + 0.5) / n).astype(np.float32)  # by the cosine
    wo = np.stack([np.sqrt(1 - mu * mu), np.zeros_like(mu), mu], 1)

    def albedo(color, many):
        lobes = lobes_at([Lobe("glossy", C(color), 0.9, multiscatter=many)], wo)
        return bsdf.sample(lobes, np.random.default_rng(4)).weight[:, 0].mean(dtype=float)

    single = albedo(1.0, False)
    kept = 0.5 * single / (1 - 0.5 * (1 - single))
    assert albedo(0.5, True) == pytest.approx(0.5 * single + 0.5 * kept * (1 - single), rel=0.004)


def test_mirror_and_glass_without_roughness_are_exact():
    n = 200_000
    wo = view(0.6, n)
    rng = np.random.default_rng(1)
    mirror = bsdf.sample(lobes_at([Lobe("glossy", C(0.9), 0.0)], wo), rng)
    assert mirror.delta.all() and np.allclose(mirror.weight, 0.9, atol=1e-5)
    assert np.allclose(mirror.wi, wo * [-1, -1, 1], atol=1e-5)
    glass = bsdf.sample(lobes_at([Lobe("glass", C(1), 0.0, 1.5)], wo), rng)
    share = microfacet.fresnel(np.float32([0.6]), np.float32([1.5]))[0]
    reflected = (~glass.through).mean()
    assert abs(reflected - share) < 4 * np.sqrt(share * (1 - share) / n)
    assert np.allclose(np.linalg.norm(glass.wi[glass.through, :2], axis=1), 0.8 / 1.5, atol=1e-4)
    assert np.allclose(glass.weight, 1, atol=1e-5)


def test_total_reflection_inside_glass():
    wo = view(0.3, 1000)
    glass = bsdf.sample(lobes_at([Lobe("glass", C(1), 0.0, 1.5)], wo, side=-1.0), np.random.default_rng(1))
    assert not glass.through.any() and np.allclose(glass.weight, 1, atol=1e-5)


@pytest.mark.parametrize("roughness", [0.0, 0.4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_coloured_glass_reflects_white_with_a_dielectric_lobe(roughness, side):
    """It reflects what white glass reflects, and passes the colour times what white glass passes."""
    n = 400_000
    wo = view(0.7, n)
    found = []
    for lobes in ([("glass", 1.0)], [("glass", 0.36), ("dielectric", 0.64)]):
        drawn = bsdf.sample(lobes_at([Lobe(kind, C(c), roughness, 1.5) for kind, c in lobes], wo, side), np.random.default_rng(6))
        found.append([np.where(drawn.through == t, drawn.weight[:, 0], 0).astype(float) for t in (False, True)])
    for expected, got in ((found[0][0], found[1][0]), (0.36 * found[0][1], found[1][1])):
        assert abs(got.mean() - expected.mean()) < 4.5 * np.sqrt((got.var() + expected.var()) / n) + 1e-5


@pytest.mark.parametrize("name", ["mirror", "mirror and diffuse", "glass and glossy"])
def test_even_directions_carry_as_much_as_drawn_ones(name):
    """Directions evenly over the sphere stand in for those of a finite density alone; what mirrors is still drawn by its share."""
    mixed = {
        "mirror": [Lobe("glossy", C(0.8), 0.0)],
        "mirror and diffuse": [Lobe("glossy", C(0.6), 0.0), Lobe("diffuse", C(0.3))],
        "glass and glossy": [Lobe("glass", C(0.5), 0.0, 1.5), Lobe("glossy", C(0.4), 0.6)],
    }
    rng = np.random.default_rng(4)
    lobes = lobes_at(mixed[name], view(0.7, 40_000))
    drawn = bsdf.sample(lobes, rng)
    even = evenly(lobes, drawn, rng)
    assert np.array_equal(even.weight[drawn.delta], drawn.weight[drawn.delta])
    assert even.weight.mean() == pytest.approx(drawn.weight.mean(), rel=0.03)
    drawn_so = ~drawn.delta
    if drawn_so.any():  # the density is of those directions too that mirror
        assert even.pdf_w[drawn_so] * 4 * np.pi == pytest.approx(np.full(drawn_so.sum(), drawn_so.mean()), rel=0.03)


def test_transparent_goes_straight_on():
    wo = view(0.5, 1000)
    straight = bsdf.sample(lobes_at([Lobe("transparent", C(0.7))], wo), np.random.default_rng(1))
    assert np.allclose(straight.wi, -wo, atol=1e-5) and np.allclose(straight.weight, 0.7, atol=1e-5)
    assert straight.delta.all() and straight.through.all()


@pytest.mark.parametrize(("degrees", "expected"), [(0, 0.0425800), (45, 0.0530452), (75, 0.2567153)])
def test_fresnel_of_window_glass(degrees, expected):
    value = microfacet.fresnel(np.float32([np.cos(np.radians(degrees))]), np.float32([1.52]))
    assert value[0] == pytest.approx(expected, rel=1e-4)


def rough(color, roughness, many=True, weight=1.0):
    return [Lobe("rough diffuse", C(color), roughness, multiscatter=many, weight=weight)]


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("mu", [0.05, 0.4, 1.0])
def test_white_rough_diffuse_surfaces_lose_nothing(mu, roughness):
    n = 200_000
    once, white = (
        bsdf.sample(lobes_at(rough(1.0, roughness, many), view(mu, n)), np.random.default_rng(2)).weight[:, 0] for many in (False, True)
    )
    assert abs(white.mean(dtype=float) - 1) < 4 * white.std() / np.sqrt(n) + 1e-4
    assert once.mean() < 1 - 0.1 * roughness * mu


COAT = Lobe("specular", C(1.0), 0.4, 1.5)


def directions(n, seed):
    w = np.random.default_rng(seed).normal(size=(n, 3))
    return (w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("coat", [[], [COAT]], ids=["bare", "coated"])
@pytest.mark.parametrize("many", [False, True])
def test_a_smooth_rough_diffuse_lobe_is_an_ideal_diffuser(many, coat):
    wo, wi = view(0.6, 1000), directions(1000, 4)
    got, want = (bsdf.evaluate(lobes_at([*lobes, *coat], wo), wi) for lobes in (rough(0.7, 0.0, many), [Lobe("diffuse", C(0.7))]))
    assert np.allclose(got[0], want[0], atol=1e-6) and np.allclose(got[1], want[1], atol=1e-6)


@pytest.mark.parametrize("roughness", [0.0, 0.5, 1.0])
def test_a_coat_dims_a_rough_diffuse_lobe_as_it_does_a_smooth_one(roughness):
    """By the same reciprocal factor, so that a white one under a coat sends back what arrives, but for where its light is more or less."""
    n = 100_000
    factor, albedo = [], []
    for base in (rough(1.0, roughness), [Lobe("diffuse", C(1.0))]):
        wo, wi = directions(1000, 5), directions(1000, 6)
        wo[:, 2], wi[:, 2] = np.abs(wo[:, 2]), np.abs(wi[:, 2])
        bare, coat, both = (bsdf.evaluate(lobes_at(lobes, wo), wi)[0][:, 0] for lobes in (base, [COAT], [*base, COAT]))
        back = bsdf.evaluate(lobes_at([*base, COAT], wi), wo)[0][:, 0]
        assert np.allclose(both / wi[:, 2], back / wo[:, 2], rtol=2e-3, atol=1e-4)
        factor.append((both - coat) / bare)
        drawn = (bsdf.sample(lobes_at([*base, COAT], view(mu, n)), np.random.default_rng(7)) for mu in (0.3, 0.6, 1.0))
        albedo.append([x.weight[:, 0].mean(dtype=float) for x in drawn])
    assert factor[1].max() < 1 < 1.2 * factor[1].max()
    assert np.allclose(*factor, rtol=2e-3, atol=2e-4)
    assert albedo[0] == pytest.approx(albedo[1], abs=0.003 + 0.03 * roughness)


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("kind", [kind for kind in kinds.LOBES if kind.delta_below < np.inf], ids=lambda kind: kind.name)
def test_factors_and_tints_of_a_white_lobe_make_up_the_lobe(kind, many):
    """Of single scattering, with what a lobe adds by itself where more bounces count."""
    n, alpha = 2000, 0.49
    wo, wi = directions(n, 8), directions(n, 9)
    wo[:, 2] = np.abs(wo[:, 2])

    def seen(color, alpha, many):
        shape = np.full(n, alpha, np.float32), np.full(n, 1.5, np.float32)
        return LobeView(wo, color, *shape, Mixture.of(0, n), np.ones(n, bool), np.full(n, many), edge)

    color = np.tile(np.float32([0.9, 0.6, 0.2]), (n, 1))
    edge = np.tile(np.float32([0.2, 0.5, 1.0]), (n, 1))
    name, width = kind.split(alpha)
    (base,) = (k for k in kinds.LOBES if k.name == name)
    white = base.evaluate(seen(np.ones_like(color), width, False), wi)[0]
    factors, tints = kind.factors(alpha, wo, wi), kind.tints(alpha, many, color, edge)
    assert len(factors) == len(tints) == kind.parts
    got = sum(white * f[:, None] * t for f, t in zip(factors, tints, strict=True))
    want = kind.evaluate(seen(color, alpha, many), wi)[0]
    assert want.max() > 0.05 and np.allclose(got, want, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("roughness", "angle", "radiance"),
    [
        (0.5, 0.0, (0.28905848, 0.17806055, 0.08482756)),
        (0.5, 1.2, (0.09686943, 0.06225868, 0.03046325)),
        (1.0, 0.5, (0.25205827, 0.14605054, 0.06695748)),
    ],
)
def test_rough_diffuse_is_what_cycles_computes(roughness, angle, radiance):
    """Measured with Cycles 5.0 and 5.2: a plane of colour (0.9, 0.6, 0.3) seen from above, irradiance cos(angle) by a sun."""
    wi = np.float32([[np.sin(angle), 0, np.cos(angle)]])
    material = [Lobe("rough diffuse", C(0.9, 0.6, 0.3), roughness, multiscatter=True)]
    assert np.allclose(bsdf.evaluate(lobes_at(material, view(1.0, 1)), wi)[0][0], radiance, rtol=3e-6)


def test_a_share_of_a_rough_diffuse_lobe_bounces_light_by_its_own_colour():
    """Half of a lobe in a mix is half as bright, not a lobe of half the albedo, which loses more between its facets."""
    wo, wi = view(1.0, 1), view(0.95, 1)
    whole, half, darker = (
        bsdf.evaluate(lobes_at(lobes, wo), wi)[0][0, 0] for lobes in (rough(0.8, 1.0), rough(0.8, 1.0, weight=0.5), rough(0.4, 1.0))
    )
    assert half == pytest.approx(0.5 * whole, rel=1e-6)
    assert darker < 0.95 * half


@pytest.mark.parametrize("many", [False, True])
def test_methods_that_know_only_diffuse_take_the_mean_albedo_of_a_rough_one(many):
    """From a quadrature over both directions; the name is in the notice, and a table that does not know the kind is diffuse."""
    lobes = [Lobe("rough diffuse", C(0.9, 0.6, 0.3), 0.7, multiscatter=many)]
    n = 400_000
    mu = np.sqrt((np.arange(n) + 0.5) / n)
    wo = np.stack([np.sqrt(1 - mu * mu), 0 * mu, mu], 1)
    want = bsdf.sample(lobes_at(lobes, wo), np.random.default_rng(4)).weight.mean(axis=0, dtype=float)
    b = SceneBuilder()
    b.quad("Quad", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("M", tuple(lobes)))
    scene = b.build()
    assert np.allclose(as_diffuse(scene.materials[0]).constant, want, rtol=2e-3)
    table = bsdf.BsdfTable(scene, frozenset({"diffuse"}))
    assert table.only_diffuse and np.allclose(table.diffuse.table[0], want, rtol=2e-3)
    (notice,) = Shading(scene).substitutions(frozenset({"diffuse"}))
    assert notice.reason == "rough diffuse taken as diffuse by this method"
    assert not Shading(scene).substitutions(kinds.ALL_LOBES)


@pytest.mark.parametrize("coat", [[], [Lobe("specular", C(1.0), 1.0, 1.5)]], ids=["bare", "coated"])
@pytest.mark.parametrize("many", [False, True])
def test_elements_with_directions_scatter_a_rough_diffuse_lobe_as_it_is(many, coat):
    """Bins: what leaves a face lit from one bin is the BSDF's mean over both bins."""
    lobes = [Lobe("rough diffuse", C(0.9, 0.6, 0.3), 1.0, multiscatter=many), *coat]
    b = SceneBuilder()
    b.quad("Quad", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("M", tuple(lobes)))
    world, bins = World(b.build()), Bins(4, 8)
    elements = Elements(world, 2.0)
    scattering = Scattering.ready(elements, bsdf.BsdfTable(world.scene), bins, 1 << 17)
    # Sides are in the frame of their element: what counts is the angle between the bins.
    n = 1 << 17
    rng = np.random.default_rng(6)
    wo, wi = (local_cosine_directions(rng.random((2, n), np.float32)) for _ in range(2))
    f = bsdf.evaluate(lobes_at(lobes, wo), wi)[0] / wi[:, 2:]
    arriving = np.zeros((2, bins.size, 3))
    lit = bins.of(wi[:1])[0]
    arriving[0, lit] = 1
    leaves = scattering.apply(arriving)[0]
    got = leaves / (np.pi * (bins.of(wi) == lit).mean())
    at, of_lit = bins.of(wo), bins.of(wi) == lit
    for out in range(bins.size):
        here = (at == out) & of_lit
        error = f[here].std(axis=0) / np.sqrt(here.sum())
        assert (np.abs(got[out] - f[here].mean(axis=0)) < 5 * error + 0.02 * got[out]).all()


@pytest.mark.parametrize("kind", ["metallic", "tinted metallic", "glossy"])
def test_elements_with_directions_colour_what_bounces_between_facets(kind):
    """As often as it bounces: even light is reflected as by the BSDF."""
    lobes, n, rng = [Lobe(kind, C(0.2, 0.5, 0.9), 1.0, multiscatter=True, edge=C(0.0, 0.2, 1.0))], 1 << 17, np.random.default_rng(6)
    b = SceneBuilder()
    b.quad("Quad", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("M", tuple(lobes)))
    world, bins = World(b.build()), Bins(4, 8)
    scattering = Scattering.ready(Elements(world, 2.0), bsdf.BsdfTable(world.scene), bins, n)
    wo, wi = (local_cosine_directions(rng.random((2, n), np.float32)) for _ in range(2))
    want = np.pi * (bsdf.evaluate(lobes_at(lobes, wo), wi)[0] / wi[:, 2:]).mean(axis=0)
    np.testing.assert_allclose(scattering.apply(np.ones((2, bins.size, 3)))[0].mean(axis=0), want, rtol=0.02)


@pytest.mark.parametrize("kind", ["diffuse", "rough diffuse"])
def test_white_below_a_white_coat_loses_nothing(kind):
    """What the coat takes from light on its way in and out comes back between the two."""
    base = [Lobe("diffuse", C(1))] if kind == "diffuse" else [Lobe(kind, C(1), 0.5, multiscatter=True)]
    lobes = lobes_at([*base, Lobe("specular", C(1), 0.4, 1.45)], view(0.6, 40_000))
    assert bsdf.sample(lobes, np.random.default_rng(2)).weight.mean() == pytest.approx(1, abs=0.02)
