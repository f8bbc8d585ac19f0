# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes that are denoised before they are written: by Blender's compositor, of which nothing stays behind, else by our own filter."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import denoising
from adjgi.adjoint_gi.bridge.cli.arguments import make_parser, request_of
from adjgi.adjoint_gi.bridge.host import compositor
from adjgi.adjoint_gi.bridge.props import properties
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.tests import baking

SIDE = 24


@pytest.fixture
def corner():
    """A floor beside a red wall below an area lamp."""
    red = bpy.data.materials.new("Red")
    red.use_nodes = True
    red.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.1, 0.1, 1)
    floor = baking.quad("Floor", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], red)
    baking.quad("Wall", [(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], red)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "AREA"))
    lamp.location, lamp.data.energy, lamp.data.size = (0.6, 0.5, 0.9), 10.0, 0.3
    bpy.context.scene.collection.objects.link(lamp)
    bpy.context.view_layer.update()
    return floor


def everything() -> dict[str, list[str]]:
    """Names of all datablocks, by kind."""
    kinds = {k: getattr(bpy.data, k) for k in dir(bpy.data)}
    return {k: sorted(x.name for x in v) for k, v in kinds.items() if isinstance(v, bpy.types.bpy_prop_collection)}


def light(**more) -> np.ndarray:
    """(h, w, 3) indirect light of the floor, baked with few samples."""
    baking.bake(baking.request(values={"samples": 16}, resolution=SIDE, quantity="indirect", objects=("Floor",), margin=0, **more))
    return read_pixels(linked_image(bpy.data.objects["Floor"], "indirect"))


def test_compositor_takes_noise_away_and_leaves_nothing_behind(registered):
    scene = bpy.context.scene
    bpy.data.images.new("Mine", 4, 4)
    before, render = everything(), (scene.render.engine, scene.render.filepath, scene.render.resolution_x)
    heard = []
    handler = bpy.app.handlers.render_pre
    handler.append(lambda *_: heard.append(1))
    own = list(handler)
    try:
        rng = np.random.default_rng(0)
        noisy = np.ones((48, 64, 3), np.float32) * rng.exponential(1, (48, 64, 1)).astype(np.float32)
        noisy[:, :32] *= 5
        up = np.broadcast_to(np.float32([0, 0, 1]), noisy.shape)
        try:
            clean = compositor.denoise(noisy, np.ones_like(noisy), up)
        except compositor.NoDenoiser as error:
            assert "built without" in str(error)
            clean = None
        assert list(handler) == own and not heard
    finally:
        handler.pop()
    assert everything() == before and bpy.context.scene == scene
    if clean is None:
        assert bpy.app.version < (4, 4), "the wheels and Blender's own downloads have the denoiser; Debian's 4.3 has not"
        return
    assert clean.shape == noisy.shape and clean[:, :24].std() < 0.2 * noisy[:, :24].std()
    for half in (slice(0, 32), slice(32, 64)):
        assert clean[:, half].mean() == pytest.approx(noisy[:, half].mean(), rel=0.05)
    assert (scene.render.engine, scene.render.filepath, scene.render.resolution_x) == render


def test_baked_lightmap_is_denoised_and_keeps_its_mean(registered, corner):
    raw, before = light(), everything()
    clean = light(denoise=True)
    assert everything() == before
    assert clean.mean(axis=(0, 1)) == pytest.approx(raw.mean(axis=(0, 1)), rel=1e-4)
    rough = [np.abs(np.diff(x[..., 0], axis=0)).mean() for x in (raw, clean)]
    assert rough[1] < 0.7 * rough[0]


def test_own_filter_steps_in_where_the_compositor_fails_and_says_so(registered, corner, monkeypatch):
    raw = light()

    def gone(*_):
        raise compositor.NoDenoiser("no OpenImageDenoise")

    monkeypatch.setattr(denoising.compositor, "denoise", gone)
    request = baking.request(values={"samples": 16}, resolution=SIDE, quantity="indirect", objects=("Floor",), margin=0, denoise=True)
    made = baking.bake(request)
    assert any("no OpenImageDenoise" in n.reason for n in made.notices)
    clean = read_pixels(linked_image(corner, "indirect"))
    assert clean.mean() == pytest.approx(raw.mean(), rel=1e-4)
    assert np.abs(np.diff(clean[..., 0], axis=0)).mean() < 0.7 * np.abs(np.diff(raw[..., 0], axis=0)).mean()


def test_what_the_compositor_has_not_written_whole_is_not_read(registered, corner, monkeypatch):
    """As on a full disk, where Blender says nothing, and crashes reading what there is: our own filter steps in, nothing is lost."""
    real = compositor._read

    def cut(path, width, height):
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        return real(path, width, height)

    monkeypatch.setattr(compositor, "_read", cut)
    request = baking.request(values={"samples": 16}, resolution=SIDE, quantity="indirect", objects=("Floor",), margin=0, denoise=True)
    made = baking.bake(request)
    assert any("is not whole: is that disk full?" in n.reason and "filter of Adjoint GI's own" in n.reason for n in made.notices)
    assert read_pixels(linked_image(corner, "indirect")).mean() > 0


def test_methods_without_noise_and_running_bakes_are_left_alone(registered, corner, monkeypatch):
    monkeypatch.setattr(denoising.compositor, "denoise", lambda *_: pytest.fail("was asked to denoise"))
    baking.bake(baking.request("local_illumination", resolution=8, objects=("Floor",), denoise=True))
    light()
    made = baking.Bake(bpy.context, baking.request(values={"samples": 16}, resolution=8, objects=("Floor",), denoise=True))
    solution = made.driver.run()
    made.driver.state = "running"  # what is written meanwhile is shown as it is
    made.write(solution)
    made.driver.state = "finished"


def test_attributes_are_denoised_along_the_mesh(registered, corner):
    fine = bpy.data.meshes.new("Fine")
    n = 12
    points = [(x / n, y / n, 0) for y in range(n + 1) for x in range(n + 1)]
    cells = [(y * (n + 1) + x, y * (n + 1) + x + 1, (y + 1) * (n + 1) + x + 1, (y + 1) * (n + 1) + x) for y in range(n) for x in range(n)]
    fine.from_pydata(points, [], cells)
    fine.materials.append(corner.data.materials[0])
    corner.data = fine
    bpy.context.view_layer.update()
    found = []
    for denoise in (False, True):
        request = baking.request(
            target="attribute", values={"samples": 8}, objects=("Floor",), domain="POINT", quantity="indirect", denoise=denoise
        )
        baking.bake(request)
        values = np.empty(len(points) * 4, np.float32)
        corner.data.color_attributes["AdjointGI"].data.foreach_get("color", values)
        found.append(values.reshape(n + 1, n + 1, 4)[..., 0])
    raw, clean = found
    assert clean.mean() == pytest.approx(raw.mean(), rel=1e-4) and np.abs(np.diff(clean)).mean() < 0.6 * np.abs(np.diff(raw)).mean()


def test_pictures_are_denoised_only_when_asked(registered, corner, tmp_path):
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, bpy.context.scene.camera = (0.5, 0.5, 3.0), camera
    made = baking.Bake(
        bpy.context, baking.request(target="render", values={"samples": 16}, width=24, height=24, denoise=True, output=str(tmp_path))
    )
    solution = made.driver.run()
    clean, told = denoising.denoise(made.request, made.writer, solution)
    assert all("built without" in n.reason for n in told) and clean.indirect.mean() == pytest.approx(solution.indirect.mean(), rel=1e-4)
    assert np.abs(clean.indirect - solution.indirect).max() > 0 and (clean.emitted == solution.emitted).all()


@pytest.mark.parametrize(
    ("arguments", "denoise"),
    [
        ([], True),
        (["--target", "attribute"], True),
        (["--no-denoise"], False),
        (["--target", "render"], False),
        (["--target", "render", "--denoise"], True),
        (["--method", "particle_tracing"], False),
        (["--method", "particle_tracing", "--denoise"], True),
    ],
)
def test_command_line_and_panel_mean_the_same_by_default(registered, corner, arguments, denoise):
    options = make_parser(True).parse_args(["bake", *arguments])
    assert request_of(options).denoise is denoise
    state = bpy.context.scene.adjoint_gi
    state.selection_only, state.method, state.target = False, options.method, options.target
    state.denoise = "AUTO" if options.denoise is None else "ON" if options.denoise else "OFF"
    assert properties.request_of(bpy.context.scene).denoise is denoise


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """What a texture shows: (n, 3) at UV coordinates (n,)."""
    h, w = image.shape[:2]
    x, y = u * w - 0.5, v * h - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    p, q = (x - i)[:, None], (y - j)[:, None]
    below, above = ((1 - p) * image[k, i] + p * image[k, i + 1] for k in (j, j + 1))
    return (1 - q) * below + q * above


def test_charts_meet_where_the_surface_goes_on(registered, corner):
    """A floor whose two halves lie apart in the image, one of them turned: the texture shows the same on both sides of the seam."""
    mesh = bpy.data.meshes.new("Halves")
    mesh.from_pydata([(x, y, 0.001) for y in (0, 1) for x in (0, 0.5, 1)], [], [(0, 1, 4, 3), (1, 2, 5, 4)])
    left = [(0.05, 0.05), (0.45, 0.05), (0.45, 0.95), (0.05, 0.95)]
    right = [(0.95, 0.95), (0.55, 0.95), (0.55, 0.05), (0.95, 0.05)]  # turned by 180 degrees
    mesh.uv_layers.new(name="Mine").uv.foreach_set("vector", np.array(left + right, np.float32).ravel())
    mesh.materials.append(corner.data.materials[0])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Halves", mesh))
    bpy.context.view_layer.update()
    t = np.linspace(0.02, 0.98, 60)
    steps = {}
    for denoise in (False, True):
        asked = baking.request(
            values={"samples": 16}, resolution=64, quantity="irradiance", objects=("Halves",), uv_layer="Mine", denoise=denoise
        )
        baking.bake(asked)
        image = read_pixels(linked_image(bpy.data.objects["Halves"], "irradiance"))
        sides = bilinear(image, np.full(60, 0.45), 0.05 + 0.9 * t), bilinear(image, np.full(60, 0.95), 0.95 - 0.9 * t)
        steps[denoise] = float(np.abs(sides[0] - sides[1]).mean() / image.max(axis=2).mean())
    assert steps[True] < 0.01 and steps[False] > 3 * steps[True]
