"""Random walks that gather: many paths side by side, compacted as they end, from receivers to emitters.

At each vertex of a path one light point is drawn, and the ray that goes on also counts the emission it meets; the two are joined
by multiple importance sampling (`core.lights.direct`). Vectors are component first, (3, n) float32. Diffuse surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..lights import direct
from ..lights.emitters import Emitters
from ..receivers.base import Receivers
from ..sampling import maps as sampling
from ..sampling import sobol as low_discrepancy
from ..sampling.maps import PI, columns, dot
from ..scene.arrays import RayKind
from ..scene.faces import Faces
from ..scene.world import World

ONE = np.float32(1)
SITE, VERTEX = 2, 5  # low-discrepancy dimensions for the place on the receiver, and for each of the first vertices
STRATIFIED = 3  # vertices that get low-discrepancy numbers
DIMENSIONS = SITE + VERTEX * STRATIFIED


@dataclass(frozen=True)
class Walk:
    """How far paths go. Lengths as in `Settings`; from path length `roulette` on, paths end at random (0: never)."""

    min_length: int = 0
    max_length: int = 64
    roulette: int = 3


@dataclass(frozen=True, eq=False)
class PathBatch:
    """Sums over the samples of receivers `first` to `last`, each (m, 3) float32; emitted and albedo only of camera receivers."""

    first: int
    last: int
    samples: int
    direct: np.ndarray
    indirect: np.ndarray
    emitted: np.ndarray | None
    albedo: np.ndarray | None
    rays: int
    spoiled: int  # samples that were not numbers and count as 0


class PathTracer:
    """Traces batches of paths in a world; safe to use from several threads at once."""

    def __init__(self, world: World, receivers: Receivers, walk: Walk, seed: tuple[int, ...]) -> None:
        """`seed`: whole numbers from which the numbers of every batch follow."""
        self.world = world
        self.receivers = receivers
        self.walk = walk
        self.seed = seed
        self.emitters = Emitters(world)
        self.faces = Faces(world)
        self.drawn, self.met = self.emitters.any_drawn(), self.emitters.any_met()

    def batch(self, first: int, last: int, samples: int, index: int) -> PathBatch:
        """Samples `index` to `index + samples` of receivers `first` to `last`; the same arguments give the same bits."""
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=(first, index))))
        receiver = np.arange(first, last)
        numbers = low_discrepancy.shifted(receiver, index, samples, DIMENSIONS, self.seed[0])
        ids = np.repeat(receiver, samples)
        place = {"uniform": numbers[:SITE]} if self.receivers.takes_uniform else {}
        points = self.receivers.sample(ids, rng, **place)
        lit = np.zeros((2, 3, len(ids)), np.float32)  # direct, indirect
        camera = self.receivers.measure == "radiance"
        emitted = np.zeros((3, len(ids)), np.float32) if camera else None
        albedo = np.zeros((3, len(ids)), np.float32) if camera else None

        # Step 1: the first vertex. Irradiance is pi times the mean radiance over the cosine; radiance has the albedo over pi in front.
        rows = np.flatnonzero(points.triangle >= 0)
        if len(rows) == len(ids):
            rows = slice(None)
        triangle, u, v = points.triangle[rows], points.u[rows], points.v[rows]
        arriving = None if points.towards is None else -columns(points.towards[rows])
        position = self.faces.positions(triangle, u, v)
        ng, ns = self.faces.normals(triangle, u, v, arriving)
        if camera:
            albedo[:, rows] = throughput = self.faces.albedo_at(triangle, u, v)
            if self.walk.min_length == 0:
                self._see(points, rows, triangle, u, v, emitted)
            scale = ONE
        else:
            throughput = np.full(position.shape, PI)
            scale = ONE / PI
        rays = points.rays
        if self.walk.max_length > 0 and len(triangle):
            rays += self._follow(np.arange(len(ids))[rows], position, ng, ns, throughput, scale, numbers[SITE:], lit, rng)

        # Step 2: sum over the samples of each receiver; nothing that is not a number may get out.
        spoiled = 0
        if not np.isfinite(lit.sum()):
            bad = ~np.isfinite(lit).all(axis=(0, 1))
            spoiled = int(bad.sum())
            lit[:, :, bad] = 0
        parts = [a if a is None else a.reshape(3, -1, samples).sum(axis=2).T for a in (lit[0], lit[1], emitted, albedo)]
        return PathBatch(first, last, samples, *parts, rays, spoiled)

    def _see(
        self, points: object, rows: np.ndarray | slice, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, emitted: np.ndarray
    ) -> None:
        """Emission that camera rays see without any bounce: surfaces, the background, and lamps in front of them."""
        escaped = points.triangle < 0
        emitted[:, escaped] = self.emitters.escaping(-points.towards[escaped]).T
        emitted[:, rows] = self.faces.emission_at(triangle, u, v)
        distance = np.where(escaped, np.float32(np.inf), points.distance).astype(np.float32)
        lamps = self.emitters.lamps_met(columns(points.origin), -columns(points.towards), distance)
        if lamps is not None:
            emitted += lamps

    def _follow(
        self,
        path: np.ndarray,
        position: np.ndarray,
        ng: np.ndarray,
        ns: np.ndarray,
        throughput: np.ndarray,
        scale: np.float32,
        numbers: np.ndarray,
        lit: np.ndarray,
        rng: np.random.Generator,
    ) -> int:
        """Walk on from the first vertices of paths `path` (n,) and add what they gather to `lit`; returns the rays cast.

        `throughput` (3, n): factor from radiance arriving at the vertex, averaged over the cosine, to the estimate.
        """
        rays, walk = 0, self.walk
        for k in range(walk.max_length):
            length = k + 1
            n = len(path)
            counts, last = length >= walk.min_length, length == walk.max_length
            origin = self.world.lifted(position, ng)
            u = self._numbers(numbers, path, k, n, rng)
            target = lit[0 if length == 1 else 1]

            # Step A: a light point, whose path has length k + 1.
            if counts and self.drawn:
                rows, value, cast = direct.from_lights(self.world, self.emitters, origin, ng, ns, u[2:5], joined=self.met)
                rays += cast
                value *= throughput.take(rows, axis=1)
                value *= ONE / PI
                _add(target, path.take(rows), value)
            if last and not (counts and self.met):
                break

            # Step B: a ray drawn by the cosine; Eq. 12 adds the emission where it arrives, at the same path length.
            w, cosine = sampling.cosine_hemisphere(ns, u[0], u[1])
            hit = self.world.intersect(origin.T, w.T, RayKind.DIFFUSE)
            triangle, hu, hv, t = hit
            rays += n
            above = None
            if ns is not ng:
                above = dot(w, ng) > 0
                throughput = throughput * above
            if counts:
                for rows, value in direct.from_hits(self.emitters, self.faces, origin, w, hit, cosine):
                    value *= throughput.take(rows, axis=1)
                    _add(target, path.take(rows), value)
            if last:
                break

            # Step C: the reflectance there, and survival by roulette: dividing by its probability keeps the estimate unbiased.
            alive = triangle >= 0
            if above is not None:
                alive &= above
            keep = np.flatnonzero(alive)
            triangle, hu, hv, t = triangle.take(keep), hu.take(keep), hv.take(keep), t.take(keep)
            throughput = throughput.take(keep, axis=1) * self.faces.albedo_at(triangle, hu, hv)
            strength = throughput.max(axis=0) * scale
            if walk.roulette and length >= walk.roulette:
                chance = np.minimum(np.sqrt(strength), ONE)
                survive = np.flatnonzero(rng.random(len(keep), np.float32) < chance)
                throughput = throughput.take(survive, axis=1) / chance.take(survive)
            else:
                survive = np.flatnonzero(strength > 0)
                throughput = throughput.take(survive, axis=1)
            if not len(survive):
                break
            keep, triangle, hu, hv, t = keep.take(survive), triangle.take(survive), hu.take(survive), hv.take(survive), t.take(survive)

            # Step D: the next vertex.
            path = path.take(keep)
            w = w.take(keep, axis=1)
            position = origin.take(keep, axis=1)
            position += w * t
            ng, ns = self.faces.normals(triangle, hu, hv, w)
        return rays

    def _numbers(self, numbers: np.ndarray, path: np.ndarray, k: int, n: int, rng: np.random.Generator) -> np.ndarray:
        """(5, n) float32 for vertex k: direction (2), light pick (1), point on the light (2)."""
        if k >= STRATIFIED:
            return rng.random((VERTEX, n), np.float32)
        u = numbers[VERTEX * k : VERTEX * (k + 1)]
        return u if n == u.shape[1] else u.take(path, axis=1)


def _add(target: np.ndarray, rows: np.ndarray, value: np.ndarray) -> None:
    """Add `value` (3, m) to columns `rows` of `target` (3, n); no row comes twice."""
    if len(rows) == target.shape[1]:
        target += value
        return
    for c in range(3):
        channel = target[c]
        channel[rows] += value[c]
