# SPDX-License-Identifier: GPL-3.0-or-later
"""Removing what bakes have left in a scene: images, attributes, UV layers and objects made of elements. Files stay."""

from __future__ import annotations

import bpy

from . import carried, links, real, stored
from .attribute import STORED, remove_attributes, remove_result_object, result_object
from .image import remove_images
from .lightmap_uv import STORED as STORED_UV
from .lightmap_uv import remove_lightmap_uv


def remove_results(scene: bpy.types.Scene) -> dict[str, int]:
    """Remove all results on the mesh objects of `scene`; returns how many of each kind went.

    What another scene's objects use stays: images, and the attributes and UV layers of shared meshes. Raises TargetError for a mesh in
    edit mode; then nothing has changed. Materials must be the user's own: restore them first.
    """
    made = links.results()
    objects = [o for o in scene.objects if o.type == "MESH" and links.linked(o, False) is None and (real.is_real(o) or o not in made)]
    own = {o.session_uid for o in objects}
    changed = [o for o in objects if _has_layers(o) and {other.session_uid for other in links.sharing(o)} <= own]
    for obj in changed:
        links.check_mesh(obj)
    layered = [o for o in objects if o in changed or carried.carrier(o) is not None]
    removed = sum(result_object(o) is not None and remove_result_object(o) for o in objects)
    images = remove_images(objects)
    for obj in objects:
        links.forget(obj)
    going = set(changed)
    with carried.removing_together():
        layers = sum(remove_lightmap_uv(o, going) for o in layered)
    attributes = sum(remove_attributes(o) for o in changed)
    instances = real.remove(scene)
    carried.drop_orphans()
    return {
        "object": removed + instances,
        "image": images,
        "attribute": attributes,
        "UV layer": layers,
        "damaged property of a bake": stored.drop_damaged(),
    }


def _has_layers(obj: bpy.types.Object) -> bool:
    """Whether a bake has put an attribute or a UV layer on the mesh, which may be changed."""
    return (stored.read(obj.data, STORED) is not None or stored.read(obj.data, STORED_UV) is not None) and links.linked(obj, True) is None
