"""Which side of each face a bake shows: the front, or the back where that is the one that is seen, or else the one that is lit.

Rooms are modelled with faces whose normals point away from the room, and a render shows their backs. What is seen is found by particles
of importance from the camera (the potential of its view, Eq. 2), what is lit by particles of the lights. A surface that hangs together
with normals that agree is turned as a whole or not at all; where both of its sides are met, its fronts are baked, as Cycles bakes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..base.errors import Notice
from ..scene.world import World, once_a_world
from ..walks import openness
from ..walks.openness import DARK, ENOUGH, MIN_ARRIVALS, count_sides, of_sheets
from ..walks.particles import walk
from .density import through_picture

PARTICLES = 16384  # of importance
LENGTH = 4  # segments each is followed
CLOSED = 1e-3  # share of the area of a body that its area vectors may leave


@dataclass(frozen=True, eq=False)
class BakedSides:
    """facing (nt, 3) float32 as `SurfaceReceivers` has it, None where all are fronts; notices: the objects of which backs are baked."""

    facing: np.ndarray | None
    notices: tuple[Notice, ...]


def baked_sides(world: World, objects: Sequence[int]) -> BakedSides:
    """The sides of the triangles of `objects` (indices) to bake. The same every time."""
    if not len(objects):  # a picture bakes no side
        return BakedSides(None, ())
    seen, lit = _seen(world), openness.measure(world).sides
    owner, volume = world.scene.object, _volume(world)
    # What is seen decides; where too little of it is known, what is lit.
    back, known = _by_back(world, seen, volume)
    also, _ = _by_back(world, lit, volume)
    also &= ~_glows(world, lit, volume)[owner]
    back = np.where(known, back, also) & np.isin(owner, np.asarray(objects, np.int64))
    if not back.any():
        return BakedSides(None, ())
    facing = np.where(back[:, None], -world.rows[:, 9:12], world.rows[:, 9:12])
    return BakedSides(facing, tuple(_notices(world, back)))


@once_a_world
def _seen(world: World) -> np.ndarray:
    """(2, nt) int64 how many particles of the camera arrive at the fronts and backs of all triangles."""
    rng, sides = np.random.default_rng(0), np.zeros((2, world.triangle_count), np.int64)
    view = through_picture(world, PARTICLES, rng)
    if view is not None:
        walk(world, view, LENGTH, rng, partial(count_sides, sides), importance=True)
    return sides


def _by_back(world: World, sides: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(nt,) bool: the back is met, and the front hardly; and (nt,) bool: enough arrived to tell. `sides` as of `_seen`, `volume` as of
    `_volume`.

    Surfaces over which the normals agree count as one. Those with few arrivals follow their objects. Small objects have few as well: where
    all are at one side, a few are enough, and any where that is the outside of a body.
    """
    owner, objects = world.scene.object, len(world.scene.objects)
    of_object, back_of_object = (np.bincount(owner, counts, objects) for counts in (sides.sum(axis=0), sides[1]))
    all_back = (of_object > 0) & (back_of_object == of_object)
    agreed = (of_object >= ENOUGH) & (all_back | (back_of_object == 0))
    told = (of_object >= MIN_ARRIVALS) | agreed | (all_back & (volume < 0))
    sheets = of_sheets(world, sides)
    total = sheets.sum(axis=0)
    own = total >= ENOUGH
    known = own | told[owner]
    back = np.where(own, sheets[1] >= DARK * total, (back_of_object >= DARK * of_object)[owner])
    return back & known, known


def _glows(world: World, lit: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """(objects,) bool: closed bodies that emit all over and are lit from outside, `lit` (2, nt). Their light within is for nobody."""
    scene = world.scene
    emits = np.array([any(lobe.kind == "emission" and not lobe.is_black for lobe in m.lobes) for m in scene.materials], bool)
    dark, fronts = (np.bincount(scene.object, x, len(scene.objects)) for x in (~emits[scene.material], lit[0]))
    return (dark == 0) & (fronts > 0) & (volume > 0)


def _volume(world: World) -> np.ndarray:
    """(objects,) float64 volumes of closed bodies, whose area vectors cancel out: negative where their fronts look inwards, 0 of others."""
    owner, objects = world.scene.object, len(world.scene.objects)

    def of_objects(values: np.ndarray) -> np.ndarray:
        return np.bincount(owner, values, objects)

    corner = world.rows[:, :9].astype(np.float64).reshape(-1, 3, 3)  # a corner and the two edges from it
    vector = 0.5 * np.cross(corner[:, 1], corner[:, 2])
    area = of_objects(np.linalg.norm(vector, axis=1))
    net = np.stack([of_objects(vector[:, k]) for k in range(3)], axis=1)
    middle = corner[:, 0] + (corner[:, 1] + corner[:, 2]) / 3
    centre = np.stack([of_objects(middle[:, k]) for k in range(3)], axis=1) / np.maximum(of_objects(np.ones(len(owner))), 1)[:, None]
    volume = of_objects(np.einsum("ij,ij->i", middle - centre[owner], vector)) / 3
    return np.where((np.linalg.norm(net, axis=1) < CLOSED * area) & (np.abs(volume) > CLOSED**2 * area**1.5), volume, 0)


def _notices(world: World, back: np.ndarray) -> list[Notice]:
    """One for each object of which backs are baked."""
    owner = world.scene.object
    out = []
    for index in np.unique(owner[back]):
        share = world.area[back & (owner == index)].sum() / max(float(world.area[owner == index].sum()), 1e-300)
        which = "all of its faces are" if share > 1 - 1e-6 else "some of its faces are"
        reason = f"{which} seen or lit from the back only, so their backs are baked"
        out.append(Notice(world.scene.objects[index].name, reason, "", "info"))
    return out
