"""Seams: where a chart ends and the surface goes on in another one, the texels of both sides are made to show the same light.

On an edge of the mesh that two charts share, samples k are taken along it. What a texture shows there is bilinear in the texels, margins
included, so that closing a seam is a matter of least squares: over corrections d of the texels' values v

    sum_k (A_k (v + d) - B_k (v + d))^2  +  s sum_ij (d_i - d_j)^2  +  l sum_i d_i^2

with A and B the look-ups on both sides. The second sum, over texels beside one another, spreads a correction over some sqrt(s / l) texels,
so that no step is only moved. Only edges over which the shading goes on smoothly are closed, and where nothing stands between both sides:
over a sharp edge, and behind a wall, light differs.

M. Iwanicki, "Lighting Technology of The Last of Us", SIGGRAPH 2013 Talks (texels moved by least squares until both sides of a split edge
match; the second sum is ours). M. R. Hestenes and E. Stiefel, "Methods of Conjugate Gradients for Solving Linear Systems", 1952.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..scene.arrays import RayKind
from ..scene.topology import weld_near
from ..scene.world import World
from .margin import FilledImage
from .texels import Lightmap, placed_triangles

SMOOTH = 0.99  # cosine between the shading normals of both sides, from which the surface goes on
NEAR = 1e-5  # of the extent of the scene: ends of edges that are one; matrices of objects leave a hundredth of it
SPREAD, KEEP = 0.25, 0.01  # weights of the second and the third sum
REACH = 12  # texels from a seam up to which values change
MOST_SAMPLES = 1 << 21  # of all seams together
MOST_AT_EDGE = 8  # triangles that may meet at an edge; of more none goes on in another one
STEPS, ENOUGH = 200, 1e-2  # of the conjugate gradients, and the share of the residual at which they stop


@dataclass(frozen=True, eq=False)
class Seams:
    """Samples on the seams of one image: the four receivers that each side shows, (k, 4) int64, and their weights (k, 4) float64;
    beside (m,), (m,) receivers next to one another in the same chart, of those near a seam."""

    receiver: tuple[np.ndarray, np.ndarray]
    weight: tuple[np.ndarray, np.ndarray]
    beside: tuple[np.ndarray, np.ndarray]

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.receiver[0])

    def steps(self, values: np.ndarray) -> np.ndarray:
        """(k, c) by how much what both sides show of `values` (n, c) differs."""
        a, b = ((w[..., None] * values[r]).sum(axis=1) for r, w in zip(self.receiver, self.weight, strict=True))
        return a - b

    def closed(self, values: np.ndarray) -> np.ndarray:
        """(n, c) float32 `values` (n, c) of all receivers with the seams closed."""
        if not self.count:
            return values
        n, columns = len(values), values.shape[1]
        place = np.full(n, -1, np.int64)
        some = np.unique(np.concatenate([*(r.ravel() for r in self.receiver), *self.beside]))
        place[some] = np.arange(len(some))
        rows = np.concatenate([place[r] for r in self.receiver], axis=1)
        factors = np.concatenate([self.weight[0], -self.weight[1]], axis=1)
        i, j = (place[x] for x in self.beside)

        def apply(x: np.ndarray) -> np.ndarray:
            return spread(difference(x)) + SPREAD * smooth(x) + KEEP * x

        def difference(x: np.ndarray) -> np.ndarray:
            return (factors * x[rows]).sum(axis=1)

        def spread(y: np.ndarray) -> np.ndarray:
            return np.bincount(rows.ravel(), (factors * y[:, None]).ravel(), len(some))

        def smooth(x: np.ndarray) -> np.ndarray:
            d = x[i] - x[j]
            return np.bincount(i, d, len(some)) - np.bincount(j, d, len(some))

        out = np.array(values, np.float32)
        for c in range(columns):
            own = values[some, c].astype(np.float64)
            out[some, c] = own + _conserving(_solve(apply, -spread(difference(own))), min(0.0, float(own.min())) - own)
        return out


def _conserving(change: np.ndarray, least: np.ndarray) -> np.ndarray:
    """`change` (n,), whose sum is 0, not below `least` (n,): what the others gain is less then, so that no light is made."""
    change = np.maximum(change, least)
    gain, loss = np.maximum(change, 0), np.minimum(change, 0)
    return loss + gain * min(1.0, -float(loss.sum()) / max(float(gain.sum()), 1e-300))


def _solve(apply: Callable[[np.ndarray], np.ndarray], right: np.ndarray) -> np.ndarray:
    """x with apply(x) = right, by conjugate gradients; `apply` is symmetric and positive."""
    x, residual = np.zeros_like(right), right.copy()
    direction, norm = residual.copy(), float(residual @ residual)
    enough = norm * ENOUGH**2
    for _ in range(STEPS):
        if norm <= enough:
            break
        image = apply(direction)
        step = norm / float(direction @ image)
        x += step * direction
        residual -= step * image
        norm, before = float(residual @ residual), norm
        direction = residual + (norm / before) * direction
    return x


def find_seams(world: World, objects: Sequence[int], uv_layer: str | Mapping[int, str], lightmap: Lightmap, filled: FilledImage) -> Seams:
    """The seams of an image: between charts of `objects` that share an edge of the mesh, or lie edge to edge. `filled`: what the image
    shows in each pixel."""
    triangle, uv, chart, _ = placed_triangles(world, objects, uv_layer, {})
    size = np.array([lightmap.width, lightmap.height])
    uv = np.where(np.isfinite(uv), uv, np.nan) * size

    # Step 1: pairs of edges at one place that are apart in the image.
    used, vertex = np.unique(world.scene.triangles[triangle], return_inverse=True)
    ids = weld_near(world.scene.vertices[used] - world.center, NEAR * world.extent)[vertex.reshape(-1, 3)]
    towards, middle = lightmap.receivers.towards, np.full(len(triangle), 1 / 3, np.float32)
    first, second, turned = _edge_pairs(ids, world.surface(triangle, middle, middle, towards(triangle)).ng)
    ends = [_ends(uv, first, np.zeros(len(first), bool)), _ends(uv, second, turned)]
    apart = (np.abs(ends[0] - ends[1]) > 1e-3).any(axis=(1, 2)) & np.isfinite(ends[0] + ends[1]).all(axis=(1, 2))
    first, second, turned = first[apart], second[apart], turned[apart]
    ends = [e[apart] for e in ends]

    # Step 2: samples along them, about one a texel, where the surface goes on smoothly.
    longest = np.maximum(*(np.linalg.norm(e[:, 1] - e[:, 0], axis=1) for e in ends))
    longest = np.minimum(longest, 2.0 * size.max())
    many = np.ceil(longest * min(1.0, MOST_SAMPLES / max(longest.sum(), 1.0))).astype(np.int64)
    edge = np.repeat(np.arange(len(many)), many)
    t = (np.arange(len(edge)) - np.repeat(np.cumsum(many) - many, many) + 0.5) / many[edge]
    has = filled.sampled.reshape(-1)[lightmap.pixel]
    sides = [_look_up(filled, has, e[edge, 0] + t[:, None] * (e[edge, 1] - e[edge, 0])) for e in ends]
    normals = (
        _normals(world, triangle, first[edge], t, towards),
        _normals(world, triangle, second[edge], np.where(turned[edge], 1 - t, t), towards),
    )
    good = (sides[0][1].sum(axis=1) > 0.999) & (sides[1][1].sum(axis=1) > 0.999) & (np.einsum("ij,ij->i", *normals) > SMOOTH)

    # Step 3: of these, where both sides show what is their own, and nothing stands between them.
    good = np.flatnonzero(good)
    shown = [r[good, w[good].argmax(axis=1)] for r, w in sides]
    chart_of = lightmap.chart.reshape(-1)[lightmap.pixel]
    own = [chart_of[r] == chart[e[edge[good]] // 3] for r, e in zip(shown, (first, second), strict=True)]
    good = good[own[0] & own[1] & _in_sight(world, lightmap, *shown)]
    receiver = tuple(r[good] for r, _ in sides)
    weight = tuple(w[good] for _, w in sides)
    return Seams(receiver, weight, _beside(lightmap, filled, np.unique(np.concatenate([r.ravel() for r in receiver]))))


def _in_sight(world: World, lightmap: Lightmap, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(k,) bool: whether receivers `a` and `b` (k,) see one another from half as high above the surface as they are apart."""
    texels = lightmap.receivers
    point = texels.start[:-1][np.concatenate([a, b])]
    at = world.surface(texels.triangle[point], texels.u[point], texels.v[point], texels.towards(texels.triangle[point]))
    far = np.linalg.norm(at.position[len(a) :] - at.position[: len(a)], axis=1)
    raised = world.leave(at) + at.ng * np.tile(0.5 * far, 2)[:, None]
    start, end = (np.ascontiguousarray(x, np.float32) for x in (raised[: len(a)], raised[len(a) :]))
    return ~world.occluded(start, end - start, np.ones(len(a), np.float32), RayKind.DIFFUSE)


def _edge_pairs(ids: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (m,), (m,), each 3 * triangle + corner, of two triangles over which the surface goes on, and whether (m,) the second runs back.

    Where only two triangles meet at an edge, it is they; of more, as where the blocks of a wall touch, any two of the same `normal`
    (nt, 3) that no third one has.
    """
    a, b = ids.ravel(), np.roll(ids, -1, axis=1).ravel()
    key = np.minimum(a, b) * (int(ids.max(initial=0)) + 1) + np.maximum(a, b)
    order = np.argsort(key, kind="stable")
    order = order[a[order] != b[order]]
    _, place, many = np.unique(key[order], return_inverse=True, return_counts=True)
    many = many[place.reshape(-1)]
    pairs = [np.zeros((0, 2), np.int64)]
    for lag in range(1, min(int(many.max(initial=0)), MOST_AT_EDGE)):
        both = np.stack([order[:-lag], order[lag:]], axis=1)
        along = np.einsum("ij,ij->i", normal[both[:, 0] // 3], normal[both[:, 1] // 3]) > SMOOTH
        pairs.append(both[(key[both[:, 0]] == key[both[:, 1]]) & ((many[lag:] == 2) | along & (many[lag:] <= MOST_AT_EDGE))])
    found = np.concatenate(pairs)
    times = np.bincount(found.ravel(), minlength=ids.size)
    first, second = found[(times[found] == 1).all(axis=1)].T
    return first, second, a[first] != a[second]


def _ends(uv: np.ndarray, edge: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """(m, 2, 2) both ends of edges in texels."""
    flat = uv.reshape(-1, 2)
    ends = np.stack([flat[edge], flat[edge - edge % 3 + (edge + 1) % 3]], axis=1)
    return np.where(turned[:, None, None], ends[:, ::-1], ends)


def _normals(world: World, triangle: np.ndarray, edge: np.ndarray, t: np.ndarray, towards: Callable) -> np.ndarray:
    """(k, 3) shading normals of the baked side at `t` (k,) of the way along edges (k,)."""
    corner = edge % 3
    bary = np.zeros((len(edge), 3))
    bary[np.arange(len(edge)), corner] = 1 - t
    bary[np.arange(len(edge)), (corner + 1) % 3] = t
    bary, own = bary.astype(np.float32), triangle[edge // 3]
    return world.surface(own, bary[:, 1], bary[:, 2], towards(own)).ns


def _look_up(filled: FilledImage, has: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Receivers (k, 4) that a bilinear texture shows at points (k, 2) in texels, and their weights; 0 where there is none that `has` (n,)
    a sample."""
    height, width = filled.receiver.shape
    place = at - 0.5
    low = np.floor(place)
    part = place - low
    x, y = (
        np.clip(low[:, c, None] + np.array(d), 0, m - 1).astype(np.int64)
        for c, d, m in ((0, (0, 1, 0, 1), width), (1, (0, 0, 1, 1), height))
    )
    px, py = part[:, :1], part[:, 1:]
    weight = np.concatenate([(1 - px) * (1 - py), px * (1 - py), (1 - px) * py, px * py], axis=1)
    receiver = filled.receiver[y, x].astype(np.int64)
    return np.maximum(receiver, 0), np.where((receiver >= 0) & has[receiver], weight, 0)


def _beside(lightmap: Lightmap, filled: FilledImage, seam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Receivers (m,), (m,) next to one another in the same chart, of those up to `REACH` texels from the receivers `seam`."""
    own = np.where(filled.sampled, filled.receiver, -1)
    near = np.zeros(own.shape, bool)
    near.reshape(-1)[lightmap.pixel[seam]] = True
    for _ in range(REACH):
        grown = near.copy()
        grown[1:] |= near[:-1]
        grown[:-1] |= near[1:]
        grown[:, 1:] |= near[:, :-1]
        grown[:, :-1] |= near[:, 1:]
        near = grown
    out = []
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        fits = near[a] & near[b] & (own[a] >= 0) & (own[b] >= 0) & (lightmap.chart[a] == lightmap.chart[b])
        out.append((own[a][fits].astype(np.int64), own[b][fits].astype(np.int64)))
    return tuple(np.concatenate(x) for x in zip(*out, strict=True))
