# SPDX-License-Identifier: GPL-3.0-or-later
"""A reference made on the spot: Cycles bakes the same texels of the same objects, and leaves the scene as it was.

A diffuse bake of direct and indirect light without colour is irradiance / pi. Cycles samples inside the one triangle that covers a
texel's centre, and only the middle half of the texel, so texels that lie on one triangle altogether are used; on finer meshes, where
these are few, those that lie on one plane. Where light is sharp the two differ by a part of a texel. Its bounce limit counts surfaces
after the baked one: path length - 1.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence

import bpy
import numpy as np

from ...core.base.errors import Notice, TargetError
from ...core.comparison.budget import Reference
from ...core.receivers.texels import Lightmap
from ...core.scene.world import World
from ..baking.textures import Sheet
from ..baking.writer import find_objects
from ..host.versions import uses_nodes
from ..results.image import read_pixels
from ..results.real import in_place

FEW = 0.25  # share of texels on one triangle below which those on one plane serve too
BASES = ("diffuse", "rough diffuse")  # what coats lie over
NAMED = 3  # materials
HALVES = 2  # bakes with different seeds, whose difference gives the noise
# Nothing that changes the mean, and no more light paths than ours.
PLAIN = {
    "device": "CPU",
    "use_adaptive_sampling": False,
    "use_denoising": False,
    "use_fast_gi": False,
    "use_guiding": False,
    "blur_glossy": 0.0,
    "sample_clamp_direct": 0.0,
    "sample_clamp_indirect": 0.0,
    "light_sampling_threshold": 0.0,
    "caustics_reflective": True,
    "caustics_refractive": True,
    "time_limit": 0.0,
}
BOUNCES = ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces", "transparent_max_bounces")


def bake_reference(
    context: bpy.types.Context, world: World, sheets: Sequence[Sheet], count: int, samples: int, max_length: int
) -> Reference:
    """Irradiance of the texels of `sheets`, `count` in all, with `samples` a texel and paths of up to `max_length` segments.

    Blocks until Cycles is done. Objects that Cycles cannot bake as they are get no reference, and a notice says so.
    Raises TargetError when none is left.
    """
    began = time.perf_counter()
    values = np.zeros((HALVES, count, 3))
    valid = np.zeros(count, bool)
    notices = list(coat_notices(world))
    objects = [find_objects(sheet.uids, sheet.name)[0] for sheet in sheets]
    with _cycles(context.scene, max_length), in_place(objects, context.view_layer):
        for obj, sheet in zip(objects, sheets, strict=True):
            problem = _problem(obj)
            if problem:
                notices.append(Notice(obj.name, f"{problem}, so Cycles cannot bake it and it has no reference", "", "warning"))
                continue
            for half in range(HALVES):
                image = _bake(context, obj, sheet, max(1, samples // HALVES), 1000 + half)
                values[half, sheet.part] = image.reshape(-1, 3)[sheet.lightmap.pixel]
            valid[sheet.part] = comparable(world, sheet.lightmap)
    if not valid.any():
        raise TargetError("Cycles", "has no texel that can be compared", "Raise the resolution, or choose another reference")
    noise = float(np.sqrt((0.25 * (values[0] - values[1])[valid] ** 2).mean()) / max(values[:, valid].mean(), 1e-300))
    label = f"Cycles bake, {samples} samples"
    return Reference(label, values.mean(axis=0), valid, noise, time.perf_counter() - began, tuple(notices))


def coat_notices(world: World) -> tuple[Notice, ...]:
    """Says that Cycles and we differ below coats, where the scene has any (docs/cycles-differences.md has the table)."""
    used = [world.scene.materials[i] for i in np.unique(world.scene.material)]
    coated = [m.name for m in used if any(x.kind == "specular" and not x.is_black for x in m.lobes) and not m.total(*BASES).is_black]
    if not coated:
        return ()
    reason = (
        "has a base that Cycles dims by the angle of view alone: rooms of it get 2 to 3 % less there of lamps that shine straight at walls"
    )
    listed = ", ".join(coated[:NAMED]) + (f" and {len(coated) - NAMED} more" if len(coated) > NAMED else "")
    return (Notice(listed, reason, "Nothing is wrong; set Specular IOR Level to 0 to compare without", "info", names=tuple(coated)),)


def _problem(obj: bpy.types.Object) -> str:
    """Why Cycles cannot bake `obj` without a change that could not be taken back, "" when it can."""
    slots = [s.material for s in obj.material_slots]
    if not slots or None in slots:
        return "has no material, or an empty material slot"
    if any(m.node_tree is None or not uses_nodes(m) for m in slots):
        return "has a material without nodes"
    if any(m.library is not None or m.override_library is not None for m in slots):
        return "has a material that is linked from another file"
    return ""


def comparable(world: World, lightmap: Lightmap) -> np.ndarray:
    """(n,) bool: texels whose points lie on one triangle; where these are fewer than FEW, on one plane."""
    receivers = lightmap.receivers
    first = receivers.start[:-1]
    full = lightmap.whole
    one = full & (np.minimum.reduceat(receivers.triangle, first) == np.maximum.reduceat(receivers.triangle, first))
    if one.mean() >= FEW:
        return one
    normal = world.rows[receivers.triangle, 9:12]
    owner = np.repeat(np.arange(receivers.count), np.diff(receivers.start))
    along = np.einsum("ij,ij->i", normal, normal[first][owner])
    return full & (np.minimum.reduceat(along, first) > 0.9999)


def _bake(context: bpy.types.Context, obj: bpy.types.Object, sheet: Sheet, samples: int, seed: int) -> np.ndarray:
    """(h, w, 3) float64 irradiance of one object."""
    context.scene.cycles.samples, context.scene.cycles.seed = samples, seed
    lightmap = sheet.lightmap
    image = bpy.data.images.new("Adjoint GI Cycles", lightmap.width, lightmap.height, alpha=False, float_buffer=True)
    try:
        image.colorspace_settings.name = "Non-Color"
        with _targets(obj, image), context.temp_override(active_object=obj, object=obj, selected_objects=[obj]):
            bpy.ops.object.bake(
                type="DIFFUSE",
                pass_filter={"DIRECT", "INDIRECT"},
                margin=0,
                use_clear=True,
                use_selected_to_active=False,
                use_cage=False,
                target="IMAGE_TEXTURES",
                save_mode="INTERNAL",
                uv_layer=sheet.uv_layers[0],
            )
        return read_pixels(image)[..., :3].astype(np.float64) * np.pi
    except RuntimeError as error:
        raise TargetError(obj.name, f"Cycles could not bake it ({str(error).strip()})", "Choose another reference") from None
    finally:
        bpy.data.images.remove(image)


@contextlib.contextmanager
def _targets(obj: bpy.types.Object, image: bpy.types.Image) -> Iterator[None]:
    """An active image node in every material of `obj`; afterwards nodes, selection and active node are as before."""
    made = []
    try:
        for material in {s.material.session_uid: s.material for s in obj.material_slots}.values():
            nodes = material.node_tree.nodes
            before = (nodes.active, [n for n in nodes if n.select])
            node = nodes.new("ShaderNodeTexImage")
            made.append((nodes, node, *before))
            node.image = image
            nodes.active = node
        yield
    finally:
        for nodes, node, active, selected in made:
            nodes.remove(node)
            for other in nodes:
                other.select = other in selected
            nodes.active = active


@contextlib.contextmanager
def _cycles(scene: bpy.types.Scene, max_length: int) -> Iterator[None]:
    """Cycles as the engine, without tricks; afterwards the scene's settings are as before."""
    engine = scene.render.engine
    before: dict[str, object] = {}
    try:
        scene.render.engine = "CYCLES"
    except TypeError:
        raise TargetError("Cycles", "is not enabled", "Enable it in the preferences, or choose another reference") from None
    cycles = scene.cycles
    wanted = PLAIN | dict.fromkeys(BOUNCES, max(0, min(max_length, 1024) - 1)) | {"samples": 1, "seed": 0}
    try:
        for name, value in wanted.items():
            if hasattr(cycles, name):  # versions differ in what they have
                was_set = cycles.is_property_set(name)
                before[name] = (was_set, getattr(cycles, name))
                setattr(cycles, name, value)
        yield
    finally:
        for name, (was_set, value) in before.items():
            setattr(cycles, name, value) if was_set else cycles.property_unset(name)
        scene.render.engine = engine
