# SPDX-License-Identifier: GPL-3.0-or-later
"""A comparison as files: index.html with everything in it, compare.json, and the pictures as PNG."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import bpy

from ...core.base.atomic import check_target, replace_file
from ...core.base.errors import WriteError
from ...core.base.text import json_text
from ...core.comparison import page
from ...core.comparison.run import Result
from ...core.images import png
from ...core.images.png import write_png
from ..baking.report import versions
from ..results import kept
from .request import PICTURES, Compare, CompareRequest

PAGE, DATA = "index.html", "compare.json"


def check_files(request: CompareRequest, folder: Path) -> None:
    """Raise TargetError when one of the files to be written is there and not ours."""
    pictures = PICTURES if request.reference.kind != "none" else PICTURES[:1]
    for name, ours in {PAGE: is_page, DATA: is_json, **{_file(p): png.is_ours for p in pictures}}.items():
        check_target(folder / name, folder, ours)


def keep_files(made: Compare, result: Result) -> list[Path]:
    """Write all into a new folder of our own, when it could not be written where it was meant to go. Raises TargetError or WriteError."""
    place = kept.folder()
    try:
        folder = Path(tempfile.mkdtemp(prefix="compare_", dir=place))
    except OSError as error:
        raise WriteError(str(place), f"cannot be written to ({error.strerror or error})", "Make room and compare again") from error
    return write_files(made, result, folder)


def write_files(made: Compare, result: Result, folder: Path) -> list[Path]:
    """Write all into `folder` and read it back; returns the paths, the page first. Raises TargetError or WriteError."""
    pictures = made.pictures(result)
    known = versions()
    world, receivers = made.driver.world, made.driver.receivers
    facts = [
        ("Scene", Path(bpy.data.filepath).name or made.scene_name),
        ("Triangles", f"{world.triangle_count:,}"),
        ("Receivers", f"{receivers.count:,} {receivers.kind}"),
        ("Adjoint GI", known["adjoint_gi"]),
        ("Blender", known["blender"]),
    ]
    title = f"Comparison: {made.scene_name}"
    text = page.page(title, result, pictures, made.notices, facts).encode()
    data = page.as_json(result, made.notices) | {"scene": dict(facts), "versions": known}
    out = [
        _write(folder / PAGE, folder, text, is_page),
        _write(folder / DATA, folder, json_text(data, indent=1).encode(), is_json),
    ]
    for name, picture in pictures.items():
        out.append(write_png(folder / _file(name), page.decoded(picture), folder=folder))
    return out


def is_page(path: Path) -> bool:
    """Whether a file is a page that we wrote."""
    try:
        with open(path, "rb") as file:
            return page.GENERATOR.encode() in file.read(1024)
    except OSError:
        return False


def is_json(path: Path) -> bool:
    """Whether a file is the JSON beside such a page."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return isinstance(found, dict) and found.get("generator") == page.GENERATOR
    except (OSError, ValueError):
        return False


def _file(picture: str) -> str:
    return picture.replace(" ", "_") + ".png"


def _write(path: Path, folder: Path, data: bytes, ours: Any) -> Path:
    return replace_file(path, folder, write=lambda p: _put(p, data), verify=lambda p: p.read_bytes() == data and ours(p), ours=ours)


def _put(path: Path, data: bytes) -> None:
    with open(path, "wb") as file:
        file.write(data)
