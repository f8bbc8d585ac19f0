"""Mean emission of parts of triangles, against closed forms and dense sums, and what emitters make of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emission import Emission
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, Source, Term
from adjgi.adjoint_gi.core.scene.mean_emission import mean_emission
from adjgi.adjoint_gi.core.scene.row_sums import polygon_means
from adjgi.adjoint_gi.core.scene.texture import Texture, sample_texture
from adjgi.adjoint_gi.core.scene.world import World

IMAGE = Source("image", texture=0)


def panel(pixels, interpolation="Closest", transform=None, terms=None):
    """World of a square of side 2 that shines as the picture says, seen once by it."""
    source = IMAGE if transform is None else dataclasses.replace(IMAGE, transform=transform)
    color = Color(terms or (Term((1.0, 1.0, 1.0), (source,)),))
    b = SceneBuilder()
    b.quad("Panel", (0, 0, 0), (2, 0, 0), (0, 2, 0), Material("Screen", (Lobe("emission", color),)))
    return World(dataclasses.replace(b.build(), textures=(Texture("T", pixels, "EXTEND", interpolation),)))


def lit(side, *texels):
    """A dark picture of side x side in which some texels have 20, 10 and 5."""
    out = np.zeros((side, side, 4), np.float32)
    out[..., 3] = 1
    for y, x in texels:
        out[y, x, :3] = 20, 10, 5
    return out


def fluxes(world):
    """(3,) flux of both sides by light sampling (the channels summed), by particles and by elements, each the channels summed."""
    elements = Elements(world, 0.23)
    shone = 2 * (elements.emitted * elements.area[:, None]).sum()
    return np.array([Emitters(world).flux.emitted, Emission(world).total.sum(), shone])


@pytest.mark.parametrize("extension", ["REPEAT", "EXTEND", "CLIP", "MIRROR"])
@pytest.mark.parametrize("interpolation", ["Closest", "Linear"])
def test_means_over_polygons_are_those_of_very_many_points(extension, interpolation):
    rng = np.random.default_rng(1)
    texture = Texture("T", rng.random((5, 7, 4)).astype(np.float32) ** 3, extension, interpolation)
    st = np.concatenate([rng.uniform(-2.2, 2.5, (4, 3, 2)), rng.uniform(0.3, 0.5, (2, 3, 2))])
    found, solid = polygon_means(texture, st)
    assert solid.all()
    k = np.arange(600) + 0.5
    a, b = (x.ravel() for x in np.meshgrid(k / 600, k / 600))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    for mean, (p, q, r) in zip(found, st, strict=True):
        points = p + a[:, None] * (q - p) + b[:, None] * (r - p)
        np.testing.assert_allclose(
            mean, sample_texture(texture, points.astype(np.float32)).mean(axis=0, dtype=float), rtol=0.01, atol=0.015
        )


def test_a_polygon_without_area_in_the_image_is_told():
    found, solid = polygon_means(
        Texture("T", lit(4, (1, 2)), interpolation="Closest"), np.array([[(0.1, 0.1), (0.5, 0.5), (0.9, 0.9)], [(0, 0), (1, 0), (1, 1)]])
    )
    assert list(solid) == [False, True] and found[0, 0] == 0 and found[1, 0] == pytest.approx(2 * 20 / 16)


@pytest.mark.parametrize("interpolation", ["Closest", "Linear"])
@pytest.mark.parametrize("side, texels", [(4, [(1, 2)]), (32, [(5, 9)]), (256, [(100, x) for x in range(1, 255)]), (512, [(101, 77)])])
def test_small_bright_texels_of_a_dark_picture_shine_as_they_do(side, texels, interpolation):
    """One texel between the points at which a triangle was looked at gave no light at all; one that was hit twice the light."""
    exact = 2 * np.pi * 35 * len(texels) * (2 / side) ** 2
    np.testing.assert_allclose(fluxes(panel(lit(side, *texels), interpolation)), exact, rtol=2e-3)


def test_a_black_picture_is_no_light():
    emitters = Emitters(panel(lit(16)))
    assert not emitters.any_mesh and emitters.flux.emitted == 0


def test_a_picture_repeated_and_one_squeezed_to_a_line():
    world = panel(lit(16, (5, 9)), transform=((0.5, 0.0, 0.25), (0.0, 0.5, 0.25)))
    np.testing.assert_allclose(fluxes(world), 2 * np.pi * 35 * (4 / 16) ** 2, rtol=2e-3)
    row = lit(16, *((5, x) for x in range(8)))
    world = panel(row, transform=((1.0, 0.0, 0.0), (0.0, 0.0, 5.5 / 16)))
    np.testing.assert_allclose(fluxes(world), 2 * np.pi * 35 * 2, rtol=0.02)


def test_products_and_complements_of_pictures():
    picture = lit(32, (5, 9))
    picture[5, 9, :3] = 0.5
    once, twice = Term((1.0,) * 3, (IMAGE,)), Term((3.0,) * 3, (IMAGE, IMAGE))
    texel = 2 * np.pi * 3 * (2 / 32) ** 2
    np.testing.assert_allclose(fluxes(panel(picture, terms=(twice,))), texel * 0.75, rtol=0.1)
    np.testing.assert_allclose(fluxes(panel(picture, terms=(Term((1.0,) * 3), Term((-1.0,) * 3, (IMAGE,))))), texel * 1023.5, rtol=0.01)
    np.testing.assert_allclose(fluxes(panel(picture, terms=(Term((2.0,) * 3), once))), texel * 2048.5, rtol=1e-3)


# ---- any emission over any polygon

PAINT = Source("attribute", "Paint")
SHINES = {
    "attribute": Color((Term((2.0, 1.0, 0.5), (PAINT,)),)),
    "image": Color((Term((2.0, 1.0, 0.5), (IMAGE,)),)),
    "alpha": Color((Term((2.0, 1.0, 0.5), (dataclasses.replace(IMAGE, alpha=True),)),)),
    "sum": Color((Term((1.0, 2.0, 3.0)), Term((2.0, 1.0, 0.5), (IMAGE,)), Term((0.5, 1.0, 2.0), (PAINT,)))),
    "product": Color((Term((2.0, 1.0, 0.5), (IMAGE, PAINT)),)),
    "clipped": Color((Term((0.5, 0.5, 0.5)), Term((-1.0, -1.0, -1.0), (IMAGE,)))),
}
# Convex, corners in order, some repeated: of a triangle, a square, a trapezoid, a kite and a pentagon as cells of elements are.
POLYGONS = np.array(
    [
        [(0.1, 0.1), (0.7, 0.1), (0.1, 0.8), (0.1, 0.8), (0.1, 0.8)],
        [(0.2, 0.2), (0.5, 0.2), (0.5, 0.5), (0.2, 0.5), (0.2, 0.5)],
        [(0.0, 0.0), (0.8, 0.0), (0.3, 0.3), (0.0, 0.3), (0.0, 0.3)],
        [(0.0, 0.0), (0.9, 0.05), (0.3, 0.3), (0.1, 0.3), (0.1, 0.3)],
        [(0.0, 0.0), (0.7, 0.0), (0.7, 0.3), (0.2, 0.8), (0.0, 0.8)],
    ]
)


def painted(color):
    """World of a triangle with a picture and an attribute, that shines as `color` says."""
    x, y = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 6))
    b = SceneBuilder()
    uv = np.array([[(0, 0), (1, 0.2), (0.1, 1)]], np.float32)
    b.mesh(
        "Leaf", np.array([(0, 0, 0), (2, 0, 0), (0, 2, 0)]), np.array([[0, 1, 2]]), Material("Shines", (Lobe("emission", color),)), uv=uv
    )
    scene = b.build()
    paint = np.array([[(0.1, 0.9, 0.3, 1), (1.0, 0.2, 0.4, 1), (0.3, 0.4, 1.0, 1)]], np.float32)
    leaf = dataclasses.replace(scene.objects[0], colors={"Paint": paint})
    texture = Texture("T", np.stack([x**2, y, x * (1 - y), 1 - x], axis=2).astype(np.float32), "EXTEND", "Linear")
    return World(dataclasses.replace(scene, objects=(leaf,), textures=(texture,)))


def inside(polygon, points):
    """(n,) bool: which of `points` (n, 2) lie in a convex polygon (k, 2) with corners counterclockwise."""
    side, away = np.roll(polygon, -1, axis=0) - polygon, points[:, None] - polygon
    return (side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0] >= 0).all(axis=1)


@pytest.mark.parametrize("kind", SHINES)
def test_the_mean_of_any_emission_over_any_polygon_is_that_of_very_many_points(kind):
    world = painted(SHINES[kind])
    found = mean_emission(world.shading, np.zeros(len(POLYGONS), np.int64), POLYGONS[..., 0], POLYGONS[..., 1])
    k = (np.arange(500) + 0.5) / 500
    grid = np.stack([x.ravel() for x in np.meshgrid(k, k)], axis=1)
    exact = []
    for polygon in POLYGONS:
        u, v = grid[inside(polygon, grid)].T.astype(np.float32)
        exact.append(world.shading.emission(np.zeros(len(u), np.int64), u, v).mean(axis=0, dtype=float))
    np.testing.assert_allclose(found, exact, rtol=0.03 if kind in ("product", "clipped") else 0.005)


def test_objects_that_emit_look_at_their_own_materials_alone(monkeypatch):
    """Each at those of all took 25 s for 900 objects with a material each."""
    b = SceneBuilder()
    for k in range(40):
        b.quad(f"Panel {k}", (k, 0, 0), (0.5, 0, 0), (0, 0.5, 0), diffuse(f"Glow {k}", 0.0, 1.0))
    world, asked = World(b.build()), []
    total = Material.total
    monkeypatch.setattr(Material, "total", lambda self, kind: asked.append(self.name) or total(self, kind))
    assert len(Emitters(world).mesh.objects) == 40 and len(asked) < 10 * 40
