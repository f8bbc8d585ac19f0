# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs pytest inside any Blender, or in a Python that has the `bpy` wheel:

    blender -b --factory-startup --python-exit-code 1 --python tests/run.py -- tests/blender -q
    python tests/run.py tests/blender -q

What follows `--` goes to pytest. Blender's own Python has neither pytest nor, unless the extension's wheels are installed, embreex
and OpenEXR: they come from the folder named by ADJOINT_GI_TEST_PACKAGES, or from the one `python dev.py packages` keeps in the cache.
Nothing is installed into Blender.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def pytest_arguments() -> list[str]:
    """What follows `--` on Blender's command line, or all arguments of a plain Python."""
    if "--" in sys.argv:
        return sys.argv[sys.argv.index("--") + 1 :]
    return sys.argv[1:] if Path(sys.argv[0]).resolve() == Path(__file__).resolve() else []


def add_packages() -> None:
    """Make pytest importable; exits with a remedy where that cannot be done."""
    if importlib.util.find_spec("pytest"):
        return
    folder = os.environ.get("ADJOINT_GI_TEST_PACKAGES")
    if folder is None:
        spec = importlib.util.spec_from_file_location("adjoint_gi_dev", ROOT / "dev.py")
        dev = sys.modules["adjoint_gi_dev"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(dev)
        folder = dev.packages_folder(sys.version_info[:2])
    # Last on the path: what Blender or the installed extension brings comes first.
    sys.path.append(str(folder))
    if importlib.util.find_spec("pytest") is None:
        version = ".".join(map(str, sys.version_info[:2]))
        end(f"no pytest in {folder}: run `python dev.py packages {version}` once, outside Blender, or set ADJOINT_GI_TEST_PACKAGES")


def end(code: int | str) -> None:
    """Leave at once with what was printed: an interpreter with Blender inside may hang or crash while it is taken apart."""
    if isinstance(code, str):
        print(code, file=sys.stderr)
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    """Run pytest from the repository root and leave with its exit code."""
    # A script's folder comes first on the path, where our helpers would stand before modules of Blender that have the same name.
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT / "tests"]
    add_packages()
    import pytest

    os.chdir(ROOT)
    # A checkout may be read-only or shared by several Blender versions: leave no cache behind.
    end(int(pytest.main(["-p", "no:cacheprovider", *pytest_arguments()])))


main()
