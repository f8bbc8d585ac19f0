"""Light of lamps and background on the elements, straight and via mirrors: what first passes have as arriving from outside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..elements.elements import Elements
from ..lights.emitters import Emitters
from ..radiosity.lamp_light import LampLight
from ..walks.mirror_chains import Chains
from .caustics import Caustics


class OutsideLight:
    """Irradiance of element sides that no element sends.

    lamps      light that comes straight, from fixed points of `light_samples` times four on each element
    caustics   light over at least one mirror, from `particles`
    """

    def __init__(self, elements: Elements, emitters: Emitters, chains: Chains, light_samples: int, particles: int) -> None:
        self.lamps = LampLight(elements, emitters, light_samples)
        self.caustics = Caustics(elements, emitters, chains, particles)

    @property
    def straight(self) -> np.ndarray:
        """(2 ne, 3) float64 W m-2 of one segment."""
        return self.lamps.irradiance

    @property
    def passed(self) -> np.ndarray:
        """(3,) float64 W of `straight` that went straight through what lets light pass, so that it is there again further on."""
        elements = self.lamps.elements
        return ((np.repeat(elements.area, 2) - elements.held.area)[:, None] * self.straight).sum(axis=0)

    @property
    def rays(self) -> int:
        """Cast so far."""
        return self.lamps.rays + self.caustics.rays

    def run(self, end: float) -> Iterator[tuple[float, str]]:
        """Yield the share done, up to `end`, and what is being done."""
        for share in self.lamps.run():
            yield 0.5 * end * share, "Light of lamps and background on elements"
        for share in self.caustics.run():
            yield 0.5 * end * (1 + share), "Light of lamps via mirrors"
