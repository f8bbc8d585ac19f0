# SPDX-License-Identifier: GPL-3.0-or-later
"""Approval: what a test tells must be what its file in `tests/told/` says, line by line.

    ADJOINT_GI_TELL=1 python tests/run.py tests/core/test_told_page.py tests/blender/test_told_panels.py

rewrites the files. They only record: read every line that changes and reckon its numbers anew before it is committed. Tests choose
numbers of which no two are alike, say how they are reckoned, and keep clocks, paths, versions and memory out.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

TOLD = Path(__file__).resolve().parent / "told"


def approve(name: str, lines: Iterable[str]) -> None:
    """Assert that `lines` are those of the file `name`; write them there where ADJOINT_GI_TELL is set."""
    path, found = TOLD / f"{name}.txt", [line.rstrip() for text in lines for line in text.split("\n")]
    if os.environ.get("ADJOINT_GI_TELL"):
        TOLD.mkdir(exist_ok=True)
        path.write_text("\n".join(found) + "\n", encoding="utf-8")
    assert found == path.read_text(encoding="utf-8").splitlines(), f"other than {path.name} says"


def flat(value: dict[str, Any], where: str = "", digits: int = 6) -> Iterator[str]:
    """A dictionary of JSON in lines "key: value", one for each dictionary of a list; numbers with so many digits."""
    for key, item in value.items():
        name = f"{where}{key}"
        if isinstance(item, dict) and item:
            yield from flat(item, f"{name}.", digits)
        elif isinstance(item, list) and item and isinstance(item[0], dict):
            for k, each in enumerate(item):
                yield f"{name} {k}: " + ", ".join(flat(each, digits=digits))
        else:
            yield f"{name}: {_rounded(item, digits)}"


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, list | tuple):
        return [_rounded(v, digits) for v in value]
    # What is left of rounding errors differs between machines.
    return float(f"{value if abs(value) > 1e-9 else 0.0:.{digits}g}") if isinstance(value, float) else value
