"""Surfaces that let light straight through: Transparent, alone or mixed with others, and what alpha cuts out.

Passing is no scattering: a ray that goes on straight keeps its direction, its kind and its density, and no segment of a path ends there.
So rays pass such surfaces on their way (`World.shadows`, `World.onward`), and BSDFs know nothing of it.
"""

from __future__ import annotations

import numpy as np

from .arrays import STRAIGHT, Color, Material, SceneArrays
from .shading import ColorField

MOST_GREY = 0.98  # chance at most to pass where something scatters or emits, so that its light is not lost
MOST_LAYERS = 1024  # surfaces that a ray passes; what lies behind more of them is taken as hidden


class Passing:
    """What the triangles of a scene let straight through.

    lets (nt + 1,) bool: whether any; the last entry is for rays that hit nothing. tinted: whether the colour of any is not grey, or more
    of it than `MOST_GREY` beside what scatters. full (nt,) bool: nothing on it scatters or emits.
    """

    def __init__(self, scene: SceneArrays) -> None:
        material = np.asarray(scene.material, np.int64)
        self._straight = ColorField([m.total(STRAIGHT) for m in scene.materials], scene)
        self._rest = ColorField([_scattered(m) for m in scene.materials], scene)
        may = np.array([not m.total(STRAIGHT).is_black for m in scene.materials] or [False])
        self.lets = np.append(may[material], False)
        self._glow = ColorField([m.total("emission") for m in scene.materials], scene)
        full = [_is_full(m) for m in scene.materials]
        self.full = np.array(full or [True], bool)[material]
        self.tinted = _tinted(scene)

    @classmethod
    def of(cls, scene: SceneArrays) -> Passing | None:
        """None where nothing lets light straight through, so that it costs nothing."""
        out = cls(scene)
        return out if out.lets.any() else None

    def through(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 share of light that goes straight on at barycentrics of triangles."""
        return np.maximum(self._straight.at(triangle, u, v), np.float32(0))

    def grey(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) float32 chance to pass for rays that carry no colour: the mean share, but less than 1 where surfaces send light; the holes
        of a cut-out send none."""
        out = self.through(triangle, u, v).mean(axis=1)
        high = np.flatnonzero((out > MOST_GREY) & ~self.full[triangle])
        at = triangle[high], u[high], v[high]
        sends = np.maximum(self._rest.at(*at), self._glow.at(*at)).max(axis=1) > 0
        out[high] = np.where(sends, np.float32(MOST_GREY), np.minimum(out[high], 1))
        return np.minimum(out, 1)

    def color(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 factor on what rays carry that go on by the chance `grey`: its mean over all rays is the colour."""
        return self.through(triangle, u, v) / np.maximum(self.grey(triangle, u, v), np.float32(1e-20))[:, None]

    def draw(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Whether rays go on, (n,) bool, and the factor (n, 3) float32 on what they carry: over the chance to go on, or to stay.

        The chance is the share of what goes straight on in all that is not absorbed, so clear panes and cut-outs bring no noise.
        """
        straight = self.through(triangle, u, v)
        rest = np.maximum(self._rest.at(triangle, u, v).mean(axis=1), np.float32(0))
        mean = straight.mean(axis=1)
        chance = mean / np.maximum(mean + rest, np.float32(1e-20))
        go = rng.random(len(triangle), np.float32) < chance
        factor = np.where(go[:, None], straight, np.float32(1)) / np.where(go, chance, 1 - chance)[:, None]
        return go, factor.astype(np.float32)


def _tinted(scene: SceneArrays) -> bool:
    """Whether the chance to pass alone is not the share of what goes straight through any material in use."""
    used = [scene.materials[i] for i in np.unique(scene.material)]
    capped = any(not _is_full(m) and max(m.total(STRAIGHT).constant) > MOST_GREY and m.total(STRAIGHT).is_constant for m in used)
    terms = (t for m in used for t in m.total(STRAIGHT).terms)
    return capped or any(len(set(t.constant)) > 1 or any(not s.alpha for s in t.sources) for t in terms)


def _is_full(material: Material) -> bool:
    """Whether it does nothing but let light through."""
    return _scattered(material).is_black and material.total("emission").is_black


def _scattered(material: Material) -> Color:
    return material.total(*{x.kind for x in material.lobes} - {STRAIGHT, "emission"})
