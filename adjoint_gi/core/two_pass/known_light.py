"""Irradiance that a first pass has found on the elements, for second passes to read at any surface point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..elements.elements import Elements
from ..elements.smooth import Nodes
from ..scene.world import Surface

# Irradiance (2 ne, 3) of element sides, direct and indirect, of light that may still fly a number of segments.
Lengths = Callable[[int], tuple[np.ndarray, np.ndarray]]


class KnownLight:
    """Smooth irradiance at points. `lengths(k)` gives that of the elements for light that flies k more segments to its receiver."""

    def __init__(self, elements: Elements, lengths: Lengths, most: int) -> None:
        """`most`: the largest k that makes a difference; larger ones are taken as this."""
        self.elements = elements
        self.lengths = lengths
        self.most = most
        self._nodes: dict[int, np.ndarray] = {}

    def prepare(self) -> None:
        """Make all node values now, before threads ask for them."""
        seen: dict[tuple[int, int], tuple[tuple, np.ndarray]] = {}
        for k in range(self.most + 1):
            light = self.lengths(k)
            key = id(light[0]), id(light[1])  # the arrays are kept, so the same numbers stand for the same arrays
            if key not in seen:
                seen[key] = light, self.elements.nodes.values(np.concatenate(light, axis=1))
            self._nodes[k] = seen[key][1]

    def at(self, surface: Surface, segments: int) -> tuple[np.ndarray, np.ndarray]:
        """Direct and indirect irradiance (n, 3) float32 on the side of `surface`, which lies `segments` from the receiver."""
        nodes: Nodes = self.elements.nodes
        element, a, b = self.elements.cell(surface.triangle, surface.u, surface.v)
        light = nodes.at(self._nodes[min(segments, self.most)], 2 * element + (surface.side < 0), a, b)
        return light[:, :3], light[:, 3:]


def lengths_of(
    by_length: list[np.ndarray], total: np.ndarray | None, first: np.ndarray, low: int, high: int
) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """`Lengths` of irradiance (n, 3) known by its length: `by_length[k]` of k segments (entry 0 unused), and `total` of all lengths,
    or None where `by_length` holds all that count. `first` is that of one segment; `low` and `high` bound the lengths that count."""

    def at(segments: int) -> tuple[np.ndarray, np.ndarray]:
        least, most = low - segments, high - segments
        direct = first if least <= 1 <= most else np.zeros_like(first)
        if total is None:
            rest = sum((h for k, h in enumerate(by_length) if k >= 2 and least <= k <= most), np.zeros_like(first))
        else:
            rest = total - first - sum((h for k, h in enumerate(by_length) if 2 <= k < least), np.zeros_like(first))
            rest = np.maximum(rest, 0)  # a difference of nearly equal sums
        return direct, rest

    return at
