"""Radiance in harmonics, shot (Sillion 1991): diffuse it is progressive radiosity, flux is exact, glossy error falls with the order."""

from __future__ import annotations

import dataclasses
import tracemalloc
from functools import partial

import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.directional.harmonic_shooting import HarmonicShooting
from adjgi.adjoint_gi.core.directional.harmonics import HemisphereHarmonics
from adjgi.adjoint_gi.core.directional.rays import DirectionalRays
from adjgi.adjoint_gi.core.directional.run import leaving
from adjgi.adjoint_gi.core.directional.scattering import Scattering
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.background import Background
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity.southwell import DiffuseShooting, Grouping
from adjgi.adjoint_gi.core.radiosity.transports import FreshRayTransport
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.radiance import Walk, gather, lobes_of
from adjgi.tests import scenes, solving
from adjgi.tests.solving import on_elements

solvers.load()

FAST = {"rays": 100_000, "tolerance": 1e-3, "order": 2}
solve = partial(solving.solve, "spherical_harmonics", **FAST)
states = partial(solving.steps, "spherical_harmonics")


def glossy_room(roughness=0.6, camera=None, glossy=0.7, base=0.1):
    """A closed room, lit from one wall, with a floor that reflects in a lobe."""
    floor = Material("Floor", (Lobe("diffuse", Color.of(base)), Lobe("glossy", Color.of(glossy), roughness)))
    mats = [diffuse("Left", 0.5, 1.0), diffuse("Right", (0.1, 0.5, 0.1)), diffuse("Front", 0.3), diffuse("Back", 0.3), floor]
    mats.append(diffuse("Top", 0.5))
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 1.5), mats, inward=True)
    b.camera = camera
    return b.build()


def down(size=12):
    """From the dark wall, down to the floor against the light."""
    f = np.array([-0.8, 0, -0.6])
    return Camera("perspective", (1.95, 1, 1.2), (0, 1, 0), (-0.6, 0, 0.8), tuple(f), (-0.4, 0.4, -0.2, 0.4), size, size)


def shooter(elements, order, window=0.0, low=0, high=NO_LIMIT):
    caster, basis = DirectionalRays(elements), HemisphereHarmonics(order, window)
    scattering = Scattering.ready(elements, BsdfTable(elements.world.scene), basis, 1 << 14)
    state = HarmonicShooting(caster, scattering, low, high)
    state.emit(leaving(elements, scattering.basis))
    return state


def mean_face(receivers, values, face):
    e = receivers.elements
    here = np.flatnonzero(e.patch == face)
    return np.average(values[2 * here], axis=0, weights=e.area[here])


@pytest.mark.parametrize("order", [0, 3])
@pytest.mark.parametrize(("low", "high"), [(0, NO_LIMIT), (1, 2), (3, NO_LIMIT)])
def test_diffuse_walls_equal_progressive_radiosity_on_the_same_rays(order, low, high):
    elements = Elements(World(scenes.room(0.7, 0.2, 0.5, (0.3, 0, 0, 0, 0, 1.0))), 1.5)
    ours = shooter(elements, order, low=low, high=high)
    transport = FreshRayTransport(ours.caster)
    theirs = DiffuseShooting(transport, np.repeat(elements.emitted, 2, axis=0), np.zeros((2 * elements.count, 3)), low, high)
    grouping = Grouping.for_sides(2 * elements.count, 20_000)
    for _ in range(12):
        index, rays = grouping.next(theirs)
        if not len(index):
            break
        theirs.shoot(index, rays)
        ours.shoot(index, rays)
    assert ours.count == transport.count > 10_000
    for a, b in ((ours.direct, theirs.direct), (ours.indirect, theirs.indirect)):
        assert np.allclose(np.sqrt(2 * np.pi) * a[:, 0], b, rtol=1e-12, atol=1e-12)
    assert np.allclose(ours.absorbed, theirs.absorbed, rtol=1e-12)
    assert np.allclose(ours.remaining(), theirs.remaining(), rtol=1e-9, atol=1e-12)
    # And both methods end within their tolerance of each other.
    if (low, high) == (0, NO_LIMIT):
        receivers = ElementReceivers(elements)
        a = solve(receivers, order=order, rays=400_000, tolerance=1e-4).quantity("irradiance")
        b = solving.solve("progressive_radiosity", receivers, rays=400_000, tolerance=1e-4).quantity("irradiance")
        assert np.allclose(a[0::2], b[0::2], rtol=0.02)


def test_eight_diffuse_furnace_is_exact_at_order_zero():
    """T1 and T8: the flux is exact, single elements are within the noise of the rays that reach them."""
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    s = solve(receivers, order=0, tolerance=1e-9, rays=1_000_000)
    area = receivers.elements.area
    assert np.average(s.quantity("radiosity")[0::2, 0], weights=area) == pytest.approx(2.0, rel=1e-6)
    assert np.allclose(s.quantity("radiosity")[0::2], 2.0, rtol=0.02)
    for longest, want in enumerate((1, 1.5, 1.75, 1.875)):
        s = solve(receivers, order=0, max_length=longest, tolerance=0.0)
        assert np.average(s.quantity("radiosity")[0::2, 0], weights=area) == pytest.approx(want, rel=1e-6)
    s = solve(receivers, order=0, min_length=3, max_length=3, tolerance=0.0)
    assert np.average(s.indirect[0::2, 0], weights=area) == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("order", [0, 2, 5])
def test_eight_glossy_kirchhoff_cavity(order):
    """T8: walls that emit 1 - a, with a what the harmonics reflect of L = 1, hold L = 1."""
    wall = Material("Wall", (Lobe("diffuse", Color.of(0.2)), Lobe("glossy", Color.of(0.6), 0.5)))
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), wall, inward=True)
    elements = Elements(World(b.build()), 1.0)
    state = shooter(elements, order)
    one = np.zeros((2 * elements.count, state.basis.size, 3))
    one[0::2] = state.basis.constant()[:, None]
    moments = np.einsum("ab,nbc->nac", state.basis.gram, one)
    emitted = one - state.scattering.apply(moments)
    emitted[1::2] = 0
    state.emit(emitted)
    grouping = solvers.spherical_harmonics.grouping(state, 400_000)
    while state.unshot_flux().sum() > 1e-6 * state.total:
        state.shoot(*grouping.next(state))
    radiance = emitted + state.scattering.apply(state.direct + state.indirect)
    irradiance = np.sqrt(2 * np.pi) * (state.direct + state.indirect)[0::2, 0]
    assert np.allclose(irradiance, np.pi, rtol=0.02)
    assert np.allclose(radiance[0::2] @ np.ones(3) / 3, one[0::2, :, 0], atol=0.05)
    lost = state.emitted - state.absorbed - state.escaped - state.remaining()
    assert np.abs(lost).max() < 1e-9 * state.total


@pytest.mark.parametrize("window", [0.0, 1.0])
@pytest.mark.parametrize("order", [0, 4])
def test_energy_is_accounted_for(order, window):
    receivers = on_elements(scenes.cornell(8, 8), 0.25)
    scene = receivers.elements.world.scene
    shiny = tuple(
        Material(m.name, (*m.lobes, Lobe("specular", Color.of(1.0), 0.3, 1.5))) if m.name == "White" else m for m in scene.materials
    )
    receivers = on_elements(dataclasses.replace(scene, materials=shiny), 0.25)
    for step in states(receivers, order=order, window=window, rays=50_000, tolerance=0.01):
        s = step.solution()
        assert s.balance.gap < 1e-9
    assert s.balance.escaped > 0 and s.balance.absorbed > 0
    assert s.balance.unshot < 0.02 * s.balance.emitted


def test_glossy_error_falls_with_the_order():
    """Radiance towards a camera of a floor that mirrors a wall, against random walks over the same points."""
    world = World(glossy_room(0.6, down()))
    camera = CameraReceivers(world, 2)
    walk = Walk(world, Emitters(world), BsdfTable(world.scene))
    rng = np.random.default_rng(3)
    want = np.zeros((camera.count, 3))
    for _ in range(96):
        points = camera.sample(np.arange(camera.count), rng)
        surface = world.surface(points.triangle, points.u, points.v, points.towards)
        found = gather(walk, surface, lobes_of(walk, surface, points.towards), rng)
        want += (found.direct + found.indirect) / 96
    floor = np.abs(surface.position[:, 2] + 0.75) < 1e-4
    assert floor.sum() > 60
    errors = []
    for order in (0, 2, 5, 8):
        s = solve(camera, order=order, max_edge=0.25, direct_light="elements", rays=600_000)
        got = s.direct + s.indirect
        errors.append(np.sqrt(((got - want)[floor] ** 2).mean() / (want[floor] ** 2).mean()))
    assert errors[3] < errors[2] < errors[1] < errors[0]
    assert errors[3] < 0.12
    # With direct light at the receivers, what is left for the harmonics is indirect.
    s = solve(camera, order=5, max_edge=0.25)
    assert (s.direct + s.indirect)[floor].mean() == pytest.approx(want[floor].mean(), rel=0.04)


@pytest.mark.parametrize("drawn", [False, True])
def test_lamps_and_background(drawn, monkeypatch):
    """The background once, also where light points are drawn from it."""
    monkeypatch.setattr(Background, "importance", np.full(1, float(drawn)))
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (4, 4, 4), diffuse("Wall", 0.5), inward=True)
    b.light(Light("Lamp", "point", (10.0, 20.0, 30.0), position=(2, 2, 2)))
    receivers = on_elements(b.build(), 1.0)
    s = solve(receivers, tolerance=1e-6)
    area = receivers.elements.area[:, None]
    flux = 4 * np.pi * np.array([10, 20, 30])
    assert np.allclose((area * s.direct[0::2]).sum(axis=0), flux, rtol=0.01)
    assert np.allclose((area * s.indirect[0::2]).sum(axis=0), (area * s.direct[0::2]).sum(axis=0), rtol=1e-5)
    b = SceneBuilder()
    b.background = (1.0, 2.0, 3.0)
    b.quad("Plane", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Grey", (Lobe("glossy", Color.of(0.5), 0.4),)))
    s = solve(on_elements(b.build(), 0.5))
    assert np.allclose(s.direct, np.pi * np.array([1, 2, 3]), rtol=1e-6)
    assert not s.indirect.any() and s.balance.gap < 1e-9


def test_texels_and_camera():
    world = World(scenes.cube(0.5, 1.0))
    centre = np.full(12, 1 / 3, np.float32)
    texels = SurfaceReceivers("texels", np.arange(13), np.arange(12), centre, centre)
    texels.world = world
    s = solve(texels, max_edge=0.5, direct_light="elements", rays=1_000_000)
    assert np.allclose(s.quantity("radiosity"), 2.0, rtol=0.02)
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 1.5), diffuse("Wall", 0.5, 0.5), inward=True)
    b.camera = down(4)
    s = solve(CameraReceivers(World(b.build())), max_edge=0.5, rays=1_000_000, order=3, direct_light="elements")
    assert np.allclose(s.quantity("radiance"), 1.0, rtol=0.02)
    assert np.allclose(s.emitted, 0.5)
    assert np.allclose(s.extra["elements"], np.pi, rtol=0.03)


def test_mirrors_that_see_each_other_come_to_an_end():
    """Noise that a narrow lobe makes of few rays must not be passed on and grow."""
    mirror = Material("Mirror", (Lobe("glossy", Color.of(0.8), 0.0),))
    mats = [mirror, mirror, diffuse("Front", 0.5), diffuse("Back", 0.5), mirror, diffuse("Top", 0.5, 1.0)]
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 1.5), mats, inward=True)
    receivers = on_elements(b.build(), 0.5)
    s = solve(receivers, order=6, rays=30_000, tolerance=2e-3)
    assert s.warnings == ()
    assert s.history[-1][1] <= 2e-3 and s.balance.gap < 1e-9


def test_windowing_takes_the_ringing_away():
    """The smallest radiance that a narrow lobe sends is less below 0."""
    elements = Elements(World(glossy_room(0.2)), 1.0)
    lowest = []
    for window in (0.0, 1.0):
        state = shooter(elements, 6, window)
        w = np.random.default_rng(0).normal(size=(500, 3))
        w = np.abs(w) / np.linalg.norm(w, axis=1)[:, None]
        moments = np.zeros((2 * elements.count, state.basis.size, 3))
        moments[:] = state.basis.values(np.array([[0.6, 0, 0.8]]))[0][:, None]
        radiance = state.basis.values(w) @ state.scattering.apply(moments, diffuse=False)[2 * int(np.flatnonzero(elements.patch == 4)[0])]
        lowest.append(radiance.min() / radiance.max())
    assert lowest[0] < lowest[1]


def test_memory_grows_with_the_order_and_bounds_what_is_used():
    solver = method("spherical_harmonics")
    receivers = on_elements(glossy_room(), 0.2)
    world = receivers.elements.world
    low, high = (solver.memory(world, receivers, solver.Settings(order=order)) for order in (0, 8))
    assert high > low
    tracemalloc.start()
    solve(receivers, order=8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < high


def test_notices_and_empty_scenes():
    receivers = on_elements(glossy_room(), 0.5)
    steps = list(states(receivers, max_shots=3))
    assert any("stopped after 3 shots" in str(x) for x in steps[-1].solution().warnings)
    assert steps[-1].fraction == 1.0 and not steps[-1].solution().partial
    assert len(solve(on_elements(SceneBuilder().build())).direct) == 0


PANE_OPTIONS = [
    ("spherical_harmonics", {"order": 4, "rays": 30_000, "tolerance": 5e-3, "max_edge": 2.0}),
    ("directional_radiosity", {"bin_rows": 4, "bin_columns": 8, "rays": 16, "max_edge": 1.0}),
]


@pytest.mark.parametrize(("light", "name", "options"), [*(("sky", *x) for x in PANE_OPTIONS), ("area", *PANE_OPTIONS[0])])
def test_a_pane_with_two_faces_lets_through_what_fresnel_says(light, name, options):
    """(1 - R) / (1 + R) of what falls on it, by all reflections between the faces; nothing beyond the critical angle is lost inside."""
    world, want = scenes.below_a_pane(light)
    s = solving.solve(name, world, solving.quads(range(5), 4), light_samples=32, **options)
    got = float(s.quantity("irradiance")[:, 0].reshape(5, -1).mean(axis=1) @ scenes.BELOW_AREA)
    assert got == pytest.approx(want, rel=0.035 if light == "area" else 0.02)
    assert sum("refracts" in w.reason for w in s.warnings) == 1


def test_a_pane_that_no_light_meets_is_not_worth_a_word():
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (1, 1, 1), diffuse("Wall", 0.5, 1.0), inward=True)
    b.quad("Pane", (5, 0, 0), (1, 0, 0), (0, 1, 0), Material("Pane", (Lobe("glass", Color.of(1.0), 0.0, 1.45),)))
    for name, options in PANE_OPTIONS:
        found = solving.solve(name, on_elements(b.build(), 1.0), **options)
        assert not any("refracts" in w.reason for w in found.warnings)


@pytest.mark.parametrize(("kind", "count"), [("glass", 1), ("glossy", 0)])
def test_light_through_glass_is_said_to_be_blurred(kind, count):
    b = SceneBuilder()
    b.quad("Pane", (0, 0, 0), (1, 0, 0), (0, 1, 0), Material("Pane", (Lobe(kind, Color.of(1.0), 0.5),)))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), position=(0.5, 0.5, 1.0)))
    world = World(b.build())
    found = solving.solve("spherical_harmonics", world, solving.scattered(world, 2), rays=1000, max_edge=1.0, tolerance=0.1)
    assert sum("refracts" in w.reason for w in found.warnings) == count
