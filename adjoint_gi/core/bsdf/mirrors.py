"""Perfect reflection and refraction: every direction that mirror-like lobes send light from, with its weight, without random numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from . import microfacet as mf
from . import table as bsdf

REFLECTING = (bsdf.GLOSSY, bsdf.METALLIC, bsdf.SPECULAR, bsdf.GLASS, bsdf.DIELECTRIC)
CLEAR = (bsdf.GLASS, bsdf.REFRACTION, bsdf.TRANSPARENT)


@dataclass(frozen=True, eq=False)
class Branch:
    """Rays that leave some of the points: rows (m,), wi (m, 3) unit in the world, weight (m, 3) = f |cos| over the delta's measure.

    `through`: all of them lie beyond the surface, or none.
    """

    rows: np.ndarray
    wi: np.ndarray
    weight: np.ndarray
    through: bool


def branches(lobes: bsdf.Lobes, mirror: tuple[np.ndarray, ...]) -> Iterator[Branch]:
    """For every slot of `lobes` its reflected and its transmitted ray, at the points where `mirror` (one (n,) bool for each slot) says
    that the lobe is taken as perfectly smooth. Glass splits by Fresnel's equations; where it reflects totally nothing goes through.
    """
    for slot, which in zip(lobes.slots, mirror, strict=True):
        rows = np.flatnonzero(which & np.isin(slot.kind, REFLECTING))
        if len(rows):
            o, part, eta = lobes.local[rows], slot.take(rows), bsdf.relative_ior(lobes, slot)[rows]
            w = o * np.array([-1, -1, 1], np.float32)
            yield Branch(rows, lobes.take(rows).to_world(w), bsdf.reflectance(part.kind, part, o[:, 2], eta), False)
        rows = np.flatnonzero(which & np.isin(slot.kind, CLEAR))
        if len(rows):
            o, part, eta = lobes.local[rows], slot.take(rows), bsdf.relative_ior(lobes, slot)[rows]
            h = np.zeros_like(o)
            h[:, 2] = 1
            w, total = mf.refract(o, h, eta)
            straight = part.kind == bsdf.TRANSPARENT
            w[straight] = -o[straight]
            passed = np.where(part.kind == bsdf.GLASS, 1 - mf.fresnel(o[:, 2], eta), np.float32(1))
            passed = np.where(total & ~straight, 0, passed)
            wi = lobes.take(rows).to_world(w)
            # A transparent surface must not turn rays where its shading normal leans away.
            wi[straight] = -lobes.wo[rows[straight]]
            yield Branch(rows, wi, part.color * passed[:, None], True)


def without(lobes: bsdf.Lobes, gone: tuple[np.ndarray, ...]) -> bsdf.Lobes:
    """The same lobes, the slots taken out where `gone` (one (n,) bool for each slot) says so; a coat still dims what lies below it."""
    slots = tuple(replace(s, kind=np.where(g, np.int8(0), s.kind)) for s, g in zip(lobes.slots, gone, strict=True))
    parts = (lobes.wo, lobes.local, lobes.x, lobes.y, lobes.z, lobes.diffuse)
    return bsdf.Lobes(*parts, slots, lobes.entering, lobes.material, lobes.table)
