"""Names and folders of files: any object name becomes a name that every system accepts, and nothing leaves the chosen folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy

from ...core.base.atomic import remove_leftovers, temporary_suffix
from ...core.base.errors import TargetError, WriteError

LONGEST = 80  # characters of a name before the hash; file systems allow 255 bytes
DEVICES = {"con", "prn", "aux", "nul", "conin$", "conout$", *(f"{d}{i}" for d in ("com", "lpt") for i in "0123456789\u00b9\u00b2\u00b3")}


def safe_name(name: str) -> str:
    """A file name without extension: the cleaned `name`, and a hash of it, so that different names never meet in one file.

    "Cube" and "cube" differ in the hash too, because some systems take them for the same file. The same name always gives the same
    result, on every system.
    """
    digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:8]
    clean = bpy.path.clean_name(name.encode("utf-8", "replace").decode())[:LONGEST].strip(" ._-")
    if clean.lower().split(".")[0] in DEVICES:
        clean = "_" + clean
    return f"{clean or 'unnamed'}-{digest}"


def absolute(text: str | Path) -> Path:
    """`text` as an absolute path, from the working directory; raises TargetError when it needs one that is gone."""
    try:
        return Path(text).absolute()
    except FileNotFoundError:
        raise TargetError("Working directory", "was removed", "Change to a folder that exists, or give absolute paths") from None


def output_folder(text: str, create: bool = True) -> Path:
    """The absolute folder that `text` names, "//" meaning beside the .blend file.

    With `create` it is made, and a file without a name is written into it; otherwise nothing is changed, and permissions are
    looked at. Raises TargetError for an empty or relative path or an unsaved file, WriteError when the folder cannot be
    made or written to.
    """
    if not text.strip():
        raise TargetError("Output folder", "is not set", "Choose a folder")
    if "\0" in text:
        raise TargetError("Output folder", "holds a null character", "Choose another folder")
    if text.startswith("//") and not bpy.data.filepath:
        raise TargetError(
            "Output folder", f'"{text}" is relative to the .blend file, which is not saved yet', "Save the file first or choose a folder"
        )
    folder = Path(os.path.expanduser(bpy.path.abspath(text)))
    if not folder.is_absolute():
        raise TargetError("Output folder", f'"{text}" is not an absolute path', "Choose an absolute folder, or one that starts with //")
    folder = Path(os.path.normpath(folder))
    try:
        parent = next((p for p in (folder, *folder.parents) if p.exists()), None)
        if parent is None:
            raise WriteError(str(folder), "is on a drive that is not there", "Choose another folder")
        if not parent.is_dir():
            raise WriteError(str(parent), "is a file, not a folder", "Choose another folder")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise WriteError(str(parent), "there is no permission to write there", "Choose a folder you may write to")
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(str(folder), f"cannot be made ({error.strerror or error})", "Choose another folder") from error
    if create:
        for place in (folder, Path(tempfile.gettempdir())):
            remove_leftovers(place)
        try:
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise WriteError(str(folder), f"cannot be written to ({error.strerror or error})", "Choose another folder") from error
    return folder


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder that is gone afterwards, also when this process is killed: then the next one removes it. Raises OSError."""
    place = Path(tempfile.gettempdir())
    remove_leftovers(place)
    with tempfile.TemporaryDirectory(prefix="adjoint_gi_", suffix="." + temporary_suffix(), dir=place) as folder:
        yield Path(folder)


def output_file(folder: Path, name: str, suffix: str) -> Path:
    """`folder` / safe_name(name) + suffix, such as ".exr"."""
    return folder / (safe_name(name) + suffix)


def relative(path: Path) -> str:
    """How a file is stored in the .blend: relative to it where that is possible, so that both can move together."""
    if bpy.data.filepath:
        try:
            return bpy.path.relpath(str(path))
        except ValueError:  # another drive on Windows
            return str(path)
    return str(path)
