"""The reflection model of Cook and Torrance 1982 [review 9]: Beckmann's distribution, Torrance and Sparrow's masking, Fresnel's equations.

    Rs = F D G / (4 (n.wi) (n.wo))
    D  = exp(-tan^2 a / m^2) / (pi m^2 cos^4 a),  a between n and the half vector h, m the root mean square slope of the facets
    G  = min(1, 2 (n.h) (n.wo) / (wo.h), 2 (n.h) (n.wi) / (wo.h))

The paper prints F D G / pi with a D that is pi times as large, four times as much in all: facets would send more than they receive. Here
D is normalised, so that the facets turned by it cover the surface once.

The paper adds Rs to the diffuse Rd as s Rs + d Rd with s + d = 1, which are weights of lobes here. A coat over a base has no such shares:
it leaves the base what it does not reflect itself (`coat.Coats.leaves`), by the albedo of these facets.
"""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from . import microfacet as mf
from .lobes import HIGHLIGHT
from .table import Lobes

GRID = 64  # half vectors of a coat's albedo, squared
SMALLEST_SLOPE = np.float32(0.05**2)  # a mirror's highlight would be a point


def cook_torrance(lobes: Lobes, wi: np.ndarray) -> np.ndarray:
    """(n, 3) Rs for light from `wi` (n, 3), unit, summed over the lobes that have highlights; m is roughness squared, as alpha of GGX."""
    out = np.zeros((len(wi), 3), np.float32)
    w = lobes.to_local(wi)
    lit = w[:, 2] > 0
    for i, kind, rows, seen in lobes.each(tuple(HIGHLIGHT[s.kind] & lit for s in lobes.slots)):
        h = seen.wo + w[rows]
        h /= np.maximum(np.sqrt(dot_rows(h, h)), mf.TINY)[:, None]
        between = dot_rows(seen.wo, h)
        d = beckmann(h, np.maximum(seen.alpha, SMALLEST_SLOPE))
        g = masking(h[:, 2], between, seen.wo[:, 2], w[rows, 2])
        scale = lobes.slots[i].weight[rows] * d * g / np.maximum(4 * seen.wo[:, 2] * w[rows, 2], np.float32(1e-7))
        out[rows] += kind.fresnel(seen, between) * scale[:, None]
    return out


def reflected_base(lobes: Lobes, wi: np.ndarray) -> np.ndarray:
    """(n, 3) albedo of the base for light from `wi` (n, 3), less what coats reflect; `Lobes.table` must have those of these facets."""
    if not lobes.coating.layers:
        return lobes.diffuse
    return lobes.diffuse * lobes.table.coats.leaves(lobes.coating, lobes.local[:, 2], np.maximum(lobes.to_local(wi)[:, 2], 0))


def coat_albedo(mu: np.ndarray, roughness: float, ior: float) -> np.ndarray:
    """(m,) albedo of a coat of these facets at cosines `mu` (m,): half vectors by Beckmann's distribution times their cosine to n."""
    grid = (np.arange(GRID) + 0.5) / GRID
    u, v = (x.ravel() for x in np.meshgrid(grid, grid, indexing="ij"))
    slope = max(roughness**2, float(SMALLEST_SLOPE))
    tan2, phi = -(slope**2) * np.log(1 - u), 2 * np.pi * v
    z = 1 / np.sqrt(1 + tan2)
    h = np.stack([np.sqrt(tan2) * z * np.cos(phi), np.sqrt(tan2) * z * np.sin(phi), z], axis=1).astype(np.float32)
    out = np.zeros(len(mu))
    for i, cosine in enumerate(np.asarray(mu, np.float32)):
        wo = np.broadcast_to(np.float32([np.sqrt(1 - cosine * cosine), 0, cosine]), h.shape)
        between, wi = dot_rows(wo, h), mf.reflect(wo, h)
        seen = (between > 0) & (wi[:, 2] > 0)
        share = masking(h[:, 2], between, wo[:, 2], wi[:, 2]) * between / (cosine * h[:, 2])
        out[i] = np.where(seen, mf.fresnel(between, np.full(len(h), ior, np.float32)) * share, 0).mean(dtype=float)
    return out


def coat_curve(mu: np.ndarray, roughness: float, ior: float) -> np.ndarray:
    """(m,) the same at the cosines of a table. The first entry stands for all smaller cosines and has the albedo at a quarter of its own,
    so that a coat and its base send no more than they get there either."""
    return coat_albedo(np.concatenate([mu[:1] / 4, mu[1:]]), roughness, ior)


def beckmann(h: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """D (n,) of half vectors `h` (n, 3) above the surface."""
    c2 = np.maximum(h[:, 2] ** 2, np.float32(1e-12))
    tan2 = (h[:, 0] ** 2 + h[:, 1] ** 2) / c2
    m2 = slope * slope
    return np.exp(-tan2 / m2) / (mf.PI * m2 * c2 * c2)


def masking(h: np.ndarray, between: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """G (n,) from cosines (n,): of the half vector, between it and a direction, of wo and of wi."""
    return np.minimum(1, 2 * h * np.minimum(wo, wi) / np.maximum(between, mf.TINY))
