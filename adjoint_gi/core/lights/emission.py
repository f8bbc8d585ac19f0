"""Everything that emits, for shooting: particles from meshes, lamps and the background.

The emission function of Pattanaik and Mudur (review, section 8, Eq. 15), sampled so that the particles of one draw carry
equal power. Lamps have no geometry of their own: nothing is hit at the place where a particle starts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..sampling.additive import STEPS, additive
from ..sampling.maps import Stretches
from ..scene.arrays import RayKind
from ..scene.world import World
from .background import Background
from .base import ParticleSource
from .lamps import Lamps
from .mesh import MeshLights


@dataclass(frozen=True, eq=False)
class Particles:
    """Particles on their way.

    origin, direction (n, 3) float32, recentred and unit; weight (n, 3) float32 power of each colour, W;
    light (n,) int32 index into `Emission.names`; dark (n,) float32: how far each lights nothing (`PointLights`), metres;
    reach (n,) float32 or None: how far the first flight may go (a camera's far clipping plane), metres. kind: `RayKind` of that flight.
    far (n,) bool or None: from light that comes from outside of the scene, of which what misses it does not count as emitted.
    """

    origin: np.ndarray
    direction: np.ndarray
    weight: np.ndarray
    light: np.ndarray
    dark: np.ndarray
    reach: np.ndarray | None = None
    kind: np.uint8 = RayKind.SHADOW
    far: np.ndarray | None = None


class Emission:
    """All light sources of a world as one distribution of particles.

    names   what emits: each emissive object, then each lamp, then "Background"; only those with some power
    flux    (k, 3) float64 emitted power of each, W. For the sun and the background it is the power that enters the spheres around
            the scene (`LightKind.far`), much of which passes by. For a textured emission it is a quadrature, although draws use the
            exact values.
    """

    def __init__(self, world: World, sources: list[ParticleSource] | None = None) -> None:
        """`sources`: only these."""
        self.mesh, self.lamps, self.background = MeshLights(world), Lamps(world), Background(world)
        if sources is None:
            sources = self.mesh.sources() + self.lamps.sources() + self.background.sources()
        self._sources = sources
        self._far = np.array([s.kind.far for s in sources], bool)
        self.names = tuple(s.name for s in sources)
        self.flux = np.array([s.flux for s in sources], np.float64).reshape(-1, 3)

        # Every source is divided into cells of known power (a lamp nearby is one cell), and a particle first chooses its cell.
        cells = [s.cells for s in sources]
        self._first = np.concatenate([[0], np.cumsum([len(c) for c in cells])]).astype(np.int64)
        self._cells = Stretches(np.concatenate(cells) if sources else np.zeros(0))

    @property
    def is_dark(self) -> bool:
        """Whether nothing emits."""
        return not self._sources

    @property
    def total(self) -> np.ndarray:
        """(3,) float64 emitted power, W."""
        return self.flux.sum(axis=0)

    def draw(self, n: int, rng: np.random.Generator) -> Particles:
        """`n` particles whose summed weight is the emitted power in expectation (exactly, where no emission is textured), of light from far
        away that which enters any of the spheres around the scene.

        Sources are chosen by power with one jittered point in each n-th of it. Position and direction within a source come from a
        low-discrepancy sequence with a random shift, so each particle alone is distributed as if drawn independently.
        """
        if self.is_dark or n == 0:
            none = np.zeros((0, 3), np.float32)
            return Particles(none, none, none, np.zeros(0, np.int32), np.zeros(0, np.float32))
        # Step 1: the cell of every particle, ascending because the jittered points are.
        point = (np.arange(n) + rng.random(n)) / n
        cell = self._cells.pick(point)
        # Step 2: four coordinates in the unit cube.
        square = additive(np.arange(1, n + 1), STEPS[4], rng.random((4, 1))).T
        # Step 3: every source turns its stretch into rays and says the power its cell would have if it shone everywhere like here.
        origin, direction, weight = (np.empty((n, 3), np.float32) for _ in range(3))
        light, dark = np.empty(n, np.int32), np.zeros(n, np.float32)
        bound = np.searchsorted(cell, self._first)
        for index, source in enumerate(self._sources):
            part = slice(bound[index], bound[index + 1])
            if part.stop > part.start:
                rays = source.shoot(square[part], rng, cell[part] - self._first[index])
                origin[part], direction[part], weight[part] = rays.origin, rays.direction, rays.flux
                light[part] = index
                if rays.dark is not None:
                    dark[part] = rays.dark
        weight /= (n * self._cells.probability[cell])[:, None].astype(np.float32)
        return Particles(origin, direction, weight, light, dark, far=self._far[light])
