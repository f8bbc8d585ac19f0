# SPDX-License-Identifier: GPL-3.0-or-later
"""The last bake of a scene as a whole: which objects hold its result, showing it on them, and taking that back."""

from __future__ import annotations

import bpy

from ..core.errors import TargetError
from . import preview, targets
from .write_attribute import linked_attribute


def holders(scene: bpy.types.Scene, quantity: str, target: str) -> list[bpy.types.Object]:
    """The mesh objects of `scene` that hold a result for `quantity`, as a texture or as an attribute."""
    found = targets.link if target == "texture" else linked_attribute
    return [o for o in scene.objects if o.type == "MESH" and found(o, quantity) is not None]


def show(scene: bpy.types.Scene) -> int:
    """Show the last bake on all objects that hold it; returns their number. Raises TargetError when there are none."""
    record = scene.adjoint_gi.result
    objects = holders(scene, record.quantity, record.target)
    if not objects:
        raise TargetError(scene.name, f"has no object with a baked {record.quantity or 'result'}", "Bake to a texture or attribute first")
    if record.target == "texture":
        preview.show(objects, record.quantity)
    else:
        for obj in objects:
            preview.show([obj], record.quantity, attribute=linked_attribute(obj, record.quantity))
    return len(objects)


def restore(scene: bpy.types.Scene) -> int:
    """Put the materials of all objects of `scene` back; returns how many showed a result."""
    return preview.restore([o for o in scene.objects if o.type == "MESH"])
