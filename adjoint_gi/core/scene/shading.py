"""Colours at points: evaluates the materials' colour polynomials, with one table look-up where they are constant."""

from __future__ import annotations

import numpy as np

from ..base.errors import Notice
from .arrays import STRAIGHT, Color, Material, Scalar, SceneArrays, Source, constant_of
from .substitutes import as_diffuse
from .texture import sample_texture

LARGEST_EMISSION = 1e9  # W m-2 sr-1; its square still fits in float32


class Shading:
    """Albedo and emission of every triangle, constant or textured."""

    def __init__(self, scene: SceneArrays) -> None:
        self.scene = scene
        self._material = np.asarray(scene.material, np.int32)
        self._albedo = ColorField([as_diffuse(m) for m in scene.materials], scene)
        self._emission = ColorField([m.total("emission") for m in scene.materials], scene)

    @property
    def emission_colors(self) -> list[Color]:
        """Of each material, not clamped."""
        return self._emission.colors

    @property
    def albedo_varies(self) -> bool:
        """Whether the reflectance varies inside a triangle."""
        return bool(self._albedo.varying)

    @property
    def emission_varies(self) -> bool:
        """Whether the emission varies inside a triangle."""
        return bool(self._emission.varying)

    def albedo(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 diffuse reflectance clamped to 0..1."""
        return np.clip(self._albedo.at(triangle, u, v), np.float32(0), np.float32(1))

    def emission(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 emitted radiance clamped to 0..`LARGEST_EMISSION`, W m-2 sr-1."""
        return np.clip(self._emission.at(triangle, u, v), np.float32(0), np.float32(LARGEST_EMISSION))

    def emissive(self) -> np.ndarray:
        """(nt,) bool: triangles that may emit."""
        may = np.array([not m.total("emission").is_black for m in self.scene.materials] or [False])
        return may[self._material] if len(self._material) else np.zeros(0, bool)

    def substitutions(self, lobes: frozenset[str]) -> tuple[Notice, ...]:
        """What a method that solves only `lobes` replaces, as one notice for each material in use."""
        out = []
        for index in np.unique(self._material):
            material: Material = self.scene.materials[index]
            other = sorted({x.kind for x in material.lobes if not x.is_black} - lobes - {"emission", "diffuse", STRAIGHT})
            if other:
                reason = f"{', '.join(other)} taken as diffuse by this method"
                out.append(Notice(f"Material {material.name}", reason, "Choose a method that handles it, or accept the substitute"))
        return tuple(dict.fromkeys(out))


class ColorField:
    """One colour for each material, with the constant ones in a table."""

    def __init__(self, colors: list[Color], scene: SceneArrays) -> None:
        self.colors = colors
        self.scene = scene
        self._material = np.asarray(scene.material, np.int32)
        self.table = np.array([c.constant for c in colors] or [(0.0, 0.0, 0.0)], np.float32)
        self.varying = [i for i, c in enumerate(colors) if not c.is_constant]
        self.is_varying = np.array([not c.is_constant for c in colors] or [False])
        self.by_triangle = self.table[self._material] if len(self._material) else self.table[:0]

    def at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 values at barycentrics of triangles."""
        values = self.by_triangle[triangle]
        if not self.varying:
            return values
        material = self._material[triangle]
        for index in self.varying:
            which = np.flatnonzero(material == index)
            if len(which):
                values[which] = evaluate(self.colors[index], self.scene, triangle[which], u[which], v[which])
        return values


class ScalarField:
    """One number for each material, with the constant ones in a table, clipped to `low`..`high`."""

    def __init__(self, values: list[Scalar], scene: SceneArrays, low: float, high: float) -> None:
        self.values = values
        self.scene = scene
        self.low, self.high = low, high
        self.varying = [i for i, x in enumerate(values) if isinstance(x, Color) and not x.is_constant]
        constants = [constant_of(x) for x in values]
        self.table = np.clip(np.array(constants, np.float32), np.float32(low), np.float32(high))

    def at(self, material: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) float32 values at barycentrics of triangles of `material` (n,)."""
        out = self.table[material]
        for index in self.varying:
            which = np.flatnonzero(material == index)
            if len(which):
                value = evaluate(self.values[index], self.scene, triangle[which], u[which], v[which])[:, 0]
                out[which] = np.clip(value, self.low, self.high)
        return out

    def range(self, index: int) -> tuple[float, float]:
        """The least and the largest value that a material may have."""
        if index not in self.varying:
            return float(self.table[index]), float(self.table[index])
        total = np.zeros(2)
        for term in self.values[index].terms:
            ends = np.full(2, term.constant[0])
            for source in term.sources:
                products = np.outer(ends, source_range(source, self.scene))
                ends = np.array([products.min(), products.max()])
            total += ends
        low, high = np.clip(total, self.low, self.high)
        return float(low), float(high)


def source_range(source: Source, scene: SceneArrays) -> tuple[float, float]:
    """The least and the largest value of the first channel of an image or attribute, where objects have it."""
    clipped = False
    if source.kind == "image":
        texture = scene.textures[source.texture]
        arrays, clipped = [texture.ranges], texture.extension == "CLIP"
    else:
        arrays = [obj.colors[source.name] for obj in scene.objects if source.name in obj.colors]
    values = [a[..., 3 if source.alpha else 0] for a in arrays if a.size]
    ends = [0.0] if clipped or not values else []
    return min([*ends, *(float(x.min()) for x in values)]), max([*ends, *(float(x.max()) for x in values)])


def evaluate(color: Color, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) float32 value of a colour polynomial at barycentrics of triangles."""
    total = np.zeros((len(triangle), 3), np.float32)
    for term in color.terms:
        product = np.broadcast_to(np.asarray(term.constant, np.float32), total.shape)
        for source in term.sources:
            product = product * source_at(source, scene, triangle, u, v)
        total += product
    return total


def source_at(source: Source, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) float32 value of one image or colour attribute; an object without the layer gives 0 (UV) or black (attribute)."""
    if source.kind == "image":
        values = sample_texture(scene.textures[source.texture], image_coordinates(source, scene, triangle, u, v))
    else:
        values = _layer_at(source, scene, triangle, u, v)
    return np.repeat(values[:, 3:4], 3, axis=1) if source.alpha else values[:, :3]


def image_coordinates(source: Source, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 2) float32 where an image is looked up."""
    m = np.asarray(source.transform, np.float32)
    return _layer_at(source, scene, triangle, u, v) @ m[:, :2].T + m[:, 2]


def _layer_at(source: Source, scene: SceneArrays, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 2) float32 UVs or (n, 4) float32 colours of the layer of a source."""
    layer = "uvs" if source.kind == "image" else "colors"
    width = 2 if layer == "uvs" else 4
    values = np.zeros((len(triangle), width), np.float32)
    owner = scene.object[triangle]
    for index in np.unique(owner):
        obj = scene.objects[index]
        name = source.name or (obj.render_uv if layer == "uvs" else "")
        data = getattr(obj, layer).get(name)
        if data is None:
            continue
        which = np.flatnonzero(owner == index)
        corner = data[triangle[which] - obj.first_triangle]
        a, b = u[which, None], v[which, None]
        values[which] = corner[:, 0] * (1 - a - b) + corner[:, 1] * a + corner[:, 2] * b
    return values
