"""Direction discretisation (Immel 1986): furnaces, lamps, the diffuse limit, glossy rooms against random walks, and its promises."""

from __future__ import annotations

import tracemalloc
from functools import partial

import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.base.errors import MemoryRefused
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.background import Background
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity.relaxation import jacobi
from adjgi.adjoint_gi.core.radiosity.transports import MatrixTransport
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.radiance import Walk, gather, lobes_of
from adjgi.tests import scenes, solving
from adjgi.tests.solving import on_elements

solvers.load()

FAST = {"bin_rows": 3, "bin_columns": 6, "rays": 4, "tolerance": 1e-8}
solve = partial(solving.solve, "directional_radiosity", **FAST)


def glossy_room(roughness=0.5, light=1.0, camera=None):
    """A closed room: a lit ceiling, a glossy floor and back wall, two coloured walls."""
    glossy = Material("Glossy", (Lobe("diffuse", Color.of(0.2)), Lobe("glossy", Color.of(0.7, 0.6, 0.5), roughness)))
    mats = [diffuse("Left", (0.6, 0.1, 0.1)), diffuse("Right", (0.1, 0.5, 0.1)), diffuse("Front", 0.3), glossy, glossy]
    mats.append(diffuse("Top", 0.5, light))
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 1.5), mats, inward=True)
    b.camera = camera
    return b.build()


def view(size=16):
    """Straight into the room."""
    return Camera("perspective", (1, 0.05, 0.75), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.7, 0.7, -0.5, 0.5), size, size)


def walked(world, points, samples):
    """(n, 3) radiance towards the camera by random walks with light points and all lobes, without own emission."""
    walk = Walk(world, Emitters(world), BsdfTable(world.scene))
    rng = np.random.default_rng(5)
    surface = world.surface(points.triangle, points.u, points.v, points.towards)
    total = np.zeros((len(points.triangle), 3))
    for _ in range(samples):
        found = gather(walk, surface, lobes_of(walk, surface, points.towards), rng)
        total += found.direct + found.indirect
    return total / samples


# ---- exact answers


@pytest.mark.parametrize("tolerance", [1.0, 0.5])
@pytest.mark.parametrize("strategy", ["gathering", "shooting"])
def test_giving_up_early_makes_no_negative_light(strategy, tolerance):
    b = scenes.cornell(boxes=False)
    s = solve(ElementReceivers(Elements(World(b), 0.5)), strategy=strategy, tolerance=tolerance)
    assert s.indirect.min() >= 0 and s.direct.min() >= 0


@pytest.mark.parametrize("strategy", ["gathering", "shooting"])
def test_one_furnace_with_every_bounce(strategy):
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    for longest, want in enumerate((1, 1.5, 1.75, 1.875)):
        s = solve(receivers, max_length=longest, strategy=strategy)
        assert np.allclose(s.quantity("radiosity")[0::2], want, rtol=2e-7)
    s = solve(receivers, strategy=strategy)
    assert np.allclose(s.quantity("radiosity")[0::2], 2.0, rtol=1e-6)
    assert np.allclose(s.direct[0::2], 1.0, rtol=1e-6)
    s = solve(receivers, min_length=2, strategy=strategy)
    assert not s.emitted.any() and not s.direct.any()
    assert np.allclose(s.indirect[0::2], 1.0, rtol=1e-6)
    s = solve(receivers, min_length=3, max_length=4, strategy=strategy)
    assert np.allclose(s.quantity("irradiance")[0::2], 0.375, rtol=1e-6)
    for shortest, want in ((3, 0.5), (4, 0.25)):
        for solver in ("jacobi", "gauss_seidel"):
            s = solve(receivers, min_length=shortest, strategy=strategy, solver=solver)
            assert np.allclose(s.quantity("irradiance")[0::2], want, rtol=1e-6)


@pytest.mark.parametrize("bins", [(1, 1), (2, 6), (4, 8)])
@pytest.mark.parametrize("lobes", [(("glossy", 0.75),), (("glossy", 0.25), ("diffuse", 0.5))])
def test_eight_mirror_furnace_at_each_bin_count(bins, lobes):
    """T8 with lobes of constant albedo a: every wall emits 1 - a in all directions, so that L = 1."""
    wall = Material("Wall", (*(Lobe(kind, Color.of(a), 0.0) for kind, a in lobes), Lobe("emission", Color.of(0.25))))
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), wall, inward=True)
    s = solve(on_elements(b.build(), 2.0), bin_rows=bins[0], bin_columns=bins[1], tolerance=1e-12)
    assert np.allclose(s.quantity("irradiance")[0::2], np.pi, rtol=1e-6)
    assert s.balance.gap < 1e-9


def test_a_lamp_in_a_closed_box():
    flux, _, indirect = solving.lamp_in_a_closed_box(solve)
    assert np.allclose(indirect, flux, rtol=0.02)


@pytest.mark.parametrize("drawn", [False, True])
def test_the_world_lights_a_plane(drawn, monkeypatch):
    """Once, also where light points are drawn from it."""
    monkeypatch.setattr(Background, "importance", np.full(1, float(drawn)))
    b = SceneBuilder()
    b.background = (1.0, 2.0, 3.0)
    b.quad("Plane", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    s = solve(on_elements(b.build(), 0.5))
    assert np.allclose(s.direct, np.pi * np.array([1, 2, 3]), rtol=1e-6)
    assert not s.indirect.any()


def test_diffuse_input_equals_the_full_matrix_of_the_same_rays(monkeypatch):
    """Through the solver, whose answer is float32; to 1e-10 in tests/core/test_directions.py."""
    scene = scenes.room(0.7, 0.2, 0.5, (0.3, 0, 0, 0, 0, 1.0))
    receivers = on_elements(scene, 1.5)
    e = receivers.elements
    runs = []

    class Recorded(solvers.directional_radiosity.BinRun):
        def __init__(self, *args):
            super().__init__(*args)
            runs.append(self)

    monkeypatch.setattr(solvers.directional_radiosity, "BinRun", Recorded)
    solver = method("directional_radiosity")
    *_, last = solver.solve(e.world, receivers, solver.Settings(**{**FAST, "tolerance": 1e-13}), np.random.default_rng(0))
    (run,) = runs
    t = run.transport
    per = t.bins.size * t.rays
    hit = t.met >= 0
    flat = np.repeat(np.arange(t.count), per)[hit] * t.count + t.met[hit] // t.bins.size
    factors = np.bincount(flat, minlength=t.count**2).reshape(t.count, t.count) / per
    emitted = np.repeat(e.emitted, 2, axis=0)
    *_, want = jacobi(MatrixTransport(t.area, np.repeat(e.albedo, 2, axis=0), factors), emitted, 0 * emitted, 1e-16, 3000)
    found = np.pi * (run.first + run.rest).mean(axis=1)
    assert np.abs(found - want.irradiance).max() < 1e-10
    assert np.allclose(last.solution().quantity("irradiance"), want.irradiance, rtol=1e-6)


def test_all_ways_to_relax_have_one_limit():
    receivers = on_elements(glossy_room(), 0.75)
    ways = ({"solver": "jacobi"}, {"solver": "gauss_seidel"}, {"strategy": "shooting"})
    a, b, c = (solve(receivers, tolerance=1e-10, **way).quantity("irradiance") for way in ways)
    assert np.allclose(a, b, rtol=1e-6, atol=1e-7)
    assert np.allclose(a, c, rtol=1e-6, atol=1e-7)


# ---- against random walks


# Mean irradiance of the faces of `glossy_room`, by core/walks/radiance.py with 430,000 walks for each face, and its standard error.
WALKED = [
    (1.436, 1.421, 1.186),
    (1.564, 1.325, 1.185),
    (1.496, 1.360, 1.139),
    (1.389, 1.279, 1.082),
    (1.501, 1.395, 1.206),
    (0.834, 0.688, 0.454),
]
WALKED_ERROR = 0.0018


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("directional_radiosity", {"bin_rows": 6, "bin_columns": 12, "rays": 8}),
        ("directional_radiosity", {"bin_rows": 12, "bin_columns": 24, "rays": 2, "strategy": "shooting"}),
        ("spherical_harmonics", {"order": 6, "rays": 400_000}),
    ],
)
def test_glossy_room_agrees_with_walks_at_elements(name, options):
    receivers = on_elements(glossy_room(), 0.25)
    got = solving.solve(name, receivers, **options).quantity("irradiance")[0::2]
    e = receivers.elements
    means = [np.average(got[e.patch == face], axis=0, weights=e.area[e.patch == face]) for face in range(6)]
    assert np.abs(np.array(means) - WALKED).max() < 5 * WALKED_ERROR + 0.005


def test_glossy_room_agrees_with_walks_at_the_camera():
    world = World(glossy_room(camera=view()))
    camera = CameraReceivers(world, 2)
    options = {"bin_rows": 6, "bin_columns": 12, "rays": 8}
    points = camera.sample(np.arange(camera.count), np.random.default_rng(1))
    reference = walked(world, points, 96)
    for direct_light in ("receivers", "elements"):
        seen = solve(camera, max_edge=0.25, direct_light=direct_light, **options)
        difference = seen.quantity("radiance") - seen.emitted - reference
        assert np.abs(difference.mean(axis=0)).max() < 0.03 * reference.mean()


def test_light_passes_a_transparent_sheet_and_glass():
    """A lit ceiling over a sheet that fills the room: what passes is what the sheet lets through."""
    for sheet, through in (
        (Material("Sheet", (Lobe("transparent", Color.of(0.5)),)), 0.5),
        (Material("Sheet", (Lobe("refraction", Color.of(0.5), 0.0, 1.0),)), 0.5),
    ):
        b = SceneBuilder()
        mats = [diffuse(f"F{i}", 0.0, 1.0 if i == 5 else 0.0) for i in range(6)]
        b.box("Room", (0, 0, 0), (4, 4, 3), mats, inward=True)
        clear = on_elements(b.build(), 0.5)
        b.quad("Sheet", (0, 0, 1.5), (4, 0, 0), (0, 4, 0), sheet)
        blocked = on_elements(b.build(), 0.5)
        options = {"bin_rows": 8, "bin_columns": 16, "rays": 4}
        a, c = (solve(r, **options).quantity("irradiance") for r in (clear, blocked))
        floor = [np.flatnonzero(r.elements.patch == 4) for r in (clear, blocked)]
        mean = [x[2 * f, 0].mean() for x, f in zip((a, c), floor, strict=True)]
        assert mean[1] == pytest.approx(through * mean[0], rel=0.03)


# ---- receivers and promises


def test_texels_and_camera_get_what_the_elements_have():
    world = World(scenes.cube(0.5, 1.0))
    centre = np.full(12, 1 / 3, np.float32)
    texels = SurfaceReceivers("texels", np.arange(13), np.arange(12), centre, centre)
    texels.world = world
    s = solve(texels, max_edge=0.5, light_samples=512)
    assert np.allclose(s.indirect, 1.0, rtol=1e-5)
    assert np.allclose(s.direct, 1.0, rtol=0.15)
    s = solve(texels, max_edge=0.5, direct_light="elements")
    assert np.allclose(s.quantity("radiosity"), 2.0, rtol=1e-5)
    b = SceneBuilder()
    b.box(
        "Room", (0, 0, 0), (2, 2, 1.5), Material("Wall", (Lobe("glossy", Color.of(0.5), 0.0), Lobe("emission", Color.of(0.5)))), inward=True
    )
    b.camera = view(4)
    for direct_light in ("elements", "receivers"):
        s = solve(CameraReceivers(World(b.build())), max_edge=0.75, direct_light=direct_light)
        assert np.allclose(s.quantity("radiance"), 1.0, rtol=2e-5)
        assert np.allclose(s.emitted, 0.5) and np.allclose(s.direct, 0.25, rtol=2e-5)
        assert np.allclose(s.extra["elements"], np.pi, rtol=1e-5)


def test_memory_is_said_and_refused_before_the_start():
    solver = method("directional_radiosity")
    receivers = on_elements(glossy_room(), 0.1)
    world = receivers.elements.world
    small, large = (solver.Settings(bin_rows=n, bin_columns=n) for n in (4, 16))
    a, b = (solver.memory(world, receivers, s) for s in (small, large))
    n = receivers.count
    assert b - a >= n * (256 - 16) * (4 * small.rays + 6 * 24)
    limited = solver.Settings(bin_rows=16, bin_columns=16, memory_limit=b >> 20)
    steps = solver.solve(world, receivers, limited, np.random.default_rng(0))
    with pytest.raises(MemoryRefused, match="over its limit"):
        next(steps)
    allowed = solver.Settings(memory_limit=(a >> 20) + 1, bin_rows=4, bin_columns=4)
    assert next(solver.solve(world, receivers, allowed, np.random.default_rng(0))).fraction < 1


def test_memory_bounds_what_is_used():
    solver = method("directional_radiosity")
    receivers = on_elements(glossy_room(), 0.25)
    for strategy in ("gathering", "shooting"):
        settings = solver.Settings(bin_rows=8, bin_columns=16, rays=4, strategy=strategy, tolerance=1e-2)
        tracemalloc.start()
        *_, last = solver.solve(receivers.elements.world, receivers, settings, np.random.default_rng(0))
        last.solution()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < solver.memory(receivers.elements.world, receivers, settings)


def test_steps_partial_results_and_notices():
    receivers = on_elements(glossy_room(), 0.2)
    steps = list(solving.steps("directional_radiosity", receivers, tolerance=1e-9, max_iterations=2))
    assert steps[-1].fraction == 1.0 and not steps[-1].solution().partial
    assert all(a.fraction <= b.fraction + 1e-9 for a, b in zip(steps, steps[1:], strict=False))
    assert any("stopped after 2 iterations" in str(x) for x in steps[-1].solution().warnings)
    s = solve(receivers)
    assert s.rays > 0 and s.history[-1][1] <= 1e-8
    assert s.balance.gap < 0.02  # rays of both ends of a path are not the same
    b = SceneBuilder()
    b.box("Dark", (0, 0, 0), (1, 1, 1), diffuse("Grey", 0.5), inward=True)
    dark = solve(on_elements(b.build()))
    assert not dark.quantity("irradiance").any()
    assert any("nothing emits light" in str(x) for x in dark.warnings)
    assert len(solve(on_elements(SceneBuilder().build())).direct) == 0
