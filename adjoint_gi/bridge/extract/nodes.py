"""Following links in node trees: through reroutes, muted nodes and node groups, with a limit on depth.

Whatever a tree holds, reading it must come to an end and name what cannot be read: nodes of other versions, sockets that a setting
hides, links that run in a circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy

GROUP_DEPTH = 64  # nested groups
STEPS = 4096  # links followed from one socket
# What reading a node of an unexpected kind may raise: it is named, and does not end the bake.
UNREADABLE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)

Groups = tuple[bpy.types.Node, ...]


class Unknown(ValueError):
    """A node or socket that cannot be evaluated; the text says which."""


class NodesTooDeep(ValueError):
    """Node groups that contain themselves or are nested too deep, and links that run in a circle."""


class Inputs(dict):
    """Inputs of one node by name. One that the node lacks, or that its settings hide, raises `Unknown`."""

    def __init__(self, node: bpy.types.Node) -> None:
        super().__init__()
        self._node = node.name

    def __missing__(self, name: str) -> Place:
        raise Unknown(f'node "{self._node}" has no socket "{name}" by its settings')


@dataclass(frozen=True)
class Place:
    """A socket and the group nodes one has to enter to get to it."""

    socket: bpy.types.NodeSocket
    groups: Groups = ()

    def sibling(self, name: str) -> Place | None:
        """The input called `name` of the same node."""
        socket = self.socket.node.inputs.get(name)
        return None if socket is None else Place(socket, self.groups)


def follow(place: Place) -> Place:
    """The output that feeds an input socket, or the unlinked input whose default value counts.

    Raises `NodesTooDeep`.
    """
    socket, groups = place.socket, place.groups
    seen: set[tuple[bpy.types.NodeSocket, int]] = set()  # a reroute linked to itself is a circle that Blender does not find
    for _ in range(STEPS):
        link = _link(socket)
        if link is None:
            return Place(socket, groups)
        node, output = link.from_node, link.from_socket
        if (output, len(groups)) in seen:
            raise NodesTooDeep("node links run in a circle")
        seen.add((output, len(groups)))
        if node.mute:
            passed = next((li.from_socket for li in node.internal_links if li.to_socket == output), None)
            if passed is None:
                return Place(socket, groups)
            socket = passed
        elif node.type == "REROUTE":
            if _link(node.inputs[0]) is None:
                return Place(socket, groups)
            socket = node.inputs[0]
        elif node.type == "GROUP":
            inside = _group_output(node, output)
            if inside is None:
                return Place(socket, groups)
            if len(groups) >= GROUP_DEPTH:
                raise NodesTooDeep(f"node groups are nested deeper than {GROUP_DEPTH}")
            socket, groups = inside, (*groups, node)
        elif node.type == "GROUP_INPUT":
            if not groups:
                return Place(socket, groups)
            outside = next((s for s in groups[-1].inputs if s.identifier == output.identifier), None)
            if outside is None:
                return Place(socket, groups)
            socket, groups = outside, groups[:-1]
        else:
            return Place(output, groups)
    raise NodesTooDeep("node links do not come to an end")


def inputs(place: Place) -> Inputs:
    """Enabled inputs by name of the node that a place belongs to; of equal names the first."""
    out = Inputs(place.socket.node)
    for socket in place.socket.node.inputs:
        if socket.enabled:
            out.setdefault(socket.name, Place(socket, place.groups))
    return out


def is_linked(place: Place) -> bool:
    """Whether something else than a default value feeds this input; links that come to no end feed nothing, as in Cycles."""
    try:
        return follow(place).socket.is_output
    except NodesTooDeep:
        return False


def _link(socket: bpy.types.NodeSocket) -> bpy.types.NodeLink | None:
    """The link into an input socket that counts."""
    if not socket.is_linked:
        return None
    return next((li for li in socket.links if not li.is_muted and li.is_valid), None)


def _group_output(node: bpy.types.Node, output: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """The socket inside a group that feeds `output` of the group node."""
    if node.node_tree is None:
        return None
    ends = [n for n in node.node_tree.nodes if n.type == "GROUP_OUTPUT"]
    end = next((n for n in ends if n.is_active_output), ends[0] if ends else None)
    if end is None:
        return None
    return next((s for s in end.inputs if s.identifier == output.identifier), None)


def attributes_read() -> frozenset[str]:
    """Names of the attributes that any material of the file reads."""
    trees = [m.node_tree for m in bpy.data.materials if m.node_tree is not None] + list(bpy.data.node_groups)
    nodes = [n for tree in trees for n in tree.nodes if n.type in ("ATTRIBUTE", "VERTEX_COLOR")]
    return frozenset(n.attribute_name if n.type == "ATTRIBUTE" else n.layer_name for n in nodes)
