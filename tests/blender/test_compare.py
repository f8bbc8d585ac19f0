# SPDX-License-Identifier: GPL-3.0-or-later
"""Comparing from the command line and the panel: the files, the record on the scene, the Cycles reference, stopping."""

from __future__ import annotations

import contextlib
import io
import json
import re
import threading
import time
import types

import bpy
import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.cli import compare as cli_compare
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.cli import main as cli
from adjgi.adjoint_gi.bridge.comparison import cycles_reference
from adjgi.adjoint_gi.bridge.comparison import job as compare_job
from adjgi.adjoint_gi.bridge.comparison import records as compare_records
from adjgi.adjoint_gi.bridge.comparison import request as compare
from adjgi.adjoint_gi.bridge.comparison.job import COMPARISONS
from adjgi.adjoint_gi.bridge.comparison.request import Compare, CompareRequest, ReferenceChoice
from adjgi.adjoint_gi.bridge.host import background
from adjgi.adjoint_gi.bridge.props.request import BakeRequest
from adjgi.adjoint_gi.bridge.results import kept
from adjgi.adjoint_gi.core.base.errors import AdjointError, Notice, SettingsError
from adjgi.adjoint_gi.core.comparison.budget import Budget
from adjgi.adjoint_gi.core.method import registry
from adjgi.panels import compare as panel
from adjgi.tests import baking
from adjgi.tests.blender import test_panel, test_preparation
from adjgi.tests.blender.fakes import square

solvers.load()
METHODS = "path_tracing,local_illumination"
SMALL = ("--budget", "time=0.3", "--reference", "path_tracing:0.6", "--resolution", "8", "--repeats", "2")
LIMIT = 30.0  # seconds that any wait in these tests may take


class ButtonLayout(test_panel.Layout):
    """As that one, with operators whose properties can be set."""

    def _inner(self, **_):
        return ButtonLayout(self.drawn)

    row = column = box = split = _inner

    def operator(self, name, text=None, icon="NONE"):
        super().operator(name, text, icon)
        return types.SimpleNamespace()


def command(*arguments):
    """Run in this process; returns (exit code, standard output, standard error)."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(["compare", *(str(a) for a in arguments)], in_blender=True)
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def box():
    """The Cornell box as the only scene."""
    scene = demo.build_cornell(size=(32, 24))
    old = bpy.context.scene
    bpy.context.window_manager.windows[0].scene = scene
    bpy.data.scenes.remove(old)
    return scene


@pytest.fixture
def state(registered, box):
    found = box.adjoint_gi_compare
    for spec in compare_records.compared():
        setattr(found, compare_records.switch(spec.id), spec.id in METHODS.split(","))
    found.seconds, found.reference_seconds, found.resolution = 0.2, 0.4, 8
    yield found
    COMPARISONS.forget()
    assert not [t for t in threading.enumerate() if t.name == "adjoint_gi_driver"]


def ticks(until):
    end = time.monotonic() + LIMIT
    while not until():
        assert time.monotonic() < end, "it never came to that"
        background.tick()
        time.sleep(0.02)


# ---- command line


def test_the_command_writes_a_page_that_needs_nothing_else(box, tmp_path):
    code, out, err = command("--methods", METHODS, *SMALL, "--output", tmp_path)
    assert code == 0, err
    assert {p.name for p in tmp_path.iterdir()} == {
        "index.html",
        "compare.json",
        "side_by_side.png",
        "differences.png",
        "error_over_time.png",
        "histogram.png",
    }
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == 4
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|@import|url\(|https?:""", text)
    data = json.loads((tmp_path / "compare.json").read_text(encoding="utf-8"))
    assert [m["method"] for m in data["methods"]] == ["path_tracing", "local_illumination"] == METHODS.split(",")
    assert data["winner"] == "path_tracing" and "Path Tracing has the least error" in out
    for m in data["methods"]:
        assert m["error"] > 0 and m["seconds"] > 0 and m["rays"] > 0 and m["curve"]
        assert f"{m['rays']:,}" in text
    assert abs(data["methods"][0]["duality_gap"]) < 0.1 and data["methods"][1]["duality_gap"] < -0.3
    assert "Local Illumination leaves out interreflection" in text and data["agreement"]["agrees"]
    # Again into the same folder: what is ours is replaced.
    assert command("--methods", "local_illumination", *SMALL, "--output", tmp_path)[0] == 0
    assert "Path Tracing</td>" not in (tmp_path / "index.html").read_text(encoding="utf-8")


def test_what_is_not_ours_is_not_replaced_and_found_before_the_run(box, tmp_path, monkeypatch):
    assert command("--methods", "local_illumination", *SMALL, "--output", tmp_path)[0] == 0
    monkeypatch.setattr(cli_compare, "Compare", None)
    assert len(list(tmp_path.iterdir())) == 6
    for file in tmp_path.iterdir():
        ours = file.read_bytes()
        file.write_text("my home page", encoding="utf-8")
        code, _, err = command("--methods", "local_illumination", *SMALL, "--output", tmp_path)
        assert code == 2 and f"{file}: exists and was not written by Adjoint GI" in err
        assert file.read_text(encoding="utf-8") == "my home page"
        file.write_bytes(ours)


def test_a_result_that_cannot_be_written_is_kept(box, tmp_path, monkeypatch):
    """The folder was free when it was looked at."""
    out, safe = tmp_path / "out", tmp_path / "kept"
    safe.mkdir()
    monkeypatch.setattr(kept, "folder", lambda: safe)
    check = cli_compare.check_files

    def meddle(request, folder):
        check(request, folder)
        (folder / "compare.json").write_text("{}", encoding="utf-8")

    monkeypatch.setattr(cli_compare, "check_files", meddle)
    code, text, err = command("--methods", "local_illumination", *SMALL, "--output", out)
    (folder,) = safe.iterdir()
    assert code == 1 and "compare.json: exists and was not written" in err and f"Result: is kept in {folder}" in err
    assert len(list(folder.iterdir())) == 6 and f"wrote {folder / 'index.html'}" in text and "Local Illumination" in text
    assert (out / "compare.json").read_text(encoding="utf-8") == "{}"


def test_an_interrupted_run_says_that_it_is_partial(box, tmp_path, monkeypatch):
    progress = cli_compare.Progress.__call__

    def interrupt(self, driver):
        progress(self, driver)
        if driver.solution() is not None and driver.solution().entries:
            raise KeyboardInterrupt

    monkeypatch.setattr(cli_compare.Progress, "__call__", interrupt)
    code, out, _ = command("--methods", METHODS, *SMALL, "--budget", "time=1.5", "--output", tmp_path)
    assert code == 130 and "stopped before its end" in out.splitlines()[-1] and "partial" in out.splitlines()[-1]
    assert json.loads((tmp_path / "compare.json").read_text(encoding="utf-8"))["partial"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--methods", "magic"), "magic: is not a method"),
        (("--methods", ","), "names none"),
        (("--budget", "luck=3"), "'luck' is not possible"),
        (("--budget", "30"), "cannot read"),
        (("--reference", "cycles:many"), "cannot read"),
        (("--reference", "constant=1,2"), "cannot read"),
        (("--reference", "constant=0"), "a relative error needs a mean above 0"),
        (("--reference", "cycles:0"), "0 samples are not possible. Give Cycles 2 to 1,048,576 samples"),
        (("--reference", "cycles:-5"), "-5 samples are not possible"),
        (("--reference", "cycles:99999999999"), "99999999999 samples are not possible"),
        (("--reference", "path_tracing:0"), "0 seconds are not possible"),
        (("--reference", "path_tracing:-3"), "-3 seconds are not possible"),
        (("--reference", "path_tracing:nan"), "nan seconds are not possible"),
        (("--budget", "error=0.02", "--reference", "none"), "an error needs a reference"),
        (("--set", "seed=1"), "not of the form METHOD.KEY=VALUE"),
        (("--set", "path_tracing.magic=1"), "is not a setting"),
        (("--receivers", "camera", "--reference", "cycles"), "Cycles bakes texels"),
        (("--objects", "Nobody"), "does not exist"),
    ],
)
def test_wrong_input_is_refused_with_exit_code_2(box, tmp_path, arguments, said):
    code, _, err = command(*SMALL, *arguments, "--output", tmp_path)
    assert code == 2 and said in err
    assert not list(tmp_path.iterdir())


def test_all_methods_that_fit_take_part_and_the_others_are_listed(box, tmp_path):
    options = ("--set", "matrix_radiosity.memory_limit=1", "--objects", "Floor", "--receivers", "texture")
    code, out, err = command("--methods", "all", *SMALL, *options, "--repeats", "0", "--budget", "time=0.1", "--output", tmp_path)
    assert code == 0, err
    data = json.loads((tmp_path / "compare.json").read_text(encoding="utf-8"))
    took, refused = {m["method"] for m in data["methods"]}, {n["object"]: n["reason"] for n in data["refused"]}
    assert "over its limit of 1 MB" in refused["Full-Matrix Radiosity"] and "not compared: Full-Matrix Radiosity" in out
    labels = {m.spec.label for m in registry.methods() if m.spec.id not in took}
    assert labels == set(refused)
    assert took == {m.spec.id for m in registry.methods() if m.spec.answers == "light"} - {"matrix_radiosity"}


def test_the_camera_is_compared_too(box, tmp_path):
    code, _, err = command("--methods", METHODS, *SMALL, "--receivers", "camera", "--resolution", "24", "--output", tmp_path)
    assert code == 0, err
    data = json.loads((tmp_path / "compare.json").read_text(encoding="utf-8"))
    assert data["agreement"]["shot"] is None and data["scene"]["Receivers"] == "432 camera"
    assert data["methods"][0]["error"] < data["methods"][1]["error"]


def test_a_closed_form_is_a_reference(registered):
    """A plane under a sky of radiance 1 has irradiance pi."""
    square()
    bpy.context.scene.world = bpy.data.worlds.new("Sky")
    demo.black_world(bpy.context.scene.world, (1, 1, 1))
    request = CompareRequest(("path_tracing",), Budget("time", 0.2), ReferenceChoice.parse("constant=3.14159265"), repeats=0, resolution=8)
    result = Compare(bpy.context, request).driver.run()
    assert result.reference.noise == 0.0 and "closed form" in result.reference.label
    assert result.entries[0].error < 0.02


# ---- Cycles


def test_a_cycles_bake_is_a_reference_and_leaves_the_scene_as_it_was(registered, box, monkeypatch):
    floor = bpy.data.objects["Floor"]
    cell = bpy.data.objects["Left Wall"]
    for obj in (floor, cell):
        obj.select_set(obj is cell)
    bpy.context.view_layer.objects.active = cell
    box.render.engine = "BLENDER_EEVEE_NEXT" if "BLENDER_EEVEE_NEXT" in _engines(box) else "BLENDER_EEVEE"
    box.cycles.max_bounces = 3
    box.cycles.blur_glossy, box.cycles.sample_clamp_indirect = 0.7, 10.0
    during, bake = set(), cycles_reference._bake
    seen = ("blur_glossy", "sample_clamp_indirect", "light_sampling_threshold")
    monkeypatch.setattr(cycles_reference, "_bake", lambda *a: (during.update(getattr(box.cycles, k) for k in seen), bake(*a))[1])
    tree = floor.data.materials[0].node_tree
    tree.nodes.active = tree.nodes[0]
    for node in tree.nodes:
        node.select = node is tree.nodes[1]

    def everything():
        cycles = {p.identifier: repr(getattr(box.cycles, p.identifier)) for p in box.cycles.bl_rna.properties}
        cycles |= {f"{k} set": box.cycles.is_property_set(k) for k in ("samples", "max_bounces", "device")}
        nodes = {
            m.name: (getattr(m.node_tree.nodes.active, "name", None), [n.name for n in m.node_tree.nodes if n.select])
            for m in bpy.data.materials
        }
        return baking.fingerprint(), cycles, nodes, box.render.engine, len(bpy.data.images)

    options = {"objects": ("Floor", "Back Wall"), "resolution": 16, "repeats": 0}
    made = Compare(bpy.context, CompareRequest(("path_tracing",), Budget("time", 0.1), ReferenceChoice("none"), **options))
    before = everything()  # the lightmap UV layers are there already
    request = CompareRequest(("path_tracing", "local_illumination"), Budget("time", 2.0), ReferenceChoice.parse("cycles:128"), **options)
    made = Compare(bpy.context, request)
    assert everything() == before
    assert during == {0.0}, "what loses light in Cycles is off while it bakes"
    result = made.driver.run()
    r, path = result.reference, result.entries[0]
    assert r.valid.mean() > 0.8 and 0.005 < r.noise < 0.2
    # The same mean within noise: that of a texel over the root of their number, and the light's edge by a part of a texel.
    assert abs(path.bias) < 0.02
    assert path.error < 0.3 < result.entries[1].error


def _engines(scene):
    return {item.identifier for item in scene.render.bl_rna.properties["engine"].enum_items}


def test_what_cycles_cannot_bake_gets_no_reference_and_is_named(registered, box):
    bpy.data.objects["Floor"].data.materials.clear()
    options = {"objects": ("Floor", "Back Wall"), "resolution": 8, "repeats": 0}
    before = test_preparation.layers()
    with pytest.raises(AdjointError, match="no texel that can be compared"):
        Compare(
            bpy.context,
            CompareRequest(
                ("local_illumination",), Budget(), ReferenceChoice.parse("cycles:4"), objects=("Floor",), resolution=8, repeats=0
            ),
        )
    assert test_preparation.layers() == before, "what was made for it is taken back"
    made = Compare(bpy.context, CompareRequest(("local_illumination",), Budget("time", 0.1), ReferenceChoice.parse("cycles:4"), **options))
    assert any(n.object == "Floor" and "no material" in n.reason for n in made.notices)
    assert box.render.engine != "CYCLES" or box.render.engine == "CYCLES" and not [i for i in bpy.data.images if "Cycles" in i.name]


# ---- panel and job


def test_there_is_a_switch_for_every_method_that_answers_light(state):
    for m in registry.methods():
        name = compare_records.switch(m.spec.id)
        assert (name in state.bl_rna.properties) == (m.spec.answers == "light")
    layout = ButtonLayout()
    panel.choice(layout, bpy.context)
    for spec in compare_records.compared():
        assert compare_records.switch(spec.id) in layout.names("prop")


@pytest.mark.parametrize(
    ("values", "there", "missing"),
    [
        ({"budget": "time"}, {"seconds", "selection_only"}, {"mega_rays", "error", "limit"}),
        ({"budget": "rays"}, {"mega_rays", "limit"}, {"seconds", "error"}),
        ({"budget": "error", "receivers": "camera"}, {"error", "limit"}, {"seconds", "selection_only"}),
        ({"reference": "cycles"}, {"cycles_samples"}, {"reference_method", "constant"}),
        ({"reference": "constant"}, {"constant"}, {"reference_method", "cycles_samples"}),
    ],
)
def test_the_panel_shows_what_is_used(state, values, there, missing):
    for name, value in values.items():
        setattr(state, name, value)
    layout = ButtonLayout()
    panel.choice(layout, bpy.context)
    props = set(layout.names("prop"))
    assert there <= props and not missing & props


def test_the_panel_asks_for_what_it_shows(state):
    state.budget, state.mega_rays, state.limit = "rays", 2.5, 7.0
    state.reference, state.constant = "constant", (1, 2, 3)
    request = compare_records.request_of(bpy.context.scene, bpy.context.view_layer)
    assert request.methods == tuple(m.spec.id for m in registry.methods() if m.spec.id in METHODS)
    assert (request.budget.kind, request.budget.value, request.budget.limit) == ("rays", 2.5e6, 7.0)
    assert (request.reference.kind, request.reference.value, request.resolution) == ("constant", (1, 2, 3), 8)
    for spec in compare_records.compared():
        setattr(state, compare_records.switch(spec.id), False)
    with pytest.raises(SettingsError, match="none is ticked"):
        compare_records.request_of(bpy.context.scene, bpy.context.view_layer)


def test_a_run_fills_table_and_pictures_and_finds_them_again(state, tmp_path):
    state.folder = str(tmp_path)
    assert bpy.ops.adjoint_gi.compare() == {"FINISHED"}
    r = state.result
    assert [row.method for row in r.rows] == ["path_tracing", "local_illumination"]
    assert [row.best for row in r.rows] == [True, False] and r.rows[0].has_gap and not r.partial
    assert "Path Tracing" in r.headline and r.files.splitlines()[0].endswith("index.html")
    images = {p.name: p.image for p in r.pictures}
    assert set(images) == {"side by side", "differences", "error over time", "histogram"}
    # What the image holds is what the file shows.
    image = images["error over time"]
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    assert tuple(image.size) == (900, 500) and pixels.min() < 0.4 and pixels.mean() > 0.8
    layout = ButtonLayout()
    panel.result(layout, bpy.context)
    assert layout.names("operator").count("adjoint_gi.show_comparison") == 4
    for word in ("Path Tracing", "rays", "gap", "leaves out interreflection"):
        assert word in layout.words
    # Found by link, whatever they are called.
    image.name = "Mine now"
    count = len(bpy.data.images)
    assert bpy.ops.adjoint_gi.compare() == {"FINISHED"}
    assert len(bpy.data.images) == count
    assert state.result.pictures["error over time"].image.name == "Mine now"
    # They survive a file.
    path = tmp_path / "kept.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    again = bpy.context.scene.adjoint_gi_compare.result
    assert len(again.rows) == 2 and again.pictures["error over time"].image.packed_file is not None
    assert bpy.ops.adjoint_gi.clear_comparison() == {"FINISHED"}
    assert not again.rows and not [i for i in bpy.data.images if i.name == "Mine now"]


def test_an_error_without_a_reference_is_refused_in_the_panel(state):
    state.budget, state.reference = "error", "none"
    with pytest.raises(SettingsError, match="an error needs a reference"):
        start(state)
    assert bpy.ops.adjoint_gi.compare() == {"CANCELLED"}


def test_a_foreign_file_is_refused_before_the_run_and_never_costs_the_result(state, tmp_path, monkeypatch):
    (tmp_path / "histogram.png").write_text("mine", encoding="utf-8")
    with pytest.raises(AdjointError, match="was not written by Adjoint GI"):
        start(state, folder=str(tmp_path))
    assert COMPARISONS.job is None
    monkeypatch.setattr(compare_job, "check_files", lambda *_: None)
    job = start(state, 0.2, str(tmp_path))
    ticks(lambda: not job.active)
    assert "was not written by Adjoint GI" in job.notices[0].reason and len(job.notices) == 1
    assert len(state.result.rows) == 2 and len(state.result.pictures) == 4


def start(state, seconds=20.0, folder=""):
    state.seconds, state.folder = seconds, folder
    return COMPARISONS.start(bpy.context, compare_records.request_of(bpy.context.scene, bpy.context.view_layer))


def test_in_the_background_it_can_be_stopped_and_keeps_what_it_has(state):
    state.reference = "none"
    job = start(state, 1.0)
    assert not bpy.ops.adjoint_gi.compare.poll() and not bpy.ops.adjoint_gi.bake.poll()
    layout = ButtonLayout()
    panel.run(layout, bpy.context)
    assert layout.names("operator") == ["adjoint_gi.stop_comparing"] and layout.names("progress")
    ticks(lambda: "Path Tracing" in job.driver.text and job.driver.solution() and job.driver.solution().entries)
    assert bpy.ops.adjoint_gi.stop_comparing() == {"FINISHED"}
    ticks(lambda: not job.active)
    assert job.state == "stopped" and state.result.partial
    assert [row.method for row in state.result.rows][:1]
    assert bpy.ops.adjoint_gi.compare.poll()


def test_it_is_prepared_in_slices_and_a_stop_meanwhile_changes_nothing(state, monkeypatch):
    gate = test_preparation.Gate(monkeypatch)
    before = test_preparation.layers()
    job = start(state, 0.2)
    ticks(lambda: job.driver.text == "Unwrapping" and gate.threads)
    assert job.preparing and gate.threads[0] is not threading.main_thread()
    layout = ButtonLayout()
    panel.run(layout, bpy.context)
    assert "Unwrapping" in layout.words and layout.names("operator") == ["adjoint_gi.stop_comparing"]
    COMPARISONS.stop()
    assert job.state == "stopped" and test_preparation.layers() == before and not state.result.rows
    gate.open.set()
    job = start(state, 0.2)
    ticks(lambda: not job.active)
    assert job.state == "finished" and len(state.result.rows) == 2


def test_a_second_run_is_refused(state):
    start(state)
    with pytest.raises(AdjointError, match="is running"):
        start(state)
    with pytest.raises(AdjointError, match="a comparison is running"):
        BAKES.start(bpy.context, BakeRequest("path_tracing", registry.method("path_tracing").Settings()))
    assert not BAKES.running and BAKES.job is None


def test_loading_a_file_ends_it(state):
    job = start(state)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert job.state == "cancelled" and COMPARISONS.job is None


def test_the_folder_is_passed_on_as_it_was_typed(state, monkeypatch):
    """With the path already made absolute the file that is not saved could not be named as the reason."""
    said = []

    def run(context, request, progress):
        said.append(request.output)
        return compare_job.CompareJob(context, request)

    monkeypatch.setattr(COMPARISONS, "run", run)
    state.folder = "//out"
    assert bpy.ops.adjoint_gi.compare() == {"CANCELLED"}
    assert said == ["//out"]
    with pytest.raises(AdjointError, match='"//out" is relative to the .blend file, which is not saved yet'):
        COMPARISONS.start(bpy.context, compare_records.request_of(bpy.context.scene, bpy.context.view_layer))


def test_a_run_of_another_scene_says_so(state, monkeypatch):
    other = bpy.data.scenes.new("Attic")
    driver = types.SimpleNamespace(fraction=0.5, seconds_left=None, text="Path Tracing")
    notices = [Notice("Cube", "is odd", "", "error")]
    job = types.SimpleNamespace(state="running", active=True, driver=driver, notices=notices, scene=other.session_uid)
    monkeypatch.setattr(COMPARISONS, "job", job)
    layout = ButtonLayout()
    panel.run(layout, bpy.context)
    assert "Comparing in scene Attic" in layout.words
    job.active = False
    layout = ButtonLayout()
    panel.run(layout, bpy.context)
    assert "Cube" not in layout.words
    job.scene = bpy.context.scene.session_uid
    layout = ButtonLayout()
    panel.run(layout, bpy.context)
    assert "Cube" in layout.words
    monkeypatch.setattr(COMPARISONS, "job", None)


def test_a_scene_that_is_gone_gets_no_result(state):
    job = start(state, 0.2)
    ticks(lambda: not job.preparing)
    other = bpy.data.scenes.new("Other")
    bpy.context.window_manager.windows[0].scene = other
    bpy.data.scenes.remove(bpy.data.scenes["Cornell Box"])
    ticks(lambda: not job.active)
    assert "was deleted" in job.notices[0].reason


def test_every_choice_has_words(state):
    for name in ("budget", "reference", "receivers", "reference_method"):
        for item in state.bl_rna.properties[name].enum_items:
            assert item.name and item.description and not item.description.endswith(".")
    assert tuple(p[0] for p in compare_records.PLACES) == compare.PLACES
