"""What one kind of lobe is: the interface that `lobes.LOBES` lists and the rest of the tree asks, without knowing any kind by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ..scene.arrays import Color, Lobe, RayKind
from .curves import Mixture

# Lobes narrower than this are perfect mirrors: float32 cannot hold their peak.
DELTA_ALPHA = np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class LobeView:
    """Lobes of one kind at m points, seen from `wo` (m, 3) float32, unit, in the frame of the shading normal (z), wo_z > 0.

    color (m, 3), the surface's own: what weight a lobe has in a mix is left to `table.py`; alpha (m,), roughness squared; ior (m,);
    entering (m,) bool: seen from outside; gain: rows of the scene's `Gains`, 0 where light that bounces more than once between
    microfacets is lost; many (m,) bool: it is kept; edge (m, 3), `Lobe.edge`, None where it is white everywhere.
    """

    wo: np.ndarray
    color: np.ndarray
    alpha: np.ndarray
    ior: np.ndarray
    gain: Mixture
    entering: np.ndarray
    many: np.ndarray
    edge: np.ndarray | None = None

    def take(self, which: np.ndarray) -> LobeView:
        """The same at a subset of the points."""
        parts = (self.wo, self.color, self.alpha, self.ior)
        edge = None if self.edge is None else self.edge[which]
        return LobeView(*(a[which] for a in parts), self.gain.take(which), self.entering[which], self.many[which], edge)

    @property
    def eta(self) -> np.ndarray:
        """(m,) index beyond the surface over the index on the side of wo."""
        return np.where(self.entering, self.ior, 1 / self.ior).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Directions that `LobeKind.sample` draws: wi (m, 3) in the frame, 0 where the light is lost; share (m, 3): of light from wi, what
    a perfectly smooth lobe sends to wo, over the probability of wi among the directions that it has."""

    wi: np.ndarray
    share: np.ndarray


class LobeKind(ABC):
    """One kind of lobe. All arrays are float32; directions lie in the frame of the shading normal; `f` is the BSDF.

    name            what `Lobe.kind` says
    delta_below     lobes of a smaller alpha are perfectly smooth: no density, only `sample`, `reflected` and `passed`
    reflects        whether a smooth one sends light the way a mirror does (`reflected`)
    passes          whether it lets light through (`passed`)
    refracts        whether what passes is turned by the index
    under_coat      whether a coat of the same stack lies over it and dims it
    is_coat         whether it is such a coat
    highlight       whether the empirical models of local illumination draw a highlight for it
    regains         whether `Gains` give back light that bounces more than once between facets (by the index, too, where it `passes`)
    nearly_diffuse  whether methods that cannot do it take it as diffuse, and not as something that shines
    parts           how many `factors` there are
    two_sided       whether it looks the same from both sides
    ray_kind        the `RayKind` of rays that it scatters without letting them through
    partial         whether `albedo` is far from the colour (of a coat, the scene's table of coats says it)
    """

    name = ""
    delta_below = np.float32(0)
    reflects = passes = refracts = under_coat = is_coat = highlight = partial = regains = nearly_diffuse = False
    two_sided = True
    ray_kind = RayKind.GLOSSY
    parts = 1

    def evaluate(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f(wo, wi) |cos| (m, 3) and the density pdf_w (m,) with which `sample` finds `wi` (m, 3); no lobe here is perfectly smooth."""
        return np.zeros((len(wi), 3), np.float32), np.zeros(len(wi), np.float32)

    @abstractmethod
    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """Directions from uniform numbers `r` (3, m); `smooth` (m,) bool: perfectly smooth."""

    def albedo(self, seen: LobeView) -> np.ndarray:
        """(m, 3) about the share of light from everywhere that is sent towards wo."""
        return seen.color

    def as_diffuse(self, lobe: Lobe) -> Color:
        """Albedo of the diffuse surface that methods put in its place which know no other lobe; black where they leave it out."""
        return lobe.share

    def mean(self, color: np.ndarray, edge: np.ndarray | None = None) -> np.ndarray:
        """(m, 3) what facets of this colour (m, 3), and edge (m, 3), reflect and pass, in the mean over all angles."""
        return color

    def reflected(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """(m, 3) share of light that a facet reflects which it meets at `cosine` (m,)."""
        return np.zeros_like(seen.color)

    def passed(self, seen: LobeView) -> tuple[np.ndarray, np.ndarray]:
        """Through a perfectly smooth surface: the other direction (m, 3), and the share (m,) of its light that comes through to wo."""
        return -seen.wo, np.zeros(len(seen.wo), np.float32)

    def fresnel(self, seen: LobeView, cosine: np.ndarray) -> np.ndarray:
        """(m, 3) the same in Cook and Torrance's model, which has no approximation of Fresnel's equations yet."""
        return self.reflected(seen, cosine)

    def highlight_tint(self, seen: LobeView) -> np.ndarray:
        """(m, 3) strength k_s of the highlight."""
        return seen.color

    def split(self, alpha: float) -> tuple[str, float]:
        """The white lobe, the name of its kind and its alpha, on whose pairs of directions `factors` act."""
        return self.name, alpha

    def factors(self, alpha: float, given: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
        """Factors (n,) float64 on the pairs of `split`: their sum, each times its colour of `tints`, is this lobe."""
        return [np.ones(len(given))]

    def tints(self, alpha: float, many: bool, color: np.ndarray, edge: np.ndarray | None = None) -> list[np.ndarray]:
        """Colours (m, 3), one for each of `factors`, of surfaces of `color` (m, 3) and `edge` (m, 3)."""
        return [color]
