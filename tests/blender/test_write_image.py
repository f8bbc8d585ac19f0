"""Images: exact numbers through saving and loading, found again by link, never another object's."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.results import links as targets
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels, remove_images, write_image
from adjgi.adjoint_gi.core.base.errors import TargetError, WriteError
from adjgi.adjoint_gi.core.receivers.texels import Placement


def plane(name="Plane", mesh=None):
    if mesh is None:
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
        mesh.uv_layers.new(name="UVMap")
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def values(h=5, w=7, seed=0):
    rng = np.random.default_rng(seed)
    pixels = (rng.random((h, w, 3)) * 10.0 ** rng.integers(-6, 6, (h, w, 3))).astype(np.float32)
    pixels[0, 0] = [123.25, 1e9, 0.18]
    return pixels, (rng.integers(0, 5, (h, w)) / 4).astype(np.float32)


def same(image, pixels, coverage):
    back = read_pixels(image)
    return back is not None and np.array_equal(back[..., :3], pixels) and np.array_equal(back[..., 3], coverage)


def reload(tmp_path, obj):
    name = obj.name
    path = str(tmp_path / "file.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path, compress=False)
    bpy.ops.wm.open_mainfile(filepath=path)
    return bpy.data.objects[name]


def test_every_float_survives_saving_and_loading(tmp_path):
    obj = plane()
    pixels, coverage = values()
    image = write_image([obj], "irradiance", pixels, coverage)
    assert image.colorspace_settings.name == "Non-Color" and image.is_float and image.alpha_mode == "CHANNEL_PACKED"
    obj = reload(tmp_path, obj)
    image = linked_image(obj, "irradiance")
    assert image.packed_file is not None and image.colorspace_settings.name == "Non-Color"
    assert same(image, pixels, coverage)


def test_a_second_bake_updates_the_same_image_even_when_renamed_resized_and_reloaded(tmp_path):
    obj = plane()
    write_image([obj], "irradiance", *values())
    linked_image(obj, "irradiance").name = "The user likes this name"
    obj = reload(tmp_path, obj)
    pixels, coverage = values(4, 11, 1)
    image = write_image([obj], "irradiance", pixels, coverage)
    assert image.name == "The user likes this name" and len(bpy.data.images) == 1
    obj = reload(tmp_path, obj)
    assert same(linked_image(obj, "irradiance"), pixels, coverage)


def test_quantities_are_kept_apart_and_a_foreign_image_of_the_same_name_is_left_alone():
    obj = plane()
    foreign = bpy.data.images.new("Plane irradiance", 3, 3)
    a = write_image([obj], "irradiance", *values())
    b = write_image([obj], "direct", *values(seed=2))
    assert a != b != foreign and a != foreign and tuple(foreign.size) == (3, 3)
    assert same(a, *values()) and same(b, *values(seed=2))


def test_objects_that_share_a_mesh_get_different_images():
    first = plane("First")
    second = plane("Second", first.data)
    a, b = write_image([first], "irradiance", *values()), write_image([second], "irradiance", *values(seed=1))
    assert a != b and same(a, *values()) and same(b, *values(seed=1))


def test_a_copy_of_an_object_does_not_overwrite_the_image_of_its_original():
    first = plane("First")
    a = write_image([first], "irradiance", *values())
    copy = first.copy()
    bpy.context.scene.collection.objects.link(copy)
    assert linked_image(copy, "irradiance") is None
    b = write_image([copy], "irradiance", *values(seed=1))
    assert b != a and same(a, *values())
    assert write_image([first], "irradiance", *values(seed=3)) == a


def test_a_renamed_object_keeps_its_image():
    obj = plane()
    a = write_image([obj], "irradiance", *values())
    obj.name = "Other"
    assert write_image([obj], "irradiance", *values(seed=1)) == a


def test_an_atlas_is_one_image_and_stores_the_placement():
    objs = [plane("A"), plane("B")]
    place = {"A": Placement((0.5, 0.5), (0, 0)), "B": Placement((0.5, 0.5), (0.5, 0))}
    a = write_image(objs, "irradiance", *values(), uv_layer="UVMap", placement=place)
    assert linked_image(objs[0], "irradiance") == linked_image(objs[1], "irradiance") == a
    assert list(targets.link(objs[1], "irradiance")["offset"]) == [0.5, 0]
    assert write_image(objs, "irradiance", *values(seed=1), placement=place) == a
    # Alone, an object leaves the atlas and the other keeps it as it is.
    alone = write_image([objs[0]], "irradiance", *values(seed=2))
    assert alone != a and same(a, *values(seed=1)) and linked_image(objs[1], "irradiance") == a


def test_a_deleted_image_is_made_again():
    obj = plane()
    bpy.data.images.remove(write_image([obj], "irradiance", *values()))
    assert linked_image(obj, "irradiance") is None
    assert same(write_image([obj], "irradiance", *values(seed=1)), *values(seed=1))


def test_an_external_file_is_shown_with_exact_numbers(tmp_path):
    obj = plane()
    pixels, coverage = values()
    path = tmp_path / "Plane.exr"
    image = write_image([obj], "irradiance", pixels, coverage, file=path, folder=tmp_path)
    assert image.packed_file is None and Path(bpy.path.abspath(image.filepath)) == path and same(image, pixels, coverage)
    obj = reload(tmp_path, obj)
    assert same(linked_image(obj, "irradiance"), pixels, coverage)
    again = values(3, 4, 1)
    image = write_image([obj], "irradiance", *again, file=path, folder=tmp_path)
    assert len(bpy.data.images) == 1 and image.filepath == "//Plane.exr" and same(image, *again)
    # From the file into the .blend and back.
    assert write_image([obj], "irradiance", *values(seed=5)) == image and image.packed_file is not None
    obj = reload(tmp_path, obj)
    assert same(linked_image(obj, "irradiance"), *values(seed=5))
    image = write_image([obj], "irradiance", *values(seed=6), file=path, folder=tmp_path)
    assert image.packed_file is None and same(image, *values(seed=6))


def test_a_deleted_external_file_is_made_again(tmp_path):
    obj = plane()
    path = tmp_path / "Plane.exr"
    write_image([obj], "irradiance", *values(), file=path, folder=tmp_path)
    obj = reload(tmp_path, obj)
    path.unlink()
    bpy.data.images[0].reload()
    image = write_image([obj], "irradiance", *values(seed=1))
    assert same(image, *values(seed=1))


def test_a_file_of_others_stops_the_write_before_anything_changes(tmp_path):
    obj = plane()
    (tmp_path / "Plane.exr").write_bytes(b"mine")
    with pytest.raises(TargetError, match="not written by Adjoint GI"):
        write_image([obj], "irradiance", *values(), file=tmp_path / "Plane.exr", folder=tmp_path)
    assert len(bpy.data.images) == 0 and targets.RESULTS not in obj


def test_bad_values_and_shapes_are_refused_and_the_old_image_stays():
    obj = plane()
    image = write_image([obj], "irradiance", *values())
    bad = values(seed=1)
    bad[0][2, 2, 1] = np.nan
    with pytest.raises(WriteError, match="1 values of the result are not finite"):
        write_image([obj], "irradiance", *bad)
    with pytest.raises(WriteError, match="do not fit"):
        write_image([obj], "irradiance", np.zeros((2, 2, 3)), np.zeros((3, 2)))
    assert same(image, *values())


def test_objects_that_cannot_keep_a_result_are_refused(tmp_path):
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    with pytest.raises(TargetError, match="Lamp: is a light"):
        write_image([lamp], "irradiance", *values())
    plane("Linked")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["Linked"]
    linked = bpy.data.objects["Linked"]
    bpy.context.scene.collection.objects.link(linked)
    with pytest.raises(TargetError, match="Linked: is linked from another file"):
        write_image([linked], "irradiance", *values())
    override = linked.override_create()
    bpy.context.scene.collection.objects.link(override)
    with pytest.raises(TargetError, match="library override"):
        write_image([override], "irradiance", *values())
    assert len(bpy.data.images) == 0


def test_removing_results_leaves_nothing_of_ours():
    objs = [plane("A"), plane("B")]
    user = bpy.data.images.new("User", 2, 2)
    write_image(objs, "irradiance", *values())
    kept = write_image(objs, "direct", *values())
    kept.use_fake_user = True
    material = bpy.data.materials.new("Uses it")
    material["image"] = kept
    assert remove_images(objs) == 1
    assert set(bpy.data.images) == {user, kept}
    assert all(targets.RESULTS not in o for o in objs)
