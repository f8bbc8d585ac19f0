"""Roughness and index that vary over a surface: the same as constant ones at every point."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.bsdf.coat import Coats
from adjgi.adjoint_gi.core.bsdf.curves import Grid
from adjgi.adjoint_gi.core.bsdf.multiscatter import Gains
from adjgi.adjoint_gi.core.directional.bins import Bins
from adjgi.adjoint_gi.core.directional.scattering import Scattering
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.shading import ScalarField
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

load()

C = Color.of
WHITE = C(0.9)
# kind -> the lobes of a material of this roughness and index
KINDS = {
    "glossy": lambda r, n: (Lobe("glossy", WHITE, r),),
    "metallic": lambda r, n: (Lobe("metallic", C(0.9, 0.6, 0.3), r),),
    "glass": lambda r, n: (Lobe("glass", WHITE, r, n),),
    "refraction": lambda r, n: (Lobe("refraction", WHITE, r, n),),
    "dielectric": lambda r, n: (Lobe("dielectric", WHITE, r, n),),
    "coated": lambda r, n: (Lobe("diffuse", C(0.6)), Lobe("specular", C(0.8), r, n)),
    "twice coated": lambda r, n: (Lobe("diffuse", C(0.6)), Lobe("specular", C(0.4), r, n), Lobe("specular", C(0.5), 0.3, 1.4)),
    "glossy, many bounces": lambda r, n: (Lobe("glossy", WHITE, r, multiscatter=True),),
    "glass, many bounces": lambda r, n: (Lobe("glass", WHITE, r, n, multiscatter=True),),
}
BY_TABLE = {"coated", "twice coated", "glossy, many bounces", "glass, many bounces"}  # what interpolates between curves


def image(texture, scale=1.0):
    """A scalar from the red channel of a texture over the default UV layer."""
    return Color((Term((scale, 0.0, 0.0), (Source("image", "", texture),)),))


def quads(materials, textures=()):
    """Unit quads side by side, facing up; u grows with x."""
    b = SceneBuilder()
    for i, material in enumerate(materials):
        b.quad(f"Quad {i}", (i, 0, 0), (1, 0, 0), (0, 1, 0), material)
    return dataclasses.replace(b.build(), textures=tuple(textures))


def halves(left, right):
    """A texture of two values, without interpolation."""
    pixels = np.ones((1, 2, 4), np.float32)
    pixels[0, :, :3] = np.float32([[left], [right]])
    return Texture("Halves", pixels, "EXTEND", "Closest")


def lobes_of(scene, x, wo, side):
    """Lobes at (x, 0.25): both lie in the first triangle of their quad."""
    n = len(wo)
    # u and v of a point in triangle (p, p + a, p + a + b).
    v = np.full(n, 0.1, np.float32)
    u = np.full(n, x - 0.1, np.float32) - np.floor(np.float32(x))
    triangle = np.full(n, 2 * int(x), np.int32)
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    return bsdf.BsdfTable(scene).at(triangle, u, v, up, np.full(n, side, np.float32), wo)


def directions(n, rng):
    w = rng.normal(size=(n, 3))
    return (w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("name", KINDS)
def test_textured_shape_is_that_of_two_constant_materials(name, side):
    make, rng, n = KINDS[name], np.random.default_rng(1), 4000
    wo, wi = directions(n, rng), directions(n, rng)
    wo[:, 2] = np.abs(wo[:, 2]) + 0.05
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    textured = quads([Material("M", make(image(0), image(1, 2.0)))], [halves(0.3, 0.7), halves(0.65, 0.75)])
    constant = quads([Material("A", make(0.3, 1.3)), Material("B", make(0.7, 1.5))])
    uniform = rng.random((4, n), np.float32)
    for x, y in ((0.3, 0.3), (0.8, 1.8)):
        got, want = lobes_of(textured, x, wo, side), lobes_of(constant, y, wo, side)
        tolerance = 0.015 if name in BY_TABLE else 1e-5
        (f, p), (g, q) = bsdf.evaluate(got, wi), bsdf.evaluate(want, wi)
        assert np.allclose(f, g, rtol=tolerance, atol=1e-6) and np.allclose(p, q, rtol=tolerance, atol=1e-6)
        a, b = (bsdf.sample(lobes, rng, uniform) for lobes in (got, want))
        # Where a coat's table decides which lobe is picked, a few of the picks differ.
        same = np.abs(a.wi - b.wi).max(axis=1) < 1e-4
        assert same.mean() > (0.98 if name in BY_TABLE else 0.999)
        assert np.allclose(a.weight[same], b.weight[same], rtol=2 * tolerance, atol=1e-5)


def test_on_the_grid_and_for_constants_curves_are_exact_and_between_within_a_percent():
    gains, coats = Gains(), Coats()
    cosine = (np.arange(1, 64) / 64).astype(np.float32)
    for curves, ior in ((gains, None), (gains, 1.52), (coats, 1.52)):
        grid = Grid(curves, (0.1, 0.9), None if ior is None else (1.45, 1.6))
        for roughness in (0.25, 0.1406, 0.61, 0.89):
            n = np.full(len(cosine), 1.0 if ior is None else ior)
            mix = grid.mixture(np.full(len(cosine), roughness), n)
            exact = type(curves)()
            row = exact.row(roughness, ior)
            for inside in (False, True):
                want = exact.at(type(mix).of(row, len(cosine)), inside, cosine)
                got = curves.at(mix, inside, cosine)
                on_grid = roughness == 0.25 and ior is None
                assert np.abs(got / want - 1).max() < (1e-6 if on_grid else 0.007)


def test_white_facets_of_any_roughness_lose_nothing():
    """The furnace test over a ramp of roughness from 0.1 to 1."""
    pixels = np.repeat(np.linspace(0.1, 1, 64, dtype=np.float32)[None, :, None], 4, axis=2)
    scene = quads([Material("M", (Lobe("glossy", C(1.0), image(0), multiscatter=True),))], [Texture("Ramp", pixels, "EXTEND")])
    rng, n = np.random.default_rng(3), 400_000
    u = rng.random((2, n), np.float32)
    v = u.min(axis=0) * 0.5
    wo = np.tile(np.float32([0.8, 0, 0.6]), (n, 1))
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    lobes = bsdf.BsdfTable(scene).at(np.zeros(n, np.int32), u.max(axis=0) - v, v, up, np.ones(n, np.float32), wo)
    assert lobes.slots[0].alpha.min() < 0.05 and lobes.slots[0].alpha.max() > 0.9
    weight = bsdf.sample(lobes, rng).weight[:, 0].astype(float)
    assert weight.mean() == pytest.approx(1.0, abs=4 * weight.std() / np.sqrt(n) + 0.006)


def lit_quads(textured):
    """Two glossy elements under a bright panel: one material with a texture, or two of constant roughness on the grid."""
    b = SceneBuilder()
    b.background = (0.2, 0.3, 0.4)

    def shiny(r):
        return (Lobe("diffuse", C(0.3)), Lobe("glossy", C(0.5), r, multiscatter=True), Lobe("specular", C(1.0), r, 1.5))

    if textured:
        material = Material("M", shiny(image(0)))
        materials = [material, material]
    else:
        materials = [Material("A", shiny(0.25)), Material("B", shiny(0.75))]
    for i, material in enumerate(materials):
        uv = np.array([[[0, 0], [0.5, 0], [0.5, 1]], [[0, 0], [0.5, 1], [0, 1]]], np.float32) + np.float32([0.5 * i, 0])
        corners = np.array([[i, 0, 0], [i + 1, 0, 0], [i + 1, 1, 0], [i, 1, 0]], float)
        b.mesh(f"Quad {i}", corners, np.array([[0, 1, 2], [0, 2, 3]]), material, polygon=np.zeros(2), uv=uv)
    b.quad("Panel", (0, 0, 1), (0, 1, 0), (2, 0, 0), Material("Light", (Lobe("emission", C(1.0)),)))
    return World(dataclasses.replace(b.build(), textures=(halves(0.25, 0.75),) if textured else ()))


def test_elements_scatter_by_their_own_roughness():
    """Bins of directions: a textured material is as good as one material for each roughness on its grid."""
    bins, out = Bins(4, 8), []
    for textured in (True, False):
        world = lit_quads(textured)
        elements = Elements(world, 1.0)
        scattering = Scattering.ready(elements, bsdf.BsdfTable(world.scene), bins, 1 << 12)
        assert len(scattering.materials) == 3
        arriving = np.random.default_rng(5).random((2 * elements.count, bins.size, 3))
        out.append(scattering.apply(arriving))
    assert np.allclose(*out, rtol=1e-5)


def test_path_tracing_over_a_texture_of_roughness_is_that_over_two_materials():
    out = []
    for textured in (True, False):
        world = lit_quads(textured)
        receivers = ElementReceivers(Elements(world, 1.0))
        solver = method("path_tracing")
        *_, last = solver.solve(world, receivers, solver.Settings(samples=64, max_length=4), np.random.default_rng(2))
        out.append(last.solution().quantity("irradiance"))
    assert np.allclose(*out, rtol=5e-3)


def test_the_range_of_a_number_is_that_of_its_images():
    """What lies outside of a clipped image is 0, and signs turn ranges round."""
    pixels = np.ones((2, 2, 4), np.float32)
    pixels[..., 0] = [[0.25, 0.5], [0.5, 0.75]]
    other = pixels.copy()
    other[..., 0] = [[-3.0, 0.5], [0.5, 1.0]]
    other[0, 0, 3] = 0.125
    scene = quads([diffuse("M", 0.5)], [Texture("A", pixels, extension) for extension in ("EXTEND", "CLIP")] + [Texture("B", other)])

    def found(*numbers):
        return ScalarField(list(numbers), scene, -10.0, 10.0).range(0)

    assert found(image(0)) == (0.25, 0.75) and found(image(1)) == (0.0, 0.75)
    assert found(image(0, -2.0)) == (-1.5, -0.5)
    product = Color((Term((-1.0, 0.0, 0.0), (Source("image", "", 2), Source("image", "", 2))),))
    assert found(product) == (-9.0, 3.0)
    assert found(Color((Term((1.0, 0.0, 0.0), (Source("image", "", 2, alpha=True),)),))) == (0.125, 1.0)
