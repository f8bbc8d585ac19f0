"""Emitting meshes: every triangle of an emissive material, from both sides.

Gathering picks a triangle and a point on it. Shooting picks an object and a cell of it: a triangle, or a small part of a textured one.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import columns, cosine_directions, dot
from ..scene.faces import points
from ..scene.mean_emission import mean_emission
from ..scene.world import World, once_a_world
from . import patches
from .base import LightKind, Rays, Sample
from .patches import Patches
from .places import Outlook

# Textured triangles are divided into about this many cells altogether, so that bright texels get their share of particles.
CELLS = 1 << 15
# A cell is taken at no less than this share of the mean, since rounding or a product of images may hide light in it.
FLOOR = 0.05


class MeshLights(LightKind):
    """The emissive triangles of a world. In `sample` and `importance` i counts `triangles`, in what is shot the emissive objects.

    triangles  (k,) int32 that emit
    density    (nt,) float32 of `sample` per area on each triangle of the world, with the probability of its pick; 0 on what is dark.
               Where emission varies it is the mean over the triangle
    """

    def __init__(self, world: World) -> None:
        self.world = world
        mean, self._patches = _looked_at(world)
        flux = 2 * np.pi * world.area * mean.sum(axis=1)  # both sides
        self.triangles = np.flatnonzero(flux > 0).astype(np.int32)
        self.number = np.zeros(world.triangle_count, np.int32)  # of each triangle among those that emit
        self.number[self.triangles] = np.arange(len(self.triangles))
        self.importance = flux[self.triangles]
        self.shadow = np.ones(len(self.triangles), bool)
        rows = world.rows[self.triangles]
        self._corner, self._e1, self._e2, self._ng = (columns(rows[:, a : a + 3]) for a in (0, 3, 6, 9))
        self._radiance = None if world.shading.emission_varies else columns(mean[self.triangles])
        self.set_pick(np.ones(len(self.triangles)))

    @property
    def any(self) -> bool:
        """Whether anything emits."""
        return len(self.triangles) > 0

    def set_pick(self, probability: np.ndarray) -> None:
        """`probability` (k,) float64 with which each triangle is picked; the densities of `sample` and `pdf_w` contain it from then on."""
        self.density = np.zeros(self.world.triangle_count, np.float32)
        area = np.maximum(self.world.area[self.triangles], 1e-300)
        self.density[self.triangles] = np.minimum(probability / area, 1e30)
        self._density = self.density[self.triangles]

    def outlook(self) -> Outlook:
        """Where the triangles are and how they shine: towards everywhere, from both sides."""
        rows, k = self.world.rows[self.triangles].astype(np.float64), len(self.triangles)
        middle = rows[:, 0:3] + (rows[:, 3:6] + rows[:, 6:9]) / 3
        radius = np.maximum(*(np.linalg.norm(rows[:, a : a + 3], axis=1) for a in (3, 6))) * (2 / 3)
        axis, everywhere, no = np.zeros((k, 3)), np.full(k, -1.0), np.zeros(k, bool)
        return Outlook(middle, radius, self.importance / (4 * np.pi), axis, everywhere, no, no)

    # ---- gathering

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """Points on the triangles, uniform or by what they emit; shadow rays end before they hit them."""
        a, b, brighter = (*sampling.triangle(u, v), None) if self._patches is None else self._patches.sample(i, u, v)
        to = points(self._corner, self._e1, self._e2, i, a, b)
        to -= p
        distance = np.sqrt(dot(to, to))
        to /= np.maximum(distance, np.float32(1e-20))
        cosine = np.abs(dot(to, self._ng.take(i, axis=1)))
        constant = self._radiance is not None
        radiance = self._radiance.take(i, axis=1) if constant else columns(self.world.shading.emission(self.triangles[i], a, b))
        pdf = self._density.take(i) if brighter is None else self._density.take(i) * brighter
        pdf *= distance
        pdf *= distance
        pdf /= np.maximum(cosine, np.float32(1e-6))
        free = self.world.short_of(distance, self.triangles.take(i), cosine)
        return Sample(to, free, radiance, np.maximum(pdf, np.float32(1e-20)))

    def radiance(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(3, n) float32 that rays see which hit triangles of the world at barycentrics `u`, `v` (n,), from either side."""
        return columns(self.world.shading.emission(triangle, u, v))

    def pdf_w(self, triangle: np.ndarray, w: np.ndarray, distance: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) density of `sample` for rays along `w` (3, n) that hit triangles of the world at `distance` (n,) and barycentrics u, v."""
        ng = columns(self.world.rows[triangle, 9:12])
        cosine = np.maximum(np.abs(dot(w, ng)), np.float32(1e-6))
        pdf = self.density[triangle] * distance * distance / cosine
        return pdf if self._patches is None else pdf * self._patches.density(self.number[triangle], u, v)

    # ---- shooting

    @cached_property
    def objects(self) -> list[Cells]:
        """The objects that emit anything, in the order of the scene."""
        world = self.world
        triangle = np.flatnonzero(world.shading.emissive() & (world.area > 0))
        owner = world.scene.object[triangle]
        area = np.bincount(owner, world.area[triangle], minlength=1)
        share = area / max(area.sum(), 1e-300)
        out = [Cells(world, index, triangle[owner == index], max(64, int(CELLS * share[index]))) for index in np.unique(owner)]
        return [x for x in out if x.power.sum() > 0]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the emissive objects."""
        return tuple(x.name for x in self.objects)

    @cached_property
    def flux(self) -> np.ndarray:
        """(objects, 3) float64 W; a quadrature of products of images, exact of all else."""
        return np.array([x.flux.sum(axis=0) for x in self.objects]).reshape(-1, 3)

    def flux_of_triangles(self) -> np.ndarray:
        """(nt, 3) float64 power that each triangle of the world emits from both sides together, W."""
        count = self.world.triangle_count
        out = np.zeros((count, 3))
        for cells in self.objects:
            for c in range(3):
                out[:, c] += np.bincount(cells.triangle, cells.flux[:, c], count)
        return out

    def cells(self, i: int) -> np.ndarray:
        """(c,) float64 power of the cells of object `i`."""
        return self.objects[i].power

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """A uniform point of the cell, either side, and a direction by the cosine."""
        return self.objects[i].shoot(cell, square)


class Cells:
    """One emissive object, cut into its emissive triangles, or small triangles within the textured ones.

    A cell covers the barycentrics base + scale * (a, b) of its triangle, with (a, b) those of the small triangle; scale is negative
    for small triangles that stand upside down. flux (c, 3) and power (c,) float64 of each, W; triangle (c,) int32 it lies on.
    """

    def __init__(self, world: World, index: int, triangle: np.ndarray, cells: int) -> None:
        self.world = world
        self.name = world.scene.objects[index].name
        self._divide(triangle, cells)
        area = world.area[self.triangle] * self.scale**2
        radiance = self._radiance_of_cells()
        # A triangle radiates pi L A from each of its two sides.
        self.full = 2 * np.pi * area
        self.flux = self.full[:, None] * radiance
        power = radiance.sum(axis=1)
        varying = ~self.constant
        if varying.any():
            mean = (power * area)[varying].sum() / area[varying].sum()
            power[varying] = np.maximum(power[varying], FLOOR * mean)
        self.power = power * self.full

    def _divide(self, triangle: np.ndarray, cells: int) -> None:
        """Fill triangle, scale, base_u, base_v and constant, (cells,) each."""
        scene = self.world.scene
        every = scene.material[triangle]
        own = np.unique(every)
        varies = np.zeros(len(scene.materials), bool)
        varies[own] = [not scene.materials[m].total("emission").is_constant for m in own]
        varying = varies[every]
        area = np.where(varying, self.world.area[triangle], 0)
        side = np.ones(len(triangle), np.int64)
        if varying.any():
            side = np.maximum(1, np.sqrt(cells * area / area.sum()).astype(np.int64))
        count = side**2
        whole = np.repeat(np.arange(len(triangle)), count)
        number = np.arange(len(whole)) - np.repeat(np.cumsum(count) - count, count)
        k = side[whole]
        # Row i of k holds k - i upright triangles and k - i - 1 upside-down ones; a square of k x k, folded, numbers them all.
        i, j = number // k, number % k
        down = i + j >= k
        # (i, j) beyond the diagonal stands for the upside-down triangle with its right angle at (k - i, k - j).
        i, j = np.where(down, k - i, i), np.where(down, k - j, j)
        self.triangle = triangle[whole].astype(np.int32)
        self.constant = ~varying[whole]
        self.scale = np.where(down, -1.0, 1.0) / k
        self.base_u, self.base_v = i / k, j / k

    def _radiance_of_cells(self) -> np.ndarray:
        """(cells, 3) float64 mean emitted radiance."""
        u, v = (x[:, None] + self.scale[:, None] * np.array(at) for x, at in ((self.base_u, (0, 1, 0)), (self.base_v, (0, 0, 1))))
        return mean_emission(self.world.shading, self.triangle, u, v)

    def _emission_at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self.world.shading.emission(triangle, u.astype(np.float32), v.astype(np.float32))

    def shoot(self, cell: np.ndarray, square: np.ndarray) -> Rays:
        """Rays from points `square` (n, 4) of the unit cube whose flux is 2 pi L A with the exact radiance L at the origin."""
        # Step 1: a uniform point of the small triangle.
        root = np.sqrt(square[:, 0])
        a, b = 1 - root, square[:, 1] * root
        u = (self.base_u[cell] + self.scale[cell] * a).astype(np.float32)
        v = (self.base_v[cell] + self.scale[cell] * b).astype(np.float32)
        surface = self.world.surface(self.triangle[cell], u, v)
        # Step 2: one of the two sides.
        front = square[:, 2] < 0.5
        side = np.where(front, np.float32(1), np.float32(-1))
        normal = surface.ng * side[:, None]
        # Step 3: cosine distributed about the normal.
        direction = cosine_directions(normal, 2 * square[:, 2] - ~front, square[:, 3])
        origin = self.world.lifted(surface.position, normal, surface.triangle)
        return Rays(origin, direction, self._emission_at(self.triangle[cell], u, v) * self.full[cell, None])


@once_a_world
def _looked_at(world: World) -> tuple[np.ndarray, Patches | None]:
    """(nt, 3) float64 mean emitted radiance of every triangle, and the patches of those that emit where emission varies."""
    mean = np.zeros((world.triangle_count, 3))
    triangles = np.flatnonzero(world.shading.emissive() & (world.area > 0)).astype(np.int32)
    if not len(triangles):
        return mean, None
    if not world.shading.emission_varies:
        middle = np.full(len(triangles), 1 / 3, np.float32)
        mean[triangles] = world.shading.emission(triangles, middle, middle)
        return mean, None
    varies = np.array([not c.is_constant for c in world.shading.emission_colors])[world.scene.material[triangles]]
    side = patches.sides(world.area[triangles], varies)
    radiance = patches.radiance(world, triangles, side)
    own = np.repeat(np.arange(len(side)), 2 * side**2)
    for c in range(3):
        mean[triangles, c] = np.bincount(own, radiance[:, c], len(side)) / side**2
    lit = mean[triangles].sum(axis=1) > 0
    return mean, Patches(side[lit], radiance[lit[own]].sum(axis=1)) if lit.any() else None
