# SPDX-License-Identifier: GPL-3.0-or-later
"""Light that bounces more than once between the microfacets of a rough surface: what a single bounce loses is given back.

A lobe f of single scattering is multiplied by s(wo) s(wi), where s makes a white lobe lose nothing: for every wo
    s(wo) * integral of f(wo, wi) s(wi) |cos| over wi = 1.
The product keeps f's symmetry, so gathering and shooting agree. Cycles multiplies by 1 / E(wo) alone (E: the albedo of f); where wi
lies near the mirror direction, as in all but the roughest lobes, s(wo) s(wi) is the same.
Coloured facets absorb at each bounce (Kulla and Conty 2017): the factor is 1 + (s s - 1) m, m = F E / (1 - F (1 - E)), with the means
F of the facets' reflectance and E of the albedo.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..sampling.maps import dot_rows
from . import microfacet as mf
from .curves import MU, Curves, Mixture

GRID = 64  # samples of visible normals for an entry, squared
STEPS = 60  # of the iteration for s
SMALLEST = 0.05  # roughness below which nothing is lost that could be seen


@dataclass(frozen=True, eq=False)
class Gain:
    """s (2, MU) float32, by side (0 outside, 1 inside) and cosine, and the mean albedo E of single scattering."""

    curve: np.ndarray
    mean: float


@lru_cache(maxsize=256)
def gain(roughness: float, ior: float | None = None) -> Gain:
    """The gain of a rough reflector, or of rough glass of index `ior`."""
    # Step 1: the share of light from each cosine that goes to each cosine, on two sides.
    sides = 1 if ior is None else 2
    kernel = np.zeros((sides, MU, sides, MU))
    for side in range(sides):
        for other, cosine, share in _scattered(roughness, ior, side):
            low, beyond = mf.cosine_entry(cosine, MU)
            for at, part in ((low, 1 - beyond), (low + 1, beyond)):
                index = np.arange(MU)[:, None] * MU + at
                found = np.bincount(index.ravel(), (share * part).ravel(), MU * MU)
                kernel[side, :, other] += found.reshape(MU, MU) / GRID**2
    kernel = kernel.reshape(sides * MU, sides * MU)

    # Step 2: scale rows and columns alike until every row sums to 1; the root keeps the iteration from swinging.
    s = np.ones(sides * MU)
    for _ in range(STEPS):
        s = np.sqrt(s / np.maximum(kernel @ s, 1e-6))
    albedo = kernel.sum(axis=1).reshape(sides, MU)
    curve = np.broadcast_to(s.reshape(sides, MU), (2, MU)).astype(np.float32)
    return Gain(curve, float((albedo * (2 * _cosines() / MU)).sum(axis=1).mean()))


def _cosines() -> np.ndarray:
    return (np.arange(MU) + 0.5) / MU


def _scattered(roughness: float, ior: float | None, side: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Where light at each cosine goes from `side`: the side it goes to, cosines (MU, GRID^2) and shares (MU, GRID^2)."""
    n = GRID * GRID
    a, b = (x.ravel() for x in np.meshgrid(*[(np.arange(GRID) + 0.5) / GRID] * 2))
    # Closer together near 1, where the few steep facets are that send light below the surface.
    density = 3 * (1 - a) ** 2
    a = 1 - (1 - a) ** 3
    mu = np.repeat(_cosines().astype(np.float32), n)
    alpha = np.full(len(mu), roughness**2, np.float32)
    wo = np.stack([np.sqrt(1 - mu * mu), np.zeros_like(mu), mu], axis=1)
    h = mf.visible_normal(wo, alpha, *(np.tile(x, MU).astype(np.float32) for x in (a, b)))
    wi = mf.reflect(wo, h)
    share = np.where(wi[:, 2] > 0, mf.masking(wo, wi, alpha) * (1 + mf.smith_lambda(wo, alpha)), 0) * np.tile(density, MU)
    if ior is None:
        return [(0, wi[:, 2].reshape(MU, n), share.reshape(MU, n))]
    eta = np.full(len(mu), 1 / ior if side else ior, np.float32)
    fresnel = mf.fresnel(dot_rows(wo, h), eta).astype(np.float64)
    t, total = mf.refract(wo, h, eta)
    passed = np.where((t[:, 2] < 0) & ~total, (1 - fresnel) / (1 + mf.smith_lambda(t, alpha)), 0) * np.tile(density, MU)
    return [
        (side, wi[:, 2].reshape(MU, n), (fresnel * share).reshape(MU, n)),
        (1 - side, t[:, 2].reshape(MU, n), passed.reshape(MU, n)),
    ]


class Gains(Curves):
    """The gains of all lobes of a scene. Row 0 is of lobes that scatter once: it changes nothing."""

    def __init__(self) -> None:
        super().__init__(_curve, 1.0)

    def row(self, roughness: float, ior: float | None) -> int:
        """The row of a lobe, made where there is none yet; `ior` is None where nothing passes."""
        return 0 if roughness < SMALLEST else super().row(roughness, ior)

    def kept(self, row: Mixture, reflectance: np.ndarray) -> np.ndarray:
        """m (n, 3): the share of what is given back that facets of mean reflectance (n, 3) do not absorb."""
        mean = self.mean_at(row)[:, None]
        return reflectance * mean / np.maximum(1 - reflectance * (1 - mean), np.float32(1e-6))

    def excess(self, row: Mixture, inside: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
        """s(wo) s(wi) - 1 (n,) for directions in the frame of the normal that points to wo's side; `inside`: that is the inside."""
        return self.at(row, inside, wo[:, 2]) * self.at(row, inside ^ (wi[:, 2] < 0), wi[:, 2]) - 1


def _curve(roughness: float, ior: float | None) -> tuple[np.ndarray, float]:
    found = gain(roughness, ior)
    return found.curve, found.mean
