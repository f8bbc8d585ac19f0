# SPDX-License-Identifier: GPL-3.0-or-later
"""Sizes of pictures from their headers: every format, sizes that stand where they mean nothing, damaged files."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from adjgi.adjoint_gi.core.images import exr as exr_files
from adjgi.adjoint_gi.core.images import exr_chunks
from adjgi.adjoint_gi.core.images.headers import Header, header_of_bytes, read_header

W, H = 300, 200


def chunk(kind, data):
    return struct.pack("<4sI", kind, len(data)) + data + b"\0" * (len(data) % 2)


def box(kind, data):
    return struct.pack(">I4s", 8 + len(data), kind) + data


def attribute(name, kind, value):
    return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value


def box2i(width, height):
    return struct.pack("<iiii", -1, -2, width - 2, height - 3)


def exr_header(width, height, channels=(b"B", b"G", b"R"), before=b"", after=b"", compression=0):
    listed = b"".join(c + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for c in channels) + b"\0"
    window = attribute(b"dataWindow", b"box2i", box2i(width, height)) + attribute(b"displayWindow", b"box2i", box2i(2, 2))
    others = attribute(b"compression", b"compression", bytes([compression])) + attribute(b"lineOrder", b"lineOrder", b"\0")
    others += attribute(b"pixelAspectRatio", b"float", bytes(4)) + attribute(b"screenWindowCenter", b"v2f", bytes(8))
    others += attribute(b"screenWindowWidth", b"float", bytes(4))
    return before + attribute(b"channels", b"chlist", listed) + others + window + after + b"\0"


def exr_tiles(across, down, levels=0):
    return attribute(b"tiles", b"tiledesc", struct.pack("<IIB", across, down, levels))


def exr_kind(kind):
    return attribute(b"type", b"string", kind)


def exr(*headers, flags=0, chunks=()):
    """A file of `chunks`, a list for each part; with more than one header a file of several parts. Where the tables begin: `exr_table`."""
    several = 0x1000 * (len(headers) > 1)
    start = b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | several | flags) + b"".join(headers) + b"\0" * bool(several)
    data = [c for part in chunks for c in part]
    places = np.cumsum([len(start) + 8 * len(data), *map(len, data)])[:-1]
    return start + places.astype("<u8").tobytes() + b"".join(data)


def exr_lines(height, each=1, part=b"", size=7, deep=False):
    """Chunks of `each` lines with `size` bytes of data."""
    tops = range(-2, height - 2, each)
    stated = struct.pack("<QQQ", size - 3, 3, 9) if deep else struct.pack("<i", size)
    return [part + struct.pack("<i", top) + stated + bytes(size) for top in tops]


def exr_tile_chunks(count, part=b"", size=7, deep=False):
    stated = struct.pack("<QQQ", size - 3, 3, 9) if deep else struct.pack("<i", size)
    return [part + struct.pack("<iiii", k, 0, 0, 0) + stated + bytes(size) for k in range(count)]


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
    "iris": (b"\x01\xda\0\1" + struct.pack(">HHHH", 3, W, H, 4), BYTES),
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
    "exr": (exr(exr_header(W, H), chunks=[exr_lines(H)]), FLOATS),
    "exr of layers": (exr(exr_header(W, H, [b"%d.R" % i for i in range(100)]), chunks=[exr_lines(H)]), 400 * W * H),
    "exr of parts": (
        exr(*(exr_header(w, h, after=exr_kind(b"scanlineimage")) for w, h in ((W, H), (10, 10))),
            chunks=[exr_lines(H, part=bytes(4)), exr_lines(10, part=b"\1\0\0\0")]), FLOATS + 1600,
    ),
    "exr of tiles": (
        exr(exr_header(W, H, after=exr_tiles(5000, 9)), flags=0x200, chunks=[exr_tile_chunks(23)]), 16 * 5000 * H,
    ),
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
        assert found is None or found.width * found.height >= W * H or kind.startswith("jpeg 2000")
        assert found is None or found.danger or not kind.startswith("exr")


false_window = attribute(b"a", b"string", attribute(b"dataWindow", b"box2i", box2i(2, 2)))
HIDING = {
    "in a string": exr(exr_header(W, H, before=false_window)),
    "in a second window": exr(exr_header(2, 2, after=attribute(b"dataWindow", b"box2i", box2i(W, H)))),
    "in a second part": exr(*(exr_header(w, h, after=exr_kind(b"scanlineimage")) for w, h in ((2, 2), (W, H)))),
    "in the display": exr(exr_header(2, 2, before=attribute(b"displayWindow", b"box2i", box2i(W, H)))),
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


# ---- damage that crashes programs

ZIP, PIZ, DWAB, ONE, MIPMAP, RIPMAP, UP = 3, 4, 9, 0, 1, 2, 16
DEEP = exr_kind(b"deepscanline")
MANY = {  # files of several chunks, and how many those are
    "lines": (exr(exr_header(20, 9), chunks=[exr_lines(9)]), 9),
    "lines of ZIP": (exr(exr_header(20, 50, compression=ZIP), chunks=[exr_lines(50, 16)]), 4),
    "lines of PIZ": (exr(exr_header(20, 50, compression=PIZ), chunks=[exr_lines(50, 32)]), 2),
    "lines of DWAB": (exr(exr_header(20, 600, compression=DWAB), chunks=[exr_lines(600, 256)]), 3),
    "tiles": (exr(exr_header(20, 9, after=exr_tiles(8, 4)), flags=0x200, chunks=[exr_tile_chunks(9)]), 9),
    # 20 x 9, 10 x 4, 5 x 2, 2 x 1, 1 x 1
    "tiles on levels": (exr(exr_header(20, 9, after=exr_tiles(8, 4, MIPMAP)), flags=0x200, chunks=[exr_tile_chunks(14)]), 14),
    # 20 x 9, 10 x 5, 5 x 3, 3 x 2, 2 x 1, 1 x 1
    "tiles on levels, up": (exr(exr_header(20, 9, after=exr_tiles(8, 4, MIPMAP | UP)), flags=0x200, chunks=[exr_tile_chunks(17)]), 17),
    # widths 20, 10, 5, 2, 1 and heights 9, 4, 2, 1: 8 by 6 tiles
    "tiles on both levels": (exr(exr_header(20, 9, after=exr_tiles(8, 4, RIPMAP)), flags=0x200, chunks=[exr_tile_chunks(48)]), 48),
    "parts": (
        exr(exr_header(20, 9, after=exr_kind(b"scanlineimage")), exr_header(20, 3, after=exr_kind(b"tiledimage") + exr_tiles(8, 4)),
            chunks=[exr_lines(9, part=bytes(4)), exr_tile_chunks(3, b"\1\0\0\0")]), 12,
    ),
    "deep lines": (exr(exr_header(20, 9, after=DEEP), flags=0x800, chunks=[exr_lines(9, deep=True)]), 9),
    "deep tiles": (
        exr(exr_header(20, 9, after=exr_kind(b"deeptile") + exr_tiles(8, 4)), flags=0xA00, chunks=[exr_tile_chunks(9, deep=True)]), 9,
    ),
}  # fmt: skip


def tables(kind):
    """A file as a bytearray, its offsets (n,) int64, and where the first of them stands."""
    data, count = MANY[kind]
    at = next(k for k in range(len(data)) if np.frombuffer(data, "<u8", 1, k)[0] == k + 8 * count)
    return bytearray(data), np.frombuffer(data, "<u8", count, at).astype(np.int64), at


@pytest.mark.parametrize("kind", MANY)
def test_whole_exr_files_are_whole(kind):
    assert header_of_bytes(MANY[kind][0]).danger == ""


@pytest.mark.parametrize("kind", MANY)
def test_an_exr_without_all_of_its_chunks_is_damaged(kind):
    """Cut off anywhere; places that are 0, in the headers, in the table, past the end; sizes that lead past the end, or are negative."""
    whole, places, at = tables(kind)
    assert all((found := header_of_bytes(bytes(whole[:end]))) is None or found.danger for end in range(len(whole)))
    for k in {0, len(places) // 2, len(places) - 1}:
        for place in (0, 5, places[0] - 1, len(whole) - 1, len(whole), 1 << 31, (1 << 64) - 1):
            data = whole[:]
            struct.pack_into("<Q", data, at + 8 * k, int(place))
            assert header_of_bytes(bytes(data)).danger, (k, place)
        size = places[k] + 4 * (kind == "parts") + (16 if "tiles" in kind or (kind == "parts" and k >= 9) else 4)
        for stated in (len(whole), 0x7FFFFFFF, 0xFFFFFFFF):
            data = whole[:]
            struct.pack_into("<I", data, size, stated)
            assert header_of_bytes(bytes(data)).danger == "a chunk is cut off", (k, stated)


@pytest.mark.parametrize("kind", [kind for kind in MANY if kind.startswith("lines")])
def test_a_table_of_zeros_leaves_the_chunks_to_be_looked_for(kind):
    """As in the float images that Blender 5.2 packs; cut off they are damaged all the same."""
    whole, places, at = tables(kind)
    whole[at : at + 8 * len(places)] = bytes(8 * len(places))
    assert header_of_bytes(bytes(whole)).danger == ""
    assert all((found := header_of_bytes(bytes(whole[:end]))) is None or found.danger for end in range(len(whole)))
    for k, stated in ((0, len(whole)), (len(places) - 1, 0xFFFFFFFF), (len(places) // 2, 0x7FFFFFFF)):
        data = whole[:]
        struct.pack_into("<I", data, places[k] + 4, stated)
        assert header_of_bytes(bytes(data)).danger == "a chunk is cut off", (k, stated)


def test_chunks_that_are_not_where_the_table_says_are_damage():
    whole, places, at = tables("lines")
    struct.pack_into("<QQ", whole, at, places[1], places[0])
    assert "another place" in header_of_bytes(bytes(whole)).danger
    whole, places, at = tables("parts")
    struct.pack_into("<i", whole, places[0], 1)
    assert "another part" in header_of_bytes(bytes(whole)).danger
    stated = exr(exr_header(20, 9, after=DEEP + attribute(b"chunkCount", b"int", struct.pack("<i", 8))), flags=0x800)
    assert "another number" in header_of_bytes(stated).danger


def test_parts_that_reach_beyond_the_first_are_dangerous():
    """Every Blender writes behind the end of memory then."""
    for first, second, told in (((20, 9), (20, 9), ""), ((20, 9), (5, 3), ""), ((20, 9), (21, 9), "beyond"), ((20, 9), (20, 10), "beyond")):
        parts = [exr_header(*size, after=exr_kind(b"scanlineimage")) for size in (first, second)]
        chunks = [exr_lines(size[1], part=bytes([k, 0, 0, 0])) for k, size in enumerate((first, second))]
        danger = header_of_bytes(exr(*parts, chunks=chunks)).danger
        assert told in danger and bool(told) == bool(danger)


NEEDED = (b"channels", b"compression", b"dataWindow", b"displayWindow", b"lineOrder", b"pixelAspectRatio", b"screenWindowCenter")


@pytest.mark.parametrize("name", (*NEEDED, b"screenWindowWidth"))
def test_an_exr_header_whose_attributes_are_missing_or_of_another_size_is_none(name):
    """Blender 5.0 ends itself over some of them."""
    data = MANY["lines"][0]
    assert header_of_bytes(data.replace(name + b"\0", name[:-1] + b"x\0", 1)) is None
    at = data.index(b"\0", data.index(name + b"\0") + len(name) + 1) + 1
    for size in (-1, struct.unpack_from("<i", data, at)[0] + 1, 0x7FFFFFFF):
        assert header_of_bytes(data[:at] + struct.pack("<i", size) + data[at + 4 :]) is None


def test_no_more_than_header_table_and_heads_are_read():
    """Of a large file too, whatever it promises."""

    class Counting(io.BytesIO):
        count = 0

        def read(self, size=-1):
            found = super().read(size)
            self.count += len(found)
            return found

    data = exr(exr_header(2000, 200), chunks=[exr_lines(200, size=30_000)])
    file = Counting(data)
    assert read_header(file).danger == "" and file.count < 100_000 < len(data) // 50
    tall = exr(exr_header(1, exr_chunks.MOST_CHUNKS + 1))
    assert "more than" in header_of_bytes(tall).danger
    file = Counting(exr(exr_header(20, 1 << 30), chunks=[exr_lines(9)]))
    assert read_header(file).danger and file.count < 100_000


needs_wheel = pytest.mark.skipif(not exr_files.wheel_is_safe(), reason="this program has an OpenEXR of its own")


@needs_wheel
@pytest.mark.parametrize("compression", range(10))
@pytest.mark.parametrize("kind", ("scanlineimage", "tiledimage", "deepscanline", "parts"))
def test_files_of_the_openexr_library(kind, compression, tmp_path):
    """Whole ones are whole, and those that are cut off are not."""
    import OpenEXR

    if kind == "deepscanline" and compression not in (0, 1, 2):
        pytest.skip("deep lines have these compressions only")
    rng, path = np.random.default_rng(0), str(tmp_path / "a.exr")
    header = {"compression": OpenEXR.Compression(compression), "type": getattr(OpenEXR, kind, OpenEXR.scanlineimage)}
    pixels = {c: rng.random((300, 40), np.float32) for c in "RGB"}
    if kind == "tiledimage":
        header["tiles"] = OpenEXR.TileDescription()
    if kind == "deepscanline":
        deep = np.empty((300, 40), object)
        for place in np.ndindex(deep.shape):
            deep[place] = rng.random(1 + sum(place) % 3, np.float32)
        pixels = {"Z": deep, "A": deep.copy()}
    if kind == "parts":
        OpenEXR.File([OpenEXR.Part(dict(header), pixels, name) for name in "ab"]).write(path)
    else:
        OpenEXR.File(header, pixels).write(path)
    data = (tmp_path / "a.exr").read_bytes()
    found = header_of_bytes(data)
    assert (found.width, found.height, found.danger) == (40, 300, "")
    cuts = [header_of_bytes(data[:end]) for end in (*range(0, len(data), len(data) // 40), len(data) - 1)]
    assert all(h is None or h.danger for h in cuts)


def test_our_own_files_are_whole(tmp_path):
    """Also those of layers, and names that are long."""
    image = np.random.default_rng(0).random((37, 20, 4)).astype(np.float32)
    path = exr_files.write_exr(tmp_path / "a.exr", image, {"direct" * 9: image}, folder=tmp_path)
    assert header_of_bytes(path.read_bytes()).danger == "" and header_of_bytes(path.read_bytes()[:-1]).danger


def iris(rows=H, channels=3):
    """A compressed Iris file: its tables, and a byte for each row."""
    count = rows * channels
    head = (b"\x01\xda\1\1" + struct.pack(">HHHH", 3, W, rows, channels)).ljust(512, b"\0")
    return head + np.arange(512 + 8 * count, 512 + 9 * count).astype(">u4").tobytes() + np.ones(count, ">u4").tobytes() + bytes(count)


def test_rows_of_an_iris_file_that_are_not_there_are_damage():
    """Blender 5.2 ends itself over them."""
    data = iris()
    assert header_of_bytes(data) == Header(W, H, BYTES)
    assert "cut off" in header_of_bytes(data[: 512 + 8 * 3 * H - 1]).danger and "missing" in header_of_bytes(data[:-1]).danger
    for at, value in ((512, 0), (512, 1 << 31), (512 + 4 * 3 * H, 1 << 31), (512 + 8 * 3 * H - 4, 2)):
        assert "missing" in header_of_bytes(data[:at] + struct.pack(">I", value) + data[at + 4 :]).danger, at


def test_user_data_of_a_dpx_are_no_longer_than_the_file():
    """Blender takes memory for as many as are stated: gigabytes, or crashes."""
    for order, mark in (("<", b"XPDS"), (">", b"SDPX")):
        for stated, told in ((0, ""), (52, ""), (0xFFFFFFFF, ""), (53, "cut off"), (3 << 30, "cut off")):
            data = (mark + bytes(28) + struct.pack(order + "I", stated)).ljust(770, b"\0") + struct.pack(order + "HII", 1, W, H)
            assert told in header_of_bytes(data.ljust(2100, b"\0")).danger and bool(told) == bool(
                header_of_bytes(data.ljust(2100, b"\0")).danger
            )
