"""Direction bins, scattering between them, and the transport over element sides and bins."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.bsdf.lobes import LOBE_KINDS
from adjgi.adjoint_gi.core.directional.bins import Bins, frames
from adjgi.adjoint_gi.core.directional.harmonics import HemisphereHarmonics
from adjgi.adjoint_gi.core.directional.pairs import pairs
from adjgi.adjoint_gi.core.directional.rays import DirectionalRays
from adjgi.adjoint_gi.core.directional.scattering import Scattering
from adjgi.adjoint_gi.core.directional.transport import DirectionalTransport
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.radiosity.relaxation import jacobi
from adjgi.adjoint_gi.core.radiosity.transports import MatrixTransport
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes

SIZES = [(1, 1), (1, 4), (2, 3), (4, 8)]
WALLS = Material("Wall", (Lobe("diffuse", Color.of(0.3, 0.5, 0.1)), Lobe("glossy", Color.of(0.4, 0.3, 0.6), 0.5)))
COATED = Material("Coated", (Lobe("diffuse", Color.of(0.6)), Lobe("specular", Color.of(1.0), 0.3, 1.5)))
METAL = Material("Metal", (Lobe("metallic", Color.of(0.9, 0.6, 0.3), 0.4),))
BRUSHED = Material("Brushed", (Lobe("metallic", Color.of(0.9, 0.6, 0.3), 0.8, multiscatter=True),))
FROSTED = Material("Frosted", (Lobe("glass", Color.of(0.9, 0.9, 0.8), 0.7, 1.5, multiscatter=True),))
MIRROR = Material("Mirror", (Lobe("glossy", Color.of(0.8), 0.0),))
GLASS = Material("Glass", (Lobe("glass", Color.of(0.9), 0.3, 1.5),))
CLEAR = Material("Clear", (Lobe("refraction", Color.of(0.9), 0.0, 1.5), Lobe("transparent", Color.of(0.05))))


def table():
    return bsdf.BsdfTable(World(SceneBuilder().build()).scene)


def transport_of(materials, rows=2, columns=4, edge=10.0, rays=4, block=None):
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), materials, inward=True)
    if block is not None:
        b.box("Block", (1.25, 1.0, 0.5), (2.0, 2.5, 1.5), block, inward=False)
    elements = Elements(World(b.build()), edge)
    bins = Bins(rows, columns)
    scattering = Scattering.ready(elements, bsdf.BsdfTable(elements.world.scene), bins, 1 << 13)
    t = DirectionalTransport(DirectionalRays(elements), scattering, rays)
    for _ in t.cast():
        pass
    return t


def inner_sides(t):
    """Sides of a closed room that see it."""
    return np.arange(t.count) % 2 == 0


def ones(t):
    return np.ones((t.count, t.bins.size, 3))


# ---- bins


@pytest.mark.parametrize(("rows", "columns"), SIZES)
def test_bins_have_equal_projected_solid_angle_and_find_their_directions(rows, columns):
    bins = Bins(rows, columns)
    rng = np.random.default_rng(0)
    index = np.repeat(np.arange(bins.size), 50)
    w = bins.directions(index, *rng.uniform(0.01, 0.99, (2, len(index))))
    assert np.allclose(np.linalg.norm(w, axis=1), 1, atol=1e-6)
    assert (bins.of(w) == index).all()
    # A cosine-weighted set falls into all bins alike.
    u = np.arange(200_000)[:, None] * np.array([0.7548776662, 0.5698402910]) % 1
    r, phi = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    w = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - u[:, 0])], axis=1)
    share = np.bincount(bins.of(w), minlength=bins.size) / len(w)
    assert np.allclose(share, 1 / bins.size, atol=1e-4)


def test_interpolation_between_bins_keeps_constants_and_middles():
    bins = Bins(4, 8)
    rng = np.random.default_rng(0)
    w = bins.directions(rng.integers(0, 32, 500), *rng.random((2, 500)))
    index, weight = bins.basis(w)
    assert np.allclose(weight.sum(axis=1), 1, atol=1e-12) and weight.min() >= 0
    middle = bins.directions(np.arange(32), np.full(32, 0.5), np.full(32, 0.5))
    index, weight = bins.basis(middle)
    own = (weight * (index == np.arange(32)[:, None])).sum(axis=1)
    assert np.allclose(own, 1, atol=1e-4)


def test_frames_of_both_sides_share_their_tangents():
    n = np.random.default_rng(1).normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    n[0], n[1] = (0, 0, 1), (0, 0, -1)
    f = frames(n)
    assert np.abs(np.einsum("nij,nkj->nik", f, f) - np.eye(3)).max() < 1e-6
    assert np.allclose(f[0::2, :2], f[1::2, :2]) and np.allclose(f[0::2, 2], -f[1::2, 2])
    assert np.allclose(f[0::2, 2], n, atol=1e-7)


# ---- scattering


@pytest.mark.parametrize(("rows", "columns"), SIZES)
@pytest.mark.parametrize(
    ("kind", "alpha"),
    [
        (LOBE_KINDS["glossy"], 0.0),
        (LOBE_KINDS["glossy"], 0.2),
        (LOBE_KINDS["specular"], 0.1),
        (LOBE_KINDS["glass"], 0.2),
        (LOBE_KINDS["dielectric"], 0.0),
        (LOBE_KINDS["refraction"], 0.0),
    ],
)
def test_scattering_is_reciprocal_and_keeps_energy(rows, columns, kind, alpha):
    bins = Bins(rows, columns)
    front, back = (pairs(kind, alpha, 1.5, side, table(), 1 << 13) for side in (True, False))
    measure = np.array([1.0, 2.25 if kind in (LOBE_KINDS["glass"], LOBE_KINDS["refraction"]) else 1.0])
    same, other = bins.kernels((front, back), measure)
    assert same.min() >= 0
    for side in (0, 1):
        assert np.abs(same[side] - same[side].T).max() < 1e-12
    out = same.sum(axis=2)
    if other is not None:
        # Radiance over the square of the index: the flux that passes is symmetric.
        assert np.abs(measure[0] * other[0] - measure[1] * other[1].T).max() < 1e-12
        out = out + other.sum(axis=2)
    # The albedo of the lobe seen from every row of bins is what was counted.
    for side, p in enumerate((front, back)):
        row = bins.of(p.given) // columns
        counted = np.bincount(row, p.weight, rows) / np.bincount(row, minlength=rows)
        # What passes is counted from both sides, and the two counts differ by their noise.
        assert np.allclose(out[side].reshape(rows, columns), counted[:, None], rtol=1e-9 if other is None else 2e-3)
        # Nor is more sent on than arrives in a bin: sums over what leaves, by flux.
        sent = same[side].sum(axis=0)
        if other is not None:
            sent = sent + measure[1 - side] / measure[side] * other[1 - side].sum(axis=0)
        assert sent.max() <= 1 + (1e-5 if other is None else 2e-3)


def across(bins):
    """Each bin (size,) and the bin (size,) half a turn about the normal from it."""
    row, column = np.divmod(np.arange(bins.size), bins.columns)
    return np.arange(bins.size), row * bins.columns + (column + bins.columns // 2) % bins.columns


def test_a_mirror_maps_bins_to_the_mirrored_bin():
    bins = Bins(3, 8)
    p = pairs(LOBE_KINDS["glossy"], 0.0, 1.5, True, table(), 1 << 13)
    same, _ = bins.kernels((p, p), np.ones(2))
    assert np.allclose(same[0][across(bins)], 1, atol=1e-6)
    assert same[0].sum() == pytest.approx(bins.size, rel=1e-6)


@pytest.mark.parametrize(("rows", "columns"), [(2, 4), (4, 8), (8, 16)])
@pytest.mark.parametrize("ior", [1.2, 1.45, 2.4])
def test_bins_end_at_the_critical_angle(rows, columns, ior):
    """Inside, what a bin sends either passes or is reflected totally; bins find their own directions and fill the hemisphere."""
    cuts = (1.0, ior**-2)
    bins = Bins(rows, columns).on(np.array(cuts))
    p = [pairs(LOBE_KINDS["glass"], 0.0, ior, front, table(), 1 << 14) for front in (True, False)]
    _, other = bins.kernels(p, np.array([1.0, ior**2]), cuts)
    passed = (other[0] * bins.solid[0, :, 0, None] / bins.solid[1, :, 0]).sum(axis=0) / ior**2  # flux, by the bin it comes from
    low = bins.of(np.array([[np.sqrt(x), 0, np.sqrt(1 - x)] for x in (cuts[1] - 1e-4, cuts[1] + 1e-4)]), np.ones(2, int))
    assert low[1] == low[0] + columns
    assert (passed[low[1] :] < 1e-12).all() and (passed[: low[1]] > 0.7).all()
    for side in (0, 1):
        index = np.repeat(np.arange(bins.size), 20)
        u = np.random.default_rng(0).uniform(0.01, 0.99, (2, len(index)))
        assert (bins.of(bins.directions(index, *u, np.full(len(index), side)), np.full(len(index), side)) == index).all()
        assert bins.solid[side].sum() == pytest.approx(np.pi)


def test_light_that_passes_a_transparent_sheet_goes_straight():
    bins = Bins(2, 6)
    p = pairs(LOBE_KINDS["transparent"], 1.0, 1.0, True, table(), 1 << 12)
    same, other = bins.kernels((p, p), np.ones(2))
    assert not same.any()
    assert np.allclose(other[:, *across(bins)], 1, atol=1e-6)


# ---- transport


def inner(t, x, y):
    """<x, y>: sum of area times projected solid angle times x y."""
    return float((t.bins.solid * t.area[:, None, None] * x * y).sum())


@pytest.mark.parametrize("material", [WALLS, COATED, METAL, BRUSHED, MIRROR, GLASS, FROSTED, CLEAR], ids=lambda m: m.name)
def test_apply_and_adjoint_are_dual(material):
    t = transport_of(WALLS, block=material, edge=1.5)
    x, y = np.random.default_rng(1).normal(size=(2, t.count, t.bins.size, 3))
    size = np.sqrt(inner(t, x, x) * inner(t, y, y))
    assert abs(inner(t, t.apply(x), y) - inner(t, x, t.adjoint(y))) <= 1e-12 * size


@pytest.mark.parametrize(("rows", "columns"), SIZES)
def test_eight_kirchhoff_cavity(rows, columns):
    """T8: walls that emit what they absorb, 1 - a by bins, hold L = 1 everywhere, to rounding."""
    faces = [WALLS, MIRROR, COATED, METAL, WALLS, COATED]
    t = transport_of(faces, rows, columns, block=METAL, edge=2.0)
    inside = t.sky().max(axis=(1, 2)) == 0
    emitted = (1 - t.scattering.apply(ones(t))) * inside[:, None, None]
    assert emitted.min() >= -1e-12
    arriving = np.zeros_like(emitted)
    # Gathering.
    solution = np.zeros_like(emitted)
    for _ in t.gauss_seidel(solution, emitted, arriving, 1e-15, 5000):
        pass
    assert np.abs(solution[inside] - 1).max() < 1e-12
    assert np.abs((emitted + t.scattering.apply(solution))[inside] - 1).max() < 1e-12
    # Shooting.
    shot = np.zeros_like(emitted)
    for _ in t.southwell(shot, emitted, arriving, 1e-14, 100_000):
        pass
    assert np.abs(shot[inside] - 1).max() < 1e-11


def test_diffuse_walls_equal_the_full_matrix_of_the_same_rays():
    mats = [diffuse(f"F{i}", r, e) for i, (r, e) in enumerate([(0.3, 1.0), (0.5, 0), (0.6, 0), (0.14, 0), (0.2, 0.3), (0.7, 0)])]
    t = transport_of(mats, 3, 5, edge=2.0, rays=3, block=diffuse("Block", 0.4))
    # F_ij: the share of the rays of a side that meet another.
    per = t.bins.size * t.rays
    side = np.repeat(np.arange(t.count), per)
    hit = t.met >= 0
    factors = np.bincount(side[hit] * t.count + t.met[hit] // t.bins.size, minlength=t.count**2).reshape(t.count, t.count) / per
    e = t.caster.elements
    rho, emitted = np.repeat(e.albedo, 2, axis=0), np.repeat(e.emitted, 2, axis=0)
    *_, want = jacobi(MatrixTransport(t.area, rho, factors), emitted, 0 * emitted, 1e-16, 3000)
    leaving = emitted[:, None] / np.pi * np.ones((1, t.bins.size, 1))
    for scheme in (t.gauss_seidel, t.southwell):
        got = np.zeros_like(leaving)
        for _ in scheme(got, leaving, 0 * leaving, 1e-15, 100_000):
            pass
        assert np.abs(np.pi * got.mean(axis=1) - want.irradiance).max() < 1e-10


def test_rays_of_a_room_all_arrive_on_its_inside():
    t = transport_of(diffuse("Grey", 0.5))
    inside = inner_sides(t)
    met = t.met.reshape(t.count, -1)[inside]
    assert met.min() >= 0
    assert (met // t.bins.size % 2 == 0).all()
    assert t.sky()[~inside].min() == 1


def test_means_of_the_shared_scene_helpers_are_two_sided():
    """The Cornell box scatters on both sides of its faces alike."""
    elements = Elements(World(scenes.cornell(8, 8)), 0.5)
    s = Scattering.ready(elements, bsdf.BsdfTable(elements.world.scene), Bins(2, 4), 64)
    assert not s.shiny.any()
    out = s.apply(np.ones((2 * elements.count, 8, 3)))
    assert np.allclose(out, np.repeat(elements.albedo, 2, axis=0)[:, None], atol=1e-12)


@pytest.mark.parametrize("basis", [Bins(6, 4), HemisphereHarmonics(4)], ids=["bins", "harmonics"])
def test_dimming_by_a_curve_is_the_flux_of_that_radiance(basis):
    """2 pi int f(c) c dc: pi for the constant 1, 2/3 pi for the cosine, pi / 2 for its square."""
    for power, flux in ((0, np.pi), (1, 2 / 3 * np.pi), (2, np.pi / 2)):
        found = basis.dimming(lambda c, power=power: c**power)
        assert basis.exitance(np.repeat(found[None, :, None], 3, axis=2)) == pytest.approx(np.full((1, 3), flux), rel=2e-3)
    assert basis.dimming(np.ones_like) == pytest.approx(basis.constant(), abs=1e-9)


def test_dimming_is_the_mean_over_each_bin():
    """Of the square of the cosine, which falls evenly from row to row, in all columns alike."""
    found = Bins(4, 3).dimming(lambda cosine: cosine**2)
    assert found == pytest.approx(np.repeat(1 - (np.arange(4) + 0.5) / 4, 3), rel=1e-9)


def test_kernels_below_a_coat_are_not_those_of_the_same_lobe_without_one():
    """However many materials share the lobe."""
    rough, coat = Lobe("rough diffuse", Color.of(0.8), 0.7), Lobe("specular", Color.of(1.0), 0.3, 1.5)
    bare, coated = Material("Bare", (rough,)), Material("Coated", (rough, coat))

    def kernels(*materials):
        b = SceneBuilder()
        for k, material in enumerate(materials):
            b.quad(f"Quad {k}", (2 * k, 0, 0), (1, 0, 0), (0, 1, 0), material)
        elements = Elements(World(b.build()), 1.0)
        made = Scattering.ready(elements, bsdf.BsdfTable(elements.world.scene), Bins(2, 4), 1 << 12).materials
        return [np.sum([part.same for part in m.parts], axis=0) for m in made]

    alone = [*kernels(bare), *kernels(coated)]
    assert np.abs(alone[0] - alone[1]).max() > 0.01
    np.testing.assert_allclose(kernels(bare, coated), alone, rtol=1e-12)
    np.testing.assert_allclose(kernels(coated, bare), alone[::-1], rtol=1e-12)
