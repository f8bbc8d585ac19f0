# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps a result as a file when it could not be written where it was meant to go."""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

from .... import __package__ as base_package
from ...core.method.solution import Solution


def folder() -> Path:
    """The extension's own folder for such files; outside an installed extension a folder for temporary files."""
    try:
        return Path(bpy.utils.extension_path_user(base_package, path="kept", create=True))
    except ValueError:  # Blender gives no folder to code that is not an extension
        path = Path(tempfile.gettempdir()) / "adjoint_gi_kept"
        path.mkdir(exist_ok=True)
        return path


def save(solution: Solution) -> str:
    """Write every array of `solution` and its numbers to a new .npz file and return its path; numpy reads it without pickle."""
    path = folder() / f"{solution.method}_{time.strftime('%Y%m%d_%H%M%S')}_{os.getpid()}_{time.monotonic_ns() % 10**6}.npz"
    about = {
        "method": solution.method,
        "measure": solution.measure,
        "settings": solution.settings,
        "seconds": solution.seconds,
        "rays": int(solution.rays),
        "partial": solution.partial,
    }
    arrays = {name: getattr(solution, name) for name in ("emitted", "direct", "indirect", "albedo", "weight")}
    np.savez_compressed(path, about=np.array(json.dumps(about)), **arrays)
    return str(path)
