# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: in this process as Blender calls it, and as a process of its own with exit codes and Ctrl-C."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.cli import bake as cli_bake
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.cli import demo as cli_demo
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.cli import open as cli_open
from adjgi.adjoint_gi.bridge.cli import progress as cli_progress
from adjgi.adjoint_gi.bridge.cli.arguments import DEMO_METHODS
from adjgi.adjoint_gi.bridge.host.background import notice_of
from adjgi.adjoint_gi.bridge.results import kept
from adjgi.adjoint_gi.bridge.results import show as results
from adjgi.adjoint_gi.core.base.errors import Notice, TargetError, WriteError
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.exr_layers import read_exr

solvers.load()
ROOT = Path(__file__).resolve().parents[2]
START = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("adjgi", sys.argv.pop(1) + "/__init__.py", submodule_search_locations=[sys.argv.pop(1)])
sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.bridge.cli.main import console
console()
"""
IS_WHEEL = not bpy.app.binary_path
CHECK = ("check", "--resolution", 32)
needs_wheel = pytest.mark.skipif(not IS_WHEEL, reason="the console command belongs to the bpy wheel; this is a Blender program")


def command(*arguments):
    """Run in this process; returns (exit code, standard output, standard error)."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main([str(a) for a in arguments], in_blender=True)
    return code, out.getvalue(), err.getvalue()


def start(*arguments, **more):
    return subprocess.Popen(
        [sys.executable, "-c", START, str(ROOT), str(ROOT), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **more,
    )


def box():
    """The Cornell box as the open scene."""
    scene = demo.build_cornell(size=(32, 32))
    old = bpy.context.scene
    bpy.context.window.scene = scene
    bpy.data.scenes.remove(old)
    return scene


@pytest.fixture
def blend(tmp_path):
    """The Cornell box as a file."""
    box()
    path = tmp_path / "box.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_methods_as_table_and_json():
    code, table, _ = command("methods")
    specs = [s.spec for s in registry.methods()]
    assert code == 0
    for spec in specs:
        line = next(line for line in table.splitlines() if line.startswith(spec.id + " "))
        assert str(spec.year) in line and spec.authors in line and spec.strategies[0] in line and spec.natures[0] in line
        assert spec.equation in table and all(limit in table for limit in spec.limits)
    code, text, _ = command("methods", "--json")
    found = json.loads(text)
    assert code == 0 and [m["identifier"] for m in found] == [s.id for s in specs]
    assert {"strategy", "nature", "authors", "year", "title", "equation", "limits"} <= set(found[0])


def test_bake_texture_writes_everything_and_a_report(tmp_path):
    box()
    report = tmp_path / "report.json"
    arguments = ("--resolution", 16, "--objects", "Floor", "Left Wall", "--set", "samples=4", "--seed", 3, "--output", tmp_path / "out")
    code, out, err = command("bake", *arguments, "--report", report)
    assert code == 0, err
    found = json.loads(report.read_text())
    assert found["settings"]["samples"] == 4 and found["seed"] == 3 and not found["partial"]
    assert len(found["files"]) == 6 and all(Path(f).is_file() for f in found["files"])
    assert all(f"wrote {f}" in out for f in found["files"]) and "peak memory" in out and "rays" in out
    assert "Path Tracing:" in err, "plain progress lines, for this is no terminal"
    code, _, err = command("bake", *arguments, "--report", report)
    assert code == 0, "our own files are replaced: " + err


def test_bake_attribute_into_a_blend(registered, tmp_path):
    box()
    target = tmp_path / "baked.blend"
    arguments = ("--method", "progressive_radiosity", "--target", "attribute", "--domain", "POINT", "--attribute", "Light")
    code, out, err = command("bake", *arguments, "--save-blend", target)
    assert code == 0, err
    bpy.ops.wm.open_mainfile(filepath=str(target))
    for name in ("Floor", "Tall Box"):
        data = bpy.data.objects[name].data.attributes["Light"].data
        values = np.empty(4 * len(data), np.float32)
        data.foreach_get("color", values)
        assert values.reshape(-1, 4)[:, :3].max() > 0.1
    record = bpy.context.scene.adjoint_gi.result
    assert (record.method, record.target, record.applied) == ("progressive_radiosity", "attribute", True) and record.mean[0] > 0.0
    assert results.show(bpy.context.scene) == 7, "the panel shows what the command line has baked"
    assert command("bake", *arguments, "--save-blend", target)[0] == 2, "an existing file is not replaced"
    assert command("bake", *arguments, "--save-blend", target, "--overwrite")[0] == 0


def test_a_blend_that_cannot_be_saved_leaves_the_one_that_is_there(tmp_path, monkeypatch):
    """A full disk shows in a file that Blender has written in part."""
    box()
    target = tmp_path / "baked.blend"
    target.write_bytes(b"BLENDER of yesterday")

    def cut(path):
        path.unlink()
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
        with open(path, "r+b") as file:
            file.truncate(4096)

    monkeypatch.setattr(cli_bake, "_save_copy", cut)
    with pytest.raises(WriteError, match="could not be written"):
        cli_bake.save_blend(target)
    assert target.read_bytes() == b"BLENDER of yesterday" and list(tmp_path.iterdir()) == [target]


def test_lightmap_packed_into_a_blend(tmp_path):
    box()
    target = tmp_path / "baked.blend"
    code, _, err = command(
        "bake", "--atlas", "--resolution", 64, "--set", "samples=1", "--quantity", "direct", "--save-blend", target
    )  # fmt: skip
    assert code == 0, err
    bpy.ops.wm.open_mainfile(filepath=str(target))
    (image,) = [i for i in bpy.data.images if "adjoint_gi_about" in i]
    assert tuple(image.size) == (64, 64) and image.packed_file is not None


@pytest.mark.parametrize("method", DEMO_METHODS)
def test_bake_picture(tmp_path, method):
    box()
    values = {"path_tracing": ["--set", "samples=2"], "particle_tracing": ["--set", "particles=20000"]}.get(method, [])
    code, out, err = command("bake", "--method", method, "--target", "render", "--size", "24x16", "--output", tmp_path, *values)
    assert code == 0, err
    (file,) = tmp_path.glob("*.exr")
    layers, _ = read_exr(file)
    assert layers[""].shape == (16, 24, 4) and {"Emission", "Direct", "Indirect", "Albedo", "Normal", "Depth"} <= set(layers)
    assert ("Elements" in layers) == registry.method(method).spec.uses_elements
    assert len(list(tmp_path.glob("*.png"))) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "sample=4"], ["sample: is not a setting", "seed, min_length", "samples"]),
        (["--set", "samples"], ["--set samples", "KEY=VALUE"]),
        (["--set", "samples=-1"], ["samples: -1 is below 1", "at least 1"]),
        (["--method", "alchemy"], ["alchemy: is not a method", "path_tracing"]),
        (["--seed", "-5"], ["seed: -5 is below 0"]),
        (["--threads", "0"], ["--threads: 0 is not possible", "1 to 256"]),
        (["--threads", "1000"], ["--threads: 1000 is not possible"]),
        (["--size", "480"], ["--size 480", "480x270"]),
        (["--target", "render", "--size", "99999999x5"], ["width: 99999999 is not possible", "Choose 1 to 65536"]),
        (["--resolution", "0"], ["resolution: 0 is not possible"]),
        (["--objects", "Nobody"], ["Nobody: does not exist", "Floor"]),
        (["--uv-layer", "Nothing"], ['has no UV layer "Nothing"', "leave it empty"]),
        (["--target", "statue"], ["invalid choice: 'statue'"]),
        (["missing.blend"], ["missing.blend: does not exist"]),
        (["/"], ["/: is a folder", "Name a .blend file"]),
    ],
)
def test_wrong_input_is_refused_with_object_reason_and_remedy(tmp_path, arguments, words):
    box()
    code, out, err = command("bake", "--output", tmp_path, *arguments)
    assert code == 2 and "Traceback" not in err
    for word in words:
        assert word in err, err
    assert list(tmp_path.iterdir()) == [] and not bpy.data.images


@needs_wheel
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with a name")
@pytest.mark.parametrize("name", ("pipe.blend", os.devnull))
def test_what_is_no_file_is_refused_at_once_and_called_what_it_is(name, tmp_path):
    """A pipe that nobody writes to would keep whoever opens it waiting for ever."""
    os.mkfifo(tmp_path / "pipe.blend")
    process = start("check", tmp_path / name)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "is a device, a pipe or a socket, not a file. Name a .blend file" in err, err


def test_results_that_would_be_lost_are_refused(tmp_path):
    box()
    for target, word in (("texture", "lost"), ("attribute", "only a .blend file holds"), ("render", "Give a folder")):
        code, _, err = command("bake", "--target", target)
        assert code == 2 and word in err
    stranger = tmp_path / "stranger.json"
    stranger.write_text("{}")
    code, _, err = command("bake", "--output", tmp_path, "--report", stranger)
    assert code == 2 and "not written by Adjoint GI" in err and stranger.read_text() == "{}"


def test_scene_that_is_no_blend(tmp_path):
    path = tmp_path / "text.blend"
    path.write_text("not a blend")
    code, _, err = command("bake", path, "--output", tmp_path / "out")
    assert code == 2 and "text.blend: cannot be opened" in err


@pytest.mark.parametrize("name", ["missing.blend", "garbage.blend", "cut.blend"])
def test_a_file_that_blender_could_not_open_is_refused_by_every_command(registered, blend, tmp_path, name):
    """Blender goes on with the scene that it has, and runs the command."""
    (tmp_path / "garbage.blend").write_text("hello")
    (tmp_path / "cut.blend").write_bytes(blend.read_bytes()[:30000])
    with pytest.raises(RuntimeError):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / name))
    out = tmp_path / "out"
    for arguments in (("bake", "--output", out), CHECK, ("compare", "--output", out)):
        code, _, err = command(*arguments)
        assert code == 2 and f"{tmp_path / name}: could not be opened" in err, err
    assert not out.exists()
    assert command(*CHECK, blend)[0] == 0, "a scene named after the command is opened"
    assert command(*CHECK)[0] == 0, "and is the open one then"


@pytest.mark.parametrize(
    ("words", "accepted"),
    [
        (["-b", "--command"], False),
        (["-b", "-c"], False),
        (["-b", "--python-exit-code", "1", "--command"], False),
        (["-b", "--python", "make.py", "--command"], True),
        (["-b", "--python-expr", "make()", "-c"], True),
    ],
)
def test_the_scene_of_the_start_is_refused_unless_a_script_may_have_built_it(tmp_path, monkeypatch, words, accepted):
    box()
    monkeypatch.setattr(sys, "argv", ["blender", *words, "adjoint_gi", "check", "--python"])
    code, _, err = command(*CHECK)
    assert code == (0 if accepted else 2) and ("no .blend file is open" in err) != accepted
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "box.blend"))
    assert command(*CHECK)[0] == 0


def test_handlers_come_and_go_with_the_extension():
    before = {name: len(getattr(bpy.app.handlers, name)) for name, _ in cli_open.HANDLERS}
    cli_open.register()
    cli_open.unregister()
    assert {name: len(getattr(bpy.app.handlers, name)) for name, _ in cli_open.HANDLERS} == before


def test_file_saved_in_edit_mode_is_baked(tmp_path):
    scene = box()
    bpy.context.view_layer.objects.active = scene.objects["Floor"]
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "edit.blend"))
    code, _, err = command(
        "bake", tmp_path / "edit.blend", "--resolution", 8, "--set", "samples=1", "--objects", "Floor", "--output", tmp_path / "out"
    )  # fmt: skip
    assert code == 0 and "info: Floor: was in edit mode" in err, err


def test_check_finds_without_baking(tmp_path):
    scene = box()
    code, out, _ = command(*CHECK, "--output", tmp_path)
    assert code == 0 and "0 errors" in out and "of memory" in out
    bpy.data.objects.remove(scene.objects["Lamp"])
    code, out, _ = command(*CHECK, "--output", tmp_path)
    assert code == 0 and "nothing emits light" in out and "1 warning\n" in out
    code, out, _ = command(*CHECK, "--target", "attribute", "--objects", "Camera")
    assert code == 2 and "error: Camera: is a camera, not a mesh" in out
    assert list(tmp_path.iterdir()) == []


def test_bake_prints_every_error_that_refuses_it(tmp_path):
    box()
    code, _, err = command("bake", "--output", tmp_path / "o", "--objects", "Nobody", "Camera")
    assert code == 2 and "error: Nobody: does not exist" in err and "error: Camera: is a camera, not a mesh" in err


SMALL = ("--resolution", 8, "--set", "samples=1", "--objects", "Floor", "Back Wall")


@pytest.mark.parametrize("arguments", [("--target", "texture"), ("--atlas", "--resolution", 64), ("--target", "render", "--size", "16x12")])
def test_files_that_are_not_ours_are_found_before_the_bake(tmp_path, monkeypatch, arguments):
    box()
    assert command("bake", *SMALL, *arguments, "--output", tmp_path)[0] == 0
    monkeypatch.setattr("adjgi.adjoint_gi.bridge.cli.bake.solve", None)
    layers = [(o.name, len(o.data.uv_layers)) for o in bpy.data.objects if o.type == "MESH"]
    for file in sorted(tmp_path.iterdir()):
        ours = file.read_bytes()
        file.write_text("mine")
        code, _, err = command("bake", *SMALL, *arguments, "--output", tmp_path)
        assert code == 2 and f"{file}: exists and was not written by Adjoint GI" in err, err
        code, out, _ = command("check", *SMALL, *arguments, "--output", tmp_path)
        assert code == 2 and f"error: {file}: exists" in out
        assert file.read_text() == "mine"
        file.write_bytes(ours)
    assert layers == [(o.name, len(o.data.uv_layers)) for o in bpy.data.objects if o.type == "MESH"]


@pytest.mark.parametrize(
    "error", [WriteError("disk", "is full", "Make room"), TargetError("it", "is not ours", "Move it"), ValueError("on purpose")]
)
def test_failed_write_is_exit_code_1_and_keeps_the_result(tmp_path, monkeypatch, error):
    box()

    def fail(*_, **__):
        raise error

    monkeypatch.setattr("adjgi.adjoint_gi.bridge.baking.textures.write_exr", fail)
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    code, out, err = command("bake", *SMALL, "--output", tmp_path / "out")
    assert code == 1 and f"error: {notice_of(error)}" in err and "wrote" not in out
    (file,) = tmp_path.glob("*.npz")
    assert f"Result: is kept in {file}" in err
    with np.load(file, allow_pickle=False) as found:
        assert (found["direct"] + found["indirect"]).max() > 0.01 and found["weight"].shape == (len(found["direct"]),)
    if isinstance(error, ValueError):
        assert "Traceback" in err, "what nobody thought of is to be reported"
        return
    # The scene holds the images, so it is saved where that was asked for.
    target = tmp_path / "baked.blend"
    code, out, _ = command("bake", *SMALL, "--output", tmp_path / "out", "--save-blend", target)
    assert code == 1 and f"wrote {target}" in out
    bpy.ops.wm.open_mainfile(filepath=str(target))
    assert len([i for i in bpy.data.images if "adjoint_gi_about" in i and i.packed_file]) == 2


def test_a_saved_scene_tells_what_could_not_be_written(registered, tmp_path, monkeypatch):
    """Of the bake, of the method, and of the files that failed, each once."""
    box()

    def fail(*_, **__):
        raise WriteError("disk", "is full", "Make room")

    monkeypatch.setattr("adjgi.adjoint_gi.bridge.baking.textures.write_exr", fail)
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    solver = type(registry.method("path_tracing"))
    solve = solver.solve

    def warns(self, *arguments):
        for step in solve(self, *arguments):
            yield dataclasses.replace(step, solution=lambda step=step: _warned(step.solution()))

    def _warned(solution):
        return dataclasses.replace(solution, warnings=(*solution.warnings, Notice("Lamp", "is dim", "Change it")))

    monkeypatch.setattr(solver, "solve", warns)
    target = tmp_path / "baked.blend"
    assert command("bake", *SMALL, "--output", tmp_path / "out", "--save-blend", target)[0] == 1
    bpy.ops.wm.open_mainfile(filepath=str(target))
    told = [str(n.notice()) for n in bpy.context.scene.adjoint_gi.result.notices]
    assert len([t for t in told if "disk: is full" in t]) == 1 and len([t for t in told if "Lamp: is dim" in t]) == 1, told


def test_failing_solver_writes_its_partial_result_and_is_exit_code_1(tmp_path, monkeypatch):
    box()
    solver = type(registry.method("path_tracing"))
    solve = solver.solve

    def fail(self, *arguments):
        for k, step in enumerate(solve(self, *arguments)):
            yield step
            if k == 1:
                raise FloatingPointError("on purpose")

    monkeypatch.setattr(solver, "solve", fail)
    arguments = ("--resolution", 32, "--set", "samples=4096", "--objects", "Floor", "--output", tmp_path)
    code, out, err = command("bake", *arguments, "--report", tmp_path / "r.json")
    assert code == 1 and "FloatingPointError: on purpose" in err and "partial result" in out
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["state"] == "failed" and report["partial"] and all("partial" in Path(f).name for f in report["files"])


def test_registered_command_in_blender(registered):
    assert cli._handle is not None
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert cli._command(["methods", "--json"]) == 0
    assert json.loads(out.getvalue())


def test_progress_on_a_terminal_is_one_line_with_a_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    class Half:
        fraction, text, seconds, seconds_left = 0.5, "8 of 16 samples", 61.0, 4.2

    stream = Terminal()
    progress = cli_progress.Progress("Path Tracing", stream)
    progress(Half())
    progress.end()
    text = stream.getvalue()
    assert "[############            ] Path Tracing:  50 %, 8 of 16 samples, 1:01 min, 4.2 s left" in text
    assert "\n" not in text and text.endswith("\r")


def test_demo_makes_every_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(cli_demo, "QUICK", {("path_tracing", t): {"samples": "2"} for t in ("render", "texture")})
    code, out, err = command("demo", "--output", tmp_path, "--size", 32)
    assert code == 0, err
    pictures = len(DEMO_METHODS)
    assert len(list(tmp_path.glob("Cornell_Box*.png"))) == pictures + 1
    assert len(list(tmp_path.glob("*.exr"))) == pictures + 3 and (tmp_path / "cornell.blend").is_file()
    report = json.loads((tmp_path / "report.json").read_text())
    assert len(report["bakes"]) == pictures + 2 and not any(b["partial"] for b in report["bakes"])
    named = [line.split()[0] for line in out.splitlines() if line.startswith("  ")]
    assert len(named) >= 8 and all(Path(p).is_file() for p in named)
    (vertex,) = tmp_path.glob("vertex_colors*.exr")
    assert read_exr(vertex)[0][""].mean() > 0.1
    assert command("demo", "--output", tmp_path, "--size", 8)[0] == 2
    assert command("demo", "--output", tmp_path, "--methods", "alchemy")[0] == 2


def test_demo_shows_each_quadrant_of_the_taxonomy():
    specs = [registry.method(m).spec for m in DEMO_METHODS]
    assert len({(s.strategies, s.natures) for s in specs}) == 4


@needs_wheel
def test_console_command_bakes_a_file(blend, tmp_path):
    process = start("bake", blend, "--resolution", 16, "--set", "samples=2", "--objects", "Floor", "--output", tmp_path / "out")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert len(list((tmp_path / "out").iterdir())) == 3 and "finished: path_tracing to texture" in out


@needs_wheel
def test_console_command_knows_the_densities_of_a_file_and_notes_its_result(registered, blend, tmp_path):
    """No extension is enabled there."""
    bpy.data.objects["Floor"].adjoint_gi_density = 3.0
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    target, report = tmp_path / "baked.blend", tmp_path / "report.json"
    words = ("--atlas", "--resolution", 64, "--texels-per-metre", 4, "--set", "samples=1", "--objects", "Floor", "Ceiling")
    process = start("bake", blend, *words, "--save-blend", target, "--report", report)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    given = {g["object"]: g["texels_per_metre"] for g in json.loads(report.read_text())["lightmaps"]}
    assert given["Floor"] > 2.0 * given["Ceiling"]
    bpy.ops.wm.open_mainfile(filepath=str(target))
    assert bpy.context.scene.adjoint_gi.result.method == "path_tracing"


@needs_wheel
def test_console_without_arguments_or_scene():
    for arguments, word in (((), "COMMAND"), (("bake",), "scene")):
        process = start(*arguments)
        _, err = process.communicate(timeout=120)
        assert process.returncode == 2 and word in err


@needs_wheel
@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to a single process")
def test_interrupt_writes_the_partial_result_and_ends_with_130(blend, tmp_path):
    out, report = tmp_path / "out", tmp_path / "report.json"
    process = start(
        "bake", blend, "--resolution", 64, "--set", "samples=100000", "--objects", "Floor", "--output", out, "--report", report,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    for line in process.stderr:
        if line.startswith("Path Tracing:"):
            break
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    text, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "partial result" in text
    found = json.loads(report.read_text())
    assert found["partial"] and found["state"] == "stopped" and 0 < found["fraction"] < 1
    assert len(found["files"]) == 3 and all("partial" in Path(f).name and Path(f).is_file() for f in found["files"])
