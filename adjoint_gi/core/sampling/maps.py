"""Maps from uniform random numbers to directions, points and picks, each with its density.

Batches of vectors are component first, (3, n) float32: numpy runs over them about ten times faster than over (n, 3), and
Embree takes their transposed views as they are. Random numbers are (n,) arrays in 0..1, made by the caller, so that the same
maps serve pseudo-random and low-discrepancy numbers.
"""

from __future__ import annotations

import numpy as np

PI = np.float32(np.pi)
TWO_PI = np.float32(2 * np.pi)
ONE = np.float32(1)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) scalar products of component-first vectors (3, n)."""
    return np.einsum("ij,ij->j", a, b)


def dot_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) scalar products of row vectors (n, 3)."""
    return np.einsum("ij,ij->i", a, b)


def columns(vectors: np.ndarray) -> np.ndarray:
    """(3, n) float32 contiguous copy of row vectors (n, 3)."""
    return np.ascontiguousarray(np.asarray(vectors, np.float32).T)


def sphere(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(3, n) unit directions, uniform over the sphere: pdf_w = 1 / (4 pi)."""
    out = np.empty((3, len(u)), np.float32)
    # The numbers may be float64; all from here on is float32.
    z = (1 - 2 * u).astype(np.float32)
    r = np.sqrt(np.maximum(ONE - z * z, 0))
    phi = (2 * np.pi * v).astype(np.float32)
    np.multiply(r, np.cos(phi), out=out[0])
    np.multiply(r, np.sin(phi), out=out[1])
    out[2] = z
    return out


def cosine_hemisphere(normal: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (3, n) about `normal` (3, n) and their cosines (n,): pdf_w = cosine / pi.

    A point of the unit sphere that touches the surface at its south pole, seen from that pole: no local frame is needed.
    """
    w = sphere(u, v)
    w += normal
    square = dot(w, w)
    # The pole opposite the normal gives no direction. It and what rounding cannot tell from it make 1 in 10^8: the normal is taken.
    bad = square < np.float32(1e-8)
    if bad.any():
        w[:, bad], square[bad] = 2 * normal[:, bad], 4
    length = np.sqrt(square)
    w /= length
    # w . n = (1 + s . n) / length = length / 2, as length^2 = 2 + 2 s . n.
    return w, np.minimum(np.float32(0.5) * length, ONE)


def cosine_directions(normal: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """`cosine_hemisphere` for rows: (n, 3) float32 unit directions about `normal` (n, 3)."""
    return np.ascontiguousarray(cosine_hemisphere(normal.T, u, v)[0].T)


def polar(sine2: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """(3, ...) unit vectors about the z axis, at angles whose sine squared is `sine2` (...,) from it and `phi` (...,) around it.

    They stay a hair above the horizon. With `sine2` uniform in 0..1 they have pdf_w = cosine / pi (Malley's method).
    """
    r = np.sqrt(sine2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(np.maximum(1 - sine2, np.float32(1e-7)))])


def polar_rows(sine2: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """`polar` for rows: (n, 3) unit vectors about the z axis."""
    return np.ascontiguousarray(polar(sine2, phi).T)


def frame(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3, n) that make a right-handed frame with `normal` (3, n) (Duff et al. 2017)."""
    nx, ny, nz = normal
    s = np.where(nz < 0, -ONE, ONE)
    a = -1 / (s + nz)
    b = nx * ny * a
    x = np.stack([ONE + s * nx * nx * a, s * b, -s * nx])
    y = np.stack([b, s + ny * ny * a, -ny])
    return x, y


def frame_rows(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`frame` for rows: two unit vectors (n, 3) at right angles to `normal` (n, 3)."""
    x, y = frame(normal.T)
    return np.ascontiguousarray(x.T), np.ascontiguousarray(y.T)


def cone(axis: np.ndarray, one_minus_cos: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (3, n) uniform in cones about `axis` (3, n), and their cosines to it: pdf_w = 1 / (2 pi one_minus_cos).

    `one_minus_cos` (n,) is 1 minus the cosine of the half angle, which stays exact for narrow cones.
    """
    x, y = frame(axis)
    a, b, c = cone_local(one_minus_cos, u, v)
    return x * a + y * b + axis * c, c


def cone_local(one_minus_cos: np.ndarray | float, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """`cone` about the z axis: (3, n) unit directions in the type of the numbers; with `one_minus_cos` 2 all over the sphere."""
    h = u * one_minus_cos
    r = np.sqrt(np.maximum(h * (2 - h), 0))
    phi = 2 * np.pi * v
    return np.stack([r * np.cos(phi), r * np.sin(phi), 1 - h])


def disk(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (x, y), each (n,), uniform in the unit disk: pdf_a = 1 / pi."""
    r = np.sqrt(u)
    phi = 2 * np.pi * v
    return r * np.cos(phi), r * np.sin(phi)


def triangle(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentrics (b1, b2), each (n,), uniform over a triangle: pdf_a = 1 / area.

    The low-distortion map of Heitz 2019, which keeps stratified numbers stratified.
    """
    swap = v > u
    small = np.float32(0.5) * np.where(swap, u, v)
    large = np.where(swap, v, u) - small
    return np.where(swap, small, large), np.where(swap, large, small)


def power_heuristic(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,) weight a^2 / (a^2 + b^2) of a sample drawn with density `a` > 0 that the other technique draws with density `b` (Veach 1997)."""
    r = np.minimum(b / a, np.float32(1e18))
    return ONE / (ONE + r * r)


class Stretches:
    """Picks an index with probability proportional to its weight: the stretch of 0..1 that a number lies in. Even numbers pick evenly.

    probability (k,) float64: of each index, 0 for weights that are 0.
    """

    def __init__(self, weights: np.ndarray) -> None:
        self.probability = weights / weights.sum() if len(weights) else weights
        self._ends = np.cumsum(self.probability)
        # Rounding may leave the last sum below 1, and what comes after the last weight that is not 0 must not be picked.
        self._last = int(np.flatnonzero(weights)[-1]) if len(weights) else 0

    def pick(self, u: np.ndarray) -> np.ndarray:
        """(n,) int64 indices for numbers `u` (n,) in 0..1, ascending where they are."""
        return np.minimum(np.searchsorted(self._ends, u, side="right"), self._last)


class PowerTable:
    """Picks an index with probability proportional to its weight, at the cost of two look-ups (Walker's alias method, 1977).

    probability (k,) float64: of each index, 0 for weights that are 0. Raises ValueError when a weight is negative or not a number.
    """

    def __init__(self, weights: np.ndarray) -> None:
        weights = np.asarray(weights, np.float64)
        total = weights.sum()
        if len(weights) and not (np.isfinite(total) and weights.min() >= 0):
            raise ValueError("weights of a power table must be finite and not negative")
        self.count = len(weights) if total > 0 else 0
        self.probability = weights / total if total > 0 else np.zeros(len(weights))
        scaled = self.probability * self.count
        self._keep = np.ones(len(weights))
        self._alias = np.arange(len(weights))
        # Entries below 1 are filled up by entries above 1 in turn. One that has given away too much is filled up by the next one,
        # so that running sums of what is missing and what is spare say who fills whom (Huebschle-Schneider and Sanders 2022).
        small, large = np.flatnonzero(scaled < 1), np.flatnonzero(scaled >= 1)
        # Equal weights may all come out a rounding error below 1; then there is nothing to fill.
        if self.count and len(small) and len(large):
            missing, spare = np.cumsum(1 - scaled[small]), np.cumsum(scaled[large] - 1)
            before = np.append(0.0, missing[:-1])
            giver = np.minimum(np.searchsorted(spare, before, side="right"), len(large) - 1)
            self._keep[small], self._alias[small] = scaled[small], large[giver]
            last = np.searchsorted(missing, spare[:-1])
            given = np.minimum(last, len(small) - 1)
            self._keep[large[:-1]] = np.where(last < len(small), 1 - (missing[given] - spare[:-1]), 1.0)
            self._alias[large[:-1]] = large[1:]
        if self.count:
            # What rounding leaves over must not give an index of weight 0 a chance.
            zero = (self.probability == 0) & (self._keep > 0)
            self._keep[zero], self._alias[zero] = 0.0, int(np.argmax(self.probability))

    def pick(self, u: np.ndarray) -> np.ndarray:
        """(n,) int64 indices for numbers `u` (n,) in 0..1; use float64 numbers for more than a few thousand weights."""
        if self.count == 1:
            return np.full(len(u), self._alias[0] if self._keep[0] < 1 else 0)
        x = u * u.dtype.type(self.count)
        i = np.minimum(x.astype(np.int64), self.count - 1)
        return np.where(x - i < self._keep.take(i), i, self._alias.take(i))
