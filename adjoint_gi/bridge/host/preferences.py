# SPDX-License-Identifier: GPL-3.0-or-later
"""Preferences of the extension: what belongs to the machine and the person, not to a scene."""

from __future__ import annotations

import os

import bpy

from .... import __package__ as base_package

_ENVIRONMENT = os.environ.get("ADJOINT_GI_THREADS", "")


class ADJOINTGI_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of Adjoint GI"""

    bl_idname = base_package

    threads: bpy.props.IntProperty(
        name="Threads",
        description="Threads that trace rays; 0 uses every core. The result does not depend on it",
        default=0,
        min=0,
        max=256,
    )
    refresh: bpy.props.FloatProperty(
        name="Refresh",
        description="Seconds between two updates of the image or attribute while a bake runs",
        default=1.0,
        min=0.2,
        max=60.0,
        soft_max=10.0,
        subtype="TIME_ABSOLUTE",
        unit="TIME_ABSOLUTE",
    )

    def draw(self, context: bpy.types.Context) -> None:
        """The two settings."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "threads")
        layout.prop(self, "refresh")


def apply_threads() -> None:
    """Set how many threads the core uses: the user's choice, else that of the environment when Blender started."""
    entry = bpy.context.preferences.addons.get(base_package)
    wanted = entry.preferences.threads if entry and entry.preferences else 0
    text = str(wanted) if wanted else _ENVIRONMENT
    if text:
        os.environ["ADJOINT_GI_THREADS"] = text
    else:
        os.environ.pop("ADJOINT_GI_THREADS", None)


def refresh_seconds() -> float:
    """Seconds between two writes of a partial result."""
    entry = bpy.context.preferences.addons.get(base_package)
    return entry.preferences.refresh if entry and entry.preferences else 1.0


register, unregister = bpy.utils.register_classes_factory((ADJOINTGI_AP_preferences,))
