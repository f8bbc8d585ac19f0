"""Everything that emits, for gathering: triangles, lamps and the background, drawn from one table by power or met by rays.

What a kind of light does is in its own file; here they are picked, and their densities joined.
Vectors inside are component first, (3, n) float32; `Emitters.sample`, `pdf` and `along` take and give rows, (n, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import PowerTable, columns
from ..sampling.sobol import hashed
from .background import Background
from .flux import LightFlux, light_flux
from .lamps import Lamps
from .mesh import MeshLights
from .places import FEWEST, LightPlaces

if TYPE_CHECKING:
    from ..scene.world import World

# Rays meet lamps by testing every ray against every lamp. With more lamps than this, or with lamps too small to be met often,
# bounces leave the lamps to light sampling alone, which is as unbiased. Camera and mirror rays are always tested against all.
MOST_LAMPS = 16

COARSE = 256  # with more emitters than this the 2^24 steps of a float32 number would show in how often each is picked


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


# Light points of emitters k (n,) of a part, picked with probabilities `pick` (n,), for origins (3, n), from two random numbers (n,).
Draw = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], LightSample]


class _Table:
    """Picks from parts of the emitters by power. Each part has its importance (k,) and a function that draws light points from it."""

    def __init__(self, parts: list[tuple[np.ndarray, Draw]], places: Callable[[np.ndarray], LightPlaces | None] | None = None) -> None:
        parts = [p for p in parts if len(p[0])]
        self.power = np.concatenate([importance for importance, _ in parts]) if parts else np.zeros(0)
        table = PowerTable(self.power)
        self.count, self._index, self.probability = table.count, table.pick, table.probability
        self.pick = table.probability.astype(np.float32)
        self.places = places(self.power) if places else None
        ends = np.cumsum([len(importance) for importance, _ in parts], dtype=np.int64)
        self._parts = [(int(end) - len(part[0]), int(end), part[1]) for end, part in zip(ends, parts, strict=True)]

    def chance(self, p: np.ndarray, index: np.ndarray) -> np.ndarray:
        """(n,) float32 probability with which emitters `index` (n,) are picked at points `p` (3, n)."""
        return self.pick.take(index) if self.places is None else self.places.probability(p, index)

    def draw(self, p: np.ndarray, u: np.ndarray) -> LightSample:
        """Light points for ray origins `p` (3, n) from random numbers `u` (3, n)."""
        if self.places is not None:
            index, pick = self.places.draw(p, refined(u))
        else:
            index = self._index(u[0] if self.count <= COARSE else refined(u))
            pick = self.pick.take(index)
        if len(self._parts) == 1:
            return self._parts[0][2](index, pick, p, u[1], u[2])
        out = LightSample(*(np.empty(shape, dtype) for shape, dtype in _layout(len(index))))
        for first, end, draw in self._parts:
            a = np.flatnonzero((index >= first) & (index < end))
            part = draw(index[a] - first, pick[a], p[:, a], u[1][a], u[2][a])
            for name in LightSample.__dataclass_fields__:
                getattr(out, name)[..., a] = getattr(part, name)
        return out


class Emitters:
    """The emitters of a world.

    mesh, lamps, background: the lights, by kind; triangles (k,) int32 that emit; density (nt,) float32: of light sampling per area
    on each triangle; power (W, the channels summed) of each triangle, then of each lamp, by which light sampling picks.
    sized, seen, shared: numbers of the lamps that mirror rays meet, of those that camera rays meet, and of those that bounced rays meet.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.mesh, self.lamps, self.background = MeshLights(world), Lamps(world), Background(world)
        self.triangles, self.any_mesh, self.any_background = self.mesh.triangles, self.mesh.any, self.background.any
        # Whether light points are drawn from the background, too; rays always meet it.
        self.draws_background = self.any_background and bool(self.background.importance.any())

        # One table over all; one for methods that treat the triangles as elements, and one for those that also trace the background.
        lamps = [(self.lamps.importance, self._draw_lamps)]
        outside = [*lamps, (self.background.importance, self._draw_background)] if self.draws_background else lamps
        self._all = _Table([(self.mesh.importance, self._draw_triangles), *outside], self._places)
        self._outside = _Table(outside, self._places)
        self._lamps = _Table(lamps, self._places) if self.draws_background else self._outside
        self.power = self._all.power[: len(self.triangles) + self.lamps.count]
        self.mesh.set_pick(self._all.probability[: len(self.triangles)])
        self.density = self.mesh.density

        self.sized = np.flatnonzero(self.lamps.sized & (self.lamps.importance > 0))
        self.seen = self.sized[np.array([x.camera for x in world.scene.lights], bool)[self.sized]]
        shared = self.sized[(self.lamps.large & self.lamps.shadow)[self.sized]]
        self.shared = shared if len(shared) <= MOST_LAMPS else shared[:0]
        self._is_shared = np.zeros(self.lamps.count, bool)
        self._is_shared[self.shared] = True

    def _places(self, power: np.ndarray) -> LightPlaces | None:
        """Probabilities by place for a table of emitters of `power` (k,); None where power alone decides."""
        lamps, k = self.lamps.outlook(), len(self.triangles)
        if np.count_nonzero(power) < FEWEST or self.draws_background or not self.world.triangle_count:
            return None
        if len(power) > self.lamps.count:
            lamps = self.mesh.outlook().joined(lamps) if k else lamps
        return None if lamps.far.all() else LightPlaces(self.world, lamps, power)

    @cached_property
    def flux(self) -> LightFlux:
        """What all of them emit, and what enters surfaces."""
        return light_flux(self.world, self.mesh, self.lamps, self.background)

    def _table(self, mesh: bool, background: bool) -> _Table:
        if mesh:
            return self._all
        return self._outside if background else self._lamps

    def any_drawn(self, mesh: bool = True, background: bool = True) -> bool:
        """Whether there is anything to draw light points from."""
        return self._table(mesh, background).count > 0

    def any_met(self, mesh: bool = True) -> bool:
        """Whether a bounced ray can meet emission."""
        return self.any_background or (mesh and self.any_mesh) or len(self.shared) > 0

    def draw(self, p: np.ndarray, u: np.ndarray, mesh: bool = True, background: bool = True) -> LightSample:
        """Light points for ray origins `p` (3, n) from random numbers `u` (3, n): pick, and two for the point on the emitter.

        Without `mesh` from lamps and the background, without both from lamps. The vectors of the result are component first.
        """
        return self._table(mesh, background).draw(p, u)

    def draw_from(self, index: int, p: np.ndarray, u: float, v: float) -> LightSample:
        """The same point (u, v) of one emitter, an index into `power`, for all ray origins `p` (3, n); pdf_w without the pick."""
        n = p.shape[1]
        a, b = np.full(n, u, np.float32), np.full(n, v, np.float32)
        first = len(self.triangles)
        if index >= first:
            return self._draw_lamps(np.full(n, index - first), np.ones(n, np.float32), p, a, b)
        return self._draw_triangles(np.full(n, index), np.ones(n, np.float32), p, a, b)

    def _draw_triangles(self, k: np.ndarray, pick: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> LightSample:
        yes, no = np.ones(len(k), bool), np.zeros(len(k), bool)
        wi, distance, radiance, pdf = self.mesh.sample(k, p, u, v)
        # The densities of triangles contain the probability of their pick by power.
        return LightSample(wi, distance, radiance, np.maximum(pdf * (pick / self._all.pick[k]), np.float32(1e-20)), no, yes, yes)

    def _draw_lamps(self, k: np.ndarray, pick: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> LightSample:
        wi, distance, radiance, pdf = self.lamps.sample(k, p, u, v)
        pdf = np.maximum(pdf * pick, np.float32(1e-20))
        return LightSample(wi, distance, radiance, pdf, ~self.lamps.sized[k], self._is_shared[k], self.lamps.shadow[k])

    def _draw_background(self, k: np.ndarray, pick: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> LightSample:
        wi, distance, radiance, pdf = self.background.sample(k, p, u, v)
        yes, no = np.ones(len(k), bool), np.zeros(len(k), bool)
        return LightSample(wi, distance, radiance, np.maximum(pdf * pick, np.float32(1e-20)), no, yes, yes)

    def escaping(self, w: np.ndarray, pdf: np.ndarray | None = None, mesh: bool = True) -> np.ndarray:
        """(n, 3) float32 radiance of the background for rays along unit directions `w` (n, 3) that leave the scene.

        With `pdf` (n,), the density the rays were drawn with, weighted by the power heuristic where light points find it, too.
        """
        radiance = self.background.radiance(w.T)
        if pdf is not None and self.draws_background:
            radiance = radiance * sampling.power_heuristic(pdf, self._table(mesh, True).pick[-1] * self.background.pdf_w(w.T))
        return radiance.T

    def pdf_met(self, hit: tuple[np.ndarray, ...], w: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """(n,) density per solid angle with which `draw` finds the points of emitting triangles that rays along `w` (3, n) have hit.

        `hit` is what `World.intersect` returned.
        """
        triangle, u, v, distance = hit
        pdf = self.mesh.pdf_w(triangle, w, distance, u, v)
        if self._all.places is None:
            return pdf
        index = self.mesh.number[triangle]
        return pdf * (self._all.chance(origin, index) / self._all.pick[index])

    def lamps_met(
        self,
        o: np.ndarray,
        w: np.ndarray,
        distance: np.ndarray,
        pdf: np.ndarray | None = None,
        mesh: bool = True,
        camera: bool = False,
        beyond: np.ndarray | None = None,
    ) -> np.ndarray | None:
        """(3, n) radiance of lamps that rays pass through before `distance` (n,), inf where they escape; None without any.

        With `pdf` (n,), the density the rays were drawn with: only of the lamps that bounces share with light sampling, each
        weighted by the power heuristic. Without: of all lamps that have a size, or of those that a `camera` sees, unweighted.
        `beyond` (n,): lamps nearer do not count.
        """
        lamps = self.shared if pdf is not None else self.seen if camera else self.sized
        if not len(lamps):
            return None
        out = np.zeros_like(w)
        table, first = self._table(mesh, True), len(self.triangles) if mesh else 0
        nearer = {} if beyond is None else {i: seen.rows for i, seen in self.lamps.seen(o, w, beyond, lamps)}
        for i, seen in self.lamps.seen(o, w, distance, lamps):
            radiance = seen.radiance
            if i in nearer:
                radiance = radiance * ~np.isin(seen.rows, nearer[i])
            if pdf is not None:
                chance = table.chance(o[:, seen.rows], np.full(len(seen.rows), first + i))
                radiance = radiance * sampling.power_heuristic(pdf[seen.rows], chance * seen.pdf_w)
            out[:, seen.rows] += radiance
        return out

    def along(self, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray, beyond: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) float32 radiance of the lamps that camera rays pass before `distance`; inf where the ray escapes. Costs rays x lamps.

        `beyond` (n,): lamps nearer do not count.
        """
        out = self.lamps_met(columns(origin), columns(direction), distance, camera=True, beyond=beyond)
        return np.zeros((len(origin), 3), np.float32) if out is None else out.T


def refined(u: np.ndarray) -> np.ndarray:
    """(n,) float64: the first of the numbers `u` (3, n) float32 in steps of 2^-56 instead of 2^-24, the finer bits a hash of the others."""
    bits = np.ascontiguousarray(u[1:], np.float32).view(np.uint32)
    fine = hashed(bits[0] ^ hashed(bits[1] + np.uint32(0x9E3779B9)))
    return u[0] + (fine + 0.5) * 2.0**-56


def _layout(n: int) -> tuple:
    """Shapes and types of the fields of a `LightSample` of n rows."""
    f, b = np.float32, bool
    return (((3, n), f), ((n,), f), ((3, n), f), ((n,), f), ((n,), b), ((n,), b), ((n,), b))
