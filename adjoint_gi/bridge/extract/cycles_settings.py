# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of Cycles that change the light of a scene and are not followed here: each is named once, with its effect.

Only what differs from Cycles' default is named. Cycles is an add-on, so its settings may be missing altogether. Kinds of rays and light
linking stand in `unsupported`.
"""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..host.notices import Notices

UNLIMITED = 1024  # Max Bounces of a lamp or world by default
BOUNCES = {  # limits of a scene and their defaults
    "max_bounces": ("Total", 12),
    "diffuse_bounces": ("Diffuse", 4),
    "glossy_bounces": ("Glossy", 4),
    "transmission_bounces": ("Transmission", 12),
    "transparent_max_bounces": ("Transparent", 8),
}
CLAMP_INDIRECT = 10.0  # by default


def name_scene_settings(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, notices: Notices) -> None:
    """Warnings for the settings of a scene and its view layer (originals)."""
    for reason, remedy in (*_sampling(scene), *_simplify(scene), *_layer(layer)):
        notices.add(f'Scene "{scene.name}"', reason, remedy)
    if scene.render.use_motion_blur:
        notices.add(f'Scene "{scene.name}"', "has motion blur, which pictures here do not show", "", "info")


def name_bounces(owner: bpy.types.Light | bpy.types.World, name: str, notices: Notices) -> None:
    """A warning for a lamp or world whose light Cycles follows over some bounces only."""
    limit = getattr(getattr(owner, "cycles", None), "max_bounces", UNLIMITED)
    if limit < UNLIMITED:
        reason = f"has Max Bounces {limit} in Cycles, which is not followed: here all of its bounces count, and shadows are brighter"
        notices.add(name, reason, f"Set it to {UNLIMITED} in Cycles to compare, or limit the path length of the method for all light")
    if not getattr(getattr(owner, "cycles", None), "use_shadows", True):
        notices.add(name, "casts no shadows in Cycles, which is not followed: here it does", "Turn its shadows on in Cycles to compare")


def name_object_settings(obj: bpy.types.Object, notices: Notices) -> None:
    """Warnings for an object with faces (original) that Cycles treats in a way of its own."""
    for switch, words in (("is_shadow_catcher", "a shadow catcher"), ("is_holdout", "a holdout")):
        if getattr(obj, switch, False):
            notices.add(obj.name, f"is {words} in Cycles, which is not followed: it counts as any object", "Turn it off to compare")


def _sampling(scene: bpy.types.Scene) -> Iterator[tuple[str, str]]:
    """Reason and remedy of what changes light paths."""
    cycles = getattr(scene, "cycles", None)
    if cycles is None:
        return
    lower = [f"{label} {getattr(cycles, p)}" for p, (label, default) in BOUNCES.items() if getattr(cycles, p, default) < default]
    if lower:
        reason = f"limits bounces in Cycles ({', '.join(lower)}), which is not followed: light goes on here, and shadows are brighter"
        yield reason, "Limit the path length of the method, or raise them in Cycles to compare"
    off = [kind for kind in ("reflective", "refractive") if not getattr(cycles, f"caustics_{kind}", True)]
    if off:
        yield f"has {' and '.join(off)} caustics turned off in Cycles; here they are computed", "Turn them on in Cycles to compare"
    if cycles.sample_clamp_direct > 0.0 or cycles.sample_clamp_indirect not in (0.0, CLAMP_INDIRECT):
        yield "clamps samples in Cycles, which takes light away there; here nothing is clamped", "Set Clamping to 0 in Cycles to compare"
    if cycles.use_fast_gi:
        yield "uses Fast GI Approximation in Cycles; here indirect light is computed", "Turn it off in Cycles to compare"
    if abs(cycles.film_exposure - 1.0) > 1e-6:
        yield f"has a film exposure of {cycles.film_exposure:.3g} in Cycles, which is not applied here", "Set it to 1 to compare"


def _simplify(scene: bpy.types.Scene) -> Iterator[tuple[str, str]]:
    """What Simplify does in Cycles alone; its levels of subdivision are those of the evaluated meshes."""
    cycles = getattr(scene, "cycles", None)
    if cycles is None or not scene.render.use_simplify:
        return
    if cycles.use_camera_cull or cycles.use_distance_cull:
        yield "leaves objects out by Simplify's culling in Cycles; here all of them count", "Turn Culling off to compare"
    if cycles.texture_limit_render != "OFF" or getattr(cycles, "texture_resolution_render", 1.0) != 1.0:
        yield "shrinks textures by Simplify in Cycles; here they keep their size", ""


def _layer(layer: bpy.types.ViewLayer) -> Iterator[tuple[str, str]]:
    """What a view layer leaves out of renders."""
    for switch, words in (("use_sky", "its world"), ("use_solid", "its surfaces")):
        if not getattr(layer, switch, True):
            yield f'leaves {words} out of renders of view layer "{layer.name}", which is not followed', "Turn it on in View Layer > Filter"
    waiting = [layer.layer_collection]
    while waiting:
        part = waiting.pop()
        waiting += [] if part.exclude else list(part.children)
        for switch, words in (("holdout", "a holdout"), ("indirect_only", "indirect only")):
            if getattr(part, switch) and not part.exclude:
                yield f'makes collection "{part.name}" {words} in renders, which is not followed: it counts as any other', ""
