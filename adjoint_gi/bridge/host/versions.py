"""Differences between Blender 4.2 and 5.2; they are met by asking for the attribute, where there is one to ask for."""

from __future__ import annotations

from typing import Any

import bpy

from .notices import Notices

WORKING_SPACE = "Linear Rec.709"

# Options of a property that holds a folder, which may start with "//". Blender 5.0 and later need that stated; 4.2 knows no such option.
FOLDER = {"ANIMATABLE"}
if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties:
    FOLDER.add("PATH_SUPPORTS_BLEND_RELATIVE")


def version_text() -> str:
    """Blender's version, as what is stored by one may be another thing after the next has loaded it."""
    return bpy.app.version_string


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


def terminator_offset(obj: bpy.types.Object, which: str) -> float:
    """The "geometry" or "shading" offset of an object's Shading Terminator: Cycles' own settings up to Blender 4.5, the object's since."""
    names = [f"shadow_terminator_{which}_offset"] + ["shadow_terminator_offset"] * (which == "shading")
    # Cycles' settings are looked at where there are any: to ask for others would make an empty group of them on the user's object.
    for owner in (obj, obj.cycles if "cycles" in obj else None):
        for name in names:
            if hasattr(owner, name):
                return float(getattr(owner, name))
    return 0.1 if which == "geometry" else 0.0


def uses_nodes(owner: bpy.types.Material | bpy.types.World | bpy.types.Light) -> bool:
    """Whether the node tree counts: always where the switch is deprecated (materials and worlds from 5.0, lights from 5.2 on)."""
    if owner.node_tree is None:
        return False
    switch = owner.bl_rna.properties.get("use_nodes")
    return switch is None or getattr(switch, "is_deprecated", False) or bool(owner.use_nodes)


def group_value_is_place(socket: bpy.types.NodeSocket) -> bool:
    """Whether an image looks up the value of this unlinked group input: from 5.0 on, unless it is hidden; else UVs (measured on 4.2)."""
    return bpy.app.version >= (5, 0, 0) and not socket.hide_value


def rough_diffuse_keeps_energy() -> bool:
    """Whether Cycles gives back what Oren-Nayar's facets lose at the first bounce: from 4.3 on."""
    return bpy.app.version >= (4, 3, 0)


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


def modifier_inputs(modifier: Any) -> list[Any]:
    """Values of a Geometry Nodes modifier's inputs: custom properties in Blender 5.0 and before, a group of its own in 5.2."""
    group = getattr(getattr(modifier, "properties", None), "inputs", None)
    if group is None:
        return [value for _, value in modifier.items()]
    return [getattr(getattr(group, p.identifier), "value", None) for p in group.bl_rna.properties if p.identifier != "rna_type"]


def modifier_input(modifier: Any, name: str) -> Any:
    """Value of the input called `name` of a Geometry Nodes modifier, None where it has no such input or no value."""
    identifier = _input(modifier, name)
    group = getattr(getattr(modifier, "properties", None), "inputs", None)
    if group is None:
        return modifier.get(identifier)
    return getattr(getattr(group, identifier, None), "value", None)


def set_modifier_input(modifier: Any, name: str, value: Any) -> None:
    """Set it."""
    group = getattr(getattr(modifier, "properties", None), "inputs", None)
    if group is None:
        modifier[_input(modifier, name)] = value
    else:
        getattr(group, _input(modifier, name)).value = value


def _input(modifier: Any, name: str) -> str:
    """Identifier of the input called `name`, empty where there is none."""
    items = modifier.node_group.interface.items_tree
    return next((i.identifier for i in items if i.item_type == "SOCKET" and i.in_out == "INPUT" and i.name == name), "")
