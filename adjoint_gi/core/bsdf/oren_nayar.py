"""Rough diffuse surfaces: Oren and Nayar 1994 in the form of Fujii 2012 ("improved Oren-Nayar"), and what its facets lose given back.

    f = c (a + b t) + c m
    a = 1 / (pi + r (pi / 2 - 2 / 3)),  b = r a,  t = s / max(cos i, cos o) where s = wi.wo - cos i cos o is above 0, else s
    m = rho^2 / pi * Em / (1 - rho (1 - Em)) * (1 - E(wo)) (1 - E(wi)) / (1 - Em)

with roughness r, colour c, E the albedo of the first term for c = 1 and Em its mean. The second term is what Kulla and Conty 2017 add to
microfacets, in closed form as in OpenPBR; white surfaces then lose nothing. `Lobe.multiscatter` switches it on. Cycles computes it from
4.3 on, and multiplies by the colour c where the formula of OpenPBR has one factor rho less; so does this file.
"""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from ..scene.arrays import Color, Lobe, RayKind, constant_of
from . import microfacet as mf
from .diffuse import local_cosine_directions
from .lobe import Drawn, LobeKind, LobeView

LOSS = np.float32(np.pi / 2 - 2 / 3)  # 1 - E(cos) = b (LOSS - G(cos))
MEAN = np.float32((2 * np.pi - 5.6) / 3)  # cosine-weighted mean of G


class OrenNayar(LobeKind):
    """Reciprocal; drawn by the cosine."""

    name = "rough diffuse"
    under_coat = nearly_diffuse = True
    ray_kind = RayKind.DIFFUSE
    parts = 2

    def evaluate(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Above the surface only."""
        up = np.maximum(wi[:, 2], 0)
        once, again = terms(seen.alpha, seen.wo, wi)
        value = seen.color * (once * up)[:, None]
        if seen.many.any():
            value += seen.color * kept(seen.alpha, seen.color) * (again * up * seen.many)[:, None]
        return value, up / mf.PI

    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """With the density cosine / pi."""
        return Drawn(local_cosine_directions(r), seen.color)

    def as_diffuse(self, lobe: Lobe) -> Color:
        """What it reflects of uniform light. Where roughness or colour vary, its colour, which is up to 7 % more at 0.8."""
        if lobe.varies or not lobe.color.is_constant:
            return lobe.share
        alpha = np.array([constant_of(lobe.roughness) ** 2])
        once = mean_albedo(alpha)
        again = lobe.multiscatter * (1 - once) * kept(alpha, np.array([lobe.color.constant]))[0]
        return lobe.share * Color.of(*(once + again))

    def split(self, alpha: float) -> tuple[str, float]:
        """A smooth one, which is an ideal diffuser."""
        return self.name, 0.0

    def factors(self, alpha: float, given: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
        """The first term of f, and the second one without its colours, over 1 / pi."""
        return [np.pi * x.astype(float) for x in terms(np.full(len(given), alpha, np.float32), given, other)]

    def tints(self, alpha: float, many: bool, color: np.ndarray, edge: np.ndarray | None = None) -> list[np.ndarray]:
        """The colour, and what is left of it after more bounces."""
        return [color, many * color * kept(np.full(len(color), alpha), color)]


def terms(alpha: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """a + b t (n,), and (1 - E(wo)) (1 - E(wi)) / (pi (1 - Em)) (n,), for directions on the same side, z > 0."""
    r = np.sqrt(alpha)
    a = 1 / (mf.PI + r * LOSS)
    b = r * a
    o, i = np.maximum(wo[:, 2], 0), np.maximum(wi[:, 2], 0)
    s = dot_rows(wo, wi) - o * i
    t = np.where(s > 0, s / np.maximum(np.maximum(o, i), mf.TINY), s)
    return a + b * t, b * (LOSS - _g(o)) * (LOSS - _g(i)) / (mf.PI * (LOSS - MEAN))


def mean_albedo(alpha: np.ndarray) -> np.ndarray:
    """(n,) Em."""
    r = np.sqrt(alpha)
    return (mf.PI + r * MEAN) / (mf.PI + r * LOSS)


def kept(alpha: np.ndarray, color: np.ndarray) -> np.ndarray:
    """(n, 3) rho^2 Em / (1 - rho (1 - Em)), rho the colour."""
    mean = mean_albedo(alpha)[:, None]
    rho = np.clip(color, 0, 1)
    return rho * rho * mean / (1 - rho * (1 - mean))


def _g(c: np.ndarray) -> np.ndarray:
    """Fujii's G(cos), (n,): E = a pi + b G. The last term is written so that it keeps its digits at grazing angles."""
    s = np.sqrt(np.maximum(1 - c * c, 0))
    third = np.float32(2 / 3)
    return s * (np.arccos(np.minimum(c, 1)) - third - s * c) + third * s * c * (1 + s + s * s) / (1 + s)
