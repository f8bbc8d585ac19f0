"""What methods on elements x directions share: one solve with the scattering of all surfaces and light on them by direction.

Fields are (2 ne, size, 3) float64, coefficients in the basis of directions (`scattering.Basis`).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..bsdf.table import BsdfTable
from ..elements.elements import Elements
from ..method.registry import Solver
from ..method.solution import EnergyBalance
from ..radiosity.element_run import ElementRun, Found
from ..radiosity.settings import RadiositySettings
from ..receivers.base import Receivers
from ..scene.world import World
from .answer import DirectionalAnswer, light_of
from .pairs import PAIRS
from .rays import ArrivingLight, DirectionalRays, Sink
from .scattering import Basis, Scattering

LIT = 1e-3  # share of all light that arrives somewhere, from which on light on glass is worth a word


class DirectionalRun(ElementRun):
    """One solve. `answer` is what receivers get; `lamps` brings light of lamps, and of the background where `background` is set.

    `pairs` of directions make the scattering of a material.
    """

    def __init__(
        self,
        solver: Solver,
        world: World,
        receivers: Receivers,
        settings: RadiositySettings,
        basis: Basis,
        background: bool,
        pairs: int = PAIRS,
    ) -> None:
        super().__init__(solver, world, receivers, settings)
        self.caster = DirectionalRays(self.elements)
        self.scattering = Scattering(self.elements, BsdfTable(world.scene), basis, pairs)
        self.basis = self.scattering.basis
        self.answer = DirectionalAnswer(self.caster, receivers, self.emitters, settings, self.scattering)
        self.lamps = ArrivingLight(self.caster, self.emitters, settings.light_samples, background)

    def field(self) -> np.ndarray:
        """A field without light, for what arrives."""
        return np.zeros((2 * self.elements.count, self.basis.heard, 3))

    def into(self, field: np.ndarray) -> Sink:
        """Takes light that arrives and adds it to `field`."""
        return lambda side, w, value: self.basis.add(field, side, w, value)

    def glass_is_lit(self, arrived: Iterable[np.ndarray]) -> bool:
        """Whether any light to speak of has `arrived`, fields by path length, on elements that pass it on."""
        flux = self.elements.held.area * sum(self.basis.irradiance(x) for x in arrived).sum(axis=1)
        return bool(flux[np.repeat(self.scattering.passes, 2)].sum() > LIT * flux.sum())

    def found(self, arrived: Iterable[np.ndarray], rays: int, balance: EnergyBalance | None) -> Found:
        """What the receivers get of two fields that have `arrived`, of one segment and of more; `rays` were cast by the transport."""
        parts = self.answer.parts(*(light_of(self.scattering, x) for x in arrived))
        return Found(parts, rays + self.lamps.rays + parts.rays, balance)


def leaving(elements: Elements, basis: Basis) -> np.ndarray:
    """The field of the elements' emission, which is the same in all directions."""
    return (elements.held.emitted / np.pi)[:, None] * basis.even()[:, :, None]
