"""Results as float images: one datablock for each object (or one for an atlas), found again by a stored link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np

from ...core.base.atomic import require_none_bad
from ...core.base.errors import TargetError, WriteError
from ...core.images.exr import write_exr
from ...core.images.rows import LazyRows, RowSource, blocks_of_rows, with_alpha
from ...core.receivers.texels import Placement
from ..host import files
from . import links as targets


def write_image(
    objects: Sequence[bpy.types.Object],
    key: str,
    pixels: RowSource,
    coverage: RowSource,
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
    height, width = values.shape[:2]
    if file is not None:
        write_exr(file, values, folder=folder or file.parent)

    image = _existing(objects, key)
    if image is not None and file is not None and image.packed_file is not None:
        image.unpack(method="REMOVE")
    if image is None:
        image = bpy.data.images.new(title, width, height, alpha=True, float_buffer=True, is_data=True)
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
    if back is None or back.shape != values.shape or not _same(back, values):
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
    if not _has_pixels(image):
        return None
    width, height = image.size
    out = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(out)
    return out.reshape(height, width, 4)


def _has_pixels(image: bpy.types.Image) -> bool:
    """Whether `read_pixels` finds any."""
    width, height = image.size
    return width > 0 and height > 0 and image.channels == 4 and len(image.pixels) == width * height * 4


def _rgba(title: str, pixels: RowSource, coverage: RowSource) -> LazyRows:
    """(h, w, 4) float32, made as it is asked for; raises WriteError when shapes disagree or a value is not finite."""
    shape = pixels.shape
    if len(shape) != 3 or shape[2] != 3 or tuple(coverage.shape) != tuple(shape[:2]) or 0 in shape:
        raise WriteError(title, f"pixels {shape} and coverage {coverage.shape} do not fit together", "Give (h, w, 3) and (h, w)")
    values = with_alpha(pixels, coverage)
    require_none_bad(title, sum(int((~np.isfinite(values[rows])).sum()) for rows in blocks_of_rows(shape)))
    return values


def _same(back: np.ndarray, values: LazyRows) -> bool:
    """Whether `back` (h, w, 4) float32 holds `values` bit for bit."""
    parts = ((back[rows], np.asarray(values[rows], np.float32)) for rows in blocks_of_rows(values.shape))
    return all(np.array_equal(a.view(np.uint32), b.view(np.uint32)) for a, b in parts)


def _fill(image: bpy.types.Image, values: LazyRows) -> None:
    """Set size and pixels, and pack them into the .blend, where they are kept as a 32-bit OpenEXR."""
    height, width = values.shape[:2]
    if tuple(image.size) != (width, height):
        image.scale(width, height)
    whole = np.empty(values.shape, np.float32)
    for rows in blocks_of_rows(values.shape):
        whole[rows] = values[rows]
    image.pixels.foreach_set(whole.ravel())
    del whole
    image.update()
    image.pack()


def _existing(objects: Sequence[bpy.types.Object], key: str) -> bpy.types.Image | None:
    """The one image that exactly these objects have for `key`, if it can be written to; else None."""
    images = [linked_image(obj, key) for obj in objects]
    image = images[0]
    if image is None or any(other != image for other in images) or not image.is_editable or not image.is_float or not _has_pixels(image):
        return None
    outsiders = [o for o in bpy.data.objects if o not in objects and linked_image(o, key) == image]
    return None if outsiders else image
