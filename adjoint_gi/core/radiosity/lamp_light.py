"""Light straight from emitters: of lamps and background on element sides, and at the receivers where it is evaluated there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..base.errors import Notice
from ..base.parallel import in_order
from ..elements import closeness
from ..elements.answer import Gather
from ..elements.elements import Elements
from ..elements.rays import shifted_points
from ..lights.direct import direct_irradiance, halved_irradiance
from ..lights.emitters import Emitters
from ..scene.world import Surface, World
from .settings import RadiositySettings

POINTS = 4  # points of an element that look at the lights, times `light_samples`
POINTS_PER_BATCH = 1 << 14


def receiver_light(world: World, emitters: Emitters, settings: RadiositySettings) -> Gather | None:
    """Direct light for `ElementAnswer`, or None where it is to be taken from the elements."""
    if settings.direct_light == "elements":
        return None

    def gather(surface: Surface, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int]:
        return halved_irradiance(world, emitters, surface, max(2, settings.light_samples), rng)

    return gather


class LampLight:
    """Mean irradiance that lamps and background cause on every element side, from fixed points and random numbers that `seed` begins.

    With `mesh` that of emitting faces as well. `sides` (m,): only on these.
    irradiance   (2 ne, 3) float64 W m-2, complete when `run` has ended; rays: cast for it
    """

    def __init__(
        self,
        elements: Elements,
        emitters: Emitters,
        samples: int,
        mesh: bool = False,
        sides: np.ndarray | None = None,
        seed: Sequence[int] = (),
    ) -> None:
        self.elements, self.seed = elements, seed
        self.mesh = mesh
        self.sides = np.arange(2 * elements.count) if sides is None else sides
        self.emitters = emitters
        self.points = POINTS * samples
        self.irradiance = np.zeros((2 * elements.count, 3))
        self.rays = 0

    def run(self) -> Iterator[float]:
        """Yield the share done."""
        if not (self.emitters.any_drawn(self.mesh) or self.emitters.any_met(self.mesh)):
            return
        total = len(self.sides)
        block = max(1, POINTS_PER_BATCH // self.points)

        def work(first: int) -> tuple[np.ndarray, np.ndarray, int]:
            sides = self.sides[first : first + block]
            owner = np.repeat(sides, self.points)
            a, b, _, _ = shifted_points(np.tile(np.arange(self.points), len(sides)), owner)
            surface = self.elements.surface(owner, a, b)
            light, rays = direct_irradiance(
                self.elements.world, self.emitters, surface, 1, np.random.default_rng([*self.seed, 3, first]), mesh=self.mesh
            )
            return sides, light.reshape(len(sides), self.points, 3).mean(axis=1, dtype=np.float64), rays

        done = 0
        for sides, light, rays in in_order(work, range(0, total, block)):
            self.irradiance[sides] = light
            self.rays += rays
            done += len(sides)
            yield done / total


def light_notices(elements: Elements, emitters: Emitters, irradiance: np.ndarray) -> tuple[Notice, ...]:
    """Warnings where nothing gives light at all, and where light starts too close to other surfaces for the elements.

    irradiance (2 ne, ..): of lamps and background.
    """
    sent = np.repeat(elements.emitted, 2, axis=0)
    if irradiance.shape == sent.shape:
        sent = sent + np.repeat(elements.albedo, 2, axis=0) * irradiance
    close = closeness.notices(elements, np.repeat(elements.area, 2) * sent.sum(axis=1), emitters.lamps)
    if close or elements.emitted.any() or irradiance.any():
        return close
    return (Notice("Scene", "nothing emits light that reaches a surface, so the result is black", "Add a lamp, emission or a background"),)
