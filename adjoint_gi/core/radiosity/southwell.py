"""The scheme that shoots: Southwell relaxation, column by column (Cohen, Chen, Wallace and Greenberg 1988; review, section 7).

    B(j) += rho(j) dB(i) F(ij) A(i) / A(j),  dB(j) likewise,  dB(i) = 0                                   (before 13)

for the side i with the most unshot flux A(i) dB(i), again and again: the shot of which Eq. 13 is the sum. Here i shoots and j receives; the
review has them the other way round. `DiffuseShooting` is the state on diffuse elements, kept as irradiance H with B = E + rho H; E is
emitted radiosity, H0 irradiance that arrives from outside the elements (lamps, background); all (n, 3). `Grouping` and `Southwell` are
the scheme over any state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..base.settings import NO_LIMIT
from ..method.solution import EnergyBalance
from .transports import Transport

# Of the sides that shoot together, at least; more where there are more sides, as each group costs a look at all of them.
RAYS_PER_GROUP = 1 << 16
MOST_RAYS_PER_GROUP = 1 << 18
MIN_RAYS_PER_SHOT, MAX_RAYS_PER_SHOT = 8, 1 << 17  # rays of one shot
MAX_SIDES_PER_GROUP = 1 << 14  # sides that shoot together at most


def length_classes(low: int, high: int) -> int:
    """Classes that unshot light is kept in, by the segments behind it, where paths of `low` to `high` segments count.

    One for each length up to `high`, where that bounds the paths; else as many as tell which light is too short, the last for all longer.
    """
    return max(1, high) if high < NO_LIMIT else max(2, low)


class ShootingState(Protocol):
    """What Southwell's scheme works on: `DiffuseShooting` on diffuse elements, `HarmonicShooting` where radiance depends on direction.

    total   emitted flux in W, the channels summed; shots: sides that have shot
    absorbed, escaped   (3,) float64 flux in W by channel
    """

    total: float
    shots: int
    absorbed: np.ndarray
    escaped: np.ndarray

    def unshot_flux(self) -> np.ndarray:
        """(n,) float64 unshot flux in W of each side, absolute values."""

    def remaining(self) -> np.ndarray:
        """(3,) float64 unshot flux in W, and flux cut off by the path length."""

    def largest(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Up to `count` sides with the most unshot flux, most first, and their flux in W; sides with none are left out."""

    def shoot(self, index: np.ndarray, rays: np.ndarray) -> None:
        """Send the unshot light of sides `index` (m,) along `rays` (m,) rays each."""


@dataclass(frozen=True)
class Grouping:
    """Which sides shoot next: those with the most unshot flux, as many as fit into one batch of rays.

    carriers   rays that carry all emitted flux; a shot takes its share of them by its flux, but at least `fewest` and at most `most`
    fewest     a number, or a function of the sides (m,) that gives each its own
    batch      rays of the sides that shoot together, about; sides: the most that do
    """

    carriers: int
    batch: int
    sides: int = MAX_SIDES_PER_GROUP
    fewest: int | Callable[[np.ndarray], np.ndarray] = MIN_RAYS_PER_SHOT
    most: int = MAX_RAYS_PER_SHOT

    @classmethod
    def for_sides(cls, sides: int, carriers: int, least: int = RAYS_PER_GROUP) -> Grouping:
        """For so many element sides: a batch holds `least` rays, or more where there are more sides."""
        return cls(carriers, int(np.clip(sides // 2, least, MOST_RAYS_PER_GROUP)))

    def rays(self, index: np.ndarray, flux: np.ndarray, total: float) -> np.ndarray:
        """(m,) int64 rays for sides `index` (m,) that send `flux` (m,) W of `total` W."""
        fewest = self.fewest(index) if callable(self.fewest) else self.fewest
        return np.clip(np.ceil(self.carriers * flux / max(total, 1e-300)), fewest, self.most).astype(np.int64)

    def next(self, state: ShootingState, shots_left: int = 1 << 62) -> tuple[np.ndarray, np.ndarray]:
        """The sides (m,) that shoot next, at most `shots_left`, and the rays (m,) of each; none where nothing is unshot."""
        index, flux = state.largest(min(self.sides, shots_left))
        rays = self.rays(index, flux, state.total)
        fits = max(1, int(np.searchsorted(np.cumsum(rays), self.batch, side="right")))
        return index[:fits], rays[:fits]


class Southwell:
    """Southwell's scheme over any state: groups shoot until little is left, the shots are used up, or nothing more is gained.

    left    flux in W that is unshot, absolute values summed; whole: the flux in W that it is a share of
    """

    def __init__(
        self,
        state: ShootingState,
        grouping: Grouping,
        tolerance: float,
        max_shots: int = 1 << 62,
        patience: int | None = None,
        whole: float | None = None,
    ) -> None:
        """`tolerance`: share of `whole` (all emitted flux where None) at which it ends. `patience`: shots in which the unshot flux must
        have become less by 2 %; None is no bound."""
        self.state, self.grouping, self.tolerance, self.max_shots, self.patience = state, grouping, tolerance, max_shots, patience
        self.whole = state.total if whole is None else whole
        self.left = float(state.unshot_flux().sum())

    def run(self) -> Iterator[float]:
        """Yield the share that is unshot after every group."""
        state = self.state
        least, best = self.left, state.shots
        while self.unfinished and state.shots < self.max_shots:
            # 1. The sides with the most unshot flux (Southwell picks the largest residual) send all of it (a term of Eq. 13).
            index, rays = self.grouping.next(state, self.max_shots - state.shots)
            if not len(index):
                return
            state.shoot(index, rays)
            # 2. What is left now.
            self.left = float(state.unshot_flux().sum())
            if self.left < 0.98 * least:
                least, best = self.left, state.shots
            yield self.share
            if self.patience is not None and state.shots - best > self.patience:
                return

    @property
    def unfinished(self) -> bool:
        """Whether more is left than the tolerance."""
        return self.left > self.tolerance * self.whole

    @property
    def share(self) -> float:
        """Unshot share."""
        return self.left / self.whole if self.whole else 0.0

    @property
    def done(self) -> float:
        """0 to 0.999: share of the way to the tolerance."""
        done = (1 - self.share) / (1 - self.tolerance) if self.tolerance < 1 else 1.0
        return float(np.clip(done, 0, 0.999))

    @property
    def text(self) -> str:
        """How far it is, in words."""
        return f"{self.state.shots:,} shots, {self.share:.2%} of the light unshot"

    @property
    def shortfall(self) -> str:
        """What to say of a run that has ended before its tolerance."""
        return f"stopped after {self.state.shots:,} shots with {self.share:.2%} of the light unshot"


class DiffuseShooting:
    """What has been shot and what has not: sides send their unshot flux, and everything they light reflects it, unshot.

    direct, indirect   (n, 3) irradiance so far, of the path lengths asked for
    first              (n, 3) irradiance so far of one segment, whether asked for or not
    unshot             (k, n, 3) unshot radiosity, by the segments its light has behind it; the last class holds all longer
                       paths where their number does not matter
    absorbed, escaped  flux in W by channel; with the flux that is unshot, and that which was `cut` by the path length, they add up
                       to `emitted` at every moment
    """

    def __init__(
        self, transport: Transport, emitted: np.ndarray, arriving: np.ndarray, low: int = 0, high: int = NO_LIMIT, overshoot: bool = False
    ) -> None:
        self.transport = transport
        self.low, self.high = low, high
        self.bounded = high < NO_LIMIT
        classes = length_classes(low, high)
        n = len(transport.area)
        self.unshot = np.zeros((classes, n, 3))
        self.direct = np.zeros((n, 3))
        self.first = np.zeros((n, 3))
        self.indirect = np.zeros((n, 3))
        self.reached = (emitted > 0).any(axis=1) | (arriving > 0).any(axis=1)
        self.absorbed = np.zeros(3)
        self.escaped = np.zeros(3)
        self.sent = np.zeros(3)  # by all shots, arrived or escaped
        self.cut = np.zeros(3)
        self.shots = 0
        # Overshooting sends light of unknown length, which a bound on lengths cannot take.
        self.overshoot = overshoot and not self.bounded and classes == 2
        area = transport.area[:, None]
        self.emitted = (area * (emitted + arriving)).sum(axis=0)
        self.total = float(self.emitted.sum())
        if high == 0:
            self.cut += self.emitted
        else:
            self.unshot[0] = emitted
            self._arrive(arriving[None], 0)

    def _arrive(self, irradiance: np.ndarray, first: int) -> None:
        """Take irradiance (k, n, 3) of light that has arrived; its class is the segments it had before, from `first` on."""
        area = self.transport.area[:, None]
        rho = self.transport.rho
        for k, light in enumerate(irradiance, first):
            length = k + 1
            if length == 1:
                self.first += light
            # In the last class the lengths are mixed, but all of them long enough.
            if self.low <= length or (not self.bounded and k == len(self.unshot) - 1):
                (self.direct if length == 1 else self.indirect)[:] += light
            self.absorbed += (area * (1 - rho) * light).sum(axis=0)
            if self.bounded and length >= self.high:
                self.cut += (area * rho * light).sum(axis=0)
            else:
                self.unshot[min(length, len(self.unshot) - 1)] += rho * light
        self.reached |= irradiance.any(axis=(0, 2))

    def refined(self, transport: Transport, root: np.ndarray, factor: np.ndarray) -> DiffuseShooting:
        """The same state on finer elements, before any light of a second segment has been shot.

        root (n,): the side that each new side is part of; factor (n, 3): its share of light of one segment, relative to that side's.
        The area-weighted means of `factor` over every old side must be 1: then no flux is gained or lost.
        """
        new = copy(self)
        new.transport = transport
        new.first, new.direct = self.first[root] * factor, self.direct[root] * factor
        new.indirect, new.reached = self.indirect[root], self.reached[root]
        new.unshot = self.unshot[:, root]
        new.unshot[1:] *= factor
        new.absorbed, new.escaped, new.cut, new.sent = (x.copy() for x in (self.absorbed, self.escaped, self.cut, self.sent))
        return new

    def arrive_later(self, irradiance: np.ndarray, other: np.ndarray, escaped: np.ndarray) -> None:
        """Take irradiance (n, 3) from outside that has flown more than one segment. Only for unbounded lengths.

        other, escaped (3,): W of it that is absorbed beside it, and that has left the scene. All of this light has arrived before, on its
        first segment, so the three add up to 0.
        """
        self.absorbed = self.absorbed + other
        self.escaped = self.escaped + escaped
        self._arrive(irradiance[None], 1)

    def has_passed(self, flux: np.ndarray) -> None:
        """Flux (3,) in W that arrived at first went straight on and arrived once more."""
        self.emitted, self.absorbed = self.emitted - flux, self.absorbed - flux
        self.total -= float(flux.sum())

    def unshot_flux(self) -> np.ndarray:
        """(n,) float64 unshot flux in W of each side; absolute values, as overshooting makes some negative."""
        return self.transport.area * np.abs(self.unshot).sum(axis=(0, 2))

    def remaining(self) -> np.ndarray:
        """(3,) float64 unshot flux in W, and flux cut off by the path length."""
        return (self.transport.area[:, None] * self.unshot.sum(axis=0)).sum(axis=0) + self.cut

    def ambient(self) -> np.ndarray:
        """(3,) irradiance that the unshot light would give everywhere it can come, reflected on for ever (Cohen 1988).

        Cohen's scenes are closed. In open ones a share of what is sent escapes; the shots so far show which, so before them this is 0.
        """
        area = self.transport.area * self.reached
        whole = max(float(area.sum()), 1e-300)
        mean_rho = (area[:, None] * self.transport.rho).sum(axis=0) / whole
        stays = np.clip(1 - self.escaped / np.maximum(self.sent, 1e-300), 0, 1) * (self.sent > 0)
        return (self.remaining() - self.cut) * stays / whole / np.maximum(1 - mean_rho * stays, 1e-3)

    def shoot(self, index: np.ndarray, rays: np.ndarray) -> None:
        """Send the unshot light of sides `index` (m,), all at once, with `rays` (m,) rays each."""
        # dB(i) is sent and becomes 0.
        out = self.unshot[:, index]
        if self.overshoot:
            out[-1] += self._expected(index)
        self.unshot[:, index] -= out
        self.sent += np.abs(out * self.transport.area[index, None]).sum(axis=(0, 1))
        classes = len(out)
        # Classes in which nobody has anything are not carried along.
        used = np.flatnonzero(out.any(axis=(1, 2)))
        flat = out[used].transpose(1, 0, 2).reshape(len(index), 3 * len(used))
        # dB(i) F(ij) A(i) / A(j) arrives; rho(j) of it is unshot there (the shot before Eq. 13).
        arrived, escaped = self.transport.shoot(index, flat, rays)
        full = np.zeros((classes, len(self.direct), 3))
        full[used] = arrived.reshape(-1, len(used), 3).transpose(1, 0, 2)
        self.escaped += escaped.reshape(-1, 3).sum(axis=0)
        self.absorbed += np.reshape(self.transport.other, (-1, 3)).sum(axis=0)
        self._arrive(full, 0)
        self.shots += len(index)

    def _expected(self, index: np.ndarray) -> np.ndarray:
        """(m, 3) radiosity that sides `index` (m,) are expected to have from light that is still under way (Feda 1992)."""
        return self.transport.rho[index] * self.reached[index, None] * self.ambient()

    def largest(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Up to `count` sides with the most unshot flux, most first, and their flux in W; sides with none are left out."""
        flux = self.unshot_flux()
        if self.overshoot:
            # What a side has sent too early must not bring it to the front again.
            out = self.unshot.sum(axis=0) + self._expected(np.arange(len(flux)))
            flux = self.transport.area * np.abs(out).sum(axis=1)
        return most_first(flux, count)


def most_first(flux: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Up to `count` indices of the largest `flux` (n,), largest first, and their values; none that is 0."""
    index = np.argpartition(-flux, count)[:count] if count < len(flux) else np.arange(len(flux))
    # Ties go to the lower index, so that the order is always the same.
    index = index[np.lexsort((index, -flux[index]))]
    index = index[flux[index] > 0]
    return index, flux[index]


def balance(state: ShootingState) -> EnergyBalance:
    """Flux summed over the channels; light cut off by the path length counts as unshot."""
    return EnergyBalance(state.total, float(state.absorbed.sum()), float(state.escaped.sum()), float(state.remaining().sum()))
