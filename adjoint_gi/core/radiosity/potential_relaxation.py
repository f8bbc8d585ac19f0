"""The potential of diffuse elements by relaxation (Pattanaik and Mudur 1993; review, section 7, Eq. 2).

The mean of the potential over the hemisphere about an element is

    W(i) = g(i) + sum_j rho_j F_ij W(j)                                                                   (before 14)

the adjoint system W = g + T* W of the transport T = rho F. Jacobi relaxes all of it at once; Southwell shoots what is left.

S. N. Pattanaik and S. P. Mudur, "The Potential Equation and Importance in Illumination Computations", Computer Graphics Forum, 12(2),
1993, 131-136.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..elements.elements import Elements
from ..elements.rays import ElementRays
from .factor_matrix import FactorMatrix
from .southwell import DiffuseShooting, Grouping, Southwell
from .transports import RayTransport, Transport

GROUP = 64  # sides that shoot together


class PotentialSystem:
    """W = g + T* W on element sides, for paths of `low` to `high` flights.

    parts   (3, 2 ne, 3) float64: the potential after 0, 1 and more reflections, as far as it is solved
    sides   (n,) that see the receivers by reflections, once form factors are found; rays: cast for these, `per_side` from each
    """

    def __init__(self, elements: Elements, g: np.ndarray, per_side: int, low: int, high: int) -> None:
        """`g` (2 ne, 3): the function of the receivers on every element side, `Detector.on_elements`."""
        self.elements, self.per_side, self.low, self.high = elements, per_side, low, high
        self.g = g
        self.parts = np.zeros((3, 2 * elements.count, 3))
        self.parts[0] = self.g * (low == 0)
        self.sides = np.zeros(0, np.int64)
        self.rays = 0
        self.transport: Transport

    def find_factors(self, how: str) -> Iterator[tuple[float, str]]:
        """Form factors as a "matrix" or along fixed "rays"; yields the share done and what is being done."""
        yield from self._by_rays() if how == "rays" else self._by_matrix()

    def relax(self, scheme: str) -> Iterator[float]:
        """Solve by "jacobi" or "southwell"; yields what is left, as a share, after every iteration."""
        if len(self.sides):
            yield from self._southwell() if scheme == "southwell" else self._jacobi()

    # ---- form factors

    def _by_matrix(self) -> Iterator[tuple[float, str]]:
        """All form factors of the sides that rays reach from the receivers."""
        matrix = FactorMatrix(self.elements, self.per_side)
        for known in matrix.discover(np.flatnonzero(self.g.any(axis=1))):
            yield 0.5 * known / (2 * self.elements.count), f"Rays from {known:,} element sides"
        self.sides = matrix.sides
        if len(self.sides):
            for share in matrix.build(self.elements.held.albedo[self.sides]):
                yield 0.5 + 0.5 * share, f"Form factors of {len(self.sides):,} element sides"
            self.transport, self.rays = matrix.transport, matrix.report.rays

    def _by_rays(self) -> Iterator[tuple[float, str]]:
        """A fixed set of rays from every side."""
        total = 2 * self.elements.count
        self.sides = np.arange(total)
        rows = []
        for piece in ElementRays(self.elements).rows(self.sides, self.per_side):
            rows.append(piece)
            yield (int(piece[0][-1]) + 1) / total, "Rays between elements"
        self.rays = total * self.per_side
        self.transport = RayTransport.of_rows(self.elements, self.sides, self.per_side, rows)

    # ---- schemes

    def _jacobi(self) -> Iterator[float]:
        """W = g + T* g + T*^2 g + ...: term k is the potential by k reflections. Yields the last term's share of all."""
        area = self.elements.held.area[self.sides, None]
        term = self.g[self.sides]
        total = term.copy()
        for length in range(1, self.high + 1):
            term = self.transport.adjoint(term)
            total += term
            if length >= self.low:
                self.parts[min(length, 2)][self.sides] += term
            scale = float((area * total).sum())
            yield float((area * term).sum()) / scale if scale else 0.0
        yield 0.0

    def _southwell(self) -> Iterator[float]:
        """The sides with the most unshot potential shoot what they reflect of it. Yields the share that is unshot."""
        g = self.g[self.sides]
        state = DiffuseShooting(self.transport, self.transport.rho * g, np.zeros_like(g), self.low, self.high)
        whole = float((self.elements.held.area[self.sides, None] * g).sum())
        grouping = Grouping(1, 1 << 62, GROUP, fewest=self.per_side, most=self.per_side)
        for left in Southwell(state, grouping, 0.0, whole=whole).run():
            self.parts[1][self.sides], self.parts[2][self.sides] = state.direct, state.indirect
            yield left
        if not state.shots:
            yield 0.0
