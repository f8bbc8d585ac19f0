"""Figures of comparisons: what stands where, at which colour."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.comparison import figures
from adjgi.adjoint_gi.core.comparison.figures import _STROKES, COLORS, LIGHT, UNKNOWN, Canvas, Curve, text_width

WHITE = (1.0, 1.0, 1.0)


def near(picture, color, tolerance=0.02):
    """(h, w) bool: pixels of a colour."""
    return (np.abs(picture - np.asarray(color, np.float32)) < tolerance).all(axis=2)


def test_false_colors_are_white_at_zero_and_full_at_the_limit():
    c = figures.false_color(np.array([0.0, 0.5, -0.5, 9.0, -9.0]), 0.5)
    assert np.allclose(c[0], 1)
    assert c[1][0] > c[1][2] and c[2][2] > c[2][0]  # red above, blue below
    assert np.allclose(c[3], c[1]) and np.allclose(c[4], c[2])
    half = figures.false_color(np.array([0.25]), 0.5)[0]
    assert np.allclose(half, 0.5 + 0.5 * c[1])


def test_exposure_brings_the_bright_parts_into_view():
    x = np.full((8, 8, 3), 5.0)
    assert figures.exposure_for(x) == pytest.approx(0.18)
    assert figures.exposure_for(np.zeros((2, 2, 3))) == 1.0
    assert figures.encode(np.array([1.0]), 1.0)[0] == pytest.approx(1.0)
    assert figures.encode(np.array([0.2140]), 1.0)[0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize(("value", "rounded"), [(0.013, 0.02), (0.05, 0.05), (3.0, 5.0), (7, 10), (1, 1), (0, 1), (float("nan"), 1)])
def test_scales_end_at_round_numbers(value, rounded):
    assert figures.round_limit(value) == pytest.approx(rounded)


def test_ticks_lie_inside_and_are_few():
    assert figures.ticks(-1.05, 0.5) == pytest.approx([0.1, 0.2, 0.5, 1, 2])
    assert figures.ticks(-3, 3) == pytest.approx([1e-3, 1e-2, 0.1, 1, 10, 100, 1000])


def test_side_by_side_shows_all_at_one_exposure():
    dark, bright = np.full((40, 40, 3), 0.1, np.float32), np.full((40, 40, 3), 0.4, np.float32)
    covered = np.ones((40, 40), bool)
    covered[:5] = False
    out = figures.side_by_side([dark, bright], ["a", "b"], 2.0, covered)
    assert near(out, np.repeat(figures.encode(np.array([0.2])), 3)).sum() >= 35 * 40
    assert near(out, np.repeat(figures.encode(np.array([0.8])), 3)).sum() >= 35 * 40
    assert near(out, UNKNOWN).sum() >= 2 * 5 * 40


def test_a_grid_breaks_into_rows():
    images = [np.zeros((20, 30, 3), np.float32)] * 5
    out = figures.side_by_side(images, list("abcde"), 1.0)
    black = near(out, (0, 0, 0))
    rows = np.flatnonzero(black.sum(axis=1) >= 30)
    assert len(rows) == 40 and (black.sum() >= 5 * 600)


def test_differences_are_signed_and_grey_where_unknown():
    reference = np.ones((50, 100, 3), np.float32)
    brighter = reference * np.float32(1.2)
    covered = np.ones((50, 100), bool)
    covered[:, :50] = False
    out = figures.differences([brighter], reference, covered, ["x"], 0.2, 1.0)
    assert near(out, figures.false_color(np.array([0.2]), 0.2)[0]).sum() >= 50 * 50
    assert near(out, UNKNOWN).sum() >= 50 * 50
    same = figures.differences([reference], reference, np.ones_like(covered), ["x"], 0.2, 1.0)
    assert near(same[60:], figures.false_color(np.array([0.2]), 0.2)[0]).sum() == 0


@pytest.mark.parametrize("off", [(0.4, 0.0, -0.2), (0.2, -0.4, 0.0), (-0.1, -0.2, -0.3)])
def test_differences_of_one_colour_do_not_hide_those_of_another(off):
    reference = np.ones((50, 50, 3), np.float32)
    out = figures.differences([reference + np.float32(off)], reference, np.ones((50, 50), bool), ["x"], 0.4, 1.0)
    want = 0.2 if sum(off) >= 0 else -0.2
    assert near(out[60:], figures.false_color(np.array([want]), 0.4)[0]).sum() >= 50 * 50 - 10


def test_a_falling_curve_falls_in_the_plot():
    x = np.geomspace(0.1, 10, 9)
    out = figures.plot([Curve("one", np.stack([x, 10 / np.sqrt(x)], axis=1))], "seconds", "error, %")
    y, at = np.nonzero(near(out[60:, :650], COLORS[0]))
    assert len(y) > 200
    left, right = y[at < np.percentile(at, 10)].mean(), y[at > np.percentile(at, 90)].mean()
    assert left > right + 100
    # A power law is a straight line on these axes.
    slope = np.polyfit(at, y, 1)
    assert np.abs(y - np.polyval(slope, at)).max() < 8


def test_the_noise_of_the_reference_is_a_line_below():
    curve = Curve("one", np.array([[0.1, 10.0], [1.0, 5.0]]))
    with_floor = figures.plot([curve], "s", "%", floor=2.0)
    without = figures.plot([curve], "s", "%")
    row = near(with_floor, figures.GREY)[70:].sum(axis=1)
    assert 150 < row.max() < 400  # dashes
    assert near(without, figures.GREY)[70:].sum(axis=1).max() < 150


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.array([[0.0, 1.0]]), np.array([[1.0, 1.0]]), np.array([[1e-9, 1e9]])])
def test_plots_of_little_or_nothing_do_not_fail(points):
    out = figures.plot([Curve("one", points)], "s", "%")
    assert np.isfinite(out).all() and out.shape == (500, 900, 3)


def test_histograms_lie_where_the_errors_are():
    rng = np.random.default_rng(1)
    out = figures.histogram([0.5 + 0.05 * rng.standard_normal(4000), np.full(4000, -5.0)], ["right", "far"], 1.0)
    plot = out[62:, :650]
    y, x = np.nonzero(near(plot, COLORS[0]))
    high = x[y > 0.8 * y.max()].mean()
    assert 30 + 620 * 0.7 < high < 30 + 620 * 0.8
    y, x = np.nonzero(near(plot, COLORS[1]))
    assert x[y > 0.8 * y.max()].mean() < 60  # what lies beyond is in the outermost bin


def test_letters_stay_inside_and_differ():
    seen = set()
    for letter in _STROKES:
        canvas = Canvas(12, 14)
        canvas.text(3, 3, letter, (0, 0, 0))
        ink = canvas.pixels < 0.5
        assert ink.any(), letter
        seen.add(ink.tobytes())
    # O and 0 share their shape, as do 5 and S up to a serif.
    assert len(seen) >= len(_STROKES) - 1
    assert text_width("AB") == 10


def test_drawing_beyond_the_border_is_cut():
    canvas = Canvas(20, 10)
    canvas.rectangle(-5, -5, 100, 8, LIGHT)
    canvas.line(np.array([[-10.0, 5.0], [30.0, 5.0]]), (1, 0, 0), 3)
    canvas.text(-20, -3, "HELLO WORLD", (0, 0, 0), 2)
    assert canvas.pixels.shape == (10, 20, 3) and near(canvas.pixels, WHITE).any()


def test_exposure_looks_at_the_brightest_colour():
    assert figures.exposure_for(np.full((8, 8, 3), (5.0, 0.5, 0.0))) == pytest.approx(0.18)
    # A few pixels that are brighter than all others do not darken the picture.
    x = np.full((10, 10, 3), 2.0)
    x[0, 0] = 1000.0
    assert figures.exposure_for(x) == pytest.approx(0.45)


def test_the_scale_of_differences_is_labelled_in_shares_of_the_mean(monkeypatch):
    written = []
    monkeypatch.setattr(Canvas, "text", lambda self, x, y, text, *rest: written.append((x, text)))
    grey = np.ones((8, 8, 3), np.float32)
    figures.differences([grey], grey, np.ones((8, 8), bool), ["x"], 0.2, 4.0)
    assert [text for _, text in sorted(written)[-3:]] == ["-5%", "0", "+5%"]


def test_rectangles_fill_their_pixels_and_no_others():
    canvas = Canvas(6, 5)
    canvas.rectangle(1, 2, 3, 2, (0.0, 0.5, 0.0))
    canvas.rectangle(5, -2, 9, 3, (0.0, 0.5, 0.0))
    right = np.zeros((5, 6), bool)
    right[2:4, 1:4] = right[0, 5] = True
    assert np.array_equal(canvas.pixels[..., 0] == 0, right) and (canvas.pixels[right] == (0, 0.5, 0)).all()
