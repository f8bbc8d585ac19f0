# SPDX-License-Identifier: GPL-3.0-or-later
"""Text that fits: lines broken at the width of the region, and numbers as people read them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import blf
import bpy

from ..adjoint_gi.bridge.props.records import plain

FONT = 0


def wrap(text: str, width: float, measure: Callable[[str], float]) -> list[str]:
    """Break `text` into lines not wider than `width`, at spaces where possible; `measure` gives the width of a string."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}" if line else word
            if measure(longer) <= width:
                line = longer
                continue
            if line:
                lines.append(line)
            # A word that is wider than a line is broken where it must be.
            while measure(word) > width and len(word) > 1:
                cut = next((n for n in range(len(word) - 1, 1, -1) if measure(word[:n]) <= width), 1)
                lines.append(word[:cut])
                word = word[cut:]
            line = word
        lines.append(line)
    return lines


def label(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE", indent: float = 0.0) -> None:
    """Draw `text` as labels that fill the region's width; `indent` is what boxes and icons around it take, in widget units."""
    unit = _unit(context)
    width = room(context) - (indent + (1.2 if icon != "NONE" else 0.0)) * unit
    column = layout.column(align=True)
    column.scale_y = 0.8
    for i, line in enumerate(wrap(text, max(width, 4 * unit), _measure(context))):
        # Lines below the icon are moved by a blank one of the same size.
        column.label(text=line, icon=icon if i == 0 else ("BLANK1" if icon != "NONE" else "NONE"))


def room(context: bpy.types.Context) -> float:
    """Width in pixels that a panel of the region leaves for text."""
    return (context.region.width if context.region else 300) - 2.6 * _unit(context)


def fits(context: bpy.types.Context, words: Iterable[str], share: float = 1.0) -> bool:
    """Whether each of `words` can be read on a button or as a name that gets `share` of the width."""
    widest = max(map(_measure(context), words), default=0.0)
    return widest + 0.8 * _unit(context) <= share * room(context)


def _unit(context: bpy.types.Context) -> float:
    """Height of a button in pixels."""
    return 20.0 * context.preferences.system.ui_scale


def _measure(context: bpy.types.Context) -> Callable[[str], float]:
    points = context.preferences.ui_styles[0].widget.points
    blf.size(FONT, points * context.preferences.system.ui_scale)
    return lambda text: blf.dimensions(FONT, text)[0]


def duration(seconds: float) -> str:
    """Seconds as "0.42 s", "12.3 s", "4 min 05 s" or "2 h 03 min"."""
    if seconds < 9.995:
        return f"{seconds:.2f} s"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes = round(seconds) // 60
    if minutes < 60:
        return f"{minutes} min {round(seconds) % 60:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def count(number: int) -> str:
    """A count as "950", "12,300", "4.56 million" or "1.20 billion"."""
    if number < 1_000_000:
        return f"{number:,}"
    if number < 1_000_000_000:
        return f"{number / 1e6:.2f} million"
    return f"{number / 1e9:.2f} billion"


def watts(flux: float) -> str:
    """A flux in W with four digits."""
    return f"{flux:.4g} W"


def percent(share: float) -> str:
    """A share in percent, two digits; what is left of rounding errors is only shown as small."""
    if 0 < share < 1e-6:
        return "under 0.0001 %"
    return f"{plain(100 * share)} %"
