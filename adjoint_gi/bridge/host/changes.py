"""Whether anything in Blender has changed since some moment: as it says itself, when it evaluates a scene, undoes or loads.

What a script writes without telling Blender (values of a mesh without an `update`) is not seen.
"""

from __future__ import annotations

import bpy

from . import background

_count = 0


def count() -> int:
    """A number that is another one after every change."""
    return _count


@bpy.app.handlers.persistent
def _noted(*_: object) -> None:
    global _count
    _count += 1


HANDLERS = tuple((name, _noted) for name in ("depsgraph_update_post", "frame_change_post", "undo_post", "redo_post", "load_post"))


def register() -> None:
    """Start to count."""
    background.listen(HANDLERS)


def unregister() -> None:
    """Count no more; doing it twice changes nothing."""
    background.stop_listening(HANDLERS)
    _noted()
