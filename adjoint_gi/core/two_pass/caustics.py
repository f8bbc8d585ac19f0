"""Light of lamps and background that reaches element sides via mirrors and through glass: particles from the lamps, followed
along chains of mirrors (Chen et al. 1991, "light ray tracing"), deposited on the elements where they meet diffuse surfaces.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..base.parallel import in_order
from ..base.settings import NO_LIMIT
from ..elements.elements import Elements
from ..lights.base import LampKind
from ..lights.emitters import Emitters
from ..sampling.additive import STEPS, additive
from ..sampling.maps import Stretches
from ..scene.arrays import RayKind
from ..walks.mirror_chains import Chains
from .known_light import KnownLight

PARTICLES_PER_BATCH = 1 << 14
MIN_PARTICLES = 256  # particles of a lamp


class Caustics:
    """Irradiance of element sides from lamps and background over at least one mirror, from fixed random numbers.

    by_length   (depth + 2, 2 ne, 3) float64 W m-2; entry k holds the light that has flown k segments, so 0 and 1 are empty
    unmet       the same shape: of this, what left the first surface after a lamp by a perfectly smooth lobe. Rays from receivers meet a
                lamp without size never and a small one hardly ever there, so view passes leave this light to what is known here
    other       (3,) W: what arrives over mirrors and neither reaches a diffuse lobe nor goes on, less what goes over them from the first
                surfaces, where straight light has all of it: with this and what escaped, (3,) W, the flux of lamps is counted once
    rays        cast for it
    """

    def __init__(self, elements: Elements, emitters: Emitters, chains: Chains, particles: int) -> None:
        self.elements, self.chains = elements, chains
        sides = 2 * elements.count
        self.rays = 0
        self.other, self.escaped = np.zeros(3), np.zeros(3)
        self.any = False
        self._sources = []
        if chains.any and particles:
            self._sources = emitters.lamps.sources() + emitters.background.sources()
        power = np.array([s.power for s in self._sources])
        self._cells = [Stretches(s.cells) for s in self._sources]
        self._counts = [max(MIN_PARTICLES, int(particles * p / power.sum())) for p in power]
        self.by_length = np.zeros((chains.depth + 2 if self._sources else 2, sides, 3))
        self.unmet = np.zeros_like(self.by_length)

    @property
    def total(self) -> np.ndarray:
        """(2 ne, 3) float64 W m-2 of all lengths."""
        return self.by_length.sum(axis=0)

    def run(self) -> Iterator[float]:
        """Yield the share done."""
        items = []
        for index, count in enumerate(self._counts):
            items += [(index, first, min(first + PARTICLES_PER_BATCH, count)) for first in range(0, count, PARTICLES_PER_BATCH)]
        with closing(in_order(self._batch, items)) as results:
            for number, (found, other, escaped, rays) in enumerate(results):
                self.rays += rays
                self.other += other
                self.escaped += escaped
                for length, side, power, unmet in found:
                    area = self.elements.area[side >> 1]
                    self.any |= len(side) > 0
                    for c in range(3):
                        h = power[:, c] / area
                        self.by_length[length, :, c] += np.bincount(side, h, self.by_length.shape[1])
                        self.unmet[length, :, c] += np.bincount(side[unmet], h[unmet], self.by_length.shape[1])
                yield (number + 1) / len(items)

    def unmet_light(self, low: int, high: int) -> KnownLight | None:
        """What is `unmet`, for a view pass that counts paths of `low` to `high` segments; None where there is none."""
        if not self.unmet.any():
            return None
        zero, sums = np.zeros_like(self.unmet[0]), {}
        longest = len(self.unmet) - 1

        def lengths(segments: int) -> tuple[np.ndarray, np.ndarray]:
            window = min(max(low - segments, 0), longest + 1), min(max(high - segments, -1), longest)
            if window not in sums:
                sums[window] = self.unmet[window[0] : window[1] + 1].sum(axis=0)
            return zero, sums[window]

        out = KnownLight(self.elements, lengths, high if high < NO_LIMIT else low)
        out.prepare()
        return out

    def _batch(self, item: tuple[int, int, int]) -> tuple[list, np.ndarray, np.ndarray, int]:
        """Particles first to last of a source: for each length the sides (m,), power (m, 3) in W and whether it is `unmet`; then `other`,
        `escaped` and `rays` of them."""
        index, first, last = item
        source = self._sources[index]
        rng = np.random.default_rng([19, index, first])
        square = additive(np.arange(first + 1, last + 1), STEPS[4], 0.5).T
        # The particles of a source are spread over its cells as over one stretch, each at random in its part of it.
        many, cells = self._counts[index], self._cells[index]
        cell = cells.pick((np.arange(first, last) + rng.random(last - first)) / many)
        start = source.shoot(square, rng, cell)
        flux = start.flux / (many * cells.probability[cell])[:, None].astype(np.float32)
        found, other, escaped, rays = [], np.zeros(3), np.zeros(3), 0
        origin, direction = (np.ascontiguousarray(x, np.float32) for x in (start.origin, start.direction))
        for met in self.chains.follow(origin, direction, RayKind.SHADOW, rng, start.dark):
            rays += len(met.row) + len(met.away)
            if met.segments < 2:
                other -= (flux[met.row] * met.scattered).sum(axis=0, dtype=float)
                continue
            escaped += (flux[met.away] * met.lost).sum(axis=0, dtype=float)
            if not len(met.row):
                continue
            s = met.surface
            power = flux[met.row] * met.weight * met.share
            other += (flux[met.row] * (met.weight - met.sent) - power).sum(axis=0, dtype=float)
            lamp = isinstance(source.kind, LampKind)
            found.append((met.segments, self.elements.side(s.triangle, s.u, s.v, s.side), power, met.clear & lamp))
        return found, other, escaped, rays
