"""Emission that reaches points straight: light points drawn by power and rays that meet it, joined by multiple importance sampling.

`from_lights` and `from_hits` serve every walk that gathers. Vectors are component first, (3, n) float32.
Source: Veach 1997, chapter 9 (power heuristic).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..sampling import maps as sampling
from ..sampling.additive import going_on
from ..sampling.maps import PI, columns, dot
from ..scene.arrays import RayKind
from ..scene.faces import Faces
from ..scene.terminator import Edge
from ..scene.world import Surface, World
from .emitters import Emitters

INF = np.float32(np.inf)
LEAST = np.float32(1e-12)  # density of rays that leave all emission to light points
POINTS_PER_BATCH = 1 << 15

# What `World.intersect` returns: triangle, u, v and distance of each ray.
Hit = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
# Radiance (m, 3) of emitting triangles at (triangle, u, v), (m,) each, towards directions (m, 3).
Emitted = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Response:
    """How surfaces answer light from one direction each.

    lit (n,) bool: where it counts at all. cosine (n,), or 1, and f (3, n), or None for 1: their product times radiance is what is found.
    pdf_w (n,): the density by which rays that meet lights share them with light points. edge: where shadow rays start off the triangle.
    """

    lit: np.ndarray
    pdf_w: np.ndarray
    cosine: np.ndarray | np.float32
    f: np.ndarray | None = None
    edge: Edge | None = None


# The response of the points to directions (3, n).
Respond = Callable[[np.ndarray], Response]


def irradiance(ng: np.ndarray, ns: np.ndarray, edge: Edge | None = None) -> Respond:
    """The response by which light points find irradiance on surfaces with normals (3, n), of which rays are drawn by the cosine."""

    def respond(wi: np.ndarray) -> Response:
        cosine = dot(wi, ns)
        lit = cosine > 0
        if ns is ng:
            return Response(lit, cosine / PI, cosine)
        above = dot(wi, ng) > 0
        lit &= above if edge is None else edge.lit(wi)
        # Rays bring nothing from below the triangle, so light points have all of it.
        return Response(lit, np.where(above, cosine / PI, np.float32(0)), cosine, edge=edge)

    return respond


def from_lights(
    world: World,
    emitters: Emitters,
    origin: np.ndarray,
    u: np.ndarray,
    respond: Respond,
    mesh: bool = True,
    joined: bool = True,
) -> tuple[np.ndarray, np.ndarray, int]:
    """What surfaces make of one light point for each ray origin (3, n): rows (m,) that are lit, values (3, m), shadow rays cast.

    `joined`: weighted for being one of two techniques; otherwise light points stand alone.
    """
    s = emitters.draw(origin, u, mesh)
    answer = respond(s.wi)

    # Only points that the light may reach cost a shadow ray.
    lit = answer.lit
    if emitters.lamps.count or answer.f is not None:
        lit &= s.radiance.max(axis=0) > 0
    rows = np.flatnonzero(lit)
    if not len(rows):
        return rows, np.zeros((3, 0), np.float32), 0
    start, wi, distance = origin.take(rows, axis=1), s.wi.take(rows, axis=1), s.distance.take(rows)
    if answer.edge is not None:
        answer.edge.take(rows).lift(start, wi, distance)
    hidden, share = world.shadows(start.T, wi.T, distance)
    if emitters.lamps.count:
        hidden &= s.shadow.take(rows)
    free = np.flatnonzero(~hidden)
    cast, rows = len(rows), rows.take(free)

    # Radiance times response over density, weighted against the density of rays.
    pdf = s.pdf_w.take(rows)
    factor = (answer.cosine.take(rows) if np.ndim(answer.cosine) else answer.cosine) / pdf
    if joined:
        weight = sampling.power_heuristic(pdf, answer.pdf_w.take(rows))
        factor *= weight if not emitters.lamps.count else np.where(s.shared.take(rows), weight, np.float32(1))
    radiance = s.radiance.take(rows, axis=1)
    if answer.f is not None:
        radiance *= answer.f.take(rows, axis=1)
    if share is not None:
        radiance *= np.where(s.shadow.take(rows), share[free].T, np.float32(1))
    return rows, radiance * factor, cast


def from_hits(
    emitters: Emitters,
    faces: Faces,
    origin: np.ndarray,
    w: np.ndarray,
    hit: Hit,
    pdf: np.ndarray,
    mesh: bool = True,
    emission: Emitted | None = None,
    lamps: np.ndarray | None = None,
    beyond: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Emission met by rays along `w` (3, n): for each kind of emitter rows (m,) and weighted radiance (3, m).

    `pdf` (n,): the density by which rays share emission with light points, as in `Response`: INF for those that take all of it, `LEAST`
    for those that leave it. `hit` is what `World.intersect` returned. `emission` stands in for that of the materials. `lamps` (n,) bool:
    which of the rays that take all of it meet lamps; None for all. `beyond` (n,): of rays that have passed surfaces, the distance up to
    which their emission has been found already.
    """
    triangle, u, v, t = hit
    if mesh and emitters.any_mesh:
        # A miss, -1, reads the last entry, which is kept for it and does not emit.
        rows = np.flatnonzero(faces.emits.take(triangle, mode="wrap") & (pdf > LEAST))
        if len(rows):
            k, wi = triangle.take(rows), w.take(rows, axis=1)
            if emission is None:
                radiance = faces.emission_at(k, u.take(rows), v.take(rows))
            else:
                radiance = columns(emission(k, u.take(rows), v.take(rows), -wi.T))
            met = emitters.pdf_met(tuple(a.take(rows) for a in hit), wi, origin.take(rows, axis=1))
            radiance *= sampling.power_heuristic(pdf.take(rows), met)
            yield rows, radiance
    if emitters.any_background:
        rows = np.flatnonzero(triangle < 0)
        yield rows, np.ascontiguousarray(emitters.escaping(w.take(rows, axis=1).T, pdf.take(rows), mesh).T)
    distance = np.where(triangle < 0, INF, t) if len(emitters.sized) else t
    if len(emitters.shared):
        rows = np.flatnonzero((pdf < INF) & (pdf > LEAST))
        o, d = (origin, w) if len(rows) == len(t) else (origin.take(rows, axis=1), w.take(rows, axis=1))
        nearer = beyond if beyond is None else beyond.take(rows)
        yield rows, emitters.lamps_met(o, d, distance.take(rows), pdf.take(rows), mesh, beyond=nearer)
    if len(emitters.sized):
        # Lamps that light points cannot find for these rays, in full.
        rows = np.flatnonzero(pdf == INF if lamps is None else (pdf == INF) & lamps)
        if len(rows):
            nearer = beyond if beyond is None else beyond.take(rows)
            yield rows, emitters.lamps_met(origin.take(rows, axis=1), w.take(rows, axis=1), distance.take(rows), beyond=nearer)


def direct_irradiance(
    world: World, emitters: Emitters, surface: Surface, samples: int, rng: np.random.Generator, mesh: bool = True
) -> tuple[np.ndarray, int]:
    """(n, 3) float32 unbiased irradiance (W m-2) that arrives straight from emitters at the points of `surface`, and the rays cast.

    Each point takes `samples` light points and, where rays can meet emission, as many rays drawn by the cosine. `mesh=False`
    leaves out emission of triangles, for methods that treat it as elements; the background is always included.
    """
    light, _, rays = halved_irradiance(world, emitters, surface, samples, rng, mesh)
    return light, rays


def halved_irradiance(
    world: World, emitters: Emitters, surface: Surface, samples: int, rng: np.random.Generator, mesh: bool = True
) -> tuple[np.ndarray, np.ndarray, int]:
    """As `direct_irradiance`; between light and rays (n, 3) float32, half of what its two halves differ by, 0 of a single sample.

    That is as large as the error of the light, or larger, since the samples of a point lie evenly.
    """
    n = len(surface.triangle)
    out, spread = np.zeros((2, n, 3), np.float32)
    rays, half = 0, samples // 2
    drawn, met = emitters.any_drawn(mesh), emitters.any_met(mesh)
    if not (drawn or met) or samples < 1:
        return out, spread, 0
    faces = Faces(world) if met else None
    for a in range(0, n, POINTS_PER_BATCH):
        part = slice(a, min(a + POINTS_PER_BATCH, n))
        origin = columns(world.lifted(surface.position[part], surface.ng[part], surface.triangle[part]))
        ng = columns(surface.ng[part])
        ns = ng if surface.ns is surface.ng else columns(surface.ns[part])
        edge = world.edge(surface.take(part))
        totals = np.zeros((2, *origin.shape))
        points, directions = rng.random((3, origin.shape[1]), np.float32), rng.random((2, origin.shape[1]), np.float32)
        for k in range(samples):
            total = totals[int(k >= half)]
            if drawn:
                u = going_on(points, k)
                rows, value, cast = from_lights(world, emitters, origin, u, irradiance(ng, ns, edge), mesh, met)
                total[:, rows] += value
                rays += cast
            if met:
                u = going_on(directions, k)
                w, cosine = sampling.cosine_hemisphere(ns, u[0], u[1])
                hit = world.intersect(origin.T, w.T, RayKind.DIFFUSE)
                rays += len(cosine)
                above = np.where(dot(w, ng) > 0, PI, np.float32(0)) if ns is not ng else np.full(len(cosine), PI)
                pdf = np.maximum(cosine / PI, 2 * LEAST)
                for rows, value in from_hits(emitters, faces, origin, w, hit, pdf, mesh):
                    total[:, rows] += value * above[rows]
                if world.passing is not None:
                    for rows, value, cast in _behind(world, emitters, faces, (origin, w, hit, pdf, mesh), above, rng):
                        total[:, rows] += value
                        rays += cast
        out[part] = (totals.sum(axis=0) / samples).T
        if half:
            spread[part] = (totals[0] / half - totals[1] / (samples - half)).T / 2
    return out, spread, rays


def _behind(
    world: World, emitters: Emitters, faces: Faces, rays: tuple, factor: np.ndarray, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray, int]]:
    """What `from_hits` finds, times `factor` (n,), behind surfaces that let the same `rays` straight through; rays cast for it."""
    origin, w, hit, pdf, mesh = rays
    hit, weight = tuple(np.array(a) for a in hit), np.broadcast_to(factor, w.shape).copy()
    for rows, passed in world.pass_on(origin.T, w.T, RayKind.DIFFUSE, hit, weight, rng):
        some = origin[:, rows], w[:, rows], tuple(a[rows] for a in hit), pdf[rows], mesh
        for found, value in from_hits(emitters, faces, *some, beyond=passed):
            yield rows[found], value * weight[:, rows[found]], 0
        yield rows[:0], np.zeros((3, 0), np.float32), len(rows)
