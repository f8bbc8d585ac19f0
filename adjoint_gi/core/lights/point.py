"""Point lamps: a point, with a radius a sphere, with soft falloff a disk that faces each receiver.

Formulas as Cycles has them (tests/blender/test_extract_lights.py measures them).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import ONE, PI, TWO_PI, dot
from ..scene.arrays import Light, RayKind
from ..scene.passing import MOST_LAYERS
from ..scene.world import World
from .base import LampKind, Rays, Sample, Seen, unit
from .outgoing import across, sphere_directions

INWARD = 0.25  # share of the rays of a sphere that light what lies in it, where anything does


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

    def shaped(self, i: np.ndarray | int, radiance: np.ndarray, out: np.ndarray, within: np.ndarray) -> np.ndarray:
        """`radiance` (3, n) as lamps `i` send it towards unit directions `out` (3, n), to points that lie `within` (n,) their sphere or
        not: the same everywhere."""
        return radiance

    def _holding(self, i: np.ndarray | int, to: np.ndarray) -> np.ndarray:
        """(n,) bool: whether points lie within the sphere of lamps `i`, whose centres are at `to` (3, n) from there."""
        return (dot(to, to) <= self.radius[i] ** 2) & (self.form == "sphere")

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
        return Sample(wi, distance, self.shaped(i, radiance, -wi, self._holding(i, to)), pdf)

    def seen(self, i: int, o: np.ndarray, w: np.ndarray, distance: np.ndarray) -> Seen:
        """Rays that pass through the sphere or the disk that faces their origin."""
        to = self.position[:, i : i + 1] - o
        rows, pdf = (_through_sphere if self.form == "sphere" else _through_disk)(self.radius[i] ** 2, to, w, distance)
        radiance = np.repeat(self.color[:, i : i + 1], len(rows), axis=1)
        return Seen(rows, self.shaped(i, radiance, -w[:, rows], self._holding(i, to[:, rows])) if len(rows) else radiance, pdf)

    # ---- shooting

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """Direction by intensity; the origin is uniform on the disk that the lamp shows in that direction."""
        direction = self.directions(i, square, rng)
        radius, center = self.lights[i].radius, self.center[i]
        both = self.form == "sphere" and bool(self.holds[i])
        inward = rng.random(len(direction)) < INWARD if both else np.zeros(len(direction), bool)
        if both:
            # Within the sphere every point of it shines all around.
            direction[inward] = sphere_directions(square[inward, 0], square[inward, 1])
        if radius <= 0:
            return self._rays(i, np.broadcast_to(center, direction.shape), direction)
        x, y = sampling.disk(square[:, 2], square[:, 3])
        b2 = x * x + y * y
        middle, half = center + radius * across(direction, x, y), radius * np.sqrt(np.maximum(0, 1 - b2))
        if self.form == "disk":
            dark = radius**2 * b2 / np.maximum(half, 1e-9)
            return self._rays(i, middle, direction, self._behind(i, middle, direction, half, radius**2 * b2, dark, rng))
        if both:
            return self._from_both_sides(i, middle, direction, half, inward)
        # The point where the line leaves the sphere.
        return self._rays(i, middle + half[:, None] * direction, direction)

    @cached_property
    def holds(self) -> np.ndarray:
        """(k,) bool: whether surfaces lie, or may lie, within the sphere of each lamp."""
        return np.array([near(self.world, c, x.radius) for c, x in zip(self.center, self.lights, strict=True)], bool)

    def _from_both_sides(self, i: int, middle: np.ndarray, direction: np.ndarray, half: np.ndarray, inward: np.ndarray) -> Rays:
        """The `inward` (n,) rays start where their line enters the sphere and light what they meet in it; the others start where it leaves.

        From inside the sphere its surface is as bright as from outside, and what lies in it casts no shadow on what lies outside.
        """
        origin = middle + np.where(inward, -half, half)[:, None] * direction
        all_around = np.asarray(self.lights[i].color, np.float64) * 4 * math.pi
        flux = np.where(inward[:, None], all_around / INWARD, self.flux[i] / (1 - INWARD))
        rows = np.flatnonzero(inward)
        flux[rows[self._distance(origin[rows], direction[rows], None) >= 2 * half[rows]]] = 0
        return Rays(origin, direction, flux)

    def _behind(
        self,
        i: int,
        middle: np.ndarray,
        direction: np.ndarray,
        half: np.ndarray,
        b2: np.ndarray,
        dark: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """`dark`, or farther where the disk that faces a receiver lies behind something: at b^2 / t behind `middle` for one at t."""
        if not self.holds[i]:
            return dark
        t = self._distance(middle, -direction, rng)
        return np.where(t < half, np.maximum(dark, b2 / np.maximum(t, 1e-12)), dark)

    def _distance(self, origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """(n,) metres to what casts shadows; with `rng` what lets light straight through is passed by the chance of its share."""
        world, rays = self.world, tuple(np.ascontiguousarray(a, np.float32) for a in (origin, direction))
        hit = world.intersect(*rays, RayKind.SHADOW)
        if rng is None or world.passing is None:
            return hit[3]
        hit, rows = tuple(np.array(a) for a in hit), np.arange(len(origin))
        for _ in range(MOST_LAYERS):
            rows = rows[(hit[0][rows] >= 0) & world.passing.lets[hit[0][rows]]]
            rows = rows[rng.random(len(rows)) < world.passing.grey(*(a[rows] for a in hit[:3]))]
            if not len(rows):
                break
            world.onward(*rays, RayKind.SHADOW, hit, rows)
        return hit[3]

    def directions(self, i: int, square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n, 3) float64 directions with density proportional to the intensity: uniform."""
        return sphere_directions(square[:, 0], square[:, 1])


def near(world: World, center: np.ndarray, radius: float) -> bool:
    """Whether a triangle of `world` may lie within `radius` (m) of `center` (3,): those whose box and plane do."""
    corner, normal = world.rows[:, 0:3], world.rows[:, 9:12]
    e1, e2 = world.rows[:, 3:6], world.rows[:, 6:9]
    low = corner + np.minimum(0, np.minimum(e1, e2))
    high = corner + np.maximum(0, np.maximum(e1, e2))
    apart = np.maximum(np.maximum(low - center, center - high), 0)
    box = np.einsum("ij,ij->i", apart, apart) < radius**2
    return bool((box & (np.abs(np.einsum("ij,ij->i", corner - center, normal)) < radius)).any())


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
