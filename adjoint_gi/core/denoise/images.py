"""Any denoiser of images as one of layers of light: texels are packed into one image, charts continued into their margins first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..receivers.margin import margin_source
from .ground import GridNeighbours, Ground
from .step import Denoiser, NoisyLight

# (image, albedo, normal), each (h, w, 3) float32, to the image without noise.
DenoiseImage = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
REACH = 16  # pixels by which charts are continued, so that neither black nor other charts come near
BORDER = 8  # pixels around every part of a packed image
DRAWS = 4  # tries of a pixel beside a chart to find one inside at random, where the mirrored one is not in it
LARGEST = 1 << 22  # pixels of one packed image, unless one part alone has more


def image_denoiser(ground: Ground, denoise_image: DenoiseImage, rng: np.random.Generator) -> Denoiser:
    """`denoise_image` for receivers that are pixels of images."""
    assert isinstance(ground.neighbours, GridNeighbours)
    images = ground.neighbours.images

    def denoise(layers: Sequence[NoisyLight]) -> list[np.ndarray]:
        out = [np.array(layer.values) for layer in layers]
        tiles = [Tile.of(image, layers[0].valid, ground.piece, rng) for image in images]
        for part in _batches([(k, tile) for tile in tiles if tile.own.any() for k in range(len(layers))]):
            _run(part, ground, layers, out, denoise_image)
        return out

    return denoise


@dataclass(frozen=True, eq=False)
class Tile:
    """One image with a border.

    receiver   (h, w) int64 that each pixel shows, -1 far from all charts; beside a chart those inside its border, mirrored, or, where the
               chart is narrower than that, some near it: a single noisy texel that was drawn out would look like light
    own        (h, w) bool, pixels that are not such
    """

    receiver: np.ndarray
    own: np.ndarray

    @staticmethod
    def of(image: np.ndarray, valid: np.ndarray, piece: np.ndarray, rng: np.random.Generator) -> Tile:
        """Of an image (h, w) of receivers, those that are `valid` (n,), each of a `piece` (n,)."""
        image = np.pad(image, BORDER, constant_values=-1)
        own = (image >= 0) & valid[np.maximum(image, 0)]
        source = margin_source(own, REACH)
        y, x = np.nonzero((source >= 0) & ~own)
        nearest = source[y, x].astype(np.int64)
        v, u = 2 * (nearest // image.shape[1]) - y, 2 * (nearest % image.shape[1]) - x
        v, u = np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)
        shown, mirrored = image.reshape(-1)[nearest], image[v, u]
        fits = own[v, u] & (piece[np.maximum(mirrored, 0)] == piece[shown])
        receiver = np.where(own, image, -1)
        receiver[y, x] = np.where(fits, mirrored, shown)

        # Of charts of few rows, others no farther away than the nearest: a row that is repeated has no noise across it.
        reach = np.maximum(np.abs(nearest // image.shape[1] - y), np.abs(nearest % image.shape[1] - x))
        for _ in range(DRAWS):
            y, x, nearest, reach, shown = (array[~fits] for array in (y, x, nearest, reach, shown))
            v = np.clip(nearest // image.shape[1] + rng.integers(-reach, reach + 1), 0, image.shape[0] - 1)
            u = np.clip(nearest % image.shape[1] + rng.integers(-reach, reach + 1), 0, image.shape[1] - 1)
            fits = own[v, u] & (piece[np.maximum(image[v, u], 0)] == piece[shown])
            receiver[y[fits], x[fits]] = image[v[fits], u[fits]]
        return Tile(receiver, own)


Job = tuple[int, Tile]  # number of the layer, and where its values go


def _batches(jobs: list[Job]) -> list[list[Job]]:
    """Parts that go into one image each, high ones first."""
    out: list[list[Job]] = []
    room = 0
    for job in sorted(jobs, key=lambda job: -job[1].own.shape[0]):
        if job[1].own.size > room:
            out.append([])
            room = LARGEST
        out[-1].append(job)
        room -= job[1].own.size
    return out


def _run(jobs: list[Job], ground: Ground, layers: Sequence[NoisyLight], out: list[np.ndarray], denoise_image: DenoiseImage) -> None:
    """Denoise the layers of `jobs` in one image, and put what comes of it into `out`."""
    # Step 1: places, in rows.
    width = max(max(tile.own.shape[1] for _, tile in jobs), int(np.sqrt(sum(tile.own.size for _, tile in jobs))))
    places, x, y, high = [], 0, 0, 0
    for _, tile in jobs:
        if x + tile.own.shape[1] > width:
            x, y, high = 0, y + high, 0
        places.append((slice(y, y + tile.own.shape[0]), slice(x, x + tile.own.shape[1])))
        x, high = x + tile.own.shape[1], max(high, tile.own.shape[0])
    whole = np.zeros((3, y + high, width, 3), np.float32)

    # Step 2: light, all layers as bright as each other, and guides.
    scale = [1.0 / max(float(layer.values[layer.valid].mean()), 1e-30) for layer in layers]
    for (k, tile), place in zip(jobs, places, strict=True):
        shown, at = tile.receiver >= 0, np.maximum(tile.receiver, 0)
        for image, values in zip(whole, (layers[k].values, ground.albedo, ground.normal), strict=True):
            image[place] = np.where(shown[..., None], values[at], 0)
        whole[0][place] *= scale[k]
    found = denoise_image(*whole)

    # Step 3: back to the receivers; pixels that continue a chart are left out.
    for (k, tile), place in zip(jobs, places, strict=True):
        out[k][tile.receiver[tile.own]] = found[place][tile.own] / scale[k]
