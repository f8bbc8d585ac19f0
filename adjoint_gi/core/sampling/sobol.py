"""Sobol points, shifted digitally for every receiver: each point is uniform, so estimates stay unbiased, and error falls faster.

Direction numbers of Joe and Kuo 2008 (new-joe-kuo-6). A random XOR of a (t, m, s)-net keeps it a net (Owen 1995, Kollig and
Keller 2002); the XOR of a receiver and dimension is a hash, so the k-th point of a receiver does not depend on batches or threads.

Only the first two or three dimensions are even from a few points on: four points of dimensions 4 and 5 may lie in two quadrants. So each
use of random numbers (a direction, a place on a light) has the first ones, in an order of its own (Burley 2020, padding).

B. Burley, "Practical Hash-based Owen Scrambling", Journal of Computer Graphics Techniques 9(4), 2020, 1-20.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Degree, coefficients and initial numbers of the primitive polynomial of each dimension after the first.
_JOE_KUO = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
    (5, 4, (1, 1, 5, 5, 5)),
    (5, 7, (1, 1, 7, 11, 19)),
    (5, 11, (1, 1, 5, 1, 1)),
    (5, 13, (1, 1, 1, 3, 11)),
    (5, 14, (1, 3, 5, 5, 31)),
    (6, 1, (1, 3, 3, 9, 7, 49)),
    (6, 13, (1, 1, 1, 15, 21, 21)),
    (6, 16, (1, 3, 1, 13, 27, 49)),
    (6, 19, (1, 1, 1, 15, 7, 5)),
    (6, 22, (1, 3, 1, 15, 13, 25)),
)
DIMENSIONS = len(_JOE_KUO) + 1


def _directions() -> np.ndarray:
    """(DIMENSIONS, 32) uint32 direction numbers, the first bit at the top."""
    out = np.zeros((DIMENSIONS, 32), np.uint64)
    out[0] = 1 << np.arange(31, -1, -1, dtype=np.uint64)
    for d, (degree, a, initial) in enumerate(_JOE_KUO, start=1):
        v = [m << (31 - i) for i, m in enumerate(initial)]
        for i in range(degree, 32):
            x = v[i - degree] ^ (v[i - degree] >> degree)
            for k in range(1, degree):
                if (a >> (degree - 1 - k)) & 1:
                    x ^= v[i - k]
            v.append(x)
        out[d] = v
    return out.astype(np.uint32)


_DIRECTIONS = _directions()


def sobol_at(index: np.ndarray, dimensions: int) -> np.ndarray:
    """(dimensions, n) uint32: the points `index` (n,) uint32 of the Sobol sequence; divide by 2^32."""
    out = np.zeros((dimensions, len(index)), np.uint32)
    for bit in range(int(index.max(initial=1)).bit_length()):
        odd = (index >> np.uint32(bit)) & np.uint32(1)
        out ^= _DIRECTIONS[:dimensions, bit, None] * odd
    return out


def hashed(key: np.ndarray) -> np.ndarray:
    """uint32 numbers mixed to look random, in place (Wellons' lowbias32)."""
    key ^= key >> np.uint32(16)
    key *= np.uint32(0x7FEB352D)
    key ^= key >> np.uint32(15)
    key *= np.uint32(0x846CA68B)
    key ^= key >> np.uint32(16)
    return key


def reordered(index: np.ndarray, key: int) -> np.ndarray:
    """(n,) uint32 places of `index` (n,) uint32 in an order by `key`, in which every block of 2^k numbers that begins at a multiple of 2^k
    stays such a block (Owen's scrambling of the bits of the number; hash of Laine and Karras as Burley has it)."""
    x = _reversed(index) + np.uint32(key)
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * np.uint32(factor)
    return _reversed(x)


def _reversed(x: np.ndarray) -> np.ndarray:
    """uint32 numbers with their bits in reverse."""
    x = (x >> np.uint32(16)) | (x << np.uint32(16))
    for step, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = ((x >> np.uint32(step)) & np.uint32(mask)) | ((x & np.uint32(mask)) << np.uint32(step))
    return x


def shifted(receiver: np.ndarray, first: int, count: int, uses: Sequence[int], seed: int) -> np.ndarray:
    """(sum of `uses`, m * count) float32 in 0..1: points `first` to `first + count` of each of the receivers (m,), receiver by receiver.

    uses: how many numbers each use takes, which are even together.
    """
    dimensions = sum(uses)
    key = hashed(receiver.astype(np.uint32) ^ np.uint32(seed & 0xFFFFFFFF))
    dimension = (np.arange(1, dimensions + 1, dtype=np.uint64) * 0x9E3779B9 & 0xFFFFFFFF).astype(np.uint32)
    shift = hashed(key[None, :] + dimension[:, None])
    index = np.arange(first, first + count, dtype=np.uint32)
    orders = hashed(np.arange(1, len(uses) + 1, dtype=np.uint32))
    points = np.concatenate([sobol_at(reordered(index, order), many) for order, many in zip(orders, uses, strict=True)])
    points = points[:, None, :] ^ shift[:, :, None]
    # 24 bits: what float32 holds without rounding up to 1.
    return ((points >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)).reshape(dimensions, -1)
