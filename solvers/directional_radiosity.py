"""Direction discretisation (Immel, Cohen and Greenberg 1986; review, section 5.2).

Gathering or shooting, deterministic. Radiosity for surfaces that are not diffuse: the unknown is the radiance L(i, d) that side i of an
element sends into bin d of its hemisphere, and all of them make one sparse linear system:

    I(i, d') = mean over rays of L(j, e) + I0(i, d'),     L(i, d) = E(i) + sum_d' S(i, d, d') I(i, d')

with rays from every pair (i, d'), each of which meets one pair (j, e), and S the BRDF between bins. It is the radiance equation (1) with
Eq. 10 and 11 as its diffuse case. Gathering relaxes its rows (Jacobi, Gauss-Seidel), shooting its columns (Southwell); the limit is one.

D. S. Immel, M. F. Cohen and D. P. Greenberg, "A Radiosity Method for Non-Diffuse Environments", Computer Graphics (SIGGRAPH '86
Proceedings), 20(4), 1986, 133-142.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..adjoint_gi.core.base.errors import MemoryRefused, Notice
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf import table as bsdf
from ..adjoint_gi.core.bsdf.curves import SHAPES
from ..adjoint_gi.core.bsdf.lobes import LOBES
from ..adjoint_gi.core.directional.answer import DirectionalAnswer, Light
from ..adjoint_gi.core.directional.bins import Bins
from ..adjoint_gi.core.directional.rays import ArrivingLight, DirectionalRays, Sink
from ..adjoint_gi.core.directional.scattering import Scattering
from ..adjoint_gi.core.directional.transport import DirectionalTransport, bytes_needed, pairs_needed
from ..adjoint_gi.core.elements.answer import element_count, elements_for
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method.registry import MethodSpec, Nature, Solver, Strategy, register
from ..adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from ..adjoint_gi.core.radiosity.schemes import NO_LIMIT
from ..adjoint_gi.core.radiosity.shared import RadiositySettings, dark_notices
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.arrays import Color
from ..adjoint_gi.core.scene.world import World

TARGET = 1000  # elements where max_edge is chosen
STAGES = (0.2, 0.3, 0.6)  # shares at which receivers, lamps and rays are done; the rest is the system
PAUSE = 0.1


@dataclass(frozen=True)
class DirectionalSettings(RadiositySettings):
    """Settings of direction discretisation."""

    bin_rows: int = setting(
        8, label="Bin Rows", help="Rings of direction bins from the normal to the horizon, of equal projected solid angle", min=1, max=64
    )
    bin_columns: int = setting(16, label="Bin Columns", help="Direction bins in each ring", min=1, max=256)
    rays: int = setting(
        4, label="Rays per Bin", help="Rays that each direction bin of each element side casts, once", min=1, max=4096, soft_max=64
    )
    strategy: str = setting(
        "gathering",
        label="Strategy",
        help="How the linear system is relaxed; the solution is the same",
        choices=(
            ("gathering", "Gathering", "Elements collect, bin by bin, what others send them"),
            ("shooting", "Shooting", "Elements with the most unsent radiance send it first (Southwell)"),
        ),
    )
    solver: str = setting(
        "gauss_seidel",
        label="Gathering Solver",
        help="Order of gathering; bounded path lengths are always found by Jacobi, one bounce at a time",
        choices=(("gauss_seidel", "Gauss-Seidel", "Uses new values at once"), ("jacobi", "Jacobi", "Each iteration adds one bounce")),
    )
    tolerance: float = setting(1e-4, label="Tolerance", help="Relative change at which the system is solved", min=0.0, max=1.0)
    max_iterations: int = setting(
        1000, label="Max Iterations", help="The method ends, and says so, after this many iterations or shots", min=1, max=1_000_000
    )
    memory_limit: int = setting(
        2048, label="Memory Limit (MB)", help="The method does not start when it needs more than this", min=1, max=1 << 20
    )


@register
class DirectionalRadiosity(Solver):
    """Casts the rays of all (side, bin) pairs, then relaxes the system."""

    spec = MethodSpec(
        id="directional_radiosity",
        number=4,
        label="Directional Radiosity",
        strategies=(Strategy.GATHERING, Strategy.SHOOTING),
        natures=(Nature.DETERMINISTIC,),
        year=1986,
        authors="D. S. Immel, M. F. Cohen, D. P. Greenberg",
        title="A Radiosity Method for Non-Diffuse Environments",
        equation="L(i, d) = E(i) + sum_d' S(i, d, d') sum_j,e V(i, d', j, e) L(j, e)  (1, with 10 and 11 as its diffuse case)",
        section="5.2",
        idea="Every element keeps one radiance for each bin of directions; elements and directions together make one sparse linear system.",
        limits=(
            "Nothing is sharper than a bin and an element: mirrors and glass show blurred, stepped pictures",
            "Memory grows with elements times bins times rays; it is said before the start and refused over the limit",
            "Elements are flat: shading normals change only the camera's direct light",
            "Lamps are no geometry: mirrors and glass pass on their light as it falls on them, but shadow rays stop at glass",
            "Light inside glass is given as basic radiance, divided by the square of the index",
            "A bounded path length is found by Jacobi iterations, whatever the strategy",
        ),
        lobes=bsdf.ALL_LOBES | {"emission"},
        uses_elements=True,
    )
    Settings = DirectionalSettings

    def element_target(self, settings: DirectionalSettings) -> int:
        """Elements wanted where max_edge is 0."""
        return TARGET

    def memory(self, world: World, receivers: Receivers, settings: DirectionalSettings) -> int:
        """Rays both ways, fields of element sides times bins, scattering matrices, receivers."""
        count = element_count(world, receivers, settings.max_edge, TARGET)
        lobes = {replace(x, color=Color()) for m in world.scene.materials for x in m.lobes if x.kind in bsdf.KINDS}
        tints = [len(LOBES[bsdf.KINDS[x.kind]].tints(np.ones((1, 3)))) for x in lobes]
        parts = sum(t * (1 + x.multiscatter) * (SHAPES if x.varies else 1) for t, x in zip(tints, lobes, strict=True))
        bins = settings.bin_rows * settings.bin_columns
        return bytes_needed(2 * count, bins, settings.rays, parts) + 600 * count + 1200 * receivers.count

    def solve(self, world: World, receivers: Receivers, settings: DirectionalSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages. Raises MemoryRefused before anything is made."""
        needed = self.memory(world, receivers, settings)
        if needed > settings.memory_limit << 20:
            reason = f"needs {needed / 2**20:,.0f} MB, over its limit of {settings.memory_limit:,} MB"
            raise MemoryRefused(self.spec.label, reason, "Lower bin_rows, bin_columns or rays, or raise max_edge or memory_limit")
        yield from _Run(self.spec, world, receivers, settings).steps()


class _Run:
    """The state of one solve."""

    def __init__(self, spec: MethodSpec, world: World, receivers: Receivers, settings: DirectionalSettings) -> None:
        self.spec, self.world, self.receivers, self.settings = spec, world, receivers, settings
        self.started = self.last = time.monotonic()
        self.elements = elements_for(world, receivers, settings.max_edge, TARGET)
        self.emitters = Emitters(world)
        self.caster = DirectionalRays(self.elements)
        self.bins = Bins(settings.bin_rows, settings.bin_columns)
        self.scattering = Scattering(self.elements, bsdf.BsdfTable(world.scene), self.bins, pairs_needed(self.bins.size))
        self.transport = DirectionalTransport(self.caster, self.bins, self.scattering, settings.rays)
        self.answer = DirectionalAnswer(self.caster, receivers, self.emitters, settings, self.scattering)
        self.lamps = ArrivingLight(self.caster, self.emitters, settings.light_samples, background=False)
        shape = (2 * self.elements.count, self.bins.size, 3)
        self.first, self.rest = np.zeros(shape), np.zeros(shape)  # what arrives of length 1, and of more
        self.balance: EnergyBalance | None = None
        self.history: list[tuple[float, float]] = []
        self.warnings = world.scene.warnings + world.shading.substitutions(spec.lobes)

    def steps(self) -> Iterator[Step]:
        receivers_end, lamps_end, rays_end = STAGES
        # 1. Scattering matrices; where the receivers lie on the elements, and direct light at them.
        for _ in self.scattering.prepare():
            yield from self._pause(0.0, "Scattering between direction bins")
        for share in self.answer.prepare():
            yield from self._pause(receivers_end * share, "Receivers and direct light")
        # 2. Light of lamps, by bins.
        arriving = np.zeros_like(self.first)
        for share in self.lamps.run(self._into(arriving)):
            yield from self._pause(receivers_end + (lamps_end - receivers_end) * share, "Light of lamps on elements")
        # 3. The rays of all pairs; those that escape bring the background.
        for share in self.transport.cast():
            yield from self._pause(lamps_end + (rays_end - lamps_end) * share, f"Rays of {len(self.first):,} element sides")
        if self.emitters.any_background:
            sky = self.emitters.escaping(self.transport.middles()).reshape(arriving.shape)
            arriving += self.transport.sky()[..., None] * sky
        leaving = np.repeat(self.elements.emitted / np.pi, 2, axis=0)[:, None] * np.ones((1, self.bins.size, 1))
        self.warnings += dark_notices(self.elements, arriving)
        # 4. The system.
        yield from self._relax(leaving, arriving, rays_end)
        yield Step(1.0, f"Solved in {len(self.history)} iterations", self._maker(False))

    def _into(self, arriving: np.ndarray) -> Sink:
        def sink(side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
            flat = arriving.reshape(-1, 3)
            pair = side * self.bins.size + self.bins.of(w)
            first = int(pair.min(initial=0))
            for c in range(3):
                sums = np.bincount(pair - first, value[:, c] / self.bins.solid)
                flat[first : first + len(sums), c] += sums

        return sink

    def _relax(self, leaving: np.ndarray, arriving: np.ndarray, done: float) -> Iterator[Step]:
        s, t = self.settings, self.transport
        low, high = s.min_length, s.max_length
        bounded = high < NO_LIMIT or low > 2
        residual = 1.0
        if bounded or (s.strategy == "gathering" and s.solver == "jacobi"):
            length = 0
            for found, term in t.neumann(leaving, arriving, high, s.tolerance, s.max_iterations):
                if term is not None:
                    length, residual = length + 1, found
                    if low <= length:
                        (self.first if length == 1 else self.rest)[:] += term
                    self._note(residual)
                yield from self._pause(self._progress(done, residual), f"Path length {length}, residual {residual:.1e}")
            solved = residual <= s.tolerance or length >= high
            if low <= 1 and high >= NO_LIMIT:
                self.balance = self._energy(leaving, arriving, self.first + self.rest)
        else:
            direct = t.gather(leaving) + arriving
            whole = np.zeros_like(direct)
            scheme = t.southwell if s.strategy == "shooting" else t.gauss_seidel
            self.first += direct if low <= 1 else 0.0
            for found in scheme(whole, leaving, arriving, s.tolerance, s.max_iterations):
                if found is not None:
                    residual = found
                    np.maximum(whole - direct, 0.0, out=self.rest)
                    self._note(residual)
                yield from self._pause(self._progress(done, residual), f"Iteration {len(self.history)}, residual {residual:.1e}")
            np.maximum(whole - direct, 0, out=self.rest)
            solved = residual <= s.tolerance
            self.balance = self._energy(leaving, arriving, whole)
        if not solved:
            reason = f"stopped after {s.max_iterations} iterations at a relative change of {residual:.1e}"
            self.warnings += (
                Notice(self.spec.label, reason, "Raise max_iterations or the tolerance, or lower albedos that are close to 1"),
            )

    def _progress(self, done: float, residual: float) -> float:
        share = np.log(max(residual, 1e-300)) / np.log(max(self.settings.tolerance, 1e-16)) if self.settings.tolerance < 1 else 1.0
        return done + (1 - done) * float(np.clip(share, 0, 0.99))

    def _note(self, residual: float) -> None:
        self.history.append((time.monotonic() - self.started, residual))

    def _energy(self, leaving: np.ndarray, arriving: np.ndarray, whole: np.ndarray) -> EnergyBalance | None:
        """Flux. Rays of both ends of a path are not the same, so the gap is their error. None where basic radiance is not radiance."""
        if self.scattering.clear:
            return None
        area = self.bins.solid * self.transport.area[:, None, None]
        reflected = self.scattering.apply(whole)
        gathered = self.transport.gather(leaving + reflected) + arriving
        escaped = area * self.transport.sky()[..., None] * (leaving + reflected)
        emitted, unshot = float((area * (leaving + arriving)).sum()), float((area * (gathered - whole)).sum())
        return EnergyBalance(emitted, float((area * (gathered - reflected)).sum()) - unshot, float(escaped.sum()), unshot)

    def _pause(self, fraction: float, text: str) -> Iterator[Step]:
        if time.monotonic() - self.last >= PAUSE:
            yield Step(fraction, text, self._maker(True))
            self.last = time.monotonic()

    def _maker(self, partial: bool) -> Callable[[], Solution]:
        seconds, history, warnings = time.monotonic() - self.started, tuple(self.history), self.warnings

        def make() -> Solution:
            parts = self.answer.parts(self._light(self.first), self._light(self.rest))
            rays = parts.rays + self.lamps.rays + len(self.transport.met)
            return Solution(
                self.spec.id,
                self.receivers.measure,
                **parts.arrays(),
                rays=rays,
                seconds=seconds,
                balance=None if partial else self.balance,
                history=history,
                warnings=warnings,
                settings=self.settings.as_dict(),
                partial=partial,
            )

        return make

    def _light(self, arriving: np.ndarray) -> Light:
        s = self.scattering
        shine = s.apply(arriving, diffuse=False)
        irradiance, base = np.pi * arriving.mean(axis=1), s.below_coat(arriving)
        exitance = np.pi * s.apply(arriving).mean(axis=1)
        return Light(irradiance, base, shine, exitance)
