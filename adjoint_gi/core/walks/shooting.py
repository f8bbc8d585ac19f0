"""The walk that shoots: rays with weights fly to the nearest surface, and what is scattered there flies on, segment by segment.

What scatters is a strategy: particles are absorbed or go on with all their power (`particles`), chains go on by the lobes that are not
diffuse (`mirror_chains`). Rows everywhere, (n, 3) float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..scene.passing import MOST_LAYERS
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
    """Rays that have met something: where, on the side they came from; direction and weight (n, 3) they arrive with; segments flown.

    stay (n,) float32: factor on what is scattered, 0 for rays that go straight on, for which those that stay make up; None for 1.
    """

    surface: Surface
    direction: np.ndarray
    weight: np.ndarray
    segments: int
    stay: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Departed:
    """What goes on: rows (k,) of the rays that arrived, and their flight. A ray goes on as one ray at most."""

    rows: np.ndarray
    flight: Flight


@dataclass(frozen=True, eq=False)
class Segment:
    """What one segment came to, or a part of it from one surface that lets rays straight through to the next: row (n,) of the rays that
    met something, among those that set out; how they arrived, and what is scattered; passed (n, 3): the weight that goes straight on, None
    where nothing does; away (k,), lost (k, 3): rows of the rays that escape, and their weight; layer: surfaces passed before."""

    row: np.ndarray
    arrived: Arrived
    scattered: Departed
    away: np.ndarray
    lost: np.ndarray
    passed: np.ndarray | None = None
    layer: int = 0

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
    """Fly at most `most` segments. What is met on the first one nearer than `dark` (n,) or farther than `reach` (n,) counts as escaped,
    but for light that it lets straight through nearer than `dark`.

    Surfaces that let rays straight through end no segment: those that pass are yielded again with the same number of segments.
    """
    passing, row = world.passing, np.arange(len(flight.weight))
    for segments in range(1, most + 1):
        dark, reach = (dark, reach) if segments == 1 else (None, None)
        # What leaves the surfaces on the way of this segment sets out on the next one.
        rows, flights = [], []
        flown, layer = np.float32(0), 0
        while len(row):
            # Step 1: fly to the nearest surface, or escape.
            found = world.intersect(flight.origin, flight.direction, flight.kind)
            if dark is not None and passing is not None:
                flight, found = _out_of_the_dark(world, flight, found, dark[row] - flown, rng)
            triangle, u, v, t = found
            met = triangle >= 0
            if dark is not None:
                met &= flown + t >= dark[row]
            if reach is not None:
                met &= flown + t <= reach[row]
            hit, miss = np.flatnonzero(met), np.flatnonzero(~met)
            direction, weight = flight.direction[hit], flight.weight[hit]
            surface = world.surface(triangle[hit], u[hit], v[hit], -direction)
            # Step 2: what goes straight on.
            go = stay = passed = None
            if passing is not None and passing.lets[surface.triangle].any():
                go, factor = passing.draw(surface.triangle, surface.u, surface.v, rng)
                stay = np.where(go, np.float32(0), factor[:, 0])
                passed = np.where(go[:, None], weight * factor, np.float32(0))
            # Step 3: what is scattered.
            arrived = Arrived(surface, direction, weight, segments, stay)
            scattered = scatter(arrived, rng)
            yield Segment(row[hit], arrived, scattered, row[miss], flight.weight[miss], passed, layer)
            rows.append(row[hit[scattered.rows]])
            flights.append(scattered.flight)
            if go is None:
                break
            on = np.flatnonzero(go)
            flown, layer = (flown + t)[hit[on]], layer + 1
            kind = flight.kind if np.ndim(flight.kind) == 0 else flight.kind[hit[on]]
            origin = np.ascontiguousarray(world.leave(surface.take(on), np.ones(len(on), bool)))
            row, flight = row[hit[on]], Flight(origin, np.ascontiguousarray(direction[on]), kind, passed[on])
        if not flights:
            return
        row, flight = rows[0] if len(rows) == 1 else np.concatenate(rows), _joined(flights)


def _out_of_the_dark(
    world: World, flight: Flight, hit: tuple[np.ndarray, ...], dark: np.ndarray, rng: np.random.Generator
) -> tuple[Flight, tuple[np.ndarray, ...]]:
    """The flight and what it hits behind surfaces nearer than `dark` (n,) that let it straight through: they get nothing from a lamp."""
    hit, weight, rows = tuple(np.array(a) for a in hit), np.array(flight.weight), np.arange(len(dark))
    for _ in range(MOST_LAYERS):
        rows = rows[(hit[0][rows] >= 0) & (hit[3][rows] < dark[rows])]
        rows = rows[world.passing.lets[hit[0][rows]]]
        go, factor = world.passing.draw(*(a[rows] for a in hit[:3]), rng)
        rows = rows[go]
        if not len(rows):
            break
        weight[rows] *= factor[go]
        world.onward(flight.origin, flight.direction, flight.kind, hit, rows)
    return replace(flight, weight=weight), hit


def _joined(flights: list[Flight]) -> Flight:
    if len(flights) == 1:
        return flights[0]
    kinds = [np.broadcast_to(f.kind, len(f.weight)) for f in flights]
    parts = ([f.origin for f in flights], [f.direction for f in flights], kinds, [f.weight for f in flights])
    return Flight(*(np.concatenate(part) for part in parts))
