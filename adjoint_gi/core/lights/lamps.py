"""Lamps: how much light each kind sends to a point, how a point on it is drawn, and which rays see it.

Formulas as Cycles has them; their constants are measured in tests/blender/test_extract_lights.py and stated in `scene.Light`.
Vectors are component first, (3, n) float32, relative to `World.center`. Lamps do not block light.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import ONE, PI, TWO_PI, dot
from ..scene.arrays import Light

# NARROW: an area lamp of either shape with a spread, of which only a part shines on a point.
POINT, SPHERE, DISK, RECTANGLE, ELLIPSE, NARROW, SUN, SUN_DISK = range(8)
FAR = np.float32(1e30)  # distance of a sun
INF = np.float32(np.inf)


class Lamps:
    """The lamps of a scene as tables, one column for each.

    kind (k,) int8; sized (k,) bool: not a POINT or SUN; color (3, k): intensity of a POINT, irradiance of a SUN, radiance of the others.
    power (k,) float64: emitted flux in W, the three channels summed; of a sun what falls on the scene's bounding sphere.
    """

    def __init__(self, lights: Sequence[Light], center: np.ndarray, size: float) -> None:
        self.count = len(lights)
        self.kind = np.array([_kind(x) for x in lights], np.int8)
        self.sized = ~np.isin(self.kind, (POINT, SUN))
        self.shadow = np.array([x.shadow for x in lights], bool)
        self.position = _table([np.asarray(x.position, float) - center for x in lights])
        self.x, self.y, self.z = (_table([getattr(x, f"axis_{a}") for x in lights]) for a in "xyz")
        self.radius = np.array([x.radius for x in lights], np.float32)
        self.size_x = np.array([x.size_x for x in lights], np.float32)
        self.size_y = np.array([x.size_y for x in lights], np.float32)
        self.area = self.size_x * self.size_y * np.where(self.kind == ELLIPSE, PI / 4, ONE)

        # The cone of a spot; a point is a spot whose cone is wider than the sphere.
        spot = np.array([x.kind == "spot" for x in lights], bool)
        half = np.array([0.5 * x.spot_angle for x in lights])
        self.any_spot = bool(spot.any())
        self.spot_cos = np.where(spot, np.cos(half), -3.0).astype(np.float32)
        blend = np.array([x.spot_blend for x in lights])
        self.spot_inverse = (1 / np.maximum((1 - np.cos(half)) * blend, 1e-7)).astype(np.float32)
        self.spot_scale = np.array([x.spot_scale for x in lights], np.float32).reshape(-1, 2).T

        # The spread of an area lamp: radiance times max(tan h - tan a, 0) / (tan h - h); the full spread leaves it as it is.
        h = np.clip(0.5 * np.array([x.spread for x in lights]), 1e-3, 1.57)
        self.round = np.array([x.shape == "ELLIPSE" for x in lights], bool)
        self.tan_spread = np.tan(h).astype(np.float32)
        self.spread_norm = (1 / (np.tan(h) - h)).astype(np.float32)

        angle = np.array([0.5 * x.angle for x in lights])
        self.sun_cone = (2 * np.sin(0.5 * angle) ** 2).astype(np.float32)  # 1 - cos, exact for small angles
        color = np.array([x.color for x in lights], float).reshape(-1, 3)
        ball, disk = np.isin(self.kind, (SPHERE, DISK)), self.kind == SUN_DISK
        color[ball] /= np.pi * np.array([x.radius**2 for x in lights], float)[ball, None]
        color[disk] /= np.pi * np.sin(angle[disk, None]) ** 2
        self.color = np.ascontiguousarray(color.T, np.float32)
        self.power = _flux(lights, size)

    def spot(self, i: np.ndarray | int, out: np.ndarray) -> np.ndarray:
        """(n,) share of the intensity that spots `i` send towards unit directions `out` (3, n), which leave the lamp."""
        x = dot(out, self.x[:, i].reshape(3, -1)) / self.spot_scale[0, i]
        y = dot(out, self.y[:, i].reshape(3, -1)) / self.spot_scale[1, i]
        z = -dot(out, self.z[:, i].reshape(3, -1))
        c = z / np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-12))
        t = np.clip((c - self.spot_cos[i]) * self.spot_inverse[i], 0, ONE)
        return t * t * (3 - 2 * t)

    def spread(self, i: np.ndarray | int, cosine: np.ndarray) -> np.ndarray:
        """(n,) share of the radiance that NARROW lamps `i` send at `cosine` (n,) to their normals."""
        cosine = np.maximum(cosine, np.float32(1e-6))
        tangent = np.sqrt(np.maximum(ONE - cosine * cosine, 0)) / cosine
        return np.maximum(self.tan_spread[i] - tangent, 0) * self.spread_norm[i]

    def window(self, i: np.ndarray | int, to: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The rectangle of NARROW lamps `i` that holds all that shines on points, whose way to the lamps' middles is `to` (3, n).

        Lower corner (x, y) and size (x, y), in metres along the lamp's axes from its middle; sizes are 0 where nothing shines.
        """
        reach = np.maximum(dot(to, self.z[:, i].reshape(3, -1)), 0) * self.tan_spread[i]
        out = []
        for axis, size in ((self.x, self.size_x), (self.y, self.size_y)):
            foot = -dot(to, axis[:, i].reshape(3, -1))
            half = np.float32(0.5) * size[i]
            low = np.maximum(foot - reach, -half)
            out.append((low, np.maximum(np.minimum(foot + reach, half) - low, 0)))
        return out[0][0], out[1][0], out[0][1], out[1][1]

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """One point on each lamp `i` (n,) as seen from `p` (3, n): wi (3, n), distance (n,), radiance (3, n), pdf_w (n,).

        A lamp without size has pdf 1 and carries intensity / distance^2, or the sun's irradiance, as radiance.
        """
        kind = self.kind[i]
        present = np.unique(kind)
        if len(present) == 1:
            return self._sample(int(present[0]), i, p, u, v)
        n = len(i)
        wi, distance, radiance, pdf = (
            np.empty((3, n), np.float32),
            np.empty(n, np.float32),
            np.empty((3, n), np.float32),
            np.empty(n, np.float32),
        )
        for k in present:
            which = np.flatnonzero(kind == k)
            part = self._sample(int(k), i[which], p[:, which], u[which], v[which])
            wi[:, which], distance[which], radiance[:, which], pdf[which] = part
        return wi, distance, radiance, pdf

    def _sample(self, kind: int, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """`sample` for lamps of one kind."""
        color = self.color.take(i, axis=1)
        if kind in (SUN, SUN_DISK):
            z = self.z.take(i, axis=1)
            if kind == SUN:
                return z, np.full(len(i), FAR), color, np.ones(len(i), np.float32)
            width = self.sun_cone[i]
            wi, _ = sampling.cone(z, width, u, v)
            return wi, np.full(len(i), FAR), color, 1 / (TWO_PI * width)
        to = self.position.take(i, axis=1) - p
        if kind in (RECTANGLE, ELLIPSE, NARROW):
            area = self.area[i]
            if kind == NARROW:
                low_x, low_y, size_x, size_y = self.window(i, to)
                a, b, area = low_x + u * size_x, low_y + v * size_y, size_x * size_y
                outside = (2 * a / self.size_x[i]) ** 2 + (2 * b / self.size_y[i]) ** 2 > 1
                color *= (area > 0) & ~(self.round[i] & outside)
            elif kind == RECTANGLE:
                a, b = (u - np.float32(0.5)) * self.size_x[i], (v - np.float32(0.5)) * self.size_y[i]
            else:
                a, b = sampling.disk(u, v)
                a, b = a * np.float32(0.5) * self.size_x[i], b * np.float32(0.5) * self.size_y[i]
            to += self.x.take(i, axis=1) * a + self.y.take(i, axis=1) * b
            wi, distance = _unit(to)
            cosine = dot(wi, self.z.take(i, axis=1))
            # One-sided: the lamp shines along -z, so a lit point lies where wi has a positive component along z.
            lit = (cosine > np.float32(1e-6)) & (area > 0)
            pdf = distance * distance / np.where(lit, cosine * area, ONE)
            color *= lit
            if kind == NARROW:
                color *= self.spread(i, cosine)
            return wi, distance, color, np.where(lit, pdf, ONE)
        if kind == SPHERE:
            wi, distance, pdf = self._sample_sphere(self.radius[i], to, u, v)
        elif kind == DISK:
            axis, d = _unit(to)
            r = self.radius[i]
            a, b = sampling.disk(u, v)
            x, y = sampling.frame(axis)
            wi, distance = _unit(to + x * (a * r) + y * (b * r))
            pdf = distance**3 / (np.maximum(d, np.float32(1e-12)) * PI * r * r)
        else:
            wi, distance = _unit(to)
            color /= np.maximum(distance * distance, np.float32(1e-24))
            pdf = np.ones(len(i), np.float32)
        if self.any_spot:
            color *= self.spot(i, -wi)
        return wi, distance, color, pdf

    @staticmethod
    def _sample_sphere(r: np.ndarray, to: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions uniform in the cone that a sphere of radius r at `to` fills; from inside, uniform over all directions."""
        axis, d = _unit(to)
        sine2 = (r / np.maximum(d, np.float32(1e-12))) ** 2
        inside = sine2 >= 1
        width = np.where(inside, 2 * ONE, sine2 / (1 + np.sqrt(np.maximum(ONE - sine2, 0))))
        wi, c = sampling.cone(axis, width, u, v)
        h = np.sqrt(np.maximum(r * r - d * d * np.maximum(ONE - c * c, 0), 0))
        distance = d * c + np.where(inside, h, -h)
        return wi, np.maximum(distance, 0), 1 / (TWO_PI * width)

    def seen(
        self, o: np.ndarray, w: np.ndarray, distance: np.ndarray, lamps: np.ndarray
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """Which rays from `o` along unit `w` (3, n) pass through each of `lamps` before `distance` (n,), inf where they escape.

        Yields lamp, rows (m,), radiance (3, m), pdf_w (m,) of drawing that direction by `sample`. Costs rays x lamps.
        """
        for i in lamps.tolist():
            kind = int(self.kind[i])
            if kind in (POINT, SUN):
                continue
            if kind == SUN_DISK:
                z = self.z[:, i : i + 1]
                # Compared through the sine, as the cosine of a half degree has no digits left in float32.
                cross = w - z * dot(w, z)
                c = 1 - self.sun_cone[i]
                inside = (dot(cross, cross) <= 1 - c * c) & (dot(w, z) > 0) & (distance == INF)
                rows = np.flatnonzero(inside)
                pdf = np.full(len(rows), 1 / (TWO_PI * self.sun_cone[i]), np.float32)
                yield i, rows, np.repeat(self.color[:, i : i + 1], len(rows), axis=1), pdf
                continue
            to = self.position[:, i : i + 1] - o
            rows, pdf, factor = self._pierce(kind, i, to, w, distance)
            if len(rows):
                if self.any_spot and kind in (SPHERE, DISK):
                    factor = factor * self.spot(i, -w[:, rows])
                yield i, rows, self.color[:, i : i + 1] * factor, pdf

    def _pierce(self, kind: int, i: int, to: np.ndarray, w: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the rays that pass through lamp i, their densities and the share of the lamp's radiance they see."""
        along, d2 = dot(to, w), dot(to, to)
        if kind == SPHERE:
            r2 = self.radius[i] ** 2
            off = to - w * along
            h2 = r2 - dot(off, off)
            h = np.sqrt(np.maximum(h2, 0))
            t = np.where(d2 > r2, along - h, along + h)
            rows = np.flatnonzero((h2 > 0) & (t > 0) & (t < limit))
            sine2 = np.minimum(r2 / np.maximum(d2[rows], np.float32(1e-24)), ONE)
            width = np.where(d2[rows] > r2, sine2 / (1 + np.sqrt(ONE - sine2)), 2 * ONE)
            return rows, 1 / (TWO_PI * width), np.ones(len(rows), np.float32)
        if kind == DISK:
            # The disk faces the ray's origin: its plane is at right angles to `to`.
            t = d2 / np.where(along > 0, along, ONE)
            off = w * t - to
            rows = np.flatnonzero((along > 0) & (t < limit) & (dot(off, off) <= self.radius[i] ** 2))
            d = np.sqrt(d2[rows])
            return rows, t[rows] ** 3 / (d * PI * self.radius[i] ** 2), np.ones(len(rows), np.float32)
        z = self.z[:, i : i + 1]
        cosine, height = dot(w, z), dot(to, z)
        lit = (cosine > np.float32(1e-6)) & (height > 0)
        t = height / np.where(lit, cosine, ONE)
        off = w * t - to
        a = dot(off, self.x[:, i : i + 1]) * (2 / self.size_x[i])
        b = dot(off, self.y[:, i : i + 1]) * (2 / self.size_y[i])
        within = a * a + b * b <= 1 if self.round[i] else (np.abs(a) <= 1) & (np.abs(b) <= 1)
        rows = np.flatnonzero(lit & within & (t < limit))
        c, area, factor = cosine[rows], self.area[i], np.ones(len(rows), np.float32)
        if kind == NARROW:
            _, _, size_x, size_y = self.window(i, to[:, rows])
            # Rays along which the lamp is dark lie outside of the window for the most part, and are no hits.
            area, factor = size_x * size_y, self.spread(i, c)
            bright = np.flatnonzero((factor > 0) & (area > 0))
            rows, c, area, factor = rows[bright], c[bright], area[bright], factor[bright]
        return rows, t[rows] ** 2 / (c * area), factor


def _kind(light: Light) -> int:
    if light.kind == "sun":
        return SUN_DISK if light.angle > 0 else SUN
    if light.kind == "area":
        if light.spread < np.pi - 2e-4:
            return NARROW
        return ELLIPSE if light.shape == "ELLIPSE" else RECTANGLE
    if light.radius <= 0:
        return POINT
    return DISK if light.soft_falloff else SPHERE


def _table(rows: list) -> np.ndarray:
    return np.ascontiguousarray(np.array(rows, np.float32).reshape(-1, 3).T)


def _unit(to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and lengths of vectors (3, n); a zero vector keeps a direction, at distance 0."""
    distance = np.sqrt(dot(to, to))
    return to / np.maximum(distance, np.float32(1e-20)), distance


def _flux(lights: Sequence[Light], size: float) -> np.ndarray:
    """(k,) float64: rough emitted flux of each lamp, by which light sampling picks."""
    out = []
    for x in lights:
        solid = 4 * np.pi
        if x.kind == "spot":
            solid = 2 * np.pi * (1 - np.cos(0.5 * x.spot_angle)) * (1 - 0.5 * x.spot_blend)
        elif x.kind == "area":
            solid = np.pi * x.size_x * x.size_y * (np.pi / 4 if x.shape == "ELLIPSE" else 1.0)
        elif x.kind == "sun":
            solid = np.pi * size**2
        out.append(max(0.0, float(sum(x.color))) * max(solid, 1e-6))
    return np.array(out)
