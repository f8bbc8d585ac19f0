"""Random walks on the radiance equation over any BSDF (review, Eq. 12): what path tracing, distribution ray tracing and the second
passes of two-pass and multi-pass methods share.

A walk starts on surface points whose lobes are known and estimates the radiance they send towards `wo`, by light points (next
event) and by the rays of the BSDF, joined by multiple importance sampling (Veach 1997). Rows everywhere: (n, 3) float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..bsdf import table as bsdf
from ..lights.emitters import Emitters
from ..sampling.maps import power_heuristic, sphere
from ..scene.arrays import RayKind
from ..scene.world import Surface, World

INF = np.float32(np.inf)


@dataclass(frozen=True, eq=False)
class Walk:
    """What a walk needs besides its start.

    min_length, max_length: path lengths that count. roulette: segments after which walks end at random.
    lights, lobes: use light points; use what BSDF rays meet. With both, each is weighted; with one, it stands alone.
    uniform: draw directions evenly over the sphere instead of by the BSDF (mirrors still by theirs): what importance sampling saves.
    emission: radiance (m, 3) of triangles at (triangle, u, v) towards directions (m, 3), for emission that is not the same in all
    directions, as in a Kirchhoff cavity; light points know nothing of it, so `lights` must be off.
    known: outgoing radiance (m, 3) that is already known of some points, as (rows (m,), radiance), asked at every hit; walks that
    get an answer end there with it, which is how second passes read the first.
    """

    world: World
    emitters: Emitters
    table: bsdf.BsdfTable
    min_length: int = 0
    max_length: int = 64
    roulette: int = 3
    lights: bool = True
    lobes: bool = True
    uniform: bool = False
    emission: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    known: Callable[[Surface, bsdf.Lobes, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None


@dataclass(frozen=True, eq=False)
class Gathered:
    """Radiance towards `wo`, (n, 3) float32: `direct` of path length 1, `indirect` of more; rays cast."""

    direct: np.ndarray
    indirect: np.ndarray
    rays: int


def lobes_of(walk: Walk, surface: Surface, wo: np.ndarray) -> bsdf.Lobes:
    """The lobes at surface points seen from `wo`."""
    return walk.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, wo)


def gather(walk: Walk, surface: Surface, lobes: bsdf.Lobes, rng: np.random.Generator, first_length: int = 1) -> Gathered:
    """Estimate the radiance that the points send towards the `wo` of their `lobes`, own emission left out.

    `first_length` is the path length of light that reaches the points directly.
    """
    n = len(surface.triangle)
    direct, indirect = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    weight = np.ones((n, 3), np.float32)
    row = np.arange(n)
    rays = 0
    for length in range(first_length, walk.max_length + 1):
        if not len(row):
            break
        out = direct if length == 1 else indirect
        counts = length >= walk.min_length
        # Step 1: light points.
        if counts and walk.lights and walk.emitters.any_drawn():
            at, value, cast = next_event(walk, surface, lobes, rng)
            out[row[at]] += weight[at] * value
            rays += cast
        # Step 2: a ray by the BSDF.
        scattered = bsdf.sample(lobes, rng)
        if walk.uniform:
            scattered = evenly(lobes, scattered, rng)
        go = leaving(surface, scattered)
        if not len(go):
            break
        origin, wi = departure(walk, surface, scattered, go)
        share = light_share(lobes)[go]
        weight, row = weight[go] * scattered.weight[go], row[go]
        pdf, delta = scattered.pdf_w[go], scattered.delta[go]
        triangle, u, v, t = walk.world.intersect(origin, wi, scattered.kind[go])
        rays += len(go)
        # Step 3: emission the ray meets.
        if counts and (walk.lobes or delta.any() or walk.emitters.any_background):
            out_here = met(walk, origin, wi, (triangle, u, v, t), pdf, delta, share)
            out[row] += weight * out_here
        # Step 4: go on from the surface that was hit, unless its radiance is known or roulette ends the walk.
        hit = np.flatnonzero(triangle >= 0)
        weight, row = weight[hit], row[hit]
        surface = walk.world.surface(triangle[hit], u[hit], v[hit], -wi[hit])
        lobes = lobes_of(walk, surface, -wi[hit])
        keep = np.ones(len(hit), bool)
        if walk.known is not None and length + 1 <= walk.max_length:
            at, value = walk.known(surface, lobes, delta[hit])
            indirect[row[at]] += weight[at] * value
            keep[at] = False
        if length >= walk.roulette:
            p = np.clip(weight.max(axis=1), np.float32(0.05), np.float32(1))
            keep &= rng.random(len(p), np.float32) < p
            weight = weight / p[:, None]
        if not keep.all():
            at = np.flatnonzero(keep)
            weight, row, surface, lobes = weight[at], row[at], surface.take(at), lobes.take(at)
    return Gathered(direct, indirect, rays)


def evenly(lobes: bsdf.Lobes, scattered: bsdf.Scattered, rng: np.random.Generator) -> bsdf.Scattered:
    """`scattered` with its directions of finite density replaced by ones uniform over the sphere."""
    p = bsdf.weights(lobes)
    smooth = 1 - sum((p[i + 1] * slot.delta for i, slot in enumerate(lobes.slots)), np.zeros(len(lobes.wo), np.float32))
    wi = sphere(*rng.random((2, len(lobes.wo)), np.float32)).T
    value, _ = bsdf.evaluate(lobes, wi, p)
    pdf = np.maximum(smooth, np.float32(1e-6)) / np.float32(4 * np.pi)
    d = scattered.delta
    through = np.where(d, scattered.through, np.einsum("ij,ij->i", wi, lobes.z) < 0)
    wi = np.where(d[:, None], scattered.wi, wi).astype(np.float32)
    weight = np.where(d[:, None], scattered.weight, value / pdf[:, None])
    return bsdf.Scattered(wi, weight, np.where(d, 0, pdf), d, through, scattered.diffuse)


def leaving(surface: Surface, scattered: bsdf.Scattered) -> np.ndarray:
    """Rows (m,) of the directions that carry something and leave on the side of the surface that they were meant for."""
    towards = np.einsum("ij,ij->i", scattered.wi, surface.ng)
    return np.flatnonzero((scattered.weight.max(axis=1) > 0) & ((towards < 0) == scattered.through))


def departure(walk: Walk, surface: Surface, scattered: bsdf.Scattered, go: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins off the surface and directions, (m, 3) float32 each, of the rays in rows `go` (m,)."""
    origin = walk.world.leave(surface.take(go), scattered.through[go])
    return np.ascontiguousarray(origin), np.ascontiguousarray(scattered.wi[go])


def next_event(
    walk: Walk, surface: Surface, lobes: bsdf.Lobes, rng: np.random.Generator, uniform: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, int]:
    """One light point for each surface point: rows (m,) that are lit, reflected radiance (m, 3), shadow rays cast.

    The light points come from `uniform` (3, n) float32 where given, else from `rng`.
    """
    able = np.flatnonzero(lobes.smooth_part())
    if not len(able):
        return able, np.zeros((0, 3), np.float32), 0
    part = lobes if len(able) == len(lobes.wo) else lobes.take(able)
    surface = surface.take(able)
    # Shadow rays start on one side; where a rough lobe lets light through, on either with equal probability.
    share = light_share(part)
    below = (share < 1) & (rng.random(len(able), np.float32) < 0.5)
    origin = walk.world.leave(surface, below)
    u = rng.random((3, len(able)), np.float32) if uniform is None else uniform[:, able]
    s = walk.emitters.draw(np.ascontiguousarray(origin.T), u)
    wi = np.ascontiguousarray(s.wi.T)
    value, pdf = bsdf.evaluate(part, wi)
    # A light on the other side of the surface, geometric or shading, does not count.
    sign = np.where(below, np.float32(-1), np.float32(1))
    agrees = (np.einsum("ij,ij->i", wi, surface.ng) * sign > 0) & (np.einsum("ij,ij->i", wi, part.z) * sign > 0)
    lit = np.flatnonzero((value.max(axis=1) > 0) & (s.radiance.max(axis=0) > 0) & agrees)
    if not len(lit):
        return lit, np.zeros((0, 3), np.float32), 0
    hidden = walk.world.occluded(np.ascontiguousarray(origin[lit]), wi[lit], s.distance[lit], RayKind.SHADOW) & s.shadow[lit]
    cast = len(lit)
    lit = lit[~hidden]
    pdf_light = s.pdf_w[lit] * share[lit]
    factor = 1 / pdf_light
    if walk.lobes:
        factor = factor * np.where(s.shared[lit], power_heuristic(pdf_light, pdf[lit]), np.float32(1))
    return able[lit], value[lit] * s.radiance.T[lit] * factor[:, None], cast


def light_share(lobes: bsdf.Lobes) -> np.ndarray:
    """(n,) float32: with which probability light points are looked for on the side they lie on; half where light passes a rough lobe."""
    return np.where(lobes.rough_passing(), np.float32(0.5), np.float32(1))


def met(walk: Walk, origin: np.ndarray, wi: np.ndarray, hit: tuple, pdf: np.ndarray, delta: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(n, 3) emission that rays meet: surfaces, lamps they pass, background; weighted where light points find it too.

    `pdf` (n,) is the density the rays were drawn with; `delta` (n,) rays have none and take everything in full. `share` (n,) is
    `light_share` of the surfaces they left.
    """
    triangle, u, v, t = hit
    emitters = walk.emitters
    out = np.zeros((len(t), 3), np.float32)
    sees = delta | walk.lobes
    escaped = triangle < 0
    if emitters.any_background:
        out[escaped] = emitters.escaping(wi[escaped], _density(walk, pdf, delta, share)[escaped])
    if emitters.any_mesh:
        at = np.flatnonzero(~escaped & sees & (emitters.density[triangle] > 0))
        if len(at):
            if walk.emission is None:
                value = walk.world.shading.emission(triangle[at], u[at], v[at])
            else:
                value = walk.emission(triangle[at], u[at], v[at], -wi[at])
            if walk.lights:
                other = emitters.pdf(triangle[at], wi[at], t[at]) * share[at]
                value = value * np.where(delta[at], np.float32(1), power_heuristic(np.maximum(pdf[at], np.float32(1e-12)), other))[:, None]
            out[at] += value
    distance = np.where(escaped, INF, t)
    # Mirror rays, and all rays where light points are off, take lamps in full.
    full = np.flatnonzero(delta) if walk.lights else np.flatnonzero(sees)
    if len(full) and len(emitters.sized):
        out[full] += emitters.along(origin[full], wi[full], distance[full])
    if walk.lights and walk.lobes and len(emitters.shared):
        rest = np.flatnonzero(~delta)
        if len(rest):
            o, w = np.ascontiguousarray(origin[rest].T), np.ascontiguousarray(wi[rest].T)
            out[rest] += emitters.lamps_met(o, w, distance[rest], np.maximum(pdf[rest] / share[rest], np.float32(1e-12))).T
    return out


def _density(walk: Walk, pdf: np.ndarray, delta: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(n,) densities that decide how rays and light points share what both find: without limit where only rays do, 0 where only points."""
    if not walk.lights:
        return np.full(len(pdf), INF)
    return np.where(delta, INF, np.maximum(pdf / share * np.float32(walk.lobes), np.float32(1e-12)))


def white(walk: Walk, surface: Surface) -> bsdf.Lobes:
    """Lobes of a white diffuse surface: what an irradiance receiver gathers is pi times the radiance these send."""
    return lobes_of(walk, surface, surface.ns).white()
