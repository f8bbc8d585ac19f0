# SPDX-License-Identifier: GPL-3.0-or-later
"""What comes before a solve runs in slices: it is shown, stopped, refused, and never blocks on a part that needs no Blender."""

from __future__ import annotations

import dataclasses
import threading
import time

import bpy
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking import preflight, textures
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.extract import depsgraph, mesh, scene_store
from adjgi.adjoint_gi.bridge.host import background
from adjgi.adjoint_gi.bridge.host import preparation as slices
from adjgi.adjoint_gi.bridge.host.preparation import Aside, Preparation, finish_stages, once
from adjgi.adjoint_gi.bridge.results import faces
from adjgi.adjoint_gi.bridge.results.lightmap_uv import own_layer
from adjgi.adjoint_gi.core.base.errors import AdjointError, TargetError
from adjgi.tests.baking import request
from adjgi.tests.blender.fakes import square

solvers.load()
LIMIT = 20.0  # seconds that any wait in these tests may take


class Clock:
    """Time that passes only when it is told to."""

    now = 0.0

    def __call__(self):
        return self.now


def until(condition, preparation=None):
    end = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < end, "it never came to that"
        (preparation.advance if preparation else background.tick)()
        time.sleep(0.002)


def test_parts_aside_run_in_a_thread_and_all_others_on_the_main_one():
    seen = []

    def stages():
        seen.append(threading.current_thread())
        answer = yield Aside("Apart", once(lambda: seen.append(threading.current_thread()) or 7))
        seen.append(threading.current_thread())
        yield f"Got {answer}"

    preparation = Preparation(stages())
    until(lambda: preparation.state == "finished", preparation)
    main = threading.main_thread()
    assert seen[0] is main and seen[1] is not main and seen[2] is main and preparation.text == "Got 7"
    seen.clear()
    finish_stages(stages())
    assert seen == [main] * 3, "in the foreground there is no thread"


def test_a_slice_ends_when_its_time_is_used_up():
    clock = Clock()

    def stages():
        for k in range(10):
            clock.now += 0.02
            yield str(k)

    preparation = Preparation(stages(), clock)
    preparation.advance()
    assert preparation.text == "2" and preparation.state == "running"
    preparation.advance()
    assert preparation.text == "5"


@pytest.mark.parametrize("run", [lambda s: finish_stages(s), lambda s: Preparation(s).finish()])
def test_errors_from_aside_arrive_where_they_were_asked_for(run):
    def fail():
        raise TargetError("A", "is bad")

    def mending():
        with pytest.raises(TargetError):
            yield Aside("Apart", once(fail))

    run(mending())

    def not_mending():
        yield Aside("Apart", once(fail))

    with pytest.raises(TargetError):
        run(not_mending())
    preparation = Preparation(not_mending())
    until(lambda: preparation.state != "running", preparation)
    assert preparation.state == "failed" and isinstance(preparation.error, TargetError)


def test_stop_ends_the_thread_between_steps_and_takes_back():
    undone = []

    def endless():
        while True:
            time.sleep(0.001)
            yield 0.5

    def stages():
        try:
            yield Aside("Apart", endless())
        finally:
            undone.append(threading.current_thread())

    preparation = Preparation(stages())
    preparation.advance()
    until(lambda: preparation.fraction == 0.5, preparation)
    assert preparation.stop() and preparation.state == "dropped" and undone == [threading.main_thread()]
    assert not [t for t in threading.enumerate() if t.name == "adjoint_gi_preparation"]


# ---- the job


@pytest.fixture
def scene(registered):
    square()
    square("Second").modifiers.new("Round", "SIMPLE_DEFORM").angle = 0.0
    bpy.context.scene.world = bpy.data.worlds.new("Lit")
    bpy.context.scene.world.color = (1.0, 1.0, 1.0)
    bpy.ops.ed.undo_push(message="Start")
    yield bpy.context.scene
    BAKES.forget()


class Gate:
    """Holds back the unwrapping until it is opened."""

    def __init__(self, monkeypatch):
        self.open, self.threads = threading.Event(), []
        whole = textures.unwrapping_to_density

        def waiting(*arguments):
            self.threads.append(threading.current_thread())
            while not self.open.is_set():
                time.sleep(0.002)
                yield 0.25
            return (yield from whole(*arguments))

        monkeypatch.setattr(textures, "unwrapping_to_density", waiting)


def layers():
    return {o.name: [layer.name for layer in o.data.uv_layers] for o in bpy.data.objects if o.type == "MESH"}


@pytest.fixture
def held(scene, monkeypatch):
    """A bake that is being prepared, and its gate."""
    gate = Gate(monkeypatch)
    job = BAKES.start(bpy.context, request(values={"samples": 2}, resolution=16))
    until(lambda: job.driver.text == "Unwrapping" and gate.threads and job.driver.fraction > 0)
    assert job.active and job.preparing and background.busy() and gate.threads[0] is not threading.main_thread()
    return job, gate


def test_a_bake_is_prepared_in_the_background_and_ends_as_one_in_the_foreground(held):
    job, gate = held
    gate.open.set()
    until(lambda: not job.active)
    assert (job.state, job.notices) == ("finished", []) and all(own_layer(bpy.data.objects[name]) for name in layers())
    found = job.bake.driver.solution().direct
    assert (Bake(bpy.context, request(values={"samples": 2}, resolution=16)).driver.run().direct == found).all()


def test_stop_while_it_is_prepared_changes_nothing(held):
    job, gate = held
    before = layers()
    BAKES.stop()
    assert job.state == "stopped" and not job.resumable and "before the solve began" in str(job.notices[0])
    assert layers() == before and not gate.open.is_set()
    assert not bpy.ops.adjoint_gi.resume.poll()


@pytest.mark.parametrize("change", ["move", "delete", "edit", "vertex", "modifier", "switched off", "hide", "mesh", "frame", "undo"])
def test_a_scene_that_changes_meanwhile_is_refused(held, change):
    job, gate = held
    obj = bpy.data.objects["Second"]
    if change == "move":
        obj.location.x += 1
    elif change == "delete":
        bpy.data.objects.remove(obj)
    elif change == "edit":
        obj.data.vertices.add(1)
    elif change == "vertex":
        obj.data.vertices[0].co.x += 1
    elif change == "modifier":
        obj.modifiers.new("A", "SUBSURF")
    elif change == "switched off":
        obj.modifiers["Round"].show_render = False
    elif change == "hide":
        obj.hide_render = True
    elif change == "mesh":
        obj.data = obj.data.copy()
    elif change == "frame":
        bpy.context.scene.frame_set(7)
    else:
        bpy.data.objects.remove(obj)
        bpy.ops.ed.undo_push(message="Delete")
    before = layers()
    gate.open.set()
    until(lambda: not job.active)
    assert job.state == "failed" and "was changed while the bake was prepared" in str(job.notices[0])
    assert layers() == before


def test_an_undo_and_redo_that_leave_the_scene_as_it_was_do_no_harm(held):
    job, gate = held
    bpy.data.objects["Second"].location.x += 1
    bpy.ops.ed.undo_push(message="Move")
    bpy.ops.ed.undo()
    gate.open.set()
    until(lambda: not job.active)
    assert job.state == "finished", job.notices


def test_what_is_made_is_taken_back_where_the_bake_is_refused_later(scene, monkeypatch):
    before = layers()

    def fail(*_, **__):
        raise TargetError("Second", "cannot be placed", "Do something")

    monkeypatch.setattr(textures, "rasterize", fail)
    try:
        job = BAKES.start(bpy.context, request(values={"samples": 2}, resolution=16))
    except TargetError:  # a quick machine comes to it while Bake is pressed
        assert not BAKES.running
    else:
        until(lambda: not job.active)
        assert job.state == "failed" and "cannot be placed" in str(job.notices[0])
    assert layers() == before


def test_what_can_be_seen_at_once_refuses_at_once_and_keeps_the_last_job(scene):
    job = BAKES.run(bpy.context, request(values={"samples": 1}, resolution=8), lambda fraction: None)
    for wrong in ({"objects": ("Nobody",)}, {"resolution": 0}):
        with pytest.raises(AdjointError):
            BAKES.start(bpy.context, dataclasses.replace(request(values={"samples": 1}), **wrong))
        assert BAKES.job is job


def test_loading_a_file_ends_a_preparation(held):
    job, _ = held
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert (BAKES.job, job.state) == (None, "cancelled")
    assert not [t for t in threading.enumerate() if t.name == "adjoint_gi_preparation"]


def test_all_that_needs_no_blender_runs_aside(scene, monkeypatch):
    """Placing and the tree of rays twice, for layers are made, and two meshes each time; two plans; checks once; texels of two objects."""
    threads = []
    for where, name in (
        (depsgraph, "place"),
        (mesh, "_usable"),
        (mesh, "_normals"),
        (faces, "Mesh"),
        (scene_store, "World"),
        (preflight.openness, "notices"),
        (textures, "rasterize"),
    ):
        made = getattr(where, name)
        monkeypatch.setattr(where, name, lambda *a, made=made, **k: threads.append(threading.current_thread()) or made(*a, **k))
    job = BAKES.start(bpy.context, request(values={"samples": 1}, resolution=8))
    until(lambda: not job.active)
    assert len(threads) == 2 + 4 + 4 + 2 + 2 + 1 + 2 and threading.main_thread() not in threads


def test_all_that_asks_blender_of_many_objects_does_it_an_object_at_a_time(scene, monkeypatch):
    """With slices that are over at once, every object has its own for its copies, its faces and its layer."""
    monkeypatch.setattr(slices, "SLICE", -1.0)
    square("Third")
    said = []

    def stages():
        steps, answer = Bake(bpy.context, request(values={"samples": 1}, resolution=16), now=False).preparing(), None
        while True:
            try:
                stage = steps.send(answer)
            except StopIteration:
                return
            said.append(stage if isinstance(stage, str) else None)
            answer = (yield stage) if isinstance(stage, Aside) else None

    finish_stages(stages())
    assert said.count("Reading the faces") == said.count("Placing texels") == 2, "none after the last"
    assert said.count("Reading the scene") > 2 * 3 * len(mesh.PIECES)
