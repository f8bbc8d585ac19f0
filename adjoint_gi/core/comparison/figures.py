"""Pictures of a comparison as arrays (h, w, 3) float32 for showing (0..1, sRGB-encoded), row 0 at the bottom.

Side by side at one exposure, false-colour differences with a scale, error over time, histogram of the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.color import encode_srgb

# Distinct on white and for colour-blind eyes (Okabe and Ito 2008), then darker variants.
COLORS = (
    (0.00, 0.45, 0.70),
    (0.84, 0.37, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
    (0.35, 0.35, 0.35),
    (0.55, 0.25, 0.10),
    (0.30, 0.20, 0.60),
    (0.45, 0.60, 0.10),
    (0.70, 0.10, 0.20),
    (0.10, 0.40, 0.40),
    (0.60, 0.60, 0.60),
    (0.20, 0.10, 0.10),
)
GREY, LIGHT = (0.25, 0.25, 0.25), (0.88, 0.88, 0.88)
UNKNOWN = (0.72, 0.72, 0.72)  # where nothing can be compared
TEXT = 1.4  # scale of all letters
LEGEND = 250  # pixels beside a plot

# Letters are strokes on a grid of 4 x 6 points, capitals only; they are ours, so no font file has to ship.
# Each glyph: polylines of points "xy" with x 0..4 to the right and y 0..6 up, separated by "|".
_STROKES = {
    "0": "10 30 41 45 36 16 05 01 10|01 45",
    "1": "05 26 20|00 40",
    "2": "05 16 36 45 44 00 40",
    "3": "06 46 23 33 42 41 30 10 01",
    "4": "30 36 02 42",
    "5": "46 06 03 33 42 41 30 10 01",
    "6": "36 16 05 01 10 30 41 42 33 03",
    "7": "06 46 10",
    "8": "10 30 41 42 33 13 04 05 16 36 45 44 33|13 02 01 10",
    "9": "10 30 41 45 36 16 05 04 13 43",
    "A": "00 04 26 44 40|02 42",
    "B": "00 06 36 45 44 33 03|33 42 41 30 00",
    "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00",
    "E": "46 06 00 40|03 33",
    "F": "46 06 00|03 33",
    "G": "45 36 16 05 01 10 30 41 43 23",
    "H": "00 06|40 46|03 43",
    "I": "16 36|26 20|10 30",
    "J": "46 41 30 10 01",
    "K": "00 06|46 03 40",
    "L": "06 00 40",
    "M": "00 06 23 46 40",
    "N": "00 06 40 46",
    "O": "10 30 41 45 36 16 05 01 10",
    "P": "00 06 36 45 44 33 03",
    "Q": "10 30 41 45 36 16 05 01 10|22 40",
    "R": "00 06 36 45 44 33 03|23 40",
    "S": "45 36 16 05 04 13 33 42 41 30 10 01",
    "T": "06 46|26 20",
    "U": "06 01 10 30 41 46",
    "V": "06 20 46",
    "W": "06 10 24 30 46",
    "X": "00 46|06 40",
    "Y": "06 23 46|23 20",
    "Z": "06 46 00 40",
    ".": "20 21",
    ",": "21 10",
    ":": "21 22|24 25",
    "-": "13 33",
    "+": "03 43|21 25",
    "%": "00 46|05 06 16 15 05|30 31 41 40 30",
    "/": "00 46",
    "(": "36 24 22 30",
    ")": "16 24 22 10",
    "=": "02 42|04 44",
    "_": "00 40",
    "<": "45 03 41",
    ">": "05 43 01",
    "*": "03 43|11 35|15 31",
    "'": "26 24",
}
GLYPH_WIDTH, GLYPH_HEIGHT = 6, 9  # of one letter with its space, at scale 1


class Canvas:
    """`pixels` (h, w, 3) float32 with row 0 at the bottom; coordinates are pixels from the lower left."""

    def __init__(self, width: int, height: int, color: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        self.pixels = np.empty((height, width, 3), np.float32)
        self.pixels[:] = color

    @property
    def width(self) -> int:
        """Pixels across."""
        return self.pixels.shape[1]

    @property
    def height(self) -> int:
        """Pixels up."""
        return self.pixels.shape[0]

    def rectangle(self, x: float, y: float, width: float, height: float, color: tuple[float, float, float]) -> None:
        """Fill an axis-aligned rectangle, cut at the canvas."""
        x0, x1 = (int(np.clip(round(a), 0, self.width)) for a in (x, x + width))
        y0, y1 = (int(np.clip(round(a), 0, self.height)) for a in (y, y + height))
        self.pixels[y0:y1, x0:x1] = color

    def paste(self, x: int, y: int, image: np.ndarray) -> None:
        """Copy `image` (h, w, 3) with its lower left corner at (x, y); it must fit."""
        h, w = image.shape[:2]
        self.pixels[y : y + h, x : x + w] = image

    def line(self, points: np.ndarray, color: tuple[float, float, float], width: float = 1.0) -> None:
        """Draw a polyline through `points` (n, 2) by stamping dots closer than a pixel, smoothed at the edges."""
        points = np.asarray(points, float)
        for a, b in zip(points[:-1], points[1:], strict=True):
            steps = max(2, int(np.ceil(2 * np.abs(b - a).max())) + 1)
            self.dots(a + (b - a) * np.linspace(0, 1, steps)[:, None], color, width)

    def dots(self, points: np.ndarray, color: tuple[float, float, float], width: float) -> None:
        """Round dots of a diameter at `points` (n, 2)."""
        r = width / 2
        reach = np.arange(-int(np.ceil(r)) - 1, int(np.ceil(r)) + 2)
        dx, dy = (a.ravel() for a in np.meshgrid(reach, reach))
        x = np.floor(points[:, :1]) + dx
        y = np.floor(points[:, 1:]) + dy
        away = np.hypot(x + 0.5 - points[:, :1], y + 0.5 - points[:, 1:])
        cover = np.clip(r + 0.5 - away, 0, 1)
        inside = (cover > 0) & (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)
        index = (y[inside] * self.width + x[inside]).astype(np.int64)
        best = np.zeros(self.width * self.height, np.float32)
        np.maximum.at(best, index, cover[inside])
        at = np.unique(index)
        flat = self.pixels.reshape(-1, 3)
        flat[at] += best[at, None] * (np.asarray(color, np.float32) - flat[at])

    def text(
        self, x: float, y: float, text: str, color: tuple[float, float, float] = (0, 0, 0), scale: float = 1.0, align: float = 0.0
    ) -> None:
        """Write `text` with its base line at y; `align` 0 starts at x, 0.5 centres on it, 1 ends there. Unknown letters become '*'."""
        x = x - align * text_width(text, scale)
        for letter in text.upper():
            strokes = _STROKES.get(letter, _STROKES["*"]) if letter != " " else ""
            for stroke in filter(None, strokes.split("|")):
                points = np.array([(x + scale * int(p[0]), y + scale * int(p[1])) for p in stroke.split()], float) + 0.5
                self.line(points, color, max(1.0, 0.9 * scale))
            x += GLYPH_WIDTH * scale


def text_width(text: str, scale: float = 1.0) -> float:
    """Pixels that `text` takes."""
    return max(0, len(text) * GLYPH_WIDTH - 2) * scale


@dataclass(frozen=True)
class Curve:
    """One line of a plot: points (n, 2) of x and y."""

    label: str
    points: np.ndarray


def encode(linear: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """sRGB-encoded values in 0..1 of scene-linear ones times `exposure`."""
    return encode_srgb(np.clip(np.asarray(linear, np.float32) * np.float32(exposure), 0, 1))


def exposure_for(linear: np.ndarray) -> float:
    """The factor that brings the 98th percentile of the brightest channel to 0.9."""
    top = float(np.percentile(np.asarray(linear).max(axis=-1), 98)) if np.size(linear) else 0.0
    return 0.9 / top if top > 0 else 1.0


def false_color(values: np.ndarray, limit: float) -> np.ndarray:
    """(..., 3) colours of signed values: blue below zero, white at zero, red above, full at +-limit."""
    x = np.clip(np.asarray(values, np.float32) / max(limit, 1e-30), -1, 1)
    low, high = np.float32([0.02, 0.19, 0.58]), np.float32([0.70, 0.02, 0.05])
    a = np.abs(x)[..., None]
    return (1 - a) + a * np.where((x < 0)[..., None], low, high)


def side_by_side(
    images: Sequence[np.ndarray], labels: Sequence[str], exposure: float, covered: np.ndarray | None = None, columns: int = 4
) -> np.ndarray:
    """Images (h, w, 3) scene-linear of one size in a grid, each with its label below, all at one exposure; grey where not `covered`."""
    shown = [encode(i, exposure) for i in images]
    if covered is not None:
        for picture in shown:
            picture[~covered] = UNKNOWN
    return _grid(shown, labels, columns)


def round_limit(value: float) -> float:
    """`value` rounded up to 1, 2 or 5 times a power of ten, so that a scale has round numbers; 1 for 0."""
    if not value > 0 or not np.isfinite(value):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in (1, 2, 5, 10) if value <= m * power * (1 + 1e-9)))


def differences(
    images: Sequence[np.ndarray], reference: np.ndarray, covered: np.ndarray, labels: Sequence[str], limit: float, mean: float
) -> np.ndarray:
    """Differences to the reference (h, w, 3) in false colours, grey where not `covered`: the mean over the channels of how far each is
    off, with the sign of their sum, so that too much red is not hidden by too little blue.

    The scale below ends at +-`limit` and is labelled in shares of `mean`.
    """
    shown = []
    for image in images:
        off = image - reference
        picture = false_color(np.copysign(np.abs(off).mean(axis=-1), off.sum(axis=-1)), limit)
        picture[~covered] = UNKNOWN
        shown.append(picture)
    grid = _grid(shown, labels, 4)
    scale = 58
    out = Canvas(max(grid.shape[1], 360), grid.shape[0] + scale)
    out.paste(0, scale, grid)
    width = min(out.width, 640) - 100
    bar = np.repeat(false_color(np.linspace(-limit, limit, width), limit)[None], 14, axis=0)
    out.rectangle(49, 31, width + 2, 16, GREY)
    out.paste(50, 32, bar)
    for x, value in ((50, -limit), (50 + width / 2, 0.0), (50 + width, limit)):
        out.rectangle(x, 27, 1, 5, GREY)
        out.text(x, 14, f"{100 * value / mean:+.3g}%" if value else "0", GREY, TEXT, 0.5)
    if out.width > 50 + width + 40 + 24 * GLYPH_WIDTH * TEXT:
        out.text(50 + width + 40, 33, "of the reference's mean", GREY, TEXT)
    return out.pixels


def _grid(images: Sequence[np.ndarray], labels: Sequence[str], columns: int) -> np.ndarray:
    h, w = images[0].shape[:2]
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    gap, caption = 8, int(GLYPH_HEIGHT * TEXT) + 10
    out = Canvas(columns * (w + gap) + gap, rows * (h + gap + caption) + gap)
    for i, (image, label) in enumerate(zip(images, labels, strict=True)):
        x = gap + (i % columns) * (w + gap)
        y = out.height - (i // columns + 1) * (h + gap + caption)
        out.paste(x, y + caption, image)
        # A long label is written smaller, and only cut when that is not enough.
        scale = max(0.9, min(TEXT, w / (GLYPH_WIDTH * max(1, len(label)))))
        out.text(x + w / 2, y + 8, label[: max(1, int(w / (GLYPH_WIDTH * scale)))], GREY, scale, 0.5)
    return out.pixels


def ticks(low: float, high: float) -> list[float]:
    """Values between 10^low and 10^high for a logarithmic axis: powers of ten, with 2 and 5 times them where there are few."""
    decades = range(int(np.floor(low)), int(np.ceil(high)) + 1)
    marks = (1.0, 2.0, 5.0) if high - low <= 2.6 else (1.0,)
    return [v for d in decades for m in marks if low - 1e-9 <= np.log10(v := m * 10.0**d) <= high + 1e-9]


def plot(
    curves: Sequence[Curve], x_label: str, y_label: str, width: int = 900, height: int = 500, floor: float | None = None
) -> np.ndarray:
    """Curves on two logarithmic axes with a grid and a legend; `floor` is a level that no curve can be trusted below."""
    canvas = Canvas(width, height)
    left, right, bottom, top = 80, LEGEND, 60, 36
    all_points = np.concatenate([c.points for c in curves if len(c.points)] or [np.ones((1, 2))])
    good = all_points[(all_points > 0).all(axis=1) & np.isfinite(all_points).all(axis=1)]
    good = good if len(good) else np.ones((1, 2))
    low, high = np.log10(good.min(axis=0)) - 0.06, np.log10(good.max(axis=0)) + 0.06
    if floor and floor > 0:
        low[1] = min(low[1], max(np.log10(floor) - 0.1, low[1] - 1.0))
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 0.2)
    low, high = middle - half, middle + half
    size = np.array([width - left - right, height - bottom - top])

    def place(points: np.ndarray) -> np.ndarray:
        return (np.log10(points) - low) / (high - low) * size + (left, bottom)

    for value in ticks(low[0], high[0]):
        at = place(np.array([value, 1.0]))[0]
        canvas.rectangle(at, bottom, 1, size[1], LIGHT)
        canvas.text(at, bottom - 20, f"{value:g}", GREY, TEXT, 0.5)
    for value in ticks(low[1], high[1]):
        at = place(np.array([1.0, value]))[1]
        canvas.rectangle(left, at, size[0], 1, LIGHT)
        canvas.text(left - 10, at - 4, f"{value:g}", GREY, TEXT, 1.0)
    if floor and floor > 0 and low[1] < np.log10(floor) < high[1]:
        at = place(np.array([1.0, floor]))[1]
        for x in range(left, left + int(size[0]), 12):
            canvas.rectangle(x, at, 6, 1, GREY)
        canvas.text(left + size[0] - 4, at + 4, "noise of the reference", GREY, 1.1, 1.0)
    canvas.rectangle(left, bottom, size[0], 1, GREY)
    canvas.rectangle(left, bottom, 1, size[1], GREY)
    canvas.text(left + size[0] / 2, 14, x_label, GREY, TEXT, 0.5)
    canvas.text(12, height - 20, y_label, GREY, TEXT)
    for i, curve in enumerate(curves):
        points = curve.points[(curve.points > 0).all(axis=1)]
        if len(points):
            at = place(points)
            if len(at) > 1:
                canvas.line(at, COLORS[i % len(COLORS)], 2.0)
            canvas.dots(at, COLORS[i % len(COLORS)], 6.0)
    _legend(canvas, [c.label for c in curves], width - right, height - top)
    return canvas.pixels


def _legend(canvas: Canvas, labels: Sequence[str], x: float, y: float) -> None:
    for i, label in enumerate(labels):
        at = y - 20 * (i + 1)
        canvas.rectangle(x + 16, at + 3, 18, 4, COLORS[i % len(COLORS)])
        scale = min(TEXT, (LEGEND - 44) / (GLYPH_WIDTH * max(1, len(label))))
        canvas.text(x + 42, at, label, GREY, max(0.9, scale))


def histogram(errors: Sequence[np.ndarray], labels: Sequence[str], limit: float, width: int = 900, height: int = 400) -> np.ndarray:
    """Histograms of relative errors (n,) in -limit..limit, one line a method, each with its share on a square-root scale.

    The outermost bins also hold what lies beyond. The square root keeps wide and low histograms visible beside narrow and high ones.
    """
    canvas = Canvas(width, height)
    left, right, bottom, top, bins = 30, LEGEND, 60, 20, 61
    size = (width - left - right, height - bottom - top)
    counts = [np.histogram(np.clip(e, -limit, limit), bins, (-limit, limit))[0] / max(1, len(e)) for e in errors]
    highest = max((c.max() for c in counts), default=1.0) or 1.0
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        x = left + (share + 1) / 2 * size[0]
        canvas.rectangle(x, bottom, 1, size[1], LIGHT if share else UNKNOWN)
        canvas.text(x, bottom - 20, f"{100 * share * limit:.3g}%", GREY, TEXT, 0.5)
    canvas.rectangle(left, bottom, size[0], 1, GREY)
    canvas.text(left + size[0] / 2, 14, "error, share of the reference's mean", GREY, TEXT, 0.5)
    edges = np.repeat(np.arange(bins + 1) / bins, 2)[1:-1]
    for i, c in enumerate(counts):
        steps = np.repeat(np.sqrt(c / highest), 2)
        canvas.line(np.stack([left + edges * size[0], bottom + steps * size[1]], axis=1), COLORS[i % len(COLORS)], 2.0)
    _legend(canvas, labels, width - right, height - top)
    return canvas.pixels
