"""Light of lamps that walks from receivers cannot find: by way of perfectly smooth surfaces, from lamps that no ray meets.

A light point is drawn for a surface that scatters, and a ray by a mirror goes on in one direction, which a lamp without size is never in.
What is missing is measured by particles, and named only where it matters.
"""

from __future__ import annotations

import numpy as np

from ..base.errors import Notice
from ..lights.emission import Emission
from ..lights.emitters import Emitters
from .mirror_chains import Chains

PARTICLES = 1 << 13
DEPTH = 8  # surfaces on the way that are followed
LEAST = 0.01  # share of the light of these lamps below which nothing is said
NAMES = 3


def notices(emitters: Emitters, sized: bool = False) -> tuple[Notice, ...]:
    """One notice with the share of the light that is missing, the lamps and the surfaces it comes by. `sized`: lamps with a size, too."""
    world = emitters.world
    lamps = emitters.lamps
    sources = [s for i in range(lamps.count) if sized or not lamps.sized[i] for s in [lamps.source(i)] if s.power > 0]
    chains = Chains(world, DEPTH)
    if not (sources and chains.any):
        return ()
    emission = Emission(world, sources)
    rng = np.random.default_rng(0)
    p = emission.draw(PARTICLES, rng)
    power, owner = p.weight.sum(axis=1), np.asarray(world.scene.object)
    first, entered, missing = np.zeros(PARTICLES, np.int64), 0.0, np.zeros(PARTICLES)
    for met in chains.follow(p.origin, p.direction, p.kind, rng, p.dark):
        s = met.surface
        if met.segments == 1:
            first[met.row] = owner[s.triangle]
            entered = float(power[met.row].sum())
            continue
        scatters = chains.diffuse(s.triangle, s.u, s.v).max(axis=1) > 0
        missing[met.row] += (p.weight[met.row] * met.weight * met.share).sum(axis=1) * (met.clear & scatters)
    share = float(missing.sum()) / entered if entered else 0.0
    if share < LEAST:
        return ()
    by_object = np.bincount(first, missing, len(world.scene.objects))
    via = [world.scene.objects[i].source for i in np.argsort(-by_object, kind="stable") if by_object[i] > LEAST * by_object.sum()]
    names = [emission.names[i] for i in np.unique(p.light[missing > 0])]
    what = "is not found by this method" if sized else "is missing: a lamp without size cannot be met there"
    remedy = "Use Particle Tracing or Progressive Multi-Pass" + ("" if sized else ", or give the lamp a size")
    reason = f"gives light by way of {_listed(via)} that {what} ({100 * share:.2g} % of what it gives)"
    return (Notice(_listed(names), reason, remedy, names=tuple(names)),)


def _listed(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    return ", ".join(names[:NAMES]) + (f" and {len(names) - NAMES} more" if len(names) > NAMES else "")
