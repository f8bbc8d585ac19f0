"""Whether an OpenEXR file holds the chunks that its headers promise: Blender 5.0 crashes reading one without some of them.

After the OpenEXR project's "OpenEXR File Layout": the headers, a table of offsets for every part, chunks of lines or tiles, each with its
place and its size before its data. Read are the tables, a block at a time, and the few bytes before the data of every chunk.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

MOST_CHUNKS = 1 << 20  # of one file: a picture of 16,384 x 16,384 in tiles of 16 x 16
BLOCK = 1 << 13  # offsets of a table read at a time
# Lines of a chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB, HTJ2K256, HTJ2K32.
LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
ONE_LEVEL, MIPMAP, RIPMAP = range(3)


@dataclass(frozen=True)
class PartHeader:
    """What one header says of its chunks.

    tiled, deep  what the chunks are
    window       x0, y0, x1, y1 of the pixels that are there
    compression  number of the scheme
    tile         width and height of a tile, and its mode of levels: lowest four bits the levels, the others how sizes are rounded
    count        of chunks as stated; None where it is not
    """

    tiled: bool
    deep: bool
    window: tuple[int, int, int, int]
    compression: int
    tile: tuple[int, int, int]
    count: int | None

    def chunks(self) -> int:
        """How many chunks there must be; raises ValueError where that cannot be told."""
        width, height = self.window[2] - self.window[0] + 1, self.window[3] - self.window[1] + 1
        if width <= 0 or height <= 0 or not 0 <= self.compression < len(LINES):
            raise ValueError("its header makes no sense")
        count = self._tiles(width, height) if self.tiled else -(-height // LINES[self.compression])
        if self.count not in (None, count):
            raise ValueError("its header states another number of chunks than it has")
        return count

    def _tiles(self, width: int, height: int) -> int:
        """How many tiles there are on all levels."""
        across, down, mode = self.tile
        levels, up = mode & 15, mode >> 4
        if not 0 < across < 1 << 31 or not 0 < down < 1 << 31 or levels > RIPMAP or up > 1:
            raise ValueError("its header makes no sense")
        if levels == ONE_LEVEL:
            return -(-width // across) * -(-height // down)
        if levels == MIPMAP:
            number = _levels(max(width, height), up)
            return sum(-(-_at(width, k, up) // across) * -(-_at(height, k, up) // down) for k in range(number))
        columns = sum(-(-_at(width, k, up) // across) for k in range(_levels(width, up)))
        return columns * sum(-(-_at(height, k, up) // down) for k in range(_levels(height, up)))


def _levels(size: int, up: int) -> int:
    """How many levels lead from `size` down to 1."""
    return (size - 1).bit_length() + 1 if up else size.bit_length()


def _at(size: int, level: int, up: int) -> int:
    """`size` on a level."""
    return max(1, (size + (1 << level) - 1 if up else size) >> level)


def danger(file: BinaryIO, parts: list[PartHeader], several: bool) -> str:
    """What crashes Blender in the file, or nothing. `file` stands behind its headers; `several`: chunks say which part they are of."""
    try:
        counts = [part.chunks() for part in parts]
    except ValueError as error:
        return str(error)
    first_window = parts[0].window
    for x0, y0, x1, y1 in (part.window for part in parts):  # Blender 4.2 to 5.2 give every part the memory of the first
        if x0 < first_window[0] or y0 < first_window[1] or x1 > first_window[2] or y1 > first_window[3]:
            return "one of its parts reaches beyond the first"
    if sum(counts) > MOST_CHUNKS:
        return f"it has more than {MOST_CHUNKS:,} chunks"
    table = file.tell()
    end = file.seek(0, io.SEEK_END)
    first = table + 8 * sum(counts)
    if first > end:
        return "its table of chunks is cut off"
    if not several and not parts[0].tiled and not parts[0].deep and not any(_offsets(file, table, counts[0])):
        return _in_a_row(file, parts[0], counts[0], first, end)
    for number, (part, count) in enumerate(zip(parts, counts, strict=True)):
        for k, offset in enumerate(_offsets(file, table, count)):
            problem = _chunk(file, number if several else None, part, k, offset, first, end)
            if problem:
                return problem
        table += 8 * count
    return ""


def _offsets(file: BinaryIO, table: int, count: int) -> Iterator[int]:
    """`count` offsets of a table, whose place is `table`."""
    for begin in range(0, count, BLOCK):
        file.seek(table + 8 * begin)
        yield from np.frombuffer(file.read(8 * min(BLOCK, count - begin)), "<u8").tolist()


def _in_a_row(file: BinaryIO, part: PartHeader, count: int, first: int, end: int) -> str:
    """What is wrong with `count` chunks of lines that follow one another from `first`, where the table says nothing: so Blender 5.2 packs
    float images, and readers look for the chunks themselves."""
    at = first
    for k in range(count):
        problem = _chunk(file, None, part, k, at, first, end)
        if problem:
            return problem
        file.seek(at + 4)  # behind its place
        at += 8 + struct.unpack("<i", file.read(4))[0]
    return ""


def _chunk(file: BinaryIO, number: int | None, part: PartHeader, k: int, offset: int, first: int, end: int) -> str:
    """What is wrong with chunk `k` of a part, which says that it is of part `number`, at `offset` from `first` to `end`."""
    place, sizes = ("<4i" if part.tiled else "<i"), ("<3Q" if part.deep else "<i")
    head = (0 if number is None else 4) + struct.calcsize(place) + struct.calcsize(sizes)
    if not first <= offset <= end - head:
        return "chunks are missing"
    file.seek(offset)
    data = file.read(head)
    if number is not None:
        if struct.unpack_from("<i", data)[0] != number:
            return "a chunk is of another part than its table says"
        data = data[4:]
    if not part.tiled and struct.unpack_from(place, data)[0] != part.window[1] + k * LINES[part.compression]:
        return "a chunk is in another place than its table says"
    stated = struct.unpack_from(sizes, data, struct.calcsize(place))
    size = sum(stated[:2]) if part.deep else stated[0]
    return "" if 0 <= size <= end - offset - head else "a chunk is cut off"
