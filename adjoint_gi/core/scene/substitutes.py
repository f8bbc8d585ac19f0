"""How a method that knows only diffuse surfaces takes the other lobes; reflections of a coat or of clear glass are left out."""

from __future__ import annotations

from math import pi

from .arrays import Color, Lobe, Material, constant_of

AS_DIFFUSE = ("diffuse", "rough diffuse", "metallic", "glossy", "glass", "refraction", "transparent")


def as_diffuse(material: Material, kinds: tuple[str, ...] = AS_DIFFUSE) -> Color:
    """The summed albedo of the lobes of these kinds."""
    out = Color()
    for lobe in material.lobes:
        if lobe.kind in kinds:
            out = out + (rough_diffuse_albedo(lobe) if lobe.kind == "rough diffuse" else lobe.color)
    return out


def rough_diffuse_albedo(lobe: Lobe) -> Color:
    """What a rough diffuse lobe reflects of uniform light. Where roughness or tint vary, its colour, which is up to 7 % more at 0.8."""
    tint = lobe.tint or lobe.color
    if lobe.varies or not tint.is_constant:
        return lobe.color
    once = rough_diffuse_share(constant_of(lobe.roughness))
    rho = [min(max(c, 0.0), 1.0) for c in tint.constant]
    again = [once * (1 - once) * x * x / (1 - x * (1 - once)) if lobe.multiscatter else 0.0 for x in rho]
    return lobe.color * Color.of(*(once + x for x in again))


def rough_diffuse_share(roughness: float) -> float:
    """Share of uniform light that facets of the model of `bsdf/oren_nayar.py` reflect at the first bounce, if they are white."""
    return (pi + roughness * (2 * pi - 5.6) / 3) / (pi + roughness * (pi / 2 - 2 / 3))
