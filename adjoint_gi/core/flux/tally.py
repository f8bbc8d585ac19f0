"""Where particles are counted - on element sides, or around the receivers themselves - and their sums over batches."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.settings import Settings
from ..elements.answer import ElementAnswer
from ..elements.elements import Elements
from ..method.solution import EnergyBalance
from ..receivers.base import Receivers
from ..receivers.film import read_surfaces
from ..scene.world import World
from ..walks.particle_density import ParticleDensity
from ..walks.particles import Ends, Hits


@dataclass(frozen=True, eq=False)
class Batch:
    """What one batch of particles brought, per particle: power on the places that are counted (m, 3) float64 in W, direct and indirect;
    area of the places (m,), m2; power shot by each light (k, 3); ends."""

    count: int
    direct: np.ndarray
    indirect: np.ndarray
    area: np.ndarray
    lights: np.ndarray
    ends: Ends


class ElementScore:
    """Counts particles on element sides; between elements the answer is interpolated. count: places."""

    def __init__(self, elements: Elements, receivers: Receivers, settings: Settings) -> None:
        self.elements = elements
        self.count = 2 * elements.count
        self._area = np.repeat(elements.area, 2)
        self._answer = ElementAnswer(elements, receivers, None, settings.min_length, settings.max_length)

    def width(self, *at: np.ndarray) -> np.ndarray:
        """(m,) of what counts particles at barycentrics (m,) of triangles, m: four elements, as the answer is interpolated between them."""
        return 4 * np.sqrt(self.elements.area[self.elements.locate(*at)])

    def prepare(self) -> Iterator[float]:
        """Find where the receivers lie; yields the share done."""
        return self._answer.prepare()

    def note(self, hits: Hits) -> tuple:
        """What must be kept of hits until the batch has ended."""
        s = hits.surface
        return self.elements.side(s.triangle, s.u, s.v, s.side), hits.arriving

    def power(self, notes: list[tuple]) -> np.ndarray:
        """(count, 3) float64 power that arrives on every side, W."""
        out = np.zeros((self.count, 3))
        if notes:
            side, weight = (np.concatenate(x) for x in zip(*notes, strict=True))
            for c in range(3):
                out[:, c] = np.bincount(side, weight[:, c], self.count)
        return out

    def area(self, particles: int, rng: np.random.Generator) -> np.ndarray:
        """(count,) area of every side, m2."""
        return self._area

    def arrays(self, direct: np.ndarray, indirect: np.ndarray, area: np.ndarray) -> tuple[dict[str, Any], int]:
        """The arrays of a `Solution` for the power and area of all places, and the rays it took to find the receivers."""
        per_area = 1 / np.maximum(area, 1e-300)[:, None]
        parts = self._answer.parts(direct * per_area, indirect * per_area)
        return parts.arrays(), parts.rays


class ReceiverScore:
    """Counts particles around the points of texels or vertices (`ParticleDensity`)."""

    def __init__(self, world: World, receivers: Receivers, settings: Settings, particles: int, radius: float) -> None:
        self.world = world
        self.receivers = receivers
        self.density = ParticleDensity(world, receivers, particles, radius)
        self.count = self.density.count
        self._emits = settings.min_length == 0
        none = np.zeros((receivers.count, 3), np.float32)
        self._surfaces = {"emission": none, "albedo": none}

    def width(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(m,) of what counts particles at barycentrics (m,) of triangles, m; 0 where nothing does."""
        owner = self.world.scene.object[triangle]
        return np.where(self.density.receives[owner], 2 * self.density.radius[owner], 0.0)

    def prepare(self) -> Iterator[float]:
        """Read albedo and emission of the receivers; yields the share done."""
        return read_surfaces(self.world, self.receivers, self._surfaces)

    def note(self, hits: Hits) -> tuple:
        """What must be kept of hits until the batch has ended."""
        return hits.surface.triangle, hits.surface.position, hits.surface.ng, hits.arriving

    def power(self, notes: list[tuple]) -> np.ndarray:
        """(count, 3) float64 power that arrives around every point, W."""
        if not notes:
            return np.zeros((self.count, 3))
        return self.density.sum(*(np.concatenate(x) for x in zip(*notes, strict=True)))

    def area(self, particles: int, rng: np.random.Generator) -> np.ndarray:
        """(count,) area around every point, m2, found by as many points as there are particles."""
        return self.density.area(particles, rng)

    def arrays(self, direct: np.ndarray, indirect: np.ndarray, area: np.ndarray) -> tuple[dict[str, Any], int]:
        """The arrays of a `Solution`, and no rays."""
        lit = [self.density.values(x, area) for x in (direct, indirect)]
        found = {
            "emitted": self._surfaces["emission"] * np.float32(np.pi * self._emits),
            "direct": lit[0][0].astype(np.float32),
            "indirect": lit[1][0].astype(np.float32),
            "albedo": self._surfaces["albedo"],
            "weight": (lit[0][1] > 0).astype(np.float32),
            "extra": {},
        }
        return found, 0


class Tally:
    """Sums over batches; a batch weighs as much as it has particles."""

    def __init__(self, places: int, lights: int) -> None:
        self.count = 0
        self.batches = 0
        self.direct, self.indirect = np.zeros((places, 3)), np.zeros((places, 3))
        self._area = np.zeros(places)
        self.squares = np.zeros(places)  # of the power that each batch brought, colours summed
        self.lights = np.zeros((lights, 3))
        self.ends = Ends()

    def add(self, batch: Batch) -> None:
        """Take a batch."""
        self.count += batch.count
        self.batches += 1
        sums = ((self.direct, batch.direct), (self.indirect, batch.indirect), (self._area, batch.area), (self.lights, batch.lights))
        for mine, other in sums:
            mine += batch.count * other
        self.squares += (batch.count * (batch.direct + batch.indirect).sum(axis=1)) ** 2
        self.ends.add(batch.ends, batch.count)

    def per_particle(self, sums: np.ndarray) -> np.ndarray:
        """Mean over all particles so far."""
        return sums / max(1, self.count)

    @property
    def area(self) -> np.ndarray:
        """(places,) float64, m2."""
        return self.per_particle(self._area)

    def relative_error(self) -> float:
        """Relative standard error of the irradiance, root mean square by area, from the spread of the batches; inf where nothing is."""
        if self.batches < 2:
            return float("inf")
        total = (self.direct + self.indirect).sum(axis=1)
        weight = np.where(self.area > 0, 1 / np.maximum(self.area, 1e-300), 0)
        spread = np.maximum(self.squares - total**2 / self.batches, 0) * (self.batches / (self.batches - 1))
        power = weight @ total**2
        return float(np.sqrt((weight @ spread) / power)) if power > 0 else math.inf

    def balance(self) -> EnergyBalance:
        """Where the power went. With smooth shading the gap is what bent normals added, see `Ends`."""
        e, n = self.ends, max(1, self.count)
        energies = (e.emitted_energy, e.absorbed_energy, e.escaped_energy, e.cut_energy)
        return EnergyBalance(*(x / n for x in energies), (e.emitted, e.absorbed, e.escaped, e.cut))
