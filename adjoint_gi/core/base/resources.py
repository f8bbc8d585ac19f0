"""What the machine has and what this process has used: memory, asked of the system without further libraries."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

from .errors import MemoryRefused

SHARE = 0.9  # of the free memory that a bake may plan to use


def available_memory() -> int | None:
    """Bytes that can be had without swapping, or None where the system does not say."""
    if sys.platform == "win32":
        return _windows_memory()
    info = Path("/proc/meminfo")
    if info.exists():
        for line in info.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    try:  # macOS says only how much there is
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def peak_memory() -> int | None:
    """Largest resident size of this process so far in bytes, or None where the system does not say."""
    try:
        import resource
    except ImportError:
        return _windows_peak() if sys.platform == "win32" else None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def require_memory(what: str, needed: int, available: int | None = None) -> None:
    """Raise `MemoryRefused` when `needed` bytes are more than a safe share of the free memory."""
    if available is None:
        available = available_memory()
    if available is not None and needed > SHARE * available:
        reason = f"needs {size_text(needed)} of memory and {size_text(available)} are free"
        raise MemoryRefused(what, reason, "Lower the resolution or the number of elements, or choose another method")


def require_within(what: str, needed: int, limit: int, remedy: str, verb: str = "could need") -> None:
    """Raise `MemoryRefused` when `needed` bytes are over the setting `memory_limit`, in MB of 2^20 bytes."""
    if needed > limit << 20:
        raise MemoryRefused(what, f"{verb} {needed / 2**20:,.0f} MB, over its limit of {limit:,} MB", remedy)


def size_text(bytes: int) -> str:
    """A number of bytes in words, such as "1.5 GB"."""
    size = float(bytes)
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" or size >= 100 else f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB" if size < 1000 else f"{size:,.0f} GB"


class _MemoryStatus(ctypes.Structure):
    _fields_ = [("length", ctypes.c_uint32), ("load", ctypes.c_uint32)] + [
        (name, ctypes.c_uint64) for name in ("total", "free", "total_page", "free_page", "total_virtual", "free_virtual", "extended")
    ]


def _windows_memory() -> int | None:
    status = _MemoryStatus()
    status.length = ctypes.sizeof(status)
    return int(status.free) if ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)) else None


class _MemoryCounters(ctypes.Structure):
    _fields_ = [("size", ctypes.c_uint32), ("faults", ctypes.c_uint32)] + [
        (name, ctypes.c_size_t) for name in ("peak", "resident", "a", "b", "c", "d", "page", "page_peak")
    ]


def _windows_peak() -> int | None:
    counters = _MemoryCounters()
    counters.size = ctypes.sizeof(counters)
    kernel = ctypes.windll.kernel32
    kernel.GetCurrentProcess.restype = ctypes.c_void_p
    query = kernel.K32GetProcessMemoryInfo
    query.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32]
    return int(counters.peak) if query(kernel.GetCurrentProcess(), ctypes.byref(counters), counters.size) else None
