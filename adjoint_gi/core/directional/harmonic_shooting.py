"""Shooting of radiance that is kept in harmonics: the state of the method of Sillion, Arvo, Westin and Greenberg 1991.

As `radiosity.southwell.DiffuseShooting`, with coefficients of radiance by direction in the place of radiosity. A shot samples the radiance
of its side along rays drawn by the cosine; what arrives is kept as moments, the sum of flux times h_a(wi) over area, and a matrix for
each material turns moments into the coefficients of what leaves. Flux is what is counted, so none is lost.
"""

from __future__ import annotations

import numpy as np

from ..base.parallel import in_order
from ..base.settings import NO_LIMIT
from ..radiosity.southwell import length_classes, most_first
from .harmonics import HemisphereHarmonics
from .rays import DirectionalRays
from .scattering import Scattering

RAYS_PER_TASK = 1 << 13  # rays in one piece of work


class HarmonicShooting:
    """What has arrived and what is unshot.

    direct, indirect   (n, heard, 3) moments of the light that has arrived, of the path lengths asked for
    unshot             (k, n, size, 3) coefficients of unshot radiance, by the segments its light has behind it (see DiffuseShooting)
    absorbed, escaped  flux in W by channel, as in DiffuseShooting; `count`: rays cast; `shots`: sides that have shot
    """

    def __init__(self, caster: DirectionalRays, scattering: Scattering[HemisphereHarmonics], low: int = 0, high: int = NO_LIMIT) -> None:
        e = caster.elements
        self.caster, self.basis, self.scattering = caster, scattering.basis, scattering
        basis = self.basis
        self.low, self.high = low, high
        self.bounded = high < NO_LIMIT
        n = 2 * e.count
        self.area, self.share = e.held.area, e.held.share[:, None, None]
        self.unshot = np.zeros((length_classes(low, high), n, basis.size, 3))
        self.direct, self.indirect = np.zeros((n, basis.heard, 3)), np.zeros((n, basis.heard, 3))
        self.emitted, self.absorbed, self.escaped, self.cut = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
        self.count = self.shots = 0
        self._used = np.zeros(n, np.int64)
        self._cut = np.zeros(n, bool) if basis.cut is None else basis.cut < 1
        self._glass = self._cut.reshape(-1, 2).any(axis=1)

    @property
    def total(self) -> float:
        """Emitted flux in W, the channels summed."""
        return float(self.emitted.sum())

    def emit(self, radiance: np.ndarray) -> None:
        """Add emission: coefficients (n, size, 3) of radiance that leaves."""
        if self._counts(self._flux(radiance)):
            self.unshot[0] += radiance

    def illuminate(self, moments: np.ndarray) -> None:
        """Add light from outside the elements: moments (n, heard, 3) of what arrives."""
        if self._counts(self._arrived(moments)):
            self._arrive(moments, 0)

    def _counts(self, flux: np.ndarray) -> bool:
        """Add to the emitted flux (3,); returns whether any path length counts."""
        self.emitted += flux
        if self.high == 0:
            self.cut += flux
        return self.high > 0

    def _flux(self, radiance: np.ndarray) -> np.ndarray:
        return self.area @ self.basis.exitance(radiance)

    def _arrived(self, moments: np.ndarray) -> np.ndarray:
        return self.area @ self.basis.irradiance(moments)

    def _arrive(self, moments: np.ndarray, behind: int) -> None:
        """Take moments of light with `behind` segments before this one."""
        length = behind + 1
        # In the last class the lengths are mixed, but all of them long enough.
        if self.low <= length or (not self.bounded and behind == len(self.unshot) - 1):
            (self.direct if length == 1 else self.indirect)[:] += moments
        lit = np.flatnonzero(moments.any(axis=(1, 2)))
        if not len(lit):
            return
        # Elements between the first and the last that are lit: scattering works on ranges.
        first, last = int(lit[0]) >> 1, (int(lit[-1]) >> 1) + 1
        sides = slice(2 * first, 2 * last)
        leaving = self.share[sides] * self.scattering.apply(moments[sides], first=first)
        flux = self.area[sides] @ self.basis.exitance(leaving, sides)
        self.absorbed += self._arrived(moments) - flux
        if self.bounded and length >= self.high:
            self.cut += flux
        else:
            self.unshot[min(length, len(self.unshot) - 1), sides] += leaving

    def unshot_flux(self) -> np.ndarray:
        """(n,) W: unshot flux of each side, absolute values, as light that rings may have a negative one.

        Radiance that carries no flux on the whole is ringing, or the noise of few rays, and does not bring a side to the front.
        """
        return self.area * np.abs(self.basis.exitance(self.unshot.sum(axis=0))).sum(axis=1)

    def remaining(self) -> np.ndarray:
        """(3,) W of unshot flux, and cut off by the path length."""
        return self._flux(self.unshot.sum(axis=0)) + self.cut

    def shoot(self, index: np.ndarray, rays: np.ndarray) -> None:
        """Send the unshot radiance of sides `index` (m,) along `rays` (m,) rays each."""
        classes = len(self.unshot)
        used = np.flatnonzero(self.unshot[:, index].any(axis=(1, 2, 3)))
        out = self.unshot[used][:, index]  # (k, m, size, 3)
        self.unshot[:, index] = 0.0
        who = np.repeat(np.arange(len(index)), rays)
        number = np.arange(len(who)) - np.repeat(np.cumsum(rays) - rays, rays) + self._used[index][who]
        self._used[index] += rays
        self.count += len(who)
        self.shots += len(index)
        # Columns: class, channel. Coefficients in rows, for products with the harmonics.
        coefficients = np.ascontiguousarray(out.transpose(1, 2, 0, 3)).reshape(len(index), self.basis.size, -1)
        plain = not coefficients[:, 1:].any() and not self._cut[index].any()

        def work(first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
            part = slice(first, first + RAYS_PER_TASK)
            side = index[who[part]]
            (a, b), w = self.caster.cosine(number[part], side)
            met, arrives, color = self.caster.trace(side, a, b, w)
            mine = coefficients[:, 0] / np.sqrt(2 * np.pi) if plain else coefficients
            mine = mine[who[part]]
            radiance = mine if plain else np.einsum("na,nak->nk", self.basis.values(w, side), mine)
            return met, arrives, radiance, color

        pieces = list(in_order(work, range(0, len(who), RAYS_PER_TASK)))
        met, arrives, radiance = (np.concatenate([p[i] for p in pieces]) for i in range(3))
        flux = np.pi * self.area[index][who, None] * radiance / rays[who, None]
        if not plain:
            exact = self.area[index, None] * self.basis.exitance(coefficients, index)
            flux = _carrying(flux, exact, who, rays)
        if self.caster.tinted:
            arriving = flux * np.tile(np.concatenate([p[3] for p in pieces]), (1, len(used)))
            # What surfaces on the way have taken.
            self.absorbed += (flux - arriving).sum(axis=0).reshape(-1, 3).sum(axis=0)
            flux = arriving
        self._land(met, arrives, flux, used, classes)

    def _land(self, met: np.ndarray, arrives: np.ndarray, flux: np.ndarray, used: np.ndarray, classes: int) -> None:
        """Sum the flux (r, k 3) of rays into moments of the sides they meet; what escapes is counted."""
        n = len(self.area)
        lost = flux[met < 0].sum(axis=0).reshape(-1, 3)
        self.escaped += lost.sum(axis=0)
        hit = np.flatnonzero(met >= 0)
        met, flux = met[hit], flux[hit]
        area = np.maximum(self.area, 1e-300)[:, None]
        columns = flux.shape[1]
        moments = np.zeros((n, self.basis.heard, columns))
        sums = np.stack([np.bincount(met, flux[:, k], n) for k in range(columns)], axis=1)
        moments[:, 0] = sums / area / np.sqrt(2 * np.pi)
        # Plainly diffuse elements do not ask for the direction.
        which = np.flatnonzero(self.scattering.shiny[met >> 1])
        if len(which) and self.basis.heard > 1:
            h, to = self.basis.moments(arrives[hit[which]], met[which]), met[which]
            half, size = self.basis.half, self.basis.size
            # Sides with a critical angle alone ask for two parts, and glass for odd moments.
            parts = [(slice(None), range(1, half))]
            if self._cut.any():
                inner, glass = np.flatnonzero(self._cut[to]), np.flatnonzero(self._glass[to >> 1])
                moments[self._cut, 0] = 0.0
                parts += [(inner, range(1)), (inner, range(half, size)), (glass, range(size, self.basis.heard))]
            for rows, numbers in parts:
                for k in range(columns):
                    light = flux[which[rows], k]
                    for a in numbers:
                        moments[:, a, k] += np.bincount(to[rows], light * h[rows, a], n) / area[:, 0]
        for k, behind in enumerate(used):
            self._arrive(np.ascontiguousarray(moments[:, :, 3 * k : 3 * k + 3]), int(behind))

    def largest(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Up to `count` sides with the most unshot flux, most first, and how much; sides with nothing are left out."""
        return most_first(self.unshot_flux(), count)


def _carrying(flux: np.ndarray, exact: np.ndarray, who: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Flux (r, k) of rays of sides `who` (r,), each of which casts `rays` (m,), made such that a side's is `exact` (m, k).

    What harmonics swing below 0 stays: without it beams turn towards the normal, and the more the higher the order.
    """
    total = np.stack([np.bincount(who, flux[:, k], len(rays)) for k in range(flux.shape[1])], axis=1)
    # The mean over the rays is not quite the integral: where a side takes light back, all its rays share the difference.
    return flux + ((exact - total) / rays[:, None])[who]
