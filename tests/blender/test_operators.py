# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators from end to end with the real bake: demonstration scene, each method and target, show, restore, clear."""

import time

import bpy
import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking import check, jobs
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.host import background
from adjgi.adjoint_gi.bridge.props import properties
from adjgi.adjoint_gi.bridge.results import links
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.blender.fakes import fake_method, quick, square

solvers.load()
METHODS = [m.spec.id for m in registry.methods()]


@pytest.fixture
def scene(registered):
    assert bpy.ops.adjoint_gi.add_demo_scene() == {"FINISHED"}
    scene = next(s for s in bpy.data.scenes if s.name.startswith("Cornell"))
    bpy.context.window.scene = scene
    for obj in scene.objects:
        obj.select_set(obj.type == "MESH")
    scene.adjoint_gi.resolution = 16
    scene.adjoint_gi.margin = 2
    yield scene
    BAKES.forget()


def materials(scene):
    return {o.name: [(s.link, s.material.name if s.material else "") for s in o.material_slots] for o in scene.objects}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("target", ["texture", "attribute"])
def test_bake_show_restore_clear(scene, method, target):
    state = quick(scene, method)
    state.target = target
    before = materials(scene)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    r = state.result
    assert (r.method, r.partial, r.applied, r.target) == (method, False, True, target)
    assert int(r.rays) > 0 and r.seconds > 0 and min(r.mean) > 0
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert materials(scene) != before
    assert bpy.ops.adjoint_gi.restore() == {"FINISHED"}
    assert materials(scene) == before
    assert bpy.ops.adjoint_gi.show_result() == {"FINISHED"}
    assert bpy.ops.adjoint_gi.clear_results() == {"FINISHED"}
    assert materials(scene) == before and r.method == ""
    assert not bpy.ops.adjoint_gi.show_result.poll()


def test_camera_picture(scene, tmp_path):
    state = quick(scene, "path_tracing")
    scene.render.resolution_x = scene.render.resolution_y = 16
    state.target = "render"
    state.folder = str(tmp_path)
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    files = state.result.files.splitlines()
    assert files and all(name.startswith(str(tmp_path)) for name in files)
    assert not bpy.ops.adjoint_gi.show_result.poll()


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda s: setattr(s, "uv_layer", "Nowhere"), "Nowhere"),
        (lambda s: setattr(s, "folder", bpy.app.binary_path or bpy.__file__), "is a file"),
        (lambda s: (setattr(s, "target", "attribute"), setattr(s, "attribute", "  ")), "name"),
        (lambda s: [o.select_set(False) for o in bpy.context.scene.objects], "selected"),
        (lambda s: [setattr(s.settings_path_tracing, name, n) for name, n in (("max_length", 64), ("min_length", 100))], "min_length"),
    ],
)
def test_refusals_change_nothing(scene, break_it, words):
    state = quick(scene, "path_tracing")
    break_it(state)
    images, layers = len(bpy.data.images), sum(len(m.uv_layers) for m in bpy.data.meshes)
    assert bpy.ops.adjoint_gi.bake() == {"CANCELLED"}
    assert any(n.severity == "error" and words in str(n) for n in check.now(bpy.context))
    assert (len(bpy.data.images), sum(len(m.uv_layers) for m in bpy.data.meshes)) == (images, layers)
    assert state.result.method == ""


def left_over(scene):
    """Everything that bakes have put on the objects and into the file."""
    layers = [(o.name, x.name) for o in scene.objects if o.type == "MESH" for x in (*o.data.uv_layers, *o.data.color_attributes)]
    keys = [(o.name, k) for o in scene.objects if o.type == "MESH" for k in (*o.keys(), *o.data.keys())]
    return (
        sorted(layers),
        sorted(keys),
        sorted(i.name for i in bpy.data.images),
        sorted(o.name for o in scene.objects),
        len(bpy.data.meshes),
    )


def test_clear_results_removes_what_was_baked_where_that_is_asked_for(scene):
    before, user = left_over(scene), materials(scene)
    state = quick(scene, "progressive_radiosity")
    for target, new_object in (("texture", False), ("attribute", False), ("attribute", True)):
        state.target, state.new_object = target, new_object
        assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    bpy.ops.adjoint_gi.show_result()
    baked = left_over(scene)
    assert bpy.ops.adjoint_gi.clear_results() == {"FINISHED"} and state.result.method == ""
    assert left_over(scene)[2:] == baked[2:], "without Remove Baked Data it stays"
    # An image that the user has given a use is kept.
    image = links.link(bpy.data.objects["Floor"], "irradiance")["image"]
    image.use_fake_user = False
    user_of_image = bpy.data.textures.new("Mine", "IMAGE")
    user_of_image.image = image
    assert bpy.ops.adjoint_gi.clear_results(remove=True) == {"FINISHED"}
    assert materials(scene) == user and image.name in bpy.data.images
    bpy.data.textures.remove(user_of_image)
    bpy.data.images.remove(image)
    assert left_over(scene) == before
    assert bpy.ops.adjoint_gi.clear_results(remove=True) == {"FINISHED"}


def test_data_of_meshes_that_another_scene_shares_stays(scene):
    quick(scene, "path_tracing").target = "texture"
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    floor = bpy.data.objects["Floor"]
    twin = bpy.data.objects.new("Twin", floor.data)
    bpy.data.scenes.new("Attic").collection.objects.link(twin)
    assert bpy.ops.adjoint_gi.clear_results(remove=True) == {"FINISHED"}
    assert "Lightmap" in floor.data.uv_layers and "Lightmap" not in bpy.data.objects["Ceiling"].data.uv_layers
    assert not bpy.data.images


def test_attributes_of_meshes_that_another_scene_shares_stay(scene):
    state = quick(scene, "path_tracing")
    state.target = "attribute"
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    floor = bpy.data.objects["Floor"].data
    bpy.data.scenes.new("Attic").collection.objects.link(bpy.data.objects.new("Twin", floor))
    assert bpy.ops.adjoint_gi.clear_results(remove=True) == {"FINISHED"}
    assert state.attribute in floor.attributes and state.attribute not in bpy.data.objects["Ceiling"].data.attributes


def test_nothing_is_removed_from_a_mesh_in_edit_mode(scene):
    quick(scene, "path_tracing").target = "texture"
    assert bpy.ops.adjoint_gi.bake() == {"FINISHED"}
    bpy.context.view_layer.objects.active = bpy.data.objects["Floor"]
    bpy.ops.object.mode_set(mode="EDIT")
    baked = left_over(scene)
    assert bpy.ops.adjoint_gi.clear_results(remove=True) == {"CANCELLED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert left_over(scene) == baked and scene.adjoint_gi.result.method == "path_tracing"


def test_check_says_what_is_missing(scene):
    quick(scene, "path_tracing").uv_layer = "Nowhere"
    assert bpy.ops.adjoint_gi.check() == {"FINISHED"}
    assert "Nowhere" in str(check._Cache.notices[0])
    assert bpy.ops.adjoint_gi.bake.poll()


def test_what_is_cleared_cannot_be_continued_or_written_any_more(registered, monkeypatch):
    with fake_method(registered):
        square()
        state = bpy.context.scene.adjoint_gi
        state.resolution, state.uv_layer = 8, "UVMap"
        state.settings_fake.steps, state.settings_fake.pause = 400, 0.005
        job = BAKES.start(bpy.context, properties.request_of(bpy.context.scene))
        end = time.monotonic() + 20
        while (job.preparing or job.driver.solution() is None) and time.monotonic() < end:
            background.tick()
            time.sleep(0.01)
        assert not bpy.ops.adjoint_gi.clear_results.poll()
        BAKES.stop()
        assert bpy.ops.adjoint_gi.resume.poll() and state.result.partial
        assert bpy.ops.adjoint_gi.clear_results() == {"FINISHED"}
        assert not bpy.ops.adjoint_gi.resume.poll() and not bpy.ops.adjoint_gi.write.poll()
        assert BAKES.job is None and state.result.method == ""


def test_the_background_job_with_the_real_bake(registered, monkeypatch):
    """The image appears while it runs, a stop labels it as partial, and the end brings the full value."""
    monkeypatch.setattr(jobs.preferences, "refresh_seconds", lambda: 0.2)
    with fake_method(registered):
        obj = square()
        state = bpy.context.scene.adjoint_gi
        state.resolution, state.uv_layer = 8, "UVMap"
        state.settings_fake.steps, state.settings_fake.pause = 150, 0.02
        job = BAKES.start(bpy.context, properties.request_of(bpy.context.scene))
        end = time.monotonic() + 20
        while links.link(obj, "irradiance") is None and time.monotonic() < end:
            background.tick()
            time.sleep(0.05)
        assert job.active
        image = links.link(obj, "irradiance")["image"]
        assert '"partial": "yes"' in image["adjoint_gi_about"]
        BAKES.stop()
        assert job.state == "stopped" and state.result.partial
        jobs.resume()
        while job.active and time.monotonic() < end:
            background.tick()
            time.sleep(0.05)
        assert (job.state, job.notices) == ("finished", [])
        assert links.link(obj, "irradiance")["image"] == image
        pixels = np.empty(8 * 8 * 4, np.float32)
        image.pixels.foreach_get(pixels)
        np.testing.assert_allclose(pixels.reshape(8, 8, 4)[4, 4, :3], [3, 6, 9])
        assert '"partial": "no"' in image["adjoint_gi_about"]
        BAKES.forget()
