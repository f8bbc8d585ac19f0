"""What every kind of light answers, for gathering and for shooting; each kind is one class in one file.

The models are `Light` of pbrt and `lights.hxx` of SmallVCM. A class holds all lights of its kind in a scene, one entry of its arrays
for each. Vectors for gathering are component first, (3, n) float32; those for shooting are rows, (n, 3) float64, as `Rays` are.
All positions are relative to `World.center`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..sampling.maps import dot
from ..scene.arrays import Light
from ..scene.clusters import clusters
from ..scene.world import World
from .outgoing import from_outside

FAR = np.float32(1e30)  # distance of what is infinitely far
INF = np.float32(np.inf)
SMALLEST_LAMP = 0.05  # of the scene's extent: rays drawn by the cosine hardly ever meet smaller ones
LEAST_SOLID = 1e-6


class Sample(NamedTuple):
    """A point on a light for each of n receiving points, if nothing is in between.

    wi (3, n) unit directions to it; distance (n,) m; radiance (3, n) that arrives, 0 where the light does not shine this way;
    pdf_w (n,) its density per solid angle. A light without size has density 1 and sends intensity / distance^2, or its irradiance.
    """

    wi: np.ndarray
    distance: np.ndarray
    radiance: np.ndarray
    pdf_w: np.ndarray


class Seen(NamedTuple):
    """What rays see of one light: rows (m,) of the rays that meet it, radiance (3, m), pdf_w (m,) of `sample` for their directions."""

    rows: np.ndarray
    radiance: np.ndarray
    pdf_w: np.ndarray


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays that leave a light: origin, direction (n, 3); flux (n, 3), emitted radiance times cosine over the density of the ray, W.

    So flux is the power that the light would have if all of it shone like this ray, and for most lights it is their power.
    dark (n,) or None: how far the ray lights nothing, metres.
    """

    origin: np.ndarray
    direction: np.ndarray
    flux: np.ndarray
    dark: np.ndarray | None = None


class LightKind:
    """All lights of one kind; `i` is the index of one, or (n,) an index for each of n points.

    names       of each
    flux        (k, 3) float64 emitted power of each, W
    importance  (k,) float64 rough power in W, the channels summed, by which light sampling picks
    shadow      (k,) bool: whether things cast shadows in its light
    sized       whether rays can meet them
    far         whether the light comes from outside of the scene: `flux` is then the power that enters the spheres around it
                (`scene.clusters`), much of which passes by, and what enters two of them counts twice

    Besides what is here a kind answers what rays see of it, with the density of `sample` for their directions: lamps, which rays pass
    through, by `seen`; meshes, which rays hit, by `radiance` and `pdf_w` of the hit; the background by those of the direction.
    """

    world: World
    names: tuple[str, ...] = ()
    flux: np.ndarray
    importance: np.ndarray
    shadow: np.ndarray
    sized = True
    far = False

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """For gathering: a point on each light `i` (n,) as seen from `p` (3, n), from random numbers `u` and `v` (n,)."""
        raise TypeError(f"{type(self).__name__} does not define sample()")

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """For shooting: rays of light `i` that start in its cells `cell` (n,), from points `square` (n, 4) of the unit cube."""
        raise TypeError(f"{type(self).__name__} does not define shoot()")

    def cells(self, i: int) -> np.ndarray:
        """(c,) float64 power of each part of light `i` that shooting chooses between; one part unless the kind says otherwise, or light
        comes from far away: then it is that which enters each sphere."""
        power = self.flux[i : i + 1].sum(axis=1)
        return power * self._shares if self.far else power

    @cached_property
    def _shares(self) -> np.ndarray:
        found = clusters(self.world)
        return found.areas / found.area

    def from_far(self, i: int, direction: np.ndarray, square: np.ndarray, cell: np.ndarray) -> Rays:
        """Rays along `direction` (n, 3) that enter the spheres `cell` (n,), from points `square` (n, 2) of the unit square.

        A ray may enter others, too, by which it could as well have been drawn: so it has the sum of the densities (Veach 1997, section
        9.2: the balance heuristic), which is that of one times their number, as all disks have one density where spheres are drawn by area.
        """
        origin, many = from_outside(clusters(self.world), direction, square, cell)
        return Rays(origin, direction, self.flux[i] * (self._shares[cell] / many)[:, None])

    def sources(self) -> list[ParticleSource]:
        """Those that emit anything, for shooting."""
        return [s for s in (ParticleSource(self, i) for i in range(len(self.names))) if s.power > 0]


@dataclass(frozen=True, eq=False)
class ParticleSource:
    """One light of a kind: where particles start. name; flux (3,) float64 W; cells (c,) float64 W and their sum, power."""

    kind: LightKind
    index: int

    @property
    def name(self) -> str:
        """The light's or the object's."""
        return self.kind.names[self.index]

    @property
    def flux(self) -> np.ndarray:
        """(3,) float64 emitted power, W."""
        return self.kind.flux[self.index]

    @property
    def cells(self) -> np.ndarray:
        """(c,) float64 power of its parts, W."""
        return self.kind.cells(self.index)

    @property
    def power(self) -> float:
        """W, the channels summed."""
        return float(self.cells.sum())

    def shoot(self, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """`LightKind.shoot` of this light."""
        return self.kind.shoot(self.index, square, rng, cell)


class LampKind(LightKind):
    """Base of the kinds that a scene lists as `Light`s; all lamps of one object have the same `form`.

    lights  the lamps (units: `scene.arrays.Light`)
    color   (3, k) float32: radiance, of a lamp without size its intensity or irradiance
    """

    extent: np.ndarray  # (k,) float32 diameter, metres

    def __init__(self, lights: Sequence[Light], world: World) -> None:
        self.lights, self.world = tuple(lights), world
        self.form = self.form_of(lights[0])
        self.sized = self.form not in ("point", "parallel")
        self.names = tuple(x.name for x in lights)
        self.shadow = np.array([x.shadow for x in lights], bool)
        self.center = np.array([x.position for x in lights], np.float64) - world.center
        self.position = table(self.center)
        self.x, self.y, self.z = (table([getattr(x, f"axis_{a}") for x in lights]) for a in "xyz")
        self.color = table(self.emitted())
        self.importance = np.array([max(0.0, float(sum(x.color))) for x in lights])
        self.importance *= np.maximum([self.rough_solid(i) for i in range(len(lights))], LEAST_SOLID)

    @staticmethod
    def form_of(light: Light) -> str:
        """Which of the kind's forms the lamp has: those that are sampled alike."""
        raise TypeError("a kind of lamp defines form_of()")

    @cached_property
    def flux(self) -> np.ndarray:
        """(k, 3) float64 emitted power, W."""
        return np.array([np.asarray(x.color, np.float64) * self.solid(i) for i, x in enumerate(self.lights)])

    def solid(self, i: int) -> float:
        """What the `color` of lamp `i` is multiplied by to give its power."""
        raise TypeError(f"{type(self).__name__} does not define solid()")

    def rough_solid(self, i: int) -> float:
        """`solid`, as far as picking lamps needs it."""
        return self.solid(i)

    def emitted(self) -> np.ndarray:
        """(k, 3) float64 rows of `color`."""
        return np.array([x.color for x in self.lights], np.float64)

    def large(self) -> np.ndarray:
        """(k,) bool: whether rays drawn by the cosine meet it often enough to be worth a test."""
        return self.extent >= SMALLEST_LAMP * self.world.extent

    def seen(self, i: int, o: np.ndarray, w: np.ndarray, distance: np.ndarray) -> Seen:
        """Rays from `o` along unit `w` (3, n) that pass through lamp `i` before `distance` (n,), inf where they escape."""
        raise TypeError(f"{type(self).__name__} does not define seen()")

    def _frame(self, i: int) -> np.ndarray:
        """(3, 3) float64 rows: the lamp's axes."""
        light = self.lights[i]
        return np.array([light.axis_x, light.axis_y, light.axis_z], np.float64)

    def _rays(self, i: int, origin: np.ndarray, direction: np.ndarray, dark: np.ndarray | None = None) -> Rays:
        """Rays that each carry the lamp's whole power."""
        return Rays(origin, direction, np.broadcast_to(self.flux[i], direction.shape), dark)


def table(rows: Sequence) -> np.ndarray:
    """(3, k) float32 contiguous columns of k vectors."""
    return np.ascontiguousarray(np.array(rows, np.float32).reshape(-1, 3).T)


def unit(to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and lengths of vectors (3, n); a zero vector keeps a direction, at distance 0."""
    distance = np.sqrt(dot(to, to))
    return to / np.maximum(distance, np.float32(1e-20)), distance
