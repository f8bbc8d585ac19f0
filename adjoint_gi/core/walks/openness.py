"""Whether light leaks out of a scene, and whether it arrives only at the backs of faces: a few thousand particles, followed before a bake.

A bake shows the fronts of faces, so faces that are lit from the back only come out black: their normals point the wrong way, or nothing
lights the side that is baked. A sheet that is lit from both sides loses nothing, and a surface that hangs together with normals that agree
counts as one: an open column in the sun, whose far half has light within alone, is the right way round. Most scenes are open, and nothing
is at stake there; light that leaves a nearly closed scene is a leak.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.errors import Notice
from ..base.text import plain
from ..lights.emission import Emission
from ..scene.topology import oriented_pieces, weld
from ..scene.world import World, once_a_world
from .particles import Hits, walk

PARTICLES = 16384
LENGTH = 8  # segments a particle is followed
LEAK = 0.03  # a scene that less than this share of the reflected particles leaves is meant to be closed
TIGHT = 1e-3  # and nothing is at stake where less than this leaves it
ENOUGH = (
    8  # arrivals at a triangle from which on they tell its dark side: at a sheet lit from both sides all of 8 are at one by chance 1 in 128
)
DARK = 0.9  # share of arrivals at the back from which on the front counts as dark
STAKE = 0.05  # share of the arrivals at an object that faces with a dark front must have
MIN_ARRIVALS = 50  # arrivals at an object from which on its share means something


@dataclass(frozen=True, eq=False)
class Openness:
    """escaped   share of the particles that met a surface and left the scene afterwards
    lost      (number of objects,) float64, share of the arrivals at each object that are at faces lit from the back only
    arrivals  (number of objects,) int64
    sides     (2, number of triangles) int64, arrivals at the front and at the back of each triangle
    """

    escaped: float
    lost: np.ndarray
    arrivals: np.ndarray
    sides: np.ndarray


def measure(world: World, particles: int = PARTICLES) -> Openness:
    """Follow `particles` particles of all lights, once for each world; nothing arrives where nothing emits."""
    return _follow(world, particles)


@once_a_world
def _follow(world: World, particles: int) -> Openness:
    emission = Emission(world)
    sides = np.zeros((2, world.triangle_count), np.int64)  # arrivals at the front and at the back of each triangle
    if emission.is_dark or world.triangle_count == 0:
        return Openness(0.0, *_lost(world, sides), sides)
    rng = np.random.default_rng(0)
    met = np.zeros(particles, bool)

    def visit(hits: Hits) -> None:
        met[hits.row] = True
        count_sides(sides, hits)

    ends = walk(world, emission.draw(particles, rng), LENGTH, rng, visit)
    count = int(np.count_nonzero(met))
    left = ends.escaped - (ends.emitted - count)
    return Openness(left / max(1, count), *_lost(world, sides), sides)


def count_sides(sides: np.ndarray, hits: Hits) -> None:
    """Add `hits` to `sides` (2, nt) int64, the arrivals at the front and at the back of each triangle."""
    surface = hits.surface
    for k, of_side in enumerate((surface.side > 0, surface.side < 0)):
        sides[k] += np.bincount(surface.triangle[of_side], minlength=sides.shape[1])


def of_sheets(world: World, sides: np.ndarray) -> np.ndarray:
    """`sides` (2, nt) int64, arrivals at both sides of each triangle, summed over the surface that hangs together with it with normals that
    agree. Triangles of objects that nearly nothing reaches from behind keep their own."""
    label = np.arange(world.triangle_count)
    behind = np.bincount(world.scene.object, sides[1], len(world.scene.objects))
    for index in np.flatnonzero(behind >= DARK * ENOUGH).tolist():
        obj = world.scene.objects[index]
        label[obj.triangles] = obj.first_triangle + _sheets(world, index)
    return np.stack([np.bincount(label, counts, world.triangle_count)[label] for counts in sides]).astype(np.int64)


@once_a_world
def _sheets(world: World, index: int) -> np.ndarray:
    """(n,) int64 labels of the triangles of object `index`."""
    obj = world.scene.objects[index]
    vertices = world.scene.vertices[obj.first_vertex : obj.first_vertex + obj.vertex_count]
    return oriented_pieces(weld(vertices)[world.scene.triangles[obj.triangles] - obj.first_vertex])


def _lost(world: World, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of arrivals at dark fronts and arrivals of each object, from those at both sides (2, nt) of all triangles.

    Where the surfaces of an object are too small to have arrivals enough each, it counts as one.
    """
    owner, objects = world.scene.object, len(world.scene.objects)

    def of_objects(counts: np.ndarray) -> np.ndarray:
        return np.bincount(owner, counts, objects)

    total, sheets = sides.sum(axis=0), of_sheets(world, sides)
    arrivals = of_objects(total)
    told = sheets.sum(axis=0) >= ENOUGH
    known = of_objects(total * told)
    dark = of_objects(total * (told & (sheets[1] >= DARK * sheets.sum(axis=0))))
    back = of_objects(sides[1])
    whole = np.where(back >= DARK * arrivals, back / np.maximum(arrivals, 1), 0.0)
    return np.where(known >= MIN_ARRIVALS, dark / np.maximum(known, 1), whole), arrivals.astype(np.int64)


def notices(world: World, baked: set[int], particles: int = PARTICLES) -> list[Notice]:
    """What `measure` finds, in words: leaks, and of the objects `baked` (indices) those whose baked side is dark."""
    found = measure(world, particles)
    out = []
    if TIGHT <= found.escaped < LEAK:
        reason = f"{plain(100 * found.escaped)} % of the light leaves the scene, which is nearly closed: it leaks through gaps"
        out.append(Notice("Scene", reason, "Close the gaps, unless they are meant"))
    for index in np.flatnonzero((found.lost > STAKE) & (found.arrivals >= MIN_ARRIVALS)):
        if index in baked:
            which = "all of its faces are" if found.lost[index] > DARK else "some of its faces are"
            reason = f"{which} lit from the back only, and only fronts are baked: they come out black"
            out.append(Notice(world.scene.objects[index].name, reason, "Recalculate its normals, or turn the faces round"))
    return out
