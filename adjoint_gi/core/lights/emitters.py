"""Everything that emits: triangles, lamps and the background, drawn from one table by power or met by rays.

The background is constant and is only met by rays that escape; drawing directions by the cosine is already its best density.
Vectors inside are component first, (3, n) float32; `Emitters.sample`, `pdf` and `along` take and give rows, (n, 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import PowerTable, columns, dot
from .lamps import RECTANGLE, SUN_DISK, Lamps

if TYPE_CHECKING:
    from ..scene.world import World

# Rays meet lamps by testing every ray against every lamp. With more lamps than this, or with lamps too small to be met often,
# bounces leave the lamps to light sampling alone, which is as unbiased. Camera and mirror rays are always tested against all.
MOST_LAMPS = 16
SMALLEST_LAMP = 0.05  # of the scene's size
SMALLEST_SUN = 0.01  # 1 - cos of the half angle
TEXTURED_POINTS = 64  # points at which a textured triangle's mean emission is measured


@dataclass(frozen=True, eq=False)
class LightSample:
    """One light point for each of n receiving points.

    wi (n, 3) unit directions to it; distance (n,) free length for a shadow ray from the receiving point, just short of the
    emitter; radiance (n, 3) arriving if nothing is in between, 0 where the emitter does not shine this way; pdf_w (n,) density
    per solid angle times the probability of the pick; delta (n,): from a lamp without size, whose radiance is intensity /
    distance^2 (or the sun's irradiance) and whose pdf_w is the probability of the pick. `shared` (n,): rays can meet it too, so
    that weights of multiple importance sampling are due. `shadow` (n,): whether things cast shadows in its light.
    """

    wi: np.ndarray
    distance: np.ndarray
    radiance: np.ndarray
    pdf_w: np.ndarray
    delta: np.ndarray
    shared: np.ndarray
    shadow: np.ndarray


class Emitters:
    """The emitters of a world.

    triangles (k,) int32 that emit; density (nt,) float32: of light sampling per area on each triangle;
    background (3,) float32 radiance; lamps the tables of the lamps; power (W, the channels summed) of each part of `table`.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.lamps = Lamps(world.scene.lights, world.center, world.size)
        self.background = np.maximum(np.asarray(world.scene.background, np.float32), 0)
        self.any_background = bool(self.background.any())

        mean = _mean_emission(world)
        flux = 2 * np.pi * world.area * mean.sum(axis=1)  # both sides
        self.triangles = np.flatnonzero(flux > 0).astype(np.int32)
        self.any_mesh = len(self.triangles) > 0
        rows = world.rows[self.triangles]
        self._corner, self._e1, self._e2, self._ng = (columns(rows[:, a : a + 3]) for a in (0, 3, 6, 9))
        self._radiance = None if world.shading.emission_varies else columns(mean[self.triangles])

        # One table over triangles, then lamps; a second one for methods that treat the triangles as elements.
        self.power = np.concatenate([flux[self.triangles], self.lamps.power])
        self.table = PowerTable(self.power)
        self.lamp_table = PowerTable(self.lamps.power)
        self._pick = self.table.probability.astype(np.float32)
        self._lamp_pick = self.lamp_table.probability.astype(np.float32)
        self.density = np.zeros(world.triangle_count, np.float32)
        area = np.maximum(world.area[self.triangles], 1e-300)
        self.density[self.triangles] = np.minimum(self.table.probability[: len(self.triangles)] / area, 1e30)
        self._triangle_density = self.density[self.triangles]

        self.sized = np.flatnonzero(self.lamps.sized & (self.lamps.power > 0))
        self.shared = self._shared()
        self._is_shared = np.zeros(self.lamps.count, bool)
        self._is_shared[self.shared] = True

    def _shared(self) -> np.ndarray:
        """Lamps that bounced rays are tested against."""
        x = self.lamps
        size = np.where(x.kind >= RECTANGLE, np.maximum(x.size_x, x.size_y), 2 * x.radius)
        large = np.where(x.kind == SUN_DISK, x.sun_cone >= SMALLEST_SUN, size >= SMALLEST_LAMP * self.world.size)
        out = self.sized[(large & x.shadow)[self.sized]]
        return out if len(out) <= MOST_LAMPS else out[:0]

    def any_drawn(self, mesh: bool = True) -> bool:
        """Whether there is anything to draw light points from."""
        return (self.table if mesh else self.lamp_table).count > 0

    def any_met(self, mesh: bool = True) -> bool:
        """Whether a bounced ray can meet emission."""
        return self.any_background or (mesh and self.any_mesh) or len(self.shared) > 0

    def draw(self, p: np.ndarray, u: np.ndarray, mesh: bool = True) -> LightSample:
        """Light points for ray origins `p` (3, n) from random numbers `u` (3, n): pick, and two for the point on the emitter.

        The vectors of the result are component first.
        """
        first = len(self.triangles) if mesh else 0
        table, probability = (self.table, self._pick) if mesh else (self.lamp_table, self._lamp_pick)
        index = table.pick(u[0])
        n = len(index)
        if first == len(self.power):
            return self._draw_triangles(index, p, u[1], u[2])
        if first == 0:
            return self._draw_lamps(index, probability[index], p, u[1], u[2])
        out = LightSample(*(np.empty(shape, dtype) for shape, dtype in _layout(n)))
        for a, is_lamp in ((np.flatnonzero(index < first), False), (np.flatnonzero(index >= first), True)):
            if is_lamp:
                part = self._draw_lamps(index[a] - first, probability[index[a]], p[:, a], u[1][a], u[2][a])
            else:
                part = self._draw_triangles(index[a], p[:, a], u[1][a], u[2][a])
            for name in LightSample.__dataclass_fields__:
                getattr(out, name)[..., a] = getattr(part, name)
        return out

    def draw_from(self, index: int, p: np.ndarray, u: float, v: float) -> LightSample:
        """The same point (u, v) of one emitter, an index into `power`, for all ray origins `p` (3, n); pdf_w without the pick."""
        n = p.shape[1]
        a, b = np.full(n, u, np.float32), np.full(n, v, np.float32)
        first = len(self.triangles)
        if index >= first:
            return self._draw_lamps(np.full(n, index - first), np.ones(n, np.float32), p, a, b)
        s = self._draw_triangles(np.full(n, index), p, a, b)
        return replace(s, pdf_w=s.pdf_w / self._pick[index])

    def _draw_triangles(self, k: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> LightSample:
        """Points uniform on the triangles `k`, moved off them towards `p`, so that a shadow ray to them ends before it hits them."""
        a, b = sampling.triangle(u, v)
        to = self._e1.take(k, axis=1)
        to *= a
        other = self._e2.take(k, axis=1)
        other *= b
        to += other
        to += self._corner.take(k, axis=1)
        to -= p
        ng = self._ng.take(k, axis=1)
        side = dot(to, ng)
        to -= np.copysign(np.float32(self.world.offset), side) * ng
        distance = np.sqrt(dot(to, to))
        to /= np.maximum(distance, np.float32(1e-20))
        cosine = np.abs(dot(to, ng))
        radiance = self._radiance.take(k, axis=1) if self._radiance is not None else self._textured(k, a, b)
        pdf = self._triangle_density.take(k)
        pdf *= distance
        pdf *= distance
        pdf /= np.maximum(cosine, np.float32(1e-6))
        yes, no = np.ones(len(k), bool), np.zeros(len(k), bool)
        return LightSample(to, distance, radiance, np.maximum(pdf, np.float32(1e-20)), no, yes, yes)

    def _textured(self, k: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return columns(self.world.shading.emission(self.triangles[k], a, b))

    def _draw_lamps(self, k: np.ndarray, probability: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> LightSample:
        wi, distance, radiance, pdf = self.lamps.sample(k, p, u, v)
        delta = ~self.lamps.sized[k]
        pdf = np.maximum(pdf * probability, np.float32(1e-20))
        return LightSample(wi, distance, radiance, pdf, delta, self._is_shared[k], self.lamps.shadow[k])

    def pdf_met(self, triangle: np.ndarray, w: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """(n,) density per solid angle with which `draw` finds the emitting `triangle` a ray along `w` (3, n) has hit at `distance`."""
        ng = columns(self.world.rows[triangle, 9:12])
        cosine = np.maximum(np.abs(dot(w, ng)), np.float32(1e-6))
        return self.density[triangle] * distance * distance / cosine

    def lamps_met(
        self, o: np.ndarray, w: np.ndarray, distance: np.ndarray, pdf: np.ndarray | None = None, mesh: bool = True
    ) -> np.ndarray | None:
        """(3, n) radiance of lamps that rays pass through before `distance` (n,), inf where they escape; None without any.

        With `pdf` (n,), the density the rays were drawn with: only of the lamps that bounces share with light sampling, each
        weighted by the power heuristic. Without: of all lamps that have a size, unweighted.
        """
        lamps = self.sized if pdf is None else self.shared
        if not len(lamps):
            return None
        out = np.zeros_like(w)
        pick = self._pick[len(self.triangles) :] if mesh else self._lamp_pick
        for i, rows, radiance, pdf_lamp in self.lamps.seen(o, w, distance, lamps):
            if pdf is not None:
                radiance = radiance * sampling.power_heuristic(pdf[rows], pick[i] * pdf_lamp)
            out[:, rows] += radiance
        return out

    def sample(self, position: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> LightSample:
        """One light point, picked by power, for each ray origin `position` (n, 3) (see `World.leave`), lit on the side of `normal`."""
        if not self.any_drawn():
            n = len(position)
            none = np.zeros(n, bool)
            zero = np.zeros((n, 3), np.float32)
            return LightSample(np.asarray(normal, np.float32), np.zeros(n, np.float32), zero, np.ones(n, np.float32), none, none, none)
        s = self.draw(columns(position), rng.random((3, len(position)), np.float32))
        radiance = s.radiance * (dot(s.wi, columns(normal)) > 0)
        return LightSample(s.wi.T, s.distance, radiance.T, s.pdf_w, s.delta, s.shared, s.shadow)

    def pdf(self, triangle: np.ndarray, direction: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """(n,) density per solid angle of `sample` for rays along `direction` (n, 3) that hit `triangle` at `distance`; 0 on what
        does not emit and where `triangle` is -1 (the background)."""
        out = np.zeros(len(triangle), np.float32)
        hit = np.flatnonzero(np.asarray(triangle) >= 0)
        out[hit] = self.pdf_met(triangle[hit], columns(direction[hit]), distance[hit])
        return out

    def along(self, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """(n, 3) float32 radiance of the lamps that rays pass through before `distance`; inf where the ray escapes. Costs rays x lamps."""
        out = self.lamps_met(columns(origin), columns(direction), distance)
        return np.zeros((len(origin), 3), np.float32) if out is None else out.T


def _layout(n: int) -> tuple:
    """Shapes and types of the fields of a `LightSample` of n rows."""
    f, b = np.float32, bool
    return (((3, n), f), ((n,), f), ((3, n), f), ((n,), f), ((n,), b), ((n,), b), ((n,), b))


def _mean_emission(world: World) -> np.ndarray:
    """(nt, 3) float64: mean emitted radiance of every triangle; exact where it is constant."""
    out = np.zeros((world.triangle_count, 3))
    triangles = np.flatnonzero(world.shading.emissive() & (world.area > 0)).astype(np.int32)
    if not len(triangles):
        return out
    points = 1
    if world.shading.emission_varies:
        points = TEXTURED_POINTS
    # A fixed lattice on the triangle; a lattice of one point is the middle.
    k = np.arange(points)
    u, v = (k + 0.5) / points, (0.5 + k * 0.6180339887498949) % 1.0
    for a, b in zip(*sampling.triangle(u.astype(np.float32), v.astype(np.float32)), strict=True):
        n = len(triangles)
        out[triangles] += world.shading.emission(triangles, np.full(n, a, np.float32), np.full(n, b, np.float32))
    out /= points
    if points > 1:
        # A small bright spot may lie between the points: no textured triangle is left out of light sampling.
        out[triangles] = np.maximum(out[triangles], 0.01 * out[triangles].mean(axis=0))
    return out
