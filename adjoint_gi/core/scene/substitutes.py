"""How a method that knows only diffuse surfaces takes a material.

Kinds of lobes answer that themselves (`LobeKind.as_diffuse` in `core/bsdf`). That folder comes after this one in the one-way order, so
`core/__init__.py` passes their answers in before anything else of the core is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from .arrays import Color, Lobe, Material

_BY_KIND: dict[str, Callable[[Lobe], Color]] = {}


def register(by_kind: Mapping[str, Callable[[Lobe], Color]]) -> None:
    """By the name of every kind of lobe: the albedo of a diffuse surface that stands in for a lobe of that kind."""
    _BY_KIND.update(by_kind)


def as_diffuse(material: Material, kinds: Collection[str] | None = None) -> Color:
    """The summed albedo of the lobes that scatter, of all kinds or of `kinds`. Raises KeyError for a kind that nothing is known of."""
    out = Color()
    for lobe in material.lobes:
        if lobe.kind != "emission" and (kinds is None or lobe.kind in kinds):
            out = out + _BY_KIND[lobe.kind](lobe)
    return out
