"""Arithmetic on colour polynomials: sums of products of constants, images and attributes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.base.color import LUMINANCE
from ...core.scene.arrays import Color, Rgb, Source, Term
from .images import Images

LARGEST_POLYNOMIAL = 64  # terms
LARGEST = 1e30  # of a coefficient: its square times a texture is still a float64, itself a float32


class NotPolynomial(ValueError):
    """The operation cannot be written as a polynomial of images and attributes."""


def simplified(color: Color) -> Color:
    """Merge terms with the same sources; raises `NotPolynomial` when too many are left."""
    out = combined(color)
    if len(out.terms) > LARGEST_POLYNOMIAL:
        raise NotPolynomial("it has too many terms")
    return out


def finite(color: Color) -> Color:
    """`color` itself where it can be computed with; else NaN becomes 0, and what is larger than `LARGEST` becomes that."""
    if all(abs(c) <= LARGEST for term in color.terms for c in term.constant):
        return color
    return Color(
        tuple(
            Term(rgb(np.clip(np.nan_to_num(t.constant, posinf=LARGEST, neginf=-LARGEST), -LARGEST, LARGEST)), t.sources)
            for t in color.terms
        )
    )


def combined(color: Color) -> Color:
    """Terms with the same sources added up, however many are left."""
    merged: dict[tuple[Source, ...], np.ndarray] = {}
    for term in color.terms:
        key = tuple(sorted(term.sources, key=repr))
        merged[key] = merged.get(key, np.zeros(3)) + np.array(term.constant)
    return Color(tuple(Term(rgb(c), s) for s, c in merged.items() if c.any() or not s))


def rgb(v: np.ndarray | tuple) -> Rgb:
    """Three floats."""
    return (float(v[0]), float(v[1]), float(v[2]))


def mean(color: Color, images: Images) -> Rgb:
    """Mean over all images, taken as independent; raises `NotPolynomial` for attributes, whose values differ by object."""
    total = np.zeros(3)
    for term in color.terms:
        product = np.array(term.constant, np.float64)
        for source in term.sources:
            if source.kind != "image":
                raise NotPolynomial("it depends on an attribute")
            m = images.mean(source.texture)
            product = product * (m[3] if source.alpha else m[:3])
        total += product
    return rgb(total)


def luminance(color: Color, images: Images) -> Color:
    """The grey of equal luminance; raises `NotPolynomial` for a coloured attribute or a product of coloured sources."""
    out = Color()
    for term in color.terms:
        colored = [s for s in term.sources if not _is_grey(s, images)]
        grey = tuple(s for s in term.sources if _is_grey(s, images))
        weights = np.array(LUMINANCE) * np.array(term.constant)
        if not colored:
            out = out + Color((Term(rgb(np.full(3, weights.sum())), grey),))
            continue
        if len(colored) > 1 or colored[0].kind != "image":
            raise NotPolynomial("its luminance cannot be taken before the sources are looked up")
        source = colored[0]
        index = images.derive(source.texture, _luminances(weights.astype(np.float32)))
        out = out + Color((Term((1.0, 1.0, 1.0), (*grey, _with(source, index))),))
    return simplified(out)


def mapped(color: Color, function: Callable[[np.ndarray], np.ndarray], images: Images) -> Color:
    """Apply `function` ((n, 3) -> (n, 3) float32) to a constant, or to the pixels when the colour depends on one image alone.

    Raises `NotPolynomial` otherwise.
    """
    if color.is_constant:
        with np.errstate(all="ignore"):  # the caller looks at what is not finite
            return Color.of(*function(np.array([color.constant], np.float32))[0].astype(float))
    sources = {s for t in color.terms for s in t.sources}
    places = {(s.kind, s.texture, s.name, s.transform) for s in sources}
    if len(places) != 1 or next(iter(sources)).kind != "image":
        raise NotPolynomial("it depends on more than one image or on an attribute")
    source = next(iter(sources))
    terms = [(term.constant, [s.alpha for s in term.sources]) for term in color.terms]

    def of(value: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.nan_to_num(function(value))

    # Outside of a clipped image a lookup gives 0: what comes of that is a constant, and the pixels hold what they have beside it.
    clipped = images.textures[source.texture].extension == "CLIP"
    beside = rgb(of(np.array([color.constant], np.float32))[0]) if clipped else (0.0, 0.0, 0.0)

    def pixels(flat: np.ndarray) -> np.ndarray:
        value = np.zeros((len(flat), 3), np.float32)
        for constant, alphas in terms:
            product = np.broadcast_to(np.array(constant, np.float32), value.shape)
            for alpha in alphas:
                product = product * (flat[:, 3:4] if alpha else flat[:, :3])
            value += product
        flat[:, :3] = of(value) - np.array(beside, np.float32)
        return flat

    return Color(
        ((Term(beside),) if any(beside) else ()) + (Term((1.0, 1.0, 1.0), (_with(source, images.derive(source.texture, pixels)),)),)
    )


def _luminances(weights: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Pixels (n, 4) to pixels whose colours are their sum by `weights` (3,)."""

    def pixels(flat: np.ndarray) -> np.ndarray:
        flat[:, :3] = (flat[:, :3] @ weights)[:, None]
        return flat

    return pixels


def _with(source: Source, texture: int) -> Source:
    """The same lookup in another texture, colour channels."""
    return Source("image", source.name, texture, source.transform)


def _is_grey(source: Source, images: Images) -> bool:
    return source.alpha or (source.kind == "image" and images.is_grey(source.texture))
