"""A cache of irradiance values on surfaces with the distance over which each may be used (Ward et al. 1988; review, section 6.1).

A record at x_i with normal n_i and harmonic mean distance R_i to what it sees estimates the irradiance at x with the error

    e_i(x) = |x - x_i| / R_i + sqrt(1 - n . n_i)

and is used where e_i < accuracy, with weight 1 / e_i. With gradients (Ward and Heckbert 1992) each record is extrapolated first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling.maps import polar

LEVELS = 24  # of grids whose cells halve from one to the next
LARGE = np.float32(1e12)


@dataclass(frozen=True, eq=False)
class Records:
    """k records: position, normal, irradiance (k, 3); radius (k,), metres; gradients (k, 3 channels, 3 axes) by
    rotation and translation. spread (k, 3): irradiance by one half of the rays less that by both, which shows its noise.
    """

    position: np.ndarray
    normal: np.ndarray
    irradiance: np.ndarray
    spread: np.ndarray
    radius: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    @staticmethod
    def empty() -> Records:
        """No records."""
        z = np.zeros((0, 3), np.float32)
        return Records(z, z, z, z, np.zeros(0, np.float32), np.zeros((0, 3, 3), np.float32), np.zeros((0, 3, 3), np.float32))

    def joined(self, other: Records) -> Records:
        """Both together."""
        names = self.__dataclass_fields__
        return Records(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


class RecordIndex:
    """Finds the records that may serve a point: each lies in every cell its reach overlaps, in a grid as coarse as its reach.

    Immutable, so any number of threads may ask it.
    """

    def __init__(self, records: Records, accuracy: float, size: float) -> None:
        self.records = records
        self.accuracy = np.float32(accuracy)
        self.size = size
        reach = np.minimum(records.radius * self.accuracy, np.float32(2 * size))
        level = np.clip(np.floor(np.log2(2 * size / np.maximum(reach, 1e-30))), 0, LEVELS - 1).astype(np.int64)
        # A cell of level l is 2 * size / 2^l wide, at least the reach: a record overlaps at most 27 cells, its own and the neighbours.
        keys, owner = [], []
        home = self._cell(records.position, level)
        for offset in np.ndindex(3, 3, 3):
            cell = home + (np.array(offset) - 1)
            width = (2 * size / 2.0**level)[:, None]
            low, high = cell * width - size, (cell + 1) * width - size
            gap = np.maximum(np.maximum(low - records.position, records.position - high), 0)
            near = np.flatnonzero((gap**2).sum(axis=1) <= reach.astype(np.float64) ** 2 * 1.001)
            keys.append(self._key(cell[near], level[near]))
            owner.append(near)
        keys, owner = np.concatenate(keys), np.concatenate(owner)
        order = np.lexsort((owner, keys))
        self._keys, self._owner = keys[order], owner[order]
        self._levels = np.unique(level)

    def _cell(self, position: np.ndarray, level: np.ndarray | int) -> np.ndarray:
        scale = (2.0**level / (2 * self.size)) * np.ones(len(position))
        return np.floor((position.astype(np.float64) + self.size) * scale[:, None]).astype(np.int64)

    @staticmethod
    def _key(cell: np.ndarray, level: np.ndarray | int) -> np.ndarray:
        mask = (1 << 19) - 1
        return ((((np.int64(level) << 19) | (cell[:, 0] & mask)) << 38) | ((cell[:, 1] & mask) << 19) | (cell[:, 2] & mask)).astype(
            np.int64
        )

    def pairs(self, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(point, record, weight) of every valid pair, m rows."""
        points, found = [], []
        for level in self._levels:
            key = self._key(self._cell(position, int(level)), int(level))
            first, last = np.searchsorted(self._keys, key, "left"), np.searchsorted(self._keys, key, "right")
            many = last - first
            point = np.repeat(np.arange(len(position)), many)
            within = np.arange(len(point)) - np.repeat(np.cumsum(many) - many, many)
            points.append(point)
            found.append(self._owner[first[point] + within])
        if not points:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32)
        point, record = np.concatenate(points), np.concatenate(found)
        r = self.records
        to = position[point] - r.position[record]
        n, m = normal[point], r.normal[record]
        turn = np.sqrt(np.maximum(1 - np.einsum("ij,ij->i", n, m), 0))
        error = np.sqrt(np.einsum("ij,ij->i", to, to)) / r.radius[record] + turn
        # A record that lies in front of the point sees what the point may not.
        ahead = np.einsum("ij,ij->i", to, n + m) < np.float32(-0.02) * r.radius[record]
        good = np.flatnonzero((error < self.accuracy) & ~ahead)
        return point[good], record[good], (1 / np.maximum(error[good], np.float32(1e-4))).astype(np.float32)

    def covered(self, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(n,) bool: points that some record serves."""
        out = np.zeros(len(position), bool)
        out[self.pairs(position, normal)[0]] = True
        return out

    def irradiance(self, position: np.ndarray, normal: np.ndarray, gradients: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n, 3) float32 irradiance, (n, 3) float32 its `spread`, and (n,) bool where it is known."""
        point, record, weight = self.pairs(position, normal)
        r = self.records
        value = r.irradiance[record]
        if gradients:
            to = position[point] - r.position[record]
            turn = np.cross(r.normal[record], normal[point])
            value = value + np.einsum("ica,ia->ic", r.translation[record], to) + np.einsum("ica,ia->ic", r.rotation[record], turn)
            value = np.maximum(value, 0)
        n = len(position)
        total = np.bincount(point, weight, n)
        share = (weight / np.maximum(total, 1e-30)[point]).astype(np.float32)

        def mean(values: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(point, share * values[:, c], n) for c in range(3)], axis=1).astype(np.float32)

        return mean(value), mean(r.spread[record]), total > 0


def halves(values: np.ndarray) -> np.ndarray:
    """(n, c) mean over one half of the cells of values (n, rows, cols, c), those of one colour of a chess board, less the mean of both.

    Both halves lie evenly over the hemisphere, so that what they differ by is noise: of the mean its standard error, in the mean square.
    """
    _, rows, cols, _ = values.shape
    sign = np.where(np.add.outer(np.arange(rows), np.arange(cols)) % 2, np.float32(-1), np.float32(1))
    return np.einsum("jk,njkc->nc", sign, values) / np.float32(rows * cols)


def hemisphere(rows: int, cols: int, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stratified cosine directions in the local frame for `count` points: (count, rows, cols, 3) float32 and the angles phi (cols,) of the
    cells' middles; cell (j, k) covers sin^2 theta in [j, j + 1] / rows and phi in [k, k + 1] 2 pi / cols."""
    jitter = rng.random((2, count, rows, cols), np.float32)
    s2 = (np.arange(rows, dtype=np.float32)[:, None] + jitter[0]) / rows
    phi = (np.arange(cols, dtype=np.float32) + jitter[1]) * np.float32(2 * np.pi / cols)
    local = np.moveaxis(polar(s2, phi), 0, -1)
    return np.ascontiguousarray(local, np.float32), ((np.arange(cols) + 0.5) * 2 * np.pi / cols).astype(np.float32)


def gradients(radiance: np.ndarray, distance: np.ndarray, local: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation gradients (n, 3 channels, 3 axes) of the irradiance from one stratified hemisphere (Ward, Heckbert 1992).

    radiance (n, rows, cols, 3), distance (n, rows, cols), local directions (n, rows, cols, 3); x, y (n, 3) the frame's tangents.
    """
    _, rows, cols, _ = radiance.shape
    middle = (np.arange(cols) + 0.5) * 2 * np.pi / cols
    edge = np.arange(cols) * 2 * np.pi / cols

    # Rotation: int L (n x w) dw = pi / (M N) sum_k v_k sum_j tan(theta_j) L_jk, with v_k = n x u_k a quarter turn beyond phi_k, dotted
    # with the turn n_i x n. The tangent is the mean over its row, as it has no bound at the horizon.
    x2 = np.arange(rows + 1) / rows
    tangent = rows * np.diff(np.arcsin(np.sqrt(x2)) - np.sqrt(x2 * (1 - x2)))
    per_col = np.einsum("j,njkc->nkc", tangent, radiance) * (np.pi / (rows * cols))
    v = np.stack([-np.sin(middle), np.cos(middle)])
    turn = np.einsum("nkc,ak->nca", per_col, v)

    # Translation across theta: rays of neighbouring rows part at their common edge, nearer hits move faster.
    lower = np.arange(1, rows) / rows
    near = np.minimum(distance[:, 1:], distance[:, :-1])
    step = (np.sqrt(lower) * (1 - lower))[None, :, None, None] * (radiance[:, 1:] - radiance[:, :-1]) / near[..., None]
    u = np.stack([np.cos(middle), np.sin(middle)])
    move = np.einsum("nkc,ak->nca", step.sum(axis=1) * (2 * np.pi / cols), u)
    # Translation across phi.
    sine = np.sqrt(np.arange(rows + 1) / rows)
    before = np.roll(radiance, 1, axis=2)
    near = np.minimum(distance, np.roll(distance, 1, axis=2))
    step = (sine[1:] - sine[:-1])[None, :, None, None] * (radiance - before) / near[..., None]
    w = np.stack([-np.sin(edge), np.cos(edge)])
    move = move + np.einsum("nkc,ak->nca", step.sum(axis=1), w)

    frame = np.stack([x, y], axis=1)
    return np.einsum("nca,nai->nci", turn, frame).astype(np.float32), np.einsum("nca,nai->nci", move, frame).astype(np.float32)
