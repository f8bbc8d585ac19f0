# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `methods`: the taxonomy as a table or as JSON, from the registry."""

from __future__ import annotations

import argparse

from ...core.base.text import json_text
from ...core.method import registry
from ...core.method.registry import MethodSpec


def methods(options: argparse.Namespace) -> int:
    """Print all methods."""
    specs = [solver.spec for solver in registry.methods()]
    print(json_text([entry(spec) for spec in specs], indent=1) if options.json else table(specs))
    return 0


def entry(spec: MethodSpec) -> dict[str, object]:
    """A method for JSON."""
    return {
        "identifier": spec.id,
        "label": spec.label,
        "strategy": [str(s) for s in spec.strategies],
        "nature": [str(n) for n in spec.natures],
        "authors": spec.authors,
        "year": spec.year,
        "title": spec.title,
        "equation": spec.equation,
        "section": spec.section,
        "limits": list(spec.limits),
        "targets": list(spec.receivers),
    }


def table(specs: list[MethodSpec]) -> str:
    """Columns of text, one line a method, and the limits below."""
    rows = [("identifier", "strategy", "nature", "year", "authors")]
    rows += [(s.id, " or ".join(s.strategies), " or ".join(s.natures), str(s.year), s.authors) for s in specs]
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(w) for text, w in zip(row, width, strict=True)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * w for w in width))
    for spec in specs:
        lines += ["", f"{spec.label} ({spec.id}): {spec.equation}", *(f"  cannot: {limit}" for limit in spec.limits)]
    return "\n".join(lines)
