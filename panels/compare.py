# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Compare" of the tab: tick methods, choose one budget and a reference, run; a table, the agreement, the pictures."""

from __future__ import annotations

import bpy

from ..adjoint_gi.bridge.comparison import records as compare_records
from ..adjoint_gi.bridge.comparison.job import COMPARISONS
from ..adjoint_gi.bridge.host.background import busy, elsewhere
from ..adjoint_gi.bridge.props.records import plain
from . import text
from .base import Tab
from .draw import boxed, field, running


def choice(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Methods, budget, reference, receivers; only what is used."""
    state = context.scene.adjoint_gi_compare
    layout = layout.column()
    layout.enabled = not busy()
    layout.use_property_decorate = False
    ticks = layout.box().column(align=True)
    for spec in compare_records.compared():
        ticks.prop(state, compare_records.switch(spec.id))
    column = layout.column()
    field(column, context, state, "budget")
    field(column, context, state, {"time": "seconds", "rays": "mega_rays", "error": "error"}[state.budget])
    if state.budget != "time":
        field(column, context, state, "limit")
    column.separator()
    field(column, context, state, "reference")
    for name in {"method": ("reference_method", "reference_seconds"), "cycles": ("cycles_samples",), "constant": ("constant",)}.get(
        state.reference, ()
    ):
        field(column, context, state, name)
    column.separator()
    field(column, context, state, "receivers")
    field(column, context, state, "resolution")
    if state.receivers == "texture":
        field(column, context, state, "selection_only")
    field(column, context, state, "folder")


def run(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button, or how far it is."""
    job = COMPARISONS.job
    if job is not None and job.active:
        running(layout, context, job, "Comparing", [job.driver.text], "adjoint_gi.stop_comparing")
        return
    row = layout.row()
    row.scale_y = 1.4
    row.operator("adjoint_gi.compare")
    if job is not None and not elsewhere(job.scene, context.scene):
        boxed(layout, context, job.notices)


def result(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Which method is best, one box a method, what agrees, the pictures."""
    record = context.scene.adjoint_gi_compare.result
    if record.partial:
        text.label(layout, context, "Partial: it was stopped before its end", "ERROR")
    text.label(layout, context, record.headline, "SOLO_ON")
    if record.reference:
        text.label(layout, context, f"Reference: {record.reference}", "BLANK1")
    for row in record.rows:
        method(layout, context, row, record.unit)
    for line in record.lines.splitlines():
        box = layout.box()
        loud = line.startswith(compare_records.LOUD)
        box.alert = loud
        text.label(box, context, line, "ERROR" if loud else "CHECKMARK" if line.startswith("Agree") else "INFO", 1)
    for entry in record.pictures:
        row = layout.row()
        row.operator("adjoint_gi.show_comparison", text=entry.name.title(), icon="IMAGE_DATA").picture = entry.name
    boxed(layout, context, [item.notice() for item in record.notices])
    for path in record.files.splitlines()[:2]:
        text.label(layout, context, path, "FILE")
    layout.operator("adjoint_gi.clear_comparison")


def method(layout: bpy.types.UILayout, context: bpy.types.Context, row: bpy.types.PropertyGroup, unit: str) -> None:
    """Error, seconds, rays, fluxes with their gap, and energy balance of one method."""
    box = layout.box()
    head = box.row()
    head.label(text=row.label, icon="SOLO_ON" if row.best else "DOT")
    right = head.row()
    right.alignment = "RIGHT"
    right.label(text=f"{plain(100 * row.error, 3)} %" if row.error >= 0 else "-")
    column = box.column(align=True)
    column.scale_y = 0.8
    text.label(column, context, f"{text.duration(row.seconds)}, {text.count(int(row.rays or 0))} rays, {row.state}", indent=1)
    flux = f"{'Flux' if unit == 'W' else 'Mean radiance, colours summed,'} {row.gathered:.4g} {unit}"
    if row.has_gap:
        flux = f"Flux gathered {row.gathered:.4g} {unit}, shot {row.shot:.4g} {unit}, gap {plain(100 * row.gap, sign='+')} %"
    if row.has_balance:
        flux += f"; energy gap {text.percent(row.balance)}"
    text.label(column, context, flux, indent=1)


class ADJOINTGI_PT_compare(Tab, bpy.types.Panel):
    """Methods side by side within one budget"""

    bl_label = "Compare"
    bl_parent_id = "ADJOINTGI_PT_main"
    bl_options = {"DEFAULT_CLOSED"}
    parts = (choice, run)


class ADJOINTGI_PT_compare_result(Tab, bpy.types.Panel):
    """The last comparison"""

    bl_label = "Comparison"
    bl_parent_id = "ADJOINTGI_PT_compare"
    parts = (result,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether methods were compared."""
        return bool(context.scene.adjoint_gi_compare.result.headline)


CLASSES = (ADJOINTGI_PT_compare, ADJOINTGI_PT_compare_result)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
