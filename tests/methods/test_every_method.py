"""Every method of the registry against closed forms, and what all methods promise. A new method is tested by one row of `ROWS`.

A row has the settings that find an answer in about a second, which light the method finds, and by how much its answer may differ from
the exact one in each scene, relative to the brightest surface of that scene.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method import clock
from adjgi.adjoint_gi.core.method.registry import Nature, method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, SceneArrays
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import MODULES, load
from adjgi.tests import scenes
from adjgi.tests.solving import bits, front_means, look, on_elements, scattered, solve, solved_by_threads, steps

PI = math.pi


# ---- scenes with known answers


@dataclass(frozen=True)
class Scene:
    """A scene, the edge of its elements, and by kind of light the exact mean of each material's fronts, in the order of the materials.

    Kinds: "all" and "direct" are irradiance; "potential" is that for the light which leaves `objects`, as radiosity is of emission.
    """

    build: Callable[[], SceneArrays]
    exact: dict[str, tuple[float, ...]]
    edge: float = 10.0
    objects: str = ""


def plates() -> SceneArrays:
    """T4: facing unit squares with perfect mirrors for walls are infinite plates."""
    mirror = Material("Mirror", (Lobe("glossy", Color.of(1), 0.0),))
    return scenes.cube(materials=[*[mirror] * 4, diffuse("Floor", 0.5, 1 / PI), diffuse("Ceiling", 0.8)])


def kirchhoff() -> SceneArrays:
    """T8: two mirrors that are diffuse as well; every surface emits what it does not reflect, so radiance is 1 everywhere."""
    mixed = Material("Mixed", (Lobe("diffuse", Color.of(0.3)), Lobe("glossy", Color.of(0.5), 0.0), Lobe("emission", Color.of(0.2))))
    return scenes.cube(materials=[mixed, mixed, *[diffuse("Wall", 0.6, 0.4)] * 4])


def sphere(lamp: bool) -> SceneArrays:
    """T3, or T12: one zone, with a point lamp of pi W/sr in the middle."""
    if not lamp:
        return scenes.two_zone_sphere(2)
    dark = scenes.two_zone_sphere(2, (0, 0), (0.5, 0.5))
    return dataclasses.replace(dark, lights=(Light("Lamp", "point", (PI, PI, PI), (0, 0, 0)),))


def zone_areas() -> tuple[float, float]:
    """Areas that the mesh gives to the zones of the sphere; the sums below hold for them."""
    vertices, triangles = scenes.icosphere(2)
    corners = vertices[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    lower = corners.mean(axis=1)[:, 2] < 0
    return float(area[~lower].sum()), float(area[lower].sum())


def floor(lamp: str) -> SceneArrays:
    """A unit square under one light: a point 1 m above its middle, a unit square facing it at 1 m, or a sky."""
    b = SceneBuilder()
    b.quad("Floor", (-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
    if lamp == "point":
        b.light(Light("Lamp", "point", (1, 1, 1), (0, 0, 1)))
    elif lamp == "area":
        b.light(Light("Lamp", "area", (1, 1, 1), (0, 0, 1), size_x=1, size_y=1))
    elif lamp == "mesh":
        b.quad("Lamp", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("Lamp", 0.0, 1.0))
    else:
        b.background = (1.0, 1.0, 1.0)
    return b.build()


FACING, ADJACENT = 0.19982489569838746, 0.20004377607540316  # form factors of faces of a cube
ZONES = zone_areas()
SPHERE = ZONES[0] / (0.8 * ZONES[0] + 0.2 * ZONES[1])  # T3: irradiance and potential
DIRECT = ZONES[0] / sum(ZONES)
LAMP = 4 * PI * PI / sum(ZONES)
SOLID_ANGLE = 4 * math.asin(0.2)  # of a unit square seen from 1 m over its middle
B_ROOMS = scenes.snowman_answer(0.1, (0.5, 0.5), (1.0, 0.0))
B_CUBE = (*[0.1811] * 4, 0.1712, 1.1044)  # T10: walls, floor and ceiling of albedo 0.5
SCENES = {
    "furnace": Scene(lambda: scenes.cube(0.5, 1.0), {"all": (2,) * 6, "direct": (1,) * 6}, 0.25),
    "sphere": Scene(
        lambda: sphere(False), {"all": (SPHERE,) * 2, "direct": (DIRECT,) * 2, "potential": (SPHERE / DIRECT,) * 2}, objects="Sphere"
    ),
    "snowman": Scene(
        lambda: scenes.snowman(1), {"all": (5 / 3, 1 / 3), "direct": (0.9, 0.1), "potential": (B_ROOMS[1], B_ROOMS[0])}, objects="B"
    ),
    "cube": Scene(
        lambda: scenes.lit_cube(0.5),
        {
            "all": (*[2 * b for b in B_CUBE[:5]], 2 * (B_CUBE[5] - 1)),
            "direct": (*[ADJACENT] * 4, FACING, 0),
            "potential": B_CUBE,
        },
        0.125,
        "Cube +z",
    ),
    "kirchhoff": Scene(
        kirchhoff,
        {
            "all": (PI,) * 6,
            "direct": (*[PI * (0.2 * FACING + 1.6 * ADJACENT)] * 2, *[PI * (0.4 * FACING + 1.2 * ADJACENT)] * 4),
        },
        0.25,
    ),
    "plates": Scene(plates, {"all": (1.5, 1.5, 1.5, 1.5, 4 / 3, 5 / 3)}, 0.25),
    "lamp in sphere": Scene(lambda: sphere(True), {"all": (2 * LAMP,) * 2, "direct": (LAMP,) * 2}),
    "lamp over floor": Scene(lambda: floor("point"), dict.fromkeys(("all", "direct"), (SOLID_ANGLE,)), 0.25),
    "area over floor": Scene(lambda: floor("area"), dict.fromkeys(("all", "direct"), (PI * FACING,)), 0.25),
    "mesh over floor": Scene(lambda: floor("mesh"), dict.fromkeys(("all", "direct"), (PI * FACING,)), 0.25),
    "floor under sky": Scene(lambda: floor("sky"), dict.fromkeys(("all", "direct"), (PI,)), 0.25),
}


# ---- the table of methods


@dataclass(frozen=True)
class Row:
    """A method's kind of light, its settings, and percents by which it may be off in the scenes, in their order; None: no answer there."""

    kind: str
    options: dict[str, object]
    percent: tuple[float | None, ...]
    noise: bool = False  # other seeds give other results


# Noise of a fixed seed is part of what is allowed: about twice what it was when the row was written.
ROWS = {
    # Percents: furnace, sphere, snowman, cube, kirchhoff, plates, lamp in sphere, lamp, area, mesh and sky over floor.
    "local_illumination": Row("direct", {"light_points": 256}, (5, 1.5, 0.2, 3, 10, None, 0.7, 0.5, 0.5, 0.1, None)),
    "whitted": Row("direct", {"light_points": 256}, (5, 1.5, 0.2, 3, 10, None, 0.7, 0.5, 0.5, 0.1, None)),
    "matrix_radiosity": Row("all", {"rays": 256}, (0.01, 0.2, 0.3, 0.7, 0.01, None, 0.01, 0.7, 0.3, 0.01, 0.01)),
    "directional_radiosity": Row("all", {"bin_rows": 4, "bin_columns": 8}, (0.1, 0.5, 0.3, 0.5, 0.1, 0.2, 0.1, 0.7, 2, 10, 0.01)),
    "two_pass": Row(
        "all", {"samples": 64, "rays": 128, "particles": 50_000, "depth": 64}, (2, 0.5, 0.5, 3, 1.5, 4, 0.1, 0.5, 1.5, 1, 0.01), noise=True
    ),
    "distribution": Row("all", {"samples": 36}, (4, 0.5, 0.5, 1.5, 5, 8, 0.5, 0.7, 0.5, 0.5, 0.01), noise=True),
    "irradiance_cache": Row("all", {"rays": 512, "light_samples": 64}, (1, 0.5, 0.2, 2, 1.5, 5, 0.3, 0.5, 0.7, 1, 0.01), noise=True),
    "path_tracing": Row("all", {"samples": 256}, (1.5, 0.5, 0.5, 1, 3, 5, 0.1, 0.5, 0.5, 0.5, 0.01), noise=True),
    "progressive_radiosity": Row("all", {"rays": 200_000}, (0.7, 0.5, 0.5, 1, 0.7, None, 0.2, 0.7, 0.3, 0.1, 0.01)),
    "spherical_harmonics": Row("all", {"rays": 100_000, "order": 2}, (1, 0.5, 0.5, 0.7, 0.7, 3, 0.3, 0.7, 2, 0.3, 0.01)),
    "particle_tracing": Row("all", {"particles": 100_000}, (2, 0.5, 1, 1.5, 1.5, 4, 1, 0.5, 0.7, 1.5, 3), noise=True),
    # Its lamp light follows the seed, with 0.6 % of noise on the floor, where that of progressive radiosity is always the same.
    "stochastic_jacobi": Row(
        "all", {"rays": 100_000, "light_samples": 64}, (1, 0.5, 0.5, 1, 1, None, 0.3, 0.7, 1.3, 0.5, 0.01), noise=True
    ),
    "multi_pass": Row(
        "all", {"samples": 64, "rays": 100_000, "particles": 50_000}, (3, 1, 0.7, 3, 2, 3, 0.1, 0.5, 1.5, 4, 0.01), noise=True
    ),
    "potential": Row("potential", {"rays": 128, "receivers": "objects"}, (None, 0.7, 0.1, 0.1, None, None, None, None, None, None, None)),
}


def options_of(name: str, scene: Scene) -> dict[str, object]:
    """The settings of a method in a scene."""
    return ROWS[name].options | ({"objects": scene.objects} if ROWS[name].kind == "potential" else {})


def quantity(name: str) -> str:
    """What the method answers for surfaces."""
    return "potential" if ROWS[name].kind == "potential" else "irradiance"


CASES = [
    (name, title)
    for name, row in ROWS.items()
    for title, percent in zip(SCENES, row.percent, strict=True)
    if percent is not None and row.kind in SCENES[title].exact
]


def test_filling_the_registry_twice_changes_nothing():
    before = [method(name) for name in MODULES]
    load()
    assert [method(name) for name in MODULES] == before


def test_every_method_has_a_row():
    assert list(ROWS) == list(MODULES), "add a row to ROWS for a new method, in the order of solvers/__init__.py"


@pytest.mark.parametrize(("name", "title"), CASES)
def test_closed_forms(name, title):
    scene, row = SCENES[title], ROWS[name]
    receivers = on_elements(scene.build(), scene.edge)
    e = receivers.elements
    found = solve(name, receivers, seed=1, **options_of(name, scene)).quantity(quantity(name))
    exact = np.array(scene.exact[row.kind])
    mean = front_means(receivers, found, e.world.scene.material[e.patch_triangle[e.patch]])[: len(exact)]
    off = 100 * np.abs(mean - exact).max() / exact.max()
    assert off <= row.percent[list(SCENES).index(title)], f"{mean} is not {exact}"


# ---- what all methods promise

NAMES = list(ROWS)
KINDS = ("texels", "vertices", "camera", "elements")


def places(kind: str, scene: SceneArrays):
    """World and receivers of a kind: points of all surfaces, corners of all objects, pixels of a camera, or elements."""
    world = World(scene)
    if kind == "vertices":
        return world, vertex_receivers(world, range(len(scene.objects))).receivers
    if kind == "camera":
        return world, CameraReceivers(world)
    if kind == "elements":
        return world, on_elements(scene, 0.25)
    return world, scattered(world, 60, kind="texels")


def furnace(factor: float = 1.0) -> SceneArrays:
    """T1 with a camera inside: radiosity 2 everywhere for an emission of 1."""
    return dataclasses.replace(scenes.cube(0.5, factor), camera=look((0.5, 0.1, 0.5), (0, 1, 0), size=8))


def lamps(factor: float = 1.0) -> SceneArrays:
    """The Cornell box with a lamp of each kind beside its emitting face, and a background, all times `factor`; a mirror, a pane."""
    b = scenes.cornell_builder(12, 12, light=15.0 * factor)
    b.quad("Mirror", (0.05, 0.6, 0.02), (0.2, 0, 0), (0, 0.1, 0.3), Material("Mirror", (Lobe("glossy", Color.of(0.8), 0.0),)))
    b.quad("Pane", (0.4, 0.1, 0.02), (0.3, 0, 0), (0, 0, 0.4), Material("Pane", (Lobe("glass", Color.of(0.9), 0.0, 1.45),)))
    color = (1.0 * factor, 2.0 * factor, 0.0)
    b.light(Light("Point", "point", color, (0.2, 0.2, 0.5), radius=0.05))
    b.light(Light("Spot", "spot", color, (0.5, 0.5, 0.9), spot_angle=0.9))
    b.light(Light("Sun", "sun", color, angle=0.02))
    b.light(Light("Area", "area", color, (0.3, 0.1, 0.8), size_x=0.2, size_y=0.1))
    b.background = (0.1 * factor, 0.2 * factor, 0.3 * factor)
    return b.build()


def quick(name: str, scene: SceneArrays) -> dict[str, object]:
    """Settings that take a moment in a scene of this file."""
    small = {"samples": 4, "rays": 64, "particles": 20_000, "light_samples": 2, "light_points": 4, "max_edge": 0.4}
    fields = {f.name for f in dataclasses.fields(method(name).Settings)}
    options = {key: value for key, value in (ROWS[name].options | small).items() if key in fields}
    return options | ({"objects": scene.objects[0].name} if ROWS[name].kind == "potential" else {})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_receivers_is_answered(name, kind):
    """The furnace, up to what the method finds of it; a camera gets radiance."""
    if kind not in method(name).spec.receivers:
        pytest.skip(f"{name} does not answer {kind}")
    row, scene = ROWS[name], furnace()
    world, receivers = places(kind, scene)
    options = dict(row.options)
    if any(f.name == "max_edge" for f in dataclasses.fields(method(name).Settings)):
        options["max_edge"] = 0.25
    if row.kind == "potential":
        options["objects"] = ", ".join(o.name for o in scene.objects)
    s = solve(name, world, receivers, seed=1, **options)
    assert s.method == name and not s.partial and s.rays > 0
    assert s.measure == ("potential" if row.kind == "potential" else "radiance" if kind == "camera" else "irradiance")
    found = s.quantity({"irradiance": "radiosity"}.get(s.measure, s.measure))
    assert found.shape == (receivers.count, 3) and found.dtype == np.float32
    for name_ in ("emitted", "direct", "indirect", "albedo"):
        assert getattr(s, name_).shape == (receivers.count, 3) and getattr(s, name_).dtype == np.float32
    assert s.weight.shape == (receivers.count,) and (s.weight > 0).all()
    if kind == "elements":
        found = found[0::2]  # the backs see nothing
    want = {"all": 2.0, "direct": 1.5, "potential": 2.0}[row.kind] / (PI if s.measure == "radiance" else 1)
    assert found.mean() == pytest.approx(want, rel=0.03)


@pytest.mark.parametrize("name", NAMES)
def test_every_method_means_the_same_by_emitted_and_entering(name):
    """A sun of 1 W/m2 upon a closed unit room puts 1 W of each colour on its roof; a lamp over a sheet sends most of its light past it."""
    if ROWS[name].kind == "potential":
        pytest.skip("a share, not a flux")
    for at, emitted, entering in (("room", 3.0, 3.0), ("sheet", 12 * PI, 2 * PI)):
        b = SceneBuilder()
        if at == "room":
            b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Grey", 0.5), inward=True)
            b.light(Light("Sun", "sun", (1.0, 1.0, 1.0)))
        else:
            b.quad("Sheet", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
            b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.5, 0.5, 0.5)))
        scene = b.build()
        world = World(scene)
        s = solve(name, on_elements(scene, 0.5), **quick(name, scene))
        assert (s.emitted_flux, s.entering_flux) == (Emitters(world).flux.emitted, Emitters(world).flux.entering)
        assert (s.emitted_flux, s.entering_flux) == pytest.approx((emitted, entering), rel=0.01)
        if s.balance is not None:
            assert s.balance.emitted == pytest.approx(emitted, rel=0.04)
            assert s.balance.absorbed + s.balance.escaped + s.balance.unshot == pytest.approx(s.balance.emitted, rel=0.02)


SHOWING_MIRRORS = ("whitted", "distribution", "path_tracing", "two_pass", "multi_pass")


def before_lamp(camera: bool, mirror: bool) -> SceneArrays:
    """A camera that looks at a lamp which lights nothing that it sees: straight, or in a mirror behind which it stands."""
    b = SceneBuilder()
    material = Material("Mirror", (Lobe("glossy", Color.of(1, 1, 1), 0.0),)) if mirror else diffuse("Black", 0.0)
    b.quad("Back", (-9, 2, -9), (18, 0, 0), (0, 0, 18), material)
    side = {"axis_x": (1.0, 0.0, 0.0), "axis_y": (0.0, 0.0, 1.0), "axis_z": (0.0, -1.0 if mirror else 1.0, 0.0)}
    b.light(Light("Lamp", "area", (2.0, 2.0, 2.0), (0, -3.0 if mirror else 1.0, 0), size_x=9.0, size_y=9.0, camera=camera, **side))
    b.camera = look((0, 0, 0), (0, 1, 0), size=4)
    return b.build()


@pytest.mark.parametrize("mirror", [False, True], ids=["straight", "mirror"])
@pytest.mark.parametrize("name", NAMES)
def test_pictures_show_lamps_that_cameras_may_see(name, mirror):
    """Cycles hides new lamps from the camera; mirrors show them all the same."""
    if ROWS[name].kind == "potential" or (mirror and name not in SHOWING_MIRRORS):
        pytest.skip("shows no lamps, or no mirrors")
    for camera in (False, True):
        scene = before_lamp(camera, mirror)
        world, receivers = places("camera", scene)
        options = quick(name, scene)
        picture = solve(name, world, receivers, **options | ({"max_edge": 20.0} if "max_edge" in options else {})).quantity("radiance")
        np.testing.assert_allclose(picture, 2.0 if camera or mirror else 0.0, rtol=0.05, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_bits_for_any_number_of_threads(name, monkeypatch):
    """And other bits for another seed exactly if the row says so."""
    scene = lamps()
    world, receivers = places("camera", scene)
    one, three = solved_by_threads(monkeypatch, lambda: solve(name, world, receivers, seed=5, **quick(name, scene)))
    assert bits(one) == bits(three) and one.rays == three.rays and one.balance == three.balance
    other = solve(name, world, receivers, seed=6, **quick(name, scene))
    assert (bits(other) != bits(one)) == ROWS[name].noise


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_matters_to_nondeterministic_methods_only(name):
    """A method of both natures may have either."""
    natures = method(name).spec.natures
    assert (Nature.NONDETERMINISTIC if ROWS[name].noise else Nature.DETERMINISTIC) in natures


@pytest.mark.parametrize("name", NAMES)
def test_every_step_has_a_sound_result(name, monkeypatch):
    """Fractions, rays and the times of the history rise, values are finite and not negative, only the last result is not partial.

    Every step that a method can make is made, also on a machine so fast or slow that a user would see others.
    """
    monkeypatch.setattr(clock, "PAUSE", 0.0)
    scene = lamps()
    world, receivers = places("texels", scene)
    before = None
    for step in steps(name, world, receivers, seed=1, **quick(name, scene)):
        s = step.solution()
        assert 0 <= step.fraction <= 1 and step.text and "\n" not in step.text
        assert s.partial == (step.fraction < 1)
        for array in (s.emitted, s.direct, s.indirect, s.albedo, s.weight):
            assert np.isfinite(array).all() and (array >= 0).all()
        assert not (s.direct[s.weight == 0].any() or s.indirect[s.weight == 0].any())
        times = [t for t, _ in s.history]
        assert times == sorted(times)
        assert all(value >= 0 for _, value in s.history)  # infinite while there is but one sample
        if before is not None:
            assert step.fraction >= before[0] and s.rays >= before[1]
        before = step.fraction, s.rays
    assert before is not None and before[0] == 1.0
    assert s.seconds > 0 and s.settings["seed"] == 1


@pytest.mark.parametrize("name", NAMES)
def test_partial_results_do_not_disturb_the_end(name):
    """A run that is looked at after every step, and stands still in between, comes to the bits of one that is not."""
    scene = lamps()
    world, receivers = places("elements", scene)
    for step in steps(name, world, receivers, seed=1, **quick(name, scene)):
        last = step.solution()
    assert bits(last) == bits(solve(name, world, receivers, seed=1, **quick(name, scene)))


@pytest.mark.parametrize("name", NAMES)
def test_no_light_is_exactly_zero(name):
    """The potential is there without light, but no flux."""
    scene = dataclasses.replace(scenes.cornell(light=0.0), camera=None)
    world, receivers = places("texels", scene)
    s = solve(name, world, receivers, **quick(name, scene))
    if ROWS[name].kind == "potential":
        assert s.quantity("potential").any() and not s.extra["flux"].any()
    else:
        assert not s.quantity("radiosity").any() and not s.quantity("irradiance").any()


@pytest.mark.parametrize("name", NAMES)
def test_the_answer_is_linear_in_emission(name):
    """Four times the light is four times the answer, with the same random numbers; the potential does not know it."""
    found = []
    for factor in (1.0, 4.0):
        scene = lamps(factor)
        world, receivers = places("texels", scene)
        found.append(solve(name, world, receivers, seed=1, **quick(name, scene)).quantity(quantity(name)))
    factor = 1.0 if ROWS[name].kind == "potential" else 4.0
    np.testing.assert_allclose(found[1], factor * found[0], rtol=1e-5, atol=1e-6 * found[1].max())


@pytest.mark.parametrize("name", NAMES)
def test_a_colour_that_nothing_emits_stays_dark(name):
    """The three channels do not mix."""
    scene = dataclasses.replace(scenes.cornell(light=(1.0, 0.0, 2.0)), camera=None)
    world, receivers = places("elements", scene)
    s = solve(name, world, receivers, **quick(name, scene))
    value = s.quantity(quantity(name))
    assert value[:, 0].any() and value[:, 2].any()
    assert value[:, 1].any() == (ROWS[name].kind == "potential")


@pytest.mark.parametrize("name", NAMES)
def test_memory_is_said_before_the_start(name):
    """A positive number of bytes that more receivers never make smaller."""
    solver, world = method(name), World(scenes.cornell())
    needed = [solver.memory(world, scattered(world, count), solver.Settings()) for count in (100, 100_000)]
    assert all(int(n) == n for n in needed) and 0 < needed[0] <= needed[1]


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_scene_has_an_empty_answer(name):
    world = World(SceneBuilder().build())
    receivers = on_elements(SceneBuilder().build())
    row = ROWS[name]
    if row.kind == "potential":
        with pytest.raises(AdjointError, match="Cube"):
            solve(name, world, receivers, **row.options, objects="Cube")
        return
    s = solve(name, world, receivers, **row.options)
    assert s.direct.shape == s.indirect.shape == (0, 3) and s.weight.shape == (0,)
