"""Images: Blender's pixels to scene-linear float32 textures, within a budget of pixels.

Blender hands out float images scene-linear with associated alpha, and byte images as they are stored (measured on 4.2 and 5.2), so the
latter are decoded here. As in Cycles, the colour of an image with straight alpha is multiplied by alpha in its stored encoding when
the node's Alpha output is not used. Two things are not copied from Cycles (seen on 4.2 to 5.2): it interpolates byte images between
their stored values and decodes afterwards, and rounds byte colours times alpha to bytes. Both are exact here.
"""

from __future__ import annotations

import bpy
import numpy as np

from ..core.scene import Texture
from .extract_notices import Notices
from .image_header import stored_size

LARGEST_IMAGE = 8192 * 8192  # pixels
LARGEST_TOTAL = 2 * LARGEST_IMAGE  # pixels of all textures together: 2 GB of float32 RGBA
MEAN_OF_NOTHING = (0.8, 0.8, 0.8, 1.0)  # for an image without pixels: Cycles' default grey
LINEAR = {"Non-Color", "Linear Rec.709", "scene_linear", "Linear", "Raw"}
SINGLE = {"FILE", "GENERATED", "VIEWER"}


class Images:
    """The textures of a scene: every image is read once for each way of reading it."""

    def __init__(self, notices: Notices) -> None:
        self._notices = notices
        self._textures: list[Texture] = []
        self._index: dict[tuple, int | None] = {}
        self._grey: dict[int, bool] = {}
        self._mean: dict[int, np.ndarray] = {}
        self._pixels = 0

    @property
    def textures(self) -> list[Texture]:
        """All textures so far; `Source.texture` indexes this list."""
        return self._textures

    def read(self, image: bpy.types.Image, extension: str, interpolation: str, straight: bool) -> int | None:
        """Index of the texture of `image`, or None with a notice when it has no usable pixels.

        `straight` keeps the colour independent of alpha, as Cycles does when the Alpha output is linked.
        """
        key = (image.original.as_pointer(), extension, interpolation, straight)
        if key not in self._index:
            pixels = self._pixels_of(image, straight)
            self._index[key] = None if pixels is None else self._add(Texture(image.name, pixels, extension, interpolation))
        return self._index[key]

    def derive(self, texture: int, key: tuple, pixels: np.ndarray) -> int:
        """Index of a texture with other pixels and the same lookup; `key` makes it once."""
        full = ("derived", texture, *key)
        if full not in self._index:
            of = self._textures[texture]
            self._index[full] = self._add(Texture(of.name, np.ascontiguousarray(pixels, np.float32), of.extension, of.interpolation))
        found = self._index[full]
        assert found is not None
        return found

    def mean(self, texture: int) -> np.ndarray:
        """(4,) float64 mean of a texture."""
        if texture not in self._mean:
            self._mean[texture] = self._textures[texture].pixels.mean(axis=(0, 1), dtype=np.float64)
        return self._mean[texture]

    def is_grey(self, texture: int) -> bool:
        """Whether the three channels are equal in every pixel."""
        if texture not in self._grey:
            p = self._textures[texture].pixels
            self._grey[texture] = bool((p[:, :, 0] == p[:, :, 1]).all() and (p[:, :, 1] == p[:, :, 2]).all())
        return self._grey[texture]

    def _add(self, texture: Texture) -> int:
        self._textures.append(texture)
        return len(self._textures) - 1

    def _pixels_of(self, image: bpy.types.Image, straight: bool) -> np.ndarray | None:
        """(h, w, 4) float32 scene-linear, row 0 at the bottom."""
        name = f'Image "{image.name}"'
        if image.source == "TILED":
            self._notices.add(name, "has UDIM tiles; only the first one is used", "Join the tiles in one image")
        elif image.source not in SINGLE:
            self._notices.add(name, "is a movie or sequence; one frame of it is used", "Use a single image")
        had = image.has_data
        size = None if had else stored_size(image)
        if size is not None and not self._fits(name, size):
            return None
        width, height = int(image.size[0]), int(image.size[1])
        if width * height == 0 or image.channels == 0:
            self._notices.add(
                name, "is missing or cannot be read; its place is taken by the grey 0.8", "Find the file or pack a working one"
            )
            return None
        if not self._fits(name, (width, height)):
            return None
        flat = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(flat)
        self._pixels += width * height
        raw = flat.reshape(height, width, image.channels)
        pixels = self._linear(image, name, _rgba(raw), straight)
        if not had and image.source == "FILE" and not image.is_dirty:
            image.buffers_free()  # it was not loaded before: leave no memory behind
        return pixels

    def _fits(self, name: str, size: tuple[int, int]) -> bool:
        """Whether an image of this size is within the budgets; a notice if not."""
        pixels = size[0] * size[1]
        if pixels > LARGEST_IMAGE:
            limit = int(LARGEST_IMAGE**0.5)
            self._notices.add(
                name, f"has {size[0]} x {size[1]} pixels, more than {limit} x {limit}; its place is taken by the grey 0.8", "Scale it down"
            )
            return False
        if self._pixels + pixels > LARGEST_TOTAL:
            text = f"would bring all images together over {LARGEST_TOTAL // 2**20} million pixels; its place is taken by the grey 0.8"
            self._notices.add(name, text, "Scale some images down")
            return False
        return True

    def _linear(self, image: bpy.types.Image, name: str, pixels: np.ndarray, straight: bool) -> np.ndarray:
        """Colour space and alpha of freshly read pixels."""
        bad = ~np.isfinite(pixels)
        if bad.any():
            self._notices.add(name, "holds values that are not numbers; they count as 0", "Repair the image")
            pixels[bad] = 0.0
        mode, alpha = image.alpha_mode, pixels[:, :, 3:4]
        has_alpha = mode in ("STRAIGHT", "PREMUL") and bool((alpha != 1.0).any())
        is_data = image.colorspace_settings.is_data
        if image.is_float:
            if has_alpha and straight and not is_data:
                with np.errstate(divide="ignore", invalid="ignore"):
                    pixels[:, :, :3] = np.where(alpha > 0.0, pixels[:, :, :3] / alpha, pixels[:, :, :3])
            return pixels
        if has_alpha and not straight and not is_data:
            pixels[:, :, :3] *= alpha
        space = image.colorspace_settings.name
        if space not in LINEAR:
            if space != "sRGB":
                self._notices.add(name, f'has the colour space "{space}"; it is read as sRGB', "Convert it to sRGB or to a float image")
            pixels[:, :, :3] = srgb_to_linear(pixels[:, :, :3])
        return pixels


def srgb_to_linear(c: np.ndarray) -> np.ndarray:
    """Decode sRGB (IEC 61966-2-1), float32."""
    return np.where(c <= 0.04045, c / np.float32(12.92), ((np.maximum(c, 0.0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4))


def _rgba(raw: np.ndarray) -> np.ndarray:
    """(h, w, 4) from 1 to 4 channels."""
    channels = raw.shape[2]
    if channels == 4:
        return raw
    out = np.ones((*raw.shape[:2], 4), np.float32)
    if channels == 3:
        out[:, :, :3] = raw
    else:
        out[:, :, :3] = raw[:, :, :1]
        if channels == 2:
            out[:, :, 3] = raw[:, :, 1]
    return out
