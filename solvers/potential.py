"""The potential (Pattanaik and Mudur; review, Eq. 2, 4 and 14): how much of the light emitted at a place reaches a set of receivers.

The adjoint of radiance, and the equation that shooting methods solve:

    W(x, Theta) = g(x, Theta) + integral f_r(y) W(y) cos dw                                                        (2)

with g the function of the receiver set S and y the point that is met. Its mean over the hemisphere about a diffuse element is

    W(i) = g(i) + sum_j rho_j F_ij W(j)                                                                   (before 14)
    Phi = pi sum_i Le(i) A(i) W(i)                                                                               (14)

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
from ..adjoint_gi.core.base.resources import require_within
from ..adjoint_gi.core.base.settings import choice, setting
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES, DIFFUSE_LOBES
from ..adjoint_gi.core.elements.answer import element_count
from ..adjoint_gi.core.flux.detectors import FaceDetector, detector, flux_by_particles
from ..adjoint_gi.core.flux.potential_walks import ReceiverWalks, walks_from_camera
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import BOTH_NATURES, SHOOTING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.radiosity.factor_matrix import bytes_needed
from ..adjoint_gi.core.radiosity.potential_relaxation import PotentialSystem
from ..adjoint_gi.core.radiosity.potential_run import PotentialRun
from ..adjoint_gi.core.receivers.base import Places, Receivers
from ..adjoint_gi.core.scene.world import World
from ..adjoint_gi.core.walks.gathering import Run

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
        southwell=("Southwell", "The elements with the most unshot potential, first"),
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
    max_iterations: int = common.max_iterations(1000, "Relaxation stops with a warning after these")
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
        equation="W(i) = g(i) + sum_j rho(j) F(ij) W(j), Phi = pi sum_i Le(i) A(i) W(i)  (2; 4 and 14)",
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
            per_ray = 100 if world.tints else 40
            matrix = bytes_needed(2 * count, settings.rays, world.tints)
            system = matrix if settings.factors == "matrix" else 2 * count * settings.rays * per_ray
        return system + count * 1000 + receivers.count * 500

    def solve(self, world: World, receivers: Receivers, settings: PotentialSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield through all stages of relaxation, or after every few walks."""
        s = settings
        if s.solution == "relaxation":
            remedy = "Raise max_edge or memory_limit, or choose random walks"
            require_within(self.spec.label, self.memory(world, receivers, s), s.memory_limit, remedy)
        detect = detector(world, s.receivers, s.objects, s.both_sides)
        places = Places(receivers, "potential")
        if s.solution == "relaxation":
            yield from self._relax(PotentialRun(self, world, places, s, detect, DIFFUSE_LOBES))
        elif isinstance(detect, FaceDetector):
            yield from self._walk_from_receivers(Run(self.spec, world, places, s, Emitters(world)), detect, rng)
        else:
            yield from self._walk_from_camera(PotentialRun(self, world, places, s, detect, ALL_LOBES), rng)

    def _relax(self, run: PotentialRun) -> Iterator[Step]:
        """W(i) = g(i) + sum_j rho_j F_ij W(j) (Eq. 2; the series before Eq. 14) on diffuse elements."""
        s = run.settings
        yield from _prepare(run)

        # 1. g(i): what the receivers see of every element.
        system = PotentialSystem(run.elements, run.detect.on_elements(run.elements), s.rays, s.min_length, s.max_length)
        run.parts = system.parts
        yield from run.step(0.2, "Receivers on elements")

        # 2. F_ij among the sides that see the receivers by reflections.
        for share, text in system.find_factors(s.factors):
            yield from run.step(0.2 + 0.6 * share, text)
        run.rays = system.rays

        # 3. W = g + T* W, by iterations.
        residual = 0.0
        for residual in system.relax(s.scheme):
            run.clock.note(residual)
            if residual <= s.tolerance or len(run.clock.history) >= s.max_iterations:
                break
            yield from run.step(run.relaxed(residual, 0.8), f"Iteration {len(run.clock.history)}, {residual:.1e} left")
        if residual > s.tolerance:
            reason = f"stopped after {len(run.clock.history)} iterations with {residual:.1e} left"
            run.warn(reason, "Raise max_iterations or the tolerance")
        run.check_reached()
        yield from run.finish(f"Relaxed in {len(run.clock.history)} iterations")

    def _walk_from_camera(self, run: PotentialRun, rng: np.random.Generator) -> Iterator[Step]:
        """Importance that leaves the camera; what arrives on an element is its potential."""
        s = run.settings
        yield from _prepare(run)
        for found in walks_from_camera(run.world, run.elements, run.detect, s.samples, s.min_length, s.max_length, rng):
            run.parts, run.rays = found.parts, found.rays
            if found.error is not None:
                run.clock.note(found.error)
            yield from run.step(0.2 + 0.799 * found.done / found.walks, f"{found.done:,} of {found.walks:,} walks")
        run.check_reached()
        yield from run.finish("Walked")

    def _walk_from_receivers(self, run: Run, detect: FaceDetector, rng: np.random.Generator) -> Iterator[Step]:
        """<W(x)> = g(x) + sum_k g(x_k) (before Eq. 15) for every receiver, from walks that leave it as light that it emits would."""
        s, world = run.settings, run.world
        flux_rng = np.random.default_rng(rng.integers(0, 1 << 63, 4))
        own = detect.on_receivers(world, run.receivers) * np.float32(s.min_length == 0)

        def with_own(step: Step) -> Step:
            return replace(step, solution=lambda: replace(step.solution(), emitted=own, extra=dict(run.extra)))

        last = None
        for last in run.random_samples(s.samples, rng, ReceiverWalks(world, detect, s.min_length, s.max_length)):
            if last.fraction < 1.0:
                yield with_own(last)
        # Phi = <W, Le> by particles of all lights (Eq. 15), which is work as well.
        run.clock.go()
        run.extra = flux_by_particles(world, detect, FLUX_PARTICLES, s.max_length, flux_rng).arrays()
        yield from run.clock.last(with_own(last))


def _prepare(run: PotentialRun) -> Iterator[Step]:
    """Where the receivers lie on the elements; where the light of lamps arrives, which the flux by Eq. 4 needs."""
    yield from run.stage(run.answer.prepare(), 0.0, 0.1, "Finding receivers")
    yield from run.stage(run.lamps.run(), 0.1, 0.2, "Where the light of lamps arrives")
