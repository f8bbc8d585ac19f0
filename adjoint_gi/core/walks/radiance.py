"""Vertices of paths on surfaces with any BSDF, and path tracing from them (review, Eq. 12): what path tracing, distribution ray tracing,
and the second passes of two-pass and multi-pass methods share.

Surfaces, lobes and results are rows, (n, 3) float32; what `paths.Paths` takes is component first.
"""

from __future__ import annotations

import numpy as np

from ..bsdf import table as bsdf
from ..lights import direct
from ..lights.direct import INF, LEAST, Hit, Response
from ..sampling.maps import columns, sphere
from ..scene.world import Surface
from .paths import Gathered, Paths, Ray, Walk, follow


class LobeVertices:
    """Surface points with their lobes, seen from where paths come from."""

    scale = None

    def __init__(self, walk: Walk, surface: Surface, lobes: bsdf.Lobes) -> None:
        self.walk, self.surface, self.lobes = walk, surface, lobes
        self.count = len(lobes.wo)

    def take(self, which: np.ndarray) -> LobeVertices:
        """Some of them."""
        return LobeVertices(self.walk, self.surface.take(which), self.lobes.take(which))

    def light_points(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, int]:
        """One light point for each: rows (m,) that are lit, reflected radiance (3, m), shadow rays cast.

        The light points come from `uniform` (3, n) float32 where given, else from `rng`.
        """
        able = np.flatnonzero(self.lobes.smooth_part())
        if not len(able):
            return able, np.zeros((3, 0), np.float32), 0
        here = self if len(able) == self.count else self.take(able)
        surface, lobes, world = here.surface, here.lobes, self.walk.world
        # Shadow rays start on one side; where a rough lobe lets light through, on either with equal probability.
        share = light_share(lobes)
        below = (share < 1) & (rng.random(len(able), np.float32) < 0.5)
        origin = columns(world.leave(surface, below))
        sign = np.where(below, np.float32(-1), np.float32(1))
        edge = world.edge(surface, surface.ng * sign[:, None])

        def respond(direction: np.ndarray) -> Response:
            wi = np.ascontiguousarray(direction.T)
            value, pdf = bsdf.evaluate(lobes, wi)
            if self.walk.uniform:
                pdf = even_density(lobes)  # that of the rays which share the light with these points
            # A light on the other side of the surface does not count; of smooth faces the shading normal tells the side.
            above = np.einsum("ij,ij->i", wi, surface.ng) * sign > 0
            agrees = (above if edge is None else edge.lit(direction)) & (np.einsum("ij,ij->i", wi, lobes.z) * sign > 0)
            # Rays bring nothing from below the triangle, so light points have all of it.
            return Response((value.max(axis=1) > 0) & agrees, np.where(above, pdf / share, np.float32(0)), 1 / share, value.T, edge)

        u = rng.random((3, len(able)), np.float32) if uniform is None else uniform[:, able]
        rows, value, cast = direct.from_lights(world, self.walk.emitters, origin, u, respond, joined=self.walk.meet_lights)
        return able[rows], value, cast

    def scatter(self, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Ray:
        """A ray by the BSDF from each, as far as it carries anything and leaves on the right side."""
        walk, surface = self.walk, self.surface
        drawn = bsdf.sample(self.lobes, rng, uniform)
        if walk.uniform:
            drawn = evenly(self.lobes, drawn, rng)
        go = leaving(surface, drawn)
        origin = walk.world.leave(surface.take(go), drawn.through[go])
        delta = drawn.delta[go]
        pdf = np.maximum(drawn.pdf_w[go] / light_share(self.lobes)[go], 2 * LEAST) if walk.meet_lights else LEAST
        pdf = np.where(delta, INF, pdf) if walk.draw_lights else np.full(len(go), INF)
        return Ray(go, columns(origin), columns(drawn.wi[go]), drawn.kind[go], pdf, drawn.weight[go].T, delta)

    def reflectance(self, hit: Hit, rows: np.ndarray) -> None:
        """The rays' weights have it."""

    def arrive(self, ray: Ray, hit: Hit, rows: np.ndarray, path: np.ndarray, rng: np.random.Generator) -> LobeVertices:
        """The vertices where rays `rows` (m,) hit."""
        return arrived(self.walk, ray, hit, rows)


def arrived(walk: Walk, ray: Ray, hit: Hit, rows: np.ndarray) -> LobeVertices:
    """The vertices where rays `rows` (m,) hit, seen from where they come from."""
    wo = np.ascontiguousarray(-ray.wi.take(rows, axis=1).T)
    surface = walk.world.surface(*(a.take(rows) for a in hit[:3]), wo)
    return LobeVertices(walk, surface, lobes_of(walk, surface, wo))


def start(walk: Walk, surface: Surface, wo: np.ndarray | None) -> tuple[LobeVertices, np.float32]:
    """First vertices, and the factor from the radiance they send to what is wanted: radiance towards `wo`, or irradiance where it is None.

    Irradiance is pi times the radiance that a white diffuse surface sends.
    """
    if wo is None:
        return LobeVertices(walk, surface, white(walk, surface)), np.float32(np.pi)
    return LobeVertices(walk, surface, lobes_of(walk, surface, wo)), np.float32(1)


def gather(walk: Walk, surface: Surface, lobes: bsdf.Lobes, rng: np.random.Generator, first_length: int = 1) -> Gathered:
    """Estimate the radiance that the points send towards the `wo` of their `lobes`, own emission left out.

    `first_length` is the path length of light that reaches the points directly.
    """
    return follow(Paths(walk, LobeVertices(walk, surface, lobes), rng, first_length))


def lobes_of(walk: Walk, surface: Surface, wo: np.ndarray) -> bsdf.Lobes:
    """The lobes at surface points seen from `wo`."""
    return walk.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, wo)


def evenly(lobes: bsdf.Lobes, scattered: bsdf.Scattered, rng: np.random.Generator) -> bsdf.Scattered:
    """`scattered` with its directions of finite density replaced by ones uniform over the sphere."""
    p = bsdf.weights(lobes)
    wi = sphere(*rng.random((2, len(lobes.wo)), np.float32)).T
    value, _ = bsdf.evaluate(lobes, wi, p)
    pdf = even_density(lobes, p)
    d = scattered.delta
    through = np.where(d, scattered.through, np.einsum("ij,ij->i", wi, lobes.z) < 0)
    wi = np.where(d[:, None], scattered.wi, wi).astype(np.float32)
    weight = np.where(d[:, None], scattered.weight, value / pdf[:, None])
    return bsdf.Scattered(wi, weight, np.where(d, 0, pdf), d, through, scattered.reflected)


def even_density(lobes: bsdf.Lobes, p: np.ndarray | None = None) -> np.ndarray:
    """(n,) float32 density per solid angle of `evenly`; `p` are the `bsdf.weights` where they are known already."""
    p = bsdf.weights(lobes) if p is None else p
    smooth = 1 - sum((p[i + 1] * slot.delta for i, slot in enumerate(lobes.slots)), np.zeros(len(lobes.wo), np.float32))
    return np.maximum(smooth, np.float32(1e-6)) / np.float32(4 * np.pi)


def leaving(surface: Surface, scattered: bsdf.Scattered) -> np.ndarray:
    """Rows (m,) of the directions that carry something and leave on the side of the surface that they were meant for."""
    towards = np.einsum("ij,ij->i", scattered.wi, surface.ng)
    return np.flatnonzero((scattered.weight.max(axis=1) > 0) & ((towards < 0) == scattered.through))


def light_share(lobes: bsdf.Lobes) -> np.ndarray:
    """(n,) float32: with which probability light points are looked for on the side they lie on; half where light passes a rough lobe."""
    return np.where(lobes.rough_passing(), np.float32(0.5), np.float32(1))


def white(walk: Walk, surface: Surface) -> bsdf.Lobes:
    """Lobes of a white diffuse surface: what an irradiance receiver gathers is pi times the radiance these send."""
    return lobes_of(walk, surface, surface.ns).white()
