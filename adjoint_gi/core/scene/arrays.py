"""Plain arrays that describe a scene: what `extract` makes and the `World` is built from. Nothing here knows Blender."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..base.errors import Notice
from .texture import Texture

Rgb = tuple[float, float, float]


class RayKind:
    """What a ray is cast for, one bit each: from the camera, scattered by a diffuse or by any other lobe, through a surface, to a light."""

    CAMERA, DIFFUSE, GLOSSY, TRANSMISSION, SHADOW = (np.uint8(1 << bit) for bit in range(5))
    ALL = np.uint8(31)


@dataclass(frozen=True)
class Source:
    """A number that varies over a surface: an image through a UV layer, or a colour attribute.

    `texture` indexes `SceneArrays.textures` when `kind` is "image". `name` is the UV layer ("" for the layer used for
    rendering) or the attribute. `transform` maps (u, v, 1) to image coordinates. `alpha` reads the alpha channel.
    """

    kind: str  # "image" or "attribute"
    name: str = ""
    texture: int = -1
    transform: tuple[Rgb, Rgb] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    alpha: bool = False


@dataclass(frozen=True)
class Term:
    """`constant` times the product of its sources."""

    constant: Rgb
    sources: tuple[Source, ...] = ()


@dataclass(frozen=True)
class Color:
    """A colour over a surface: a sum of products, which is what Mix, Add and Multiply of images and constants come to."""

    terms: tuple[Term, ...] = ()

    @staticmethod
    def of(r: float, g: float | None = None, b: float | None = None) -> Color:
        """A constant colour; one number makes it grey."""
        rgb = (float(r), float(r if g is None else g), float(r if b is None else b))
        return Color((Term(rgb),))

    @property
    def is_constant(self) -> bool:
        """Whether it is the same everywhere."""
        return not any(t.sources for t in self.terms)

    @property
    def constant(self) -> Rgb:
        """The sum of the constant terms."""
        rgb = [sum(t.constant[c] for t in self.terms if not t.sources) for c in range(3)]
        return (rgb[0], rgb[1], rgb[2])

    @property
    def is_black(self) -> bool:
        """Whether it is zero everywhere for certain."""
        return all(not any(t.constant) for t in self.terms)

    def __add__(self, other: Color) -> Color:
        if self.is_constant and other.is_constant:
            a, b = self.constant, other.constant
            return Color.of(a[0] + b[0], a[1] + b[1], a[2] + b[2])
        return Color(self.terms + other.terms)

    def __mul__(self, other: Color | float) -> Color:
        if not isinstance(other, Color):
            other = Color.of(other)
        terms = []
        for a in self.terms:
            for b in other.terms:
                rgb = tuple(x * y for x, y in zip(a.constant, b.constant, strict=True))
                if any(rgb):
                    terms.append(Term(rgb, a.sources + b.sources))
        return Color(tuple(terms))

    __rmul__ = __mul__

    def complement(self) -> Color:
        """One minus this colour."""
        return Color.of(1.0) + self * -1.0


Scalar = float | Color  # a number that is the same everywhere, or a colour over the surface of which the first channel counts
WHITE_AT_GRAZING = frozenset({"metallic", "tinted metallic"})  # kinds of lobes that reflect even where their colour is black


def constant_of(x: Scalar) -> float:
    """The number; of one that varies, its constant part."""
    return x.constant[0] if isinstance(x, Color) else x


@dataclass(frozen=True)
class Lobe:
    """One term of a BSDF (or an emission): `weight` times what a surface of `color` scatters (or emits).

    kinds: diffuse, rough diffuse, emission; metallic, tinted metallic, specular (a dielectric coat), glossy, glass, refraction,
    transparent, and dielectric, which is what glass reflects without what it passes.
    color: of the surface itself, of which Fresnel's terms and what bounces again between microfacets are computed.
    weight: the share that it has in a mix, from 0 to 1; one that varies is grey.
    roughness (0 to 1) and ior may vary over the surface, too.
    multiscatter: light that bounces more than once between microfacets is kept (metallic, glossy, glass and rough diffuse).
    stack: a coat lies over the diffuse and rough diffuse lobes of its own stack, whose weight it shares, and over no others.
    edge: by what a tinted metal's reflectance is multiplied at 82 degrees, 0 to 1; other kinds have none.
    """

    kind: str
    color: Color
    roughness: Scalar = 1.0
    ior: Scalar = 1.45
    multiscatter: bool = False
    weight: Scalar = 1.0
    stack: int = 0
    edge: Color = Color.of(1.0)

    @property
    def share(self) -> Color:
        """Its colour times its weight."""
        return self.color * self.weight

    @property
    def is_black(self) -> bool:
        """Whether it does nothing for certain: no weight, or no colour, with which a metal still reflects at grazing angles."""
        weightless = self.weight.is_black if isinstance(self.weight, Color) else not self.weight
        return weightless or (self.color.is_black and self.kind not in WHITE_AT_GRAZING)

    @property
    def is_even(self) -> bool:
        """Whether it is the same everywhere."""
        return self.share.is_constant and self.edge.is_constant and not self.varies

    @property
    def varies(self) -> bool:
        """Whether its shape, roughness or index, is not the same everywhere."""
        return any(isinstance(x, Color) and not x.is_constant for x in (self.roughness, self.ior))


STRAIGHT = "transparent"  # the kind of lobe that lets light straight through


@dataclass(frozen=True)
class Material:
    """A surface: the sum of its lobes. Emission is radiance in W m-2 sr-1 from both sides."""

    name: str
    lobes: tuple[Lobe, ...] = (Lobe("diffuse", Color.of(0.8)),)

    def total(self, *kinds: str) -> Color:
        """The summed colour of the lobes of these kinds, each times its weight."""
        out = Color()
        for lobe in self.lobes:
            if lobe.kind in kinds:
                out = out + lobe.share
        return out


@dataclass(frozen=True)
class Light:
    """A lamp, already in radiometric units.

    `color` is radiant intensity (W sr-1) along the axis for "point" and "spot", radiance (W m-2 sr-1) for "area",
    irradiance on a facing surface (W m-2) for "sun". The lamp shines along -`axis_z`. An area lamp has full sizes
    `size_x`, `size_y` along `axis_x`, `axis_y` and shines on one side. A `radius` makes a point or spot a sphere
    of radiance intensity / (pi radius^2). Angles are full angles in radians.

    Measured against Cycles 4.2, 5.0 and 5.2 (tests/blender/test_extract_lights.py):
    - soft_falloff (Blender's default for point and spot): not a sphere but a disk of that radius and radiance which faces each
      receiver, so that a facing receiver at distance d sees intensity / (d^2 + radius^2).
    - spot: the intensity towards direction w is `color` * t^2 (3 - 2 t), t = (c - e) / ((1 - e) spot_blend) clamped to 0..1, where
      e = cos(spot_angle / 2) and c is the cosine of the angle to -`axis_z` of w after its components along `axis_x` and `axis_y`
      were divided by `spot_scale` (an object scaled unevenly has an elliptical cone). spot_blend 0 is a hard edge.
      With a radius, w is the direction from the sampled point of the sphere or disk to the receiver.
    - area: the radiance at angle a to its normal is `color` * max(tan(h) - tan(a), 0) / (tan(h) - h), h = spread / 2,
      and `color` for spread = pi.
    - sun: the radiance of its disk is `color` / (pi sin^2(angle / 2)).
    - camera: whether pictures show it, straight and through what lets light straight through; mirrors show it anyway.
    """

    name: str
    kind: str  # point, spot, sun, area
    color: Rgb
    position: Rgb = (0.0, 0.0, 0.0)
    axis_x: Rgb = (1.0, 0.0, 0.0)
    axis_y: Rgb = (0.0, 1.0, 0.0)
    axis_z: Rgb = (0.0, 0.0, 1.0)
    radius: float = 0.0
    shape: str = "RECTANGLE"  # or ELLIPSE
    size_x: float = 0.0
    size_y: float = 0.0
    spread: float = float(np.pi)
    angle: float = 0.0  # of the sun's disk
    spot_angle: float = float(np.pi)
    spot_blend: float = 0.0
    spot_scale: tuple[float, float] = (1.0, 1.0)
    soft_falloff: bool = False
    shadow: bool = True
    camera: bool = True


@dataclass(frozen=True)
class Camera:
    """A perspective or orthographic camera. `frame` is (left, right, bottom, top) at distance 1, or in metres when orthographic.

    With an `aperture_radius` (m) it has a round thin lens in the plane through `position`, sharp in the plane `focus_distance` (m)
    before it along `forward`; a radius of 0 is a pinhole.
    """

    kind: str  # perspective or orthographic
    position: Rgb
    right: Rgb
    up: Rgb
    forward: Rgb
    frame: tuple[float, float, float, float]
    width: int
    height: int
    clip_start: float = 0.0
    clip_end: float = float("inf")
    aperture_radius: float = 0.0
    focus_distance: float = 10.0


@dataclass(frozen=True, eq=False)
class ObjectArrays:
    """One object or instance and its stretch of the triangle arrays.

    `uvs` maps layer to (nt, 3, 2) float32, `colors` maps attribute to (nt, 3, 4) float32 scene-linear, per triangle corner.
    `selected` (nt,) bool tells the triangles of selected faces, None where that is not known.
    """

    name: str  # unique and stable: "Cube", or "Cube[0.3]" for an instance
    source: str  # the Blender object that owns the mesh
    uid: int = 0  # its session_uid
    instance: tuple[int, ...] = ()  # empty for the object itself
    first_triangle: int = 0
    triangle_count: int = 0
    first_vertex: int = 0
    vertex_count: int = 0
    corner_count: int = 0
    polygon_count: int = 0
    uvs: dict[str, np.ndarray] = field(default_factory=dict)
    render_uv: str = ""
    colors: dict[str, np.ndarray] = field(default_factory=dict)
    selected: np.ndarray | None = None
    maker: str = ""  # the object that makes the instance
    terminator: float = 0.1  # cosine below which shadow rays of smooth faces are lifted (`scene.terminator`); 0: nowhere

    @property
    def triangles(self) -> slice:
        """Its stretch of the triangle arrays."""
        return slice(self.first_triangle, self.first_triangle + self.triangle_count)


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """Everything that is solved, in metres and world space, owning its memory.

    vertices        (nv, 3) float64
    triangles       (nt, 3) int32, wound so that the cross product of its edges is the outward normal (mirrored objects too)
    corner_normals  (nt, 3, 3) float32, unit, world space
    smooth          (nt,) bool: shade with the interpolated corner normals
    material        (nt,) int32 index into `materials`
    object          (nt,) int32 index into `objects`
    polygon         (nt,) int32 polygon of the object's evaluated mesh
    corners         (nt, 3) int32 corner (loop) of the object's evaluated mesh
    background      radiance of the world
    visibility      (number of objects,) uint8, the bits of `RayKind` that meet each object; None: all meet all. Extraction from Blender
                    does not fill it yet
    """

    vertices: np.ndarray
    triangles: np.ndarray
    corner_normals: np.ndarray
    smooth: np.ndarray
    material: np.ndarray
    object: np.ndarray
    polygon: np.ndarray
    corners: np.ndarray
    materials: tuple[Material, ...]
    objects: tuple[ObjectArrays, ...]
    textures: tuple[Texture, ...] = ()
    lights: tuple[Light, ...] = ()
    background: Rgb = (0.0, 0.0, 0.0)
    camera: Camera | None = None
    warnings: tuple[Notice, ...] = ()
    visibility: np.ndarray | None = None
