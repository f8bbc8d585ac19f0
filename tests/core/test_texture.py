# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures of bytes and halves give the values of float ones, bit for bit, and smaller copies their means."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.color import decode_srgb
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder
from adjgi.adjoint_gi.core.scene import texture as textures
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, Source, Term
from adjgi.adjoint_gi.core.scene.passing import Passing
from adjgi.adjoint_gi.core.scene.shading import LARGEST_EMISSION, Shading
from adjgi.adjoint_gi.core.scene.texture import Texture, as_bytes, compact, halvings_within, sample_texture


def stored(channels, seed=3, size=(37, 21)):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (*size, channels), np.uint8)


def floats(s, srgb, times_alpha):
    """What float textures of earlier versions held."""
    out = np.ones((*s.shape[:2], 4), np.float32)
    out[..., :3] = (s[..., :3] if s.shape[2] >= 3 else s[..., :1]) * np.float32(1 / 255)
    if s.shape[2] in (2, 4):
        out[..., 3] = s[..., -1] * np.float32(1 / 255)
    if times_alpha:
        out[..., :3] *= out[..., 3:]
    if srgb:
        out[..., :3] = decode_srgb(out[..., :3])
    return out


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("srgb", [False, True])
@pytest.mark.parametrize("times_alpha", [False, True])
def test_bytes_have_the_values_of_floats_at_every_texel_and_between(channels, srgb, times_alpha, monkeypatch):
    monkeypatch.setattr(textures, "BLOCK", 100)
    s = stored(channels)
    right = floats(s, srgb, times_alpha and channels in (2, 4))
    small = Texture("a", s, srgb=srgb, times_alpha=times_alpha)
    np.testing.assert_array_equal(small.pixels, right)
    st = np.random.default_rng(1).uniform(-2, 3, (500, 2)).astype(np.float32)
    for extension in ("REPEAT", "EXTEND", "CLIP", "MIRROR"):
        for interpolation in ("Linear", "Closest"):
            found = sample_texture(textures.renamed(small, "b", extension, interpolation), st)
            np.testing.assert_array_equal(found, sample_texture(Texture("b", right, extension, interpolation), st))
    np.testing.assert_allclose(small.row_means, right.mean(axis=1, dtype=np.float64), rtol=1e-12)
    np.testing.assert_array_equal(small.ranges, [right.min(axis=(0, 1)), right.max(axis=(0, 1))])
    assert small.is_grey == (channels < 3)


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize(("dtype", "scale"), [(np.float16, 1.0), (np.float32, 1.0), (np.float32, 1e6)])
def test_compact_loses_nothing(grey, opaque, dtype, scale):
    pixels = (np.random.default_rng(2).random((13, 7, 4)) * scale).astype(dtype).astype(np.float32)
    if grey:
        pixels[..., 1:3] = pixels[..., :1]
    if opaque:
        pixels[..., 3] = 1
    kept = compact(pixels)
    assert kept.dtype == dtype and kept.shape[2] == (1 if grey else 3) + (not opaque)
    np.testing.assert_array_equal(Texture("a", kept).pixels, pixels)


@pytest.mark.parametrize("grey", [False, True])
def test_compact_keeps_what_one_texel_alone_has(grey):
    """Alpha, or colour, of a single texel of an image that is opaque, or grey, elsewhere."""
    for channel in range(4):
        pixels = np.ones((5, 3, 4), np.float32)
        pixels[..., :3] = 0.25 if grey else (0.25, 0.5, 0.75)
        pixels[2, 1, channel] = 0.125
        np.testing.assert_array_equal(Texture("a", compact(pixels)).pixels, pixels)


@pytest.mark.parametrize("size", [(64, 64), (61, 9), (1, 7)])
def test_smaller_copies_are_box_means(size, monkeypatch):
    monkeypatch.setattr(textures, "BLOCK", 70)
    whole = Texture("a", stored(4, size=size), srgb=True)
    small = whole.smaller(2)
    assert (small.height, small.width) == (max(1, size[0] >> 2), max(1, size[1] >> 2))
    np.testing.assert_allclose(small.pixels.mean(axis=(0, 1)), whole.pixels.mean(axis=(0, 1)), rtol=0.08)
    if size == (64, 64):
        boxes = whole.pixels.reshape(16, 4, 16, 4, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(small.pixels, boxes, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("bright", [6e4, 1e6])
def test_smaller_copies_hold_what_is_bright_beside_what_is_dark(bright):
    """Halves end at 65504."""
    pixels = np.ones((4, 4, 4), np.float32)
    pixels[:2, :, :3] = bright
    small = Texture("Lamp", pixels).smaller(1)
    assert small.stored.dtype == (np.float16 if bright == 6e4 else np.float32)
    np.testing.assert_allclose(small.pixels[:, 0, 0], [bright, 1.0], rtol=1e-3)


def test_halving_keeps_what_fits_and_fits_what_it_shrinks():
    whole = Texture("a", stored(3, size=(64, 64)))
    assert halvings_within(whole, whole.stored.nbytes, 64 * 64 * 3) == 0
    for most in (64 * 64 * 3 - 1, 1000, 8):
        assert whole.smaller(halvings_within(whole, whole.stored.nbytes, most)).stored.nbytes <= most


def test_as_bytes_is_exact():
    values = np.arange(256, dtype=np.float32) * np.float32(1 / 255)
    np.testing.assert_array_equal(as_bytes(values), np.arange(256))
    np.testing.assert_array_equal(as_bytes((np.arange(256) / 255).astype(np.float32)), np.arange(256))


BEYOND = {"REPEAT": "wrap", "EXTEND": "edge", "CLIP": "constant", "MIRROR": "symmetric"}


@pytest.mark.parametrize("extension", BEYOND)
def test_beyond_its_borders_an_image_goes_on_as_it_says(extension):
    """Three images away on all sides, of an image that is wider than it is high; between texels it is bilinear."""
    pixels = np.random.default_rng(4).random((3, 5, 4)).astype(np.float32)
    wide = np.pad(pixels, ((9, 9), (15, 15), (0, 0)), BEYOND[extension])
    y, x = (a.ravel() for a in np.meshgrid(np.arange(-9, 11), np.arange(-15, 19), indexing="ij"))
    closest = sample_texture(Texture("a", pixels, extension, "Closest"), np.stack([(x + 0.9) / 5, (y + 0.2) / 3], axis=1))
    np.testing.assert_array_equal(closest, wide[y + 9, x + 15])
    found = sample_texture(Texture("a", pixels, extension, "Linear"), np.stack([(x + 0.75) / 5, (y + 0.9) / 3], axis=1))
    rows = [0.75 * wide[y + k, x + 15] + 0.25 * wide[y + k, x + 16] for k in (9, 10)]
    np.testing.assert_allclose(found, 0.6 * rows[0] + 0.4 * rows[1], atol=1e-5)


def test_parts_of_unequal_size_have_their_own_means(monkeypatch):
    monkeypatch.setattr(textures, "BLOCK", 70)
    whole = Texture("a", stored(4, size=(11, 6)))
    ys, xs = (np.round(np.linspace(0, n, (n >> 1) + 1)).astype(int) for n in (11, 6))
    parts = [[whole.pixels[a:b, c:d].mean(axis=(0, 1)) for c, d in zip(xs, xs[1:])] for a, b in zip(ys, ys[1:])]  # noqa: B905
    np.testing.assert_allclose(whole.smaller(1).pixels, parts, rtol=1e-3)


def test_what_pictures_reflect_and_emit_stays_within_what_can_be_computed():
    """Products of a bright picture and a large strength: no more than the largest emission, nothing below zero, no albedo above 1."""
    pixels = np.array([[[1e6, -1.0, 0.5, 1.0]]], np.float32)
    b = SceneBuilder()
    picture = [Color((Term((x,) * 3, (Source("image", texture=0),)),)) for x in (1.0, 1e6)]
    b.quad("Screen", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Screen", (Lobe("diffuse", picture[0]), Lobe("emission", picture[1]))))
    shading = Shading(dataclasses.replace(b.build(), textures=(Texture("Bright", pixels),)))
    at = np.zeros(1, np.int32), np.full(1, 0.25, np.float32), np.full(1, 0.25, np.float32)
    assert shading.emission(*at)[0] == pytest.approx([LARGEST_EMISSION, 0, 5e5])
    assert shading.albedo(*at)[0] == pytest.approx([1, 0, 0.5])


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_an_image_is_grey_where_all_three_channels_agree(channel):
    stored = np.full((3, 4, 3), 100, np.uint8)
    assert Texture("Image", stored.copy()).is_grey
    stored[1, 2, channel] = 101
    assert not Texture("Image", stored).is_grey


@pytest.mark.parametrize("straight, scattered, tinted", [(0.99, 0.01, True), (0.9, 0.1, False), (0.99, 0.0, False), (1.0, 0.0, False)])
def test_chances_to_pass_are_no_colours_where_they_are_capped(straight, scattered, tinted):
    """Some rays must meet what scatters, so that those which pass carry more than their share."""
    b = SceneBuilder()
    lobes = (Lobe("transparent", Color.of(straight)), *([Lobe("diffuse", Color.of(scattered))] if scattered else []))
    b.quad("Pane", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Pane", lobes))
    passing = Passing.of(b.build())
    one, third = np.zeros(1, np.int64), np.full(1, 1 / 3, np.float32)
    assert passing.tinted == tinted
    assert passing.grey(one, third, third)[0] * passing.color(one, third, third) == pytest.approx(np.full((1, 3), straight))
