# SPDX-License-Identifier: GPL-3.0-or-later
"""What is missing before Bake can be pressed: looked up outside of drawing, seldom enough never to be felt.

What Blender's data say of each object is looked up at once; what needs the extracted scene in slices, as a bake is prepared.
"""

from __future__ import annotations

import time
import traceback

import bpy

from ...core.base.errors import AdjointError, Notice
from ..host import background
from ..host.preparation import Preparation, Stages
from ..props.properties import request_of
from ..props.request import BakeRequest
from .preflight import look, preflight, preflighting

INTERVAL = 1.0  # shortest time in seconds between two checks
QUIET = 0.4  # seconds without a change before a check
SHARE = 0.02  # largest share of the time that checks of the extracted scene may take
STEP = 0.05  # seconds between two slices of a check


class _Cache:
    """The notices of one scene and when they may be looked up again."""

    scene = 0  # session_uid
    request: BakeRequest | Notice | None = None  # what was checked
    notices: tuple[Notice, ...] | None = None
    next_time = 0.0
    full_time = 0.0  # when the scene may be extracted again
    changed_at = 0.0  # when the scene changed last
    dirty = True
    running: Preparation | None = None  # a check of the extracted scene that is under way
    began = 0.0  # when it was begun
    stopping = False  # whether it is to end as soon as its thread lets go


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
    except Exception as error:
        return (_said_of(error),)


def _said_of(error: BaseException) -> Notice:
    """What is said of an error: one of a timer is not shown, and the panel would look as if nothing were wrong."""
    if isinstance(error, AdjointError):
        return error.notice
    traceback.print_exception(error)
    return Notice("Check", f"failed with {type(error).__name__}: {error}", "Report this with the scene", "error")


def cached(scene: bpy.types.Scene) -> tuple[Notice, ...] | None:
    """What the last check of `scene` found, None before the first; a new check is scheduled when the last one is old.

    For panels: whatever changes the scene also redraws them, so drawing is a good moment to ask, and a bad one to look.
    """
    known = _Cache.scene == scene.session_uid
    if (not known or time.monotonic() >= _Cache.next_time) and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=0.05 if not known else 0.2)
    return _Cache.notices if known else None


def refresh() -> None:
    """Look in the present scene, unless nothing has changed since the last look, and redraw if the answer is another.

    What needs the extracted scene is begun, and goes on by `advance`; until then the panel shows what it knew, unless an error is new.
    """
    # As it is in a timer: `temp_override` with a window and threads at work would crash Blender, see `background.push_undo`.
    context, started = bpy.context, time.monotonic()
    request, scene = _request(context), context.scene.session_uid
    _Cache.next_time = started + INTERVAL
    if (request, scene) == (_Cache.request, _Cache.scene) and not _Cache.dirty:
        return
    found = _check(context, request, full=False)
    # Reading the whole scene takes long in big scenes, so it is done less often than what is known at once.
    due = started >= _Cache.full_time
    full = due and not any(n.severity == "error" for n in found)
    if not full or _Cache.notices is None or scene != _Cache.scene:
        _show(found, scene)
    _Cache.request, _Cache.scene, _Cache.dirty = request, scene, not due
    if full:
        _Cache.running, _Cache.began = Preparation(_checking(context, request)), started


def _checking(context: bpy.types.Context, request: BakeRequest) -> Stages[None]:
    """Look in the extracted scene, in slices, and show what is found."""
    found = yield from preflighting(context, request)
    _show(tuple(found), _Cache.scene)


def _show(found: tuple[Notice, ...], scene: int) -> None:
    """Have the panel show `found` of the scene of session_uid `scene`."""
    if (found, scene) != (_Cache.notices, _Cache.scene):
        background.redraw()
    _Cache.notices, _Cache.scene = found, scene


def advance() -> None:
    """One slice of the check under way."""
    check, noted = _Cache.running, (_Cache.dirty, _Cache.changed_at)
    check.advance()
    _Cache.dirty, _Cache.changed_at = noted  # what the slice itself has brought up to date is no change
    if check.state == "running":
        background.redraw()
    elif check.state == "failed" and isinstance(check.error, AdjointError):
        _ended(dirty=True)  # the user has changed something meanwhile
    else:
        if check.state == "failed":
            _show((_said_of(check.error),), _Cache.scene)
        _ended()


def under_way() -> Preparation | None:
    """The check of the extracted scene that runs now."""
    return _Cache.running


def stop(timeout: float = 0.0) -> bool:
    """End the check under way; returns whether it has ended, else a later call does the rest."""
    if _Cache.running is None:
        return True
    _Cache.stopping = not _Cache.running.stop(timeout)
    if not _Cache.stopping:
        _ended(dirty=True)
    return not _Cache.stopping


def _ended(dirty: bool = False) -> None:
    """Nothing is under way any more; the next check waits as long as this one's share demands."""
    now = time.monotonic()
    _Cache.full_time, _Cache.running = now + (now - _Cache.began) / SHARE, None
    _Cache.dirty = _Cache.dirty or dirty
    background.redraw()


def look_again() -> None:
    """Check the extracted scene anew, whatever is known and however short ago it was."""
    stop()
    _Cache.dirty, _Cache.full_time = True, 0.0
    if not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=STEP)


def _look() -> float | None:
    if background.busy():
        return None if stop() else STEP
    if _Cache.stopping:
        stop()
        return STEP
    if _Cache.running is not None:
        advance()
        return STEP if _Cache.running is not None else None
    # Not while something is being dragged or typed: every change puts the check off.
    quiet = time.monotonic() - _Cache.changed_at
    if quiet < QUIET:
        return QUIET - quiet + 0.01
    refresh()
    return STEP if _Cache.running is not None else None


@bpy.app.handlers.persistent
def _before_load(*_: object) -> None:
    """Another file: what is read belongs to this one."""
    if _Cache.running is not None:
        _Cache.running.cancel()
        _Cache.running, _Cache.stopping = None, False


@bpy.app.handlers.persistent
def _changed(*_: object) -> None:
    """Something in the scene is not as it was when it was checked. Nothing may be read or written here but this note."""
    _Cache.dirty, _Cache.changed_at = True, time.monotonic()


HANDLERS = (("depsgraph_update_post", _changed), ("load_pre", _before_load))


def register() -> None:
    """Start without knowledge."""
    _Cache.scene, _Cache.request, _Cache.notices, _Cache.next_time, _Cache.dirty = 0, None, None, 0.0, True
    _Cache.full_time, _Cache.running = 0.0, None
    background.listen(HANDLERS)


def unregister() -> None:
    """End what is under way, take the timer away if it waits, and the handlers."""
    _before_load()
    background.stop_listening(HANDLERS)
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
