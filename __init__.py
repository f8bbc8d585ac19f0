# SPDX-License-Identifier: GPL-3.0-or-later
"""Adjoint GI: bakes and compares global illumination by gathering and shooting. Nothing happens at import."""


def _parts() -> tuple:
    """The modules that register something, in order."""
    from . import operators, panels
    from .adjoint_gi.bridge.baking import check
    from .adjoint_gi.bridge.cli import main as cli
    from .adjoint_gi.bridge.comparison import records as compare_records
    from .adjoint_gi.bridge.engine import render_engine as engine
    from .adjoint_gi.bridge.extract import scene_store
    from .adjoint_gi.bridge.host import background, changes, compositor, preferences
    from .adjoint_gi.bridge.props import properties

    return (properties, compare_records, preferences, background, changes, scene_store, compositor, check, operators, engine, panels, cli)


def register() -> None:
    """Register everything with Blender."""
    for part in _parts():
        part.register()


def unregister() -> None:
    """Stop what runs and take everything back, in reverse order."""
    for part in reversed(_parts()):
        part.unregister()
