"""Spherical harmonics: constants, orthonormality, rotation, and the projection of lobes (verification page, section 2.6b)."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.bsdf.lobes import LOBE_KINDS
from adjgi.adjoint_gi.core.bsdf.microfacet import fresnel
from adjgi.adjoint_gi.core.directional.harmonic_shooting import _carrying
from adjgi.adjoint_gi.core.directional.harmonics import (
    HemisphereHarmonics,
    bands,
    harmonic_count,
    hemisphere_quadrature,
    real_harmonics,
    rotation,
    sphere_quadrature,
)
from adjgi.adjoint_gi.core.directional.pairs import Pairs, pairs
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder
from adjgi.adjoint_gi.core.scene.world import World

ORDER = 8


def table():
    return bsdf.BsdfTable(World(SceneBuilder().build()).scene)


def random_directions(n, seed=1):
    w = np.random.default_rng(seed).normal(size=(n, 3))
    return w / np.linalg.norm(w, axis=1)[:, None]


def random_rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def cosine_coefficients(order):
    """(order + 1,) A_l = 2 pi int_0^1 P_l(t) t dt of the clamped cosine: irradiance is the sum of A_l L_lm Y_lm(n)."""
    w, weight = hemisphere_quadrature(order + 1)
    l = np.arange(order + 1)  # noqa: E741
    # Along the pole only m = 0 remains, and there Y_l0 = sqrt((2 l + 1) / (4 pi)) P_l.
    return (weight * w[:, 2]) @ real_harmonics(order, w)[:, l * l + l] / np.sqrt((2 * l + 1) / (4 * np.pi))


def test_clamped_cosine():
    want = np.array([np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24, 0, np.pi / 64])
    got = cosine_coefficients(6)
    # The cosine has a corner at the horizon, but its upper half is a polynomial: the quadrature is exact.
    assert np.allclose(got, want, atol=1e-14)


def test_a_constant_is_its_first_coefficient():
    w, weight = sphere_quadrature(ORDER)
    c = weight @ real_harmonics(ORDER, w)
    assert c[0] == pytest.approx(3.5449077018, abs=1e-10)
    assert np.abs(c[1:]).max() < 1e-13
    # Irradiance of L = 1 is pi, whatever the normal.
    y = real_harmonics(ORDER, random_directions(5))
    irradiance = y @ (cosine_coefficients(ORDER)[bands(ORDER)] * c)
    assert np.allclose(irradiance, np.pi, atol=1e-12)


def test_orthonormal_on_the_sphere():
    w, weight = sphere_quadrature(2 * ORDER)
    y = real_harmonics(ORDER, w)
    assert np.abs(y.T @ (y * weight[:, None]) - np.eye((ORDER + 1) ** 2)).max() < 1e-12


def test_low_orders_by_hand():
    w = random_directions(20)
    x, y, z = w.T
    got = real_harmonics(2, w)
    k = np.sqrt(3 / (4 * np.pi))
    assert np.allclose(got[:, 1:4], k * np.stack([y, z, x], axis=1), atol=1e-14)
    assert np.allclose(got[:, 4], np.sqrt(15 / (4 * np.pi)) * x * y, atol=1e-14)
    assert np.allclose(got[:, 6], np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1), atol=1e-14)


@pytest.mark.parametrize("seed", [1, 2])
def test_rotation_turns_the_function_and_keeps_the_norm_of_every_band(seed):
    matrix = random_rotation(seed)
    d = rotation(ORDER, matrix)
    c = np.random.default_rng(seed).normal(size=(ORDER + 1) ** 2)
    turned = d @ c
    w = random_directions(30)
    assert np.allclose(real_harmonics(ORDER, w) @ turned, real_harmonics(ORDER, w @ matrix) @ c, atol=1e-12)
    band = bands(ORDER)
    norms = [np.bincount(band, x * x) for x in (c, turned)]
    assert np.allclose(*norms, rtol=1e-12)
    assert np.abs(d[1:, 0]).max() < 1e-14


@pytest.mark.parametrize("order", range(ORDER + 1))
def test_even_half_is_orthonormal_over_the_hemisphere(order):
    basis = HemisphereHarmonics(order)
    assert basis.size == harmonic_count(order)
    w, weight = hemisphere_quadrature(2 * order + 2)
    h = basis.values(w)
    assert np.abs(h.T @ (h * weight[:, None]) - np.eye(basis.size)).max() < 1e-12
    mirrored = basis.values(w * (1, 1, -1))
    assert np.allclose(h, mirrored, atol=1e-12)
    # Flux of a radiance of 1.
    assert basis.flux @ basis.constant() == pytest.approx(np.pi, rel=1e-13)
    assert np.allclose(basis.values(w) @ basis.constant(2.5), 2.5)


def mean_albedo(p):
    return p.weight.mean()


@pytest.mark.parametrize("kind", [LOBE_KINDS["glossy"], LOBE_KINDS["specular"], LOBE_KINDS["glass"]])
@pytest.mark.parametrize("alpha", [0.0, 0.09, 0.5])
@pytest.mark.parametrize("window", [0.0, 1.0])
def test_even_light_keeps_its_flux_at_every_order(kind, alpha, window):
    """What leaves for L = 1 all around has the flux of the lobe's mean albedo, on the side and through it."""
    front, back = (pairs(kind, alpha, 1.5, side, table(), 4096) for side in (True, False))
    for order in (0, 3, 8):
        basis = HemisphereHarmonics(order, window)
        same, other = basis.kernels((front, back), np.array([1.0, 2.25]))
        moments = basis.gram @ basis.constant()  # of L = 1
        for side, p in enumerate((front, back)):
            reflected = p.weight[~p.through].sum() / len(p.weight)
            assert basis.flux @ same[side] @ moments / np.pi == pytest.approx(reflected, rel=2e-3)
            passed = p.weight[p.through].sum() / len(p.weight)
            if kind == LOBE_KINDS["glass"]:
                assert basis.flux @ other[1 - side] @ moments / np.pi == pytest.approx(passed, rel=2e-3)
        if kind != LOBE_KINDS["glass"]:
            assert other is None


@pytest.mark.parametrize("ior", [1.2, 1.45, 2.4, 1 / 1.45])
def test_glass_passes_and_reflects_by_fresnel_at_every_angle(ior):
    """Of light along one direction, on either side: by 1 % from order 4 on (2.4: 2 %, noise of pairs); none beyond the critical angle."""
    front, back = (pairs(LOBE_KINDS["glass"], 0.0, ior, side, table()) for side in (True, False))
    cuts = (1.0, ior**-2) if ior > 1 else (ior**2, 1.0)
    theta = np.linspace(0.02, 1.4, 40)
    w = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    assert HemisphereHarmonics(3).on(np.array(cuts)).moments(w[:0], np.zeros(0, int)).shape == (0, 26)
    for order, error in ((2, 0.02), (4, 0.01), (8, 0.02 if ior == 2.4 else 0.01)):
        basis = HemisphereHarmonics(order).on(np.array(cuts))
        same, other = basis.kernels((front, back), None, cuts)
        for side, eta in enumerate((ior, 1 / ior)):
            moments = basis.moments(w, np.full(len(w), side)).T
            want = fresnel(np.cos(theta).astype(np.float32), np.full(len(w), eta, np.float32))
            passed = basis.exitance((other[1 - side] @ moments).T[:, :, None], np.full(len(w), 1 - side))[:, 0]
            sent = basis.exitance((same[side] @ moments).T[:, :, None], np.full(len(w), side))[:, 0]
            assert np.abs(passed - (1 - want)).max() < error
            assert np.abs(sent - want).max() < error


def test_a_diffuse_lobe_is_one_number():
    basis = HemisphereHarmonics(4)
    p = pairs(LOBE_KINDS["glossy"], 1.0, 1.5, True, table(), 1 << 14)
    rng = np.random.default_rng(3)
    # Any other direction by the cosine, whatever the given one.
    r, phi = np.sqrt(rng.random(1 << 14)), 2 * np.pi * rng.random(1 << 14)
    other = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=1)
    lambert = Pairs(p.given, other, np.zeros(len(other), bool), np.full(len(other), 0.6))
    same, _ = basis.kernels((lambert, lambert), None)
    want = np.outer(basis.constant(), basis.constant()) * 0.6 / np.pi
    assert np.abs(same[0] - want).max() < 0.15
    assert same[0][0, 0] == pytest.approx(want[0, 0], rel=0.02)


def test_kernels_are_reciprocal_and_join_equal_m_only():
    basis = HemisphereHarmonics(5)
    p = pairs(LOBE_KINDS["glossy"], 0.2, 1.5, True, table(), 1 << 13)
    same, _ = basis.kernels((p, p), None)
    assert np.abs(same[0] - same[0].T).max() < 1e-12 * np.abs(same[0]).max()
    assert not same[0][basis.m[:, None] != basis.m].any()
    assert np.linalg.norm(same[0], 2) > 0


def test_projected_lobes_come_closer_with_the_order():
    """Radiance that a lobe makes of light from 45 degrees, in the norm under the cosine that the projection is made for."""
    p = pairs(LOBE_KINDS["glossy"], 0.3, 1.5, True, table(), 1 << 16)
    scene = table()
    w, weight = hemisphere_quadrature(96)
    wi = np.tile(np.float32([[np.sqrt(0.5), 0, np.sqrt(0.5)]]), (len(w), 1))
    seen = bsdf.white_lobe(LOBE_KINDS["glossy"], 0.3, 1.5, wi, True, scene)
    value, _ = bsdf.evaluate(seen, w.astype(np.float32))
    exact = value[:, 0] / w[:, 2]
    errors = []
    for order in (0, 2, 4, 8):
        basis = HemisphereHarmonics(order)
        same, _ = basis.kernels((p, p), None)
        got = basis.values(w) @ same[0] @ basis.values(wi[:1])[0]
        errors.append(np.sqrt(weight @ (w[:, 2] * (got - exact) ** 2)))
    assert errors[3] < errors[2] < errors[1] < errors[0]
    assert errors[3] < 0.2 * errors[0]


def test_windows_damp_bands_by_lanczos_and_keep_the_flux():
    for window in (0.0, 1.0, 2.0):
        basis = HemisphereHarmonics(4, window)
        damp = basis._window
        for band in range(1, 5):
            at = np.flatnonzero(basis.l == band)
            assert np.diag(damp)[at] == pytest.approx(np.sinc(band / 5) ** window)
        assert basis.flux @ damp == pytest.approx(basis.flux)


def test_rays_of_a_side_carry_its_flux_whether_they_ring_or_not():
    """All rays share what is missing."""
    flux, exact = np.array([[-1.0], [2], [3], [0], [1], [2], [3], [-4]]), np.array([[2.0], [8.0]])
    who, rays = np.repeat([0, 1], 4), np.array([4, 4])
    found = _carrying(flux, exact, who, rays)
    np.testing.assert_allclose(found.ravel(), [-1.5, 1.5, 2.5, -0.5, 2.5, 3.5, 4.5, -2.5])
