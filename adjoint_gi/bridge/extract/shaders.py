"""Shader nodes to lobes. Mix and Add Shader multiply weights, never the colours of which Fresnel's terms are computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy
import numpy as np

from ...core.scene.arrays import Color, Lobe, Rgb
from ..host.notices import Notices
from ..host.versions import uses_nodes
from .color_math import LARGEST_POLYNOMIAL, combined
from .colors import Colors
from .images import Images
from .nodes import UNREADABLE, NodesTooDeep, Place, follow, inputs, is_linked
from .principled import diffuse_lobe, metal_lobe, principled_lobes

DEPTH = 64  # shaders mixed into each other
LINEAR = ("diffuse", "emission", "transparent")  # kinds whose weight goes into their colour: nothing else is computed of it
GREY = 0.8  # Cycles' default surface


class Shaders:
    """Walks the shader tree of one material, world or light and collects its lobes."""

    def __init__(self, colors: Colors) -> None:
        self.colors = colors
        self._depth = 0
        self._stacks = 0  # coats and their bases given out so far
        self._known: dict[Place, list[Lobe]] = {}  # shaders already read: one that feeds two inputs is read once

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
        if found not in self._known:
            self._depth += 1
            try:
                self._known[found] = self._shader(found)
            finally:
                self._depth -= 1
        return [self._weighted(x, weight) for x in self._known[found]]

    def _shader(self, place: Place) -> list[Lobe]:
        """Lobes of the node that `place` is an output of; one that cannot be read is named and counts as Cycles' default."""
        reader = _SHADERS.get(place.socket.node.bl_idname, Shaders._unknown)
        try:
            return reader(self, place.socket.node, place)
        except UNREADABLE as e:
            self.colors.skip(
                place, f"cannot be read ({type(e).__name__}: {e})", f"a grey diffuse surface of {GREY} is used", "Use Principled"
            )
            return [Lobe("diffuse", Color.of(GREY))]

    def _tell(self, reason: str, remedy: str) -> None:
        self.colors.notices.add(self.colors.owner, reason, remedy)

    def _weighted(self, lobe: Lobe, weight: Color) -> Lobe:
        if lobe.kind in LINEAR:
            return replace(lobe, color=self._times(lobe.share, weight), weight=1.0)
        return replace(lobe, weight=self._times(Color.of(1.0) * lobe.weight, weight))

    def _times(self, color: Color, weight: Color) -> Color:
        """Product of two polynomials; if it gets too long, the colour alone with a notice."""
        product = combined(color * weight)
        if len(product.terms) <= LARGEST_POLYNOMIAL or weight.is_constant:
            return product
        self._tell("mixes too many textures; a mixing factor is left out", "Bake the material to one image")
        return color

    def _mix(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Mix Shader: (1 - factor) of the first and factor of the second."""
        factor = self.colors.share(Place(node.inputs[0], place.groups))
        first = self.lobes(Place(node.inputs[1], place.groups), factor.complement())
        return merged(first + self.lobes(Place(node.inputs[2], place.groups), factor))

    def _add(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Add Shader."""
        return merged([lobe for s in node.inputs for lobe in self.lobes(Place(s, place.groups), Color.of(1.0))])

    def _emission(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Emission and Background: colour times strength."""
        sockets = inputs(place)
        return [Lobe("emission", self._times(self.colors.color(sockets["Color"]), self.colors.value(sockets["Strength"])))]

    def _principled(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        self._stacks += 1
        return principled_lobes(self.colors, place, self._stacks)

    def _diffuse(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Diffuse BSDF, Lambert's or with a roughness Oren and Nayar's."""
        sockets = inputs(place)
        self._normal(place, sockets)
        roughness = self.colors.number(sockets["Roughness"], "roughness") if "Roughness" in sockets else 0.0
        color = self.colors.color(sockets["Color"])
        return [diffuse_lobe(color, roughness)]

    def _as_diffuse(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Translucent, subsurface, sheen, toon: their colour reflected by an ideal diffuser."""
        sockets = inputs(place)
        self.colors.skip(place, "is not computed", "an ideal diffuser of its colour is used", "Use Diffuse or Principled")
        return [Lobe("diffuse", self.colors.color(sockets["Color"]))]

    def _rough(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
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
        many = node.distribution == "MULTI_GGX"
        fresnel = getattr(node, "fresnel_type", "")
        if fresnel == "F82":
            edge = self.colors.color(sockets["Edge Tint"])
            return [metal_lobe(self.colors.color(sockets["Base Color"]), edge, min(max(roughness, 0.0), 1.0), many)]
        if fresnel == "PHYSICAL_CONDUCTOR":
            color = self._conductor(place, sockets)
        else:
            color = self.colors.color(sockets["Color"] if "Color" in sockets else sockets["Base Color"])
        return [Lobe(kind, color, min(max(roughness, 0.0), 1.0), max(ior, 1e-3), many)]

    def _conductor(self, place: Place, sockets: dict[str, Place]) -> Color:
        """Reflectance at normal incidence of a Metallic BSDF given by n + ik for each channel: ((n - 1)^2 + k^2) / ((n + 1)^2 + k^2)."""
        index, extinction = self.colors.color(sockets["IOR"]), self.colors.color(sockets["Extinction"])
        if not (index.is_constant and extinction.is_constant):
            self.colors.skip(place, "has an index of refraction that varies", f"the grey {GREY} is used", "Use one index for each channel")
            return Color.of(GREY)
        n, k = np.maximum(index.constant, 0.0), np.maximum(extinction.constant, 0.0)
        below = (n + 1.0) ** 2 + k**2
        return Color.of(*(1.0 - 4.0 * n / below).tolist())

    def _transparent(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        return [Lobe("transparent", self.colors.color(inputs(place)["Color"]))]

    def _nothing(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Holdout and volumes at a surface socket: black."""
        self.colors.skip(place, "is not computed", "black is used", "Use a surface shader")
        return []

    def _unknown(self, node: bpy.types.Node, place: Place) -> list[Lobe]:
        """Anything else: its colour, or Cycles' default grey, reflected by an ideal diffuser."""
        sockets = inputs(place)
        if "Color" in sockets:
            return self._as_diffuse(node, place)
        self.colors.skip(place, "is not understood", f"a grey diffuse surface of {GREY} is used", "Use Diffuse or Principled")
        return [Lobe("diffuse", Color.of(GREY))]

    def _normal(self, place: Place, sockets: dict[str, Place]) -> None:
        """A linked normal (bump or normal map) is left out and named."""
        if "Normal" in sockets and is_linked(sockets["Normal"]):
            self.colors.skip(place, "has a bump or normal map", "the mesh's own normals are used", "")


_SHADERS: dict[str, Callable[[Shaders, bpy.types.Node, Place], list[Lobe]]] = {
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


def merged(lobes: list[Lobe]) -> list[Lobe]:
    """One lobe for all that differ in weight alone, and for all of a `LINEAR` kind: constants add up, and clamping sees their sum."""
    sums: dict[Lobe, Color] = {}
    for lobe in lobes:
        linear = lobe.kind in LINEAR
        key = Lobe(lobe.kind, Color(), stack=lobe.stack) if linear else replace(lobe, weight=1.0)
        sums[key] = sums.get(key, Color()) + (lobe.share if linear else Color.of(1.0) * lobe.weight)
    return [replace(x, **{"color" if x.kind in LINEAR else "weight": combined(total)}) for x, total in sums.items()]


def surface(tree: bpy.types.NodeTree, output: str) -> Place | None:
    """The Surface socket of the tree's output node for Cycles; None where there is none, or only one for EEVEE (Cycles: black)."""
    node = tree.get_output_node("CYCLES")
    return None if node is None or node.type != output else Place(node.inputs["Surface"])


def light_emission(data: bpy.types.Light, name: str, notices: Notices) -> Rgb:
    """Colour times strength of a light's own nodes, (1, 1, 1) without nodes. What varies is replaced by its mean."""
    if not uses_nodes(data):
        return (1.0, 1.0, 1.0)
    colors = Colors(Images(notices, bpy.context.scene.frame_current), notices)
    colors.owner, colors.remedy = name, "Use an Emission with a constant colour and strength"
    place = surface(data.node_tree, "OUTPUT_LIGHT")
    if place is None:
        notices.add(name, "is a light without an output node for Cycles; it is dark, as there", "Add a Light Output whose target is All")
        return (0.0, 0.0, 0.0)
    lobes = Shaders(colors).lobes(place, Color.of(1.0))
    total = Color()
    for lobe in lobes:
        if lobe.kind == "emission":
            total = total + lobe.color
    if not total.is_constant:
        notices.add(name, "is a light whose nodes vary with direction or place; its typed values are not used", "Use a constant Emission")
        return (1.0, 1.0, 1.0)
    return total.constant
