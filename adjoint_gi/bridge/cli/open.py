# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene of a command: the named file, or what is open in Blender if that is what was asked for."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import bpy

from ...core.base.errors import Notice, TargetError
from ..host import background, files
from .streams import say_notices

COMMAND = ("-c", "--command")
SCRIPT = ("-P", "--python", "--python-expr", "--python-text")  # may have built the scene

_unread = ""  # the last file, if it could not be opened


def open_scene(options: argparse.Namespace) -> None:
    """Open the named file, if any, and make the scene ready; raises `TargetError` when that cannot be done."""
    if options.scene:
        open_file(options.scene)
    else:
        require_scene()
    leave_edit_mode()


def open_file(scene: str) -> None:
    """Open a .blend file without its window layout; raises `TargetError`."""
    path = files.absolute(scene)
    if not os.path.isfile(path):  # what is none is not opened: a pipe would wait for ever
        raise TargetError(str(path), _instead_of_a_file(path), "Name a .blend file")
    try:
        # Scripts in a file from elsewhere are not run.
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise TargetError(str(path), f"cannot be opened ({str(error).strip()})", "Name a .blend file that this Blender can read") from None


def _instead_of_a_file(path: Path) -> str:
    """What a path is that names no regular file."""
    if os.path.isdir(path):
        return "is a folder"
    return "is a device, a pipe or a socket, not a file" if os.path.exists(path) else "does not exist"


def require_scene() -> None:
    """Raise `TargetError` unless the open scene is one that was asked for.

    Blender goes on with the scene of its start after a file that it could not open, and when no file was named at all. There
    `bpy.data.is_dirty` is no help: in background it is always set.
    """
    if _unread:
        raise TargetError(_unread, "could not be opened, so another scene is open", "Name a .blend file that this Blender can read")
    words = sys.argv[1:]
    started = next((words[:i] for i, word in enumerate(words) if word in COMMAND), None)  # None: a script calls, and knows its scene
    if started is not None and not bpy.data.filepath and not any(word in SCRIPT for word in started):
        raise TargetError("Scene", "no .blend file is open", "Name one before --command, or after the command's name")


def leave_edit_mode() -> None:
    """Leave edit mode on every object: a file may have been saved in it, and here no user can leave it by hand."""
    layer = bpy.context.view_layer
    layer.update()  # after a removal the list of objects has a hole until then
    for obj in layer.objects:
        if obj.mode == "EDIT":
            active, layer.objects.active = layer.objects.active, obj
            bpy.ops.object.mode_set(mode="OBJECT")
            layer.objects.active = active
            say_notices([Notice(obj.name, "was in edit mode, which has been left", "", "info")])


@bpy.app.handlers.persistent
def _after_load(*_: object) -> None:
    global _unread
    _unread = ""


@bpy.app.handlers.persistent
def _after_failure(path: str, *_: object) -> None:
    global _unread
    _unread = path


HANDLERS = (("load_post", _after_load), ("load_post_fail", _after_failure))


def register() -> None:
    """Take note of files that cannot be opened."""
    background.listen(HANDLERS)


def unregister() -> None:
    """Do so no longer."""
    background.stop_listening(HANDLERS)
    _after_load()
