"""Text for others to read: names from files that strangers made, numbers, and JSON that every reader accepts."""

from __future__ import annotations

import json
import math
import unicodedata
from typing import Any

# Controls (C0, C1), marks that turn the direction of writing or cannot be seen, ends of lines, halves of characters.
HIDDEN = {"Cc", "Cf", "Zl", "Zp", "Cs"}
JOINERS = "\u200c\u200d"  # invisible too, but a part of words in several scripts and of emoji
NOT_NUMBERS = "not_numbers"  # key of a report under which the places of null stand that are no finite numbers


def printable(text: str, keep: str = "") -> str:
    """`text` with everything that a terminal would obey instead of show written as an escape such as \\x1b or \\n, so that a name is one
    line, in the order in which it is stored. Characters in `keep` stay."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if c in keep or c in JOINERS or unicodedata.category(c) not in HIDDEN else _escape(c) for c in text)


def _escape(c: str) -> str:
    return c.encode("unicode_escape").decode()


def plain(x: float, digits: int = 2, sign: str = "") -> str:
    """`x` with so many digits that count, and never with an exponent for many before the point: 100, not 1e+02. `sign`: "+" to have it."""
    text = f"{x:{sign}.{digits}g}"
    return f"{x:{sign}.0f}" if "e+" in text else text


def json_text(value: Any, indent: int | None = None) -> str:
    """Strict JSON (RFC 8259), which has neither infinity nor NaN: these become null.

    Where `value` is a dictionary, its key "not_numbers" then says what stood there, by place: {"history[0][1]": "infinity"}.
    """
    found: dict[str, str] = {}
    clean = _finite(value, "", found)
    if found and isinstance(clean, dict):
        clean = {**clean, NOT_NUMBERS: found}
    return json.dumps(clean, indent=indent, allow_nan=False)


def _finite(value: Any, place: str, found: dict[str, str]) -> Any:
    """The same with None for floats that are not finite, which are noted in `found` by their place."""
    if isinstance(value, dict):
        return {k: _finite(v, f"{place}.{k}" if place else str(k), found) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v, f"{place}[{i}]", found) for i, v in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        found[place] = "not a number" if math.isnan(value) else "infinity" if value > 0 else "minus infinity"
        return None
    return value
