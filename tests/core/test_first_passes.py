"""Parts of first passes that only their sums show: chains of mirrors, known light by length, light that is still to be shot."""

from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.elements.rays import ElementRays
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.radiosity.southwell import DiffuseShooting
from adjgi.adjoint_gi.core.sampling.maps import sphere
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material, RayKind
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.two_pass.extended_factors import ExtendedShots
from adjgi.adjoint_gi.core.two_pass.known_light import lengths_of
from adjgi.adjoint_gi.core.two_pass.view_pass import View
from adjgi.adjoint_gi.core.walks.mirror_chains import ROULETTE_FROM, Chains
from adjgi.adjoint_gi.core.walks.paths import Walk
from adjgi.adjoint_gi.core.walks.radiance import start


def test_roulette_keeps_the_light_of_chains():
    """In a closed room of mirrors of 0.7 what meets the k-th surface is 0.7^(k - 1) of what set out, whoever has ended before."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 2), Material("Mirror", (Lobe("glossy", Color.of(0.7), 0.0),)), inward=True)
    chains, rng = Chains(World(b.build()), depth=12), np.random.default_rng(1)
    n = 20_000
    direction = np.ascontiguousarray(sphere(*rng.random((2, n), np.float32)).T)
    carried, flown = [], []
    for met in chains.follow(np.zeros((n, 3), np.float32), direction, RayKind.DIFFUSE, rng):
        carried.append(float(met.weight.mean(axis=1).sum()) / n)
        flown.append(len(met.row))
    assert len(carried) == 13 and flown[ROULETTE_FROM + 2] < 0.5 * n  # many have ended at random
    assert carried == pytest.approx(0.7 ** np.arange(13), rel=0.1)
    assert carried[: ROULETTE_FROM + 2] == pytest.approx(0.7 ** np.arange(ROULETTE_FROM + 2), rel=0.02)


@pytest.mark.parametrize("tint", [1.0, 0.6])
def test_chains_share_what_a_mirror_sends_and_what_passes_it(tint):
    """Half of a ray goes on straight, and half is reflected: what meets the two walls is 0.5 and 0.5 times the colour."""
    b = SceneBuilder()
    half = Material("Half", (Lobe("glossy", Color.of(tint), 0.0, weight=0.5), Lobe("transparent", Color.of(1.0), weight=0.5)))
    b.quad("Pane", (-1, -1, 0), (2, 0, 0), (0, 2, 0), half)
    b.quad("Above", (-9, -9, 2), (0, 18, 0), (18, 0, 0), diffuse("Above", 0.5))
    b.quad("Below", (-9, -9, -2), (18, 0, 0), (0, 18, 0), diffuse("Below", 0.5))
    n = 40_000
    origin, down = np.tile(np.float32((0.3, 0.2, 1)), (n, 1)), np.tile(np.float32((0, 0, -1)), (n, 1))
    met = np.zeros(2)
    for part in Chains(World(b.build()), 4).follow(origin, down, RayKind.DIFFUSE, np.random.default_rng(3)):
        side = part.surface.position[:, 2]
        met += [part.weight[side > 1, 0].sum() / n, part.weight[side < -1, 0].sum() / n]
    assert met == pytest.approx([0.5 * tint, 0.5], abs=0.015)


@pytest.mark.parametrize("hops", [0, 1, 2])
def test_mirrors_are_no_hops_of_a_view_pass(hops):
    """Seen in a mirror, the ceiling is the first surface of those that are sampled before light is known."""
    b = SceneBuilder()
    b.quad("Mirror", (-0.1, -0.1, 0.5), (0.2, 0, 0), (0, 0.2, 0), Material("Mirror", (Lobe("glossy", Color.of(1.0), 0.0),)))
    b.quad("Floor", (-9, -9, 0), (18, 0, 0), (0, 18, 0), diffuse("Floor", 0.5))
    b.quad("Ceiling", (-9, -9, 2), (0, 18, 0), (18, 0, 0), diffuse("Ceiling", 0.5))
    world, read = World(b.build()), []

    class Known:
        def at(self, surface, segments):
            read.append(int(np.min(segments)))
            return np.ones((2, len(surface.triangle), 3))

    walk = Walk(world, Emitters(world), BsdfTable(world.scene))
    down = np.tile(np.float32((0, 0, -1)), (200, 1))
    mirror = world.surface(np.zeros(200, np.int32), np.full(200, 0.2, np.float32), np.full(200, 0.2, np.float32), down)
    View(walk, Known(), hops, sharp=False).gather(start(walk, mirror, -down)[0], np.random.default_rng(1))
    assert min(read) == hops + 1


@pytest.mark.parametrize("low", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("segments", [0, 1, 2])
def test_known_light_of_all_lengths_leaves_out_what_is_too_short(low, segments):
    """Light of k segments is 0.5^k here, and all of it 1: what may fly `segments` more must have flown low - segments already."""
    by_length = [np.zeros((1, 3)), *(np.full((1, 3), 0.5**k) for k in range(1, 6))]
    direct, rest = lengths_of(by_length, np.ones((1, 3)), by_length[1], low, 1024)(segments)
    least = low - segments
    assert direct == pytest.approx(0.5 if least <= 1 else 0.0)
    assert rest == pytest.approx(0.5 ** (max(least, 2) - 1))


@pytest.mark.parametrize("high", [2, 3, 4])
def test_known_light_by_length_is_cut_at_both_ends(high):
    by_length = [np.zeros((1, 3)), *(np.full((1, 3), 0.5**k) for k in range(1, 5))]
    direct, rest = lengths_of(by_length, None, by_length[1], 2, high)(0)
    assert not direct.any() and rest == pytest.approx(sum(0.5**k for k in range(2, high + 1)))


def test_the_ambient_estimate_counts_what_escapes_on_every_bounce():
    """Unshot flux U: of it s U arrives, of that rho s U again, and so on, over all the surfaces that light can reach."""
    area, rho = np.array([1.0, 3.0, 2.0]), np.array([[0.5] * 3, [0.7] * 3, [0.2] * 3])
    transport = SimpleNamespace(area=area, rho=rho)
    emitted = np.array([[4.0] * 3, [1.0] * 3, [0.0] * 3])
    state = DiffuseShooting(transport, emitted, np.zeros((3, 3)))
    assert not state.ambient().any()  # nothing is known of what escapes before the first shot
    state.sent, state.escaped, state.reached = np.full(3, 10.0), np.full(3, 4.0), np.array([True, True, False])
    stays, mean_rho, whole, unshot = 0.6, (0.5 + 3 * 0.7) / 4, 4.0, 4.0 + 3.0
    series = sum(unshot * stays * (mean_rho * stays) ** k for k in range(200))
    assert state.ambient() == pytest.approx(series / whole)


def test_light_that_goes_straight_through_a_sheet_is_conserved_by_chains():
    """What a shot sends arrives at diffuse lobes, escapes, or is lost where it is said to be: half of it on clear sheets it is none."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    b.quad("Sheet", (-9, -9, 0.5), (18, 0, 0), (0, 18, 0), Material("Clear", (Lobe("transparent", Color.of(0.6)),)))
    b.quad("Ceiling", (-9, -9, 1), (0, 18, 0), (18, 0, 0), diffuse("Ceiling", 0.5))
    world = World(b.build())
    shots = ExtendedShots(ElementRays(Elements(world, 100.0)), Chains(world, 4))
    arrived, escaped = shots.shoot(np.array([0]), np.ones((1, 3)), np.array([4000]))
    flux = shots.area @ arrived
    assert flux + shots.other + escaped == pytest.approx(np.full(3, 4.0), rel=1e-5)
    # The sheet, which scatters nothing, has taken its share; nearly all of the rest has met the ceiling.
    assert shots.area[4:] @ arrived[4:] == pytest.approx(np.full(3, 0.6 * 4.0), rel=0.03)
