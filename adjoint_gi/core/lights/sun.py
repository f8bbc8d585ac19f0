"""Suns: light from one direction, or from the directions of a disk in the sky."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import TWO_PI, dot
from ..scene.arrays import Light
from ..scene.clusters import clusters
from ..scene.world import World
from .base import FAR, INF, LampKind, Rays, Sample, Seen
from .outgoing import cone_directions

SMALLEST_SUN = 0.01  # 1 - cos of the half angle: rays drawn by the cosine hardly ever meet smaller ones


class SunLights(LampKind):
    """Suns. Radiance of the disk is irradiance / (pi sin^2 h), h half its angle; a sun without an angle sends parallel light.

    Their `flux` is the power that enters the spheres around the scene, much of which passes by.
    """

    far = True

    def __init__(self, lights: Sequence[Light], world: World) -> None:
        super().__init__(lights, world)
        self._cone = (2 * np.sin(0.5 * self._half()) ** 2).astype(np.float32)  # 1 - cos, exact for small angles

    @staticmethod
    def form_of(light: Light) -> str:
        """A disk in the sky, or parallel light."""
        return "disk" if light.angle > 0 else "parallel"

    def rough_solid(self, i: int) -> float:
        """What falls on the scene rather than passes by: a disk of the scene's size, m2."""
        return math.pi * self.world.extent**2

    def solid(self, i: int) -> float:
        """Cross-section of the spheres around the scene, times what the tilt of the disk's rim adds, m2."""
        # Radiance is E / (pi sin^2 h) over the disk's solid angle 2 pi (1 - cos h), with h half its angle.
        return clusters(self.world).area * 2 / (1 + math.cos(self.lights[i].angle / 2))

    def emitted(self) -> np.ndarray:
        """(k, 3) float64: radiance of a disk, irradiance of parallel light."""
        color = super().emitted()
        if self.sized:
            color /= np.pi * np.sin(self._half()[:, None]) ** 2
        return color

    def large(self) -> np.ndarray:
        """(k,) bool: whether rays drawn by the cosine meet it often enough to be worth a test."""
        return self._cone >= SMALLEST_SUN

    def _half(self) -> np.ndarray:
        return np.array([0.5 * x.angle for x in self.lights])

    # ---- gathering

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """A uniform direction of the disk."""
        color, z, far = self.color.take(i, axis=1), self.z.take(i, axis=1), np.full(len(i), FAR)
        if self.form == "parallel":
            return Sample(z, far, color, np.ones(len(i), np.float32))
        width = self._cone[i]
        wi, _ = sampling.cone(z, width, u, v)
        return Sample(wi, far, color, 1 / (TWO_PI * width))

    def seen(self, i: int, o: np.ndarray, w: np.ndarray, distance: np.ndarray) -> Seen:
        """Rays that escape into the disk."""
        z = self.z[:, i : i + 1]
        # Compared through the sine, as the cosine of a half degree has no digits left in float32.
        cross = w - z * dot(w, z)
        c = 1 - self._cone[i]
        rows = np.flatnonzero((dot(cross, cross) <= 1 - c * c) & (dot(w, z) > 0) & (distance == INF))
        pdf = np.full(len(rows), 1 / (TWO_PI * self._cone[i]), np.float32)
        return Seen(rows, np.repeat(self.color[:, i : i + 1], len(rows), axis=1), pdf)

    # ---- shooting

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """A uniform direction of the disk; the origin before the scene, on the disk that covers sphere `cell`."""
        local = cone_directions(math.cos(self.lights[i].angle / 2), square[:, 0], square[:, 1])
        direction = -local @ self._frame(i)
        return self.from_far(i, direction, square[:, 2:], cell)
