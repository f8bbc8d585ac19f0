# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said before a bake. Numbers are those of section 7 of the verification page."""

from __future__ import annotations

import contextlib
import os

import bpy
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.baking import preflight as module
from adjgi.adjoint_gi.bridge.baking.bake import Bake, BakeRequest, preflight
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.adjoint_gi.core.method import registry

solvers.load()
CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
INWARD = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (1, 5, 7, 3), (3, 7, 6, 2), (2, 6, 4, 0)]


def request(target="texture", method="path_tracing", **more):
    return BakeRequest(method, registry.method(method).Settings(), target, **{"resolution": 16, **more})


def said(target="texture", **more):
    return preflight(bpy.context, request(target, **more))


def errors(target="texture", **more):
    return [n for n in said(target, **more) if n.severity == "error"]


def warnings(target="texture", **more):
    return [n for n in said(target, **more) if n.severity == "warning"]


def refused_by(notices, object, reason):
    """The one error has this object and reason, and a remedy; a bake is refused with the same words."""
    assert len(notices) == 1, notices
    assert object in notices[0].object and reason in notices[0].reason and notices[0].remedy, notices[0]
    return notices[0]


def plane(name="Plane", color=(0.8, 0.8, 0.8), emission=None):
    return demo.quad(bpy.context.scene, name, (0, 0, 0), (1, 0, 0), (0, 1, 0), demo.material(name, color, emission))


def room(faces=INWARD, corners=CORNERS, name="Room"):
    return demo.mesh_object(bpy.context.scene, name, corners, faces, demo.material("Wall", (0.5, 0.5, 0.5)))


def lamp(location=(0.5, 0.5, 0.9), energy=10.0):
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = energy, 0.0
    made = bpy.data.objects.new("Lamp", data)
    made.location = location
    bpy.context.scene.collection.objects.link(made)
    return made


def linked(name, kind):
    made = bpy.data.objects.new(name, kind)
    bpy.context.scene.collection.objects.link(made)
    return made


def test_1_empty_scene():
    refused_by(errors(), "Scene", "has no faces and no lights")
    with pytest.raises(AdjointError, match="has no faces and no lights"):
        Bake(bpy.context, request())


def test_a_scene_of_instances_alone_says_how_they_are_baked():
    lamp()
    inner = bpy.data.collections.new("Furniture")
    mesh = bpy.data.meshes.new("Chair")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    inner.objects.link(bpy.data.objects.new("Chair", mesh))
    maker = linked("Maker", None)
    maker.instance_type, maker.instance_collection = "COLLECTION", inner
    (error,) = errors()
    assert error.reason == "has faces to bake in instances only" and "--instances" in error.remedy


def test_2_only_lights_refuses_a_lightmap_and_gives_a_black_picture(tmp_path):
    lamp()
    notices = said()
    assert any("no mesh object with faces to bake" in n.reason for n in notices if n.severity == "error")
    assert any("every result is black" in n.reason for n in notices)
    camera = linked("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0, 0, 50)
    bpy.context.scene.camera = camera
    made = Bake(bpy.context, request("render", output=str(tmp_path), width=8, height=8))
    assert not made.driver.run().quantity("radiance").any()
    assert any("every result is black" in n.reason for n in made.notices)


@pytest.mark.parametrize("points", [[], [(0, 0, 0), (1, 0, 0)]], ids=["3 no vertices", "4 vertices only"])
def test_3_4_meshes_without_faces_are_named_and_refused_when_asked_for(points):
    plane(emission=(1, 1, 1))
    demo.mesh_object(bpy.context.scene, "Points", points, [], demo.material("M", (1, 1, 1)))
    notices = said()
    assert not [n for n in notices if n.severity == "error"]
    assert any("Points" in n.object and "no faces" in n.reason for n in notices)
    assert any("Points" in n.object and "no faces" in n.reason for n in errors(objects=("Points",)))


def test_20_open_box_is_as_good_as_any_and_a_gap_is_a_warning():
    lamp()
    made = room(INWARD[:5])
    notices = said()
    assert not [n for n in notices if n.severity != "info"], notices
    assert not any("open" in n.reason for n in notices), "nothing is at stake"
    bpy.data.objects.remove(made)
    room()
    assert not any("open" in n.reason or "closed" in n.reason for n in said()), "closed"
    bpy.data.objects.remove(bpy.data.objects["Room"])
    room([INWARD[0], *INWARD[2:]])
    demo.quad(bpy.context.scene, "Lid", (0, 0, 1.02), (0, 1, 0), (1, 0, 0), demo.material("Lid", (0.5, 0.5, 0.5)))
    found = [n for n in said() if "nearly closed" in n.reason]
    assert len(found) == 1 and "%" in found[0].reason and found[0].remedy


def test_22_turned_normals_are_told():
    lamp()
    turned = [tuple(reversed(INWARD[0])), *INWARD[1:]]
    room(turned)
    assert warnings() == []
    (notice,) = [n for n in said() if "back" in n.reason]
    assert notice.object == "Room" and notice.reason == "some of its faces are seen or lit from the back only, so their backs are baked"
    bpy.data.objects.remove(bpy.data.objects["Room"])
    room([tuple(reversed(face)) for face in INWARD])
    (notice,) = [n for n in said() if "back" in n.reason]
    assert notice.reason.startswith("all of its faces are seen or lit from the back only")


def test_22_a_sheet_lit_from_both_sides_or_in_a_picture_loses_nothing(tmp_path):
    """Curtains, leaves, panes: much of their light arrives at the back, and their fronts have theirs all the same."""
    lamp()
    for z in (2.0, -2.0):
        demo.quad(bpy.context.scene, f"Lamp {z}", (0, 0, z), (1, 0, 0), (0, 1, 0), demo.material("Lamp", (0, 0, 0), (1, 1, 1)))
    sheet = demo.quad(bpy.context.scene, "Sheet", (0, 0, 0), (1, 0, 0), (0, 1, 0), demo.material("Sheet", (0.5, 0.5, 0.5)))
    assert not [n for n in said() if sheet.name in n.object and "back" in n.reason]
    room([tuple(reversed(face)) for face in INWARD])
    assert not [n for n in said(target="render", output=str(tmp_path)) if "back" in n.reason]


def test_22_objects_with_the_same_trouble_are_one_sentence():
    lamp()
    for k in range(6):
        made = room([tuple(reversed(face)) for face in INWARD])
        made.location.x = 3.0 * k
        lamp().location.x = 3.0 * k + 0.5
    assert len([n for n in said() if "lit from the back only" in n.reason]) == 1


def test_22_boxes_without_a_bottom_do_not_warn():
    scene = demo.build_cornell()
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        assert warnings() == []


def test_26_other_kinds_are_named():
    plane(emission=(1, 1, 1))
    linked("Empty", None)
    volume = linked("Smoke", bpy.data.volumes.new("Smoke"))
    notices = said()
    assert not [n for n in notices if n.severity == "error"]
    assert any(volume.name in n.object for n in notices)
    refused_by(errors(objects=("Empty",)), "Empty", "not a mesh")


def test_27_edit_mode_is_refused_while_the_mesh_would_change():
    made = plane(emission=(1, 1, 1))
    bpy.context.view_layer.objects.active = made
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        for target in ("texture", "attribute"):
            notice = refused_by(errors(target), "Plane", "edit mode")
            assert "edit mode" in notice.remedy.lower()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def test_28_hidden_and_excluded_objects():
    plane("Shown", emission=(1, 1, 1))
    hidden = plane("Hidden")
    hidden.hide_render = True
    away = bpy.data.collections.new("Away")
    bpy.context.scene.collection.children.link(away)
    other = plane("Other")
    bpy.context.scene.collection.objects.unlink(other)
    away.objects.link(other)
    bpy.context.view_layer.layer_collection.children["Away"].exclude = True
    assert errors() == []
    assert [o.name for o in module.target_objects(bpy.context, request())] == ["Shown"]
    refused_by(errors(objects=("Hidden",)), "Hidden", "hidden in render")
    refused_by(errors(objects=("Other",)), "Other", "not in this view layer")
    notice = refused_by(errors(objects=("Nobody",)), "Nobody", "does not exist")
    assert "Shown" in notice.remedy


def test_40_no_light_is_a_warning():
    plane()
    (notice,) = warnings()
    assert "nothing emits light; the result is black" in notice.reason and notice.remedy
    assert errors() == []
    lamp((0.5, 0.5, 1))
    assert warnings() == []


def test_41_no_uv_map_gets_one_and_a_missing_name_is_refused():
    made = plane(emission=(1, 1, 1))
    assert any("one is made" in n.reason and n.severity == "info" for n in said())
    notice = refused_by(errors(uv_layer="Light"), "Plane", 'has no UV layer "Light" (layers: none)')
    assert "leave it empty" in notice.remedy
    assert len(made.data.uv_layers) == 0
    Bake(bpy.context, request())
    assert len(made.data.uv_layers) == 1
    assert not any("one is made" in n.reason for n in said())


def test_42_eight_uv_maps():
    made = plane(emission=(1, 1, 1))
    for k in range(8):
        made.data.uv_layers.new(name=f"UV{k}")
    assert errors(uv_layer="UV3") == []
    assert errors() == [], "a modifier carries the ninth"
    Bake(bpy.context, request())
    assert len(made.data.uv_layers) == 8


def test_46_sizes_of_lightmaps():
    plane(emission=(1, 1, 1))
    assert errors(resolution=1) == []
    for bad in (0, -1, 16385):
        refused_by(errors(resolution=bad), "resolution", str(bad))


def test_49_a_mesh_shared_by_objects():
    made = plane(emission=(1, 1, 1))
    other = linked("Twin", made.data)
    other.location = (3, 0, 0)
    assert errors("texture") == []
    told = [n for n in said("attribute") if "shares its mesh" in n.reason]
    assert {n.severity for n in told} == {"info"} and all(module.SEPARATE in n.reason for n in told)
    assert {name for n in told for name in n.names} == {made.name, other.name}
    assert errors("attribute") == [] and errors("attribute", new_object=True) == []


def test_a_scene_without_meshes_names_scenes_that_have_some():
    plane(emission=(1, 1, 1))
    menu = bpy.data.scenes.new("Menu")
    menu.world = bpy.data.worlds.new("World")
    menu.world.color = (1.0, 1.0, 1.0)
    bpy.context.window.scene = menu
    (told,) = errors()
    refused_by([told], 'Scene "Menu"', 'other scenes of the file have: "Scene"')


def test_55_unsaved_file_is_said(tmp_path):
    plane(emission=(1, 1, 1))
    assert any("never saved" in n.reason and n.severity == "info" for n in said())
    assert not any("never saved" in n.reason for n in said(output=str(tmp_path)))


def test_56_folders_that_cannot_be_written_to(tmp_path, monkeypatch):
    plane(emission=(1, 1, 1))
    file = tmp_path / "file"
    file.write_text("x")
    refused_by(errors(output=str(file)), "file", "is a file, not a folder")
    assert errors(output=str(tmp_path / "new" / "folder")) == []
    # The user who runs the tests may be allowed everything, so the system's answer is replaced.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    refused_by(errors(output=str(tmp_path / "new" / "folder")), tmp_path.name, "no permission")


def test_56_a_folder_beside_an_unsaved_file_is_refused(tmp_path):
    plane(emission=(1, 1, 1))
    notice = refused_by(errors(output="//out"), "Output folder", '"//out" is relative to the .blend file, which is not saved yet')
    assert "Save the file" in notice.remedy
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert errors(output="//out") == [] and not (tmp_path / "out").exists()


def test_56_a_folder_that_cannot_be_made_refuses_before_the_bake(tmp_path, monkeypatch):
    made = plane(emission=(1, 1, 1))

    def refuse(*_, **__):
        raise OSError(2, "No such file or directory")

    monkeypatch.setattr(module.files.Path, "mkdir", refuse)
    with pytest.raises(AdjointError, match="out: cannot be made"):
        Bake(bpy.context, request(output=str(tmp_path / "out")))
    assert not made.data.uv_layers.get("Lightmap")


def _hide(made):
    made.hide_viewport = True


def _flatten(made):
    made.scale = (0, 0, 0)


def _lose(made):
    made.location.x = float("nan")


def _far(made):
    made.location.x = 1e13


def _collection(made):
    hidden = bpy.data.collections.new("Hidden")
    hidden.hide_render = True
    bpy.context.scene.collection.children.link(hidden)
    hidden.objects.link(made)
    bpy.context.scene.collection.objects.unlink(made)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_hide, "is disabled in the viewport"),
        (_flatten, "has a scale of zero or a matrix that is not a number"),
        (_lose, "has a scale of zero or a matrix that is not a number"),
        (_far, "lies further out"),
        (_collection, "is hidden in render"),
        (lambda made: made.data.clear_geometry(), "has no faces"),
    ],
)
def test_an_object_that_is_left_out_gives_one_error_with_the_true_reason(change, reason):
    plane(emission=(1, 1, 1))
    made, other = plane("Left Out"), plane("Other")
    other.location.z = 2
    change(made)
    notice = refused_by(errors(objects=("Left Out", "Other")), "Left Out", reason)
    assert notice.object == "Left Out"
    assert sum(reason in n.reason for n in said(objects=("Left Out", "Other"))) == 1
    # Not asked for, it is no error, and others of the same reason keep theirs.
    assert errors(objects=("Other",)) == []
    second = plane("Also")
    change(second)
    found = [n for n in said(objects=("Left Out", "Other")) if reason in n.reason]
    assert [(n.object, n.severity == "error") for n in found] == [("Left Out", True), ("Also", False)]


def test_equal_reasons_are_one_notice_and_long_lists_are_cut():
    for i in range(7):
        made = plane(f"Plane {i}", emission=(1, 1, 1))
        made.location.z = i
        made.select_set(True)
        bpy.context.view_layer.objects.active = made
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        notice = refused_by(errors("attribute"), "Plane 0, Plane 1, Plane 2, Plane 3 and 3 more", "its mesh is in edit mode")
        assert len(notice.names) == 7
        # Merged again with others, no name is lost or counted twice.
        more = module.ordered([notice, module.Notice("Plane 0", *_words(notice)), module.Notice("New", *_words(notice))])
        assert [n.object for n in more] == ["Plane 0, Plane 1, Plane 2, Plane 3 and 4 more"]
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def _words(notice):
    return notice.reason, notice.remedy, notice.severity


def test_modifiers_that_change_the_mesh_give_an_attribute_an_object_of_its_own():
    made = plane(emission=(1, 1, 1))
    made.modifiers.new("Subdivide", "SUBSURF").levels = 1
    (told,) = [n for n in said("attribute") if module.SEPARATE in n.reason]
    assert told.severity == "info" and "has modifiers" in told.reason
    assert errors("attribute") == [] and errors("attribute", new_object=True) == [] and errors("texture") == []


def test_picture_without_camera_or_folder():
    plane(emission=(1, 1, 1))
    reasons = [n.reason for n in errors("render")]
    assert any("no active camera" in r for r in reasons) and any("no folder" in r for r in reasons)


def test_memory_is_estimated_and_refused(monkeypatch):
    plane(emission=(1, 1, 1))
    assert any("of memory" in n.reason and "256 texels" in n.reason for n in said())
    assert any("elements" in n.reason for n in said(method="progressive_radiosity"))
    monkeypatch.setattr(module, "available_memory", lambda: 1000)
    notice = refused_by(errors(), "Path Tracing", "1 kB are free")
    assert "Lower the resolution" in notice.remedy


def test_big_scenes_are_left_to_the_bake(monkeypatch):
    plane(emission=(1, 1, 1))
    monkeypatch.setattr(module, "QUICK", 1)
    monkeypatch.setattr(module, "extracting", None)
    assert any("looked at when the bake starts" in n.reason for n in said())


def test_nothing_is_changed_by_looking():
    made = plane(emission=(1, 1, 1))
    before = (len(bpy.data.images), len(made.data.uv_layers), list(made.keys()), list(made.data.keys()))
    for target in ("texture", "attribute", "render"):
        said(target)
    assert before == (len(bpy.data.images), len(made.data.uv_layers), list(made.keys()), list(made.data.keys()))


# ---- objects of other files


@pytest.fixture
def library(tmp_path):
    """Put two objects into a file of their own, link them into the empty scene, and give the path of that file."""
    plane("Far"), plane("Shape")
    path = tmp_path / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects, wanted.meshes = ["Far"], ["Shape"]
    bpy.context.scene.collection.objects.link(bpy.data.objects["Far"])
    lamp()
    return path


def test_objects_of_other_files_are_skipped_with_a_warning(library, tmp_path):
    plane("Near")
    for target in ("texture", "attribute"):
        assert errors(target) == []
        (notice,) = [n for n in warnings(target) if "not baked" in n.reason]
        assert notice.object == "Far" and "linked from another file" in notice.reason and "Make it local" in notice.remedy
        assert [o.name for o in module.target_objects(bpy.context, request(target))] == ["Near"]
    made = Bake(bpy.context, request(output=str(tmp_path / "out")))
    made.write(made.driver.run())
    assert any(n.object == "Far" and "not baked" in n.reason for n in made.notices)
    assert any("Near" in name for name in made.files) and not any("Far" in name for name in made.written)
    assert len(made.driver.world.scene.objects) == 2, "it is in the light"


def test_overrides_and_linked_meshes_are_skipped_with_a_warning(library):
    plane("Near")
    linked("Local", bpy.data.meshes["Shape"]).location = (4, 0, 0)
    bpy.data.objects["Far"].override_create(remap_local_usages=True)
    found = {n.object: n for n in warnings() if "not baked" in n.reason}
    assert "library override" in found["Far"].reason and found["Far"].remedy
    assert errors() == []
    # Of a texture nothing has to be written to the mesh, and an attribute goes to an object of its own.
    assert "Local" not in found
    (told,) = [n for n in said("attribute") if n.object == "Local" and module.SEPARATE in n.reason]
    assert 'its mesh "Shape" is linked' in told.reason and told.severity == "info"
    assert "Local" not in {n.object for n in said("attribute", new_object=True) if "not baked" in n.reason}


def test_only_objects_of_other_files_are_refused(library):
    notice = refused_by(errors(), "Far", "linked from another file")
    assert "Make it local" in notice.remedy
    with pytest.raises(AdjointError, match="Far"):
        Bake(bpy.context, request())


def test_objects_of_other_files_that_are_named_are_refused(library):
    plane("Near")
    refused_by(errors(objects=("Far", "Near")), "Far", "linked from another file")


def test_a_missing_library_is_named(library):
    plane("Near")
    use = library.with_name("use.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(use))
    library.unlink()
    with contextlib.suppress(RuntimeError):  # Blender reports the missing file as an error and opens the rest
        bpy.ops.wm.open_mainfile(filepath=str(use))
    (notice,) = [n for n in said() if "Far" in n.object]
    assert notice.severity == "warning" and "its library file is missing" in notice.reason and "library.blend" in notice.reason
    notice = refused_by(errors(objects=("Far",)), "Far", "its library file is missing")
    assert "relocate" in notice.remedy


def test_an_object_that_its_library_lost_is_named(library):
    plane("Near")
    use = library.with_name("use.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(use))
    bpy.ops.wm.open_mainfile(filepath=str(library))
    bpy.data.objects.remove(bpy.data.objects["Far"])
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    with contextlib.suppress(RuntimeError):
        bpy.ops.wm.open_mainfile(filepath=str(use))
    (notice,) = [n for n in said() if "Far" in n.object]
    assert notice.severity == "warning" and "not in its library file any more" in notice.reason and notice.remedy


def test_a_refusal_carries_all_errors():
    plane("Hidden").hide_render = True
    with pytest.raises(AdjointError) as refused:
        Bake(bpy.context, request(objects=("Nobody", "Hidden")))
    assert [n.object for n in (refused.value.notice, *refused.value.others)] == ["Nobody", "Hidden"]
