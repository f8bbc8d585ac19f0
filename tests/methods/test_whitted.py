"""Recursive ray tracing against closed forms: furnaces, mirror corridor, images, slab, total reflection."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SceneError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import whitted as module
from adjgi.tests import scenes, solving

solve = partial(solving.solve, "whitted")
camera = partial(solving.view, grid=1)


def mirror(rho, emission=0.0, roughness=0.0, name="Mirror"):
    lobes = [Lobe("glossy", Color.of(rho), roughness)]
    if emission:
        lobes.append(Lobe("emission", Color.of(emission)))
    return Material(name, tuple(lobes))


def radiance(world, receivers, **options):
    """(n,) of the red channel."""
    return solve(world, receivers, **options).quantity("radiance")[:, 0]


def fresnel(degrees, n):
    """Unpolarised reflectance from outside, by Snell's law and the two amplitudes."""
    a = math.radians(degrees)
    b = math.asin(math.sin(a) / n)
    s = (math.cos(a) - n * math.cos(b)) / (math.cos(a) + n * math.cos(b))
    p = (n * math.cos(a) - math.cos(b)) / (n * math.cos(a) + math.cos(b))
    return (s * s + p * p) / 2


# ---- direct light


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_furnace_of_direct_light(rho):
    """T1 in a sphere, whose kernel is constant: own emission and one reflection, 1 + rho (1.5 and 1.8)."""
    world = World(scenes.two_zone_sphere(3, (1.0, 1.0), (rho, rho)))
    n = world.triangle_count
    middle = np.full(n, 1 / 3, np.float32)
    found = solve(world, SurfaceReceivers("texels", np.arange(n + 1), np.arange(n), middle, middle), light_points=256)
    b = found.quantity("radiosity")[:, 0]
    assert (b * world.area).sum() / world.area.sum() == pytest.approx(1 + rho, rel=0.005)
    assert (found.indirect == 0).all()


def test_diffuse_scenes_look_as_in_local_illumination():
    """Without mirrors Eq. 9 is Eq. 6."""
    from adjgi.solvers import local_illumination  # noqa: F401

    local = method("local_illumination")
    world = World(scenes.cornell(24, 24))
    for receivers in (CameraReceivers(world), SurfaceReceivers("texels", np.arange(11), np.arange(10), *np.full((2, 10), 0.3, np.float32))):
        *_, last = local.solve(world, receivers, local.Settings(ambient=0.3), np.random.default_rng(0))
        a, b = last.solution(), solve(world, receivers, ambient=0.3)
        for part in ("emitted", "direct", "indirect"):
            np.testing.assert_allclose(getattr(b, part), getattr(a, part), rtol=1e-5, atol=1e-6)


# ---- mirrors


def corridor(rho, slope):
    """Mirrors at z = 0 and z = 1, an emitter across the end at x = 20; a narrow view rising by `slope`."""
    b = SceneBuilder()
    b.quad("Low", (0, -50, 0), (20, 0, 0), (0, 100, 0), mirror(rho))
    b.quad("High", (0, -50, 1), (0, 100, 0), (20, 0, 0), mirror(rho))
    b.quad("End", (20, -50, -1), (0, 0, 3), (0, 100, 0), diffuse("Lamp", 0, 2.0))
    return camera(b, (0.1, 0, 0.5), (1, 0, slope), 1e-4, 2)


@pytest.mark.parametrize("slope", [0.0, 0.04, 0.12, 0.3, -0.37])
def test_mirror_corridor(slope):
    """A ray that meets the mirrors k times carries rho^k Le."""
    rho = 0.85
    k = abs(math.floor(0.5 + 19.9 * slope))
    world, receivers = corridor(rho, slope)
    found = radiance(world, receivers, depth=32, contribution=0)
    np.testing.assert_allclose(found, 2.0 * rho**k, rtol=1e-5)
    if k:
        assert (radiance(world, receivers, depth=k - 1, contribution=0) == 0).all()
        assert (radiance(world, receivers, depth=k, contribution=0) > 0).all()
        assert (radiance(world, receivers, depth=32, contribution=1.01 * rho**k if rho**k < 0.99 else 1.0) == 0).all()
        assert (radiance(world, receivers, depth=32, max_length=k) > 0).all()
        assert (radiance(world, receivers, depth=32, max_length=k - 1, contribution=0) == 0).all()
        assert (radiance(world, receivers, depth=32, min_length=k + 1, contribution=0) == 0).all()


@pytest.mark.parametrize("depth", [0, 1, 5, 12])
def test_mirror_furnace(depth):
    """T8 with mirrors: walls that reflect rho and emit 1 - rho; after d mirrors 1 - rho^(d+1)."""
    rho = 0.7
    b = SceneBuilder()
    b.box("Cube", (0, 0, 0), (1, 1, 1), mirror(rho, 1 - rho), inward=True)
    world, receivers = camera(b, (0.3, 0.4, 0.6), (1, 0.5, 0.2), 1.0, 8)
    np.testing.assert_allclose(radiance(world, receivers, depth=depth, contribution=0), 1 - rho ** (depth + 1), rtol=1e-5)


@pytest.mark.parametrize("lamp", ["point", "area"])
def test_image_in_a_mirror(lamp):
    """T11: what is seen in a mirror is the mirrored room seen directly, times the reflectance; lit by the lamp behind the mirror."""
    rho = 0.8

    def room(sign, b):
        values = {"point": {}, "area": {"size_x": 0.3, "size_y": 0.3, "axis_x": (0, 0, 1), "axis_y": (0, 1, 0), "axis_z": (-sign, 0, 0)}}
        b.quad("Wall", (sign, -3, 3 * sign), (0, 6, 0), (0, 0, -6 * sign), diffuse("Wall", 0.6))
        b.quad("Thing", (0.7 * sign, 0.1, 0.2 * sign), (0, 0.4, 0), (0, 0, -0.4 * sign), diffuse("Thing", 0.2))
        b.light(Light("Lamp", lamp, (3, 2, 1), (0.4 * sign, -0.5, 0), **values[lamp]))

    real, image = SceneBuilder(), SceneBuilder()
    room(1, real)
    real.quad("Mirror", (0, -3, -3), (0, 6, 0), (0, 0, 6), mirror(rho))
    room(-1, image)
    # The real room's wall stands behind the camera, so that its own lamp lights nothing that the camera sees.
    a = solve(*camera(real, (0.5, 0, 0), (-1, 0, 0), 0.7, 24)).quantity("radiance")
    b = solve(*camera(image, (0.5, 0, 0), (-1, 0, 0), 0.7, 24)).quantity("radiance")
    assert b.max() > 2 * np.median(b) > 0
    np.testing.assert_allclose(a, rho * b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["area", "sphere", "mesh"])
def test_lamps_are_seen_in_mirrors(kind):
    """Radiance of the lamp times the reflectance, for lamps with a size and for emissive meshes."""
    b = SceneBuilder()
    b.quad("Mirror", (-2, -2, 0), (4, 0, 0), (0, 4, 0), mirror(0.9))
    if kind == "area":
        b.light(Light("Lamp", "area", (5, 5, 5), (1, 0, 1), size_x=0.5, size_y=0.5))
    elif kind == "sphere":
        b.light(Light("Lamp", "point", (5 * math.pi * 0.04,) * 3, (1, 0, 1), radius=0.2))
    else:
        b.quad("Lamp", (0.75, -0.25, 1), (0.5, 0, 0), (0, 0.5, 0), diffuse("Lamp", 0, 5))
    found = radiance(*camera(b, (-1, 0, 1), (1, 0, -1), 0.02, 3))
    np.testing.assert_allclose(found, 5 * 0.9, rtol=1e-5)


def test_the_world_is_seen_in_mirrors():
    b = SceneBuilder()
    b.quad("Mirror", (-2, -2, 0), (4, 0, 0), (0, 4, 0), mirror(0.9))
    b.background = (0.3, 0.3, 0.3)
    np.testing.assert_allclose(radiance(*camera(b, (-1, 0, 1), (1, 0, -1), 0.02, 3)), 0.27, rtol=1e-6)


def test_ambient_light_is_seen_in_mirrors_and_mirrors_have_none():
    b = SceneBuilder()
    b.quad("Mirror", (-2, -2, 0), (4, 0, 0), (0, 4, 0), mirror(0.9))
    b.quad("Roof", (-9, -9, 2), (0, 18, 0), (18, 0, 0), diffuse("Roof", 0.5))
    world, receivers = camera(b, (-1, 0, 1), (1, 0, -1), 0.02, 3)
    np.testing.assert_allclose(radiance(world, receivers, ambient=0.2), 0.9 * 0.5 * 0.2, rtol=1e-5)


def test_sheets_on_the_way_of_mirrored_rays_cost_no_segment():
    """An emitter seen in a mirror through two clear sheets: by the shares of all three, at a path length of one."""
    b = SceneBuilder()
    b.quad("Mirror", (-2, -2, 0), (4, 0, 0), (0, 4, 0), mirror(0.9))
    for z in (1.2, 1.3):
        b.quad("Sheet", (-9, -9, z), (18, 0, 0), (0, 18, 0), Material("Sheet", (Lobe("transparent", Color.of(0.6)),)))
    b.quad("Roof", (-9, -9, 2), (0, 18, 0), (18, 0, 0), diffuse("Roof", 0.0, 5.0))
    world, receivers = camera(b, (-1, 0, 1), (1, 0, -1), 0.02, 3)
    for longest in (1, 64):
        found = solve(world, receivers, max_length=longest)
        assert found.direct[:, 0] == pytest.approx(np.full(9, 0.9 * 0.6**2 * 5), rel=1e-5) and not found.indirect.any()


def lit_by_ambience(material, degrees=75, **options):
    """Radiance of a plane, seen at an angle to its normal, in ambient light of 0.2 alone."""
    b, a = SceneBuilder(), math.radians(degrees)
    b.quad("Plane", (-9, -9, 0), (18, 0, 0), (0, 18, 0), material)
    way = np.array([math.sin(a), 0, -math.cos(a)])
    return radiance(*camera(b, -way, way, 0.001, 1), ambient=0.2, **options)[0]


def test_a_coat_takes_its_share_of_ambient_light():
    coated = Material("Coated", (Lobe("diffuse", Color.of(0.5)), Lobe("specular", Color.of(1), 0.0, 1.5)))
    assert lit_by_ambience(coated) == pytest.approx(0.2 * 0.5 * (1 - fresnel(75, 1.5)), rel=0.01)


def test_lobes_reflect_ambient_light_by_their_weight():
    whole, part = (lit_by_ambience(Material("Gloss", (Lobe("glossy", Color.of(0.8), 0.5, weight=w),))) for w in (1.0, 0.25))
    assert whole > 0.1 and part == pytest.approx(0.25 * whole, rel=1e-5)


def test_ambient_light_has_flown_two_segments_or_more():
    plane = diffuse("Plane", 0.5)
    assert lit_by_ambience(plane, max_length=1) == 0
    assert lit_by_ambience(plane, max_length=2) == pytest.approx(0.1, rel=1e-5)


def test_highlights_of_phong_have_the_cosine_of_incidence():
    """k (n + 2) / (2 pi) cos^n alpha cos theta E, in the middle of the highlight, 60 degrees from the normal."""
    b, a, roughness, distance = SceneBuilder(), math.radians(60), 0.5, 2.0
    b.quad("Plane", (-9, -9, 0), (18, 0, 0), (0, 18, 0), mirror(0.9, roughness=roughness))
    b.light(Light("Lamp", "point", (3, 3, 3), (distance * math.sin(a), 0, distance * math.cos(a))))
    way = np.array([math.sin(a), 0, -math.cos(a)])
    n = (2 / roughness**4 - 2) / 4
    expected = 0.9 * (n + 2) / (2 * math.pi) * math.cos(a) * 3 / distance**2
    assert radiance(*camera(b, -way, way, 0.001, 1), rough="phong")[0] == pytest.approx(expected, rel=1e-3)


# ---- glass


def slab(degrees, n, emitter, thickness=0.5, kind="glass"):
    """A slab z = 0..thickness over an emitter at z = -1, seen from above at an angle to its normal."""
    b = SceneBuilder()
    b.box("Slab", (-30, -30, 0), (30, 30, thickness), Material("Glass", (Lobe(kind, Color.of(1), 0.0, n),)), inward=False)
    b.quad("Emitter", (-40, -40, -1), (80, 0, 0), (0, 80, 0), emitter)
    a = math.radians(degrees)
    position = np.array((0, 0, thickness)) - 2 * np.array((math.sin(a), 0, -math.cos(a)))
    return camera(b, position, (math.sin(a), 0, -math.cos(a)), 1e-3, 2, "orthographic")


SLAB = {0: 0.9183, 30: 0.9160, 45: 0.9025, 60: 0.8435, 75: 0.6148}


@pytest.mark.parametrize("degrees", SLAB)
def test_slab_lets_through_what_fresnel_says(degrees):
    """All reflections inside together: (1 - R) / (1 + R), CIE 171 case 5.5 without absorption; the first ray alone (1 - R)^2."""
    world, receivers = slab(degrees, 1.52, diffuse("Lamp", 0, 1.0), 0.01)
    r = fresnel(degrees, 1.52)
    np.testing.assert_allclose(radiance(world, receivers, depth=2, contribution=0), (1 - r) ** 2, rtol=1e-5)
    found = radiance(world, receivers, depth=20, contribution=0)
    np.testing.assert_allclose(found, (1 - r) / (1 + r), rtol=1e-5)
    # With the two polarisations followed apart the slab lets through more: by up to 4 percent at 75 degrees.
    assert SLAB[degrees] * 0.96 < found.min()
    assert found.max() < SLAB[degrees] + 6e-5


@pytest.mark.parametrize("degrees", [20, 50, 70])
def test_slab_shifts_the_ray_by_snells_law(degrees):
    """An emitter whose radiance is its x tells where the ray comes out: d sin a (1 - cos a / sqrt(n^2 - sin^2 a)) to the side."""
    ramp = Texture("Ramp", np.repeat(np.linspace(0, 1, 1024, dtype=np.float32)[None, :, None], 4, axis=2), "EXTEND")
    source = Source("image", "UVMap", 0, ((1023 / 1024, 0, 0.5 / 1024), (0, 1, 0)))
    emitter = Material("Ramp", (Lobe("emission", Color((Term((80.0,) * 3, (source,)),))),))
    import dataclasses

    n, d = 1.5, 0.5
    world, receivers = slab(degrees, n, emitter, d)
    world = World(dataclasses.replace(world.scene, textures=(ramp,)))
    a = math.radians(degrees)
    inside = math.asin(math.sin(a) / n)
    x = d * math.tan(inside) + 1 * math.tan(a)
    side = d * math.sin(a) * (1 - math.cos(a) / math.sqrt(n * n - math.sin(a) ** 2))
    assert (1.5 * math.tan(a) - x) * math.cos(a) == pytest.approx(side, rel=1e-9)
    found = radiance(world, CameraReceivers(world, grid=1), depth=2, contribution=0)
    np.testing.assert_allclose(found / (1 - fresnel(degrees, n)) ** 2 - 40, x, atol=2e-3)


@pytest.mark.parametrize("kind", ["refraction", "transparent"])
def test_lobes_that_only_let_through(kind):
    """They lose nothing to reflection, and a transparent surface does not turn the ray."""
    world, receivers = slab(45, 1.5, diffuse("Lamp", 0, 1.0), 0.5, kind)
    np.testing.assert_allclose(radiance(world, receivers), 1.0, rtol=1e-6)


@pytest.mark.parametrize(("degrees", "total"), [(20, False), (40, False), (43, True), (60, True), (80, True)])
def test_total_reflection(degrees, total):
    """From inside glass: beyond 41.8 degrees everything is reflected, below Fresnel's share; the rest sees the sky."""
    b = SceneBuilder()
    b.box("Glass", (-30, -30, -30), (30, 30, 0), Material("Glass", (Lobe("glass", Color.of(1), 0.0, 1.5),)), inward=False)
    b.quad("Lamp", (-20, -20, -2), (40, 0, 0), (0, 40, 0), diffuse("Lamp", 0, 1.0))
    a = math.radians(degrees)
    found = radiance(*camera(b, (0, 0, -1), (math.sin(a), 0, math.cos(a)), 1e-3, 2), depth=1)
    expected = 1.0 if total else fresnel(math.degrees(math.asin(1.5 * math.sin(a))), 1.5)
    np.testing.assert_allclose(found, expected, rtol=2e-4 if total else 0.02)


def test_glass_in_a_uniform_world_is_invisible():
    """Every branch of the tree counted once: weights sum to 1 at every surface."""
    vertices, triangles = scenes.icosphere(3)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles, Material("Glass", (Lobe("glass", Color.of(1), 0.0, 1.5),)))
    b.background = (0.5, 0.5, 0.5)
    found = radiance(*camera(b, (0, -4, 0), (0, 1, 0), 0.3, 16), depth=100, contribution=1e-6)
    assert found.max() < 0.5001
    assert found.mean() > 0.499


# ---- rough lobes, batches, bits


def rough_scene(roughness):
    b = SceneBuilder()
    b.quad("Plate", (-2, -2, 0), (4, 0, 0), (0, 4, 0), Material("Brushed", (Lobe("metallic", Color.of(0.6), roughness),)))
    b.light(Light("Lamp", "area", (5, 5, 5), (1, 0, 1), size_x=0.5, size_y=0.5))
    return camera(b, (-1, 0, 1), (1, 0, -1), 0.5, 16)


def test_rough_lobes_are_refused_by_name():
    with pytest.raises(SceneError, match="Brushed.*metallic.*rough"):
        solve(*rough_scene(0.3), rough="refuse")
    solve(*rough_scene(0.0), rough="refuse")


def test_rough_lobes_as_mirrors_are_mirrors():
    found = solve(*rough_scene(0.3), rough="mirrors")
    np.testing.assert_array_equal(found.quantity("radiance"), solve(*rough_scene(0.0)).quantity("radiance"))
    assert found.quantity("radiance").max() > 2
    assert any("Brushed" in str(w) for w in found.warnings)


@pytest.mark.parametrize("rough", ["highlights", "phong"])
def test_rough_lobes_as_highlights(rough):
    """They reflect the lamp in a wider and weaker spot than a mirror, about as much light in all."""
    found = solve(*rough_scene(0.45), rough=rough, light_points=64)
    assert any("Brushed" in str(w) for w in found.warnings)
    spot, sharp = found.quantity("radiance")[:, 0], radiance(*rough_scene(0.0))
    assert 0.05 < spot.max() < 0.8 * sharp.max()
    assert (spot > 0.1 * spot.max()).sum() > 1.5 * (sharp > 0).sum()


def test_small_fronts_give_the_same(monkeypatch):
    """The tree may be worked off in pieces of any size."""
    vertices, triangles = scenes.icosphere(2)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles, Material("Glass", (Lobe("glass", Color.of(1), 0.0, 1.5),)), smooth_normals=vertices)
    b.quad("Floor", (-5, -5, -1), (10, 0, 0), (0, 10, 0), diffuse("Floor", 0.5))
    b.light(Light("Lamp", "point", (9, 9, 9), (2, -2, 4)))
    world, receivers = camera(b, (0, -4, 0), (0, 1, -0.1), 0.4, 32)
    whole = radiance(world, receivers)
    monkeypatch.setattr(module, "FRONT", 100)
    np.testing.assert_allclose(radiance(world, receivers), whole, rtol=1e-5, atol=1e-6)
    assert whole.mean() > 0.01


def test_same_bits_for_any_number_of_threads(monkeypatch):
    b = SceneBuilder()
    b.box("Room", (-2, -2, -1), (2, 2, 2), diffuse("Wall", 0.5), inward=True)
    vertices, triangles = scenes.icosphere(3)
    b.mesh("Ball", vertices, triangles, Material("Glass", (Lobe("glass", Color.of(1), 0.0, 1.5),)), smooth_normals=vertices)
    b.light(Light("Lamp", "point", (9, 9, 9), (1.5, -1.5, 1.5)))
    world, receivers = camera(b, (0, -1.9, 0), (0, 1, 0), 0.8, 200)
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        found.append(radiance(world, receivers, contribution=0.02))
    np.testing.assert_array_equal(*found)
    assert found[0].mean() > 0.05


def test_many_glass_surfaces_without_a_limit_are_named_and_keep_steps_short():
    b = SceneBuilder()
    glass = Material("Glass", (Lobe("glass", Color.of(1), 0.0, 1.5),))
    for i in range(3):
        b.box(f"Block{i}", (0, 0, i), (1, 1, i + 0.8), glass, inward=False)
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), position=(0.5, 0.5, 5.0)))
    b.camera = Camera("perspective", (0.4, 0.3, -3), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-0.2, 0.2, -0.2, 0.2), 4, 4)
    world = World(b.build())
    solver = method("whitted")
    for contribution, depth, named in ((0.0, 12, True), (0.001, 12, False), (0.0, 4, False)):
        settings = solver.Settings(contribution=contribution, depth=depth)
        found = list(solver.solve(world, CameraReceivers(world), settings, np.random.default_rng(0)))
        assert any("doubles the rays" in str(w) for w in found[-1].solution().warnings) == named
