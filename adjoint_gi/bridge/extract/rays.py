"""Switches of Cycles that let light depend on the kind of ray or on the receiver. They are not computed, and named."""

from __future__ import annotations

from typing import Any

import bpy

from ..host.notices import Notices

LAMP_RAYS = ("diffuse", "glossy", "transmission")
MESH_RAYS = (*LAMP_RAYS, "shadow")
REMEDY = "Turn it on in Ray Visibility, or leave it out of renders altogether, if Cycles shall do the same"


def name_rays(obj: bpy.types.Object, notices: Notices) -> None:
    """Warnings for ray visibility and light linking of a lamp or of an object with faces (original)."""
    lamp = obj.type == "LIGHT"
    _name_off(obj.name, obj, "visible_", LAMP_RAYS if lamp else MESH_RAYS, notices)
    if not lamp:  # Blender hides every new lamp from the camera, and so do we
        _name_camera(obj.name, obj, "visible_camera", notices)
    linking = getattr(obj, "light_linking", None)
    if linking is not None and (linking.receiver_collection or linking.blocker_collection):
        reason = "lights or shadows some objects only (light linking), which is not computed: it counts for all objects"
        notices.add(obj.name, reason, "Clear its light linking and shadow linking, if Cycles shall do the same")


def name_world_rays(world: bpy.types.World, name: str, notices: Notices) -> None:
    """The same for a world that gives light. Its switches belong to Cycles, an add-on that may be turned off."""
    switches = getattr(world, "cycles_visibility", None)
    if switches is not None:
        _name_off(name, switches, "", LAMP_RAYS, notices)
        _name_camera(name, switches, "camera", notices)


def _name_off(name: str, owner: Any, prefix: str, rays: tuple[str, ...], notices: Notices) -> None:
    off = [ray for ray in rays if not getattr(owner, prefix + ray, True)]
    if off:
        reason = f"is turned off for {' and '.join(off)} rays in Cycles, which is not computed: it counts for all light"
        notices.add(name, reason, REMEDY)


def _name_camera(name: str, owner: Any, switch: str, notices: Notices) -> None:
    if not getattr(owner, switch, True):
        notices.add(name, "is turned off for camera rays in Cycles, but is seen in pictures here", REMEDY, "info")
