"""Paths through scenes that are diffuse all over: cheaper vertices for the walk of `paths`, and batches of paths from receivers.

A vertex looks up no BSDF: directions are drawn by the cosine, and reflectance is an albedo that goes into the weights of the paths. Its
random numbers are low-discrepancy ones at the first surfaces. Where irradiance is wanted the receiver is such a vertex in any scene.
Vectors are component first, (3, n) float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..lights import direct
from ..lights.direct import LEAST, Hit
from ..receivers.base import Receivers
from ..sampling import maps as sampling
from ..sampling import sobol as low_discrepancy
from ..sampling.maps import PI, columns, dot
from ..scene.arrays import RayKind
from ..scene.terminator import Edge
from .gathering import Sums
from .paths import Gathered, Paths, Ray, Walk
from .radiance import LobeVertices, arrived
from .sight import see

ONE = np.float32(1)
SITE, VERTEX = 2, (2, 3)  # numbers for the place on the receiver; and at each of the first vertices for a direction and for a light point
STRATIFIED = 3  # vertices that get low-discrepancy numbers
USES = (SITE, *VERTEX * STRATIFIED)


class DiffuseVertices:
    """Points with normals (3, n) on surfaces that are diffuse: where a scene has no other lobes, this is all there is to know.

    The reflectance of a vertex is in the weights of the paths that reach it, times pi over the radiance that it averages.
    """

    scale = ONE / PI

    def __init__(
        self, walk: Walk, origin: np.ndarray, ng: np.ndarray, ns: np.ndarray, u: np.ndarray, numbers: Numbers, edge: Edge | None = None
    ) -> None:
        """`origin`: of rays that leave. `u` (5, n): their random numbers; `numbers`: where those of later ones come from. `edge`:
        where light ends on smooth faces."""
        self.walk, self.ng, self.ns, self.u, self.numbers, self.edge = walk, ng, ns, u, numbers, edge
        self.count, self.origin = origin.shape[1], origin

    def light_points(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, int]:
        """One light point for each: rows (m,) that are lit, irradiance (3, m), shadow rays cast."""
        walk, respond = self.walk, direct.irradiance(self.ng, self.ns, self.edge)
        return direct.from_lights(walk.world, walk.emitters, self.origin, self.u[2:5], respond, joined=walk.emitters.any_met())

    def scatter(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Ray:
        """A ray drawn by the cosine from each; those below the surface carry nothing."""
        origin, (w, cosine), rows = self.origin, sampling.cosine_hemisphere(self.ns, self.u[0], self.u[1]), None
        if self.ns is not self.ng:
            rows = np.flatnonzero(dot(w, self.ng) > 0)
            origin, w, cosine = origin.take(rows, axis=1), w.take(rows, axis=1), cosine.take(rows)
        return Ray(rows, origin, w, RayKind.DIFFUSE, np.maximum(cosine / PI, 2 * LEAST))

    def reflectance(self, hit: Hit, rows: np.ndarray) -> np.ndarray:
        """(3, m) albedo where rays `rows` (m,) hit."""
        return self.walk.faces.albedo_at(*(a.take(rows) for a in hit[:3]))

    def arrive(self, ray: Ray, hit: Hit, rows: np.ndarray, path: np.ndarray, rng: np.random.Generator) -> DiffuseVertices:
        """The vertices where rays `rows` (m,) of paths `path` (m,) hit."""
        triangle, u, v, t = (a.take(rows) for a in hit)
        w = ray.wi.take(rows, axis=1)
        faces, later = self.walk.faces, self.numbers.next()
        ng, ns = faces.normals(triangle, u, v, w)
        origin = ray.origin.take(rows, axis=1)
        origin += w * t
        origin = faces.lifted(origin, ng, triangle, t)
        return DiffuseVertices(self.walk, origin, ng, ns, later.at(path, rng), later, faces.edge(triangle, u, v, ng, ns))


class WhiteVertices(DiffuseVertices):
    """Receivers of irradiance in scenes with other lobes, which paths meet from the next vertex on. Irradiance is what a white surface
    sends, times pi, which is in the weights of the paths."""

    def reflectance(self, hit: Hit, rows: np.ndarray) -> None:
        """The rays' weights from there on have it."""

    def arrive(self, ray: Ray, hit: Hit, rows: np.ndarray, path: np.ndarray, rng: np.random.Generator) -> LobeVertices:
        """The vertices where rays `rows` (m,) hit."""
        return arrived(self.walk, ray, hit, rows)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Random numbers of vertex `k` of paths: low-discrepancy ones of `points` (5 * STRATIFIED, paths) first, then others.

    Of each vertex direction (2), light pick (1), point on the light (2).
    """

    points: np.ndarray
    k: int = 0

    def at(self, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(5, n) float32 for paths `path` (n,)."""
        many = sum(VERTEX)
        if self.k >= STRATIFIED:
            return rng.random((many, len(path)), np.float32)
        u = self.points[many * self.k : many * (self.k + 1)]
        return u if len(path) == u.shape[1] else u.take(path, axis=1)

    def next(self) -> Numbers:
        """Those of the next vertex."""
        return Numbers(self.points, self.k + 1)


class PathTracer:
    """Traces batches of paths in a world; safe to use from several threads at once. With a camera, in scenes of diffuse surfaces only."""

    def __init__(self, walk: Walk, receivers: Receivers, trace: Callable[[Paths], Gathered], seed: tuple[int, ...]) -> None:
        """`trace` takes the steps of paths. `seed`: whole numbers from which the numbers of every batch follow."""
        self.walk, self.receivers, self.trace, self.seed = walk, receivers, trace, seed
        self.emitters, self.faces = walk.emitters, walk.faces
        self.vertices = DiffuseVertices if walk.table.only_diffuse else WhiteVertices

    def batch(self, item: tuple[int, int, int, int]) -> Sums:
        """Samples of `item` (first receiver, last, samples, index of the first sample); the same item gives the same bits."""
        first, last, samples, index = item
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=(first, index))))
        receiver = np.arange(first, last)
        numbers = low_discrepancy.shifted(receiver, index, samples, USES, self.seed[0])
        ids = np.repeat(receiver, samples)
        place = {"uniform": numbers[:SITE]} if self.receivers.takes_uniform else {}
        points = self.receivers.sample(ids, rng, **place)
        lit = np.zeros((2, 3, len(ids)), np.float32)  # direct, indirect
        camera, emitted, rays, seen = self.receivers.measure == "radiance", None, points.rays, None
        if camera:
            sight = see(self.emitters, self.receivers, points, rng, self.walk.min_length == 0)
            points, seen = sight.layers[0].points, sight.layers[0].weight
            emitted, rays = columns(sight.emitted), sight.rays
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
            throughput = self.faces.albedo_at(triangle, u, v)
            if seen is not None:
                throughput = throughput * seen[rows].T
            albedo[:, rows] = throughput
            scale = ONE
        else:
            throughput = np.full(position.shape, PI)
            scale = ONE / PI
        later = Numbers(numbers[SITE:, rows])
        origin, edge = self.faces.lifted(position, ng, triangle), self.faces.edge(triangle, u, v, ng, ns)
        vertices = self.vertices(self.walk, origin, ng, ns, later.at(triangle, rng), later, edge)
        found = self.trace(Paths(self.walk, vertices, rng, weight=throughput, unit=scale))
        lit[0][:, rows], lit[1][:, rows] = found.direct.T, found.indirect.T
        rays += found.rays

        # Step 2: sum over the samples of each receiver; nothing that is not a number may get out.
        spoiled = 0
        if not np.isfinite(lit.sum()):
            bad = ~np.isfinite(lit).all(axis=(0, 1))
            spoiled = int(bad.sum())
            lit[:, :, bad] = 0
        parts = [a if a is None else a.reshape(3, -1, samples).sum(axis=2).T for a in (lit[0], lit[1], emitted, albedo)]
        tail = None if found.tail is None else np.where(np.isfinite(found.tail), found.tail, 0).sum(axis=1, dtype=np.float64)
        return Sums(first, last, samples, *parts, rays, spoiled, tail=tail)
