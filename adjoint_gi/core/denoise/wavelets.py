"""A denoiser of our own for texels, pixels and vertices: an edge-avoiding a-trous filter that knows the noise.

Each level takes for every receiver the mean over its neighbours, each with the weight

    w = h  max(0, n_i . n_j)^64  exp(-|n_i . (x_j - x_i)| / d)  exp(-|v_i - v_j| / (4 s_i))

of the kernel h, the normals n, the distance d of neighbours on that level, and of the values v by their standard errors s, which the
filter takes along. Where there is no noise, s is 0 and nothing changes.

H. Dammertz et al., Edge-Avoiding A-Trous Wavelet Transform for Fast Global Illumination Filtering, High Performance Graphics 2010;
C. Schied et al., Spatiotemporal Variance-Guided Filtering, High Performance Graphics 2017 (weights by variance, Eq. 4 and 5).
"""

from __future__ import annotations

import numpy as np

from .ground import Ground

FACING = 64.0  # exponent of the cosine between two normals
CLEAR = 4.0  # standard errors that a difference of values may have
DARK = 0.02  # albedo below which texture is not divided out
SHARE = 1e-5  # of the mean value, below which nothing counts as a difference


def smoothed(values: np.ndarray, error: np.ndarray, ground: Ground, valid: np.ndarray) -> np.ndarray:
    """(n, 3) float32 `values` without noise. error (n,) standard errors of the channels' sum, of which inf is one that is not known;
    valid (n,) bool: receivers that have a value."""
    # Textures that are seen are divided out, so that they stay as sharp as they are.
    albedo = np.maximum(ground.albedo, DARK)
    values, error = values / albedo.astype(np.float64), error / albedo.mean(axis=1)
    variance = spread_out(known_error(values, error, ground, valid) ** 2, ground, valid)
    for level in range(ground.neighbours.levels):
        values, variance = _level(values, variance, ground, valid, level)
    return (values * albedo).astype(np.float32)


def spread_out(values: np.ndarray, ground: Ground, valid: np.ndarray, levels: int = 1) -> np.ndarray:
    """(n,) float64 means of `values` (n,) over each receiver and those around it, in its piece, ever farther with more `levels`."""
    total, many = np.where(valid, values, 0.0).astype(np.float64), valid.astype(np.float64)
    for level in range(levels):
        values, weights = total.copy(), many.copy()
        for i, j, weight in ground.neighbours.pairs(level):
            total += np.bincount(i, weight * values[j], len(values))
            many += np.bincount(i, weight * weights[j], len(values))
    return total / np.maximum(many, 1e-12)


def known_error(values: np.ndarray, error: np.ndarray, ground: Ground, valid: np.ndarray) -> np.ndarray:
    """(n,) `error` with an estimate where it is not known: how far a value of `values` (n, 3) is from the mean over its surroundings."""
    if np.isfinite(error[valid]).all():
        return np.where(valid, error, 0)
    value = values.sum(axis=1, dtype=np.float64)
    around = np.abs(value - spread_out(value, ground, valid)) * 1.25
    return np.where(valid, np.where(np.isfinite(error), error, around), 0)


def _level(values: np.ndarray, variance: np.ndarray, ground: Ground, valid: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Values and variances after one level."""
    n, value = len(values), values.sum(axis=1)
    noise = np.sqrt(spread_out(variance, ground, valid)) * CLEAR + SHARE * max(float(np.abs(value[valid]).mean()), 1e-30)
    reach = np.maximum(ground.size * ground.neighbours.distance(level), 1e-12)
    total, spread, many = values * valid[:, None], variance * valid, valid.astype(np.float64)
    for i, j, h in ground.neighbours.pairs(level):
        facing = np.einsum("ij,ij->i", ground.normal[i], ground.normal[j]).clip(0, 1) ** FACING
        off = np.abs(np.einsum("ij,ij->i", ground.normal[i], ground.position[j] - ground.position[i])) / reach[i]
        w = h * facing * np.exp(-off - np.abs(value[i] - value[j]) / noise[i]) * valid[j]
        many += np.bincount(i, w, n)
        spread += np.bincount(i, w * w * variance[j], n)
        for c in range(3):
            total[:, c] += np.bincount(i, w * values[j, c], n)
    many = np.maximum(many, 1e-12)
    return total / many[:, None], spread / many**2
