# SPDX-License-Identifier: GPL-3.0-or-later
"""Work is never lost: full disks, targets that change during a bake, signals, and what killed processes leave behind."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys

import bpy
import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.cli import bake as cli_bake
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.cli import open as cli_open
from adjgi.adjoint_gi.bridge.host.meshes import corner_vertices
from adjgi.adjoint_gi.bridge.results import kept
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute, result_object
from adjgi.adjoint_gi.core.base.atomic import remove_leftovers, temporary_suffix
from adjgi.adjoint_gi.core.base.errors import TargetError, WriteError
from adjgi.adjoint_gi.core.base.process import is_alive, this_machine
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.baking import request
from adjgi.tests.blender.fakes import square

solvers.load()
STOPS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
posix = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signals")


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def lit():
    """A square below a bright background."""
    obj = square()
    world = bpy.data.worlds.new("Lit")
    bpy.context.scene.world = world
    world.color = (1.0, 1.0, 1.0)
    return obj


def corners(obj):
    name = linked_attribute(obj, "irradiance")
    out = np.empty(4 * len(obj.data.attributes[name].data), np.float32)
    obj.data.attributes[name].data.foreach_get("color", out)
    return out


def baked(lit):
    made = Bake(bpy.context, request(target="attribute", values={"samples": 4}, objects=(lit.name,)))
    made.driver.run()
    return made


def linked_duplicate(obj):
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Duplicate", obj.data))


def subdivision(obj):
    obj.modifiers.new("Subdivision", "SUBSURF").levels = 1


@pytest.mark.parametrize("change", [linked_duplicate, subdivision])
def test_a_target_that_cannot_hold_its_attribute_any_more_gets_it_on_an_object_of_its_own(lit, change):
    made = baked(lit)
    made.write(made.driver.solution())
    expected = corners(lit)
    change(lit)
    lit.data.attributes.remove(lit.data.attributes[linked_attribute(lit, "irradiance")])
    made.write(made.driver.solution())
    own = result_object(lit)
    np.testing.assert_array_equal(corners(own), expected)
    assert linked_attribute(lit, "irradiance") is None and own.data != lit.data
    assert any(f'the result is on the object "{own.name}"' in str(n) for n in made.notices)


def mask(obj):
    obj.modifiers.new("Mask", "MASK")


def more_copies(obj):
    obj.modifiers["Array"].count = 5


def no_modifier(obj):
    obj.modifiers.clear()


def other_mesh(obj):
    subdivision(obj)
    obj.data.clear_geometry()


@pytest.mark.parametrize("domain", ["POINT", "CORNER"])
@pytest.mark.parametrize("change", [subdivision, mask, more_copies, no_modifier, other_mesh, None])
def test_values_that_fit_no_mesh_any_more_get_the_one_that_was_baked(lit, change, domain):
    """Of quads, mirrored, with three materials: every value at its place, material and shading of its face."""
    for name in ("First", "Second"):
        lit.data.materials.append(bpy.data.materials.new(name))
    array = lit.modifiers.new("Array", "ARRAY")
    array.relative_offset_displace, array.fit_type = (1.5, 0, 0), "FIXED_COUNT"
    lit.scale, lit.location = (-2, 1, 1), (1, 2, 3)
    lit.data.polygons[0].material_index, lit.data.polygons[0].use_smooth = 1, True
    bpy.context.view_layer.update()
    ask = request(target="attribute", values={"samples": 4}, domain=domain, objects=(lit.name,))
    made = Bake(bpy.context, ask)
    made.driver.run()
    shape = lit.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    expected = [lit.matrix_world @ shape.vertices[k].co for k in corner_vertices(shape)], [list(p.vertices) for p in shape.polygons]
    lit.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh_clear()
    if change is not None:
        change(lit)
        bpy.context.view_layer.update()
    made.driver.state, state = "running", made.driver.state
    if change is not None:
        with pytest.raises(TargetError):  # what is shown meanwhile waits for the end
            made.write(made.driver.solution())
    made.driver.state = state
    made.write(made.driver.solution())
    own = result_object(lit)
    mesh = own.data
    bpy.context.view_layer.update()
    np.testing.assert_allclose([own.matrix_world @ mesh.vertices[k].co for k in corner_vertices(mesh)], expected[0], atol=1e-5)
    assert [list(p.vertices) for p in mesh.polygons] == expected[1]
    assert {p.material_index for p in mesh.polygons} == {1} and all(p.use_smooth for p in mesh.polygons)
    assert [s.material.name for s in own.material_slots] == ["Square", "First", "Second"]
    index = next(iter(made.writer.vertices.index))
    values = made.driver.solution().quantity("irradiance")
    np.testing.assert_array_equal(corners(own).reshape(-1, 4)[:, :3], made.writer.vertices.spread(index, values))
    told = [n for n in made.notices if f'the result is on the object "{own.name}"' in n.reason]
    assert len(told) == (change is not None) and all(n.remedy for n in told)
    before = mesh
    made.write(made.driver.solution())
    assert result_object(lit).data == before or change is None, "a continued bake goes on there"


def test_a_kept_result_on_a_full_disk_is_an_error_with_a_remedy(lit, monkeypatch, tmp_path):
    made = baked(lit)
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    monkeypatch.setattr(kept.np, "savez_compressed", full)
    with pytest.raises(WriteError, match="disk is full"):
        kept.save(made.driver.solution())
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    monkeypatch.setattr(kept.bpy.utils, "extension_path_user", full)
    with pytest.raises(WriteError, match="No space left"):
        kept.save(made.driver.solution())


def test_a_kept_result_reads_back(lit, tmp_path, monkeypatch):
    made = baked(lit)
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    solution = dataclasses.replace(made.driver.solution(), partial=True)
    with np.load(kept.save(solution), allow_pickle=False) as found:
        for name in kept.ARRAYS:
            np.testing.assert_array_equal(found[name], getattr(solution, name))
        about = json.loads(str(found["about"]))
    assert about == {name: getattr(solution, name) for name in about} and len(about) == 6 and about["settings"]["samples"] > 0


def test_a_kept_picture_has_its_normals_and_depths(lit, tmp_path, monkeypatch):
    solution = baked(lit).driver.solution()
    more = {"normal": np.ones((2, 3), np.float32), "light_names": np.array(["Lamp"], np.str_)}
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    with np.load(kept.save(dataclasses.replace(solution, extra=more)), allow_pickle=False) as found:
        assert set(found) == {"about", *kept.ARRAYS, *more}
        assert all(np.array_equal(found[name], value) for name, value in more.items())


@posix
@pytest.mark.parametrize("number", STOPS)
def test_every_signal_writes_the_partial_result(lit, tmp_path, monkeypatch, number):
    solver = type(registry.method("path_tracing"))
    solve = solver.solve

    def signalled(self, *arguments):
        for k, step in enumerate(solve(self, *arguments)):
            if k == 1:
                os.kill(os.getpid(), number)
            yield step

    monkeypatch.setattr(solver, "solve", signalled)
    before = [signal.getsignal(n) for n in STOPS]
    arguments = ["--resolution", "8", "--set", "samples=100000", "--output", str(tmp_path), "--report", str(tmp_path / "r.json")]
    assert cli.main(["bake", *arguments], in_blender=True) == 130
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["state"] == "stopped" and len(found["files"]) == 3 and all("partial" in f for f in found["files"])
    assert [signal.getsignal(n) for n in STOPS] == before


@posix
@pytest.mark.parametrize("number", STOPS)
def test_signals_do_not_tear_what_is_being_written(lit, tmp_path, monkeypatch, number):
    write = cli_bake.write

    def signalled(*arguments):
        os.kill(os.getpid(), number)
        return write(*arguments)

    monkeypatch.setattr(cli_bake, "write", signalled)
    arguments = ["--resolution", "8", "--set", "samples=1", "--output", str(tmp_path), "--report", str(tmp_path / "r.json")]
    assert cli.main(["bake", *arguments], in_blender=True) == 0
    assert len(json.loads((tmp_path / "r.json").read_text())["files"]) == 3


@posix
@pytest.mark.parametrize("number", STOPS)
def test_signals_before_the_solve_are_an_interruption(lit, tmp_path, monkeypatch, number):
    monkeypatch.setattr(cli_bake, "open_scene", lambda _: os.kill(os.getpid(), number))
    assert cli.main(["bake", "--output", str(tmp_path)], in_blender=True) == 130


@posix
def test_what_is_told_to_ignore_a_hangup_goes_on(lit, tmp_path, monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        monkeypatch.setattr(cli_bake, "open_scene", lambda options: (os.kill(os.getpid(), signal.SIGHUP), cli_open.open_scene(options)))
        assert cli.main(["bake", "--resolution", "8", "--set", "samples=1", "--output", str(tmp_path)], in_blender=True) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def dead():
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_leftovers_of_killed_processes_go_and_nothing_else(tmp_path):
    gone, other = dead(), "0" * 8
    names = {
        f".a.{this_machine()}-{gone}-0123456789ab.tmp": False,
        f"adjoint_gi_x.{this_machine()}-{gone}-0123456789ab.tmp": False,
        f".b.{temporary_suffix()}": True,  # this process runs
        f".c.{other}-{gone}-0123456789ab.tmp": True,  # of another machine, on a shared folder
        f".d.{this_machine()}-{gone}-0123456789ab.tmp.exr": True,
        "e.tmp": True,
    }
    for name in names:
        (tmp_path / name).write_text("x")
    folder = tmp_path / f"f.{this_machine()}-{gone}-0123456789ab.tmp"
    folder.mkdir()
    (folder / "copy.blend").write_text("x")
    remove_leftovers(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {name for name, stays in names.items() if stays}
    remove_leftovers(tmp_path / "nowhere")
    assert is_alive(os.getpid()) and not is_alive(gone)


def test_a_bake_removes_what_a_killed_one_left(lit, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(kept.tempfile, "tempdir", str(temporary))
    out = tmp_path / "out"
    out.mkdir()
    end = f"{this_machine()}-{dead()}-0123456789ab.tmp"
    (temporary / f"adjoint_gi_x.{end}").mkdir()
    (out / f".a.{end}").write_text("x")
    arguments = ["--resolution", "8", "--set", "samples=1", "--output", str(out), "--save-blend", str(tmp_path / "a.blend")]
    assert cli.main(["bake", *arguments], in_blender=True) == 0
    assert list(temporary.iterdir()) == [] and len(list(out.iterdir())) == 3 and not any(p.name.startswith(".") for p in out.iterdir())
