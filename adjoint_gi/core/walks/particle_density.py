"""Irradiance at receivers from the particles that land around them: kernel density with the area measured the same way.

Around every receiver point particles are summed with a kernel K that falls from 1 to 0 at a radius h (Epanechnikov), and so is surface
area, at random points that lie evenly on the same objects:

    E = (sum_k K(d_k) w_k) / (area of a point * sum_l K(d_l))

Dividing by the area that the kernel really covers leaves no dark rims at borders and no error on curved or narrow surfaces. Only
what lies on the same object and faces the same way (within 60 degrees) counts.

Bias: the mean over the kernel is taken for its middle, so shadows and caustics are blurred over h, and light leaks by up to h under
a wall that stands on the receiving object. It vanishes with h; h follows the number of particles, down to the distance of the receivers.
"""

from __future__ import annotations

import numpy as np

from ..receivers.base import SurfaceReceivers, turned
from ..receivers.inside import Interiors
from ..sampling.additive import STEPS, additive
from ..scene.world import Surface, World

HITS = 100  # particles wanted within a kernel, if they were spread evenly over the scene
LOOKS = 1 << 14  # points that show whether any area lies inside bodies
PAIRS = 1 << 20  # pairs of a particle and a receiver point that are looked at together
FACING = 0.5  # cosine of the largest angle between the normals
SMALLEST = 1e-4  # kernel radius over the extent of the world


class ParticleDensity:
    """The points of texels or vertices, found by place: a grid of cells as large as the kernel, for each object its own.

    radius (number of objects,) float64 of the kernel on each object, m; count points.
    """

    def __init__(self, world: World, receivers: SurfaceReceivers, particles: int, radius: float = 0.0) -> None:
        """`radius` in metres for all objects; 0 chooses it by the number of particles and the distance of the receivers."""
        self.world = world
        self.receivers = receivers
        self._find_points()
        scene = world.scene
        objects = max(1, len(scene.objects))
        owner = scene.object[self.triangle] if self.count else np.zeros(0, np.int64)
        self.receives = np.bincount(owner, minlength=objects) > 0
        object_area = np.bincount(scene.object, world.area, objects)
        if radius > 0:
            self.radius = np.full(objects, float(radius))
        else:
            # h so that HITS particles, each arriving about once and spread evenly, fall into pi h^2.
            by_particles = np.sqrt(HITS * max(float(world.area.sum()), 1e-300) / (np.pi * max(1, particles)))
            spacing = np.sqrt(object_area / np.maximum(np.bincount(owner, minlength=objects), 1)) if receivers.kind == "texels" else 0.0
            self.radius = np.maximum(spacing, np.minimum(by_particles, np.sqrt(np.maximum(object_area, 1e-300) / np.pi)))
        self.radius = np.maximum(self.radius, SMALLEST * world.extent)
        self._make_grid(owner)
        # Area points go to the receiving objects only, in proportion to area.
        weight = np.where(self.receives[scene.object], world.area, 0.0)
        self._cumulative = np.cumsum(weight)
        self._total = float(self._cumulative[-1]) if len(weight) else 0.0
        # Nothing lands where a wall stands on a face, so no area is counted there, where there is any.
        self._interiors = Interiors(world)
        self._any_inside = True
        self._any_inside = self._total > 0 and not self._spread(LOOKS, np.random.default_rng(0))[1].all()

    def _find_points(self) -> None:
        """One point for each triangle of each receiver: the mean of the receiver's points there, with their share of the receiver."""
        r = self.receivers
        owner = np.repeat(np.arange(r.count), np.diff(r.start))
        order = np.lexsort((r.triangle, owner))
        owner, triangle = owner[order], r.triangle[order].astype(np.int64)
        new = np.r_[True, (np.diff(owner) != 0) | (np.diff(triangle) != 0)][: len(owner)]
        group = np.cumsum(new) - 1
        many = np.bincount(group).astype(np.float64) if len(group) else np.zeros(0)
        self.owner, self.triangle = owner[new], triangle[new]
        u = np.bincount(group, r.u[order]) / many if len(group) else many
        v = np.bincount(group, r.v[order]) / many if len(group) else many
        self.share = many / np.maximum(np.bincount(owner, minlength=r.count), 1)[self.owner]
        self.count = len(self.owner)
        surface = self.world.surface(self.triangle, u.astype(np.float32), v.astype(np.float32), r.towards(self.triangle))
        self.position, self.normal = surface.position, surface.ng

    def _make_grid(self, owner: np.ndarray) -> None:
        """Sort the points by cell. Cells of one row lie behind one another, so three neighbours are one stretch of points."""
        size = self.world.extent
        self._cells = int(np.ceil(2 * size / self.radius[self.receives].min(initial=size))) + 4
        key = self._key(owner, self.position)
        order = np.argsort(key, kind="stable")
        self._sorted, self._order = key[order], order

    def _key(self, owner: np.ndarray, position: np.ndarray) -> np.ndarray:
        """(n,) int64 number of the cell in which points of objects `owner` (n,) lie."""
        cell = np.floor((position + np.float32(self.world.extent)) / self.radius[owner, None]).astype(np.int64) + 1
        cell = np.clip(cell, 1, self._cells - 2)
        k = self._cells
        return ((owner.astype(np.int64) * k + cell[:, 2]) * k + cell[:, 1]) * k + cell[:, 0]

    def sum(self, triangle: np.ndarray, position: np.ndarray, normal: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(count, c) float64 kernel sums of `weight` (n, c) over surface points (n,), `normal` (n, 3) on the side that counts."""
        out = np.zeros((self.count, weight.shape[1]))
        owner = self.world.scene.object[triangle]
        on = np.flatnonzero(self.receives[owner])
        if not len(on):
            return out
        key = self._key(owner[on], position[on])
        order = np.argsort(key, kind="stable")
        on, key = on[order], key[order]
        k = self._cells
        for dz in (-1, 0, 1):
            for dy in (-1, 0, 1):
                middle = key + (dz * k + dy) * k
                first = np.searchsorted(self._sorted, middle - 1, side="left")
                many = np.searchsorted(self._sorted, middle + 1, side="right") - first
                self._add(out, (self.radius[owner], position, normal, weight), on, first, many)
        return out

    def _add(self, out: np.ndarray, hits: tuple, on: np.ndarray, first: np.ndarray, many: np.ndarray) -> None:
        """Add hits `on` (n,) to the points in stretches `first`, `many` (n,) of the sorted list, a part at a time."""
        radius, position, normal, weight = hits
        total = np.cumsum(many)
        at = 0
        while at < len(on):
            done = total[at - 1] if at else 0
            stop = max(at + 1, int(np.searchsorted(total, done + PAIRS, side="right")))
            part = slice(at, stop)
            at = stop
            count = many[part]
            hit = np.repeat(on[part], count)
            if not len(hit):
                continue
            run = np.arange(len(hit)) - np.repeat(np.cumsum(count) - count, count)
            point = self._order[np.repeat(first[part], count) + run]
            apart = self.position[point] - position[hit]
            kernel = 1 - np.einsum("ij,ij->i", apart, apart) / radius[hit] ** 2
            same = (kernel > 0) & (np.einsum("ij,ij->i", self.normal[point], normal[hit]) > FACING)
            pick = np.flatnonzero(same)
            for c in range(weight.shape[1]):
                out[:, c] += np.bincount(point[pick], kernel[pick] * weight[hit[pick], c], self.count)

    def area(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """(count,) float64 area within each kernel, weighted by it, m2: an estimate from `n` points spread over the receiving faces."""
        if n == 0 or self._total <= 0:
            return np.zeros(self.count)
        surface, outside = self._spread(n, rng)
        return self.sum(surface.triangle, surface.position, surface.ng, outside[:, None] * (self._total / n))[:, 0]

    def _spread(self, n: int, rng: np.random.Generator) -> tuple[Surface, np.ndarray]:
        """`n` points spread over the receiving faces, each for the same area, and (n,) float64 1, or 0 for those inside bodies."""
        # Step 1: triangles by area, one jittered point in each n-th; places in them by a low-discrepancy sequence.
        at = (np.arange(n) + rng.random(n)) / n * self._total
        triangle = np.minimum(np.searchsorted(self._cumulative, at, side="right"), len(self._cumulative) - 1)
        s, t = additive(np.arange(1, n + 1), STEPS[4][:2], rng.random((2, 1)))
        root = np.sqrt(s)
        u, v = (1 - root).astype(np.float32), (t * root).astype(np.float32)
        # Step 2: those that nothing can reach.
        inside = self._interiors.hold(triangle, u, v) if self._any_inside else np.zeros(n, bool)
        inside &= ~turned(self.world, self.receivers.facing)[triangle]
        return self.world.surface(triangle, u, v, self.receivers.towards(triangle)), np.where(inside, 0.0, 1.0)

    def values(self, power: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance (receivers, 3) float64 from kernel sums of power (count, 3) in W and area (count,) in m2, and the share (receivers,)
        of each receiver that has any area measured; the rest is left out of its mean."""
        known = self.share * (area > 0)
        density = power / np.maximum(area, 1e-300)[:, None] * known[:, None]
        n = self.receivers.count
        weight = np.bincount(self.owner, known, n)
        total = np.stack([np.bincount(self.owner, density[:, c], n) for c in range(3)], axis=1)
        return total / np.maximum(weight, 1e-300)[:, None], weight
