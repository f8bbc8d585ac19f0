"""Showing a result and putting the user's materials back: exact, also after saving, and for objects that share a mesh."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.host.versions import uses_nodes
from adjgi.adjoint_gi.bridge.results import links as targets
from adjgi.adjoint_gi.bridge.results import preview
from adjgi.adjoint_gi.bridge.results.attribute import write_attribute
from adjgi.adjoint_gi.bridge.results.image import linked_image, write_image
from adjgi.adjoint_gi.core.base.errors import TargetError
from adjgi.adjoint_gi.core.receivers.texels import Placement


def plain(value):
    """A property value as something that can be compared and outlives the data it came from."""
    if isinstance(value, bpy.types.ID):
        return (type(value).__name__, value.name_full)
    if isinstance(value, bpy.types.bpy_struct):
        return structure(value)
    if hasattr(value, "__len__") and not isinstance(value, (str, bytes, set)):
        return tuple(plain(x) for x in value)
    return value if not isinstance(value, set) else tuple(sorted(value))


SKIPPED = {"rna_type", "node_tree", "internal_links", "links", "is_evaluated", "users", "preview", "session_uid", "id_data"}


def structure(thing, skip=SKIPPED):
    """Every property of a Blender struct, except links to its owner."""
    out = {}
    for p in thing.bl_rna.properties:
        if p.identifier in skip or p.type == "COLLECTION" or p.identifier in ("node", "from_node", "to_node", "parent", "use_nodes"):
            continue
        if p.type == "POINTER" and not isinstance(getattr(thing, p.identifier, None), bpy.types.ID):
            continue
        out[p.identifier] = plain(getattr(thing, p.identifier, None))
    return out


def custom(owner):
    """Custom properties as plain values."""
    return {k: v.to_dict() if hasattr(v, "to_dict") else plain(v) for k, v in owner.items()}


def tree_of(tree):
    """Everything in a node tree: nodes, sockets with their values, and links."""
    if tree is None:
        return None
    nodes = {}
    for n in tree.nodes:
        sockets = [[structure(s) for s in sockets] for sockets in (n.inputs, n.outputs)]
        nodes[n.name] = (structure(n), sockets)
    links = [(k.from_node.name, k.from_socket.identifier, k.to_node.name, k.to_socket.identifier) for k in tree.links]
    return nodes, links, custom(tree)


def everything():
    """Materials, meshes, and slots of the file as plain values."""
    materials = {m.name: (structure(m), uses_nodes(m), tree_of(m.node_tree), m.users, custom(m)) for m in bpy.data.materials}
    meshes = {}
    for m in bpy.data.meshes:
        index = np.zeros(len(m.polygons), np.int32)
        m.polygons.foreach_get("material_index", index)
        meshes[m.name] = ([x and x.name for x in m.materials], index.tolist(), custom(m), sorted(a.name for a in m.attributes))
    objects = {}
    for o in bpy.data.objects:
        slots = []
        for slot in o.material_slots:
            link = slot.link
            slot.link = "OBJECT"
            slots.append((link, slot.material and slot.material.name))
            slot.link = link
            slots[-1] += (slot.material and slot.material.name,)
        objects[o.name] = (slots, o.active_material_index, [k for k in o.keys() if k != targets.RESULTS])  # noqa: SIM118
    return materials, meshes, objects


def material(name, color=(0.2, 0.4, 0.6, 1)):
    m = bpy.data.materials.new(name)
    if m.node_tree is None:
        m.use_nodes = True
    m.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color
    return m


def plane(name="Plane", mesh=None, materials=()):
    if mesh is None:
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [], [(0, 1, 2, 3)])
        mesh.uv_layers.new(name="UVMap")
        for m in materials:
            mesh.materials.append(m)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def bake(obj, key="irradiance", value=2.0, **more):
    return write_image([obj], key, np.full((4, 4, 3), value, np.float32), np.ones((4, 4)), uv_layer="UVMap", **more)


def rich_scene():
    """Objects with every kind of slot: mesh, object, empty, textured, without nodes, shared mesh, no slots at all."""
    texture = material("Textured")
    image = texture.node_tree.nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.new("Picture", 2, 2)
    texture.node_tree.links.new(image.outputs["Color"], texture.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
    mix = material("Mixed")
    tree = mix.node_tree
    diffuse, shader = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeMixShader")
    tree.links.new(diffuse.outputs[0], shader.inputs[1])
    tree.links.new(tree.nodes["Principled BSDF"].outputs[0], shader.inputs[2])
    tree.links.new(shader.outputs[0], tree.get_output_node("ALL").inputs["Surface"])
    first = plane("First", materials=[texture, None, mix])
    first.material_slots[1].link = "OBJECT"
    first.material_slots[1].material = material("On the object")
    first.material_slots[2].link = "OBJECT"  # an empty slot of the object hides the mesh's material
    first.active_material_index = 2
    twin = plane("Twin", first.data)
    bare = plane("Bare")
    bare.data.polygons.foreach_set("material_index", [3])
    bare_twin = plane("Bare Twin", bare.data)
    objs = [first, twin, bare, bare_twin]
    for k, obj in enumerate(objs):
        bake(obj, value=float(k))
    return objs


def difference(a, b, path=""):
    """Where two nested values differ, for a message that can be read."""
    if type(a) is not type(b) or not isinstance(a, (dict, list, tuple)):
        return [] if a == b else [f"{path}: {a!r} became {b!r}"]
    if isinstance(a, dict):
        out = [f"{path}: {sorted(map(str, set(a) ^ set(b)))} on one side only"] if set(a) != set(b) else []
        return out + [d for k in a if k in b for d in difference(a[k], b[k], f"{path}/{k}")]
    out = [f"{path}: {len(a)} items became {len(b)}"] if len(a) != len(b) else []
    return out + [d for k, (x, y) in enumerate(zip(a, b, strict=False)) for d in difference(x, y, f"{path}/{k}")]


def test_the_comparison_sees_small_changes():
    objs = rich_scene()
    before = everything()
    nodes = bpy.data.materials["Textured"].node_tree.nodes
    socket = nodes["Principled BSDF"].inputs["Roughness"]
    old = socket.default_value
    socket.default_value = old + 1e-3
    assert difference(before, everything())
    socket.default_value = old
    assert not difference(before, everything())
    objs[0].material_slots[0].link = "OBJECT"
    assert difference(before, everything())
    objs[0].material_slots[0].link = "DATA"
    nodes["Principled BSDF"].location.x += 1
    assert difference(before, everything())


def test_restore_is_exact():
    objs = rich_scene()
    before = everything()
    preview.show(objs, "irradiance")
    assert all(preview.shown(o) for o in objs)
    during = everything()
    assert {k: v[:3] for k, v in during[0].items() if k in before[0]} == {k: v[:3] for k, v in before[0].items()}
    assert preview.restore(objs) == 4 and not any(preview.shown(o) for o in objs)
    assert difference(before, everything()) == []
    assert preview.restore(objs) == 0


def test_restore_is_exact_after_saving_and_loading(tmp_path):
    objs = rich_scene()
    path = str(tmp_path / "a.blend")
    # Materials without a user are not saved; the comparison starts from a loaded file.
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    before = everything()
    preview.show([bpy.data.objects[n] for n in before[2]], "irradiance")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert preview.restore(list(bpy.data.objects)) == 4 == len(objs)
    assert difference(before, everything()) == []


def test_showing_twice_and_switching_the_quantity_still_restores_exactly():
    objs = rich_scene()
    for obj in objs:
        bake(obj, "radiosity")
    before = everything()
    preview.show(objs, "irradiance")
    count = len(bpy.data.materials)
    preview.show(objs, "irradiance")
    assert len(bpy.data.materials) == count
    preview.show(objs, "radiosity")
    preview.restore(objs)
    assert difference(before, everything()) == []


def test_a_new_bake_changes_only_the_previews_that_show_its_quantity():
    one, other, unshown = (plane(name, materials=[material(name)]) for name in ("One", "Other", "Unshown"))
    for obj in (one, other, unshown):
        bake(obj)
        bake(obj, "direct")
    preview.show([one], "irradiance")
    preview.show([other], "direct")

    def shown():
        return [obj.material_slots[0].material for obj in (one, other, unshown)]

    before = shown()
    # The same picture is the same preview, of whatever is shown.
    preview.follow([one, other, unshown], "irradiance")
    assert shown() == before
    for obj in (one, other, unshown):
        targets.forget(obj, ["irradiance"])
        bake(obj, value=3.0)
    preview.follow([one, other, unshown], "irradiance")
    names = [m.name for m in shown()]
    assert shown()[0] != before[0] and shown()[1:] == before[1:] and names[2] == "Unshown"
    assert [obj.get(preview.STATE, {}).get("key") for obj in (one, other, unshown)] == ["irradiance", "direct", None]
    image = next(n.image for n in shown()[0].node_tree.nodes if n.type == "TEX_IMAGE")
    assert image == linked_image(one, "irradiance")


def test_restoring_one_of_two_keeps_the_other():
    objs = rich_scene()
    before = everything()
    preview.show(objs, "irradiance")
    preview.restore([objs[0], objs[2]])
    assert preview.shown(objs[1]) and objs[1].material_slots[0].material.get(preview.OURS)
    assert preview.shown(objs[3]) and objs[3].material_slots[0].material.get(preview.OURS)
    assert objs[0].material_slots[0].material.name == "Textured"
    preview.restore([objs[1], objs[3]])
    assert difference(before, everything()) == []


def test_objects_that_share_a_mesh_show_their_own_image():
    first, twin, *_ = objs = rich_scene()
    preview.show(objs, "irradiance")
    images = []
    for obj in (first, twin):
        nodes = obj.material_slots[0].material.node_tree.nodes
        images.append(next(n.image for n in nodes if n.type == "TEX_IMAGE" and n.image.name != "Picture"))
    assert images == [linked_image(first, "irradiance"), linked_image(twin, "irradiance")] and images[0] != images[1]


def test_a_material_of_the_user_put_in_meanwhile_stays():
    obj = plane(materials=[material("Old")])
    bake(obj)
    preview.show([obj], "irradiance")
    new = material("New")
    obj.material_slots[0].material = new
    preview.restore([obj])
    assert obj.material_slots[0].material == new and not preview.shown(obj)


def test_missing_results_change_nothing():
    objs = rich_scene()
    other = plane("No result", materials=[material("Plain")])
    before = everything()
    with pytest.raises(TargetError, match="No result: has no result for irradiance"):
        preview.show([*objs, other], "irradiance")
    assert difference(before, everything()) == []


def radiance(obj, size=8):
    """Mean rendered radiance of a plane that fills an orthographic camera: Cycles, raw float values."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.cycles.use_denoising = False
    scene.cycles.device = "CPU"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.9
    camera.location = (0.5, 0.5, 3)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def render(scene, path):
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.is_data = True
    out = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(out)
    return out.reshape(*image.size, 4)[..., :3]


@pytest.mark.parametrize("case", ["irradiance", "radiosity", "attribute", "atlas", "no nodes", "no material"])
def test_the_picture_has_the_right_radiance(case, tmp_path):
    if "CYCLES" not in {e.identifier for e in bpy.types.RenderSettings.bl_rna.properties["engine"].enum_items} and not hasattr(
        bpy.types.Scene, "cycles"
    ):
        pytest.skip("this Blender has no Cycles")
    base = np.array([0.2, 0.4, 0.6])
    if case == "no nodes":
        m = bpy.data.materials.new("No nodes")
        m.diffuse_color = (*base, 1)
        if uses_nodes(m):
            pytest.skip("materials always use nodes in Blender 5.0 and later")
    else:
        m = material("Base", (*base, 1))
    obj = plane(materials=[] if case == "no material" else [m])
    if case == "no material":
        base = np.full(3, 0.8)
    value = np.array([3.0, 5.0, 7.0], np.float32)
    key = "radiosity" if case == "radiosity" else "irradiance"
    if case == "attribute":
        write_attribute(obj, key, "CORNER", np.tile(value, (4, 1)), np.ones(4))
    elif case == "atlas":
        # The object's value stands in the upper right quarter, something else in the rest.
        pixels = np.full((8, 8, 3), 100, np.float32)
        pixels[4:, 4:] = value
        place = {obj.name: Placement((0.5, 0.5), (0.5, 0.5))}
        write_image([obj], key, pixels, np.ones((8, 8)), uv_layer="UVMap", placement=place)
    else:
        write_image([obj], key, np.tile(value, (4, 4, 1)), np.ones((4, 4)), uv_layer="UVMap")
    scene = radiance(obj)
    preview.show([obj], key)
    got = render(scene, tmp_path / "picture.exr")
    want = value / np.pi * (1 if case == "radiosity" else base)
    inner = got[1:-1, 1:-1] if case == "atlas" else got
    assert np.allclose(inner, want, rtol=2e-3)


def pixel(obj, path, key="irradiance"):
    """Radiance (3,) in the middle of the picture with the preview of `obj`."""
    scene = radiance(obj)
    preview.show([obj], key)
    return render(scene, path)[4, 4]


def shining(m, strength=2.0, color=(1.0, 0.5, 0.0, 1.0)):
    inputs = m.node_tree.nodes["Principled BSDF"].inputs
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = color, strength
    return m


def behind(value=10.0):
    """A plane behind the first that emits `value`."""
    m = bpy.data.materials.new("Behind")
    if m.node_tree is None:
        m.use_nodes = True
    tree = m.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value, emission.inputs["Strength"].default_value = (1, 1, 1, 1), value
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    plane("Behind", materials=[m]).location.z = -1


BASE = np.array([0.2, 0.4, 0.6])
LIT = BASE * 2.0 / np.pi  # of `bake`


def by_group(m):
    """The shader of `m` inside a node group."""
    tree = m.node_tree
    inner = bpy.data.node_groups.new("Inner", "ShaderNodeTree")
    inner.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    shader, end = inner.nodes.new("ShaderNodeBsdfDiffuse"), inner.nodes.new("NodeGroupOutput")
    shader.inputs["Color"].default_value = (*BASE, 1)
    inner.links.new(shader.outputs[0], end.inputs[0])
    group = tree.nodes.new("ShaderNodeGroup")
    group.node_tree = inner
    tree.links.new(group.outputs[0], tree.get_output_node("ALL").inputs["Surface"])


def see_through(m, alpha):
    m.node_tree.nodes["Principled BSDF"].inputs["Alpha"].default_value = alpha


def transparent_mix(m):
    """Half of a Transparent shader."""
    tree = m.node_tree
    mix, clear = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    tree.links.new(tree.nodes["Principled BSDF"].outputs[0], mix.inputs[1])
    tree.links.new(clear.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.get_output_node("ALL").inputs["Surface"])


def glassy(m, weight=1.0):
    inputs = m.node_tree.nodes["Principled BSDF"].inputs
    inputs["Transmission Weight"].default_value, inputs["Roughness"].default_value, inputs["IOR"].default_value = weight, 0.0, 1.0
    inputs["Base Color"].default_value = (1, 1, 1, 1)


CLEAR = {
    "emission": (lambda m: shining(m), LIT + 2.0 * np.array([1.0, 0.5, 0.0])),
    "alpha 0": (lambda m: see_through(m, 0.0), np.full(3, 10.0)),
    "alpha of an emitter": (lambda m: see_through(shining(m), 0.25), 0.25 * (LIT + 2.0 * np.array([1.0, 0.5, 0.0])) + 7.5),
    "half transparent": (transparent_mix, 0.5 * LIT + 5.0),
    "glass": (glassy, np.full(3, 10.0)),
    "half glass": (lambda m: glassy(m, 0.5), 5.0 + 0.5 * 2.0 / np.pi),
    "a group": (by_group, LIT),
}


@pytest.mark.parametrize("case", CLEAR)
def test_what_lets_light_pass_or_emits_stays_as_it_is(case, tmp_path):
    change, want = CLEAR[case]
    m = material("Base", (*BASE, 1))
    change(m)
    obj = plane(materials=[m])
    bake(obj)
    behind()
    scene = radiance(obj)
    scene.camera.data.ortho_scale = 0.5
    before = everything(), len(bpy.data.node_groups)
    preview.show([obj], "irradiance")
    scene.cycles.samples = 4096
    scene.cycles.use_denoising = False
    scene.render.resolution_x = scene.render.resolution_y = 4
    got = render(scene, tmp_path / "picture.exr").mean(axis=(0, 1))
    assert np.allclose(got, want, rtol=0.02), (got, want)
    preview.restore([obj])
    assert difference(before[0][0], everything()[0]) == [] and len(bpy.data.node_groups) == before[1]


def test_other_quantities_show_no_emission_of_their_own(tmp_path):
    obj = plane(materials=[shining(material("Base", (*BASE, 1)))])
    for key in ("direct", "radiosity"):
        bake(obj, key)
    assert np.allclose(pixel(obj, tmp_path / "direct.exr", "direct"), LIT, rtol=2e-3)
    assert np.allclose(pixel(obj, tmp_path / "radiosity.exr", "radiosity"), 2 / np.pi, rtol=2e-3)


def test_a_mesh_that_has_changed_is_magenta(tmp_path):
    obj = plane(materials=[material("Base", (*BASE, 1))])
    bake(obj)
    obj.data.uv_layers["UVMap"].uv.foreach_set("vector", np.full(8, -1, np.float32))
    got = pixel(obj, tmp_path / "picture.exr")
    assert np.allclose(got, BASE * [1, 0, 1], rtol=2e-3)


@pytest.mark.parametrize("muted", ("shader", "mix", "color link", "shader link", "nothing"))
def test_what_is_muted_shades_nothing_in_the_preview(muted, tmp_path):
    """As Cycles has it: a muted Principled gives nothing, a muted Mix its first shader, a muted link the value that was typed."""
    made = material("m", (0.25, 0.5, 1.0, 1.0))
    tree = made.node_tree
    shader, output = tree.nodes["Principled BSDF"], tree.get_output_node("ALL")
    colour, mix = tree.nodes.new("ShaderNodeRGB"), tree.nodes.new("ShaderNodeMixShader")
    colour.outputs[0].default_value = (0.5, 0.5, 0.5, 1.0)
    tree.links.new(colour.outputs[0], shader.inputs["Base Color"])
    tree.links.new(shader.outputs[0], mix.inputs[1])
    mix.inputs[0].default_value = 0.75
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    shader.mute, mix.mute = muted == "shader", muted == "mix"
    for link, name in ((shader.inputs["Base Color"].links[0], "color link"), (mix.inputs[1].links[0], "shader link")):
        link.is_muted = muted == name
    obj = plane(materials=[made])
    bake(obj, value=np.pi)
    preview.show([obj], "irradiance")
    expected = {"shader": 0.0, "mix": 0.5, "color link": np.array((0.25, 0.5, 1.0)) / 4, "shader link": 0.0, "nothing": 0.125}[muted]
    seen = render(radiance(obj), tmp_path / "seen.exr")
    np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), rtol=1e-2, atol=1e-6)
