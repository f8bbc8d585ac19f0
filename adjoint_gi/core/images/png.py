"""8-bit sRGB PNG pictures to look at; results to compute with are OpenEXR."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from ..base.atomic import SOFTWARE, replace_file, require_finite
from ..base.color import encode_srgb

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def encode_png(linear: np.ndarray) -> bytes:
    """The bytes of a PNG of scene-linear values (h, w, 3 or 4), row 0 at the bottom; alpha is kept linear."""
    linear = np.asarray(linear, np.float32)
    height, width, channels = linear.shape
    values = np.concatenate([encode_srgb(np.clip(linear[..., :3], 0, 1)), np.clip(linear[..., 3:], 0, 1)], axis=2)
    rows = np.zeros((height, 1 + width * channels), np.uint8)  # every row starts with filter type 0
    rows[:, 1:] = np.rint(values[::-1] * 255).astype(np.uint8).reshape(height, -1)
    kind = {3: 2, 4: 6}[channels]
    parts = [
        _block(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)),
        _block(b"sRGB", b"\0"),
        _block(b"tEXt", b"Software\0" + SOFTWARE.encode("latin-1")),
        _block(b"IDAT", zlib.compress(rows.tobytes(), 6)),
        _block(b"IEND", b""),
    ]
    return SIGNATURE + b"".join(parts)


def write_png(path: Path, linear: np.ndarray, *, folder: Path) -> Path:
    """Write `encode_png(linear)` to `path` inside `folder`; raises TargetError or WriteError, then nothing has changed."""
    require_finite(str(path), np.asarray(linear))
    data = encode_png(linear)
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
