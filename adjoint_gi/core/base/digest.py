"""Whether two values are the same, told by 16 bytes of each."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Set

import numpy as np

SIZE = 16  # bytes: two of 2^32 values are alike by chance once in 10^19


def digest(value: object) -> bytes:
    """16 bytes of all that `value` holds: numbers, texts, arrays, and dataclasses, tuples, lists, sets and dictionaries of them.

    Fields that a dataclass does not compare count, too; what it has computed and keeps beside its fields does not. Raises TypeError for
    anything else.
    """
    out = hashlib.blake2b(digest_size=SIZE)
    _feed(out, value)
    return out.digest()


def _feed(out: hashlib.blake2b, value: object) -> None:
    """Add `value`, with its type and length, so that no two values of different shape give the same bytes."""
    if isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        if array.dtype.hasobject:
            raise TypeError("an array of objects has no digest")
        out.update(f"array {array.dtype.str} {np.shape(value)};".encode())
        out.update(array.reshape(-1).view(np.uint8))
    elif value is None or isinstance(value, bool | int | float | complex):
        out.update(f"{type(value).__name__} {value!r};".encode())
    elif isinstance(value, str | bytes):
        raw = value.encode("utf-8", "surrogatepass") if isinstance(value, str) else value
        out.update(f"{type(value).__name__} {len(raw)};".encode() + raw)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        _feed(out, (type(value).__qualname__, *(getattr(value, field.name) for field in dataclasses.fields(value))))
    elif isinstance(value, Mapping):
        _feed(out, ("mapping", *(part for item in value.items() for part in item)))
    elif isinstance(value, Set):
        _feed(out, ("set", *sorted(digest(item) for item in value)))
    elif isinstance(value, tuple | list):
        out.update(f"{type(value).__name__} {len(value)};".encode())
        for part in value:
            _feed(out, part)
    else:
        raise TypeError(f"{type(value).__name__} has no digest")
