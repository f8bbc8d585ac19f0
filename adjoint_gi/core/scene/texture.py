"""Images on surfaces: kept as small as they are stored, decoded where they are looked up."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..base.color import decode_srgb
from ..base.digest import digest

BLOCK = 1 << 20  # texels that are decoded at once where all of them are wanted
LARGEST_HALF = 65504.0  # of a float16
KEPT = ("ranges", "row_means", "is_grey", "content")  # what is computed of the stored values once

Pixels = Callable[[np.ndarray], np.ndarray]  # of (n, 4) float32 scene-linear values others with the same alpha, in place or not


@dataclass(frozen=True, eq=False)
class Texture:
    """An image, row 0 at the bottom.

    stored       (h, w, c) uint8 as they are in the file, or float32 or float16 scene-linear; c is 4, 3 (opaque), 2 (grey with alpha) or 1
    srgb         of bytes: colours are sRGB-encoded
    times_alpha  of bytes: colours count times alpha, multiplied as they are stored
    """

    name: str
    stored: np.ndarray
    extension: str = "REPEAT"  # REPEAT, EXTEND, CLIP or MIRROR
    interpolation: str = "Linear"  # Linear or Closest
    srgb: bool = False
    times_alpha: bool = False

    @property
    def height(self) -> int:
        """Rows."""
        return self.stored.shape[0]

    @property
    def width(self) -> int:
        """Columns."""
        return self.stored.shape[1]

    @property
    def pixels(self) -> np.ndarray:
        """(h, w, 4) float32 scene-linear, all at once."""
        return self._decoded(self.stored.reshape(-1, self.stored.shape[2])).reshape(self.height, self.width, 4)

    @functools.cached_property
    def is_grey(self) -> bool:
        """Whether the three colour channels are equal in every texel."""
        if self.stored.shape[2] < 3:
            return True
        parts = (self.stored[rows] for rows in self.strips())  # a part at a time: colour shows soon
        return all(bool((s[:, :, 0] == s[:, :, 1]).all() and (s[:, :, 1] == s[:, :, 2]).all()) for s in parts)

    def strips(self) -> Iterator[slice]:
        """Rows from the bottom up, about `BLOCK` texels at a time."""
        step = max(1, BLOCK // self.width)
        return (slice(first, min(first + step, self.height)) for first in range(0, self.height, step))

    def blocks(self) -> Iterator[tuple[slice, np.ndarray]]:
        """(rows, (n, w, 4) float32 scene-linear) of the image from its bottom up, a part at a time."""
        for rows in self.strips():
            part = self.stored[rows]
            yield rows, self._decoded(part.reshape(-1, part.shape[2])).reshape(len(part), self.width, 4)

    @functools.cached_property
    def row_means(self) -> np.ndarray:
        """(h, 4) float64 mean of each row."""
        return np.concatenate([part.mean(axis=1, dtype=np.float64) for _, part in self.blocks()])

    @functools.cached_property
    def ranges(self) -> np.ndarray:
        """(2, 4) float32 least and largest value of each channel."""
        if self.stored.dtype == np.uint8 and not self.times_alpha:  # decoding keeps the order
            return self._decoded(_ends(self.stored))
        ends = np.array([_ends(part) for _, part in self.blocks()])
        return np.array([ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)])

    @functools.cached_property
    def content(self) -> bytes:
        """Digest of what is stored and how it is read, not of how it is looked up."""
        return digest((self.stored, self.srgb, self.times_alpha))

    def texels(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(n, 4) float32 scene-linear values of texels inside the image."""
        flat = self.stored.reshape(-1, self.stored.shape[2])
        return self._decoded(flat.take(y * self.width + x, axis=0))

    def with_pixels(self, pixels: np.ndarray) -> Texture:
        """The same look-up in other scene-linear pixels (h, w, 4) float32."""
        return Texture(self.name, compact(pixels), self.extension, self.interpolation)

    def smaller(self, halvings: int, pixels: Pixels | None = None) -> Texture:
        """A copy whose sides are divided by 2^`halvings`, each texel the mean of those that it stands for, or of what `pixels` makes of
        them."""
        ys, xs = _edges(self.height, halvings), _edges(self.width, halvings)
        sums = np.zeros((len(ys) - 1, len(xs) - 1, 4))
        row = np.repeat(np.arange(len(ys) - 1), np.diff(ys))
        for rows, part in self.blocks():
            part = part if pixels is None else pixels(part.reshape(-1, 4)).reshape(part.shape)
            across = np.add.reduceat(part, xs[:-1], axis=1, dtype=np.float64)
            into, starts = np.unique(row[rows], return_index=True)
            sums[into] += np.add.reduceat(across, starts, axis=0)
        mean = sums / (np.diff(ys)[:, None, None] * np.diff(xs)[None, :, None])
        return self.with_pixels(mean.astype(np.float16 if mean.max() <= LARGEST_HALF else np.float32).astype(np.float32))

    def _decoded(self, s: np.ndarray) -> np.ndarray:
        """(n, 4) float32 of stored values (n, c)."""
        out = np.empty((len(s), 4), np.float32)
        colors = s[:, :3] if s.shape[1] >= 3 else s[:, :1]
        alpha = s[:, -1:] if s.shape[1] in (2, 4) else None
        if s.dtype != np.uint8:
            out[:, :3], out[:, 3:] = colors, 1.0 if alpha is None else alpha
            return out
        if self.times_alpha and alpha is not None:
            out[:, :3] = _products(self.srgb)[colors.astype(np.uint16) << 8 | alpha]
        else:
            out[:, :3] = byte_values(self.srgb)[colors]
        out[:, 3:] = 1.0 if alpha is None else byte_values(False)[alpha]
        return out


def compact(pixels: np.ndarray) -> np.ndarray:
    """(h, w, c) with all that (h, w, 4) float32 holds: equal colours once, no alpha of 1, float16 where that has the same values."""
    height, width = pixels.shape[:2]
    flat = pixels.reshape(-1, 4)
    grey = bool((flat[:, 0] == flat[:, 1]).all() and (flat[:, 1] == flat[:, 2]).all())
    channels = ([0] if grey else [0, 1, 2]) + ([3] if (flat[:, 3] != 1.0).any() else [])
    if all(_fits_half(flat[i : i + BLOCK]) for i in range(0, len(flat), BLOCK)):
        return np.ascontiguousarray(flat[:, channels].astype(np.float16)).reshape(height, width, -1)
    kept = flat if len(channels) == 4 else np.ascontiguousarray(flat[:, channels])
    return kept.astype(np.float32, copy=False).reshape(height, width, -1)


def sample_texture(texture: Texture, st: np.ndarray) -> np.ndarray:
    """(n, 4) float32 texture values at image coordinates `st` (n, 2), bilinear between scene-linear values, or closest."""
    size = np.array([texture.width, texture.height], np.float32)
    st = np.where(np.isfinite(st), st, np.float32(0))
    if texture.interpolation == "Closest":
        cell = np.floor(st * size).astype(np.int64)
        return _texel(texture, cell[:, 0], cell[:, 1])
    p = st * size - np.float32(0.5)
    low = np.floor(p)
    f = (p - low).astype(np.float32)
    x, y = low[:, 0].astype(np.int64), low[:, 1].astype(np.int64)
    fx, fy = f[:, :1], f[:, 1:]
    bottom = _texel(texture, x, y) * (1 - fx) + _texel(texture, x + 1, y) * fx
    top = _texel(texture, x, y + 1) * (1 - fx) + _texel(texture, x + 1, y + 1) * fx
    return bottom * (1 - fy) + top * fy


def _texel(texture: Texture, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    height, width = texture.height, texture.width
    if texture.extension == "REPEAT":
        return texture.texels(y % height, x % width)
    if texture.extension == "MIRROR":
        x, y = x % (2 * width), y % (2 * height)
        return texture.texels(np.minimum(y, 2 * height - 1 - y), np.minimum(x, 2 * width - 1 - x))
    values = texture.texels(np.clip(y, 0, height - 1), np.clip(x, 0, width - 1))
    if texture.extension == "CLIP":
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        values = values * inside[:, None]
    return values


def as_bytes(values: np.ndarray) -> np.ndarray:
    """(n,) uint8 of float32 k / 255, as Blender hands out images of bytes."""
    out = np.empty(values.shape, np.uint8)
    step = 1 << 16  # what fits a cache
    for first in range(0, len(values), step):
        part = values[first : first + step] * np.float32(255)
        out[first : first + step] = np.rint(part, out=part)
    return out


def halvings_within(texture: Texture, size: int, most: int) -> int:
    """How often to halve the sides of what takes `size` bytes at those of `texture`, for it to take at most `most`, if it can."""
    halvings = 0
    # A copy holds at most four halves a texel, or floats where these do not do.
    while size > most and (texture.width >> halvings) * (texture.height >> halvings) * 8 > max(most, 8):
        halvings += 1
    return halvings


def renamed(texture: Texture, name: str, extension: str, interpolation: str) -> Texture:
    """The same stored values, looked up in another way; what is known of them stays known."""
    made = replace(texture, name=name, extension=extension, interpolation=interpolation)
    made.__dict__.update({key: texture.__dict__[key] for key in KEPT if key in texture.__dict__})
    return made


def _ends(values: np.ndarray) -> np.ndarray:
    """(2, c) least and largest of (h, w, c), a channel at a time, which is much faster than all at once."""
    channels = [values[..., c] for c in range(values.shape[2])]
    return np.array([[c.min() for c in channels], [c.max() for c in channels]], values.dtype)


def _edges(size: int, halvings: int) -> np.ndarray:
    """(m + 1,) where m parts of nearly equal size begin and end."""
    return np.round(np.linspace(0, size, max(1, size >> halvings) + 1)).astype(np.int64)


def _fits_half(values: np.ndarray) -> bool:
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float16).astype(np.float32) == values).all())


@functools.cache
def byte_values(srgb: bool) -> np.ndarray:
    """(256,) float32 scene-linear values of bytes."""
    values = np.arange(256, dtype=np.float32) * np.float32(1 / 255)
    return decode_srgb(values) if srgb else values


@functools.cache
def _products(srgb: bool) -> np.ndarray:
    """(65536,) float32 scene-linear values of a byte times an alpha: index 256 * byte + alpha."""
    values = np.multiply.outer(byte_values(False), byte_values(False)).ravel()
    return decode_srgb(values) if srgb else values
