"""What camera rays see without any bounce: emission of surfaces, background and lamps, and what shines through the surfaces they pass."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..lights.emitters import Emitters
from ..receivers.base import CameraReceivers, Points
from ..scene.passing import MOST_LAYERS


@dataclass(frozen=True, eq=False)
class SightLayer:
    """Surfaces that camera rays see: rows (m,) of the rays, points where they stay, or escape, and weight (m, 3) float32, the factor on the
    radiance that leaves there, None for 1."""

    rows: np.ndarray
    points: Points
    weight: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Sight:
    """layers: one behind another where rays are split, else one; emitted (n, 3) float32 radiance that is seen; rays: cast to find them."""

    layers: list[SightLayer]
    emitted: np.ndarray
    rays: int


def seen_at_once(
    emitters: Emitters, receivers: CameraReceivers, points: Points, rng: np.random.Generator, counts: bool
) -> tuple[Points, np.ndarray, np.ndarray]:
    """All surfaces that camera rays see, layer after layer in one list: points, which may belong to a receiver more than once, the factor
    (m, 3) float32 on the radiance that leaves there, and the emission (n, 3) of the rays."""
    sight = see(emitters, receivers, points, rng, counts, split=True)
    on = [np.flatnonzero(x.points.triangle >= 0) for x in sight.layers]
    parts = [x.points.take(rows) for x, rows in zip(sight.layers, on, strict=True)]
    weight = [np.ones((len(rows), 3), np.float32) if x.weight is None else x.weight[rows] for x, rows in zip(sight.layers, on, strict=True)]
    joined = {f.name: [getattr(p, f.name) for p in parts] for f in fields(Points)}
    arrays = {k: np.concatenate(v) if isinstance(v[0], np.ndarray) else v[0] for k, v in joined.items()}
    return Points(**(arrays | {"rays": sight.rays})), np.concatenate(weight), sight.emitted


def see(
    emitters: Emitters, receivers: CameraReceivers, points: Points, rng: np.random.Generator, counts: bool = True, split: bool = False
) -> Sight:
    """What the rays of `points` see; emission only where it `counts`. Where surfaces let light straight through, rays stay or go on at
    random, or do both with `split`."""
    passing, n = emitters.world.passing, len(points.receiver)
    emitted = _emission(emitters, points) if counts else np.zeros((n, 3), np.float32)
    if passing is None:
        return Sight([SightLayer(np.arange(n), points, None)], emitted, points.rays)
    weight, layers, rays = np.ones_like(emitted), [SightLayer(np.arange(n), points, None)], points.rays
    rows = np.flatnonzero(passing.lets[points.triangle])
    for _ in range(MOST_LAYERS):
        if not len(rows):
            break
        at = points.triangle[rows], points.u[rows], points.v[rows]
        if split:
            weight[rows] *= passing.through(*at)
            rows = rows[weight[rows].max(axis=1) > 0]
        else:
            go, factor = passing.draw(*at, rng)
            weight[rows] *= factor
            rows = rows[go]
        beyond = points.distance[rows]
        points = receivers.onward(points, rows)
        rays += len(rows)
        there = points.take(rows)
        if counts:
            emitted[rows] += weight[rows] * _emission(emitters, there, beyond)
        if split and len(rows):
            layers.append(SightLayer(rows, there, weight[rows]))
        rows = rows[passing.lets[there.triangle]]
    return Sight(layers if split else [SightLayer(np.arange(n), points, weight)], emitted, rays)


def _emission(emitters: Emitters, points: Points, beyond: np.ndarray | None = None) -> np.ndarray:
    """(n, 3) float32 emission where rays arrive, and of lamps on their way that are farther than `beyond` (n,)."""
    world, out = emitters.world, np.zeros((len(points.receiver), 3), np.float32)
    away = points.triangle < 0
    on = np.flatnonzero(~away)
    out[away] = emitters.escaping(-points.towards[away])
    out[on] = world.shading.emission(points.triangle[on], points.u[on], points.v[on])
    distance = np.where(away, np.float32(np.inf), points.distance).astype(np.float32)
    return out + emitters.along(points.origin, -points.towards, distance, beyond)
