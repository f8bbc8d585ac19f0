"""The errors of Adjoint GI: each names the object, the reason and the remedy."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from .text import printable


@dataclass(frozen=True)
class Notice:
    """One sentence for the user: which object, what is wrong, what to do about it.

    `severity` is "info", "warning" or "error"; an error in a pre-flight list refuses the bake. Where one sentence is about several
    objects, `names` holds all of them, and `object` a list that may be cut short.
    """

    object: str
    reason: str
    remedy: str = ""
    severity: str = "warning"
    names: tuple[str, ...] = field(default=(), compare=False, repr=False)

    def __str__(self) -> str:
        text = f"{self.object}: {self.reason}" if self.object else self.reason
        # Names and messages of files from strangers reach terminals.
        return printable(f"{text}. {self.remedy}" if self.remedy else text)


class AdjointError(Exception):
    """Base of every error raised on purpose; carries the `Notice` that is shown to the user, and `others` found at the same time."""

    others: tuple[Notice, ...] = ()

    def __init__(self, object: str, reason: str, remedy: str = "") -> None:
        self.notice = Notice(object, reason, remedy, "error")
        super().__init__(str(self.notice))


class SceneError(AdjointError):
    """The scene cannot be solved as it is: no geometry, coordinates that are not numbers, no camera."""


class SettingsError(AdjointError):
    """A setting is unknown, of the wrong type or out of its range."""


class MemoryRefused(AdjointError):
    """The method would need more memory than its limit allows; the message says both numbers."""


class WriteError(AdjointError):
    """A result could not be written or did not read back as it was written."""


class TargetError(AdjointError):
    """The place to write to is missing or cannot be used: no UV layer, linked mesh, symlink, not our file."""


class Refusals:
    """Errors of many objects, raised together in the end: who leaves out what is refused then tries again once, not once for each."""

    def __init__(self) -> None:
        self.notices: list[Notice] = []

    @contextlib.contextmanager
    def each(self) -> Iterator[None]:
        """Around what is done for one object, which may raise SceneError or TargetError."""
        try:
            yield
        except (SceneError, TargetError) as error:
            self.notices += [error.notice, *error.others]

    def raise_all(self) -> None:
        """Raise TargetError for the first, with the others."""
        raise_all(self.notices, TargetError)


def raise_all(notices: Sequence[Notice], kind: type[AdjointError] = AdjointError) -> None:
    """Raise `kind` for the first of `notices`, if there is one; it carries the rest as `others`."""
    if notices:
        first, *others = notices
        error = kind(first.object, first.reason, first.remedy)
        error.others = tuple(others)
        raise error
