# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures made of others have the values of their pixels, in as few bytes as hold them."""

import numpy as np
import pytest
from adjgi.adjoint_gi.core.scene import derived as module
from adjgi.adjoint_gi.core.scene import texture as textures
from adjgi.adjoint_gi.core.scene.derived import derived, largest_size
from adjgi.adjoint_gi.core.scene.texture import Texture

HALF = 2.0**-11  # what rounding to a half changes at most, relatively


def stored(channels, size=(37, 21)):
    return np.random.default_rng(3).integers(0, 256, (*size, channels), np.uint8)


def mixed(flat):
    """Colours that depend on one another and on alpha, some of them above 1."""
    flat[:, :3] = (flat[:, [1, 2, 0]] ** 0.5 + flat[:, :3]) * flat[:, 3:]
    return flat


@pytest.mark.parametrize("by_colors", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("times_alpha", [False, True])
def test_values_of_bytes_are_those_of_their_pixels(channels, times_alpha, by_colors, monkeypatch):
    monkeypatch.setattr(textures, "BLOCK", 100)
    monkeypatch.setattr(module, "BLOCK", 100 if by_colors else 10**6)
    of = Texture("a", stored(channels), "CLIP", "Closest", srgb=True, times_alpha=times_alpha)
    made = derived(of, mixed)
    right = mixed(of.pixels.reshape(-1, 4)).reshape(of.pixels.shape)
    np.testing.assert_allclose(made.pixels, right, rtol=HALF, atol=1e-7)
    assert made.stored.dtype == np.float16 and made.stored.shape[2] == channels and made.stored.nbytes <= largest_size(of)
    assert (made.name, made.extension, made.interpolation) == ("a", "CLIP", "Closest")
    np.testing.assert_array_equal(made.ranges, [made.pixels.min(axis=(0, 1)), made.pixels.max(axis=(0, 1))])
    assert made.is_grey == (channels < 3)


@pytest.mark.parametrize("by_colors", [False, True])
@pytest.mark.parametrize("srgb", [False, True])
def test_what_bytes_hold_stays_bytes(srgb, by_colors, monkeypatch):
    """A channel of three, as packed roughness is, takes a byte a texel, with the same values."""
    monkeypatch.setattr(module, "BLOCK", 100 if by_colors else 10**6)
    of = Texture("a", stored(3), srgb=srgb)

    def green(flat):
        flat[:, :3] = flat[:, 1:2]
        return flat

    made = derived(of, green)
    np.testing.assert_array_equal(made.stored, of.stored[..., 1:2])
    assert made.srgb == srgb


def test_a_colour_that_recurs_is_computed_once(monkeypatch):
    monkeypatch.setattr(module, "BLOCK", 100)
    seen = []

    def counting(flat):
        seen.append(len(flat))
        return mixed(flat)

    derived(Texture("a", np.repeat(stored(3, (1, 21)), 50, axis=0)), counting)
    assert sum(seen) == 2 * 21, "once to see whether bytes do"


def test_halves_are_derived_as_halves(monkeypatch):
    """As a ramp is of the luminance of an image of bytes."""
    grey = Texture("a", np.random.default_rng(2).random((37, 21, 1)).astype(np.float16))
    right = mixed(grey.pixels.reshape(-1, 4)).reshape(37, 21, 4)
    for block in (10**6, 100):
        monkeypatch.setattr(module, "BLOCK", block)
        made = derived(grey, mixed)
        np.testing.assert_allclose(made.pixels, right, rtol=HALF, atol=1e-7)
        assert made.stored.dtype == np.float16 and made.stored.shape == (37, 21, 1)


def test_what_halves_cannot_hold_is_kept_as_floats():
    def bright(flat):
        flat[:, :3] *= 1e6
        return flat

    of = Texture("a", stored(3))
    np.testing.assert_array_equal(derived(of, bright).pixels, bright(of.pixels.reshape(-1, 4)).reshape(of.pixels.shape))
    floats = Texture("b", np.random.default_rng(1).random((5, 4, 4), np.float32))
    np.testing.assert_array_equal(derived(floats, mixed).pixels, mixed(floats.pixels.reshape(-1, 4)).reshape(5, 4, 4))


def test_smaller_copies_are_means_of_what_is_derived():
    """Not what is derived of means: a threshold of a fine pattern stays grey."""

    def threshold(flat):
        flat[:, :3] = flat[:, :3] > 0.9
        return flat

    board = (np.indices((8, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None]
    small = Texture("a", board).smaller(2, threshold)
    np.testing.assert_array_equal(small.pixels[..., :3], np.full((2, 2, 3), 0.5, np.float32))
