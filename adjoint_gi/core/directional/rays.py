"""Rays between element sides whose directions count at both ends, and the light that lamps and background send along known directions."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ..base.parallel import in_order
from ..elements.elements import Elements
from ..elements.rays import ElementRays, shifted_points
from ..lights.emitters import Emitters
from ..sampling.maps import TWO_PI, polar_rows
from .bins import frames

POINTS = 4  # points of an element that look at the lights, times `samples`
RAYS_PER_LIGHT_BATCH = 1 << 14  # about, towards lights, in one piece of work


class DirectionalRays(ElementRays):
    """Casts rays from element sides along directions of the side's frame; says what they meet and along which direction they arrive."""

    def __init__(self, elements: Elements) -> None:
        super().__init__(elements)
        self.frames = frames(elements.normal)

    def start(self, side: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(n, 3) float32 ray origins at local coordinates a, b (n,) float32 in 0..1 of sides (n,)."""
        rows = self._rows[side >> 1]
        fold = ~self.elements.is_quad[side >> 1] & (a + b > 1)
        a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
        origin = rows[:, 0:3] + a[:, None] * rows[:, 3:6] + b[:, None] * rows[:, 6:9]
        return self.world.lifted(origin, self.frames[side, 2], self._triangle[side >> 1])

    def to_world(self, side: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Directions `w` (n, 3) of the sides' frames in the world."""
        return np.einsum("nk,nkj->nj", w, self.frames[side])

    def to_local(self, side: np.ndarray, w: np.ndarray) -> np.ndarray:
        """World directions in the sides' frames, z kept above 0."""
        out = np.einsum("nkj,nj->nk", self.frames[side], w)
        out[:, 2] = np.maximum(out[:, 2], np.float32(1e-6))
        return out

    def cosine(self, number: np.ndarray, stream: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ray `number` of the fixed set of `stream`: place on the side (2, n) and direction by the cosine (n, 3), float32."""
        u = shifted_points(number, stream).astype(np.float32)
        return u[:2], polar_rows(u[2], TWO_PI * u[3])

    def trace(self, side: np.ndarray, a: np.ndarray, b: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Sides met (n,) int64, -1 where rays escape, the directions (n, 3) in their frames from which rays arrive, and colour."""
        origin, direction = self.start(side, a, b), self.to_world(side, w)
        triangle, u, v, color = self.meet(origin, direction, self.frames[side, 2])
        hit = np.flatnonzero(triangle >= 0)
        met, arrives = np.full(len(side), -1, np.int64), np.zeros((len(side), 3), np.float32)
        behind = np.einsum("ij,ij->i", self._normals[triangle[hit]], direction[hit]) > 0
        met[hit] = 2 * self.elements.locate(triangle[hit], u[hit], v[hit]) + behind
        arrives[hit] = self.to_local(met[hit], -direction[hit])
        return met, arrives, color

    def cast(self, side: np.ndarray, number: np.ndarray, stream: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """As in `ElementRays`, with directions of the frames used here."""
        (a, b), w = self.cosine(number, stream)
        met, _, color = self.trace(side, a, b, w)
        return met, color


# Takes light that arrives: sides (m,), directions in their frames (m, 3), and what it adds to the irradiance (m, 3).
Sink = Callable[[np.ndarray, np.ndarray, np.ndarray], None]


class ArrivingLight:
    """Light of lamps, and of the background where asked, on every element side, with the direction it comes from. `rays`: cast for it."""

    def __init__(self, caster: DirectionalRays, emitters: Emitters, samples: int, background: bool) -> None:
        self.caster, self.emitters = caster, emitters
        self.points = POINTS * samples
        self.background = background and emitters.any_background
        self.rays = 0

    def run(self, sink: Sink) -> Iterator[float]:
        """Hand everything to `sink`; yields the share done. From fixed points and fixed random numbers."""
        if not (self.emitters.any_drawn(False, False) or self.background):
            return
        total = len(self.caster.frames)
        block = max(1, RAYS_PER_LIGHT_BATCH // self.points)

        def work(first: int) -> tuple[int, list, int]:
            side = np.repeat(np.arange(first, min(first + block, total)), self.points)
            (a, b), w = self.caster.cosine(np.tile(np.arange(self.points), len(side) // self.points), side)
            found, rays = [], 0
            if self.emitters.any_drawn(False, False):
                found.append(self._lamps(side, a, b, np.random.default_rng([5, first])))
                rays += len(side)
            if self.background:
                met, _, color = self.caster.trace(side, a, b, w)
                out = np.flatnonzero(met < 0)
                value = np.pi * self.emitters.escaping(self.caster.to_world(side[out], w[out]))
                found.append((side[out], w[out], value if color is None else value * color[out]))
                rays += len(side)
            return first, found, rays

        for first, found, rays in in_order(work, range(0, total, block)):
            for side, w, value in found:
                sink(side, w, value.astype(np.float64) / self.points)
            self.rays += rays
            yield min(1.0, (first + block) / total)

    def _lamps(self, side: np.ndarray, a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One light point for each place: sides that are lit, directions and irradiance."""
        origin = self.caster.start(side, a, b)
        s = self.emitters.draw(np.ascontiguousarray(origin.T), rng.random((3, len(side)), np.float32), False, False)
        cosine = np.einsum("cn,nc->n", s.wi, self.caster.frames[side, 2])
        lit = np.flatnonzero((cosine > 0) & (s.radiance.max(axis=0) > 0))
        wi = np.ascontiguousarray(s.wi[:, lit].T)
        hidden, share = self.caster.world.shadows(np.ascontiguousarray(origin[lit]), wi, s.distance[lit])
        free = np.flatnonzero(~(hidden & s.shadow[lit]))
        lit, wi = lit[free], wi[free]
        value = s.radiance[:, lit].T * (cosine[lit] / s.pdf_w[lit])[:, None]
        if share is not None:
            value *= np.where(s.shadow[lit, None], share[free], np.float32(1))
        return side[lit], self.caster.to_local(side[lit], wi), value
