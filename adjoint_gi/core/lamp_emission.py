"""Particles from lamps, the sun and the background. Units and shapes: `scene.Light`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .scene import Light, Rgb

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]


def lamp_source(light: Light, center: np.ndarray, radius: float) -> LampEmission:
    """The emission of a lamp in a scene that lies within `radius` of `center`; raises ValueError for an unknown kind."""
    kinds = {"point": PointEmission, "spot": PointEmission, "area": AreaEmission, "sun": SunEmission}
    if light.kind not in kinds:
        raise ValueError(f"{light.name}: unknown kind of light {light.kind!r}")
    return kinds[light.kind](light, center, radius)


class LampEmission:
    """Base: one cell with the power of the whole lamp."""

    def __init__(self, light: Light, center: np.ndarray, radius: float) -> None:
        self.light = light
        self.name = light.name
        self.position = np.asarray(light.position, np.float64) - center
        self.frame = np.array([light.axis_x, light.axis_y, light.axis_z], np.float64)
        self.scene_radius = radius
        self.flux = np.asarray(light.color, np.float64) * self.solid()
        self.power = float(self.flux.sum())
        self.cells = np.array([self.power])

    def solid(self) -> float:
        """What the lamp's `color` is multiplied by to give its power."""
        raise TypeError(f"{type(self).__name__} does not define solid()")

    def rays(self, square: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions (n, 3) float64, from points (n, 4) of the unit cube."""
        raise TypeError(f"{type(self).__name__} does not define rays()")

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Origins, directions and the lamp's power, (n, 3) each."""
        origin, direction = self.rays(square, rng)
        return origin, direction, np.broadcast_to(self.flux, (len(cell), 3))


class PointEmission(LampEmission):
    """A point or spot lamp. With a radius it is a sphere whose every point has the same radiance in one direction."""

    def solid(self) -> float:
        """Solid angle, in a spot's cone weighted by its falloff, sr."""
        if self.light.kind == "point":
            return 4 * math.pi
        # The falloff is a smooth step over the share `blend` of the cone's range of cosines; its mean there is a half.
        return 2 * math.pi * (1 - math.cos(self.light.spot_angle / 2)) * (1 - self.light.spot_blend / 2)

    def rays(self, square: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Direction by intensity; the origin is uniform on the disk that the sphere shows in that direction."""
        if self.light.kind == "point":
            direction = sphere_directions(square[:, 0], square[:, 1])
        else:
            low = math.cos(self.light.spot_angle / 2)
            local = cone_directions(low, square[:, 0], square[:, 1])
            reject(local, lambda d: spot_falloff(d[:, 2], self.light), lambda s, t: cone_directions(low, s, t), rng)
            direction = -local @ self.frame
        origin = np.broadcast_to(self.position, direction.shape)
        if self.light.radius > 0:
            # The point where a line through the disk leaves the sphere.
            x, y = disk(square[:, 2], square[:, 3])
            height = np.sqrt(np.maximum(0, 1 - x * x - y * y))
            origin = origin + self.light.radius * (across(direction, x, y) + height[:, None] * direction)
        return origin, direction


class AreaEmission(LampEmission):
    """A rectangle or ellipse that shines on one side, within its spread."""

    def solid(self) -> float:
        """Area times pi: the spread narrows the beam but keeps its power, m2 sr."""
        area = self.light.size_x * self.light.size_y
        return math.pi * area * (math.pi / 4 if self.light.shape == "ELLIPSE" else 1)

    def rays(self, square: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A uniform point; the direction by cosine and spread."""
        if self.light.shape == "ELLIPSE":
            x, y = (0.5 * a for a in disk(square[:, 0], square[:, 1]))
        else:
            x, y = square[:, 0] - 0.5, square[:, 1] - 0.5
        offset = np.stack([x * self.light.size_x, y * self.light.size_y], axis=1)
        origin = self.position + offset @ self.frame[:2]

        # A cosine distribution within the spread, thinned out by the falloff.
        widest = math.sin(min(self.light.spread, math.pi) / 2)
        local = lambert_cone(widest, square[:, 2], square[:, 3])
        if self.light.spread < math.pi and widest > 0:
            reject(local, lambda d: spread_falloff(d[:, 2], self.light), lambda s, t: lambert_cone(widest, s, t), rng)
        return origin, -local @ self.frame


class SunEmission(LampEmission):
    """Light from the directions of a disk in the sky, started outside the scene."""

    def solid(self) -> float:
        """Cross-section of the sphere around the scene, times what the tilt of the disk's rim adds, m2."""
        # Radiance is E / (pi sin^2 h) over the disk's solid angle 2 pi (1 - cos h), with h half its angle.
        return math.pi * self.scene_radius**2 * 2 / (1 + math.cos(self.light.angle / 2))

    def rays(self, square: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A uniform direction of the disk; the origin on a disk that covers the scene."""
        local = cone_directions(math.cos(self.light.angle / 2), square[:, 0], square[:, 1])
        direction = -local @ self.frame
        return from_outside(direction, self.scene_radius, square[:, 2:]), direction


class Background:
    """A constant radiance from all directions, started outside the scene."""

    name = "Background"

    def __init__(self, radiance: Rgb, radius: float) -> None:
        self.scene_radius = radius
        self.flux = np.maximum(np.asarray(radiance, np.float64), 0) * (4 * math.pi**2 * radius**2)
        self.power = float(self.flux.sum())
        self.cells = np.array([self.power])

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Origins, directions and the power that enters the sphere around the scene, (n, 3) each."""
        direction = sphere_directions(square[:, 0], square[:, 1])
        return from_outside(direction, self.scene_radius, square[:, 2:]), direction, np.broadcast_to(self.flux, (len(cell), 3))


def spot_falloff(cosine: np.ndarray, light: Light) -> np.ndarray:
    """(n,) share of a spot's intensity at an angle from its axis: a smooth step over `spot_blend` of the cone's cosines."""
    low = math.cos(light.spot_angle / 2)
    inside = cosine - low
    if light.spot_blend <= 0:
        return (inside >= 0).astype(np.float64)
    x = np.clip(inside / max((1 - low) * light.spot_blend, 1e-12), 0, 1)
    return x * x * (3 - 2 * x)


def spread_falloff(cosine: np.ndarray, light: Light) -> np.ndarray:
    """(n,) share of an area lamp's axial radiance that its spread lets through: 1 - tan(angle) / tan(spread / 2), at least 0."""
    tangent = np.sqrt(np.maximum(0, 1 - cosine**2)) / np.maximum(cosine, 1e-12)
    return np.maximum(0, 1 - tangent / math.tan(light.spread / 2))


def reject(local: np.ndarray, keep: Callable, propose: Callable, rng: np.random.Generator) -> None:
    """Replace the directions in `local` (n, 3) until each has passed with probability `keep(direction)`, in place."""
    which = np.arange(len(local))
    while len(which):
        which = which[rng.random(len(which)) >= keep(local[which])]
        local[which] = propose(rng.random(len(which)), rng.random(len(which)))


def sphere_directions(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions."""
    return cone_directions(-1.0, s, t)


def cone_directions(low: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) uniform directions with z between `low` and 1."""
    gap = (1 - low) * s  # 1 - z, kept apart because a narrow cone would lose it to rounding
    r = np.sqrt(np.maximum(0, gap * (2 - gap)))
    phi = 2 * np.pi * t
    return np.stack([r * np.cos(phi), r * np.sin(phi), 1 - gap], axis=1)


def lambert_cone(widest: float, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) directions with density proportional to cosine, up to the angle of sine `widest` from z."""
    r = widest * np.sqrt(s)
    phi = 2 * np.pi * t
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(np.maximum(0, 1 - r * r))], axis=1)


def disk(s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y of uniform points of the unit disk."""
    r = np.sqrt(s)
    phi = 2 * np.pi * t
    return r * np.cos(phi), r * np.sin(phi)


def across(direction: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 3) offsets x, y along two axes at right angles to each direction (frame of Duff et al. 2017)."""
    dx, dy, dz = direction.T
    sign = np.where(dz < 0, -1.0, 1.0)
    a = -1 / (sign + dz)
    b = dx * dy * a
    first = np.stack([1 + sign * dx * dx * a, sign * b, -sign * dx], axis=1)
    second = np.stack([b, sign + dy * dy * a, -dy], axis=1)
    return x[:, None] * first + y[:, None] * second


def from_outside(direction: np.ndarray, radius: float, square: np.ndarray) -> np.ndarray:
    """(n, 3) origins, uniform on the disk before the scene that a beam along `direction` needs to cover it."""
    x, y = disk(square[:, 0], square[:, 1])
    return radius * (across(direction, x, y) - direction)
