"""Adaptive subdivision: elements cut into four where their light changes too much, a hit found in as many steps as there are levels.

A refinement makes new `Elements` from old ones and keeps these to descend through: cells halve, so a child is found from the local
coordinates of its parent (Cohen, Greenberg, Immel and Brock 1986, "An Efficient Radiosity Approach for Realistic Image Synthesis").
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from .elements import Elements
from .smooth import Nodes

FINEST = 3  # levels between neighbours over which nodes are kept from cracking


class RefinedElements(Elements):
    """`old` elements, those in `split` (count,) bool cut into four.

    parent   (count,) int64 element of `old`; root (count,) int64 element of the elements that were never refined
    level    (count,) int64 how often an element has been cut
    """

    def __init__(self, old: Elements, split: np.ndarray) -> None:
        self.old = old
        self.world = old.world
        self.max_edge = old.max_edge
        for name in ("patch_triangle", "patch_second", "quad", "patch_of", "edge_s", "edge_t", "origin", "patch_area", "n", "m"):
            setattr(self, name, getattr(old, name))
        self._to_st, self._to_uv = old._to_st, old._to_uv
        many = np.where(split, 4, 1)
        self._first = np.cumsum(many) - many
        self._split = split
        self.count = int(many.sum())
        p = self.parent = np.repeat(np.arange(old.count), many)
        self.root = getattr(old, "root", np.arange(old.count))[p]
        cut = split[p]
        self.level = getattr(old, "level", np.zeros(old.count, np.int64))[p] + cut
        self.patch, self.is_quad = old.patch[p], old.is_quad[p]
        self.columns, self.rows = old.columns[p] << cut, old.rows[p] << cut
        self.area = np.where(cut, 0.25, 1.0) * old.area[p]

        # Children 0 to 2 lie at the corner, along a and along b; child 3 is the far corner of a quad, or the middle of a triangle.
        k = np.where(cut, np.arange(self.count) - self._first[p], 0)
        da, db = (k == 1) | (self.is_quad & (k == 3)), (k == 2) | (self.is_quad & (k == 3))
        # An upper triangle is the lower one turned by half a turn, and so are its children.
        upper = old.upper[p]
        di, dj = np.where(upper & (k < 3), ~da, da | (upper & (k == 3))), np.where(upper & (k < 3), ~db, db | (upper & (k == 3)))
        self.upper = upper ^ (cut & (k == 3) & ~self.is_quad)
        self.i = ((old.i[p] << cut) + (cut & di)).astype(np.int32)
        self.j = ((old.j[p] << cut) + (cut & dj)).astype(np.int32)
        self._finish()

    def descend(self, element: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Elements and local coordinates (n,) of points that lie at `a`, `b` of the elements `element` (n,) of `old`."""
        out = self._first[element]
        at = np.flatnonzero(self._split[element])
        if not len(at):
            return out, a, b
        a, b = a.copy(), b.copy()
        x, y = 2 * a[at], 2 * b[at]
        quad = self.old.is_quad[element[at]]
        right, high = x > 1, y > 1
        middle = ~quad & ~right & ~high & (x + y > 1)
        out[at] += np.where(quad, right + 2 * high, np.where(middle, 3, np.where(right, 1, 2 * high)))
        x, y = x - right, y - high
        a[at] = np.clip(np.where(middle, 1 - x, x), 0, 1)
        b[at] = np.clip(np.where(middle, 1 - y, y), 0, 1)
        return out, a, b

    def cell(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `Elements.cell`, level by level."""
        return self.descend(*self.old.cell(triangle, u, v))

    @cached_property
    def nodes(self) -> RefinedNodes:
        """The corners of all elements."""
        return RefinedNodes(self)


class RefinedNodes(Nodes):
    """Corners of refined elements. One that lies inside a longer edge hangs: its value follows that edge, so that nothing cracks."""

    def __init__(self, elements: RefinedElements) -> None:
        self.elements = e = elements
        index = np.arange(e.count)
        corner = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        owner, a, b = np.repeat(index, 4), np.tile(corner[:, 0], e.count), np.tile(corner[:, 1], e.count)
        # A triangle repeats its third corner.
        a = np.where(~e.is_quad[owner] & (a == 1) & (b == 1), 0.0, a)
        # Points inside edges at which finer neighbours may have a corner.
        depth = np.minimum(e.level.max(initial=0) - e.level, FINEST)
        pieces = [(owner, a, b)]
        ends = []
        for step in range(1, FINEST + 1):
            which = index[depth >= step]
            for share in (np.arange(1, 2**step, 2) / 2**step).tolist():
                # Edges between corners of `of_element`: 0-1, 0-2, and 1-3, 2-3 of a quad or 1-2 of a triangle.
                for c, d in ((0, 1), (0, 2), (1, 3), (2, 3)):
                    some = which[e.is_quad[which]] if (c, d) == (2, 3) else which
                    last = np.where(e.is_quad[some], d, min(d, 2))
                    at = corner[c] + share * (corner[last] - corner[c])
                    pieces.append((some, at[:, 0], at[:, 1]))
                    ends.append((some, np.full(len(some), c), last, np.full(len(some), share)))
        owner, a, b = (np.concatenate(x) for x in zip(*pieces, strict=True))
        shared, place = self._join(owner, a, b)
        first = shared[: 4 * e.count]
        real, self.of_element = np.unique(first, return_inverse=True)
        self.of_element = self.of_element.reshape(e.count, 4).astype(np.int32)
        self.count = len(real)
        self.position = np.empty((self.count, 3))
        self.position[self.of_element.ravel()] = place[: 4 * e.count]
        self._hang(real, shared[4 * e.count :], ends)
        self.weight = np.repeat(1 / np.sqrt(np.maximum(e.area, 1e-300))[:, None], 4, axis=1)
        self.weight[:, 3] *= e.is_quad

    def _join(self, owner: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shared numbers (n,) and positions (n, 3) of points of elements, each point of a patch looked at once."""
        e = self.elements
        scale = 1 << (int(e.level.max(initial=0)) + 1)
        s, t = e._st(owner, a, b)
        p = e.patch[owner]
        grid = np.stack([p, np.rint(s * e.n[p] * scale), np.rint(t * e.m[p] * scale)], axis=1).astype(np.int64)
        _, first, back = np.unique(grid, axis=0, return_index=True, return_inverse=True)
        normal = np.asarray(e.world.surface(*e.point(owner[first], a[first], b[first])).ns, np.float64)
        position = e.position(owner, a, b)
        return self._shared(position[first], normal)[back.reshape(-1)], position

    def _hang(self, real: np.ndarray, shared: np.ndarray, ends: list) -> None:
        """Find the nodes that lie inside longer edges; longest edges first, as their ends rule the rest."""
        empty = [np.zeros(0, np.int64)] * 3 + [np.zeros(0)]
        some, c, d, share = (np.concatenate(x) for x in zip(*ends, strict=True)) if ends else empty
        at = np.minimum(np.searchsorted(real, shared), self.count - 1)
        hit = np.flatnonzero(real[at] == shared) if self.count else np.zeros(0, np.int64)
        node, some, share = at[hit], some[hit], share[hit]
        low, high = self.of_element[some, c[hit]], self.of_element[some, d[hit]]
        length = np.linalg.norm(self.position[high] - self.position[low], axis=1)
        order = np.lexsort((node, -length))
        node, low, high, share, length = (x[order] for x in (node, low, high, share, length))
        # The longest edge rules a node that lies in several.
        _, first = np.unique(node, return_index=True)
        keep = np.sort(first)
        self.hanging = node[keep], low[keep], high[keep], share[keep].astype(np.float32)
        cut = np.flatnonzero(np.diff(length[keep]) < -1e-9 * self.elements.world.extent) + 1
        self.groups = np.split(np.arange(len(keep)), cut) if len(keep) else []

    def values(self, values: np.ndarray) -> np.ndarray:
        """As `Nodes.values`; nearer, smaller elements weigh more, and hanging nodes follow their edge."""
        out = super().values(values)
        node, low, high, share = self.hanging
        for group in self.groups:
            w = share[group, None]
            for side in (0, 1):
                a, b = out[2 * low[group] + side], out[2 * high[group] + side]
                out[2 * node[group] + side] = (1 - w) * a + w * b
        return out


def smoothed(elements: RefinedElements, base: Elements, values: np.ndarray) -> np.ndarray:
    """`values` (2 count, c) averaged over the elements of `base`, from which `elements` were refined, and read off them smoothly at the
    middles of `elements`: for light that few rays bring to each small element."""
    index = np.arange(elements.count)
    middle = np.where(elements.is_quad, 0.5, 1 / 3)
    s, t = elements._st(index, middle, middle)
    root = elements.root
    a, b = s * base.columns[root] - base.i[root], t * base.rows[root] - base.j[root]
    upper = base.upper[root]
    a, b = np.where(upper, 1 - a, a), np.where(upper, 1 - b, b)
    nodes = base.nodes.values(over_base(elements, base, values))
    a, b = (np.repeat(x.astype(np.float32), 2) for x in (a, b))
    return base.nodes.at(nodes, (2 * root[:, None] + np.arange(2)).ravel(), a, b)


def over_base(elements: RefinedElements, base: Elements, values: np.ndarray) -> np.ndarray:
    """(2 base.count, c) float64 area-weighted means of `values` (2 count, c) over the elements they were refined from."""
    side = (2 * elements.root[:, None] + np.arange(2)).ravel()
    area = np.repeat(elements.area, 2)
    total = np.repeat(base.area, 2)
    sums = [np.bincount(side, area * values[:, c], 2 * base.count) for c in range(values.shape[1])]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-300)[:, None]


def contrast(elements: Elements, irradiance: np.ndarray) -> np.ndarray:
    """(count,) how much `irradiance` (2 count, 3) of the sides changes over each element: the range of its corners' values and its own,
    as a share of the largest of them, which counts for at least a tenth of the mean of all that is lit."""
    light = irradiance.sum(axis=1)[:, None]
    area = np.repeat(elements.area, 2)
    lit = light[:, 0] > 0
    floor = 0.1 * (area * light[:, 0]).sum() / max(float(area[lit].sum()), 1e-300)
    nodes = elements.nodes.values(light)[:, 0].reshape(-1, 2)
    corners = nodes[elements.nodes.of_element]  # (count, 4, 2)
    both = np.concatenate([corners, light.reshape(-1, 1, 2)], axis=1)
    high, low = both.max(axis=1), both.min(axis=1)
    return ((high - low) / np.maximum(np.maximum(high, floor), 1e-300)).max(axis=1)


def longest_edge(elements: Elements) -> np.ndarray:
    """(count,) longest edge of each element, metres."""
    corners = elements.corners(np.arange(elements.count))
    return np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
