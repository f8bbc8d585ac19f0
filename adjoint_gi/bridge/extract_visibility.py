"""Which objects count: what a render shows, whatever mode the depsgraph was evaluated for.

An object counts when the depsgraph evaluates it and it is not hidden in render, by itself, by all of its collections, or because it
makes instances and is told not to show itself. An instance counts when its object and its instancer are not hidden so. Children
that are instanced on the vertices or faces of their parent count as instances only. All this was compared with what Blender lists
for a render (measured on 5.0).
"""

from __future__ import annotations

import bpy

from .extract_notices import Notices

INVISIBLE = {"CAMERA", "ARMATURE", "LATTICE", "SPEAKER", "LIGHT_PROBE", "EMPTY"}  # never seen: nothing to say when hidden


class Visibility:
    """Answers for one depsgraph, and names what is left out."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, notices: Notices) -> None:
        self._notices = notices
        self._by_collections = _hidden_by_collections(depsgraph.view_layer)
        self._hidden: dict[int, bool] = {}
        self._replaced: dict[int, bool] = {}

    def shows(self, inst: bpy.types.DepsgraphObjectInstance, original: bpy.types.Object) -> bool:
        """Whether a render would show this object or instance; `original` is the user's object."""
        if not inst.show_self or self._is_hidden(original):
            return False
        if inst.is_instance:
            return inst.parent is None or not self._is_switched_off(inst.parent.original)
        return not (original.as_pointer() in self._by_collections or self._is_replaced(original))

    def name_missing(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Notices for what a render would show but this depsgraph, made for the viewport, does not evaluate."""
        if depsgraph.mode == "RENDER":
            return
        for obj in depsgraph.view_layer.objects:
            pointer = obj.as_pointer()
            if obj.type in INVISIBLE or pointer in self._hidden:
                continue
            if self._is_switched_off(obj) or pointer in self._by_collections:
                self._notices.add(obj.name, "is hidden in render and is left out", "Enable it in renders if it should count", "info")
            else:
                self._notices.add(
                    obj.name, "is disabled in the viewport, so it is left out, although a render shows it", "Enable it in the viewport"
                )

    def _is_hidden(self, original: bpy.types.Object) -> bool:
        """Hidden by itself, whether it is an instance or not; named once."""
        pointer = original.as_pointer()
        hidden = self._hidden.get(pointer)
        if hidden is None:
            silent = original.is_instancer and original.type != "EMPTY" and not original.show_instancer_for_render
            hidden = self._hidden[pointer] = original.hide_render or silent
            if (hidden or pointer in self._by_collections) and original.type not in INVISIBLE:
                self._notices.add(original.name, "is hidden in render and is left out", "Enable it in renders if it should count", "info")
        return hidden

    def _is_switched_off(self, original: bpy.types.Object) -> bool:
        """Hidden by its own switch or by its collections, as an instancer is."""
        return original.hide_render or original.as_pointer() in self._by_collections

    def _is_replaced(self, original: bpy.types.Object) -> bool:
        """Whether its parent shows it on vertices or faces instead of where it is."""
        pointer = original.as_pointer()
        if pointer not in self._replaced:
            parent = original.parent
            self._replaced[pointer] = parent is not None and parent.instance_type in ("VERTS", "FACES")
        return self._replaced[pointer]


def _hidden_by_collections(view_layer: bpy.types.ViewLayer) -> set[int]:
    """Pointers of objects all of whose collections in this view layer are hidden in render."""
    shown: set[int] = set()
    hidden: set[int] = set()

    def visit(layer: bpy.types.LayerCollection, off: bool) -> None:
        off = off or layer.collection.hide_render
        if not layer.exclude:
            (hidden if off else shown).update(o.as_pointer() for o in layer.collection.objects)
        for child in layer.children:
            visit(child, off)

    visit(view_layer.layer_collection, False)
    return hidden - shown
