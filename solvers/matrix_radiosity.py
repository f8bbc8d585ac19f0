"""Full-matrix radiosity (Goral, Torrance, Greenberg and Battaile 1984; review, section 5.2, Eq. 10 and 11).

Gathering, deterministic. Every diffuse element gathers from all others through form factors:

    B(i) = E(i) + rho(i) sum_j F(ij) B(j)                                                                         (11)

The matrix F is filled by rays, and by closed forms for pairs of rectangles with common axes that see each other freely. It is made
reciprocal (A_i F_ij = A_j F_ji) and closed (each row and its sky sum to 1). The system is relaxed by Jacobi or Gauss-Seidel.

C. M. Goral, K. E. Torrance, D. P. Greenberg and B. Battaile, "Modeling the Interaction of Light Between Diffuse Surfaces",
Computer Graphics (SIGGRAPH '84 Proceedings), 18(3), 1984, 213-222.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.errors import MemoryRefused, Notice
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.elements.answer import ElementAnswer, element_count, elements_for
from ..adjoint_gi.core.elements.elements import Elements
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.radiosity.factor_matrix import FactorMatrix, bytes_needed
from ..adjoint_gi.core.radiosity.schemes import gauss_seidel, jacobi, lengths, trapped
from ..adjoint_gi.core.radiosity.shared import LampLight, RadiositySettings, dark_notices, receiver_light
from ..adjoint_gi.core.radiosity.transports import MatrixTransport
from ..adjoint_gi.core.radiosity.trapped import refuse
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World

TARGET = 2000  # elements where max_edge is chosen
# Shares of the whole at which the stages end: receivers, lamps, rows of rays, factors; the rest is the system.
STAGES = (0.1, 0.2, 0.5, 0.9)


@dataclass(frozen=True)
class MatrixSettings(RadiositySettings):
    """Settings of full-matrix radiosity."""

    rays: int = setting(
        1024, label="Rays per Element", help="Rays that each element casts to find its form factors", min=1, max=1 << 20, soft_max=16384
    )
    closed_forms: bool = setting(
        True, label="Closed Forms", help="Exact form factors for rectangles with common axes where test rays find nothing between them"
    )
    solver: str = setting(
        "gauss_seidel",
        label="Solver",
        help="How the linear system is relaxed",
        choices=(
            ("gauss_seidel", "Gauss-Seidel", "Uses new values at once; about half the iterations"),
            ("jacobi", "Jacobi", "Each iteration adds one bounce"),
        ),
    )
    tolerance: float = setting(
        1e-6, label="Tolerance", help="Relative change of the irradiance at which the system is solved", min=0.0, max=1.0
    )
    max_iterations: int = setting(
        1000, label="Max Iterations", help="The solver gives up, and says so, after this many", min=1, max=100_000
    )
    memory_limit: int = setting(
        2048, label="Memory Limit (MB)", help="The method does not start when its matrix could need more than this", min=1, max=1 << 20
    )


@register
class MatrixRadiosity(Solver):
    """Builds the form-factor matrix and relaxes the radiosity system."""

    spec = MethodSpec(
        id="matrix_radiosity",
        number=3,
        label="Full-Matrix Radiosity",
        strategies=(Strategy.GATHERING,),
        natures=(Nature.DETERMINISTIC,),
        year=1984,
        authors="C. M. Goral, K. E. Torrance, D. P. Greenberg, B. Battaile",
        title="Modeling the Interaction of Light Between Diffuse Surfaces",
        equation="B(i) = E(i) + rho(i) sum_j F(ij) B(j)  (10, 11)",
        section="5.2",
        idea="Every element gathers from all others; the form factors make one linear system, which is relaxed.",
        limits=(
            "Diffuse surfaces only: other lobes are taken as diffuse",
            "Memory grows with the square of the elements; refused over the memory limit",
            "Indirect shadows are as sharp as the elements are small",
            "Path lengths are cut out of the full solution, so a short maximum saves no time",
            "Light that is trapped between surfaces of albedo 1 has no solution and is refused",
        ),
        lobes=frozenset({"diffuse", "emission"}),
        uses_elements=True,
    )
    Settings = MatrixSettings

    def element_target(self, settings: MatrixSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return TARGET

    def memory(self, world: World, receivers: Receivers, settings: MatrixSettings) -> int:
        """At most this: as if light reached both sides of every element."""
        count = element_count(world, receivers, settings.max_edge, TARGET)
        return bytes_needed(2 * count, settings.rays) + 600 * count + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: MatrixSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages; partial results hold the direct light until the system is being relaxed."""
        needed = self.memory(world, receivers, settings)
        if needed > settings.memory_limit << 20:
            reason = f"could need {needed / 2**20:,.0f} MB, over its limit of {settings.memory_limit:,} MB"
            raise MemoryRefused(self.spec.label, reason, "Raise max_edge or memory_limit, or choose Progressive Radiosity")
        started = time.monotonic()
        elements = elements_for(world, receivers, settings.max_edge, TARGET)
        run = _Run(self, world, receivers, settings, elements, started)
        yield from run.steps()


class _Run:
    """The state of one solve."""

    def __init__(
        self, solver: Solver, world: World, receivers: Receivers, settings: MatrixSettings, elements: Elements, started: float
    ) -> None:
        self.solver, self.world, self.receivers, self.settings = solver, world, receivers, settings
        self.elements, self.started = elements, started
        emitters = Emitters(world)
        gather = receiver_light(world, emitters, settings)
        self.answer = ElementAnswer(elements, receivers, gather, settings.min_length, settings.max_length)
        self.lamps = LampLight(elements, emitters, settings.light_samples)
        self.matrix = FactorMatrix(elements, settings.rays, settings.closed_forms)
        self.history: list[tuple[float, float]] = []
        self.warnings = world.scene.warnings + world.shading.substitutions(solver.spec.lobes)
        self.transport: MatrixTransport | None = None
        self.irradiance = np.zeros((0, 3))

    def steps(self) -> Iterator[Step]:
        receivers_end, lamps_end, rows_end, factors_end = STAGES
        # 1. Where the receivers lie on the elements, and direct light at them.
        for share in self.answer.prepare():
            yield self._step(receivers_end * share, "Receivers and direct light")
        # 2. Light of lamps and background on the elements.
        for share in self.lamps.run():
            yield self._step(receivers_end + (lamps_end - receivers_end) * share, "Light of lamps and background on elements")
        self.warnings += dark_notices(self.elements, self.lamps.irradiance)
        # 3. Rays to find the sides that light can reach, and what they see.
        emits = np.repeat(self.elements.emitted.any(axis=1), 2)
        lit = np.flatnonzero(emits | self.lamps.irradiance.any(axis=1))
        for known in self.matrix.discover(lit):
            share = known / max(1, 2 * self.elements.count)
            yield self._step(lamps_end + (rows_end - lamps_end) * share, f"Rays from {known:,} element sides")
        # 4. The matrix.
        sides = self.matrix.sides
        for share in self.matrix.build(self.elements.albedo[sides >> 1]):
            yield self._step(rows_end + (factors_end - rows_end) * share, f"Form factors of {len(sides):,} element sides")
        self.transport = self.matrix.transport
        self.emitted = self.elements.emitted[sides >> 1]
        self.arriving = self.lamps.irradiance[sides]
        self._refuse_trapped()
        # 5. The system.
        s = self.settings
        scheme = jacobi if s.solver == "jacobi" else gauss_seidel
        first = residual = 1.0
        for iterate in scheme(self.transport, self.emitted, self.arriving, s.tolerance, s.max_iterations):
            self.irradiance, residual = iterate.irradiance, iterate.residual
            first = first if self.history else max(residual, 1e-300)
            self.history.append((time.monotonic() - self.started, residual))
            done = np.log(max(residual, 1e-300) / first) / np.log(max(s.tolerance, 1e-16) / first) if residual < first else 0.0
            text = f"Iteration {len(self.history)}, residual {residual:.1e}"
            yield self._step(factors_end + (1 - factors_end) * float(np.clip(done, 0, 0.99)), text)
        if residual > s.tolerance:
            reason = f"stopped after {s.max_iterations} iterations at a relative change of {residual:.1e}"
            self.warnings += (Notice(self.solver.spec.label, reason, "Raise max_iterations or the tolerance"),)
        yield self._step(1.0, f"Solved in {len(self.history)} iterations", partial=False)

    def _refuse_trapped(self) -> None:
        caught = np.flatnonzero(trapped(self.transport))
        if len(caught):
            refuse(self.elements, int(self.matrix.sides[caught[0]]))

    def _step(self, fraction: float, text: str, partial: bool = True) -> Step:
        irradiance, history, warnings = self.irradiance, tuple(self.history), self.warnings
        seconds = time.monotonic() - self.started
        return Step(fraction, text, lambda: self._solution(irradiance, history, warnings, seconds, partial))

    def _solution(self, irradiance: np.ndarray, history: tuple, warnings: tuple[Notice, ...], seconds: float, partial: bool) -> Solution:
        s = self.settings
        low, high = s.min_length, s.max_length
        n = 2 * self.elements.count
        direct, indirect = np.zeros((n, 3)), np.zeros((n, 3))
        balance, rays, extra = None, self.lamps.rays, {}
        if self.transport is None or not len(irradiance):
            # Before the system is relaxed: what the lamps give, which is of length 1.
            direct += self.lamps.irradiance if low <= 1 <= high else 0.0
        else:
            sides, t = self.matrix.sides, self.transport
            direct[sides], indirect[sides] = lengths(t, self.emitted, self.arriving, irradiance, low, high)
            counted = direct[sides] + indirect[sides]
            if low > 1:
                counted = sum(lengths(t, self.emitted, self.arriving, irradiance, 1, high))
            balance = energy_balance(t, self.emitted, self.arriving, counted)
            report = self.matrix.report
            rays += report.rays
            names = ("exact", "cast", "reciprocity", "closure")
            extra = {f"factors_{name}": np.array([getattr(report, name)], np.float64) for name in names}
        parts = self.answer.parts(direct, indirect)
        return Solution(
            self.solver.spec.id,
            self.receivers.measure,
            **{**parts.arrays(), "extra": {**parts.extra, **extra}},
            rays=rays + parts.rays,
            seconds=seconds,
            balance=balance,
            history=history,
            warnings=warnings,
            settings=s.as_dict(),
            partial=partial,
        )


def energy_balance(transport: MatrixTransport, emitted: np.ndarray, arriving: np.ndarray, irradiance: np.ndarray) -> EnergyBalance:
    """Flux for irradiance (n, 3) that need not have converged: what leaves the elements and is not in it yet is unshot."""
    area = transport.area[:, None]
    radiosity = emitted + transport.rho * irradiance
    next_ = transport.gather(radiosity) + arriving
    return EnergyBalance(
        emitted=float((area * (emitted + arriving)).sum()),
        absorbed=float((area * (1 - transport.rho) * irradiance).sum()),
        escaped=float((area * transport.sky[:, None] * radiosity).sum()),
        unshot=float((area * (next_ - irradiance)).sum()),
    )
