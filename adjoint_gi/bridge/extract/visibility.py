"""Which objects count: what a render shows, whatever mode the depsgraph was evaluated for.

A depsgraph of a render lists just that. In one of the viewport, an object counts when it is not hidden in render, by itself, by all
of its collections, or because it makes instances and is set not to show itself. An instance counts when its instancer is not
hidden so and, where it stands for a member of a collection, the member is not hidden there. Geometry nodes and particles that name an
object show it even if it is hidden. Children that are instanced on the vertices or faces of their parent count as instances only.
All this was compared with what Blender lists for a render (measured on 4.2, 5.0 and 5.2; tests/blender/test_extract_visibility.py).
"""

from __future__ import annotations

import bpy

from ..host.notices import Notices
from ..results import links as targets
from .members import Members, References, references

NO_ID = 2**31 - 1  # fills the unused end of a persistent_id
INVISIBLE = {"CAMERA", "ARMATURE", "LATTICE", "SPEAKER", "LIGHT_PROBE", "EMPTY"}  # never seen: nothing to say when hidden


class Visibility:
    """Answers for one depsgraph, and names what is left out."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, notices: Notices) -> None:
        self._notices = notices
        self._all = depsgraph.mode == "RENDER"
        self._members = Members()
        self._references: dict[bpy.types.Object, References] = {}
        self._by_collections = _hidden_by_collections(depsgraph.view_layer)
        self._listed: set[bpy.types.Object] = set()  # by themselves, not as instances
        self._instanced: set[bpy.types.Object] = set()  # with at least one instance that counts
        # Only of these an instance may be hidden by what is in between it and its instancer.
        self._doubtful = {o for o in bpy.data.objects if o.hide_render}
        self._doubtful.update(*(c.all_objects for c in bpy.data.collections if c.hide_render))
        self._quiet = set() if self._all else _quiet_hosts(depsgraph)

    def shows(self, inst: bpy.types.DepsgraphObjectInstance, original: bpy.types.Object) -> bool:
        """Whether a render would show this object or instance; `original` is the user's object."""
        if self._all:
            return inst.show_self
        if not inst.is_instance:
            self._listed.add(original)
            parent = original.parent
            replaced = parent is not None and parent.instance_type in ("VERTS", "FACES")
            return not (replaced or self._is_switched_off(original) or self._is_silent(original))
        shown = not self._is_silent(original) and self._shows_instance(inst, original)
        if shown:
            self._instanced.add(original)
        return shown

    def name_missing(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Notices for what is hidden in a render, and for what a render would show but this depsgraph, of the viewport, does not have."""
        if self._all:
            return
        results = targets.results()
        for obj in depsgraph.view_layer.objects:
            if (obj.type in INVISIBLE and obj.instance_collection is None) or obj in results:
                continue
            if self._is_switched_off(obj):
                if obj in self._instanced:
                    self._notices.add(obj.name, "is hidden in render: only its instances count, as in a render", "", "info")
                else:
                    self._hidden(obj, "is hidden in render and is left out")
            elif self._is_silent(obj) and obj.type != "EMPTY":
                reason = "makes instances or particles and does not show itself in renders, so it is left out"
                self._notices.add(obj.name, reason, "Turn on Show Instancer or Show Emitter for renders if it should count", "info")
            elif obj not in self._listed:
                switch = "Enable it in the viewport" if obj.show_instancer_for_viewport else "Enable it and Show Instancer in the viewport"
                self._notices.add(obj.name, "is disabled in the viewport, so it is left out, although a render shows it", switch)
            else:
                self._name_members(obj)

    def _shows_instance(self, inst: bpy.types.DepsgraphObjectInstance, original: bpy.types.Object) -> bool:
        """Whether instancer and all that is in between show it."""
        if inst.parent is None:
            return True
        host = inst.parent.original
        if self._is_switched_off(host):
            return False
        if not self._doubtful:
            return True
        # Step 1: instances of collections, and those inside them, outermost first: the persistent id counts the members.
        ids = [i for i in inst.persistent_id if i != NO_ID]
        collection = None
        while ids and host.instance_type == "COLLECTION" and host.instance_collection is not None:
            collection = host.instance_collection
            host = self._members.all(collection)[ids.pop()]
            if host not in self._members.on(collection, "hide_render"):
                return self._left_out(original)
        # Step 2: what remains is made by `host`, unless it is `host` itself, as texts and curves are.
        if not ids or host == original or original not in self._doubtful:
            return True
        if host.instance_type in ("VERTS", "FACES"):
            off = self._is_switched_off(original) if collection is None else original not in self._members.on(collection, "hide_render")
            return self._left_out(original) if off else True
        if len(ids) == 1:
            return True  # an object that geometry nodes name; a member of a collection has one id more
        return self._shows_made(host, original)

    def _shows_made(self, host: bpy.types.Object, original: bpy.types.Object) -> bool:
        """Whether geometry nodes or particles of `host` show a hidden object: yes if they name it, no as a member of a collection."""
        found = self._of(host)
        answers = {original in self._members.on(c, "hide_render") for c in found.collections if original in self._members.all(c)}
        if original in found.objects:
            answers.add(True)
        if len(answers) == 1:
            return True if answers.pop() else self._left_out(original)
        reason = f'is hidden in render, and whether its instances on "{host.name}" are is not known here; they are kept'
        self._notices.add(original.name, reason, "Enable it and its collections in renders, or take it out of what is instanced")
        return True

    def _name_members(self, host: bpy.types.Object) -> None:
        """Warnings for members of instanced collections that only a render evaluates."""
        waiting, seen = [host], {host}
        while waiting:
            found = self._of(waiting.pop())
            for collection in found.collections:
                shown = self._members.on(collection, "hide_render")
                for obj in shown - self._members.on(collection, "hide_viewport") - found.objects:
                    reason = f'is disabled in the viewport, so instances of "{collection.name}" lack it, although a render shows it'
                    self._notices.add(obj.name, reason, "Enable it and its collections in the viewport")
                waiting += [o for o in shown if o not in seen]
                seen |= shown

    def _left_out(self, original: bpy.types.Object) -> bool:
        self._hidden(original, "is hidden in render in a collection that is instanced; these instances are left out")
        return False

    def _hidden(self, original: bpy.types.Object, reason: str) -> None:
        self._notices.add(original.name, reason, "Enable it in renders if it should count", "info")

    def _of(self, host: bpy.types.Object) -> References:
        if host not in self._references:
            self._references[host] = references(host)
        return self._references[host]

    def _is_switched_off(self, original: bpy.types.Object) -> bool:
        """Hidden by its own switch or by its collections."""
        return original.hide_render or original in self._by_collections

    def _is_silent(self, original: bpy.types.Object) -> bool:
        """Whether it makes instances, or has particles, and is set not to show itself."""
        if original.show_instancer_for_render:
            return False
        return original.is_instancer or len(original.particle_systems) > 0 or original in self._quiet


def _quiet_hosts(depsgraph: bpy.types.Depsgraph) -> set[bpy.types.Object]:
    """Objects that are set not to show themselves in renders and have instances; for geometry nodes nothing else shows that they have."""
    if all(o.show_instancer_for_render for o in depsgraph.view_layer.objects):
        return set()
    makers = (i.parent.original for i in depsgraph.object_instances if i.is_instance and i.parent is not None)
    return {o for o in makers if not o.show_instancer_for_render}


def _hidden_by_collections(view_layer: bpy.types.ViewLayer) -> set[bpy.types.Object]:
    """Objects all of whose collections in this view layer are hidden in render."""
    shown: set[bpy.types.Object] = set()
    hidden: set[bpy.types.Object] = set()

    def visit(layer: bpy.types.LayerCollection, off: bool) -> None:
        off = off or layer.collection.hide_render
        if not layer.exclude:
            (hidden if off else shown).update(layer.collection.objects)
        for child in layer.children:
            visit(child, off)

    visit(view_layer.layer_collection, False)
    return hidden - shown
