# SPDX-License-Identifier: GPL-3.0-or-later
"""An extraction is kept while Blender says the same, and never when anything that counts has changed, with or without a sign."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake, rehearse
from adjgi.adjoint_gi.bridge.baking.jobs import BAKES
from adjgi.adjoint_gi.bridge.baking.preflight import preflight
from adjgi.adjoint_gi.bridge.cli.cornell import black_world
from adjgi.adjoint_gi.bridge.extract import depsgraph, mesh, scene_store
from adjgi.adjoint_gi.bridge.extract.depsgraph import extracting
from adjgi.adjoint_gi.bridge.extract.scene_store import SCENES
from adjgi.adjoint_gi.bridge.host.preparation import finish_stages
from adjgi.tests.baking import request
from adjgi.tests.blender.fakes import square
from adjgi.tests.blender.test_extract_slices import at_once, same
from mathutils import Matrix


@pytest.fixture(autouse=True)
def forgotten():
    SCENES.clear()
    yield
    SCENES.clear()
    BAKES.forget()


@pytest.fixture
def scene(registered, tmp_path):
    """Two objects, of which one has all that can be read of a mesh, a lamp, a camera, a world, an instance and a linked object."""
    with_library(tmp_path / "library.blend")
    bpy.ops.mesh.primitive_monkey_add()
    monkey = bpy.context.object
    monkey.name = "Monkey"
    monkey.data.color_attributes.new("Paint", "FLOAT_COLOR", "CORNER")
    monkey.modifiers.new("Round", "SUBSURF").levels = 0
    monkey.modifiers.new("Wave", "SIMPLE_DEFORM").angle = 0.0
    square("Plain")
    material = bpy.data.materials.new("Painted")
    material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.new("Image", 4, 4)
    file = bpy.data.images.new("File", 4, 4)
    file.filepath_raw, file.file_format = str(tmp_path / "file.png"), "PNG"
    file.save()
    bpy.data.images.remove(file)
    second = material.node_tree.nodes.new("ShaderNodeTexImage")
    second.image = bpy.data.images.load(str(tmp_path / "file.png"))
    shader = material.node_tree.nodes["Principled BSDF"]
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Emission Strength"].default_value = 1.0
    material.node_tree.links.new(second.outputs["Color"], shader.inputs["Emission Color"])
    for k in range(2):
        monkey.data.materials.append(material if k == 0 else bpy.data.materials.new("Other"))
    made = bpy.context.scene
    for name, data in (("Lamp", bpy.data.lights.new("Lamp", "POINT")), ("Camera", bpy.data.cameras.new("Camera"))):
        made.collection.objects.link(bpy.data.objects.new(name, data))
    made.camera = bpy.data.objects["Camera"]
    made.world = bpy.data.worlds.new("World")
    collection = bpy.data.collections.new("Set")
    collection.objects.link(bpy.data.objects["Plain"])
    empty = bpy.data.objects.new("Maker", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    made.collection.objects.link(empty)
    driven = bpy.data.objects["Plain"].driver_add("location", 2).driver
    driven.expression = "frame * 0.1"
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, data):
        data.objects = ["Linked"]
    made.collection.objects.link(data.objects[0])
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="Start")
    return made


def with_library(path: Path, size: float = 1.0) -> None:
    """A file with one object, and the present one as it was."""
    obj = square("Linked")
    obj.data.transform(Matrix.Scale(size, 4))
    bpy.data.libraries.write(str(path), {obj})
    bpy.data.batch_remove([obj, obj.data])


def monkey():
    return bpy.data.objects["Monkey"]


def mesh_values(data, name, values, update):
    data.foreach_set(name, values)
    if update:
        monkey().data.update()


def pixels(name, value):
    image = bpy.data.images[name]
    image.pixels.foreach_set(np.full(len(image.pixels), value, np.float32))


def repainted_file(scene):
    image = bpy.data.images["file.png"]
    other = bpy.data.images.new("Other", 4, 4)
    other.pixels.foreach_set(np.full(64, 0.7, np.float32))
    other.filepath_raw, other.file_format = image.filepath, "PNG"
    other.save()
    bpy.data.images.remove(other)
    image.reload()


def reloaded_library(scene):
    library = bpy.data.libraries[0]
    with_library(Path(bpy.path.abspath(library.filepath)), 3.0)
    library.reload()


def overridden(scene):
    bpy.context.view_layer.material_override = bpy.data.materials["Other"]


def sharp(scene):
    values = np.zeros(len(monkey().data.polygons), bool)
    mesh_values(monkey().data.polygons, "use_smooth", ~values, True)


def undone(scene):
    monkey().location.x += 1.0
    bpy.ops.ed.undo_push(message="Move")
    finish_stages(extracting())
    bpy.ops.ed.undo()


EDITS = {
    "vertices": lambda s: mesh_values(monkey().data.vertices, "co", np.zeros(3 * len(monkey().data.vertices), np.float32), True),
    "one vertex": lambda s: setattr(monkey().data.vertices[7].co, "x", 3.0) or monkey().data.update(),
    "vertices without a sign": lambda s: mesh_values(
        monkey().data.attributes["position"].data, "vector", np.ones(3 * len(monkey().data.vertices), np.float32), False
    ),
    "uv": lambda s: mesh_values(monkey().data.uv_layers[0].uv, "vector", np.zeros(2 * len(monkey().data.loops), np.float32), True),
    "uv without a sign": lambda s: mesh_values(
        monkey().data.uv_layers[0].uv, "vector", np.zeros(2 * len(monkey().data.loops), np.float32), False
    ),
    "paint": lambda s: mesh_values(
        monkey().data.color_attributes[0].data, "color", np.full(4 * len(monkey().data.loops), 0.3, np.float32), True
    ),
    "smooth": sharp,
    "slots": lambda s: mesh_values(
        monkey().data.polygons, "material_index", np.arange(len(monkey().data.polygons), dtype=np.int32) % 2, True
    ),
    "selection": lambda s: mesh_values(monkey().data.polygons, "select", np.zeros(len(monkey().data.polygons), bool), True),
    "node value": lambda s: setattr(
        bpy.data.materials["Painted"].node_tree.nodes["Principled BSDF"].inputs["Roughness"], "default_value", 0.17
    ),
    "node link": lambda s: bpy.data.materials["Painted"].node_tree.links.remove(bpy.data.materials["Painted"].node_tree.links[-1]),
    "painted image": lambda s: pixels("Image", 0.25),
    "image of a file": repainted_file,
    "image settings": lambda s: setattr(bpy.data.images["Image"].colorspace_settings, "name", "Non-Color"),
    "material": lambda s: setattr(monkey().material_slots[0], "material", bpy.data.materials["Other"]),
    "override": overridden,
    "lamp": lambda s: setattr(bpy.data.lights["Lamp"], "energy", 3.0),
    "lamp's place": lambda s: setattr(bpy.data.objects["Lamp"].location, "x", 3.0),
    "lamp's rays": lambda s: setattr(bpy.data.objects["Lamp"], "visible_camera", not bpy.data.objects["Lamp"].visible_camera),
    "move": lambda s: setattr(monkey().location, "z", 0.001),
    "mirror": lambda s: setattr(monkey().scale, "x", -1.0),
    "hide": lambda s: setattr(monkey(), "hide_render", True),
    "disable": lambda s: setattr(monkey(), "hide_viewport", True),
    "collection": lambda s: setattr(bpy.data.collections["Set"], "hide_render", True),
    "modifier": lambda s: setattr(monkey().modifiers["Round"], "levels", 1),
    "modifier's number": lambda s: setattr(monkey().modifiers["Wave"], "angle", 1.0),
    "modifier gone": lambda s: monkey().modifiers.clear() or setattr(monkey().location, "x", 1e-3),
    "frame": lambda s: s.frame_set(7),
    "driver": lambda s: setattr(bpy.data.objects["Plain"].animation_data.drivers[0].driver, "expression", "5.0"),
    "world": lambda s: black_world(s.world, (0.5, 0.25, 0.125)),
    "camera": lambda s: setattr(s.camera.data, "lens", 20.0),
    "picture": lambda s: setattr(s.render, "resolution_x", 100),
    "name": lambda s: setattr(monkey(), "name", "Ape"),
    "new object": lambda s: square("New"),
    "object gone": lambda s: bpy.data.objects.remove(monkey()),
    "instance": lambda s: setattr(bpy.data.objects["Maker"].location, "y", 2.0),
    "library": reloaded_library,
    "undo": undone,
    "ray visibility": lambda s: setattr(monkey(), "visible_diffuse", False),
}


@pytest.mark.parametrize("edit", EDITS)
def test_every_edit_is_seen(scene, edit):
    before = finish_stages(extracting())
    assert finish_stages(extracting()) is before, "nothing has changed"
    EDITS[edit](scene)
    found, wanted = finish_stages(extracting()), at_once()
    assert same(found, wanted)
    if "without a sign" not in edit and edit != "undo":
        assert found is not before and not same(found, before), "or the edit tests nothing"


@pytest.fixture
def counted(monkeypatch):
    """How often what is computed of an extraction was computed."""
    calls = dict.fromkeys(("_usable", "_normals", "place", "World"), 0)
    for where, name in ((mesh, "_usable"), (mesh, "_normals"), (depsgraph, "place"), (scene_store, "World")):
        made = getattr(where, name)

        def counting(*a, made=made, name=name, **k):
            calls[name] += 1
            return made(*a, **k)

        monkeypatch.setattr(where, name, counting)
    return calls


def test_check_and_bakes_extract_once(registered, counted):
    """The first bake makes UV layers, so there are two scenes; before and after that each is extracted once, however often it is asked."""
    square("A")
    square("B")
    asked = request(values={"samples": 1}, resolution=8)
    once = {"_usable": 2, "_normals": 2, "place": 1, "World": 1}
    preflight(bpy.context, asked)
    rehearse(bpy.context, asked)
    first = dict(counted)
    assert first == {name: 2 * count for name, count in once.items()}, "the rehearsal makes layers and takes them back"
    job = BAKES.run(bpy.context, asked, lambda fraction: None)
    made = {name: counted[name] - first[name] for name in first}
    assert made == {name: 2 * count for name, count in once.items()}, "the check's scene is gone, and layers are made"
    again = Bake(bpy.context, asked)
    preflight(bpy.context, asked)
    assert counted == {name: 4 * count for name, count in once.items()}
    assert again.driver.world is job.bake.driver.world
    again.driver.run()
    assert np.array_equal(again.driver.solution().direct, job.bake.driver.solution().direct)


def test_what_is_large_is_not_kept(registered, monkeypatch):
    square("A")
    found = finish_stages(extracting())
    monkeypatch.setattr(scene_store, "MOST", scene_store.needed(found) - 1)
    assert finish_stages(extracting()) is found
    bpy.data.objects["A"].location.x = 1.0
    assert finish_stages(extracting()) is not finish_stages(extracting())


def test_another_file_and_the_end_forget_it(registered):
    square("A")
    found = finish_stages(extracting())
    assert SCENES.world(found) is SCENES.world(found)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert SCENES._kept is None and SCENES.world(found) is not SCENES.world(found)
    scene_store.SCENES._kept = scene_store.Kept(b"", found)
    scene_store.unregister()
    assert SCENES._kept is None
    scene_store.register()
