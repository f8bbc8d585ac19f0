"""Margins: nearest texel, never across islands, never over covered texels."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.receivers.margin import fill_margin


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
