# SPDX-License-Identifier: GPL-3.0-or-later
"""The numbers of the last bake, kept on the scene so that they survive saving, loading and closing."""

from __future__ import annotations

import json
from collections.abc import Iterable

import bpy

from ...core.base.errors import AdjointError, Notice
from ...core.base.text import json_text, plain
from ...core.flux.density import Given
from ...core.method.solution import Solution

__all__ = ["AdjointError", "Notice", "clear", "plain", "store"]  # operators and panels may not import the core

ROWS = 100  # objects of which is kept what they were given
SEVERITIES = (("info", "Info", "", 0), ("warning", "Warning", "", 1), ("error", "Error", "", 2))


class ADJOINTGI_PG_notice(bpy.types.PropertyGroup):
    """One sentence for the user: object, reason, remedy"""

    object: bpy.props.StringProperty()
    reason: bpy.props.StringProperty()
    remedy: bpy.props.StringProperty()
    severity: bpy.props.EnumProperty(items=SEVERITIES, default="warning")

    def notice(self) -> Notice:
        """The same as a `Notice`."""
        return Notice(self.object, self.reason, self.remedy, self.severity)


class ADJOINTGI_PG_result(bpy.types.PropertyGroup):
    """Numbers of the last bake"""

    method: bpy.props.StringProperty(description="Identifier of the method; empty when nothing was baked")
    target: bpy.props.StringProperty()
    quantity: bpy.props.StringProperty()
    seconds: bpy.props.FloatProperty()
    rays: bpy.props.StringProperty(description="A decimal number: it may exceed the integers of Blender")
    partial: bpy.props.BoolProperty(description="The bake was stopped before its end")
    has_balance: bpy.props.BoolProperty()
    emitted: bpy.props.FloatProperty(description="Flux in W, sum of the channels")
    entering: bpy.props.FloatProperty(description="Flux in W that arrives at surfaces before any reflection, sum of the channels")
    absorbed: bpy.props.FloatProperty(description="Flux in W, sum of the channels")
    escaped: bpy.props.FloatProperty(description="Flux in W, sum of the channels")
    unshot: bpy.props.FloatProperty(description="Flux in W, sum of the channels")
    gap: bpy.props.FloatProperty(description="Share of the flux that is not accounted for")
    mean: bpy.props.FloatVectorProperty(size=3, description="Mean of the quantity over the receivers")
    new_object: bpy.props.BoolProperty(description="The attribute is on objects made for it")
    applied: bpy.props.BoolProperty(default=True, description="The result was written to the objects")
    notices: bpy.props.CollectionProperty(type=ADJOINTGI_PG_notice)
    files: bpy.props.StringProperty(description="Files written, one a line")
    given: bpy.props.StringProperty(description="JSON list of what objects got of the lightmaps: name, texels a metre, share of the image")

    def lightmaps(self) -> list[tuple[str, float, float]]:
        """Name, texels a metre and share of its image of each object, the most texels first; empty where nothing sound is stored."""
        try:
            return [(str(name), float(density), float(share)) for name, density, share in json.loads(self.given or "[]")]
        except (TypeError, ValueError, RecursionError):
            return []


def store(
    record: ADJOINTGI_PG_result,
    solution: Solution,
    *,
    target: str,
    quantity: str,
    applied: bool,
    new_object: bool = False,
    files: Iterable[str] = (),
    notices: Iterable[Notice] = (),
    given: Iterable[Given] = (),
) -> None:
    """Put the numbers of `solution`, what objects were `given` of the lightmaps and `notices` into `record`."""
    clear(record)
    record.method, record.target, record.quantity = solution.method, target, quantity
    record.seconds, record.rays, record.partial = solution.seconds, str(int(solution.rays)), solution.partial
    record.applied, record.new_object = applied, new_object
    record.files = "\n".join(files)
    most = sorted(given, key=lambda part: -part.texels)[:ROWS]
    record.given = json_text([[part.object, round(part.texels_per_metre, 6), round(part.share, 6)] for part in most]) if most else ""
    if solution.balance is not None:
        b = solution.balance
        record.has_balance = True
        record.absorbed, record.escaped, record.unshot, record.gap = b.absorbed, b.escaped, b.unshot, b.gap
    record.emitted, record.entering = solution.emitted_flux, solution.entering_flux
    name = solution.whole if target == "render" else quantity
    got = solution.weight > 0
    if got.any():
        record.mean = solution.quantity(name)[got].mean(axis=0, dtype=float).tolist()
    for notice in notices:
        item = record.notices.add()
        item.object, item.reason, item.remedy, item.severity = notice.object, notice.reason, notice.remedy, notice.severity


def clear(record: ADJOINTGI_PG_result) -> None:
    """Forget everything."""
    for name in [p.identifier for p in record.bl_rna.properties if not p.is_readonly and p.identifier != "name"]:
        record.property_unset(name)
    record.notices.clear()
