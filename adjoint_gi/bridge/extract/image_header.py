"""Files of images: the size from the first bytes, so that an image bomb is refused before it is decoded; frames of sequences."""

from __future__ import annotations

import os
import re
import struct

import bpy

HEADER = 65536  # bytes looked at


def stored_size(image: bpy.types.Image) -> tuple[int, int] | None:
    """(width, height) of a packed or stored PNG, JPEG, OpenEXR or BMP, or None when it cannot be read."""
    return size_of_bytes(_first_bytes(image))


def sequence_file(image: bpy.types.Image, frame: int) -> str:
    """Path of one frame of an image sequence: the last number in the name of its file is replaced, with as many digits."""
    folder, name = os.path.split(bpy.path.abspath(image.filepath, library=image.library))
    stem, extension = os.path.splitext(name)
    found = re.fullmatch(r"(.*?)(\d+)(\D*)", stem)
    if found is None:
        return os.path.join(folder, name)
    return os.path.join(folder, f"{found[1]}{frame:0{len(found[2])}d}{found[3]}{extension}")


def _first_bytes(image: bpy.types.Image) -> bytes:
    if image.source == "GENERATED":
        return b""
    if image.packed_file is not None:
        return bytes(image.packed_file.data[:HEADER])
    path = bpy.path.abspath(image.filepath, library=image.library)
    if not os.path.isfile(path):
        return b""
    try:
        with open(path, "rb") as file:
            return file.read(HEADER)
    except OSError:
        return b""


def size_of_bytes(data: bytes) -> tuple[int, int] | None:
    """(width, height) by the header in `data`."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return struct.unpack(">II", data[16:24])
        if data[:4] == b"\x76\x2f\x31\x01":
            return _exr(data)
        if data[:2] == b"\xff\xd8":
            return _jpeg(data)
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return width, abs(height)
    except struct.error:
        return None
    return None


def _exr(data: bytes) -> tuple[int, int] | None:
    """Size of the data window, an attribute of the header: name, type, byte count, value."""
    at = data.find(b"dataWindow\0box2i\0")
    if at < 0:
        return None
    x0, y0, x1, y1 = struct.unpack("<iiii", data[at + 21 : at + 37])
    return max(0, x1 - x0 + 1), max(0, y1 - y0 + 1)


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """Size in the first start-of-frame segment."""
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], struct.unpack(">H", data[at + 2 : at + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return None
