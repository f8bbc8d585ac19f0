# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: thin classes over the bridge."""

from __future__ import annotations

import bpy

from . import background, bake, compare, demo, result

PARTS = (background, bake, result, demo, compare)
register, unregister = bpy.utils.register_classes_factory([cls for part in PARTS for cls in part.classes])
