# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of the panel in each state and of a baked Cornell box, made in the window of a real Blender.

    python bench/window_pictures.py [--out docs/pictures] [--blender PROGRAM] [--zip FILE] [--methods]

Builds the extension's zip (or takes FILE), installs it into an empty user folder, starts Blender with a window and lets
`window_session.py` work there as a person would. Needs a Python with the bpy wheel, as `python dev.py test` makes it in .venv,
and a Blender that can open a window: PROGRAM, or ../shared/tools/real-blender, or `blender` on the path where there is a display.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SECONDS = 600  # limit of the session


def find_blender(given: str | None) -> str:
    """The Blender to use; leaves with a remedy when there is none."""
    shared = ROOT.parent / "shared" / "tools" / "real-blender"
    if given:
        return given
    if shared.is_file():
        return str(shared)
    found = shutil.which("blender")
    if found and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform in ("win32", "darwin")):
        return found
    sys.exit(f"no Blender with a window: {shared} is missing, and there is no `blender` on the path with a display. Name one by --blender")


def load_dev():
    """dev.py as a module."""
    spec = importlib.util.spec_from_file_location("adjoint_gi_dev", ROOT / "dev.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> int:
    """Build, install, run the session; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures", help="folder for the pictures")
    parser.add_argument("--blender", help="program to use")
    parser.add_argument("--zip", type=Path, help="zip of the extension; built when not given")
    parser.add_argument("--methods", action="store_true", help="also a picture of the panel for each method")
    arguments = parser.parse_args()
    blender = find_blender(arguments.blender)
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="adjoint_gi_window_") as folder:
        package = arguments.zip
        if package is None:
            dev = load_dev()
            python = Path(sys.executable) if importlib.util.find_spec("bpy") else dev.main_environment()
            dev.build(python, Path(folder) / "dist")
            package = dev.own_zip(Path(folder) / "dist")
        environment = os.environ | {"BLENDER_USER_RESOURCES": str(Path(folder) / "user")}
        (Path(folder) / "user").mkdir()
        install = ["--command", "extension", "install-file", "-r", "user_default", "--enable", str(package.resolve())]
        subprocess.run([blender, "--factory-startup", *install], env=environment, timeout=300, check=True, stdin=subprocess.DEVNULL)
        session = str(ROOT / "bench" / "window_session.py")
        command = [blender, "--factory-startup", "--python-exit-code", "1", "--python", session, "--", str(arguments.out.resolve())]
        command += ["--methods"] if arguments.methods else []
        done = subprocess.run(command, env=environment, timeout=SECONDS, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        ended = time.time()
    print(done.stdout)
    print(done.stderr, file=sys.stderr)
    # The session ends by quitting in the middle of a bake and says when.
    quits = [float(line.split()[1]) for line in done.stdout.splitlines() if line.startswith("QUIT ")]
    if done.returncode or not quits:
        print(f"the session failed with exit code {done.returncode}", file=sys.stderr)
        return 1
    print(f"quitting during a bake took {ended - quits[0]:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
