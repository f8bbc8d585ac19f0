# SPDX-License-Identifier: GPL-3.0-or-later
"""The background job: its states, what it writes and when, and what happens to it when the scene changes under it.

Timers do not fire without a window, so the tests call what the timer calls.
"""

import dataclasses
import threading
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import jobs
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.baking.watch import Targets
from adjgi.adjoint_gi.bridge.host import background
from adjgi.adjoint_gi.bridge.props.request import BakeRequest
from adjgi.adjoint_gi.core.base.errors import AdjointError, TargetError, WriteError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.driver import Driver
from adjgi.adjoint_gi.core.receivers.base import SurfaceReceivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.blender.fakes import Fake, FakeSettings, fake_method, square

LIMIT = 20.0  # seconds that any wait in these tests may take


class FakeBake:
    """A bake whose driver is real and whose writing is a list."""

    refuse = None  # an error that the next write raises
    in_blend = ()  # datablocks that are written all the same
    given = ()

    def __init__(self, context, request, now=True):
        self.request = request
        b = SceneBuilder()
        b.quad("Square", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
        receivers = SurfaceReceivers("texels", np.arange(5), np.zeros(4), np.full(4, 0.2), np.full(4, 0.2))
        self.driver = Driver(Fake(), World(b.build()), receivers, request.settings)
        self.written = []
        self.notices = []
        self.files = []

    def preparing(self):
        yield "Preparing"

    def take_back(self):
        pass

    remember = Bake.remember

    def write(self, solution):
        if FakeBake.refuse is not None:
            self.written, self.files = list(FakeBake.in_blend), []
            raise FakeBake.refuse
        self.written.append(solution)
        self.files = ["result.exr"]


@pytest.fixture
def scene(registered, monkeypatch):
    with fake_method(registered):
        monkeypatch.setattr(jobs, "Bake", FakeBake)
        monkeypatch.setattr(FakeBake, "refuse", None)
        monkeypatch.setattr(FakeBake, "in_blend", ())
        monkeypatch.setattr(jobs.preferences, "refresh_seconds", lambda: 0.2)
        square()
        bpy.ops.ed.undo_push(message="Start")
        yield bpy.context.scene
        BAKES.forget()
    assert not [t for t in threading.enumerate() if t.name == "adjoint_gi_driver"]


def request(steps=10**6, pause=0.01, **values):
    settings = FakeSettings(steps=steps, pause=pause, **values)
    return BakeRequest("fake", settings, objects=("Square",), uv_layer="UVMap")


def start(**values):
    return BAKES.start(bpy.context, request(**values))


def ticks(until, seconds=LIMIT):
    """Tick like the timer until `until()` holds."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, "it never came to that"
        background.tick()
        time.sleep(0.02)


def threads():
    """Names of threads of jobs that have not ended; atlases that earlier tests have left at rest go by themselves."""
    return [t.name for t in threading.enumerate() if t.name.startswith("adjoint_gi") and t.name != "adjoint_gi_atlases"]


def result():
    return bpy.context.scene.adjoint_gi.result


def test_it_finishes_writes_once_and_notes_the_numbers(scene):
    job = start(steps=5)
    assert bpy.app.timers.is_registered(background._tick)
    ticks(lambda: not job.active)
    assert (job.state, job.notices, job.solution) == ("finished", [], None)
    assert [s.partial for s in job.bake.written] == [False]
    r = result()
    assert (r.method, r.partial, r.applied, r.files, r.target) == ("fake", False, True, "result.exr", "texture")
    assert list(r.mean) == pytest.approx([3, 6, 9])
    assert background._tick() is None  # the timer ends


def test_partial_results_are_written_while_it_runs_but_seldom(scene):
    job = start(pause=0.002)
    ticks(lambda: len(job.bake.written) >= 2)
    driver = job.bake.driver
    assert driver.fraction * driver.settings.steps > 20 * len(job.bake.written)
    assert all(s.partial for s in job.bake.written)
    assert result().method == ""  # the numbers come at the end


def test_stop_keeps_the_partial_result_and_continue_goes_on(scene):
    job = start(steps=300, pause=0.005)
    ticks(lambda: job.bake.driver.fraction > 0.1)
    BAKES.stop()
    assert job.state == "stopped" and not threads()
    assert job.bake.written[-1].partial
    assert result().partial and result().applied
    at = job.bake.driver.fraction
    jobs.resume()
    assert job.bake.driver.fraction >= at
    ticks(lambda: not job.active)
    assert (job.state, result().partial) == ("finished", False)
    assert not job.bake.written[-1].partial


def test_stop_before_the_first_step_says_so(scene):
    job = start(pause=0.3)
    BAKES.stop()
    ticks(lambda: not job.active)
    assert job.state == "stopped"
    if not job.bake.written:
        assert "before the first result" in job.notices[0].reason


def test_a_second_start_is_refused(scene):
    job = start()
    with pytest.raises(AdjointError, match="another bake is running"):
        start()
    assert BAKES.job is job and job.active
    assert not bpy.ops.adjoint_gi.bake.poll()


def test_continue_without_a_stopped_bake_is_refused(scene):
    with pytest.raises(AdjointError, match="no stopped bake"):
        jobs.resume()
    job = start(steps=2)
    ticks(lambda: not job.active)
    with pytest.raises(AdjointError, match="no stopped bake"):
        jobs.resume()


def test_a_failing_method_says_why_and_its_partial_result_can_be_written(scene):
    job = start(steps=10, mode="fails")
    ticks(lambda: not job.active)
    assert job.state == "failed"
    assert str(job.notices[0]) == "Fake: fails on purpose. Choose Fine"
    assert job.solution is not None and job.solution.partial
    assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
    assert len(job.bake.written) == 1


def test_an_unexpected_exception_ends_the_job(scene):
    job = start()
    FakeBake.refuse = ZeroDivisionError("by zero")
    ticks(lambda: not job.active)
    assert job.state == "failed"
    assert "ZeroDivisionError: by zero" in str(job.notices[0])


@pytest.mark.parametrize("change", ["delete", "edit", "edit mode", "uv", "uv layer", "scene"])
def test_changed_objects_get_nothing_and_the_result_is_kept_as_a_file(scene, change, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = start(steps=60, pause=0.005)
    square = bpy.data.objects["Square"]
    if change == "delete":
        bpy.data.objects.remove(square)
    elif change == "edit":
        square.data.vertices[0].co.z = 1.0
    elif change == "uv":
        square.data.uv_layers["UVMap"].uv[0].vector.x = 0.25
    elif change == "uv layer":
        square.data.uv_layers.remove(square.data.uv_layers["UVMap"])
    elif change == "edit mode":
        bpy.ops.object.mode_set(mode="EDIT")
    else:
        bpy.data.scenes.new("Other")
        bpy.data.scenes.remove(scene)
    ticks(lambda: not job.active)
    assert job.state == "finished"
    words = " ".join(map(str, job.notices))
    said = {"edit mode": "Edit Mode", "uv": "UV layer", "uv layer": "UV layer", "scene": "Scene"}
    assert said.get(change, change) in words
    assert "kept in" in words
    assert not [s for s in job.bake.written if not s.partial]
    (file,) = tmp_path.iterdir()
    with np.load(file, allow_pickle=False) as arrays:
        np.testing.assert_allclose(arrays["indirect"][0], [2, 4, 6])
    if change != "scene":
        assert not result().applied and result().files == str(file)
    if change == "edit mode":
        bpy.ops.object.mode_set(mode="OBJECT")
        assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
        assert result().applied and not job.bake.written[-1].partial


def test_faces_that_are_turned_over_are_an_edit(scene):
    """No vertex has moved, and no count has changed, but values of corners would go to others."""
    square = bpy.data.objects["Square"]
    targets = Targets([square])
    assert not targets.problems()
    square.data.flip_normals()
    (problem,) = targets.problems()
    assert problem.object == "Square" and "edited" in problem.reason


def test_renaming_is_no_change(scene):
    job = start(steps=30, pause=0.005)
    bpy.data.objects["Square"].name = "Round"
    bpy.data.objects["Round"].data.name = "Mesh"
    ticks(lambda: not job.active)
    assert (job.state, job.notices) == ("finished", [])


def test_a_target_that_refuses_is_named(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = start(steps=2)
    FakeBake.refuse = TargetError("Image", "is linked", "Make it local")
    ticks(lambda: not job.active)
    assert "Image: is linked. Make it local" in str(job.notices[0])
    assert len(list(tmp_path.iterdir())) == 1
    FakeBake.refuse = None
    assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
    assert result().applied


def full_disk(solution):
    raise WriteError("/tmp", "could not be written: the disk is full", "Free some space")


def test_an_error_at_writing_that_nobody_thought_of_loses_nothing(scene, monkeypatch, tmp_path):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = start(steps=2)
    FakeBake.refuse = ValueError("on purpose")
    ticks(lambda: not job.active)
    FakeBake.refuse = None
    (file,) = tmp_path.glob("*.npz")
    assert job.state == "finished" and result().files == str(file) and "ValueError: on purpose" in " ".join(map(str, job.notices))


def test_a_result_that_no_disk_has_room_for_stays_in_memory(scene, monkeypatch):
    monkeypatch.setattr(jobs.kept, "save", full_disk)
    job = start(steps=2)
    FakeBake.refuse = OSError(28, "No space left on device")
    ticks(lambda: not job.active)
    words = " ".join(map(str, job.notices))
    assert job.state == "finished" and "disk is full" in words and "kept in memory" in words and "Write Result" in words
    assert job.solution is not None and not result().applied and result().files == ""
    FakeBake.refuse = None
    assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
    assert result().applied and job.solution is None and job.notices == []


def test_a_partial_result_that_cannot_be_shown_does_not_end_the_bake(scene):
    job = start(steps=60, pause=0.01)
    FakeBake.refuse = TargetError("Square", "shares its mesh", "Make it a single user")
    ticks(lambda: job._written > 0)
    assert job.active and job.driver.state == "running"
    FakeBake.refuse = None
    ticks(lambda: not job.active)
    assert (job.state, job.notices, job.solution) == ("finished", [], None)


def test_a_bake_that_stopped_for_a_failure_of_its_surroundings_can_be_continued(scene, monkeypatch):
    monkeypatch.setattr(jobs.preferences, "refresh_seconds", lambda: 0.0)
    job = start(steps=200, pause=0.005)
    FakeBake.refuse = ZeroDivisionError("by zero")
    ticks(lambda: not job.active)
    assert job.state == "failed" and job.resumable and job.driver.state == "stopped"
    FakeBake.refuse = None
    assert bpy.ops.adjoint_gi.resume() == {"FINISHED"}
    ticks(lambda: not job.active)
    assert (job.state, result().partial, job.solution) == ("finished", False, None)


@pytest.mark.parametrize("way", ["start", "run"])
def test_a_bake_that_is_refused_while_it_is_prepared_leaves_the_last_one_to_go_on(scene, monkeypatch, way):
    job = start(steps=300, pause=0.002)
    ticks(lambda: job.bake.driver.fraction > 0.1)
    BAKES.stop()

    def refuse(self):
        raise TargetError("Square", "does not fit", "")
        yield

    with monkeypatch.context() as patch, pytest.raises(TargetError):
        patch.setattr(FakeBake, "preparing", refuse)
        start() if way == "start" else BAKES.run(bpy.context, request(), lambda fraction: None)
    assert BAKES.job is job and job.resumable
    jobs.resume()
    ticks(lambda: not job.active)
    assert (job.state, result().partial) == ("finished", False)


def test_writing_again_makes_no_second_file_and_goes_where_the_panel_says(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = start(steps=2)
    FakeBake.refuse = TargetError("Image", "is linked", "Make it local")
    ticks(lambda: not job.active)
    (file,) = tmp_path.iterdir()
    for _ in range(3):
        assert bpy.ops.adjoint_gi.write() == {"CANCELLED"}
        assert str(file) in " ".join(map(str, job.notices))
    assert list(tmp_path.iterdir()) == [file] and result().files == str(file)
    scene.adjoint_gi.folder = "//another"
    FakeBake.refuse = None
    assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
    assert job.bake.request.output == job.request.output == "//another"


def test_images_without_their_files_are_no_lost_result(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = start(steps=2)
    FakeBake.refuse, FakeBake.in_blend = WriteError("/gone", "is a file, not a folder", "Choose another folder"), ("image Square",)
    ticks(lambda: not job.active)
    assert [n.object for n in job.notices] == ["/gone", ""] and "their files are missing" in job.notices[1].reason
    assert "Write Result" in job.notices[1].remedy
    assert not list(tmp_path.iterdir()) and result().applied and job.solution is not None
    FakeBake.refuse = None
    assert bpy.ops.adjoint_gi.write() == {"FINISHED"}
    assert job.solution is None and job.notices == []


def test_objects_with_the_same_problem_are_named_in_one_line(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    for i in range(6):
        square(f"More {i}")
    names = tuple(o.name for o in scene.objects)
    job = BAKES.start(bpy.context, dataclasses.replace(request(steps=60, pause=0.005), objects=names))
    bpy.ops.object.mode_set(mode="EDIT")
    ticks(lambda: not job.active)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(job.notices) == 2
    assert "and 3 more: is in Edit Mode" in str(job.notices[0]) and "kept in" in str(job.notices[1])


def test_loading_a_file_cancels_and_waits_for_the_thread(scene):
    job = start()
    time.sleep(0.1)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert (BAKES.job, job.state) == (None, "cancelled") and not threads()
    assert not bpy.app.timers.is_registered(background._tick)
    background.tick()


def test_saving_does_not_touch_it(scene, tmp_path):
    job = start()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert job.active
    ticks(lambda: job.bake.driver.version > 0)


def test_undo_and_redo_fifty_times(scene):
    job = start(pause=0.001)
    obj = bpy.data.objects["Square"]
    for i in range(5):
        obj.location.x = i
        bpy.ops.ed.undo_push(message="Move")
        obj = bpy.data.objects["Square"]
    for i in range(50):
        (bpy.ops.ed.undo if i % 10 < 5 else bpy.ops.ed.redo)()
        background.tick()
    end = time.monotonic() + 0.5
    ticks(lambda: time.monotonic() > end)
    assert job.active and not job.notices and not job.bake.written, "a write may need an undo step, which takes the user's redo away"
    BAKES.stop()
    assert job.state == "stopped" and result().applied


def test_undo_of_the_baked_object_stops_the_job(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    square("Late")
    bpy.ops.ed.undo_push(message="Add")
    r = dataclasses.replace(request(), objects=("Late",))
    job = BAKES.start(bpy.context, r)
    ticks(lambda: job.bake.driver.version > 0)
    bpy.ops.ed.undo()
    assert "Late" not in bpy.data.objects
    ticks(lambda: not job.active)
    assert job.state == "stopped"
    assert "Late: was deleted" in str(job.notices[0])
    with pytest.raises(AdjointError, match="was deleted"):
        jobs.resume()


def test_rendering_during_the_job(scene):
    from adjgi.tests.blender.fakes import camera

    camera()
    scene.render.engine = "ADJOINT_GI"
    scene.render.resolution_x = scene.render.resolution_y = 8
    job = start()
    bpy.ops.render.render()
    assert job.active
    ticks(lambda: job.bake.driver.version > 0)


def test_disabling_the_extension_during_the_job(scene, registered):
    job = start()
    registered.unregister()
    assert job.state == "cancelled" and BAKES.job is None and not threads()
    assert not bpy.app.timers.is_registered(background._tick)
    registered.register()


def test_operators_stop_and_continue(scene):
    job = start(steps=200, pause=0.005)
    ticks(lambda: job.bake.driver.version > 0)
    assert bpy.ops.adjoint_gi.stop() == {"FINISHED"}
    assert job.state == "stopped"
    assert bpy.ops.adjoint_gi.resume() == {"FINISHED"}
    assert job.active
    ticks(lambda: not job.active)
    assert job.state == "finished"


def test_uvs_are_not_renewed_under_a_bake_that_runs(scene):
    """Its texels lie by the old ones."""
    scene.adjoint_gi.target, scene.adjoint_gi.uv_layer = "texture", ""
    assert bpy.ops.adjoint_gi.renew_uvs.poll()
    start()
    assert not bpy.ops.adjoint_gi.renew_uvs.poll()
    BAKES.stop()
    assert bpy.ops.adjoint_gi.renew_uvs.poll()


def test_the_foreground_bake_does_the_same(scene):
    shares = []
    job = BAKES.run(bpy.context, request(steps=4, pause=0.0), shares.append)
    assert (job.state, shares) == ("finished", [0.25, 0.5, 0.75, 1.0])
    assert not result().partial and result().applied
    job = BAKES.run(bpy.context, request(steps=4, pause=0.0, mode="fails"), shares.append)
    assert job.state == "failed"


def test_kept_files_have_their_own_names(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs.kept, "folder", lambda: tmp_path)
    job = BAKES.run(bpy.context, request(steps=1, pause=0.0), lambda fraction: None)
    solution = job.bake.written[0]
    paths = {jobs.kept.save(solution) for _ in range(3)}
    assert len(paths) == 3 and all(Path(p).is_file() for p in paths)


def test_undo_steps_are_safe_while_threads_compute(scene):
    """Inside `temp_override` this crashes Blender 4.2 and 5.0 within a second or two."""
    end = threading.Event()

    def busy():
        while not end.is_set():
            {str(i): i for i in range(300)}
            time.sleep(0)

    threads = [threading.Thread(target=busy) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(1000):
            background.push_undo("Adjoint GI Test")
    finally:
        end.set()
        for thread in threads:
            thread.join()


def test_an_undo_step_is_made_without_a_window_too(scene):
    names = lambda: {o.name for o in bpy.data.objects}  # noqa: E731
    before = names()
    with bpy.context.temp_override(window=None):
        assert not bpy.ops.ed.undo_push.poll()
        for name in ("First", "Second"):
            bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, None))
            background.push_undo("Adjoint GI Test")
    bpy.ops.ed.undo()
    assert names() == before | {"First"}
