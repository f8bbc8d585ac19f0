"""Writing a file so that there is either the complete new one or the old one, and never one that is not ours to replace."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .errors import TargetError, WriteError
from .process import is_alive, this_machine

SOFTWARE = "Adjoint GI"  # stands in the header of every file we write, and is how we know our own

LEFTOVER = re.compile(r"\.([0-9a-f]{8})-(\d{1,10})-[0-9a-f]{12}\.tmp$")  # ends of the names of files being written: machine, process

REASONS = {
    errno.ENOSPC: ("the disk is full", "Free some space or choose another folder"),
    errno.EDQUOT: ("the disk quota is used up", "Free some space or choose another folder"),
    errno.EFBIG: ("the file would be larger than this system allows", "Lower the resolution or choose another folder"),
    errno.EACCES: ("there is no permission to write there", "Choose a folder you may write to"),
    errno.EPERM: ("there is no permission to write there", "Choose a folder you may write to"),
    errno.EROFS: ("the file system is read-only", "Choose a folder you may write to"),
    errno.ENAMETOOLONG: ("the path is too long", "Choose a folder with a shorter path"),
    errno.ENOENT: ("the folder does not exist", "Choose an existing folder"),
    errno.ENOTDIR: ("a part of the path is not a folder", "Choose an existing folder"),
}


def check_target(path: Path, folder: Path, ours: Callable[[Path], bool]) -> None:
    """Raise TargetError unless `path` lies inside `folder`, is no symlink, and is either new or a file that `ours` knows."""
    name = str(path)
    if "\0" in name:
        raise TargetError(name.replace("\0", "?"), "holds a null character", "Choose another name")
    try:
        real_folder, real_parent = os.path.realpath(folder), os.path.realpath(path.parent)
        if path.name in ("", ".", "..") or os.path.commonpath([real_folder, real_parent]) != real_folder:
            raise TargetError(name, f"is outside of the chosen folder {folder}", "Choose a name without a path")
        if path.is_symlink():
            raise TargetError(name, "is a symbolic link, which is not followed", "Remove the link or choose another name")
        if os.path.lexists(path):
            if not path.is_file():
                raise TargetError(name, "exists and is not a file", "Choose another name")
            if not ours(path):
                raise TargetError(name, "exists and was not written by Adjoint GI, so it is not replaced", "Move it or choose another name")
    except (OSError, UnicodeError) as error:
        raise _write_error(name, error) from error
    except ValueError as error:  # folders on different drives
        raise TargetError(name, f"cannot be used as a path ({error})", "Choose another name") from error


def replace_file(
    path: Path, folder: Path, *, write: Callable[[Path], None], verify: Callable[[Path], bool], ours: Callable[[Path], bool]
) -> Path:
    """Write `path` by `write(temporary)` beside it, flush it to the disk, check it by `verify(temporary)`, and put it in place.

    Nothing is left behind on failure and an earlier file stays as it was. Raises TargetError for a place that must not be written
    and WriteError where writing fails or the file does not read back as it was written.
    """
    path, folder = Path(path), Path(folder)
    check_target(path, folder, ours)
    remove_leftovers(path.parent)
    temporary = path.with_name(f".{path.stem[:40]}.{temporary_suffix()}")
    try:
        # Step 1: claim the temporary name, so that it cannot be a link that someone put there.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        # Step 2: write and flush; a full disk may show only here, or only when reading back.
        write(temporary)
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        # Step 3: read back.
        if not verify(temporary):
            raise WriteError(str(path), "did not read back as it was written", "Check that the disk is not full and try again")
        # Step 4: put it in place; the check again, because writing took time.
        check_target(path, folder, ours)
        os.replace(temporary, path)
    except (OSError, UnicodeError) as error:
        raise _write_error(str(path), error) from error
    except RuntimeError as error:  # from the OpenEXR library
        raise WriteError(str(path), f"could not be written ({error})", "Check that the disk is not full and try again") from error
    finally:
        with contextlib.suppress(OSError, UnicodeError):
            os.unlink(temporary)
    _flush_folder(path.parent)
    return path


def temporary_suffix() -> str:
    """The end of the name of a file or folder that exists only while this process writes; unlike any other."""
    return f"{this_machine()}-{os.getpid()}-{secrets.token_hex(6)}.tmp"


def remove_leftovers(folder: Path) -> None:
    """Remove from `folder` what ends like `temporary_suffix` and was left by a process of this machine that is no more.

    Never raises: what cannot be removed stays.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = LEFTOVER.search(entry.name)
            if found is None or found[1] != this_machine() or is_alive(int(found[2])):
                continue
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def _flush_folder(folder: Path) -> None:
    """Make the new name survive a power cut, where the system can do that for folders."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _write_error(name: str, error: OSError | UnicodeError) -> WriteError:
    if isinstance(error, UnicodeError):
        reason = f"file names have no such characters here ({sys.getfilesystemencoding()})"
        return WriteError(name, f"could not be written: {reason}", "Set PYTHONUTF8 to 1, or give plain names")
    reason, remedy = REASONS.get(error.errno, (error.strerror or str(error), "Choose another folder"))
    return WriteError(name, f"could not be written: {reason}", remedy)


def require_finite(name: str, values: np.ndarray) -> None:
    """Raise WriteError when `values` holds anything that is not a finite number."""
    require_none_bad(name, int((~np.isfinite(values)).sum()))


def require_none_bad(name: str, bad: int) -> None:
    """Raise WriteError when `bad` values, which were counted as not finite, are any."""
    if bad:
        raise WriteError(
            name, f"{bad} values of the result are not finite numbers, so it is not written", "Report this scene and its settings"
        )
