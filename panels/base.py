# SPDX-License-Identifier: GPL-3.0-or-later
"""What all panels have in common: where they stand, what they draw, and when they are shown."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import bpy

from ..adjoint_gi.bridge.engine.render_engine import ENGINE
from ..adjoint_gi.bridge.props.properties import chosen

Part = Callable[[bpy.types.UILayout, bpy.types.Context], None]


class Section:
    """A panel that draws `parts` one below the other; a subclass overrides `poll` where it is not always shown."""

    parts: ClassVar[tuple[Part, ...]]

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the parts."""
        for part in self.parts:
            part(self.layout, context)


class Tab(Section):
    """A panel in the tab "Adjoint GI" of the 3D View."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Adjoint GI"


class Properties(Section):
    """A panel in the render properties, shown with our engine."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES: ClassVar[set[str]] = {ENGINE}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene is rendered by our engine."""
        return context.engine in cls.COMPAT_ENGINES


def has_method(context: bpy.types.Context) -> bool:
    """Whether a method is chosen, so that it has settings."""
    return chosen(context.scene) is not None
