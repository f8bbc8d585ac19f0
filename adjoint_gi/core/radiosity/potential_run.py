"""One solve of the potential on elements: from its parts on element sides to receivers, and to the flux of the set (review, Eq. 4)."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from ..base.errors import Notice
from ..base.settings import Settings
from ..elements.answer import ElementAnswer, Parts
from ..flux.detectors import Detector, FaceDetector, flux_by_potential
from ..method.registry import Solver
from ..receivers.base import Receivers
from ..scene.world import World
from .element_run import ElementRun, Found
from .lamp_light import LampLight

LIGHT_SAMPLES = 8  # for the flux of lamps by Eq. 4


class PotentialRun(ElementRun):
    """One solve. `parts` (3, 2 ne, 3) float64: potential of element sides after 0, 1 and more reflections; `rays` cast to find it."""

    def __init__(
        self, solver: Solver, world: World, receivers: Receivers, settings: Settings, detect: Detector, lobes: frozenset[str]
    ) -> None:
        super().__init__(solver, world, receivers, settings, lobes)
        self.detect = detect
        self.answer = ElementAnswer(self.elements, receivers)
        self.lamps = LampLight(self.elements, self.emitters, LIGHT_SAMPLES)
        self.parts = np.zeros((3, 2 * self.elements.count, 3))
        self.rays = 0
        self.find = self._find

    def check_reached(self) -> None:
        """Say so where the potential is 0 everywhere."""
        if not self.parts.any():
            reason = "are reached by nothing, so the potential is 0 everywhere"
            self.warnings += (Notice("Receivers", reason, "Check the camera's view or the chosen faces"),)

    def _noise(self, parts: Parts) -> tuple[Notice, ...]:
        """Nothing of light, which the potential is not."""
        return ()

    @cached_property
    def _own(self) -> np.ndarray | None:
        """(n, 3) float32 g at the receivers themselves; None where it is to be taken from the elements."""
        if not isinstance(self.detect, FaceDetector):
            return None
        return self.detect.on_receivers(self.world, self.receivers) * np.float32(self.settings.min_length == 0)

    def _find(self, partial: bool) -> Found:
        found = self.answer.parts(self.parts[1], self.parts[2])
        seen = self.answer.parts(self.parts[0], np.zeros_like(self.parts[0])).direct if self._own is None else self._own
        flux = flux_by_potential(self.elements, self.lamps.irradiance, self.parts)
        return Found(replace(found, emitted=seen), self.rays + self.lamps.rays + found.rays, extra=flux.arrays())
