"""Principled BSDF of Blender 4.2 to 5.2 as lobes; sockets are looked up by name.

With alpha a, metallic m, transmission t, base colour C (each may be textured), weight x colour:
    transparent 1 - a;  emission a * colour * strength;  metallic a m x C, tinted at its edge where the specular tint is not white;
    glass a (1 - m) t x sqrt(C), dielectric a (1 - m) t x (1 - sqrt(C));
    diffuse a (1 - m) (1 - t) x C, rough where Diffuse Roughness is above 0;
    specular a (1 - m) (1 - t) x tint, a dielectric coat over the diffuse of the same node.
Like in Cycles, what passes is coloured by sqrt(C), so that two surfaces give C, and what is reflected is white: the glass lobe colours
both, and the dielectric lobe adds what its reflections lack.
Sheen, coat, thin film, anisotropy and subsurface scattering are not computed and are named when they are used.
"""

from __future__ import annotations

import math

from ...core.scene.arrays import Color, Lobe, Scalar
from ..host.versions import rough_diffuse_keeps_energy
from .colors import Colors
from .nodes import Place, inputs, is_linked

IGNORED = {
    "Subsurface Weight": "subsurface scattering, which is computed as diffuse",
    "Sheen Weight": "sheen, which is left out",
    "Coat Weight": "a coat, which is left out",
    "Anisotropic": "anisotropy, which is left out",
    "Thin Film Thickness": "a thin film, which is left out",
    "Thin Wall": "thin walls, which are computed as solid",
}


def principled_lobes(colors: Colors, place: Place, stack: int) -> list[Lobe]:
    """Lobes of the Principled node that `place` is an output of; `stack` is a number of its own for its coat and its base."""
    sockets = inputs(place)

    def value(name: str, default: float) -> Color:
        """A number from 0 to 1 that may be textured."""
        return colors.share(sockets[name]) if name in sockets else Color.of(default)

    def number(name: str, default: float) -> float:
        return colors.number(sockets[name], name.lower()) if name in sockets else default

    base = colors.color(sockets["Base Color"])
    alpha, metallic, transmission = value("Alpha", 1.0), value("Metallic", 0.0), value("Transmission Weight", 0.0)
    roughness = min(max(number("Roughness", 0.5), 0.0), 1.0)
    ior = max(number("IOR", 1.5), 1e-3)
    level = number("Specular IOR Level", 0.5)
    dielectric = alpha * metallic.complement() * transmission.complement()

    many = place.socket.node.distribution == "MULTI_GGX"
    adjusted = _adjusted_ior(ior, level)
    stack = stack if adjusted != 1.0 else 0  # no coat: the base may join others

    # Step 1: what passes through and what is emitted. The default emission strength is 0, its default colour is not.
    lobes = [Lobe("transparent", alpha.complement())]
    strength = colors.value(sockets["Emission Strength"]) if "Emission Strength" in sockets else Color.of(0.0)
    if not strength.is_black and "Emission Color" in sockets:
        lobes.append(Lobe("emission", colors.color(sockets["Emission Color"]) * strength * alpha))

    # Step 2: what is reflected.
    lobes.append(diffuse_lobe(base, number("Diffuse Roughness", 0.0), dielectric, stack))
    shines = not metallic.is_black or adjusted != 1.0
    tint = colors.color(sockets["Specular Tint"]) if shines and "Specular Tint" in sockets else Color.of(1.0)
    lobes.append(metal_lobe(base, tint, roughness, many, metallic * alpha))
    glass = alpha * metallic.complement() * transmission
    if not glass.is_black:
        root = _root(colors, place, base)
        lobes.append(Lobe("glass", root, roughness, ior, many, glass))
        lobes.append(Lobe("dielectric", root.complement(), roughness, ior, weight=glass))
    if adjusted != 1.0:
        lobes.append(Lobe("specular", tint, roughness, adjusted, weight=dielectric, stack=stack))

    # Step 3: name what is left out.
    for name, text in IGNORED.items():
        if name in sockets and (is_linked(sockets[name]) or float(sockets[name].socket.default_value) > 0.0):
            colors.skip(place, f"has {text}", "the rest is used", f"Set {name} to 0")
    if "Normal" in sockets and is_linked(sockets["Normal"]):
        colors.skip(place, "has a bump or normal map", "the mesh's own normals are used", "")
    return [lobe for lobe in lobes if not lobe.is_black]


def diffuse_lobe(color: Color, roughness: float, weight: Scalar = 1.0, stack: int = 0) -> Lobe:
    """An ideal diffuser, or with a roughness that of Oren and Nayar."""
    if not roughness > 0.0:
        return Lobe("diffuse", color, weight=weight, stack=stack)
    keeps = rough_diffuse_keeps_energy()
    return Lobe("rough diffuse", color, min(roughness, 1.0), multiscatter=keeps, weight=weight, stack=stack)


def metal_lobe(color: Color, edge: Color, roughness: float, multiscatter: bool, weight: Scalar = 1.0) -> Lobe:
    """A metal by Schlick, or where it is tinted at 82 degrees, by the F82 model; a tint above 1 counts as 1, as in Cycles."""
    if edge.is_constant and min(edge.constant) >= 1.0:
        return Lobe("metallic", color, roughness, multiscatter=multiscatter, weight=weight)
    if edge.is_constant:
        edge = Color.of(*(min(max(c, 0.0), 1.0) for c in edge.constant))
    return Lobe("tinted metallic", color, roughness, multiscatter=multiscatter, weight=weight, edge=edge)


def _root(colors: Colors, place: Place, base: Color) -> Color:
    """Square root of a colour; a texture has none that is a polynomial, so it stays and a notice says so."""
    if base.is_constant:
        return Color.of(*(math.sqrt(min(max(c, 0.0), 1.0)) for c in base.constant))
    colors.skip(place, "transmits by a texture", "each surface colours light by it, not by its square root as in Cycles", "Use one colour")
    return base


def _adjusted_ior(ior: float, level: float) -> float:
    """The index whose reflectance at normal incidence is that of `ior` times 2 * level, as Cycles adjusts it."""
    if level == 0.5:
        return ior
    f0 = min(((ior - 1.0) / (ior + 1.0)) ** 2 * 2.0 * max(level, 0.0), 0.999)
    root = math.sqrt(f0)
    adjusted = (1.0 + root) / (1.0 - root)
    return adjusted if ior >= 1.0 else 1.0 / adjusted
