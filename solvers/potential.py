"""The potential (Pattanaik and Mudur; review, Eq. 2, 4 and 14): how much of the light emitted at a place reaches a set of receivers.

The adjoint of radiance, and the equation that shooting methods solve:

    W(x, Theta) = g(x, Theta) + integral f_r(y) W(y) cos dw                                                        (2)

with g the function of the receiver set S and y the point that is met. Its mean over the hemisphere about a diffuse element is

    W(i) = g(i) + sum_j rho_j F_ij W(j),    Phi = pi sum_i Le(i) A(i) W(i)                                          (14)

W(i) is the share of a unit of flux emitted at i that becomes part of Phi, the flux of S. With S the faces of some objects, Phi is what
leaves them (W, and W has no unit); with S the camera's view, W is in m-2, see `core.flux.detectors`.

Solved by relaxation - Jacobi, or Southwell's shooting of what is left - of the adjoint system of the transport T = rho F, or by random
walks: from a receiver point by the cosine, where every visit to S counts what S scatters of the walk's weight; for the camera, which no
walk would meet by chance, from its picture, where what arrives on an element is its potential.

S. N. Pattanaik and S. P. Mudur, "The Potential Equation and Importance in Illumination Computations", Computer Graphics Forum, 12(2),
1993, 131-136.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.errors import MemoryRefused, Notice
from ..adjoint_gi.core.base.parallel import in_order
from ..adjoint_gi.core.base.settings import choice, setting
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES
from ..adjoint_gi.core.bsdf.table import BsdfTable
from ..adjoint_gi.core.elements.answer import ElementAnswer, element_count, elements_for
from ..adjoint_gi.core.elements.rays import ElementRays
from ..adjoint_gi.core.flux.detectors import Detector, FaceDetector, Flux, detector, flux_by_particles, flux_by_potential
from ..adjoint_gi.core.lights.emission import Particles
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.lights.outgoing import cosine_directions
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.clock import Clock
from ..adjoint_gi.core.method.registry import BOTH_NATURES, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Solution, Step
from ..adjoint_gi.core.radiosity.factor_matrix import FactorMatrix, bytes_needed
from ..adjoint_gi.core.radiosity.lamp_light import LampLight
from ..adjoint_gi.core.radiosity.southwell import Southwell
from ..adjoint_gi.core.radiosity.transports import MatrixTransport, RayTransport, Transport
from ..adjoint_gi.core.receivers.base import Places, Receivers
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks.gathering import Run
from ..adjoint_gi.core.walks.particles import Hits, walk
from ..adjoint_gi.core.walks.radiance import Gathered

WALKS = 1 << 14  # walks in a batch
GROUP = 64  # sides that shoot together
LIGHT_SAMPLES = 8  # for the flux of lamps by Eq. 4
FLUX_PARTICLES = 1 << 16  # for the flux by Eq. 15


@dataclass(frozen=True)
class PotentialSettings(base.Settings):
    """Settings of the potential."""

    max_length: int = common.max_length(
        "Most flights on the way to the receivers that count; 0 leaves only what is emitted by the receivers themselves"
    )
    receivers: str = choice(
        "camera",
        "Receivers",
        "The set of points and directions whose flux matters",
        camera=("Camera View", "Light that reaches the camera through its picture"),
        objects=("Objects", "Light that leaves the objects named below"),
        faces=("Selected Faces", "Light that leaves the selected faces, of the objects named below or of all"),
    )
    objects: str = setting("", "Objects", "Names of the objects that receive, separated by commas")
    both_sides: bool = setting(
        False, "Both Sides", "Faces receive on both sides, as open sheets do; else on their front, which closed objects need"
    )
    solution: str = choice(
        "relaxation",
        "Solution",
        "How the potential equation is solved",
        relaxation=("Relaxation", "Deterministic: the linear system of the elements, diffuse surfaces"),
        walks=("Random Walks", "Nondeterministic: walks that are absorbed or scattered at random, all surfaces"),
    )
    scheme: str = choice(
        "jacobi",
        "Scheme",
        "How the linear system is relaxed",
        jacobi=("Jacobi", "All elements at once; each iteration adds one reflection"),
        southwell=("Southwell", "The elements with the most potential left to pass on, first"),
    )
    factors: str = choice(
        "matrix",
        "Form Factors",
        "How the form factors between elements are found and kept",
        matrix=("Matrix", "All of them: closed forms where they hold, rays elsewhere; memory grows with the square of the elements"),
        rays=("Rays", "A fixed set of rays from each element"),
    )
    rays: int = common.element_rays(1024, "Rays that find the form factors of an element")
    max_edge: float = common.max_edge("Longest edge of the elements; 0 chooses it")
    tolerance: float = common.tolerance(1e-6, "Share of the potential at which relaxation ends")
    max_iterations: int = common.max_iterations(1000, "Relaxation gives up, and says so, after these")
    samples: int = common.samples(
        256, "Walks from each texel, vertex, pixel or element side; for the camera, that many for each element side in all", label="Walks"
    )
    memory_limit: int = common.memory_limit()


@register
class Potential(Solver):
    """Finds the potential of every receiver towards a set of others."""

    spec = MethodSpec(
        id="potential",
        number=13,
        label="Potential",
        strategies=SHOOTING,
        natures=BOTH_NATURES,
        year=1993,
        authors="S. N. Pattanaik, S. P. Mudur",
        title="The Potential Equation and Importance in Illumination Computations",
        equation="W(i) = g(i) + sum_j rho(j) F(ij) W(j), Phi = pi sum Le A W  (2, 4, 14)",
        section="3",
        idea="The adjoint of radiance: how much of the light that a place emits reaches the chosen receivers.",
        lobes=ALL_LOBES,
        limits=lines("""
            Answers the potential, not light: bake it as the quantity potential
            Relaxation takes all surfaces as diffuse; the mean over the hemisphere is what it knows of directions
            A matrix of form factors grows with the square of the elements; refused over the memory limit
            Potential for the camera is found on elements, and is as sharp as they are small
        """),
        elements=1500,
        answers="potential",
    )
    Settings = PotentialSettings

    def memory(self, world: World, receivers: Receivers, settings: PotentialSettings) -> int:
        """The matrix or the rays of the elements, their fields, and the receivers' points; of walks only what is under way."""
        if settings.solution == "walks" and settings.receivers != "camera":
            return receivers.count * 500 + (64 << 20)
        count = element_count(world, receivers, settings.max_edge, self.spec.elements)
        system = 0
        if settings.solution == "relaxation":
            system = bytes_needed(2 * count, settings.rays) if settings.factors == "matrix" else 2 * count * settings.rays * 40
        return system + count * 1000 + receivers.count * 500

    def solve(self, world: World, receivers: Receivers, settings: PotentialSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages of relaxation, or after every few walks."""
        needed = self.memory(world, receivers, settings)
        if settings.solution == "relaxation" and needed > settings.memory_limit << 20:
            reason = f"could need {needed / 2**20:,.0f} MB, over its limit of {settings.memory_limit:,} MB"
            raise MemoryRefused(self.spec.label, reason, "Raise max_edge or memory_limit, or choose random walks")
        detect = detector(world, settings.receivers, settings.objects, settings.both_sides)
        places = Places(receivers, "potential")
        if settings.solution == "walks" and isinstance(detect, FaceDetector):
            yield from _walks_from_receivers(self, world, places, settings, detect, rng)
        else:
            yield from _OnElements(self, world, places, settings, detect, rng).steps()


class _OnElements:
    """Potential on element sides, by relaxation or by walks from the camera; `parts` (3, 2 ne, 3) after 0, 1 and more reflections."""

    def __init__(
        self, solver: Solver, world: World, places: Receivers, settings: PotentialSettings, detect: Detector, rng: np.random.Generator
    ) -> None:
        self.solver, self.world, self.places, self.settings, self.detect, self.rng = solver, world, places, settings, detect, rng
        self.elements = elements_for(world, places, settings.max_edge, solver.spec.elements)
        self.answer = ElementAnswer(self.elements, places)
        self.lamps = LampLight(self.elements, Emitters(world), LIGHT_SAMPLES)
        self.parts = np.zeros((3, 2 * self.elements.count, 3))
        self.area = np.repeat(self.elements.area, 2)[:, None]
        self.rays = 0
        self.clock = Clock()
        self.history: list[tuple[float, float]] = []
        walks = settings.solution == "walks"
        lobes = solver.spec.lobes if walks else frozenset({"diffuse", "emission"})
        self.warnings = world.scene.warnings + world.shading.substitutions(lobes)

    def steps(self) -> Iterator[Step]:
        """All stages."""
        walks = self.settings.solution == "walks"
        for share in self.answer.prepare():
            yield from self.clock.pause(self._step(0.1 * share, "Finding receivers"))
        for share in self.lamps.run():
            yield from self.clock.pause(self._step(0.1 + 0.1 * share, "Where the light of lamps arrives"))
        yield from self._walk() if walks else self._relax()
        if not self.parts.any():
            reason = "are reached by nothing, so the potential is 0 everywhere"
            self.warnings += (Notice("Receivers", reason, "Check the camera's view or the chosen faces"),)
        yield from self.clock.last(self._step(1.0, "Walked" if walks else f"Relaxed in {len(self.history)} iterations", partial=False))

    # ---- relaxation

    def _relax(self) -> Iterator[Step]:
        s = self.settings
        g = np.repeat(self.detect.on_elements(self.elements)[:, None], 3, axis=1)
        self.parts[0] = g * (s.min_length == 0)
        yield from self.clock.pause(self._step(0.2, "Receivers on elements"))
        sides, transport = yield from self._transport(g)
        if not len(sides):
            return
        relax = self._southwell if s.scheme == "southwell" else self._jacobi
        residual, count = 0.0, 0
        for residual in relax(transport, g[sides], sides):
            self.history.append((self.clock.seconds, residual))
            count += 1
            if residual <= s.tolerance or count >= s.max_iterations:
                break
            done = np.log(max(residual, 1e-300)) / np.log(max(s.tolerance, 1e-16)) if s.tolerance < 1 else 1.0
            text = f"Iteration {count}, {residual:.1e} left"
            yield from self.clock.pause(self._step(0.8 + 0.2 * float(np.clip(done, 0, 0.99)), text))
        if residual > s.tolerance:
            reason = f"stopped after {count} iterations with {residual:.1e} left"
            self.warnings += (Notice(self.solver.spec.label, reason, "Raise max_iterations or the tolerance"),)

    def _transport(self, g: np.ndarray) -> Iterator[Step]:
        """Form factors among the sides that see, by reflections, the receivers; returns these sides (n,) and the transport."""
        s, total = self.settings, 2 * self.elements.count
        if s.factors == "rays":
            sides = np.arange(total)
            targets = []
            caster = ElementRays(self.elements)
            for part, met in caster.rows(sides, s.rays):
                targets.append(met.ravel())
                yield from self.clock.pause(self._step(0.2 + 0.6 * (int(part[-1]) + 1) / total, "Rays between elements"))
            self.rays += total * s.rays
            rho = np.repeat(self.elements.albedo, 2, axis=0)
            source = np.repeat(sides, s.rays)
            return sides, RayTransport(self.area[:, 0], rho, source, np.concatenate(targets).astype(np.int64))
        matrix = FactorMatrix(self.elements, s.rays)
        for known in matrix.discover(np.flatnonzero(g.any(axis=1))):
            text = f"Rays from {known:,} element sides"
            yield from self.clock.pause(self._step(0.2 + 0.3 * known / total, text))
        sides = matrix.sides
        if len(sides):
            for share in matrix.build(self.elements.albedo[sides >> 1]):
                yield from self.clock.pause(self._step(0.5 + 0.3 * share, f"Form factors of {len(sides):,} element sides"))
            self.rays += matrix.report.rays
            return sides, matrix.transport
        return sides, MatrixTransport(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 0)))

    def _jacobi(self, transport: Transport, g: np.ndarray, sides: np.ndarray) -> Iterator[float]:
        """W = g + T* g + T*^2 g + ...: term k is the potential by k reflections. Yields the last term's share of all."""
        low, high = self.settings.min_length, self.settings.max_length
        area = self.area[sides]
        term, total = g, g.copy()
        for length in range(1, high + 1):
            term = transport.adjoint(term)
            total += term
            if length >= low:
                self.parts[min(length, 2)][sides] += term
            scale = float((area * total).sum())
            yield float((area * term).sum()) / scale if scale else 0.0
        yield 0.0

    def _southwell(self, transport: Transport, g: np.ndarray, sides: np.ndarray) -> Iterator[float]:
        """Shooting: the sides with the most potential left pass on what they reflect of it. Yields the share that is left."""
        s = self.settings
        state = Southwell(transport, transport.rho * g, np.zeros_like(g), s.min_length, s.max_length)
        whole = float((self.area[sides] * g).sum())
        while True:
            index, _ = state.largest(GROUP)
            if not len(index) or s.max_length == 0:
                yield 0.0
                return
            state.shoot(index, np.full(len(index), s.rays))
            self.parts[1][sides], self.parts[2][sides] = state.direct, state.indirect
            yield float(state.unshot_flux().sum()) / whole if whole else 0.0

    # ---- walks from the camera

    def _walk(self) -> Iterator[Step]:
        """Importance particles from the camera: the first hit is what it sees, the second what it sees by one reflection, and so on."""
        s, sides = self.settings, 2 * self.elements.count
        table = BsdfTable(self.world.scene)
        table = None if table.only_diffuse else table
        wanted = s.samples * sides
        batches = max(16, -(-wanted // (2 * WALKS)))
        n = -(-wanted // batches)
        seed = self.rng.integers(0, 1 << 63, 4).tolist()

        def shoot(index: int) -> tuple[np.ndarray, int]:
            rng = np.random.Generator(np.random.SFC64([*seed, index]))
            notes: list[list[tuple[np.ndarray, np.ndarray]]] = [[], [], []]

            def visit(hits: Hits) -> None:
                if hits.length - 1 >= s.min_length:
                    h = hits.surface
                    notes[min(hits.length, 3) - 1].append((self.elements.side(h.triangle, h.u, h.v, h.side), hits.arriving))

            ends = walk(self.world, self.detect.particles(n, rng), s.max_length + 1, rng, visit, table, importance=True)
            out = np.zeros((3, sides, 3))
            for part, some in zip(out, notes, strict=True):
                for side, weight in some:
                    for c in range(3):
                        part[:, c] += np.bincount(side, weight[:, c], sides)
            return out, ends.rays

        total, squares, area = np.zeros_like(self.parts), np.zeros(sides), np.maximum(self.area, 1e-300)
        for done, (sums, rays) in enumerate(in_order(shoot, range(batches)), 1):
            total += sums
            squares += sums.sum(axis=(0, 2)) ** 2
            self.parts = total / done / area
            self.rays += rays
            if done > 1:
                power = total.sum(axis=(0, 2)) ** 2
                spread = np.maximum(squares - power / done, 0) * done / (done - 1)
                scale = (power / area[:, 0]).sum()
                self.history.append((self.clock.seconds, float(np.sqrt((spread / area[:, 0]).sum() / scale)) if scale else 0.0))
            yield from self.clock.pause(self._step(0.2 + 0.799 * done / batches, f"{done * n:,} of {batches * n:,} walks"))

    # ---- answers

    def _step(self, fraction: float, text: str, partial: bool = True) -> Step:
        return Step(fraction, text, lambda: self._solution(partial))

    def _solution(self, partial: bool) -> Solution:
        found = self.answer.parts(self.parts[1], self.parts[2])
        seen = self.answer.parts(self.parts[0], np.zeros_like(self.parts[0])).direct
        if isinstance(self.detect, FaceDetector):
            seen = _shares(self.world, self.places, self.detect) * np.float32(self.settings.min_length == 0)
        flux = flux_by_potential(self.elements, self.lamps.irradiance, self.parts)
        arrays = found.arrays() | {"emitted": seen, "extra": flux_arrays(flux)}
        return Solution(
            self.solver.spec.id,
            "potential",
            **arrays,
            rays=self.rays + self.lamps.rays + found.rays,
            seconds=self.clock.seconds,
            history=tuple(self.history),
            warnings=self.warnings,
            settings=self.settings.as_dict(),
            partial=partial,
        )


def _walks_from_receivers(
    solver: Solver, world: World, places: Receivers, settings: PotentialSettings, detect: FaceDetector, rng: np.random.Generator
) -> Iterator[Step]:
    """<W(x)> = g(x) + sum_k g(x_k) (Eq. 15) for every receiver, from walks that leave it as light that it emits would."""
    table = BsdfTable(world.scene)
    table = None if table.only_diffuse else table
    run = Run(solver.spec, world, places, settings, Emitters(world))
    flux_rng = np.random.default_rng(rng.integers(0, 1 << 63, 4))
    own = _shares(world, places, detect) * np.float32(settings.min_length == 0)
    extra: dict[str, np.ndarray] = {}

    def estimate(surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
        n = len(surface.triangle)
        direction = cosine_directions(surface.ng, rng.random(n, np.float32), rng.random(n, np.float32))
        start = Particles(world.leave(surface), direction, np.ones((n, 3), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32))
        found = np.zeros((2, n, 3), np.float32)

        def visit(hits: Hits) -> None:
            if hits.length >= settings.min_length:
                on = np.flatnonzero(detect.holds(hits.surface.triangle, hits.surface.side))
                found[min(hits.length, 2) - 1, hits.row[on]] += hits.leaving[on]

        ends = walk(world, start, settings.max_length, rng, visit, table)
        return Gathered(found[0], found[1], ends.rays)

    def finished(step: Step) -> Step:
        return Step(step.fraction, step.text, lambda: replace(step.solution(), emitted=own, extra=extra))

    last = None
    for last in run.steps(estimate, settings.samples, rng):
        if last.fraction < 1.0:
            yield finished(last)
    extra |= flux_arrays(flux_by_particles(world, detect, FLUX_PARTICLES, settings.max_length, flux_rng))
    yield finished(last)


def flux_arrays(flux: Flux) -> dict[str, np.ndarray]:
    """Phi = <W, Le> for `Solution.extra`: "flux" and "flux_error", (3 path lengths, 3 colours) float64."""
    return {"flux": flux.value, "flux_error": flux.error}


def _shares(world: World, places: Receivers, detect: FaceDetector) -> np.ndarray:
    """(n, 3) float32 share of each receiver's points that are in the set."""
    total, count = np.zeros(places.count), np.zeros(places.count)
    for points in places.sites():
        side = np.ones(len(points.receiver))
        if points.towards is not None:
            side = np.einsum("ij,ij->i", world.rows[points.triangle, 9:12], points.towards)
        total += np.bincount(points.receiver, detect.holds(points.triangle, side), places.count)
        count += np.bincount(points.receiver, minlength=places.count)
    return np.repeat((total / np.maximum(count, 1)).astype(np.float32)[:, None], 3, axis=1)
