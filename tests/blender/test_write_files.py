"""File names from any object name, output folders, and files that Blender reads back with the same numbers."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.host import files
from adjgi.adjoint_gi.bridge.host.files import output_file, output_folder, safe_name
from adjgi.adjoint_gi.bridge.results.image import read_pixels
from adjgi.adjoint_gi.core.base.errors import TargetError, WriteError
from adjgi.adjoint_gi.core.images.exr import write_exr
from adjgi.adjoint_gi.core.images.png import write_png

HOSTILE = [
    "../../x", "/etc/passwd", "a/b\\c:d", "new\nline", "x" * 255, "\U0001f600", "\u05d0\u05d1\u05d2",
    "   ", "", "CON", "nul.txt", "LPT1", "-rf",
    ".hidden", "..", "caf\u00e9", "cafe", "Cube", "cube",
    "\udcff", "a?b*c", "COM\u00b9", "%TEMP%", "~", "$HOME", "a.", "a",
]  # fmt: skip


def test_every_name_becomes_a_different_plain_file_name():
    names = [safe_name(name) for name in HOSTILE]
    assert len({n.lower() for n in names}) == len(HOSTILE)
    for name in names:
        assert len((name + ".exr").encode()) <= 120
        assert not set(name) & set('/\\:*?"<>|\n\0') and name.strip(" .") == name and not name.startswith("-")
        assert name.split(".")[0].lower() not in ("con", "nul", "lpt1")
    assert safe_name("Cube") == safe_name("Cube") == "Cube-" + safe_name("Cube")[-8:]


@pytest.mark.parametrize("name", HOSTILE)
def test_every_name_can_be_written_and_read_by_blender(tmp_path, name):
    pixels = np.random.default_rng(0).random((3, 4, 4)).astype(np.float32)
    path = write_exr(output_file(tmp_path, name, ".exr"), pixels, folder=tmp_path)
    assert path.parent == tmp_path
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.is_data = True
    assert np.array_equal(read_pixels(image), pixels)


def test_blender_reads_the_same_numbers_from_a_file_without_layers(tmp_path):
    rng = np.random.default_rng(1)
    pixels = (rng.random((9, 5, 4)) * 10.0 ** rng.integers(-20, 20, (9, 5, 4))).astype(np.float32)
    pixels[0, 0] = [-3.5, 123456.789, 1e-30, 1]
    pixels[..., 3] = rng.integers(0, 3, (9, 5)) / 2
    image = bpy.data.images.load(str(write_exr(tmp_path / "a.exr", pixels, folder=tmp_path)))
    image.colorspace_settings.is_data = True
    assert image.is_float and np.array_equal(read_pixels(image).view(np.uint32), pixels.view(np.uint32))


def test_a_second_program_reads_the_same_numbers_from_the_layers(tmp_path):
    expose = getattr(bpy.utils, "expose_bundled_modules", None)
    if expose is None:
        pytest.skip("this Blender brings no OpenImageIO for Python (before 4.5)")
    expose()
    oiio = pytest.importorskip("OpenImageIO", reason="this Blender brings no OpenImageIO for Python")
    rng = np.random.default_rng(2)
    pixels, direct, cover = rng.random((6, 7, 4)), rng.random((6, 7, 3)), rng.random((6, 7))
    path = write_exr(tmp_path / "a.exr", pixels, {"direct": direct, "coverage": cover}, folder=tmp_path)
    file = oiio.ImageInput.open(str(path))
    spec = file.spec()
    data = file.read_image(oiio.FLOAT)
    file.close()
    names = list(spec.channelnames)
    for k, letter in enumerate("RGBA"):
        assert np.array_equal(data[::-1, :, names.index(letter)], pixels[..., k].astype(np.float32))
    for k, letter in enumerate("RGB"):
        assert np.array_equal(data[::-1, :, names.index("direct." + letter)], direct[..., k].astype(np.float32))
    assert np.array_equal(data[::-1, :, names.index("coverage.V")], cover.astype(np.float32))


def test_blender_reads_our_png(tmp_path):
    linear = np.random.default_rng(0).random((5, 6, 3)).astype(np.float32)
    image = bpy.data.images.load(str(write_png(tmp_path / "a.png", linear, folder=tmp_path)))
    assert image.colorspace_settings.name == "sRGB"
    coded = read_pixels(image)[..., :3]
    decoded = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    assert np.abs(decoded - linear).max() < 0.005


def test_folders(tmp_path):
    assert output_folder(str(tmp_path / "new" / "deep")).is_dir()
    for text in ("", "  ", "relative", "a\0b"):
        with pytest.raises(TargetError):
            output_folder(text)
    with pytest.raises(TargetError, match="not saved yet"):
        output_folder("//out")
    (tmp_path / "file").write_text("x")
    with pytest.raises(WriteError):
        output_folder(str(tmp_path / "file"))
    with pytest.raises(WriteError):
        output_folder(str(tmp_path / "file" / "below"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert output_folder("//out/../else") == Path(tmp_path / "else")


def test_looking_at_a_folder_makes_nothing_and_making_it_writes_there(tmp_path, monkeypatch):
    wanted = tmp_path / "new" / "deep"
    assert output_folder(str(wanted), create=False) == wanted and not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(WriteError, match="is a file, not a folder"):
        output_folder(str(tmp_path / "file" / "below"), create=False)
    with pytest.raises(TargetError, match="not saved yet"):
        output_folder("//out", create=False)

    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    # The user who runs the tests may be allowed everything, so the system's answers are replaced.
    monkeypatch.setattr(files.tempfile, "TemporaryFile", refuse)
    with pytest.raises(WriteError, match="cannot be written to .Read-only file system"):
        output_folder(str(wanted))
    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(WriteError, match="cannot be made .Read-only file system"):
        output_folder(str(tmp_path / "other"))
