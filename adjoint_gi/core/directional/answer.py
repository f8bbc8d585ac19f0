"""Answers of methods that know radiance by direction: what reaches surface receivers, and what elements send towards the camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..base.parallel import in_order
from ..bsdf import table as bsdf
from ..elements.answer import AnswerSums, ElementAnswer, Parts, sum_by_receiver
from ..lights.direct import halved_irradiance
from ..lights.emitters import Emitters
from ..radiosity.lamp_light import receiver_light
from ..radiosity.settings import RadiositySettings
from ..receivers.base import Points, Receivers
from ..scene.world import Surface
from ..walks.gathering import sliced
from ..walks.paths import Walk
from ..walks.radiance import gather
from ..walks.sight import seen_at_once
from .rays import DirectionalRays
from .scattering import Scattering

PIECE = 1 << 13  # receiver points in one piece of work


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """Light of some path lengths on element sides: irradiance (n, 3); base (n, 3), what of it reaches the diffuse base; shine
    (n, size, 3), radiance that the other lobes send, by coefficients; exitance (n, 3), all that leaves, W m-2."""

    irradiance: np.ndarray
    base: np.ndarray
    shine: np.ndarray
    exitance: np.ndarray


def light_of(scattering: Scattering, arriving: np.ndarray) -> DirectionalLight:
    """What a field that arrives, (n, size, 3), means to receivers."""
    basis = scattering.basis
    shine = scattering.apply(arriving, diffuse=False)
    # What harmonics swing below 0 is not light.
    irradiance = np.maximum(basis.irradiance(arriving), 0)
    return DirectionalLight(irradiance, scattering.below_coat(arriving), shine, basis.exitance(scattering.apply(arriving)))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Camera points of one chunk that lie on surfaces."""

    receiver: np.ndarray
    side: np.ndarray
    a: np.ndarray
    b: np.ndarray
    local: np.ndarray  # (n, 3) towards the camera, in the side's frame
    base: np.ndarray  # (n, 3) what the diffuse base makes of irradiance
    factor: np.ndarray  # (n, 3) share of what leaves there that comes to the camera


class DirectionalAnswer:
    """As `ElementAnswer`, which it uses for irradiance. Cameras see diffuse light with the albedo of every point, other light
    interpolated between elements and in direction, and direct light evaluated where they look if the settings say so.
    """

    def __init__(
        self, caster: DirectionalRays, receivers: Receivers, emitters: Emitters, settings: RadiositySettings, scattering: Scattering
    ) -> None:
        e = caster.elements
        self.caster, self.receivers, self.emitters, self.settings, self.scattering = caster, receivers, emitters, settings, scattering
        low, high = settings.min_length, settings.max_length
        self.camera = receivers.measure == "radiance"
        self.plain = None if self.camera else ElementAnswer(e, receivers, receiver_light(e.world, emitters, settings), low, high)
        self.table = bsdf.BsdfTable(e.world.scene)
        self.sharp = self.camera and settings.direct_light == "receivers" and low <= 1 <= high
        self.rays = 0
        self._seen: list[_Seen] = []
        self._sums = AnswerSums(receivers.count)

    def prepare(self) -> Iterator[float]:
        """Find all receiver points; yields the share done, 0 to 1, after each chunk."""
        if self.plain is not None:
            yield from self.plain.prepare()
            self.rays = self.plain.rays
            return
        for seen, sums, rays in in_order(self._chunk, enumerate(sliced(self.receivers.sites(), PIECE))):
            self._seen.append(seen)
            self.rays += rays
            yield self._sums.add(sums)

    def _chunk(self, item: tuple[int, Points]) -> tuple[_Seen, list, int]:
        index, points = item
        e, world, every = self.caster.elements, self.caster.world, points.receiver
        # A generator for each chunk, so that neither threads nor order change the result.
        rng = np.random.default_rng([13, index])
        points, factor, emitted = seen_at_once(self.emitters, self.receivers, points, rng, self.settings.min_length == 0)
        towards = points.towards
        surface = world.surface(points.triangle, points.u, points.v, towards)
        lobes = self.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, towards)
        element, a, b = e.cell(surface.triangle, surface.u, surface.v)
        side = 2 * element + (surface.side < 0)
        direct, spread = np.zeros((2, len(side), 3), np.float32)
        rays = points.rays
        if self.sharp and len(side):
            direct, spread, cast = self._direct_light(surface, lobes, self.scattering.shiny[element], rng)
            rays += cast
        base = lobes.diffuse * (1 - lobes.coat()) / np.float32(np.pi)
        seen = _Seen(points.receiver, side, a, b, self.caster.to_local(side, towards), base, factor)
        sums = [
            sum_by_receiver(every, emitted),
            sum_by_receiver(seen.receiver, world.albedo(surface) * factor),
            sum_by_receiver(seen.receiver, direct * factor),
            sum_by_receiver(seen.receiver, spread * factor),
        ]
        sums.append(sum_by_receiver(every, np.ones((len(every), 1))))
        return seen, sums, rays

    def _direct_light(
        self, surface: Surface, lobes: bsdf.Lobes, shiny: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """(n, 3) radiance towards the camera of light straight from emitters, half of what its two halves differ by; the rays cast."""
        world, samples = self.caster.world, max(2, self.settings.light_samples)
        out, spread = np.zeros((2, len(shiny), 3), np.float32)
        rays, half = 0, samples // 2
        plain, rest = np.flatnonzero(~shiny), np.flatnonzero(shiny)
        if len(plain):
            light, differ, rays = halved_irradiance(world, self.emitters, surface.take(plain), samples, rng)
            out[plain], spread[plain] = (x * lobes.diffuse[plain] / np.float32(np.pi) for x in (light, differ))
        if len(rest):
            walk = Walk(world, self.emitters, self.table, 1, 1)
            at, seen = surface.take(rest), lobes.take(rest)
            for k in range(samples):
                found = gather(walk, at, seen, rng)
                out[rest] += found.direct / np.float32(samples)
                spread[rest] += found.direct / np.float32(2 * half if k < half else -2 * (samples - half))
                rays += found.rays
        return out, spread, rays

    def parts(self, direct: DirectionalLight, indirect: DirectionalLight) -> Parts:
        """The answer for light of path length 1 and of more. Camera: "elements" in `extra` is the radiosity of the elements."""
        if self.plain is not None:
            return self.plain.parts(direct.irradiance, indirect.irradiance)
        e = self.caster.elements
        lights = (indirect,) if self.sharp else (direct, indirect)
        base = e.nodes.values(np.concatenate([x.base for x in lights], axis=1))
        shines = None
        if self.scattering.shiny.any():
            shines = [e.nodes.values(x.shine.reshape(len(x.shine), -1)).reshape(-1, 3) for x in lights]
        flat = np.repeat(e.emitted, 2, axis=0) * (self.settings.min_length == 0) + direct.exitance + indirect.exitance

        def evaluate(s: _Seen) -> tuple[int, np.ndarray]:
            light = e.nodes.at(base, s.side, s.a, s.b) * np.tile(s.base, (1, len(lights)))
            rows = np.flatnonzero(self.scattering.shiny[s.side >> 1])
            if shines is not None and len(rows):
                light[rows] += self._shine(shines, s, rows)
            # What harmonics swing below 0 is not light.
            light = np.maximum(light, 0) * np.tile(s.factor, (1, len(lights)))
            return sum_by_receiver(s.receiver, np.concatenate([light, flat[s.side] * s.factor], axis=1))

        total = np.zeros((self.receivers.count, 3 * len(lights) + 3))
        for first, values in in_order(evaluate, self._seen):
            total[first : first + len(values)] += values
        sums = self._sums
        share = 1.0 / np.maximum(sums.weight, 1)
        total *= share
        direct_here = sums.direct * share if self.sharp else total[:, :3]
        arrays = (sums.emitted * share, direct_here, total[:, -6:-3], sums.albedo * share)
        extra = {"elements": total[:, -3:].astype(np.float32)}
        spread = sums.spread * share if self.sharp else None
        return Parts(*(x.astype(np.float32) for x in arrays), (sums.weight[:, 0] > 0).astype(np.float32), self.rays, extra, spread)

    def _shine(self, shines: list[np.ndarray], s: _Seen, rows: np.ndarray) -> np.ndarray:
        """(m, 3 k) radiance of the lobes other than diffuse towards the camera, interpolated between the nodes of the elements."""
        e, size = self.caster.elements, self.scattering.size
        side, a, b = s.side[rows], s.a[rows], s.b[rows]
        index, weight = self.scattering.basis.basis(s.local[rows], side)
        weight = weight.astype(np.float32)
        node = 2 * e.nodes.of_element[side >> 1].astype(np.int64) + (side & 1)[:, None]
        ab = np.where(e.is_quad[side >> 1], a * b, np.float32(0))
        out = np.zeros((len(rows), 3 * len(shines)), np.float32)
        for corner, share in enumerate((1 - a - b + ab, a - ab, b - ab, ab)):
            at = node[:, corner, None] * size + index
            for k, shine in enumerate(shines):
                out[:, 3 * k : 3 * k + 3] += share[:, None] * np.einsum("nq,nqc->nc", weight, shine[at])
        return out
