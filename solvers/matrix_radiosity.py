"""Full-matrix radiosity (Goral, Torrance, Greenberg and Battaile 1984; review, section 5.2, Eq. 10 and 11).

Gathering, deterministic. Every diffuse element gathers from all others through form factors:

    B(i) = E(i) + rho(i) sum_j F(ij) B(j)                                                                         (11)

The matrix F is filled by rays, and by closed forms for pairs of rectangles with common axes that see each other freely. It is made
reciprocal (A_i F_ij = A_j F_ji) and closed (each row and its sky sum to 1). The system is relaxed by Jacobi or Gauss-Seidel.

C. M. Goral, K. E. Torrance, D. P. Greenberg and B. Battaile, "Modeling the Interaction of Light Between Diffuse Surfaces",
Computer Graphics (SIGGRAPH '84 Proceedings), 18(3), 1984, 213-222.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base.resources import require_within
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.lobes import DIFFUSE_LOBES
from ..adjoint_gi.core.elements.answer import element_count
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, GATHERING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.radiosity.element_run import Found, RadiosityRun
from ..adjoint_gi.core.radiosity.factor_matrix import FactorMatrix, bytes_needed
from ..adjoint_gi.core.radiosity.relaxation import System, gauss_seidel, jacobi
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.radiosity.trapped import refuse_trapped
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import World


@dataclass(frozen=True)
class MatrixSettings(RadiositySettings):
    """Settings of full-matrix radiosity."""

    rays: int = common.element_rays(1024, "Rays that each element casts to find its form factors")
    closed_forms: bool = setting(
        True, "Closed Forms", "Exact form factors for rectangles with common axes where test rays find nothing between them"
    )
    solver: str = common.relaxation("Solver", "How the linear system is relaxed", "Uses new values at once; about half the iterations")
    tolerance: float = common.tolerance(1e-6, "Relative change of the irradiance at which the system is solved")
    max_iterations: int = common.max_iterations(1000, "The solver stops with a warning after this many")
    memory_limit: int = common.memory_limit()


@register
class MatrixRadiosity(Solver):
    """Builds the form-factor matrix and relaxes the radiosity system."""

    spec = MethodSpec(
        id="matrix_radiosity",
        number=3,
        label="Full-Matrix Radiosity",
        strategies=GATHERING,
        natures=DETERMINISTIC,
        year=1984,
        authors="C. M. Goral, K. E. Torrance, D. P. Greenberg, B. Battaile",
        title="Modeling the Interaction of Light Between Diffuse Surfaces",
        equation="B(i) = E(i) + rho(i) sum_j F(ij) B(j)  (11)",
        section="5.2",
        idea="Every element gathers from all others; the form factors make one linear system, which is relaxed.",
        lobes=DIFFUSE_LOBES,
        limits=lines("""
            Diffuse surfaces only: other lobes are taken as diffuse
            Memory grows with the square of the elements; refused over the memory limit
            Indirect shadows are as sharp as the elements are small
            Path lengths are cut out of the full solution, so a short maximum saves no time
            Light that is trapped between surfaces of albedo 1 has no solution and is refused
        """),
        elements=2000,
    )
    Settings = MatrixSettings

    def memory(self, world: World, receivers: Receivers, settings: MatrixSettings) -> int:
        """At most this: as if light reached both sides of every element."""
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        return bytes_needed(2 * count, settings.rays, world.tints) + 600 * count + 100 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: MatrixSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages; partial results hold the direct light until the system is being relaxed."""
        s = settings
        remedy = "Raise max_edge or memory_limit, or choose Progressive Radiosity"
        require_within(self.spec.label, self.memory(world, receivers, s), s.memory_limit, remedy)

        # 1. The elements, where the receivers lie on them, and direct light there.
        run = RadiosityRun(self, world, receivers, s)
        elements, total = run.elements, 2 * run.elements.count
        yield from run.stage(run.answer.prepare(), 0.0, 0.1, "Receivers and direct light")

        # 2. What arrives from lamps and background.
        yield from run.stage(run.lamps.run(), 0.1, 0.2, "Light of lamps and background on elements")
        light = run.lamps.irradiance
        run.check_lit(light)

        # 3. Rays find the sides that light can reach, and what they see.
        matrix = FactorMatrix(elements, s.rays, s.closed_forms)
        for known in matrix.discover(np.flatnonzero(run.emitted.any(axis=1) | light.any(axis=1))):
            yield from run.step(0.2 + 0.3 * known / max(1, total), f"Rays from {known:,} element sides")
        sides = matrix.sides

        # 4. F(ij), reciprocal and closed.
        rho = elements.held.albedo[sides]
        yield from run.stage(matrix.build(rho), 0.5, 0.9, f"Form factors of {len(sides):,} element sides")
        refuse_trapped(elements, sides, matrix.transport)
        system = System(matrix.transport, run.emitted[sides], light[sides], s.min_length, s.max_length)

        # 5. B = E + rho F B (Eq. 11), relaxed row by row.
        relax = jacobi if s.solver == "jacobi" else gauss_seidel
        residual = 0.0
        for iterate in relax(system.transport, system.emitted, system.arriving, s.tolerance, s.max_iterations):
            run.find, residual = finder(run, matrix, system, iterate.irradiance), iterate.residual
            run.clock.note(residual)
            yield from run.step(run.relaxed(residual, 0.9), f"Iteration {len(run.clock.history)}, residual {residual:.1e}")
        run.check_converged(residual)
        yield from run.finish(f"Solved in {len(run.clock.history)} iterations")


def finder(run: RadiosityRun, matrix: FactorMatrix, system: System, irradiance: np.ndarray) -> Callable[[bool], Found]:
    """The answer to the iterate `irradiance` (n, 3) of the system, found when it is asked for."""

    def find(partial: bool) -> Found:
        direct, indirect = np.zeros((2, 2 * run.elements.count, 3))
        direct[matrix.sides], indirect[matrix.sides], balance = system.counted(irradiance)
        parts = run.answer.parts(direct, indirect)
        return Found(parts, run.lamps.rays + matrix.report.rays + parts.rays, balance, matrix.report.arrays())

    return find
