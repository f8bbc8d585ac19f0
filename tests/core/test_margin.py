"""Margins: nearest texel, never across islands, never over covered texels."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.receivers import margin
from adjgi.adjoint_gi.core.receivers.margin import FilledImage, margin_source


def fill_margin(image, covered, width):
    """A copy of `image` with its margins filled, and the source of each pixel."""
    source = margin_source(covered, width)
    out = np.where((source >= 0)[..., None], image.reshape(-1, image.shape[2])[source], image)
    return out, source


def brute(covered, width):
    """Squared distance of every pixel to the nearest covered one within `width`, else -1."""
    ys, xs = np.nonzero(covered)
    out = np.full(covered.shape, -1)
    for y in range(covered.shape[0]):
        for x in range(covered.shape[1]):
            d = ((ys - y) ** 2 + (xs - x) ** 2).min() if len(ys) else 10**9
            out[y, x] = d if d <= width * width else -1
    return out


@pytest.mark.parametrize("width", [0, 1, 3, 16])
def test_source_is_the_nearest_covered_texel(width):
    rng = np.random.default_rng(width)
    covered = rng.random((40, 31)) < 0.02
    image = rng.random((40, 31, 3)).astype(np.float32)
    out, source = fill_margin(image, covered, width)
    want = brute(covered, width)
    y, x = np.mgrid[:40, :31]
    got = (source // 31 - y) ** 2 + (source % 31 - x) ** 2
    assert np.array_equal(np.where(source >= 0, got, -1), want)
    grown = source >= 0
    assert np.array_equal(out[grown], image.reshape(-1, 3)[source[grown]])
    assert np.array_equal(out[~grown], image[~grown])
    assert np.array_equal(out[covered], image[covered])


def test_two_islands_meet_half_way():
    covered = np.zeros((9, 20), bool)
    covered[:, :4] = covered[:, 14:] = True
    image = np.zeros((9, 20, 1), np.float32)
    image[:, :4], image[:, 14:] = 1, 2
    out, _ = fill_margin(image, covered, 16)
    assert np.all(out[:, :9] == 1) and np.all(out[:, 9:] == 2)
    out, source = fill_margin(image, covered, 2)
    assert np.all(out[:, 4:6] == 1) and np.all(out[:, 12:14] == 2) and np.all(source[:, 6:12] == -1)


def test_nothing_covered_leaves_everything():
    image = np.full((3, 3, 3), 5, np.float32)
    out, source = fill_margin(image, np.zeros((3, 3), bool), 4)
    assert np.array_equal(out, image) and np.all(source == -1)


def test_ties_go_to_the_lower_and_to_the_left_texel():
    covered = np.zeros((5, 5), bool)
    covered[2, [0, 4]] = True
    assert fill_margin(np.zeros((5, 5, 1), np.float32), covered, 3)[1][2, 2] == 10
    covered = np.zeros((5, 5), bool)
    covered[[0, 4], 2] = True
    assert fill_margin(np.zeros((5, 5, 1), np.float32), covered, 3)[1][2, 2] == 2
    # A texel of the same row comes before those above and below.
    covered[:] = False
    covered[[0, 2], [2, 4]] = True
    assert fill_margin(np.zeros((5, 5, 1), np.float32), covered, 3)[1][2, 2] == 14


def test_an_image_of_receivers_shows_margins_and_gives_any_rows():
    """As placing the values and filling the margins of the whole image would; texels without a sample count as not covered."""
    rng = np.random.default_rng(1)
    pixel = np.flatnonzero(rng.random(40 * 31) < 0.1)
    sampled, values = rng.random(len(pixel)) < 0.7, rng.random((len(pixel), 3)).astype(np.float32)
    filled = FilledImage.of((40, 31), pixel, sampled, 3)
    has, whole = np.zeros(40 * 31, bool), np.zeros((40 * 31, 3), np.float32)
    has[pixel[sampled]], whole[pixel] = True, values
    want = fill_margin(whole.reshape(40, 31, 3), has.reshape(40, 31), 3)[0]
    image = filled.image(values)
    assert image.shape == (40, 31, 3) and np.array_equal(image[slice(0, 40)], want) and np.array_equal(image[slice(7, 9)], want[7:9])
    assert np.array_equal(filled.sampled, has.reshape(40, 31))


@pytest.mark.parametrize("rows", [1, 3, 7])
def test_blocks_of_rows_know_what_lies_beyond_them(rows, monkeypatch):
    covered = np.random.default_rng(2).random((40, 31)) < 0.02
    whole = margin_source(covered, 6)
    monkeypatch.setattr(margin, "PIXELS_PER_BLOCK", 31 * rows)
    assert np.array_equal(margin_source(covered, 6), whole)


def test_only_pixels_near_islands_are_looked_at(monkeypatch):
    """A row far from every island costs nothing, and one beside an island is done when no farther row can be nearer."""
    looked = []
    real = margin._nearest
    monkeypatch.setattr(
        margin, "_nearest", lambda left, right, row, column, width: looked.append(len(row)) or real(left, right, row, column, width)
    )
    covered = np.zeros((200, 50), bool)
    covered[:20] = True
    margin_source(covered, 4)
    assert looked == [4 * 50]
