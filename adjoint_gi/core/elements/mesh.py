"""The elements themselves as a mesh, with a value at every corner: what adaptive subdivision has made, ready to be written as an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .elements import Elements


@dataclass(frozen=True, eq=False)
class ElementMesh:
    """A mesh of quads and triangles.

    vertices   (nv, 3) float64 world space, metres; shared where the surface is smooth, doubled along hard edges
    corners    (nl,) int32 vertex of every face corner, anticlockwise about the front; start (nf + 1,) int64 first corner of each face
    triangle   (nf,) int32 triangle of the scene that each face lies on (the first one of its polygon)
    values     (nl, c) float32 at the corners, of the front side
    """

    vertices: np.ndarray
    corners: np.ndarray
    start: np.ndarray
    triangle: np.ndarray
    values: np.ndarray


def element_mesh(elements: Elements, values: np.ndarray) -> ElementMesh:
    """The mesh of `elements` with smooth corner values made of `values` (2 count, c), one for each side."""
    nodes = elements.nodes
    # Order of the nodes around a face: a quad's far corner comes third.
    around = nodes.of_element[:, [0, 1, 3, 2]]
    keep = np.ones(around.shape, bool)
    keep[:, 3] = elements.is_quad
    around[~elements.is_quad, 2] = nodes.of_element[~elements.is_quad, 2]
    corners = around[keep]
    start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
    smooth = nodes.values(values)[2 * corners]
    triangle = elements.patch_triangle[elements.patch].astype(np.int32)
    return ElementMesh(nodes.position + elements.world.center, corners.astype(np.int32), start, triangle, smooth)
