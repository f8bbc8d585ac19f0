# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures for tests of the built zips; they need Blender, or the bpy wheel, and its own builder."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
HAS_BPY = "bpy" in sys.modules or importlib.util.find_spec("bpy") is not None
collect_ignore_glob = [] if HAS_BPY else ["test_*.py"]


def pytest_terminal_summary(terminalreporter):
    """Say that the folder was left out."""
    if not HAS_BPY:
        terminalreporter.write_line("tests/package was not collected: this Python has no bpy (use `python dev.py test`)", yellow=True)


def blender_command() -> list[str]:
    """How to start another Blender like this one that runs a script: its own program, or a Python with the bpy wheel."""
    binary = sys.modules["bpy"].app.binary_path if "bpy" in sys.modules else ""
    if binary:
        return [binary, "-b", "--factory-startup", "--python-exit-code", "1", "--python"]
    return [sys.executable]


@pytest.fixture(scope="session")
def zips(tmp_path_factory) -> Path:
    """The folder with one zip a platform: built now by Blender's builder, or the one that ADJOINT_GI_DIST names."""
    if os.environ.get("ADJOINT_GI_DIST"):
        return Path(os.environ["ADJOINT_GI_DIST"]).resolve()
    dev = importlib.import_module("adjgi.dev")
    folder = tmp_path_factory.mktemp("dist")
    dev.build(Path(sys.executable), folder)
    return folder


@pytest.fixture(scope="session")
def own_zip(zips) -> Path:
    """The zip for the platform of this machine."""
    dev = importlib.import_module("adjgi.dev")  # not `from adjgi import`: it is no part of an installed extension
    return dev.own_zip(zips)


@pytest.fixture(scope="session")
def in_blender(tmp_path_factory):
    """A function that runs a script of this folder in a new Blender with an empty user folder and returns what it printed.

    The Blender ends by itself: hanging or crashing on the way out fails the test as well.
    """

    def run(script: str, *arguments: object, seconds: float = 240) -> str:
        # Nothing of this process: no alias of the extension, no user folder of an outer run.
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("ADJOINT_GI", "BLENDER_"))}
        folder = tmp_path_factory.mktemp("user")
        environment["BLENDER_USER_RESOURCES"] = str(folder)
        command = [*blender_command(), str(HERE / script), "--", *map(str, arguments)]
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=seconds, cwd=folder, env=environment, stdin=subprocess.DEVNULL
        )
        assert answer.returncode == 0, f"exit {answer.returncode}\n{answer.stdout}\n{answer.stderr}"
        return answer.stdout

    return run
