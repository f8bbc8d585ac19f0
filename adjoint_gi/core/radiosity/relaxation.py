"""Schemes that gather: Jacobi and Gauss-Seidel, row by row (Goral, Torrance, Greenberg and Battaile 1984; review, Eq. 10 and 11).

    B(i) = E(i) + rho(i) sum_j F(ij) B(j)                                                                         (11)

is solved over any transport as H = F (E + rho H) + H0, of which B = E + rho H: H is irradiance, E emitted radiosity, H0 irradiance that
arrives from outside the elements (lamps, background); all (n, 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base.settings import NO_LIMIT
from ..method.solution import EnergyBalance
from .transports import MatrixTransport, Transport, colored, product

ROWS_PER_BLOCK = 64  # rows that Gauss-Seidel solves together


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
    starts = range(0, n, ROWS_PER_BLOCK)
    # Row i of a block: H_i - sum_{j < i} F_ij rho_j H_j = F_i B (with the block's new part left out) + H0_i.
    lower = [np.tril(factors[..., a : a + ROWS_PER_BLOCK, a : a + ROWS_PER_BLOCK], -1) for a in starts]
    for step in range(limit):
        change = np.zeros_like(emitted)
        for a, triangle in zip(starts, lower, strict=True):
            b = slice(a, a + ROWS_PER_BLOCK)
            right = product(factors[..., b, :], radiosity) + arriving[b] - product(triangle, radiosity[b] - emitted[b])
            if triangle.any():
                matrix = np.eye(triangle.shape[-1]) - triangle * rho[b].T[:, None, :]
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


@dataclass(frozen=True, eq=False)
class System:
    """The linear system of Eq. 10 and 11 on n sides, and what a solution of it means: paths of `low` to `high` segments.

    emitted, arriving   (n, 3) float64 W m-2
    """

    transport: MatrixTransport
    emitted: np.ndarray
    arriving: np.ndarray
    low: int
    high: int

    def counted(self, irradiance: np.ndarray) -> tuple[np.ndarray, np.ndarray, EnergyBalance]:
        """Direct and indirect irradiance (n, 3) of the paths that count, from `irradiance` (n, 3) of all, and where the flux is.

        The solution need not have converged: what leaves the elements and is not in it yet is unshot. Paths that are too short to
        count still carry flux.
        """
        direct, indirect = lengths(self.transport, self.emitted, self.arriving, irradiance, self.low, self.high)
        if self.low <= 1:
            return direct, indirect, self._balance(direct + indirect)
        return direct, indirect, self._balance(sum(lengths(self.transport, self.emitted, self.arriving, irradiance, 1, self.high)))

    def _balance(self, irradiance: np.ndarray) -> EnergyBalance:
        area = self.transport.area[:, None]
        radiosity = self.emitted + self.transport.rho * irradiance
        gathered = self.transport.gather(radiosity)
        next_ = gathered + self.arriving
        escaped = float((area * colored(self.transport.sky, 3) * radiosity).sum())
        # What tinted surfaces between elements have taken.
        on_the_way = float((area * (radiosity - gathered)).sum()) - escaped if self.transport.tinted else 0.0
        return EnergyBalance(
            emitted=float((area * (self.emitted + self.arriving)).sum()),
            absorbed=float((area * (1 - self.transport.rho) * irradiance).sum()) + on_the_way,
            escaped=escaped,
            unshot=float((area * (next_ - irradiance)).sum()),
        )
