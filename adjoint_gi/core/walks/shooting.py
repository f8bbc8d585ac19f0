"""The walk that shoots: rays with weights fly to the nearest surface, and what is scattered there flies on, segment by segment.

What scatters is a strategy: particles are absorbed or go on with all their power (`particles`), chains go on by the lobes that are not
diffuse (`mirror_chains`). Rows everywhere, (n, 3) float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..scene.passing import Passing
from ..scene.world import Surface, World

NONE = np.zeros(0, np.int64)


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
            triangle, u, v, t = world.intersect(flight.origin, flight.direction, flight.kind)
            met = triangle >= 0
            if dark is not None:
                met &= flown + t >= dark[row]
            if reach is not None:
                met &= flown + t <= reach[row]
            # Within the dark of a lamp surfaces get nothing, but let light through as anywhere.
            inside = NONE if dark is None else np.flatnonzero((triangle >= 0) & (flown + t < dark[row]))
            near, share = _passed(passing, inside, (triangle[inside], u[inside], v[inside]), rng)
            lost = ~met
            lost[near] = False
            hit, miss = np.flatnonzero(met), np.flatnonzero(lost)
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
            if go is None and not len(near):
                break
            on = NONE if go is None else np.flatnonzero(go)
            goes = np.concatenate([hit[on], near])
            straight = flight.weight[near] * share
            straight = straight if passed is None else np.concatenate([passed[on], straight])
            flown, layer = (flown + t)[goes], layer + 1
            kind = flight.kind if np.ndim(flight.kind) == 0 else flight.kind[goes]
            behind = world.surface(triangle[goes], u[goes], v[goes], -flight.direction[goes])
            origin = np.ascontiguousarray(world.leave(behind, np.ones(len(goes), bool)))
            row, flight = row[goes], Flight(origin, np.ascontiguousarray(flight.direction[goes]), kind, straight)
        if not flights:
            return
        row, flight = rows[0] if len(rows) == 1 else np.concatenate(rows), _joined(flights)


def _passed(
    passing: Passing | None, rows: np.ndarray, hit: tuple[np.ndarray, np.ndarray, np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Those of `rows` (n,) that surfaces `hit`, triangle, u, v (n,), let straight through, and the factor (m, 3) on their weights."""
    if passing is None or not len(rows):
        return NONE, np.zeros((0, 3), np.float32)
    at = np.flatnonzero(passing.lets[hit[0]])
    go, factor = passing.draw(*(x[at] for x in hit), rng)
    return rows[at[go]], factor[go]


def _joined(flights: list[Flight]) -> Flight:
    if len(flights) == 1:
        return flights[0]
    kinds = [np.broadcast_to(f.kind, len(f.weight)) for f in flights]
    parts = ([f.origin for f in flights], [f.direction for f in flights], kinds, [f.weight for f in flights])
    return Flight(*(np.concatenate(part) for part in parts))
