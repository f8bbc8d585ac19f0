"""Particle tracing with all lobes of the BSDF, and counted at receivers: caustics, agreement with paths, densities."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.bsdf.table import BsdfTable
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import radiance
from adjgi.tests import scenes
from adjgi.tests.particles import agrees, on_elements, replicates, solve

# ---- all lobes


def shiny(kind, color=1.0, roughness=0.0, ior=1.5):
    """A material of one lobe."""
    return Material(kind, (Lobe(kind, Color.of(color), roughness, ior),))


def by_walks(scene, samples=64, target=100, **options):
    """Mean irradiance (objects, 3) of the fronts by paths from the receivers, and its standard error, over runs."""
    world, receivers = on_elements(scene, target)
    walks = radiance.Walk(world, Emitters(world), BsdfTable(scene), **options)
    sides = np.repeat(np.arange(0, receivers.count, 2), samples)
    owner = scene.object[receivers.elements.patch_triangle[receivers.elements.patch]]
    values = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points = receivers.sample(sides, rng)
        surface = world.surface(points.triangle, points.u, points.v, points.towards)
        found = radiance.gather(walks, surface, radiance.white(walks, surface), rng)
        light = np.pi * (found.direct + found.indirect).astype(float).reshape(-1, samples, 3).mean(axis=1)
        area = receivers.elements.area
        values.append([[np.bincount(owner, area * light[:, c])[o] / area[owner == o].sum() for c in range(3)] for o in np.unique(owner)])
    return np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / math.sqrt(len(values))


def test_a_mirror_makes_a_caustic_of_its_image_lamp():
    """A black floor beside a mirror wall: irradiance of the lamp and of its image behind the mirror; the mirror's light is indirect."""
    b = SceneBuilder()
    b.quad("Floor", (0, -0.5, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))
    b.quad("Mirror", (1, -50, 0), (0, 0, 50), (0, 100, 0), shiny("glossy", 0.9))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.5, 0.0, 1.0)))
    floor = lambda e: np.where(np.arange(2 * e.count) % 2 == 0, by_object(e), -1)  # noqa: E731
    x = (np.arange(200) + 0.5) / 200
    px, py = np.meshgrid(x, x - 0.5)

    def mean(at, strength):
        return (strength / ((px - at) ** 2 + py**2 + 1) ** 1.5).mean()

    for part, expected in (("direct", mean(0.5, 1.0)), ("indirect", mean(1.5, 0.9))):
        found, error = replicates(b.build(), floor, particles=40_000, part=part)
        agrees(found[0], error[0], np.full(3, expected), resolution=0.01)


def by_object(elements):
    """Object of each side, 0 for the first; others are -1."""
    owner = np.repeat(elements.world.scene.object[elements.patch_triangle[elements.patch]], 2)
    return np.where(owner == 0, 0, -1)


@pytest.mark.parametrize("pane,share", [(shiny("transparent", 0.5), 0.5), (shiny("refraction", 0.8), 0.8), (shiny("glass", 1.0), 1 - 0.04)])
def test_a_pane_under_the_sun_lets_its_share_through(pane, share):
    """Light that falls straight on one surface of a pane: coloured, or 4 % reflected by Fresnel at an index of 1.5."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))
    b.quad("Pane", (-0.2, -0.2, 0.5), (1.4, 0, 0), (0, 1.4, 0), pane)
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0)))
    floor = lambda e: np.where(np.arange(2 * e.count) % 2 == 0, by_object(e), -1)  # noqa: E731
    # Passing straight is no scattering, so what a transparent pane lets through is direct light.
    part = "direct" if pane.lobes[0].kind == "transparent" else "indirect"
    found, error = replicates(b.build(), floor, runs=12, particles=20_000, part=part)
    agrees(found[0], error[0], np.full(3, share), resolution=0.01)


METAL = Material("Metal", (Lobe("metallic", Color.of(0.9, 0.6, 0.3), 0.3),))
COAT = Material("Coat", (Lobe("diffuse", Color.of(0.6, 0.4, 0.2)), Lobe("specular", Color.of(1.0), 0.3, 1.5)))
GLOSSY = shiny("glossy", 0.8, 0.5)
LOBES = {
    "opaque": [GLOSSY, METAL, COAT, METAL, GLOSSY, COAT],
    "glass": shiny("glass", 1.0, 0.0),
    "rough glass": shiny("glass", 0.9, 0.4),
}


@pytest.mark.parametrize("name", LOBES)
def test_every_lobe_agrees_with_paths_from_the_receivers(name):
    """A box of grey walls and a block of the material in it, under a panel: irradiance of every object by T* and by T."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (2, 2, 2), diffuse("Grey", 0.4), inward=True)
    b.box("Block", (0.5, 0.6, 0.3), (1.4, 1.5, 1.0), LOBES[name], inward=False)
    b.quad("Panel", (0.6, 0.6, 1.9), (0, 0.8, 0), (0.8, 0, 0), diffuse("Panel", 0.0, (3.0, 2.0, 1.0)))
    scene = b.build()
    paths, sigma = by_walks(scene, samples=128)
    fronts = lambda e: np.where(  # noqa: E731
        np.arange(2 * e.count) % 2 == 0, np.repeat(scene.object[e.patch_triangle[e.patch]], 2), -1
    )
    found, error = replicates(scene, fronts, runs=8, particles=40_000)
    both = np.hypot(error, sigma)
    assert (both < 0.1 * paths + 0.005).all()
    assert (np.abs(found - paths) < 5 * both).all()


WHITE = {
    "multiscatter metal": (Lobe("metallic", Color.of(1.0), 0.8, multiscatter=True),),
    "coat": (Lobe("diffuse", Color.of(1.0)), Lobe("specular", Color.of(1.0), 0.5, 1.5)),
}


@pytest.mark.parametrize("name", WHITE)
def test_what_absorbs_nothing_is_not_said_to(name):
    """A white box in the open: all light escapes, though sampled lobes make particles weaker and stronger."""
    b = SceneBuilder()
    b.box("Box", (0, 0, 0), (1, 1, 1), Material(name, WHITE[name]), inward=False)
    b.background = (1.0, 1.0, 1.0)
    world, receivers = on_elements(b.build())
    balance = solve(world, receivers, 400_000).balance
    assert balance.gap < 1e-6
    assert abs(balance.absorbed) < 0.005 * balance.emitted


def test_a_radius_in_which_nothing_is_counted_is_named():
    world = World(scenes.cornell())
    receivers = SurfaceReceivers("texels", np.arange(3), np.zeros(2, np.int32), np.full(2, 0.2), np.full(2, 0.3))
    said = {}
    for radius in (0.0, 1e-7):
        found = solve(world, receivers, 20_000, score="receivers", radius=radius)
        said[radius] = [str(w) for w in found.warnings if "counted no particle" in str(w)]
    assert not said[0.0] and "Raise radius" in said[1e-7][0]


def test_bent_normals_of_glossy_surfaces_obey_the_adjoint():
    """A glossy floor with tilted shading normals: what it throws on a wall is the same by particles and by paths."""
    tilt = np.array([math.sin(0.3), 0, math.cos(0.3)])
    b = SceneBuilder()
    b.quad("Wall", (2, 0, 0), (0, 0, 2), (0, 2, 0), diffuse("Black", 0))
    corners = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)], float)
    b.mesh("Floor", corners, np.array([[0, 1, 2], [0, 2, 3]]), shiny("glossy", 0.8, 0.6), smooth_normals=np.tile(tilt, (4, 1)))
    b.quad("Panel", (0.5, 0.5, 1.5), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0.0, 1.0))
    scene = b.build()
    paths, sigma = by_walks(scene, samples=256)
    group = lambda e: np.where(np.arange(2 * e.count) % 2 == 0, by_object(e), -1)  # noqa: E731
    found, error = replicates(scene, group, particles=100_000)
    assert (np.abs(found[0] - paths[0]) < 5 * np.hypot(error[0], sigma[0])).all()
    assert (np.hypot(error[0], sigma[0]) < 0.01 * paths[0]).all()


def test_a_camera_is_told_that_it_sees_irradiance():
    scene = scenes.cube(materials=[shiny("glossy", 0.5, 0.2)] + [diffuse("Wall", 0.5, 1.0)] * 5)
    camera = Camera("perspective", (0.5, 0.2, 0.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-1, 1, -1, 1), 4, 4)
    world = World(dataclasses.replace(scene, camera=camera))
    text = " ".join(str(w) for w in solve(world, CameraReceivers(world), 1000, score="receivers").warnings)
    assert "seen as diffuse" in text and "counted on elements" in text


# ---- counting at receivers


def grid_texels(scene, n):
    """n x n texels of the first rectangle of `scene`, four points each."""
    x = (np.arange(2 * n) + 0.5) / (2 * n)
    s, t = (a.reshape(n, 2, n, 2).transpose(0, 2, 1, 3).ravel() for a in np.meshgrid(x, x))
    # A quad's triangles are (0, 1, 2) and (0, 2, 3): barycentrics of (s, t) in the one it lies in.
    lower = s >= t
    u, v = np.where(lower, s - t, s), np.where(lower, t, t - s)
    return SurfaceReceivers("texels", np.arange(n * n + 1) * 4, np.where(lower, 0, 1), u, v)


def test_density_at_texels_has_no_dark_rims():
    """T1: irradiance 2 at every texel, also at edges and corners of the face."""
    scene = scenes.cube(0.5, 1.0)
    world = World(scene)
    texels = grid_texels(scene, 12)
    options = {"score": "receivers", "radius": 0.15}
    found = np.mean([solve(world, texels, 100_000, seed=s, **options).quantity("irradiance") for s in range(6)], axis=0)
    image = found.mean(axis=1).reshape(12, 12)
    for part in (image[1:-1, 1:-1], image[0], image[:, -1], image[[0, 0, -1, -1], [0, -1, 0, -1]]):
        assert part.mean() == pytest.approx(2, abs=0.1)
    assert image.std() < 0.1


def test_density_at_texels_follows_a_point_lamp():
    """Irradiance z / r^3 under a lamp, at every texel within noise and the kernel's blur."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0))
    b.light(Light("Lamp", "point", (1.0, 2.0, 3.0), (0.5, 0.5, 0.5)))
    scene = b.build()
    solution = solve(World(scene), grid_texels(scene, 16), 400_000, score="receivers", radius=0.06)
    x = (np.arange(16) + 0.5) / 16 - 0.5
    expected = 0.5 / (x[:, None] ** 2 + x**2 + 0.25) ** 1.5
    found = solution.direct.reshape(16, 16, 3)
    np.testing.assert_allclose(found / [1, 2, 3], np.repeat(expected[..., None], 3, axis=2), rtol=0.2)
    assert np.abs(found[..., 0] / expected - 1).mean() < 0.05
    assert found.sum() == pytest.approx(6 * expected.sum(), rel=0.01)
    assert (solution.weight == 1).all() and not solution.indirect.any()


def test_density_at_vertices_is_the_mean_over_the_faces_around():
    """Points of a cube's corner lie on three faces: a sun straight down gives each top corner a third of its irradiance."""
    b = SceneBuilder()
    b.box("Cube", (0, 0, 0), (1, 1, 1), diffuse("Black", 0), inward=False)
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0)))
    scene = b.build()
    # Triangles 10 and 11 are the top; 0 and 1 the -x face. One receiver on the top, one on three faces, one on the bottom.
    triangle = np.array([10, 11, 10, 1, 4, 8])
    receivers = SurfaceReceivers("vertices", np.array([0, 2, 5, 6]), triangle, np.full(6, 0.05), np.full(6, 0.05))
    solution = solve(World(scene), receivers, 400_000, score="receivers")
    np.testing.assert_allclose(solution.direct[:, 0], [1, 1 / 3, 0], atol=0.08)


@pytest.mark.parametrize("shortest", [0, 1])
def test_own_emission_at_receivers_is_light_of_length_0(shortest):
    """What a wall emits itself, which a least length of 1 leaves out."""
    scene = scenes.cube(0.5, 1.0)
    solution = solve(World(scene), grid_texels(scene, 2), 1000, score="receivers", min_length=shortest)
    np.testing.assert_allclose(solution.emitted, float(shortest == 0), rtol=1e-6)
    assert solution.direct.all()


def test_counting_at_receivers_is_the_same_for_any_number_of_threads(monkeypatch):
    scene = scenes.cornell()
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
        found.append(solve(World(scene), grid_texels(scene, 8), 40_000, score="receivers").quantity("irradiance"))
    assert np.array_equal(*found)


def test_lights_are_named_beside_their_power():
    scene = dataclasses.replace(scenes.cornell(), lights=(Light("Bulb", "point", (1.0, 0.5, 0.25), (0.5, 0.5, 0.5)),))
    world, receivers = on_elements(scene)
    extra = solve(world, receivers, 2000).extra
    assert extra["light_names"].tolist() == ["Lamp", "Bulb"] and extra["light_flux"].shape == (2, 3)
