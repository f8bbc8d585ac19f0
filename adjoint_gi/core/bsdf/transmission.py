"""Lobes that let light through: glass and refraction by GGX microfacets (Walter et al. 2007), and plain transparency."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from ..scene.arrays import STRAIGHT, Color, Lobe
from . import microfacet as mf
from .lobe import DELTA_ALPHA, Drawn, LobeKind, LobeView
from .reflection import facets, mirrored


class Refraction(LobeKind):
    """Facets that pass all light and reflect none."""

    name = "refraction"
    delta_below = DELTA_ALPHA
    passes = refracts = True
    two_sided = False

    def evaluate(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Below the surface, and above it what facets reflect."""
        value, pdf = np.zeros((len(wi), 3), np.float32), np.zeros(len(wi), np.float32)
        above = np.flatnonzero(wi[:, 2] > 0)
        if self.reflects and len(above):
            here = seen.take(above)
            h, cosine, scale = mirrored(here, wi[above])
            share = self._facet(cosine, here.eta)
            value[above] = here.color * share[:, None] * scale[:, None]
            pdf[above] = share * mf.visible_pdf(here.wo, h, here.alpha) / np.maximum(4 * cosine, np.float32(1e-7))
        below = np.flatnonzero(wi[:, 2] < 0)
        if len(below):
            here = seen.take(below)
            passed, pdf[below] = self._through(here, wi[below])
            value[below] = here.color * passed[:, None]
        return value, pdf

    def _facet(self, cosine: np.ndarray, eta: np.ndarray) -> np.ndarray:
        """(m,) share that a facet reflects."""
        return np.zeros(len(cosine), np.float32)

    def _through(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f |cos| (m,) of white facets and pdf_w (m,) for wi below the surface."""
        o, a, e = seen.wo, seen.alpha, seen.eta
        h = -(o + e[:, None] * wi)
        h *= np.where(h[:, 2] < 0, np.float32(-1), np.float32(1))[:, None]
        h /= np.maximum(np.sqrt(dot_rows(h, h)), mf.TINY)[:, None]
        co, ci = dot_rows(o, h), dot_rows(wi, h)
        good = (co > 0) & (ci < 0)
        f = self._facet(co, e)
        # dw_h / dw_i with the index on the side of wi: Walter et al. 2007, Eq. 17.
        jacobian = e * e * np.abs(ci) / np.maximum((co + e * ci) ** 2, np.float32(1e-12))
        d = mf.distribution(h, a)
        g = 1 / (1 + mf.smith_lambda(o, a)) / (1 + mf.smith_lambda(wi, a))
        value = np.where(good, np.abs(co) * jacobian * (1 - f) * g * d / o[:, 2], 0)
        return value, np.where(good, (1 - f) * mf.visible_pdf(o, h, a) * jacobian, 0)

    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """A visible facet, and reflection or transmission at it. The choice between them cancels the share that a facet reflects."""
        eta, h = seen.eta, facets(seen, smooth, r)
        go = r[2] >= self._facet(dot_rows(seen.wo, h), eta)
        wi, total = mf.refract(seen.wo, h, eta)
        wi = np.where(go[:, None], wi, mf.reflect(seen.wo, h))
        wi[(go & (total | (wi[:, 2] >= 0))) | (~go & (wi[:, 2] <= 0))] = 0
        return Drawn(wi, seen.color)

    def passed(self, seen: LobeView) -> tuple[np.ndarray, np.ndarray]:
        """By Snell's law; nothing where it reflects totally."""
        up = np.zeros_like(seen.wo)
        up[:, 2] = 1
        wi, total = mf.refract(seen.wo, up, seen.eta)
        return wi, np.where(total, 0, 1 - self._facet(seen.wo[:, 2], seen.eta))


class Glass(Refraction):
    """Facets that split light by Fresnel's equations."""

    name = "glass"
    reflects = regains = True

    def _facet(self, cosine: np.ndarray, eta: np.ndarray) -> np.ndarray:
        return mf.fresnel(cosine, eta)

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Fresnel's equations."""
        return seen.color * mf.fresnel(cosine, seen.eta)[:, None]


class Transparent(LobeKind):
    """Light goes straight on."""

    name = STRAIGHT
    delta_below = np.float32(np.inf)
    passes = True
    two_sided = False

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Nothing: rays of every method pass."""
        return Color()

    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """The only direction that there is."""
        return Drawn(-seen.wo, seen.color)

    def passed(self, seen: LobeView) -> tuple[np.ndarray, np.ndarray]:
        """All of it, straight on."""
        return -seen.wo, np.ones(len(seen.wo), np.float32)
