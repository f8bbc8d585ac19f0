"""Mean emitted radiance over parts of triangles: exact where images and attributes are added, by many points where they are multiplied."""

from __future__ import annotations

import numpy as np

from ..sampling.additive import STEPS, additive
from .arrays import Color, SceneArrays, Source
from .row_sums import polygon_means
from .shading import LARGEST_EMISSION, Shading, evaluate, image_coordinates, source_at

POINTS = 64  # at least, of a part of a triangle whose emission is a product
POINTS_PER_TEXEL = 16  # of such products, as long as there are no more points altogether than
MOST_POINTS = 1 << 22


def mean_emission(shading: Shading, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) float64 mean of `shading.emission` over convex polygons with corners at barycentrics `u`, `v` (n, k) of triangles (n,).

    Corners are in order; polygons with fewer than k repeat some.
    """
    scene, colors = shading.scene, shading.emission_colors
    material = np.asarray(scene.material)[triangle]
    present, back = np.unique(material, return_inverse=True)
    out = np.array([colors[index].constant for index in present], np.float64).reshape(-1, 3)[back]
    for index in present:
        if not colors[index].is_constant:
            which = np.flatnonzero(material == index)
            out[which] = _means(colors[index], scene, triangle[which], u[which], v[which])
    return np.clip(out, 0, LARGEST_EMISSION)


def _means(color: Color, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) means of one colour."""
    if not _adds_up(color, scene):
        return _by_points(color, scene, triangle, u, v)
    out, measured = np.zeros((len(triangle), 3)), np.ones(len(triangle), bool)
    for term in color.terms:
        mean = 1.0
        for source in term.sources:
            mean, solid = _source_means(source, scene, triangle, u, v)
            measured &= solid
        out += np.asarray(term.constant) * mean
    flat = np.flatnonzero(~measured)
    if len(flat):
        out[flat] = _by_points(color, scene, triangle[flat], u[flat], v[flat])
    return out


def _adds_up(color: Color, scene: SceneArrays) -> bool:
    """Whether the mean of the colour is the sum of means: no products, and no value that is clipped."""
    low, high = np.zeros(3), np.zeros(3)
    for term in color.terms:
        if len(term.sources) > 1:
            return False
        ends = np.array([term.constant, term.constant], np.float64)
        for source in term.sources:
            ends = ends * _ends(source, scene)
        low, high = low + ends.min(axis=0), high + ends.max(axis=0)
    return bool((low >= 0).all() and (high <= LARGEST_EMISSION).all())


def _ends(source: Source, scene: SceneArrays) -> np.ndarray:
    """(2, 3) least and largest value of a source, 0 among them as it may be missing."""
    if source.kind == "image":
        ends = [scene.textures[source.texture].ranges]
    else:
        ends = [
            np.array([x.min(axis=(0, 1)), x.max(axis=(0, 1))]) for x in (o.colors.get(source.name) for o in scene.objects) if np.size(x) > 1
        ]
    both = np.array([np.zeros(4), *(row for pair in ends for row in pair)], np.float64)
    both = np.array([both.min(axis=0), both.max(axis=0)])
    return np.repeat(both[:, 3:], 3, axis=1) if source.alpha else both[:, :3]


def _source_means(source: Source, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) means of an image or attribute, and (n,) whether they could be measured."""
    if source.kind != "image":  # linear, so its mean is the value at the centroid
        return source_at(source, scene, triangle, *_centroid(u, v)).astype(np.float64), np.ones(len(triangle), bool)
    flat = (np.repeat(triangle, u.shape[1]), u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    texture = scene.textures[source.texture]
    channels = (3,) if source.alpha else (0,) if texture.is_grey else (0, 1, 2)
    values, solid = polygon_means(texture, image_coordinates(source, scene, *flat).reshape(*u.shape, 2), channels)
    return np.broadcast_to(values, (len(values), 3)), solid


def _fan(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, k - 2) areas of the triangles of a fan from the first corner, summing to 1."""
    a, b = u[:, 1:] - u[:, :1], v[:, 1:] - v[:, :1]
    area = np.abs(a[:, :-1] * b[:, 1:] - a[:, 1:] * b[:, :-1]) + 1e-30
    return area / area.sum(axis=1, keepdims=True)


def _centroid(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentrics (n,) float32 each."""
    share = _fan(u, v)
    u, v = (((x[:, :1] + x[:, 1:-1] + x[:, 2:]) / 3 * share).sum(axis=1) for x in (u, v))
    return u.astype(np.float32), v.astype(np.float32)


def _by_points(color: Color, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) means over evenly spread points, more where a part covers more texels; a little more than 0, as some lie between them."""
    texels = np.zeros(len(triangle))
    flat = (np.repeat(triangle, u.shape[1]), u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    for source in {s for term in color.terms for s in term.sources if s.kind == "image"}:
        texture = scene.textures[source.texture]
        st = image_coordinates(source, scene, *flat).reshape(*u.shape, 2)
        side = np.ptp(st, axis=1) * (texture.width, texture.height) + 1
        texels = np.maximum(texels, side.prod(axis=1))
    wanted = POINTS_PER_TEXEL * texels
    count = np.ceil(np.maximum(POINTS, wanted * min(1, MOST_POINTS / max(wanted.sum(), 1)))).astype(np.int64)
    out, share = np.zeros((len(triangle), 3)), np.cumsum(_fan(u, v), axis=1)
    ends = np.cumsum(count)
    for part in np.split(np.arange(len(triangle)), np.flatnonzero(np.diff(ends // (1 << 20))) + 1):
        own = np.repeat(part, count[part])
        number = np.arange(len(own)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        # Points of the square, folded, and of which triangle of the fan.
        a, b, c = additive(number, STEPS[2], 0.5)[0], additive(number, STEPS[2], 0.5)[1], (number + 0.5) / count[own]
        fold = a + b > 1
        a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
        k = np.minimum((c[:, None] > share[own]).sum(axis=1), share.shape[1] - 1)
        x, y = ((w[own, 0] + a * (w[own, k + 1] - w[own, 0]) + b * (w[own, k + 2] - w[own, 0])).astype(np.float32) for w in (u, v))
        values = np.clip(evaluate(color, scene, triangle[own], x, y), 0, LARGEST_EMISSION)
        for channel in range(3):
            out[:, channel] += np.bincount(own, values[:, channel], len(out))
    return out / count[:, None]
