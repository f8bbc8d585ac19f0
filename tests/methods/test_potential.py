"""The potential against exact solutions, relaxation against walks, and flux by both equations (review, Eq. 3, 4, 14)."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import AdjointError, MemoryRefused
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.detectors import detector
from adjgi.adjoint_gi.core.flux.potential_walks import _relative_error, walks_from_camera
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity.potential_relaxation import PotentialSystem
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load
from adjgi.tests import scenes
from adjgi.tests.solving import flux_by_radiance

load()
# Standard deviations that a sound method exceeds once in a thousand runs of the z-tests here (Sidak, 40 of them).
Z = 4.2


def solve(world, places, /, seed=1, name="potential", **options):
    """The finished solution."""
    solver = method(name)
    *_, last = solver.solve(world, places, solver.Settings(**options), np.random.default_rng(seed))
    return last.solution()


def one_element_a_face(scene):
    """World and element sides with one element on each rectangle."""
    world = World(scene)
    return world, ElementReceivers(Elements(world, max_edge=100.0))


def runs(count, group, area, value):
    """Mean and standard error (g, 3) of `value(seed)` (n, 3), averaged by area over groups (n,), -1 for none."""
    used = group >= 0
    total = np.bincount(group[used], area[used])
    means = []
    for seed in range(count):
        q = value(seed).astype(float)
        means.append(np.stack([np.bincount(group[used], (area * q[:, c])[used]) / total for c in range(3)], axis=1))
    return np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / math.sqrt(count)


# ---- closed forms


@pytest.mark.parametrize("scheme", ["jacobi", "southwell"])
def test_the_floor_of_a_cube_sees_its_ceiling_as_t9b_says(scheme):
    """T9b: W of the floor at the ceiling, one patch a face; it is the floor's radiosity when the ceiling emits 1."""
    world, receivers = one_element_a_face(scenes.lit_cube((0.5, 0.5, 0.63, 0.14, 0.2, 0.8)))
    options = {"receivers": "objects", "objects": "Cube -z", "scheme": scheme, "tolerance": 1e-14, "rays": 64}
    solution = solve(world, receivers, **options)
    potential = solution.quantity("potential")
    assert potential[10] == pytest.approx(np.full(3, 0.065934152332), rel=1e-6)
    # Emission on the floor is part of the flux itself.
    assert solution.emitted[8] == pytest.approx(np.ones(3)) and potential[8, 0] > 1
    # Phi = sum of E A W: the ceiling emits radiosity 1 from its front; its back sees nothing.
    assert solution.extra["flux"].sum(axis=0) == pytest.approx(np.full(3, 0.065934152332), rel=1e-7)  # colours are float32


@pytest.mark.parametrize("scheme", ["jacobi", "southwell"])
def test_dual_identity_with_unequal_areas(scheme):
    """<g, B> = <W, E> in the 4 x 4 x 3 room: E = 1 on one wall, g = 1 on the floor: 1.0626... on both sides."""
    world, receivers = one_element_a_face(scenes.room(emission=(1.0, 0, 0, 0, 0, 0)))
    options = {"receivers": "objects", "objects": "Room -z", "scheme": scheme, "tolerance": 1e-15, "rays": 64}
    by_potential = solve(world, receivers, **options).extra["flux"]
    assert by_potential.sum(axis=0) == pytest.approx(np.full(3, 1.06264137633323), rel=1e-7)  # colours are float32
    radiosity = solve(world, receivers, name="matrix_radiosity", tolerance=1e-14, rays=64)
    by_radiance = flux_by_radiance(detector(world, "objects", "Room -z"), radiosity, receivers.elements)
    # The same by each path length: emitted there, arriving directly, and after reflections.
    np.testing.assert_allclose(by_radiance.value, by_potential, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("factors", ["matrix", "rays"])
@pytest.mark.parametrize("c,rho", [(0.1, (0.5, 0.5)), (0.1, (0.7, 0.4))])
def test_two_rooms_joined_by_a_door(c, rho, factors):
    """T6: importance of room B's walls seen from room A: W_A = rho_B c / D, at every point of A."""
    world = World(scenes.snowman(2, c, rho))
    receivers = ElementReceivers(Elements(world, target=500))
    options = {"receivers": "objects", "objects": "B", "factors": factors, "rays": 256, "tolerance": 1e-8}
    w = solve(world, receivers, **options).quantity("potential")[::2, 0].astype(float)
    room_a = world.scene.object[receivers.elements.patch_triangle[receivers.elements.patch]] == 0
    d = (1 - rho[0] * (1 - c)) * (1 - rho[1] * (1 - c)) - rho[0] * rho[1] * c * c
    area = receivers.elements.area[room_a]
    # The coarse polyhedron has a door of nearly the right area; 256 rays meet it 25 times each.
    assert (area @ w[room_a]) / area.sum() == pytest.approx(rho[1] * c / d, rel=0.02)


def test_walks_find_the_door_of_two_rooms():
    """T6 by random walks from points of room A; the mesh makes the door a little small."""
    c, rho = 0.1, (0.5, 0.5)
    world = World(scenes.snowman(3, c, rho))
    inside = np.flatnonzero(world.scene.object == 0)
    triangle = np.random.default_rng(2).choice(inside, 400, p=world.area[inside] / world.area[inside].sum())
    points = SurfaceReceivers("texels", np.arange(401), triangle, np.full(400, 1 / 3), np.full(400, 1 / 3))
    options = {"receivers": "objects", "objects": "B", "solution": "walks", "samples": 100}
    everything = np.zeros(400, int), np.ones(400)
    mean, error = runs(8, *everything, lambda seed: solve(world, points, seed, **options).quantity("potential"))
    d = (1 - rho[0] * (1 - c)) * (1 - rho[1] * (1 - c)) - rho[0] * rho[1] * c * c
    assert (error < 0.02 * mean).all()
    assert (np.abs(mean - rho[1] * c / d) < Z * error + 0.004).all()


@pytest.mark.parametrize("solution", ["relaxation", "walks"])
def test_lengths_of_paths_are_counted(solution):
    """In a furnace of albedo 0.5 with all faces as receivers: g = 1, then 0.5, 0.25, ...; limits leave out the rest."""
    world, receivers = one_element_a_face(scenes.cube(0.5, 1.0))
    names = ",".join(o.name for o in world.scene.objects)
    options = {"receivers": "objects", "objects": names, "solution": solution, "samples": 4096, "rays": 64}
    full = solve(world, receivers, **options)
    for name, value in (("emitted", 1), ("direct", 0.5), ("indirect", 0.5), ("potential", 2)):
        assert full.quantity(name)[::2].mean() == pytest.approx(value, abs=0.01)
    some = solve(world, receivers, **options, min_length=1, max_length=2)
    for name, value in (("emitted", 0), ("direct", 0.5), ("indirect", 0.25)):
        assert some.quantity(name)[::2].mean() == pytest.approx(value, abs=0.01)
    # Backs see nothing, and are receivers themselves only where both sides count.
    assert not full.quantity("potential")[1::2].any()
    both = solve(world, receivers, **options | {"samples": 4}, both_sides=True)
    np.testing.assert_allclose(both.quantity("potential")[1::2], 1, atol=1e-6)


# ---- relaxation against walks


def test_relaxation_and_walks_agree_in_the_cornell_box():
    """Potential towards both boxes, by object; elements of 10 cm may be off by a few percent, as in radiosity."""
    world = World(scenes.cornell())
    receivers = ElementReceivers(Elements(world, max_edge=0.1))
    names = ",".join(o.name for o in world.scene.objects if o.name.startswith(("Short", "Tall")))
    owner = np.repeat(world.scene.object[receivers.elements.patch_triangle[receivers.elements.patch]], 2)
    group = np.where(np.arange(len(owner)) % 2 == 0, owner, -1)
    area = np.repeat(receivers.elements.area, 2)
    options = {"receivers": "objects", "objects": names}
    walked, error = runs(6, group, area, lambda seed: solve(world, receivers, seed, **options, solution="walks", samples=16).indirect)
    direct, direct_error = runs(6, group, area, lambda seed: solve(world, receivers, seed, **options, solution="walks", samples=16).direct)
    relaxed = solve(world, receivers, **options, rays=256)
    for mean, sigma, part in ((walked, error, relaxed.indirect), (direct, direct_error, relaxed.direct)):
        other, _ = runs(2, group, area, lambda seed, part=part: part)
        gap = np.abs(mean - other) - Z * sigma
        assert (gap < 0.06 * other + 0.006).all(), gap.max(axis=1)
        assert (sigma < 0.06 * mean + 0.02).all()


def camera_scene():
    """A room with a camera inside that sees one wall."""
    camera = Camera("perspective", (2, 0.5, 1.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.5, 0.5, -0.4, 0.4), 40, 32)
    return dataclasses.replace(scenes.room(emission=(1.0, 0, 0, 0, 0, 0.5)), camera=camera)


def test_relaxation_and_walks_agree_for_the_camera():
    world = World(camera_scene())
    receivers = ElementReceivers(Elements(world, max_edge=0.5))
    e = receivers.elements
    owner = np.repeat(world.scene.object[e.patch_triangle[e.patch]], 2)
    group, area = np.where(np.arange(len(owner)) % 2 == 0, owner, -1), np.repeat(e.area, 2)
    relaxed = solve(world, receivers, rays=256)
    for name in ("emitted", "direct", "indirect"):
        mean, error = runs(6, group, area, lambda s, n=name: solve(world, receivers, s, solution="walks", samples=64).quantity(n))
        other, _ = runs(2, group, area, lambda s, n=name: relaxed.quantity(n))
        assert (np.abs(mean - other) < Z * error + 0.01 * other + 1e-7).all()


def test_the_camera_sees_its_projected_solid_angle():
    """A g summed over all that fills the view is the view's projected solid angle over pi: of a rectangle of 1 x 0.8 at distance 1."""
    world = World(camera_scene())
    elements = Elements(world, max_edge=0.5)
    g = detector(world, "camera").on_elements(elements)
    x, y = 0.5, 0.4
    form_factor = 4 / (2 * math.pi) * sum(a / math.hypot(1, a) * math.atan(b / math.hypot(1, a)) for a, b in ((x, y), (y, x)))
    assert np.repeat(elements.area, 2) @ g == pytest.approx(form_factor, rel=1e-4)


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "lens"])
@pytest.mark.parametrize("solution", ["relaxation", "walks"])
def test_flux_to_the_camera_by_both_equations(kind, solution):
    """<L, g> of a path-traced picture against <W, Le>, with a point lamp beside emitting walls."""
    scene = camera_scene()
    camera = dataclasses.replace(scene.camera, aperture_radius=0.1 * (kind == "lens"), focus_distance=3.0)
    if kind == "orthographic":
        camera = dataclasses.replace(camera, kind=kind)
    lamp = Light("Lamp", "point", (0.5, 1.0, 1.5), (1.0, 1.0, 2.0))
    world = World(dataclasses.replace(scene, camera=camera, lights=(lamp,)))
    places = ElementReceivers(Elements(world, max_edge=0.5))
    flux = solve(world, places, solution=solution, rays=256, samples=256).extra["flux"]
    picture = solve(world, CameraReceivers(world), name="path_tracing", samples=64)
    other = flux_by_radiance(detector(world, "camera"), picture)
    # Direct light falls off over elements of half a metre.
    np.testing.assert_allclose(flux.sum(axis=0), other.total, rtol=0.02)
    np.testing.assert_allclose(flux, other.value, rtol=0.04)


# ---- flux by both equations, for lamps and mesh lights, object by object


def lit_room(light):
    """A room with a block in it, lit by one light."""
    rho = (0.3, (0.5, 0.2, 0.1), 0.6, 0.14, 0.2, 0.7)
    b = SceneBuilder()
    mats = [diffuse(f"Face{i}", r, 0.4 if (light == "mesh" and i == 5) else 0.0) for i, r in enumerate(rho)]
    b.box("Room", (0, 0, 0), (4, 4, 3), mats, inward=True)
    b.box("Block", (1.25, 1.0, 0.5), (2.0, 2.5, 1.5), diffuse("Block", 0.4), inward=False)
    if light == "point":
        b.light(Light("Lamp", "point", (1.0, 2.0, 3.0), (3.0, 3.0, 2.0)))
    if light == "area":
        b.light(Light("Lamp", "area", (3.0, 2.0, 1.0), (2.5, 2.5, 2.9), size_x=1.0, size_y=0.5))
    return b.build()


@pytest.mark.parametrize("light", ["point", "area", "mesh"])
def test_flux_of_every_object_by_both_equations(light):
    """<g, L> by path tracing on element sides against <W, Le> by relaxation and by particles, for each object and path length."""
    world = World(lit_room(light))
    receivers = ElementReceivers(Elements(world, max_edge=0.5))
    by_paths = [solve(world, receivers, seed, name="path_tracing", samples=16) for seed in range(6)]
    for name in ("Room -z", "Room +x", "Room +z", "Block +z"):
        detect = detector(world, "objects", name)
        found = np.array([flux_by_radiance(detect, s, receivers.elements).value for s in by_paths])
        mean, error = found.mean(axis=0), found.std(axis=0, ddof=1) / math.sqrt(len(found))
        relaxed = solve(world, receivers, receivers="objects", objects=name, rays=256).extra["flux"]
        np.testing.assert_allclose(relaxed.sum(axis=0), mean.sum(axis=0), rtol=0.03)
        walks = {"receivers": "objects", "objects": name, "solution": "walks", "samples": 1}
        one = SurfaceReceivers("texels", np.array([0, 1]), np.array([0]), np.array([0.3]), np.array([0.3]))
        particles = solve(world, one, **walks)
        gap = np.abs(particles.extra["flux"] - mean)
        both = np.hypot(error, particles.extra["flux_error"])
        assert (gap < 5 * both + 1e-6).all(), (name, particles.extra["flux"], mean)
        assert (both < 0.05 * mean.sum(axis=0)).all()


def test_flux_through_glass_and_mirrors_by_walks():
    """Walks take all lobes: the floor's potential under a pane that halves the light, and beside a mirror that doubles what it sees."""
    b = SceneBuilder()
    pane = Material("Pane", (Lobe("transparent", Color.of(0.5)),))
    b.quad("Floor", (-20, -20, 0), (40, 0, 0), (0, 40, 0), diffuse("Floor", 0.6))
    b.quad("Pane", (-20, -20, 1), (40, 0, 0), (0, 40, 0), pane)
    b.quad("Panel", (-0.1, 0.1, 2), (0.2, 0, 0), (0, -0.2, 0), diffuse("Panel", 0.0, 1.0))
    world = World(b.build())
    panel = SurfaceReceivers("texels", np.array([0, 1]), np.array([4]), np.array([0.3]), np.array([0.3]))
    found = solve(world, panel, receivers="objects", objects="Floor", solution="walks", samples=20_000)
    # Reflected after the first flight, which passes the pane, and again what comes back from it: nothing does. Some rays miss the floor.
    assert found.direct[0] == pytest.approx(np.full(3, 0.5 * 0.6 * 400 / 404), abs=0.012)
    assert not found.indirect.any()


# ---- receivers and settings


def test_texels_vertices_and_pixels_are_answered_too():
    world = World(camera_scene())
    texels = SurfaceReceivers("texels", np.arange(7), np.array([0, 2, 4, 6, 8, 10]), np.full(6, 0.3), np.full(6, 0.3))
    for receivers in (texels, CameraReceivers(world)):
        for options in ({"solution": "relaxation"}, {"solution": "walks", "samples": 8}):
            s = solve(world, receivers, receivers="objects", objects="Room -z", max_edge=1.0, rays=64, **options)
            assert s.measure == s.whole == "potential"
            values = s.quantity("potential")
            assert values.shape == (receivers.count, 3) and np.isfinite(values).all() and (s.weight > 0).all()
            with pytest.raises(ValueError):
                s.quantity("irradiance")
        if receivers is texels:
            # Only the floor (triangles 8 and 9) is its own receiver.
            assert s.emitted[:, 0].tolist() == [0, 0, 0, 0, 1, 0]


def test_selected_faces_are_receivers():
    scene = scenes.room()
    objects = list(scene.objects)
    objects[4] = dataclasses.replace(objects[4], selected=np.array([True, True]))
    objects[5] = dataclasses.replace(objects[5], selected=np.array([False, False]))
    world = World(dataclasses.replace(scene, objects=tuple(objects)))
    assert np.flatnonzero(detector(world, "faces").mask).tolist() == [8, 9]
    with pytest.raises(AdjointError, match="no selected face"):
        detector(world, "faces", "Room +z")
    receivers = ElementReceivers(Elements(world, max_edge=100.0))
    by_faces = solve(world, receivers, receivers="faces", rays=64)
    by_name = solve(world, receivers, receivers="objects", objects="Room -z", rays=64)
    assert np.array_equal(by_faces.quantity("potential"), by_name.quantity("potential"))


def test_what_is_missing_is_named():
    world, receivers = one_element_a_face(scenes.room())
    for options, words in (
        ({}, "no camera"),
        ({"receivers": "objects"}, "names no object"),
        ({"receivers": "objects", "objects": "Roof"}, "'Roof'"),
        ({"receivers": "faces"}, "no selected face"),
    ):
        with pytest.raises(AdjointError, match=words):
            solve(world, receivers, **options)
    with pytest.raises(MemoryRefused):
        solve(world, ElementReceivers(Elements(world, max_edge=0.02)), receivers="objects", objects="Room -z")


def test_same_seed_same_bits_for_any_number_of_threads(monkeypatch):
    world = World(camera_scene())
    receivers = ElementReceivers(Elements(world, max_edge=1.0))
    for options in ({"receivers": "objects", "objects": "Room -z", "samples": 4}, {"samples": 4}):
        found = []
        for threads in ("1", "3"):
            monkeypatch.setenv("ADJOINT_GI_THREADS", threads)
            found.append(solve(world, receivers, 5, solution="walks", **options).quantity("potential"))
        assert np.array_equal(*found)
        assert not np.array_equal(found[0], solve(world, receivers, 6, solution="walks", **options).quantity("potential"))


def test_iterations_that_do_not_suffice_are_told():
    world, receivers = one_element_a_face(scenes.cube(0.95, 1.0))
    s = solve(world, receivers, receivers="objects", objects="Cube -z", rays=64, max_iterations=3, tolerance=1e-9)
    assert any("stopped after 3" in str(w) for w in s.warnings)
    assert len(s.history) == 3


def test_the_error_of_walks_is_that_of_the_mean_of_their_batches():
    """Root mean square over the sides by area, of the potential: power over area."""
    rng = np.random.default_rng(5)
    area, sums = rng.random(30) + 0.5, rng.normal(10, 2, (7, 3, 30, 3))
    found = _relative_error(sums.sum(axis=0), (sums.sum(axis=(1, 3)) ** 2).sum(axis=0), 7, area)
    each = sums.sum(axis=(1, 3)) / area
    mean, variance = each.mean(axis=0), each.var(axis=0, ddof=1) / 7
    assert found == pytest.approx(np.sqrt(area @ variance / (area @ mean**2)), rel=1e-9)


def test_walks_from_the_camera_count_the_lengths_that_are_asked_for():
    """Of two segments and more what is seen itself, and by one reflection, is none."""
    world = World(camera_scene())
    elements, detect = Elements(world, max_edge=2.0), detector(world, "camera")

    def parts(low, high=NO_LIMIT):
        *_, last = walks_from_camera(world, elements, detect, 4, low, high, np.random.default_rng(1))
        return last.parts

    whole, longer, shorter = parts(0), parts(2), parts(0, 1)
    assert whole.any(axis=(1, 2)).all() and not longer[:2].any() and not shorter[2].any()
    np.testing.assert_array_equal(longer[2], whole[2])
    assert shorter[:2].any(axis=(1, 2)).all()


@pytest.mark.parametrize("low", [0, 1, 2])
def test_what_receivers_see_themselves_counts_from_length_zero(low):
    elements = Elements(World(scenes.cube(0.5, 1.0)), 1.0)
    g = np.zeros((2 * elements.count, 3))
    g[0] = 1
    parts = PotentialSystem(elements, g, 16, low, 4).parts
    assert parts[0].sum() == 3 * (low == 0) and not parts[1:].any()
