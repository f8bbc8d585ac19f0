"""Images: Blender's pixels to scene-linear float32 textures, within a budget of pixels.

Blender hands out float images (and files of 16 bits a channel) scene-linear with associated alpha, and byte images as they are stored
(measured on 4.2, 5.0 and 5.2), so the latter are decoded here. As in Cycles, the colour of an image with straight alpha is multiplied by
alpha in its stored encoding when the node's Alpha output is not used. Two things are not copied from Cycles (seen on 4.2 to 5.2): it
interpolates byte images between their stored values and decodes afterwards, and rounds byte colours times alpha to bytes. Both are exact
here.
"""

from __future__ import annotations

import os
import threading

import bpy
import numpy as np

from ...core.base.color import decode_srgb, encode_srgb
from ...core.base.resources import size_text
from ...core.scene.arrays import Texture
from ..host.notices import Notices
from .image_header import NoFile, sequence_file, stored_header

LARGEST_IMAGE = 8192 * 8192  # pixels
LARGEST_DECODED = 16 * LARGEST_IMAGE  # bytes that Blender may need for one image
LARGEST_TOTAL = 2 * LARGEST_IMAGE  # pixels of all textures together: 2 GB of float32 RGBA
MEAN_OF_NOTHING = (0.8, 0.8, 0.8, 1.0)  # for an image without pixels: Cycles' default grey
LINEAR = {"Non-Color", "Linear Rec.709", "scene_linear", "Linear", "Raw"}
ASSOCIATED = {"OPEN_EXR", "OPEN_EXR_MULTILAYER", "HDR", "DPX", "CINEON"}  # formats whose colours are stored times alpha
GREY = "its place is taken by the grey 0.8"


class Images:
    """The textures of a scene at `frame`, which image sequences show: every image is read once for each way of reading it."""

    def __init__(self, notices: Notices, frame: int) -> None:
        self._notices = notices
        self._frame = frame
        self._textures: list[Texture] = []
        self._index: dict[tuple, int | None] = {}
        self._grey: dict[int, bool] = {}
        self._mean: dict[int, np.ndarray] = {}
        self._pixels = 0

    @property
    def textures(self) -> list[Texture]:
        """All textures so far; `Source.texture` indexes this list."""
        return self._textures

    def read(self, node: bpy.types.Node, extension: str, interpolation: str, straight: bool) -> int | None:
        """Index of the texture of the image of an Image or Environment Texture, or None with a notice when it has no usable pixels.

        `straight` keeps the colour independent of alpha, as Cycles does when the Alpha output is linked.
        """
        image = node.image
        frame = shown_frame(node.image_user, self._frame) if image.source == "SEQUENCE" else None
        key = (image.original.as_pointer(), frame, extension, interpolation, straight)
        if key not in self._index:
            pixels = self._pixels_of(image, straight) if frame is None else self._pixels_of_frame(image, frame, straight)
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

    def _pixels_of_frame(self, image: bpy.types.Image, frame: int, straight: bool) -> np.ndarray | None:
        """(h, w, 4) float32 of one file of an image sequence, for which Blender gives no pixels: it is loaded for the moment."""
        name = f'Image "{image.name}"'
        path = sequence_file(image, frame)
        if not os.path.isfile(path):
            text = f'is an image sequence whose file of frame {frame}, "{os.path.basename(path)}", is missing; {GREY}'
            self._notices.add(name, text, "Find the file, or choose the frames that there are in the node")
            return None
        if threading.current_thread() is not threading.main_thread():
            # F12 in a window reads the scene in a thread of Blender's, from which no datablock may be made.
            text = f"is an image sequence, which F12 in a window cannot read; {GREY}"
            self._notices.add(name, text, "Bake, render in background (blender -b), or use a single image")
            return None
        single = bpy.data.images.load(path, check_existing=False)
        try:
            single.colorspace_settings.name, single.alpha_mode = image.colorspace_settings.name, image.alpha_mode
            pixels = self._pixels_of(single, straight, name)
        finally:
            bpy.data.images.remove(single)
        if pixels is not None:
            self._notices.add(name, f"is an image sequence; its frame {frame} is used", "", "info")
        return pixels

    def _pixels_of(self, image: bpy.types.Image, straight: bool, name: str = "") -> np.ndarray | None:
        """(h, w, 4) float32 scene-linear, row 0 at the bottom. Notices call the image `name` where it stands for another."""
        name = name or f'Image "{image.name}"'
        had = image.has_data
        if not had and not self._may_decode(image, name):
            return None
        width, height = int(image.size[0]), int(image.size[1])
        if width * height == 0 or image.channels == 0:
            reason, remedy = _why_empty(image)
            self._notices.add(name, f"{reason}; {GREY}", remedy)
            return None
        if not self._fits(name, (width, height)):
            return None
        if image.source == "TILED":
            self._notices.add(name, "has UDIM tiles; only the first one is used", "Join the tiles in one image")
        elif image.source == "MOVIE":
            self._notices.add(name, "is a movie; one frame of it is used", "Use a single image or an image sequence")
        flat = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(flat)
        self._pixels += width * height
        raw = flat.reshape(height, width, image.channels)
        pixels = self._linear(image, name, _rgba(raw), straight)
        if not had and image.source == "FILE" and not image.is_dirty:
            image.buffers_free()  # it was not loaded before: leave no memory behind
        return pixels

    def _may_decode(self, image: bpy.types.Image, name: str) -> bool:
        """Whether an image that is not loaded may be: it is known to fit; a notice if not. Blender decodes it when asked for its size."""
        if image.type in ("RENDER_RESULT", "COMPOSITING"):
            return True
        try:
            header = stored_header(image)
        except NoFile:
            self._notices.add(name, f"{_why_empty(image)[0]}; {GREY}", _why_empty(image)[1])
            return False
        if header is None:
            text = f"cannot be read safely, for its size is not known before it is decoded (damaged, or of another format); {GREY}"
            self._notices.add(name, text, "Save it as PNG or OpenEXR, or open it in an Image Editor first")
            return False
        if header.bytes > LARGEST_DECODED and header.width * header.height <= LARGEST_IMAGE:
            text = f"takes {size_text(header.bytes)} when all of its layers are read, more than {size_text(LARGEST_DECODED)}; {GREY}"
            self._notices.add(name, text, "Save what is used of it as an image of its own")
            return False
        return self._fits(name, (header.width, header.height))

    def _fits(self, name: str, size: tuple[int, int]) -> bool:
        """Whether an image of this size is within the budgets; a notice if not."""
        pixels = size[0] * size[1]
        if pixels > LARGEST_IMAGE:
            limit = int(LARGEST_IMAGE**0.5)
            self._notices.add(name, f"has {size[0]} x {size[1]} pixels, more than {limit} x {limit}; {GREY}", "Scale it down")
            return False
        if self._pixels + pixels > LARGEST_TOTAL:
            text = f"would bring all images together over {LARGEST_TOTAL // 2**20} million pixels; {GREY}"
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
        is_data = image.colorspace_settings.is_data
        has_alpha = mode in ("STRAIGHT", "PREMUL") and bool((alpha != 1.0).any()) and not is_data
        space = image.colorspace_settings.name
        stored_straight = image.source != "GENERATED" and image.file_format not in ASSOCIATED
        if has_alpha and image.source != "GENERATED" and stored_straight != (mode == "STRAIGHT"):
            usual = "Straight" if stored_straight else "Premultiplied"
            text = f"is marked as having {mode.lower()} alpha, unlike its file format, which versions of Cycles read in different ways"
            self._notices.add(name, text, f"Set its Alpha to {usual}")
        if image.is_float:
            if has_alpha and (straight or stored_straight):
                with np.errstate(divide="ignore", invalid="ignore"):
                    pixels[:, :, :3] = np.where(alpha > 0.0, pixels[:, :, :3] / alpha, pixels[:, :, :3])
                if not straight:
                    self._multiply_stored(pixels, space, name)
            return pixels
        if has_alpha and not straight:
            pixels[:, :, :3] *= alpha
        if space not in LINEAR:
            if space != "sRGB":
                self._notices.add(name, f'has the colour space "{space}"; it is read as sRGB', "Convert it to sRGB or to a float image")
            pixels[:, :, :3] = decode_srgb(pixels[:, :, :3])
        return pixels

    def _multiply_stored(self, pixels: np.ndarray, space: str, name: str) -> None:
        """Multiply linear colours by alpha in the encoding of the file, in place."""
        if space == "sRGB":
            pixels[:, :, :3] = decode_srgb(encode_srgb(pixels[:, :, :3]) * pixels[:, :, 3:4])
            return
        pixels[:, :, :3] *= pixels[:, :, 3:4]
        if space not in LINEAR and not space.startswith(("Linear", "ACES")):
            text = f'has alpha and the colour space "{space}"; its linear colours are multiplied by alpha, in Cycles its stored ones'
            self._notices.add(name, text, "Convert it to sRGB")


def shown_frame(user: bpy.types.ImageUser, frame: int) -> int:
    """Number in the file name of an image sequence that a node shows at `frame`, as Cycles counts (measured on 4.2, 5.0 and 5.2)."""
    at, count = frame - user.frame_start + 1, max(int(user.frame_duration), 1)
    at = (at - 1) % count + 1 if user.use_cyclic else min(max(at, 0), count)
    return at + user.frame_offset


def _why_empty(image: bpy.types.Image) -> tuple[str, str]:
    """(reason, remedy) for an image of which Blender gives no pixels."""
    if image.type in ("RENDER_RESULT", "COMPOSITING"):
        what = "render result" if image.type == "RENDER_RESULT" else "viewer image"
        return f"is a {what}, whose pixels Blender does not give", "Save it as a file and use that"
    if image.type == "MULTILAYER":
        return "is a multilayer OpenEXR, whose layers are not read", "Save the layer as an image of its own"
    what = "a movie that" if image.source == "MOVIE" else "an image that"
    return f"is {what} is missing or cannot be read", "Find the file or pack a working one"


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
