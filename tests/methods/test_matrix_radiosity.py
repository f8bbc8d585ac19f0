"""Full-matrix radiosity through the real mesh path against exact solutions (T1 to T3, T6, T9, T9b, T10), and its promises."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import MemoryRefused, SceneError
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Color, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes, solving

solve = partial(solving.solve, "matrix_radiosity", rays=128, tolerance=1e-14)
states = partial(solving.steps, "matrix_radiosity", rays=128, tolerance=1e-14)
face_means = solving.front_means


def on_elements(scene, edge=10.0, exact=None):
    """World and its elements as receivers; `exact` (six albedos) undoes the rounding of colours to float32."""
    world = World(scene)
    elements = Elements(world, edge)
    if exact is not None:
        elements.albedo = np.repeat(np.broadcast_to(exact, 6)[elements.patch][:, None], 3, axis=1).astype(float)
        elements.emitted = np.round(elements.emitted, 6)
    return ElementReceivers(elements)


# Solutions are handed over as float32.
FLOAT32 = 2e-7


@pytest.mark.parametrize("solver", ["jacobi", "gauss_seidel"])
def test_nine_one_patch_a_face(solver):
    for rho, want in ((0.5, (1.0909090981, 0.1817458261, 0.1818362689)), (0.8, (1.5517241537, 0.6895510707, 0.6896811939))):
        receivers = on_elements(scenes.lit_cube(rho), exact=rho)
        got = face_means(receivers, solve(receivers, solver=solver).quantity("radiosity"))
        assert got[5] == pytest.approx(want[0], rel=FLOAT32)
        assert got[4] == pytest.approx(want[1], rel=FLOAT32)
        assert np.allclose(got[:4], want[2], rtol=FLOAT32)


def test_nine_b_mixed_albedos():
    rho = (0.5, 0.5, 0.63, 0.14, 0.2, 0.8)
    receivers = on_elements(scenes.lit_cube(rho), exact=rho)
    got = face_means(receivers, solve(receivers).quantity("radiosity"))
    want = [0.155936360493, 0.155936360493, 0.191955473047, 0.046719809960, 0.065934152332, 1.098647189394]
    assert np.allclose(got, want, rtol=FLOAT32)


@pytest.mark.parametrize(("n", "want"), [(2, (1.09901581, 0.17363911, 0.18183627)), (8, (1.10384468, 0.17137322, 0.18119552))])
def test_ten_refined(n, want):
    receivers = on_elements(scenes.lit_cube(0.5), 1 / n, exact=0.5)
    assert receivers.elements.count == 6 * n * n
    got = face_means(receivers, solve(receivers, rays=64).quantity("radiosity"))
    assert got[5] == pytest.approx(want[0], rel=FLOAT32)
    assert got[4] == pytest.approx(want[1], rel=FLOAT32)
    assert np.allclose(got[:4], want[2], rtol=FLOAT32)
    assert got.sum() == pytest.approx(2.0, rel=FLOAT32)


def test_one_furnace_with_every_bounce():
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.4)
    for longest, want in enumerate((1, 1.5, 1.75, 1.875, 1.9375, 1.96875)):
        s = solve(receivers, max_length=longest)
        # Both sides emit; what matters is inside.
        assert np.allclose(s.quantity("radiosity")[0::2], want, rtol=FLOAT32)
    assert np.allclose(solve(receivers).quantity("radiosity")[0::2], 2.0, rtol=FLOAT32)
    s = solve(receivers, min_length=2)
    assert not s.emitted.any() and not s.direct.any()
    assert np.allclose(s.indirect[0::2], 1.0, rtol=FLOAT32)
    # And with rays alone: rows that close are all a furnace asks for.
    assert np.allclose(solve(receivers, closed_forms=False).quantity("radiosity")[0::2], 2.0, rtol=FLOAT32)


@pytest.mark.parametrize("closed_forms", [True, False])
def test_two_power_balance(closed_forms):
    receivers = on_elements(scenes.room(0.5, 0.5, 0.5, (0.3, 0, 0, 0, 0, 1.0)), 0.8)
    s = solve(receivers, closed_forms=closed_forms)
    area = receivers.elements.area
    mean = (area * s.quantity("irradiance")[0::2, 0]).sum() / area.sum()
    flux = 16 * 1.0 + 12 * 0.3
    assert mean == pytest.approx(flux / (area.sum() * 0.5), rel=1e-6)
    assert s.balance.gap < 1e-12
    assert s.balance.emitted == pytest.approx(2 * 3 * flux, rel=1e-6)


def test_three_two_zone_sphere():
    """H = mean(E) / (1 - mean(rho)) everywhere, by the areas that the mesh gives its zones; factors are shares of rays."""
    worst = []
    for level in (1, 2, 3):
        receivers = on_elements(scenes.two_zone_sphere(level))
        s = solve(receivers, rays=1024, tolerance=1e-8, closed_forms=False)
        e = receivers.elements
        h = s.quantity("irradiance")[0::2, 0].astype(float)
        area = e.area
        # Exact on any mesh: what is absorbed is what is emitted.
        assert (area * (1 - e.albedo[:, 0]) * h).sum() == pytest.approx((area * e.emitted[:, 0]).sum(), rel=1e-6)
        want = (area * e.emitted[:, 0]).sum() / (area * (1 - e.albedo[:, 0])).sum()
        worst.append(np.sqrt((area * (h / want - 1) ** 2).sum() / area.sum()))
        for zone in (0, 1):
            which = e.centroid[:, 2] * (1 - 2 * zone) > 0
            assert (area * h)[which].sum() / area[which].sum() == pytest.approx(want, abs=0.1 / 4**level + 0.003)
    assert worst[2] < worst[1] < worst[0]
    assert worst[2] < 0.03


def test_six_snowman():
    c, rho, emission = 0.1, (0.5, 0.5), (1.0, 0.0)
    receivers = on_elements(scenes.snowman(2, c, rho, emission))
    s = solve(receivers, rays=512, tolerance=1e-8)
    e = receivers.elements
    b = s.quantity("radiosity")[0::2, 0]
    room = np.array([0, 1])[(e.emitted[:, 0] == 0).astype(int)]
    got = [np.average(b[room == k], weights=e.area[room == k]) for k in (0, 1)]
    want = scenes.snowman_answer(c, rho, emission)
    assert got[0] == pytest.approx(want[0], rel=0.01)
    assert got[1] == pytest.approx(want[1], rel=0.06)  # 1/6, through the door, on a polyhedron


def test_a_lamp_in_a_closed_box():
    """CIE 5.8: the mean indirect irradiance is rho flux / (S (1 - rho))."""
    _, direct, indirect = solving.lamp_in_a_closed_box(solve)
    assert np.allclose(indirect, direct, rtol=1e-5)


def test_the_world_lights_a_plane():
    b = SceneBuilder()
    b.background = (1.0, 2.0, 3.0)
    b.quad("Plane", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    s = solve(on_elements(b.build(), 0.5))
    assert np.allclose(s.direct, np.pi * np.array([1, 2, 3]), rtol=1e-5)
    assert not s.indirect.any()
    assert s.balance.gap < 1e-12


def test_an_obstacle_hides():
    """A black plate between two squares takes the closed form away and leaves the light that passes."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Light", (0, 0, 1), (0, 1, 0), (1, 0, 0), diffuse("Light", 0.0, 1 / np.pi))
    b.quad("Plate", (-9, -9, 0.5), (18, 0, 0), (0, 18, 0), diffuse("Black", 0.0))
    s = solve(on_elements(b.build(), 100.0), rays=4096)
    assert s.direct[0].max() == 0
    # The plate is far larger than the light: all its downward light lands there, but for what leaves past the rim.
    assert s.direct[4, 0] == pytest.approx(1 / 18**2, rel=0.02)


def test_reciprocity_and_closure_are_reported():
    s = solve(on_elements(scenes.cornell(), 0.25))
    assert s.extra["factors_exact"][0] > 0
    assert s.extra["factors_cast"][0] > 0
    assert s.extra["factors_reciprocity"][0] > 0
    assert 0 < s.extra["factors_closure"][0] < 0.3
    assert s.rays > 0 and s.seconds > 0
    assert s.history[-1][1] <= 1e-14
    assert s.balance.gap < 1e-12


def test_direct_light_at_receivers_and_on_elements_agree_in_the_mean():
    world = World(scenes.cornell(12, 12, boxes=False))
    receivers = CameraReceivers(world)
    # Finer than the ceiling's bright ring around the lamp, or smoothing lets it shine out behind the lamp: 3 % of the light here.
    at = solve(receivers, max_edge=0.05, tolerance=1e-4, closed_forms=False, light_samples=32)
    on = solve(receivers, max_edge=0.05, tolerance=1e-4, direct_light="elements", closed_forms=False)
    assert at.direct.mean() == pytest.approx(on.direct.mean(), rel=0.05)
    assert np.array_equal(at.emitted, on.emitted)
    assert at.extra["elements"].shape == (144, 3)
    assert at.extra["elements"].mean() > at.direct.mean()


def test_memory_is_said_before_and_refused_over_the_limit():
    world = World(scenes.cornell())
    solver = method("matrix_radiosity")
    receivers = CameraReceivers(world)
    settings = solver.Settings(max_edge=0.02, memory_limit=100)
    needed = solver.memory(world, receivers, settings)
    sides = 2 * Elements(world, 0.02).count
    assert needed >= 8 * sides**2
    with pytest.raises(MemoryRefused, match=rf"could need {needed / 2**20:,.0f} MB, over its limit of 100 MB"):
        next(solver.solve(world, receivers, settings, np.random.default_rng(0)))


def test_light_that_is_trapped_is_refused_by_name():
    with pytest.raises(SceneError, match="Material Snow: reflects all light"):
        solve(on_elements(scenes.cube(materials=diffuse("Snow", 1.0, 1.0))))
    # One wall that absorbs is enough.
    mats = [diffuse("Snow", 1.0)] * 5 + [diffuse("Lamp", 0.5, 1.0)]
    s = solve(on_elements(scenes.cube(materials=mats)))
    assert s.history[-1][1] <= 1e-14


def test_giving_up_is_said():
    s = solve(on_elements(scenes.lit_cube(0.8)), max_iterations=3, solver="jacobi")
    assert any("stopped after 3 iterations" in str(w) for w in s.warnings)
    assert s.balance.unshot > 0
    assert s.balance.gap < 1e-12


def test_a_dark_scene_is_black_and_says_so():
    s = solve(on_elements(scenes.cube()))
    assert not s.quantity("radiosity").any()
    assert any("nothing emits light" in str(w) for w in s.warnings)


def test_a_world_without_triangles():
    s = solve(on_elements(SceneBuilder().build()))
    assert s.direct.shape == (0, 3)


def test_other_lobes_are_named():
    glossy = Material("Chrome", (Lobe("metallic", Color.of(0.5)),))
    mats = [glossy] * 5 + [diffuse("Lamp", 0.5, 1.0)]
    s = solve(on_elements(scenes.cube(materials=mats)))
    assert any("Chrome" in str(w) for w in s.warnings)
    assert s.indirect.any()


def test_steps_lead_to_the_end_and_every_partial_result_is_sound():
    receivers = on_elements(scenes.cornell(), 0.3)
    steps = list(states(receivers))
    fractions = [s.fraction for s in steps]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    final = steps[-1].solution()
    assert not final.partial
    for step in steps[:-1]:
        s = step.solution()
        assert s.partial
        assert np.isfinite(s.quantity("irradiance")).all()
        assert (s.quantity("irradiance") <= final.quantity("irradiance") * (1 + 1e-5) + 1e-6).all()


def test_texels_of_a_furnace():
    world = World(scenes.cube(0.5, 1.0))
    texels = SurfaceReceivers("texels", [0, 1, 2], [0, 11], [0.2, 0.3], [0.1, 0.6])
    solver = method("matrix_radiosity")
    *_, last = solver.solve(world, texels, solver.Settings(max_edge=0.5, light_samples=64), np.random.default_rng(0))
    s = last.solution()
    assert np.allclose(s.indirect, 1.0, rtol=1e-5)
    assert np.allclose(s.direct, 1.0, rtol=0.2)
    assert np.allclose(s.albedo, 0.5)


def test_fields_reach_the_settings():
    solver = method("matrix_radiosity")
    settings = solver.Settings().replaced({"rays": "64", "solver": "jacobi", "max_edge": "0.5"})
    assert dataclasses.asdict(settings)["rays"] == 64
