"""The world: one radiance from all directions."""

from __future__ import annotations

import bpy
import numpy as np

from ...core.scene.arrays import Color, Rgb
from ..host.notices import Notices
from ..host.versions import uses_nodes
from .color_math import NotPolynomial, mean
from .colors import Colors
from .cycles_settings import name_bounces
from .nodes import is_linked
from .shaders import Shaders, surface
from .unsupported import name_world_rays

LARGEST_RADIANCE = 1e9


def read_world(world: bpy.types.World | None, colors: Colors, notices: Notices) -> Rgb:
    """Radiance (W m-2 sr-1) of the background; black without a world. What varies with direction is replaced by its mean."""
    if world is None:
        return (0.0, 0.0, 0.0)
    name = f'World "{world.name}"'
    radiance = _radiance(world, name, colors, notices)
    if any(radiance):
        name_bounces(world.original, name, notices)
        name_world_rays(world.original, name, notices)  # a change of these switches need not reach the evaluated copy (4.2)
    return radiance


def _radiance(world: bpy.types.World, name: str, colors: Colors, notices: Notices) -> Rgb:
    """The radiance of a world's colour or node tree."""
    colors.owner = name
    if not uses_nodes(world):
        return _safe(tuple(world.color), name, notices)
    place = surface(world.node_tree, "OUTPUT_WORLD")
    if place is None:
        notices.add(name, "has no output node for Cycles; it is black, as there", "Add a World Output whose target is All")
        return (0.0, 0.0, 0.0)
    volume = place.sibling("Volume")
    if volume is not None and is_linked(volume):
        notices.add(name, "has a volume, which is not computed: the air is clear", "")
    total = np.zeros(3)
    for lobe in Shaders(colors).lobes(place, Color.of(1.0)):
        if lobe.kind != "emission":
            notices.add(name, f"has a {lobe.kind} shader, which gives no light", "Use Background")
            continue
        color = lobe.color
        if not color.is_constant:
            notices.add(name, "varies with direction; the mean radiance of its images is used", "Use a constant colour")
            try:
                color = Color.of(*mean(color, colors.images))
            except NotPolynomial:
                color = Color.of(*color.constant)
        total += color.constant
    return _safe((total[0], total[1], total[2]), name, notices)


def _safe(radiance: tuple[float, ...], name: str, notices: Notices) -> Rgb:
    """Numbers from 0 to a large bound."""
    good = [min(max(float(c), 0.0), LARGEST_RADIANCE) if c == c else 0.0 for c in radiance[:3]]
    if any(abs(a - b) > 1e-6 or a != a for a, b in zip(radiance, good, strict=False)):
        notices.add(name, f"has a radiance outside 0 to {LARGEST_RADIANCE:g}; it is clamped", "Choose a sensible strength")
    return (good[0], good[1], good[2])
