"""Point lamps: a point, with a radius a sphere, with soft falloff a disk that faces each receiver.

Formulas as Cycles has them (tests/blender/test_extract_lights.py measures them).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import ONE, PI, TWO_PI, dot
from ..scene.arrays import Light
from ..scene.world import World
from .base import LampKind, Rays, Sample, Seen, unit
from .outgoing import across, sphere_directions


class PointLights(LampKind):
    """Point lamps. Every point of a sphere or disk sends the same radiance, intensity / (pi radius^2), in one direction.

    The disk of soft falloff faces each receiver. Of the rays in one direction, those that pass the centre at distance b then light
    only what is farther than b^2 / sqrt(radius^2 - b^2): from nearer by, they miss the disk.
    """

    def __init__(self, lights: Sequence[Light], world: World) -> None:
        super().__init__(lights, world)
        self.radius = np.array([x.radius for x in lights], np.float32)
        self.extent = 2 * self.radius

    @staticmethod
    def form_of(light: Light) -> str:
        """A point, a sphere or a disk."""
        if light.radius <= 0:
            return "point"
        return "disk" if light.soft_falloff else "sphere"

    def solid(self, i: int) -> float:
        """Solid angle, sr."""
        return 4 * math.pi

    def emitted(self) -> np.ndarray:
        """(k, 3) float64: intensity of a point, radiance of a sphere or disk."""
        color = super().emitted()
        if self.sized:
            color /= np.pi * np.array([x.radius**2 for x in self.lights], float)[:, None]
        return color

    def shaped(self, i: np.ndarray | int, radiance: np.ndarray, out: np.ndarray) -> np.ndarray:
        """`radiance` (3, n) as lamps `i` send it towards unit directions `out` (3, n): the same everywhere."""
        return radiance

    # ---- gathering

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """A point of the part of a sphere that `p` sees, uniform in solid angle; a uniform one of a disk."""
        radiance = self.color.take(i, axis=1)
        to = self.position.take(i, axis=1) - p
        if self.form == "sphere":
            wi, distance, pdf = _on_sphere(self.radius[i], to, u, v)
        elif self.form == "disk":
            wi, distance, pdf = _on_disk(self.radius[i], to, u, v)
        else:
            wi, distance = unit(to)
            radiance /= np.maximum(distance * distance, np.float32(1e-24))
            pdf = np.ones(len(i), np.float32)
        return Sample(wi, distance, self.shaped(i, radiance, -wi), pdf)

    def seen(self, i: int, o: np.ndarray, w: np.ndarray, distance: np.ndarray) -> Seen:
        """Rays that pass through the sphere or the disk that faces their origin."""
        to = self.position[:, i : i + 1] - o
        rows, pdf = (_through_sphere if self.form == "sphere" else _through_disk)(self.radius[i] ** 2, to, w, distance)
        radiance = np.repeat(self.color[:, i : i + 1], len(rows), axis=1)
        return Seen(rows, self.shaped(i, radiance, -w[:, rows]) if len(rows) else radiance, pdf)

    # ---- shooting

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """Direction by intensity; the origin is uniform on the disk that the lamp shows in that direction."""
        direction = self.directions(i, square, rng)
        radius, center = self.lights[i].radius, self.center[i]
        if radius <= 0:
            return self._rays(i, np.broadcast_to(center, direction.shape), direction)
        x, y = sampling.disk(square[:, 2], square[:, 3])
        offset = radius * across(direction, x, y)
        b2 = x * x + y * y
        height = np.sqrt(np.maximum(0, 1 - b2))
        if self.form == "disk":
            return self._rays(i, center + offset, direction, radius * b2 / np.maximum(height, 1e-9))
        # The point where the line leaves the sphere.
        return self._rays(i, center + offset + radius * height[:, None] * direction, direction)

    def directions(self, i: int, square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n, 3) float64 directions with density proportional to the intensity: uniform."""
        return sphere_directions(square[:, 0], square[:, 1])


def _on_sphere(r: np.ndarray, to: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions uniform in the cone that a sphere of radius r at `to` fills; from inside, uniform over all directions."""
    axis, d = unit(to)
    sine2 = (r / np.maximum(d, np.float32(1e-12))) ** 2
    inside = sine2 >= 1
    width = np.where(inside, 2 * ONE, sine2 / (1 + np.sqrt(np.maximum(ONE - sine2, 0))))
    wi, c = sampling.cone(axis, width, u, v)
    h = np.sqrt(np.maximum(r * r - d * d * np.maximum(ONE - c * c, 0), 0))
    distance = d * c + np.where(inside, h, -h)
    return wi, np.maximum(distance, 0), 1 / (TWO_PI * width)


def _through_sphere(r2: np.float32, to: np.ndarray, w: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the rays that pass through it before `limit`, and the density of `_on_sphere` for their directions."""
    along, d2 = dot(to, w), dot(to, to)
    off = to - w * along
    h2 = r2 - dot(off, off)
    h = np.sqrt(np.maximum(h2, 0))
    t = np.where(d2 > r2, along - h, along + h)
    rows = np.flatnonzero((h2 > 0) & (t > 0) & (t < limit))
    sine2 = np.minimum(r2 / np.maximum(d2[rows], np.float32(1e-24)), ONE)
    width = np.where(d2[rows] > r2, sine2 / (1 + np.sqrt(ONE - sine2)), 2 * ONE)
    return rows, 1 / (TWO_PI * width)


def _on_disk(r: np.ndarray, to: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Uniform points of a disk of radius r at `to` that faces the origin."""
    axis, d = unit(to)
    a, b = sampling.disk(u, v)
    x, y = sampling.frame(axis)
    wi, distance = unit(to + x * (a * r) + y * (b * r))
    return wi, distance, distance**3 / (np.maximum(d, np.float32(1e-12)) * PI * r * r)


def _through_disk(r2: np.float32, to: np.ndarray, w: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the rays that pass through it before `limit`, and the density of `_on_disk` for their directions."""
    along, d2 = dot(to, w), dot(to, to)
    # The disk faces the ray's origin: its plane is at right angles to `to`.
    t = d2 / np.where(along > 0, along, ONE)
    off = w * t - to
    rows = np.flatnonzero((along > 0) & (t < limit) & (dot(off, off) <= r2))
    return rows, t[rows] ** 3 / (np.sqrt(d2[rows]) * PI * r2)
