"""OpenEXR files with 32-bit float channels: the picture as R, G, B, A and any further layers beside it.

Files are coded by the OpenEXR wheel, or in plain numpy and zlib (scanlines, ZIP compression) where the wheel cannot be used. Its library
exports its C functions (exr_start_write and 180 more). Where the program itself is linked to a shared OpenEXR of another version, the
dynamic linker of Linux lets the program's functions take the place of the wheel's, and the first write ends the process (measured:
Debian's Blender 4.3). `wheel_is_safe` asks beforehand; `write_channels`, `read_channels` and `read_strings` choose.

Layout after the OpenEXR project's "OpenEXR File Layout": magic, version, attributes, table of chunks, chunks of 16 scanlines.
"""

from __future__ import annotations

import ctypes
import io
import struct
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR

from ..base.atomic import SOFTWARE, replace_file, require_finite
from ..base.errors import WriteError

# Letters of the channels of a layer with 1, 3 or 4 of them. One letter alone is what Blender calls a value pass.
LETTERS = {1: "V", 3: "RGB", 4: "RGBA"}
MAGIC, VERSION, LONG_NAMES = 20000630, 2, 0x400
FLOAT, NONE, ZIPS, ZIP = 2, 0, 2, 3
LINES_PER_CHUNK = {NONE: 1, ZIPS: 1, ZIP: 16}
LARGEST_HEADER = 1 << 20  # bytes


def write_exr(
    path: Path,
    image: np.ndarray,
    layers: Mapping[str, np.ndarray] | None = None,
    *,
    folder: Path,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write `image` (h, w, 3 or 4) float32, row 0 at the bottom, and `layers` of (h, w), (h, w, 1), (h, w, 3) or (h, w, 4).

    A layer "direct" becomes the channels direct.R, direct.G, direct.B. Blender shows a file without layers as an image with
    pixels; one with layers is a multilayer image, whose `pixels` Python cannot read there. Values are stored bit for bit.
    `path` must lie in `folder`. Raises TargetError or WriteError; then nothing has changed.
    """
    path = Path(path)
    channels = _channels("", image)
    for name, values in (layers or {}).items():
        if not name or "." in name:
            raise WriteError(str(path), f"{name!r} cannot name a layer", "Use a name without dots")
        channels.update(_channels(name + ".", values))
    shapes = {c.shape for c in channels.values()}
    if len(shapes) != 1:
        raise WriteError(str(path), f"its layers have different sizes {sorted(shapes)}", "Give layers of one size")
    for name, values in channels.items():
        require_finite(f"{path} channel {name}", values)
    strings = {"software": SOFTWARE} | {f"adjoint_gi.{key}": str(value) for key, value in (metadata or {}).items()}

    def verify(temporary: Path) -> bool:
        back = read_channels(temporary)[0]
        return set(back) == set(channels) and all(np.array_equal(back[k].view(np.uint32), v.view(np.uint32)) for k, v in channels.items())

    return replace_file(path, folder, write=lambda p: write_channels(p, channels, strings), verify=verify, ours=is_ours)


def is_ours(path: Path) -> bool:
    """Whether this is an OpenEXR file that Adjoint GI wrote."""
    try:
        return read_strings(path).get("software") == SOFTWARE
    except (RuntimeError, OSError, ValueError):
        return False


def _channels(prefix: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """One (h, w) float32 array for each channel, with the top row first as OpenEXR stores it."""
    values = np.asarray(values, np.float32)
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in LETTERS or 0 in values.shape:
        raise WriteError(prefix.rstrip(".") or "image", f"has the shape {values.shape}", "Give (h, w) or (h, w, 1, 3 or 4) values")
    if prefix == "" and values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    return {prefix + letter: np.ascontiguousarray(values[::-1, :, k]) for k, letter in enumerate(LETTERS[values.shape[2]])}


# ---- by the wheel or in numpy


def wheel_is_safe() -> bool:
    """Whether the functions of the OpenEXR wheel will be its own: no other OpenEXR is visible to the whole process."""
    if not sys.platform.startswith("linux"):
        return True  # macOS and Windows look a function up in the library it was linked from
    return not hasattr(ctypes.CDLL(None), "exr_start_write")


def write_channels(path: Path, channels: Mapping[str, np.ndarray], strings: Mapping[str, str]) -> None:
    """Write `channels` (h, w) float32, top row first, with `strings` as attributes. Raises RuntimeError or OSError."""
    if not wheel_is_safe():
        write_numpy(path, channels, strings)
        return
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **strings}
    # Encoded in memory and written by Python: the library takes no path that is not UTF-8 and hides why a write failed.
    encoded = io.BytesIO()
    OpenEXR.File(header, {k: v.copy() for k, v in channels.items()}).write(encoded)
    with open(path, "wb") as file:
        file.write(encoded.getbuffer())


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


# ---- in numpy


def write_numpy(path: Path, channels: Mapping[str, np.ndarray], strings: Mapping[str, str]) -> None:
    """Write `channels` (h, w) float32, top row first, with `strings` as attributes. Raises OSError."""
    names = sorted(channels, key=lambda n: n.encode())
    planes = [np.ascontiguousarray(channels[n], "<f4") for n in names]
    height, width = planes[0].shape

    # Step 1: the header.
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
    head += b"\0"

    # Step 2: chunks of 16 scanlines, in each line all channels one after the other.
    chunks = []
    for y in range(0, height, LINES_PER_CHUNK[ZIP]):
        raw = np.stack([p[y : y + LINES_PER_CHUNK[ZIP]] for p in planes], axis=1).tobytes()
        packed = zlib.compress(_interleave(raw), 4)
        data = packed if len(packed) < len(raw) else raw
        chunks.append(struct.pack("<ii", y, len(data)) + data)

    # Step 3: the table says where each chunk starts.
    sizes = np.array([len(c) for c in chunks], np.int64)
    offsets = len(head) + 8 * len(chunks) + np.concatenate([[0], np.cumsum(sizes)[:-1]])
    with open(path, "wb") as file:
        file.write(head)
        file.write(offsets.astype("<u8").tobytes())
        file.writelines(chunks)


def read_numpy(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels (h, w) float32, top row first, and string attributes of a file of the kind `write_numpy` makes.

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
    data = np.frombuffer(raw, np.uint8)
    data = np.concatenate([data[0::2], data[1::2]])
    out = data.copy()
    out[1:] = data[1:] - data[:-1] + np.uint8(128)
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
