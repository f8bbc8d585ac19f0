"""Light sources as sums of differential elements (review, Eq. 6), and the cosine-power lobe that goes with them (Eq. 8).

The elements come from a fixed low-discrepancy set, the same for every receiver, so shadows are crisp and nothing is random.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..base.errors import Notice
from ..bsdf import table as bsdf
from ..bsdf.lobes import HIGHLIGHT
from ..sampling.additive import STEPS, additive
from ..sampling.maps import dot_rows
from ..scene.world import Surface, World
from .emitters import Emitters


class LightPoints:
    """`count` elements for every lamp with a size, one for every lamp without, and `count` for all emissive triangles together."""

    def __init__(self, emitters: Emitters, count: int) -> None:
        self.emitters = emitters
        k = np.arange(count)
        u, v = additive(k, STEPS[2], 0.5)
        triangles = len(emitters.triangles)
        self._draws: list[tuple[int, float, float, float]] = []
        if triangles:
            # Triangles are taken in proportion to their power: element k stands in the k-th stratum of the table.
            share = emitters.power[:triangles] / emitters.power[:triangles].sum()
            at = np.minimum(np.searchsorted(np.cumsum(share), (k + 0.5) / count), triangles - 1)
            for i, a, b in zip(at, u, v, strict=True):
                self._draws.append((int(i), float(share[i] * count), float(a), float(b)))
        for lamp in np.flatnonzero(emitters.lamps.importance > 0):
            many = count if emitters.lamps.sized[lamp] else 1
            for a, b in zip(u[:many], v[:many], strict=True):
                self._draws.append((triangles + int(lamp), float(many), float(a), float(b)))

    @property
    def batch(self) -> int:
        """At how many points to work at once, so that a batch takes about a tenth of a second."""
        return max(256, min(1 << 14, (1 << 17) // max(1, len(self._draws))))

    def irradiance(self, world: World, surface: Surface, shadows: bool = True) -> tuple[np.ndarray, int]:
        """(n, 3) float32 sum_j Le(j) cos theta(j) dw(j) at the points, W m-2, and the shadow rays cast."""
        out, rays = np.zeros((len(surface.triangle), 3), np.float32), 0
        for _, cosine, radiance, weight, cast in self.at(world, surface, shadows):
            out += radiance * (cosine * weight)[:, None]
            rays += cast
        return out, rays

    def at(self, world: World, surface: Surface, shadows: bool) -> Iterator[tuple]:
        """For each element j: wi (n, 3), cosine (n,), radiance (n, 3), weight (n,) = solid angle (0 where hidden), shadow rays cast."""
        origin, edge = world.leave(surface), world.edge(surface)
        p = np.ascontiguousarray(origin.T)
        for index, many, a, b in self._draws:
            s = self.emitters.draw_from(index, p, a, b)
            wi = np.ascontiguousarray(s.wi.T)
            cosine = np.maximum(dot_rows(wi, surface.ns), 0)
            above = dot_rows(wi, surface.ng) > 0 if edge is None else edge.lit(s.wi)
            weight = np.where((cosine > 0) & above, 1 / (s.pdf_w * np.float32(many)), np.float32(0))
            radiance = s.radiance.T
            lit = np.flatnonzero((weight > 0) & (radiance.max(axis=1) > 0))
            cast = 0
            if shadows and len(lit):
                start, way, distance = p.take(lit, axis=1), s.wi.take(lit, axis=1), s.distance[lit]
                if edge is not None:
                    edge.take(lit).lift(start, way, distance)
                hidden, share = world.shadows(np.ascontiguousarray(start.T), np.ascontiguousarray(way.T), distance)
                weight[lit[hidden & s.shadow[lit]]] = 0
                if share is not None:
                    radiance = radiance.copy()
                    radiance[lit] *= np.where(s.shadow[lit, None], share, np.float32(1))
                cast = len(lit)
            yield wi, cosine, radiance, weight.astype(np.float32), cast


def background_notices(emitters: Emitters, ambient: float) -> tuple[Notice, ...]:
    """Says that these elements have none of the background's light, unless an `ambient` radiance stands for it."""
    if ambient > 0 or not emitters.any_background:
        return ()
    mean = float(np.mean(emitters.world.scene.background))
    remedy = f"Set Ambient Radiance (ambient) to its mean, {mean:.3g}, or use Path Tracing"
    return (Notice("World", "lights no surface in this method: what it alone lights is black", remedy),)


def exponent(roughness: np.ndarray) -> np.ndarray:
    """n of cos^n alpha for a GGX roughness r: (2 / r^4 - 2) / 4, at most 1e4.

    2 / r^4 - 2 is the exponent about the half vector of a GGX lobe's width; the mirror direction turns twice as fast, hence the quarter.
    """
    return np.clip((2 / np.maximum(roughness, np.float32(0.05)) ** 4 - 2) / 4, 0, 1e4).astype(np.float32)


def phong_lobe(lobes: bsdf.Lobes, wi: np.ndarray) -> np.ndarray:
    """(n, 3) k_s (n + 2) / (2 pi) cos^n alpha, summed over the glossy lobes; alpha is the angle of wo to the mirror direction of wi."""
    mirrored = 2 * dot_rows(wi, lobes.z)[:, None] * lobes.z - wi
    cosine = np.maximum(dot_rows(mirrored, lobes.wo), 0)
    out = np.zeros((len(wi), 3), np.float32)
    for i, kind, rows, seen in lobes.each(tuple(HIGHLIGHT[s.kind] for s in lobes.slots)):
        power = exponent(np.sqrt(seen.alpha))
        lobe = lobes.slots[i].weight[rows] * (power + 2) / np.float32(2 * np.pi) * cosine[rows] ** power
        out[rows] += kind.highlight_tint(seen) * lobe[:, None]
    return out
