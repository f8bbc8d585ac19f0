"""Shader nodes to lobes: the weights of Mix and Add Shader are multiplied out into the lobes' colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy

from ..core.scene import Color, Lobe, Rgb
from .color_math import NotPolynomial, simplified
from .extract_colors import Colors
from .extract_images import Images
from .extract_nodes import NodesTooDeep, Place, follow, inputs, is_linked
from .extract_notices import Notices
from .principled import principled_lobes
from .versions import uses_nodes

DEPTH = 64  # shaders mixed into each other
GREY = 0.8  # Cycles' default surface


class Shaders:
    """Walks a shader tree and collects its lobes."""

    def __init__(self, colors: Colors) -> None:
        self.colors = colors
        self._depth = 0

    def lobes(self, place: Place, weight: Color) -> list[Lobe]:
        """Lobes of the shader that feeds the socket at `place`, times `weight`."""
        if weight.is_black:
            return []
        if self._depth >= DEPTH:
            self._tell(f"mixes shaders deeper than {DEPTH}; the innermost ones are black", "Simplify the nodes")
            return []
        try:
            found = follow(place)
        except NodesTooDeep as e:
            self._tell(f"{e}; a grey diffuse surface of {GREY} is used", "Take the group out of itself")
            return [Lobe("diffuse", weight * GREY)]
        if not found.socket.is_output:
            return []
        if found.socket.type != "SHADER":  # a colour at a surface socket is emitted, as in Cycles
            return [Lobe("emission", self._times(self.colors.color(place), weight))]
        self._depth += 1
        try:
            reader = _SHADERS.get(found.socket.node.bl_idname, Shaders._unknown)
            return reader(self, found.socket.node, found, weight)
        finally:
            self._depth -= 1

    def _tell(self, reason: str, remedy: str) -> None:
        self.colors.notices.add(self.colors.owner, reason, remedy)

    def _times(self, color: Color, weight: Color) -> Color:
        """Product of two polynomials; if it gets too long, the colour alone with a notice."""
        try:
            return simplified(color * weight)
        except NotPolynomial:
            self._tell("mixes too many textures; a mixing factor is left out", "Bake the material to one image")
            return color

    def _mix(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Mix Shader: (1 - factor) of the first and factor of the second."""
        factor = self.colors.value(Place(node.inputs[0], place.groups))
        if factor.is_constant:
            factor = Color.of(min(max(factor.constant[0], 0.0), 1.0))
        first = self.lobes(Place(node.inputs[1], place.groups), self._times(factor.complement(), weight))
        return first + self.lobes(Place(node.inputs[2], place.groups), self._times(factor, weight))

    def _add(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Add Shader."""
        return [lobe for s in node.inputs for lobe in self.lobes(Place(s, place.groups), weight)]

    def _emission(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Emission and Background: colour times strength."""
        sockets = inputs(place)
        color = self._times(self.colors.color(sockets["Color"]), self.colors.value(sockets["Strength"]))
        return [Lobe("emission", self._times(color, weight))]

    def _principled(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        return [replace(x, color=self._times(x.color, weight)) for x in principled_lobes(self.colors, place)]

    def _diffuse(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Diffuse BSDF; its roughness (Oren-Nayar) is not computed."""
        sockets = inputs(place)
        if "Roughness" in sockets and (is_linked(sockets["Roughness"]) or sockets["Roughness"].socket.default_value > 0.0):
            self.colors.skip(place, "has a roughness", "it is computed as an ideal diffuser", "Set its roughness to 0")
        self._normal(place, sockets)
        return [Lobe("diffuse", self._times(self.colors.color(sockets["Color"]), weight))]

    def _as_diffuse(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Translucent, subsurface, sheen, toon: their colour reflected by an ideal diffuser."""
        sockets = inputs(place)
        self.colors.skip(place, "is not computed", "an ideal diffuser of its colour is used", "Use Diffuse or Principled")
        return [Lobe("diffuse", self._times(self.colors.color(sockets["Color"]), weight))]

    def _rough(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Glossy, Metallic, Glass and Refraction."""
        sockets = inputs(place)
        kind = {"ShaderNodeBsdfGlass": "glass", "ShaderNodeBsdfRefraction": "refraction"}.get(node.bl_idname, "glossy")
        roughness = self.colors.number(sockets["Roughness"], "roughness") if "Roughness" in sockets else 0.0
        ior = self.colors.number(sockets["IOR"], "index of refraction") if "IOR" in sockets and kind != "glossy" else 1.45
        if "Anisotropy" in sockets and self.colors.number(sockets["Anisotropy"], "anisotropy") != 0.0:
            self.colors.skip(place, "is anisotropic", "it is computed as isotropic", "Set its anisotropy to 0")
        self._normal(place, sockets)
        if node.distribution in ("BECKMANN", "ASHIKHMIN_SHIRLEY") and roughness > 0.0:
            self.colors.skip(place, f"has the distribution {node.distribution}", "it is computed as GGX", "Choose GGX")
        color = self.colors.color(sockets["Color"] if "Color" in sockets else sockets["Base Color"])
        many = node.distribution == "MULTI_GGX"
        return [Lobe(kind, self._times(color, weight), min(max(roughness, 0.0), 1.0), max(ior, 1e-3), many)]

    def _transparent(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        return [Lobe("transparent", self._times(self.colors.color(inputs(place)["Color"]), weight))]

    def _nothing(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Holdout and volumes at a surface socket: black."""
        self.colors.skip(place, "is not computed", "black is used", "Use a surface shader")
        return []

    def _unknown(self, node: bpy.types.Node, place: Place, weight: Color) -> list[Lobe]:
        """Anything else: its colour, or Cycles' default grey, reflected by an ideal diffuser."""
        sockets = inputs(place)
        if "Color" in sockets:
            return self._as_diffuse(node, place, weight)
        self.colors.skip(place, "is not understood", f"a grey diffuse surface of {GREY} is used", "Use Diffuse or Principled")
        return [Lobe("diffuse", weight * GREY)]

    def _normal(self, place: Place, sockets: dict[str, Place]) -> None:
        """A linked normal (bump or normal map) is left out and named."""
        if "Normal" in sockets and is_linked(sockets["Normal"]):
            self.colors.skip(place, "has a bump or normal map", "the mesh's own normals are used", "")


_SHADERS: dict[str, Callable[[Shaders, bpy.types.Node, Place, Color], list[Lobe]]] = {
    "ShaderNodeMixShader": Shaders._mix,
    "ShaderNodeAddShader": Shaders._add,
    "ShaderNodeEmission": Shaders._emission,
    "ShaderNodeBackground": Shaders._emission,
    "ShaderNodeBsdfPrincipled": Shaders._principled,
    "ShaderNodeBsdfDiffuse": Shaders._diffuse,
    "ShaderNodeBsdfTranslucent": Shaders._as_diffuse,
    "ShaderNodeSubsurfaceScattering": Shaders._as_diffuse,
    "ShaderNodeBsdfSheen": Shaders._as_diffuse,
    "ShaderNodeBsdfToon": Shaders._as_diffuse,
    "ShaderNodeBsdfAnisotropic": Shaders._rough,
    "ShaderNodeBsdfGlossy": Shaders._rough,
    "ShaderNodeBsdfMetallic": Shaders._rough,
    "ShaderNodeBsdfGlass": Shaders._rough,
    "ShaderNodeBsdfRefraction": Shaders._rough,
    "ShaderNodeBsdfTransparent": Shaders._transparent,
    "ShaderNodeHoldout": Shaders._nothing,
}


def surface(tree: bpy.types.NodeTree, output: str) -> Place | None:
    """The Surface socket of the tree's active output node for Cycles."""
    node = tree.get_output_node("CYCLES")
    if node is None or node.type != output:
        node = next((n for n in tree.nodes if n.type == output), None)
    return None if node is None else Place(node.inputs["Surface"])


def light_emission(data: bpy.types.Light, name: str, notices: Notices) -> Rgb:
    """Colour times strength of a light's own nodes, (1, 1, 1) without nodes. What varies is replaced by its mean."""
    if not uses_nodes(data):
        return (1.0, 1.0, 1.0)
    colors = Colors(Images(notices), notices)
    colors.owner = name
    place = surface(data.node_tree, "OUTPUT_LIGHT")
    lobes = [] if place is None else Shaders(colors).lobes(place, Color.of(1.0))
    total = Color()
    for lobe in lobes:
        if lobe.kind == "emission":
            total = total + lobe.color
    if not total.is_constant:
        notices.add(name, "is a light whose nodes vary with direction or place; its typed values are not used", "Use a constant Emission")
        return (1.0, 1.0, 1.0)
    return total.constant
