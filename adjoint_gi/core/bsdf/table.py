"""Scattering at surfaces: any sum of the lobe kinds of `lobes.py`.

Three functions, as in Nori and pbrt: `evaluate` (f times cosine, and pdf_w), `sample`, and `Lobes` that prepares both.
Radiance is carried as basic radiance (divided by the index squared), so one set of formulas serves gathering and shooting:
T and T* differ only in which of the two directions is given.

Limits: roughness and index are constant over a material; a coat loses what bounces more than once between its microfacets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..scene.arrays import Color, Lobe, SceneArrays
from ..scene.shading import ColorField
from . import microfacet as mf
from .diffuse import cosine_directions, lambert
from .lobe import DELTA_ALPHA, LobeKind, Seen
from .lobes import ALL_LOBES, DELTA_BELOW, KINDS, LOBES, PARTIAL, REFRACTING, present
from .multiscatter import Gains

__all__ = ["ALL_LOBES", "KINDS", "LOBES", "BsdfTable", "Lobes", "Scattered", "Slot", "evaluate", "frame", "sample", "weights"]

MU = 32  # entries of the coat's albedo over the cosine


@dataclass(frozen=True, eq=False)
class Slot:
    """One non-diffuse lobe at n points: kind (n,) int8 (0 where there is none), color (n, 3), alpha (n,), ior (n,), and gain (n,)
    int32, the row of `BsdfTable.gains` for light that bounces more than once between microfacets, 0 where it is lost."""

    kind: np.ndarray
    color: np.ndarray
    alpha: np.ndarray
    ior: np.ndarray
    gain: np.ndarray

    def take(self, which: np.ndarray) -> Slot:
        """The same at a subset of the points."""
        return Slot(self.kind[which], self.color[which], self.alpha[which], self.ior[which], self.gain[which])

    @property
    def delta(self) -> np.ndarray:
        """(n,) bool: mirror-like, without a density."""
        return self.alpha < DELTA_BELOW[self.kind]


@dataclass(frozen=True, eq=False)
class Lobes:
    """The BSDF at n surface points seen from `wo` (n, 3): frame of the shading normal and lobe weights.

    entering (n,) bool: seen from outside, so that light which goes through enters the object.
    material (n,) int32: row of the coat table, -1 for no coat.
    """

    wo: np.ndarray  # world
    local: np.ndarray  # wo in the frame, z > 0
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    diffuse: np.ndarray
    slots: tuple[Slot, ...]
    entering: np.ndarray
    material: np.ndarray
    table: BsdfTable

    def take(self, which: np.ndarray) -> Lobes:
        """The same at a subset of the points."""
        slots = tuple(s.take(which) for s in self.slots)
        parts = (self.wo, self.local, self.x, self.y, self.z, self.diffuse)
        return Lobes(*(a[which] for a in parts), slots, self.entering[which], self.material[which], self.table)

    def to_local(self, w: np.ndarray) -> np.ndarray:
        """World directions in the frame."""
        return np.stack([mf.dot(w, self.x), mf.dot(w, self.y), mf.dot(w, self.z)], axis=1)

    def to_world(self, w: np.ndarray) -> np.ndarray:
        """Frame directions in the world."""
        return w[:, :1] * self.x + w[:, 1:2] * self.y + w[:, 2:3] * self.z

    def each(self, which: tuple[np.ndarray, ...]) -> Iterator[tuple[int, LobeKind, np.ndarray, Seen]]:
        """The lobes of every slot and kind where `which` (one (n,) bool for each slot): slot, kind, rows (m,), and what is there."""
        for i, (slot, here) in enumerate(zip(self.slots, which, strict=True)):
            kind = np.where(here, slot.kind, np.int8(0))
            for k in present(kind):
                rows = np.flatnonzero(kind == k)
                yield i, LOBES[k], rows, self.seen(i, rows)

    def seen(self, i: int, rows: np.ndarray) -> Seen:
        """Slot `i` in some rows, all of one kind."""
        s = self.slots[i]
        return Seen(self.local[rows], s.color[rows], s.alpha[rows], s.ior[rows], s.gain[rows], self.entering[rows])

    def albedos(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Where lobes reflect only a part of their colour towards wo: slot, rows (m,), and the part (m,)."""
        for i, kind, rows, seen in self.each(tuple(PARTIAL[s.kind] for s in self.slots)):
            yield i, rows, self.coat(rows) if kind.is_coat else kind.albedo(seen)

    def without(self, gone: tuple[np.ndarray, ...]) -> Lobes:
        """The same, the slots taken out where `gone` (one (n,) bool for each slot) says so; a coat still dims what lies below it."""
        return replace(self, slots=tuple(replace(s, kind=np.where(g, np.int8(0), s.kind)) for s, g in zip(self.slots, gone, strict=True)))

    def without_diffuse(self, which: np.ndarray) -> Lobes:
        """The same with no diffuse lobe in the rows `which` (n,) bool."""
        return replace(self, diffuse=np.where(which[:, None], np.float32(0), self.diffuse))

    def white(self) -> Lobes:
        """White diffuse surfaces at the same points, without a coat."""
        slots = tuple(replace(s, kind=np.zeros_like(s.kind)) for s in self.slots)
        return replace(self, diffuse=np.ones_like(self.diffuse), slots=slots, material=np.full_like(self.material, -1))

    def coat(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """(m,) albedo towards wo of what coats the points in some rows, 0 without a coat."""
        return self.table.coat_at(self.material[rows], self.local[rows, 2])

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

    def __init__(self, scene: SceneArrays) -> None:
        self._material = np.asarray(scene.material, np.int32)
        mats = scene.materials
        others = [[x for x in m.lobes if x.kind in KINDS and not x.color.is_black] for m in mats]
        self.count = max((len(o) for o in others), default=0)
        self._diffuse = ColorField([m.total("diffuse") for m in mats], scene)
        self._slots = []
        self.gains = Gains()

        for i in range(self.count):
            lobes = [o[i] if i < len(o) else None for o in others]
            kind = np.array([KINDS[x.kind] if x else 0 for x in lobes], np.int8)
            rough = np.array([x.roughness if x else 1.0 for x in lobes], np.float32)
            ior = np.array([x.ior if x else 1.0 for x in lobes], np.float32)
            color = ColorField([x.color if x else Color() for x in lobes], scene)
            self._slots.append((kind, rough**2, ior, np.array([self._gain(x) for x in lobes], np.int32), color))
        self.coat, self.coat_mean = self._coats(others)

    @property
    def only_diffuse(self) -> bool:
        """Whether no material has any other lobe."""
        return self.count == 0

    def _gain(self, lobe: Lobe | None) -> int:
        """Row of `gains` for a lobe."""
        return 0 if lobe is None else LOBES[KINDS[lobe.kind]].gain_row(lobe, self.gains)

    def _coats(self, others: list) -> tuple[np.ndarray, np.ndarray]:
        """Albedo of each material's dielectric coat over the cosine, (nm, MU), and its cosine-weighted mean (nm,)."""
        table = np.zeros((max(len(others), 1), MU), np.float32)
        mu = ((np.arange(MU) + 0.5) / MU).astype(np.float32)
        for i, lobes in enumerate(others):
            for lobe in lobes:
                if LOBES[KINDS[lobe.kind]].is_coat:
                    tint = float(np.mean(lobe.color.constant)) if lobe.color.is_constant else 1.0
                    table[i] += tint * coat_albedo(mu, lobe.roughness, lobe.ior)
        table = np.minimum(table, np.float32(0.999))
        # A last row of zeros stands for no material: index -1 is a surface without a coat.
        table = np.concatenate([table, np.zeros((1, MU), np.float32)])
        return table, (table * (2 * mu / MU)).sum(axis=1)

    def coat_at(self, material: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """(n,) coat albedo at a cosine, linear between entries."""
        i, f = mf.cosine_entry(cosine, MU)
        return self.coat[material, i] * (1 - f) + self.coat[material, i + 1] * f

    def at(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, ns: np.ndarray, side: np.ndarray, wo: np.ndarray) -> Lobes:
        """Lobes at barycentrics of triangles with shading normals `ns` on the side of `wo`; `side` is +1 outside, -1 inside."""
        material = self._material[triangle]
        slots = tuple(Slot(k[material], c.at(triangle, u, v), a[material], i[material], g[material]) for k, a, i, g, c in self._slots)
        x, y = frame(ns)
        local = np.stack([mf.dot(wo, x), mf.dot(wo, y), np.maximum(mf.dot(wo, ns), np.float32(1e-4))], axis=1)
        local /= np.sqrt(mf.dot(local, local))[:, None]
        diffuse = np.clip(self._diffuse.at(triangle, u, v), 0, 1)
        return Lobes(wo, local, x, y, ns, diffuse, slots, side > 0, material, self)


def frame(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) that make a right-handed frame with n (Duff et al. 2017)."""
    s = np.where(n[:, 2] < 0, np.float32(-1), np.float32(1))
    a = -1 / (s + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    x = np.stack([1 + s * n[:, 0] ** 2 * a, s * b, -s * n[:, 0]], axis=1)
    y = np.stack([b, s + n[:, 1] ** 2 * a, -n[:, 1]], axis=1)
    return x, y


def coat_albedo(mu: np.ndarray, roughness: float, ior: float) -> np.ndarray:
    """(m,) albedo of a rough dielectric's reflection at cosines `mu` (m,), by quadrature over visible normals."""
    grid = 32
    a, b = np.meshgrid((np.arange(grid) + 0.5) / grid, (np.arange(grid) + 0.5) / grid)
    m = np.repeat(mu, grid * grid)
    alpha = np.full(len(m), max(roughness**2, float(DELTA_ALPHA)), np.float32)
    wo = np.stack([np.sqrt(1 - m * m), np.zeros_like(m), m], axis=1)
    h = mf.visible_normal(wo, alpha, np.tile(a.ravel(), len(mu)).astype(np.float32), np.tile(b.ravel(), len(mu)).astype(np.float32))
    wi = mf.reflect(wo, h)
    value = mf.masking(wo, wi, alpha) * (1 + mf.smith_lambda(wo, alpha)) * mf.fresnel(mf.dot(wo, h), np.full(len(m), ior, np.float32))
    return np.where(wi[:, 2] > 0, value, 0).reshape(len(mu), -1).mean(axis=1)


def _below_coat(lobes: Lobes, cosine: np.ndarray) -> np.ndarray | None:
    """(n,) what coats leave for lobes below, reciprocal in wo and wi (Ashikhmin et al. 2000); `cosine` (n,) of wi. None: no coats."""
    table = lobes.table
    if not table.coat.any():
        return None
    out = 1 - lobes.coat()
    back = 1 - table.coat_at(lobes.material, cosine)
    return out * back / (1 - table.coat_mean[lobes.material])


def weights(lobes: Lobes) -> np.ndarray:
    """(1 + slots, n) probabilities with which `sample` picks the diffuse lobe and each slot; sums to 1 (0 where all black)."""
    p = np.empty((1 + len(lobes.slots), len(lobes.wo)), np.float32)
    p[0] = lobes.diffuse.mean(axis=1)
    for i, s in enumerate(lobes.slots):
        p[i + 1] = np.where(s.kind > 0, s.color.mean(axis=1), 0)
    for i, rows, albedo in lobes.albedos():
        p[i + 1, rows] *= np.maximum(albedo, np.float32(0.02))
    return p / np.maximum(p.sum(axis=0), mf.TINY)


def evaluate(lobes: Lobes, wi: np.ndarray, p: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """f(wo, wi) |cos| (n, 3) float32 and the density pdf_w (n,) with which `sample` finds wi; delta lobes count for nothing."""
    p = weights(lobes) if p is None else p
    w = lobes.to_local(wi)
    # 1. The diffuse lobe, which most points have.
    up = np.maximum(w[:, 2], 0)
    below = _below_coat(lobes, up)
    value = lambert(lobes.diffuse, up if below is None else up * below)
    pdf = p[0] * up / mf.PI
    # 2. The others, where they have a density.
    for i, kind, rows, seen in lobes.each(tuple(~s.delta for s in lobes.slots)):
        f, q = kind.evaluate(seen, w[rows])
        f *= gain_factor(kind, seen, w[rows], lobes.table.gains)
        if kind.under_coat and below is not None:
            f *= below[rows, None]
        value[rows] += f
        pdf[rows] += p[i + 1, rows] * q
    return value.astype(np.float32), pdf.astype(np.float32)


def gain_factor(kind: LobeKind, seen: Seen, wi: np.ndarray, gains: Gains) -> np.ndarray | np.float32:
    """(m, 3) factor on single scattering that gives back what bounces again between microfacets; 1 where it is lost."""
    if not seen.gain.any():
        return np.float32(1)
    kept = gains.kept(seen.gain, kind.mean(seen.color))
    return 1 + kept * gains.excess(seen.gain, ~seen.entering, seen.wo, wi)[:, None]


@dataclass(frozen=True, eq=False)
class Scattered:
    """Directions drawn by `sample`: wi (n, 3) world, weight (n, 3) = f |cos| / pdf, pdf_w (n,), delta (n,) bool,
    through (n,) bool: wi lies beyond the surface. weight 0 ends the walk."""

    wi: np.ndarray
    weight: np.ndarray
    pdf_w: np.ndarray
    delta: np.ndarray
    through: np.ndarray


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
    # 2. A direction in it: the diffuse lobe first, then the others.
    rows = np.flatnonzero(pick == 0)
    wi[rows] = cosine_directions(r[1:, rows])
    for i, kind, rows, seen in lobes.each(tuple(pick == i + 1 for i in range(len(lobes.slots)))):
        smooth = lobes.slots[i].delta[rows]
        drawn = kind.sample(seen, smooth, r[1:, rows])
        wi[rows], delta[rows] = drawn.wi, smooth
        found = smooth & drawn.wi.any(axis=1)
        weight[rows] = np.where(found[:, None], drawn.share / np.maximum(p[i + 1, rows], mf.TINY)[:, None], 0)
    # 3. Rough and diffuse: the whole BSDF over the whole density.
    world = lobes.to_world(wi)
    dense = np.flatnonzero(~delta & (np.abs(wi[:, 2]) > 0))
    pdf = np.zeros(n, np.float32)
    if len(dense):
        value, q = evaluate(lobes.take(dense), world[dense], p[:, dense])
        weight[dense] = np.where((q > 0)[:, None], value / np.maximum(q, mf.TINY)[:, None], 0)
        pdf[dense] = q
    return Scattered(world.astype(np.float32), weight, pdf, delta, wi[:, 2] < 0)
