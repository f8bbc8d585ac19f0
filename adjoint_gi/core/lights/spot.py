"""Spot lamps: point lamps whose intensity falls off towards the edge of a cone, round or elliptic.

`falloff` is the one place of that; gathering asks for it towards a direction, shooting draws directions by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..sampling.maps import dot
from ..scene.arrays import Light
from ..scene.world import World
from .elliptic_cone import EllipticCone
from .outgoing import cone_directions, reject
from .point import PointLights

SMALLEST_SCALE = 1e-6  # of an elliptic cone's axes
SMALLEST_STEP = 1e-7  # of the cosine, over which a hard edge falls off in float32


def falloff(cosine: np.ndarray, edge: np.ndarray | float, slope: np.ndarray | float) -> np.ndarray:
    """(n,) share of the intensity at `cosine` (n,) to the axis: a smooth step that rises from `edge` over 1 / `slope` of the cosine."""
    t = np.clip((cosine - edge) * slope, 0, 1)
    return t * t * (3 - 2 * t)


class SpotLights(PointLights):
    """Spot lamps, of the three forms of point lamps."""

    def __init__(self, lights: Sequence[Light], world: World) -> None:
        super().__init__(lights, world)
        cosine = np.cos([0.5 * x.spot_angle for x in lights])
        blend = np.array([x.spot_blend for x in lights])
        self._edge = cosine.astype(np.float32)
        self._slope = (1 / np.maximum((1 - cosine) * blend, SMALLEST_STEP)).astype(np.float32)
        self._scale = np.maximum(np.array([x.spot_scale for x in lights], np.float32).reshape(-1, 2).T, np.float32(SMALLEST_SCALE))

    def shaped(self, i: np.ndarray | int, radiance: np.ndarray, out: np.ndarray, within: np.ndarray) -> np.ndarray:
        """`radiance` (3, n) as spots `i` send it towards unit directions `out` (3, n), which leave the lamp.

        A sphere has no cone for points `within` (n,) it, as in Cycles.
        """
        x = dot(out, self.x[:, i].reshape(3, -1)) / self._scale[0, i]
        y = dot(out, self.y[:, i].reshape(3, -1)) / self._scale[1, i]
        z = -dot(out, self.z[:, i].reshape(3, -1))
        c = z / np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-12))
        return radiance * np.where(within, np.float32(1), falloff(c, self._edge[i], self._slope[i]))

    def rough_solid(self, i: int) -> float:
        """Solid angle of the round cone, weighted by its falloff, sr."""
        # The falloff's mean over the share `blend` of the cone's range of cosines is a half.
        light = self.lights[i]
        return 2 * math.pi * (1 - math.cos(light.spot_angle / 2)) * (1 - light.spot_blend / 2)

    def solid(self, i: int) -> float:
        """Solid angle of the cone, weighted by its falloff, sr."""
        light = self.lights[i]
        if _is_round(light):
            return self.rough_solid(i)
        return _elliptic(light).solid()

    def directions(self, i: int, square: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n, 3) float64 directions with density proportional to the intensity: uniform in the cone, thinned out by the falloff."""
        light = self.lights[i]
        if not _is_round(light):
            return -_elliptic(light).directions(square[:, :2], rng) @ self._frame(i)
        edge = math.cos(light.spot_angle / 2)
        local = cone_directions(edge, square[:, 0], square[:, 1])
        reject(local, lambda d: _falloff_of(light, d[:, 2]), lambda n: cone_directions(edge, *rng.random((2, n))), rng)
        return -local @ self._frame(i)


def _falloff_of(light: Light, cosine: np.ndarray) -> np.ndarray:
    """`falloff` of one lamp in float64, where a hard edge is as good as sharp."""
    edge = math.cos(light.spot_angle / 2)
    return falloff(cosine, edge, 1 / max((1 - edge) * light.spot_blend, 1e-12))


def _is_round(light: Light) -> bool:
    return tuple(light.spot_scale) == (1.0, 1.0)


def _elliptic(light: Light) -> EllipticCone:
    x, y = np.maximum(light.spot_scale, SMALLEST_SCALE).tolist()
    edge = math.cos(light.spot_angle / 2)
    return EllipticCone((x, y), edge, edge + (1 - edge) * light.spot_blend)
