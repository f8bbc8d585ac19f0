"""Pictures of a comparison as arrays (h, w, 3) float32 for showing (0..1, sRGB-encoded), row 0 at the bottom.

Side by side at one exposure, false-colour differences with a scale, error over time, histogram of the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .canvas import GLYPH_HEIGHT, Canvas

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
GREY, LIGHT = (0.35, 0.35, 0.35), (0.88, 0.88, 0.88)


@dataclass(frozen=True)
class Curve:
    """One line of a plot: points (n, 2) of x and y."""

    label: str
    points: np.ndarray


def encode(linear: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """sRGB-encoded values in 0..1 of scene-linear ones times `exposure`."""
    x = np.clip(np.asarray(linear, np.float32) * np.float32(exposure), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


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


def side_by_side(images: Sequence[np.ndarray], labels: Sequence[str], exposure: float, columns: int = 4) -> np.ndarray:
    """Images (h, w, 3) scene-linear of one size in a grid, each with its label below, all at one exposure."""
    return _grid([encode(i, exposure) for i in images], labels, columns)


def differences(
    images: Sequence[np.ndarray], reference: np.ndarray, covered: np.ndarray, labels: Sequence[str], limit: float
) -> np.ndarray:
    """Signed differences of luminance to the reference (h, w, 3) in false colours, grey where not `covered` (h, w), with the scale."""
    shown = []
    for image in images:
        picture = false_color((image - reference).mean(axis=-1), limit)
        picture[~covered] = LIGHT
        shown.append(picture)
    grid = _grid(shown, labels, 4)
    out = Canvas(max(grid.shape[1], 220), grid.shape[0] + 36)
    out.paste(0, 36, grid)
    width = out.width - 80
    out.paste(40, 18, np.repeat(false_color(np.linspace(-limit, limit, width), limit)[None], 10, axis=0))
    for x, value in ((40, -limit), (40 + width / 2, 0.0), (40 + width, limit)):
        out.text(x, 6, f"{value:.2g}", GREY, 1.0, 0.5)
    return out.pixels


def _grid(images: Sequence[np.ndarray], labels: Sequence[str], columns: int) -> np.ndarray:
    h, w = images[0].shape[:2]
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    gap, caption = 6, GLYPH_HEIGHT + 8
    out = Canvas(columns * (w + gap) + gap, rows * (h + gap + caption) + gap)
    for i, (image, label) in enumerate(zip(images, labels, strict=True)):
        x = gap + (i % columns) * (w + gap)
        y = out.height - (i // columns + 1) * (h + gap + caption)
        out.paste(x, y + caption, image)
        out.text(x + w / 2, y + 6, label[: max(1, w // 6)], GREY, 1.0, 0.5)
    return out.pixels


def plot(curves: Sequence[Curve], x_label: str, y_label: str, width: int = 720, height: int = 440) -> np.ndarray:
    """Curves on two logarithmic axes with decades as grid, and a legend."""
    canvas = Canvas(width, height)
    left, right, bottom, top = 70, 190, 48, 24
    all_points = np.concatenate([c.points for c in curves if len(c.points)] or [np.ones((1, 2))])
    good = all_points[(all_points > 0).all(axis=1)]
    good = good if len(good) else np.ones((1, 2))
    low = np.floor(np.log10(good.min(axis=0)) * 2) / 2
    high = np.maximum(np.ceil(np.log10(good.max(axis=0)) * 2) / 2, low + 0.5)
    size = np.array([width - left - right, height - bottom - top])

    def place(points: np.ndarray) -> np.ndarray:
        return (np.log10(points) - low) / (high - low) * size + (left, bottom)

    for axis in (0, 1):
        for decade in range(int(np.ceil(low[axis])), int(np.floor(high[axis])) + 1):
            at = (decade - low[axis]) / (high[axis] - low[axis]) * size[axis] + (left, bottom)[axis]
            label = f"{10.0**decade:g}"
            if axis == 0:
                canvas.rectangle(at, bottom, 1, size[1], LIGHT)
                canvas.text(at, bottom - 16, label, GREY, 1.0, 0.5)
            else:
                canvas.rectangle(left, at, size[0], 1, LIGHT)
                canvas.text(left - 6, at - 3, label, GREY, 1.0, 1.0)
    canvas.rectangle(left, bottom, size[0], 1, GREY)
    canvas.rectangle(left, bottom, 1, size[1], GREY)
    canvas.text(left + size[0] / 2, 12, x_label, GREY, 1.2, 0.5)
    canvas.text(left - 60, height - 16, y_label, GREY, 1.2)
    for i, curve in enumerate(curves):
        color = COLORS[i % len(COLORS)]
        points = curve.points[(curve.points > 0).all(axis=1)]
        if len(points):
            at = place(points)
            canvas.line(at, color, 2.0) if len(at) > 1 else None
            canvas.dots(at, color, 5.0)
        y = height - top - 14 * (i + 1)
        canvas.rectangle(width - right + 12, y + 2, 14, 3, color)
        canvas.text(width - right + 32, y, curve.label[:25], GREY)
    return canvas.pixels


def histogram(errors: Sequence[np.ndarray], labels: Sequence[str], limit: float, width: int = 720, height: int = 300) -> np.ndarray:
    """Histograms of relative errors (n,) in -limit..limit, one line a method, all scaled to the highest."""
    canvas = Canvas(width, height)
    left, right, bottom, top = 20, 190, 40, 20
    size = (width - left - right, height - bottom - top)
    counts = [np.histogram(np.clip(e, -limit, limit), 81, (-limit, limit))[0] / max(1, len(e)) for e in errors]
    highest = max((c.max() for c in counts), default=1.0) or 1.0
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        x = left + (share + 1) / 2 * size[0]
        canvas.rectangle(x, bottom, 1, size[1], LIGHT if share else GREY)
        canvas.text(x, bottom - 16, f"{100 * share * limit:.3g}%", GREY, 1.0, 0.5)
    canvas.rectangle(left, bottom, size[0], 1, GREY)
    canvas.text(left + size[0] / 2, 8, "relative error", GREY, 1.2, 0.5)
    middle = (np.arange(81) + 0.5) / 81
    for i, (c, label) in enumerate(zip(counts, labels, strict=True)):
        color = COLORS[i % len(COLORS)]
        canvas.line(np.stack([left + middle * size[0], bottom + c / highest * size[1]], axis=1), color, 2.0)
        y = height - top - 14 * (i + 1)
        canvas.rectangle(width - right + 12, y + 2, 14, 3, color)
        canvas.text(width - right + 32, y, label[:25], GREY)
    return canvas.pixels
