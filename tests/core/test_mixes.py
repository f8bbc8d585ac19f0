"""Lobes with a weight: a mix sends what its parts send, by their shares; it makes no light, and is reciprocal."""

import dataclasses
import itertools

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import mirrors
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.bsdf.coat import COSINES, coat_albedo
from adjgi.adjoint_gi.core.bsdf.lobes import LOBE_KINDS, LOBES
from adjgi.adjoint_gi.core.directional.bins import Bins
from adjgi.adjoint_gi.core.directional.scattering import Scattering
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.substitutes import as_diffuse
from adjgi.adjoint_gi.core.scene.world import World

C = Color.of
GRAZING = np.sin(np.radians(3.0))
COLORS = {"a": C(0.9, 0.5, 0.0), "b": C(0.2, 0.8, 1.0)}
PAIRS = list(itertools.combinations_with_replacement([kind.name for kind in LOBES], 2))


def scene_of(lobes, textures=()):
    b = SceneBuilder()
    b.quad("Quad", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("M", tuple(lobes)))
    return dataclasses.replace(b.build(), textures=tuple(textures))


def lobes_at(lobes, wo, side=1.0, textures=(), u=0.2):
    table = bsdf.BsdfTable(scene_of(lobes, textures), straight=True)
    n = len(wo)
    at = np.full(n, u, np.float32), np.full(n, 0.2, np.float32)
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    return table.at(np.zeros(n, np.int32), *at, up, np.full(n, side, np.float32), np.asarray(wo, np.float32))


def view(mu, n):
    return np.tile(np.float32([np.sqrt(1 - mu * mu), 0, mu]), (n, 1))


def directions(n, seed, upper=True):
    w = np.random.default_rng(seed).normal(size=(n, 3))
    w[: n // 4, 2] *= 0.05  # many at grazing angles
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    if upper:
        w[:, 2] = np.abs(w[:, 2]).clip(1e-3)
    return w.astype(np.float32)


def albedo(lobes, mu, side=1.0, n=20_000, seed=1):
    """(3,) share of uniform light that is sent towards `mu`, and its standard error, by samples."""
    weight = bsdf.sample(lobes_at(lobes, view(mu, n), side), np.random.default_rng(seed)).weight.astype(float)
    return weight.mean(axis=0), weight.std(axis=0) / np.sqrt(n)


def pair(first, second, weight, roughness):
    """A mix of two lobes, each in a stack of its own, as two nodes are."""
    shape = {"roughness": roughness, "ior": 1.5, "multiscatter": True}
    a, b = Lobe(first, COLORS["a"], **shape, weight=weight), Lobe(second, COLORS["b"], **shape, weight=1 - weight, stack=1)
    return [a, b]


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_a_mix_sends_what_its_parts_send_by_their_shares(first, second):
    wo, wi = directions(400, 1), directions(400, 2, upper=False)
    for weight, roughness, side in ((0.5, 0.0, 1.0), (0.1, 0.3, 1.0), (0.7, 1.0, -1.0)):
        mix = pair(first, second, weight, roughness)
        whole = lobes_at(mix, wo, side)
        parts = [(x.weight, lobes_at([dataclasses.replace(x, weight=1.0)], wo, side)) for x in mix]
        want = sum(w * bsdf.evaluate(lobes, wi)[0] for w, lobes in parts)
        assert np.allclose(bsdf.evaluate(whole, wi)[0], want, rtol=1e-4, atol=1e-6)
        got, want = (sum(w * smooth_light(lobes) for w, lobes in some) for some in ([(1.0, whole)], parts))
        assert np.allclose(got, want, rtol=1e-5, atol=1e-6)


def smooth_light(lobes):
    """(2, n, 3) weights of the rays that perfectly smooth lobes reflect and pass."""
    out = np.zeros((2, len(lobes.wo), 3))
    for branch in mirrors.branches(lobes, tuple((s.kind > 0) & s.delta for s in lobes.slots)):
        np.add.at(out[int(branch.through)], branch.rows, branch.weight)
    return out


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_a_mix_makes_no_light_in_a_furnace(first, second):
    """Also of white surfaces, as smooth as mirrors or rough, seen at 3 degrees from the surface and from above."""
    for (weight, roughness, mu), white in itertools.product(((0.5, 0.0, GRAZING), (0.5, 0.3, GRAZING), (0.1, 1.0, 0.9)), (False, True)):
        lobes = pair(first, second, weight, roughness)
        if white:
            lobes = [dataclasses.replace(x, color=C(1.0)) for x in lobes]
        for side in (1.0, -1.0):
            mean, error = albedo(lobes, mu, side, 4000)
            assert (mean < 1.0 + 4.5 * error + (0.02 if roughness > 0 else 1e-5)).all(), (weight, roughness, mu, side, white)


@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_half_a_metal_reflects_half_of_what_a_metal_does_at_grazing_angles(roughness):
    """By the closed form of a mirror: Schlick's reflectance at 3 degrees, 0.7 + 0.3 (1 - sin 3)^5; it was 1.39 and 1.17 with 1 as white."""
    half = [Lobe("diffuse", C(1.0), weight=0.5), Lobe("metallic", C(0.7), roughness, weight=0.5)]
    mean, error = albedo(half, GRAZING, n=100_000)
    whole, _ = albedo([Lobe("metallic", C(0.7), roughness)], GRAZING, n=100_000)
    assert mean[0] == pytest.approx(0.5 + 0.5 * whole[0], abs=5 * error[0] + 1e-4)
    if roughness == 0:
        assert whole[0] == pytest.approx(0.7 + 0.3 * (1 - GRAZING) ** 5, rel=1e-5)


@pytest.mark.parametrize("kind", ["evaluated", "elements", "diffuse"])
def test_black_metal_still_reflects(kind):
    """Schlick's term, (1 - cos)^5, 1 / 21 in the mean."""
    metal = Lobe("metallic", C(0.0), 0.0)
    if kind == "evaluated":
        assert albedo([metal], 0.3, n=100)[0][0] == pytest.approx(0.7**5, rel=1e-4)
    elif kind == "elements":
        assert leaving([metal]).mean() == pytest.approx(1 / 21, rel=0.01)
    else:
        assert as_diffuse(Material("M", (metal,))).constant == pytest.approx([1 / 21] * 3)
        half = dataclasses.replace(metal, weight=0.5)
        assert as_diffuse(Material("M", (half,))).constant == pytest.approx([0.5 / 21] * 3)


TINTED = [((0.9, 0.6, 0.3), (0.2, 0.4, 0.9)), ((0.02, 0.0, 1.0), (0.0, 0.5, 0.2)), ((0.5, 1.0, 0.0), (1.0, 0.0, 0.0))]


def f82(mu, color, edge):
    """(3,) Schlick's reflectance, less what makes it `edge` times as much at the cosine 1/7 (Kutz et al. 2021), not below 0."""
    color, edge = np.array(color), np.array(edge)
    schlick, at_edge = (color + (1 - color) * (1 - c) ** 5 for c in (mu, 1 / 7))
    return np.maximum(schlick - at_edge * (1 - edge) * mu * (1 - mu) ** 6 / ((1 / 7) * (6 / 7) ** 6), 0)


def tinted(color, edge, roughness, weight=1.0):
    return Lobe("tinted metallic", C(*color), roughness, multiscatter=True, weight=weight, edge=C(*edge))


@pytest.mark.parametrize(("color", "edge"), TINTED)
def test_a_metals_edge_has_its_tint(color, edge):
    """Of mirrors by the closed form, by samples and by rays; at 82 degrees the tint times Schlick's reflectance."""
    for mu in (GRAZING, 1 / 7, 0.3, 0.6, 1.0):
        want = f82(mu, color, edge)
        assert albedo([tinted(color, edge, 0.0)], mu, n=100)[0] == pytest.approx(want, abs=1e-5)
        assert smooth_light(lobes_at([tinted(color, edge, 0.0, 0.5)], view(mu, 1)))[0, 0] == pytest.approx(0.5 * want, abs=1e-5)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.7, 1.0])
@pytest.mark.parametrize(("color", "edge"), [*TINTED, ((1.0,) * 3, (0.0, 0.5, 1.0))])
def test_rough_tinted_metals_make_no_light_and_send_less_than_untinted_ones(color, edge, roughness):
    for mu in (GRAZING, 1 / 7, 0.5, 1.0):
        found, error = albedo([tinted(color, edge, roughness)], mu)
        plain, _ = albedo([tinted(color, (1.0,) * 3, roughness)], mu)
        assert (found < 1.0 + 4.5 * error + 0.02).all() and (found >= 0).all()
        assert (found < plain + 4.5 * error + 1e-4).all()


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_an_edge_of_white_changes_no_bit(roughness):
    """Also where another material of the scene has a tint."""
    wo, wi = directions(300, 7), directions(300, 8)
    plain = [Lobe("metallic", C(0.9, 0.6, 0.3), roughness, multiscatter=True)]
    want = lobes_at(plain, wo)
    for edge in (C(1.0), Color((Term((1.0,) * 3, (Source("image", "", 0),)),))):
        image = [Texture("White", np.ones((1, 1, 4), np.float32), "EXTEND", "Closest")]
        got = lobes_at([dataclasses.replace(plain[0], kind="tinted metallic", edge=edge)], wo, textures=image)
        assert np.array_equal(bsdf.evaluate(got, wi)[0], bsdf.evaluate(want, wi)[0])
        assert np.array_equal(smooth_light(got), smooth_light(want))
        drawn, same = (bsdf.sample(x, np.random.default_rng(3)) for x in (got, want))
        assert np.array_equal(drawn.wi, same.wi) and np.array_equal(drawn.weight, same.weight)


def test_an_edge_by_a_texture_is_at_every_point_that_of_its_colour():
    pixels = np.ones((1, 2, 4), np.float32)
    pixels[0, :, :3] = (0.2, 0.4, 0.9), (2.0, 0.0, 1.0)
    image = [Texture("Edge", pixels, "EXTEND", "Closest")]
    lobe = dataclasses.replace(tinted((0.9, 0.6, 0.3), (1.0,) * 3, 0.0), edge=Color((Term((1.0,) * 3, (Source("image", "", 0),)),)))
    for u, edge in ((0.2, pixels[0, 0, :3]), (0.6, (1.0, 0.0, 1.0))):
        got = bsdf.sample(lobes_at([lobe], view(0.2, 10), textures=image, u=u), np.random.default_rng(1)).weight
        assert got[0] == pytest.approx(f82(0.2, (0.9, 0.6, 0.3), edge), abs=1e-4)


@pytest.mark.parametrize(("color", "edge"), TINTED)
def test_elements_and_diffuse_methods_have_the_mean_of_a_tinted_metal(color, edge):
    """On elements the reflectance of a black edge of a dark metal, which is 0 over a range of angles, is up to 0.012 too high."""
    mu = (np.arange(2000) + 0.5) / 2000
    want = sum(2 * m * f82(m, color, edge) for m in mu) / len(mu)
    assert as_diffuse(Material("M", (tinted(color, edge, 0.0),))).constant == pytest.approx(want, abs=1e-4)
    assert leaving([dataclasses.replace(tinted(color, edge, 0.0), multiscatter=False)]).mean(axis=0) == pytest.approx(want, abs=0.012)
    half = as_diffuse(Material("M", (tinted(color, edge, 0.0, 0.5),))).constant
    assert half == pytest.approx(0.5 * want, abs=1e-4)
    textured = Color((Term(color, (Source("image", "", 0),)),))
    image = [Texture("White", np.ones((1, 1, 4), np.float32), "EXTEND", "Closest")]
    scene = scene_of([dataclasses.replace(tinted(color, edge, 0.0), color=textured)], image)
    at = np.zeros(1, int), np.full(1, 0.2), np.full(1, 0.2)
    assert World(scene).shading.albedo(*at)[0] == pytest.approx(want, abs=0.02)


@pytest.mark.parametrize("name", ["metal", "tinted metal", "coats", "rough"])
def test_mixes_are_reciprocal(name):
    lobes = {
        "metal": [Lobe("diffuse", C(0.4), weight=0.3), Lobe("metallic", C(0.0), 0.4, multiscatter=True, weight=0.7)],
        "tinted metal": [Lobe("diffuse", C(0.4), weight=0.3), tinted((0.9, 0.6, 0.0), (0.2, 0.0, 0.4), 0.4, 0.7)],
        "coats": two_coats(),
        "rough": [*two_coats(), Lobe("rough diffuse", C(0.9, 0.1, 0.5), 0.8, multiscatter=True, weight=0.2, stack=1)],
    }[name]
    a, b = directions(3000, 5), directions(3000, 6)
    forward, back = (bsdf.evaluate(lobes_at(lobes, o), i)[0] / i[:, 2:] for o, i in ((a, b), (b, a)))
    assert np.allclose(forward, back, rtol=3e-3, atol=1e-5)


def two_coats():
    """A red and a blue node, each with a coat of its own, and a bare yellow one."""
    return [
        Lobe("diffuse", C(1.0, 0.1, 0.1), weight=0.3, stack=1),
        Lobe("specular", C(1.0), 0.5, 1.5, weight=0.3, stack=1),
        Lobe("diffuse", C(0.1, 0.2, 1.0), weight=0.5, stack=2),
        Lobe("specular", C(1.0, 0.8, 0.5), 0.2, 2.0, weight=0.5, stack=2),
        Lobe("diffuse", C(0.9, 0.9, 0.0), weight=0.2),
    ]


def two_coats_albedo(mu):
    """(m, 3) what they send of uniform light at cosines `mu` (m,): each coat takes from its own base alone."""
    first, second = (coat_albedo(mu, *shape)[:, None] for shape in ((0.5, 1.5), (0.2, 2.0)))
    tint = np.array([1.0, 0.8, 0.5])
    red = 0.3 * (np.array([1.0, 0.1, 0.1]) * (1 - first) + first)
    blue = 0.5 * (np.array([0.1, 0.2, 1.0]) * (1 - tint * second) + tint * second)
    return red + blue + 0.2 * np.array([0.9, 0.9, 0.0])


@pytest.mark.parametrize("mu", [GRAZING, 0.2, 0.5, 1.0])
def test_every_coat_takes_from_its_own_base_alone(mu):
    got, error = albedo(two_coats(), mu, n=100_000)
    assert (np.abs(got - two_coats_albedo(np.float32([mu]))[0]) < 4.5 * error + 0.002).all()


@pytest.mark.parametrize("weight", [0.1, 0.5, 1.0])
def test_a_share_of_a_coated_white_surface_loses_and_makes_nothing(weight):
    """Alpha of a white Principled: the coat dims its base in full, whatever share of the mix the two have together."""
    lobes = [Lobe("diffuse", C(1.0), weight=weight), Lobe("specular", C(1.0), 0.5, 1.5, weight=weight), Lobe("transparent", C(1 - weight))]
    for mu in (0.1, 0.7):
        mean, error = albedo(lobes, mu, n=50_000)
        assert mean[0] == pytest.approx(1.0, abs=5 * error[0] + 3e-3)


def leaving(lobes, textures=(), size=2.0):
    """(bins, 3) radiance that leaves the elements of a quad where it arrives as 1 from everywhere, in the mean over elements."""
    world, bins = World(scene_of(lobes, textures)), Bins(4, 8)
    elements = Elements(world, size)
    scattering = Scattering.ready(elements, bsdf.BsdfTable(world.scene), bins, 1 << 15)
    return scattering.apply(np.ones((2 * elements.count, bins.size, 3)))[::2].mean(axis=0)


def test_elements_with_directions_pair_coats_and_bases_too():
    mu = COSINES
    want = (two_coats_albedo(mu) * (2 * mu / len(mu))[:, None]).sum(axis=0)
    assert leaving(two_coats()).mean(axis=0) == pytest.approx(want, rel=0.01)


def test_a_mix_by_a_texture_is_at_every_point_the_mix_of_its_factor():
    """Two Principled nodes mixed by an image: weights of lobes, and shares of coats, follow it; elements take their means."""
    pixels = np.ones((1, 2, 4), np.float32)
    pixels[0, :, :3] = np.float32([[0.25], [1.0]])
    image = [Texture("Factor", pixels, "EXTEND", "Closest")]
    factor = Color((Term((1.0, 1.0, 1.0), (Source("image", "", 0),)),))

    def mix(w):
        rest = w.complement() if isinstance(w, Color) else 1.0 - w
        one = [Lobe("diffuse", C(1.0, 0.1, 0.1), weight=w, stack=1), Lobe("specular", C(1.0), 0.5, 1.5, weight=w, stack=1)]
        return [*one, Lobe("diffuse", C(0.1, 0.2, 1.0), weight=rest), Lobe("metallic", C(0.6, 0.1, 0.0), 0.4, weight=rest)]

    wo, wi = directions(500, 3), directions(500, 4)
    for u, w in ((0.2, 0.25), (0.6, 1.0)):
        got, want = (bsdf.evaluate(lobes_at(x, wo, textures=t, u=u), wi)[0] for x, t in ((mix(factor), image), (mix(w), ())))
        assert np.allclose(got, want, rtol=1e-4, atol=1e-6)
    halves = 0.5 * (leaving(mix(0.25)) + leaving(mix(1.0)))
    assert np.allclose(leaving(mix(factor), image, 0.5), halves, rtol=0.02)


@pytest.mark.parametrize("roughness", [0.0, 0.4])
@pytest.mark.parametrize("kind", ["glass", "refraction"])
def test_elements_with_directions_pass_basic_radiance_through_glass(kind, roughness):
    """With the square of the index, 1 outside and 2.25 inside, their matrices are reciprocal; white glass in a furnace sends 1 both ways,
    and what passes a boundary that reflects nothing is, from inside, what arrives within the critical angle: a share of 1 / 2.25."""
    world, bins = World(scene_of([Lobe(kind, C(1.0), roughness, 1.5, multiscatter=True)])), Bins(4, 8)
    scattering = Scattering.ready(Elements(world, 2.0), bsdf.BsdfTable(world.scene), bins, 1 << 15)
    x, y = np.random.default_rng(1).random((2, 2 * scattering.count, bins.size, 3))
    measure = np.tile([1.0, 2.25], scattering.count)[:, None, None] * scattering.basis.solid
    assert (measure * y * scattering.apply(x)).sum() == pytest.approx((measure * x * scattering.apply(y)).sum(), rel=1e-5)
    out, back = scattering.basis.exitance(scattering.apply(np.ones_like(x)))[:2].mean(axis=1) / np.pi
    if kind == "glass":
        assert (out, back) == pytest.approx((1.0, 1.0), abs=0.01 if roughness == 0 else 0.03)
    elif roughness == 0:
        assert (out, back) == pytest.approx((1.0, 1 / 2.25), rel=0.02)


def test_what_has_no_weight_is_black():
    for lobe in (Lobe("metallic", C(0.5), weight=0.0), Lobe("glossy", C(0.0)), Lobe("metallic", C(0.0), weight=Color())):
        assert lobe.is_black
        assert bsdf.BsdfTable(scene_of([lobe])).count == 0
    assert not Lobe("metallic", C(0.0)).is_black
    assert len(LOBE_KINDS) == len(LOBES) - 1
