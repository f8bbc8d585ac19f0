"""The table of all lobe kinds. A new one is a file with its `LobeKind`, and a line here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..scene.arrays import SceneArrays
from .diffuse import Diffuse
from .lobe import LobeKind
from .oren_nayar import OrenNayar
from .reflection import Dielectric, Glossy, Metallic, Specular, TintedMetallic
from .transmission import Glass, Refraction, Transparent

# A lobe's number is its place here. Diffuse is number 0: points keep its colour apart, and an empty slot has this number, too.
LOBES: tuple[LobeKind, ...] = (
    Diffuse(),
    Glossy(),
    Metallic(),
    Specular(),
    Glass(),
    Refraction(),
    Transparent(),
    Dielectric(),
    OrenNayar(),
    TintedMetallic(),
)
DIFFUSE = 0
LOBE_KINDS = {kind.name: number for number, kind in enumerate(LOBES) if number}
ALL_LOBES = frozenset(("emission", *(kind.name for kind in LOBES)))  # what surfaces may have
DIFFUSE_LOBES = frozenset(("diffuse", "emission"))
NEARLY_DIFFUSE = frozenset(kind.name for kind in LOBES if kind.nearly_diffuse)
FIRST_PASS_LOBES = ALL_LOBES - NEARLY_DIFFUSE  # what methods know that take what is nearly diffuse as diffuse
DELTA_BELOW = np.array([kind.delta_below for kind in LOBES], np.float32)
SHINY = LOBE_KINDS.keys() - NEARLY_DIFFUSE  # what elements cannot hold: chains go on over it


def those(which: Callable[[LobeKind], bool]) -> np.ndarray:
    """(kinds,) bool table of a property, to be indexed by numbers of kinds."""
    return np.array([which(kind) for kind in LOBES])


REFLECTING = those(lambda kind: kind.reflects)
PASSING = those(lambda kind: kind.passes)
REFRACTING = those(lambda kind: kind.refracts)
SHINING = REFLECTING | PASSING
PARTIAL = those(lambda kind: kind.partial)
HIGHLIGHT = those(lambda kind: kind.highlight)


def opaque(scene: SceneArrays) -> np.ndarray:
    """(nt,) bool: triangles of materials that let no light through."""
    lets = [any(LOBES[LOBE_KINDS.get(x.kind, DIFFUSE)].passes and not x.is_black for x in m.lobes) for m in scene.materials]
    return ~np.array(lets or [False])[np.asarray(scene.material, np.int64)]


def present(kind: np.ndarray) -> list[int]:
    """The kinds among the numbers `kind` (n,), empty slots left out."""
    return [int(k) for k in np.flatnonzero(np.bincount(kind, minlength=1)) if k]
