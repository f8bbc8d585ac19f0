"""GGX microfacets and Fresnel reflectance, in the local frame of the shading normal (z).

Walter et al. 2007 (distribution, transmission), Heitz 2018 (sampling of visible normals), Cook and Torrance 1982 [review 9].
All arrays float32; directions (n, 3) unit, pointing away from the surface; `alpha` (n,) is roughness squared.
"""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows

PI = np.float32(np.pi)
TINY = np.float32(1e-20)
EDGE_WHITE, EDGE_SCALE = np.float32((6 / 7) ** 5), np.float32(7 / (6 / 7) ** 6)  # (1 - c)^5 and 1 / (c (1 - c)^6) at the cosine 1/7


def cosine_entry(cosine: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a cosine lies in a table of `size` entries over 0..1: the entry below it, (n,) int32, and the share of the next one, (n,)."""
    x = np.clip(np.abs(cosine) * size - np.float32(0.5), 0, np.float32(size - 1.001))
    low = x.astype(np.int32)
    return low, x - low


def distribution(h: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """D(h), density of microfacet normals per solid angle, (n,)."""
    a2 = alpha * alpha
    # a2 cos^2 + sin^2, with the sine from x and y: 1 - cos^2 has no digits left in float32 for narrow lobes.
    d = a2 * h[:, 2] ** 2 + h[:, 0] ** 2 + h[:, 1] ** 2
    return np.where(h[:, 2] > 0, a2 / (PI * d * d + TINY), np.float32(0))


def smith_lambda(w: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Smith's Lambda(w) for GGX, (n,); w may lie on either side."""
    c2 = np.maximum(w[:, 2] ** 2, np.float32(1e-12))
    t2 = np.maximum(1 - c2, 0) / c2
    return np.float32(0.5) * (np.sqrt(1 + alpha * alpha * t2) - 1)


def masking(wo: np.ndarray, wi: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Height-correlated masking and shadowing G2(wo, wi) for reflection, (n,)."""
    return 1 / (1 + smith_lambda(wo, alpha) + smith_lambda(wi, alpha))


def visible_normal(wo: np.ndarray, alpha: np.ndarray, r1: np.ndarray, r2: np.ndarray) -> np.ndarray:
    """Microfacet normals (n, 3) drawn with density G1(wo) max(0, wo.h) D(h) / wo_z; wo must be above the surface."""
    # Stretch the view direction so that the microsurface becomes a hemisphere.
    v = wo * np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)
    v /= np.maximum(np.sqrt(dot_rows(v, v)), TINY)[:, None]
    # An orthonormal frame around it: Heitz's, whose first axis is horizontal; `maps.frame` would draw other points of the same lobe.
    length = v[:, 0] ** 2 + v[:, 1] ** 2
    scale = 1 / np.sqrt(np.maximum(length, TINY))
    flat = length < 1e-14
    t1 = np.stack([np.where(flat, 1, -v[:, 1] * scale), np.where(flat, 0, v[:, 0] * scale), np.zeros_like(scale)], axis=1)
    t2 = np.cross(v, t1)
    # A point on the projected half disk.
    r = np.sqrt(r1)
    phi = 2 * PI * r2
    p1, p2 = r * np.cos(phi), r * np.sin(phi)
    s = np.float32(0.5) * (1 + v[:, 2])
    p2 = (1 - s) * np.sqrt(np.maximum(1 - p1 * p1, 0)) + s * p2
    p3 = np.sqrt(np.maximum(1 - p1 * p1 - p2 * p2, 0))
    h = p1[:, None] * t1 + p2[:, None] * t2 + p3[:, None] * v
    # Back to the ellipsoid.
    h *= np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)
    h[:, 2] = np.maximum(h[:, 2], np.float32(1e-6))
    return (h / np.sqrt(dot_rows(h, h))[:, None]).astype(np.float32)


def visible_pdf(wo: np.ndarray, h: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Density of `visible_normal` per solid angle of h, (n,)."""
    g1 = 1 / (1 + smith_lambda(wo, alpha))
    return g1 * np.maximum(dot_rows(wo, h), 0) * distribution(h, alpha) / np.maximum(np.abs(wo[:, 2]), np.float32(1e-6))


def fresnel(cos_i: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Unpolarised reflectance (n,) of a dielectric; `eta` is the index beyond the surface over the index before it."""
    c = np.abs(cos_i)
    g2 = eta * eta - 1 + c * c
    g = np.sqrt(np.maximum(g2, 0))
    a = (g - c) / np.maximum(g + c, TINY)
    b = (c * (g + c) - 1) / np.where(np.abs(c * (g - c) + 1) > TINY, c * (g - c) + 1, TINY)
    return np.where(g2 > 0, np.float32(0.5) * a * a * (1 + b * b), np.float32(1)).astype(np.float32)


def schlick(cos_i: np.ndarray, f0: np.ndarray) -> np.ndarray:
    """Schlick's reflectance (n, 3) of a conductor with normal reflectance `f0` (n, 3)."""
    m = np.clip(1 - np.abs(cos_i), 0, 1)[:, None]
    return f0 + (1 - f0) * (m * m) * (m * m) * m


def tinted(cos_i: np.ndarray, f0: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """The same (n, 3) of a conductor that reflects `edge` (n, 3) times as much at 82 degrees, the cosine 1/7 (Kutz et al. 2021)."""
    c = np.clip(np.abs(cos_i), 0, 1)[:, None]
    m = 1 - c
    return np.maximum(schlick(cos_i, f0) - edge_dip(f0, edge) * (c * (m * m) * (m * m) * (m * m)), 0)


def edge_dip(f0: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """b (n, 3): by b c (1 - c)^6 at the cosine c an edge's tint lowers Schlick's reflectance, which at c = 1/7 is f0 + (1 - f0) (6/7)^5."""
    return (f0 + (1 - f0) * EDGE_WHITE) * (1 - edge) * EDGE_SCALE


def reflect(w: np.ndarray, h: np.ndarray) -> np.ndarray:
    """w mirrored about h, (n, 3)."""
    return 2 * dot_rows(w, h)[:, None] * h - w


def refract(w: np.ndarray, h: np.ndarray, eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Refracted direction (n, 3) of w through a facet h with w.h > 0, and (n,) bool where there is total reflection."""
    c = dot_rows(w, h)
    inv = 1 / eta
    c2 = 1 - inv * inv * (1 - c * c)
    total = c2 <= 0
    t = (inv * c - np.sqrt(np.maximum(c2, 0)))[:, None] * h - inv[:, None] * w
    return t.astype(np.float32), total
