"""Materials of the scene: each node tree once, made safe to compute with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import bpy
import numpy as np

from ...core.scene.arrays import Color, Lobe, Material, Term, Texture
from ...core.scene.shading import LARGEST_EMISSION
from ..host.notices import Notices
from ..host.versions import uses_nodes
from .color_math import NotPolynomial, mapped
from .colors import Colors
from .images import Images
from .nodes import Place, is_linked
from .shaders import LINEAR, Shaders, merged, surface

COAT = "specular"  # what it reflects is taken from the base below
DEFAULT = "Default"  # name of the material of faces without one


class Materials:
    """Collects materials while the objects are walked over, and reads them afterwards. `aside` as `Images` has it."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, notices: Notices, aside: bool = False) -> None:
        self.depsgraph = depsgraph
        self._override = depsgraph.view_layer.material_override
        self._notices = notices
        self._index: dict[int, int] = {}  # by the address of the material, 0 for none
        self._materials: list[Material] = []
        self.bodiless: set[int] = set()  # indices of materials that have a volume and no surface: light passes through their faces
        self.images = Images(notices, depsgraph.scene_eval.frame_current, aside)
        self.colors = Colors(self.images, notices)

    def index_of(self, material: bpy.types.Material | None) -> int:
        """Index of a material; None gives Cycles' default, grey diffuse 0.8. The view layer's override stands for every one."""
        material = self._override or material
        key = 0 if material is None else material.original.as_pointer()
        return self._index.setdefault(key, len(self._index))

    def go_on(self, over: Callable[[], bool]) -> bool:
        """Read what was met, one material after the other until `over()`; returns whether all are read. Raises `Wanted`, and goes on with
        the same material when it is called again."""
        found = {material.as_pointer(): material for material in bpy.data.materials}
        for key in list(self._index)[len(self._materials) :]:
            read = self._read(found[key].evaluated_get(self.depsgraph), len(self._materials)) if key else Material(DEFAULT)
            self._materials.append(read)
            if over():
                return False
        return True

    def result(self) -> tuple[Material, ...]:
        """All materials that were read."""
        return tuple(self._materials)

    def textures(self) -> tuple[Texture, ...]:
        """All textures that the materials refer to."""
        return tuple(self.images.textures)

    def _read(self, material: bpy.types.Material, index: int = 0) -> Material:
        self.colors.owner = f'Material "{material.name}"'
        if not uses_nodes(material):
            return Material(material.name, (self._safe(Lobe("diffuse", Color.of(*material.diffuse_color[:3]))),))
        place = surface(material.node_tree, "OUTPUT_MATERIAL")
        if place is None:
            self._tell("has no output node for Cycles; it is black, as there", "Add a Material Output whose target is All")
            return Material(material.name, ())
        if self._leftovers(place):
            self.bodiless.add(index)
            return Material(material.name, ())
        lobes = merged(Shaders(self.colors).lobes(place, Color.of(1.0)))
        if not getattr(material, "use_transparent_shadow", True) and any(lobe.kind == "transparent" for lobe in lobes):
            self._tell(
                "has Transparent Shadows turned off in Cycles, which is not followed: light passes through it", "Turn them on to compare"
            )
        return Material(material.name, self._bounded([self._safe(lobe) for lobe in lobes]))

    def _tell(self, reason: str, remedy: str) -> None:
        self._notices.add(self.colors.owner, reason, remedy)

    def _leftovers(self, place: Place) -> bool:
        """Name volume and displacement, which are not computed; returns whether there is a volume and no surface."""
        has = {name for name in ("Volume", "Displacement") if (socket := place.sibling(name)) is not None and is_linked(socket)}
        if "Displacement" in has:
            self._tell("has displacement, which is not computed: the mesh is taken as it is", "Use a Displace modifier")
        if "Volume" in has and is_linked(place):
            self._tell("has a volume, which is not computed: light passes inside it as through air", "")
        elif "Volume" in has:
            self._tell("has a volume and no surface: light passes through as if it were not there, without mist or smoke", "")
        return "Volume" in has and not is_linked(place)

    def _safe(self, lobe: Lobe) -> Lobe:
        """The lobe with numbers that can be computed with: albedo 0 to 1, emission 0 to a large bound, no NaN."""
        emission = lobe.kind == "emission"
        top = LARGEST_EMISSION if emission else 1.0
        word = "emission" if emission else "albedo"
        color, weight = self._safe_color(lobe.color, top, word), self._safe_color(Color.of(1.0) * lobe.weight, LARGEST_EMISSION, "amount")
        roughness, ior = lobe.roughness if math.isfinite(lobe.roughness) else 1.0, lobe.ior if math.isfinite(lobe.ior) else 1.45
        return replace(lobe, color=color, weight=weight.constant[0] if weight.is_constant else weight, roughness=roughness, ior=ior)

    def _safe_color(self, color: Color, top: float, word: str) -> Color:
        """A colour between 0 and `top`; `word` says what it is."""
        if not color.is_constant:
            return self._safe_textured(color, top, word)
        clamped = tuple(_clamp(c, top) for c in color.constant)
        if any(abs(a - b) > 1e-6 or a != a for a, b in zip(color.constant, clamped, strict=True)):
            self._tell(f"has an {word} outside 0 to {top:g}; it is clamped", f"Choose an {word} of 0 to {top:g}")
        return Color.of(*clamped)

    def _safe_textured(self, color: Color, top: float, word: str) -> Color:
        """Textured colours: no infinite constants, and single images that leave the range are clamped."""
        terms = tuple(Term(tuple(_clamp_signed(c) for c in t.constant), t.sources) for t in color.terms)  # type: ignore[arg-type]
        color = Color(terms)
        if any(s.kind != "image" for t in terms for s in t.sources) or len(terms) > 1 or len(terms[0].sources) > 1:
            return color
        source = terms[0].sources[0]
        ranges = self.images.ranges(source.texture)
        values = np.array(terms[0].constant) * (ranges[:, 3:] if source.alpha else ranges[:, :3])
        if values.min() < 0.0 or values.max() > top + 1e-4:
            self._tell(f"has an {word} outside 0 to {top:g} in its image; it is clamped", f"Use an image within 0 to {top:g}")
            try:
                return mapped(color, lambda c: np.clip(c, 0.0, top), self.images)
            except NotPolynomial:
                return color
        return color

    def _bounded(self, lobes: list[Lobe]) -> tuple[Lobe, ...]:
        """All lobes together must not reflect and pass more than they receive: constants over 1 are scaled down with a notice."""
        totals = {False: np.zeros(3), True: np.zeros(3)}
        for lobe in lobes:
            if lobe.kind != "emission" and lobe.share.is_constant:
                totals[lobe.kind == COAT] += lobe.share.constant
        worst = float(max(total.max() for total in totals.values()))
        if worst <= 1.0 + 1e-5:
            return tuple(lobe for lobe in lobes if not lobe.is_black)
        self._tell(
            f"reflects and passes {worst:.3g} times what it receives; it is scaled down to 1", "Use Mix Shader instead of Add Shader"
        )
        out = [x if x.kind == "emission" else replace(x, weight=x.weight * (1.0 / worst)) for x in lobes]
        return tuple(lobe for lobe in (replace(x, color=x.share, weight=1.0) if x.kind in LINEAR else x for x in out) if not lobe.is_black)


def _clamp(x: float, top: float) -> float:
    return min(max(x, 0.0), top) if x == x else 0.0


def _clamp_signed(x: float) -> float:
    return min(max(x, -LARGEST_EMISSION), LARGEST_EMISSION) if x == x else 0.0
