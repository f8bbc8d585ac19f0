"""Real spherical harmonics, and the half of them that is even in z as a basis of functions over a hemisphere.

Y_lm is orthonormal over the sphere; index l^2 + l + m; no Condon-Shortley sign. Those with l + m even are even in z: times sqrt(2) they are
orthonormal over the upper hemisphere and complete there, so a radiance that is known on one side only needs (l + 1)(l + 2) / 2 of them,
and is taken as mirrored to the other side (Sillion, Arvo, Westin and Greenberg 1991; Ramamoorthi and Hanrahan 2001 for the cosine).

On the inside of glass radiance ends at the critical angle: what has come in lies within it, what lies beyond is reflected totally.
Harmonics over the whole hemisphere swing across that edge, so that light leaks over it and stays inside, and the more the higher the order
(16 % of a pane's light at order 4). `HemisphereHarmonics.on` keeps the two apart: on such a side one set of harmonics describes what lies
within the critical angle and one what lies beyond, each over its own hemisphere, to which sin^2 theta is stretched. Within, that is
refraction's own map (sin theta_outside = n sin theta_inside), and both maps keep projected solid angle up to a constant.

How much a surface of glass passes is no even function of the cosine, which is all that these harmonics with m = 0 can be: they gave 6 % too
little at the normal at order 4. So what arrives there is kept by three odd powers of the cosine besides, as far as they differ from the
harmonics; with them Fresnel's equations are met to 0.5 % from order 4 on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import numpy as np

from .pairs import Pairs

MAX_ORDER = 8
ODD = np.array([1, 3, 5])  # powers of the cosine that what arrives on glass is kept by besides


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
    l, m (half,) of every coefficient; flux (half,): radiant exitance pi mean L cos of a radiance with coefficients c is flux @ c.

    cut (n,) of all sides: sin^2 of the critical angle, 1 where there is none; None: there is none anywhere. Then `size`, the coefficients
    of a side, is `half`; else it is twice that: those within the critical angle (or all), and those beyond (or nothing). heard: moments of
    what arrives on a side, which are `size`, and where anything is cut three more for either part.
    """

    def __init__(self, order: int, window: float = 0.0) -> None:
        l = bands(order)  # noqa: E741
        m = np.arange((order + 1) ** 2) - l * l - l
        self.order = order
        self.index = np.flatnonzero((l + m) % 2 == 0)
        self.l, self.m = l[self.index], m[self.index]
        self.size = self.half = self.heard = len(self.index)
        self.cut: np.ndarray | None = None
        w, weight = hemisphere_quadrature(2 * order + 2)
        h = self.values(w)
        self.gram = h.T @ (h * (weight * w[:, 2])[:, None])
        self.gram[self.m[:, None] != self.m] = 0.0
        self.inverse = np.linalg.inv(self.gram)
        self.flux = self.gram @ self.constant()
        self._window = self._damping(order, window)
        self._odd_made = self._orthonormal_odd()

    def _orthonormal_odd(self) -> tuple[np.ndarray, np.ndarray]:
        """What makes odd powers of the cosine orthogonal to the harmonics, (half, 3), and to each other, (3, 3), under the cosine."""
        w, weight = hemisphere_quadrature(64)
        h, odd, weight = self._hemisphere(w), w[:, 2:] ** ODD, (weight * w[:, 2])[:, None]
        less = self.inverse @ np.where(self.m[:, None] == 0, h.T @ (weight * odd), 0.0)
        rest = odd - h @ less
        return less, np.linalg.inv(np.linalg.cholesky(rest.T @ (weight * rest))).T

    def on(self, cut: np.ndarray) -> HemisphereHarmonics:
        """The harmonics of sides with a critical angle each, `cut` (n,)."""
        return self if (cut >= 1).all() else self._with(cut)

    def _with(self, cut: np.ndarray) -> HemisphereHarmonics:
        out = copy(self)
        out.cut, out.size, out.heard = cut, 2 * self.half, 2 * (self.half + len(ODD))
        return out

    def _parts(self, cut: float) -> list[tuple[slice, float, float]]:
        """Of a side with this critical angle: coefficients, and the least sin^2 and the width of what they describe."""
        if cut >= 1:
            return [(slice(0, self.half), 0.0, 1.0)]
        return [(slice(0, self.half), 0.0, cut), (slice(self.half, 2 * self.half), cut, 1 - cut)]

    def _blocks(self, matrix: np.ndarray, cut: float, power: int = 0) -> np.ndarray:
        """(size, size): `matrix` (half, half) for each part of a side, times the power of the share of the hemisphere that it has."""
        out = np.zeros((self.size, self.size))
        for part, _, width in self._parts(cut):
            out[part, part] = matrix * width**power
        return out

    def _of_moments(self, cut: float) -> np.ndarray:
        """(heard, heard): the inverse of the products under the cosine of the functions by which what arrives is kept."""
        out = np.zeros((self.heard, self.heard))
        out[: self.size, : self.size] = self._blocks(self.inverse, cut, -1)
        for k, (_, _, width) in enumerate(self._parts(cut) if self.heard > self.size else []):
            odd = self.size + k * len(ODD) + np.arange(len(ODD))
            out[odd, odd] = 1 / width
        return out

    def _damping(self, order: int, window: float) -> np.ndarray:
        """(size, size): band l times Lanczos's sinc(l / (order + 1)) to the power `window`; the flux that this takes goes into l = 0."""
        keep = np.diag(np.sinc(self.l / (order + 1)) ** window)
        unit = self.constant()
        return keep + np.outer(unit, self.flux @ (np.eye(self.size) - keep)) / (self.flux @ unit)

    def values(self, w: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """(n, size) float64: h_a in directions `w` (n, 3) of the frames of sides (n,)."""
        return self.moments(w, side)[:, : self.size]

    def _hemisphere(self, w: np.ndarray) -> np.ndarray:
        return np.sqrt(2.0) * real_harmonics(self.order, w)[:, self.index]

    def moments(self, w: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """(n, heard) float64: the functions by which what arrives along `w` (n, 3) on sides (n,) is kept."""
        if self.cut is None:
            return self._hemisphere(w)
        w, cut = np.asarray(w, np.float64), self.cut[side]
        s = w[:, 0] ** 2 + w[:, 1] ** 2
        beyond = (s >= cut) & (cut < 1)
        stretched = np.clip((s - np.where(beyond, cut, 0)) / np.where(beyond, 1 - cut, cut), 0, 1)
        scale = np.where(beyond, np.sqrt(stretched / np.maximum(s, 1e-300)), 1 / np.sqrt(cut))
        w = np.stack([w[:, 0] * scale, w[:, 1] * scale, np.sqrt(1 - stretched)], axis=1)
        h, row, part = self._hemisphere(w), np.arange(len(w)), beyond.astype(int)
        less, made = self._odd_made
        out, odd = np.zeros((len(w), 2, self.half)), np.zeros((len(w), 2, len(ODD)))
        out[row, part], odd[row, part] = h, (w[:, 2:] ** ODD - h @ less) @ made
        return np.concatenate([out.reshape(len(w), 2 * self.half), odd.reshape(len(w), 2 * len(ODD))], axis=1)

    def basis(self, w: np.ndarray, side: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """All coefficients, and their weights (n, size)."""
        return np.broadcast_to(np.arange(self.size), (len(w), self.size)), self.values(w, side)

    def constant(self, value: float = 1.0, cut: float = 1.0) -> np.ndarray:
        """(size,) coefficients of the radiance `value` in every direction, on a side with this critical angle."""
        out = np.zeros(self.size)
        for part, _, _ in self._parts(cut):
            out[part.start] = value * np.sqrt(2 * np.pi)
        return out

    def even(self) -> np.ndarray:
        """(n, size), or (1, size) where all sides are alike: the radiance 1 in every direction."""
        out = self.constant()[None]
        if self.cut is None:
            return out
        return np.where((self.cut < 1)[:, None], self.constant(cut=0.5), out)

    def share(self, cut: float = 1.0) -> np.ndarray:
        """(size,) what turns products with what arrives into a mean over the hemisphere: moments are of flux."""
        return np.full(self.size, 1 / np.pi)

    def irradiance(self, arriving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of light that arrives, moments (n, heard, 3)."""
        return np.sqrt(2 * np.pi) * arriving[:, : self.size : self.half].sum(axis=1)

    def exitance(self, leaving: np.ndarray, sides: slice | np.ndarray = slice(None)) -> np.ndarray:
        """(n, c) W m-2 of radiance that leaves `sides`, coefficients (n, size, c)."""
        out = np.einsum("a,nac->nc", self.flux, leaving[:, : self.half])
        if self.cut is None:
            return out
        cut = self.cut[sides, None]
        return cut * out + (1 - cut) * np.einsum("a,nac->nc", self.flux, leaving[:, self.half :])

    def add(self, field: np.ndarray, side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
        """Add to the moments `field` (n, heard, 3) light that arrives on sides (m,) along `w` (m, 3) and adds `value` (m, 3) W m-2 to the
        irradiance."""
        first = int(side.min(initial=0))
        h = self.moments(w, side)
        for c in range(3):
            for a in np.flatnonzero(h.any(axis=0)):
                sums = np.bincount(side - first, value[:, c] * h[:, a])
                field[first : first + len(sums), a, c] += sums

    def dimming(self, curve: Callable[[np.ndarray], np.ndarray], cut: float = 1.0) -> np.ndarray:
        """(size,) coefficients of `curve(cosine)`, on a side with this critical angle."""
        w, weight = hemisphere_quadrature(64)
        h, out = self._hemisphere(w), np.zeros(self.size)
        for part, low, width in self._parts(cut):
            cosine = np.sqrt(np.maximum(1 - low - width * (1 - w[:, 2] ** 2), 0))
            values = h * (weight * w[:, 2] * np.asarray(curve(cosine), np.float64))[:, None]
            out[part] = self.inverse @ np.where(self.m == 0, values.sum(axis=0), 0.0)
        return out

    def kernels(
        self, sides: Sequence[Pairs], measure: np.ndarray | None, cuts: Sequence[float] = (1.0, 1.0)
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Matrices (2, size, heard) that take moments sum of flux h_b(wi), per area, to coefficients of the radiance that leaves.

        same: on the side where it arrives; other: from the side beyond, or None. They carry flux, for which no `measure` is needed.
        `cuts`: of the two sides.
        """
        both = self if self.cut is None and min(cuts) >= 1 else self._with(np.asarray(cuts, np.float64))
        same, other = np.zeros((2, both.size, both.heard)), np.zeros((2, both.size, both.heard))
        for side, pairs in enumerate(sides):
            for through, target, at in ((False, same, side), (True, other, 1 - side)):
                which = np.flatnonzero((pairs.through == through) & (pairs.weight > 0))
                if len(which):
                    given, out = (np.full(len(which), s) for s in (side, at))
                    sent = both.values(pairs.other[which], out) * (np.pi / len(pairs.weight) * pairs.weight[which])[:, None]
                    projected = both._isotropic(sent.T @ both.moments(pairs.given[which], given), not through)
                    if min(cuts) >= 1:
                        projected[:, both.size :] = 0.0  # only glass asks for the odd ones
                    projected = both._blocks(self.inverse, cuts[at], -1) @ projected @ both._of_moments(cuts[side])
                    target[at] = both._blocks(self._window, cuts[at]) @ projected
        return same, other if other.any() else None

    def _isotropic(self, matrix: np.ndarray, reciprocal: bool) -> np.ndarray:
        """The part that does not change when both directions are turned about the normal or mirrored: blocks of equal m."""
        size, flip = self.size, np.lexsort((-self.m, self.l))  # position of (l, -m)
        flip = np.concatenate([*(flip + k for k in range(0, size, self.half)), np.arange(size, self.heard)])
        m = np.concatenate([np.tile(self.m, size // self.half), np.zeros(self.heard - size, int)])
        matrix = np.where(m[:size, None] == m, matrix, 0.0)
        matrix = 0.5 * (matrix + matrix[np.ix_(flip[:size], flip)])
        if reciprocal:
            matrix[:, :size] = 0.5 * (matrix[:, :size] + matrix[:, :size].T)
        return matrix


def harmonic_count(order: int) -> int:
    """Coefficients of a hemisphere up to `order`."""
    return (order + 1) * (order + 2) // 2
