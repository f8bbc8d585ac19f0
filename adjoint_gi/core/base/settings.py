"""Settings of the methods: frozen dataclasses from which panels, command-line flags and manual tables are generated."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field, fields
from typing import Any

from .errors import SettingsError

Rgb = tuple[float, float, float]
NO_LIMIT = 1024  # a max_length of this or more does not bound the paths


def setting(
    default: Any,
    label: str,
    help: str,
    *,
    min: float | None = None,
    max: float | None = None,
    soft_max: float | None = None,
    choices: tuple[tuple[str, str, str], ...] = (),
    unit: str = "",
    effort: bool = False,
) -> Any:
    """A dataclass field with the words and bounds that every user interface of it needs.

    `choices` holds (identifier, label, description) and makes a `str` field an enumeration.
    `unit` is a Blender property subtype in lower case ("distance", "factor") or empty.
    `effort` marks the number of random samples that a budget of time or rays may raise; at most one field of a method has it.
    """
    meta = {
        "label": label,
        "help": help,
        "min": min,
        "max": max,
        "soft_max": soft_max,
        "choices": choices,
        "unit": unit,
        "effort": effort,
    }
    return field(default=default, metadata=meta)


def choice(default: str, label: str, help: str, **choices: tuple[str, str]) -> Any:
    """A field that takes one of `choices`: identifier=(label, description)."""
    return setting(default, label, help, choices=tuple((id, *words) for id, words in choices.items()))


@dataclass(frozen=True)
class Settings:
    """What every method takes. Path length counts segments between light and receiver: 0 own emission, 1 direct, 2 one bounce."""

    seed: int = setting(0, label="Seed", help="Start of the random numbers; the same seed gives the same result", min=0, max=2**31 - 1)
    min_length: int = setting(
        0, label="Min Path Length", help="Shortest light path that counts: 0 is own emission, 1 direct light, 2 one bounce", min=0, max=1024
    )
    max_length: int = setting(
        NO_LIMIT,
        label="Max Path Length",
        help="Longest light path that counts: 1 is direct light only, 2 adds one bounce; 1024 is no limit",
        min=0,
        max=NO_LIMIT,
        soft_max=64,
    )

    def __post_init__(self) -> None:
        for f in fields(self):
            if field_type(f) is tuple:
                object.__setattr__(self, f.name, as_rgb(f, getattr(self, f.name)))
        self.validate()

    def validate(self) -> None:
        """Raise `SettingsError` for a value of the wrong type or outside its bounds."""
        for f in fields(self):
            check(f, getattr(self, f.name))
        if self.min_length > self.max_length:
            # The panel shows labels, the command line takes keys.
            low, high = (f"{f.metadata['label']} ({f.name})" for f in fields(self) if f.name in ("min_length", "max_length"))
            raise SettingsError(low, f"{self.min_length} is more than {high} {self.max_length}", f"Lower it or raise {high}")

    def as_dict(self) -> dict[str, Any]:
        """All values by name, ready for JSON."""
        return dataclasses.asdict(self)

    def replaced(self, texts: dict[str, Any]) -> Settings:
        """A copy with values from `texts` (strings are parsed by the field's type), as given by `--set key=value`."""
        known = {f.name: f for f in fields(self)}
        values = {}
        for key, text in texts.items():
            if key not in known:
                raise SettingsError(key, "is not a setting of this method", "Choose one of: " + ", ".join(known))
            values[key] = parse(known[key], text)
        return dataclasses.replace(self, **values)


def field_type(f: dataclasses.Field) -> type:
    """The Python type of a settings field: bool, int, float, str, or tuple of a colour."""
    return type(f.default)


def as_rgb(f: dataclasses.Field, value: Any) -> Rgb:
    """Three numbers, or one for a grey, as a colour; raises `SettingsError`."""
    try:
        rgb = tuple(float(x) for x in (value if isinstance(value, tuple | list) else (value,) * 3))
    except (TypeError, ValueError):
        rgb = ()
    if len(rgb) != 3:
        raise SettingsError(f.name, f"{value!r} is no colour", "Give three numbers, or one for a grey")
    return rgb


def parse(f: dataclasses.Field, text: Any) -> Any:
    """Turn `text` into the type of field `f`; raises `SettingsError` naming the field."""
    kind = field_type(f)
    if not isinstance(text, str):
        return as_rgb(f, text) if kind is tuple else kind(text)
    try:
        if kind is bool:
            words = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}
            return words[text.strip().lower()]
        if kind is not str and ("_" in text or not text.isascii()):  # Python reads 1_0, and digits of other scripts
            raise ValueError(text)
        if kind is tuple:
            parts = tuple(float(x) for x in text.strip().strip("()").split(","))
            return parts if len(parts) > 1 else parts[0]
        return kind(text)
    except (KeyError, ValueError):
        if kind is tuple:
            raise SettingsError(f.name, f"cannot read {text!r} as a colour", "Give R,G,B or one number, such as 1,0.5,0.2") from None
        raise SettingsError(f.name, f"cannot read {text!r} as {kind.__name__}", f"Give a {kind.__name__}, such as {f.default!r}") from None


def check(f: dataclasses.Field, value: Any) -> None:
    """Raise `SettingsError` unless `value` has the type of field `f` and lies inside its bounds."""
    kind = field_type(f)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise SettingsError(f.name, f"{value!r} is not of type {kind.__name__}", f"Give a value such as {f.default!r}")
    meta = f.metadata
    names = [c[0] for c in meta["choices"]]
    if names and value not in names:
        raise SettingsError(f.name, f"{value!r} is not a choice", "Choose one of: " + ", ".join(names))
    for number in value if kind is tuple else (value,) if kind in (int, float) else ():
        if number != number:
            raise SettingsError(f.name, "is not a number", f"Give a value such as {f.default!r}")
        if meta["min"] is not None and number < meta["min"]:
            raise SettingsError(f.name, f"{number} is below {meta['min']}", f"Give at least {meta['min']}")
        if meta["max"] is not None and number > meta["max"]:
            raise SettingsError(f.name, f"{number} is above {meta['max']}", f"Give at most {meta['max']}")
        if math.isinf(number):
            raise SettingsError(f.name, f"{number} is not a finite number", f"Give a value such as {f.default!r}")
