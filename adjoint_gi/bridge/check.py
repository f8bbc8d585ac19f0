# SPDX-License-Identifier: GPL-3.0-or-later
"""What is missing before Bake can be pressed: looked up outside of drawing, seldom enough never to be felt."""

from __future__ import annotations

import contextlib
import time

import bpy

from ..core.errors import AdjointError, Notice
from . import jobs
from .properties import request_of

INTERVAL = 1.0  # shortest time in seconds between two checks
SHARE = 0.02  # largest share of the main thread's time that checks may take


class _Cache:
    """The notices of one scene and when they may be looked up again."""

    scene = 0  # session_uid
    notices: tuple[Notice, ...] | None = None
    next_time = 0.0


def now(context: bpy.types.Context) -> tuple[Notice, ...]:
    """Check at once. An error in the list refuses the bake."""
    from .bake import preflight

    try:
        return tuple(preflight(context, request_of(context.scene, context.view_layer)))
    except AdjointError as error:
        return (error.notice,)


def cached(scene: bpy.types.Scene) -> tuple[Notice, ...] | None:
    """What the last check of `scene` found, None before the first; a new check is scheduled when the last one is old.

    For panels: whatever changes the scene also redraws them, so drawing is a good moment to ask, and a bad one to look.
    """
    known = _Cache.scene == scene.session_uid
    if (not known or time.monotonic() >= _Cache.next_time) and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=0.05 if not known else 0.2)
    return _Cache.notices if known else None


def refresh() -> None:
    """Look in the scene of the first window and redraw if the answer has changed."""
    manager = bpy.context.window_manager
    window = bpy.context.window or next(iter(manager.windows if manager else ()), None)
    started = time.monotonic()
    with bpy.context.temp_override(window=window) if window else contextlib.nullcontext():
        context = bpy.context
        found, scene = now(context), context.scene.session_uid
    spent = time.monotonic() - started
    changed = (found, scene) != (_Cache.notices, _Cache.scene)
    _Cache.notices, _Cache.scene = found, scene
    _Cache.next_time = time.monotonic() + max(INTERVAL, spent / SHARE)
    if changed:
        jobs.redraw()


def _look() -> None:
    if not jobs.running():
        refresh()


def register() -> None:
    """Start without knowledge."""
    _Cache.scene, _Cache.notices, _Cache.next_time = 0, None, 0.0


def unregister() -> None:
    """Take the timer away if it waits."""
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
