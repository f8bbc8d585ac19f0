"""What a denoiser knows of the receivers: where they lie, which way they face, and which of them lie beside one another.

Light is never carried over the border of a piece - a chart of a lightmap, an object with vertex values - and the mean of every piece is
kept. Neighbours in a texture are looked for by rows and columns, those on a mesh along its edges.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..receivers.base import CameraReceivers, SurfaceReceivers
from ..receivers.texels import Lightmap
from ..receivers.vertices import VertexMap
from ..scene.world import World

# Pairs (i, j) of receivers, each (m,) int64: j counts for i with the weight that follows.
Pairs = tuple[np.ndarray, np.ndarray, float]


class Neighbours(Protocol):
    """Who lies beside whom, ever farther from level to level."""

    levels: int

    def pairs(self, level: int) -> Iterator[Pairs]:
        """Those of one level of the filter."""

    def distance(self, level: int) -> float:
        """How far they are from each other, in distances of the first level."""


@dataclass(frozen=True, eq=False)
class Ground:
    """What is known of the n receivers.

    piece      (n,) int64, 0, 1, ...: stretches that keep to themselves
    position   (n, 3) float32 m
    normal     (n, 3) float32, unit; zero where it is not known
    size       (n,) float32 distance of a receiver to the next one, m
    albedo     (n, 3) float32 of what is seen, which light from there has been multiplied by; 1 for light that arrives
    """

    piece: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    size: np.ndarray
    albedo: np.ndarray
    neighbours: Neighbours


class GridNeighbours:
    """Eight neighbours in images, twice as far from level to level (a-trous)."""

    levels = 5

    def __init__(self, images: Sequence[np.ndarray], piece: np.ndarray) -> None:
        """images (h, w) int64: the receiver of each pixel, -1 where there is none; piece (n,) as in `Ground`."""
        self.images, self._piece = images, piece

    def pairs(self, level: int) -> Iterator[Pairs]:
        """Both ways of each of the four directions."""
        step = 1 << level
        for image in self.images:
            for dy, dx, weight in ((0, 1, 0.5), (1, 0, 0.5), (1, 1, 0.25), (1, -1, 0.25)):
                a, b = _shifted(image, dy * step, dx * step)
                both = (a >= 0) & (b >= 0)
                i, j = a[both], b[both]
                same = self._piece[i] == self._piece[j]
                i, j = i[same], j[same]
                yield i, j, weight
                yield j, i, weight

    def distance(self, level: int) -> float:
        """Doubles."""
        return float(1 << level)


def _shifted(image: np.ndarray, dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
    """The parts of an image that lie over each other when it is moved by dy >= 0 rows and dx columns."""
    h, w = image.shape
    if dy >= h or abs(dx) >= w:
        return image[:0], image[:0]
    low, high = (image[: h - dy], image[dy:]) if dy else (image, image)
    return (low[:, : w - dx], high[:, dx:]) if dx >= 0 else (low[:, -dx:], high[:, :dx])


class EdgeNeighbours:
    """The ends of the edges of a mesh, again from level to level: a value walks one edge at each."""

    levels = 8

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        """Every edge (m,) once, between receivers `a` and `b`."""
        self._edges = a, b

    def pairs(self, level: int) -> Iterator[Pairs]:
        """All edges, both ways."""
        a, b = self._edges
        yield a, b, 0.5
        yield b, a, 0.5

    def distance(self, level: int) -> float:
        """Stays."""
        return 1.0


def texel_ground(world: World, receivers: SurfaceReceivers, lightmaps: Sequence[Lightmap]) -> Ground:
    """Of the texels of images, whose receivers follow one another in `receivers`; pieces are their charts."""
    piece, images, first, pieces = [], [], 0, 0
    for lightmap in lightmaps:
        chart = np.unique(lightmap.chart.reshape(-1)[lightmap.pixel], return_inverse=True)[1].reshape(-1) + pieces
        index = np.full(lightmap.height * lightmap.width, -1, np.int64)
        index[lightmap.pixel] = np.arange(first, first + len(chart))
        images.append(index.reshape(lightmap.height, lightmap.width))
        piece.append(chart.astype(np.int64))
        first, pieces = first + len(chart), int(chart.max(initial=pieces - 1)) + 1
    all_pieces = np.concatenate(piece)
    return _on_surfaces(world, receivers, all_pieces, GridNeighbours(images, all_pieces))


def vertex_ground(world: World, vertices: VertexMap) -> Ground:
    """Of the vertices or corners of meshes; pieces are objects."""
    receivers, piece, a, b = vertices.receivers, np.zeros(vertices.receivers.count, np.int64), [], []
    for k, (number, index) in enumerate(vertices.index.items()):
        piece[index[index >= 0]] = k
        corners = index[_nodes(world, number, vertices.domain)]
        a.append(corners.ravel())
        b.append(np.roll(corners, -1, axis=1).ravel())
    ends = np.sort(np.stack([np.concatenate(a), np.concatenate(b)], axis=1), axis=1)
    ends = np.unique(ends[(ends[:, 0] >= 0) & (ends[:, 0] != ends[:, 1])], axis=0)
    return _on_surfaces(world, receivers, piece, EdgeNeighbours(ends[:, 0], ends[:, 1]))


def _nodes(world: World, number: int, domain: str) -> np.ndarray:
    """(nt, 3) int64: which entries of a vertex map of object `number` its triangles have."""
    scene, obj = world.scene, world.scene.objects[number]
    if domain == "POINT":
        return scene.triangles[obj.triangles].astype(np.int64) - obj.first_vertex
    return scene.corners[obj.triangles].astype(np.int64)


def _on_surfaces(world: World, receivers: SurfaceReceivers, piece: np.ndarray, neighbours: Neighbours) -> Ground:
    """Of small sets of surface points, by the first of each."""
    first = receivers.start[:-1]
    triangle = receivers.triangle[first]
    surface = world.surface(triangle, receivers.u[first], receivers.v[first], receivers.towards(triangle))
    return _measured(piece, surface.position, surface.ns, neighbours, np.ones((len(piece), 3), np.float32))


def pixel_ground(receivers: CameraReceivers, normal: np.ndarray, depth: np.ndarray, albedo: np.ndarray) -> Ground:
    """Of the pixels of a camera, one piece, with their normals and albedos (n, 3) and depths (n,) along the rays, inf where there is no
    surface."""
    n = receivers.count
    pixel, middle = np.arange(n), np.full(n, 0.5)
    origin, direction = receivers.rays(pixel, middle, middle)
    met = np.isfinite(depth)
    position = origin + direction * np.where(met, depth, 0)[:, None]
    piece = np.zeros(n, np.int64)
    index = np.where(met, pixel, -1).reshape(receivers.height, receivers.width)
    return _measured(piece, position, normal, GridNeighbours([index], piece), albedo)


def _measured(piece: np.ndarray, position: np.ndarray, normal: np.ndarray, neighbours: Neighbours, albedo: np.ndarray) -> Ground:
    """With the mean distance of each receiver to those beside it."""
    n = len(piece)
    total, many = np.zeros(n), np.zeros(n)
    for i, j, _ in neighbours.pairs(0):
        total += np.bincount(i, np.linalg.norm(position[i] - position[j], axis=1), n)
        many += np.bincount(i, minlength=n)
    size = (total / np.maximum(many, 1)).astype(np.float32)
    return Ground(piece, position.astype(np.float32), normal.astype(np.float32), size, albedo, neighbours)
