"""What the radiosity methods share: settings, light from lamps and background on element sides, direct light at receivers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base import settings as base
from ..base.errors import Notice
from ..base.parallel import in_order
from ..base.settings import setting
from ..elements.answer import Gather
from ..elements.elements import Elements
from ..elements.rays import shifted_points
from ..lights.direct import direct_irradiance
from ..lights.emitters import Emitters
from ..scene.world import Surface, World
from .schemes import NO_LIMIT

POINTS = 4  # points of an element that look at the lights, times `light_samples`
BATCH = 1 << 14


@dataclass(frozen=True)
class RadiositySettings(base.Settings):
    """Settings of every radiosity method. The seed has no effect: these methods are deterministic."""

    max_length: int = setting(
        NO_LIMIT,
        label="Max Path Length",
        help="Longest light path that counts: 1 is direct light only, 2 adds one bounce; 1024 is no limit",
        min=0,
        max=NO_LIMIT,
        soft_max=64,
    )
    max_edge: float = setting(
        0.0,
        label="Max Element Edge",
        help="Longest edge of the elements that faces are cut into; 0 chooses it",
        min=0.0,
        max=1e6,
        unit="distance",
    )
    direct_light: str = setting(
        "receivers",
        label="Direct Light",
        help="Where light that comes straight from lamps, background and emitting faces is evaluated in the result",
        choices=(
            ("receivers", "At Receivers", "At every texel, vertex or pixel, so that shadows are sharp; not part of the original method"),
            ("elements", "On Elements", "On the elements, as in the paper: shadows are as sharp as the elements are small"),
        ),
    )
    light_samples: int = setting(
        8,
        label="Light Samples",
        help="Points on lights, and rays to the background, for each receiver point; each element takes four times as many",
        min=1,
        max=4096,
        soft_max=64,
    )


def receiver_light(world: World, emitters: Emitters, settings: RadiositySettings) -> Gather | None:
    """Direct light for `ElementAnswer`, or None where it is to be taken from the elements."""
    if settings.direct_light == "elements":
        return None

    def gather(surface: Surface, rng: np.random.Generator) -> tuple[np.ndarray, int]:
        return direct_irradiance(world, emitters, surface, settings.light_samples, rng)

    return gather


class LampLight:
    """Mean irradiance that lamps and background cause on every element side, from fixed points and fixed random numbers.

    With `mesh` that of emitting faces as well. `sides` (m,): only on these.
    irradiance   (2 ne, 3) float64 W m-2, complete when `run` has ended; rays: cast for it
    """

    def __init__(self, elements: Elements, emitters: Emitters, samples: int, mesh: bool = False, sides: np.ndarray | None = None) -> None:
        self.elements = elements
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
        block = max(1, BATCH // self.points)

        def work(first: int) -> tuple[np.ndarray, np.ndarray, int]:
            sides = self.sides[first : first + block]
            owner = np.repeat(sides, self.points)
            a, b, _, _ = shifted_points(np.tile(np.arange(self.points), len(sides)), owner)
            surface = self.elements.surface(owner, a, b)
            light, rays = direct_irradiance(
                self.elements.world, self.emitters, surface, 1, np.random.default_rng([3, first]), mesh=self.mesh
            )
            return sides, light.reshape(len(sides), self.points, 3).mean(axis=1, dtype=np.float64), rays

        done = 0
        for sides, light, rays in in_order(work, range(0, total, block)):
            self.irradiance[sides] = light
            self.rays += rays
            done += len(sides)
            yield done / total


def dark_notices(elements: Elements, irradiance: np.ndarray) -> tuple[Notice, ...]:
    """A warning where nothing gives light at all."""
    if elements.emitted.any() or irradiance.any():
        return ()
    return (Notice("Scene", "nothing emits light that reaches a surface, so the result is black", "Add a lamp, emission or a background"),)
