"""Scattering at surfaces: any sum of diffuse, glossy, metallic, coated, glass, refracting and transparent lobes.

Three functions, as in Nori and pbrt: `evaluate` (f times cosine, and pdf_w), `sample`, and `Lobes` that prepares both.
Radiance is carried as basic radiance (divided by the index squared), so one set of formulas serves gathering and shooting:
T and T* differ only in which of the two directions is given.

Limits: roughness and index are constant over a material; a coat loses what bounces more than once between its microfacets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.arrays import Color, Lobe, SceneArrays
from ..scene.shading import ColorField
from . import microfacet as mf
from .multiscatter import Gains

GLOSSY, METALLIC, SPECULAR, GLASS, REFRACTION, TRANSPARENT, DIELECTRIC = range(1, 8)
KINDS = {
    "glossy": GLOSSY,
    "metallic": METALLIC,
    "specular": SPECULAR,
    "glass": GLASS,
    "refraction": REFRACTION,
    "transparent": TRANSPARENT,
    "dielectric": DIELECTRIC,
}
ALL_LOBES = frozenset(("diffuse", *KINDS))
# Lobes narrower than this are perfect mirrors: float32 cannot hold their peak.
DELTA_ALPHA = np.float32(1e-3)
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
        return (self.alpha < DELTA_ALPHA) | (self.kind == TRANSPARENT)


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

    def smooth_part(self) -> np.ndarray:
        """(n,) bool: whether any lobe has a density, so that light sampling makes sense."""
        any_ = self.diffuse.max(axis=1) > 0
        for s in self.slots:
            any_ |= (s.kind > 0) & ~s.delta
        return any_


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
        if lobe is None or not lobe.multiscatter or lobe.kind not in ("glossy", "metallic", "glass"):
            return 0
        return self.gains.row(lobe.roughness, lobe.ior if lobe.kind == "glass" else None)

    def _coats(self, others: list) -> tuple[np.ndarray, np.ndarray]:
        """Albedo of each material's dielectric coat over the cosine, (nm, MU), and its cosine-weighted mean (nm,)."""
        table = np.zeros((max(len(others), 1), MU), np.float32)
        mu = ((np.arange(MU) + 0.5) / MU).astype(np.float32)
        for i, lobes in enumerate(others):
            for lobe in lobes:
                if lobe.kind == "specular":
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


def reflectance(kind: np.ndarray, slot: Slot, cosine: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """(n, 3) share of light that a facet reflects, by the lobe's kind."""
    out = slot.color.copy()
    which = kind == METALLIC
    if which.any():
        out[which] = mf.schlick(cosine[which], slot.color[which])
    which = (kind == SPECULAR) | (kind == GLASS) | (kind == DIELECTRIC)
    if which.any():
        out[which] = slot.color[which] * mf.fresnel(cosine[which], eta[which])[:, None]
    out[(kind == REFRACTION) | (kind == TRANSPARENT)] = 0
    return out


def relative_ior(lobes: Lobes, slot: Slot) -> np.ndarray:
    """Index beyond the surface over the index on the side of wo. A coat is never seen from inside: it lies on both sides."""
    inside = ~lobes.entering & (slot.kind != SPECULAR)
    return np.where(inside, 1 / slot.ior, slot.ior).astype(np.float32)


def _diffuse_scale(lobes: Lobes, cos_i: np.ndarray) -> np.ndarray:
    """(n,) what a coat leaves for the diffuse base below, reciprocal in wo and wi (Ashikhmin et al. 2000)."""
    table = lobes.table
    if not table.coat.any():
        return np.ones(len(cos_i), np.float32)
    out = 1 - table.coat_at(lobes.material, lobes.local[:, 2])
    back = 1 - table.coat_at(lobes.material, cos_i)
    return out * back / (1 - table.coat_mean[lobes.material])


def boundary_share(lobes: Lobes, slot: Slot) -> np.ndarray:
    """(n,) Fresnel reflectance of a smooth boundary seen from wo."""
    return mf.fresnel(lobes.local[:, 2], relative_ior(lobes, slot))


def weights(lobes: Lobes) -> np.ndarray:
    """(1 + slots, n) probabilities with which `sample` picks the diffuse lobe and each slot; sums to 1 (0 where all black)."""
    p = np.empty((1 + len(lobes.slots), len(lobes.wo)), np.float32)
    p[0] = lobes.diffuse.mean(axis=1)
    for i, s in enumerate(lobes.slots):
        p[i + 1] = np.where(s.kind > 0, s.color.mean(axis=1), 0)
        coat = s.kind == SPECULAR
        if coat.any():
            at = lobes.table.coat_at(lobes.material[coat], lobes.local[coat, 2])
            p[i + 1, coat] *= np.maximum(at, np.float32(0.02))
        boundary = s.kind == DIELECTRIC
        if boundary.any():
            p[i + 1, boundary] *= np.maximum(boundary_share(lobes, s)[boundary], np.float32(0.02))
    return p / np.maximum(p.sum(axis=0), mf.TINY)


def evaluate(lobes: Lobes, wi: np.ndarray, p: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """f(wo, wi) |cos| (n, 3) float32 and the density pdf_w (n,) with which `sample` finds wi; delta lobes count for nothing."""
    p = weights(lobes) if p is None else p
    w = lobes.to_local(wi)
    up = np.maximum(w[:, 2], 0)
    value = lobes.diffuse * (up * _diffuse_scale(lobes, up) / mf.PI)[:, None]
    pdf = p[0] * up / mf.PI
    for i, slot in enumerate(lobes.slots):
        which = np.flatnonzero((slot.kind > 0) & ~slot.delta)
        if len(which):
            part = slot.take(which)
            f, q = _evaluate_slot(lobes.local[which], w[which], part, relative_ior(lobes, slot)[which])
            if part.gain.any():
                f *= _multiple(lobes.table.gains, part, ~lobes.entering[which], lobes.local[which], w[which])
            value[which] += f
            pdf[which] += p[i + 1, which] * q
    return value.astype(np.float32), pdf.astype(np.float32)


def mean_reflectance(kind: np.ndarray, color: np.ndarray) -> np.ndarray:
    """(n, 3) what facets reflect and pass in the mean over all angles: of Schlick's reflectance the mean is f0 + (1 - f0) / 21."""
    return np.where((kind == METALLIC)[:, None], color + (1 - color) / 21, color)


def _multiple(gains: Gains, slot: Slot, inside: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """(n, 3) factor on single scattering that gives back what bounces again between microfacets."""
    kept = gains.kept(slot.gain, mean_reflectance(slot.kind, slot.color))
    return 1 + kept * gains.excess(slot.gain, inside, wo, wi)[:, None]


def _evaluate_slot(wo: np.ndarray, wi: np.ndarray, slot: Slot, eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f |cos| and pdf_w of one rough lobe, reflecting above the surface and transmitting below."""
    value = np.zeros((len(wo), 3), np.float32)
    pdf = np.zeros(len(wo), np.float32)
    above = np.flatnonzero((wi[:, 2] > 0) & (slot.kind != REFRACTION))
    if len(above):
        o, i, a, e = wo[above], wi[above], slot.alpha[above], eta[above]
        part = slot.take(above)
        h = o + i
        h /= np.maximum(np.sqrt(mf.dot(h, h)), mf.TINY)[:, None]
        c = mf.dot(o, h)
        share = reflectance(part.kind, part, c, e)
        value[above] = share * (mf.distribution(h, a) * mf.masking(o, i, a) / (4 * o[:, 2]))[:, None]
        # A glass lobe reflects with probability Fresnel, the others always.
        q = np.where(part.kind == GLASS, mf.fresnel(c, e), np.float32(1))
        pdf[above] = q * mf.visible_pdf(o, h, a) / np.maximum(4 * c, np.float32(1e-7))
    below = np.flatnonzero((wi[:, 2] < 0) & ((slot.kind == GLASS) | (slot.kind == REFRACTION)))
    if len(below):
        o, i, a, e = wo[below], wi[below], slot.alpha[below], eta[below]
        h = -(o + e[:, None] * i)
        h *= np.where(h[:, 2] < 0, np.float32(-1), np.float32(1))[:, None]
        h /= np.maximum(np.sqrt(mf.dot(h, h)), mf.TINY)[:, None]
        co, ci = mf.dot(o, h), mf.dot(i, h)
        good = (co > 0) & (ci < 0)
        f = np.where(slot.kind[below] == GLASS, mf.fresnel(co, e), np.float32(0))
        # dw_h / dw_i with the index on the side of wi: Walter et al. 2007, Eq. 17.
        jacobian = e * e * np.abs(ci) / np.maximum((co + e * ci) ** 2, np.float32(1e-12))
        d = mf.distribution(h, a)
        g = 1 / (1 + mf.smith_lambda(o, a)) / (1 + mf.smith_lambda(i, a))
        value[below] = slot.color[below] * np.where(good, np.abs(co) * jacobian * (1 - f) * g * d / o[:, 2], 0)[:, None]
        pdf[below] = np.where(good, (1 - f) * mf.visible_pdf(o, h, a) * jacobian, 0)
    return value, pdf


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
    # 2. Diffuse: cosine law.
    phi, s = 2 * mf.PI * r[1], np.sqrt(r[2])
    z = np.sqrt(np.maximum(1 - r[2], 0))
    cosine = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1)
    wi[pick == 0] = cosine[pick == 0]
    # 3. The others: a facet, then reflection or transmission at it.
    for i, slot in enumerate(lobes.slots):
        which = np.flatnonzero((pick == i + 1) & (slot.kind > 0))
        if not len(which):
            continue
        part = slot.take(which)
        d = part.delta
        eta = relative_ior(lobes, slot)[which]
        o = lobes.local[which]
        h = mf.visible_normal(o, part.alpha, r[1, which], r[2, which])
        h[d] = (0, 0, 1)
        c = mf.dot(o, h)
        f = np.where(part.kind == GLASS, mf.fresnel(c, eta), np.float32(part.kind != REFRACTION))
        go = (r[3, which] >= f) & ((part.kind == GLASS) | (part.kind == REFRACTION))
        t, total = mf.refract(o, h, eta)
        w = np.where(go[:, None], t, mf.reflect(o, h))
        straight = part.kind == TRANSPARENT
        w[straight] = -o[straight]
        lost = (go & total) | (~go & ~straight & (w[:, 2] <= 0)) | (go & (w[:, 2] >= 0))
        wi[which] = w
        # Delta lobes: the choice between reflection and transmission cancels the Fresnel share.
        share = np.where((part.kind == GLASS)[:, None], part.color, reflectance(part.kind, part, c, eta))
        share = np.where((go | straight)[:, None], part.color, share)
        weight[which] = np.where((d & ~lost)[:, None], share / np.maximum(p[i + 1, which], mf.TINY)[:, None], 0)
        delta[which] = d
        wi[which[lost]] = 0
    # 4. Rough and diffuse: the whole BSDF over the whole density.
    world = lobes.to_world(wi)
    smooth = np.flatnonzero(~delta & (np.abs(wi[:, 2]) > 0))
    pdf = np.zeros(n, np.float32)
    if len(smooth):
        value, q = evaluate(lobes.take(smooth), world[smooth], p[:, smooth])
        weight[smooth] = np.where((q > 0)[:, None], value / np.maximum(q, mf.TINY)[:, None], 0)
        pdf[smooth] = q
    return Scattered(world.astype(np.float32), weight, pdf, delta, wi[:, 2] < 0)
