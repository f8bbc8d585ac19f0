"""The beam of a spot whose object is scaled unevenly: solid angle, and directions drawn from it, at the same cost for every scale.

A direction w lies in the beam by s = cos(angle to the axis) of (x / a, y / b, z), and its intensity is the spot's `falloff` at s. The
falloff rises from 0 to 1, so it is a mixture of beams with hard edges, {w: s(w) >= e}, with weights f'(e) de. Of the azimuth phi such
a beam holds 1 - C(phi), C the cosine of its rim. That is D / (1 + C) with D = sin^2 of the rim, and D has a closed form:

    D = (1 - e^2) / (e^2 k^2 + 1 - e^2),   k^2 = cos^2 phi / a^2 + sin^2 phi / b^2
    integral of D over phi = 2 pi (1 - e^2) a b / sqrt((e^2 + (1 - e^2) a^2) (e^2 + (1 - e^2) b^2))

and phi with density D is the argument of an ellipse. What is left, 1 / (1 + C), lies between 1/2 and 1 whatever the scale.
"""

from __future__ import annotations

import math

import numpy as np

from .outgoing import reject

STEPS = 96  # cells of the falloff, even ones and ones that narrow towards both ends of the cosine
LEAST_COSINE = 1e-9


class EllipticCone:
    """Directions w about +z with density proportional to the falloff between cosines `edge` and `inner` of a cone scaled by (a, b)."""

    def __init__(self, scale: tuple[float, float], edge: float, inner: float) -> None:
        """`inner` = `edge` is a hard edge."""
        self.a, self.b = scale
        self.edge, self.inner = edge, inner
        # Cells of e, each with a bound of f' times the integral of D, which falls with e.
        even = edge + (inner - edge) * np.linspace(0, 1, STEPS + 1)
        low = np.geomspace(LEAST_COSINE, 0.5, 2 * STEPS)
        self._cells = np.unique(np.clip(np.concatenate([even, low, 1 - low]), edge, inner))
        slope = np.maximum(self._slope(self._cells[:-1]), self._slope(self._cells[1:]))
        middle = 0.5 * (edge + inner)
        slope[(self._cells[:-1] < middle) & (self._cells[1:] > middle)] = self._slope(np.array([middle]))[0]
        self._bound = slope * self._around(self._cells[:-1])
        self._cumulative = np.cumsum(self._bound * np.diff(self._cells))

    def solid(self) -> float:
        """Solid angle weighted by the falloff, sr."""
        if self.inner <= self.edge:
            return float(self._hard(np.array([self.edge]))[0])
        x, w = np.polynomial.legendre.leggauss(4)
        low, width = self._cells[:-1, None], np.diff(self._cells)[:, None]
        e = (low + width * (x + 1) / 2).ravel()
        return float(self._slope(e) * self._hard(e) @ (width * w / 2).ravel())

    def directions(self, square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n, 3) float64 unit directions from points `square` (n, 2)."""
        rows = np.concatenate([self._edges(len(square), rng)[:, None], square], axis=1)

        def keep(rows: np.ndarray) -> np.ndarray:
            return self._falls(rows[:, 0]) / (1 + self._rim(rows[:, 0], self._azimuth(rows[:, 0], rows[:, 1])))

        def propose(many: int) -> np.ndarray:
            return np.concatenate([self._edges(many, rng)[:, None], rng.random((many, 2))], axis=1)

        reject(rows, keep, propose, rng)
        e, s, t = rows.T
        phi = self._azimuth(e, s)
        # The cosine is uniform between the rim's and 1; 1 minus the rim's is D / (1 + C), exact for narrow beams.
        h = t * self._square(e, phi) / (1 + self._rim(e, phi))
        r = np.sqrt(h * (2 - h))
        return np.stack([r * np.cos(phi), r * np.sin(phi), 1 - h], axis=1)

    # ---- hard beams of edge e

    def _edges(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """(n,) edges with density proportional to the bounds of the cells."""
        if self.inner <= self.edge:
            return np.full(n, self.edge)
        cell = np.searchsorted(self._cumulative, rng.random(n) * self._cumulative[-1], side="right")
        cell = np.minimum(cell, len(self._bound) - 1)
        return self._cells[cell] + rng.random(n) * np.diff(self._cells)[cell]

    def _falls(self, e: np.ndarray) -> np.ndarray | float:
        """(n,) share of the cell's bound that f' times the integral of D has at `e`."""
        if self.inner <= self.edge:
            return 1.0
        cell = np.clip(np.searchsorted(self._cells, e, side="right") - 1, 0, len(self._bound) - 1)
        return self._slope(e) * self._around(e) / np.maximum(self._bound[cell], 1e-300)

    def _slope(self, e: np.ndarray) -> np.ndarray:
        """f' of the smooth step."""
        width = max(self.inner - self.edge, 1e-300)
        t = np.clip((e - self.edge) / width, 0, 1)
        return 6 * t * (1 - t) / width

    def _around(self, e: np.ndarray) -> np.ndarray:
        """Integral of D over the azimuth."""
        e2 = e * e
        return 2 * math.pi * (1 - e2) * self.a * self.b / np.sqrt((e2 + (1 - e2) * self.a**2) * (e2 + (1 - e2) * self.b**2))

    def _azimuth(self, e: np.ndarray, s: np.ndarray) -> np.ndarray:
        """(n,) azimuths with density proportional to D, from random numbers `s`."""
        e2, psi = e * e, 2 * math.pi * s
        x = np.cos(psi) * self.a * np.sqrt(e2 + (1 - e2) * self.b**2)
        y = np.sin(psi) * self.b * np.sqrt(e2 + (1 - e2) * self.a**2)
        return np.arctan2(y, x)

    def _square(self, e: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """D: the squared sine of the rim at `phi`."""
        k2 = (np.cos(phi) / self.a) ** 2 + (np.sin(phi) / self.b) ** 2
        return (1 - e * e) / (e * e * k2 + 1 - e * e)

    def _rim(self, e: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """C: the cosine of the rim at `phi`."""
        return np.sqrt(np.maximum(1 - self._square(e, phi), 0))

    def _hard(self, e: np.ndarray) -> np.ndarray:
        """Solid angles of hard beams: the integral of D times the mean of 1 / (1 + C) over azimuths drawn by D."""
        # Tanh-sinh in a quarter of the ellipse, as C may turn within a thousandth of it at either end.
        k = np.linspace(-3.4, 3.4, 129)
        s = 0.125 * (1 + np.tanh(0.5 * math.pi * np.sinh(k)))
        w = np.cosh(k) / np.cosh(0.5 * math.pi * np.sinh(k)) ** 2
        value = 1 / (1 + self._rim(e[:, None], self._azimuth(e[:, None], s)))
        return self._around(e) * (value @ w) / w.sum()
