"""The one registry of methods: every menu, table, flag and test parameter is generated from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, ClassVar

from ..base.errors import SettingsError
from ..base.settings import Settings

if TYPE_CHECKING:
    import numpy as np

    from ..receivers.base import Receivers
    from ..scene.world import World
    from .solution import Step


class Strategy(StrEnum):
    """Which of the two adjoint equations a method solves."""

    GATHERING = "gathering"
    SHOOTING = "shooting"


class Nature(StrEnum):
    """How it solves it."""

    DETERMINISTIC = "deterministic"
    NONDETERMINISTIC = "nondeterministic"


GATHERING, SHOOTING = (Strategy.GATHERING,), (Strategy.SHOOTING,)
GATHERING_OR_SHOOTING = (*GATHERING, *SHOOTING)  # as the settings say
SHOOTING_THEN_GATHERING = (*SHOOTING, *GATHERING)
DETERMINISTIC, NONDETERMINISTIC = (Nature.DETERMINISTIC,), (Nature.NONDETERMINISTIC,)
BOTH_NATURES = (*DETERMINISTIC, *NONDETERMINISTIC)


@dataclass(frozen=True)
class MethodSpec:
    """What a method is, where it stands in the taxonomy, and what it cannot do."""

    id: str  # identifier in files and on the command line, never renamed
    number: int  # fixed number for .blend files, never reused
    label: str
    strategies: tuple[Strategy, ...]
    natures: tuple[Nature, ...]
    year: int
    authors: str
    title: str  # of the paper
    equation: str  # plain text with the review's equation numbers
    section: str  # of the review
    idea: str
    limits: tuple[str, ...]
    lobes: frozenset[str]  # BSDF lobes solved as they are; others are replaced and warned about
    elements: int = 0  # wanted at default settings, where `max_edge` is 0; 0 for methods that have none
    receivers: tuple[str, ...] = ("texels", "vertices", "camera", "elements")
    answers: str = "light"  # or "potential": then its solutions have that measure for all receivers
    leaves_out: str = ""  # light that it leaves out by design, so that it differs from the others there
    allowance: float | None = None  # relative error of an object's flux at default settings; None: as for all methods on elements, else 0

    @property
    def uses_elements(self) -> bool:
        """Whether the method cuts surfaces into elements."""
        return self.elements > 0


def lines(text: str) -> tuple[str, ...]:
    """The lines of a text, for `MethodSpec.limits`: one limit a line."""
    return tuple(line.strip() for line in text.strip().splitlines())


class Solver:
    """Base of all methods. `solve` is a generator; its consumer may stop between any two steps and keep the last."""

    spec: ClassVar[MethodSpec]
    Settings: ClassVar[type[Settings]]

    def memory(self, world: World, receivers: Receivers, settings: Settings) -> int:
        """Bytes the method will need beyond the world and the receivers, known before it starts."""
        return receivers.count * 3 * 4 * 6

    def element_target(self, settings: Settings) -> int:
        """Elements wanted where the setting `max_edge` is 0; for methods that use elements."""
        return self.spec.elements

    def solve(self, world: World, receivers: Receivers, settings: Settings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield a `Step` at least every quarter of a second; the last one is the finished result."""
        raise TypeError(f"{type(self).__name__} does not define solve()")


_METHODS: dict[str, Solver] = {}


def register(cls: type[Solver]) -> type[Solver]:
    """Class decorator that enters a method; raises ValueError on a second method of the same id or number."""
    for other in _METHODS.values():
        if other.spec.id == cls.spec.id or other.spec.number == cls.spec.number:
            raise ValueError(f"method {cls.spec.id} ({cls.spec.number}) is registered twice")
    _METHODS[cls.spec.id] = cls()
    return cls


def arrange(ids: Sequence[str]) -> None:
    """Put the methods `ids` first, in this order: modules may have been imported in another one."""
    for id in [*ids, *(x for x in _METHODS if x not in ids)]:
        _METHODS[id] = _METHODS.pop(id)


def methods() -> tuple[Solver, ...]:
    """All methods in the order of `solvers/__init__.py`."""
    return tuple(_METHODS.values())


def method(id: str) -> Solver:
    """The method called `id`; raises `SettingsError` that lists the known ones."""
    try:
        return _METHODS[id]
    except KeyError:
        raise SettingsError(id, "is not a method", "Choose one of: " + ", ".join(_METHODS)) from None


def fitting(strategy: str, nature: str) -> tuple[Solver, ...]:
    """Methods in one quadrant of the taxonomy."""
    return tuple(m for m in methods() if Strategy(strategy) in m.spec.strategies and Nature(nature) in m.spec.natures)
