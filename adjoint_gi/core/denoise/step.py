"""Denoising as a step between solving and writing: what is noisy of a solution is smoothed, what is not stays as it is.

Direct and indirect light are smoothed apart, so their sum stays the whole, and shadows without noise stay crisp. A denoiser is any
function of a `NoisyLight`; the mean of every piece of the surface is kept, whatever it does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..method.registry import MethodSpec, Nature
from ..method.solution import Solution
from .ground import Ground
from .wavelets import known_error, smoothed, spread_out

PARTS = ("direct", "indirect")
CLEAN, NOISY = 0.005, 0.02  # relative standard errors between which a receiver's own value gives way to the smoothed one

AROUND = 3  # levels over which noise is averaged: some seven receivers to each side
NEAR = 2  # levels over which noise is compared with what smoothing changes: some three receivers to each side


@dataclass(frozen=True, eq=False)
class NoisyLight:
    """Light to be smoothed: values (n, 3) float32, error (n,) their standard errors (`Film.errors`), valid (n,) bool."""

    name: str
    values: np.ndarray
    error: np.ndarray
    valid: np.ndarray


# Gives the smoothed values (n, 3) of every layer.
Denoiser = Callable[[Sequence[NoisyLight]], list[np.ndarray]]


def can_denoise(spec: MethodSpec) -> bool:
    """Whether results of the method have noise."""
    return Nature.NONDETERMINISTIC in spec.natures


def own_denoiser(ground: Ground) -> Denoiser:
    """The filter of `wavelets`."""
    return lambda layers: [smoothed(layer.values, layer.error, ground, layer.valid) for layer in layers]


def denoised(solution: Solution, ground: Ground, denoiser: Denoiser) -> Solution:
    """`solution` with its noisy parts smoothed; the same object where there is nothing to do."""
    valid = solution.weight > 0
    unknown = np.full(len(valid), np.inf, np.float32)
    layers = [NoisyLight(name, getattr(solution, name), solution.extra.get(f"{name}_error", unknown), valid) for name in PARTS]
    shares = [noisy_share(layer, ground) for layer in layers]
    noisy = [k for k, share in enumerate(shares) if share.any()]
    if not noisy:
        return solution
    found = denoiser([layers[k] for k in noisy])
    parts = {}
    for k, smooth in zip(noisy, found, strict=True):
        parts[layers[k].name] = merged(layers[k], smooth, shares[k] * trusted(layers[k], smooth, ground), ground)
    return replace(solution, **parts)


def noisy_share(layer: NoisyLight, ground: Ground) -> np.ndarray:
    """(n,) float64 in 0..1: how much of the smoothed value each receiver gets, by the noise around it; 0 where there is no value.

    Of indirect light, which has no sharp edges, all get as much as their piece has noise: it comes from few bright samples, and where
    none has come by chance nothing tells of it.
    """
    error = known_error(layer.values, layer.error, ground, layer.valid)
    # Few groups of samples tell little of the noise of one receiver: where they agree by chance it would stay as it is, as a spot.
    value = spread_out(layer.values.sum(axis=1, dtype=np.float64), ground, layer.valid, AROUND)
    around = np.sqrt(spread_out(error**2, ground, layer.valid, AROUND))
    if layer.name == "indirect":
        value, around = _of_pieces(value, layer, ground), np.sqrt(_of_pieces(around**2, layer, ground))
    relative = around / np.maximum(value, 1e-30)
    share = np.clip((relative - CLEAN) / (NOISY - CLEAN), 0, 1)
    return np.where(layer.valid & (value > 0), share, 0)


def trusted(layer: NoisyLight, smooth: np.ndarray, ground: Ground) -> np.ndarray:
    """(n,) float64 in 0..1: the share of `smooth` (n, 3) that makes the error least.

    Values have a variance V and no bias, smoothed ones a bias b and hardly a variance: the error of w smooth + (1 - w) values is least for
    w = V / (V + b^2), and what smoothing changes is V + b^2 in the mean. So edges of shadows give way only as far as they are noise, and
    with more samples the result converges. Of indirect light, of whose variance a receiver's few bright samples tell little, all in a
    piece get the same share.
    """
    error = known_error(layer.values, layer.error, ground, layer.valid)
    changed = (smooth - layer.values).sum(axis=1, dtype=np.float64)
    if layer.name == "indirect":
        variance, change = (_of_pieces(x**2, layer, ground) for x in (error, changed))
    else:
        variance, change = (spread_out(x**2, ground, layer.valid, NEAR) for x in (error, changed))
    return np.where(change > variance, variance / np.maximum(change, 1e-300), 1.0)


def _of_pieces(values: np.ndarray, layer: NoisyLight, ground: Ground) -> np.ndarray:
    """(n,) float64 means of `values` (n,) over the valid receivers of each piece."""
    many = int(ground.piece.max(initial=0)) + 1
    sums, counts = np.bincount(ground.piece, values * layer.valid, many), np.bincount(ground.piece, layer.valid, many)
    return (sums / np.maximum(counts, 1))[ground.piece]


def merged(layer: NoisyLight, smooth: np.ndarray, share: np.ndarray, ground: Ground) -> np.ndarray:
    """(n, 3) float32: the values with their `share` (n,) of `smooth`, scaled so that every piece keeps its mean in each channel."""
    out = np.array(layer.values, np.float64)
    many = int(ground.piece.max(initial=0)) + 1
    for c in range(3):
        was, now = share * layer.values[:, c], share * np.maximum(smooth[:, c], 0)
        before, after = (np.bincount(ground.piece, x, many) for x in (was, now))
        # Where nothing is left to scale, as of a single bright texel, the values stay.
        keeps = after <= 1e-3 * before
        gain = np.where(keeps, 0, before / np.maximum(after, 1e-300))[ground.piece]
        out[:, c] += np.where(keeps[ground.piece], 0, now * gain - was)
    return out.astype(np.float32)
