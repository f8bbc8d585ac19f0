"""Additive sequences: even sets of any number of points, the fractional parts of multiples of fixed steps.

In one dimension the step is the golden ratio's; in d dimensions the steps are the powers 1 / x, 1 / x^2, ... of the root of
x^(d + 1) = x + 1 (M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018).
"""

from __future__ import annotations

import numpy as np

STEPS = {
    1: np.array([0.6180339887498949]),
    2: np.array([0.7548776662466927, 0.5698402909980532]),
    3: 1.2207440846057596 ** -np.arange(1, 4),
    4: 1.1673039782614187 ** -np.arange(1, 5),
    5: np.array([1.1347241384015194**-k for k in range(1, 6)]),
}


def additive(number: np.ndarray | int, steps: np.ndarray, *shifts: np.ndarray | float) -> np.ndarray:
    """(d, n) float64 in 0..1: points `number`, (n,) or one, of the sequence with `steps` (d,), one of `STEPS`, moved by `shifts` modulo 1.

    A shift is a number, (d, 1) for all points, or (d, n).
    """
    x = number * steps[:, None]
    for shift in shifts:
        x = x + shift
    return x - np.floor(x)


BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))


def going_on(start: np.ndarray, number: int) -> np.ndarray:
    """(d, n) float32 in 0..1, 1 left out: point `number` of n sequences that begin at `start` (d, n), each at a random point of its own.

    Every point is as random as the first (Cranley and Patterson 1976), and the points of one sequence lie evenly.
    """
    return np.minimum(additive(number, STEPS[len(start)], start).astype(np.float32), BELOW_ONE)
