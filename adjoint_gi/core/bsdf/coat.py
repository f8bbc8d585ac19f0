"""What dielectric coats reflect, and what they leave for the lobes below (Ashikhmin et al. 2000).

A coat of albedo E over a base of albedo c leaves it c (1 - E(wo)) (1 - E(wi)) / (1 - Em) with the mean Em of E: reciprocal, and towards
every wo exactly c (1 - E(wo)), so that a white base and its coat lose and make nothing. A material may mix bases below several coats
and bare ones. Then E here is the mean of the coats over the bases, each weighted by the albedo c that lies below it: towards every wo all
bases together still send what they send one by one; only how light is spread over wi differs, by products of differences of coats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..sampling.maps import dot_rows
from ..scene.arrays import Color, Lobe, SceneArrays
from ..scene.shading import ColorField
from . import microfacet as mf
from .curves import MU, Curves, Mixture
from .lobe import DELTA_ALPHA

MAX_COAT_SHARE = np.float32(0.999)  # something is always left for what lies below


@dataclass(frozen=True, eq=False)
class Layer:
    """The coats in one slot of the lobes at n points: rows of `Coats`, and share (n, 1) or (n, 3), by which the base is dimmed."""

    slot: int
    rows: Mixture
    share: np.ndarray

    def take(self, which: np.ndarray) -> Layer:
        """The same at a subset of the points."""
        return Layer(self.slot, self.rows.take(which), self.share[which])


@dataclass(frozen=True)
class Coating:
    """All coats at n points."""

    layers: tuple[Layer, ...] = ()

    def take(self, which: np.ndarray) -> Coating:
        """The same at a subset of the points."""
        return Coating(tuple(x.take(which) for x in self.layers))

    def any(self) -> bool:
        """Whether anything is dimmed."""
        return any(x.share.any() for x in self.layers)


class Coats(Curves):
    """Albedo of white coats over the cosine. Row 0 is no coat."""

    def __init__(self, albedo: Callable[[np.ndarray, float, float], np.ndarray] | None = None) -> None:
        """`albedo`: (m,) of a coat at cosines (m,) for a roughness and an index; `coat_albedo` unless another model of facets is given."""
        albedo = albedo or coat_albedo
        super().__init__(lambda roughness, ior: _with_mean(albedo(COSINES, roughness, ior)), 0.0)

    def by(self, albedo: Callable[[np.ndarray, float, float], np.ndarray]) -> Coats:
        """The same coats in the same rows, by another model of their facets."""
        out = Coats(albedo)
        for shape in self._known:
            out.row(*shape)
        return out

    def albedo(self, coating: Coating, cosine: np.ndarray) -> np.ndarray:
        """E (n, 1) or (n, 3) of all coats at a cosine (n,); coats of one stack lie on one another, each in full."""
        return self._total(coating, len(cosine), lambda rows: self.at(rows, False, cosine))

    def mean_albedo(self, coating: Coating, n: int) -> np.ndarray:
        """Em (n, 1) or (n, 3)."""
        return self._total(coating, n, self.mean_at)

    def leaves(self, coating: Coating, out: np.ndarray, back: np.ndarray) -> np.ndarray:
        """(n, 1) or (n, 3) what is left for lobes below at the cosines (n,) of wo and wi."""
        gone = 1 - self.mean_albedo(coating, len(out))
        return (1 - self.albedo(coating, out)) * (1 - self.albedo(coating, back)) / gone

    def _total(self, coating: Coating, n: int, value: Callable[[Mixture], np.ndarray]) -> np.ndarray:
        total = sum((x.share * value(x.rows)[:, None] for x in coating.layers), np.zeros((n, 1), np.float32))
        return np.minimum(total, MAX_COAT_SHARE)


class CoatShares:
    """By how much the coats in one slot of every material dim what all its bases reflect: the coat's colour, times the share of the
    bases' albedo that lies in its stack."""

    def __init__(self, coats: list[Lobe | None], bases: list[list[tuple[int, Color]]], scene: SceneArrays) -> None:
        """`bases`: stack and albedo of what could lie below, for each material."""
        tint, below, rest = [], [], []
        for coat, others in zip(coats, bases, strict=True):
            stack = coat.stack if coat else 0
            tint.append(coat.color if coat else Color())
            below.append(sum((c for s, c in others if s == stack), Color()))
            rest.append(sum((c for s, c in others if s != stack), Color()))
        self._tint, self._below, self._rest = (ColorField(x, scene) for x in (tint, below, rest))
        partly = any(coat and not dark.is_black for coat, dark in zip(coats, rest, strict=True))
        self.grey = not partly and all(c.is_constant and len(set(c.constant)) == 1 for c in tint)

    def at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 1) where all are grey, or (n, 3), at barycentrics of triangles."""
        tint = self._tint.at(triangle, u, v)
        if self.grey:
            return tint[:, :1]
        below, rest = (np.maximum(x.at(triangle, u, v), 0) for x in (self._below, self._rest))
        return np.clip(tint, 0, 1) * np.where(rest > 0, below / np.maximum(below + rest, mf.TINY), np.float32(1))


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
