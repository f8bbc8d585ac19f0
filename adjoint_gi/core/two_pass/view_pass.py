"""The second pass: from receivers over mirrors and sampled lobes to surfaces whose diffuse light the first pass has found.

At every surface the diffuse lobe either reads the known irradiance or is sampled like the others; all other lobes are always sampled
by their BSDF, with light points and multiple importance sampling for what they see of the lights (Sillion and Puech 1989, second
pass; Chen et al. 1991, the passes after the first).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bsdf import microfacet as mf
from ..bsdf import table as bsdf
from ..lights.direct import direct_irradiance
from ..scene.world import Surface
from ..walks.gathering import Estimate
from ..walks.radiance import Gathered, Walk, departure, leaving, light_share, lobes_of, met, next_event, white
from .known_light import KnownLight


@dataclass(frozen=True, eq=False)
class View:
    """hops: at so many rough or diffuse surfaces in a row the diffuse lobe is sampled, too; from the next one on it is known.

    sharp: where it is known and seen directly or over perfect mirrors only, direct light is evaluated at the point itself.
    unmet: light that no sampled ray can find, for the diffuse lobes that are sampled; or None.
    """

    walk: Walk
    known: KnownLight
    hops: int
    sharp: bool
    unmet: KnownLight | None = None

    def gather(self, surface: Surface, lobes: bsdf.Lobes, rng: np.random.Generator) -> Gathered:
        """Radiance (n, 3) that the points send towards the `wo` of their `lobes`, own emission left out."""
        walk, n = self.walk, len(surface.triangle)
        direct, indirect = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        weight, row = np.ones((n, 3), np.float32), np.arange(n)
        hops, mirrored = np.full(n, self.hops), np.ones(n, bool)
        rays = 0
        for segments in range(walk.max_length):
            # Light that reaches the surface straight has length `segments` + 1.
            counts = walk.min_length <= segments + 1
            out = direct if segments == 0 else indirect
            # Step 1: what is known of the diffuse lobes, which are done with then.
            known = (hops <= 0) & (lobes.diffuse.max(axis=1) > 0)
            at = np.flatnonzero(known)
            if len(at):
                bright = weight[at] * below_coat(lobes, at)
                first, rest, cast = self._known(surface.take(at), segments, mirrored[at], counts, rng)
                out[row[at]] += bright * first
                indirect[row[at]] += bright * rest
                rays += cast
                lobes = lobes.without_diffuse(known)
            at = np.flatnonzero(~known & (lobes.diffuse.max(axis=1) > 0))
            if self.unmet is not None and len(at):
                indirect[row[at]] += weight[at] * below_coat(lobes, at) * self.unmet.at(surface.take(at), segments)[1]
            # Step 2: points with nothing left have come to their end.
            left = (lobes.diffuse.max(axis=1) > 0) | lobes.others()
            if not left.all():
                at = np.flatnonzero(left)
                row, weight, hops, mirrored = row[at], weight[at], hops[at], mirrored[at]
                surface, lobes = surface.take(at), lobes.take(at)
            if not len(row):
                break
            # Step 3: light points.
            if counts and walk.lights and walk.emitters.any_drawn():
                at, value, cast = next_event(walk, surface, lobes, rng)
                out[row[at]] += weight[at] * value
                rays += cast
            # Step 4: a ray by the lobes that are left, and the emission it meets.
            scattered = bsdf.sample(lobes, rng)
            go = leaving(surface, scattered)
            if not len(go):
                break
            origin, wi = departure(walk, surface, scattered, go)
            share, pdf, delta = light_share(lobes)[go], scattered.pdf_w[go], scattered.delta[go]
            weight, row = weight[go] * scattered.weight[go], row[go]
            hops, mirrored = hops[go] - ~delta, mirrored[go] & delta
            triangle, u, v, t = walk.world.intersect(origin, wi, scattered.kind[go])
            rays += len(go)
            if counts:
                out[row] += weight * met(walk, origin, wi, (triangle, u, v, t), pdf, delta, share)
            # Step 5: the surface it meets.
            keep = triangle >= 0
            if segments + 1 >= walk.roulette:
                p = np.clip(weight.max(axis=1), np.float32(0.05), np.float32(1))
                keep &= rng.random(len(p), np.float32) < p
                weight = weight / p[:, None]
            at = np.flatnonzero(keep)
            weight, row, hops, mirrored, wo = weight[at], row[at], hops[at], mirrored[at], -wi[at]
            surface = walk.world.surface(triangle[at], u[at], v[at], wo)
            lobes = walk.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, wo)
        return Gathered(direct, indirect, rays)

    def _known(
        self, surface: Surface, segments: int, mirrored: np.ndarray, counts: bool, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Direct and indirect irradiance (n, 3), and the rays cast for it."""
        first, rest = self.known.at(surface, segments)
        at = np.flatnonzero(mirrored)
        if not (self.sharp and counts and len(at)):
            return first, rest, 0
        first[at], cast = direct_irradiance(self.walk.world, self.walk.emitters, surface.take(at), 1, rng)
        return first, rest, cast


def below_coat(lobes: bsdf.Lobes, at: np.ndarray) -> np.ndarray:
    """(m, 3) radiance towards wo for irradiance 1 on the diffuse lobes in rows `at` (m,), below whatever coat they have."""
    part = lobes.diffuse[at] / mf.PI
    if not lobes.table.any_coat:
        return part
    return part * (1 - lobes.coat(at))[:, None]


def estimator(view: View) -> Estimate:
    """An `Estimate` for `gathering.Run` of what a view pass finds."""

    def estimate(surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
        if wo is not None:
            return view.gather(surface, lobes_of(view.walk, surface, wo), rng)
        found = view.gather(surface, white(view.walk, surface), rng)
        return Gathered(np.float32(np.pi) * found.direct, np.float32(np.pi) * found.indirect, found.rays)

    return estimate
