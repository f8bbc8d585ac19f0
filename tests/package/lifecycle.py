# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs a built zip into an empty Blender, uses it, disables it, and prints what it saw as JSON. Run by test_install.py:

python lifecycle.py -- ZIP FOLDER       or       blender -b ... --python lifecycle.py -- ZIP FOLDER
"""

from __future__ import annotations

import inspect
import json
import sys
import threading
from pathlib import Path

import bpy  # isort: split

import addon_utils  # importable only after bpy

NAME = "bl_ext.user_default.adjoint_gi"
commands: list = []  # handles of the command-line commands that are registered now


def watch_commands() -> None:
    """Blender keeps no list of command-line commands that Python can read: count those that come and go."""
    register, unregister = bpy.utils.register_cli_command, bpy.utils.unregister_cli_command

    def counted_register(name: str, function: object) -> object:
        handle = register(name, function)
        commands.append((handle, name, function))
        return handle

    def counted_unregister(handle: object) -> None:
        unregister(handle)
        commands[:] = [entry for entry in commands if entry[0] is not handle]

    bpy.utils.register_cli_command, bpy.utils.unregister_cli_command = counted_register, counted_unregister


def our_functions() -> list:
    """All functions that modules of the extension hold; a timer is asked for by its function."""
    modules = [module for name, module in list(sys.modules.items()) if name.split(".")[:3] == NAME.split(".")]
    return [value for module in modules for value in vars(module).values() if inspect.isfunction(value)]


def registered_classes(base: type) -> list[type]:
    """All classes below `base` that scripts have registered; `dir(bpy.types)` leaves property groups out."""
    below = [cls for sub in base.__subclasses__() for cls in [sub, *registered_classes(sub)]]
    # Blender makes classes of its own operators, in the module bpy.types, when they are first called.
    return [cls for cls in below if "bl_rna" in vars(cls) and cls.__module__ != "bpy.types"]


def traces() -> dict[str, list[str]]:
    """Everything that registering can leave in Blender, by kind, as sorted names."""
    types = {name: getattr(bpy.types, name) for name in dir(bpy.types)}
    handlers = {name: value for name, value in inspect.getmembers(bpy.app.handlers) if isinstance(value, list)}
    draws = {name: getattr(getattr(cls, "draw", None), "_draw_funcs", []) for name, cls in types.items()}
    found = {
        "classes": [f"{cls.__module__}.{cls.__qualname__}" for cls in registered_classes(bpy.types.bpy_struct)],
        "properties": [f"{name}.{p.identifier}" for name, cls in types.items() if hasattr(cls, "bl_rna") for p in cls.bl_rna.properties],
        "handlers": [
            f"{name}: {getattr(f, '__module__', '')}.{getattr(f, '__qualname__', f)}" for name, fs in handlers.items() for f in fs
        ],
        "menus": [f"{name}: {f.__module__}.{f.__qualname__}" for name, functions in draws.items() for f in functions],
        "timers": [f.__qualname__ for f in our_functions() if bpy.app.timers.is_registered(f)],
        "operators": [f"{group}.{name}" for group in dir(bpy.ops) for name in dir(getattr(bpy.ops, group))],
        "presets": bpy.utils.preset_paths("adjoint_gi"),
        "commands": [name for _, name, _ in commands],
        "threads": [thread.name for thread in threading.enumerate()],
    }
    return {kind: sorted(map(str, names)) for kind, names in found.items()}


def left_behind(before: dict, after: dict) -> dict:
    """What `after` has and `before` had not."""
    return {kind: extra for kind in before if (extra := sorted(set(after[kind]) - set(before[kind])))}


def fail(error: Exception) -> None:
    raise error


def bake(folder: Path) -> int:
    """Bake one lightmap of a lit box by the command that the extension registered; returns its exit code, -1 when it registered none."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)  # a cube, a lamp and a camera
    blend = folder / "cube.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    command = next((function for _, name, function in commands if name == "adjoint_gi"), None)
    if command is None:
        return -1
    words = ["bake", "--method", "path_tracing", "--target", "texture", "--resolution", "16", "--set", "samples=1"]
    return command([*words, "--output", str(folder), "--report", str(folder / "report.json")])


def main(package: Path, folder: Path) -> dict:
    """Install, use, disable, and do the last twenty times more."""
    watch_commands()
    start = traces()
    bpy.ops.extensions.package_install_files(filepath=str(package), repo="user_default", enable_on_install=True)
    seen = {"enabled": NAME in bpy.context.preferences.addons, "registered": left_behind(start, traces())}

    # Loading the methods is part of using the extension: libraries of the wheels come from the extension's own folder.
    seen["bake"] = bake(folder)
    seen["warnings"] = {key: value for key, value in addon_utils._extensions_warnings_get().items() if "adjoint_gi" in key}
    seen["wheels"] = sorted(path.name for path in Path(bpy.utils.resource_path("USER")).glob("extensions/.local/**/site-packages/*"))

    addon_utils.disable(NAME, default_set=True, handle_error=fail)
    seen["left"] = left_behind(start, traces())
    for _ in range(20):
        assert addon_utils.enable(NAME, default_set=True, handle_error=fail) is not None
        addon_utils.disable(NAME, default_set=True, handle_error=fail)
    seen["left_after_twenty"] = left_behind(start, traces())
    return seen


if __name__ == "__main__":
    package, folder = map(Path, sys.argv[sys.argv.index("--") + 1 :])
    print("SEEN " + json.dumps(main(package, folder)))
