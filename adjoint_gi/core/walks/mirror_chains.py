"""Chains of mirrors: rays that go on via mirror-like, glossy and clear surfaces until they meet diffuse ones.

What extended form factors (Wallace 1987; Sillion and Puech 1989) and caustics are made of. A ray that meets a surface gives its
light to the diffuse lobe there and goes on by one direction of the other lobes, drawn by their BSDF, so that rays do not multiply.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..bsdf import table as bsdf
from ..bsdf.lobes import FIRST_PASS_LOBES, SHINY
from ..scene.arrays import STRAIGHT
from ..scene.world import Surface, World
from .paths import russian_roulette
from .radiance import leaving
from .shooting import Arrived, Departed, Flight, shoot

ROULETTE_FROM = 4  # segments after which chains end at random


@dataclass(frozen=True, eq=False)
class Met:
    """What rays meet at the end of one segment.

    segments   flown so far
    row        (m,) which ray; surface: where, on the side it came from; weight (m, 3) float32 of what it carries
    share      (m, 1) or (m, 3) float32 of that which coats let through to the diffuse lobe, 1 where there are none
    sent       (m, 3) float32 weight that goes on from there; scattered: the part of it that does so by a lobe, not straight through
    clear      (m,) bool: the first surface on the way was left by a perfectly smooth lobe, so that no light point finds this chain
    solid      (m,) float32 sr: how far the lobes on the way spread the ray, as the solid angles that have their densities; 0 by smooth ones
    away, lost (k,), (k, 3): rays that escape, and their weight
    """

    segments: int
    row: np.ndarray
    surface: Surface
    weight: np.ndarray
    share: np.ndarray
    sent: np.ndarray
    scattered: np.ndarray
    clear: np.ndarray
    solid: np.ndarray
    away: np.ndarray
    lost: np.ndarray


@dataclass(frozen=True, eq=False)
class Mirrored(Departed):
    """Rays that go on; delta (k,) bool: by a perfectly smooth lobe; pdf_w (k,) float32 of the others."""

    delta: np.ndarray
    pdf_w: np.ndarray


class Chains:
    """Follows chains in a world. depth: surfaces in a row that a chain may leave; rough: whether it goes on by rough lobes, too."""

    def __init__(self, world: World, depth: int, rough: bool = True) -> None:
        self.world = world
        # What is nearly diffuse ends a chain, as elements know its light.
        self.table = bsdf.BsdfTable(world.scene, FIRST_PASS_LOBES)
        self.depth = depth
        self.rough = rough
        shiny = [any(x.kind in SHINY and x.kind != STRAIGHT and not x.is_black for x in m.lobes) for m in world.scene.materials]
        self.shiny = np.array(shiny or [False])[np.asarray(world.scene.material, np.int64)]
        self.any = bool(self.shiny.any())
        self.albedo_varies = bool(self.table.diffuse.varying)

    def diffuse(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n, 3) float32 albedo of the diffuse lobe alone, what lies on it left out."""
        return np.clip(self.table.diffuse.at(triangle, u, v), np.float32(0), np.float32(1))

    def share(self, surface: Surface, wo: np.ndarray) -> np.ndarray:
        """(n, 1) or (n, 3) float32 what coats leave for the diffuse lobe of light that leaves towards, or comes from, `wo` (n, 3)."""
        if not self.table.any_coat:
            return np.ones((len(wo), 1), np.float32)
        coating = self.table.coating(surface.triangle, surface.u, surface.v)
        return 1 - self.table.coats.albedo(coating, np.einsum("ij,ij->i", surface.ns, wo))

    def follow(
        self, origin: np.ndarray, wi: np.ndarray, kind: np.uint8, rng: np.random.Generator, dark: np.ndarray | None = None
    ) -> Iterator[Met]:
        """Follow rays (n, 3) float32 of weight 1, at first of `kind`, and yield what they meet, segment by segment.

        What is hit closer than `dark` (n,) on the first segment counts as escaped.
        """
        flight = Flight(origin, wi, kind, np.ones((len(origin), 3), np.float32))
        clear, solid = np.ones(len(origin), bool), np.zeros(len(origin), np.float32)
        for segment in shoot(self.world, flight, self.depth + 1, self._scatter, rng, dark):
            row, at, on = segment.row, segment.arrived, segment.scattered
            scattered = np.zeros_like(at.weight)
            scattered[on.rows] = on.flight.weight
            sent = scattered if segment.passed is None else scattered + segment.passed
            share = self.share(at.surface, -at.direction)
            before = clear[row], solid[row]
            yield Met(at.segments, row, at.surface, at.weight, share, sent, scattered, *before, segment.away, segment.lost)
            if at.segments == 1:
                clear[row[on.rows]] = on.delta
            solid[row[on.rows]] += np.where(on.delta, np.float32(0), 1 / np.maximum(on.pdf_w, np.float32(1e-6)))

    def _scatter(self, at: Arrived, rng: np.random.Generator) -> Mirrored:
        """One ray by the lobes that are not diffuse, from the surfaces that have any."""
        able = self.shiny[at.surface.triangle] & (at.segments <= self.depth)
        if at.stay is not None:
            able &= at.stay > 0
        rows = np.flatnonzero(able)
        surface = at.surface.take(rows)
        lobes = self.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, -at.direction[rows])
        lobes = lobes.without_diffuse(np.ones(len(rows), bool))
        if not self.rough:
            lobes = lobes.without(tuple(~s.delta for s in lobes.slots))
        drawn = bsdf.sample(lobes, rng)
        go = leaving(surface, drawn)
        weight = at.weight[rows[go]] * drawn.weight[go]
        if at.stay is not None:
            weight *= at.stay[rows[go], None]
        if at.segments >= ROULETTE_FROM:
            survive, chance = russian_roulette(weight.max(axis=1), rng.random(len(go), np.float32))
            go, weight = go[survive], weight[survive] / chance[:, None]
        origin = np.ascontiguousarray(self.world.leave(surface.take(go), drawn.through[go]))
        flight = Flight(origin, np.ascontiguousarray(drawn.wi[go]), drawn.kind[go], weight)
        return Mirrored(rows[go], flight, drawn.delta[go], drawn.pdf_w[go])
