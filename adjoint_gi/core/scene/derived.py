"""Textures made of others, value by value: of bytes in as few bytes as hold them well, and a colour that recurs is computed once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .texture import BLOCK, LARGEST_HALF, Pixels, Texture, byte_values


def derived(texture: Texture, pixels: Pixels) -> Texture:
    """The same look-up in the values that `pixels` makes of those of `texture`.

    Of bytes they are kept as bytes where these have the same values, else as halves, whose steps of at most 0.1 % are a fraction of those
    between bytes; of halves as halves; of floats as they are.
    """
    if texture.stored.dtype == np.float32:
        return texture.with_pixels(np.concatenate([_applied(pixels, part) for _, part in texture.blocks()]))
    if texture.stored.itemsize * texture.stored.shape[2] < 4 and texture.height * texture.width > BLOCK:
        return _by_colors(texture, pixels)
    return _value_by_value(texture, pixels)


def largest_size(texture: Texture) -> int:
    """Bytes that what is `derived` of `texture` takes at most, but where bytes or halves become more than a half holds."""
    return texture.height * texture.width * (3 + _has_alpha(texture)) * (4 if texture.stored.dtype == np.float32 else 2)


def _value_by_value(texture: Texture, pixels: Pixels) -> Texture:
    """In the first of three forms that holds all of the values."""
    forms = (_collected(texture, pixels, form) for form in (_as_bytes, _as_halves, _as_floats))
    stored = next(values for values in forms if values is not None)
    made = replace(texture, stored=stored, srgb=texture.srgb and stored.dtype == np.uint8, times_alpha=False)
    return replace(made, stored=np.ascontiguousarray(stored[:, :, ::3])) if made.is_grey else made  # red, and alpha if there is one


def _by_colors(texture: Texture, pixels: Pixels) -> Texture:
    """The same where a texel takes up to three bytes: every colour that occurs becomes a texel of a smaller image."""
    raw = texture.stored.view(np.uint8)
    shifts = np.arange(raw.shape[2]) * 8
    occurs = np.zeros(1 << 8 * len(shifts), bool)
    for rows in texture.strips():
        occurs[_codes(raw[rows])] = True
    codes = np.flatnonzero(occurs)
    colors = (codes[:, None] >> shifts & 255).astype(np.uint8).view(texture.stored.dtype)
    made = _value_by_value(replace(texture, stored=colors[:, None]), pixels)
    number = np.cumsum(occurs, dtype=np.int32) - 1
    stored = np.empty((texture.height, texture.width, made.stored.shape[2]), made.stored.dtype)
    for rows in texture.strips():
        stored[rows] = made.stored[number[_codes(raw[rows])], 0]
    out = replace(made, stored=stored)
    out.__dict__.update(ranges=made.ranges, is_grey=made.is_grey)  # all of its values are there, and no others
    return out


def _codes(colors: np.ndarray) -> np.ndarray:
    """A number (h, w) int32 for each colour (h, w, c) uint8, its first byte the lowest."""
    out = colors[..., 0].astype(np.int32)
    for c in range(1, colors.shape[2]):
        out |= colors[..., c].astype(np.int32) << 8 * c
    return out


def _applied(pixels: Pixels, part: np.ndarray) -> np.ndarray:
    return pixels(part.reshape(-1, 4)).reshape(part.shape)


def _has_alpha(texture: Texture) -> bool:
    return texture.stored.shape[2] in (2, 4)


def _collected(texture: Texture, pixels: Pixels, form: Callable[[Texture, np.ndarray], np.ndarray | None]) -> np.ndarray | None:
    """(h, w, 3 or 4) what `pixels` makes of all values in one form, None where some do not have it."""
    parts = []
    for _, part in texture.blocks():
        kept = form(texture, _applied(pixels, part))
        if kept is None:
            return None
        parts.append(kept)
    return np.concatenate(parts)


def _as_bytes(texture: Texture, values: np.ndarray) -> np.ndarray | None:
    """Values (h, w, 4) of an opaque image of bytes as bytes (h, w, 3) in its encoding, if they are among the 256."""
    if texture.stored.dtype != np.uint8 or _has_alpha(texture):
        return None
    table = byte_values(texture.srgb)
    found = np.minimum(np.searchsorted(table, values[..., :3]), 255)
    return found.astype(np.uint8) if (table[found] == values[..., :3]).all() else None


def _as_halves(texture: Texture, values: np.ndarray) -> np.ndarray | None:
    """Values (h, w, 4) rounded to halves, with alpha if the image has it; None where one is too large."""
    return _as_floats(texture, values).astype(np.float16) if np.abs(values).max() <= LARGEST_HALF else None


def _as_floats(texture: Texture, values: np.ndarray) -> np.ndarray:
    return values if _has_alpha(texture) else np.ascontiguousarray(values[..., :3])
