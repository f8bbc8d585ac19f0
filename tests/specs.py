# SPDX-License-Identifier: GPL-3.0-or-later
"""What methods that exist only for tests say of themselves."""

from __future__ import annotations

from adjgi.adjoint_gi.core.method.registry import MethodSpec, Nature, Strategy


def spec_of(id: str, number: int, strategy: Strategy, nature: Nature, **more: object) -> MethodSpec:
    """The spec of a method by nobody; `more` are further fields, or others than those here."""
    about = {"year": 1999, "authors": "Nobody", "title": "Nothing", "section": "0"}
    return MethodSpec(id=id, number=number, label=id.capitalize(), strategies=(strategy,), natures=(nature,), **about, **more)
