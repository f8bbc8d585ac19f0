"""Collects samples of receivers and makes the `Solution` of them; and what receivers look like without any light."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..lights.background import Background
from ..scene.world import World
from .base import Receivers


class Film:
    """Sums over the samples of every receiver.

    direct, indirect   (n, 3) float64 sums of estimates
    emitted, albedo    (n, 3) float64 sums over camera samples, which see other points each time; unused otherwise
    count              (n,) int64 samples
    """

    def __init__(self, receivers: Receivers) -> None:
        n = receivers.count
        self.direct = np.zeros((n, 3))
        self.indirect = np.zeros((n, 3))
        own = n if receivers.kind == "camera" else 0
        self.emitted = np.zeros((own, 3))
        self.albedo = np.zeros((own, 3))
        self.count = np.zeros(n, np.int64)
        self._groups = np.zeros(n, np.int32)
        self._squares = np.zeros((3, n))  # of direct light, of indirect light, and of both together

    def add(self, receivers: slice, samples: int, direct: np.ndarray, indirect: np.ndarray, spread: np.ndarray | None = None) -> None:
        """Sums over one group of `samples` samples of each of the receivers, (m, 3) each.

        With `spread` over two, whose means are the mean of both and, one more and one less, `spread / samples`.
        """
        self.direct[receivers] += direct
        self.indirect[receivers] += indirect
        self.count[receivers] += samples
        self._groups[receivers] += 1
        parts = [part.sum(axis=1, dtype=np.float64) for part in (direct, indirect)]
        for squares, total in zip(self._squares, (*parts, parts[0] + parts[1]), strict=True):
            squares[receivers] += total * total / samples
        if spread is not None:
            # How much of it is of which part is not known, so each counts with all of it.
            self._groups[receivers] += 1
            self._squares[:, receivers] += spread.sum(axis=1, dtype=np.float64) ** 2 / samples

    def mean(self, sums: np.ndarray) -> np.ndarray:
        """(n, 3) float32 means; 0 where there is no sample."""
        return (sums / np.maximum(self.count, 1)[:, None]).astype(np.float32)

    def relative_error(self) -> float | None:
        """Standard error of the receivers (root mean square) over their mean; None before the second group of samples.

        It comes from the differences between groups, and so is rather too large for low-discrepancy samples.
        """
        known = self._groups > 1
        if not known.any():
            return None
        total = (self.direct[known] + self.indirect[known]).sum(axis=1)
        mean = (total / self.count[known]).mean()
        return float(np.sqrt(self._variance(total, self._squares[2], known).mean()) / mean) if mean > 0 else None

    def errors(self) -> dict[str, np.ndarray]:
        """(n,) float32 standard errors of the channels' sum, "direct_error" and "indirect_error"; inf where there is one group of samples.

        Nothing where no receiver has two. As `relative_error` they are rather too large.
        """
        known = self._groups > 1
        out = {}
        for name, sums, squares in zip(("direct", "indirect"), (self.direct, self.indirect), self._squares, strict=False):
            error = np.full(len(known), np.inf, np.float32)
            error[known] = np.sqrt(self._variance(sums[known].sum(axis=1), squares, known))
            out[f"{name}_error"] = error
        return out if known.any() else {}

    def _variance(self, total: np.ndarray, squares: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Variance of the means of the `known` receivers, with sums `total` and `squares` of groups."""
        count = self.count[known]
        # sum n m^2 - N M^2 over the groups estimates (groups - 1) sigma^2, where a group mean of n samples has variance sigma^2 / n.
        return np.maximum(squares[known] - total * total / count, 0) / (self._groups[known] - 1) / count


def read_surfaces(world: World, receivers: Receivers, out: dict[str, np.ndarray]) -> Iterator[float]:
    """Fill `out` from the receivers' fixed sites, chunk by chunk, yielding the share of the receivers that is done.

    albedo (n, 3); emission (n, 3) radiance, the background where a camera ray escapes; normal (n, 3) unit shading normal in
    world space, on the side that is seen; depth (n,) mean distance along the camera's rays, inf where they escape, absent for
    receivers on surfaces; weight (n,) share of sites on a surface. All float32.
    """
    n = receivers.count
    albedo, emission, normal = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    sites, solid, depth = np.zeros(n), np.zeros(n), np.zeros(n)
    has_depth = receivers.kind == "camera"
    background = Background(world)

    def count(into: np.ndarray, owner: np.ndarray, values: np.ndarray | None = None) -> None:
        # Only over the stretch of receivers of this chunk: the cost must not grow with chunks times receivers.
        first, last = int(owner.min()), int(owner.max()) + 1
        into[first:last] += np.bincount(owner - first, values, last - first)

    def collect(into: np.ndarray, values: np.ndarray, owner: np.ndarray) -> None:
        for c in range(3):
            count(into[:, c], owner, values[:, c])

    for points in receivers.sites():
        count(sites, points.receiver)
        on = np.flatnonzero(points.triangle >= 0)
        if has_depth and len(on) < len(points.receiver):
            away = points.triangle < 0
            collect(emission, background.radiance(-points.towards[away].T).T, points.receiver[away])
        if len(on):
            owner = points.receiver[on]
            towards = None if points.towards is None else points.towards[on]
            s = world.surface(points.triangle[on], points.u[on], points.v[on], towards)
            collect(albedo, world.albedo(s), owner)
            collect(emission, world.emission(s), owner)
            collect(normal, s.ns, owner)
            count(solid, owner)
            if has_depth:
                count(depth, owner, points.distance[on])
        yield min(1.0, (int(points.receiver.max()) + 1) / n)

    surface = np.maximum(solid, 1)
    out["albedo"] = (albedo / np.maximum(sites, 1)[:, None]).astype(np.float32)
    out["emission"] = (emission / np.maximum(sites, 1)[:, None]).astype(np.float32)
    length = np.linalg.norm(normal, axis=1)
    out["normal"] = (normal / np.maximum(length, 1e-12)[:, None]).astype(np.float32)
    out["weight"] = (solid / np.maximum(sites, 1)).astype(np.float32)
    if has_depth:
        out["depth"] = np.where(solid > 0, depth / surface, np.inf).astype(np.float32)
