# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene remembers of comparing: the choice of methods, budget and reference, and the table and pictures of the last run.

`Scene.adjoint_gi_compare` holds everything; one switch for each method is generated from the registry.
"""

from __future__ import annotations

from collections.abc import Mapping

import bpy
import numpy as np

from .... import solvers
from ...core.base.errors import Notice, SettingsError
from ...core.comparison.budget import STATES, Budget
from ...core.comparison.page import best_text, gap_of
from ...core.comparison.run import Result
from ...core.flux.agreement import LOUD  # noqa: F401  for the panel
from ...core.method import registry
from ...core.method.registry import MethodSpec
from ..host.versions import FOLDER
from ..props.properties import settings_of
from ..props.records import ADJOINTGI_PG_notice
from ..results import show as results
from .request import LIGHT_ONLY, CompareRequest, ReferenceChoice

BUDGETS = (
    ("time", "Equal Time", "Every method computes for as long", 0),
    ("rays", "Equal Rays", "Every method casts as many rays", 1),
    ("error", "Equal Error", "Every method computes until its error is as small", 2),
)
REFERENCES = (
    ("method", "Method", "One method, run for long", 0),
    ("cycles", "Cycles Bake", "Cycles bakes the same texels first, without Filter Glossy; Blender does not answer meanwhile", 1),
    ("constant", "Closed Form", "One known value everywhere", 2),
    ("none", "None", "No errors, only fluxes and their agreement", 3),
)
PLACES = (
    ("texture", "Texels", "Irradiance at the texels of small lightmaps", 0),
    ("camera", "Camera", "Radiance of a small picture of the scene's camera", 1),
)
PICTURE = "Adjoint GI Compare"


class ADJOINTGI_PG_compare_row(bpy.types.PropertyGroup):
    """One method of the last comparison"""

    method: bpy.props.StringProperty()
    label: bpy.props.StringProperty()
    state: bpy.props.StringProperty()
    seconds: bpy.props.FloatProperty()
    rays: bpy.props.StringProperty(description="A decimal number: it may exceed the integers of Blender")
    error: bpy.props.FloatProperty(default=-1.0, description="Relative RMSE, negative where it is not known")
    gathered: bpy.props.FloatProperty(description="Flux by Eq. 3, W")
    shot: bpy.props.FloatProperty(description="Flux by Eq. 4, W")
    has_gap: bpy.props.BoolProperty()
    gap: bpy.props.FloatProperty(description="Relative difference of the two fluxes")
    has_balance: bpy.props.BoolProperty()
    balance: bpy.props.FloatProperty(description="Share of the emitted flux that is not accounted for")
    best: bpy.props.BoolProperty()


class ADJOINTGI_PG_compare_picture(bpy.types.PropertyGroup):
    """One figure: its name is `name`"""

    image: bpy.props.PointerProperty(type=bpy.types.Image)


class ADJOINTGI_PG_compare_result(bpy.types.PropertyGroup):
    """The last comparison"""

    headline: bpy.props.StringProperty(description="Which method is best; empty when nothing was compared")
    reference: bpy.props.StringProperty()
    partial: bpy.props.BoolProperty()
    unit: bpy.props.StringProperty()
    rows: bpy.props.CollectionProperty(type=ADJOINTGI_PG_compare_row)
    pictures: bpy.props.CollectionProperty(type=ADJOINTGI_PG_compare_picture)
    lines: bpy.props.StringProperty(description="Lines of the agreement report")
    notices: bpy.props.CollectionProperty(type=ADJOINTGI_PG_notice)
    files: bpy.props.StringProperty(description="Files written, one a line")


class Choice:
    """The part of the choice that does not depend on which methods exist."""

    budget: bpy.props.EnumProperty(name="Budget", description="What all methods get the same of", items=BUDGETS, default="time")
    seconds: bpy.props.FloatProperty(name="Seconds", description="Time of each method", default=10.0, min=0.1, max=86400.0, soft_max=600.0)
    mega_rays: bpy.props.FloatProperty(
        name="Million Rays", description="Rays of each method, in millions", default=5.0, min=0.001, max=1e6, soft_max=1000.0
    )
    error: bpy.props.FloatProperty(
        name="Relative RMSE", description="Error that ends a method, as a share of the mean", default=0.05, min=1e-6, max=10.0, precision=4
    )
    limit: bpy.props.FloatProperty(
        name="Time Limit",
        description="Most seconds of each method, whatever its budget",
        default=60.0,
        min=1.0,
        max=86400.0,
        soft_max=3600.0,
    )
    reference: bpy.props.EnumProperty(name="Reference", description="What errors are measured against", items=REFERENCES, default="method")
    reference_seconds: bpy.props.FloatProperty(
        name="Its Seconds", description="How long it runs; 0 is four times the budget", default=0.0, min=0.0, max=86400.0, soft_max=3600.0
    )
    cycles_samples: bpy.props.IntProperty(
        name="Samples", description="Samples of each texel by Cycles", default=512, min=2, max=1 << 20, soft_max=8192
    )
    constant: bpy.props.FloatVectorProperty(name="Value", description="The known value of each colour", size=3, default=(1.0, 1.0, 1.0))
    receivers: bpy.props.EnumProperty(name="At", description="Where methods are compared", items=PLACES, default="texture")
    selection_only: bpy.props.BoolProperty(
        name="Selected Only", description="Compare on the selected objects; otherwise on every mesh object that is rendered", default=False
    )
    resolution: bpy.props.IntProperty(
        name="Resolution", description="Texels a side, or pixels along the longer side", default=32, min=4, max=4096, soft_max=256
    )
    folder: bpy.props.StringProperty(
        name="Folder",
        description="Where a page, JSON and PNG files are saved. Empty: nowhere",
        default="",
        subtype="DIR_PATH",
        options=FOLDER,
    )
    result: bpy.props.PointerProperty(type=ADJOINTGI_PG_compare_result)


def compared() -> tuple[MethodSpec, ...]:
    """The methods that can be ticked."""
    return tuple(m.spec for m in registry.methods() if m.spec.answers == LIGHT_ONLY)


def switch(method: str) -> str:
    """Name of the property that ticks a method."""
    return f"use_{method}"


def request_of(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> CompareRequest:
    """What the panel asks for; raises SettingsError."""
    state = scene.adjoint_gi_compare
    methods = tuple(spec.id for spec in compared() if getattr(state, switch(spec.id)))
    if not methods:
        raise SettingsError("Methods", "none is ticked", "Tick at least one")
    objects = results.selected(view_layer) if state.selection_only else ()
    if state.selection_only and not objects and state.receivers == "texture":
        raise SettingsError("Selected Only", *results.nothing_selected(view_layer))
    value = {"time": state.seconds, "rays": 1e6 * state.mega_rays, "error": state.error}[state.budget]
    limit = max(state.limit, state.seconds) if state.budget == "time" else state.limit
    reference = ReferenceChoice(
        state.reference, state.reference_method, state.reference_seconds, state.cycles_samples, tuple(state.constant)
    )
    return CompareRequest(
        methods,
        Budget(state.budget, float(value), float(limit)),
        reference,
        state.receivers,
        objects,
        state.resolution,
        {m: settings_of(scene, m) for m in {*methods, state.reference_method}},
        output=state.folder,
    )


def store(record: ADJOINTGI_PG_compare_result, result: Result, notices: list[Notice], files: list[str]) -> None:
    """Put the table and the words of `result` into `record`; pictures stay as they are."""
    record.headline, record.partial = best_text(result), result.partial
    record.reference = result.reference.label if result.reference is not None else ""
    record.unit = "W" if result.measure == "irradiance" else "W/(m² sr)"
    record.lines = "\n".join(result.agreement.lines) if result.agreement is not None else ""
    record.files = "\n".join(files)
    record.rows.clear()
    for e in sorted(result.entries, key=lambda e: float("inf") if e.error is None else e.error):
        row = record.rows.add()
        row.method, row.label, row.seconds, row.rays = e.method, e.label, e.seconds, str(e.rays)
        row.state = STATES[e.state] + ("" if e.complete else ", partial")
        row.error = -1.0 if e.error is None else e.error
        row.gathered = result.gathered(e)
        row.shot = result.shot[0] if result.shot is not None else 0.0
        gap = gap_of(result, e)
        row.has_gap, row.gap = gap is not None, gap or 0.0
        balance = e.solution.balance
        row.has_balance, row.balance = balance is not None, balance.gap if balance is not None else 0.0
        row.best = e is result.winner
    record.notices.clear()
    of_reference = result.reference.notices if result.reference is not None else ()
    shown = [*result.refused, *notices, *of_reference, *(n for e in result.entries for n in e.notices)]
    for notice in dict.fromkeys(shown):
        item = record.notices.add()
        item.object, item.reason, item.remedy, item.severity = notice.object, notice.reason, notice.remedy, notice.severity


def store_pictures(record: ADJOINTGI_PG_compare_result, pictures: Mapping[str, np.ndarray]) -> None:
    """Each figure into its image: the one that the link leads to, or a new one. They are packed into the .blend.

    `pictures` (h, w, 3) are sRGB-encoded, as the bytes of such images are.
    """
    for index in reversed(range(len(record.pictures))):
        if record.pictures[index].name not in pictures:
            record.pictures.remove(index)
    for name, pixels in pictures.items():
        entry = record.pictures.get(name) or record.pictures.add()
        entry.name = name
        height, width = pixels.shape[:2]
        image = entry.image
        if image is None or image.is_float or not image.is_editable:
            image = entry.image = bpy.data.images.new(f"{PICTURE} {name}", width, height, alpha=False)
        elif tuple(image.size) != (width, height):
            image.scale(width, height)
        rgba = np.ones((height, width, 4), np.float32)
        rgba[..., :3] = pixels
        image.pixels.foreach_set(rgba.ravel())
        image.update()
        image.pack()


def clear(record: ADJOINTGI_PG_compare_result) -> None:
    """Forget everything, and remove the pictures that nothing else uses."""
    images = [p.image for p in record.pictures if p.image is not None]
    for name in ("headline", "reference", "partial", "unit", "lines", "files"):
        record.property_unset(name)
    record.rows.clear()
    record.notices.clear()
    record.pictures.clear()
    for image in images:
        if image.users == int(image.use_fake_user):
            bpy.data.images.remove(image)


def _choice_class() -> type[bpy.types.PropertyGroup]:
    """The fixed part, a switch for each method and the menu of reference methods."""
    specs = compared()
    annotations: dict[str, object] = {
        switch(s.id): bpy.props.BoolProperty(name=s.label, description=s.idea.rstrip("."), default=not s.leaves_out) for s in specs
    }
    items = tuple((s.id, s.label, s.idea.rstrip("."), s.number) for s in specs)
    usual = ReferenceChoice.method if any(s.id == ReferenceChoice.method for s in specs) else items[0][0]
    annotations["reference_method"] = bpy.props.EnumProperty(
        name="Method", description="The method that makes the reference", items=items, default=usual
    )
    return type(
        "ADJOINTGI_PG_compare", (Choice, bpy.types.PropertyGroup), {"__annotations__": annotations, "__doc__": "Comparing of methods"}
    )


PARTS = (ADJOINTGI_PG_compare_row, ADJOINTGI_PG_compare_picture, ADJOINTGI_PG_compare_result)
_classes: list[type] = []


def register() -> None:
    """Hang the group on every scene."""
    solvers.load()
    for cls in (*PARTS, _choice_class()):
        bpy.utils.register_class(cls)
        _classes.append(cls)
    bpy.types.Scene.adjoint_gi_compare = bpy.props.PointerProperty(type=_classes[-1])


def unregister() -> None:
    """Take it off; doing it twice changes nothing."""
    if hasattr(bpy.types.Scene, "adjoint_gi_compare"):
        del bpy.types.Scene.adjoint_gi_compare
    while _classes:
        bpy.utils.unregister_class(_classes.pop())
