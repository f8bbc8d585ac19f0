"""Lobes that only reflect, by GGX microfacets; they differ in what a facet reflects (Cook and Torrance 1982 [review 9])."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import dot_rows
from ..scene.arrays import Color, Lobe
from . import microfacet as mf
from .lobe import DELTA_ALPHA, Drawn, LobeKind, LobeView

COSINES = (np.arange(64) + 0.5) / 64  # at which a tinted reflectance is kept from falling below 0


class Reflection(LobeKind):
    """What the facets `reflected`, times D G / (4 wo_z)."""

    delta_below = DELTA_ALPHA
    reflects = True

    def evaluate(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Above the surface only."""
        value, pdf = np.zeros((len(wi), 3), np.float32), np.zeros(len(wi), np.float32)
        above = np.flatnonzero(wi[:, 2] > 0)
        if len(above):
            here = seen.take(above)
            h, cosine, scale = mirrored(here, wi[above])
            value[above] = self.reflected(here, cosine) * scale[:, None]
            pdf[above] = mf.visible_pdf(here.wo, h, here.alpha) / np.maximum(4 * cosine, np.float32(1e-7))
        return value, pdf

    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """A visible facet, and the direction that it mirrors wo to."""
        h = facets(seen, smooth, r)
        wi = mf.reflect(seen.wo, h)
        wi[wi[:, 2] <= 0] = 0
        return Drawn(wi, self.reflected(seen, dot_rows(seen.wo, h)))


class Glossy(Reflection):
    """Facets of one colour at all angles."""

    name = "glossy"
    highlight = regains = True

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """The colour."""
        return seen.color


class Metallic(Glossy):
    """Facets of a conductor, by Schlick: the colour at normal incidence, white at grazing angles."""

    name = "metallic"
    parts = 2
    partial = True

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Schlick's formula."""
        return mf.schlick(cosine, seen.color)

    def mean(self, color: np.ndarray, edge: np.ndarray | None = None) -> np.ndarray:
        """The mean of Schlick's reflectance is f0 + (1 - f0) / 21."""
        return color + (1 - color) / 21

    def albedo(self, seen: LobeView) -> np.ndarray:
        """The reflectance of a smooth metal."""
        return mf.schlick(seen.wo[:, 2], seen.color)

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Its mean reflectance."""
        return lobe.share * (20 / 21) + Color.of(1 / 21) * lobe.weight

    def fresnel(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Fresnel's equations, of the index that has the colour at normal incidence (Cook and Torrance 1982)."""
        root = np.sqrt(np.clip(seen.color, 0, np.float32(0.9999)))
        return mf.fresnel(cosine[:, None], (1 + root) / (1 - root))

    def split(self, alpha: float) -> tuple[str, float]:
        """Facets of one colour."""
        return Glossy.name, alpha

    def factors(self, alpha: float, given: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
        """The part that takes the metal's colour, and Schlick's white rest: (1 - c)^5, c the cosine to the facet between the two."""
        h = given + other
        h /= np.maximum(np.linalg.norm(h, axis=1), 1e-20)[:, None]
        white = np.clip(1 - np.einsum("ij,ij->i", given, h).astype(np.float64), 0, 1) ** 5
        return [1 - white, white]

    def tints(self, alpha: float, many: bool, color: np.ndarray, edge: np.ndarray | None = None) -> list[np.ndarray]:
        """The metal's colour, and white."""
        return [color, np.ones_like(color)]


class TintedMetallic(Metallic):
    """Facets of a conductor whose reflectance is tinted at 82 degrees (Kutz et al. 2021, the F82 model): Schlick's, less b c (1 - c)^6 at
    the cosine c, and never below 0."""

    name = "tinted metallic"
    parts = 3

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Schlick's formula and the tint of the edge."""
        return super().reflected(seen, cosine) if seen.edge is None else mf.tinted(cosine, seen.color, seen.edge)

    def mean(self, color: np.ndarray, edge: np.ndarray | None = None) -> np.ndarray:
        """The mean of c (1 - c)^6 is 1 / 126."""
        white = super().mean(color)
        return white if edge is None else np.maximum(white - mf.edge_dip(color, edge) / 126, 0)

    def albedo(self, seen: LobeView) -> np.ndarray:
        """The reflectance of a smooth metal."""
        return self.reflected(seen, seen.wo[:, 2])

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Its mean reflectance: of constant colours as it is, of others without the bound at 0."""
        if lobe.color.is_constant and lobe.edge.is_constant:
            color, edge = (np.broadcast_to(np.float32(x.constant), (len(COSINES), 3)) for x in (lobe.color, lobe.edge))
            mean = (2 * COSINES[:, None] * mf.tinted(COSINES, color, edge)).mean(axis=0)
            return Color.of(*mean.tolist()) * lobe.weight
        at_edge = lobe.color + Color.of(float(mf.EDGE_WHITE)) * lobe.color.complement()
        dip = at_edge * lobe.edge.complement() * lobe.weight * (float(mf.EDGE_SCALE) / 126)
        return super().as_diffuse(lobe) + dip * -1.0

    def fresnel(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """Fresnel's reflectance times what the tint leaves of Schlick's."""
        left = self.reflected(seen, cosine) / np.maximum(super().reflected(seen, cosine), mf.TINY)
        return super().fresnel(seen, cosine) * left

    def factors(self, alpha: float, given: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
        """Those of an untinted metal, and what the tint takes away: c (1 - c)^6."""
        plain, white = super().factors(alpha, given, other)
        beyond = white ** (1 / 5)  # 1 - c
        return [plain, white, (1 - beyond) * white * beyond]

    def tints(self, alpha: float, many: bool, color: np.ndarray, edge: np.ndarray | None = None) -> list[np.ndarray]:
        """The metal's colour, white, and -b, as large as leaves a reflectance of at least 0 at every angle."""
        dip = np.zeros_like(color)
        if edge is not None:
            dip = mf.edge_dip(color, edge)
            for c in COSINES:
                dip = np.minimum(dip, (color + (1 - color) * (1 - c) ** 5) / (c * (1 - c) ** 6))
        return [*super().tints(alpha, many, color), -dip]


class Dielectric(Reflection):
    """What glass reflects, without what it passes: by Fresnel."""

    name = "dielectric"
    two_sided = False
    partial = True

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Fresnel's equations."""
        return seen.color * mf.fresnel(cosine, seen.eta)[:, None]

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Left out."""
        return Color()

    def albedo(self, seen: LobeView) -> np.ndarray:
        """The reflectance of a smooth boundary."""
        return self.reflected(seen, seen.wo[:, 2])


class Specular(Reflection):
    """A dielectric coat over what its stack has `under_coat`. It lies on both sides and is never seen from inside."""

    name = "specular"
    is_coat = highlight = partial = True

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """By Fresnel's equations."""
        return seen.color * mf.fresnel(cosine, seen.ior)[:, None]

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Left out."""
        return Color()

    def highlight_tint(self, seen: LobeView) -> np.ndarray:
        """What it reflects at normal incidence."""
        return seen.color * (((seen.ior - 1) / (seen.ior + 1)) ** 2)[:, None]


def facets(seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(m, 3) visible facet normals, z where `smooth`."""
    h = mf.visible_normal(seen.wo, seen.alpha, r[0], r[1])
    h[smooth] = (0, 0, 1)
    return h


def mirrored(seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For wi (m, 3) above the surface: the facet normal h (m, 3) between wo and wi, the cosine (m,) to it, f |cos| (m,) if it is white."""
    h = seen.wo + wi
    h /= np.maximum(np.sqrt(dot_rows(h, h)), mf.TINY)[:, None]
    value = mf.distribution(h, seen.alpha) * mf.masking(seen.wo, wi, seen.alpha) / (4 * seen.wo[:, 2])
    return h, dot_rows(seen.wo, h), value
