# SPDX-License-Identifier: GPL-3.0-or-later
"""The render engine: what F12 and `-f 1` write, read back from the file."""

import bpy
import numpy as np
import OpenEXR
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.adjoint_gi.bridge.engine.passes import FAR, Geometry
from adjgi.adjoint_gi.bridge.engine.passes import pixels as passes_of
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.images import exr
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.method.solution import Solution
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.blender.fakes import camera, fake_method, quick, square

WIDTH, HEIGHT = 40, 30
solvers.load()
METHODS = [m.spec.id for m in registry.methods() if "camera" in m.spec.receivers and m.spec.answers == "light"]
NO_ELEMENTS = {"two_pass", "multi_pass"}  # solve elements but do not hand them over: the pass is black, with a warning


@pytest.fixture
def scene(registered):
    with fake_method(registered):
        scene = bpy.context.scene
        scene.render.engine = "ADJOINT_GI"
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
        square()  # 2 m wide under a camera that sees 3 m across its width and 2.25 m across its height
        camera()
        yield scene


def rendered(scene, path, layer="ViewLayer") -> dict[str, np.ndarray]:
    """Render to a multilayer EXR; pass name to (h, w, channels) float32 of one view layer, row 0 at the top."""
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    passes: dict[str, dict[str, np.ndarray]] = {}
    for name, pixels in channels_of(path):
        of, group, letter = name.split(".")
        if of == layer:
            assert letter not in passes.setdefault(group, {}), f"{group} stands twice in the file"
            passes[group][letter] = pixels
    order = "RGBAXYZV"
    return {name: np.stack([c[k] for k in sorted(c, key=order.index)], -1) for name, c in passes.items()}


def channels_of(path):
    """(name, (h, w) float32) of every channel of all parts of a file."""
    if not exr.wheel_is_safe():
        # Debian's Blender: the OpenEXR wheel would crash here (see core/images/exr.py). Its files have one part.
        return list(exr.read_numpy(path)[0].items())
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [(name, np.array(c.pixels, np.float32)) for part in file.parts for name, c in part.channels.items()]


def test_all_passes_reach_the_file(scene, tmp_path):
    got = rendered(scene, tmp_path / "out.exr")
    assert {"Combined", "Depth", "Normal", "Emission", "Direct", "Indirect", "Albedo", "Elements"} <= set(got)
    assert got["Combined"].shape == (HEIGHT, WIDTH, 4)
    on, off = (HEIGHT // 2, WIDTH // 2), (0, 0)
    np.testing.assert_allclose(got["Direct"][on], [1, 2, 3])
    np.testing.assert_allclose(got["Indirect"][on], [2, 4, 6])
    np.testing.assert_allclose(got["Combined"][on], [3, 6, 9, 1])
    np.testing.assert_allclose(got["Elements"][on], 7)
    np.testing.assert_allclose(got["Albedo"][on], 0.5)
    np.testing.assert_allclose(got["Normal"][on], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(got["Depth"][on], 5, rtol=1e-5)
    assert got["Depth"][off] == np.float32(FAR)
    assert not got["Normal"][off].any()
    assert got["Combined"][off][3] == 1  # the background is opaque


@pytest.mark.parametrize("on", [True, False])
def test_blenders_own_pass_switches_double_nothing(scene, tmp_path, on):
    layer = scene.view_layers[0]
    for name in ("combined", "z", "normal", "emit", "mist", "position", "object_index"):
        setattr(layer, f"use_pass_{name}", on)
    got = rendered(scene, tmp_path / "out.exr")
    np.testing.assert_allclose(got["Depth"][HEIGHT // 2, WIDTH // 2], 5, rtol=1e-5)
    np.testing.assert_allclose(got["Combined"][HEIGHT // 2, WIDTH // 2], [3, 6, 9, 1])


def test_transparent_film_takes_the_background_out(scene, tmp_path):
    scene.render.film_transparent = True
    got = rendered(scene, tmp_path / "out.exr")
    assert got["Combined"][HEIGHT // 2, WIDTH // 2, 3] == 1
    assert not got["Combined"][0, 0].any()
    covered = got["Combined"][..., 3].mean()
    assert covered == pytest.approx(2 * 2 / (3 * 2.25), rel=0.02)


@pytest.mark.parametrize("transparent", [False, True])
def test_pixels_that_a_surface_covers_in_part(transparent):
    """Each holds as much of the surface, and of the background, as it has points on them; depth and normal are those of the surface."""
    width, sky, glow = 4, np.array([1.0, 2.0, 3.0]), np.array([5.0, 4.0, 3.0])
    b = SceneBuilder()
    b.quad("Sheet", (0.125, 0, 0), (9, 0, 0), (0, 9, 0), diffuse("Sheet", 0.0, tuple(glow)))
    b.background = tuple(sky)
    b.camera = Camera("orthographic", (0, 0, 5), (1, 0, 0), (0, 1, 0), (0, 0, -1), (-0.5, 0.5, -0.5, 0.5), width, width, clip_start=1.0)
    world = World(b.build())
    receivers = CameraReceivers(world)
    geometry = Geometry.of(world, receivers)
    # A quarter of the picture is right of the edge, above the middle: half of the third column, all of the fourth.
    covered = np.zeros((width, width))
    covered[2:, 2:] = 0.5, 1.0
    np.testing.assert_allclose(geometry.alpha.reshape(width, width), covered)
    np.testing.assert_allclose(geometry.behind, (1 - covered.reshape(-1, 1)) * sky, rtol=1e-6)
    np.testing.assert_allclose(geometry.depth.reshape(width, width), np.where(covered > 0, 5, FAR), rtol=1e-6)
    np.testing.assert_allclose(geometry.normal, (covered.reshape(-1, 1) > 0) * [0, 0, 1], atol=1e-6)
    seen = (covered.reshape(-1, 1) * glow + (1 - covered.reshape(-1, 1)) * sky).astype(np.float32)
    none = np.zeros_like(seen)
    found = Solution("path_tracing", "radiance", seen, none, none, none, np.ones(len(seen), np.float32))
    got = passes_of(registry.method("path_tracing").spec, found, geometry, transparent)
    alpha = covered.reshape(-1, 1) if transparent else np.ones((width**2, 1))
    want = covered.reshape(-1, 1) * glow if transparent else seen
    np.testing.assert_allclose(got["Combined"], np.concatenate([want, alpha], axis=1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(got["Emission"], want, rtol=1e-5, atol=1e-6)


def test_percentage_of_the_resolution(scene, tmp_path):
    scene.render.resolution_percentage = 50
    got = rendered(scene, tmp_path / "out.exr")
    assert got["Combined"].shape == (HEIGHT // 2, WIDTH // 2, 4)


@pytest.mark.parametrize("crop", [True, False])
def test_render_region(scene, tmp_path, crop):
    bpy.data.objects["Square"].location = (0.4, 0.3, 0)
    whole = rendered(scene, tmp_path / "whole.exr")["Depth"]
    # Above and to the right of the middle, so the square reaches the upper end of the picture, and not the lower one.
    assert whole[0, WIDTH // 2] < FAR and whole[-1, WIDTH // 2] == np.float32(FAR)
    assert whole[HEIGHT // 2, 34] < FAR and whole[HEIGHT // 2, WIDTH - 1 - 34] == np.float32(FAR)
    scene.render.use_border, scene.render.use_crop_to_border = True, crop
    scene.render.border_min_x, scene.render.border_max_x = 0.1, 0.5
    scene.render.border_min_y, scene.render.border_max_y = 0.2, 0.95
    got = rendered(scene, tmp_path / "part.exr")["Depth"]
    rows, columns = slice(HEIGHT - 28, HEIGHT - 6), slice(4, 20)  # 28 = int(0.95 * 30), counted from below
    if crop:
        np.testing.assert_array_equal(got, whole[rows, columns])
    else:
        assert got.shape == whole.shape
        np.testing.assert_array_equal(got[rows, columns], whole[rows, columns])


def test_animation_writes_every_frame(scene, tmp_path):
    scene.frame_start, scene.frame_end = 1, 2
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(tmp_path / "frame_")
    bpy.ops.render.render(animation=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frame_0001.exr", "frame_0002.exr"]


def test_two_view_layers(scene, tmp_path):
    scene.view_layers.new("Second")
    for layer in ("ViewLayer", "Second"):
        got = rendered(scene, tmp_path / f"{layer}.exr", layer)
        np.testing.assert_allclose(got["Direct"][HEIGHT // 2, WIDTH // 2], [1, 2, 3])


@pytest.mark.parametrize("case", ["no camera", "method fails", "panoramic camera", "stereo", "tiny region", "contradiction"])
def test_errors_are_said(scene, tmp_path, case):
    state = scene.adjoint_gi
    if case == "no camera":
        bpy.data.objects.remove(scene.camera)
    elif case == "method fails":
        state.settings_fake.mode = "fails"
    elif case == "panoramic camera":
        scene.camera.data.type = "PANO"
    elif case == "stereo":
        scene.render.use_multiview = True
    elif case == "tiny region":
        scene.render.use_border = True
        scene.render.border_min_x, scene.render.border_max_x = 0.5, 0.501
    else:
        state.settings_fake.min_length, state.settings_fake.max_length = 5, 2
    words = {
        "no camera": "amera",
        "method fails": "fails on purpose",
        "panoramic camera": "pano",
        "stereo": "stereoscopy",
        "tiny region": "too small",  # Blender itself refuses it
        "contradiction": "min_length",
    }
    with pytest.raises(RuntimeError, match=words[case]):
        bpy.ops.render.render()
    # The next render works.
    if case == "method fails":
        state.settings_fake.mode = "fine"
        np.testing.assert_allclose(rendered(scene, tmp_path / "out.exr")["Direct"][15, 20], [1, 2, 3])


@pytest.mark.parametrize("method", METHODS)
def test_every_method_renders_the_cornell_box(registered, tmp_path, method):
    scene = demo.build_cornell(size=(16, 16))
    bpy.context.window.scene = scene
    scene.render.engine = "ADJOINT_GI"
    quick(scene, method)
    got = rendered(scene, tmp_path / "out.exr")
    for name, values in got.items():
        assert np.isfinite(values).all(), name
    np.testing.assert_allclose(got["Combined"][..., :3], got["Emission"] + got["Direct"] + got["Indirect"], rtol=1e-4, atol=1e-5)
    assert got["Direct"].mean() > 0.05
    assert got["Albedo"][8, 1, 0] > 3 * got["Albedo"][8, 1, 1]  # the left wall is red
    assert got["Normal"][8, 1, 0] == pytest.approx(1, abs=1e-3)  # and faces right
    spec = registry.method(method).spec
    assert ("Elements" in got) == spec.uses_elements
    if spec.uses_elements and method not in NO_ELEMENTS:
        assert got["Elements"][8, 8].min() > 0


def test_compositor_sees_the_passes(scene):
    """The sockets of the Render Layers node come from the same list as the passes."""
    scene.view_layers[0].update_render_passes()
    if hasattr(scene, "compositing_node_group"):
        tree = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        scene.compositing_node_group = tree
    else:
        scene.use_nodes = True
        tree = scene.node_tree
    node = tree.nodes.new("CompositorNodeRLayers")
    scene.view_layers[0].update_render_passes()
    names = {s.name for s in node.outputs if s.enabled}
    assert {"Direct", "Indirect", "Albedo", "Elements"} <= names
