# SPDX-License-Identifier: GPL-3.0-or-later
"""The custom properties that bakes leave in a file, read through one place, because a file may hold anything under their names.

What is not as a bake stores it counts as absent: nothing is shown, restored or reused by it, and a bake that needs the name replaces it.
`damaged` names such properties, and `drop_damaged` removes them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import bpy

from ..host.viewport import MADE_BY_US

RESULTS = "adjoint_gi_results"  # of objects: a group for each result, see `links`
MADE = "adjoint_gi_made"  # of objects that a bake has made to hold its result
STATE = "adjoint_gi_preview"  # of objects that show a result: their slots before
REAL = "adjoint_gi_instance"  # of objects that a bake has made of instances or of what is no mesh: of which, and a checksum of the mesh
REALS = "adjoint_gi_instances"  # of the collection that holds them
HIDDEN = "adjoint_gi_hidden"  # of objects that were hidden for a preview: where, in favour of which, and what was selected
ATTRIBUTES = "adjoint_gi_attributes"  # of meshes: key -> JSON list of our attributes
UV = "adjoint_gi_uv"  # of meshes: name of the layer made by us
SHARED = "adjoint_gi_uv_atlas"  # of meshes and HOLDERs: which square that layer shares with others, and its number there
FACES = "adjoint_gi_uv_faces"  # of meshes: checksum of the faces that the layer was made for
ASKED = "adjoint_gi_uv_density"  # of meshes and HOLDERs: which density that layer was asked to have, and the texels a side of its image
HOLDER = "adjoint_gi_uv_holder"  # of hidden objects whose vertices are UVs, see `carried`
ADDED = "adjoint_gi_slot"  # of meshes without slots, which got one for the preview
ABOUT = "adjoint_gi_about"  # of images and meshes: JSON that describes the result
OURS = "adjoint_gi_material"  # of materials of a preview
ORIGINAL = "adjoint_gi_original"  # of materials of a preview: the one of the user that each stands for, None when that was deleted
TREE = MADE_BY_US  # of node groups made by us: what for
NODES = "adjoint_gi_nodes"  # of such node groups: checksum of their nodes as they were made

COLLECTIONS = ("objects", "meshes", "materials", "images", "node_groups", "collections")  # of datablocks that may carry them


def read(owner: bpy.types.ID, name: str) -> Any | None:
    """The property `name` of `owner` if it is as a bake stores it, else None. Of a group, what is wrong in it is still to be asked."""
    value = owner.get(name)
    return value if value is not None and PROPERTIES[name](value) else None


def entry(owner: bpy.types.ID, name: str, key: str) -> Any | None:
    """The entry `key` of the group `name` if it is as a bake stores it, else None; of ATTRIBUTES the list."""
    group = read(owner, name)
    if group is None or key not in group:
        return None
    if name == ATTRIBUTES:
        return _attributes(group[key])
    return group[key] if _is_result(group[key]) else None


def keys(owner: bpy.types.ID, name: str) -> list[str]:
    """Keys of all sound entries of the group `name`."""
    group = read(owner, name)
    return [key for key in group.keys() if entry(owner, name, key) is not None] if group is not None else []  # noqa: SIM118


def damaged() -> list[tuple[str, str]]:
    """(name of the datablock, name of the property) of all that is not as a bake stores it; linked datablocks included."""
    return [(owner.name, name) for owner, name in _damaged()]


def drop_damaged() -> int:
    """Remove all of that from what can be changed; returns how many properties went."""
    found = [(owner, name) for owner, name in _damaged() if owner.is_editable and owner.library is None]
    for owner, name in found:
        group = owner.get(name)
        bad = [k for k in group.keys() if entry(owner, name, k) is None] if read(owner, name) is not None else []  # noqa: SIM118
        for key in bad:
            del group[key]
        if not bad or not group.keys():
            del owner[name]
    return len(found)


def _damaged() -> Iterator[tuple[bpy.types.ID, str]]:
    for kind in COLLECTIONS:
        for owner in getattr(bpy.data, kind):
            for name in owner.keys():  # noqa: SIM118
                if name in PROPERTIES and not _is_sound(owner, name):
                    yield owner, name


def _is_sound(owner: bpy.types.ID, name: str) -> bool:
    """Whether a property, and every entry in it, is as a bake stores it; a link to what was deleted is."""
    value = read(owner, name)
    if value is None:
        return owner.get(name) is None
    return name not in (RESULTS, ATTRIBUTES) or len(keys(owner, name)) == len(value.keys())


# ---- what a bake stores


def _is_group(value: Any) -> bool:
    """A group of properties, of which no datablock, number, text or array has this method."""
    return hasattr(value, "to_dict")


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_on(value: Any) -> bool:
    """A switch: Blender hands out the integer 1 where True was stored by an old version."""
    return isinstance(value, bool | int) and value == 1


def _is_result(value: Any) -> bool:
    """One entry of RESULTS."""
    if not (_is_group(value) and isinstance(value.get("owner"), str) and isinstance(value.get("uv_layer", ""), str)):
        return False
    image, made = value.get("image"), value.get("made")
    return (
        (image is None or isinstance(image, bpy.types.Image))
        # Clear Results removes it, so it must be one that a bake has made.
        and (made is None or (isinstance(made, bpy.types.Object) and made.type == "MESH" and read(made, MADE) is not None))
        and all(_is_pair(value[name]) for name in ("scale", "offset") if name in value)
    )


def _is_pair(value: Any) -> bool:
    """Two numbers."""
    try:
        return not isinstance(value, str) and len(value) == 2 and all(math.isfinite(x) for x in value)
    except TypeError:
        return False


def _attributes(value: Any) -> list[dict[str, Any]] | None:
    """The list in one entry of ATTRIBUTES, None where it is none."""
    try:
        found = json.loads(value)
        sound = isinstance(found, list) and all(
            isinstance(e, dict) and isinstance(e.get("name"), str) and isinstance(e.get("wanted"), str) and isinstance(e.get("sum"), int)
            for e in found
        )
    except (TypeError, ValueError, RecursionError):
        return None
    return found if sound else None


def _is_state(value: Any) -> bool:
    """STATE: slots before a preview."""
    if not (_is_group(value) and isinstance(value.get("count"), int) and isinstance(value.get("key", ""), str)):
        return False
    links = [value[k] for k in value.keys() if k.startswith("link")]  # noqa: SIM118
    materials = [value[k] for k in value.keys() if k.startswith(("material", "mesh_material"))]  # noqa: SIM118
    return all(x in ("DATA", "OBJECT") for x in links) and all(x is None or isinstance(x, bpy.types.Material) for x in materials)


def _is_hidden(value: Any) -> bool:
    """HIDDEN: where an object was hidden."""
    return (
        _is_group(value)
        and isinstance(value.get("layer"), str)
        and isinstance(value.get("made_selected"), bool | int)
        and isinstance(value.get("scene"), bpy.types.Scene | None)
        and isinstance(value.get("seen"), bpy.types.Object | None)
    )


def _is_real(value: Any) -> bool:
    """REAL: which instance an object was made of."""
    return (
        _is_group(value)
        and isinstance(value.get("instance"), str)
        and isinstance(value.get("sum"), str)
        and isinstance(value.get("sheared"), bool | int)
        and isinstance(value.get("maker"), bpy.types.Object | None)
        and isinstance(value.get("kind", ""), str)
    )


PROPERTIES: dict[str, Callable[[Any], bool]] = {
    RESULTS: _is_group,
    MADE: _is_on,
    STATE: _is_state,
    REAL: _is_real,
    REALS: _is_on,
    HIDDEN: _is_hidden,
    ATTRIBUTES: _is_group,
    UV: _is_text,
    SHARED: _is_text,
    FACES: _is_text,
    ASKED: lambda value: isinstance(value, str) and value.count("/") == 1 and value.split("/")[1].isdecimal(),
    HOLDER: _is_on,
    ADDED: _is_on,
    ABOUT: _is_text,
    OURS: _is_on,
    ORIGINAL: lambda value: isinstance(value, bpy.types.Material),
    TREE: _is_text,
    NODES: _is_text,
}
