"""Sizes of pictures from the headers of their files: what decoding would need, known before memory is taken; what crashes Blender.

Every format that Blender reads as an image. A header is walked as its format says, field by field, so that a size that stands in a
comment or an attribute is not taken for that of the picture; where a file names several sizes, the largest counts. What cannot be read
for certain gives None.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from . import exr_chunks

MOST_ITEMS = 4096  # attributes, segments, directories of one file; more is no picture
MOST_ROWS = 1 << 20  # of all channels of an Iris file
LONGEST_TEXT = 1 << 16  # bytes of the header of a Radiance file


@dataclass(frozen=True)
class Header:
    """Size of a picture, and the bytes that it takes decoded: four channels of bytes, or of float32, or all of its layers.

    danger  what Blender may crash over, such as pixels that are stated and missing
    """

    width: int
    height: int
    bytes: int
    danger: str = ""


class _Unknown(ValueError):
    """This is not a header of the format."""


def read_header(file: BinaryIO) -> Header | None:
    """The header of a picture in `file`, whose position is moved; None when the format is not known or its header is damaged."""
    found = []
    for read in _READERS:
        try:
            file.seek(0)
            found.append(read(file))
        except (_Unknown, struct.error, ValueError, OverflowError, OSError):
            continue
    # One format has no signature, so a file may look like two.
    return max(found, key=lambda h: (bool(h.danger), h.bytes), default=None)


def header_of_bytes(data: bytes) -> Header | None:
    """`read_header` of a file in memory."""
    return read_header(io.BytesIO(data))


def _header(width: int, height: int, channels: int = 4, depth: int = 1) -> Header:
    """Of `channels` with `depth` bytes each in the file; decoded there are four at least, deeper ones than bytes as float32."""
    if width <= 0 or height <= 0:
        raise _Unknown
    wide = 4 if depth > 1 else 1
    return Header(width, height, width * height * max(4 * wide, channels * max(depth, wide)))


def _tiled(size: tuple[int, int], tile: tuple[int, int], channels: int, depth: int) -> Header:
    """The same of a picture in tiles: each takes memory as a whole, and may be larger than the picture."""
    whole = _header(max(size[0], tile[0]), max(size[1], tile[1]), channels, depth)
    return Header(*size, whole.bytes) if min(size) > 0 else _header(*size)


def _largest(headers: list[Header]) -> Header:
    """The largest width, height and need of several."""
    if not headers:
        raise _Unknown
    return Header(max(h.width for h in headers), max(h.height for h in headers), max(h.bytes for h in headers))


def _take(file: BinaryIO, layout: str) -> tuple:
    """The next fields; raises struct.error at the end of the file."""
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _expect(file: BinaryIO, *starts: bytes) -> bytes:
    """The next bytes, which must be one of `starts` (of one length)."""
    found = file.read(len(starts[0]))
    if found not in starts:
        raise _Unknown
    return found


def _png(file: BinaryIO) -> Header:
    _expect(file, b"\x89PNG\r\n\x1a\n")
    length, kind, width, height, bits = _take(file, ">I4sIIB")
    if (length, kind) != (13, b"IHDR"):
        raise _Unknown
    return _header(width, height, depth=2 if bits > 8 else 1)


def _jpeg(file: BinaryIO) -> Header:
    """Size in the first start-of-frame segment, which the segments before it lead to."""
    _expect(file, b"\xff\xd8")
    for _ in range(MOST_ITEMS):
        _expect(file, b"\xff")
        marker = 0xFF
        while marker == 0xFF:  # any number of fill bytes
            (marker,) = _take(file, "B")
        (length,) = _take(file, ">H")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            _, height, width, channels = _take(file, ">BHHB")
            return _header(width, height, channels)
        if length < 2 or marker in (0xD8, 0xD9, 0xDA):
            raise _Unknown
        file.seek(length - 2, io.SEEK_CUR)
    raise _Unknown


def _bmp(file: BinaryIO) -> Header:
    _expect(file, b"BM")
    file.seek(14)
    (size,) = _take(file, "<I")
    if size == 12:
        width, height = _take(file, "<HH")
    elif size in (16, 40, 52, 56, 64, 108, 124):
        width, height = _take(file, "<ii")
    else:
        raise _Unknown
    return _header(width, abs(height))


_IRIS_TABLES = 512  # where the tables of a compressed file begin: of places, then of sizes of all rows of all channels


def _iris(file: BinaryIO) -> Header:
    _expect(file, b"\x01\xda")
    packed, depth, dimensions, width, height, channels = _take(file, ">BBHHHH")
    header = _header(width, height, channels, depth)
    if not packed:
        return header
    rows = height if dimensions > 1 else 1
    count = rows * (channels if dimensions > 2 else 1)
    if count > MOST_ROWS:
        raise _Unknown
    file.seek(_IRIS_TABLES)
    data = file.read(8 * count)
    if len(data) < 8 * count:
        return replace(header, danger="its tables of rows are cut off")
    tables = np.frombuffer(data, ">u4").astype(np.int64)
    whole = (tables[:count] >= _IRIS_TABLES + 8 * count) & (tables[:count] + tables[count:] <= file.seek(0, io.SEEK_END))
    return header if whole.all() else replace(header, danger="rows are missing")


def _targa(file: BinaryIO) -> Header:
    """No signature: the fields must make sense."""
    _, mapped, kind, _, _, _, _, _, width, height, bits, _ = _take(file, "<BBBHHBHHHHBB")
    if mapped > 1 or kind not in (1, 2, 3, 9, 10, 11) or bits not in (8, 15, 16, 24, 32):
        raise _Unknown
    return _header(width, height)


def _cineon(file: BinaryIO) -> Header:
    order = ">" if _expect(file, b"\x80\x2a\x5f\xd7", b"\xd7\x5f\x2a\x80")[0] == 0x80 else "<"
    file.seek(193)
    (channels,) = _take(file, "B")
    if not 1 <= channels <= 8:
        raise _Unknown
    sizes = []
    for c in range(channels):
        file.seek(200 + 28 * c)
        sizes.append(_take(file, order + "II"))
    return _header(max(w for w, _ in sizes), max(h for _, h in sizes), channels, 2)


_DPX_HEADERS = 2048  # bytes before the user's


def _dpx(file: BinaryIO) -> Header:
    order = ">" if _expect(file, b"SDPX", b"XPDS") == b"SDPX" else "<"
    file.seek(32)
    (user,) = _take(file, order + "I")
    file.seek(770)
    elements, width, height = _take(file, order + "HII")
    # Blender's reader takes memory for as many bytes of the user's as are stated, and crashes where they are over 2 GB.
    cut = user != 0xFFFFFFFF and user > max(0, file.seek(0, io.SEEK_END) - _DPX_HEADERS)
    return replace(_header(width, height, 4 * max(1, elements), 2), danger="data of its user's are cut off" if cut else "")


def _radiance(file: BinaryIO) -> Header:
    """Lines of text with the format among them, an empty one, and then the size. Readers differ in which of these they look for, so all
    must be there in this order, and every size in the text counts."""
    found = re.match(rb"#\?(RADIANCE|RGBE)[^\n]*\n([^\n]+\n)*?FORMAT=[^\n]*\n([^\n]+\n)*\n[^\n]*\n", file.read(LONGEST_TEXT))
    if found is None:
        raise _Unknown
    sizes = []
    for first, a, b in re.findall(rb"[+-]([XY])\s*(\d{1,10})\s+[+-][XY]\s*(\d{1,10})", found[0]):
        sizes.append(_header(*((int(a), int(b)) if first == b"X" else (int(b), int(a))), depth=4))
    return _largest(sizes)


_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_TIFF_TAGS = {256: "width", 257: "height", 258: "bits", 277: "channels", 322: "tile_width", 323: "tile_height"}


def _tiff(file: BinaryIO) -> Header:
    """All directories of the main chain; a tile may be larger than its picture."""
    order = "<" if _expect(file, b"II", b"MM") == b"II" else ">"
    (version,) = _take(file, order + "H")
    if version == 42:
        count_layout, offset_layout = order + "H", order + "I"
    elif version == 43:
        if _take(file, order + "HH") != (8, 0):
            raise _Unknown
        count_layout, offset_layout = order + "Q", order + "Q"
    else:
        raise _Unknown
    (at,) = _take(file, offset_layout)
    headers, seen = [], set()
    while at and at not in seen and len(seen) < MOST_ITEMS:
        seen.add(at)
        file.seek(at)
        (count,) = _take(file, count_layout)
        if count > MOST_ITEMS:
            raise _Unknown
        tags: dict[str, int] = {}
        for _ in range(count):
            _tiff_tag(file, order, offset_layout, tags)
        (at,) = _take(file, offset_layout)
        if "width" in tags and "height" in tags:
            size, tile = (tags["width"], tags["height"]), (tags.get("tile_width", 0), tags.get("tile_height", 0))
            headers.append(_tiled(size, tile, tags.get("channels", 1), -(-tags.get("bits", 1) // 8)))
    return _largest(headers)


def _tiff_tag(file: BinaryIO, order: str, offset_layout: str, tags: dict[str, int]) -> None:
    """Read one entry of a directory; the largest of its values goes to `tags` when it is about the size."""
    tag, kind, count = _take(file, order + "HH" + offset_layout[-1])
    value = file.read(struct.calcsize(offset_layout))
    name = _TIFF_TAGS.get(tag)
    if name is None:
        return
    if kind not in _TIFF_TYPES or not 1 <= count <= MOST_ITEMS:
        raise _Unknown
    layout = f"{order}{count}{_TIFF_TYPES[kind]}"
    size = struct.calcsize(layout)
    if size <= len(value):
        data = value[:size]
    else:
        back = file.tell()
        file.seek(struct.unpack(offset_layout, value)[0])
        data = file.read(size)
        file.seek(back)
    tags[name] = max(tags.get(name, 0), *struct.unpack(layout, data))


def _psd(file: BinaryIO) -> Header:
    _expect(file, b"8BPS")
    version, _, channels, height, width, bits = _take(file, ">H6sHIIH")
    if version not in (1, 2):
        raise _Unknown
    return _header(width, height, channels, -(-bits // 8))


def _dds(file: BinaryIO) -> Header:
    _expect(file, b"DDS ")
    size, _, height, width, _, slices = _take(file, "<IIIIII")
    file.seek(112)
    (kind,) = _take(file, "<I")
    if size != 124:
        raise _Unknown
    # A cube is laid out as a cross of 4 x 3 sides; a volume has slices.
    count = 12 if kind & 0x200 else max(1, slices) if kind & 0x200000 else 1
    return _header(width, height, 4 * count, 4)


def _boxes(file: BinaryIO, end: int) -> Iterator[tuple[bytes, int, int]]:
    """(kind, begin, end) of the boxes of a JPEG 2000 file up to `end`, the contents without their heads."""
    for _ in range(MOST_ITEMS):
        at = file.tell()
        if at + 8 > end:
            return
        length, kind = _take(file, ">I4s")
        if length == 1:
            (length,) = _take(file, ">Q")
        begin = file.tell()
        stop = end if length == 0 else at + length
        if stop < begin:
            raise _Unknown
        yield kind, begin, min(stop, end)
        file.seek(stop)
    raise _Unknown


def _jpeg2000(file: BinaryIO) -> Header:
    """A bare code stream, or boxes around one; the size in the code stream is what decides, that in the boxes counts too."""
    start = file.read(12)
    end = file.seek(0, io.SEEK_END)
    file.seek(0)
    if start[:4] == b"\xff\x4f\xff\x51":
        return _codestream(file)
    if start != b"\0\0\0\x0cjP  \r\n\x87\n":
        raise _Unknown
    headers, streams = [], 0
    for kind, begin, stop in _boxes(file, end):
        file.seek(begin)
        if kind == b"jp2c":
            headers.append(_codestream(file))
            streams += 1
        elif kind == b"jp2h":
            for inner, at, _ in _boxes(file, stop):
                if inner == b"ihdr":
                    file.seek(at)
                    height, width, channels = _take(file, ">IIH")
                    headers.append(_header(width, height, channels, 4))
    if not streams:
        raise _Unknown
    return _largest(headers)


def _codestream(file: BinaryIO) -> Header:
    _expect(file, b"\xff\x4f\xff\x51")
    _, _, right, bottom, _, _, tile_width, tile_height, _, _, channels = _take(file, ">HHIIIIIIIIH")
    # Decoders hold every component as 32-bit numbers. The corner is on the reference grid, so the picture is no larger.
    if not tile_width or not tile_height:
        raise _Unknown
    return _header(right, bottom, channels, 4)


def _webp(file: BinaryIO) -> Header:
    riff, length, kind = _take(file, "<4sI4s")
    if (riff, kind) != (b"RIFF", b"WEBP"):
        raise _Unknown
    headers = []
    for _ in range(MOST_ITEMS):
        head = file.read(8)
        if len(head) < 8 or file.tell() > length + 8:
            break
        name, size = struct.unpack("<4sI", head)
        after = file.tell() + size + size % 2
        if name in (b"VP8X", b"ANMF"):
            data = file.read(12)
            at = 4 if name == b"VP8X" else 6
            headers.append(_header(1 + int.from_bytes(data[at : at + 3], "little"), 1 + int.from_bytes(data[at + 3 : at + 6], "little")))
        elif name == b"VP8 ":
            data = file.read(10)
            if data[3:6] != b"\x9d\x01\x2a":
                raise _Unknown
            width, height = struct.unpack("<HH", data[6:10])
            headers.append(_header(width & 0x3FFF, height & 0x3FFF))
        elif name == b"VP8L":
            mark, bits = _take(file, "<BI")
            if mark != 0x2F:
                raise _Unknown
            headers.append(_header(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)))
        file.seek(after)
    return _largest(headers)


def _gif(file: BinaryIO) -> Header:
    _expect(file, b"GIF87a", b"GIF89a")
    return _header(*_take(file, "<HH"))


def _exr(file: BinaryIO) -> Header:
    """Attributes of every part: name, type, byte count, value. All channels of all parts are decoded to float32."""
    _expect(file, b"\x76\x2f\x31\x01")
    (version,) = _take(file, "<I")
    if version & 0xFF != 2:
        raise _Unknown
    several = bool(version & _EXR_SEVERAL)
    headers: list[Header] = []
    parts: list[exr_chunks.PartHeader] = []
    while (found := _exr_part(file, version)) is not None:
        headers.append(found[0])
        parts.append(found[1])
        if not several:
            break
        if len(parts) > MOST_ITEMS:
            raise _Unknown
    whole = _largest(headers)
    danger = exr_chunks.danger(file, parts, several)
    return Header(whole.width, whole.height, sum(h.bytes for h in headers), danger)


_EXR_TILED, _EXR_DEEP, _EXR_SEVERAL = 0x200, 0x800, 0x1000  # flags of the version
_EXR_KINDS = {b"scanlineimage": (False, False), b"tiledimage": (True, False), b"deepscanline": (False, True), b"deeptile": (True, True)}
_EXR_LAYOUTS = {b"box2i": "<iiii", b"compression": "B", b"int": "<i", b"tiledesc": "<IIB", b"lineOrder": "B", b"float": "<f", b"v2f": "<ff"}
# What every header must have. Blender 5.0 ends itself over some that have not.
_EXR_NEEDED = {
    *((b"channels", b"chlist"), (b"compression", b"compression"), (b"dataWindow", b"box2i"), (b"displayWindow", b"box2i")),
    *((b"lineOrder", b"lineOrder"), (b"pixelAspectRatio", b"float"), (b"screenWindowCenter", b"v2f"), (b"screenWindowWidth", b"float")),
}


def _exr_part(file: BinaryIO, version: int) -> tuple[Header, exr_chunks.PartHeader] | None:
    """Of the attributes up to an empty name; None where there are none, which ends a file of several parts."""
    found: dict[tuple[bytes, bytes], list[tuple[int, int]]] = {}  # where the values of each name and kind begin and end
    for _ in range(MOST_ITEMS):
        name = _exr_text(file)
        if not name:
            break
        kind, (length,) = _exr_text(file), _take(file, "<i")
        if length < 0 or (kind in _EXR_LAYOUTS and length != struct.calcsize(_EXR_LAYOUTS[kind])):
            raise _Unknown
        begin = file.tell()
        found.setdefault((name, kind), []).append((begin, begin + length))
        file.seek(begin + length)
    else:
        raise _Unknown
    if not found:
        return None
    if not found.keys() >= _EXR_NEEDED:
        raise _Unknown
    behind = file.tell()

    def values(name: bytes, kind: bytes) -> list[tuple]:
        """All that is stated under a name, which should be once; readers take the last."""
        out = []
        for begin, end in found.get((name, kind), ()):
            file.seek(begin)
            out.append(_take(file, _EXR_LAYOUTS[kind]) if kind in _EXR_LAYOUTS else (file.read(min(end - begin, 256)),))
        return out

    windows = values(b"dataWindow", b"box2i")
    sizes = [(x1 - x0 + 1, y1 - y0 + 1) for x0, y0, x1, y1 in windows + values(b"displayWindow", b"box2i")]
    if any(min(size) <= 0 for size in sizes):
        raise _Unknown
    tile = (values(b"tiles", b"tiledesc") or [(0, 0, 0)])[-1]
    channels = 0
    for begin, end in found.get((b"channels", b"chlist"), ()):
        file.seek(begin)
        channels += _exr_channels(file, end)
    header = _tiled((max(w for w, _ in sizes), max(h for _, h in sizes)), tile[:2], channels, 4)
    tiled, deep = bool(version & _EXR_TILED), False
    if version & (_EXR_DEEP | _EXR_SEVERAL):  # else the flag counts: programs have left the type of another file there
        kinds = values(b"type", b"string")
        if not kinds or kinds[-1][0] not in _EXR_KINDS:
            raise _Unknown
        tiled, deep = _EXR_KINDS[kinds[-1][0]]
    (compression,) = values(b"compression", b"compression")[-1]
    (count,) = (values(b"chunkCount", b"int") or [(None,)])[-1]
    file.seek(behind)
    return header, exr_chunks.PartHeader(tiled, deep, windows[-1], compression, tile, count)


def _exr_channels(file: BinaryIO, end: int) -> int:
    """How many channels a list holds, at least one; it must come to its end at `end`."""
    for count in range(MOST_ITEMS):
        if not _exr_text(file):
            if count == 0 or file.tell() != end:
                raise _Unknown
            return count
        kind, _, across, down = _take(file, "<iB3xii")
        if not 0 <= kind <= 2 or across < 1 or down < 1:
            raise _Unknown
    raise _Unknown


def _exr_text(file: BinaryIO) -> bytes:
    """The bytes up to a zero, 255 at most."""
    text = file.read(256)
    end = text.find(b"\0")
    if end < 0:
        raise _Unknown
    file.seek(end + 1 - len(text), io.SEEK_CUR)
    return text[:end]


_READERS: tuple[Callable[[BinaryIO], Header], ...] = (
    _png, _jpeg, _bmp, _iris, _targa, _cineon, _dpx, _radiance, _tiff, _psd, _dds, _jpeg2000, _webp, _gif, _exr,
)  # fmt: skip
