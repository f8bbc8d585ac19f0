# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene asks for and does not get, named in notices, so that nothing differs from Cycles without a word.

Layers that materials read and objects lack; switches that let light depend on the kind of ray or on the receiver; and objects that
the viewport evaluates in another way than a render does (Cycles bakes what a render evaluates).
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ...core.scene.arrays import Material, ObjectArrays
from ...core.scene.shading import LARGEST_EMISSION
from ..host.notices import Notices
from ..host.versions import terminator_offset
from ..host.viewport import differences, pair

LAMP_RAYS = ("diffuse", "glossy", "transmission")
MESH_RAYS = (*LAMP_RAYS, "shadow")
REMEDY = "Turn it on in Ray Visibility, or leave it out of renders altogether, to match Cycles"


# ---- layers


def name_missing_layers(
    objects: tuple[ObjectArrays, ...], object: np.ndarray, material: np.ndarray, materials: tuple[Material, ...], notices: Notices
) -> None:
    """A notice for every object whose material reads a UV layer or colour attribute that the object lacks.

    `object` and `material` are (nt,) int32 per triangle. The value that is computed with is 0, as in Cycles.
    """
    asked = {i: _layers(m) for i, m in enumerate(materials)}
    reading = np.array([bool(asked[i]) for i in range(len(materials))] or [False])
    which = reading[material] if len(material) else np.zeros(0, bool)
    pairs = np.unique(object[which].astype(np.int64) * max(len(materials), 1) + material[which])
    for o, m in zip((pairs // max(len(materials), 1)).tolist(), (pairs % max(len(materials), 1)).tolist(), strict=True):
        owner = objects[o]
        for kind, name in asked[m]:
            if kind == "image" and (name or owner.render_uv) not in owner.uvs:
                layer = f'UV layer "{name}"' if name else "UV layer"
                notices.add(owner.source, f'has no {layer} for the images of material "{materials[m].name}"', "Unwrap it")
            elif kind == "attribute" and name not in owner.colors:
                layer = f'attribute "{name}" of colours, numbers or vectors on points, corners or faces' if name else "colour attribute"
                notices.add(owner.source, f'has no {layer} for material "{materials[m].name}"; it counts as black', "Add the attribute")


def name_bright_attributes(
    objects: tuple[ObjectArrays, ...], object: np.ndarray, material: np.ndarray, materials: tuple[Material, ...], notices: Notices
) -> None:
    """A notice for every object whose colour attribute makes a material reflect or emit more than is computed with.

    Only products with one attribute are looked at, whose largest value is at a corner; the values themselves are clamped where they are
    read, in `Shading`.
    """
    for index, made in enumerate(materials):
        for lobe in made.lobes:
            term = lobe.color.terms[0] if len(lobe.color.terms) == 1 else None
            if term is None or [s.kind for s in term.sources] != ["attribute"]:
                continue
            word, top = ("emission", LARGEST_EMISSION) if lobe.kind == "emission" else ("albedo", 1.0)
            for o in np.unique(object[material == index]).tolist():
                values = objects[o].colors.get(term.sources[0].name)
                if values is not None and values.size and (values[..., :3].max(axis=(0, 1)) * np.float64(term.constant)).max() > top + 1e-4:
                    layer = f'colour attribute "{term.sources[0].name}" that gives material "{made.name}" an {word} above {top:g}'
                    notices.add(objects[o].source, f"has a {layer}; it is clamped", f"Choose colours that give an {word} of 0 to {top:g}")


def _layers(material: Material) -> set[tuple[str, str]]:
    """(kind, name) of all sources of a material."""
    return {(s.kind, s.name) for lobe in material.lobes for t in (*lobe.share.terms, *lobe.edge.terms) for s in t.sources}


# ---- kinds of rays and light linking


def name_rays(obj: bpy.types.Object, notices: Notices) -> None:
    """Warnings for ray visibility and light linking of a lamp or of an object with faces (original)."""
    lamp = obj.type == "LIGHT"
    _name_off(obj.name, obj, "visible_", LAMP_RAYS if lamp else MESH_RAYS, notices)
    if not lamp:  # Blender hides every new lamp from the camera, and so do we
        _name_camera(obj.name, obj, "visible_camera", notices)
        if terminator_offset(obj, "shading") > 0:
            reason = "has a Shading Offset of its Shading Terminator, which is not followed; the Geometry Offset is"
            notices.add(obj.name, reason, "Set it to 0 to match Cycles, or use more faces")
    linking = getattr(obj, "light_linking", None)
    if linking is not None and (linking.receiver_collection or linking.blocker_collection):
        reason = "lights or shadows some objects only (light linking), which is not computed: it counts for all objects"
        notices.add(obj.name, reason, "Clear its light linking and shadow linking, to match Cycles")


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


# ---- viewport and render


def name_viewport(obj: bpy.types.Object, scene: bpy.types.Scene, notices: Notices) -> None:
    """A warning when a render would give `obj` (original) another shape or other particles than a depsgraph of the viewport does."""
    found = differences(obj, scene)
    for system in obj.particle_systems:
        settings = system.settings
        if settings.display_percentage != 100 and settings.render_type in ("OBJECT", "COLLECTION"):
            found.append(f'particles "{system.name}" ({settings.display_percentage} % in the viewport)')
    if obj.type in ("CURVE", "SURFACE", "FONT"):
        found += pair("resolution", obj.data.resolution_u, obj.data.render_resolution_u or obj.data.resolution_u)
    elif obj.type == "META":
        found += pair("resolution", obj.data.resolution, obj.data.render_resolution)
    if found:
        reason = f"is computed as the viewport has it, and a render differs: {', '.join(found)}"
        notices.add(obj.name, reason, "Make viewport and render the same")
