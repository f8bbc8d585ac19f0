"""OpenEXR and PNG files: every bit survives, nothing of others is overwritten, failures are clear and leave nothing behind."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import textwrap
import zlib
from pathlib import Path

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base import atomic
from adjgi.adjoint_gi.core.base.errors import TargetError, WriteError
from adjgi.adjoint_gi.core.images import exr, png, rows
from adjgi.adjoint_gi.core.images.rows import LazyRows
from adjgi.tests.exr_layers import read_exr

ROOT = Path(__file__).resolve().parents[2]


def picture(h=6, w=9, c=4):
    rng = np.random.default_rng(h)
    return (rng.standard_normal((h, w, c)) * 10.0 ** rng.integers(-30, 30, (h, w, c))).astype(np.float32)


def test_layers_come_back_bit_for_bit(tmp_path):
    image, direct, cover = picture(), picture(c=3), picture(c=1)
    image[0, 0] = [1e-40, -0.0, np.finfo(np.float32).max, 0]  # denormal, negative zero, largest
    layers = {"direct": direct, "coverage": cover[..., 0]}
    path = exr.write_exr(tmp_path / "a.exr", image, layers, folder=tmp_path, metadata={"method": "x", "seed": 3})
    back, meta = read_exr(path)
    assert set(back) == {"", "direct", "coverage"}
    for name, want in (("", image), ("direct", direct), ("coverage", cover)):
        assert back[name].dtype == np.float32
        assert np.array_equal(back[name].view(np.uint32), want.view(np.uint32))
    assert meta == {"method": "x", "seed": "3"}
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_top_row_of_the_file_is_the_last_row_of_the_array(tmp_path):
    import OpenEXR

    image = picture(c=3)
    path = exr.write_exr(tmp_path / "a.exr", image, folder=tmp_path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert np.array_equal(file.channels()["R"].pixels[0], image[-1, :, 0])
        assert file.channels()["R"].pixels.dtype == np.float32


def test_our_own_file_is_replaced(tmp_path):
    exr.write_exr(tmp_path / "a.exr", picture(), folder=tmp_path)
    exr.write_exr(tmp_path / "a.exr", picture(4, 4), folder=tmp_path)
    assert read_exr(tmp_path / "a.exr")[0][""].shape == (4, 4, 4)


@pytest.mark.parametrize("content", [b"", b"hello", b"v/1\x01 broken"])
def test_a_file_of_others_is_never_replaced(tmp_path, content):
    for write, name in ((exr.write_exr, "a.exr"), (png.write_png, "a.png")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TargetError, match="not written by Adjoint GI"):
            write(tmp_path / name, np.zeros((2, 2, 3), np.float32), folder=tmp_path)
        assert (tmp_path / name).read_bytes() == content


def test_a_file_that_others_put_there_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "a.txt"

    def write(temporary):
        temporary.write_bytes(b"ours")
        path.write_bytes(b"theirs")

    with pytest.raises(TargetError, match="not written by Adjoint GI"):
        atomic.replace_file(path, tmp_path, write=write, verify=lambda _: True, ours=lambda _: False)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.txt", b"theirs")]


def test_names_that_the_system_cannot_have_are_refused(tmp_path):
    """As where file names are ASCII."""
    with pytest.raises(WriteError, match="no such characters"):
        atomic.replace_file(tmp_path / "a.txt", tmp_path, write=lambda _: "\u00fc".encode("ascii"), verify=bool, ours=bool)
    assert list(tmp_path.iterdir()) == []


def test_an_exr_of_another_program_is_never_replaced(tmp_path):
    import OpenEXR

    path = tmp_path / "a.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": np.zeros((2, 2), np.float32)}).write(str(path))
    before = path.read_bytes()
    with pytest.raises(TargetError, match="not written by Adjoint GI"):
        exr.write_exr(path, picture(), folder=tmp_path)
    assert path.read_bytes() == before


def make_link(link, target, folder=False):
    try:
        os.symlink(target, link, target_is_directory=folder)
    except OSError as error:
        pytest.skip(f"this system does not let us make a symbolic link: {error}")


def test_links_are_refused(tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    inside = tmp_path / "inside"
    inside.mkdir()
    victim = outside / "mine.exr"
    exr.write_exr(victim, picture(), folder=outside)
    before = victim.read_bytes()
    make_link(inside / "a.exr", victim)
    with pytest.raises(TargetError, match="symbolic link"):
        exr.write_exr(inside / "a.exr", picture(3, 3), folder=inside)
    make_link(inside / "dangling.exr", outside / "new.exr")
    with pytest.raises(TargetError, match="symbolic link"):
        exr.write_exr(inside / "dangling.exr", picture(3, 3), folder=inside)
    make_link(inside / "sub", outside, folder=True)
    with pytest.raises(TargetError, match="outside of the chosen folder"):
        exr.write_exr(inside / "sub" / "b.exr", picture(3, 3), folder=inside)
    assert victim.read_bytes() == before and sorted(p.name for p in outside.iterdir()) == ["mine.exr"]


@pytest.mark.parametrize("name", ["../a.exr", "../../etc/a.exr", "/a.exr", "", "..", "a\0b.exr"])
def test_paths_that_leave_the_folder_are_refused(tmp_path, name):
    folder = tmp_path / "out"
    folder.mkdir()
    with pytest.raises(TargetError):
        exr.write_exr(folder / name if name != "/a.exr" else Path(name), picture(), folder=folder)
    assert list(folder.iterdir()) == []


def test_missing_folder_is_a_clear_error(tmp_path):
    with pytest.raises(WriteError, match="the folder does not exist"):
        exr.write_exr(tmp_path / "no" / "a.exr", picture(), folder=tmp_path / "no")


def test_a_folder_whose_name_is_not_utf8(tmp_path):
    try:
        folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
        folder.mkdir()
    except (OSError, UnicodeError) as error:
        pytest.skip(f"this system has no such names: {error}")
    image = picture()
    exr.write_exr(folder / "a.exr", image, folder=folder)
    assert np.array_equal(read_exr(folder / "a.exr")[0][""], image) and exr.is_ours(folder / "a.exr")


def test_too_long_name_is_a_clear_error(tmp_path):
    with pytest.raises(WriteError, match="too long"):
        exr.write_exr(tmp_path / ("x" * 300 + ".exr"), picture(), folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_read_only_folder_is_a_clear_error(tmp_path, monkeypatch):
    if sys.platform == "win32":
        pytest.skip("folders have no write permission of this kind on Windows")
    folder = tmp_path / "out"
    folder.mkdir()
    exr.write_exr(folder / "a.exr", picture(), folder=folder)
    before = (folder / "a.exr").read_bytes()
    if os.geteuid() == 0:  # permissions do not stop root, so the system's answer is given here
        real = os.open

        def refuse(path, flags, *args):
            if flags & os.O_CREAT:
                raise PermissionError(13, "Permission denied", str(path))
            return real(path, flags, *args)

        monkeypatch.setattr(atomic.os, "open", refuse)
    else:
        folder.chmod(0o555)
    try:
        with pytest.raises(WriteError, match="no permission"):
            exr.write_exr(folder / "a.exr", picture(3, 3), folder=folder)
    finally:
        folder.chmod(0o755)
    assert (folder / "a.exr").read_bytes() == before


FULL = """
import importlib.util, resource, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("adjgi", {root!r} + "/__init__.py", submodule_search_locations=[{root!r}])
sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["adjgi"])
import numpy as np
from adjgi.adjoint_gi.core.images import exr, png, rows
from adjgi.adjoint_gi.core.images.rows import LazyRows
from adjgi.adjoint_gi.core.base.errors import WriteError
folder = Path({folder!r})
noise = np.random.default_rng(0).random((256, 256, 3)).astype(np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
for write, name in ((exr.write_exr, "a.exr"), (png.write_png, "a.png")):
    try:
        write(folder / name, noise, folder=folder)
        print("written")
    except WriteError as error:
        print("refused:", error)
"""


def test_disk_that_fills_up_is_a_clear_error_and_keeps_the_old_file(tmp_path):
    if sys.platform == "win32":
        pytest.skip("Windows has no limit of the file size to stand in for a full disk")
    small = np.zeros((2, 2, 3), np.float32)
    exr.write_exr(tmp_path / "a.exr", small, folder=tmp_path)
    png.write_png(tmp_path / "a.png", small, folder=tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    code = textwrap.dedent(FULL.format(root=str(ROOT), folder=str(tmp_path)))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and all(line.startswith("refused: ") and "larger than this system allows" in line for line in lines), (
        done.stdout + done.stderr
    )
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize("place", [0, 60, -20, -1])
def test_a_file_that_reads_back_differently_is_not_kept(tmp_path, monkeypatch, place):
    real = exr.write_channels

    def flipped(path, *arguments):
        written = real(path, *arguments)
        data = bytearray(path.read_bytes())
        data[place] ^= 1
        path.write_bytes(data)
        return written

    monkeypatch.setattr(exr, "write_channels", flipped)
    with pytest.raises(WriteError, match="did not read back"):
        exr.write_exr(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32), folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_layers_are_asked_for_a_few_rows_at_a_time(tmp_path, monkeypatch):
    """Whatever the size of the image: no layer is in memory as a whole, and every row is made once."""
    asked = []

    def make(part):
        asked.append((part.start, part.stop))
        return np.broadcast_to(np.arange(part.start, part.stop, dtype=np.float32)[:, None, None], (part.stop - part.start, 40, 3))

    image = LazyRows((200, 40, 3), make)
    back = read_exr(exr.write_exr(tmp_path / "a.exr", image, {"direct": image}, folder=tmp_path))[0]
    assert max(b - a for a, b in asked) <= 16 and sum(b - a for a, b in asked) == 2 * 200
    assert np.array_equal(back["direct"][:, 7, 1], np.arange(200)) and np.array_equal(back[""], back["direct"])
    asked.clear()
    monkeypatch.setattr(rows, "PIXELS", 400)
    png.write_png(tmp_path / "a.png", LazyRows((200, 40, 3), make), folder=tmp_path)
    assert max(b - a for a, b in asked) == 10 and sum(b - a for a, b in asked) == 200


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(tmp_path, bad):
    image = np.zeros((2, 2, 3), np.float32)
    image[1, 1, 2] = bad
    for write in (exr.write_exr, png.write_png):
        with pytest.raises(WriteError, match="1 values"):
            write(tmp_path / "a", image, folder=tmp_path)


def test_wrong_shapes_and_layer_names_are_refused(tmp_path):
    good = np.zeros((2, 2, 3), np.float32)
    for image, layers in ((np.zeros((2, 2, 5)), {}), (np.zeros((0, 2, 3)), {}), (good, {"a": np.zeros((3, 3))}), (good, {"a.b": good})):
        with pytest.raises(WriteError):
            exr.write_exr(tmp_path / "a.exr", image, layers, folder=tmp_path)


def test_unreadable_file_is_an_error_and_not_ours(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(50))
    with pytest.raises((RuntimeError, OSError)):
        exr.read_channels(tmp_path / "a.exr")
    assert not exr.is_ours(tmp_path / "a.exr")


def decode(data):
    """Pixels (h, w, c) uint8, top row first, of a PNG with filter 0."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, blocks = 8, {}
    while at < len(data):
        n = struct.unpack(">I", data[at : at + 4])[0]
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + n]
        assert struct.unpack(">I", data[at + 8 + n : at + 12 + n])[0] == zlib.crc32(kind + body)
        blocks[kind] = body
        at += 12 + n
    w, h, depth, kind = struct.unpack(">IIBB", blocks[b"IHDR"][:10])
    c = {2: 3, 6: 4}[kind]
    rows = np.frombuffer(zlib.decompress(blocks[b"IDAT"]), np.uint8).reshape(h, 1 + w * c)
    assert depth == 8 and not rows[:, 0].any()
    return rows[:, 1:].reshape(h, w, c)


def test_png_holds_srgb_values(tmp_path):
    image = np.zeros((2, 3, 4), np.float32)
    image[0, 0] = [0.2158605, 1.0, 2.0, 0.5]  # 0.2158605 is 128 of 255 in sRGB
    image[1, 2] = [0.0021, -1, 0, 1]
    path = png.write_png(tmp_path / "a.png", image, folder=tmp_path)
    pixels = decode(path.read_bytes())
    assert list(pixels[1, 0]) == [128, 255, 255, 128]
    assert list(pixels[0, 2]) == [7, 0, 0, 255]
    png.write_png(tmp_path / "a.png", image, folder=tmp_path)
