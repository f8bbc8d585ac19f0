# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps a result as a file when it could not be written where it was meant to go."""

from __future__ import annotations

import functools
import os
import tempfile
import time
import zipfile
from pathlib import Path

import bpy
import numpy as np

from .... import __package__ as base_package
from ...core.base.atomic import replace_file
from ...core.base.errors import WriteError
from ...core.base.text import json_text
from ...core.method.solution import Solution

ARRAYS = ("emitted", "direct", "indirect", "albedo", "weight")  # beside those of `Solution.extra`, under their own names


def folder() -> Path:
    """The extension's own folder for such files; outside an installed extension a folder for temporary files. Raises WriteError."""
    try:
        return Path(bpy.utils.extension_path_user(base_package, path="kept", create=True))
    except ValueError:  # Blender gives no folder to code that is not an extension
        return _temporary_folder()
    except OSError as error:
        raise WriteError("Folder for kept results", f"cannot be made ({error.strerror or error})", "Make room, then write again") from error


@functools.cache
def _temporary_folder() -> Path:
    """A new folder that only this user can enter: whoever knew its name could have put a link there."""
    try:
        return Path(tempfile.mkdtemp(prefix="adjoint_gi_kept_"))
    except OSError as error:
        raise WriteError("Temporary folder", f"cannot be used ({error.strerror or error})", "Make room, then write again") from error


def save(solution: Solution) -> str:
    """Write every array of `solution` and its numbers to a new .npz file and return its path; numpy reads it without pickle.

    Raises WriteError, as on a full disk; then there is no file.
    """
    place = folder()
    path = place / f"{solution.method}_{time.strftime('%Y%m%d_%H%M%S')}_{os.getpid()}_{time.monotonic_ns() % 10**6}.npz"
    about = {
        "method": solution.method,
        "measure": solution.measure,
        "settings": solution.settings,
        "seconds": solution.seconds,
        "rays": int(solution.rays),
        "partial": solution.partial,
    }
    arrays = solution.extra | {name: getattr(solution, name) for name in ARRAYS}

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, about=np.array(json_text(about)), **arrays)

    replace_file(path, place, write=write, verify=lambda file: _is_whole(file, len(arrays) + 1), ours=lambda _: False)
    return str(path)


def _is_whole(path: Path, count: int) -> bool:
    """Whether all `count` arrays read back; zip files hold a checksum of each."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None and len(file.namelist()) == count
    except zipfile.BadZipFile:
        return False
