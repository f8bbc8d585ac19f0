"""The background: what rays see that leave the scene. The one place that knows that it is constant.

A background that varies with direction has another `radiance`, `flux` and `shoot` here. Where some directions are much brighter than
others it also has an `importance`, and `sample` with its `pdf_w` by radiance: then light points are drawn from it everywhere.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from ..sampling import maps as sampling
from ..sampling.maps import PI
from ..scene.clusters import clusters
from ..scene.world import World
from .base import FAR, LightKind, Rays, Sample
from .outgoing import sphere_directions

UNIFORM = 1 / (4 * PI)


class Background(LightKind):
    """The radiance that arrives from far away.

    `any`: whether it is not black. Its `flux` is the power that enters the spheres around the scene, much of which passes by.
    Light points are not drawn from it (its importance is 0): rays drawn by the cosine are its best density, as it is constant.
    """

    names = ("Background",)
    far = True
    shadow = np.ones(1, bool)
    importance = np.zeros(1)

    def __init__(self, world: World) -> None:
        self.world = world
        self._color = np.maximum(np.asarray(world.scene.background, np.float32), 0)
        self.any = bool(self._color.any())

    def radiance(self, w: np.ndarray) -> np.ndarray:
        """(3, n) float32 that rays along unit directions `w` (3, n) see when they escape."""
        return np.repeat(self._color[:, None], w.shape[1], axis=1)

    def pdf_w(self, w: np.ndarray) -> np.ndarray:
        """(n,) float32 density of `sample` for directions `w` (3, n)."""
        return np.full(w.shape[1], UNIFORM)

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """A uniform direction."""
        wi = sampling.sphere(u, v)
        return Sample(wi, np.full(len(u), FAR), self.radiance(wi), self.pdf_w(wi))

    @cached_property
    def flux(self) -> np.ndarray:
        """(1, 3) float64 W."""
        color = np.maximum(np.asarray(self.world.scene.background, np.float64), 0)
        return (color * (4 * math.pi * clusters(self.world).area))[None]

    def shoot(self, i: int, square: np.ndarray, rng: np.random.Generator, cell: np.ndarray) -> Rays:
        """A uniform direction; the origin before the scene, on the disk that covers sphere `cell`."""
        direction = sphere_directions(square[:, 0], square[:, 1])
        return self.from_far(i, direction, square[:, 2:], cell)
