# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels show, wherever they stand. Nothing here computes or writes; everything about methods comes from their specs."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.baking import check
from ..adjoint_gi.bridge.baking.jobs import BAKES, BakeJob
from ..adjoint_gi.bridge.host import background
from ..adjoint_gi.bridge.host.background import Job
from ..adjoint_gi.bridge.props.properties import MethodSpec, chosen, group_name, method_label, own_and_common, quadrant
from ..adjoint_gi.bridge.props.records import Notice
from ..adjoint_gi.bridge.results.real import may_become_mesh, standing_for
from . import text

NARROW = 400  # pixels; a sidebar is less wide
SEEN = 1.0  # seconds from which on a check that is under way is shown
CRAMPED = 260  # pixels; names stand above their values
OUTPUT = {  # what each target uses
    "texture": ("target", "quantity", "selection_only", "instances", "resolution", "atlas", "uv_layer", "denoise", "folder"),
    "attribute": ("target", "quantity", "selection_only", "instances", "attribute", "domain", "new_object", "denoise"),
    "render": ("target", "denoise", "folder"),
}
ICONS = {"info": "INFO", "warning": "ERROR", "error": "CANCEL"}


def choice(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Strategy, nature, method, and what the method is."""
    state = context.scene.adjoint_gi
    column = layout.column()
    column.enabled = not BAKES.running
    for name in ("strategy", "nature"):
        words = [item.name for item in state.bl_rna.properties[name].enum_items]
        _beside(column, context, words).prop(state, name, expand=True)
    solver = chosen(context.scene)
    if solver is None:
        text.label(layout, context, f"No method is both {state.strategy} and {state.nature}", "INFO")
        return
    column.prop(state, quadrant(state.strategy, state.nature), text="")
    taxonomy(layout, context, solver.spec)


def taxonomy(layout: bpy.types.UILayout, context: bpy.types.Context, spec: MethodSpec) -> None:
    """Year, authors, equation, idea and what it cannot do; read only."""
    column = layout.box().column(align=True)
    text.label(column, context, f"{spec.authors}, {spec.year}", "USER", 1)
    text.label(column, context, spec.equation, "CON_TRANSFORM", 1)
    column.separator(factor=0.5)
    text.label(column, context, spec.idea, "INFO", 1)
    # Long lists can be folded, so that what follows stays in sight.
    header, body = layout.panel("ADJOINTGI_limits")
    header.label(text="Cannot Do")
    if body:
        column = body.column(align=True)
        for limit in spec.limits:
            text.label(column, context, limit, "X", 1)


def settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The settings that only the chosen method has."""
    _settings(layout, context, 0)


def common_settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The settings of the chosen method that every method has."""
    _settings(layout, context, 1)


def _settings(layout: bpy.types.UILayout, context: bpy.types.Context, which: int) -> None:
    solver = chosen(context.scene)
    if solver is None:
        return
    _form(layout)
    group = getattr(context.scene.adjoint_gi, group_name(solver.spec.id))
    column = layout.column()
    for name in own_and_common(solver)[which]:
        _entry(column, context, group, name)


def _form(layout: bpy.types.UILayout) -> None:
    """Names on the left, values on the right, locked while a bake runs."""
    layout.use_property_split = True
    layout.use_property_decorate = False
    layout.enabled = not BAKES.running


def _wider(context: bpy.types.Context, pixels: int) -> bool:
    """Whether the region is wider than that many pixels at Blender's resolution scale of 1."""
    return bool(context.region) and context.region.width > pixels * context.preferences.system.ui_scale


def _beside(layout: bpy.types.UILayout, context: bpy.types.Context, words: list[str]) -> bpy.types.UILayout:
    """Where buttons with these words go: beside each other, or below each other where that would cut words off."""
    return layout.row(align=True) if text.fits(context, words, 1 / len(words)) else layout.column(align=True)


def _entry(layout: bpy.types.UILayout, context: bpy.types.Context, data: bpy.types.PropertyGroup, name: str) -> None:
    """One property, placed as the width allows."""
    if _wider(context, NARROW):  # Blender's own way leaves enough for both
        layout.prop(data, name)
    else:
        field(layout, context, data, name)


def field(layout: bpy.types.UILayout, context: bpy.types.Context, data: bpy.types.PropertyGroup, name: str) -> None:
    """One property in a narrow region."""
    item = data.bl_rna.properties[name]
    if item.type == "BOOLEAN":
        place = layout.column()
        if _wider(context, CRAMPED):
            place = place.split(factor=0.12)
            place.label(text="")
        place.use_property_split = False
        place.prop(data, name)
    else:
        # A menu has an arrow beside its words; large numbers have as many digits.
        values = [f"{i.name}    " for i in item.enum_items] if item.type == "ENUM" else ["" if item.type == "STRING" else "0000000000"]
        _value(layout, context, item.name, values).prop(data, name, text="")


def _value(layout: bpy.types.UILayout, context: bpy.types.Context, name: str, values: list[str]) -> bpy.types.UILayout:
    """Where the value called `name` goes, which may be any of `values`: the name is on the left and gets half of the width, as
    Blender's two fifths cut long names off, or above where even that is too little for one of them."""
    if _wider(context, CRAMPED) and text.fits(context, [name], 0.52) and text.fits(context, values, 0.48):
        split = layout.split(factor=0.52)
        left = split.row()
        left.alignment = "RIGHT"
    else:
        left = split = layout.column(align=True)
    left.label(text=name)
    split.use_property_split = False
    return split


def output(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is written, and where to; only what the target uses."""
    state = context.scene.adjoint_gi
    _form(layout)
    column = layout.column()
    for name in OUTPUT[state.target]:
        mesh = context.object.data if context.object and context.object.type == "MESH" else None
        if name == "uv_layer" and mesh is not None:
            place, words = (column, "UV Layer") if _wider(context, NARROW) else (_value(column, context, "UV Layer", []), "")
            place.prop_search(state, "uv_layer", mesh, "uv_layers", text=words, icon="GROUP_UVS")
        else:
            _entry(column, context, state, name)


def texels(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is seldom changed about a texture."""
    _form(layout)
    column = layout.column()
    for name in ("texels_per_metre", "margin", "subsamples"):
        _entry(column, context, context.scene.adjoint_gi, name)
    owner = standing_for(context.object) if context.object is not None else None
    if owner is not None and (owner.type == "MESH" or may_become_mesh(owner)):
        _entry(column, context, owner, "adjoint_gi_density")
    column.operator("adjoint_gi.renew_uvs", icon="UV_DATA")


def film(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Transparency of a picture's background."""
    layout.use_property_split = True
    layout.use_property_decorate = False
    layout.prop(context.scene.render, "film_transparent", text="Transparent")


def looking(layout: bpy.types.UILayout) -> None:
    """How far a check of the scene is that takes long enough to be seen."""
    under_way = check.under_way()
    if under_way is None or under_way.seconds < SEEN:
        return
    row = layout.row(align=True)
    row.progress(factor=under_way.fraction, text=f"Checking: {under_way.text}")
    row.operator("adjoint_gi.stop_check", text="", icon="X")


def bake(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is missing, the buttons, and how far the bake is."""
    job = BAKES.job
    elsewhere = background.elsewhere(job.scene, context.scene) if job is not None else ""
    if job is not None and job.active:
        driver = job.driver
        done = "" if job.preparing else f", {text.count(driver.rays)} rays"
        lines = [driver.text, f"{text.duration(driver.seconds)}{done}"]
        running(layout, context, job, "Baking", lines, "adjoint_gi.stop")
        return
    found = check.cached(context.scene)
    notices = [n for n in found or () if n.severity != "info"]
    boxed(layout, context, notices)
    looking(layout)
    row = layout.row(align=True)
    row.scale_y = 1.4
    start = row.row(align=True)
    start.enabled = not any(n.severity == "error" for n in notices)
    start.operator("adjoint_gi.bake", icon="RENDER_STILL" if context.scene.adjoint_gi.target == "render" else "NONE")
    if job is not None and job.resumable and not elsewhere:
        row.operator("adjoint_gi.resume")
    if job is None or job.state == "finished" and not job.notices:
        return
    if elsewhere:
        # Its objects and its panel are in that scene: Continue and Write Result are offered there.
        if job.state == "stopped" and not job.preparing:
            text.label(layout, context, f"Stopped at {100 * job.driver.fraction:.0f} % in scene {elsewhere}", "INFO")
        elif job.solution is not None:
            text.label(layout, context, f"A result waits to be written in scene {elsewhere}", "INFO")
        return
    _ended(layout, context, job, notices)


def running(layout: bpy.types.UILayout, context: bpy.types.Context, job: Job, doing: str, lines: list[str], stop: str) -> None:
    """How far a job is, in `lines` below the bar, and the button of the operator `stop`; `doing` is what it does, for another scene."""
    driver = job.driver
    left = f", {text.duration(driver.seconds_left)} left" if driver.seconds_left is not None else ""
    layout.progress(factor=driver.fraction, text=f"{100 * driver.fraction:.0f} %{left}")
    other = background.elsewhere(job.scene, context.scene)
    if other:
        text.label(layout, context, f"{doing} in scene {other}", "SCENE_DATA")
    column = layout.column(align=True)
    for line in lines:
        text.label(column, context, line)
    row = layout.row()
    row.scale_y = 1.4
    row.enabled = job.state == "running"
    row.operator(stop, text="Stop" if job.state == "running" else "Stopping...")


def _ended(layout: bpy.types.UILayout, context: bpy.types.Context, job: BakeJob, shown: list[Notice]) -> None:
    """The state in which the bake ended; the notices `shown` are on the panel already."""
    driver = job.driver
    if job.state == "stopped" and not job.preparing:  # how far a stopped preparation was is nothing to go on from
        layout.progress(factor=driver.fraction, text=f"Stopped at {100 * driver.fraction:.0f} %")
    boxed(layout, context, [n for n in job.notices if n not in shown])
    if job.solution is not None:
        layout.operator("adjoint_gi.write")


def boxed(layout: bpy.types.UILayout, context: bpy.types.Context, notices: list[Notice]) -> None:
    """All `notices` in one box; nothing where there are none."""
    if notices:
        box = layout.box()
        for item in notices:
            notice(box, context, item)


def notice(layout: bpy.types.UILayout, context: bpy.types.Context, item: Notice) -> None:
    """One line of the check: object and reason, the remedy below."""
    column = layout.column(align=True)
    text.label(column, context, f"{item.object}: {item.reason}" if item.object else item.reason, ICONS[item.severity], 1)
    if item.remedy:
        text.label(column, context, item.remedy, "BLANK1", 1)


def result(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The numbers of the last bake and what can be done with it."""
    record = context.scene.adjoint_gi.result
    layout.use_property_split = True
    if record.partial:
        text.label(layout, context, "Partial result: the bake was stopped before its end", "ERROR")
    # What the Bake panel shows of the last bake is not shown again.
    job = BAKES.job
    shown = job.notices if job is not None and not job.active and not background.elsewhere(job.scene, context.scene) else []
    paths = [path for path in record.files.splitlines() if not any(path in item.reason for item in shown)]
    if not record.applied and paths:
        text.label(layout, context, "Kept as a file, not written to the objects", "ERROR")
    rows: list[tuple[str, str]] = [
        ("Method", method_label(record.method)),
        ("Time", text.duration(record.seconds)),
        ("Rays", text.count(int(record.rays or 0))),
    ]
    potential = record.method == "potential"
    unit = "" if potential else "W/(m² sr)" if record.target == "render" else "W/m²"
    name = record.quantity.title() if record.target != "render" else "Potential" if potential else "Radiance"
    rows.append((f"Mean {name}", f"{sum(record.mean) / 3:.4g} {unit}".rstrip()))
    if record.has_balance:
        rows += [
            ("Emitted", text.watts(record.emitted)),
            ("Entering", text.watts(record.entering)),
            ("Absorbed", text.watts(record.absorbed)),
            ("Escaped", text.watts(record.escaped)),
        ]
        if record.unshot:
            rows.append(("Not Yet Shot", text.watts(record.unshot)))
        rows.append(("Balance Gap", text.percent(record.gap)))
    elif record.emitted:
        # A gathering method follows no light from its source, so where it goes is not known.
        rows += [("Emitted", text.watts(record.emitted)), ("Entering", text.watts(record.entering))]
    table(layout, context, rows)
    told = (*shown, *(check.cached(context.scene) or ()))  # above the button
    warnings = [i.notice() for i in record.notices if i.severity != "info" and i.notice() not in told]
    boxed(layout, context, warnings)
    given(layout, context, record)
    for path in paths:
        text.label(layout, context, path, "FILE_IMAGE")
    if record.target != "render":
        row = _beside(layout, context, ["Show Result", "Restore Materials"])
        row.operator("adjoint_gi.show_result")
        row.operator("adjoint_gi.restore")
    layout.operator("adjoint_gi.clear_results")


def given(layout: bpy.types.UILayout, context: bpy.types.Context, record: bpy.types.PropertyGroup) -> None:
    """What objects got of the lightmaps, folded: texels a metre and, where several share an image, their share of it."""
    parts = record.lightmaps()
    if not parts:
        return
    header, body = layout.panel("ADJOINTGI_given", default_closed=True)
    shared = any(share < 1.0 for _, _, share in parts)
    header.label(text="Texels per Metre" + (", Share of Image" if shared else ""))
    if body:
        table(body, context, [(name, f"{density:.3g}" + (f", {100 * share:.3g} %" if shared else "")) for name, density, share in parts])


def table(layout: bpy.types.UILayout, context: bpy.types.Context, rows: list[tuple[str, str]]) -> None:
    """Names on the left, values on the right; lines that are broken where that would cut words off."""
    column = layout.column(align=True)
    beside = text.fits(context, [r[0] for r in rows], 0.45) and text.fits(context, [r[1] for r in rows], 0.55)
    if beside:
        column.scale_y = 0.85
    for name, value in rows:
        if not beside:
            whole = f"{name}: {value}"
            text.label(column, context, whole if text.fits(context, [whole]) else f"{name}:\n{value}")
            continue
        split = column.split(factor=0.45)
        split.label(text=name)
        split.label(text=value)
