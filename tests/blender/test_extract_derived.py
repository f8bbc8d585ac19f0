# SPDX-License-Identifier: GPL-3.0-or-later
"""Images that nodes change: computed aside, once while image and nodes are the same, within the budget of all images."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract import depsgraph, image_store, images
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract, extracting
from adjgi.adjoint_gi.bridge.host.preparation import Aside, finish_stages
from adjgi.adjoint_gi.core.base.steps import finish
from adjgi.tests.blender.fakes import square
from adjgi.tests.blender.test_extract_images import emitter, png
from adjgi.tests.blender.test_extract_slices import same

KINDS = ["ShaderNodeHueSaturation", "ShaderNodeValToRGB", "ShaderNodeRGBCurve", "ShaderNodeGamma", "ShaderNodeInvert", "ShaderNodeRGBToBW"]


@pytest.fixture(autouse=True)
def nothing_known():
    image_store.KNOWN.clear()
    yield
    image_store.KNOWN.clear()


def through(shown, kind):
    """A new node between the image node `shown` and what it feeds."""
    tree = shown.id_data
    node, to = tree.nodes.new(kind), shown.outputs["Color"].links[0].to_socket
    main = next(s for s in node.inputs if s.name in ("Color", "Fac", "Factor") and (s.type == "RGBA" or kind == "ShaderNodeValToRGB"))
    tree.links.new(shown.outputs["Color"], main)
    tree.links.new(node.outputs[0], to)
    if kind == "ShaderNodeHueSaturation":
        node.inputs["Saturation"].default_value = 0.5
    elif kind == "ShaderNodeGamma":
        node.inputs["Gamma"].default_value = 2.0
    return node


def image_of(tmp_path, name="a.png", color=(0.8, 0.4, 0.2, 1.0)):
    return bpy.data.images.load(png(tmp_path / name, color))


def run(stages, aside=lambda: None, back=lambda: None):
    """`stages` to their end, with what is called before and after each part that runs aside."""
    answer = None
    while True:
        try:
            stage = stages.send(answer)
        except StopIteration as end:
            return end.value
        answer = None
        if isinstance(stage, Aside):
            aside()
            answer = finish(stage.steps)
            back()


def derivations(monkeypatch):
    """Bytes of each texture that is derived, or made smaller, from now on: a list that grows."""
    found = []

    def counted(whole):
        def made(*args):
            texture = whole(*args)
            found.append(texture.stored.nbytes)
            return texture

        return made

    monkeypatch.setattr(images, "derived", counted(images.derived))
    monkeypatch.setattr(images.Texture, "smaller", counted(images.Texture.smaller))
    return found


def now():
    return extract(bpy.context.evaluated_depsgraph_get(), bpy.context.scene)


@pytest.mark.parametrize("kind", KINDS)
def test_the_main_thread_computes_no_pixels(tmp_path, monkeypatch, kind):
    shown = emitter(image_of(tmp_path))
    through(shown, kind)
    through(shown, "ShaderNodeGamma").inputs["Gamma"].default_value = 1.5  # of which the first is computed
    where, main = [], [True]
    decoded = images.Texture._decoded
    monkeypatch.setattr(images.Texture, "_decoded", lambda self, s: where.append(main[0]) or decoded(self, s))
    arrays = run(extracting(), lambda: main.__setitem__(0, False), lambda: main.__setitem__(0, True))
    assert where and not any(where)
    image_store.KNOWN.clear()
    assert same(arrays, now()), "what is computed at once is the same"


def test_facts_of_plain_images_are_computed_aside_too(tmp_path, monkeypatch):
    """Means, for coordinates that are no UVs and for the world, and images that no object of the view layer shows."""
    shown = emitter(image_of(tmp_path))
    shown.projection = "BOX"
    world = bpy.context.scene.world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    sky = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = image_of(tmp_path, "sky.png", (0.1, 0.2, 0.4, 1.0))
    world.node_tree.links.new(sky.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    where, main = [], [True]
    for owner, name in ((images.Texture, "_decoded"), (images.Images, "_bytes_of")):
        whole = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, whole=whole: where.append(main[0]) or whole(*a))
    arrays = run(extracting(), lambda: main.__setitem__(0, False), lambda: main.__setitem__(0, True))
    assert len(where) >= 4 and not any(where) and all(arrays.background)


def test_a_derived_image_is_kept_from_one_extraction_to_the_next(tmp_path, monkeypatch):
    image = image_of(tmp_path)
    through(emitter(image), "ShaderNodeHueSaturation")
    made = derivations(monkeypatch)
    first, second = finish_stages(extracting()), now()
    assert len(made) == 1 and first.textures[1].stored is second.textures[1].stored
    # What Blender holds is read anew, but its pixels are the same.
    assert image.pixels[0] > 0.0 and image.has_data
    now()
    assert len(made) == 1


def painted(image, shown, node):
    image.pixels.foreach_set(np.full(len(image.pixels), 0.3, np.float32))


def other_space(image, shown, node):
    image.colorspace_settings.name = "Non-Color"


def other_stop(image, shown, node):
    node.color_ramp.elements[0].color = (0.3, 0.0, 0.0, 1.0)


def other_steps(image, shown, node):
    node.color_ramp.interpolation = "CONSTANT"


def inserted(image, shown, node):
    through(shown, "ShaderNodeInvert")


@pytest.mark.parametrize("edit", [painted, other_space, other_stop, other_steps, inserted])
def test_every_edit_of_image_or_ramp_is_seen(tmp_path, monkeypatch, edit):
    image = image_of(tmp_path)
    shown = emitter(image)
    node = through(shown, "ShaderNodeValToRGB")
    made = derivations(monkeypatch)
    before = now()
    edit(image, shown, node)
    bpy.context.view_layer.update()
    after = finish_stages(extracting())
    assert len(made) > 1 and not np.array_equal(before.textures[-1].pixels, after.textures[-1].pixels)
    image_store.KNOWN.clear()
    assert same(after, now())


def test_two_nodes_that_do_the_same_share_a_texture_and_others_do_not(tmp_path, monkeypatch):
    image = image_of(tmp_path)
    nodes = [through(emitter(image), "ShaderNodeValToRGB") for _ in range(3)]
    nodes[2].color_ramp.elements[1].position = 0.7
    made = derivations(monkeypatch)
    assert len(now().textures) == 4 and len(made) == 3, "one luminance and two ramps of it"


def test_derived_images_are_within_the_budget_before_they_are_made(monkeypatch):
    """What does not fit is never there in full, and a second extraction makes no copy again."""
    monkeypatch.setattr(images, "LARGEST_TOTAL", 64 * 64 * 4 * 2)
    rng = np.random.default_rng(1)
    for name in ("first", "second"):
        image = bpy.data.images.new(name, 64, 64)
        pixels = np.ones((64, 64, 4), np.float32)
        pixels[..., :3] = rng.random((64, 64, 3))
        image.pixels.foreach_set(pixels.ravel())
        through(emitter(image), "ShaderNodeHueSaturation")
    made = derivations(monkeypatch)
    arrays = finish_stages(extracting())
    assert sum(t.stored.nbytes for t in arrays.textures) <= images.LARGEST_TOTAL
    assert made and max(made) < 64 * 64 * 2 * 3 and len(arrays.textures) == 4
    assert any("all images together" in n.reason and 'Image "second"' in n.names for n in arrays.warnings)
    count = len(made)
    assert same(arrays, finish_stages(extracting())) and len(made) == count


def test_pixels_are_computed_aside_where_objects_are_shown_for_the_moment(tmp_path, monkeypatch, registered):
    """What a bake hides is read at once, and not anew for each texture."""
    shown = emitter(image_of(tmp_path))
    through(shown, "ShaderNodeHueSaturation")
    through(shown, "ShaderNodeGamma")
    hidden = square("Hidden")

    class Unhidden:
        def __enter__(self):
            hidden.hide_set(False)
            bpy.context.view_layer.update()

        def __exit__(self, *_):
            hidden.hide_set(True)
            bpy.context.view_layer.update()

    hidden.hide_set(True)
    bpy.context.view_layer.update()
    monkeypatch.setattr(depsgraph, "unhidden", lambda layer: Unhidden())
    readings, whole = [], depsgraph.Reading
    monkeypatch.setattr(depsgraph, "Reading", lambda *a, **k: readings.append(k) or whole(*a, **k))
    made, asides = derivations(monkeypatch), []
    arrays = run(extracting(), lambda: asides.append(len(made)))
    assert len(readings) == 1 and len(made) == 2 and len(asides) >= 3
    assert {o.name for o in arrays.objects} >= {"Hidden"}


def test_notices_of_an_image_that_two_nodes_show_are_said_once_and_come_to_an_end(tmp_path):
    image = image_of(tmp_path, color=(0.8, 0.4, 0.2, 0.5))
    image.alpha_mode = "PREMUL"
    emitter(image)
    emitter(image).extension = "CLIP"
    for arrays in (finish_stages(extracting()), now()):
        assert len(arrays.textures) == 2 and sum("premul" in n.reason for n in arrays.warnings) == 1
