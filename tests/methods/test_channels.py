# SPDX-License-Identifier: GPL-3.0-or-later
"""The three channels of colour are three scenes in one: no method mixes them, takes one for another, or a mean of them for each.

One scene has all that has a colour, each with channels of its own. Where it chooses, a method weighs the channels by their sum, mean or
largest, so that a scene whose channels change places has the same answer with its channels changed in the same way, but for rounding.
That each channel is the answer of the grey scene made of it alone, tells a mean over the channels, which changing places cannot.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import Solution
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, SceneArrays, Source, Term
from adjgi.adjoint_gi.core.scene.texture import Texture
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.methods.test_every_method import KINDS, NAMES, ROWS, places, quick
from adjgi.tests.solving import ARRAYS, look, on_elements, solve

IMAGE, GREY = Source("image", texture=0), Source("image", texture=1)
HUE = np.array([0.9, 0.5, 0.1])
COUNTING_ALL_RAYS = ("progressive_radiosity", "spherical_harmonics", "stochastic_jacobi")  # others: of each place
ORDER = [2, 0, 1]  # changes the place of every channel


# ---- the scene, and others made of it


def coloured() -> SceneArrays:
    """A room in which each colour that a scene can have is there, and has three different channels."""
    b = SceneBuilder()
    image, grey = Source("image", texture=0), Source("image", texture=1)
    painted = Color((Term((0.9, 0.8, 0.7), (image,)), Term((0.02, 0.05, 0.08))))
    lamp = Color((Term((2.0, 3.0, 5.0), (image,)),))
    share = Color((Term((0.6, 0.6, 0.6), (grey,)),))
    rest = Color((Term((1.0, 1.0, 1.0)), Term((-0.6, -0.6, -0.6), (grey,))))
    walls = [
        diffuse("Left", (0.7, 0.2, 0.1)),
        diffuse("Right", (0.15, 0.3, 0.6)),
        diffuse("Near", (0.3, 0.5, 0.4)),
        Material("Painted", (Lobe("diffuse", painted),)),
        Material("Mixed", (Lobe("diffuse", painted, weight=share), Lobe("glossy", Color.of(0.9, 0.5, 0.2), 0.4, weight=rest))),
        diffuse("Above", (0.6, 0.55, 0.7), (0.1, 0.3, 0.2)),
    ]
    # Half of the ceiling is missing, for the sun and the sky.
    corners = ((0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0), (0, 0, 0), (0, 0, 1))
    x, y, z, half = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, 0, 0)
    edges = ((y, z), (z, y), (z, x), (x, z), (x, y), (y, half))
    for wall, corner, (edge_x, edge_y) in zip(walls, corners, edges, strict=True):
        b.quad(wall.name, corner, edge_x, edge_y, wall)
    things = (
        Material("Glow", (Lobe("emission", lamp),)),
        Material("Corners", (Lobe("diffuse", Color((Term((0.8, 0.9, 1.0), (Source("attribute", "Col"),)),))),)),
        Material("Tint", (Lobe("transparent", Color.of(0.8, 0.4, 0.6)), Lobe("diffuse", Color.of(0.1, 0.2, 0.15)))),
        Material("Glass", (Lobe("glass", Color.of(0.5, 0.7, 0.9), 0.0, 1.45),)),
        Material("Mirror", (Lobe("glossy", Color.of(0.9, 0.6, 0.4), 0.0),)),
        Material("Metal", (Lobe("metallic", Color.of(0.4, 0.6, 0.9), 0.5, multiscatter=True),)),
        Material("Coat", (Lobe("specular", Color.of(0.9, 0.7, 0.5), 0.3, 1.5), Lobe("diffuse", Color.of(0.2, 0.7, 0.5)))),
        Material("Rough", (Lobe("rough diffuse", Color.of(0.7, 0.3, 0.5), 0.8, multiscatter=True),)),
    )
    for i, material in enumerate(things):
        x, y = 0.06 + 0.24 * (i % 4), 0.3 + 0.4 * (i // 4)
        b.quad(material.name, (x, y, 0.2 + 0.1 * (i % 3)), (0.16, 0.02, 0.05), (0, 0.05, 0.2), material)
    b.light(Light("Point", "point", (0.2, 0.5, 0.3), (0.5, 0.5, 0.6), radius=0.02))
    b.light(Light("Spot", "spot", (0.6, 0.2, 0.4), (0.3, 0.5, 0.9), spot_angle=1.0, spot_blend=0.3))
    b.light(Light("Area", "area", (0.5, 2.0, 1.0), (0.7, 0.3, 0.8), size_x=0.2, size_y=0.1))
    b.light(Light("Sun", "sun", (0.2, 0.1, 0.4), angle=0.02))
    b.background = (0.2, 0.1, 0.3)
    b.camera = look((0.5, 0.05, 0.5), (0, 1, 0), half=0.9, size=8)
    scene = b.build()
    rng = np.random.default_rng(3)
    pixels = np.ones((4, 4, 4), np.float32)
    pixels[..., :3] = rng.uniform(0.1, 0.9, (4, 4, 3))
    plain = np.ones((4, 4, 4), np.float32)
    plain[..., :3] = rng.uniform(0.1, 0.9, (4, 4, 1))
    objects = list(scene.objects)
    k = next(i for i, o in enumerate(objects) if o.name == "Corners")
    objects[k] = dataclasses.replace(objects[k], colors={"Col": rng.uniform(0.2, 0.9, (2, 3, 4)).astype(np.float32)})
    return dataclasses.replace(scene, objects=tuple(objects), textures=(Texture("Image", pixels), Texture("Grey", plain)))


def with_channels(scene: SceneArrays, order: list[int]) -> SceneArrays:
    """The scene whose channels are those of `scene` in another order; the same one three times makes it grey."""

    def rgb(x):
        return tuple(x[c] for c in order)

    def color(x):
        return dataclasses.replace(x, terms=tuple(dataclasses.replace(t, constant=rgb(t.constant)) for t in x.terms))

    def last_axis(x):
        return x[..., [*order, 3]].copy()

    def material(m):
        return dataclasses.replace(m, lobes=tuple(dataclasses.replace(x, color=color(x.color)) for x in m.lobes))

    return dataclasses.replace(
        scene,
        materials=tuple(material(m) for m in scene.materials),
        lights=tuple(dataclasses.replace(x, color=rgb(x.color)) for x in scene.lights),
        background=rgb(scene.background),
        textures=tuple(dataclasses.replace(t, stored=last_axis(t.stored)) for t in scene.textures),
        objects=tuple(dataclasses.replace(o, colors={k: last_axis(v) for k, v in o.colors.items()}) for o in scene.objects),
    )


def textured(scene: SceneArrays) -> SceneArrays:
    """The scene with a coloured and a grey image, and a colour attribute "Col" on every object."""
    rng = np.random.default_rng(3)
    pixels = np.ones((2, 4, 4, 4), np.float32)
    pixels[0, ..., :3] = rng.uniform(0.1, 0.9, (4, 4, 1)) * HUE
    pixels[1, ..., :3] = rng.uniform(0.1, 0.9, (4, 4, 1))
    colors = [{"Col": rng.uniform(0.2, 1.0, (o.triangle_count, 3, 4)).astype(np.float32)} for o in scene.objects]
    objects = tuple(dataclasses.replace(o, colors=c) for o, c in zip(scene.objects, colors, strict=True))
    return dataclasses.replace(scene, objects=objects, textures=(Texture("Image", pixels[0]), Texture("Grey", pixels[1])))


def hued(factor: float = 1.0) -> tuple[float, float, float]:
    """The one hue of a scene, so that what chooses by a sum over the channels chooses alike in each of them."""
    return tuple(factor * HUE)


def coloured_light() -> SceneArrays:
    """A grey floor and wall in coloured light, some of which passes a coloured pane."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Wall", (0, 1, 0), (1, 0, 0), (0, 0, 1), diffuse("Wall", 0.7))
    b.quad("Pane", (0, 0, 0.3), (0.5, 0, 0), (0, 0.9, 0), Material("Pane", (Lobe("transparent", Color.of(*hued())),)))
    b.quad("Glow", (0, 0, 1), (0, 0.5, 0), (1, 0, 0), Material("Glow", (Lobe("emission", Color((Term((3.0,) * 3, (IMAGE,)),))),)))
    b.light(Light("Point", "point", hued(0.3), (0.5, 0.5, 0.6), radius=0.02))
    b.light(Light("Spot", "spot", hued(1.0), (0.3, 0.5, 0.9), spot_angle=1.0, spot_blend=0.3))
    b.light(Light("Area", "area", hued(12.0), (0.7, 0.3, 0.8), size_x=0.2, size_y=0.1))
    b.light(Light("Sun", "sun", hued(0.6), angle=0.02))
    b.background = hued(0.2)
    return textured(b.build())


def coloured_surfaces() -> SceneArrays:
    """A room of many coloured surfaces in the white light of its ceiling."""
    share, rest = Color((Term((0.6,) * 3, (GREY,)),)), Color((Term((1.0,) * 3), Term((-0.6,) * 3, (GREY,))))
    hue, painted = Color.of(*hued()), Color((Term((0.9,) * 3, (IMAGE,)), Term(hued(0.2))))
    walls = [
        Material("Mixed", (Lobe("diffuse", painted, weight=share), Lobe("glossy", hue, 0.6, weight=rest))),
        Material("Metal", (Lobe("metallic", hue, 0.6, multiscatter=True),)),
        Material("Coat", (Lobe("specular", hue, 0.5, 1.5), Lobe("diffuse", hue))),
        Material("Corners", (Lobe("diffuse", Color((Term(hued(), (Source("attribute", "Col"),)),))),)),
        Material("Rough", (Lobe("rough diffuse", hue, 0.8, multiscatter=True),)),
        diffuse("Above", hued(0.5), 1.0),
    ]
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), walls, inward=True)
    b.quad("Glass", (0.2, 0.2, 0.5), (0.6, 0, 0), (0, 0.6, 0), Material("Glass", (Lobe("glass", hue, 0.0, 1.45),)))
    return textured(b.build())


def answer(name: str, kind: str, scene: SceneArrays, **options: object) -> Solution:
    """What a method finds in a moment."""
    world, receivers = (World(scene), on_elements(scene, 2.0)) if kind == "elements" else places(kind, scene)
    small = {"samples": 2, "rays": 16, "particles": 3000, "light_points": 2, "max_edge": 2.0, "bin_rows": 2, "bin_columns": 4}
    known = {f.name for f in dataclasses.fields(method(name).Settings)}
    small |= {"tolerance": 0.1, "max_length": 4, "order": 1} | options
    return solve(name, world, receivers, seed=2, **quick(name, scene) | {key: x for key, x in small.items() if key in known})


# ---- what must hold


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_channels_that_change_places_change_the_answer_alike(name, kind):
    if kind not in method(name).spec.receivers:
        pytest.skip(f"{name} does not answer {kind}")
    scene = coloured()
    one, other = answer(name, kind, scene), answer(name, kind, with_channels(scene, ORDER))
    for array in ARRAYS:
        a, b = getattr(one, array), getattr(other, array)
        np.testing.assert_allclose(b, a[:, ORDER] if a.ndim == 2 else a, rtol=1e-4, atol=1e-5 * a.max(), err_msg=array)
    if ROWS[name].kind != "potential":
        for x in (one.direct, one.direct if ROWS[name].kind == "direct" else one.indirect):
            assert (np.ptp(x, axis=1) > 0.1 * x.max()).any(), "a scene too grey to tell"


@pytest.mark.parametrize("build", [coloured_light, coloured_surfaces])
@pytest.mark.parametrize("name", NAMES)
def test_a_channel_is_the_grey_scene_made_of_it(name, build):
    scene = build()
    if ROWS[name].kind == "potential":
        pytest.skip("the same for all channels")
    rays = 20_000 if name in COUNTING_ALL_RAYS else 64
    more = {"samples": 16, "rays": rays, "particles": 10_000, "light_points": 4, "light_samples": 4, "tolerance": 1e-3}
    dark = int(HUE.argmin())  # in which a mean over the channels shows most: as five times as much light
    found, grey = (answer(name, "texels", s, **more) for s in (scene, with_channels(scene, [dark] * 3)))
    assert np.array_equal(found.emitted[:, dark], grey.emitted[:, dark]) and np.array_equal(found.albedo[:, dark], grey.albedo[:, dark])
    for array, off in (("direct", 0.02 if name == "distribution" else 1e-5), ("indirect", 0.15)):
        got, want = getattr(found, array).mean(axis=0)[dark], getattr(grey, array).mean(axis=0)
        np.testing.assert_allclose(want, got, rtol=off, err_msg=array)
