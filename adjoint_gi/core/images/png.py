"""8-bit sRGB PNG pictures to look at; results to compute with are OpenEXR."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from ..base.atomic import SOFTWARE, replace_file, require_none_bad
from ..base.color import encode_srgb
from .rows import RowSource, blocks_of_rows

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def encode_png(linear: RowSource, name: str = "PNG") -> bytes:
    """The bytes of a PNG of scene-linear values (h, w, 3 or 4), row 0 at the bottom; alpha is kept linear.

    Raises WriteError about `name` where a value is not finite.
    """
    height, width, channels = linear.shape
    packer, packed, bad = zlib.compressobj(6), [], 0
    for rows in reversed(list(blocks_of_rows(linear.shape))):
        part = np.asarray(linear[rows], np.float32)[::-1]
        bad += int((~np.isfinite(part)).sum())
        packed.append(packer.compress(_stored(part).tobytes()))
    require_none_bad(name, bad)
    kind = {3: 2, 4: 6}[channels]
    parts = [
        _block(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)),
        _block(b"sRGB", b"\0"),
        _block(b"tEXt", b"Software\0" + SOFTWARE.encode("latin-1")),
        _block(b"IDAT", b"".join(packed) + packer.flush()),
        _block(b"IEND", b""),
    ]
    return SIGNATURE + b"".join(parts)


def _stored(part: np.ndarray) -> np.ndarray:
    """(rows, 1 + w * c) uint8 of linear values (rows, w, c), top row first; every row starts with filter type 0."""
    with np.errstate(invalid="ignore"):  # what is not finite is refused afterwards
        values = np.concatenate([encode_srgb(np.clip(part[..., :3], 0, 1)), np.clip(part[..., 3:], 0, 1)], axis=2)
        out = np.zeros((len(part), 1 + part.shape[1] * part.shape[2]), np.uint8)
        out[:, 1:] = np.rint(values * 255).astype(np.uint8).reshape(len(part), -1)
    return out


def write_png(path: Path, linear: RowSource, *, folder: Path) -> Path:
    """Write `encode_png(linear)` to `path` inside `folder`; raises TargetError or WriteError, then nothing has changed."""
    data = encode_png(linear, str(path))
    return replace_file(Path(path), folder, write=lambda p: _put(p, data), verify=lambda p: p.read_bytes() == data, ours=is_ours)


def is_ours(path: Path) -> bool:
    """Whether this is a PNG file that Adjoint GI wrote: our name stands in a block before the pixels."""
    try:
        with open(path, "rb") as file:
            head = file.read(512)
    except OSError:
        return False
    return head.startswith(SIGNATURE) and b"tEXtSoftware\0" + SOFTWARE.encode("latin-1") in head


def _put(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)


def _block(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
