# SPDX-License-Identifier: GPL-3.0-or-later
"""One bake from Blender's scene to images, attributes and pictures, its partial results, and its report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking.bake import Bake, BakeRequest, preflight
from adjgi.adjoint_gi.bridge.baking.report import of_bake
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.cli.arguments import DEMO_METHODS
from adjgi.adjoint_gi.bridge.results import links as targets
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.adjoint_gi.bridge.results.lightmap_uv import STORED, in_one_square, make_lightmap_uvs
from adjgi.adjoint_gi.bridge.results.links import ABOUT
from adjgi.adjoint_gi.core.base.errors import AdjointError, TargetError
from adjgi.adjoint_gi.core.method import registry
from adjgi.tests.exr_layers import read_exr

solvers.load()
RADIOSITY = 1.0  # emitted by every wall of the furnace
RHO = 0.5
ANSWER = RADIOSITY / (1 - RHO)  # irradiance in a closed room of uniform emission and reflectance (T1)


def furnace(size=1.0):
    """T1: a closed cube seen from inside, one object, every face emitting and reflecting alike."""
    scene = bpy.context.scene
    wall = demo.material("Wall", (RHO,) * 3, (RADIOSITY / np.pi,) * 3)
    corners = [(x, y, z) for z in (0, size) for y in (0, size) for x in (0, size)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (1, 5, 7, 3), (3, 7, 6, 2), (2, 6, 4, 0)]
    made = demo.mesh_object(scene, "Room", corners, faces, wall)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (size / 2, size / 2, size / 2)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return made


def request(method="path_tracing", target="texture", values=None, **more):
    settings = registry.method(method).Settings().replaced({"samples": 64, **(values or {})} if method == "path_tracing" else values or {})
    return BakeRequest(method, settings, target, **{"resolution": 32, **more})


def finish(req):
    made = Bake(bpy.context, req)
    solution = made.driver.run()
    made.write(solution)
    return made, solution


def test_furnace_to_texture_has_the_closed_form_in_image_and_file(tmp_path):
    room = furnace()
    made, solution = finish(request(output=str(tmp_path)))
    image = linked_image(room, "irradiance")
    pixels = read_pixels(image)
    covered = pixels[..., 3] > 0
    assert covered.mean() > 0.2
    assert pixels[covered][:, :3].mean() == pytest.approx(ANSWER, rel=0.02)
    layers, about = read_exr(Path(made.files[0]))
    assert np.array_equal(layers[""], pixels)
    parts, about = read_exr(Path(made.files[1]))
    assert {"emitted", "direct", "indirect", "albedo", "coverage"} <= set(parts)
    assert np.allclose((parts["direct"] + parts["indirect"])[covered], pixels[covered][:, :3], atol=1e-5)
    assert np.allclose(parts["emitted"][covered], RADIOSITY, rtol=1e-5) and np.allclose(parts["albedo"][covered], RHO, rtol=1e-5)
    assert about["partial"] == "no" and about["quantity"] == "irradiance" and about["method"] == "path_tracing"
    assert Path(made.files[2]).read_bytes().startswith(b"\x89PNG")
    assert made.written == [f"image {image.name}", *made.files]
    assert targets.link(room, "irradiance")["uv_layer"] in room.data.uv_layers


def test_files_of_others_in_the_place_of_any_result_are_seen_before_the_bake(tmp_path):
    furnace()
    req = request(output=str(tmp_path), values={"samples": 1})
    made, _ = finish(req)
    assert len(made.files) == 3 and not [n for n in preflight(bpy.context, req) if n.severity == "error"], "ours are replaced"
    for name in made.files:
        path = Path(name)
        ours = path.read_bytes()
        path.write_bytes(b"of another program")
        (error,) = [n for n in preflight(bpy.context, req) if n.severity == "error"]
        assert error.object == name and "was not written by Adjoint GI" in error.reason
        path.write_bytes(ours)


@pytest.mark.parametrize("domain", ["POINT", "CORNER"])
def test_furnace_to_attribute(domain):
    room = furnace()
    finish(request("progressive_radiosity", "attribute", domain=domain, quantity="radiosity"))
    name = linked_attribute(room, "radiosity")
    data = room.data.attributes[name]
    assert (data.domain, data.data_type, len(data.data)) == (domain, "FLOAT_COLOR", 8 if domain == "POINT" else 24)
    values = np.empty(4 * len(data.data), np.float32)
    data.data.foreach_get("color", values)
    color = values.reshape(-1, 4)[:, :3]
    assert np.allclose(color, RADIOSITY + RHO * ANSWER, rtol=0.08)  # form factors by rays: noise
    assert color.mean() == pytest.approx(RADIOSITY + RHO * ANSWER, rel=0.03)
    assert json.loads(room.data[ABOUT])["partial"] == "no"


def test_furnace_to_picture_with_all_passes(tmp_path):
    furnace()
    made, _ = finish(request("progressive_radiosity", "render", output=str(tmp_path), width=24, height=16))
    layers, about = read_exr(Path(made.files[0]))
    assert {"", "Emission", "Direct", "Indirect", "Albedo", "Normal", "Depth", "Elements"} == set(layers)
    assert layers[""].shape == (16, 24, 4)
    assert np.allclose(layers[""][..., :3], ANSWER / np.pi, rtol=0.03), "radiance of the furnace is E / (pi (1 - rho))"
    assert np.allclose(layers["Emission"] + layers["Direct"] + layers["Indirect"], layers[""][..., :3], atol=1e-5)
    assert np.allclose(layers["Elements"], ANSWER, rtol=0.1)
    assert layers["Elements"].mean() == pytest.approx(ANSWER, rel=0.01)
    assert layers["Depth"].min() == pytest.approx(0.5, rel=0.01) and about["quantity"] == "radiance"


@pytest.mark.parametrize("method", DEMO_METHODS)
def test_each_kind_of_method_bakes_texture_and_attribute(method):
    room = furnace()
    values = {"path_tracing": {"samples": 16}, "particle_tracing": {"particles": 20000}}.get(method, {"max_edge": 0.5})
    for target in ("texture", "attribute"):
        made, solution = finish(request(method, target, values, resolution=16))
        assert solution.method == method and not solution.partial and made.driver.state == "finished"
        assert np.isfinite(solution.quantity("irradiance")).all()
    assert linked_image(room, "irradiance") and linked_attribute(room, "irradiance")


def test_atlas_gives_each_object_its_own_place():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        made, _ = finish(request(atlas=True, resolution=128, values={"samples": 1}))
        floor, wall = scene.objects["Floor"], scene.objects["Left Wall"]
        image = linked_image(floor, "irradiance")
        assert image == linked_image(wall, "irradiance")
        (sheet,) = made.writer.sheets
        assert sheet.lightmap.overlapping == 0 and sheet.lightmap.covered.mean() > 0.6
        owner = made.driver.world.scene.object[sheet.lightmap.receivers.triangle[sheet.lightmap.receivers.start[:-1]]]
        assert len(np.unique(owner)) == len(sheet.uids)
        # Packed together, so the layers are used as they are, also by a second bake.
        before = digest(floor)
        for _ in (made, finish(request(atlas=True, resolution=128, values={"samples": 1}))[0]):
            assert digest(floor) == before and list(targets.link(wall, "irradiance")["offset"]) == [0, 0]


def test_objects_of_an_atlas_show_it_by_their_own_layers_whatever_these_are_called():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        meshes = [o for o in scene.objects if o.type == "MESH"]
        made, _ = finish(request(atlas=True, values={"samples": 1}))
        for k, obj in enumerate(meshes):
            layer = obj.data.uv_layers[obj.data[STORED]]
            layer.name = obj.data[STORED] = f"Mine {k}"
        made, _ = finish(request(atlas=True, values={"samples": 1}))
        assert len(made.writer.sheets) == 1
        for obj in meshes:
            assert targets.link(obj, "irradiance")["uv_layer"] == obj.data[STORED] != ""
        assert len({targets.link(obj, "irradiance")["uv_layer"] for obj in meshes}) == len(meshes)


def test_objects_with_a_layer_from_before_get_a_new_one_in_the_atlas():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        make_lightmap_uvs([scene.objects["Floor"]], 128, (2,))
        before = digest(scene.objects["Floor"])
        made, _ = finish(request(atlas=True, resolution=128, values={"samples": 1}))
        assert made.writer.sheets[0].lightmap.overlapping == 0 and digest(scene.objects["Floor"]) != before
        assert in_one_square([o for o in scene.objects if o.type == "MESH"])


def test_objects_that_share_a_mesh_have_their_own_places_in_the_atlas():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        twin = bpy.data.objects.new("Twin", scene.objects["Tall Box"].data)
        twin.location.x = 0.4
        scene.collection.objects.link(twin)
        made, _ = finish(request(atlas=True, resolution=128, values={"samples": 1}))
        assert made.writer.sheets[0].lightmap.overlapping == 0 and twin.data == scene.objects["Tall Box"].data
        assert not twin.data.uv_layers and in_one_square([twin, scene.objects["Tall Box"], scene.objects["Floor"]])


def test_a_layer_made_for_an_atlas_is_kept_by_a_bake_without_and_this_is_said():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        finish(request(atlas=True, resolution=128, values={"samples": 1}))
        before = digest(scene.objects["Floor"])
        made, _ = finish(request(resolution=64, values={"samples": 1}))
        assert digest(scene.objects["Floor"]) == before
        (notice,) = (n for n in made.notices if "fills only a part" in n.reason)
        assert set(notice.names) >= {"Floor", "Tall Box"}


def digest(obj):
    """What our layer holds."""
    layer = obj.data.uv_layers[obj.data[STORED]]
    return [tuple(x.vector) for x in layer.uv]


def test_named_uv_layer_is_used_and_nothing_is_made():
    room = furnace()
    room.data.uv_layers.new(name="Mine")
    made, _ = finish(request(uv_layer="Mine", values={"samples": 1}))
    assert [x.name for x in room.data.uv_layers] == ["Mine"]
    assert any("claimed by faces at different places" in n.reason for n in made.notices), "every face fills the same square"


def test_second_bake_uses_the_layer_and_image_of_the_first():
    room = furnace()
    finish(request(values={"samples": 1}))
    layers, images = [x.name for x in room.data.uv_layers], len(bpy.data.images)
    finish(request(values={"samples": 2}))
    assert [x.name for x in room.data.uv_layers] == layers and len(bpy.data.images) == images


def test_stop_writes_a_labelled_partial_result_beside_the_whole_one(tmp_path):
    room = furnace()
    whole, _ = finish(request(output=str(tmp_path), values={"samples": 1}))
    made = Bake(bpy.context, request(output=str(tmp_path), values={"samples": 4096}))
    solution = made.driver.run(lambda d: d.fraction > 0.0 and d.stop())
    assert made.driver.state == "stopped" and solution.partial
    made.write(solution)
    assert not set(made.files) & set(whole.files)
    assert all("partial" in Path(f).name for f in made.files)
    assert json.loads(linked_image(room, "irradiance")[ABOUT])["partial"] == "yes"
    assert read_exr(Path(made.files[1]))[1]["partial"] == "yes"
    report = of_bake(made)
    assert report["partial"] and report["state"] == "stopped" and 0 < report["fraction"] < 1


def test_live_refresh_writes_datablocks_only(tmp_path):
    room = furnace()
    made = Bake(bpy.context, request(output=str(tmp_path), values={"samples": 4096}))
    made.driver.start()
    while made.driver.version == 0:
        assert made.driver.state == "running"
    made.write(made.driver.solution())
    assert made.driver.state == "running", "the bake must not end before the test looks"
    assert made.files == [] and list(tmp_path.iterdir()) == []
    assert linked_image(room, "irradiance") is not None
    assert made.driver.stop()
    made.write(made.driver.solution())
    assert len(made.files) == 3 and all(Path(f).is_file() for f in made.files)


def test_same_seed_same_bits():
    room = furnace()
    first = finish(request(values={"samples": 3, "seed": 5}))[1].direct
    assert np.array_equal(first, finish(request(values={"samples": 3, "seed": 5}))[1].direct)
    assert not np.array_equal(first, finish(request(values={"samples": 3, "seed": 6}))[1].direct)
    assert room.name == "Room"


def test_object_deleted_during_the_bake_is_said():
    room = furnace()
    made = Bake(bpy.context, request(values={"samples": 1}))
    solution = made.driver.run()
    bpy.data.objects.remove(room)
    with pytest.raises(TargetError, match="Room: was deleted while it was baked"):
        made.write(solution)


def test_renamed_object_is_found_by_its_session_uid():
    room = furnace()
    made = Bake(bpy.context, request(values={"samples": 1}))
    solution = made.driver.run()
    room.name = "Chamber"
    made.write(solution)
    assert linked_image(room, "irradiance") is not None


def test_refused_bake_leaves_the_scene_as_it_was():
    room = furnace()
    room.data.uv_layers.new(name="Mine")
    for bad in (
        request(uv_layer="Yours"),
        request(objects=("Nobody",)),
        request(resolution=0),
        request(target="render"),
        request(target="statue"),
        dataclasses.replace(request(), method="alchemy"),
    ):
        with pytest.raises(AdjointError) as caught:
            Bake(bpy.context, bad)
        assert caught.value.notice.remedy
    assert [x.name for x in room.data.uv_layers] == ["Mine"] and not bpy.data.images and targets.keys(room) == []


def test_scene_without_light_is_black_and_says_so():
    bpy.ops.mesh.primitive_plane_add()
    made, solution = finish(request(values={"samples": 1}))
    assert not solution.quantity("irradiance").any()
    assert any("nothing emits light" in n.reason for n in made.notices)


def test_report_is_json_and_complete(tmp_path):
    furnace()
    made, solution = finish(request("particle_tracing", values={"particles": 10000}, output=str(tmp_path)))
    report = json.loads(json.dumps(of_bake(made)))
    assert report["settings"]["particles"] == 10000 and report["seed"] == 0
    assert report["seconds"] > 0 and report["rays"] == solution.rays > 10000
    balance = report["energy_balance"]
    assert balance["emitted"] == pytest.approx(2 * 3 * 6 * RADIOSITY, rel=1e-3), "both sides emit"
    assert balance["gap"] < 1e-6
    assert sum(balance["particles"][1:]) == balance["particles"][0] == 10000
    assert report["mean"]["irradiance"] == pytest.approx([ANSWER] * 3, rel=0.1)
    assert report["files"] == made.files and {"blender", "numpy", "embreex", "OpenEXR", "adjoint_gi"} <= set(report["versions"])
    assert report["scene"]["triangles"] == 12 and report["state"] == "finished" and not report["partial"]
    assert report["memory"]["peak_bytes"] > 1e6


def test_every_step_of_a_bake_is_reported():
    furnace()
    seen = []
    made = Bake(bpy.context, request(values={"samples": 256}))
    made.write(made.driver.run(lambda d: seen.append(d.fraction)))
    assert seen and seen == sorted(seen) and made.written


def test_images_are_not_lost_with_their_files(tmp_path):
    """The folder is gone when the bake ends; the image is in the .blend, and the next write puts it into files."""
    room = furnace()
    first, _ = finish(request(output=str(tmp_path / "old"), values={"samples": 1}))
    image = linked_image(room, "irradiance")
    assert image.packed_file is None
    made = Bake(bpy.context, request(output=str(tmp_path / "new" / "below")))
    solution = made.driver.run()
    (tmp_path / "new" / "below").rmdir()
    (tmp_path / "new").rmdir()
    (tmp_path / "new").write_text("a file")
    with pytest.raises(AdjointError, match="is a file, not a folder"):
        made.write(solution)
    assert (made.written, made.files) == ([f"image {image.name}"], [])
    assert linked_image(room, "irradiance") == image and image.packed_file is not None
    pixels = read_pixels(image)
    assert pixels[pixels[..., 3] > 0][:, :3].mean() == pytest.approx(ANSWER, rel=0.02)
    made.request = dataclasses.replace(made.request, output=str(tmp_path / "other"))
    made.write(solution)
    assert len(made.files) == 3 and image.packed_file is None
    assert np.array_equal(read_exr(Path(made.files[0]))[0][""], pixels)


def test_a_picture_without_a_folder_is_not_lost_in_silence(tmp_path):
    furnace()
    made = Bake(bpy.context, request(target="render", output=str(tmp_path), width=4, height=4))
    solution = made.driver.run()
    made.request = dataclasses.replace(made.request, output="")
    with pytest.raises(TargetError, match="Output folder: is not set"):
        made.write(solution)
