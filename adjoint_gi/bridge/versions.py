"""Differences between Blender 4.2 and 5.2; they are met by asking for the attribute, so no version number is compared."""

from __future__ import annotations

from typing import Any

import bpy

from .extract_notices import Notices

WORKING_SPACE = "Linear Rec.709"


def working_space() -> str:
    """Name of the file's scene-linear space; always Linear Rec.709 before Blender 5.0."""
    colorspace = getattr(bpy.data, "colorspace", None)
    return colorspace.working_space if colorspace is not None else WORKING_SPACE


def working_space_notice(notices: Notices) -> None:
    """Say so when colours are not in Linear Rec.709, which luminances and results are labelled with."""
    name = working_space()
    if name != WORKING_SPACE:
        notices.add(
            name,
            "is the working space of this file; results are in it, not in Linear Rec.709",
            "Choose Linear Rec.709 in the scene's colour management",
        )


def uses_nodes(owner: bpy.types.Material | bpy.types.World | bpy.types.Light) -> bool:
    """Whether the node tree counts: always where the switch is deprecated (materials and worlds from 5.0, lights from 5.2 on)."""
    if owner.node_tree is None:
        return False
    switch = owner.bl_rna.properties.get("use_nodes")
    return switch is None or getattr(switch, "is_deprecated", False) or bool(owner.use_nodes)


def light_exposure(light: Any) -> float:
    """Stops of a light's exposure (Blender 4.5 and later), else 0."""
    return float(getattr(light, "exposure", 0.0))


def light_normalized(light: Any) -> bool:
    """Whether a light's power is spread over its size (always before Blender 4.5)."""
    return bool(getattr(light, "normalize", True))


def light_temperature_color(light: Any) -> tuple[float, float, float]:
    """Colour of a light's temperature (Blender 4.5 and later), white when it is not used."""
    if not getattr(light, "use_temperature", False):
        return (1.0, 1.0, 1.0)
    r, g, b = light.temperature_color
    return (float(r), float(g), float(b))
