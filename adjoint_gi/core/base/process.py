"""Processes of this machine: which they are, and whether they still run."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import sys

QUERY, STILL_ACTIVE = 0x1000, 259  # Windows: PROCESS_QUERY_LIMITED_INFORMATION, and the exit code of what has not ended


@functools.cache
def this_machine() -> str:
    """Eight hexadecimal digits that stand for what numbers the processes: this computer, or a container on it."""
    try:
        space = str(os.stat("/proc/self/ns/pid").st_ino)
    except OSError:
        space = ""
    return hashlib.sha256(f"{platform.node()} {space}".encode()).hexdigest()[:8]


def is_alive(pid: int) -> bool:
    """Whether a process of this number runs; True also where the system does not say."""
    if sys.platform == "win32":  # there `os.kill` ends a process, whatever the signal
        return _is_alive_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it belongs to another user
        return True
    return True


def _is_alive_windows(pid: int) -> bool:
    kernel = ctypes.windll.kernel32
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = kernel.OpenProcess(QUERY, False, ctypes.c_uint32(pid))
    if not handle:
        return kernel.GetLastError() == 5  # access denied: there is one
    code = ctypes.c_uint32()
    known = kernel.GetExitCodeProcess(ctypes.c_void_p(handle), ctypes.byref(code))
    kernel.CloseHandle(ctypes.c_void_p(handle))
    return not known or code.value == STILL_ACTIVE
