# SPDX-License-Identifier: GPL-3.0-or-later
"""Our own OpenEXR files against the OpenEXR library, bit for bit in both directions, and hostile files."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from adjgi.adjoint_gi.core.images import exr
from adjgi.tests.exr_layers import read_exr

if not exr.wheel_is_safe():
    pytest.skip("this program has an OpenEXR of its own, next to which the wheel crashes", allow_module_level=True)
import OpenEXR


def write(path, made, strings):
    """Write channels (h, w), top row first: each has a layer of its own."""
    exr.write_channels(path, {name: (name, 0) for name in made}, {name: values[::-1] for name, values in made.items()}, strings)


def channels(width, height, noise=False):
    rng = np.random.default_rng(1)
    values = rng.integers(0, 2**32, (4, height, width), dtype=np.uint32).view(np.float32) if noise else rng.random((4, height, width))
    values = np.where(np.isfinite(values), values, 0).astype(np.float32)
    names = ("R", "G", "direct.B", "a layer with a name longer than thirty-one characters.R")
    return dict(zip(names, values, strict=True))


@pytest.mark.parametrize("size", [(1, 1), (7, 16), (64, 33), (5, 100)])
@pytest.mark.parametrize("noise", [False, True])
def test_files_are_read_by_the_library_and_by_ourselves(tmp_path, size, noise):
    made = channels(*size, noise)
    path = tmp_path / "x.exr"
    write(path, made, {"software": "Adjoint GI", "adjoint_gi.note": "\u00fc 1"})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())  # closing the file empties it
        back = {name: np.array(c.pixels) for name, c in file.channels().items()}
    assert header["software"] == "Adjoint GI" and header["compression"] == OpenEXR.ZIP_COMPRESSION
    own, strings = exr.read_numpy(path)
    assert strings["adjoint_gi.note"] == "\u00fc 1" and exr.strings_numpy(path) == strings
    for name, values in made.items():
        assert np.array_equal(back[name].view(np.uint32), values.view(np.uint32))
        assert np.array_equal(own[name].view(np.uint32), values.view(np.uint32))


@pytest.mark.parametrize("compression", ["ZIP_COMPRESSION", "ZIPS_COMPRESSION", "NO_COMPRESSION"])
def test_files_of_the_library_are_read(tmp_path, compression):
    made = channels(33, 50)
    path = tmp_path / "x.exr"
    header = {"compression": getattr(OpenEXR, compression), "type": OpenEXR.scanlineimage, "software": "Adjoint GI"}
    OpenEXR.File(header, {k: v.copy() for k, v in made.items()}).write(str(path))
    own, strings = exr.read_numpy(path)
    assert strings["software"] == "Adjoint GI" and set(own) == set(made)
    assert all(np.array_equal(own[name].view(np.uint32), values.view(np.uint32)) for name, values in made.items())


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "x.exr"
    write(path, channels(20, 20), {})
    whole = path.read_bytes()
    for cut in (0, 3, 8, 50, 200, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(RuntimeError, match="not an OpenEXR file"):
            exr.read_numpy(path)
    path.write_bytes(b"P6 2 2 255 " + bytes(500))
    with pytest.raises(RuntimeError):
        exr.strings_numpy(path)
    rng = np.random.default_rng(2)
    for _ in range(200):
        data = bytearray(whole)
        data[int(rng.integers(8, 400))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            exr.read_numpy(path)
        except (RuntimeError, MemoryError):
            continue


def test_pictures_are_the_same_with_and_without_the_wheel(tmp_path, monkeypatch):
    """A picture with layers and metadata is written one way and read the other way."""
    rng = np.random.default_rng(3)
    image, layer = rng.random((9, 20, 4), np.float32), rng.random((9, 20), np.float32)
    for writer in (True, False):
        monkeypatch.setattr(exr, "wheel_is_safe", lambda writer=writer: writer)
        path = exr.write_exr(tmp_path / f"{writer}.exr", image, {"depth": layer}, folder=tmp_path, metadata={"method": "x"})
        monkeypatch.setattr(exr, "wheel_is_safe", lambda writer=writer: not writer)
        layers, metadata = read_exr(path)
        assert exr.is_ours(path) and metadata == {"method": "x"}
        np.testing.assert_array_equal(layers[""], image)
        np.testing.assert_array_equal(layers["depth"][..., 0], layer)


def test_windows_that_do_not_begin_at_zero(tmp_path):
    """Other programs crop: the numbers of the scanlines are those of the window."""
    made = {"R": np.arange(40 * 3, dtype=np.float32).reshape(40, 3)}
    path = tmp_path / "x.exr"
    write(path, made, {})
    data = bytearray(path.read_bytes())
    name = b"dataWindow\0box2i\0" + struct.pack("<i", 16)
    at = data.index(name) + len(name)
    assert struct.unpack_from("<4i", data, at) == (0, 0, 2, 39)
    struct.pack_into("<4i", data, at, 5, -7, 7, 32)
    table = exr._attributes(bytes(data))[1]
    for offset in struct.unpack_from("<3q", data, table):
        (y,) = struct.unpack_from("<i", data, offset)
        struct.pack_into("<i", data, offset, y - 7)
    path.write_bytes(data)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert np.array_equal(file.channels()["R"].pixels, made["R"])
    assert np.array_equal(exr.read_numpy(path)[0]["R"], made["R"])
