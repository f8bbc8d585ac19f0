# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws docs/pictures/house.svg: the folders as rooms in their one-way order, and which room imports from which, read off the sources.

    python bench/house_picture.py

One row a room; a dot stands in the column of a room that it imports from, larger the more files do. A room may import only from rooms
above it, so everything right of the diagonal is free for what the rooms hold.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections import Counter
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
if "adjgi" not in sys.modules:
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.tests.test_architecture import ORDER, PRODUCT, imports, part_of, read  # noqa: E402

PICTURE = ROOT / "docs" / "pictures" / "house.svg"
PARTS = ("adjoint_gi/core", "solvers", "adjoint_gi/bridge", "operators", "panels")
COLORS = dict(zip(PARTS, ("#3b6ea5", "#b3541e", "#4b7f52", "#7a5195", "#7a5195"), strict=True))
NOTES = {"solvers": "The methods, one file each.", "operators": "Blender's operators.", "panels": "Blender's panels."}
CELL, EDGE, WIDTH = 20, 12, 1160
RADII = ((1, 3.0), (3, 4.5), (8, 6.5))  # of a dot, from so many files on


def rooms() -> list[str]:
    """All rooms in their order: paths of folders."""
    return [room for part in PARTS for room in ([f"{part}/{folder}" for folder in ORDER[part].split()] if part in ORDER else [part])]


def room_of(path: str) -> str:
    """The room of a file, or of a module or name in one."""
    part = part_of(path)
    return "/".join(path.split("/")[:3]) if part in ORDER else part


def edges() -> Counter[tuple[str, str]]:
    """(room, room that it imports from) -> number of files that do."""
    known = set(rooms())
    found: Counter[tuple[str, str]] = Counter()
    for path in PRODUCT:
        targets = {room_of(name) for name, relative in imports(ast.parse(read(path)), path) if relative}
        found.update((room_of(path), target) for target in targets & known - {room_of(path)} if room_of(path) in known)
    return found


def note(room: str) -> str:
    """What the room holds."""
    return NOTES.get(room) or ast.get_docstring(ast.parse(read(f"{room}/__init__.py")))


def svg() -> str:
    """The picture."""
    order, found = rooms(), edges()
    place = {room: EDGE + i * CELL for i, room in enumerate(order)}
    height = len(order) * CELL + 2 * EDGE
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" font-family="sans-serif" font-size="12">']
    out.append(f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>')
    for y in place.values():
        # The way that the columns of a room take down to those who import from it.
        out.append(f'<path d="M{EDGE} {y + CELL / 2:g}H{y}M{y + CELL / 2:g} {y + CELL}V{height - EDGE}" stroke="#e4e4e4" fill="none"/>')
    for (room, target), count in sorted(found.items(), key=lambda item: (place[item[0][0]], place[item[0][1]])):
        radius = max(size for least, size in RADII if count >= least)
        x, y = place[target] + CELL / 2, place[room] + CELL / 2
        text = f"{room} imports from {target}: {count} {'file' if count == 1 else 'files'}"
        out.append(f'<circle cx="{x:g}" cy="{y:g}" r="{radius}" fill="{COLORS[part_of(target)]}"><title>{text}</title></circle>')
    for room, y in place.items():
        files = sum(room_of(path) == room and not path.endswith("__init__.py") for path in PRODUCT)
        color, name = COLORS[part_of(room)], room.removeprefix("adjoint_gi/")
        out.append(f'<rect x="{y + 1}" y="{y + 1}" width="{CELL - 2}" height="{CELL - 2}" rx="3" fill="{color}"/>')
        text = f'<tspan font-weight="bold" fill="{color}">{name}/</tspan> <tspan fill="#444444">{escape(note(room))} {files} files</tspan>'
        out.append(f'<text x="{y + CELL + 5}" y="{y + 14.5:g}">{text}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
