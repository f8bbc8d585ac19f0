"""What surfaces make of the light that arrives on their elements, for any basis of directions: bins or harmonics.

Fields are (2 elements, heard or size, 3): for each side the coefficients of what arrives, or of the radiance that leaves. Each material is
a sum of parts, a grey matrix times a colour of each element, so that textured colours cost nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from ..bsdf import table as bsdf
from ..bsdf.coat import MAX_COAT_SHARE, Coating
from ..bsdf.curves import Mixture, rounded
from ..bsdf.lobes import LOBE_KINDS, LOBES
from ..elements.elements import COLOR_GRID, Elements
from .pairs import PAIRS, Pairs, pairs


class Basis(Protocol):
    """A basis of directions over the hemispheres of all sides. `cut`: sin^2 of the critical angle where light is reflected totally from
    it on, 1 where there is none. size: coefficients of the radiance that leaves a side; heard: of what arrives there, the first of which
    are those."""

    size: int
    heard: int

    def on(self, cut: np.ndarray) -> Self:
        """The basis for sides with `cut` (n,)."""

    def constant(self, value: float = 1.0, cut: float = 1.0) -> np.ndarray:
        """Coefficients (size,) of the radiance `value` in every direction."""

    def even(self) -> np.ndarray:
        """The same of the radiance 1, of all sides: (n, size) or (1, size)."""

    def share(self, cut: float = 1.0) -> np.ndarray:
        """(size,) factors that turn a product with what arrives into a mean over the hemisphere."""

    def irradiance(self, arriving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of a field (n, size, 3) that arrives."""

    def exitance(self, leaving: np.ndarray) -> np.ndarray:
        """(n, 3) W m-2 of a field (n, size, 3) that leaves."""

    def add(self, field: np.ndarray, side: np.ndarray, w: np.ndarray, value: np.ndarray) -> None:
        """Add to `field` light that arrives on sides (m,) along `w` (m, 3) and adds `value` (m, 3) W m-2 to the irradiance."""

    def dimming(self, curve: Callable[[np.ndarray], np.ndarray], cut: float = 1.0) -> np.ndarray:
        """Coefficients (size,) of `curve(cosine)`."""

    def kernels(
        self, sides: Sequence[Pairs], measure: np.ndarray | None, cuts: Sequence[float] = (1.0, 1.0)
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Matrices (2, size, heard) from what arrives on a side and on the other side to what leaves."""

    def basis(self, w: np.ndarray, side: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (n, q) that matter in directions `w` (n, 3) of the frames of sides (n,), and their weights (n, q)."""


AnyBasis = TypeVar("AnyBasis", bound=Basis)
MOST_CUT = 0.95  # sin^2 of critical angles beyond which a side is not parted at them: too little would be left to describe


@dataclass(frozen=True, eq=False)
class Part:
    """One lobe of a material: color (m, 3) of its elements, weight and all, and the matrices of `Basis.kernels`."""

    color: np.ndarray
    same: np.ndarray
    other: np.ndarray | None


@dataclass(frozen=True, eq=False)
class MaterialScattering:
    """A material: its elements (m,), what its diffuse base reflects, and its other lobes.

    The base reflects albedo (m, 3) D D^T, where D = sum of `curves` (c, 2, size) times `dims` (c, m, 1 or 3) is what its coats leave, by
    side and direction; taken (m, 1) or (m, 3): over the mean of that, so that taken D^T of what arrives, in the mean over the hemisphere by
    `share` (2, size), is what reaches the base.
    """

    elements: np.ndarray
    albedo: np.ndarray
    curves: np.ndarray
    dims: np.ndarray
    taken: np.ndarray
    share: np.ndarray
    parts: tuple[Part, ...]

    def reaching(self, x: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """(m, 2, 3) mean radiance that reaches the base of the elements `rows` where `x` (m, 2, size, 3) arrives."""
        mean = sum(
            d[rows, None] * np.einsum("sd,esdc->esc", c * self.share, x[:, :, : c.shape[1]])
            for c, d in zip(self.curves, self.dims, strict=True)
        )
        return mean * self.taken[rows, None]

    def sent(self, mean: np.ndarray, rows: slice) -> np.ndarray:
        """(m, 2, size, 3) radiance of the bases that reach `mean` (m, 2, 3) of it, in the mean."""
        out = mean * self.albedo[rows, None]
        return sum(c[:, :, None] * (d[rows, None] * out)[:, :, None] for c, d in zip(self.curves, self.dims, strict=True))


class Scattering(Generic[AnyBasis]):
    """The scattering of all elements. `prepare` makes it, material by material; those not made yet are black.

    passes (ne,) bool: those that let light through by a lobe.
    basis: the one given, on sides with the critical angles of their materials.
    shiny (ne,) bool: elements of materials that are more than plainly diffuse; clear: whether anything refracts, so that basic
    radiance and radiance differ.
    """

    def __init__(self, elements: Elements, table: bsdf.BsdfTable, basis: AnyBasis, count: int = PAIRS) -> None:
        self.elements, self.table, self.pairs = elements, table, count
        self._material = np.asarray(elements.world.scene.material)[elements.patch_triangle[elements.patch]]
        self._cuts = critical_sines(table)
        self.basis = basis.on(self._cuts[self._material].ravel())
        self.count, self.size = elements.count, self.basis.size
        self.shiny = np.zeros(elements.count, bool)
        self.passes = np.zeros(elements.count, bool)
        self.clear = False
        self.materials: list[MaterialScattering] = []

    @classmethod
    def ready(cls, elements: Elements, table: bsdf.BsdfTable, basis: AnyBasis, count: int = PAIRS) -> Scattering[AnyBasis]:
        """Made and prepared in one call."""
        out = cls(elements, table, basis, count)
        for _ in out.prepare():
            pass
        return out

    def prepare(self) -> Iterator[float]:
        """Find the colours of the elements and the matrices of every material; yields the share done."""
        elements, table, basis = self.elements, self.table, self.basis
        means, groups = _mean_surfaces(elements, table)
        cache: dict[tuple, list[tuple[np.ndarray, np.ndarray | None]]] = {}
        for done, group in enumerate(groups, 1):
            which = group.elements
            parts: list[Part] = []
            for slot, (kind, alpha, ior, gain, many) in enumerate(group.kinds):
                color, weight, edge = means.color[slot][which], means.weight[slot][which, None], means.edge[slot]
                edge = None if edge is None else edge[which]
                if not kind or not weight.any():
                    continue
                shares = [weight * x for x in LOBES[kind].tints(alpha, many, color, edge)]
                if not any(x.any() for x in shares):
                    continue
                self.clear |= LOBES[kind].refracts and ior != 1
                coating = group.coating if LOBES[kind].under_coat and group.coating.any() else None
                cuts = tuple(self._cuts[group.material])
                key = (kind, alpha, ior, gain, cuts, None if coating is None else done)
                if key not in cache:
                    cache[key] = _kernels(basis, *key[:5], table, self.pairs, coating)
                    yield (done - 0.5) / len(groups)
                if gain:
                    kept = table.gains.kept(Mixture.of(gain, len(color)), LOBES[kind].mean(color, edge))
                    shares += [share * kept for share in shares]
                parts += [Part(share, *kernel) for share, kernel in zip(shares, cache[key], strict=True)]
            curves, dims, taken, share = self._base(group, means)
            self.shiny[which] = bool(parts) or len(curves) > 1
            self.passes[which] = any(part.other is not None for part in parts)
            self.materials.append(MaterialScattering(which, means.diffuse[which], curves, dims, taken, share, tuple(parts)))
        yield 1.0

    def _base(self, group: _Group, means: _Means) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """`curves`, `dims`, `taken` and `share` of `MaterialScattering`."""
        coats, m, cuts = self.table.coats, len(group.elements), self._cuts[group.material]
        curves, dims, mean = [np.stack([self.basis.constant(cut=c) for c in cuts])], [np.ones((m, 1))], np.zeros((m, 1))
        for layer, share in zip(group.coating.layers, means.dims, strict=True):
            dim = share[group.elements]
            if not dim.any():
                continue

            def curve(cosine: np.ndarray, rows: Mixture = layer.rows) -> np.ndarray:
                return coats.at(rows.take(np.zeros(len(cosine), int)), False, cosine.astype(np.float32))

            curves.append(np.stack([self.basis.dimming(curve, c) for c in cuts]))
            dims.append(-dim)
            mean = mean + dim * float(coats.mean_at(layer.rows)[0])
        taken = 1 / (1 - np.minimum(mean, MAX_COAT_SHARE))
        return np.stack(curves), np.stack(np.broadcast_arrays(*dims)), taken, np.stack([self.basis.share(c) for c in cuts])

    def apply(self, arriving: np.ndarray, diffuse: bool = True, first: int = 0) -> np.ndarray:
        """(2 m, size, 3) radiance that leaves the elements `first` to `first` + m where `arriving` (2 m, heard, 3) arrives.

        Without `diffuse`, only what the other lobes send.
        """
        return self._sum(arriving, diffuse, first, False)

    def adjoint(self, values: np.ndarray) -> np.ndarray:
        """The adjoint, of all elements: the transposed matrices, between `Basis.share`."""
        return self._sum(values, True, 0, True)

    def _sum(self, x: np.ndarray, diffuse: bool, first: int, transposed: bool) -> np.ndarray:
        m = len(x) // 2
        by_side = x.reshape(m, 2, x.shape[1], 3)
        out = np.zeros((m, 2, self.size, 3))
        for material in self.materials:
            a, b = np.searchsorted(material.elements, (first, first + m))
            at = material.elements[a:b] - first
            if a == b:
                continue
            here = by_side[at]
            total = np.zeros((b - a, 2, self.size, 3))
            share = material.share[:, :, None] if transposed else np.ones(1)
            if diffuse:
                total += share * material.sent(material.reaching(here, slice(a, b)), slice(a, b))
            here = share * here
            for part in material.parts:
                color = part.color[a:b, None]
                for side in (0, 1):
                    total[:, side] += color * _product(part.same[side], here[:, side], transposed)
                    if part.other is not None:
                        kernel = part.other[1 - side if transposed else side]
                        total[:, side] += color * _product(kernel, here[:, 1 - side], transposed)
            out[at] = total / share
        return out.reshape(2 * m, self.size, 3)

    def below_coat(self, arriving: np.ndarray) -> np.ndarray:
        """(2 ne, 3) irradiance that reaches the diffuse base, so that its radiance is albedo / pi times what the coat leaves of it."""
        out = np.zeros((self.count, 2, 3))
        by_side = arriving.reshape(self.count, 2, self.basis.heard, 3)
        for material in self.materials:
            out[material.elements] = np.pi * material.reaching(by_side[material.elements])
        return out.reshape(-1, 3)


def critical_sines(table: bsdf.BsdfTable) -> np.ndarray:
    """(materials, 2) sin^2 of the angle from which on light is reflected totally, in front and behind: of the first lobe that refracts, in
    the middle of the indices that it has. 1 where nothing is, or next to nothing."""
    out = np.ones((len(table.varies), 2))
    for slot in reversed(table.slots):
        for m in np.flatnonzero([LOBES[k].refracts for k in slot.kind]):
            ior = np.mean(slot.ior.range(m))
            cut = min(ior, 1 / ior) ** 2
            if cut <= MOST_CUT and slot.weight.range(m)[1] > 0:
                out[m] = (1.0, cut) if ior > 1 else (cut, 1.0)
    return out


def _product(kernel: np.ndarray, x: np.ndarray, transposed: bool) -> np.ndarray:
    """kernel (size, heard) @ x (m, heard, 3), or its transpose, as one matrix product."""
    m, heard, _ = x.shape
    flat = x.transpose(0, 2, 1).reshape(3 * m, heard) @ (kernel if transposed else kernel.T)
    return flat.reshape(m, 3, -1).transpose(0, 2, 1)


def _kernels(
    basis: Basis,
    kind: int,
    alpha: float,
    ior: float,
    gain: int,
    cuts: tuple[float, float],
    table: bsdf.BsdfTable,
    count: int,
    coating: Coating | None,
) -> list:
    """One pair of matrices for each part of the lobe that has a colour of its own (`LobeKind.tints`). The same once more, where there
    is a gain, for what bounces more than once between microfacets. `coating`: of one point, what lies over the lobe; grey here.
    """
    lobe = LOBES[kind]
    measure = np.array([1.0, ior * ior if lobe.refracts else 1.0])
    name, width = lobe.split(alpha)
    front = pairs(LOBE_KINDS[name], width, ior, True, table, count)
    back = front if lobe.two_sided else pairs(LOBE_KINDS[name], width, ior, False, table, count)
    if coating is not None:
        front, back = (
            p.times(table.coats.leaves(coating.take(np.zeros(len(p.given), int)), p.given[:, 2], p.other[:, 2]).mean(axis=1))
            for p in (front, back)
        )
    shares = list(zip(*(lobe.factors(alpha, p.given, p.other) for p in (front, back)), strict=True))
    if gain:
        more = (front.excess(table.gains, gain, False), back.excess(table.gains, gain, True))
        shares += [(a * more[0], b * more[1]) for a, b in shares]
    return [basis.kernels((front.times(a), back.times(b)), measure, cuts) for a, b in shares]


@dataclass(frozen=True, eq=False)
class _Group:
    """Elements (m,) of one material and of one shape of its lobes: (kind, alpha, ior, row of gains, many) of every slot, and its coat."""

    material: int
    elements: np.ndarray
    kinds: list[tuple[int, float, float, int, bool]]
    coating: Coating


@dataclass(frozen=True, eq=False)
class _Means:
    """Means over elements, float64: diffuse (ne, 3), albedo of the base; of every slot weight (ne,), and by the weight color (ne, 3) and
    edge, (ne, 3) or None; of every layer of coats dims (ne, 1 or 3), `coat.Layer.share`."""

    diffuse: np.ndarray
    weight: list[np.ndarray]
    color: list[np.ndarray]
    edge: list[np.ndarray | None]
    dims: list[np.ndarray]


def _mean_surfaces(elements: Elements, table: bsdf.BsdfTable) -> tuple[_Means, list[_Group]]:
    """The means, and the elements in groups that scatter alike.

    Where roughness or index vary over a material, an element has the mean of its points, rounded to the grid of `curves`.
    """
    scene = elements.world.scene
    even = all(x.is_even for m in scene.materials for x in m.lobes)
    steps = [0.25] if even else (np.arange(COLOR_GRID) + 0.5) / COLOR_GRID
    diffuse, weight, color, dims = np.zeros((elements.count, 3)), [0.0] * table.count, [0.0] * table.count, {}
    edge: list[np.ndarray | None] = [None] * table.count
    shapes = np.zeros((elements.count, table.count, 2))
    index = np.arange(elements.count)
    for a in steps:
        for b in steps:
            surface = elements.world.surface(*elements.point(index, np.full(len(index), a), np.full(len(index), b)))
            lobes = table.at(surface.triangle, surface.u, surface.v, surface.ng, surface.side, surface.ng)
            diffuse += lobes.diffuse / len(steps) ** 2
            for k, layer in enumerate(lobes.coating.layers):
                dims[k] = dims.get(k, 0.0) + layer.share / len(steps) ** 2
            for k, slot in enumerate(lobes.slots):
                weight[k] = weight[k] + slot.weight.astype(float) / len(steps) ** 2
                color[k] = color[k] + slot.color * slot.weight[:, None].astype(float) / len(steps) ** 2
                if slot.edge is not None:
                    edge[k] = (0.0 if edge[k] is None else edge[k]) + slot.edge * slot.weight[:, None].astype(float) / len(steps) ** 2
                shapes[:, k] += np.stack([np.sqrt(slot.alpha), slot.ior], axis=1) / len(steps) ** 2
    own = np.asarray(scene.material)[surface.triangle]
    groups = []
    for material in np.unique(own):
        which = np.flatnonzero(own == material)
        if table.varies[material]:
            groups += _shaped(which, int(material), shapes[which], lobes, table)
        else:
            e = which[0]
            kinds = [(int(s.kind[e]), float(s.alpha[e]), float(s.ior[e]), int(s.gain.rows[0][e]), bool(s.many[e])) for s in lobes.slots]
            groups.append(_Group(int(material), which, kinds, lobes.coating.take(which[:1])))
    color = [c / np.maximum(w, 1e-20)[:, None] for c, w in zip(color, weight, strict=True)]
    edge = [e if e is None else e / np.maximum(w, 1e-20)[:, None] for e, w in zip(edge, weight, strict=True)]
    return _Means(diffuse, weight, color, edge, [dims[k] for k in sorted(dims)]), groups


def _shaped(which: np.ndarray, material: int, shapes: np.ndarray, lobes: bsdf.Lobes, table: bsdf.BsdfTable) -> list[_Group]:
    """The elements `which` (m,) of a material in groups of one rounded shape; shapes (m, slots, 2): roughness and index."""
    near = np.stack(rounded(shapes[..., 0], shapes[..., 1]), axis=-1)
    found, group = np.unique(near.reshape(len(which), -1), axis=0, return_inverse=True)
    out = []
    for g, shape in enumerate(found.reshape(len(found), -1, 2)):
        at = which[np.flatnonzero(group.ravel() == g)]
        kinds = []
        for slot, fields, (roughness, ior) in zip(lobes.slots, table.slots, shape, strict=True):
            gain = fields.gain_row(material, float(roughness), float(ior))
            kinds.append((int(slot.kind[at[0]]), float(roughness**2), float(ior), gain, bool(slot.many[at[0]])))
        out.append(_Group(material, at, kinds, lobes.coating.take(at[:1])))
    return out
