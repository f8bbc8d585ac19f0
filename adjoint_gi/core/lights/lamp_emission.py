"""Particles from lamps, the sun and the background. Units and shapes: `scene.Light`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..scene.arrays import Light, Rgb


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of a source: origin, direction (n, 3); flux (n, 3), the power of the source if all of it shone like this ray, W.

    dark (n,) or None: how far the ray lights nothing, metres.
    """

    origin: np.ndarray
    direction: np.ndarray
    flux: np.ndarray
    dark: np.ndarray | None = None


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

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Rays from points (n, 4) of the unit cube; every one has the lamp's power."""
        raise TypeError(f"{type(self).__name__} does not define draw()")

    def _rays(self, origin: np.ndarray, direction: np.ndarray, dark: np.ndarray | None = None) -> Rays:
        return Rays(origin, direction, np.broadcast_to(self.flux, direction.shape), dark)


class PointEmission(LampEmission):
    """A point or spot lamp. With a radius it is a sphere whose every point has the same radiance in one direction.

    With soft falloff it is a disk that faces each receiver. Of the rays in one direction, those that pass the centre at distance b
    then light only what is farther than b^2 / sqrt(radius^2 - b^2): from nearer by, they miss the disk.
    """

    def solid(self) -> float:
        """Solid angle, in a spot's cone weighted by its falloff, sr."""
        if self.light.kind == "point":
            return 4 * math.pi
        if self._is_round:
            # The falloff is a smooth step over the share `blend` of the cone's range of cosines; its mean there is a half.
            return 2 * math.pi * (1 - self._edge) * (1 - self.light.spot_blend / 2)
        # An elliptical cone is a round one, stretched: a rule of Gauss in each half of the falloff, equal steps around.
        blend = self._edge + (1 - self._edge) * self.light.spot_blend
        x, w = np.polynomial.legendre.leggauss(64)
        parts = [(self._edge, blend), (blend, 1.0)]
        c = np.concatenate([a + (b - a) * (x + 1) / 2 for a, b in parts])
        w = np.concatenate([(b - a) * w / 2 for a, b in parts])
        phi = 2 * math.pi * (np.arange(256) + 0.5) / 256
        r = np.sqrt(1 - c * c)
        local = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(c[:, None], 256, 1)], -1)
        density = spot_falloff(local[..., 2], self.light) * self._stretch(local)
        return float(2 * math.pi * (w @ density.mean(axis=1)))

    @property
    def _edge(self) -> float:
        return math.cos(self.light.spot_angle / 2)

    @property
    def _scale(self) -> np.ndarray:
        return np.array([*np.maximum(self.light.spot_scale, 1e-6), 1.0])

    @property
    def _is_round(self) -> bool:
        return tuple(self.light.spot_scale) == (1.0, 1.0)

    def _stretch(self, local: np.ndarray) -> np.ndarray:
        """Solid angle after stretching a direction of the round cone, over that before."""
        scale = self._scale
        return scale.prod() / ((local * scale) ** 2).sum(axis=-1) ** 1.5

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Direction by intensity; the origin is uniform on the disk that the lamp shows in that direction."""
        if self.light.kind == "point":
            direction = sphere_directions(square[:, 0], square[:, 1])
        else:
            direction = -self._spot_directions(square, rng) @ self.frame
        radius = self.light.radius
        if radius <= 0:
            return self._rays(np.broadcast_to(self.position, direction.shape), direction)
        x, y = disk(square[:, 2], square[:, 3])
        offset = radius * across(direction, x, y)
        b2 = x * x + y * y
        height = np.sqrt(np.maximum(0, 1 - b2))
        if self.light.soft_falloff:
            return self._rays(self.position + offset, direction, radius * b2 / np.maximum(height, 1e-9))
        # The point where the line leaves the sphere.
        return self._rays(self.position + offset + radius * height[:, None] * direction, direction)

    def _spot_directions(self, square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        edge = self._edge
        local = cone_directions(edge, square[:, 0], square[:, 1])

        if self._is_round:
            reject(local, lambda d: spot_falloff(d[:, 2], self.light), lambda s, t: cone_directions(edge, s, t), rng)
            return local
        # The stretch is largest on the axis or at the rim, along the shorter axis of the ellipse.
        rim = np.array([[0, 0, 1], [math.sqrt(1 - edge**2), 0, edge], [0, math.sqrt(1 - edge**2), edge]])
        most = self._stretch(rim).max()
        reject(
            local,
            lambda d: spot_falloff(d[:, 2], self.light) * self._stretch(d) / most,
            lambda s, t: cone_directions(edge, s, t),
            rng,
        )
        local = local * self._scale
        return local / np.linalg.norm(local, axis=1)[:, None]


class AreaEmission(LampEmission):
    """A rectangle or ellipse that shines on one side, within its spread."""

    def solid(self) -> float:
        """Area times pi: the spread narrows the beam but keeps its power, m2 sr."""
        area = self.light.size_x * self.light.size_y
        return math.pi * area * (math.pi / 4 if self.light.shape == "ELLIPSE" else 1)

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
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
        return self._rays(origin, -local @ self.frame)


class SunEmission(LampEmission):
    """Light from the directions of a disk in the sky, started outside the scene."""

    def solid(self) -> float:
        """Cross-section of the sphere around the scene, times what the tilt of the disk's rim adds, m2."""
        # Radiance is E / (pi sin^2 h) over the disk's solid angle 2 pi (1 - cos h), with h half its angle.
        return math.pi * self.scene_radius**2 * 2 / (1 + math.cos(self.light.angle / 2))

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """A uniform direction of the disk; the origin on a disk that covers the scene."""
        local = cone_directions(math.cos(self.light.angle / 2), square[:, 0], square[:, 1])
        direction = -local @ self.frame
        return self._rays(from_outside(direction, self.scene_radius, square[:, 2:]), direction)


class Background:
    """A constant radiance from all directions, started outside the scene."""

    name = "Background"

    def __init__(self, radiance: Rgb, radius: float) -> None:
        self.scene_radius = radius
        self.flux = np.maximum(np.asarray(radiance, np.float64), 0) * (4 * math.pi**2 * radius**2)
        self.power = float(self.flux.sum())
        self.cells = np.array([self.power])

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Rays with the power that enters the sphere around the scene."""
        direction = sphere_directions(square[:, 0], square[:, 1])
        return Rays(from_outside(direction, self.scene_radius, square[:, 2:]), direction, np.broadcast_to(self.flux, direction.shape))


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
