# SPDX-License-Identifier: GPL-3.0-or-later
"""Gives every test the code under one name, `adjgi`, in plain Python, in the `bpy` wheel and inside Blender.

The repository root is the package, but its folder name is the developer's choice and the extension's name is Blender's. So the root
is never put on `sys.path` (the inner folder `adjoint_gi` would be found as a second copy of all modules). Instead `adjgi` is

- plain (default): a package made from the root `__init__.py`;
- `ADJOINT_GI_EXTENSION=1`: an alias of `bl_ext.user_default.adjoint_gi`, the checkout linked into an empty user folder and enabled;
- `ADJOINT_GI_EXTENSION=installed`: an alias of the extension that is installed in this Blender's user folder.

Shared helpers of tests are imported as `from adjgi.tests.NAME import ...`, in all three ways.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent
MODE = os.environ.get("ADJOINT_GI_EXTENSION", "")
EXTENSION = "bl_ext.user_default.adjoint_gi"
CHECKOUT_ONLY = ("adjgi.tests", "adjgi.bench", "adjgi.dev")  # do not ship
TEMPORARY: list[str] = []  # user folders made by this run


class AliasFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Answers `adjgi.x` with the very module `bl_ext.user_default.adjoint_gi.x`, so that nothing exists twice."""

    def __init__(self) -> None:
        self._specs: dict[str, importlib.machinery.ModuleSpec | None] = {}

    def find_spec(self, fullname, path=None, target=None):
        if fullname in CHECKOUT_ONLY:
            return importlib.machinery.PathFinder.find_spec(fullname, [str(ROOT)])
        if fullname.startswith(tuple(name + "." for name in CHECKOUT_ONLY)):
            return None
        if fullname == "adjgi" or fullname.startswith("adjgi."):
            return importlib.machinery.ModuleSpec(fullname, self)
        return None

    def create_module(self, spec):
        module = importlib.import_module(EXTENSION + spec.name.removeprefix("adjgi"))
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module):
        # The import system has set __spec__ to the alias; the module keeps its own.
        for alias, spec in self._specs.items():
            if spec is not None and spec.name == module.__name__:
                module.__spec__ = spec
                del self._specs[alias]
                return


def make_plain_alias() -> None:
    """Load the root `__init__.py` as the package `adjgi`."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["adjgi"] = module
    spec.loader.exec_module(module)


def link_folder(source: Path, link: Path) -> None:
    """Make `link` show the folder `source`; Windows needs no special right for a junction."""
    if sys.platform == "win32":
        import _winapi

        _winapi.CreateJunction(str(source), str(link))
    else:
        link.symlink_to(source, target_is_directory=True)


def enable_extension(link_checkout: bool) -> None:
    """Enable the extension in this process and make `adjgi` its alias; raises pytest.UsageError with the reason when that fails."""
    if link_checkout:
        if "bpy" in sys.modules and "BLENDER_USER_RESOURCES" not in os.environ:
            reason = "ADJOINT_GI_EXTENSION=1 inside Blender would write into the user's own folder"
            raise pytest.UsageError(f"{reason}: set BLENDER_USER_RESOURCES to an empty folder")
        # Processes of one run have a folder each: Blender puts the extension's wheels there, over those that another has loaded.
        if "BLENDER_USER_RESOURCES" not in os.environ or "PYTEST_XDIST_WORKER" in os.environ:
            TEMPORARY.append(tempfile.mkdtemp(prefix="adjoint_gi_user_"))
            os.environ["BLENDER_USER_RESOURCES"] = TEMPORARY[0]
    if importlib.util.find_spec("bpy") is None:
        raise pytest.UsageError("ADJOINT_GI_EXTENSION is set but this Python has no bpy: unset it, or use Blender or the bpy wheel")
    import bpy  # isort: split
    import addon_utils  # importable only after bpy

    if link_checkout:
        repos = {repo.module: repo for repo in bpy.context.preferences.extensions.repos}
        target = Path(repos["user_default"].directory) / "adjoint_gi"
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            link_folder(ROOT, target)
        addon_utils.extensions_refresh()
    problems: list[Exception] = []
    module = addon_utils.enable(EXTENSION, default_set=True, handle_error=problems.append)
    if module is None:
        raise pytest.UsageError(f"{EXTENSION} could not be enabled: {problems[0] if problems else 'it is not installed'}") from (
            problems[0] if problems else None
        )
    sys.meta_path.insert(0, AliasFinder())


# A shell without job control starts what it runs in the background with interrupts ignored, and all that this starts in turn.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# `python -m pytest` puts the working directory first.
sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != ROOT]

if MODE == "":
    make_plain_alias()
elif MODE in ("1", "installed"):
    enable_extension(link_checkout=MODE == "1")
else:
    raise pytest.UsageError(f"ADJOINT_GI_EXTENSION={MODE!r}: leave it unset, or set it to 1 or to installed")


def pytest_collect_directory(path, parent):
    """The root is a package to Blender; to pytest it is a folder, so its `__init__.py` is not imported under another name."""
    return pytest.Dir.from_parent(parent, path=path) if path == ROOT else None


def pytest_report_header(config):
    """Say which code is under test."""
    adjgi = importlib.import_module("adjgi")
    blender = sys.modules["bpy"].app.version_string if "bpy" in sys.modules else "not loaded"
    numpy = importlib.import_module("numpy")
    return f"adjgi: {MODE or 'plain'} from {adjgi.__file__}, Blender {blender}, numpy {numpy.__version__}"


def pytest_unconfigure(config):
    """Disable the extension: a class or timer that stays registered can keep the interpreter from ending."""
    if MODE:
        import addon_utils

        addon_utils.disable(EXTENSION, default_set=True)
    for folder in TEMPORARY:
        shutil.rmtree(folder, ignore_errors=True)  # removes the link, not the checkout behind it
