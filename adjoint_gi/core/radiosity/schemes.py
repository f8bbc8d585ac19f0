"""Schemes that solve H = F (E + rho H) + H0 over any transport: Jacobi and Gauss-Seidel gather, Southwell shoots.

H is irradiance, E emitted radiosity, H0 irradiance that arrives from outside the elements (lamps, background); all (n, 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass

import numpy as np

from ..method.solution import EnergyBalance
from .transports import MatrixTransport, Transport

BLOCK = 64  # rows that Gauss-Seidel solves together
NO_LIMIT = 1024  # a max_length of this or more does not bound the paths
BATCH = 1 << 16  # rays of the sides that shoot together, at least; more where there are more sides, as each group costs a look at all
LARGEST_BATCH = 1 << 18
FEWEST, MOST = 8, 1 << 17  # rays of one shot
AT_ONCE = 1 << 14  # sides that shoot together at most


@dataclass(frozen=True, eq=False)
class Iterate:
    """One step of a gathering scheme: irradiance (n, 3) and the residual relative to the solution, in area-weighted mean."""

    irradiance: np.ndarray
    residual: float


def jacobi(transport: Transport, emitted: np.ndarray, arriving: np.ndarray, tolerance: float, limit: int) -> Iterator[Iterate]:
    """Jacobi from zero: iterate k holds exactly the paths of 1 to k + 1 segments (the Neumann series).

    Yields until the residual falls to `tolerance` or `limit` steps are done.
    """
    term = transport.gather(emitted) + arriving
    total = term.copy()
    for step in range(limit):
        residual = _relative(transport, term, total)
        yield Iterate(total, residual)
        if residual <= tolerance or step == limit - 1:
            return
        term = transport.gather(transport.rho * term)
        total = total + term


def gauss_seidel(transport: MatrixTransport, emitted: np.ndarray, arriving: np.ndarray, tolerance: float, limit: int) -> Iterator[Iterate]:
    """Gauss-Seidel: each row uses the rows already done. Rows go in blocks whose own triangle is solved directly: the same numbers.

    Iterates do not hold the paths of a known length; `lengths` cuts them out of the finished solution.
    """
    factors, rho = transport.factors, transport.rho
    n = len(rho)
    radiosity = emitted.copy()
    irradiance = np.zeros_like(emitted)
    starts = range(0, n, BLOCK)
    # Row i of a block: H_i - sum_{j < i} F_ij rho_j H_j = F_i B (with the block's new part left out) + H0_i.
    lower = [np.tril(factors[a : a + BLOCK, a : a + BLOCK], -1) for a in starts]
    for step in range(limit):
        change = np.zeros_like(emitted)
        for a, triangle in zip(starts, lower, strict=True):
            b = slice(a, a + BLOCK)
            right = factors[b] @ radiosity + arriving[b] - triangle @ (radiosity[b] - emitted[b])
            if triangle.any():
                matrix = np.eye(len(triangle)) - triangle * rho[b].T[:, None, :]
                new = np.linalg.solve(matrix, right.T[..., None])[..., 0].T
            else:
                new = right
            change[b] = new - irradiance[b]
            irradiance[b] = new
            radiosity[b] = emitted[b] + rho[b] * new
        residual = _relative(transport, change, irradiance)
        yield Iterate(irradiance.copy(), residual)
        if residual <= tolerance or step == limit - 1:
            return


def _relative(transport: Transport, change: np.ndarray, total: np.ndarray) -> float:
    scale = float((transport.area[:, None] * np.abs(total)).sum())
    return float((transport.area[:, None] * np.abs(change)).sum()) / scale if scale else 0.0


def lengths(
    transport: Transport, emitted: np.ndarray, arriving: np.ndarray, irradiance: np.ndarray, low: int, high: int
) -> tuple[np.ndarray, np.ndarray]:
    """Direct and indirect irradiance (n, 3) of the paths of `low` to `high` segments, from the whole solution `irradiance`.

    If H holds all lengths, F rho applied k times leaves those above k: what is longer than `high` is H pushed on `high` times.
    """
    first = transport.gather(emitted) + arriving
    direct = first if low <= 1 <= high else np.zeros_like(first)
    rest = transport.gather(transport.rho * irradiance)  # lengths 2 and more
    kept = rest if high >= 2 else np.zeros_like(rest)
    above = rest
    if high < NO_LIMIT or low > 2:
        for length in range(3, max(low, high + 1 if 2 <= high < NO_LIMIT else 0) + 1):
            above = transport.gather(transport.rho * above)  # lengths `length` and more
            if above.max(initial=0.0) <= 1e-17 * irradiance.max(initial=0.0):
                above = np.zeros_like(above)  # nothing of that length: the rest would only push zeros on
                kept = above if length <= low else kept
                break
            if length == low:
                kept = above
            if length == high + 1:
                kept = kept - above
    return direct, kept


def trapped(transport: MatrixTransport) -> np.ndarray:
    """(n,) bool: sides from which light can never leave, because all it can reach has albedo 1 in some channel."""
    out = np.zeros(len(transport.area), bool)
    for c in range(3):
        loses = (transport.rho[:, c] < 1) | (transport.sky > 1e-9)
        while True:
            more = loses | (transport.factors @ loses > 1e-12)
            if (more == loses).all():
                break
            loses = more
        out |= ~loses
    return out


class Southwell:
    """Shooting: the sides with the most unshot flux send it out, and everything they light gets it to send on (Cohen 1988, Eq. 13, 14).

    direct, indirect   (n, 3) irradiance so far, of the path lengths asked for
    first              (n, 3) irradiance so far of one segment, whether asked for or not
    unshot             (k, n, 3) radiosity not yet sent, by the segments its light has behind it; the last class holds all longer
                       paths where their number does not matter
    absorbed, escaped  flux in W by channel; with the flux that is unshot, and that which was `cut` by the path length, they add up
                       to `emitted` at every moment
    """

    def __init__(
        self, transport: Transport, emitted: np.ndarray, arriving: np.ndarray, low: int = 0, high: int = NO_LIMIT, overshoot: bool = False
    ) -> None:
        self.transport = transport
        self.low, self.high = low, high
        self.bounded = high < NO_LIMIT
        classes = max(1, high) if self.bounded else max(2, low)
        n = len(transport.area)
        self.unshot = np.zeros((classes, n, 3))
        self.direct = np.zeros((n, 3))
        self.first = np.zeros((n, 3))
        self.indirect = np.zeros((n, 3))
        self.reached = (emitted > 0).any(axis=1) | (arriving > 0).any(axis=1)
        self.absorbed = np.zeros(3)
        self.escaped = np.zeros(3)
        self.sent = np.zeros(3)  # by all shots, arrived or escaped
        self.cut = np.zeros(3)
        self.shots = 0
        # Overshooting sends light of unknown length, which a bound on lengths cannot take.
        self.overshoot = overshoot and not self.bounded and classes == 2
        area = transport.area[:, None]
        self.emitted = (area * (emitted + arriving)).sum(axis=0)
        self.total = float(self.emitted.sum())
        if high == 0:
            self.cut += self.emitted
        else:
            self.unshot[0] = emitted
            self._arrive(arriving[None], 0)

    def _arrive(self, irradiance: np.ndarray, first: int) -> None:
        """Take irradiance (k, n, 3) of light that has arrived; its class is the segments it had before, from `first` on."""
        area = self.transport.area[:, None]
        rho = self.transport.rho
        for k, light in enumerate(irradiance, first):
            length = k + 1
            if length == 1:
                self.first += light
            # In the last class the lengths are mixed, but all of them long enough.
            if self.low <= length or (not self.bounded and k == len(self.unshot) - 1):
                (self.direct if length == 1 else self.indirect)[:] += light
            self.absorbed += (area * (1 - rho) * light).sum(axis=0)
            if self.bounded and length >= self.high:
                self.cut += (area * rho * light).sum(axis=0)
            else:
                self.unshot[min(length, len(self.unshot) - 1)] += rho * light
        self.reached |= irradiance.any(axis=(0, 2))

    def refined(self, transport: Transport, root: np.ndarray, factor: np.ndarray) -> Southwell:
        """The same state on finer elements, before any light of a second segment has been shot.

        root (n,): the side that each new side is part of; factor (n, 3): its share of light of one segment, relative to that side's.
        The area-weighted means of `factor` over every old side must be 1: then no flux is gained or lost.
        """
        new = copy(self)
        new.transport = transport
        new.first, new.direct = self.first[root] * factor, self.direct[root] * factor
        new.indirect, new.reached = self.indirect[root], self.reached[root]
        new.unshot = self.unshot[:, root]
        new.unshot[1:] *= factor
        new.absorbed, new.escaped, new.cut, new.sent = (x.copy() for x in (self.absorbed, self.escaped, self.cut, self.sent))
        return new

    def arrive_later(self, irradiance: np.ndarray) -> None:
        """Take irradiance (n, 3) from outside that has flown more than one segment. Only for unbounded lengths."""
        flux = (self.transport.area[:, None] * irradiance).sum(axis=0)
        self.emitted = self.emitted + flux
        self.total += float(flux.sum())
        self._arrive(irradiance[None], 1)

    def unshot_flux(self) -> np.ndarray:
        """(n,) float64 flux in W that each side has still to send; absolute values, as overshooting makes some negative."""
        return self.transport.area * np.abs(self.unshot).sum(axis=(0, 2))

    def remaining(self) -> np.ndarray:
        """(3,) float64 flux in W not yet sent, and flux cut off by the path length."""
        return (self.transport.area[:, None] * self.unshot.sum(axis=0)).sum(axis=0) + self.cut

    def ambient(self) -> np.ndarray:
        """(3,) irradiance that the unshot light would give everywhere it can come, reflected on for ever (Cohen 1988).

        Cohen's scenes are closed. In open ones a share of what is sent escapes; the shots so far tell it, so before them this is 0.
        """
        area = self.transport.area * self.reached
        whole = max(float(area.sum()), 1e-300)
        mean_rho = (area[:, None] * self.transport.rho).sum(axis=0) / whole
        stays = np.clip(1 - self.escaped / np.maximum(self.sent, 1e-300), 0, 1) * (self.sent > 0)
        return (self.remaining() - self.cut) * stays / whole / np.maximum(1 - mean_rho * stays, 1e-3)

    def shoot(self, index: np.ndarray, rays: np.ndarray) -> None:
        """Send the unshot light of sides `index` (m,), all at once, with `rays` (m,) rays each."""
        out = self.unshot[:, index]
        if self.overshoot:
            out[-1] += self._expected(index)
        self.unshot[:, index] -= out
        self.sent += np.abs(out * self.transport.area[index, None]).sum(axis=(0, 1))
        classes = len(out)
        # Classes in which nobody has anything are not carried along.
        used = np.flatnonzero(out.any(axis=(1, 2)))
        flat = out[used].transpose(1, 0, 2).reshape(len(index), 3 * len(used))
        arrived, escaped = self.transport.shoot(index, flat, rays)
        full = np.zeros((classes, len(self.direct), 3))
        full[used] = arrived.reshape(-1, len(used), 3).transpose(1, 0, 2)
        self.escaped += escaped.reshape(-1, 3).sum(axis=0)
        self.absorbed += np.reshape(self.transport.other, (-1, 3)).sum(axis=0)
        self._arrive(full, 0)
        self.shots += len(index)

    def _expected(self, index: np.ndarray) -> np.ndarray:
        """(m, 3) radiosity that sides `index` (m,) are expected to have from light that is still under way (Feda 1992)."""
        return self.transport.rho[index] * self.reached[index, None] * self.ambient()

    def largest(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Up to `count` sides with the most flux to send, most first, and their flux in W; sides with none are left out."""
        flux = self.unshot_flux()
        if self.overshoot:
            # What a side has sent too early must not bring it to the front again.
            out = self.unshot.sum(axis=0) + self._expected(np.arange(len(flux)))
            flux = self.transport.area * np.abs(out).sum(axis=1)
        index = np.argpartition(-flux, count)[:count] if count < len(flux) else np.arange(len(flux))
        # Ties go to the lower index, so that the order is always the same.
        index = index[np.lexsort((index, -flux[index]))]
        index = index[flux[index] > 0]
        return index, flux[index]


def group(state: Southwell, carriers: int, max_shots: int, least: int = BATCH) -> tuple[np.ndarray, np.ndarray]:
    """The sides that shoot next and the rays of each: in the order of their unshot flux, as many as fit into one batch of rays.

    `carriers` rays carry all emitted flux, in at most `max_shots` shots. A batch holds `least` rays, or more where there are more sides.
    """
    many = min(AT_ONCE, max_shots - state.shots)
    index, flux = state.largest(many)
    rays = np.clip(np.ceil(carriers * flux / max(state.total, 1e-300)), FEWEST, MOST).astype(np.int64)
    batch = int(np.clip(len(state.direct) // 2, least, LARGEST_BATCH))
    fits = max(1, int(np.searchsorted(np.cumsum(rays), batch, side="right")))
    return index[:fits], rays[:fits]


def balance(state: Southwell) -> EnergyBalance:
    """Flux summed over the channels; light cut off by the path length counts as unshot."""
    return EnergyBalance(state.total, float(state.absorbed.sum()), float(state.escaped.sum()), float(state.remaining().sum()))
