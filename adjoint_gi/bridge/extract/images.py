"""Images: Blender's pixels to textures, bytes as bytes, within a budget of memory; over it, smaller copies.

Blender hands out float images (and files of 16 bits a channel) scene-linear with associated alpha, and byte images as they are stored
(measured on 4.2, 5.0 and 5.2), so the latter are decoded here, where they are looked up. As in Cycles, the colour of an image with
straight alpha is multiplied by alpha in its stored encoding when the node's Alpha output is not used. Two things are not copied from
Cycles (seen on 4.2 to 5.2): it interpolates byte images between their stored values and decodes afterwards, and rounds byte colours times
alpha to bytes. Both are exact here.
"""

from __future__ import annotations

import inspect
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...core.base.color import decode_srgb, encode_srgb
from ...core.base.digest import digest
from ...core.base.resources import size_text
from ...core.scene.derived import derived, largest_size
from ...core.scene.texture import Pixels, Texture, as_bytes, compact, halvings_within, renamed
from ..host.notices import Notices
from ..host.preparation import Stages
from .image_header import NoFile, sequence_file, stored_header
from .image_store import KNOWN, Recorder, Wanted, fingerprint

LARGEST_IMAGE = 8192 * 8192  # pixels
LARGEST_DECODED = 16 * LARGEST_IMAGE  # bytes that Blender may need for one image
LARGEST_TOTAL = 2 << 30  # bytes that all textures together may take, also those made of others by nodes
MEAN_OF_NOTHING = (0.8, 0.8, 0.8, 1.0)  # for an image without pixels: Cycles' default grey
LINEAR = {"Non-Color", "Linear Rec.709", "scene_linear", "Linear", "Raw"}
ASSOCIATED = {"OPEN_EXR", "OPEN_EXR_MULTILAYER", "HDR", "DPX", "CINEON"}  # formats whose colours are stored times alpha
HELD = ("FILE", "GENERATED")  # what Blender may hold the pixels of, painted or not
GREY = "its place is taken by the grey 0.8"


@dataclass(frozen=True, eq=False)
class HandedOut:
    """What Blender says of one image.

    name             what notices call it
    image            its own name
    pixels           (h, w, c) float32 with 1 to 4 channels, as Blender hands them out
    space, is_data   its colour space, and whether that is one of numbers that are no colours
    stored_straight  whether its file's format stores colours independent of alpha
    is_made          whether Blender made it, without a file
    """

    name: str
    image: str
    pixels: np.ndarray
    is_float: bool
    space: str
    is_data: bool
    alpha_mode: str
    stored_straight: bool
    is_made: bool


class Images:
    """The textures of a scene at `frame`, which image sequences show: every image is read once for each way of reading it.

    With `aside` work on pixels that is not done yet is not done here either, but raised as `Wanted`, for whoever reads to let it be done
    in a thread and to read the same again.
    """

    def __init__(self, notices: Notices, frame: int, aside: bool = False) -> None:
        self._notices = Recorder(notices)
        self._frame = frame
        self._aside = aside
        self._textures: list[Texture] = []
        self._found: dict[tuple, Texture | None] = {}  # as they were read, maybe too large
        self._index: dict[tuple, int | None] = {}
        self._bytes = 0

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
            if key not in self._found:  # else it was read before something else was `Wanted`
                read = self._once(image, straight) if frame is None else self._read_frame(image, frame, straight)
                self._found[key] = None if read is None else renamed(read, image.name, extension, interpolation)
            found = self._found[key]
            self._index[key] = None if found is None else self._add(found)
            del self._found[key]
        return self._index[key]

    def knowing(self, image: bpy.types.Image, straight: bool) -> Stages[None]:
        """Read it for who asks for it later, as `read` would with `straight`; nothing where it is known.

        Blender is asked in the first slice, and its floats are made to a texture aside.
        """
        key = fingerprint(image) or _lent(image)
        if key is None or KNOWN.holds((*key, straight)):
            return
        try:
            self._keep(image, straight, (*key, straight))
        except Wanted as wanted:
            yield wanted.aside()

    def derive(self, texture: int, pixels: Pixels) -> int:
        """Index of a texture with the same lookup and other pixels, which `pixels` makes of some of them. Two functions are the same where
        their code is and what they hold."""
        function = digest(_identity(pixels))
        full = ("derived", texture, function)
        if full not in self._index:
            of = self._textures[texture]
            halvings = self._halvings(of, largest_size(of))
            make = (lambda: of.smaller(halvings, pixels)) if halvings else (lambda: derived(of, pixels))
            made = self._made(of, ("derived", function, halvings), make)
            self._index[full] = self._add(made)
        found = self._index[full]
        assert found is not None
        return found

    def mean(self, texture: int) -> np.ndarray:
        """(4,) float64 mean of a texture."""
        return self.row_means(texture).mean(axis=0)

    def row_means(self, texture: int) -> np.ndarray:
        """(h, 4) float64 mean of each row of a texture."""
        return self._fact(self._textures[texture], "row_means")

    def ranges(self, texture: int) -> np.ndarray:
        """(2, 4) float32 least and largest value of each channel of a texture."""
        return self._fact(self._textures[texture], "ranges")

    def is_grey(self, texture: int) -> bool:
        """Whether the three channels are equal in every pixel."""
        return self._fact(self._textures[texture], "is_grey")

    def _add(self, texture: Texture) -> int:
        """Keep a texture, or a smaller copy of it where all together would take too much."""
        halvings = self._halvings(texture, texture.stored.nbytes)
        small = self._made(texture, ("smaller", halvings), lambda: texture.smaller(halvings)) if halvings else texture
        self._bytes += small.stored.nbytes
        self._textures.append(small)
        return len(self._textures) - 1

    def _halvings(self, texture: Texture, size: int) -> int:
        """How often the sides of what takes `size` bytes at those of `texture` are to be halved, with a notice: never the last of what is
        left of the budget is taken."""
        left = LARGEST_TOTAL - self._bytes
        halvings = halvings_within(texture, size, max(left - LARGEST_TOTAL // 4, left // 2))
        if halvings:
            text = f"is used in a smaller copy, because all images together would take more than {size_text(LARGEST_TOTAL)}"
            self._notices.add(f'Image "{texture.name}"', text, "Scale down images that need no detail")
        return halvings

    def _made(self, of: Texture, how: tuple, make: Callable[[], Texture]) -> Texture:
        """What `make` makes of the values of a texture: kept from earlier if it was made of the same ones and `how` is the same."""
        key = ("made", self._fact(of, "content"), *how)
        if KNOWN.known(key) is None:
            self._work(of.name, lambda: KNOWN.put(key, _ranged(make()), []))
        made = KNOWN.known(key)
        assert made is not None
        return renamed(made, of.name, of.extension, of.interpolation)

    def _fact(self, texture: Texture, name: str) -> Any:
        """What a texture computes of its pixels once."""
        if name not in texture.__dict__:
            self._work(texture.name, lambda: getattr(texture, name))
        return getattr(texture, name)

    def _work(self, name: str, work: Callable[[], object]) -> None:
        """Do it with the pixels of the image `name`, or raise it."""
        if self._aside:
            raise Wanted(f"Reading image {name}", work)
        work()

    def _read_frame(self, image: bpy.types.Image, frame: int, straight: bool) -> Texture | None:
        """One file of an image sequence, for which Blender gives no pixels: it is loaded for the moment."""
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
            texture = self._read(single, straight, name)
        finally:
            bpy.data.images.remove(single)
        if texture is not None:
            self._notices.add(name, f"is an image sequence; its frame {frame} is used", "", "info")
        return texture

    def _once(self, image: bpy.types.Image, straight: bool) -> Texture | None:
        """`_read`, or what it gave before when nothing that it depends on has changed since."""
        key = fingerprint(image)
        if key is None:
            lent = _lent(image)
            if lent is None or not KNOWN.holds((*lent, straight)):
                return self._read(image, straight)
            key = lent
        elif not KNOWN.holds((*key, straight)):
            self._keep(image, straight, (*key, straight))
        return KNOWN.get((*key, straight), self._notices, lambda: self._read(image, straight))

    def _keep(self, image: bpy.types.Image, straight: bool, key: tuple) -> None:
        """Read it and keep it, and what is said of it, as `key`."""
        self._notices.begin()
        asked, said = self._ask(image), self._notices.said
        if asked is None:
            KNOWN.put(key, None, said)
        else:
            self._work(image.name, lambda: KNOWN.put(key, _ranged(self._texture(asked, straight)), said))

    def _read(self, image: bpy.types.Image, straight: bool, name: str = "") -> Texture | None:
        """Its pixels, as bytes where it has bytes. Notices call the image `name` where it stands for another."""
        asked = self._ask(image, name)
        return self._texture(asked, straight) if asked is not None else None

    def _ask(self, image: bpy.types.Image, name: str = "") -> HandedOut | None:
        """What Blender says of an image; None with a notice when it has no usable pixels."""
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
        space = image.colorspace_settings
        made = image.source == "GENERATED"
        stored_straight = not made and image.file_format not in ASSOCIATED
        pixels = flat.reshape(height, width, image.channels)
        asked = HandedOut(name, image.name, pixels, image.is_float, space.name, space.is_data, image.alpha_mode, stored_straight, made)
        if not had and image.source in ("FILE", "TILED") and not image.is_dirty:
            image.buffers_free()  # it was not loaded before: leave no memory behind
        return asked

    def _texture(self, asked: HandedOut, straight: bool) -> Texture:
        """The texture of what Blender has said. Needs no Blender."""
        if asked.is_float:
            return Texture(asked.image, compact(self._linear(asked, _rgba(asked.pixels), straight)))
        return self._bytes_of(asked, as_bytes(asked.pixels.ravel()).reshape(asked.pixels.shape), straight)

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
        if not self._fits(name, (header.width, header.height)):
            return False
        if header.danger:
            self._notices.add(name, f"cannot be read safely, for {header.danger}; {GREY}", "Save it anew, or find a whole copy")
        return not header.danger

    def _fits(self, name: str, size: tuple[int, int]) -> bool:
        """Whether an image of this size may be read at all; a notice if not."""
        if size[0] * size[1] <= LARGEST_IMAGE:
            return True
        limit = int(LARGEST_IMAGE**0.5)
        self._notices.add(name, f"has {size[0]} x {size[1]} pixels, more than {limit} x {limit}; {GREY}", "Scale it down")
        return False

    def _bytes_of(self, asked: HandedOut, stored: np.ndarray, straight: bool) -> Texture:
        """An image of bytes with its colour space and alpha. `stored` is (h, w, c) uint8 with 1 to 4 channels."""
        varies = stored.shape[2] in (2, 4) and bool((stored[..., -1] != 255).any())
        has_alpha = self._has_alpha(asked, varies)
        if stored.shape[2] == 4 and not varies:
            stored = np.ascontiguousarray(stored[..., :3])
        space = asked.space
        if space not in LINEAR and space != "sRGB":
            self._notices.add(asked.name, f'has the colour space "{space}"; it is read as sRGB', "Convert it to sRGB or to a float image")
        return Texture(asked.name, stored, srgb=space not in LINEAR, times_alpha=has_alpha and not straight)

    def _has_alpha(self, asked: HandedOut, varies: bool) -> bool:
        """Whether colours count times alpha, which `varies`; a notice where the image is marked otherwise than its format has it."""
        mode = asked.alpha_mode
        has_alpha = mode in ("STRAIGHT", "PREMUL") and varies and not asked.is_data
        if has_alpha and not asked.is_made and asked.stored_straight != (mode == "STRAIGHT"):
            usual = "Straight" if asked.stored_straight else "Premultiplied"
            text = f"is marked as having {mode.lower()} alpha, unlike its file format, which versions of Cycles read in different ways"
            self._notices.add(asked.name, text, f"Set its Alpha to {usual}")
        return has_alpha

    def _linear(self, asked: HandedOut, pixels: np.ndarray, straight: bool) -> np.ndarray:
        """Alpha of freshly read float pixels (h, w, 4), which Blender hands out scene-linear."""
        bad = ~np.isfinite(pixels)
        if bad.any():
            self._notices.add(asked.name, "holds values that are not numbers; they count as 0", "Repair the image")
            pixels[bad] = 0.0
        alpha = pixels[:, :, 3:4]
        has_alpha = self._has_alpha(asked, bool((alpha != 1.0).any()))
        if has_alpha and (straight or asked.stored_straight):
            with np.errstate(divide="ignore", invalid="ignore"):
                pixels[:, :, :3] = np.where(alpha > 0.0, pixels[:, :, :3] / alpha, pixels[:, :, :3])
            if not straight:
                self._multiply_stored(pixels, asked.space, asked.name)
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


LENT = "lent"  # marks what is known of an image only until `return_images`


def _lent(image: bpy.types.Image) -> tuple | None:
    """What stands for the pixels of an image that Blender holds, or makes, while a bake is prepared; None where there are none.

    A reload, or painting what is painted already, gives no sign, so what is known by this is never kept for another bake or check.
    """
    if image.source not in HELD or not (image.has_data or image.source == "GENERATED"):
        return None
    size = tuple(image.size) if image.has_data else (image.generated_width, image.generated_height, image.generated_type)
    return LENT, image.session_uid, image.name, image.is_dirty, size, image.colorspace_settings.name, image.alpha_mode


def return_images() -> None:
    """The end of what `reading` was for: images that Blender holds, painted ones too, are read again by who asks for them next."""
    KNOWN.drop(LENT)


def reading(context: bpy.types.Context) -> Stages[None]:
    """Read the images on the objects of `context` and in its world that are not known yet, one in each slice; an extraction finds them
    known then, and says what there is to say of them. Whoever calls it calls `return_images` when the bake is prepared: until then they
    count as they were when they were read."""
    return_images()  # what a check has left that was stopped in the middle
    context.view_layer.update()
    trees = {slot.material.node_tree for obj in context.view_layer.objects for slot in obj.material_slots if slot.material is not None}
    trees.add(context.scene.world.node_tree if context.scene.world is not None else None)
    wanted = sorted({(image.name, straight) for tree in trees if tree is not None for image, straight in _images_of(tree)})
    for name, straight in wanted:
        yield f"Reading image {name}"
        image = bpy.data.images.get(name)  # anything may have happened meanwhile
        if image is not None:
            yield from Images(Notices(), 0, aside=True).knowing(image, straight)


def _ranged(texture: Texture) -> Texture:
    """The texture with what extractions ask of it, and it keeps, computed."""
    _ = texture.ranges, texture.is_grey, texture.content
    return texture


def _identity(function: Callable) -> tuple:
    """All that tells one function from another: where its code is, and the values that it holds."""
    held = inspect.getclosurevars(function).nonlocals
    values = {name: _identity(value) if callable(value) else value for name, value in held.items()}
    return function.__module__, function.__qualname__, function.__code__.co_firstlineno, values


def _images_of(tree: bpy.types.NodeTree, depth: int = 0) -> Iterator[tuple[bpy.types.Image, bool]]:
    """Single images in the nodes of `tree` and of its groups, down to a depth that no tree of a person has, and whether `is_straight`."""
    for node in tree.nodes:
        image, group = getattr(node, "image", None), getattr(node, "node_tree", None)
        if image is not None and image.source in HELD and image.library is None:
            yield image, is_straight(node)
        if group is not None and depth < 10:
            yield from _images_of(group, depth + 1)


def is_straight(node: bpy.types.Node) -> bool:
    """Whether the colour of an image node is kept independent of alpha, as Cycles does where its Alpha output is used."""
    return any(output.name == "Alpha" and output.is_linked for output in node.outputs)


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
