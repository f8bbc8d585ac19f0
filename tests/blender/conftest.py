# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests that need Blender: every one starts from an empty factory file.

A test that uses what the extension registers (operators, properties, engine, panels) asks for the fixture `registered`.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys

import pytest

HAS_BPY = "bpy" in sys.modules or importlib.util.find_spec("bpy") is not None

# Without Blender these files cannot even be imported.
collect_ignore_glob = [] if HAS_BPY else ["test_*.py"]


def pytest_terminal_summary(terminalreporter):
    """Say that the folder was left out, so that a green run is not read as more than it is."""
    if not HAS_BPY:
        terminalreporter.write_line("tests/blender was not collected: this Python has no bpy (use `python dev.py test`)", yellow=True)


@pytest.fixture(scope="session")
def registered():
    """The root package of the extension, registered; in extension mode Blender has enabled it before."""
    adjgi = importlib.import_module("adjgi")
    if os.environ.get("ADJOINT_GI_EXTENSION"):
        yield adjgi
        return
    adjgi.register()
    yield adjgi
    adjgi.unregister()


@pytest.fixture(autouse=True)
def empty_file():
    """Load an empty file before the test. Preferences stay, so the extension stays enabled."""
    import bpy

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
