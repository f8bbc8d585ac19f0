"""From irradiance on element sides to answers at receivers: texels, vertices, camera pixels or the elements themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..base.parallel import in_order
from ..lights.emitters import Emitters
from ..receivers.base import Points, Receivers
from ..scene.world import Surface, World
from ..walks.gathering import sliced
from ..walks.sight import seen_at_once
from .elements import Elements
from .refinement import RefinedElements, over_base

# Irradiance (n, 3) of surfaces, half of what its two halves differ by (n, 3), and the number of rays it took, for direct light evaluated
# at the receivers themselves.
Gather = Callable[[Surface, np.random.Generator], tuple[np.ndarray, np.ndarray, int]]

PIECE = 1 << 13  # receiver points in one piece of work when direct light is evaluated at them


@dataclass(frozen=True, eq=False)
class Parts:
    """The arrays of a `Solution`, one row a receiver, as its fields describe them; `rays` were cast to find them.

    spread: (n, 3) of direct light that was evaluated at the receivers, half of what its two halves differ by; None where it was not.
    """

    emitted: np.ndarray
    direct: np.ndarray
    indirect: np.ndarray
    albedo: np.ndarray
    weight: np.ndarray
    rays: int = 0
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    spread: np.ndarray | None = None

    @property
    def noise(self) -> float | None:
        """Standard error of the receivers' direct light (root mean square of the channels' sum) over their mean light; None where it is
        not known, or where all is dark."""
        known = self.weight > 0
        if self.spread is None or not known.any():
            return None
        mean = float((self.direct + self.indirect)[known].sum(axis=1, dtype=np.float64).mean())
        error = self.spread[known].sum(axis=1, dtype=np.float64)
        return float(np.sqrt((error**2).mean())) / mean if mean > 0 else None

    def arrays(self) -> dict[str, Any]:
        """Keyword arguments for `Solution`, all but `rays`."""
        names = ("emitted", "direct", "indirect", "albedo", "weight", "extra")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class _Sites:
    """Receiver points of one chunk that lie on surfaces, with all that an answer needs of them."""

    receiver: np.ndarray  # (n,) int64
    side: np.ndarray  # (n,) int32 element side
    a: np.ndarray  # (n,) float32 local coordinates
    b: np.ndarray
    albedo: np.ndarray  # (n, 3) float32


def elements_for(world: World, receivers: Receivers, max_edge: float, target: int) -> Elements:
    """The receivers' own elements where the receivers are elements or their corners, else new ones."""
    own = getattr(receivers, "elements", None)
    return own if own is not None else Elements(world, max_edge, target)


def element_count(world: World, receivers: Receivers, max_edge: float, target: int) -> int:
    """How many elements `elements_for` gives, without making them."""
    own = getattr(receivers, "elements", None)
    return own.count if own is not None else Elements.planned(world, max_edge, target)


class AnswerSums:
    """Sums over the points of `n` receivers: emitted, albedo, direct and its spread (n, 3) float64, and weight (n, 1), the number of
    points."""

    def __init__(self, n: int) -> None:
        self.emitted, self.albedo, self.direct, self.spread = np.zeros((4, n, 3))
        self.weight = np.zeros((n, 1))

    def add(self, chunk: Sequence[tuple[int, np.ndarray]]) -> float:
        """Add the sums of a chunk of receivers, each with its first receiver, in the order of the fields; returns the share done."""
        for total, (first, values) in zip((self.emitted, self.albedo, self.direct, self.spread, self.weight), chunk, strict=True):
            total[first : first + len(values)] += values
        return float(first + len(values)) / max(1, len(self.weight))


class ElementAnswer:
    """Evaluates element solutions at receivers; their points are found once and kept for every later partial result.

    Run `prepare()` to its end, then call `parts()` as often as wanted. With `gather`, direct light is evaluated at every
    receiver point instead of taken from the elements; `seed` begins its random numbers.
    """

    def __init__(
        self,
        elements: Elements,
        receivers: Receivers,
        gather: Gather | None = None,
        min_length: int = 0,
        max_length: int = 1 << 30,
        seed: Sequence[int] = (),
    ) -> None:
        self.elements, self.seed = elements, seed
        self.receivers = receivers
        self.identity = receivers.kind == "elements" and getattr(receivers, "elements", None) is elements
        self.emission = min_length == 0
        self.gather = gather if min_length <= 1 <= max_length and not self.identity else None
        # The background is seen by the camera, and lamps with a size in front of it and of surfaces.
        self.emitters = Emitters(elements.world) if receivers.measure == "radiance" else None
        self.rays = 0
        self.ready = 0.0
        self._sites: list[_Sites] = []
        self._sums = AnswerSums(receivers.count)

    def prepare(self) -> Iterator[float]:
        """Find all receiver points; yields the share done, 0 to 1, after each chunk."""
        if self.identity:
            self.ready = 1.0
            return
        for sites, sums, rays in in_order(self._chunk, enumerate(self._pieces())):
            self._sites.append(sites)
            self.rays += rays
            self.ready = self._sums.add(sums)
            yield self.ready
        self.ready = 1.0

    def _pieces(self) -> Iterator[Points]:
        """The receivers' points, in smaller pieces where each of them costs rays to lights."""
        return self.receivers.sites() if self.gather is None else sliced(self.receivers.sites(), PIECE)

    def _chunk(self, item: tuple[int, Points]) -> tuple[_Sites, list[tuple[int, np.ndarray]], int]:
        index, points = item
        world, radiance = self.elements.world, self.receivers.measure == "radiance"
        every, rng = points.receiver, np.random.default_rng([*self.seed, 7, index])
        if radiance:
            points, factor, emitted = seen_at_once(self.emitters, self.receivers, points, rng, self.emission)
        else:
            on = points.triangle >= 0
            emitted, points = np.zeros((len(on), 3), np.float32), points.take(on)
        rays = points.rays
        surface = world.surface(points.triangle, points.u, points.v, points.towards)
        albedo = world.albedo(surface)
        element, a, b = self.elements.cell(points.triangle, points.u, points.v)
        if radiance:
            albedo = albedo * factor
        elif self.emission:
            emitted[on] = np.float32(np.pi) * world.emission(surface)
        sites = _Sites(points.receiver, (2 * element + (surface.side < 0)).astype(np.int32), a, b, albedo)
        direct, spread = np.zeros((2, len(points.receiver), 3), np.float32)
        if self.gather is not None and len(direct):
            # A generator for each chunk, so that neither threads nor order change the result.
            direct, spread, cast = self.gather(surface, rng)
            rays += cast
            if radiance:
                direct, spread = (x * albedo / np.float32(np.pi) for x in (direct, spread))
        sums = [
            sum_by_receiver(every, emitted),
            sum_by_receiver(sites.receiver, albedo),
            sum_by_receiver(sites.receiver, direct),
            sum_by_receiver(sites.receiver, spread),
            sum_by_receiver(every, np.ones((len(every), 1), np.float32)),
        ]
        return sites, sums, rays

    def refine(self, elements: RefinedElements) -> None:
        """Go over from the elements that `elements` were refined from to these. Receivers that are elements stay what they are."""
        self.elements = elements
        for i, s in enumerate(self._sites):
            element, a, b = elements.descend(s.side >> 1, s.a, s.b)
            self._sites[i] = replace(s, side=(2 * element + (s.side & 1)).astype(np.int32), a=a, b=b)

    def parts(self, direct: np.ndarray, indirect: np.ndarray) -> Parts:
        """The answer for irradiance `direct` and `indirect` (2 ne, 3) of the element sides.

        Camera: "elements" in `extra` is the radiosity of the elements as they are, without smoothing, W m-2.
        """
        e = self.elements
        if self.identity:
            return self._identity(direct, indirect)
        radiance = self.receivers.measure == "radiance"
        nodes = e.nodes.values(np.concatenate([direct, indirect], axis=1))
        flat = None
        if radiance:
            own = np.repeat(e.emitted if self.emission else 0 * e.emitted, 2, axis=0)
            flat = (own + np.repeat(e.albedo, 2, axis=0) * (direct + indirect)).astype(np.float32)

        def evaluate(s: _Sites) -> tuple[int, np.ndarray]:
            light = e.nodes.at(nodes, s.side, s.a, s.b)
            if radiance:
                light *= np.tile(s.albedo, (1, 2)) / np.float32(np.pi)
                light = np.concatenate([light, flat[s.side]], axis=1)
            return sum_by_receiver(s.receiver, light)

        total = np.zeros((self.receivers.count, 9 if radiance else 6))
        for first, values in in_order(evaluate, self._sites):
            total[first : first + len(values)] += values
        sums = self._sums
        share = 1.0 / np.maximum(sums.weight, 1)
        total *= share
        direct_here = total[:, :3] if self.gather is None else sums.direct * share
        arrays = (sums.emitted * share, direct_here, total[:, 3:6], sums.albedo * share)
        extra = {"elements": total[:, 6:].astype(np.float32)} if radiance else {}
        spread = None if self.gather is None else sums.spread * share
        return Parts(*(x.astype(np.float32) for x in arrays), (sums.weight[:, 0] > 0).astype(np.float32), self.rays, extra, spread)

    def _identity(self, direct: np.ndarray, indirect: np.ndarray) -> Parts:
        e = self.receivers.elements
        if e is not self.elements:
            direct, indirect = over_base(self.elements, e, direct), over_base(self.elements, e, indirect)
        emitted = np.repeat(e.emitted if self.emission else 0 * e.emitted, 2, axis=0)
        arrays = (emitted, direct, indirect, np.repeat(e.albedo, 2, axis=0))
        return Parts(*(np.asarray(x, np.float32) for x in arrays), np.ones(2 * e.count, np.float32), self.rays)


def sum_by_receiver(receiver: np.ndarray, values: np.ndarray) -> tuple[int, np.ndarray]:
    """First receiver of the chunk and sums (k, c) float64 of `values` (n, c) from it on."""
    if not len(receiver):
        return 0, np.zeros((0, values.shape[1]))
    first = int(receiver.min())
    index = receiver - first
    count = int(index.max()) + 1
    return first, np.stack([np.bincount(index, values[:, c], count) for c in range(values.shape[1])], axis=1)
