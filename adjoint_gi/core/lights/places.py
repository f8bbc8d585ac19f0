"""Picks emitters by what they are likely to give at a place, so that a lamp next door costs few samples.

A grid over the scene has for each of its cells the probabilities of clusters of emitters, by intensity towards the cell over squared
distance, mixed with those by power alone, so that none is 0. Within a cluster, which holds one emitter where there are few, power decides.
The idea is that of light trees (Conty Estevez and Kulla 2018); a table costs two look-ups where a tree is walked, and gives the density
of any emitter as fast. Shadows are not known here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.world import World

FEWEST = 4  # emitters below which power alone decides
CLUSTERS = 256
ENTRIES = 1 << 20  # of the table, cells times clusters
CELLS = 1 << 13
BY_POWER = 0.1  # share of the picks that power alone decides


@dataclass(frozen=True, eq=False)
class Outlook:
    """Where k emitters are and how they shine: position (k, 3); radius (k,) m; intensity (k,) along `axis` (k, 3), W sr-1, or irradiance
    W m-2 where `far`; edge (k,): cosine of the angle to the axis beyond which nothing is sent, -1 where it goes everywhere; lambert (k,)
    bool: falls off by the cosine."""

    position: np.ndarray
    radius: np.ndarray
    intensity: np.ndarray
    axis: np.ndarray
    edge: np.ndarray
    lambert: np.ndarray
    far: np.ndarray

    def joined(self, other: Outlook) -> Outlook:
        """Both, one after the other."""
        return Outlook(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__dataclass_fields__))


class LightPlaces:
    """Probabilities of emitters at points of a world. `power` (k,) float64, those of 0 are never picked."""

    def __init__(self, world: World, outlook: Outlook, power: np.ndarray) -> None:
        self._cluster(outlook, power)
        self._grid(world)
        shares = self._estimates(outlook, power)
        shares *= (1 - BY_POWER) / np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
        shares += BY_POWER * self._power / self._power.sum()
        self._probability = shares / shares.sum(axis=1, keepdims=True)
        cumulative = np.cumsum(self._probability, axis=1)
        # Padded to a power of two for the search, and with the last cluster that can be picked at the end.
        self._steps = [1 << s for s in reversed(range((self.clusters - 1).bit_length()))]
        padded = np.full((len(cumulative), 1 << len(self._steps)), 2.0)
        last = int(np.flatnonzero(self._power)[-1])
        padded[:, :last] = cumulative[:, :last]
        self._cumulative, self._width = padded.ravel(), padded.shape[1]

    def _cluster(self, outlook: Outlook, power: np.ndarray) -> None:
        """Order emitters along a curve through space and cut it; those from far away are each alone, at the end."""
        far = outlook.far
        low = outlook.position[~far].min(axis=0, initial=np.inf)
        extent = np.ptp(outlook.position[~far], axis=0).max(initial=1e-9) if (~far).any() else 1.0
        cell = np.clip(np.nan_to_num((outlook.position - low) / max(extent, 1e-9)) * 1023, 0, 1023).astype(np.int64)
        code = sum(((cell[:, c] >> bit) & 1) << (3 * bit + c) for bit in range(10) for c in range(3))
        order = np.lexsort((np.arange(len(power)), code, far))
        near = int((~far).sum())
        groups = min(near, max(1, CLUSTERS - int(far.sum())))
        of = np.concatenate([np.arange(near) * groups // max(near, 1), groups + np.arange(len(power) - near)])
        self.clusters = int(of[-1]) + 1
        self._order, self._of = order, np.empty(len(power), np.int64)
        self._of[order] = of
        self._cum = np.concatenate([[0.0], np.cumsum(power[order])])
        start = np.searchsorted(of, np.arange(self.clusters + 1))
        self._start = self._cum[start]
        self._first, self._last = start[:-1], start[1:] - 1
        self._power = np.diff(self._start)
        self._within = power / np.maximum(self._power[self._of], 1e-300)

    def _grid(self, world: World) -> None:
        rows = world.rows.astype(np.float64)
        corners = np.concatenate([rows[:, 0:3], rows[:, 0:3] + rows[:, 3:6], rows[:, 0:3] + rows[:, 6:9]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        extent = np.maximum(high - low, 1e-3 * (high - low).max() + 1e-9)
        cells = min(CELLS, ENTRIES // self.clusters)
        edge = (extent.prod() / cells) ** (1 / 3)
        count = np.clip(np.ceil(extent / edge), 1, 256)
        while count.prod() > 2 * cells:
            count = np.maximum(1, np.floor(count * 0.8))
        # Walls at round coordinates shall not lie on the borders of cells.
        self._size = extent / (count - 0.37) if (count > 1).all() else extent / np.maximum(count - 0.37 * (count > 1), 1)
        self._low, self._count = low - 0.19 * self._size * (count > 1), count.astype(np.int64)
        self._origin, self._scale = self._low.astype(np.float32)[:, None], (1 / self._size).astype(np.float32)[:, None]
        self._most = (self._count - 1).astype(np.float32)[:, None]

    def _estimates(self, outlook: Outlook, power: np.ndarray) -> np.ndarray:
        """(cells, clusters) float64 rough irradiance."""
        axes = [self._low[c] + (np.arange(self._count[c]) + 0.5) * self._size[c] for c in range(3)]
        cell = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)
        half = 0.5 * float(np.linalg.norm(self._size))
        out = np.zeros((len(cell), self.clusters))
        for cluster in range(self.clusters):
            mine = self._order[self._first[cluster] : self._last[cluster] + 1]
            mine = mine[power[mine] > 0]
            if not len(mine):
                continue
            intensity = outlook.intensity[mine].sum()
            if outlook.far[mine[0]]:
                out[:, cluster] = intensity
                continue
            middle = np.average(outlook.position[mine], axis=0, weights=power[mine])
            radius = float((np.linalg.norm(outlook.position[mine] - middle, axis=1) + outlook.radius[mine]).max())
            to = cell - middle
            square = np.einsum("ij,ij->i", to, to)
            reach = half + radius
            out[:, cluster] = intensity / (square + 0.25 * reach**2)
            if len(mine) == 1 and outlook.edge[mine[0]] > -1:
                # Beyond the edge by more than the cell and the emitter span, nothing is sent.
                cosine = np.clip(to @ outlook.axis[mine[0]] / np.sqrt(np.maximum(square, 1e-30)), -1, 1)
                slack = np.arcsin(np.minimum(1, reach / np.sqrt(np.maximum(square, 1e-30))))
                angle = np.maximum(np.arccos(cosine) - slack, 0)
                sent = np.where(angle <= np.arccos(outlook.edge[mine[0]]), 1.0, 0.0)
                out[:, cluster] *= sent * np.maximum(np.cos(angle), 0) if outlook.lambert[mine[0]] else sent
        return out

    def _cells(self, p: np.ndarray) -> np.ndarray:
        """(n,) int64 cells of points `p` (3, n); what lies outside of the grid belongs to its border."""
        at = p - self._origin
        at *= self._scale
        np.clip(at, np.float32(0), self._most, out=at)
        x, y, z = at.astype(np.int64)
        return (x * self._count[1] + y) * self._count[2] + z

    def draw(self, p: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Emitters (n,) for points `p` (3, n) from numbers `u` (n,) float64, and the probability (n,) float32 of each."""
        row = self._cells(p)
        base, cluster = row * self._width, np.zeros(len(row), np.int64)
        for step in self._steps:
            cluster += step * (self._cumulative.take(base + cluster + (step - 1)) <= u)
        chance = self._probability.ravel().take(row * self.clusters + cluster)
        if self.clusters == len(self._order):
            index = self._order[cluster]
            return index, chance.astype(np.float32)
        below = np.where(cluster > 0, self._cumulative.take(np.maximum(base + cluster - 1, 0)), 0.0)
        inside = np.clip((u - below) / chance, 0, 1)
        at = np.searchsorted(self._cum, self._start[cluster] + inside * self._power[cluster], side="right") - 1
        index = self._order[np.clip(at, self._first[cluster], self._last[cluster])]
        return index, (chance * self._within[index]).astype(np.float32)

    def probability(self, p: np.ndarray, index: np.ndarray) -> np.ndarray:
        """(n,) float32 with which `draw` picks emitters `index` (n,) at points `p` (3, n)."""
        at = self._cells(p) * self.clusters + self._of[index]
        return (self._probability.ravel().take(at) * self._within[index]).astype(np.float32)
