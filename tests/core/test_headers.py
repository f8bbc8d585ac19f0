# SPDX-License-Identifier: GPL-3.0-or-later
"""Sizes of pictures from their headers: every format, sizes that stand where they mean nothing, damaged files."""

from __future__ import annotations

import struct

import pytest
from adjgi.adjoint_gi.core.images.headers import Header, header_of_bytes

W, H = 300, 200


def chunk(kind, data):
    return struct.pack("<4sI", kind, len(data)) + data + b"\0" * (len(data) % 2)


def box(kind, data):
    return struct.pack(">I4s", 8 + len(data), kind) + data


def attribute(name, kind, value):
    return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value


def box2i(width, height):
    return struct.pack("<iiii", -1, -2, width - 2, height - 3)


def exr_header(width, height, channels=(b"B", b"G", b"R"), before=b"", after=b""):
    listed = b"".join(c + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for c in channels) + b"\0"
    window = attribute(b"dataWindow", b"box2i", box2i(width, height))
    return before + attribute(b"channels", b"chlist", listed) + window + after + b"\0"


def exr(*headers, several=False):
    return b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | 0x1000 * several) + b"".join(headers) + b"\0" * several


def tiff(order, tags, following=()):
    """Directories one after the other, all values in place."""
    out, at = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, 8), 8
    lists = [tags, *following]
    for k, listed in enumerate(lists):
        body = struct.pack(order + "H", len(listed))
        for tag, kind, value in listed:
            body += struct.pack(order + "HHI", tag, kind, 1) + (
                struct.pack(order + "HH", value, 0) if kind == 3 else struct.pack(order + "I", value)
            )
        at += len(body) + 4
        out += body + struct.pack(order + "I", at if k + 1 < len(lists) else 0)
    return out


def siz(width, height, channels=3):
    return b"\xff\x4f\xff\x51" + struct.pack(">HHIIIIIIIIH", 47, 0, width, height, 0, 0, width, height, 0, 0, channels)


JP2 = b"\0\0\0\x0cjP  \r\n\x87\n"
BYTES, FLOATS = 4 * W * H, 16 * W * H
FILES = {
    "png": (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", 13, b"IHDR", W, H, 8, 6), BYTES),
    "png of 16 bits": (b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", 13, b"IHDR", W, H, 16, 6), FLOATS),
    "jpeg": (b"\xff\xd8\xff\xe0\0\4ab\xff\xff\xc2\0\x11\x08" + struct.pack(">HHB", H, W, 3), BYTES),
    "bmp": (b"BM" + bytes(12) + struct.pack("<Iii", 40, W, -H), BYTES),
    "old bmp": (b"BM" + bytes(12) + struct.pack("<IHH", 12, W, H), BYTES),
    "iris": (b"\x01\xda\1\1" + struct.pack(">HHHH", 3, W, H, 4), BYTES),
    "targa": (struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, W, H, 24, 0), BYTES),
    "cineon": (b"\x80\x2a\x5f\xd7" + bytes(189) + b"\1" + bytes(6) + struct.pack(">II", W, H), FLOATS),
    "dpx": (b"XPDS" + bytes(766) + struct.pack("<HII", 1, W, H), FLOATS),
    "radiance": (b"#?RADIANCE\nA=1\nFORMAT=32-bit_rle_rgbe\nB=2\n\n-Y %d +X %d\n" % (H, W), FLOATS),
    "turned radiance": (b"#?RGBE\nFORMAT=x\n\n+X %d -Y %d\n" % (W, H), FLOATS),
    "tiff": (tiff("<", [(256, 3, W), (257, 3, H), (258, 3, 8)]), BYTES),
    "tiff of 16 bits": (tiff(">", [(256, 4, W), (257, 4, H), (258, 3, 16), (277, 3, 3)]), FLOATS),
    "tiff of 12 bits": (tiff("<", [(256, 3, W), (257, 3, H), (258, 3, 12), (277, 3, 3)]), FLOATS),
    "tiff of tiles": (tiff("<", [(256, 4, W), (257, 4, H), (322, 4, 9000), (323, 4, 10)]), 4 * 9000 * H),
    "psd": (b"8BPS\0\1" + bytes(6) + struct.pack(">HIIH", 3, H, W, 8), BYTES),
    "dds": (b"DDS " + struct.pack("<IIIIII", 124, 0, H, W, 0, 1) + bytes(84) + struct.pack("<I", 0), FLOATS),
    "cubic dds": (b"DDS " + struct.pack("<IIIIII", 124, 0, H, W, 0, 1) + bytes(84) + struct.pack("<I", 0x200), 12 * FLOATS),
    "jpeg 2000": (JP2 + box(b"jp2h", box(b"ihdr", struct.pack(">IIH", 1, 1, 3))) + box(b"jp2c", siz(W, H)), FLOATS),
    "bare jpeg 2000": (siz(W, H, 4), FLOATS),
    "webp": (b"RIFF" + struct.pack("<I", 99) + b"WEBP" + chunk(b"VP8 ", bytes(3) + b"\x9d\x01\x2a" + struct.pack("<HH", W, H)), BYTES),
    "webp behind an odd block": (
        b"RIFF" + struct.pack("<I", 99) + b"WEBP" + chunk(b"ALPH", b"\1\2\3")
        + chunk(b"VP8 ", bytes(3) + b"\x9d\x01\x2a" + struct.pack("<HH", W, H)), BYTES,
    ),
    "lossless webp": (
        b"RIFF" + struct.pack("<I", 99) + b"WEBP" + chunk(b"VP8L", struct.pack("<BI", 0x2F, W - 1 | H - 1 << 14)), BYTES,
    ),
    "gif": (b"GIF89a" + struct.pack("<HH", W, H), BYTES),
    "exr": (exr(exr_header(W, H)), FLOATS),
    "exr of layers": (exr(exr_header(W, H, [b"%d.R" % i for i in range(100)])), 400 * W * H),
    "exr of parts": (exr(exr_header(W, H), exr_header(10, 10), several=True), FLOATS + 1600),
    "exr of tiles": (exr(exr_header(W, H, after=attribute(b"tiles", b"tiledesc", struct.pack("<IIB", 5000, 9, 0)))), 16 * 5000 * H),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
def test_size_and_need_of_every_format(kind):
    data, needed = FILES[kind]
    assert header_of_bytes(data + bytes(64)) == Header(W, H, needed)


@pytest.mark.parametrize("kind", FILES)
def test_files_that_end_early_have_no_size(kind):
    data, _ = FILES[kind]
    for end in range(0, len(data), max(1, len(data) // 50)):
        found = header_of_bytes(data[:end])
        # Several sizes may be there already; none of them is smaller than the picture.
        assert found is None or found.width * found.height >= W * H or kind.startswith(("jpeg 2000", "exr of parts"))


false_window = attribute(b"a", b"string", attribute(b"dataWindow", b"box2i", box2i(2, 2)))
HIDING = {
    "in a string": exr(exr_header(W, H, before=false_window)),
    "in a second window": exr(exr_header(2, 2, after=attribute(b"dataWindow", b"box2i", box2i(W, H)))),
    "in a second part": exr(exr_header(2, 2), exr_header(W, H), several=True),
    "in the display": exr(exr_header(2, 2, after=attribute(b"displayWindow", b"box2i", box2i(W, H)))),
    "in a segment": b"\xff\xd8\xff\xe1\0\x0c\xff\xc0\0\x11\x08\0\1\0\1\3\xff\xc0\0\x11\x08" + struct.pack(">HHB", H, W, 3),
    "far from the start": b"\xff\xd8" + (b"\xff\xe2" + struct.pack(">H", 65000) + bytes(64998)) * 3 + FILES["jpeg"][0][2:],
    "in a comment": b"#?RGBE\n-Y 2 +X 2\nFORMAT=x\n\n-Y %d +X %d\n" % (H, W),
    "in a second directory": tiff("<", [(256, 3, 2), (257, 3, 2)], [[(256, 3, W), (257, 3, H)]]),
    "in a frame": b"RIFF" + struct.pack("<I", 99) + b"WEBP" + chunk(b"VP8X", bytes(10)) + chunk(
        b"ANMF", bytes(6) + (W - 1).to_bytes(3, "little") + (H - 1).to_bytes(3, "little") + bytes(4)
    ),
}  # fmt: skip


@pytest.mark.parametrize("where", HIDING)
def test_a_small_size_does_not_hide_a_large_one(where):
    found = header_of_bytes(HIDING[where])
    assert (found.width, found.height) == (W, H)


DAMAGED = [
    b"",
    b"hello" * 100,
    b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", 14, b"IHDR", W, H, 8, 6),
    b"#?RGBE\n\n-Y 2 +X 2\nFORMAT=x\n\n-Y 9999 +X 9999\n",  # where the size is depends on the reader
    exr(b"\0"),
    exr(exr_header(W, H, channels=())),
    b"\x76\x2f\x31\x01" + struct.pack("<I", 2) + b"a\0b\0" + struct.pack("<i", -1000),
    exr(exr_header(0, 5)),
    tiff("<", [(256, 12, W), (257, 3, H)]),
    struct.pack("<4sI4sI", b"\0\0\0\x1c", 0, b"ftyp", 0) + b"avif" + bytes(30),
]


@pytest.mark.parametrize("data", DAMAGED)
def test_what_cannot_be_told_is_not_guessed(data):
    assert header_of_bytes(data) is None
