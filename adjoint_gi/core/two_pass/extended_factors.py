"""Extended form factors: what element sides see of one another straight and via mirrors, glass and glossy surfaces.

F_ext(i, j) is the share of diffuse light leaving i that arrives at j via any number of surfaces that are not diffuse (Wallace,
Cohen and Greenberg 1987; Sillion and Puech 1989). They are found by tracing, and coloured as mirrors may be.

Below a coat a surface reflects diffusely what the coat lets through: exact for light that leaves (gathering) or arrives (shooting);
for the other direction the light is taken as coming from, or going to, all sides alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..base.parallel import in_order
from ..elements.rays import RAYS_PER_TASK, ElementRays
from ..radiosity.transports import FreshRayTransport, Transport
from ..scene.arrays import RayKind
from ..walks.mirror_chains import Chains


def diffuse_rho(rays: ElementRays, chains: Chains) -> np.ndarray:
    """(2 ne, 3) float64 albedo of the diffuse lobe alone."""
    return np.repeat(rays.elements.mean(chains.diffuse, chains.albedo_varies), 2, axis=0)


class ExtendedTransport(Transport):
    """Chains drawn once from every side and kept; gathers.

    `build` must have ended. weight (r, 3) float32, share (r, 1) or (r, 3) of what leaves the target below its coat; rows are sorted by the
    segments of the chains, and those of s segments are `rows[s]`.
    """

    def __init__(self, rays: ElementRays, chains: Chains, per_side: int) -> None:
        self.rays, self.chains, self.per_side = rays, chains, per_side
        self.area = np.repeat(rays.elements.area, 2)
        self.rho = diffuse_rho(rays, chains)
        self.emitted = np.repeat(rays.elements.emitted, 2, axis=0)
        self.count = 0  # rays cast

    def build(self, sides: np.ndarray) -> Iterator[float]:
        """Cast the chains of `sides` (m,); yields the share done."""
        sends = (self.rho.max(axis=1) > 0) | (self.emitted.max(axis=1) > 0)
        block = max(1, RAYS_PER_TASK // self.per_side)
        elements = self.rays.elements

        def work(first: int) -> tuple[list[list[tuple]], int]:
            owner = np.repeat(sides[first : first + block], self.per_side)
            number = np.tile(np.arange(self.per_side), len(owner) // self.per_side)
            origin, direction, _ = self.rays.start(owner, number, owner)
            out, cast = [[] for _ in range(self.chains.depth + 2)], 0
            for met in self.chains.follow(origin, direction, RayKind.DIFFUSE, np.random.default_rng([17, first])):
                cast += len(met.row) + len(met.away)
                s = met.surface
                side = elements.side(s.triangle, s.u, s.v, s.side)
                keep = np.flatnonzero(sends[side])
                row = met.row[keep]
                out[met.segments].append((owner[row].astype(np.int32), side[keep].astype(np.int32), met.weight[keep], met.share[keep]))
            return out, cast

        pieces: list[list[tuple]] = [[] for _ in range(self.chains.depth + 2)]
        with closing(in_order(work, range(0, len(sides), block))) as results:
            for number, (found, cast) in enumerate(results):
                for all_, new in zip(pieces, found, strict=True):
                    all_ += new
                self.count += cast
                yield min(1.0, (number + 1) * block / max(1, len(sides)))
        self.rows, first = [], 0
        for part in pieces:
            many = sum(len(p[0]) for p in part)
            self.rows.append(slice(first, first + many))
            first += many
        flat = [p for part in pieces for p in part]
        none, channels = np.zeros(0, np.int32), self.chains.table.coat_channels
        empty = (none, none, np.zeros((0, 3), np.float32), np.zeros((0, channels), np.float32))
        self.source, self.target, self.weight, self.share = (np.concatenate([e, *(p[i] for p in flat)]) for i, e in enumerate(empty))
        self.weight /= np.float32(self.per_side)
        self.below = self.weight * self.share if self.chains.table.any_coat else self.weight

    def gather(self, x: np.ndarray) -> np.ndarray:
        """F_ext x for light x (n, 3) that surfaces reflect diffusely."""
        return self.through(x, slice(None))

    def through(self, x: np.ndarray, rows: slice, emitted: bool = False) -> np.ndarray:
        """The part of F_ext x over the chains in `rows`; `emitted`: x leaves above the coats."""
        source, target = self.source[rows], self.target[rows]
        weight = (self.weight if emitted else self.below)[rows]
        n = len(self.area)
        out = [np.bincount(source, weight[:, c] * x[target, c], n) for c in range(3)]
        return np.stack(out, axis=1).astype(np.float64)


class ExtendedShots(FreshRayTransport):
    """Chains cast anew at every shot; shoots.

    other   (c,) float64 W: of the last shot, what arrived and neither reached a diffuse lobe nor went on along a chain, less what was
            counted once at a surface and once more at the next: with it, flux is conserved exactly.
    """

    def __init__(self, rays: ElementRays, chains: Chains) -> None:
        super().__init__(rays)
        self.chains = chains
        # Chains give their light to every surface that they pass, so sides are met as a whole.
        self.area = np.repeat(rays.elements.area, 2)
        self.rho = diffuse_rho(rays, chains)

    def shoot(self, index: np.ndarray, radiosity: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every chain carries the same share of its side's flux, times its colour."""
        n, columns = len(self.area), radiosity.shape[1]
        who = np.repeat(np.arange(len(index)), rays)
        number = np.arange(len(who)) - np.repeat(np.cumsum(rays) - rays, rays) + self._used[index][who]
        side = index[who]
        self._used[index] += rays
        share = self.area[index, None] * radiosity / rays[:, None]
        serial = self.count
        elements = self.rays.elements

        def work(first: int) -> tuple[list[tuple], np.ndarray, np.ndarray, int]:
            part = slice(first, first + RAYS_PER_TASK)
            origin, direction, _ = self.rays.start(side[part], number[part], side[part])
            flux = share[who[part]]
            found, other, escaped, cast = [], np.zeros(columns), np.zeros(columns), 0
            for met in self.chains.follow(origin, direction, RayKind.DIFFUSE, np.random.default_rng([23, serial, first])):
                cast += len(met.row) + len(met.away)
                s = met.surface
                arrives = flux[met.row] * _colors(met.weight, columns)
                taken = arrives * _colors(met.share, columns)
                found.append((elements.side(s.triangle, s.u, s.v, s.side), taken))
                other += (arrives - taken - flux[met.row] * _colors(met.sent, columns)).sum(axis=0)
                escaped += (flux[met.away] * _colors(met.lost, columns)).sum(axis=0)
            return found, other, escaped, cast

        arrived, self.other, escaped = np.zeros((n, columns)), np.zeros(columns), np.zeros(columns)
        for found, other, lost, cast in in_order(work, range(0, len(who), RAYS_PER_TASK)):
            for met, taken in found:
                for c in range(columns):
                    arrived[:, c] += np.bincount(met, taken[:, c], n)
            self.other += other
            escaped += lost
            self.count += cast
        return arrived / np.maximum(self.area, 1e-300)[:, None], escaped


def _colors(weight: np.ndarray, columns: int) -> np.ndarray:
    """Weights (m, 3), or grey ones (m, 1), as float64 for radiosities of `columns` columns, which are colours over and over."""
    return np.tile(weight.astype(np.float64), (1, columns // weight.shape[1]))
