"""The walk that shoots: rays with weights fly to the nearest surface, and what is scattered there flies on, segment by segment.

What scatters is a strategy: particles are absorbed or go on with all their power (`particles`), chains go on by the lobes that are not
diffuse (`mirror_chains`). Rows everywhere, (n, 3) float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..scene.world import Surface, World


@dataclass(frozen=True, eq=False)
class Flight:
    """Rays about to fly: origin, unit direction (n, 3) float32; kind: their `RayKind`, one for all or (n,); weight (n, 3) float32."""

    origin: np.ndarray
    direction: np.ndarray
    kind: np.ndarray | np.uint8
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class Arrived:
    """Rays that have met something: where, on the side they came from; direction and weight (n, 3) they arrive with; segments flown."""

    surface: Surface
    direction: np.ndarray
    weight: np.ndarray
    segments: int


@dataclass(frozen=True, eq=False)
class Departed:
    """What goes on: rows (k,) of the rays that arrived, and their flight. A ray goes on as one ray at most."""

    rows: np.ndarray
    flight: Flight


@dataclass(frozen=True, eq=False)
class Segment:
    """What one segment came to: row (n,) of the rays that met something, among those that set out; how they arrived, and what goes on;
    away (k,), lost (k, 3): rows of the rays that escape, and their weight."""

    row: np.ndarray
    arrived: Arrived
    scattered: Departed
    away: np.ndarray
    lost: np.ndarray

    @property
    def rays(self) -> int:
        """How many flew."""
        return len(self.row) + len(self.away)


Scatter = Callable[[Arrived, np.random.Generator], Departed]


def shoot(
    world: World,
    flight: Flight,
    most: int,
    scatter: Scatter,
    rng: np.random.Generator,
    dark: np.ndarray | None = None,
    reach: np.ndarray | None = None,
) -> Iterator[Segment]:
    """Fly at most `most` segments. What is met on the first one nearer than `dark` (n,) or farther than `reach` (n,) counts as escaped."""
    row = np.arange(len(flight.weight))
    for segments in range(1, most + 1):
        if not len(row):
            return
        # Step 1: fly to the nearest surface, or escape.
        triangle, u, v, t = world.intersect(flight.origin, flight.direction, flight.kind)
        met = triangle >= 0
        if segments == 1 and dark is not None:
            met &= t >= dark
        if segments == 1 and reach is not None:
            met &= t <= reach
        hit, miss = np.flatnonzero(met), np.flatnonzero(~met)
        direction = flight.direction[hit]
        surface = world.surface(triangle[hit], u[hit], v[hit], -direction)
        # Step 2: what is scattered there.
        arrived = Arrived(surface, direction, flight.weight[hit], segments)
        scattered = scatter(arrived, rng)
        yield Segment(row[hit], arrived, scattered, row[miss], flight.weight[miss])
        # Step 3: that flies on.
        row, flight = row[hit[scattered.rows]], scattered.flight
