"""Area lamps: a rectangle or an ellipse that shines on one side, in all directions or within a spread.

Formulas as Cycles has them (tests/blender/test_extract_lights.py measures them).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import ONE, PI, dot
from ..scene.arrays import Light
from ..scene.world import World
from .base import LampKind, Rays, Sample, Seen, unit
from .outgoing import lambert_cone, reject

FULL = np.pi - 2e-4  # a spread from which on a lamp is sampled as one that shines in all directions


def falloff(cosine: np.ndarray, tan_half: np.ndarray | float) -> np.ndarray:
    """(n,) max(tan h - tan a, 0), to which the radiance at angle a to the normal is proportional, h half the spread."""
    cosine = np.maximum(cosine, np.float32(1e-6))
    tangent = np.sqrt(np.maximum(ONE - cosine * cosine, 0)) / cosine
    return np.maximum(tan_half - tangent, 0)


class AreaLights(LampKind):
    """Area lamps. The radiance at angle a is `color` * falloff / (tan h - h): the spread narrows the beam but keeps its power.

    Of a narrow lamp, only the part within a window below the point shines on it, and light points are drawn there.
    """

    def __init__(self, lights: Sequence[Light], world: World) -> None:
        super().__init__(lights, world)
        self.size_x = np.array([x.size_x for x in lights], np.float32)
        self.size_y = np.array([x.size_y for x in lights], np.float32)
        self.extent = np.maximum(self.size_x, self.size_y)
        self._round = np.array([x.shape == "ELLIPSE" for x in lights], bool)
        self.area = self.size_x * self.size_y * np.where(self._round & (self.form != "narrow"), PI / 4, ONE)
        h = np.clip(0.5 * np.array([x.spread for x in lights]), 1e-3, 1.57)
        self._tan_half = np.tan(h).astype(np.float32)
        self._norm = (1 / (np.tan(h) - h)).astype(np.float32)

    @staticmethod
    def form_of(light: Light) -> str:
        """A rectangle, an ellipse, or either with a spread."""
        if light.spread < FULL:
            return "narrow"
        return "ellipse" if light.shape == "ELLIPSE" else "rectangle"

    def solid(self, i: int) -> float:
        """Area times pi, m2 sr."""
        light = self.lights[i]
        return math.pi * (light.size_x * light.size_y) * (math.pi / 4 if light.shape == "ELLIPSE" else 1)

    # ---- gathering

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """A uniform point, of a narrow lamp within its window."""
        radiance = self.color.take(i, axis=1)
        to = self.position.take(i, axis=1) - p
        size_x, size_y, area = self.size_x[i], self.size_y[i], self.area[i]
        if self.form == "narrow":
            low_x, low_y, window_x, window_y = self._window(i, to)
            a, b, area = low_x + u * window_x, low_y + v * window_y, window_x * window_y
            outside = (2 * a / size_x) ** 2 + (2 * b / size_y) ** 2 > 1
            radiance *= (area > 0) & ~(self._round[i] & outside)
        elif self.form == "rectangle":
            a, b = (u - np.float32(0.5)) * size_x, (v - np.float32(0.5)) * size_y
        else:
            a, b = sampling.disk(u, v)
            a, b = a * np.float32(0.5) * size_x, b * np.float32(0.5) * size_y
        to += self.x.take(i, axis=1) * a + self.y.take(i, axis=1) * b
        wi, distance = unit(to)
        cosine = dot(wi, self.z.take(i, axis=1))
        # One-sided: the lamp shines along -z, so a lit point lies where wi has a positive component along z.
        lit = (cosine > np.float32(1e-6)) & (area > 0)
        pdf = distance * distance / np.where(lit, cosine * area, ONE)
        radiance *= lit
        if self.form == "narrow":
            radiance *= falloff(cosine, self._tan_half[i]) * self._norm[i]
        return Sample(wi, distance, radiance, np.where(lit, pdf, ONE))

    def seen(self, i: int, o: np.ndarray, w: np.ndarray, distance: np.ndarray) -> Seen:
        """Rays that pass through the lamp from its bright side."""
        to = self.position[:, i : i + 1] - o
        z = self.z[:, i : i + 1]
        cosine, height = dot(w, z), dot(to, z)
        lit = (cosine > np.float32(1e-6)) & (height > 0)
        t = height / np.where(lit, cosine, ONE)
        off = w * t - to
        a = dot(off, self.x[:, i : i + 1]) * (2 / self.size_x[i])
        b = dot(off, self.y[:, i : i + 1]) * (2 / self.size_y[i])
        within = a * a + b * b <= 1 if self._round[i] else (np.abs(a) <= 1) & (np.abs(b) <= 1)
        rows = np.flatnonzero(lit & within & (t < distance))
        c, area, factor = cosine[rows], self.area[i], np.ones(len(rows), np.float32)
        if self.form == "narrow":
            _, _, size_x, size_y = self._window(i, to[:, rows])
            # Rays along which the lamp is dark lie outside of the window for the most part, and are no hits.
            area, factor = size_x * size_y, falloff(c, self._tan_half[i]) * self._norm[i]
            bright = np.flatnonzero((factor > 0) & (area > 0))
            rows, c, area, factor = rows[bright], c[bright], area[bright], factor[bright]
        return Seen(rows, self.color[:, i : i + 1] * factor, t[rows] ** 2 / (c * area))

    def _window(self, i: np.ndarray | int, to: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The rectangle of narrow lamps `i` that holds all that shines on points, whose way to the lamps' middles is `to` (3, n).

        Lower corner (x, y) and size (x, y), in metres along the lamp's axes from its middle; sizes are 0 where nothing shines.
        """
        reach = np.maximum(dot(to, self.z[:, i].reshape(3, -1)), 0) * self._tan_half[i]
        out = []
        for axis, size in ((self.x, self.size_x), (self.y, self.size_y)):
            foot = -dot(to, axis[:, i].reshape(3, -1))
            half = np.float32(0.5) * size[i]
            low = np.maximum(foot - reach, -half)
            out.append((low, np.maximum(np.minimum(foot + reach, half) - low, 0)))
        return out[0][0], out[1][0], out[0][1], out[1][1]

    # ---- shooting

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """A uniform point; the direction by cosine and spread."""
        light, frame = self.lights[i], self._frame(i)
        if light.shape == "ELLIPSE":
            x, y = (0.5 * a for a in sampling.disk(square[:, 0], square[:, 1]))
        else:
            x, y = square[:, 0] - 0.5, square[:, 1] - 0.5
        offset = np.stack([x * light.size_x, y * light.size_y], axis=1)
        origin = self.center[i] + offset @ frame[:2]

        # A cosine distribution within the spread, thinned out by the falloff.
        widest, tan_half = math.sin(min(light.spread, math.pi) / 2), math.tan(light.spread / 2)

        local = lambert_cone(widest, square[:, 2], square[:, 3])
        if light.spread < math.pi and widest > 0:
            reject(local, lambda d: falloff(d[:, 2], tan_half) / tan_half, lambda n: lambert_cone(widest, *rng.random((2, n))), rng)
        return self._rays(i, origin, -local @ frame)
