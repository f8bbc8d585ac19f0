# SPDX-License-Identifier: GPL-3.0-or-later
"""Standard output and error of the command line: writing to them never ends a bake, and no name can forge a line.

A reader that has gone (`check | head -1`), a full device, a closed stream and an encoding without the characters of a name are all met
here, so that commands only say lines.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator
from typing import TextIO

from ...core.base.errors import Notice
from ...core.base.text import printable

LAYOUT = "\n\r\t"  # control characters that we write ourselves


def say(line: str = "", error: bool = False) -> None:
    """Print one line; line ends and other controls inside of it are shown as escapes."""
    print(printable(line), file=sys.stderr if error else sys.stdout, flush=True)


def say_notices(notices: Iterable[Notice]) -> None:
    """Print notices to standard error, with their severity."""
    for notice in notices:
        say(f"{notice.severity}: {notice}", error=True)


def say_traceback() -> None:
    """Print the exception being handled, indented, so that none of its lines can be taken for one of ours."""
    for line in traceback.format_exc().splitlines():
        say("  " + line, error=True)


class Stream(io.TextIOBase):
    """Writes to `stream`, or nowhere when that is None, and never raises; the first failure stands in `error`, and nothing is written
    after it."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.error: Exception | None = None

    def write(self, text: str) -> int:
        """Characters that the stream's encoding lacks, and controls but those of `LAYOUT`, are written as escapes."""
        self._try(lambda stream: _put(stream, printable(text, LAYOUT)))
        return len(text)

    def flush(self) -> None:
        """What is written reaches the system."""
        self._try(lambda stream: stream.flush())

    def isatty(self) -> bool:
        """Whether a person looks at it."""
        return self._stream is not None and self.error is None and self._stream.isatty()

    @property
    def lost(self) -> str:
        """Why what was said could not be written, such as a full device; empty where it was, or where its reader has gone by itself."""
        if self.error is None or isinstance(self.error, BrokenPipeError):
            return ""
        return getattr(self.error, "strerror", None) or str(self.error)

    def _try(self, action: object) -> None:
        if self._stream is None or self.error is not None:
            return
        try:
            action(self._stream)
        except (OSError, ValueError) as error:
            self.error = error
            _discard(self._stream)


def _put(stream: TextIO, text: str) -> None:
    try:
        stream.write(text)
    except UnicodeEncodeError:
        encoding = stream.encoding or "ascii"
        stream.write(text.encode(encoding, "backslashreplace").decode(encoding))


def _discard(stream: TextIO) -> None:
    """Send what is buffered, and what Blender writes there later, to nowhere: it would fail again when the interpreter ends."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextlib.contextmanager
def guarded() -> Iterator[tuple[Stream, Stream]]:
    """Standard output and error as `Stream`s while a command runs."""
    streams = Stream(sys.stdout), Stream(sys.stderr)
    with _without_sigpipe(), contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        yield streams
        for stream in streams:
            stream.flush()


@contextlib.contextmanager
def _without_sigpipe() -> Iterator[None]:
    """Have a write to a pipe without a reader fail instead of ending the process, as it does where Blender embeds Python."""
    if not hasattr(signal, "SIGPIPE") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGPIPE, before if before is not None else signal.SIG_DFL)
