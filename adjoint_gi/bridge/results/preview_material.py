"""The material that shows a result: base colour of the user's material, times the result, as emission."""

from __future__ import annotations

import math
from typing import Any

import bpy

from ..host.versions import uses_nodes
from . import stored

GROUP = "Adjoint GI Preview"
TIMES_ALBEDO = ("irradiance", "direct", "indirect")


def make_material(
    obj: bpy.types.Object, key: str, material: bpy.types.Material | None, entry: Any | None, attribute: str
) -> bpy.types.Material:
    """A new material that shows the image of the stored link `entry`, or the colour `attribute`.

    It is a copy of `material` when that has nodes and its base colour is wanted, so that textures and groups keep working; the
    original is never touched.
    """
    quantity = key.split("[")[0]
    wants_base = quantity in TIMES_ALBEDO
    if material is not None and wants_base and uses_nodes(material):
        made = material.copy()
        made.name = f"{material.name} (GI)"
    else:
        made = bpy.data.materials.new(f"{material.name if material else obj.name} (GI)")
        if made.node_tree is None:
            made.use_nodes = True  # before Blender 5.0 a new material has no nodes
        made.node_tree.nodes.clear()
    made.use_fake_user = False
    tree = made.node_tree
    nodes, links = tree.nodes, tree.links

    # Step 1: the base colour socket, before the output is taken away from its shader.
    base = _base_color(tree) if wants_base else None
    color = (1.0, 1.0, 1.0, 1.0)
    if wants_base and base is None:
        color = tuple(material.diffuse_color) if material is not None and not uses_nodes(material) else (0.8, 0.8, 0.8, 1.0)

    # Step 2: the result, through its UV layer and its place in an atlas.
    result = _image(nodes, links, entry) if entry is not None else _attribute(nodes, attribute)

    # Step 3: our group turns both into emitted radiance.
    group = nodes.new("ShaderNodeGroup")
    group.node_tree = preview_group()
    links.new(result, group.inputs["Result"])
    if base is not None and base.is_linked:
        links.new(base.links[0].from_socket, group.inputs["Base Color"])
    else:
        group.inputs["Base Color"].default_value = tuple(base.default_value) if base is not None else color
    output = _output(tree) or nodes.new("ShaderNodeOutputMaterial")
    for name in ("Volume", "Displacement"):
        for link in list(output.inputs[name].links):
            links.remove(link)
    links.new(group.outputs["Shader"], output.inputs["Surface"])
    return made


def aim(material: bpy.types.Material, entry: Any | None, attribute: str) -> None:
    """Have a material of ours show the image of the stored link `entry`, or the colour `attribute`, in place of one of the same kind."""
    ours = [n for n in material.node_tree.nodes if n.type == "GROUP" and n.node_tree is not None and stored.read(n.node_tree, stored.TREE)]
    for link in [link for node in ours for link in node.inputs["Result"].links]:
        if link.from_node.type == "TEX_IMAGE" and entry is not None:
            _aim_image(link.from_node, entry)
        elif link.from_node.type == "VERTEX_COLOR" and attribute:
            link.from_node.layer_name = attribute


def preview_group() -> bpy.types.NodeTree:
    """Our node group Base Color x Result / pi -> Emission, made once for each file."""
    for tree in bpy.data.node_groups:
        if stored.read(tree, stored.TREE) == "preview" and tree.library is None:
            return tree
    tree = bpy.data.node_groups.new(GROUP, "ShaderNodeTree")
    tree[stored.TREE] = "preview"
    tree.interface.new_socket("Base Color", in_out="INPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Result", in_out="INPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    times = tree.nodes.new("ShaderNodeVectorMath")
    times.operation = "MULTIPLY"
    emit = tree.nodes.new("ShaderNodeEmission")
    emit.inputs["Strength"].default_value = 1 / math.pi  # from irradiance or radiosity to radiance
    for k, node in enumerate((start, times, emit, end)):
        node.location = (200 * k, 0)
    tree.links.new(start.outputs["Base Color"], times.inputs[0])
    tree.links.new(start.outputs["Result"], times.inputs[1])
    tree.links.new(times.outputs["Vector"], emit.inputs["Color"])
    tree.links.new(emit.outputs["Emission"], end.inputs["Shader"])
    return tree


def remove_unused_group() -> None:
    """Remove our node group when no material uses it any more."""
    for tree in [t for t in bpy.data.node_groups if stored.read(t, stored.TREE) == "preview" and t.library is None and t.users == 0]:
        bpy.data.node_groups.remove(tree)


def _image(nodes: bpy.types.Nodes, links: bpy.types.NodeLinks, entry: Any) -> bpy.types.NodeSocket:
    """Nodes that read the linked image; returns their colour socket."""
    uv, mapping, texture = (nodes.new(f"ShaderNode{x}") for x in ("UVMap", "Mapping", "TexImage"))
    texture.extension = "EXTEND"
    links.new(uv.outputs["UV"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    _aim_image(texture, entry)
    return texture.outputs["Color"]


def _aim_image(texture: bpy.types.Node, entry: Any) -> None:
    """Have `texture`, made by `_image`, show the image of the stored link `entry` where its object has its place in it."""
    mapping = texture.inputs["Vector"].links[0].from_node
    mapping.inputs["Vector"].links[0].from_node.uv_map = entry.get("uv_layer", "")
    mapping.inputs["Scale"].default_value = (*entry.get("scale", (1, 1)), 1)
    mapping.inputs["Location"].default_value = (*entry.get("offset", (0, 0)), 0)
    texture.image = entry["image"]


def _attribute(nodes: bpy.types.Nodes, name: str) -> bpy.types.NodeSocket:
    node = nodes.new("ShaderNodeVertexColor")
    node.layer_name = name
    return node.outputs["Color"]


def _output(tree: bpy.types.NodeTree) -> bpy.types.Node | None:
    """The output that counts: for all engines, else the active one of any."""
    return tree.get_output_node("ALL") or tree.get_output_node("CYCLES") or tree.get_output_node("EEVEE")


def _base_color(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket | None:
    """The base colour socket of the first shader behind the output that has one, nearest first; None if there is none."""
    output = _output(tree)
    waiting = [link.from_node for link in output.inputs["Surface"].links] if output else []
    seen = set()
    while waiting:
        node = waiting.pop(0)
        if node.name in seen:
            continue
        seen.add(node.name)
        socket = node.inputs.get("Base Color") or (node.inputs.get("Color") if node.type.startswith("BSDF_") else None)
        if socket is not None:
            return socket
        for socket in node.inputs:
            if socket.type == "SHADER" or node.type == "REROUTE":
                waiting += [link.from_node for link in socket.links]
    return None
