"""Files of images: what one would take in memory, by its header, so that an image bomb is refused before it is decoded; sequences."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

import bpy

from ...core.images.headers import Header, read_header


class NoFile(Exception):
    """The image has no file, or one that cannot be read: there is nothing to decode either."""


def stored_header(image: bpy.types.Image) -> Header | None:
    """What decoding an image that is not loaded would give, or None where that cannot be told for certain. Blender is not asked for the
    size, because it would decode the image. Raises NoFile."""
    headers = [_generated(made) for made in _generators(image)]
    try:
        if image.source != "GENERATED" or image.packed_files:
            with _files(image) as files:
                headers += [read_header(file) for file in files]
    except NoFile:
        if not headers:
            raise
    known = [h for h in headers if h is not None]
    return max(known, key=lambda h: (bool(h.danger), h.bytes)) if known and len(known) == len(headers) else None


def sequence_file(image: bpy.types.Image, frame: int) -> str:
    """Path of one frame of an image sequence: the last number in the name of its file is replaced, with as many digits."""
    folder, name = os.path.split(file_path(image))
    stem, extension = os.path.splitext(name)
    found = re.fullmatch(r"(.*?)(\d+)(\D*)", stem)
    if found is None:
        return os.path.join(folder, name)
    return os.path.join(folder, f"{found[1]}{frame:0{len(found[2])}d}{found[3]}{extension}")


def file_path(image: bpy.types.Image) -> str:
    """Absolute path of its file; with tiles or frames a pattern."""
    return bpy.path.abspath(image.filepath, library=image.library)


def _generators(image: bpy.types.Image) -> list[bpy.types.Image | bpy.types.UDIMTile]:
    """What is made of nothing when it is looked at, with the size that it gets then: a generated image, and maybe a tile."""
    if image.source == "GENERATED":
        return [image]
    return [image.tiles[0]] if image.source == "TILED" and image.tiles else []


def _generated(made: bpy.types.Image | bpy.types.UDIMTile) -> Header:
    width, height = max(made.generated_width, 1), max(made.generated_height, 1)
    return Header(width, height, width * height * 16)


@contextmanager
def _files(image: bpy.types.Image) -> Iterator[list[BinaryIO]]:
    """What is packed in the image, or its file; of tiles the first one, which is all that is used. Raises NoFile."""
    if image.packed_files:
        yield [io.BytesIO(item.packed_file.data) for item in image.packed_files if item.packed_file is not None]
        return
    if image.use_multiview and image.views_format == "INDIVIDUAL":  # a file for each eye, under names of Blender's making
        yield [io.BytesIO()]
        return
    path = _tile(image, file_path(image)) if image.source == "TILED" else file_path(image)
    try:
        if not os.path.isfile(path):  # a folder or a device is no picture
            raise NoFile
        with open(path, "rb") as file:
            yield [file]
    except OSError as error:
        raise NoFile from error


def _tile(image: bpy.types.Image, path: str) -> str:
    """The file of the first tile: `<UDIM>` is its number, `<UVTILE>` its column and row from 1."""
    number = image.tiles[0].number if image.tiles else 1001
    column, row = (number - 1001) % 10 + 1, (number - 1001) // 10 + 1
    return path.replace("<UDIM>", str(number)).replace("<UVTILE>", f"u{column}_v{row}")
