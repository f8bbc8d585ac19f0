"""Lambert's law: radiance is the same in all directions."""

from __future__ import annotations

import numpy as np

from ..sampling.maps import TWO_PI, polar_rows
from ..scene.arrays import RayKind
from . import microfacet as mf
from .lobe import Drawn, LobeKind, LobeView


class Diffuse(LobeKind):
    """f = colour / pi."""

    name = "diffuse"
    under_coat = True
    ray_kind = RayKind.DIFFUSE

    def evaluate(self, seen: LobeView, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the cosine."""
        up = np.maximum(wi[:, 2], 0)
        return lambert(seen.color, up), up / mf.PI

    def sample(self, seen: LobeView, smooth: np.ndarray, r: np.ndarray) -> Drawn:
        """With the density cosine / pi."""
        return Drawn(local_cosine_directions(r), seen.color)


def lambert(color: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(n, 3) f |cos| of an ideal diffuser."""
    return color * (cosine / mf.PI)[:, None]


def local_cosine_directions(r: np.ndarray) -> np.ndarray:
    """(n, 3) directions about z with the density cosine / pi, from `r` (2 or more, n)."""
    return polar_rows(r[1], TWO_PI * r[0])
