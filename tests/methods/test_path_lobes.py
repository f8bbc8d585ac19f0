"""Path tracing via mirrors, glass and rough lobes, and with each variance reduction switched off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi import solvers
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.background import Background
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes
from adjgi.tests.methods.test_path_tracing import PI, Z, check, solve
from adjgi.tests.solving import look, scattered

solvers.load()


def lossless(lobes, albedo=0.5):
    """A furnace of radiance 1 with a ball of `lobes` inside, which is invisible if it loses and makes nothing."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (3, 3, 3), diffuse("Wall", albedo, 1 - albedo), inward=True)
    vertices, triangles = scenes.icosphere(3)
    b.mesh("Ball", 0.9 * vertices + 1.5, triangles, Material("Ball", tuple(lobes)), smooth_normals=vertices)
    return World(b.build())


@pytest.mark.parametrize(
    "lobe",
    [
        Lobe("glossy", Color.of(1), 0.0),
        Lobe("glass", Color.of(1), 0.0, 1.5),
        Lobe("transparent", Color.of(1)),
        Lobe("refraction", Color.of(1), 0.0, 1.0),
    ],
    ids=["mirror", "glass", "transparent", "refraction"],
)
def test_lossless_ball_in_a_furnace_is_invisible(lobe):
    world = lossless([lobe])
    walls = np.arange(world.triangle_count) < 12
    s = solve(world, scattered(world, 1500, triangles=walls), samples=64, max_length=400)
    # The ball is faceted and shaded smooth, which loses the few rays whose reflection points into the facets.
    check(s.quantity("irradiance"), [PI] * 3, bias=0.002)
    assert not s.warnings


def test_mirror_cavity():
    # T8: mirrors that reflect 0.9 and emit 0.1 everywhere.
    b = SceneBuilder()
    b.box(
        "Box", (0, 0, 0), (1, 1, 1), Material("Mirror", (Lobe("glossy", Color.of(0.9), 0.0), Lobe("emission", Color.of(0.1)))), inward=True
    )
    world = World(b.build())
    s = solve(world, scattered(world, 1000), samples=4, max_length=150, roulette=False)
    check(s.quantity("irradiance"), [PI] * 3, bias=1e-4)


@pytest.mark.parametrize(
    "lobes", [[Lobe("glossy", Color.of(0.9), 0.4)], [Lobe("diffuse", Color.of(0.6)), Lobe("specular", Color.of(1), 0.3, 1.5)]]
)
@pytest.mark.parametrize("options", [{}, {"joined": False}, {"light_importance": False}], ids=["joined", "alone", "rays"])
@pytest.mark.parametrize("drawn", [False, True], ids=["met", "drawn"])
def test_rough_plane_under_a_white_sky_sends_its_directional_albedo(lobes, drawn, options, monkeypatch):
    """The same whether rays alone find the sky or light points do as well."""
    if drawn:
        monkeypatch.setattr(Background, "importance", np.ones(1))
    b = SceneBuilder()
    b.quad("Plane", (-1, -1, 0), (2, 0, 0), (0, 2, 0), Material("Plane", tuple(lobes)))
    b.background = (1.0, 1.0, 1.0)
    slant = 0.6
    forward = (0, np.sqrt(1 - slant**2), -slant)
    b.camera = Camera(
        "orthographic", (0, -2 * forward[1], 2 * slant), (1, 0, 0), (0, slant, forward[1]), forward, (-0.3, 0.3, -0.2, 0.2), 32, 32
    )
    world = World(b.build())
    s = solve(world, CameraReceivers(world), samples=64 if not options else 256, **options)
    # By quadrature over the upper hemisphere, independent of sampling.
    z = (np.arange(400) + 0.5) / 400
    phi = 2 * PI * (np.arange(400) + 0.5) / 400
    zz, pp = (a.ravel() for a in np.meshgrid(z, phi))
    r = np.sqrt(1 - zz**2)
    wi = np.stack([r * np.cos(pp), r * np.sin(pp), zz], 1).astype(np.float32)
    n = len(wi)
    wo = np.tile(-np.float32(forward), (n, 1))
    up = np.tile(np.float32([0, 0, 1]), (n, 1))
    at = bsdf.BsdfTable(world.scene).at(np.zeros(n, np.int32), zz * 0, zz * 0, up, np.ones(n, np.float32), wo)
    albedo = bsdf.evaluate(at, wi)[0].astype(float).mean(axis=0) * 2 * PI
    check(s.quantity("radiance"), albedo, bias=0.003, resolution=0.01 if options else 0.003)


SWITCHES = ("light_importance", "lobe_importance", "joined", "stratified")


@pytest.mark.parametrize("off", [(x,) for x in SWITCHES] + [("light_importance", "lobe_importance")], ids="-".join)
def test_without_a_variance_reduction_the_mean_is_the_same_and_the_noise_higher(off):
    world = World(scenes.cornell(boxes=False))
    floor = np.arange(world.triangle_count) < 2
    receivers = scattered(world, 300, triangles=floor)
    options = {"samples": 64, "max_length": 3}
    full = runs(world, receivers, **options)
    less = runs(world, receivers, **options, **dict.fromkeys(off, False))
    error = np.hypot(*(x.mean(axis=1).std(ddof=1) for x in (full, less))) / math.sqrt(len(full))
    assert abs(full.mean() - less.mean()) < Z * error
    # Joining helps where a light is near; on the floor, far from a small lamp, light points alone are as good.
    if "joined" not in off:
        assert noise(less) > 1.1 * noise(full)


@pytest.mark.parametrize("off", SWITCHES)
def test_furnace_is_closed_without_any_one_variance_reduction(off):
    """Light points and rays find the same emission here: their weights must sum to 1, whatever density the rays have."""
    world = World(scenes.cube(0.5, 0.5))
    s = solve(world, scattered(world, 1500), samples=64, max_length=60, **{off: False})
    check(s.quantity("irradiance"), [1.0] * 3, bias=0.002, resolution=0.02)


def runs(world, receivers, count=12, **options):
    """(count, n) irradiance by independent seeds."""
    return np.array([solve(world, receivers, seed=seed, **options).quantity("irradiance")[:, 0] for seed in range(count)], float)


def noise(values):
    """Root mean square standard deviation of the receivers."""
    return float(np.sqrt(values.var(axis=0, ddof=1).mean()))


def test_lamps_without_size_need_light_points():
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0, 0, 1)))
    world = World(b.build())
    s = solve(world, scattered(world, 10), samples=4, light_importance=False)
    assert not s.direct.any() and any("Lamp" in str(w) for w in s.warnings)


def behind_frosted(emitter, kind, roughness, distance):
    """A camera before a rough pane, and a square of 1 m and radiance 2 some way behind it: a lamp or a panel."""
    b = SceneBuilder()
    b.quad("Pane", (-3, 1, -3), (6, 0, 0), (0, 0, 6), Material("Frosted", (Lobe(kind, Color.of(1), roughness, 1.3),)))
    y = 1 + distance
    if emitter == "lamp":
        axes = {"axis_x": (1.0, 0.0, 0.0), "axis_y": (0.0, 0.0, -1.0), "axis_z": (0.0, 1.0, 0.0)}
        b.light(Light("Area", "area", (2.0, 2.0, 2.0), position=(0, y, 0), size_x=1.0, size_y=1.0, **axes))
    else:
        b.quad("Panel", (-0.5, y, -0.5), (1, 0, 0), (0, 0, 1), diffuse("Panel", 0.0, 2.0))
    b.camera = look((0, 0, 0), (0, 1, 0), half=0.3, size=4)
    return World(b.build())


@pytest.mark.parametrize("emitter", ["lamp", "panel"])
@pytest.mark.parametrize(("kind", "roughness", "distance"), [("glass", 0.5, 0.6), ("refraction", 0.7, 0.6)])
def test_light_points_and_rays_share_what_comes_through_rough_glass(emitter, kind, roughness, distance):
    """Light points look on either side of rough glass with probability one half, which the weights of both techniques must know."""
    world = behind_frosted(emitter, kind, roughness, distance)
    receivers = CameraReceivers(world)

    def mean(**options):
        found = [solve(world, receivers, seed=s, samples=384, **options).direct.mean() for s in range(6)]
        return np.mean(found), np.std(found, ddof=1) / np.sqrt(len(found))

    (joined, a), (rays, b) = mean(), mean(light_importance=False)
    error = np.hypot(a, b)
    assert error < 0.004 * rays
    assert abs(joined - rays) < 4 * error


def test_texels_have_even_numbers_in_every_scene():
    """Direct light on a floor has as little noise beside a polished ball as without, because the receivers are the same."""

    def lit(material: Material) -> np.ndarray:
        b = SceneBuilder()
        b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
        b.quad("Far", (50, 50, 0), (0.1, 0, 0), (0, 0.1, 0), material)
        b.quad("Panel", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0.0, 1.0))
        world = World(b.build())
        return solve(world, scattered(world, 500, triangles=np.arange(world.triangle_count) < 2), samples=16).direct

    plain, beside = lit(diffuse("Matt", 0.5)), lit(Material("Polished", (Lobe("glossy", Color.of(0.9), 0.1),)))
    np.testing.assert_allclose(beside, plain, rtol=1e-4, atol=1e-6)
