"""What the makers of instances refer to (collections, geometry nodes, particles), and which members of a collection are switched on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import bpy

from ..host import versions
from ..host.viewport import node_trees

NAMED = {"GeometryNodeInputObject": "object", "GeometryNodeInputCollection": "collection"}  # nodes that hold what they give


@dataclass(eq=False)
class References:
    """What an object may make instances of: single objects, shown whatever their switches say, and collections, which obey switches."""

    objects: set[bpy.types.Object] = field(default_factory=set)
    collections: list[bpy.types.Collection] = field(default_factory=list)


class Members:
    """Answers about collections, each looked at once."""

    def __init__(self) -> None:
        self._all: dict[bpy.types.Collection, list[bpy.types.Object]] = {}
        self._on: dict[tuple[bpy.types.Collection, str], set[bpy.types.Object]] = {}

    def all(self, collection: bpy.types.Collection) -> list[bpy.types.Object]:
        """All objects of a collection and its children, in the order by which persistent ids of its instances count."""
        if collection not in self._all:
            self._all[collection] = list(collection.all_objects)
        return self._all[collection]

    def on(self, collection: bpy.types.Collection, switch: str) -> set[bpy.types.Object]:
        """Those that an instance of it shows: `switch`, hide_render or hide_viewport, is off for them and on some way to them."""
        key = (collection, switch)
        if key not in self._on:
            found: set[bpy.types.Object] = set()
            if not getattr(collection, switch):
                found.update(o for o in collection.objects if not getattr(o, switch))
                found.update(*(self.on(child, switch) for child in collection.children))
            self._on[key] = found
        return self._on[key]


def references(host: bpy.types.Object) -> References:
    """What `host` (original) may make instances of, as far as its settings and node trees show."""
    out = References()
    if host.instance_type == "COLLECTION" and host.instance_collection is not None:
        out.collections.append(host.instance_collection)
    for system in host.particle_systems:
        settings = system.settings
        if settings.render_type == "OBJECT" and settings.instance_object is not None:
            out.objects.add(settings.instance_object)
        elif settings.render_type == "COLLECTION" and settings.instance_collection is not None:
            out.collections.append(settings.instance_collection)
    nodes = [node for tree in node_trees(host) for node in tree.nodes]
    if not nodes:
        return out
    # A Collection Info node gives the collection as one instance, or its objects and its child collections each as their own.
    separate = {_separates(node) for node in nodes if node.bl_idname == "GeometryNodeCollectionInfo"}
    for value in _values(host, nodes):
        if isinstance(value, bpy.types.Object):
            out.objects.add(value)
        elif isinstance(value, bpy.types.Collection):
            if separate != {False}:
                out.objects.update(value.objects)
            out.collections += value.children if separate == {True} else [value]
    return out


def _separates(node: bpy.types.Node) -> bool | None:
    """Whether a Collection Info node separates children; None when a link decides."""
    socket = node.inputs["Separate Children"]
    return None if socket.is_linked else bool(socket.default_value)


def _values(host: bpy.types.Object, nodes: list[bpy.types.Node]) -> Iterator[bpy.types.ID]:
    """Objects and collections in the inputs of modifiers and nodes."""
    for modifier in host.modifiers:
        if modifier.type == "NODES":
            yield from (value for value in versions.modifier_inputs(modifier) if isinstance(value, bpy.types.ID))
    for node in nodes:
        yield from (s.default_value for s in node.inputs if s.type in ("OBJECT", "COLLECTION") and s.default_value is not None)
        value = getattr(node, NAMED.get(node.bl_idname, ""), None)
        if value is not None:
            yield value
