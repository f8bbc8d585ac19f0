"""Scattering at surfaces: any sum of the lobe kinds of `lobes.py`.

Three functions, as in Nori and pbrt: `evaluate` (f times cosine, and pdf_w), `sample`, and `Lobes` that prepares both.
Radiance is carried as basic radiance (divided by the index squared), so one set of formulas serves gathering and shooting:
T and T* differ only in which of the two directions is given.

The diffuse lobe is not a slot like the others: nearly every point has one. `weights`, `evaluate` and `sample` compute it first, inline and
at all points at once, by the functions of `diffuse.py`: no gather of the points that have it, no call for each kind. The order of the
sums, the diffuse term before those of the slots, decides the last bits of every result.

Limit: a coat loses what bounces more than once between its microfacets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..sampling.maps import dot_rows, frame_rows
from ..scene.arrays import STRAIGHT, Color, Lobe, Material, RayKind, SceneArrays, constant_of
from ..scene.shading import ColorField, ScalarField
from ..scene.substitutes import as_diffuse
from . import microfacet as mf
from .coat import Coating, Coats, CoatShares, Layer
from .curves import Grid, Mixture
from .diffuse import lambert, local_cosine_directions
from .lobe import LobeKind, LobeView
from .lobes import ALL_LOBES, DELTA_BELOW, DIFFUSE, LOBE_KINDS, LOBES, NEARLY_DIFFUSE, PARTIAL, REFRACTING, present
from .multiscatter import Gains

__all__ = ["LOBE_KINDS", "LOBES", "BsdfTable", "Lobes", "Scattered", "Slot", "evaluate", "sample", "weights", "white_lobe"]

WHITE = Color.of(1.0)
LEAST_ALBEDO = np.float32(0.02)  # as which a lobe counts at least when one is picked: coats and metals that are dark at normal incidence


@dataclass(frozen=True, eq=False)
class Slot:
    """One non-diffuse lobe at n points: kind (n,) int8 (0 where there is none), color (n, 3) of the surface, weight (n,) that the lobe
    has, alpha (n,), ior (n,), and gain, rows of `BsdfTable.gains` for light that bounces more than once between microfacets, 0 where it
    is lost; many (n,) bool: it is kept; edge (n, 3), `Lobe.edge`, None where no material tints it."""

    kind: np.ndarray
    color: np.ndarray
    weight: np.ndarray
    alpha: np.ndarray
    ior: np.ndarray
    gain: Mixture
    many: np.ndarray
    edge: np.ndarray | None = None

    def take(self, which: np.ndarray) -> Slot:
        """The same at a subset of the points."""
        parts = (self.kind, self.color, self.weight, self.alpha, self.ior)
        edge = None if self.edge is None else self.edge[which]
        return Slot(*(a[which] for a in parts), self.gain.take(which), self.many[which], edge)

    @property
    def delta(self) -> np.ndarray:
        """(n,) bool: mirror-like, without a density."""
        return self.alpha < DELTA_BELOW[self.kind]


@dataclass(frozen=True, eq=False)
class Lobes:
    """The BSDF at n surface points seen from `wo` (n, 3): frame of the shading normal and lobe weights.

    entering (n,) bool: seen from outside, so that light which goes through enters the object.
    """

    wo: np.ndarray  # world
    local: np.ndarray  # wo in the frame, z > 0
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    diffuse: np.ndarray
    slots: tuple[Slot, ...]
    entering: np.ndarray
    coating: Coating
    table: BsdfTable

    def take(self, which: np.ndarray) -> Lobes:
        """The same at a subset of the points."""
        slots = tuple(s.take(which) for s in self.slots)
        parts = (self.wo, self.local, self.x, self.y, self.z, self.diffuse)
        return Lobes(*(a[which] for a in parts), slots, self.entering[which], self.coating.take(which), self.table)

    def to_local(self, w: np.ndarray) -> np.ndarray:
        """World directions in the frame."""
        return np.stack([dot_rows(w, self.x), dot_rows(w, self.y), dot_rows(w, self.z)], axis=1)

    def to_world(self, w: np.ndarray) -> np.ndarray:
        """Frame directions in the world."""
        return w[:, :1] * self.x + w[:, 1:2] * self.y + w[:, 2:3] * self.z

    def each(self, which: tuple[np.ndarray, ...]) -> Iterator[tuple[int, LobeKind, np.ndarray, LobeView]]:
        """The lobes of every slot and kind where `which` (one (n,) bool for each slot): slot, kind, rows (m,), and what is there."""
        for i, (slot, here) in enumerate(zip(self.slots, which, strict=True)):
            kind = np.where(here, slot.kind, np.int8(0))
            for k in present(kind):
                rows = np.flatnonzero(kind == k)
                yield i, LOBES[k], rows, self.seen(i, rows)

    def seen(self, i: int, rows: np.ndarray) -> LobeView:
        """Slot `i` in some rows, all of one kind."""
        s = self.slots[i]
        parts = (self.local[rows], s.color[rows], s.alpha[rows], s.ior[rows], s.gain.take(rows), self.entering[rows], s.many[rows])
        return LobeView(*parts, None if s.edge is None else s.edge[rows])

    def albedos(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Where lobes of weight 1 send something else than their colour of uniform light towards wo: slot, rows (m,), and what (m, 3)."""
        for i, kind, rows, seen in self.each(tuple(PARTIAL[s.kind] for s in self.slots)):
            yield i, rows, self._coat_albedo(i, rows) if kind.is_coat else kind.albedo(seen)

    def _coat_albedo(self, i: int, rows: np.ndarray) -> np.ndarray:
        """(m, 3) of the coats in slot `i`."""
        layer = next(x for x in self.coating.layers if x.slot == i)
        return self.slots[i].color[rows] * self.table.coats.at(layer.rows.take(rows), False, self.local[rows, 2])[:, None]

    def without(self, gone: tuple[np.ndarray, ...]) -> Lobes:
        """The same, the slots taken out where `gone` (one (n,) bool for each slot) says so; a coat still dims what lies below it."""
        return replace(self, slots=tuple(replace(s, kind=np.where(g, np.int8(0), s.kind)) for s, g in zip(self.slots, gone, strict=True)))

    def without_diffuse(self, which: np.ndarray) -> Lobes:
        """The same with no diffuse lobe in the rows `which` (n,) bool."""
        return replace(self, diffuse=np.where(which[:, None], np.float32(0), self.diffuse))

    def white(self) -> Lobes:
        """White diffuse surfaces at the same points, without a coat."""
        slots = tuple(replace(s, kind=np.zeros_like(s.kind)) for s in self.slots)
        return replace(self, diffuse=np.ones_like(self.diffuse), slots=slots, coating=Coating())

    def coat(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """(m, 1) or (m, 3), by what share coats dim what the points in some rows send towards wo from below, 0 without a coat."""
        return self.table.coats.albedo(self.coating.take(rows), self.local[rows, 2])

    def others(self) -> np.ndarray:
        """(n,) bool: whether there is any lobe but the diffuse one."""
        out = np.zeros(len(self.wo), bool)
        for slot in self.slots:
            out |= slot.kind > 0
        return out

    def smooth_part(self) -> np.ndarray:
        """(n,) bool: whether any lobe has a density, so that light sampling makes sense."""
        any_ = self.diffuse.max(axis=1) > 0
        for s in self.slots:
            any_ |= (s.kind > 0) & ~s.delta
        return any_

    def rough_passing(self) -> np.ndarray:
        """(n,) bool: whether any lobe spreads light over directions beyond the surface."""
        out = np.zeros(len(self.wo), bool)
        for s in self.slots:
            out |= REFRACTING[s.kind] & ~s.delta
        return out


class BsdfTable:
    """The lobes of every material of a scene; `at` evaluates them at points."""

    def __init__(self, scene: SceneArrays, known: frozenset[str] = ALL_LOBES, straight: bool = False) -> None:
        """Lobes that are nearly diffuse and not `known` are diffuse. `straight`: light that passes straight is a lobe, too, for those who
        do not let their rays pass (`scene.passing`)."""
        taken = tuple({"diffuse"} | NEARLY_DIFFUSE - known)
        left_out = taken if straight else (*taken, STRAIGHT)
        self._material = np.asarray(scene.material, np.int32)
        mats = scene.materials
        others = [[x for x in m.lobes if x.kind in LOBE_KINDS and x.kind not in left_out and not x.is_black] for m in mats]
        self.count = max((len(o) for o in others), default=0)
        self.varies = np.array([any(x.varies for x in o) for o in others] or [False])
        self.diffuse = ColorField([as_diffuse(m, taken) for m in mats], scene)
        self.gains, self.coats = Gains(), Coats()
        self.slots = tuple(SlotFields([o[i] if i < len(o) else None for o in others], scene, self) for i in range(self.count))
        bases = [_bases(m) for m in mats]
        self._shares = {i: CoatShares(slot.coats, bases, scene) for i, slot in enumerate(self.slots) if any(slot.coats)}
        self.coat_channels = 1 if all(x.grey for x in self._shares.values()) else 3

    @property
    def only_diffuse(self) -> bool:
        """Whether no material has any other lobe."""
        return self.count == 0

    @property
    def any_coat(self) -> bool:
        """Whether any material has a coat."""
        return bool(self._shares)

    def coating(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> Coating:
        """What lies over the bases at barycentrics of triangles."""
        material = self._material[triangle]
        return Coating(
            tuple(Layer(i, self.slots[i].coat_rows(material, triangle, u, v), x.at(triangle, u, v)) for i, x in self._shares.items())
        )

    def at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, ns: np.ndarray, side: np.ndarray, wo: np.ndarray) -> Lobes:
        """Lobes at barycentrics of triangles with shading normals `ns` on the side of `wo`; `side` is +1 outside, -1 inside."""
        material = self._material[triangle]
        slots = tuple(slot.at(material, triangle, u, v) for slot in self.slots)
        x, y = frame_rows(ns)
        local = np.stack([dot_rows(wo, x), dot_rows(wo, y), np.maximum(dot_rows(wo, ns), np.float32(1e-4))], axis=1)
        local /= np.sqrt(dot_rows(local, local))[:, None]
        diffuse = np.clip(self.diffuse.at(triangle, u, v), 0, 1)
        return Lobes(wo, local, x, y, ns, diffuse, slots, side > 0, self.coating(triangle, u, v), self)


def _bases(material: Material) -> list[tuple[int, Color]]:
    """Stack and albedo of every lobe that a coat could lie over."""
    below = (x for x in material.lobes if x.kind == LOBES[DIFFUSE].name or x.kind in LOBE_KINDS)
    return [(x.stack, kind.as_diffuse(x)) for x in below if (kind := LOBES[LOBE_KINDS.get(x.kind, DIFFUSE)]).under_coat]


_Grids = dict[int, Grid]  # by material


class SlotFields:
    """One slot of every material: constants in tables, and what varies as fields. Entries of materials without it are None."""

    def __init__(self, lobes: list[Lobe | None], scene: SceneArrays, table: BsdfTable) -> None:
        self.kind = np.array([LOBE_KINDS[x.kind] if x else 0 for x in lobes], np.int8)
        self.color = ColorField([x.color if x else Color() for x in lobes], scene)
        edges = [x.edge if x else WHITE for x in lobes]
        self.edge = ColorField(edges, scene) if any(x != WHITE for x in edges) else None
        self.roughness = ScalarField([x.roughness if x else 1.0 for x in lobes], scene, 0.0, 1.0)
        self.ior = ScalarField([x.ior if x else 1.0 for x in lobes], scene, 1e-3, np.inf)
        self.weight = ScalarField([x.weight if x else 0.0 for x in lobes], scene, 0.0, np.inf)
        # Light that bounces again between microfacets: a row where roughness and index are one, else a grid.
        self.many = np.array([x is not None and x.multiscatter for x in lobes], bool)
        self.coats = [x if x and LOBES[LOBE_KINDS[x.kind]].is_coat else None for x in lobes]
        self._table = table
        self._gain = np.zeros(len(lobes), np.int32)
        self._gains: _Grids = {}
        self._coat = np.zeros(len(lobes), np.int32)
        self._coat_grids: _Grids = {}
        for m, lobe in enumerate(lobes):
            regains = self.many[m] and LOBES[self.kind[m]].regains
            if regains and not lobe.varies:
                self._gain[m] = self.gain_row(m, constant_of(lobe.roughness), constant_of(lobe.ior))
            elif regains:
                passes = LOBES[self.kind[m]].passes
                self._gains[m] = Grid(table.gains, self.roughness.range(m), self.ior.range(m) if passes else None)
            if self.coats[m] and lobe.varies:
                self._coat_grids[m] = Grid(table.coats, self.roughness.range(m), self.ior.range(m))
            elif self.coats[m]:
                self._coat[m] = table.coats.row(constant_of(lobe.roughness), constant_of(lobe.ior))

    def gain_row(self, material: int, roughness: float, ior: float) -> int:
        """Row of the scene's gains for a lobe of one roughness and index."""
        kind = LOBES[self.kind[material]]
        return self._table.gains.row(roughness, ior if kind.passes else None) if self.many[material] and kind.regains else 0

    def at(self, material: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> Slot:
        """The slot at barycentrics of triangles of `material` (n,)."""
        roughness = self.roughness.at(material, triangle, u, v)
        ior = self.ior.at(material, triangle, u, v)
        gain = Mixture((self._gain[material],))
        if self._gains:
            gain = _mixture(self._gains, material, roughness, ior, gain.rows[0])
        weight = self.weight.at(material, triangle, u, v)
        color = self.color.at(triangle, u, v)
        if self.color.varying:
            color = np.clip(color, 0, 1)
        edge = None if self.edge is None else np.clip(self.edge.at(triangle, u, v), 0, 1)
        return Slot(self.kind[material], color, weight, roughness**2, ior, gain, self.many[material], edge)

    def coat_rows(self, material: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> Mixture:
        """Rows of the scene's coats at barycentrics of triangles of `material` (n,), 0 where there is none."""
        row = self._coat[material]
        if not self._coat_grids:
            return Mixture((row,))
        shape = self.roughness.at(material, triangle, u, v), self.ior.at(material, triangle, u, v)
        return _mixture(self._coat_grids, material, *shape, row)


def _mixture(grids: _Grids, material: np.ndarray, roughness: np.ndarray, ior: np.ndarray, rest: np.ndarray) -> Mixture:
    """Rows at points of the materials of `grids`, with their shares; elsewhere the row `rest` (n,)."""
    n = len(material)
    rows, shares = np.zeros((4, n), np.int32), np.zeros((4, n), np.float32)
    rows[0], shares[0] = rest, 1
    for m, grid in grids.items():
        which = np.flatnonzero(material == m)
        mix = grid.mixture(roughness[which], ior[which])
        shares[:, which] = 0
        for k, (row, part) in enumerate(zip(mix.rows, mix.shares, strict=True)):
            rows[k, which], shares[k, which] = row, part
    return Mixture(tuple(rows), tuple(shares))


def white_lobe(number: int, alpha: float, ior: float, wo: np.ndarray, front: bool, table: BsdfTable) -> Lobes:
    """One white lobe of a kind, of single scattering, seen from `wo` (n, 3) in the frame of the axes, from outside or from inside."""
    n = len(wo)
    axes = (np.broadcast_to(np.eye(3, dtype=np.float32)[i], (n, 3)) for i in range(3))
    shape = (np.full(n, x, np.float32) for x in (1.0, alpha, ior))
    slot = Slot(np.full(n, number, np.int8), np.ones((n, 3), np.float32), *shape, Mixture.of(0, n), np.zeros(n, bool))
    coating = Coating((Layer(0, Mixture.of(0, n), np.ones((n, 1), np.float32)),)) if LOBES[number].is_coat else Coating()
    return Lobes(wo, wo, *axes, np.zeros((n, 3), np.float32), (slot,), np.full(n, front), coating, table)


def _below_coat(lobes: Lobes, cosine: np.ndarray) -> np.ndarray | None:
    """(n, 1) or (n, 3) what coats leave for lobes below; `cosine` (n,) of wi. None: no coats."""
    if not lobes.coating.layers:
        return None
    return lobes.table.coats.leaves(lobes.coating, lobes.local[:, 2], cosine)


def weights(lobes: Lobes) -> np.ndarray:
    """(1 + slots, n) probabilities with which `sample` picks the diffuse lobe and each slot; sums to 1 (0 where all black)."""
    p = np.empty((1 + len(lobes.slots), len(lobes.wo)), np.float32)
    p[0] = lobes.diffuse.mean(axis=1)  # inline: see the head of this file
    for i, s in enumerate(lobes.slots):
        p[i + 1] = np.where(s.kind > 0, s.weight * s.color.mean(axis=1), 0)
    for i, rows, albedo in lobes.albedos():
        p[i + 1, rows] = lobes.slots[i].weight[rows] * np.maximum(albedo.mean(axis=1), LEAST_ALBEDO)
    return p / np.maximum(p.sum(axis=0), mf.TINY)


def evaluate(lobes: Lobes, wi: np.ndarray, p: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """f(wo, wi) |cos| (n, 3) float32 and the density pdf_w (n,) with which `sample` finds wi; delta lobes count for nothing."""
    p = weights(lobes) if p is None else p
    w = lobes.to_local(wi)
    # 1. The diffuse lobe, which most points have; inline (see the head of this file).
    up = np.maximum(w[:, 2], 0)
    below = _below_coat(lobes, up)
    value = lambert(lobes.diffuse, up) if below is None else lobes.diffuse * (up[:, None] * below / mf.PI)
    pdf = p[0] * up / mf.PI
    # 2. The others, where they have a density.
    for i, kind, rows, seen in lobes.each(tuple(~s.delta for s in lobes.slots)):
        f, q = kind.evaluate(seen, w[rows])
        f *= gain_factor(kind, seen, w[rows], lobes.table.gains)
        if kind.under_coat and below is not None:
            f *= below[rows]
        value[rows] += f * lobes.slots[i].weight[rows, None]
        pdf[rows] += p[i + 1, rows] * q
    return value.astype(np.float32), pdf.astype(np.float32)


def gain_factor(kind: LobeKind, seen: LobeView, wi: np.ndarray, gains: Gains) -> np.ndarray | np.float32:
    """(m, 3) factor on single scattering that gives back what bounces again between microfacets; 1 where it is lost."""
    if not seen.gain.any():
        return np.float32(1)
    kept = gains.kept(seen.gain, kind.mean(seen.color, seen.edge))
    return 1 + kept * gains.excess(seen.gain, ~seen.entering, seen.wo, wi)[:, None]


@dataclass(frozen=True, eq=False)
class Scattered:
    """Directions drawn by `sample`: wi (n, 3) world, weight (n, 3) = f |cos| / pdf, pdf_w (n,), delta (n,) bool,
    through (n,) bool: wi lies beyond the surface; reflected (n,) uint8: the `RayKind` where it does not. weight 0 ends the walk."""

    wi: np.ndarray
    weight: np.ndarray
    pdf_w: np.ndarray
    delta: np.ndarray
    through: np.ndarray
    reflected: np.ndarray

    @property
    def kind(self) -> np.ndarray:
        """(n,) uint8 `RayKind` of the rays."""
        return np.where(self.through, RayKind.TRANSMISSION, self.reflected)


def sample(lobes: Lobes, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Scattered:
    """Draw a direction at each point: a lobe by its weight, then a direction in it, from `uniform` (4, n) float32 or else from `rng`."""
    n = len(lobes.wo)
    p = weights(lobes)
    r = rng.random((4, n), np.float32) if uniform is None else uniform
    # 1. Pick the lobe.
    pick = (r[0] >= np.cumsum(p, axis=0)).sum(axis=0).clip(0, len(lobes.slots))
    wi = np.zeros((n, 3), np.float32)
    weight = np.zeros((n, 3), np.float32)
    delta = np.zeros(n, bool)
    reflected = np.full(n, LOBES[DIFFUSE].ray_kind)
    # 2. A direction in it: the diffuse lobe first, inline (see the head of this file), then the others.
    rows = np.flatnonzero(pick == 0)
    wi[rows] = local_cosine_directions(r[1:, rows])
    for i, kind, rows, seen in lobes.each(tuple(pick == i + 1 for i in range(len(lobes.slots)))):
        smooth = lobes.slots[i].delta[rows]
        drawn = kind.sample(seen, smooth, r[1:, rows])
        wi[rows], delta[rows], reflected[rows] = drawn.wi, smooth, kind.ray_kind
        found = smooth & drawn.wi.any(axis=1)
        share = drawn.share * lobes.slots[i].weight[rows, None]
        weight[rows] = np.where(found[:, None], share / np.maximum(p[i + 1, rows], mf.TINY)[:, None], 0)
    # 3. Rough and diffuse: the whole BSDF over the whole density.
    world = lobes.to_world(wi)
    dense = np.flatnonzero(~delta & (np.abs(wi[:, 2]) > 0))
    pdf = np.zeros(n, np.float32)
    if len(dense):
        value, q = evaluate(lobes.take(dense), world[dense], p[:, dense])
        weight[dense] = np.where((q > 0)[:, None], value / np.maximum(q, mf.TINY)[:, None], 0)
        pdf[dense] = q
    return Scattered(world.astype(np.float32), weight, pdf, delta, wi[:, 2] < 0, reflected)
