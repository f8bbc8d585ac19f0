# SPDX-License-Identifier: GPL-3.0-or-later
"""Images that Blender does not hand out as Cycles reads them: 16 bits with alpha, sequences, movies, results of renders."""

from __future__ import annotations

import contextlib
import struct
import threading
import zlib

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract import image_store, images
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.bridge.extract.image_header import sequence_file
from adjgi.adjoint_gi.bridge.host.preparation import finish_stages
from adjgi.adjoint_gi.core.base.steps import finish
from adjgi.adjoint_gi.core.images.exr import write_exr
from adjgi.adjoint_gi.core.images.headers import header_of_bytes
from adjgi.tests.core import test_headers as headers
from adjgi.tests.cycles_patch import render_patch, shader_material, white_plane


def png(path, rgba, bits=8):
    """A picture of 2 x 2 equal pixels, values from 0 to 1."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pixel = struct.pack(">4H" if bits == 16 else ">4B", *(round(v * (2**bits - 1)) for v in rgba))
    header = struct.pack(">IIBBBBB", 2, 2, bits, 6, 0, 0, 0)
    rows = zlib.compress((b"\0" + pixel * 2) * 2)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    return str(path)


def emitter(image, alpha_used=False):
    """A plane that emits the image; with `alpha_used` the Alpha output is linked, without an effect. Returns the image node."""
    material = shader_material("m", "ShaderNodeEmission")
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, node.interpolation = image, "Closest"
    emission = next(n for n in tree.nodes if n.type == "EMISSION")
    tree.links.new(node.outputs["Color"], emission.inputs["Color"])
    if alpha_used:
        one = tree.nodes.new("ShaderNodeMath")
        one.operation, one.inputs[1].default_value, one.inputs[2].default_value = "MULTIPLY_ADD", 0.0, 1.0
        tree.links.new(node.outputs["Alpha"], one.inputs[0])
        tree.links.new(one.outputs[0], emission.inputs["Strength"])
    white_plane(2.0, material)
    return node


FORMATS = ["JPEG", "OPEN_EXR", "PNG", "WEBP", "BMP", "CINEON", "DPX", "IRIS", "JPEG2000", "HDR", "TARGA", "TARGA_RAW", "TIFF"]


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_is_refused_before_it_is_decoded_where_it_is_too_large(tmp_path, monkeypatch, kind):
    if kind in ("CINEON", "DPX", "IRIS") and bpy.app.version < (5, 0):
        pytest.skip("Blender 4.2 and 4.3 crash when they save these, or cannot read their own")
    made = bpy.data.images.new("made", 70, 50)
    made.file_format, made.filepath_raw = kind, str(tmp_path / f"a.{kind.lower()}")
    made.save()
    header = header_of_bytes((tmp_path / f"a.{kind.lower()}").read_bytes())
    assert (header.width, header.height) == (70, 50)
    image = bpy.data.images.load(made.filepath_raw)
    emitter(image)
    arrays, told = notices()
    assert len(arrays.textures) == 1 and header.bytes >= (16 if image.is_float else 4) * 70 * 50 and not told
    for packed in (False, True):
        image.buffers_free()
        if packed:
            image.pack()
        image_store.KNOWN.clear()
        monkeypatch.setattr(images, "LARGEST_IMAGE", 70 * 50 - 1)
        arrays, told = notices()
        assert not arrays.textures and not image.has_data and "70 x 50" in told[0]


def test_formats_are_all_that_blender_saves():
    found = {item.identifier for item in bpy.types.Image.bl_rna.properties["file_format"].enum_items}
    assert found - {"OPEN_EXR_MULTILAYER", "FFMPEG", "AVIF", "AVI_JPEG", "AVI_RAW"} == set(FORMATS)


def test_layers_count_and_unknown_formats_are_not_decoded(tmp_path, monkeypatch):
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 8
    (tmp_path / "a.exr").write_bytes(headers.exr(headers.exr_header(8, 8, [b"%d.Z" % i for i in range(99)])))
    (tmp_path / "b.tif").write_bytes(b"no picture")
    for name in ("a.exr", "b.tif"):
        emitter(bpy.data.images.load(str(tmp_path / name)))
    monkeypatch.setattr(images, "LARGEST_DECODED", 8 * 8 * 16)
    arrays, told = notices()
    assert not arrays.textures and not any(i.has_data for i in bpy.data.images)
    assert any("a.exr" in t and "25.3 kB when all of its layers are read" in t for t in told)
    assert any("b.tif" in t and "cannot be read safely" in t for t in told)


@pytest.mark.parametrize("packed", (False, True))
@pytest.mark.parametrize("kept", (0.5, 0.99))
def test_an_exr_that_was_cut_off_is_named_and_not_opened(tmp_path, packed, kept):
    """Blender 5.0 crashes when it is asked for its size."""
    whole = write_exr(tmp_path / "whole.exr", np.random.default_rng(0).random((40, 40, 4)).astype(np.float32), folder=tmp_path)
    data = whole.read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[: int(kept * len(data))])
    image = bpy.data.images.load(str(tmp_path / "cut.exr"))
    if packed:
        image.pack()
    emitter(image)
    arrays, told = notices()
    assert not arrays.textures and not image.has_data
    assert any("cut.exr" in t and "cannot be read safely, for " in t and "grey 0.8" in t for t in told), told


def test_generated_images_are_checked_before_they_are_made():
    image = bpy.data.images.new("large", 8, 8)
    image.generated_width = image.generated_height = 9000
    image.buffers_free()
    emitter(image)
    arrays, told = notices()
    assert not arrays.textures and not image.has_data and "9000 x 9000" in told[0]


def notices():
    """(arrays, sentences about images) of the scene as it is."""
    arrays = extract(bpy.context.evaluated_depsgraph_get())
    return arrays, [str(n) for n in arrays.warnings if n.object.startswith("Image")]


@pytest.mark.parametrize("mode", ["STRAIGHT", "CHANNEL_PACKED", "NONE"])
@pytest.mark.parametrize("space", ["sRGB", "Non-Color", "Linear Rec.709"])
@pytest.mark.parametrize("linked", [False, True])
def test_alpha_of_16_bits(tmp_path, mode, space, linked):
    image = bpy.data.images.load(png(tmp_path / "a.png", (0.8, 0.5, 0.2, 0.5), 16))
    image.colorspace_settings.name, image.alpha_mode = space, mode
    emitter(image, linked)
    arrays, told = notices()
    np.testing.assert_allclose(arrays.textures[0].pixels[0, 0, :3], render_patch(pixels=4, samples=1)[0, 0], atol=1e-3)
    assert told == []


@pytest.mark.parametrize("bits", [8, 16])
def test_alpha_that_the_file_has_not_is_named(tmp_path, bits):
    image = bpy.data.images.load(png(tmp_path / "a.png", (0.8, 0.5, 0.2, 0.5), bits))
    image.alpha_mode = "PREMUL"
    emitter(image)
    _, told = notices()
    assert len(told) == 1 and "premul alpha, unlike its file format" in told[0] and "Straight" in told[0]


SETTINGS = [(1, 0, 3, False), (1, 0, 3, True), (2, 1, 3, False), (2, 1, 2, True), (1, -2, 5, False)]


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("refresh", [False, True])
def test_the_frame_of_a_sequence_is_that_of_cycles(tmp_path, setting, refresh):
    for k in range(1, 5):
        png(tmp_path / f"f2_{k:03d}.png", (0.2 * k, 0.2 * k, 0.2 * k, 1.0))
    image = bpy.data.images.load(str(tmp_path / "f2_001.png"))
    image.source = "SEQUENCE"
    image.colorspace_settings.name = "Non-Color"
    user = emitter(image).image_user
    user.frame_start, user.frame_offset, user.frame_duration, user.use_cyclic = setting
    user.use_auto_refresh = refresh
    for frame in (-2, 1, 2, 3, 5):
        bpy.context.scene.frame_set(frame)
        arrays, told = notices()
        theirs = render_patch(pixels=4, samples=1)[0, 0]
        assert len(told) == 1
        if theirs[0] == theirs[1]:
            np.testing.assert_allclose(arrays.textures[0].pixels[0, 0, :3], theirs, atol=1e-3)
            assert f"its frame {round(theirs[0] / 0.2)} is used" in told[0]
        else:  # Cycles' pink
            assert not arrays.textures and "image sequence whose file of frame" in told[0] and "is missing" in told[0]
    assert {i.name for i in bpy.data.images} <= {image.name, "Render Result"}  # what was loaded for the moment is gone


def test_a_sequence_is_not_loaded_from_a_thread_of_the_renderer(tmp_path):
    """In a window F12 extracts in a thread, where a new datablock could crash Blender."""
    png(tmp_path / "s_001.png", (0.3, 0.3, 0.3, 1.0))
    image = bpy.data.images.load(str(tmp_path / "s_001.png"))
    image.source = "SEQUENCE"
    emitter(image)
    found = []
    thread = threading.Thread(target=lambda: found.append(notices()))
    thread.start()
    thread.join()
    arrays, told = found[0]
    assert not arrays.textures and any("F12 in a window cannot read" in text for text in told)


def test_two_nodes_show_two_frames(tmp_path):
    for k in (1, 2):
        png(tmp_path / f"{k}.png", (0.3 * k, 0.3 * k, 0.3 * k, 1.0))
    image = bpy.data.images.load(str(tmp_path / "1.png"))
    image.source = "SEQUENCE"
    for offset in (0, 1):
        user = emitter(image).image_user
        user.frame_duration, user.frame_offset = 1, offset
    arrays, told = notices()
    assert len(arrays.textures) == 2 and len(told) == 2
    assert arrays.textures[0].pixels[0, 0, 0] < arrays.textures[1].pixels[0, 0, 0]


def test_names_of_frames():
    image = bpy.data.images.new("i", 2, 2)
    for path, expected in (("/a/b12_0007.v.png", "/a/b12_0123.v.png"), ("/a/7x.exr", "/a/123x.exr"), ("/a/b.png", "/a/b.png")):
        image.filepath = path
        assert sequence_file(image, 123) == expected


def test_movies_are_told_once(tmp_path):
    image = bpy.data.images.load(png(tmp_path / "a.png", (1.0, 1.0, 1.0, 1.0)))
    image.source = "MOVIE"
    emitter(image)
    _, told = notices()
    assert len(told) == 1 and "movie" in told[0]


def test_results_of_renders_are_named(tmp_path):
    """Blender gives no pixels of a render result and of the layers of a file; the notice says so, not that a file is missing."""
    render_patch(pixels=4, samples=1)  # makes the render result
    settings = bpy.context.scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    path = str(tmp_path / "layers.exr")
    bpy.data.images["Render Result"].save_render(path, scene=bpy.context.scene)
    emitter(bpy.data.images["Render Result"])
    emitter(bpy.data.images.load(path))
    arrays, told = notices()
    assert not arrays.textures and len(told) == 2
    assert any("Render Result" in t and "is a render result, whose pixels Blender does not give" in t for t in told)
    assert any("layers.exr" in t and "is a multilayer OpenEXR" in t for t in told)


def read_count(monkeypatch):
    """How often images are decoded from now on: a list that grows."""
    found = []
    whole = images.as_bytes
    monkeypatch.setattr(images, "as_bytes", lambda values: found.append(len(values)) or whole(values))
    return found


@pytest.mark.parametrize("packed", [False, True])
def test_an_image_is_read_once_while_it_is_the_same(tmp_path, monkeypatch, packed):
    image_store.KNOWN.clear()
    path = tmp_path / "a.png"
    image = bpy.data.images.load(png(path, (0.8, 0.4, 0.2, 0.5)))
    image.alpha_mode = "PREMUL"
    if packed:
        image.pack()
    image.buffers_free()
    emitter(image)
    reads = read_count(monkeypatch)
    (first, told), (second, again) = notices(), notices()
    assert len(reads) == 1 and told == again and len(told) == 1
    assert first.textures[0].stored is second.textures[0].stored
    image.colorspace_settings.name = "Non-Color"
    third, _ = notices()
    assert third.textures[0].srgb is False and first.textures[0].srgb is True
    if not packed:
        png(path, (0.1, 0.1, 0.1, 1.0))
        image.reload()
        image.buffers_free()
        np.testing.assert_array_equal(notices()[0].textures[0].stored[0, 0], [26, 26, 26])


READ_ANEW = {
    "colour space": lambda image, path: setattr(image.colorspace_settings, "name", "Non-Color"),
    "alpha": lambda image, path: setattr(image, "alpha_mode", "CHANNEL_PACKED"),
    "another file": lambda image, path: setattr(image, "filepath", png(path.with_name("b.png"), (0.2, 0.4, 0.2, 0.5))),
    "file repainted": lambda image, path: png(path, (0.2, 0.4, 0.2, 0.5)),
    "packed": lambda image, path: (png(path, (0.2, 0.4, 0.2, 0.5)), image.pack()),
}


@pytest.mark.parametrize("change", READ_ANEW)
@pytest.mark.parametrize("linked", [False, True])
def test_an_image_is_read_anew_where_anything_of_it_has_changed(tmp_path, change, linked):
    """What is kept gives what a fresh reading gives."""
    path = tmp_path / "a.png"
    image = bpy.data.images.load(png(path, (0.8, 0.4, 0.2, 0.5)))
    image.buffers_free()
    emitter(image, linked)
    before, _ = notices()
    READ_ANEW[change](image, path)
    image.buffers_free()
    kept, _ = notices()
    image_store.KNOWN.clear()
    fresh, _ = notices()
    for name in ("pixels", "srgb", "times_alpha"):
        np.testing.assert_array_equal(getattr(kept.textures[0], name), getattr(fresh.textures[0], name))
    if change != "alpha" or not linked:
        different = [not np.array_equal(getattr(kept.textures[0], x), getattr(before.textures[0], x)) for x in ("pixels", "times_alpha")]
        assert any(different), "or the change tests nothing"


def test_images_that_blender_holds_are_read_anew(tmp_path, monkeypatch):
    image = bpy.data.images.load(png(tmp_path / "a.png", (0.8, 0.4, 0.2, 1.0)))
    emitter(image)
    image.pixels[0]  # loads it
    reads = read_count(monkeypatch)
    notices()
    image.pixels[0] = 1.0  # no sign of it anywhere
    arrays, _ = notices()
    assert len(reads) == 2 and arrays.textures[0].stored[0, 0, 0] == 255


def test_what_is_not_asked_for_is_not_kept(tmp_path):
    image_store.KNOWN.clear()
    emitter(bpy.data.images.load(png(tmp_path / "a.png", (0.8, 0.4, 0.2, 1.0))))
    notices()
    assert len(image_store.KNOWN._known) == 1
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    white_plane(2.0, None)
    notices()
    assert not image_store.KNOWN._known


def test_budget_of_all_images(monkeypatch):
    """Smaller copies with the same means, and one sentence about all of them; never grey in the place of an image."""
    monkeypatch.setattr(images, "LARGEST_TOTAL", 3 * 64 * 64 * 4 // 3)
    rng = np.random.default_rng(1)
    for name in ("first", "second", "third"):
        image = bpy.data.images.new(name, 64, 64)
        pixels = np.ones((64, 64, 4), np.float32)
        pixels[..., :3] = rng.random((64, 64, 3)) * np.linspace(0, 1, 64)[:, None, None]
        image.pixels.foreach_set(pixels.ravel())
        emitter(image)
    arrays, _ = notices()
    assert [t.width for t in arrays.textures] == [64, 16, 8]
    assert sum(t.stored.nbytes for t in arrays.textures) <= images.LARGEST_TOTAL
    full = arrays.textures[0].row_means.mean(axis=0)[:3]
    for small in arrays.textures[1:]:
        np.testing.assert_allclose(small.row_means.mean(axis=0)[:3], full, rtol=0.06)  # of other random numbers
        assert small.row_means[-1, 0] > 10 * small.row_means[0, 0], "the picture is still there"
    (notice,) = [n for n in arrays.warnings if "all images together" in n.reason]
    assert notice.names == ('Image "second"', 'Image "third"') and "smaller copy" in notice.reason


def test_an_image_that_blender_holds_is_read_once_for_a_bake_and_again_when_it_is_over(tmp_path, monkeypatch):
    image_store.KNOWN.clear()
    image = bpy.data.images.load(png(tmp_path / "a.png", (0.8, 0.4, 0.2, 1.0)))
    painted = bpy.data.images.load(png(tmp_path / "b.png", (0.2, 0.4, 0.2, 1.0)))
    for shown in (image, painted):
        emitter(shown)
        assert shown.pixels[0] > 0 and shown.has_data  # as a viewport that shows it has
    reads = read_count(monkeypatch)
    finish_stages(images.reading(bpy.context))
    assert len(reads) == 2
    notices()
    painted.pixels[0] = 1.0
    notices()
    assert len(reads) == 3, "what was painted meanwhile is read as it is now"
    images.return_images()
    png(tmp_path / "a.png", (0.1, 0.4, 0.2, 1.0))
    image.reload()
    assert image.pixels[0] < 0.5
    arrays, _ = notices()
    assert len(reads) == 5
    assert min(t.stored[..., 0].min() for t in arrays.textures) < 0.5 * 255


def test_images_whose_alpha_is_used_and_those_of_the_world_are_read_before_the_extraction_too(tmp_path, monkeypatch):
    """The same image both ways is read both ways, each as the extraction asks for it."""
    image_store.KNOWN.clear()
    image = bpy.data.images.load(png(tmp_path / "leaf.png", (0.8, 0.4, 0.2, 0.5)))
    emitter(image)
    emitter(image, alpha_used=True)
    world = bpy.context.scene.world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    sky = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = bpy.data.images.load(png(tmp_path / "sky.png", (0.1, 0.2, 0.4, 1.0)))
    world.node_tree.links.new(sky.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
    reads = read_count(monkeypatch)
    finish_stages(images.reading(bpy.context))
    assert len(reads) == 3
    arrays, _ = notices()
    assert len(reads) == 3, "the extraction finds all of them known"
    assert sorted(t.times_alpha for t in arrays.textures if t.name == "leaf.png") == [False, True]


def test_images_are_read_one_by_one_before_the_extraction(tmp_path, monkeypatch):
    image_store.KNOWN.clear()
    for k in range(3):
        emitter(bpy.data.images.load(png(tmp_path / f"{k}.png", (0.2 * k, 0.4, 0.2, 1.0))))
    emitter(bpy.data.images.load(png(tmp_path / "alpha.png", (0.8, 0.4, 0.2, 0.5)))).image.alpha_mode = "PREMUL"
    gone = bpy.data.images.load(png(tmp_path / "gone.png", (0.8, 0.4, 0.2, 0.5)))
    emitter(gone)
    reads = read_count(monkeypatch)
    counts, answer, where, stages = [], None, [], images.reading(bpy.context)
    made = images.as_bytes
    monkeypatch.setattr(images, "as_bytes", lambda values: where.append(aside) or made(values))
    aside = False
    with contextlib.suppress(StopIteration):
        while True:
            stage, answer = stages.send(answer), None
            if isinstance(stage, str):
                counts.append(len(reads))
                if stage.endswith("gone.png"):
                    bpy.data.images.remove(gone)
            else:
                aside = True
                answer = finish(stage.steps)
                aside = False
    assert where == [True] * 4, "only pixels are handed out on the main thread"
    assert counts == [0, 1, 2, 3, 4] and len(reads) == 4
    arrays, told = notices()
    assert len(reads) == 4 and len(arrays.textures) == 4 and all("ranges" in t.__dict__ for t in arrays.textures)
    assert sum("premul" in t for t in told) == 1


@pytest.mark.parametrize("kind", ["generated", "painted", "packed"])
def test_images_without_a_file_of_their_own_are_read_before_the_extraction_and_anew_for_the_next_bake(tmp_path, monkeypatch, kind):
    image_store.KNOWN.clear()
    path = png(tmp_path / "a.png", (0.8, 0.4, 0.2, 1.0))
    image = bpy.data.images.new("Made", 8, 8) if kind == "generated" else bpy.data.images.load(path)
    if kind == "packed":
        image.pack()
    emitter(image)
    image.pixels.foreach_set(np.full(len(image.pixels), 0.25, np.float32))
    reads = read_count(monkeypatch)
    finish_stages(images.reading(bpy.context))
    assert len(reads) == 1
    for _ in range(2):
        arrays, _ = notices()
        assert len(reads) == 1, "the extraction finds it known, and the one after layers were made, too"
    assert {*arrays.textures[0].stored.ravel()} == {64}
    # A check that was stopped in the middle has not returned the images.
    image.pixels.foreach_set(np.full(len(image.pixels), 0.75, np.float32))
    finish_stages(images.reading(bpy.context))
    arrays, _ = notices()
    assert len(reads) == 2 and {*arrays.textures[0].stored.ravel()} == {191}
    images.return_images()
    image.pixels.foreach_set(np.full(len(image.pixels), 0.5, np.float32))
    arrays, _ = notices()
    assert len(reads) == 3 and {*arrays.textures[0].stored.ravel()} == {128}
