# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators: thin classes over the bridge."""

from __future__ import annotations

import bpy

from . import bake, compare, demo, result

register, unregister = bpy.utils.register_classes_factory((*bake.classes, *result.classes, *demo.classes, *compare.classes))
