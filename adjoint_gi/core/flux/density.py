"""How densely a lightmap should lie on each object: by the importance that arrives there from the camera and from inside the scene.

The importance that arrives on a surface, per area, is the potential W of a view (Eq. 2): so many texels should see as much of the view as
others. Half of the particles leave through the picture, where there is a camera; the others leave the objects' own fronts, and what
they lose to the sky nobody sees. Both follow a few diffuse reflections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import AdjointError
from ..lights.emission import Particles
from ..sampling.maps import cosine_directions
from ..scene.arrays import RayKind
from ..scene.world import World
from ..walks.particles import Hits, walk
from .detectors import CameraDetector

PARTICLES = 16384  # of each kind
LENGTH = 3  # segments a particle is followed
LEAST = 1 / 32  # of the density of what is seen best: nothing goes empty,
SPARE = 0.1  # unless what is seen so little would get more than this beside the texels of the others
STEPS = 64  # in which the highest density is raised
FULL_IMAGES = 16  # objects that each get an image of the full resolution, or as many texels for more of them
SMALLEST = 16  # texels a side of an image of its own
TYPICAL = 0.75  # share of the importance that arrives where the potential is no higher than what gets the full density,
MOST = 0.5  # unless one object would get more than this of the image: then what is seen better gets more, as far as it is


@dataclass(frozen=True, eq=False)
class SeenObjects:
    """importance (n,) float64 share of each object in all that arrives; area (n,) float64 m2; weight (n,) float64 its density, an edge's
    length in texels a metre, beside those of the others: LEAST to 1."""

    importance: np.ndarray
    area: np.ndarray
    weight: np.ndarray


def seen(world: World, particles: int = PARTICLES) -> SeenObjects:
    """What of each object of `world` is seen. The same every time; all weights are 1 where nothing is seen of anything."""
    objects = len(world.scene.objects)
    area = np.bincount(world.scene.object, world.area, objects) if world.triangle_count else np.zeros(objects)
    rng = np.random.default_rng(0)
    views = [
        _arriving(world, start, rng) for start in (through_picture(world, particles, rng), _from_inside(world, particles, rng)) if start
    ]
    views = [view / view.sum() for view in views if view.sum() > 0]
    importance = np.mean(views, axis=0) if views else np.zeros(objects)
    return SeenObjects(importance, area, weights(importance, area))


def weights(importance: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(n,) float64 densities by `importance` and `area` (n,): as the root of the potential, up to a typical one, and not below LEAST.

    A landscape behind a window has 10,000 times the area of the room, and LEAST of its density would be most of the image.
    """
    if not importance.sum() > 0:
        return np.ones(len(area))
    potential = importance / np.maximum(area, 1e-300)
    order = np.argsort(potential, kind="stable")
    typical = potential[order][np.searchsorted(np.cumsum(importance[order]), TYPICAL * importance.sum())]
    weight = _up_to_most(np.sqrt(potential / typical), area)
    least = np.sqrt(SPARE * float((area * weight**2).sum()) / max(float(area.sum()), 1e-300))
    return np.maximum(weight, min(LEAST, least))


def _up_to_most(density: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(n,) float64 of `density` (n,), what is at most 1, or more where one object would get more than MOST else; the highest is 1.

    The ground of a landscape gets nearly all that is seen, and has nearly all of the area. A little less of it is much for all props.
    """
    weight = np.minimum(density, 1.0)
    for most in np.geomspace(1, max(float(density.max()), 1.0), STEPS):
        weight = np.minimum(density, most)
        texels = area * weight**2
        if texels.max() <= MOST * texels.sum():
            break
    return weight / weight.max()


def _arriving(world: World, start: Particles, rng: np.random.Generator) -> np.ndarray:
    """(objects,) float64 importance that arrives at each object."""
    total = np.zeros(len(world.scene.objects))

    def visit(hits: Hits) -> None:
        nonlocal total
        owner = world.scene.object[hits.surface.triangle]
        total += np.bincount(owner, hits.arriving.sum(axis=1), len(total))

    walk(world, start, LENGTH, rng, visit, importance=True)
    return total


def through_picture(world: World, count: int, rng: np.random.Generator) -> Particles | None:
    """`count` particles from the camera; None where there is none that can be used."""
    try:
        return CameraDetector(world).particles(count, rng)
    except AdjointError:
        return None


def _from_inside(world: World, count: int, rng: np.random.Generator) -> Particles | None:
    """`count` particles from the fronts of the objects, of each as the root of its area, of none more than of all others together; None
    where nothing has an area."""
    triangle = np.flatnonzero(world.area > 0)
    if not len(triangle):
        return None
    owner = world.scene.object[triangle]
    whole = np.bincount(owner, world.area[triangle])
    root = np.sqrt(whole)
    root = np.minimum(root, max(root.sum() - root.max(), 1e-3 * root.max()))
    share = np.cumsum(world.area[triangle] * (root / np.maximum(whole, 1e-300))[owner])
    which = triangle[np.minimum(np.searchsorted(share, rng.random(count) * share[-1], side="right"), len(triangle) - 1)]
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    surface = world.surface(which, (1 - root).astype(np.float32), (root * v).astype(np.float32))
    direction = cosine_directions(surface.ng, *rng.random((2, count)))
    weight = np.full((count, 3), 1 / count, np.float32)
    return Particles(world.leave(surface), direction, weight, np.zeros(count, np.int32), np.zeros(count, np.float32), kind=RayKind.DIFFUSE)


@dataclass(frozen=True, eq=False)
class Given:
    """What an object got of an image: texels, texels a metre, its share of the texels that are covered, and its weight, which is its
    texels a metre beside those of the densest object in the image. They are the root of its texels over its area: as many as along an
    edge, and the mean of length and width where long faces have fewer along their length."""

    object: str
    texels: int
    texels_per_metre: float
    share: float
    weight: float


def given(world: World, objects: Sequence[int], triangle: np.ndarray) -> tuple[Given, ...]:
    """Of `objects`, whose texels have their first points on `triangle` (n,)."""
    texels = np.bincount(world.scene.object[triangle], minlength=len(world.scene.objects))
    area = [max(float(world.area[world.scene.objects[k].triangles].sum()), 1e-300) for k in objects]
    many = texels[list(objects)].astype(np.float64)
    density = np.sqrt(many / area)
    share, weight = many / max(many.sum(), 1.0), density / max(density.max(initial=0.0), 1e-300)
    rows = zip(objects, many, density, share, weight, strict=True)
    return tuple(Given(world.scene.objects[k].name, int(m), float(d), float(s), float(w)) for k, m, d, s, w in rows)


def own_resolutions(area: np.ndarray, resolution: int) -> np.ndarray:
    """(n,) int64 texels a side of the images of n objects of `area` (n,) m2: `resolution`, as long as there are not more than FULL_IMAGES.

    Of more objects the larger ones get it, and the others powers of two by the root of their areas, so that all together take about
    as much as FULL_IMAGES.
    """
    count = len(area)
    if count <= FULL_IMAGES:
        return np.full(count, resolution, np.int64)
    # Shares by area, of which none is more than one whole image: what the largest do not take, the others get.
    part = np.sort(np.maximum(area, 1e-300))[::-1]
    rest = np.cumsum(part[::-1])[::-1]
    scale = (FULL_IMAGES - np.arange(FULL_IMAGES)) / rest[:FULL_IMAGES]
    whole = np.flatnonzero(scale * part[:FULL_IMAGES] <= 1)
    side = resolution * np.sqrt(scale[whole[0] if len(whole) else -1] * np.maximum(area, 1e-300))
    power = np.exp2(np.rint(np.log2(side))).clip(SMALLEST, None)
    return np.minimum(power, resolution).astype(np.int64)
