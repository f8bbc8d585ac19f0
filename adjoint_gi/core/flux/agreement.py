"""Whether methods agree: flux of receiver objects by both equations, and differences with their statistical significance.

    Phi = <L, g>     (Eq. 3)  from the irradiance that a method has found, summed over the areas of the receivers
    Phi = <W, Le>    (Eq. 4)  by particles from all lights (Eq. 15): what arrives at the object, whatever the receivers are

g is 1 for light that arrives on the sides that the receivers of an object stand on. Texels and vertices know the irradiance at a few
points only: there g is the linear function on each triangle by which both equations weigh a linear irradiance alike
(`_weights_of_points`), so that coarse lightmaps do not look like methods that disagree. Fluxes are sums of the three colours, in W.
Random methods are repeated with other seeds; the spread gives standard errors. Deterministic ones have none, but elements are not
small: their flux may be off by an allowance, which each method states. A difference counts when what is left of it beyond the
allowances is significant after Sidak's correction for the number of comparisons, by Welch's t test. Methods that were told to count
other path lengths are not compared with each other, nor with Eq. 4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..base.settings import NO_LIMIT
from ..base.text import plain
from ..bsdf.table import BsdfTable
from ..lights.emission import Emission
from ..method.registry import MethodSpec
from ..receivers.base import Receivers
from ..scene.world import Surface, World
from ..walks.particles import Hits, walk

ALPHA = 0.01  # a comparison of methods that all agree cries wolf once in a hundred times
ELEMENTS = 0.03  # allowance of methods on elements that state none: relative error of an object's flux
DARK = 0.01  # the same, as a share of the mean flux per area: a small leak into a dark object is no disagreement
TEXELS = 0.01  # relative error of the flux of an object from its values at the receivers' points, however many
EDGE = -0.75  # power of the number n of points for what a shadow's edge adds: it splits the areas of about n^(1/2) points at random
FEW = 3  # degrees of freedom (of 4 repeats) below which noise is hardly known
LOUD = ("DISAGREE", "Too few repeats")  # how lines begin that must not be overlooked
EVERY_LENGTH = (0, NO_LIMIT)  # shortest and longest path
MUCH = 0.1  # relative difference that should not pass as noise then
ROUNDING = 1e-5  # float32 sums
PARTICLES_PER_BATCH = 1 << 14
NODES = np.polynomial.legendre.leggauss(64)  # for the tail of Student's t


@dataclass(frozen=True, eq=False)
class Groups:
    """Receivers by object: names; `owner` (n,) group of each receiver, -1 for none; `weight` (n,) m2; `triangle` (nt,) group whose g is not
    0 on a triangle, -1 for none. `g` (nt, 3) float64: it is g0 + g1 u + g2 v on a triangle; None: 1. `points` (g,) of the receivers of each
    group, None where they stand for all of their areas.

    For a camera weights are shares of the picture, fluxes are mean radiances, and no triangle is in a group.
    """

    names: tuple[str, ...]
    owner: np.ndarray
    weight: np.ndarray
    triangle: np.ndarray
    unit: str = "W"
    g: np.ndarray | None = None
    points: np.ndarray | None = None

    @property
    def area(self) -> np.ndarray:
        """(g,) summed weights."""
        on = self.owner >= 0
        return np.bincount(self.owner[on], self.weight[on], len(self.names))

    def flux(self, values: np.ndarray) -> np.ndarray:
        """(g,) float64 flux of `values` (n, 3), colours summed."""
        on = self.owner >= 0
        each = self.weight[on] * np.asarray(values, np.float64)[on].sum(axis=1)
        return np.bincount(self.owner[on], each, len(self.names))

    def source(self, surface: Surface) -> np.ndarray | float:
        """g at points (n,) on triangles of the groups."""
        if self.g is None:
            return 1.0
        g = self.g[surface.triangle]
        return g[:, 0] + g[:, 1] * surface.u + g[:, 2] * surface.v


def groups_of(world: World, receivers: Receivers) -> Groups:
    """The receivers by the object that they stand on.

    Each point stands for its share of its triangle. Triangles so small that they have none are left out of both equations.
    """
    objects = np.asarray(world.scene.object, np.int64)
    if receivers.measure == "radiance":
        return _camera_groups(world, receivers, objects)
    points = list(receivers.sites())
    triangle = np.concatenate([p.triangle for p in points])
    receiver = np.concatenate([p.receiver for p in points])
    many = np.bincount(triangle, minlength=world.triangle_count)
    # Elements answer for both sides, texels and vertices for the front.
    share = _sides(receivers) * world.area[triangle] / many[triangle]
    owner, present = _majority(receiver, objects[triangle], share, receivers.count)
    group = np.where(many > 0, np.searchsorted(present, objects), -1)
    weight = np.bincount(receiver, share, receivers.count)
    names = tuple(world.scene.objects[i].name for i in present)
    if receivers.kind == "elements":
        return Groups(names, owner, weight, group)
    u, v = (np.concatenate([getattr(p, x) for p in points]).astype(np.float64) for x in "uv")
    # The value of a receiver is the mean over its points, whatever triangles they stand on.
    each = (weight / np.maximum(np.bincount(receiver, minlength=receivers.count), 1))[receiver]
    many = np.bincount(owner[receiver], minlength=len(names))
    return Groups(names, owner, weight, group, g=_weights_of_points(world, triangle, u, v, each), points=many)


# Means of the products of 1, u and v over a triangle.
MOMENTS = np.array([[1, 1 / 3, 1 / 3], [1 / 3, 1 / 6, 1 / 12], [1 / 3, 1 / 12, 1 / 6]])


def _weights_of_points(world: World, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(nt, 3) float64 coefficients of 1, u and v of the function g on each triangle with

        integral of g f over the triangle = sum of `weight` f at its points u, v (n,)      for f = 1, u and v

    A texel across the edge of a box takes its mean from both faces, and points do not lie in the middle of what they stand for: with
    g = 1 the flux of a box of 46 texels would be off by 5 %.
    """
    sums = np.stack([np.bincount(triangle, weight * f, world.triangle_count) for f in (np.ones_like(u), u, v)])
    return np.linalg.solve(MOMENTS, sums / np.maximum(world.area, 1e-300)).T


def _sides(receivers: Receivers) -> int:
    return 2 if receivers.kind == "elements" else 1


def _majority(receiver: np.ndarray, what: np.ndarray, share: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """For each of `count` receivers the position of the `what` (n,) with the largest summed share, -1 for none, among the sorted values."""
    present = np.unique(what)
    if not len(receiver):
        return np.full(count, -1, np.int64), present
    pair, back = np.unique(receiver * len(present) + np.searchsorted(present, what), return_inverse=True)
    total = np.bincount(back.ravel(), share)
    order = np.lexsort((total, pair // len(present)))
    owner = np.full(count, -1, np.int64)
    owner[pair[order] // len(present)] = pair[order] % len(present)  # of equal indices the last stays: the largest
    return owner, present


def _camera_groups(world: World, receivers: Receivers, objects: np.ndarray) -> Groups:
    """Pixels by the object that most of their rays see."""
    n = receivers.count
    receiver, seen = [], []
    for p in receivers.sites():
        hit = p.triangle >= 0
        receiver.append(p.receiver[hit])
        seen.append(objects[p.triangle[hit]])
    receiver, seen = np.concatenate(receiver), np.concatenate(seen)
    owner, present = _majority(receiver, seen, np.ones(len(receiver)), n)
    names = tuple(world.scene.objects[i].name for i in present)
    return Groups(names, owner, np.full(n, 1.0 / n), np.full(world.triangle_count, -1), "W m-2 sr-1, mean over the picture")


@dataclass(frozen=True, eq=False)
class ShotFlux:
    """<W, Le> of every group and its standard error, (g,) float64 W, from `batches` of particles; rays cast and seconds taken."""

    value: np.ndarray
    error: np.ndarray
    batches: int
    rays: int


def shoot(
    world: World, groups: Groups, both_sides: bool, min_length: int, max_length: int, seed: int, least: int = 16
) -> Iterator[ShotFlux | None]:
    """Flux that arrives at the groups by Eq. 15 after `min_length` to `max_length` segments, better with every batch; yields without an end
    (None before two batches)."""
    emission = Emission(world)
    table = BsdfTable(world.scene)
    table = None if table.only_diffuse else table
    group = groups.triangle
    g, k, rays = len(groups.names), 0, 0
    total, squares = np.zeros(g), np.zeros(g)
    none = np.zeros(g)
    while True:
        if emission.is_dark:
            yield ShotFlux(none, none, least, 0)
            continue
        here = np.zeros(g)

        def visit(hits: Hits, here: np.ndarray = here) -> None:
            if hits.length < min_length:
                return
            at = group[hits.surface.triangle]
            on = (at >= 0) & (both_sides | (hits.surface.side > 0))
            arriving = groups.source(hits.surface) * hits.arriving.sum(axis=1, dtype=np.float64)
            here += np.bincount(at[on], arriving[on], g)

        rng = np.random.Generator(np.random.SFC64([seed, 15, k]))
        rays += walk(world, emission.draw(PARTICLES_PER_BATCH, rng), max_length, rng, visit, table).rays
        k += 1
        total += here
        squares += here**2
        if k < 2:
            yield None
            continue
        spread = np.sqrt(np.maximum(squares - total**2 / k, 0) / (k - 1) / k)
        yield ShotFlux(total / k, spread, k, rays)


@dataclass(frozen=True, eq=False)
class Measured:
    """Fluxes of one method: value and standard error (g,), `freedom` of the error (0 where it is exact), relative allowance (one, or
    (g,)), shortest and longest path that it counts."""

    method: str
    label: str
    value: np.ndarray
    error: np.ndarray
    freedom: int
    allowance: float | np.ndarray
    leaves_out: str = ""
    notes: tuple[str, ...] = ()  # replaced lobes
    lengths: tuple[int, int] = EVERY_LENGTH


@dataclass(frozen=True)
class Difference:
    """Of two methods at one object: relative difference, its t beyond the allowances, and p after Sidak's correction. `unknown`: why noise
    could explain a large difference only because there are too few repeats, "" otherwise."""

    first: str
    second: str
    object: str
    relative: float
    t: float
    p: float
    unknown: str = ""

    @property
    def significant(self) -> bool:
        """Whether chance does not explain it."""
        return self.p < ALPHA


@dataclass(frozen=True, eq=False)
class Agreement:
    """`differences` holds the worst object of every pair; `gaps` (m, g) relative differences between Eq. 3 by method and Eq. 4, NaN where a
    method counts other path lengths."""

    groups: Groups
    methods: tuple[Measured, ...]
    shot: ShotFlux | None
    gaps: np.ndarray | None
    differences: tuple[Difference, ...]
    lines: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether no line says that two methods disagree."""
        return not any(line.startswith("DISAGREE") for line in self.lines)


def allowance_of(spec: MethodSpec) -> float:
    """The relative error that a method states for the flux of an object at its default settings."""
    if spec.allowance is not None:
        return spec.allowance
    return ELEMENTS if spec.uses_elements else 0.0


def agreement(groups: Groups, methods: Sequence[Measured], shot: ShotFlux | None, lengths: tuple[int, int] = EVERY_LENGTH) -> Agreement:
    """Compare all pairs of methods, and all methods with Eq. 4, object by object; `lengths` are those of `shot`."""
    sides = list(methods)
    if shot is not None:
        texels = TEXELS if groups.points is None else TEXELS + np.maximum(groups.points, 1) ** EDGE
        sides.append(Measured("", "Eq. 4", shot.value, shot.error, shot.batches - 1, texels, lengths=lengths))
    # Mean flux per area, from which an object counts as dark.
    middle = np.median([m.value.sum() for m in sides]) / max(groups.area.sum(), 1e-300) if sides else 0.0
    floor = DARK * middle * groups.area
    pairs = [(a, b) for i, a in enumerate(sides) for b in sides[i + 1 :] if a.lengths == b.lengths]
    tests = max(1, len(pairs) * len(groups.names))
    worst = [d for a, b in pairs if (d := _worst(a, b, groups, floor, tests)) is not None]
    gaps = None
    if shot is not None and methods:
        scale = np.maximum(np.abs(shot.value), np.maximum(floor, 1e-300))
        gaps = np.stack([(m.value - shot.value) / scale if m.lengths == lengths else np.full(len(scale), np.nan) for m in methods])
    lines = _lines(worst, {m.label: m for m in sides}) + _apart(sides)
    return Agreement(groups, tuple(methods), shot, gaps, tuple(worst), lines)


def _worst(a: Measured, b: Measured, groups: Groups, floor: np.ndarray, tests: int) -> Difference | None:
    """The most significant difference of two methods; one that is large but cannot be told from the noise of few repeats comes before
    others that are not significant."""
    if not len(groups.names):
        return None
    difference = a.value - b.value
    size = np.maximum(0.5 * (np.abs(a.value) + np.abs(b.value)), 1e-300)
    allowed = (a.allowance + b.allowance + ROUNDING) * size + floor * (a.allowance + b.allowance > 0)
    beyond = np.maximum(np.abs(difference) - allowed, 0.0)
    variance = a.error**2 + b.error**2
    # Where both are 0 there is nothing beyond, and t is 0.
    t = beyond / np.sqrt(np.maximum(variance, np.maximum((1e-9 * size) ** 2, 1e-300)))
    freedom = _welch(a, b, variance)
    p = np.array([1 - (1 - min(1.0, two_sided(x, f))) ** tests for x, f in zip(t, freedom, strict=True)])
    relative = difference / np.maximum(size, floor + 1e-300)
    # The smallest p; among those that chance explains anyway, the largest relative difference.
    k = int(np.lexsort((-np.abs(relative), p))[0])
    few = [m for m in (a, b) if 0 < m.freedom < FEW]
    unknown = ""
    if few and p[k] >= ALPHA:
        large = np.where(beyond > MUCH * np.maximum(size, floor), np.abs(relative), 0.0)
        if large.any():
            k = int(np.argmax(large))
            unknown = f"{' and '.join(m.label for m in few)} with {few[0].freedom + 1} repeats"
    return Difference(a.label, b.label, groups.names[k], float(relative[k]), float(t[k]), float(p[k]), unknown)


def _welch(a: Measured, b: Measured, variance: np.ndarray) -> np.ndarray:
    """(g,) degrees of freedom of a difference (Welch and Satterthwaite), infinite where neither is random."""
    below = np.zeros(len(variance))
    for m in (a, b):
        if m.freedom > 0:
            below += m.error**4 / m.freedom
    return np.where(below > 0, variance**2 / np.maximum(below, 1e-300), np.inf)


def two_sided(t: float, freedom: float) -> float:
    """Probability that |Student's t| exceeds `t`. In the angle phi with cot phi = t / sqrt(freedom) the density is sin^(freedom - 1)."""
    if t <= 0:
        return 1.0
    if not math.isfinite(freedom) or freedom > 1e5:
        return math.erfc(t / math.sqrt(2))

    def integral(top: float) -> float:
        x, w = NODES
        return float(0.5 * top * (w * np.sin(0.5 * top * (x + 1)) ** (freedom - 1)).sum())

    return min(1.0, integral(math.atan2(math.sqrt(freedom), t)) / integral(0.5 * math.pi))


def _lines(differences: Sequence[Difference], methods: dict[str, Measured]) -> tuple[str, ...]:
    """What the differences mean, the loud lines first. What methods say of themselves is said once for each."""
    loud, stated = [], {}
    for d in sorted(differences, key=lambda d: -abs(d.relative)):
        if not d.significant:
            continue
        a, b = methods[d.first], methods[d.second]
        reasons = [(m, f"{m.label} leaves out {m.leaves_out}") for m in (a, b) if m.leaves_out]
        reasons += [(m, f"{m.label} replaces lobes ({'; '.join(m.notes)})") for m in (a, b) if m.notes]
        for m, reason in reasons:
            other = b if m is a else a
            stated.setdefault(reason, []).append(f"{plain(100 * abs(d.relative), 3)} % from {other.label} on {d.object}")
        if not reasons:
            loud.append(f"DISAGREE: {d.first} and {d.second} differ by {plain(100 * abs(d.relative), 3)} % on {d.object}, {_chance(d.p)}.")
    dim = sorted((d for d in differences if d.unknown), key=lambda d: -abs(d.relative))
    if not loud and differences:
        fine = sum(not d.significant and not d.unknown for d in differences)
        rest = "" if fine + len(dim) == len(differences) else "; the others differ as they state"
        untold = f"; {len(dim)} cannot be told" if dim else ""
        if fine or not dim:
            share = f"{fine} of {len(differences)} pairs"
            loud.append(f"Agree: {share} differ by no more than noise and their stated allowances{untold}{rest}.")
    if dim:
        parts = [f"{d.first} and {d.second} differ by {plain(100 * abs(d.relative), 3)} % on {d.object} ({d.unknown})" for d in dim]
        loud.append(f"Too few repeats to tell: {'; '.join(parts)}. Choose at least {FEW + 1} repeats.")
    known = [f"Differs as stated: {reason}: {', '.join(parts)}." for reason, parts in stated.items()]
    return tuple(loud + known)


def _apart(sides: Sequence[Measured]) -> tuple[str, ...]:
    """Who is not compared with whom because they count other path lengths."""
    by: dict[tuple[int, int], list[str]] = {}
    for m in sides:
        by.setdefault(m.lengths, []).append(m.label)
    if len(by) < 2:
        return ()
    most = EVERY_LENGTH[1]
    parts = [
        f"path lengths {low} {f'to {high}' if high < most else 'and more'} ({', '.join(labels)})" for (low, high), labels in by.items()
    ]
    return (f"Not compared: {' with '.join(parts)}. Set the same min_length and max_length to compare them.",)


def _chance(p: float) -> str:
    return "which noise does not explain" if p < 1e-12 else f"by chance once in {1 / p:,.0f} comparisons like this one"
