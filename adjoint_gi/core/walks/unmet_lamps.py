"""Light that walks from receivers never or hardly ever find: by way of smooth or nearly smooth surfaces, from lamps that few rays or none
meet.

A light point is drawn for a surface that scatters, and a ray by a mirror goes on in one direction, which a lamp without size is never in
and a small lamp hardly ever: such a path is found only where a ray by the cosine happens to lead to the lamp. By a nearly smooth surface
it may lead past it, as far as the lobe is wide. Samples that hardly ever find a light do not know how noisy it is, either.
What is missing is measured by particles, and named only where it matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..base.errors import Notice
from ..base.settings import NO_LIMIT
from ..base.text import plain
from ..bsdf.lobes import opaque
from ..lights.base import LampKind, ParticleSource
from ..lights.emission import Emission
from ..lights.emitters import Emitters
from .mirror_chains import Chains

PARTICLES = 1 << 13
DEPTH = 8  # surfaces on the way that are followed
ENOUGH = 200  # particles of one light that tell its share
LEAST = 0.01  # share of the light of these lamps below which nothing is said
FEW = 0.1  # paths of one receiver that meet a lamp, on average, from which the noise shows that it is found
MOST_JOINT = 1000  # sources that come one way
NAMES = 3
SHOOT = "Use Particle Tracing or Progressive Multi-Pass"
READ = "Use Particle Tracing or Two-Pass"


def notices(
    emitters: Emitters,
    paths: float = math.inf,
    sized: bool = False,
    measure: str = "radiance",
    by_particles: bool = False,
    longest: int = NO_LIMIT,
) -> tuple[Notice, ...]:
    """Up to two notices, of lamps without and with a size: the share of the light that is missing, the lamps, the surfaces it comes by.

    paths: from one receiver, over which lamps with a size, and all by nearly smooth surfaces, count as found where at least `FEW` meet
    them. sized: lamps with a size are not found at all, and named with the others. measure: what is asked for; irradiance is what black
    surfaces and metals get like others. by_particles: the light of lamps by way of perfectly smooth surfaces is found otherwise. longest:
    segments of the paths that count.
    """
    world, lamps = emitters.world, emitters.lamps
    chains = Chains(world, min(DEPTH, longest - 1))
    if not chains.any or longest < 2:
        return ()
    irradiance, out = measure == "irradiance", []
    points = [] if by_particles else [lamps.source(i) for i in range(lamps.count) if sized or not lamps.sized[i]]
    unmet = chance_light(emitters, chains, points, irradiance=irradiance)
    if unmet is not None:
        what = "is not found by this method" if sized else "is missing: a lamp without size cannot be met there"
        out.append(unmet.notice(what, SHOOT + ("" if sized else ", or give the lamp a size")))
    if paths < math.inf and not sized:
        sources = [lamps.source(i) for i in range(lamps.count)] + emitters.mesh.sources()
        rare = chance_light(emitters, chains, sources, paths, irradiance, by_particles)
        if rare is not None:
            what = f"is found by luck alone: of {paths:,.0f} paths from a place {paths * rare.chance:.1g} meet the light there"
            out.append(rare.notice(what, READ + ", or make the light larger or the surface rougher"))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class ChanceLight:
    """What paths miss: its share of the light of these lamps that meets anything, the chance that one path from where it arrives meets
    the lamp, names of the lamps and of the objects it comes by."""

    share: float
    chance: float
    lamps: list[str]
    via: list[str]

    def notice(self, what: str, remedy: str) -> Notice:
        """Says so of the first lamps and objects."""
        reason = f"gives light by way of {_listed(self.via)} that {what} ({plain(100 * self.share)} % of what it gives)"
        return Notice(_listed(self.lamps), reason, remedy, names=tuple(self.lamps))


def chance_light(
    emitters: Emitters,
    chains: Chains,
    sources: list[ParticleSource],
    paths: float | None = None,
    irradiance: bool = False,
    by_particles: bool = False,
) -> ChanceLight | None:
    """Light of `sources` by way of smooth surfaces, of those that give at least `LEAST` of theirs so; None where none does. With `paths`
    that which fewer than `FEW` of them find, by way of rough surfaces, too, but not what is missing or, with `by_particles`, found
    otherwise: that of lamps by way of smooth ones.

    What counts is light that the diffuse lobe of a surface gets; with `irradiance` what its surface gets, whatever it makes of that.
    """
    sources = [s for s in sources if s.power > 0]
    if not sources:
        return None
    world = emitters.world
    emission = Emission(world, sources)
    rng = np.random.default_rng(0)
    p = emission.draw(PARTICLES, rng)
    power, owner = p.weight.sum(axis=1), np.asarray(world.scene.object)
    first, near, entered = np.zeros(PARTICLES, np.int64), np.zeros(PARTICLES), np.zeros(len(sources))
    last, flown, ends = p.origin.astype(np.float64), np.zeros(PARTICLES), opaque(world.scene)
    far = np.array([s.kind.far for s in sources])[p.light]
    known = [not s.kind.sized or (by_particles and isinstance(s.kind, LampKind)) for s in sources]
    known = np.array(known)[p.light]
    rows, light, chance = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
    for met in chains.follow(p.origin, p.direction, p.kind, rng, p.dark):
        s, row = met.surface, met.row
        step = s.position - last[row]
        length = np.linalg.norm(step, axis=1)
        last[row], flown[row] = s.position, flown[row] + length
        if met.segments == 1:
            first[row], near[row] = owner[s.triangle], length
            entered = np.bincount(p.light[row], power[row], len(sources))
            continue
        counts = ends[s.triangle] if irradiance else chains.diffuse(s.triangle, s.u, s.v).max(axis=1) > 0
        counts &= met.clear if paths is None else ~(met.clear & known[row])
        share = np.ones_like(met.share) if irradiance else met.share
        # The chance of a ray by the cosine, from here back along the same surfaces, to meet the lamp in its image, or a lobe that does.
        cosine = np.abs(np.einsum("ij,ij->i", step, s.ns)) / np.maximum(length, 1e-12)
        image = p.origin[row] + p.direction[row] * flown[row, None]
        wide = met.solid * np.where(far[row], 1, near[row] / np.maximum(flown[row], 1e-12)) ** 2
        reached = np.minimum(cosine / np.pi * (solid_angles(sources, p.light[row], image, flown[row]) + wide), 1)
        # A smooth lobe is one of several to choose; a light point has all of a rough one.
        reached *= np.where(met.solid > 0, 1, np.minimum(met.weight.mean(axis=1), 1))
        rows.append(row[counts])
        light.append((p.weight[row] * met.weight * share).sum(axis=1)[counts])
        chance.append(reached[counts])
    row, light, chance = (np.concatenate(x) for x in (rows, light, chance))
    # Where enough paths meet any of the lights that come the same way, light is found: it is noisy at worst, and noise is measured.
    if paths is not None:
        chance = _joint_chance(first[row], p.light[row], light, chance)
        light = light * (paths * chance < FEW)
    # Lights of which there are few particles are judged together.
    judged = np.where(np.bincount(p.light, minlength=len(sources)) < ENOUGH, len(sources), np.arange(len(sources)))
    missing = np.bincount(p.light[row], light, len(sources))
    some, whole = (np.bincount(judged, x, len(sources) + 1)[judged] for x in (missing, entered))
    told = (some >= LEAST * np.maximum(whole, 1e-300)) & (missing > 0)
    light, total = light * told[p.light[row]], float(missing[told].sum())
    if total <= 0:
        return None
    missing, met_by = np.bincount(row, light, PARTICLES), float((light * chance).sum())
    by_object = np.bincount(first, missing, len(world.scene.objects))
    via = [world.scene.objects[i].source for i in np.argsort(-by_object, kind="stable") if by_object[i] > LEAST * by_object.sum()]
    return ChanceLight(total / float(entered[told].sum()), met_by / total, [emission.names[i] for i in np.flatnonzero(told)], via)


def _joint_chance(first: np.ndarray, source: np.ndarray, light: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """(n,) middle chance, over its `light` (n,), to meet the source by way of the object `first` (n,), or another source that comes the
    same way: of those each counts as far as it gives as much, and is met as often."""
    way, back = np.unique(first, return_inverse=True)
    pair, which = np.unique(back * (int(source.max(initial=0)) + 1) + source, return_inverse=True)
    each = np.bincount(which, light, len(pair))
    order = np.lexsort((chance, which))
    upto, last = np.cumsum(light[order]), np.cumsum(np.bincount(which, minlength=len(pair))) - 1
    middle = chance[order][np.minimum(np.searchsorted(upto, upto[last] - each / 2), last)]
    owner, joint = np.zeros(len(pair), np.int64), np.zeros(len(pair))
    owner[which] = back
    for k in range(len(way)):
        own = np.flatnonzero(owner == k)
        others = own[np.argsort(-each[own], kind="stable")[:MOST_JOINT]]
        as_much = np.minimum(1, each[others] / np.maximum(each[own, None], 1e-300))
        joint[own] = (np.minimum(middle[others], middle[own, None]) * as_much).sum(axis=1)
    return joint[which]


def solid_angles(sources: list[ParticleSource], light: np.ndarray, at: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(n,) float64 rough solid angles of sources `light` (n,) as seen from `at` (n, 3), `distance` (n,) m from where light started."""
    out = np.zeros(len(light))
    order = np.argsort(light, kind="stable")
    present, begin = np.unique(light[order], return_index=True)
    for index, first, end in zip(present, begin, [*begin[1:], len(light)], strict=False):
        source, rows = sources[index], order[first:end]
        if not source.kind.sized:
            continue
        if isinstance(source.kind, LampKind):
            # Points of lamps are drawn with a density per solid angle, which is the reciprocal of what they fill.
            half = np.full(len(rows), np.float32(0.5))
            towards = np.ascontiguousarray(at[rows].T, np.float32)
            out[rows] = 1 / np.maximum(source.kind.sample(np.full(len(rows), source.index), towards, half, half).pdf_w, 1e-12)
        else:
            # Sheets that shine by the cosine show half of their area in the mean over directions.
            cells = source.kind.objects[source.index]
            area = cells.full / (2 * np.pi)
            lit = cells.power.sum() ** 2 / max(float((cells.power**2 / np.maximum(area, 1e-300)).sum()), 1e-300)
            out[rows] = 0.5 * lit / np.maximum(distance[rows], 1e-12) ** 2
    return np.minimum(out, 2 * np.pi)


def _listed(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    return ", ".join(names[:NAMES]) + (f" and {len(names) - NAMES} more" if len(names) > NAMES else "")
