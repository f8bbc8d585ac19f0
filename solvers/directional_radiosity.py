"""Direction discretisation (Immel, Cohen and Greenberg 1986; review, section 5.2.1 (ii)).

Gathering or shooting, deterministic. Radiosity for surfaces that are not diffuse: the unknown is the radiance L(i, d) that side i of an
element sends into bin d of its hemisphere, and all of them make one sparse linear system:

    I(i, d') = sum_j,e V(i, d', j, e) L(j, e) + I0(i, d'),     L(i, d) = E(i) + sum_d' S(i, d, d') I(i, d')

with V the share of the rays of pair (i, d') that meet pair (j, e), I0 the light of lamps and background, and S the BRDF between bins. It
is the radiance equation (1), with Eq. 10 and 11 as its diffuse case. Gathering relaxes its rows (Jacobi, Gauss-Seidel), shooting its
columns (Southwell); the limit is one.

D. S. Immel, M. F. Cohen and D. P. Greenberg, "A Radiosity Method for Non-Diffuse Environments", Computer Graphics (SIGGRAPH '86
Proceedings), 20(4), 1986, 133-142.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..adjoint_gi.core.base.resources import require_within
from ..adjoint_gi.core.base.settings import NO_LIMIT, choice, setting
from ..adjoint_gi.core.bsdf import table as bsdf
from ..adjoint_gi.core.bsdf.curves import SHAPES
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES, LOBES
from ..adjoint_gi.core.directional.bins import Bins
from ..adjoint_gi.core.directional.run import DirectionalRun, leaving
from ..adjoint_gi.core.directional.transport import DirectionalTransport, bytes_needed, pairs_needed
from ..adjoint_gi.core.elements.answer import element_count
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, GATHERING_OR_SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Step
from ..adjoint_gi.core.radiosity.element_run import Found
from ..adjoint_gi.core.radiosity.settings import RadiositySettings
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.arrays import Color
from ..adjoint_gi.core.scene.world import World


@dataclass(frozen=True)
class DirectionalSettings(RadiositySettings):
    """Settings of direction discretisation."""

    bin_rows: int = setting(
        8, "Bin Rows", "Rings of direction bins from the normal to the horizon, of equal projected solid angle", min=1, max=64
    )
    bin_columns: int = setting(16, "Bin Columns", "Direction bins in each ring", min=1, max=256)
    rays: int = setting(4, "Rays per Bin", "Rays that each direction bin of each element side casts, once", min=1, max=4096, soft_max=64)
    strategy: str = choice(
        "gathering",
        "Strategy",
        "How the linear system is relaxed; the solution is the same",
        gathering=("Gathering", "Elements collect, bin by bin, what others send them"),
        shooting=("Shooting", "Elements with the most unshot radiance shoot it first (Southwell)"),
    )
    solver: str = common.relaxation(
        "Gathering Solver", "Order of gathering; bounded path lengths are always found by Jacobi, one bounce at a time"
    )
    tolerance: float = common.tolerance(1e-4, "Relative change at which the system is solved")
    max_iterations: int = common.max_iterations(1000, "The method stops with a warning after this many iterations or shots", max=1_000_000)
    memory_limit: int = common.memory_limit("The method does not start when it needs more than this")


@register
class DirectionalRadiosity(Solver):
    """Casts the rays of all (side, bin) pairs, then relaxes the system."""

    spec = MethodSpec(
        id="directional_radiosity",
        number=4,
        label="Directional Radiosity",
        strategies=GATHERING_OR_SHOOTING,
        natures=DETERMINISTIC,
        year=1986,
        authors="D. S. Immel, M. F. Cohen, D. P. Greenberg",
        title="A Radiosity Method for Non-Diffuse Environments",
        equation="L(i, d) = E(i) + sum_d' S(i, d, d') sum_j,e V(i, d', j, e) L(j, e)  (1, with 10 and 11 as its diffuse case)",
        section="5.2.1 (ii)",
        idea="Every element keeps one radiance for each bin of directions; elements and directions together make one sparse linear system.",
        lobes=ALL_LOBES,
        limits=lines("""
            Nothing is sharper than a bin and an element: mirrors and glass show blurred, stepped pictures, beams behind panes spread
            Memory grows with elements times bins times rays; it is said before the start and refused over the limit
            Elements are flat: shading normals change only the camera's direct light
            Lamps are not geometry: mirrors and glass pass on their light as it falls on them, but shadow rays stop at glass
            Light inside glass is given as basic radiance, divided by the square of the index
            A bounded path length is found by Jacobi iterations, whatever the strategy
        """),
        elements=1000,
    )
    Settings = DirectionalSettings

    def memory(self, world: World, receivers: Receivers, settings: DirectionalSettings) -> int:
        """Rays both ways, fields of element sides times bins, scattering matrices, receivers."""
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        own = (x for m in world.scene.materials for x in m.lobes if x.kind in bsdf.LOBE_KINDS)
        lobes = {replace(x, color=Color(), weight=1.0, stack=0, edge=Color()) for x in own}
        parts = sum(LOBES[bsdf.LOBE_KINDS[x.kind]].parts * (1 + x.multiscatter) * (SHAPES if x.varies else 1) for x in lobes)
        bins = settings.bin_rows * settings.bin_columns
        return bytes_needed(2 * count, bins, settings.rays, parts, world.tints) + 600 * count + 1200 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: DirectionalSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages. Raises MemoryRefused before anything is made."""
        remedy = "Lower bin_rows, bin_columns or rays, or raise max_edge or memory_limit"
        require_within(self.spec.label, self.memory(world, receivers, settings), settings.memory_limit, remedy, verb="needs")
        run = BinRun(self, world, receivers, settings)

        # 1. S(i, d, d'); where the receivers lie on the elements, and direct light at them.
        for _ in run.scattering.prepare():
            yield from run.pause(0.0, "Scattering between direction bins")
        yield from run.stage(run.answer.prepare(), 0.0, 0.2, "Receivers and direct light", run.pause)

        # 2. I0(i, d'): light of lamps, by bins.
        arriving = run.field()
        yield from run.stage(run.lamps.run(run.into(arriving)), 0.2, 0.3, "Light of lamps on elements", run.pause)

        # 3. V(i, d', j, e): the rays of all pairs; those that escape bring the background.
        yield from run.stage(run.transport.cast(), 0.3, 0.6, f"Rays of {len(arriving):,} element sides", run.pause)
        if run.emitters.any_background:
            sky = run.emitters.escaping(run.transport.middles()).reshape(arriving.shape)
            arriving += run.transport.sky() * sky
        run.check_lit(arriving)

        # 4. The system L = E + S (V L + I0).
        bounded = settings.max_length < NO_LIMIT or settings.min_length > 2
        by_length = bounded or (settings.strategy == "gathering" and settings.solver == "jacobi")
        yield from (run.by_length if by_length else run.relax)(leaving(run.elements, run.basis), arriving)
        run.check_converged(run.residual, "Raise max_iterations or the tolerance, or lower albedos that are close to 1")
        if run.glass_is_lit((run.first, run.rest)):
            bins = f"{settings.bin_rows} x {settings.bin_columns} bins"
            blurred = f"light that refracts is blurred by {bins}"
            reason = f"{blurred}: with 8 x 16 one pane's flux was within 5 %, a floor below it up to 17 % too dark (30 % at index 2.4)"
            run.warn(reason, "Raise bin_rows, bin_columns and rays, or take Particle Tracing where light comes through glass")
        yield from run.finish(f"Solved in {len(run.clock.history)} iterations")


class BinRun(DirectionalRun):
    """One solve in bins. first, rest: what has arrived (2 ne, bins, 3), of one segment and of more; `residual` of the system."""

    def __init__(self, solver: Solver, world: World, receivers: Receivers, settings: DirectionalSettings) -> None:
        bins = Bins(settings.bin_rows, settings.bin_columns)
        super().__init__(solver, world, receivers, settings, bins, False, pairs_needed(bins.size))
        self.transport = DirectionalTransport(self.caster, self.scattering, settings.rays)
        self.first, self.rest = self.field(), self.field()
        self.balance: EnergyBalance | None = None
        self.residual = 1.0
        self.find = self._find

    def by_length(self, emitted: np.ndarray, arriving: np.ndarray) -> Iterator[Step]:
        """Jacobi: one path length after another, of which those that count are kept."""
        s, length, whole = self.settings, 0, self.field()
        for found, term in self.transport.neumann(emitted, arriving, s.max_length, s.tolerance, s.max_iterations):
            if term is not None:
                length, self.residual = length + 1, found
                whole += term
                if s.min_length <= length:
                    (self.first if length == 1 else self.rest)[:] += term
                self.clock.note(found)
            yield from self.pause(self.relaxed(self.residual, 0.6), f"Path length {length}, residual {self.residual:.1e}")
        if length >= s.max_length:
            self.residual = 0.0  # no longer path counts
        self.balance = self._energy(emitted, arriving, whole)

    def relax(self, emitted: np.ndarray, arriving: np.ndarray) -> Iterator[Step]:
        """Gauss-Seidel gathers rows, Southwell shoots columns; all path lengths at once."""
        s, t = self.settings, self.transport
        direct = t.gather(emitted) + arriving
        whole = np.zeros_like(direct)
        self.first += direct if s.min_length <= 1 else 0.0
        scheme = t.southwell if s.strategy == "shooting" else t.gauss_seidel
        for found in scheme(whole, emitted, arriving, s.tolerance, s.max_iterations):
            if found is not None:
                self.residual = found
                np.maximum(whole - direct, 0.0, out=self.rest)
                self.clock.note(found)
            yield from self.pause(self.relaxed(self.residual, 0.6), f"Iteration {len(self.clock.history)}, residual {self.residual:.1e}")
        np.maximum(whole - direct, 0, out=self.rest)
        self.balance = self._energy(emitted, arriving, whole)

    def _find(self, partial: bool) -> Found:
        return self.found((self.first, self.rest), len(self.transport.met), None if partial else self.balance)

    def _energy(self, emitted: np.ndarray, arriving: np.ndarray, whole: np.ndarray) -> EnergyBalance | None:
        """Flux. Rays of both ends of a path are not the same, so the gap is their error. None where basic radiance is not radiance."""
        if self.scattering.clear:
            return None
        area = self.basis.solid * self.transport.area[:, None, None]
        reflected = self.transport.share * self.scattering.apply(whole)
        gathered = self.transport.gather(emitted + reflected) + arriving
        sent = area * (emitted + reflected)
        escaped, taken = float((sent * self.transport.sky()).sum()), float((sent * self.transport.taken()).sum())
        total, unshot = float((area * (emitted + arriving)).sum()), float((area * (gathered - whole)).sum())
        return EnergyBalance(total, float((area * (gathered - reflected)).sum()) - unshot + taken, escaped, unshot)
