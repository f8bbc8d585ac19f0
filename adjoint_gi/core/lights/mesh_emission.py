"""Particles from emissive meshes: both sides of every triangle, cosine about the geometric normal."""

from __future__ import annotations

import numpy as np

from ..scene.world import World
from .lamp_emission import Rays

# Textured triangles are divided into about this many cells altogether, so that bright texels get their share of particles.
CELLS = 1 << 15
# A cell is taken at no less than this share of the mean, since a bright spot between its samples must still be found.
FLOOR = 0.05
# Where a cell's emission is looked at to estimate its power: barycentrics of a small triangle.
LOOKS = np.array([(1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3), (1 / 3, 1 / 3)])


class MeshEmission:
    """One emissive object. Its cells are its emissive triangles, or small triangles within the textured ones.

    A cell covers the barycentrics base + scale * (a, b) of its triangle, with (a, b) those of the small triangle; scale is negative
    for small triangles that stand upside down.
    """

    def __init__(self, world: World, name: str, triangle: np.ndarray, cells: int) -> None:
        self.world = world
        self.name = name
        self._divide(triangle, cells)
        area = world.area[self.triangle] * self.scale**2
        radiance = self._radiance_of_cells()
        # A triangle radiates pi L A from each of its two sides.
        self.full = 2 * np.pi * area
        self.cell_flux = self.full[:, None] * radiance
        self.flux = self.cell_flux.sum(axis=0)
        power = radiance.sum(axis=1)
        varying = ~self.constant
        if varying.any():
            mean = (power * area)[varying].sum() / area[varying].sum()
            power[varying] = np.maximum(power[varying], FLOOR * mean)
        self.cells = power * self.full
        self.power = float(self.cells.sum())

    @staticmethod
    def of(world: World) -> list[MeshEmission]:
        """One for each object that emits anything, in the order of the scene."""
        triangle = np.flatnonzero(world.shading.emissive() & (world.area > 0))
        owner = world.scene.object[triangle]
        area = np.bincount(owner, world.area[triangle], minlength=1)
        out = []
        for index in np.unique(owner):
            share = area[index] / area.sum()
            one = MeshEmission(world, world.scene.objects[index].name, triangle[owner == index], max(64, int(CELLS * share)))
            if one.power > 0:
                out.append(one)
        return out

    def _divide(self, triangle: np.ndarray, cells: int) -> None:
        """Fill triangle, scale, base_u, base_v and constant, (cells,) each."""
        scene = self.world.scene
        varying = np.array([not m.total("emission").is_constant for m in scene.materials])[scene.material[triangle]]
        area = np.where(varying, self.world.area[triangle], 0)
        side = np.ones(len(triangle), np.int64)
        if varying.any():
            side = np.maximum(1, np.sqrt(cells * area / area.sum()).astype(np.int64))
        count = side**2
        own = np.repeat(np.arange(len(triangle)), count)
        number = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
        k = side[own]
        # Row i of k holds k - i upright triangles and k - i - 1 upside-down ones; a square of k x k, folded, numbers them all.
        i, j = number // k, number % k
        down = i + j >= k
        # (i, j) beyond the diagonal stands for the upside-down triangle with its right angle at (k - i, k - j).
        i, j = np.where(down, k - i, i), np.where(down, k - j, j)
        self.triangle = triangle[own].astype(np.int32)
        self.constant = ~varying[own]
        self.scale = np.where(down, -1.0, 1.0) / k
        self.base_u, self.base_v = i / k, j / k

    def _radiance_of_cells(self) -> np.ndarray:
        """(cells, 3) float64 mean emitted radiance, exact where constant."""
        total = np.zeros((len(self.triangle), 3))
        looks = LOOKS if not self.constant.all() else LOOKS[3:]
        for a, b in looks:
            total += self.emission_at(self.triangle, self.base_u + self.scale * a, self.base_v + self.scale * b)
        return total / len(looks)

    def emission_at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 emitted radiance."""
        return self.world.shading.emission(triangle, u.astype(np.float32), v.astype(np.float32))

    def draw(self, cell: np.ndarray, square: np.ndarray, rng: np.random.Generator) -> Rays:
        """Rays whose flux is 2 pi L A with the exact radiance L at the origin."""
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
        origin = surface.position + np.float32(self.world.offset) * normal
        return Rays(origin, direction, self.emission_at(self.triangle[cell], u, v) * self.full[cell, None])


def cosine_directions(normal: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(n, 3) float32 unit directions with density cos / pi about unit normals (n, 3), from s and t uniform in 0..1.

    A uniform point of the unit sphere on top of the tip of the normal: no tangent frame is needed.
    """
    z = (1 - 2 * s).astype(np.float32)
    r = np.sqrt(np.maximum(1 - z * z, np.float32(0)))
    phi = (2 * np.pi * t).astype(np.float32)
    direction = np.empty((len(normal), 3), np.float32)
    direction[:, 0] = r * np.cos(phi)
    direction[:, 1] = r * np.sin(phi)
    direction[:, 2] = z
    direction += normal
    square = np.einsum("ij,ij->i", direction, direction)
    # The point opposite the normal gives no direction. It and what rounding cannot tell from it make 1 in 10^8: the normal is taken.
    bad = square < 1e-8
    if bad.any():
        direction[bad] = normal[bad]
        square[bad] = 1
    direction /= np.sqrt(square)[:, None]
    return direction
