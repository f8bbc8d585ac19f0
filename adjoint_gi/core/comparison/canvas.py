"""A small raster canvas: rectangles, lines and labels on a (h, w, 3) float array, for plots that must become Blender images.

Letters are strokes on a grid of 4 x 6 points, capitals only; they are ours, so no font file has to ship.
"""

from __future__ import annotations

import numpy as np

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
