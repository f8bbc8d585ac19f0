# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line where its output cannot go, where names forge lines, where its folder is gone, where files hold scripts; and strict JSON
from every method."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import sys

import bpy
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.baking.report import of_bake
from adjgi.adjoint_gi.bridge.cli import cornell
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.cli.arguments import make_parser
from adjgi.adjoint_gi.bridge.cli.arguments import request_of as cli_request
from adjgi.adjoint_gi.bridge.cli.bake import write_report
from adjgi.adjoint_gi.bridge.props.request import RECEIVERS, BakeRequest
from adjgi.adjoint_gi.bridge.results import kept
from adjgi.adjoint_gi.core.method import registry

solvers.load()
CHECK = ("check", "--resolution", "32")
SMALL = ("--resolution", "8", "--set", "samples=1", "--objects", "Floor")


class Broken(io.StringIO):
    """A stream that takes `room` characters and then fails."""

    def __init__(self, number, room=0):
        super().__init__()
        self.number, self.room = number, room

    def write(self, text):
        if self.tell() + len(text) > self.room:
            raise OSError(self.number, os.strerror(self.number))
        return super().write(text)


@pytest.fixture
def scene():
    made = cornell.build_cornell(size=(16, 16))
    old = bpy.context.scene
    bpy.context.window.scene = made
    bpy.data.scenes.remove(old)
    return made


def command(out, err, *arguments):
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return cli.main([str(a) for a in arguments], in_blender=True)


def ascii_stream():
    return io.TextIOWrapper(io.BytesIO(), "ascii", write_through=True)


@pytest.mark.parametrize("number", [errno.EPIPE, errno.ENOSPC, errno.EIO])
def test_a_bake_whose_output_cannot_be_written_writes_everything_else(scene, tmp_path, number):
    report, err = tmp_path / "r.json", io.StringIO()
    code = command(Broken(number), err, "bake", *SMALL, "--output", tmp_path, "--report", report)
    assert code == 0 and len(json.loads(report.read_text())["files"]) == 3, err.getvalue()
    assert ("Standard output: could not be written" in err.getvalue()) == (number != errno.EPIPE)
    assert "Traceback" not in err.getvalue()
    code = command(Broken(number), Broken(number), "bake", *SMALL, "--output", tmp_path, "--report", report)
    assert code == 0
    assert command(None, None, "bake", *SMALL, "--output", tmp_path, "--report", report) == 0, "closed streams"


@pytest.mark.parametrize(("number", "code"), [(errno.EPIPE, 0), (errno.ENOSPC, 1)])
def test_an_answer_that_is_lost_fails_unless_its_reader_has_gone(scene, number, code):
    for arguments in (CHECK, ("methods",), ("methods", "--json")):
        assert command(Broken(number, room=20), io.StringIO(), *arguments) == code
    assert command(Broken(number), io.StringIO(), "check", "--objects", "Nobody") == 2


def test_a_real_pipe_without_a_reader(scene):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as out:
        assert command(out, io.StringIO(), *CHECK) == 0
        out.flush()  # what was still buffered goes nowhere, as at the end of an interpreter


def test_names_are_one_line_in_every_encoding(scene):
    scene.objects["Floor"].name = "Fl\xf6\x1b[2Jor\nerror: forged\u202e"
    out, err = ascii_stream(), ascii_stream()
    assert command(out, err, *CHECK) == 0
    text = (out.buffer.getvalue() + err.buffer.getvalue()).decode("ascii")
    assert "Fl\\xf6\\x1b[2Jor\\nerror: forged\\u202e" in text
    assert not [line for line in text.splitlines() if line.startswith("error")] and "\x1b" not in text


def test_arguments_and_tracebacks_forge_no_line(scene, monkeypatch):
    err = io.StringIO()
    assert command(io.StringIO(), err, "check", "a.blend", "b\nerror: forged\x1b") == 2

    def fail(*_):
        raise RuntimeError("name\nerror: forged\x1b")

    monkeypatch.setitem(cli.COMMANDS, "check", fail)
    assert command(io.StringIO(), err, "check") == 1
    assert not [line for line in err.getvalue().splitlines() if line.startswith("error")] and "\x1b" not in err.getvalue()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not remove the working directory of a process")
def test_a_working_directory_that_is_gone(scene, tmp_path, monkeypatch):
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    err = io.StringIO()
    assert command(io.StringIO(), err, "bake", *SMALL, "--output", tmp_path, "--report", tmp_path / "r.json") == 0, err.getvalue()
    for arguments in (("bake", "--output", "out"), ("bake", "--output", tmp_path, "--report", "r.json"), ("check", "a.blend")):
        err = io.StringIO()
        assert command(io.StringIO(), err, *arguments) == 2 and "Working directory: was removed" in err.getvalue()
    monkeypatch.chdir(tmp_path)


NUMBERS = ["\u00b2", "\u0663", "1_0", "1e3", "inf", "nan", "9" * 30, "9" * 5000, ""]


@pytest.mark.parametrize("text", NUMBERS)
def test_numbers_that_only_python_would_read(scene, text):
    cases = [("--size", f"{text}x4"), ("--size", f"4x{text}"), ("--resolution", text), ("--seed", text), ("--set", f"samples={text}")]
    for option, value in cases:
        err = io.StringIO()
        assert command(io.StringIO(), err, "check", "--target", "render", option, value) == 2, (option, value)
        assert "Traceback" not in err.getvalue() and "error: " in err.getvalue()


def test_kept_results_follow_no_link(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "adjoint_gi_kept").symlink_to(victim, target_is_directory=True)
    monkeypatch.setattr(kept.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(kept.bpy.utils, "extension_path_user", lambda *_, **__: (_ for _ in ()).throw(ValueError()))
    kept._temporary_folder.cache_clear()
    folder = kept.folder()
    kept._temporary_folder.cache_clear()
    assert folder.parent == tmp_path and not folder.is_symlink() and folder.resolve() != victim
    assert sys.platform == "win32" or folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("method", [m.spec.id for m in registry.methods()])
def test_the_report_of_every_method_is_strict_json(scene, tmp_path, method):
    solver = registry.method(method)
    target = next(t for t in ("render", "texture", "attribute") if RECEIVERS[t] in solver.spec.receivers)
    settings = solver.Settings().replaced({"particles": "64"} if method == "particle_tracing" else {})  # one batch, so no error is known
    quantity = "potential" if solver.spec.answers == "potential" else "irradiance"
    made = Bake(
        bpy.context,
        BakeRequest(method, settings, target, ("Floor",), quantity, resolution=4, output=str(tmp_path), width=4, height=4),
    )

    def stop(driver):
        if driver.fraction > 0:  # a first result is enough
            raise KeyboardInterrupt

    made.driver.run(stop)
    path = write_report(tmp_path / "r.json", of_bake(made))
    found = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert found["method"]["id"] == method
    if method == "particle_tracing":
        assert "infinity" in found["not_numbers"].values()


@pytest.mark.parametrize("name", ["check", "bake", "compare"])
def test_scripts_in_a_named_file_are_not_run(scene, tmp_path, name):
    """Neither a registered text nor a driver that Blender holds for unsafe, by any command; opened with scripts, the file runs both."""
    path, mark = tmp_path / "box.blend", tmp_path / "ran"
    text = bpy.data.texts.new("start")
    text.use_module, text.name = True, "start.py"
    text.write(f"open({str(mark)!r}, 'w').close()")
    bpy.data.objects["Floor"].driver_add("location", 0).driver.expression = "frame.real"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))

    def ran():
        bpy.context.scene.frame_set(7)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return mark.exists(), bpy.data.objects["Floor"].evaluated_get(depsgraph).location.x == 7.0

    bpy.ops.wm.open_mainfile(filepath=str(path), use_scripts=True)
    assert ran() == (True, True)
    mark.unlink()
    # The folder is a file, so that nothing more is done once the scene is open.
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        cli.main([name, str(path), *([] if name == "check" else ["--output", str(path)])], in_blender=False)
    assert bpy.data.filepath == str(path) and ran() == (False, False), told.getvalue()


@pytest.mark.parametrize("name", ["bake", "check", "compare"])
def test_an_option_of_several_names_goes_on_where_it_is_given_again(name):
    words = [name, "a.blend", "--objects", "Floor", "Wall", "--set", "x=1", "--objects", "Wall", "Roof", "--set", "y=2"]
    for _ in range(2):  # nor do defaults grow by what was asked before
        options = make_parser(in_blender=False).parse_args([*words, *(["--output", "out"] if name == "compare" else [])])
        assert options.objects == ["Floor", "Wall", "Wall", "Roof"] and options.set == ["x=1", "y=2"]
    if name == "bake":
        assert cli_request(make_parser(in_blender=False).parse_args(words[:5] + words[7:10])).objects == ("Floor", "Wall", "Roof")
