"""What dielectric coats reflect, and what they leave for the lobes below (Ashikhmin et al. 2000)."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from . import microfacet as mf
from .curves import MU, Curves
from .lobe import DELTA_ALPHA

MAX_COAT_SHARE = np.float32(0.999)  # something is always left for what lies below


class Coats(Curves):
    """Albedo of coats over the cosine. Row 0 is no coat."""

    def __init__(self) -> None:
        super().__init__(lambda roughness, ior: _with_mean(coat_albedo(COSINES, roughness, ior)), 0.0)

    def sum_of(self, coats: list[tuple[float, float, float]]) -> int:
        """A new row: the sum of coats (tint, roughness, index) that lie on one another, each in full."""
        total = np.zeros(MU, np.float32)
        for tint, roughness, ior in coats:
            total += tint * coat_albedo(COSINES, roughness, ior)
        return self.add(*_with_mean(np.minimum(total, MAX_COAT_SHARE)))


COSINES = ((np.arange(MU) + 0.5) / MU).astype(np.float32)


def _with_mean(curve: np.ndarray) -> tuple[np.ndarray, float]:
    return curve, (curve * (2 * COSINES / MU)).sum()


def coat_albedo(mu: np.ndarray, roughness: float, ior: float) -> np.ndarray:
    """(m,) albedo of a rough dielectric's reflection at cosines `mu` (m,), by quadrature over visible normals."""
    grid = 32
    a, b = np.meshgrid((np.arange(grid) + 0.5) / grid, (np.arange(grid) + 0.5) / grid)
    m = np.repeat(mu, grid * grid)
    alpha = np.full(len(m), max(roughness**2, float(DELTA_ALPHA)), np.float32)
    wo = np.stack([np.sqrt(1 - m * m), np.zeros_like(m), m], axis=1)
    h = mf.visible_normal(wo, alpha, np.tile(a.ravel(), len(mu)).astype(np.float32), np.tile(b.ravel(), len(mu)).astype(np.float32))
    wi = mf.reflect(wo, h)
    value = mf.masking(wo, wi, alpha) * (1 + mf.smith_lambda(wo, alpha)) * mf.fresnel(dot_rows(wo, h), np.full(len(m), ior, np.float32))
    return np.where(wi[:, 2] > 0, value, 0).reshape(len(mu), -1).mean(axis=1)
