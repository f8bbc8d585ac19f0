"""Progressive radiosity against exact solutions and against the full matrix, and its promises at every step."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SceneError
from adjgi.adjoint_gi.core.bsdf.lobes import LOBES
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.elements.mesh import element_mesh
from adjgi.adjoint_gi.core.elements.refinement import RefinedElements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity import importance as adaptive
from adjgi.adjoint_gi.core.radiosity.southwell import MOST_RAYS_PER_GROUP
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes, solving
from adjgi.tests.solving import grid, on_elements, quad_points

solve = partial(solving.solve, "progressive_radiosity")
states = partial(solving.steps, "progressive_radiosity")


def sphere_irradiance(receivers, solution):
    """Irradiance of the fronts relative to the exact one, which takes the areas that the mesh gives the zones."""
    e = receivers.elements
    want = (e.area * e.emitted[:, 0]).sum() / (e.area * (1 - e.albedo[:, 0])).sum()
    return solution.quantity("irradiance")[0::2, 0] / want


def sphere_error(receivers, solution):
    area = receivers.elements.area
    return np.sqrt((area * (sphere_irradiance(receivers, solution) - 1) ** 2).sum() / area.sum())


def test_one_furnace():
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    s = solve(receivers, rays=400_000, tolerance=1e-7)
    b = s.quantity("radiosity")[0::2]
    area = receivers.elements.area[:, None]
    assert np.allclose((area * b).sum(axis=0) / 6, 2.0, rtol=1e-6)
    assert np.allclose(b, 2.0, rtol=0.01)


@pytest.mark.parametrize("kind", LOBES, ids=lambda kind: kind.name)
def test_every_kind_of_lobe_reflects_here_as_a_diffuse_surface_or_is_a_clear_surface_that_is_left_out(kind):
    """A furnace of emitting walls with the lobe over a diffuse one: B = 1 / (1 - rho), and a notice of what was done to the lobe."""
    lobes = (Lobe("diffuse", Color.of(0.3)), Lobe(kind.name, Color.of(0.5), 0.5, 1.5), Lobe("emission", Color.of(1 / np.pi)))
    s = solve(on_elements(scenes.cube(materials=Material("Wall", lobes)), 0.5), rays=100_000, tolerance=1e-7)
    albedo = 1 - 1 / s.quantity("radiosity")[0::2].mean() - 0.3
    if kind.name in ("specular", "dielectric", "transparent"):
        assert albedo == pytest.approx(0.0, abs=1e-3)
    elif kind.name in ("metallic", "tinted metallic"):
        assert albedo == pytest.approx(0.5 + 0.5 / 21, abs=1e-3)  # the mean of Schlick's reflectance
    else:
        assert 0.9 * 0.5 < albedo < 0.5 + 1e-3
    said = [n.reason for n in s.warnings if n.object == "Material Wall"]
    assert said == ([] if kind.name in ("diffuse", "transparent") else [f"{kind.name} taken as diffuse by this method"])


def test_one_every_bounce():
    receivers = on_elements(scenes.cube(0.5, 1.0), 0.5)
    area = receivers.elements.area[:, None]
    for longest, want in enumerate((1, 1.5, 1.75, 1.875, 1.9375, 1.96875)):
        s = solve(receivers, rays=100_000, tolerance=0.0, max_length=longest)
        assert np.allclose((area * s.quantity("radiosity")[0::2]).sum(axis=0) / 6, want, rtol=1e-6)
        assert s.balance.gap < 1e-9
        # What the length cuts off is reported as unshot.
        assert s.balance.unshot > 0
    s = solve(receivers, rays=100_000, tolerance=1e-7, min_length=2)
    assert not s.emitted.any() and not s.direct.any()
    assert np.allclose((area * s.indirect[0::2]).sum(axis=0) / 6, 1.0, rtol=1e-6)
    # Of four segments and more: 1 / 8 + 1 / 16 + ...
    s = solve(receivers, rays=100_000, tolerance=1e-7, min_length=4)
    assert np.allclose((area * s.indirect[0::2]).sum(axis=0) / 6, 0.25, rtol=1e-5)


def test_two_power_balance():
    receivers = on_elements(scenes.room(0.5, 0.5, 0.5, (0.3, 0, 0, 0, 0, 1.0)), 0.8)
    s = solve(receivers, rays=300_000, tolerance=1e-7)
    area = receivers.elements.area
    flux = 16 * 1.0 + 12 * 0.3
    mean = (area * s.quantity("irradiance")[0::2, 0]).sum() / area.sum()
    assert mean == pytest.approx(flux / (area.sum() * 0.5), rel=1e-6)
    # The backs emit into empty space.
    assert s.balance.escaped == pytest.approx(3 * flux, rel=1e-6)
    assert s.balance.gap < 1e-9


def test_three_two_zone_sphere():
    receivers = on_elements(scenes.two_zone_sphere(3))
    few = solve(receivers, rays=100_000, tolerance=1e-4)
    many = solve(receivers, rays=1_600_000, tolerance=1e-4)
    assert sphere_error(receivers, many) < 0.5 * sphere_error(receivers, few)
    assert sphere_error(receivers, many) < 0.03
    e = receivers.elements
    h = sphere_irradiance(receivers, many)
    for zone in (0, 1):
        which = e.centroid[:, 2] * (1 - 2 * zone) > 0
        assert np.average(h[which], weights=e.area[which]) == pytest.approx(1.0, abs=0.004)


def test_six_snowman():
    c, rho, emission = 0.1, (0.5, 0.5), (1.0, 0.0)
    receivers = on_elements(scenes.snowman(2, c, rho, emission))
    e = receivers.elements
    s = solve(receivers, rays=500_000, tolerance=1e-4)
    b = s.quantity("radiosity")[0::2, 0]
    bright = e.emitted[:, 0] > 0
    got = np.average(b[bright], weights=e.area[bright]), np.average(b[~bright], weights=e.area[~bright])
    want = scenes.snowman_answer(c, rho, emission)
    assert got[0] == pytest.approx(want[0], rel=0.005)
    assert got[1] == pytest.approx(want[1], rel=0.02)


def test_ten_face_means():
    receivers = on_elements(scenes.lit_cube(0.5), 1 / 8)
    s = solve(receivers, rays=1_000_000, tolerance=1e-6)
    e = receivers.elements
    got = np.bincount(e.patch, e.area * s.quantity("radiosity")[0::2, 0], 6)
    assert got[5] == pytest.approx(1.10384468, rel=1e-3)
    assert got[4] == pytest.approx(0.17137322, rel=3e-3)
    assert np.allclose(got[:4], 0.18119552, rtol=3e-3)


@pytest.mark.parametrize("overshoot", [False, True])
def test_it_comes_to_the_full_matrix(overshoot):
    receivers = on_elements(scenes.cornell(), 0.15)
    a = solve(receivers, rays=2_000_000, tolerance=1e-5, overshoot=overshoot)
    b = solving.solve("matrix_radiosity", receivers, rays=4096)
    area = np.repeat(receivers.elements.area, 2)[:, None]
    for part in ("direct", "indirect"):
        x, y = (area * getattr(s, part).astype(float) for s in (a, b))
        assert np.allclose(x.sum(axis=0), y.sum(axis=0), rtol=0.02)
        # Both have errors of their own: element by element they differ by a few percent of the mean.
        assert np.sqrt(((x - y) ** 2 / area).sum(axis=0) / area.sum()).max() < 0.1 * y.sum(axis=0).max() / area.sum()


def test_light_of_lamps_is_direct_and_shot_first():
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (4, 4, 4), diffuse("Wall", 0.5), inward=True)
    b.light(Light("Lamp", "point", (10.0, 20.0, 30.0), position=(2, 2, 2)))
    receivers = on_elements(b.build(), 1.0)
    s = solve(receivers, rays=200_000, tolerance=1e-7)
    area = receivers.elements.area[:, None]
    direct = (area * s.direct[0::2]).sum(axis=0)
    assert np.allclose(direct, 4 * np.pi * np.array([10, 20, 30]), rtol=0.01)
    assert np.allclose((area * s.indirect[0::2]).sum(axis=0), direct, rtol=1e-5)
    assert s.balance.emitted == pytest.approx(direct.sum(), rel=1e-6)


def test_promises_of_every_step():
    """Flux is conserved, unshot falls, nothing exceeds the end, fractions rise, and no step is long."""
    receivers = on_elements(scenes.cornell(), 0.2)
    final = solve(receivers, ambient=False, tolerance=1e-4, rays=500_000)
    before, fraction, rays, unshot = None, 0.0, 0, np.inf
    for step in states(receivers, ambient=False, tolerance=1e-4, rays=500_000):
        s = step.solution()
        assert s.rays - rays <= MOST_RAYS_PER_GROUP  # a quarter of a second on a machine that is not busy
        assert s.balance.gap <= 1e-9
        assert s.balance.unshot <= unshot * (1 + 1e-12)
        assert fraction <= step.fraction <= 1.0
        now = s.quantity("irradiance")
        assert before is None or (now >= before * (1 - 1e-6)).all()
        assert (now <= final.quantity("irradiance") * (1 + 1e-5) + 1e-7).all()
        before, fraction, unshot, rays = now, step.fraction, s.balance.unshot, s.rays
    assert fraction == 1.0
    assert not s.partial
    residuals = [r for _, r in s.history]
    assert residuals == sorted(residuals, reverse=True)
    assert residuals[-1] <= 1e-4


def test_the_ambient_estimate_brings_partial_results_nearer_and_is_gone_at_the_end():
    receivers = on_elements(scenes.cornell(), 0.2)
    final = solve(receivers, rays=200_000)
    assert np.array_equal(final.indirect, solve(receivers, rays=200_000, ambient=False).indirect)
    truth = final.indirect.mean()
    # The truth lies nearer to the partial result with the estimate; a step's solution is of the moment it is asked for.
    nearer = []
    both = zip(states(receivers, rays=200_000), states(receivers, rays=200_000, ambient=False), strict=True)
    for with_, without in both:
        if with_.fraction < 1:
            middle = with_.solution().indirect
            nearer.append(abs(middle.mean() - truth) < abs(without.solution().indirect.mean() - truth))
    assert len(nearer) > 5
    assert np.mean(nearer[: len(nearer) // 2]) > 0.9  # later the noise of the rays decides
    # The backs of closed boxes are never reached, so the estimate does not light them.
    dark = np.flatnonzero(final.direct.sum(axis=1) + final.indirect.sum(axis=1) == 0)
    assert len(dark) and not middle[dark].any()


def test_the_ambient_estimate_knows_that_light_escapes_from_open_scenes():
    # A trough open to a bright sky, of albedo 0.8: taken for closed, it would be several times too bright.
    b = SceneBuilder()
    wall = diffuse("Wall", 0.8)
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), wall)
    b.quad("Left", (-1, -1, 0), (0, 2, 0), (0, 0, 0.5), wall)
    b.quad("Right", (1, -1, 0), (0, 0, 0.5), (0, 2, 0), wall)
    b.background = (1.0, 1.0, 1.0)
    receivers = on_elements(b.build(), 0.1)
    final = solve(receivers, rays=200_000).indirect.mean()
    partial = [s.solution().indirect.mean() for s in states(receivers, rays=200_000) if s.fraction < 1]
    assert len(partial) > 3 and max(partial) < 1.25 * final


def test_a_stop_keeps_the_partial_result_and_the_generator_goes_on():
    receivers = on_elements(scenes.cornell(), 0.2)
    run = states(receivers, rays=200_000)
    early = [next(run) for _ in range(3)][-1].solution()
    assert early.partial
    *_, last = run
    assert np.array_equal(last.solution().indirect, solve(receivers, rays=200_000).indirect)


def test_albedo_one_ends_by_the_number_of_shots_and_says_so():
    s = solve(on_elements(scenes.cube(1.0, 1.0), 0.5), rays=10_000, max_shots=50)
    assert any("stopped after 50 shots" in str(w) for w in s.warnings)
    assert np.isfinite(s.quantity("irradiance")).all()
    assert s.balance.gap < 1e-9


def test_overshooting_with_bounded_lengths_is_off_and_says_so():
    s = solve(on_elements(scenes.lit_cube(0.5)), rays=10_000, overshoot=True, max_length=3)
    assert any("overshooting is off" in str(w) for w in s.warnings)


def test_a_dark_scene_and_an_empty_one():
    s = solve(on_elements(scenes.cube()))
    assert not s.quantity("radiosity").any()
    assert any("nothing emits light" in str(w) for w in s.warnings)
    assert solve(on_elements(SceneBuilder().build())).direct.shape == (0, 3)


def test_memory_grows_linearly():
    solver = method("progressive_radiosity")
    needed = []
    for edge in (0.02, 0.01):
        world = World(scenes.cube())
        receivers = CameraReceivers(World(scenes.cornell(1, 1)))
        needed.append(solver.memory(world, receivers, solver.Settings(max_edge=edge)) - 600 * MOST_RAYS_PER_GROUP)
    assert needed[1] == pytest.approx(4 * needed[0], rel=0.01)


def half_shadow(width=64):
    """A floor lit by a small lamp over a screen, which throws a shadow with soft edges; a camera looks straight down past the screen."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
    b.quad("Screen", (0.3, 0.35, 0.3), (0, 0.3, 0), (0.4, 0, 0), diffuse("Screen", 0.1))
    b.quad("Lamp", (0.45, 0.45, 1.0), (0, 0.1, 0), (0.1, 0, 0), diffuse("Lamp", 0.0, 50.0))
    return b.build()


def adaptive_errors():
    """(faces of the mesh, root mean square error of direct light on the floor) for a uniform and an adaptive mesh; the last solution."""
    world = World(half_shadow())
    receivers = quad_points(*grid(48))
    surface = world.surface(receivers.triangle, receivers.u, receivers.v)
    truth = direct_irradiance(world, Emitters(world), surface, 512, np.random.default_rng(0))[0]
    solver = method("progressive_radiosity")
    out = []
    for options in ({"max_edge": 0.03}, {"max_edge": 0.1, "adaptive": True, "min_edge": 0.0125, "contrast": 0.2}):
        settings = solver.Settings(direct_light="elements", rays=4_000_000, light_samples=32, **options)
        *_, last = solver.solve(world, receivers, settings, np.random.default_rng(0))
        s = last.solution()
        count = len(s.extra["mesh_start"]) - 1 if options.get("adaptive") else Elements(world, 0.03).count
        out.append((count, float(np.sqrt(((s.direct - truth) ** 2).mean()) / truth.mean())))
    return out, s, world


def test_subdivision_finds_shadow_boundaries_with_fewer_elements():
    (uniform, cut), s, world = adaptive_errors()
    assert cut[0] < uniform[0]
    assert cut[1] < 0.8 * uniform[1]
    assert s.balance.gap < 1e-9
    # Elements at the corners of the floor, where the light changes little, are as coarse as they began; some at the shadow are not.
    start, corners = s.extra["mesh_start"], s.extra["mesh_corners"]
    first = s.extra["mesh_vertices"][corners[start[:-1]]]
    size = np.linalg.norm(s.extra["mesh_vertices"][corners[start[:-1] + 1]] - first, axis=1)
    on_floor = world.scene.object[s.extra["mesh_triangle"]] == 0
    far = on_floor & (np.abs(first[:, :2] - 0.5).max(axis=1) > 0.42)
    assert np.median(size[far]) == pytest.approx(0.1, rel=0.01)
    assert size[on_floor].min() == pytest.approx(0.0125, rel=0.01)


def test_subdivision_keeps_flux_at_every_step_and_its_receivers():
    receivers = on_elements(scenes.cornell(), 0.2)
    coarse = solve(receivers, rays=500_000, tolerance=1e-4)
    texts = set()
    for step in states(receivers, rays=500_000, tolerance=1e-4, adaptive=True, ambient=False):
        s = step.solution()
        assert s.balance.gap < 1e-9
        assert s.direct.shape == coarse.direct.shape
        texts.add(step.text.split(",")[0])
    assert "Shadow boundaries" in texts
    # Direct light of an element is the same flux, however it lies on its pieces.
    area = np.repeat(receivers.elements.area, 2)[:, None]
    x, y = ((area * a.direct.astype(float)).sum(axis=0) for a in (s, coarse))
    assert np.allclose(x, y, rtol=0.01)
    assert (area * s.indirect).sum() == pytest.approx((area * coarse.indirect).sum(), rel=0.15)


def test_subdivision_leaves_even_light_alone():
    s = solve(on_elements(scenes.cube(0.5, 1.0), 0.5), rays=2_000_000, adaptive=True)
    assert "mesh_start" not in s.extra


def test_subdivision_with_bounded_lengths():
    world = World(half_shadow())
    # Light comes back to the floor by way of the screen: no shorter than three segments.
    for longest in (0, 1, 3):
        solver = method("progressive_radiosity")
        settings = solver.Settings(direct_light="elements", rays=100_000, adaptive=True, max_edge=0.2, max_length=longest, tolerance=0.0)
        *_, last = solver.solve(world, quad_points(*grid(8)), settings, np.random.default_rng(0))
        s = last.solution()
        assert s.balance.gap < 1e-9
        assert s.direct.any() == (longest >= 1)
        assert s.indirect.any() == (longest >= 3)


def test_subdivision_that_meets_its_limit_says_so(monkeypatch):
    monkeypatch.setattr(adaptive, "GROWTH", 2)
    world = World(half_shadow())
    solver = method("progressive_radiosity")
    settings = solver.Settings(direct_light="elements", rays=100_000, adaptive=True, max_edge=0.1, contrast=0.05)
    *_, last = solver.solve(world, quad_points(*grid(8)), settings, np.random.default_rng(0))
    s = last.solution()
    assert any("subdivision stopped" in str(w) for w in s.warnings)
    assert len(s.extra["mesh_start"]) - 1 <= 2 * Elements(world, 0.1).count


def test_the_mesh_of_the_elements():
    world = World(half_shadow())
    base = Elements(world, 0.25)
    fine = RefinedElements(base, np.arange(base.count) % 3 == 0)
    mesh = element_mesh(fine, np.repeat(fine.centroid + world.center, 2, axis=0))
    corners = mesh.vertices[mesh.corners].reshape(-1, 4, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cross += np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 0])
    assert np.allclose(np.linalg.norm(cross, axis=1) / 2, fine.area)
    assert (np.einsum("ij,ij->i", cross, fine.normal) > 0).all()
    assert np.array_equal(mesh.start, 4 * np.arange(fine.count + 1))
    # The values are smooth versions of the centroids: near the corners, by less than an element.
    assert np.abs(mesh.values - mesh.vertices[mesh.corners]).max() < 0.25


def test_light_that_is_caught_is_refused_by_name():
    mats = [diffuse("Snow", 1.0)] * 5 + [diffuse("Lamp", 1.0, 1.0)]
    with pytest.raises(SceneError, match="(Snow|Lamp): reflects all light"):
        solve(on_elements(scenes.cube(materials=mats), 0.5), rays=20_000)
    # What loses little goes on to its end.
    s = solve(on_elements(scenes.cube(0.98, 1.0), 0.5), rays=20_000)
    assert s.quantity("radiosity")[0::2].mean() == pytest.approx(50, rel=0.02)
