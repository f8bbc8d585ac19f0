"""Adaptive subdivision at shadow boundaries: refines elements where direct light changes most, and spreads their light anew.

The flux that an element has got from the first shots is kept; how it lies on the pieces is found by looking from them at the lights
(after M. F. Cohen, D. P. Greenberg, D. S. Immel and P. J. Brock, "An Efficient Radiosity Approach for Realistic Image Synthesis", IEEE
Computer Graphics and Applications, 6(3), 1986, 26-35). Where it matters little to some receivers, elements are cut less, by their
potential (after B. E. Smits, J. R. Arvo and D. H. Salesin, "An Importance-Driven Radiosity Algorithm", SIGGRAPH 1992, 273-282).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..elements.elements import Elements
from ..elements.rays import ElementRays
from ..elements.refinement import RefinedElements, contrast, longest_edge, over_base
from ..flux.detectors import Detector
from ..lights.emitters import Emitters
from .lamp_light import LampLight
from .southwell import DiffuseShooting
from .transports import RayTransport

PER_SIDE = 64  # rays of each element side for the potential that says what matters
GROWTH = 16  # there are at most so many times as many elements as before


class Subdivision:
    """Refines the elements of a world round by round.

    elements   the finest so far; rays cast; full: whether more would have been cut but for `GROWTH`
    """

    def __init__(
        self, base: Elements, emitters: Emitters, samples: int, limit: float, min_edge: float, importance: np.ndarray | None = None
    ) -> None:
        """`limit`: contrast over which an element is cut; `min_edge`: metres, no edge is cut to less than this.

        `importance` (base.count,) 0 to 1: elements that matter less must have as much more contrast.
        """
        self.base, self.elements = base, base
        self.emitters, self.samples = emitters, samples
        self.limit, self.min_edge = limit, min_edge
        self.importance = importance
        self.rays = 0
        self.full = False

    def run(self, first: np.ndarray) -> Iterator[str]:
        """Refine by the irradiance `first` (2 base.count, 3) of one segment; yields often, after every round with a new `elements`."""
        seen = np.zeros((2 * self.base.count, 3))  # light that the pieces see
        light = first
        while True:
            split = self._choose(light)
            if not split.any():
                return
            fine = RefinedElements(self.elements, split)
            pieces = np.flatnonzero(split[fine.parent])
            sides = (2 * pieces[:, None] + np.arange(2)).ravel()
            root = (2 * fine.root[:, None] + np.arange(2)).ravel()
            sides = sides[first[root[sides]].any(axis=1)]
            look = LampLight(fine, self.emitters, self.samples, mesh=True, sides=sides)
            for share in look.run():
                yield f"Shadow boundaries, {fine.count:,} elements, {share:.0%}"
            self.rays += look.rays
            seen = np.repeat(seen.reshape(-1, 2, 3), np.where(split, 4, 1), axis=0).reshape(-1, 3)
            seen[sides] = look.irradiance[sides]
            self.elements = fine
            self.factor = self._factor(seen, root)
            light = first[root] * self.factor
            yield f"Shadow boundaries, {fine.count:,} elements"

    @property
    def root(self) -> np.ndarray:
        """(2 count,) side of `base` that each side is part of."""
        return (2 * self.elements.root[:, None] + np.arange(2)).ravel()

    def _choose(self, light: np.ndarray) -> np.ndarray:
        """(count,) bool: elements to cut, those of the highest contrast first where not all may be."""
        change = contrast(self.elements, light)
        if self.importance is not None:
            first = self.elements is self.base
            change = change * (self.importance if first else self.importance[self.elements.root])
        split = (change > self.limit) & (longest_edge(self.elements) >= 2 * self.min_edge * (1 - 1e-6))
        room = max(0, GROWTH * self.base.count - self.elements.count) // 3
        if split.sum() > room:
            self.full = True
            at = np.flatnonzero(split)
            order = np.lexsort((at, -change[at]))
            split[at[order[room:]]] = False
        return split

    def _factor(self, seen: np.ndarray, root: np.ndarray) -> np.ndarray:
        """(2 count, 3) light of each side relative to that of the side of `base` it is part of; the mean over this is 1."""
        mean = over_base(self.elements, self.base, seen)[root]
        factor = np.where(mean > 0, seen / np.where(mean > 0, mean, 1), 1.0)
        # Rounding must not cost flux.
        return factor / np.maximum(over_base(self.elements, self.base, factor)[root], 1e-300)


def importance(elements: Elements, detect: Detector, reflections: int = 8) -> np.ndarray:
    """(count,) float64 how much light on each element matters to receivers: its potential over the mean one, at most 1.

    Relaxes W = g + T* W (review, Eq. 2) on a few rays from every element; elements of more than the mean potential count in full.
    """
    transport = RayTransport.cast(ElementRays(elements), PER_SIDE)
    term = detect.on_elements(elements)
    total = term.copy()
    for _ in range(reflections):
        term = transport.adjoint(term)
        total += term
    potential = total.mean(axis=1).reshape(-1, 2).max(axis=1)
    mean = float((elements.area * potential).sum() / elements.area.sum())
    return np.minimum(1.0, potential / mean) if mean > 0 else np.ones(elements.count)


def shoot_emitters(state: DiffuseShooting, rays: np.ndarray, batch: int) -> Iterator[None]:
    """Shoot everything that is emitted, with `rays` (n,) rays for each side, in groups of about `batch` rays."""
    sides = np.flatnonzero(state.unshot[0].any(axis=1))
    ends = np.cumsum(rays[sides]) // batch
    for part in np.split(sides, np.flatnonzero(np.diff(ends)) + 1) if len(sides) else ():
        state.shoot(part, rays[part])
        yield
