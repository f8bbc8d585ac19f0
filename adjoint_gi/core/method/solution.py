"""What a method returns: emitted, direct and indirect light apart, with everything needed to judge it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..base.errors import Notice

QUANTITIES = ("irradiance", "radiosity", "direct", "indirect", "emitted", "potential")


@dataclass(frozen=True)
class EnergyBalance:
    """Flux in W (sum of the three colour channels): `emitted` = `absorbed` + `escaped` + `unshot` for an exact method.

    Particle tracing also counts: `particles` = (emitted, absorbed, escaped, cut off by the path length).
    """

    emitted: float
    absorbed: float
    escaped: float
    unshot: float = 0.0
    particles: tuple[int, int, int, int] | None = None

    def with_passing(self, flux: float) -> EnergyBalance:
        """The same where light of lamps that meets no surface, `flux`, was not counted."""
        return replace(self, emitted=self.emitted + flux, escaped=self.escaped + flux)

    @property
    def gap(self) -> float:
        """Relative difference between what was emitted and what was accounted for."""
        lost = self.emitted - self.absorbed - self.escaped - self.unshot
        return abs(lost) / self.emitted if self.emitted else 0.0


@dataclass(frozen=True, eq=False)
class Solution:
    """The state of a solve for `n` receivers.

    measure   "irradiance" (texels, vertices, elements): `direct` and `indirect` are irradiance in W m-2 and `emitted` is
              emitted radiosity in W m-2. "radiance" (camera): all three are outgoing radiance in W m-2 sr-1. "potential": shares
              of emitted flux that reach a set of receivers (`core.flux.detectors` has units), `emitted` without a reflection, `direct`
              after one and `indirect` after more.
    emitted, direct, indirect, albedo   (n, 3) float32
    weight    (n,) float32, 0 where a receiver got no sample (its values are 0)
    """

    method: str
    measure: str
    emitted: np.ndarray
    direct: np.ndarray
    indirect: np.ndarray
    albedo: np.ndarray
    weight: np.ndarray
    rays: int = 0
    seconds: float = 0.0  # of work up to this step; the time in which its consumer held a step is none (`method.clock`)
    balance: EnergyBalance | None = None
    left_out: float | None = None  # share of the light that a longest path leaves out, estimated (`walks.path_limit`); None: not known
    emitted_flux: float = 0.0  # of all emitters, W, channels summed; both as `core.lights.flux` defines them, for every method
    entering_flux: float = 0.0  # what of it arrives at surfaces before any reflection
    history: tuple[tuple[float, float], ...] = ()  # (seconds of work, residual, unshot share or relative standard error)
    warnings: tuple[Notice, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    partial: bool = False
    extra: dict[str, np.ndarray] = field(default_factory=dict)  # "elements" (n, 3), "normal" (n, 3), "depth" (n,)

    @property
    def whole(self) -> str:
        """The quantity that `emitted`, `direct` and `indirect` are parts of; of irradiance `emitted` is none."""
        return self.measure

    def quantity(self, name: str) -> np.ndarray:
        """(n, 3) float32 array of one of `QUANTITIES`, or "radiance" for what a camera sees. Potential has no irradiance or radiosity."""
        if name in ("emitted", "direct", "indirect"):
            return getattr(self, name)
        if name == "irradiance" and self.measure == "irradiance":
            return self.direct + self.indirect
        if name == "radiosity" and self.measure == "irradiance":
            return self.emitted + self.albedo * (self.direct + self.indirect)
        if name == self.measure and name in ("radiance", "potential"):
            return self.emitted + self.direct + self.indirect
        raise ValueError(f"a solution in {self.measure} has no {name}")


@dataclass(frozen=True)
class Step:
    """One step of a solver: how far it is, and the partial result on demand (copying it costs, so it is a call)."""

    fraction: float  # 0 to 1, of something true: samples done, energy delivered
    text: str
    solution: Callable[[], Solution]
