"""Colour and number sockets to polynomials: which constants, images and attributes they come to.

A node that is not understood is named in a notice. Its place is taken by the mean of the image it changes, else by the default value
of the socket that it feeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np

from ...core.scene.arrays import Color, Source, Term
from ..host.notices import Notices
from . import color_nodes
from .color_math import NotPolynomial, finite, luminance, mapped, mean, simplified
from .images import MEAN_OF_NOTHING, Images, is_straight
from .nodes import UNREADABLE, NodesTooDeep, Place, Unknown, follow, inputs
from .uv import NotUv, read_coordinates

DEPTH = 100  # nodes between a shader and the end of a chain
MOST_SOURCES = 8  # of a share; one of more is not looked at, and counts as within 0 to 1
ROUNDING = 1e-4  # by which a share may leave 0 to 1


class Colors:
    """Reads sockets. `owner` is set to the name of the material, world or light that notices should carry, `remedy` to what helps against
    any node that is not understood; where it is empty, each has its own."""

    remedy = ""

    def __init__(self, images: Images, notices: Notices) -> None:
        self.images = images
        self.notices = notices
        self.uses_default_attribute = False
        self.owner = ""
        self._depth = 0

    @property
    def owner(self) -> str:
        """Name of what is being read."""
        return self._owner

    @owner.setter
    def owner(self, name: str) -> None:
        self._owner = name
        self._known: dict[Place, Color] = {}  # outputs already read: a node that feeds two inputs is read once

    def color(self, place: Place) -> Color:
        """The colour at an input socket."""
        return self._read(place, grey=False)

    def value(self, place: Place) -> Color:
        """The number at an input socket, as a grey colour."""
        return self._read(place, grey=True)

    def share(self, place: Place) -> Color:
        """The number at an input socket that Cycles keeps between 0 and 1, such as a factor."""
        value = self.value(place)
        if value.is_constant:
            return Color.of(min(max(value.constant[0], 0.0), 1.0))
        if not self._leaves(value):
            return value
        try:
            return mapped(value, lambda c: np.clip(c, 0.0, 1.0), self.images)
        except NotPolynomial:
            self.skip(place, "takes a share beyond 0 to 1 that several sources make", "it is not clamped there", "Keep it between 0 and 1")
            return value

    def _leaves(self, value: Color) -> bool:
        """Whether a polynomial may lie outside of 0 to 1: where each source is at one of its ends. Attributes count as 0 to 1."""
        sources = sorted({s for t in value.terms for s in t.sources}, key=repr)
        if len(sources) > MOST_SOURCES:
            return False
        ends = [self._ends(s) for s in sources]
        corner = {s: e[np.arange(1 << len(sources)) >> k & 1] for k, (s, e) in enumerate(zip(sources, ends, strict=True))}
        total = np.zeros((1 << len(sources), 3))
        for term in value.terms:
            total += np.prod([np.broadcast_to(term.constant, total.shape), *(corner[s] for s in term.sources)], axis=0)
        return bool(total.min() < -ROUNDING or total.max() > 1.0 + ROUNDING)

    def _ends(self, source: Source) -> np.ndarray:
        """(2, 3) float64 least and largest value of each channel."""
        if source.kind != "image":
            return np.array([[0.0] * 3, [1.0] * 3])
        ends = self.images.ranges(source.texture)[:, [3, 3, 3] if source.alpha else [0, 1, 2]].astype(np.float64)
        if self.images.textures[source.texture].extension == "CLIP":
            ends[0], ends[1] = np.minimum(ends[0], 0.0), np.maximum(ends[1], 0.0)
        return ends

    def number(self, place: Place, word: str) -> float:
        """A number that has to be the same everywhere; when it is not, its mean, with a notice that calls it `word`."""
        value = self.value(place)
        if not value.is_constant:
            try:
                value = Color.of(*mean(value, self.images))
                text = "it is replaced by its mean"
            except NotPolynomial:
                value = self._default(place)
                text = "it is replaced by its default"
            self.notices.add(self.owner, f"{word} varies over the surface, which is not computed; {text}", f"Use one number for {word}")
        return value.constant[0]

    def skip(self, place: Place, reason: str, substitute: str, remedy: str = "Bake it to an image or use a constant") -> None:
        """Note that the node of `place` was not understood and what stands in for it."""
        node = place.socket.node
        label = node.name if node.name.startswith(node.bl_label) else f"{node.name} ({node.bl_label})"
        self.notices.add(self.owner, f'node "{label}" {reason}; {substitute}', self.remedy or remedy)

    def _default(self, place: Place) -> Color:
        """The value typed into a socket, or 0 when it has none."""
        value = getattr(place.socket, "default_value", None)
        if isinstance(value, bool | int | float):
            return self._sound((float(value),) * 3, place)
        if value is None or isinstance(value, str):
            return Color.of(0.0)
        numbers = [float(x) for x in value]
        if len(numbers) < 3:
            return Color.of(0.0)
        return self._sound((numbers[0], numbers[1], numbers[2]), place)

    def _sound(self, value: tuple[float, float, float], place: Place) -> Color:
        if all(math.isfinite(x) for x in value):
            return Color.of(*value)
        self.notices.add(self.owner, f'socket "{place.socket.name}" holds a value that is not a number; it counts as 0', "Type a number")
        return Color.of(*(x if math.isfinite(x) else 0.0 for x in value))

    def _read(self, place: Place, grey: bool) -> Color:
        """The polynomial at an input, or its default with a notice."""
        try:
            if self._depth > DEPTH:
                raise NodesTooDeep(f"nodes are chained deeper than {DEPTH}")
            self._depth += 1
            try:
                found = follow(place)
                out = self._once(found) if found.socket.is_output else self._default(found)
            finally:
                self._depth -= 1
            return self._grey(out, found, place) if grey else out
        except (NodesTooDeep, NotPolynomial) as e:
            self.notices.add(self.owner, f'socket "{place.socket.name}": {e}; its default value is used', "Simplify the nodes")
        except Unknown as e:
            text = f'{e}; the default value of socket "{place.socket.name}" is used'
            self.notices.add(self.owner, text, self.remedy or "Bake it to an image or use a constant")
        default = self._default(place)
        return luminance(default, self.images) if grey and place.socket.type == "RGBA" else default

    def _grey(self, color: Color, found: Place, place: Place) -> Color:
        """What a number socket makes of a colour (its luminance) or a vector (the mean of its components)."""
        if found.socket.type == "RGBA":
            try:
                return luminance(color, self.images)
            except NotPolynomial:
                self.skip(
                    found, f'feeds colours to the number "{place.socket.name}"', "each channel is used by itself", "Use a grey attribute"
                )
                return color
        if found.socket.type == "VECTOR" and color.is_constant:
            return Color.of(sum(color.constant) / 3.0)
        return color

    def _once(self, place: Place) -> Color:
        """The simplified polynomial of a node's output, from memory when it was read before."""
        if place not in self._known:
            read = simplified(self._output(place))
            self._known[place] = finite(read)
            if self._known[place] is not read:
                self.skip(
                    place, "computes what is not a number or too large", "it counts as 0 or as the largest number", "Check its inputs"
                )
        return self._known[place]

    def _output(self, place: Place) -> Color:
        """The polynomial of a node's output; raises `Unknown` or `NotPolynomial`."""
        node = place.socket.node
        reader, function = _READERS.get(node.bl_idname), color_nodes.FUNCTIONS.get(node.bl_idname)
        try:
            if reader is not None:
                return reader(self, node, place)
            if function is not None:
                return self._function(node, place, function)
        except (NodesTooDeep, NotPolynomial, Unknown):
            raise
        except UNREADABLE as e:
            raise Unknown(f'node "{node.name}" ({node.bl_label}) cannot be read ({type(e).__name__}: {e})') from e
        raise Unknown(f'node "{node.name}" ({node.bl_label}) is not understood')

    def _function(self, node: bpy.types.Node, place: Place, function: Callable) -> Color:
        """A node that maps one colour or number to another, its other inputs being constant."""
        if place.socket.name == "Alpha":
            raise Unknown(f'the alpha of node "{node.name}" is not computed')
        sockets = inputs(place)
        main = color_nodes.main_input(sockets)
        numbers = {n: self.number(p, f'"{n}" of node "{node.name}"') for n, p in sockets.items() if n != main and p.socket.type == "VALUE"}
        value = self.value(sockets[main]) if sockets[main].socket.type == "VALUE" else self.color(sockets[main])
        mapping = function(node, numbers)
        try:
            return mapped(value, mapping, self.images)
        except NotPolynomial as e:
            try:
                constant = Color.of(*mean(value, self.images))
                text = "its result for the mean of its input is used"
            except NotPolynomial:
                constant = self._default(sockets[main])
                text = "its result for its input's default value is used"
            self.skip(place, f"cannot be computed, because {e}", text)
            return mapped(constant, mapping, self.images)

    def _image(self, node: bpy.types.Node, place: Place) -> Color:
        """Image Texture: a lookup through a UV layer, or the mean of the image where the coordinates are others."""
        alpha = place.socket.name == "Alpha"
        if node.image is None:
            self.skip(place, "has no image", "black is used, as in Cycles", "Choose an image")
            return Color.of(0.0)
        straight = is_straight(node)
        if node.interpolation not in ("Closest", "Linear"):
            text = f'node "{node.name}" has {node.interpolation.lower()} interpolation; it is computed as linear'
            self.notices.add(self.owner, text, "Choose linear", "info")
        interpolation = "Closest" if node.interpolation == "Closest" else "Linear"
        index = self.images.read(node, node.extension, interpolation, straight)
        if index is None:
            return Color.of(1.0) if alpha else Color.of(*MEAN_OF_NOTHING[:3])
        try:
            if node.projection != "FLAT":
                raise NotUv(f"has {node.projection.lower()} projection")
            layer, m = read_coordinates(inputs(place)["Vector"])
        except (NotUv, NodesTooDeep) as e:
            self.skip(place, str(e), "the mean of the image is used", "Use UV coordinates")
            value = self.images.mean(index)
            return Color.of(float(value[3])) if alpha else Color.of(*value[:3].tolist())
        rows = tuple(tuple(float(x) for x in row) for row in m)
        return Color((Term((1.0, 1.0, 1.0), (Source("image", layer, index, rows, alpha),)),))  # type: ignore[arg-type]

    def _environment(self, node: bpy.types.Node, place: Place) -> Color:
        """Environment Texture: the mean over the sphere; the rows of a latitude-longitude image weigh by the sine of their angle."""
        if node.image is None:
            self.skip(place, "has no image", "black is used", "Choose an image")
            return Color.of(0.0)
        index = self.images.read(node, "REPEAT", "Linear", False)
        if index is None:
            return Color.of(*MEAN_OF_NOTHING[:3])
        rows = self.images.row_means(index)
        weight = np.ones(len(rows))
        if node.projection == "EQUIRECTANGULAR":
            weight = np.sin(np.pi * (np.arange(len(rows)) + 0.5) / len(rows))
        value = weight @ rows[:, :3] / weight.sum()
        self.skip(place, "varies with direction", "the mean radiance of its image is used", "Use a constant colour")
        return Color.of(*value.tolist())

    def _attribute(self, node: bpy.types.Node, place: Place) -> Color:
        """Color Attribute and Attribute nodes."""
        if node.bl_idname == "ShaderNodeVertexColor":
            name = node.layer_name
        elif node.attribute_type == "GEOMETRY":
            name = node.attribute_name
        else:
            raise Unknown(f'node "{node.name}" reads an attribute of the {node.attribute_type.lower()}')
        if place.socket.name == "Vector":
            raise Unknown(f'node "{node.name}" uses an attribute as a vector')
        self.uses_default_attribute |= not name
        color = Color((Term((1.0, 1.0, 1.0), (Source("attribute", name, alpha=place.socket.name == "Alpha"),)),))
        if place.socket.name in ("Fac", "Factor"):
            self.skip(place, "uses an attribute as a number", "each of its channels is used by itself", "Use its Color output")
        return color

    def _constant(self, node: bpy.types.Node, place: Place) -> Color:
        """RGB and Value nodes."""
        return self._default(place)

    def _mix(self, node: bpy.types.Node, place: Place) -> Color:
        """Mix (colour or number) and the old MixRGB."""
        sockets = inputs(place)
        if node.bl_idname == "ShaderNodeMix":
            if node.data_type == "VECTOR" and node.factor_mode != "UNIFORM":
                raise Unknown(f'node "{node.name}" mixes vectors by a vector')
            read = self.value if node.data_type == "FLOAT" else self.color
            place_of_factor, a, b = sockets["Factor"], read(sockets["A"]), read(sockets["B"])
            kind = node.blend_type if node.data_type == "RGBA" else "MIX"
            clamp_factor, clamp = node.clamp_factor, node.clamp_result and node.data_type == "RGBA"
        else:
            first, second, third = (Place(s, place.groups) for s in list(node.inputs)[:3])  # Blender 5 renamed them
            place_of_factor, a, b = first, self.color(second), self.color(third)
            kind, clamp_factor, clamp = node.blend_type, True, node.use_clamp
        factor = self.share(place_of_factor) if clamp_factor else self.value(place_of_factor)
        out = color_nodes.blend(kind, factor, a, b)
        if out is None:
            self.skip(place, f"blends by {kind.lower().replace('_', ' ')}, which is not computed", "its first colour is used")
            out = a
        return self._clamped(out, place) if clamp else out

    def _math(self, node: bpy.types.Node, place: Place) -> Color:
        """Math: any operation on constants; sums and products of images and attributes."""
        values = [self.value(Place(s, place.groups)) for s in node.inputs if s.enabled]
        if all(v.is_constant for v in values):
            result = color_nodes.math_constant(node.operation, [v.constant[0] for v in values])
            if result is None:
                raise Unknown(f'node "{node.name}" computes {node.operation.lower()}, which is not understood')
            out = Color.of(result)
        else:
            polynomial = color_nodes.math_polynomial(node.operation, values)
            if polynomial is None:
                raise Unknown(f'node "{node.name}" computes {node.operation.lower()} of a texture, which is not understood')
            out = polynomial
        return self._clamped(out, place) if node.use_clamp else out

    def _clamped(self, color: Color, place: Place) -> Color:
        """A colour kept between 0 and 1 where that can be computed; sums of images within 0 to 1 are left as they are."""
        try:
            return mapped(color, lambda c: np.clip(c, 0.0, 1.0), self.images)
        except NotPolynomial:
            self.skip(place, "clamps a mixture of sources", "it is not clamped", "Switch clamping off")
            return color

    def _separate(self, node: bpy.types.Node, place: Place) -> Color:
        """Separate Color by red, green and blue, and the old Separate RGB, whose outputs are called R, G and B."""
        if getattr(node, "mode", "RGB") != "RGB":
            raise Unknown(f'node "{node.name}" separates a colour by {node.mode}')
        channel = "RGB".index(place.socket.name[0])
        main = next(iter(inputs(place).values()))
        return mapped(self.color(main), lambda c: np.repeat(c[:, channel : channel + 1], 3, axis=1), self.images)

    def _combine(self, node: bpy.types.Node, place: Place) -> Color:
        """Combine Color by red, green and blue, and the old Combine RGB, whose inputs are called R, G and B."""
        if getattr(node, "mode", "RGB") != "RGB":
            raise Unknown(f'node "{node.name}" combines a colour by {node.mode}')
        out = Color()
        sockets = {name[0]: socket for name, socket in inputs(place).items()}
        for name, unit in (("R", (1.0, 0.0, 0.0)), ("G", (0.0, 1.0, 0.0)), ("B", (0.0, 0.0, 1.0))):
            out = out + self.value(sockets[name]) * Color.of(*unit)
        return out


_READERS: dict[str, Callable[[Colors, bpy.types.Node, Place], Color]] = {
    "ShaderNodeTexImage": Colors._image,
    "ShaderNodeTexEnvironment": Colors._environment,
    "ShaderNodeVertexColor": Colors._attribute,
    "ShaderNodeAttribute": Colors._attribute,
    "ShaderNodeRGB": Colors._constant,
    "ShaderNodeValue": Colors._constant,
    "ShaderNodeMix": Colors._mix,
    "ShaderNodeMixRGB": Colors._mix,
    "ShaderNodeMath": Colors._math,
    "ShaderNodeSeparateColor": Colors._separate,
    "ShaderNodeSeparateRGB": Colors._separate,
    "ShaderNodeCombineColor": Colors._combine,
    "ShaderNodeCombineRGB": Colors._combine,
}
