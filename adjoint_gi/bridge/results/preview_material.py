"""The material that shows a result: the user's, with emission of base colour times result in the place of all that scatters light.

Transparency, glass and own emission stay as they are, so leaf cards keep their outline, lit panels their light, and windows stay clear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import bpy

from ..host.versions import uses_nodes
from . import stored

GROUP = "Adjoint GI Preview"
COPY = "preview copy"  # kind of node groups that are copies of the user's
RESULT = "Adjoint GI Result"  # name of the node that reads the result
TIMES_ALBEDO = ("irradiance", "direct", "indirect")
WITH_EMISSION = ("irradiance",)  # of the others, a surface's own light is a part, or it is left out on purpose
# Shaders that stay: they do not scatter the light that is baked. All others that scatter are shown by the result.
CLEAR = {"BSDF_GLASS", "BSDF_REFRACTION", "BSDF_TRANSPARENT", "BSDF_RAY_PORTAL"}
SCATTERS_TOO = {"SUBSURFACE_SCATTERING", "EEVEE_SPECULAR"}
NO_PLACE = (math.pi, 0.0, math.pi, 1.0)  # result where the lightmap has none, because the mesh has changed: magenta, as of a lost image


def make_material(key: str, material: bpy.types.Material | None, entry: Any | None, attribute: str) -> bpy.types.Material:
    """A new material that shows the image of the stored link `entry`, or the colour `attribute`.

    It is a copy of `material` when that has nodes, so that textures keep working; the original is never touched.
    """
    quantity = key.split("[")[0]
    if material is None or not uses_nodes(material):
        return _plain(material, quantity, entry, attribute)
    made = material.copy()
    made.name = f"{material.name} (GI)"
    made.use_fake_user = False
    _Rewriting(quantity, entry, attribute).rewrite(made.node_tree)
    for output in [n for n in made.node_tree.nodes if n.type == "OUTPUT_MATERIAL"]:
        for link in list(output.inputs["Displacement"].links):  # a bake knows the surface without it
            made.node_tree.links.remove(link)
    return made


def _plain(material: bpy.types.Material | None, quantity: str, entry: Any | None, attribute: str) -> bpy.types.Material:
    """The same for a `material` without nodes, or for none."""
    made = bpy.data.materials.new(f"{material.name if material else 'No Material'} (GI)")
    if made.node_tree is None:
        made.use_nodes = True  # before Blender 5.0 a new material has no nodes
    tree = made.node_tree
    tree.nodes.clear()
    color = (1.0, 1.0, 1.0, 1.0)
    if quantity in TIMES_ALBEDO:
        color = tuple(material.diffuse_color) if material is not None else (0.8, 0.8, 0.8, 1.0)
    group = _group_node(tree, _result(tree, entry, attribute))
    _constant(tree, color, group.inputs["Base Color"])
    tree.links.new(group.outputs["Shader"], tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return made


class _Rewriting:
    """Puts the result in the place of what scatters light, in a node tree and in copies of the groups in it."""

    def __init__(self, quantity: str, entry: Any | None, attribute: str) -> None:
        self._times_base, self._emits = quantity in TIMES_ALBEDO, quantity in WITH_EMISSION
        self._entry, self._attribute = entry, attribute
        self._copies: dict[bpy.types.NodeTree, bpy.types.NodeTree] = {}

    def rewrite(self, tree: bpy.types.NodeTree) -> None:
        """Rewrite `tree`, which is ours. What is muted shades nothing: such links are as good as none, and such nodes stay as they are."""
        for link in [link for link in tree.links if link.is_muted]:
            tree.links.remove(link)
        nodes = [node for node in tree.nodes if not node.mute]
        scattering = [n for n in nodes if n.type in SCATTERS_TOO or (n.type.startswith("BSDF_") and n.type not in CLEAR)]
        emitting = [n for n in nodes if n.type == "EMISSION"]
        if not self._times_base and not scattering:  # the result is all of the light that leaves, that of lamps included
            scattering, emitting = emitting, []
        for node in emitting if not self._emits else ():
            _set(tree, node.inputs["Strength"], 0.0)
        for node in nodes:
            if node.type == "GROUP" and node.node_tree is not None and any(s.type == "SHADER" for s in node.outputs):
                node.node_tree = self._copy(node.node_tree)
        result = _result(tree, self._entry, self._attribute) if scattering else None
        for node in scattering:
            self._replace(tree, node, result)

    def _copy(self, tree: bpy.types.NodeTree) -> bpy.types.NodeTree:
        """A rewritten copy of a group of the user, made once."""
        if tree not in self._copies:
            made = self._copies[tree] = tree.copy()
            made[stored.TREE] = COPY
            made.use_fake_user = False
            self.rewrite(made)
        return self._copies[tree]

    def _replace(self, tree: bpy.types.NodeTree, node: bpy.types.Node, result: bpy.types.NodeSocket) -> None:
        """The result where `node` is linked to."""
        targets = [link.to_socket for link in node.outputs[0].links]
        if not targets:
            return
        group = _group_node(tree, result)
        base = node.inputs.get("Base Color") or node.inputs.get("Color")
        if self._times_base and base is not None and base.is_linked:
            _take_over(tree, base, group.inputs["Base Color"])
        else:
            _constant(tree, base.default_value if self._times_base and base is not None else (1.0,) * 4, group.inputs["Base Color"])
        shader = group.outputs["Shader"]
        if node.type == "BSDF_PRINCIPLED":
            shader = self._principled(tree, node, shader)
        for target in targets:
            tree.links.new(shader, target)
        if not node.outputs[0].links:
            tree.nodes.remove(node)

    def _principled(self, tree: bpy.types.NodeTree, node: bpy.types.Node, shader: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """`shader` with the transmission, emission and alpha of `node`, which stays where it is needed for its glass alone."""
        inputs = node.inputs
        if self._emits and _counts(inputs["Emission Strength"]) and _counts(inputs["Emission Color"]):
            emission, add = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeAddShader")
            _take_over(tree, inputs["Emission Color"], emission.inputs["Color"])
            _take_over(tree, inputs["Emission Strength"], emission.inputs["Strength"])
            tree.links.new(shader, add.inputs[0])
            tree.links.new(emission.outputs["Emission"], add.inputs[1])
            shader = add.outputs["Shader"]
        alpha = tree.nodes.new("ShaderNodeMixShader") if inputs["Alpha"].is_linked or inputs["Alpha"].default_value < 1.0 else None
        if alpha is not None:
            _take_over(tree, inputs["Alpha"], alpha.inputs["Fac"])
        if _counts(inputs["Transmission Weight"]):
            mix = tree.nodes.new("ShaderNodeMixShader")
            _take_over(tree, inputs["Transmission Weight"], mix.inputs["Fac"])
            tree.links.new(shader, mix.inputs[1])
            for name, value in (("Transmission Weight", 1.0), ("Metallic", 0.0), ("Alpha", 1.0), ("Emission Strength", 0.0)):
                _set(tree, inputs[name], value)
            tree.links.new(node.outputs[0], mix.inputs[2])
            shader = mix.outputs["Shader"]
        if alpha is not None:
            tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs["BSDF"], alpha.inputs[1])
            tree.links.new(shader, alpha.inputs[2])
            shader = alpha.outputs["Shader"]
        return shader


def _counts(socket: bpy.types.NodeSocket) -> bool:
    """Whether a socket is anything but zero, or black."""
    value = socket.default_value
    return socket.is_linked or any(x > 0.0 for x in (list(value)[:3] if hasattr(value, "__len__") else [value]))


def _take_over(tree: bpy.types.NodeTree, source: bpy.types.NodeSocket, target: bpy.types.NodeSocket) -> None:
    """Give `target` the link, or the value, that `source` has."""
    if source.is_linked:
        tree.links.new(source.links[0].from_socket, target)
    else:
        value = source.default_value
        target.default_value = tuple(value) if hasattr(value, "__len__") else value


def _constant(tree: bpy.types.NodeTree, color: Sequence[float], target: bpy.types.NodeSocket) -> None:
    """Give `target` a colour by a node: exporters look for it there."""
    node = tree.nodes.new("ShaderNodeRGB")
    node.outputs[0].default_value = tuple(color)
    tree.links.new(node.outputs[0], target)


def _set(tree: bpy.types.NodeTree, socket: bpy.types.NodeSocket, value: float) -> None:
    """Give a socket a value, and no link."""
    for link in list(socket.links):
        tree.links.remove(link)
    socket.default_value = value


def _group_node(tree: bpy.types.NodeTree, result: bpy.types.NodeSocket) -> bpy.types.Node:
    """Our group in `tree`, which reads `result`."""
    group = tree.nodes.new("ShaderNodeGroup")
    group.node_tree = preview_group()
    tree.links.new(result, group.inputs["Result"])
    return group


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
    # Exporters for games understand a product of colours by this node.
    times = tree.nodes.new("ShaderNodeMix")
    times.data_type, times.blend_type = "RGBA", "MULTIPLY"
    factor, result, base = (next(x for x in times.inputs if x.name == name and x.enabled) for name in ("Factor", "A", "B"))
    factor.default_value = 1.0
    emit = tree.nodes.new("ShaderNodeEmission")
    emit.inputs["Strength"].default_value = 1 / math.pi  # from irradiance or radiosity to radiance
    for k, node in enumerate((start, times, emit, end)):
        node.location = (200 * k, 0)
    tree.links.new(start.outputs["Base Color"], base)
    tree.links.new(start.outputs["Result"], result)
    tree.links.new(next(x for x in times.outputs if x.enabled), emit.inputs["Color"])
    tree.links.new(emit.outputs["Emission"], end.inputs["Shader"])
    return tree


def remove_unused_group() -> None:
    """Remove our node group, and copies of the user's, when no material uses them any more; a copy may hold others."""
    unused = True
    while unused:
        ours = [t for t in bpy.data.node_groups if stored.read(t, stored.TREE) in ("preview", COPY) and t.library is None]
        unused = [t for t in ours if t.users == 0]
        for tree in unused:
            bpy.data.node_groups.remove(tree)


def _result(tree: bpy.types.NodeTree, entry: Any | None, attribute: str) -> bpy.types.NodeSocket:
    """Nodes in `tree` that read the linked image, or the colour attribute; returns their colour socket."""
    if entry is not None:
        return _image(tree, entry)
    node = tree.nodes.new("ShaderNodeVertexColor")
    node.name, node.layer_name = RESULT, attribute
    return node.outputs["Color"]


def _image(tree: bpy.types.NodeTree, entry: Any) -> bpy.types.NodeSocket:
    """Nodes that read the linked image; returns their colour socket."""
    nodes, links = tree.nodes, tree.links
    uv, mapping, texture = (nodes.new(f"ShaderNode{x}") for x in ("UVMap", "Mapping", "TexImage"))
    texture.name, texture.extension, texture.image = RESULT, "EXTEND", entry["image"]
    links.new(uv.outputs["UV"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    uv.uv_map, scale, offset = place(entry)[1:]
    mapping.inputs["Scale"].default_value, mapping.inputs["Location"].default_value = (*scale, 1), (*offset, 0)

    # A carried layer whose mesh has changed lies left of the image.
    axes, left, choice = (nodes.new(f"ShaderNode{x}") for x in ("SeparateXYZ", "Math", "Mix"))
    links.new(uv.outputs["UV"], axes.inputs["Vector"])
    left.operation, left.inputs[1].default_value = "LESS_THAN", -0.5
    links.new(axes.outputs["X"], left.inputs[0])
    choice.data_type = "RGBA"
    factor, own, lost = (next(s for s in choice.inputs if s.name == name and s.enabled) for name in ("Factor", "A", "B"))
    links.new(left.outputs["Value"], factor)
    links.new(texture.outputs["Color"], own)
    lost.default_value = NO_PLACE
    return next(s for s in choice.outputs if s.enabled)


def place(entry: Any) -> tuple[int, str, tuple[float, ...], tuple[float, ...]]:
    """The image of the stored link `entry` by its session_uid, its UV layer, and scale and offset of its object's place in it."""
    return entry["image"].session_uid, entry.get("uv_layer", ""), tuple(entry.get("scale", (1, 1))), tuple(entry.get("offset", (0, 0)))
