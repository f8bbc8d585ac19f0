"""Pairs of directions that a lobe joins, drawn once from a fixed set: from them scattering is put into bins or into harmonics.

Both need integrals of f(wo, wi) cos cos over two hemispheres. The given direction is drawn by the cosine, the other one by the lobe
itself, so that narrow lobes, perfect mirrors and refraction need nothing special.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bsdf import table as bsdf
from ..bsdf.curves import Mixture
from ..bsdf.multiscatter import Gains
from ..sampling.additive import STEPS, additive
from ..sampling.maps import TWO_PI, polar

PAIRS = 1 << 15


@dataclass(frozen=True, eq=False)
class Pairs:
    """n pairs: `given` (n, 3) float32 distributed by the cosine, `other` (n, 3) where its lobe sends it, both with z > 0 on their own
    side; through (n,) bool: `other` lies on the other side; weight (n,) float64 whose mean over the others is the albedo."""

    given: np.ndarray
    other: np.ndarray
    through: np.ndarray
    weight: np.ndarray

    def times(self, factor: np.ndarray) -> Pairs:
        """The same pairs with their weights times `factor` (n,)."""
        return Pairs(self.given, self.other, self.through, self.weight * factor)

    def excess(self, gains: Gains, row: int, inside: bool) -> np.ndarray:
        """(n,) what comes on top of single scattering, for white facets; `inside`: the given directions lie on the inside."""
        n = len(self.given)
        other = self.other * np.where(self.through, -1, 1)[:, None]
        return gains.excess(Mixture.of(row, n), np.full(n, inside), self.given, other)


def given_directions(count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` directions (n, 3) float32 by the cosine, and three more numbers in 0..1 for each, (3, n) float32."""
    x = additive(np.arange(count), STEPS[5], 0.5).astype(np.float32)
    return np.ascontiguousarray(polar(x[0], TWO_PI * x[1]).T), x[2:]


def pairs(kind: int, alpha: float, ior: float, front: bool, table: bsdf.BsdfTable, count: int = PAIRS) -> Pairs:
    """The pairs of a white lobe (a kind of `bsdf.LOBE_KINDS`) of single scattering, seen from the outside, or from the back."""
    given, u = given_directions(count)
    n = len(given)
    lobes = bsdf.white_lobe(kind, alpha, ior, given, front, table)
    uniform = np.concatenate([np.full((1, n), 0.5, np.float32), u])
    s = bsdf.sample(lobes, np.random.default_rng(0), uniform)
    other = s.wi.copy()
    other[:, 2] = np.abs(other[:, 2])
    weight = np.where(np.isfinite(s.weight[:, 0]), s.weight[:, 0], 0).astype(np.float64)
    return Pairs(given, other, s.through & (weight > 0), weight)
