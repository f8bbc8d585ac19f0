# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels: the tab in the 3D View, and the same settings in the render properties of our engine."""

from __future__ import annotations

from . import compare, render, view3d


def register() -> None:
    """Add the panels."""
    view3d.register()
    compare.register()
    render.register()


def unregister() -> None:
    """Remove them."""
    render.unregister()
    compare.unregister()
    view3d.unregister()
