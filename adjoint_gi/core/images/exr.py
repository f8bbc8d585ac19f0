"""OpenEXR files with 32-bit float channels: the picture as R, G, B, A and any further layers beside it.

Files are written in numpy and zlib (scanlines, ZIP compression), a few rows at a time: the OpenEXR wheel would want all channels of an
image at once, a gigabyte for an atlas of 4096. They are read by the wheel, or in numpy where it cannot be used. Its library exports its C
functions (exr_start_read and 180 more). Where the program itself is linked to a shared OpenEXR of another version, the dynamic linker of
Linux lets the program's functions take the place of the wheel's, and the first use ends the process (measured: Debian's Blender 4.3).
`wheel_is_safe` asks beforehand; `read_channels` and `read_strings` choose.

Layout after the OpenEXR project's "OpenEXR File Layout": magic, version, attributes, table of chunks, chunks of 16 scanlines.
"""

from __future__ import annotations

import ctypes
import struct
import sys
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR

from ..base.atomic import SOFTWARE, replace_file, require_none_bad
from ..base.errors import WriteError
from ..base.parallel import in_order
from .rows import RowSource

# Letters of the channels of a layer with 1, 3 or 4 of them. One letter alone is what Blender calls a value pass.
LETTERS = {1: "V", 3: "RGB", 4: "RGBA"}
MAGIC, VERSION, LONG_NAMES = 20000630, 2, 0x400
FLOAT, NONE, ZIPS, ZIP = 2, 0, 2, 3
LINES_PER_CHUNK = {NONE: 1, ZIPS: 1, ZIP: 16}
LARGEST_HEADER = 1 << 20  # bytes
LEVEL = 1  # of zlib: noisy floats get no smaller by more of it
READ = 1 << 20  # bytes read back in one go


def write_exr(
    path: Path,
    image: RowSource,
    layers: Mapping[str, RowSource] | None = None,
    *,
    folder: Path,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write `image` (h, w, 3 or 4) float32, row 0 at the bottom, and `layers` of (h, w), (h, w, 1), (h, w, 3) or (h, w, 4).

    A layer "direct" becomes the channels direct.R, direct.G, direct.B. Blender shows a file without layers as an image with
    pixels; one with layers is a multilayer image, whose `pixels` Python cannot read there. Values are stored bit for bit. Of layers that
    are made as they are asked for (`LazyRows`) only a few rows are in memory at a time.
    `path` must lie in `folder`. Raises TargetError or WriteError; then nothing has changed.
    """
    path = Path(path)
    _check_layer("image", image)
    for name, values in (layers or {}).items():
        _check_layer(name, values)
    parts = {"": image, **(layers or {})}
    sizes = {values.shape[:2] for values in parts.values()}
    if len(sizes) != 1:
        raise WriteError(str(path), f"its layers have different sizes {sorted(sizes)}", "Give layers of one size")
    channels = {channel: (name, k) for name, values in parts.items() for channel, k in _channels(name, values)}
    strings = {"software": SOFTWARE} | {f"adjoint_gi.{key}": str(value) for key, value in (metadata or {}).items()}
    written = []

    def write(temporary: Path) -> None:
        written.append(write_channels(temporary, channels, parts, strings))
        for name, count in written[0].bad.items():
            require_none_bad(f"{path} channel {name}", count)

    return replace_file(path, folder, write=write, verify=lambda p: written[0].stands_in(p), ours=is_ours)


def is_ours(path: Path) -> bool:
    """Whether this is an OpenEXR file that Adjoint GI wrote."""
    try:
        return read_strings(path).get("software") == SOFTWARE
    except (RuntimeError, OSError, ValueError):
        return False


def _check_layer(name: str, values: RowSource) -> None:
    """Raise WriteError where `values` can be no layer of this name."""
    if not name or "." in name:
        raise WriteError(name, f"{name!r} cannot name a layer", "Use a name without dots")
    shape = values.shape if len(values.shape) != 2 else (*values.shape, 1)
    if len(shape) != 3 or shape[2] not in LETTERS or 0 in shape:
        raise WriteError(name, f"has the shape {values.shape}", "Give (h, w) or (h, w, 1, 3 or 4) values")


def _channels(name: str, values: RowSource) -> list[tuple[str, int]]:
    """Names of the channels of a layer, and which of its values each of them holds. A picture of one value is grey."""
    depth = values.shape[2] if len(values.shape) == 3 else 1
    if not name and depth == 1:
        return [(letter, 0) for letter in LETTERS[3]]
    return [(f"{name}.{letter}" if name else letter, k) for k, letter in enumerate(LETTERS[depth])]


# ---- reading, by the wheel or in numpy


def wheel_is_safe() -> bool:
    """Whether the functions of the OpenEXR wheel will be its own: no other OpenEXR is visible to the whole process."""
    if not sys.platform.startswith("linux"):
        return True  # macOS and Windows look a function up in the library it was linked from
    return not hasattr(ctypes.CDLL(None), "exr_start_write")


def read_channels(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels (h, w) float32, top row first, and string attributes of a file. Raises RuntimeError or OSError."""
    if not wheel_is_safe():
        return read_numpy(path)
    with open(path, "rb") as stream, OpenEXR.File(stream, separate_channels=True) as file:
        return {name: np.array(c.pixels) for name, c in file.channels().items()}, _strings(file)


def read_strings(path: Path) -> dict[str, str]:
    """The string attributes of a file. Raises RuntimeError, OSError or ValueError."""
    if not wheel_is_safe():
        return strings_numpy(path)
    with open(path, "rb") as stream, OpenEXR.File(stream, header_only=True) as file:
        return _strings(file)


def _strings(file: OpenEXR.File) -> dict[str, str]:
    return {name: value for name, value in file.header().items() if isinstance(value, str)}


# ---- writing


@dataclass(frozen=True, eq=False)
class Written:
    """What a file must hold: its `start` (header and table of chunks), how many bytes come after it, and the checksum of these.

    bad  by channel, how many values are not finite, where there are any
    """

    start: bytes
    size: int
    checksum: int
    bad: dict[str, int]

    def stands_in(self, path: Path) -> bool:
        """Whether the file holds just that. Raises OSError."""
        checksum, size = 0, 0
        with open(path, "rb") as file:
            if file.read(len(self.start)) != self.start:
                return False
            while block := file.read(READ):
                checksum, size = zlib.crc32(block, checksum), size + len(block)
        return (size, checksum) == (self.size, self.checksum)


def write_channels(
    path: Path, channels: Mapping[str, tuple[str, int]], layers: Mapping[str, RowSource], strings: Mapping[str, str]
) -> Written:
    """Write `channels`, by name the layer and which of its values, of `layers` (h, w[, c]) float32, row 0 at the bottom, with `strings` as
    attributes. Raises OSError."""
    names = sorted(channels, key=lambda name: name.encode())
    height, width = next(iter(layers.values())).shape[:2]
    head = _header(names, width, height, strings)
    tops = range(0, height, LINES_PER_CHUNK[ZIP])

    def coded(top: int) -> tuple[bytes, np.ndarray]:
        # The top row of a file is the last one here.
        rows = slice(max(0, height - top - LINES_PER_CHUNK[ZIP]), height - top)
        parts = {name: np.asarray(values[rows], np.float32)[::-1] for name, values in layers.items()}
        lines = _lines(parts, [channels[name] for name in names])
        return _chunk(top, lines), (~np.isfinite(lines)).sum(axis=(0, 2))

    first = at = len(head) + 8 * len(tops)
    offsets, checksum, bad = [], 0, np.zeros(len(names), np.int64)
    with open(path, "wb") as file:
        file.seek(first)  # the table comes before the chunks, whose sizes it tells
        for chunk, found in in_order(coded, tops):
            file.write(chunk)
            offsets.append(at)
            checksum, at, bad = zlib.crc32(chunk, checksum), at + len(chunk), bad + found
        start = head + np.array(offsets, "<u8").tobytes()
        file.seek(0)
        file.write(start)
    return Written(start, at - first, checksum, {name: int(count) for name, count in zip(names, bad, strict=True) if count})


def _lines(parts: Mapping[str, np.ndarray], channels: list[tuple[str, int]]) -> np.ndarray:
    """(lines, channels, w) float32 of a chunk: in each line all channels one after the other. `parts` (lines, w[, c]) float32 by layer."""
    lines, width = next(iter(parts.values())).shape[:2]
    out = np.empty((lines, len(channels), width), "<f4")
    for k, (name, which) in enumerate(channels):
        out[:, k] = parts[name].reshape(lines, width, -1)[..., which]
    return out


def _chunk(top: int, lines: np.ndarray) -> bytes:
    """A chunk of a file: compressed, unless that makes it larger."""
    raw = lines.tobytes()
    packed = zlib.compress(_interleave(raw), LEVEL)
    data = packed if len(packed) < len(raw) else raw
    return struct.pack("<ii", top, len(data)) + data


def _header(names: list[str], width: int, height: int, strings: Mapping[str, str]) -> bytes:
    """Everything before the table of chunks, of channels `names` in the order of their bytes."""
    entries = b"".join(n.encode() + b"\0" + struct.pack("<iB3xii", FLOAT, 0, 1, 1) for n in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        ("channels", "chlist", entries),
        ("compression", "compression", bytes([ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        *((key, "string", text.encode()) for key, text in strings.items()),
    ]
    long_names = any(len(n.encode()) > 31 for n in (*names, *strings))
    head = struct.pack("<ii", MAGIC, VERSION | (LONG_NAMES if long_names else 0))
    for name, kind, data in attributes:
        head += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
    return head + b"\0"


# ---- reading in numpy


def read_numpy(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels (h, w) float32, top row first, and string attributes of a file of the kind `write_channels` makes.

    Raises RuntimeError for any other kind of file and OSError where it cannot be read.
    """
    data = Path(path).read_bytes()
    try:
        attributes, at = _attributes(data)
        names = _channel_names(attributes["channels"][1])
        compression = attributes["compression"][1][0]
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"][1])
        width, height = right - left + 1, bottom - top + 1
        lines = LINES_PER_CHUNK[compression]
        out = np.zeros((height, len(names), width), "<f4")
        count = -(-height // lines)
        if width < 1 or height < 1 or len(data) < at + 8 * count:
            raise ValueError("its size is wrong")
        for offset in np.frombuffer(data, "<u8", count, at).tolist():
            y, size = struct.unpack_from("<ii", data, offset)
            block = data[offset + 8 : offset + 8 + size]
            rows = out[y - top : y - top + lines]
            if size < rows.nbytes:
                unpacker = zlib.decompressobj()
                block = _deinterleave(unpacker.decompress(block, rows.nbytes))
            rows[:] = np.frombuffer(block, "<f4").reshape(rows.shape)
    except (KeyError, IndexError, ValueError, struct.error, zlib.error) as error:
        raise RuntimeError(f"not an OpenEXR file of float scanlines with ZIP compression ({error})") from error
    channels = {name: np.ascontiguousarray(out[:, k], np.float32) for k, name in enumerate(names)}
    return channels, {name: value.decode() for name, (kind, value) in attributes.items() if kind == "string"}


def strings_numpy(path: Path) -> dict[str, str]:
    """The string attributes of a file; raises RuntimeError or OSError as `read_numpy` does."""
    with open(path, "rb") as file:
        data = file.read(LARGEST_HEADER)
    try:
        attributes, _ = _attributes(data)
        return {name: value.decode() for name, (kind, value) in attributes.items() if kind == "string"}
    except (IndexError, ValueError, struct.error) as error:
        raise RuntimeError(f"not an OpenEXR file ({error})") from error


def _attributes(data: bytes) -> tuple[dict[str, tuple[str, bytes]], int]:
    """All attributes as name: (type, value), and where the header ends."""
    magic, version = struct.unpack_from("<ii", data, 0)
    if magic != MAGIC or version & ~LONG_NAMES != VERSION:
        raise ValueError("it is of another kind")
    found, at = {}, 8
    while data[at]:
        end = data.index(b"\0", at)
        stop = data.index(b"\0", end + 1)
        size = struct.unpack_from("<i", data, stop + 1)[0]
        value = data[stop + 5 : stop + 5 + size]
        if size < 0 or len(value) != size:
            raise ValueError("its header is cut off")
        found[data[at:end].decode()] = (data[end + 1 : stop].decode(), value)
        at = stop + 5 + size
    return found, at + 1


def _channel_names(entries: bytes) -> list[str]:
    """Names of the channels of a channel list, all of which must be 32-bit float without subsampling."""
    names, at = [], 0
    while entries[at]:
        end = entries.index(b"\0", at)
        kind, _, x, y = struct.unpack_from("<iB3xii", entries, end + 1)
        if (kind, x, y) != (FLOAT, 1, 1):
            raise ValueError("a channel is not 32-bit float")
        names.append(entries[at:end].decode())
        at = end + 17
    return names


def _interleave(raw: bytes) -> bytes:
    """Even bytes, then odd bytes, then differences of neighbours plus 128: what makes float data compress well."""
    data, half = np.frombuffer(raw, np.uint8), (len(raw) + 1) // 2
    sorted_bytes = np.empty_like(data)
    sorted_bytes[:half], sorted_bytes[half:] = data[0::2], data[1::2]
    out = sorted_bytes.copy()
    np.subtract(sorted_bytes[1:], sorted_bytes[:-1], out=out[1:])
    out[1:] += np.uint8(128)
    return out.tobytes()


def _deinterleave(data: bytes) -> bytes:
    """The inverse of `_interleave`."""
    values = np.frombuffer(data, np.uint8).copy()
    values[1:] += np.uint8(128)
    values = np.cumsum(values, dtype=np.uint8)
    half = (len(values) + 1) // 2
    out = np.empty_like(values)
    out[0::2], out[1::2] = values[:half], values[half:]
    return out.tobytes()
