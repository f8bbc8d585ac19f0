"""Real spherical harmonics, and the half of them that is even in z as a basis of functions over a hemisphere.

Y_lm is orthonormal over the sphere; index l^2 + l + m; no Condon-Shortley sign. Those with l + m even are even in z: times sqrt(2) they are
orthonormal over the upper hemisphere and complete there, so a radiance that is known on one side only needs (l + 1)(l + 2) / 2 of them,
and is taken as mirrored to the other side (Sillion, Arvo, Westin and Greenberg 1991; Ramamoorthi and Hanrahan 2001 for the cosine).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .pairs import Pairs

MAX_ORDER = 8


def real_harmonics(order: int, w: np.ndarray) -> np.ndarray:
    """(n, (order + 1)^2) float64: all Y_lm up to l = `order` in unit directions `w` (n, 3)."""
    x, y, z = (np.asarray(w[:, i], np.float64) for i in range(3))
    out = np.empty((len(x), (order + 1) ** 2))
    # cos(m phi) sin^m and sin(m phi) sin^m are polynomials in x and y; the rest of P_lm is one in z.
    c, s = np.ones_like(x), np.zeros_like(x)
    first = np.sqrt(0.25 / np.pi)
    for m in range(order + 1):
        before, p = np.zeros_like(z), np.full_like(z, first)
        scale = np.sqrt(2.0) if m else 1.0
        for l in range(m, order + 1):  # noqa: E741 - l is its name everywhere
            if l > m:
                a = np.sqrt((4 * l * l - 1) / (l * l - m * m))
                b = np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) if l > m + 1 else 0.0
                before, p = p, a * (z * p - b * before)
            out[:, l * l + l + m] = scale * p * c
            if m:
                out[:, l * l + l - m] = scale * p * s
        c, s = x * c - y * s, y * c + x * s
        first *= np.sqrt((2 * m + 3) / (2 * m + 2))
    return out


def sphere_quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and weights (n,) that integrate polynomials up to `degree` exactly over the sphere."""
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    return _rings(z, weight, degree + 1)


def hemisphere_quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """The same over the upper hemisphere, for polynomials that are even in x and y together at every power of z."""
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    return _rings(0.5 * (z + 1), 0.5 * weight, degree + 1)


def _rings(z: np.ndarray, weight: np.ndarray, many: int) -> tuple[np.ndarray, np.ndarray]:
    phi = 2 * np.pi * (np.arange(many) + 0.5) / many
    r = np.sqrt(1 - z * z)
    w = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(z[:, None], many, axis=1)], axis=2)
    return w.reshape(-1, 3), np.repeat(weight * 2 * np.pi / many, many)


def rotation(order: int, matrix: np.ndarray) -> np.ndarray:
    """((order + 1)^2, (order + 1)^2) matrix that turns coefficients with the rotation `matrix` (3, 3): (D f)(w) = f(matrix^T w)."""
    w, weight = sphere_quadrature(2 * order)
    out = (real_harmonics(order, w) * weight[:, None]).T @ real_harmonics(order, w @ np.asarray(matrix, np.float64))
    band = bands(order)
    return np.where(band[:, None] == band, out, 0.0)


def bands(order: int) -> np.ndarray:
    """((order + 1)^2,) the l of every coefficient."""
    return np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)


class HemisphereHarmonics:
    """The harmonics up to `order` with l + m even, times sqrt(2): h_a, orthonormal over the hemisphere of a side's frame.

    Functions are projected under the cosine: c = G^-1 int f h cos, G = int h h cos. So the flux that a radiance carries is kept
    exactly, whatever the order. `window` (0..1) damps the high orders of what lobes reflect, without changing its flux.
    l, m (size,) of every coefficient; flux (size,): radiant exitance pi mean L cos of a radiance with coefficients c is flux @ c.
    """

    def __init__(self, order: int, window: float = 0.0) -> None:
        l = bands(order)  # noqa: E741
        m = np.arange((order + 1) ** 2) - l * l - l
        self.order = order
        self.index = np.flatnonzero((l + m) % 2 == 0)
        self.l, self.m = l[self.index], m[self.index]
        self.size = len(self.index)
        self.unit = 1 / np.pi  # what arrives comes as moments of flux
        w, weight = hemisphere_quadrature(2 * order + 2)
        h = self.values(w)
        self.gram = h.T @ (h * (weight * w[:, 2])[:, None])
        self.gram[self.m[:, None] != self.m] = 0.0
        self.inverse = np.linalg.inv(self.gram)
        self.flux = self.gram @ self.constant()
        self._window = self._damping(order, window)

    def _damping(self, order: int, window: float) -> np.ndarray:
        """(size, size): band l times Lanczos's sinc(l / (order + 1)) to the power `window`; the flux that this takes goes into l = 0."""
        keep = np.diag(np.sinc(self.l / (order + 1)) ** window)
        unit = self.constant()
        return keep + np.outer(unit, self.flux @ (np.eye(self.size) - keep)) / (self.flux @ unit)

    def values(self, w: np.ndarray) -> np.ndarray:
        """(n, size) float64: h_a in directions `w` (n, 3) of a side's frame."""
        return np.sqrt(2.0) * real_harmonics(self.order, w)[:, self.index]

    def basis(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All coefficients, and their weights (n, size)."""
        return np.broadcast_to(np.arange(self.size), (len(w), self.size)), self.values(w)

    def constant(self, value: float = 1.0) -> np.ndarray:
        """(size,) coefficients of the radiance `value` in every direction."""
        out = np.zeros(self.size)
        out[0] = value * np.sqrt(2 * np.pi)
        return out

    def irradiance(self, arriving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of light that arrives, moments (n, size, 3)."""
        return np.sqrt(2 * np.pi) * arriving[:, 0]

    def exitance(self, leaving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of radiance that leaves, coefficients (n, size, 3)."""
        return np.einsum("a,nac->nc", self.flux, leaving)

    def add(self, field: np.ndarray, side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
        """Add to the moments `field` (n, size, 3) light that arrives on sides (m,) along `w` (m, 3) and adds `value` (m, 3) W m-2 to the
        irradiance."""
        first = int(side.min(initial=0))
        h = self.values(w)
        for c in range(3):
            for a in range(self.size):
                sums = np.bincount(side - first, value[:, c] * h[:, a])
                field[first : first + len(sums), a, c] += sums

    def dimming(self, curve: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """(size,) coefficients of `curve(cosine)`."""
        w, weight = hemisphere_quadrature(64)
        values = self.values(w) * (weight * w[:, 2] * np.asarray(curve(w[:, 2]), np.float64))[:, None]
        return self.inverse @ np.where(self.m == 0, values.sum(axis=0), 0.0)

    def kernels(self, sides: Sequence[Pairs], measure: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Matrices (2, size, size) that take moments sum of flux h_b(wi), per area, to coefficients of the radiance that leaves.

        same: on the side where it arrives; other: from the side beyond, or None. They carry flux, for which no `measure` is needed.
        """
        same, other = np.zeros((2, self.size, self.size)), np.zeros((2, self.size, self.size))
        for side, pairs in enumerate(sides):
            for through, target, at in ((False, same, side), (True, other, 1 - side)):
                which = np.flatnonzero((pairs.through == through) & (pairs.weight > 0))
                if len(which):
                    out = self.values(pairs.other[which]) * (np.pi / len(pairs.weight) * pairs.weight[which])[:, None]
                    projected = self._isotropic(out.T @ self.values(pairs.given[which]), not through)
                    target[at] = self._window @ self.inverse @ projected @ self.inverse
        return same, other if other.any() else None

    def _isotropic(self, matrix: np.ndarray, reciprocal: bool) -> np.ndarray:
        """The part that does not change when both directions are turned about the normal or mirrored: blocks of equal m."""
        matrix = np.where(self.m[:, None] == self.m, matrix, 0.0)
        flip = np.lexsort((-self.m, self.l))  # position of (l, -m)
        matrix = 0.5 * (matrix + matrix[np.ix_(flip, flip)])
        return 0.5 * (matrix + matrix.T) if reciprocal else matrix


def harmonic_count(order: int) -> int:
    """Coefficients of a hemisphere up to `order`."""
    return (order + 1) * (order + 2) // 2
