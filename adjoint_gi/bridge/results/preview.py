"""Showing a result on the objects, and putting the user's materials back exactly.

Nothing of the user's materials is changed, nor of what meshes look like. Every material slot of an object is switched to the object
(slots linked to the object belong to it alone, so objects that share a mesh show their own results) and filled with a material of ours.
Where modifiers change a mesh that no other object uses, the slot stays with the mesh: exports that apply modifiers read it there. What was
there is stored in a custom property of the object, which is saved with the file, so it can be restored after loading.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import bpy

from ...core.base.errors import TargetError
from ..host.meshes import material_slots
from . import links as targets
from . import stored
from .attribute import linked_attribute
from .preview_material import make_material, place, remove_unused_group
from .stored import ADDED, ORIGINAL, OURS, STATE


def show(objects: Sequence[bpy.types.Object], key: str, *, attributes: bool = False) -> None:
    """Show what is linked for `key` on `objects`: the image where there is one, else the colour attribute; with `attributes` always that.

    "irradiance", "direct" and "indirect" are multiplied by each material's base colour and divided by pi; "radiosity" and "emitted"
    are shown as they are, divided by pi: both are radiance then. Showing again replaces what is shown. Raises TargetError when an
    object has no such result or cannot be changed; then nothing has changed.
    """
    # Step 1: everything that can fail.
    sources = []
    for obj in objects:
        targets.check_object(obj)
        sources.append((obj, *_source(obj, key, attributes)))
        if not obj.material_slots:
            targets.check_mesh(obj)

    # Step 2: the slots as the user has them.
    restore(objects)
    made: dict[tuple, bpy.types.Material] = {}
    for obj, entry, name in sources:
        if not obj.material_slots:
            obj.data.materials.append(None)
            obj.data[ADDED] = True
        originals = [slot.material for slot in obj.material_slots]
        _remember(obj)
        source = _named(entry, name)
        obj[STATE]["key"], obj[STATE]["source"] = key, source
        # Step 3: ours in their place. Slots that would be shown alike share one: each new one makes Blender look through all others.
        for slot, material in zip(obj.material_slots, originals, strict=True):
            alike = (material and material.session_uid, source)
            if alike not in made:
                made[alike] = make_material(key, material, entry, name)
                made[alike][OURS] = True
                if material is not None:
                    made[alike][ORIGINAL] = material
            _fill(obj, slot, made[alike])


def restore(objects: Sequence[bpy.types.Object]) -> int:
    """Put the user's materials back on `objects`; returns how many objects had a preview."""
    count, ours = 0, set()
    for obj in objects:
        state = stored.read(obj, STATE)
        if state is None:
            continue
        count += 1
        ours.update(material for _, material in _put_back(obj) if material is not None)
        del obj[STATE]
        _drop_added_slot(obj)
    # All at once: Blender looks through all that it has for each removal.
    bpy.data.batch_remove([material for material in ours if material.users == 0])
    remove_unused_group()
    return count


def follow(objects: Sequence[bpy.types.Object], key: str, *, attributes: bool = False) -> None:
    """Those of `objects` that show their result for `key` show what it is now: a bake may have given them another image, UV layer,
    place in an atlas, or name."""
    showing = [(o, state) for o in objects if (state := stored.read(o, STATE)) is not None and state.get("key") == key]
    changed = [o for o, state in showing if state.get("source") != _named(*_source(o, key, attributes))]
    if changed:
        show(changed, key, attributes=attributes)


def _source(obj: bpy.types.Object, key: str, attributes: bool) -> tuple[Any | None, str]:
    """The stored link of the image, or None and the name of the colour attribute, that hold the result; raises TargetError."""
    entry, name = targets.link(obj, key), linked_attribute(obj, key) or ""
    if not attributes and entry is not None and entry.get("image") is not None:
        return entry, ""
    if name and name in obj.data.color_attributes:
        return None, name
    raise TargetError(obj.name, f"has no result for {key}", "Bake it first")


def _named(entry: Any | None, name: str) -> str:
    """What `_source` has found, as text that is equal where a preview would look the same."""
    return name if entry is None else str(place(entry))


def shown(obj: bpy.types.Object) -> bool:
    """Whether `obj` shows a preview."""
    return stored.read(obj, STATE) is not None


def exported(obj: bpy.types.Object) -> bool:
    """Whether a glTF export that applies modifiers has what `obj` shows: with modifiers it reads the slots of the mesh, and those of the
    object only where the mesh has a single one, which is empty."""
    empty = [*obj.data.materials] == [None]
    return not shown(obj) or not obj.modifiers or empty or all(slot.link == "DATA" for slot in obj.material_slots)


def own_material(
    obj: bpy.types.Object, index: int, material: bpy.types.Material | None, below: bpy.types.Material | None
) -> tuple[bpy.types.Material | None, bool]:
    """What the user has where `material` is, in slot `index` of `obj`, and whether that is lost because it was deleted.

    Behind one of ours it is what `restore` would put back; `below` is the material that the mesh has in this slot. Where nothing is
    remembered of the object, as in a mesh joined of several, it is what our material was made for.
    """
    if material is None or not stored.read(material, OURS):
        return material, False
    stands_for = stored.read(material.original, ORIGINAL)
    deleted = stands_for is None and material.original.get(ORIGINAL, "") is None  # not there when the slot was empty
    state = stored.read(obj.original, STATE)
    if state is None or f"link{index}" not in state or (below is not None and stored.read(below, OURS)):
        own = stands_for
    else:
        own = below if state[f"link{index}"] == "DATA" else state.get(f"material{index}")
    return own, own is None and deleted


@contextlib.contextmanager
def lifted(objects: Sequence[bpy.types.Object]) -> Iterator[None]:
    """The user's materials on `objects` for a while, as for a render by Cycles, and the preview again afterwards."""
    ours = [(obj, index, material) for obj in objects if shown(obj) for index, material in _put_back(obj)]
    try:
        yield
    finally:
        for obj, index, material in ours:
            _fill(obj, obj.material_slots[index], material)


def _fill(obj: bpy.types.Object, slot: bpy.types.MaterialSlot, material: bpy.types.Material | None) -> None:
    """Put one of ours into a slot that is as the user has it."""
    if slot.link == "OBJECT" or not obj.modifiers or targets.linked(obj, True) is not None or targets.shares(obj):
        slot.link = "OBJECT"
    slot.material = material


def _put_back(obj: bpy.types.Object) -> list[tuple[int, bpy.types.Material | None]]:
    """Put the user's materials back into the slots that are ours; returns their indices with what was in them."""
    state, out = obj[STATE], []
    for index, slot in enumerate(obj.material_slots):
        if f"link{index}" not in state or (slot.material is not None and not stored.read(slot.material, OURS)):
            continue  # a slot or material that the user has put there meanwhile
        out.append((index, slot.material))
        if slot.link == "DATA":
            slot.material = state.get(f"mesh_material{index}")
            continue
        slot.link = "OBJECT"
        slot.material = state.get(f"material{index}")
        slot.link = state[f"link{index}"]
    return out


def _remember(obj: bpy.types.Object) -> None:
    """Store the link of every slot and the materials that the object itself and its mesh hold there."""
    obj[STATE] = {"count": len(obj.material_slots)}
    for index, slot in enumerate(obj.material_slots):
        link = slot.link
        slot.link = "OBJECT"  # only so can the object's own material be read
        own = slot.material
        slot.link = link
        obj[STATE][f"link{index}"] = link
        # What is stored counts as a user, so a purge cannot delete it.
        if own is not None:
            obj[STATE][f"material{index}"] = own
        if link == "DATA" and slot.material is not None:
            obj[STATE][f"mesh_material{index}"] = slot.material


def _drop_added_slot(obj: bpy.types.Object) -> None:
    """Remove the slot that was added to a mesh without any, when the last object that shows it is restored."""
    mesh = obj.data
    if stored.read(mesh, ADDED) is None or any(shown(other) for other in targets.sharing(obj)):
        return
    if len(mesh.materials) == 1 and mesh.materials[0] is None:
        index = material_slots(mesh)
        mesh.materials.clear()
        if index.any():  # clearing sets all of them to 0
            mesh.polygons.foreach_set("material_index", index)
    del mesh[ADDED]
