# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels show, wherever they stand. Nothing here computes or writes; everything about methods comes from their specs."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge import check, jobs
from ..adjoint_gi.bridge.properties import MethodSpec, chosen, group_name, method_label, own_and_common, quadrant
from ..adjoint_gi.bridge.records import Notice
from . import text

NARROW = 400  # pixels; a sidebar is less wide
ICONS = {"info": "INFO", "warning": "ERROR", "error": "CANCEL"}


def choice(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Strategy, nature, method, and what the method is."""
    state = context.scene.adjoint_gi
    column = layout.column()
    column.enabled = not jobs.running()
    column.row().prop(state, "strategy", expand=True)
    column.row().prop(state, "nature", expand=True)
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
            text.label(column, context, limit, "X")


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
        if context.region and context.region.width > NARROW * context.preferences.system.ui_scale:
            column.prop(group, name)
        else:
            field(column, group, name)


def _form(layout: bpy.types.UILayout) -> None:
    """Names on the left, values on the right, locked while a bake runs."""
    layout.use_property_split = True
    layout.use_property_decorate = False
    layout.enabled = not jobs.running()


def field(layout: bpy.types.UILayout, data: bpy.types.PropertyGroup, name: str) -> None:
    """One property in a narrow region: its name on the left gets half of the width, as Blender's two fifths cut long names off."""
    item = data.bl_rna.properties[name]
    switch = item.type == "BOOLEAN"
    split = layout.split(factor=0.12 if switch else 0.52)
    left = split.row()
    left.alignment = "RIGHT"
    left.label(text="" if switch else item.name)
    split.use_property_split = False
    split.prop(data, name, text=item.name if switch else "")


def output(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is written, and where to; only what the target uses."""
    state = context.scene.adjoint_gi
    _form(layout)
    layout.prop(state, "target")
    if state.target != "render":
        layout.prop(state, "quantity")
        layout.prop(state, "selection_only")
    column = layout.column()
    if state.target == "texture":
        column.prop(state, "resolution")
        column.prop(state, "atlas")
        mesh = context.object.data if context.object and context.object.type == "MESH" else None
        if mesh is not None:
            column.prop_search(state, "uv_layer", mesh, "uv_layers", icon="GROUP_UVS")
        else:
            column.prop(state, "uv_layer", icon="GROUP_UVS")
    elif state.target == "attribute":
        column.prop(state, "attribute")
        column.prop(state, "domain")
        solver = chosen(context.scene)
        made = "New Object (Elements)" if solver is not None and solver.spec.uses_elements else "New Object (Evaluated Mesh)"
        column.prop(state, "new_object", text=made)
    if state.target != "attribute":
        layout.prop(state, "folder")


def texels(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is seldom changed about a texture."""
    _form(layout)
    layout.prop(context.scene.adjoint_gi, "margin")
    layout.prop(context.scene.adjoint_gi, "subsamples")


def bake(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What is missing, the buttons, and how far the bake is."""
    job = jobs.current()
    if job is not None and job.active:
        _running(layout, job)
        return
    found = check.cached(context.scene)
    notices = [n for n in found or () if n.severity != "info"]
    if notices:
        box = layout.box()
        for item in notices:
            notice(box, context, item)
    row = layout.row(align=True)
    row.scale_y = 1.4
    start = row.row(align=True)
    start.enabled = not any(n.severity == "error" for n in notices)
    start.operator("adjoint_gi.bake", icon="RENDER_STILL" if context.scene.adjoint_gi.target == "render" else "NONE")
    if job is not None and job.state == "stopped" and not job.notices:
        row.operator("adjoint_gi.resume")
    if job is None or job.state == "finished" and not job.notices:
        return
    _ended(layout, context, job)


def _running(layout: bpy.types.UILayout, job: jobs.Job) -> None:
    driver = job.bake.driver
    left = f", {text.duration(driver.seconds_left)} left" if driver.seconds_left is not None else ""
    layout.progress(factor=driver.fraction, text=f"{100 * driver.fraction:.0f} %{left}")
    column = layout.column(align=True)
    column.scale_y = 0.8
    column.label(text=driver.text)
    column.label(text=f"{text.duration(driver.seconds)}, {text.count(driver.rays)} rays")
    row = layout.row()
    row.scale_y = 1.4
    row.enabled = job.state == "running"
    row.operator("adjoint_gi.stop", text="Stop" if job.state == "running" else "Stopping...")


def _ended(layout: bpy.types.UILayout, context: bpy.types.Context, job: jobs.Job) -> None:
    driver = job.bake.driver
    if job.state == "stopped":
        layout.progress(factor=driver.fraction, text=f"Stopped at {100 * driver.fraction:.0f} %")
    if job.notices:
        box = layout.box()
        for item in job.notices:
            notice(box, context, item)
    if job.solution is not None:
        layout.operator("adjoint_gi.write")


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
    if not record.applied:
        text.label(layout, context, "Kept as a file, not written to the objects", "ERROR")
    rows: list[tuple[str, str]] = [
        ("Method", method_label(record.method)),
        ("Time", text.duration(record.seconds)),
        ("Rays", text.count(int(record.rays or 0))),
    ]
    potential = record.method == "potential"
    unit = "" if potential else "W/m² sr" if record.target == "render" else "W/m²"
    name = record.quantity.title() if record.target != "render" else "Potential" if potential else "Radiance"
    rows.append((f"Mean {name}", f"{sum(record.mean) / 3:.4g} {unit}".rstrip()))
    if record.has_balance:
        rows += [
            ("Emitted", text.watts(record.emitted)),
            ("Absorbed", text.watts(record.absorbed)),
            ("Escaped", text.watts(record.escaped)),
        ]
        if record.unshot:
            rows.append(("Not Yet Shot", text.watts(record.unshot)))
        rows.append(("Balance Gap", text.percent(record.gap)))
    elif record.emitted:
        # A gathering method follows no light from its source, so what becomes of it is not known.
        rows.append(("Emitted", text.watts(record.emitted)))
    table(layout, rows)
    warnings = [i.notice() for i in record.notices if i.severity != "info"]
    if warnings:
        box = layout.box()
        for item in warnings:
            notice(box, context, item)
    for path in record.files.splitlines():
        text.label(layout, context, path, "FILE_IMAGE")
    if record.target != "render":
        row = layout.row(align=True)
        row.operator("adjoint_gi.show_result")
        row.operator("adjoint_gi.restore")
    layout.operator("adjoint_gi.clear_results")


def table(layout: bpy.types.UILayout, rows: list[tuple[str, str]]) -> None:
    """Names on the left, values on the right."""
    column = layout.column(align=True)
    column.scale_y = 0.85
    for name, value in rows:
        split = column.split(factor=0.45)
        split.label(text=name)
        split.label(text=value)
