"""Results as float images: one datablock for each object (or one for an atlas), found again by a stored link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np

from ...core.base.atomic import require_finite
from ...core.base.errors import TargetError, WriteError
from ...core.images.exr import write_exr
from ...core.receivers.texels import Placement
from ..host import files
from . import links as targets


def write_image(
    objects: Sequence[bpy.types.Object],
    key: str,
    pixels: np.ndarray,
    coverage: np.ndarray,
    *,
    name: str = "",
    uv_layer: str = "",
    placement: Mapping[str, Placement] | None = None,
    file: Path | None = None,
    folder: Path | None = None,
) -> bpy.types.Image:
    """Put `pixels` (h, w, 3) float32, row 0 at the bottom, with `coverage` (h, w) as alpha into the image of `objects`.

    `key` distinguishes the results of one object (the quantity; an instance adds its own number). An image that these objects already
    have for `key` is updated, whatever it is called now; otherwise a new one is made. It holds plain numbers (Non-Color, channel
    packed), so every value is stored and used exactly as it is. Without `file` it is packed into the .blend; with `file` it is
    written there as OpenEXR inside `folder`. `uv_layer` and `placement` (by object name) are stored with the link for the preview.
    Raises TargetError before anything is changed, and WriteError when the file or image does not hold what was written.
    """
    for obj in objects:
        targets.check_object(obj)
    if not objects:
        raise TargetError("Image", "there is no object to link it to", "Select a mesh object")
    title = name or f"{objects[0].name} {key}"
    values = _rgba(title, pixels, coverage)
    if file is not None:
        write_exr(file, values, folder=folder or file.parent)

    image = _existing(objects, key)
    if image is not None and file is not None and image.packed_file is not None:
        image.unpack(method="REMOVE")
    if image is None:
        image = bpy.data.images.new(title, values.shape[1], values.shape[0], alpha=True, float_buffer=True, is_data=True)
    if file is None:
        _fill(image, values)
    else:
        image.source = "FILE"
        image.filepath = files.relative(file)
        image.reload()
    image.colorspace_settings.is_data = True
    image.alpha_mode = "CHANNEL_PACKED"

    # Believe nothing that was not read back.
    back = read_pixels(image)
    if back is None or back.shape != values.shape or not np.array_equal(back.view(np.uint32), values.view(np.uint32)):
        raise WriteError(image.name, "does not hold the values that were written", "Check the memory and disk space, and bake again")
    for obj in objects:
        place = (placement or {}).get(obj.name, Placement())
        targets.store(obj, key, image=image, uv_layer=uv_layer, scale=list(place.scale), offset=list(place.offset))
    return image


def linked_image(obj: bpy.types.Object, key: str) -> bpy.types.Image | None:
    """The image `obj` has for `key`, or None."""
    entry = targets.link(obj, key)
    return entry.get("image") if entry is not None else None


def remove_images(objects: Sequence[bpy.types.Object], keys: Sequence[str] | None = None) -> int:
    """Remove the linked images of `objects` that nothing else uses, and their links; returns how many images went."""
    images = []
    for obj in objects:
        for key in targets.keys(obj) if keys is None else keys:
            image = linked_image(obj, key)
            if image is not None:
                images += [image] if image not in images else []
                targets.forget(obj, [key])
    removed = 0
    for image in images:
        if image.users == int(image.use_fake_user):
            bpy.data.images.remove(image)
            removed += 1
    return removed


def read_pixels(image: bpy.types.Image) -> np.ndarray | None:
    """(h, w, 4) float32 pixels, row 0 at the bottom, or None when the image holds none."""
    width, height = image.size
    if width == 0 or height == 0 or image.channels != 4 or len(image.pixels) != width * height * 4:
        return None
    out = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(out)
    return out.reshape(height, width, 4)


def _rgba(title: str, pixels: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """(h, w, 4) float32 in one piece; raises WriteError when shapes disagree or a value is not finite."""
    pixels, coverage = np.asarray(pixels, np.float32), np.asarray(coverage, np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or coverage.shape != pixels.shape[:2] or 0 in pixels.shape:
        raise WriteError(title, f"pixels {pixels.shape} and coverage {coverage.shape} do not fit together", "Give (h, w, 3) and (h, w)")
    values = np.ascontiguousarray(np.concatenate([pixels, coverage[..., None]], axis=2))
    require_finite(title, values)
    return values


def _fill(image: bpy.types.Image, values: np.ndarray) -> None:
    """Set size and pixels, and pack them into the .blend, where they are kept as a 32-bit OpenEXR."""
    if tuple(image.size) != (values.shape[1], values.shape[0]):
        image.scale(values.shape[1], values.shape[0])
    image.pixels.foreach_set(values.ravel())
    image.update()
    image.pack()


def _existing(objects: Sequence[bpy.types.Object], key: str) -> bpy.types.Image | None:
    """The one image that exactly these objects have for `key`, if it can be written to; else None."""
    images = [linked_image(obj, key) for obj in objects]
    image = images[0]
    if (
        image is None
        or any(other != image for other in images)
        or not image.is_editable
        or not image.is_float
        or read_pixels(image) is None
    ):
        return None
    outsiders = [o for o in bpy.data.objects if o not in objects and linked_image(o, key) == image]
    return None if outsiders else image
