"""Sample sets of any size in any number of dimensions: independent, jittered, or Sobol points.

A set belongs to one receiver and one use (a `stream`: the place in a pixel, the lens, the light points of the first hit, ...). Its
points are numbered, and point k is computed from k alone, so neither batches nor threads change it. Sets of different streams are
joined at random, as Cook does: each stream takes its points in a random order of its own. Every point is uniform, so estimates stay
unbiased; jittered and Sobol sets cover the unit cube more evenly, so that their error falls faster with the size of the set.

R. L. Cook, "Stochastic Sampling in Computer Graphics", ACM TOG 5(1), 1986 (jittering).
A. Kensler, "Correlated Multi-Jittered Sampling", Pixar 13-01, 2013 (random order by hashing).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .sobol import DIMENSIONS, hashed, sobol_at

SAMPLERS = (
    ("independent", "Independent", "Plain random numbers"),
    ("jittered", "Jittered", "One random point in each cell of a grid over every pair of dimensions (Cook 1986)"),
    ("sobol", "Sobol", "Points of the Sobol sequence, shifted at random; powers of two are best"),
)
ONE_BELOW = np.float32(1 - 2**-24)
U = np.uint32


@dataclass(frozen=True)
class Sampler:
    """Sets of one kind, one of `SAMPLERS`. `seed` is any whole number."""

    kind: str
    seed: int

    def draw(
        self, stream: int, total: int, receiver: np.ndarray, index: np.ndarray, dimensions: int, rng: np.random.Generator
    ) -> np.ndarray:
        """(dimensions, n) float32 in 0..1, below 1: point `index` (n,) of the set of `total` points of each `receiver` (n,).

        Independent numbers and the place inside a jittered cell come from `rng`.
        """
        n = len(receiver)
        if self.kind == "independent" or n == 0:
            return rng.random((dimensions, n), np.float32)
        # One number for each receiver and stream, from which all else is hashed.
        stem = hashed(receiver.astype(U) ^ U(self.seed & 0xFFFFFFFF))
        stem = hashed(stem + _spread(stream + 1))
        out = np.empty((dimensions, n), np.float32)
        step = DIMENSIONS if self.kind == "sobol" else 2
        for first in range(0, dimensions, step):
            part = out[first : first + step]
            # Every block of dimensions has an order of its own.
            cells = total if self.kind == "sobol" or len(part) == 1 else math.prod(grid(total))
            order = shuffled(index.astype(U), cells, hashed(stem + _spread(1000 + first)))
            if self.kind == "sobol":
                points = sobol_at(order, len(part))
                for d in range(len(part)):
                    points[d] ^= hashed(stem + _spread(2000 + first + d))
                # 24 bits: what float32 holds without rounding up to 1.
                part[:] = (points >> U(8)).astype(np.float32) * np.float32(2**-24)
            else:
                part[:] = _jittered(order, total, len(part), rng)
        return out


def _spread(number: int) -> np.uint32:
    """A constant for each small number, far from the others."""
    return U(number * 0x9E3779B9 & 0xFFFFFFFF)


def grid(total: int) -> tuple[int, int]:
    """Columns and rows of a nearly square grid of at least `total` cells, and as few more as may be."""
    root = math.isqrt(total - 1) + 1
    sizes = [(a, -(-total // a)) for a in range((root + 1) // 2, root + 1)]
    return min(sizes, key=lambda s: (s[0] * s[1], s[1] - s[0]))


def _jittered(order: np.ndarray, total: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """(dimensions, n): a random point in cell `order` (n,) of a grid, or of a row of cells in one dimension."""
    u = rng.random((dimensions, len(order)), np.float32)
    if dimensions == 1:
        cells = [(order, total)]
    else:
        columns, rows = grid(total)
        cells = [(order % U(columns), columns), (order // U(columns), rows)]
    out = np.stack([(cell + x) * np.float32(1 / many) for x, (cell, many) in zip(u, cells, strict=True)])
    return np.minimum(out, ONE_BELOW)


def shuffled(index: np.ndarray, total: int, key: np.ndarray) -> np.ndarray:
    """(n,) uint32: where `index` (n,) uint32 < total stands in a random order of 0..total - 1 that `key` (n,) uint32 chooses.

    Kensler 2013: a hash that can be undone maps the numbers below a power of two to each other; it is applied again until the
    result lies below `total`. Twice with two keys, as one round knows only some hundred orders of few numbers.
    """
    if total == 1:
        return np.zeros_like(index)
    mask = U((1 << (total - 1).bit_length()) - 1)
    out = index
    for k in (key, hashed(key + _spread(1))):
        out = out.copy()
        todo = np.arange(len(index))
        while len(todo):
            out[todo] = _mixed(out[todo], k[todo], mask)
            todo = todo[out[todo] >= total]
        out = (out + k % U(total)) % U(total)
    return out


def _mixed(i: np.ndarray, p: np.ndarray, w: np.uint32) -> np.ndarray:
    """One round of Kensler's hash of i (n,) below w + 1, a power of two, keyed by p (n,)."""
    i = i ^ p
    i *= U(0xE170893D)
    i ^= p >> U(16)
    i ^= (i & w) >> U(4)
    i ^= p >> U(8)
    i *= U(0x0929EB3F)
    i ^= p >> U(23)
    i ^= (i & w) >> U(1)
    i *= U(1) | (p >> U(27))
    i *= U(0x6935FA69)
    i ^= (i & w) >> U(11)
    i *= U(0x74DCB303)
    i ^= (i & w) >> U(2)
    i *= U(0x9E501CC3)
    i ^= (i & w) >> U(2)
    i *= U(0xC860A3DF)
    i &= w
    return i ^ (i >> U(5))
