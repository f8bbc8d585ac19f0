"""The two-pass method against exact solutions with mirrors, and both its passes on their own."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, RayKind
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import radiance
from adjgi.adjoint_gi.core.walks.mirror_chains import Chains
from adjgi.solvers.two_pass import FirstPass
from adjgi.tests import scenes, solving
from adjgi.tests.solving import on_elements

MIRROR = Material("Mirror", (Lobe("glossy", Color.of(1, 1, 1), 0.0),))
solve = partial(solving.solve, "two_pass")


def first_pass(scene, edge=10.0, **options):
    """The first pass alone, done."""
    world = World(scene)
    first = FirstPass(Elements(world, edge), Emitters(world), method("two_pass").Settings(**options), True)
    for share, _ in first.run():
        assert 0 <= share <= 1
    return first


def mirror_cube(ceiling=1.0):
    """T11: face -x is a perfect mirror, the others diffuse of 0.5; the ceiling emits."""
    mats = [MIRROR, *(diffuse(f"Face{i}", 0.5, ceiling / np.pi if i == 5 else 0.0) for i in range(1, 6))]
    return scenes.cube(materials=mats)


def cavity(k=0.5):
    """T8: two faces are mirror and diffuse at once; every surface emits what it does not reflect, so the radiance is 1 everywhere."""
    mixed = Material(
        "Mixed",
        (Lobe("diffuse", Color.of(0.3, 0.3, 0.3)), Lobe("glossy", Color.of(k, k, k), 0.0), Lobe("emission", Color.of(*[0.7 - k] * 3))),
    )
    return scenes.cube(materials=[mixed, mixed, *[diffuse("Wall", 0.6, 0.4)] * 4])


def test_one_furnace_and_every_bounce():
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    for light in ("elements", "receivers"):
        s = solve(receivers, rays=32, samples=256, direct_light=light)
        assert np.allclose(s.quantity("radiosity")[0::2].mean(axis=0), 2.0, rtol=1e-4 if light == "elements" else 0.01)
    for longest, want in enumerate((1, 1.5, 1.75, 1.875, 1.9375)):
        s = solve(receivers, rays=32, samples=1, max_length=longest, direct_light="elements")
        assert np.allclose(s.quantity("radiosity")[0::2], want, rtol=1e-5)
    for shortest, want in ((1, 1.0), (2, 0.5), (3, 0.25)):
        s = solve(receivers, rays=32, samples=1, min_length=shortest, direct_light="elements")
        assert not s.emitted.any()
        assert np.allclose(s.albedo[0::2] * s.quantity("irradiance")[0::2], want, rtol=1e-4)


def test_eleven_extended_factor_over_a_mirror():
    first = first_pass(mirror_cube(), rays=65_536)
    t = first.transport
    floor = t.through(t.emitted, t.rows[1])[8, 0], t.through(t.emitted, t.rows[2])[8, 0]
    assert floor[0] == pytest.approx(0.199825, rel=5e-3)
    assert floor[1] == pytest.approx(0.086050, rel=5e-3)
    b = (np.repeat(first.elements.emitted, 2, axis=0) + t.rho * first.total)[0::2, 0]
    assert b[5] == pytest.approx(1.11142355, rel=1e-3)
    assert b[4] == pytest.approx(0.23648522, rel=3e-3)
    assert np.allclose(b[2:4], 0.21845583, rtol=3e-3)
    assert b[1] == pytest.approx(0.21517958, rel=3e-3)


def test_eleven_mirror_is_the_room_beyond():
    """A cube with a mirror has the irradiance of the room of twice the length, also for texels that are gathered."""
    b = SceneBuilder()
    b.box("Room", (-1, 0, 0), (1, 1, 1), [diffuse(f"Face{i}", 0.5, 1 / np.pi if i == 5 else 0.0) for i in range(6)], inward=True)
    cube, room = World(mirror_cube()), World(b.build())
    x, y = 0.15, 0.4
    rng = np.random.default_rng(0)
    answers = []
    for world, gather in ((cube, False), (cube, True), (room, False)):
        origin = np.array([[x, y, 0.01]], np.float32) - world.center.astype(np.float32)
        triangle, u, v, _ = world.intersect(origin, np.array([[0, 0, -1]], np.float32), RayKind.CAMERA)
        texel = SurfaceReceivers("texels", [0, 1], triangle, u, v)
        solver = method("two_pass")
        options = solver.Settings(samples=4096, rays=256, max_edge=0.125, gather=gather)
        *_, last = solver.solve(world, texel, options, rng)
        s = last.solution()
        answers.append((s.direct + s.indirect)[0, 0])
    assert np.allclose(answers, answers[2], rtol=0.02)


@pytest.mark.parametrize("gather", [False, True])
def test_eight_kirchhoff_cavity_with_mirrors(gather):
    receivers = on_elements(cavity(), 0.5)
    s = solve(receivers, rays=128, samples=256, depth=64, gather=gather)
    h = s.quantity("irradiance")[0::2] / np.pi
    assert h.mean() == pytest.approx(1.0, abs=0.005)
    assert np.abs(h - 1).max() < 0.08


def test_eight_seen_by_a_camera():
    camera = Camera("perspective", (0.5, 0.3, 0.5), (0, 1, 0), (0, 0, 1), (1, 0, 0), (-1, 1, -1, 1), 12, 12)
    world = World(dataclasses.replace(cavity(), camera=camera))
    s = solve(CameraReceivers(world), rays=128, samples=128, depth=64, max_edge=0.25)
    seen = s.quantity("radiance")
    assert seen.mean() == pytest.approx(1.0, abs=0.005)
    assert np.abs(seen - 1).max() < 0.15


def rough_cavity():
    """T8 with a rough glossy lobe of small albedo: its directional albedo is nearly its colour at low roughness."""
    gloss = Material("Gloss", (Lobe("glossy", Color.of(0.8, 0.8, 0.8), 0.2), Lobe("emission", Color.of(0.2, 0.2, 0.2))))
    return scenes.cube(materials=[gloss, gloss, *[diffuse("Wall", 0.6, 0.4)] * 4])


def test_rough_lobes_take_part_in_the_first_pass_or_not():
    full, bare = (first_pass(rough_cavity(), 0.5, rays=256, rough=rough, depth=64) for rough in (True, False))
    walls = np.flatnonzero(full.transport.rho[0::2, 0] > 0) * 2
    assert full.total[walls].mean() / np.pi == pytest.approx(1.0, abs=0.02)
    assert bare.total[walls].mean() < 0.9 * full.total[walls].mean()


def test_light_of_a_point_lamp_over_a_mirror():
    """The mirror shows a second lamp at height -1, at three times the distance of the first from the ceiling."""
    first = first_pass(scenes.lamp_over_mirror(), 100.0, particles=2_000_000, rays=16)
    assert first.outside.caustics.unmet.any()
    got = first.outside.caustics.total[2]  # front of the ceiling, which faces down
    assert np.allclose(got, first.outside.caustics.unmet.sum(axis=0)[2])
    straight = first.outside.straight[2]
    assert np.allclose(got / straight, 1 / 9, rtol=0.1)
    assert np.allclose(first.total[2], got + straight, rtol=1e-6)
    none = first_pass(scenes.lamp_over_mirror(), 100.0, particles=0, rays=16)
    assert not none.outside.caustics.total.any() and np.allclose(none.total[2], straight)


def test_light_of_the_background_over_a_mirror_is_met_by_rays():
    """So what is known of it does not count beside what they find."""
    b = SceneBuilder()
    b.quad("Mirror", (0, 0, 0), (1, 0, 0), (0, 1, 0), MIRROR)
    b.quad("Wall", (0, 0, 0), (0, 1, 0), (0, 0, 1), diffuse("Wall", 0.5))
    b.background = (1.0, 1.0, 1.0)
    caustics = first_pass(b.build(), 100.0, particles=4096, rays=16).outside.caustics
    assert caustics.total[2].min() > 0.1 and not caustics.unmet.any()


@pytest.mark.parametrize("far", [0.0, 2e3, 2e4])
@pytest.mark.parametrize("sky", ["sun", "sky"])
def test_light_over_a_mirror_that_is_far_from_other_things(sky, far):
    """A wall beside a mirror, and another object far away: over the mirror the wall gets what it gets without that."""
    b = SceneBuilder()
    b.quad("Mirror", (0, 0, 0), (1, 0, 0), (0, 1, 0), MIRROR)
    b.quad("Wall", (0, 0, 0), (0, 1, 0), (0, 0, 1), diffuse("Wall", 0.5))
    if far:
        b.quad("Far", (far, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Far", 0.5))
    if sky == "sun":
        b.light(Light("Sun", "sun", (1.0,) * 3, axis_x=(0.8, 0, -0.6), axis_y=(0, 1, 0), axis_z=(0.6, 0, 0.8)))
    else:
        b.background = (1 / np.pi,) * 3
    caustics = first_pass(b.build(), 100.0, particles=100_000, rays=16).outside.caustics
    # Of the sun all that falls within 0.75 m of the wall, of the sky the form factor between squares that share an edge.
    expected = 0.75 * 0.8 if sky == "sun" else 0.20004378
    assert caustics.total[2, 0] == pytest.approx(expected, rel=0.03) and not caustics.total[3].any()


def test_light_of_a_lamp_with_a_size_through_a_pane():
    """Particles from the lamp bring what rays that meet the lamp through the pane find; the pane is thick, so both its faces refract."""
    glass = Material("Glass", (Lobe("glass", Color.of(1, 0.9, 0.8), 0.0, 1.5),))
    b = SceneBuilder()
    b.quad("Floor", (-0.2, -0.2, 0), (0.4, 0, 0), (0, 0.4, 0), diffuse("Floor", 0.5))
    b.box("Pane", (-3, -3, 0.4), (3, 3, 0.6), glass, inward=False)
    b.light(Light("Lamp", "area", (5.0, 5.0, 5.0), position=(0, 0, 1.5), axis_z=(0, 0, 1), axis_x=(1, 0, 0), size_x=0.8, size_y=0.8))
    world = World(b.build())
    walk = radiance.Walk(world, Emitters(world), bsdf.BsdfTable(world.scene))
    rng = np.random.default_rng(0)
    n = 200_000
    triangle, u = rng.integers(0, 2, n).astype(np.int32), rng.random((2, n), np.float32)
    fold = u.sum(axis=0) > 1
    u = np.where(fold, 1 - u, u)
    surface = world.surface(triangle, u[0], u[1])
    found = radiance.gather(walk, surface, radiance.white(walk, surface), rng)
    truth = np.pi * (found.direct + found.indirect).astype(float)
    error = truth.std(axis=0) / np.sqrt(n)
    first = first_pass(b.build(), 100.0, particles=2_000_000, rays=16)
    np.testing.assert_allclose(first.outside.caustics.unmet.sum(axis=0), first.outside.caustics.total)
    got = first.total[0]
    assert (np.abs(got - truth.mean(axis=0)) < 5 * error + 0.02 * truth.mean(axis=0)).all()
    assert (error < 0.02 * truth.mean(axis=0)).all()


def test_a_coat_dims_what_lies_below_it_but_no_light_is_lost():
    """Under uniform light a coated surface reflects coat and base together, less than 1 and more than the base alone."""
    coated = Material("Coated", (Lobe("diffuse", Color.of(0.5, 0.5, 0.5)), Lobe("specular", Color.of(1, 1, 1), 0.0, 1.5)))
    first = first_pass(scenes.cube(materials=[coated, *[diffuse("Wall", 0.0, 1.0)] * 5]), rays=4096)
    chains = first.chains
    at = np.zeros(1, np.int32), np.full(1, 0.3, np.float32), np.full(1, 0.3, np.float32)
    mean = chains.table.coats.mean_albedo(chains.table.coating(*at), 1)[0, 0]
    assert mean == pytest.approx(0.0918, abs=2e-3)  # Fresnel reflectance of diffuse light at index 1.5
    # A white furnace: all that leaves the coated face, seen from the others, is base and coat times the radiance 1 of the walls.
    t = first.transport
    walls = np.arange(2, 12, 2)
    arrives = t.through(t.rho * first.total, t.rows[1])[walls, 0]
    want = t.through(np.pi * 0.5 * (np.arange(12) == 0)[:, None] * np.ones(3), t.rows[1], emitted=True)[walls, 0] * (1 - mean)
    assert arrives.sum() == pytest.approx(want.sum(), rel=0.02)


def test_chains_tell_how_far_and_over_what_they_went():
    world = World(scenes.lamp_over_mirror())
    chains = Chains(world, 4)
    n = 100
    origin = np.tile(np.array([[0, 0, 0]], np.float32), (n, 1))
    wi = np.tile(np.array([[0, 0, -1]], np.float32), (n, 1))
    met = list(chains.follow(origin, wi, RayKind.DIFFUSE, np.random.default_rng(0)))
    assert [m.segments for m in met] == [1, 2]
    assert met[0].clear.all() and met[1].clear.all()
    assert np.allclose(met[1].weight, 1) and (met[1].surface.triangle >= 2).all()
    assert not met[1].sent.any()
    # A depth of none ends at the mirror.
    assert [m.segments for m in Chains(world, 0).follow(origin, wi, RayKind.DIFFUSE, np.random.default_rng(0))] == [1]


def test_albedo_one_stops_and_says_so_and_a_dark_scene_too():
    s = solve(on_elements(scenes.cube(1.0, 1.0), 0.5), rays=16, samples=1, max_iterations=20)
    assert any("stopped after 20 iterations" in str(w) for w in s.warnings)
    s = solve(on_elements(scenes.cube()), rays=16, samples=1)
    assert any("nothing emits light" in str(w) for w in s.warnings)
    assert solve(on_elements(SceneBuilder().build())).direct.shape == (0, 3)


def test_no_step_is_long_and_memory_grows_with_rays():
    solver = method("two_pass")
    world = World(scenes.cornell(4, 4))
    few, many = (solver.memory(world, CameraReceivers(world), solver.Settings(rays=rays)) for rays in (64, 128))
    assert many > few


def test_paths_of_a_least_length_by_way_of_a_mirror_and_a_diffuse_surface_that_are_sampled():
    """The first pass knows its light by length as far as the second one asks: two segments before a receiver that is sampled, too."""
    world, receivers = World(mirror_cube()), solving.quad_points(*solving.grid(3), first=4)
    exact = solving.solve("path_tracing", world, receivers, samples=512, min_length=3).indirect.mean()
    options = {"samples": 256, "rays": 256, "max_edge": 0.5, "particles": 0, "direct_light": "elements"}
    found = solve(world, receivers, gather=True, min_length=3, **options)
    assert found.indirect.mean() == pytest.approx(exact, rel=0.05)  # elements of 0.5 m; one length too few takes 14 %


@pytest.mark.parametrize(
    "low, high, segments, counts", [(0, 2, 0, True), (0, 2, 1, False), (3, 8, 0, False), (3, 8, 1, True), (3, 8, 7, False)]
)
def test_what_no_ray_meets_counts_where_its_whole_path_does(low, high, segments, counts):
    """It has two segments, and flies `segments` more."""
    unmet = first_pass(scenes.lamp_over_mirror(), 100.0, particles=4096, rays=16).outside.caustics.unmet_light(low, high)
    assert unmet.lengths(segments)[1].any() == counts


@pytest.mark.parametrize("shortest, share", [(1, 2**-8), (3, 2**-6), (5, 2**-4)])
def test_what_is_longer_than_the_longest_is_a_share_of_what_counts(shortest, share):
    """In a furnace of albedo 1/2 every length has half the light of the one before, and eight may count."""
    first = first_pass(scenes.cube(0.5, 1.0), rays=64, min_length=shortest, max_length=8)
    assert first.left_out() == pytest.approx(share, rel=1e-3)
