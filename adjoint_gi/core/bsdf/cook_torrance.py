"""The reflection model of Cook and Torrance 1982 [review 9]: Beckmann's distribution, Torrance and Sparrow's masking, Fresnel's equations.

    Rs = F D G / (4 (n.wi) (n.wo))
    D  = exp(-tan^2 a / m^2) / (pi m^2 cos^4 a),  a between n and the half vector h, m the root mean square slope of the facets
    G  = min(1, 2 (n.h) (n.wo) / (wo.h), 2 (n.h) (n.wi) / (wo.h))

The paper prints F D G / pi with a D that is pi times as large, four times as much in all: facets would send more than they receive. Here
D is normalised, so that the facets turned by it cover the surface once.
"""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from . import microfacet as mf
from .lobes import HIGHLIGHT
from .table import Lobes

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


def beckmann(h: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """D (n,) of half vectors `h` (n, 3) above the surface."""
    c2 = np.maximum(h[:, 2] ** 2, np.float32(1e-12))
    tan2 = (h[:, 0] ** 2 + h[:, 1] ** 2) / c2
    m2 = slope * slope
    return np.exp(-tan2 / m2) / (mf.PI * m2 * c2 * c2)


def masking(h: np.ndarray, between: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """G (n,) from cosines (n,): of the half vector, between it and a direction, of wo and of wi."""
    return np.minimum(1, 2 * h * np.minimum(wo, wi) / np.maximum(between, mf.TINY))
