"""Collecting notices for the user: one sentence per reason, with the names it is about."""

from __future__ import annotations

from ...core.base.errors import Notice

NAMES_SHOWN = 4


class Notices:
    """Groups equal sentences, so that a thousand empties give one notice that names the first of them."""

    def __init__(self) -> None:
        self._names: dict[tuple[str, str, str], dict[str, None]] = {}

    def add(self, name: str, reason: str, remedy: str = "", severity: str = "warning") -> None:
        """Note that `name` has this problem; the same note twice counts once."""
        self._names.setdefault((reason, remedy, severity), {})[name] = None

    def result(self) -> tuple[Notice, ...]:
        """All notices, errors first, in the order in which they were added."""
        rank = {"error": 0, "warning": 1, "info": 2}
        notices = [Notice(listed(list(names)), *key, names=tuple(names)) for key, names in self._names.items()]
        return tuple(sorted(notices, key=lambda n: rank[n.severity]))


def listed(names: list[str]) -> str:
    """ "A", "A, B" or "A, B and 40 more"."""
    if len(names) <= NAMES_SHOWN:
        return ", ".join(names)
    return ", ".join(names[:NAMES_SHOWN]) + f" and {len(names) - NAMES_SHOWN} more"
