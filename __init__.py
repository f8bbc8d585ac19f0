# SPDX-License-Identifier: GPL-3.0-or-later
"""Adjoint GI: bakes and compares global illumination by gathering and shooting. Nothing happens at import."""


def _parts() -> tuple:
    """The modules that register something, in order."""
    from . import operators, panels
    from .adjoint_gi.bridge import check, cli, compare_job, compare_records, engine, jobs, preferences, properties

    return (properties, compare_records, preferences, jobs, compare_job, check, operators, engine, panels, cli)


def register() -> None:
    """Register everything with Blender."""
    for part in _parts():
        part.register()


def unregister() -> None:
    """Stop what runs and take everything back, in reverse order."""
    for part in reversed(_parts()):
        part.unregister()
