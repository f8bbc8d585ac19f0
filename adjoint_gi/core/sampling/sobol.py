"""Sobol points, shifted digitally for every receiver: each point is uniform, so estimates stay unbiased, and error falls faster.

Direction numbers of Joe and Kuo 2008 (new-joe-kuo-6). A random XOR of a (t, m, s)-net keeps it a net (Owen 1995, Kollig and
Keller 2002); the XOR of a receiver and dimension is a hash, so the k-th point of a receiver does not depend on batches or threads.
"""

from __future__ import annotations

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


def sobol(first: int, count: int, dimensions: int) -> np.ndarray:
    """(dimensions, count) uint32: points `first` to `first + count` of the Sobol sequence; divide by 2^32."""
    return sobol_at(np.arange(first, first + count, dtype=np.uint32), dimensions)


def sobol_at(index: np.ndarray, dimensions: int) -> np.ndarray:
    """(dimensions, n) uint32: the points `index` (n,) uint32 of the Sobol sequence."""
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


def shifted(receiver: np.ndarray, first: int, count: int, dimensions: int, seed: int) -> np.ndarray:
    """(dimensions, m * count) float32 in 0..1: points `first` to `first + count` of each of the receivers (m,), receiver by receiver."""
    key = hashed(receiver.astype(np.uint32) ^ np.uint32(seed & 0xFFFFFFFF))
    dimension = (np.arange(1, dimensions + 1, dtype=np.uint64) * 0x9E3779B9 & 0xFFFFFFFF).astype(np.uint32)
    shift = hashed(key[None, :] + dimension[:, None])
    points = sobol(first, count, dimensions)[:, None, :] ^ shift[:, :, None]
    # 24 bits: what float32 holds without rounding up to 1.
    return ((points >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)).reshape(dimensions, -1)
