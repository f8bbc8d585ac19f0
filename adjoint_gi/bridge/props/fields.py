# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender properties made from the fields of a settings dataclass, and the values read back from them."""

from __future__ import annotations

import dataclasses
import zlib
from typing import Any

import bpy
import numpy as np

from ...core.base.settings import Settings, field_type

INT_RANGE = (-(2**31), 2**31 - 1)
# Units of a settings field that Blender knows as a subtype, with the unit it shows.
SUBTYPES = {"distance": "LENGTH", "angle": "ROTATION", "time": "TIME", "factor": "NONE", "percentage": "NONE", "pixel": "NONE"}


def blender_property(f: dataclasses.Field) -> Any:
    """The Blender property for one settings field: label, tooltip, bounds and unit are the field's own."""
    meta, kind = f.metadata, field_type(f)
    words = {"name": meta["label"], "description": meta["help"].rstrip(".")}
    if kind is bool:
        return bpy.props.BoolProperty(default=f.default, **words)
    if kind is str and meta["choices"]:
        return bpy.props.EnumProperty(items=enum_items(meta["choices"]), default=f.default, **words)
    if kind is str:
        return bpy.props.StringProperty(default=f.default, **words)
    bounds = {key: meta[key] for key in ("min", "max", "soft_max") if meta[key] is not None}
    if kind is int:
        bounds = {key: int(np.clip(value, *INT_RANGE)) for key, value in bounds.items()}
        return bpy.props.IntProperty(default=f.default, **bounds, **words)
    if kind is tuple:
        return bpy.props.FloatVectorProperty(default=f.default, subtype="COLOR", **bounds, **words)
    unit = meta["unit"].lower()
    if unit in SUBTYPES:
        words |= {"subtype": unit.upper(), "unit": SUBTYPES[unit]}
    return bpy.props.FloatProperty(default=f.default, precision=_precision(f), **bounds, **words)


def enum_items(choices: tuple[tuple[str, str, str], ...]) -> tuple[tuple[str, str, str, int], ...]:
    """Enum items whose numbers follow from the identifiers, so that a .blend file survives new choices and a new order."""
    return tuple((name, label, text.rstrip("."), zlib.crc32(name.encode()) & 0x7FFFFFFF) for name, label, text in choices)


def _precision(f: dataclasses.Field) -> int:
    """Digits after the point, so that a small default is not shown as 0.000."""
    size = min((abs(x) for x in (f.default, f.metadata["min"] or 0) if x), default=1.0)
    return int(np.clip(2 - np.floor(np.log10(size)), 3, 6))


def group_class(name: str, settings: type[Settings], label: str) -> type[bpy.types.PropertyGroup]:
    """A PropertyGroup class called `name` with one property for each field of `settings`."""
    annotations = {f.name: blender_property(f) for f in dataclasses.fields(settings)}
    return type(name, (bpy.types.PropertyGroup,), {"__annotations__": annotations, "__doc__": f"Settings of {label}"})


def values(group: bpy.types.PropertyGroup, settings: type[Settings]) -> Settings:
    """The settings that `group` holds; raises `SettingsError` where they contradict each other.

    Blender stores float32: 0.001 comes back as 0.00100000005, so the shortest decimal that means the same float32 is taken.
    """
    out = {}
    for f in dataclasses.fields(settings):
        value = getattr(group, f.name)
        if field_type(f) is tuple:
            value = tuple(_shortest(x) for x in value)
        out[f.name] = _shortest(value) if field_type(f) is float else value
    return settings(**out)


def _shortest(x: float) -> float:
    return float(str(np.float32(x)))
