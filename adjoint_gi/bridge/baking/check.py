# SPDX-License-Identifier: GPL-3.0-or-later
"""What is missing before Bake can be pressed: looked up outside of drawing, seldom enough never to be felt."""

from __future__ import annotations

import contextlib
import time
import traceback

import bpy

from ...core.base.errors import AdjointError, Notice
from ..host import background
from ..props.properties import request_of
from ..props.request import BakeRequest
from .jobs import BAKES
from .preflight import look, preflight

INTERVAL = 1.0  # shortest time in seconds between two checks
QUIET = 0.4  # seconds without a change before a check
SHARE = 0.02  # largest share of the main thread's time that checks may take


class _Cache:
    """The notices of one scene and when they may be looked up again."""

    scene = 0  # session_uid
    request: BakeRequest | Notice | None = None  # what was checked
    notices: tuple[Notice, ...] | None = None
    next_time = 0.0
    full_time = 0.0  # when the scene may be extracted again
    changed_at = 0.0  # when the scene changed last
    dirty = True


def now(context: bpy.types.Context) -> tuple[Notice, ...]:
    """Check at once. An error in the list refuses the bake."""
    return _check(context, _request(context))


def _request(context: bpy.types.Context) -> BakeRequest | Notice:
    """What the panel asks for, or why it asks for nothing."""
    try:
        return request_of(context.scene, context.view_layer)
    except AdjointError as error:
        return error.notice


def _check(context: bpy.types.Context, request: BakeRequest | Notice, full: bool = True) -> tuple[Notice, ...]:
    if isinstance(request, Notice):
        return (request,)
    try:
        return tuple(preflight(context, request) if full else look(context, request))
    except AdjointError as error:
        return (error.notice,)
    except Exception as error:  # an error of a timer is not shown, and the panel would look as if nothing were wrong
        traceback.print_exc()
        return (Notice("Check", f"failed with {type(error).__name__}: {error}", "Report this with the scene", "error"),)


def cached(scene: bpy.types.Scene) -> tuple[Notice, ...] | None:
    """What the last check of `scene` found, None before the first; a new check is scheduled when the last one is old.

    For panels: whatever changes the scene also redraws them, so drawing is a good moment to ask, and a bad one to look.
    """
    known = _Cache.scene == scene.session_uid
    if (not known or time.monotonic() >= _Cache.next_time) and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=0.05 if not known else 0.2)
    return _Cache.notices if known else None


def refresh() -> None:
    """Look in the present scene, unless nothing has changed since the last look, and redraw if the answer is another."""
    # As it is in a timer: `temp_override` with a window and threads at work would crash Blender, see `background.push_undo`.
    context, started = bpy.context, time.monotonic()
    request, scene = _request(context), context.scene.session_uid
    _Cache.next_time = started + INTERVAL
    if (request, scene) == (_Cache.request, _Cache.scene) and not _Cache.dirty:
        return
    # Reading the whole scene takes long in big scenes, so it is done less often than what is known at once.
    full = started >= _Cache.full_time
    found = _check(context, request, full)
    if full:
        ended = time.monotonic()
        _Cache.full_time = ended + (ended - started) / SHARE
    changed = (found, scene) != (_Cache.notices, _Cache.scene)
    _Cache.request, _Cache.notices, _Cache.scene, _Cache.dirty = request, found, scene, not full
    if changed:
        background.redraw()


def _look() -> float | None:
    if BAKES.running:
        return None
    # Not while something is being dragged or typed: every change puts the check off.
    quiet = time.monotonic() - _Cache.changed_at
    if quiet < QUIET:
        return QUIET - quiet + 0.01
    refresh()
    return None


@bpy.app.handlers.persistent
def _changed(*_: object) -> None:
    """Something in the scene is not as it was when it was checked. Nothing may be read or written here but this note."""
    _Cache.dirty, _Cache.changed_at = True, time.monotonic()


def register() -> None:
    """Start without knowledge."""
    _Cache.scene, _Cache.request, _Cache.notices, _Cache.next_time, _Cache.dirty = 0, None, None, 0.0, True
    _Cache.full_time = 0.0
    bpy.app.handlers.depsgraph_update_post.append(_changed)


def unregister() -> None:
    """Take the timer away if it waits, and the handler."""
    with contextlib.suppress(ValueError):
        bpy.app.handlers.depsgraph_update_post.remove(_changed)
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
