"""Direct light at points: light points drawn by power and rays drawn by the cosine, joined by multiple importance sampling.

Both kernels, `from_lights` and `from_hits`, also serve the path tracer. Vectors are component first, (3, n) float32.
Source: Veach 1997, chapter 9 (power heuristic).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import PI, columns, dot
from ..scene.arrays import RayKind
from ..scene.faces import Faces
from ..scene.world import Surface, World
from .emitters import Emitters

INF = np.float32(np.inf)
BATCH = 1 << 15


def from_lights(
    world: World,
    emitters: Emitters,
    origin: np.ndarray,
    ng: np.ndarray,
    ns: np.ndarray,
    u: np.ndarray,
    mesh: bool = True,
    joined: bool = True,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Irradiance estimates from one light point for each ray origin (3, n): rows (m,) that are lit, values (3, m), shadow rays cast.

    `joined`: weighted for being one of two techniques; otherwise light points stand alone.
    """
    s = emitters.draw(origin, u, mesh)

    # Only points that the light may reach cost a shadow ray.
    cosine = dot(s.wi, ns)
    lit = cosine > 0
    if ns is not ng:
        lit &= dot(s.wi, ng) > 0
    if emitters.lamps.count:
        lit &= s.radiance.max(axis=0) > 0
    rows = np.flatnonzero(lit)
    if not len(rows):
        return rows, np.zeros((3, 0), np.float32), 0
    wi, distance = s.wi.take(rows, axis=1), s.distance.take(rows)
    hidden = world.occluded(origin.take(rows, axis=1).T, wi.T, distance, RayKind.SHADOW)
    if emitters.lamps.count:
        hidden &= s.shadow.take(rows)
    free = np.flatnonzero(~hidden)
    lit_rows, rows = len(rows), rows.take(free)

    # Radiance times cosine over density, weighted against the density of a ray drawn by the cosine.
    cosine, pdf = cosine.take(rows), s.pdf_w.take(rows)
    factor = cosine / pdf
    if joined:
        weight = sampling.power_heuristic(pdf, cosine / PI)
        factor *= weight if not emitters.lamps.count else np.where(s.shared.take(rows), weight, np.float32(1))
    return rows, s.radiance.take(rows, axis=1) * factor, lit_rows


def from_hits(
    emitters: Emitters,
    faces: Faces,
    origin: np.ndarray,
    w: np.ndarray,
    hit: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    cosine: np.ndarray,
    mesh: bool = True,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Emission met by rays along `w` (3, n) drawn by the cosine (n,): for each kind of emitter rows (m,) and weighted radiance (3, m).

    `hit` is what `World.intersect` returned. The irradiance estimate is pi times the radiance.
    """
    triangle, u, v, t = hit
    pdf = np.maximum(cosine / PI, np.float32(1e-12))
    if mesh and emitters.any_mesh:
        # A miss, -1, reads the last entry, which is kept for it and does not emit.
        rows = np.flatnonzero(faces.emits.take(triangle, mode="wrap"))
        if len(rows):
            k = triangle.take(rows)
            radiance = faces.emission_at(k, u.take(rows), v.take(rows))
            other = emitters.pdf_met(k, w.take(rows, axis=1), t.take(rows))
            radiance *= sampling.power_heuristic(pdf.take(rows), other)
            yield rows, radiance
    if emitters.any_background:
        rows = np.flatnonzero(triangle < 0)
        yield rows, emitters.escaping(w.take(rows, axis=1).T, pdf.take(rows), mesh).T
    if len(emitters.shared):
        yield np.arange(len(t)), emitters.lamps_met(origin, w, np.where(triangle < 0, INF, t), pdf, mesh)


def direct_irradiance(
    world: World, emitters: Emitters, surface: Surface, samples: int, rng: np.random.Generator, mesh: bool = True
) -> tuple[np.ndarray, int]:
    """(n, 3) float32 unbiased irradiance (W m-2) that arrives straight from emitters at the points of `surface`, and the rays cast.

    Each point takes `samples` light points and, where rays can meet emission, as many rays drawn by the cosine. `mesh=False`
    leaves out emission of triangles, for methods that treat it as elements; the background is always included.
    """
    n = len(surface.triangle)
    out = np.zeros((n, 3), np.float32)
    rays = 0
    drawn, met = emitters.any_drawn(mesh), emitters.any_met(mesh)
    if not (drawn or met) or samples < 1:
        return out, 0
    faces = Faces(world) if met else None
    for a in range(0, n, BATCH):
        part = slice(a, min(a + BATCH, n))
        origin = columns(world.lifted(surface.position[part], surface.ng[part]))
        ng = columns(surface.ng[part])
        ns = ng if surface.ns is surface.ng else columns(surface.ns[part])
        total = np.zeros((3, origin.shape[1]))
        for _ in range(samples):
            if drawn:
                rows, value, cast = from_lights(world, emitters, origin, ng, ns, rng.random((3, len(total[0])), np.float32), mesh, met)
                total[:, rows] += value
                rays += cast
            if met:
                u = rng.random((2, len(total[0])), np.float32)
                w, cosine = sampling.cosine_hemisphere(ns, u[0], u[1])
                hit = world.intersect(origin.T, w.T, RayKind.DIFFUSE)
                rays += len(cosine)
                above = np.where(dot(w, ng) > 0, PI, np.float32(0)) if ns is not ng else np.full(len(cosine), PI)
                for rows, value in from_hits(emitters, faces, origin, w, hit, cosine, mesh):
                    total[:, rows] += value * above[rows]
        out[part] = (total / samples).T
    return out, rays
