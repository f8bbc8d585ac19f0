"""The potential by random walks (Pattanaik and Mudur 1993; review, section 8, Eq. 2), for surfaces of all kinds.

From a receiver point a walk leaves as light that is emitted there would, by the cosine, and every visit to the set S counts what S
scatters of the walk's weight:

    <W(x)> = g(x) + sum_k g(x_k)                                                                           (before 15)

No walk would meet the camera by chance. So importance leaves it through its picture, and what arrives on an element, per area, is the
element's potential.

S. N. Pattanaik and S. P. Mudur, "The Potential Equation and Importance in Illumination Computations", Computer Graphics Forum, 12(2),
1993, 131-136.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base.parallel import in_order
from ..bsdf.table import BsdfTable
from ..elements.elements import Elements
from ..lights.emission import Particles
from ..sampling.maps import cosine_directions
from ..scene.arrays import RayKind
from ..scene.world import Surface, World
from ..walks.particles import Hits, walk
from ..walks.paths import Gathered
from .detectors import CameraDetector, FaceDetector

WALKS_PER_BATCH = 1 << 14  # walks in a batch
MIN_BATCHES = 16  # batches, so that their spread tells the error


def scattering_table(world: World) -> BsdfTable | None:
    """The lobes of the world; None where all surfaces are diffuse, which `walk` has a faster way for."""
    table = BsdfTable(world.scene)
    return None if table.only_diffuse else table


class ReceiverWalks:
    """One walk from each surface point for every call: an estimate for `gathering.Run`, of paths of `low` to `high` segments."""

    def __init__(self, world: World, detect: FaceDetector, low: int, high: int) -> None:
        self.world, self.detect, self.low, self.high = world, detect, low, high
        self.table = scattering_table(world)

    def __call__(self, surface: Surface, wo: np.ndarray | None, rng: np.random.Generator) -> Gathered:
        """(n, 3) potential after one reflection and after more; g(x) itself is no part of it."""
        n = len(surface.triangle)
        direction = cosine_directions(surface.ng, rng.random(n, np.float32), rng.random(n, np.float32))
        one, light, dark = np.ones((n, 3), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32)
        start = Particles(self.world.leave(surface), direction, one, light, dark, kind=RayKind.DIFFUSE)
        found = np.zeros((2, n, 3), np.float32)

        def visit(hits: Hits) -> None:
            if hits.length >= self.low:
                on = np.flatnonzero(self.detect.holds(hits.surface.triangle, hits.surface.side))
                found[min(hits.length, 2) - 1, hits.row[on]] += hits.leaving[on]

        ends = walk(self.world, start, self.high, rng, visit, self.table)
        return Gathered(found[0], found[1], ends.rays)


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """Potential of element sides from the walks so far.

    parts   (3, 2 ne, 3) float64 after 0, 1 and more reflections
    error   relative standard error over all elements, None after the first batch
    """

    parts: np.ndarray
    done: int
    walks: int
    rays: int
    error: float | None


def walks_from_camera(
    world: World, elements: Elements, detect: CameraDetector, samples: int, low: int, high: int, rng: np.random.Generator
) -> Iterator[CameraEstimate]:
    """Importance particles through the picture, `samples` for each element side in all, of `low` to `high` flights before the last.

    The first hit is what the camera sees, the second what it sees by one reflection, and so on. Yields after every batch.
    """
    sides = 2 * elements.count
    table = scattering_table(world)
    batches = max(MIN_BATCHES, -(-samples * sides // (2 * WALKS_PER_BATCH)))
    n = -(-samples * sides // batches)
    seed = rng.integers(0, 1 << 63, 4).tolist()

    def shoot(index: int) -> tuple[np.ndarray, int]:
        rng = np.random.Generator(np.random.SFC64([*seed, index]))
        notes: list[list[tuple[np.ndarray, np.ndarray]]] = [[], [], []]

        def visit(hits: Hits) -> None:
            if hits.length - 1 >= low:
                h = hits.surface
                notes[min(hits.length, 3) - 1].append((elements.side(h.triangle, h.u, h.v, h.side), hits.arriving))

        ends = walk(world, detect.particles(n, rng), high + 1, rng, visit, table, importance=True)
        out = np.zeros((3, sides, 3))
        for part, some in zip(out, notes, strict=True):
            for side, weight in some:
                for c in range(3):
                    part[:, c] += np.bincount(side, weight[:, c], sides)
        return out, ends.rays

    area = np.maximum(np.repeat(elements.area, 2)[:, None], 1e-300)
    total, squares, rays = np.zeros((3, sides, 3)), np.zeros(sides), 0
    for done, (sums, cast) in enumerate(in_order(shoot, range(batches)), 1):
        total += sums
        squares += sums.sum(axis=(0, 2)) ** 2
        rays += cast
        error = _relative_error(total, squares, done, area[:, 0]) if done > 1 else None
        yield CameraEstimate(total / done / area, done * n, batches * n, rays, error)


def _relative_error(total: np.ndarray, squares: np.ndarray, batches: int, area: np.ndarray) -> float:
    """Of the potential of all sides, by the spread of their sums (n,) over the batches."""
    power = total.sum(axis=(0, 2)) ** 2
    spread = np.maximum(squares - power / batches, 0) * batches / (batches - 1)
    scale = (power / area).sum()
    return float(np.sqrt((spread / area).sum() / scale)) if scale else 0.0
