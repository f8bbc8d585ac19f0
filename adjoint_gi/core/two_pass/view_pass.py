"""The second pass: from receivers via mirrors and sampled lobes to surfaces whose diffuse light the first pass has found.

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
from ..sampling.maps import columns
from ..scene.arrays import RayKind
from ..scene.world import Surface
from ..walks.gathering import Estimate
from ..walks.paths import Gathered, Paths, Walk
from ..walks.radiance import LobeVertices, start
from .known_light import KnownLight


@dataclass(frozen=True, eq=False)
class View:
    """hops: at so many rough or diffuse surfaces in a row the diffuse lobe is sampled, too; from the next one on it is known.

    sharp: where it is known and seen directly or via perfect mirrors only, direct light is evaluated at the point itself.
    unmet: light of lamps that sampled rays hardly find, for the diffuse lobes that are sampled; or None. Rays that meet a lamp behind
    such a lobe and a mirror leave it to this.
    """

    walk: Walk
    known: KnownLight
    hops: int
    sharp: bool
    unmet: KnownLight | None = None

    def gather(self, vertices: LobeVertices, rng: np.random.Generator) -> Gathered:
        """Radiance (n, 3) that the vertices send towards the `wo` of their lobes, own emission left out."""
        paths, n = Paths(self.walk, vertices, rng), vertices.count
        paths.carried = {"hops": np.full(n, self.hops), "mirrored": np.ones(n, bool), "spread": np.zeros(n, bool)}
        while paths.alive:
            # Step 1: what is known of the diffuse lobes, which are done with then; paths with nothing left have come to their end.
            self._read(paths)
            # Step 2: light points, and a ray by the lobes that are left.
            paths.light_points()
            if not paths.scatter():
                break
            delta, before = paths.ray.delta, paths.carried
            spread = before["spread"] | (paths.ray.kind == RayKind.DIFFUSE)
            paths.carried = before | {"hops": before["hops"] - ~delta, "mirrored": before["mirrored"] & delta, "spread": spread}
            # Step 3: the emission it meets, and the surface.
            paths.emission_met(None if self.unmet is None else ~spread)
            paths.arrive()
        return paths.gathered()

    def _read(self, paths: Paths) -> None:
        """Add what is known where the paths stand."""
        surface, lobes, segments = paths.vertices.surface, paths.vertices.lobes, paths.length - 1
        diffuse = lobes.diffuse.max(axis=1) > 0
        known = (paths.carried["hops"] <= 0) & diffuse
        at = np.flatnonzero(known)
        if len(at):
            bright = below_coat(lobes, at)
            first, rest, cast = self._known(surface.take(at), segments, paths.carried["mirrored"][at], paths.counts, paths.rng)
            paths.rays += cast
            paths.collect(at, columns(bright * first))
            paths.collect(at, columns(bright * rest), indirect=True)
            lobes = lobes.without_diffuse(known)
        at = np.flatnonzero(~known & diffuse)
        if self.unmet is not None and len(at):
            paths.collect(at, columns(below_coat(lobes, at) * self.unmet.at(surface.take(at), segments)[1]), indirect=True)
        at = np.flatnonzero((lobes.diffuse.max(axis=1) > 0) | lobes.others())
        paths.take(at)
        paths.vertices = LobeVertices(self.walk, surface.take(at), lobes.take(at))

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
    return part * (1 - lobes.coat(at))


def estimator(view: View) -> Estimate:
    """An `Estimate` for `gathering.Run` of what a view pass finds."""

    def estimate(surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
        vertices, factor = start(view.walk, surface, wo)
        return view.gather(vertices, rng).times(factor)

    return estimate
