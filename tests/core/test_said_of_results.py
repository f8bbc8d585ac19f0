"""What a result says of itself: elements that are too coarse for what lies close together, and noise."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.closeness import close_light, lamp_spots
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.flux.tally import Batch, Tally
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.lights.lamps import Lamps
from adjgi.adjoint_gi.core.method import noise
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity.lamp_light import LampLight, light_notices
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.gathering import Run, lights_of
from adjgi.adjoint_gi.core.walks.particles import Ends
from adjgi.tests import scenes
from adjgi.tests.solving import grid, quad_points, scattered, solve

ON_ELEMENTS = {
    "progressive_radiosity": {"rays": 10_000, "tolerance": 0.1},
    "matrix_radiosity": {"rays": 16, "max_edge": 0.5},
    "stochastic_jacobi": {"rays": 10_000, "max_edge": 0.5},
    "two_pass": {"samples": 1, "rays": 8, "max_edge": 0.5},
    "multi_pass": {"samples": 1, "rays": 10_000, "tolerance": 0.1, "max_edge": 0.5},
    "spherical_harmonics": {"rays": 10_000, "tolerance": 0.1, "max_edge": 0.5},
    "directional_radiosity": {"bin_rows": 2, "bin_columns": 4, "rays": 16, "max_edge": 1.0},
}


def room(gap):
    """A room of 4 x 4 x 3 m with an emitting panel of 1 m below its ceiling."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), diffuse("White", 0.7), inward=True)
    b.quad("Panel", (1.5, 1.5, 3 - gap), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0.0, 10.0))
    return World(b.build())


def lit(lamp):
    """The same room with a lamp alone."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), diffuse("White", 0.7), inward=True)
    b.light(lamp)
    return World(b.build())


def spot(x):
    """A spot 2 cm from a wall that shines along +x or -x."""
    axes = {"axis_x": (0, 1, 0), "axis_y": (0, 0, -x), "axis_z": (-x, 0, 0)}
    return Light("Lamp", "spot", (1.0, 1.0, 1.0), position=(0.02, 2.1, 1.4), spot_angle=1.0, **axes)


def area(z):
    """A panel 2 cm below the ceiling that shines down, or up."""
    return Light("Lamp", "area", (1.0, 1.0, 1.0), position=(2, 2, 2.98), size_x=1, size_y=1, axis_y=(0, z, 0), axis_z=(0, 0, z))


def said(solution, words):
    """The notices that have these words."""
    return [w for w in solution.warnings if words in w.reason]


@pytest.mark.parametrize("name", ON_ELEMENTS)
def test_a_panel_close_to_the_ceiling_is_said_by_methods_on_elements(name):
    world = room(0.01)
    (one,) = said(solve(name, world, scattered(world, 20), seed=1, **ON_ELEMENTS[name]), "closer than elements are wide")
    assert one.names == ("Panel",) and "50% of the light" in one.reason and "0.01 m" in one.remedy and "Path Tracing" in one.remedy


@pytest.mark.parametrize(("gap", "edge", "share"), [(0.01, 0.25, 0.5), (0.5, 0.25, 0.0), (0.1, 0.5, 0.5), (0.1, 0.1, 0.0)])
def test_closeness_is_that_of_the_elements_and_not_of_the_scene(gap, edge, share):
    """Half of the panel's light goes up."""
    e = Elements(room(gap), edge)
    flux = np.repeat(e.area, 2) * np.repeat(e.emitted, 2, axis=0).sum(axis=1)
    part, nearest = close_light(e, flux)
    assert part.sum() / flux.sum() == pytest.approx(share, abs=1e-6)
    assert np.isinf(nearest).all() if share == 0 else nearest.min() == pytest.approx(gap, rel=0.6)


def test_each_object_is_told_of_its_own_least_distance():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    for name, x, gap in (("Low", 0.5, 0.01), ("High", 2.5, 0.1)):
        b.quad(name, (x, 0.5, gap), (1, 0, 0), (0, 1, 0), diffuse(name, 0.0, 1.0))
    e = Elements(World(b.build()), 0.5)
    flux = np.repeat(e.area, 2) * np.repeat(e.emitted, 2, axis=0).sum(axis=1)
    part, nearest = close_light(e, flux)
    assert np.isinf(nearest[0]) and nearest[1:] == pytest.approx([0.01, 0.1], rel=0.6)
    assert part[0] == 0 and part[1:] == pytest.approx(part[1], rel=1e-5) and part[1] > 0


LAMPS = {  # at 2 cm from a wall or a ceiling, and the share of its light that begins so at elements of 0.5 m
    "point": (Light("Lamp", "point", (1.0, 1.0, 1.0), position=(0.02, 2, 1.5)), 0.46),
    "spot at a wall": (spot(-1), 1.0),
    "spot into the room": (spot(1), 0.0),
    "area below a ceiling, up": (area(-1), 1.0),
    "area below a ceiling, down": (area(1), 0.0),
    "sun": (Light("Lamp", "sun", (1.0, 1.0, 1.0)), 0.0),
}


@pytest.mark.parametrize("kind", LAMPS)
def test_spots_of_lamps_that_are_smaller_than_elements_are_found(kind):
    """By the closed form, of a point: half of it goes to the wall, of that what is nearer than 0.25 m, 1 - 0.02 / 0.25."""
    lamp, share = LAMPS[kind]
    world = lit(lamp)
    spots = lamp_spots(Elements(world, 0.5), Lamps(world))
    assert spots.close.sum() == pytest.approx(share * spots.total, abs=0.02 * max(spots.total, 1e-9))
    assert not share or 0.02 <= spots.nearest.min() < 0.0225


@pytest.mark.parametrize("name", ON_ELEMENTS)
def test_a_lamp_beside_a_wall_is_said_by_methods_on_elements(name):
    """Also where no point of an element looks into the spot, which is no reason to call the room dark."""
    world = lit(LAMPS["spot at a wall"][0])
    found = solve(name, world, scattered(world, 20), seed=1, **ON_ELEMENTS[name], light_samples=1)
    (one,) = said(found, "closer than elements are wide")
    assert one.names == ("Lamp",) and "0.02 m" in one.remedy and not said(found, "nothing emits")


KERNELS = {
    "elements": ({"max_edge": 0.25}, 0.1, 0.6),  # of 0.18 m: the answer is interpolated between two
    "receivers": ({"score": "receivers", "radius": 0.25}, 0.1, 0.6),
}


def blurred(world, **options):
    """What particle tracing says of light that is close."""
    return said(solve("particle_tracing", world, scattered(world, 20), seed=1, particles=1 << 14, **options), "and is blurred there")


@pytest.mark.parametrize("count", KERNELS)
@pytest.mark.parametrize("light", ["panel", "lamp"])
def test_particle_tracing_says_where_its_kernels_blur_light_that_is_close(count, light):
    """Its stated noise is small there: all that it counts is a mean. What it says to set is silent."""
    options, close, far = KERNELS[count]
    lamp = Light("Lamp", "point", (1.0, 1.0, 1.0), position=(close, 2, 1.5))
    world = room(close) if light == "panel" else lit(lamp)
    (one,) = blurred(world, **options)
    assert one.names == ("Panel" if light == "panel" else "Lamp",) and "Path Tracing" in one.remedy
    name, value = one.remedy.split("(")[1].split(")")[0], float(one.remedy.split(" to ")[1].split(" m")[0])
    assert name in options and 0.25 * close < value <= 0.5 * close and not blurred(world, **(options | {name: value}))
    other = room(far) if light == "panel" else lit(dataclasses.replace(lamp, position=(2.0, 2.0, 1.5)))
    assert not blurred(other, **options)


def test_closeness_is_that_of_light_which_matters():
    """Not of what shines within a bulb, of what passes glass, or of a lamp that gives little of all light, the sun's included."""
    options = {"max_edge": 0.25}

    def scene(lamp=None, sun=0.0, bulb=0.0, lantern=0.0):
        b = SceneBuilder()
        b.box("Room", (0, 0, 0), (4, 4, 3), diffuse("White", 0.7), inward=True)
        middle = np.array([2, 2, 1.5])
        if bulb:
            b.box("Bulb", middle - bulb / 2, middle + bulb / 2, diffuse("Bulb", 0.0, 10.0), inward=False)
        if lantern:
            pane = Material("Pane", (Lobe("glass", Color.of(1), 0.0, 1.5),))
            b.box("Lantern", middle - lantern / 2, middle + lantern / 2, pane, inward=False)
        if lamp:
            b.light(Light("Lamp", "point", (lamp[1],) * 3, position=lamp[0]))
        if sun:
            b.light(Light("Sun", "sun", (sun,) * 3))
        return World(b.build())

    beside = (0.05, 2, 1.5)
    assert not blurred(scene(bulb=0.1), **options)
    assert not blurred(scene(lamp=((2, 2, 1.5), 1.0), lantern=0.2), **options)
    assert blurred(scene(lamp=(beside, 1.0)), **options)
    assert not blurred(scene(lamp=(beside, 0.001), sun=1.0), **options)


@pytest.mark.parametrize("name", ["matrix_radiosity", "particle_tracing"])
def test_no_remedy_asks_for_elements_of_no_size(name):
    """Of a lamp in a wall, or next to nothing off it."""
    for x in (0.0, 1e-5):
        world = lit(Light("Lamp", "point", (1.0, 1.0, 1.0), position=(x, 2, 1.5)))
        options = {"particles": 1 << 14} if name == "particle_tracing" else ON_ELEMENTS[name]
        (one,) = said(solve(name, world, scattered(world, 20), seed=1, **options), "lights surfaces")
        assert "Move it away" in one.remedy and "Set" not in one.remedy


def test_corners_of_rooms_are_not_close():
    for scene in (scenes.cube(0.5, 1.0), scenes.room(), scenes.two_zone_sphere(2)):
        world = World(scene)
        for target in (200, 2000):
            e = Elements(world, 0.0, target)
            flux = np.repeat(e.area, 2)
            assert close_light(e, flux)[0].sum() < 0.02 * flux.sum()


@pytest.mark.parametrize("name", ["local_illumination", "whitted"])
def test_a_background_that_lights_nothing_is_said_once(name):
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("White", 0.7))
    b.background = (0.5, 0.5, 0.2)
    world = World(b.build())
    dark = solve(name, world, scattered(world, 5))
    (one,) = said(dark, "black")
    assert one.object == "World" and "0.4" in one.remedy and not dark.direct.any()
    assert not said(solve(name, world, scattered(world, 5), ambient=0.4), "black")
    assert not said(solve(name, room(0.5), scattered(room(0.5), 5)), "black")


GATHERED = dict.fromkeys(("local_illumination", "whitted", "irradiance_cache"), {}) | dict.fromkeys(
    ("distribution", "path_tracing"), {"samples": 2}
)
GATHERED |= {name: ON_ELEMENTS[name] for name in ("two_pass", "multi_pass")}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("measure", ["irradiance", "radiance"])
@pytest.mark.parametrize("name", GATHERED)
def test_samples_that_are_no_numbers_are_told_by_all_methods_that_gather(name, measure):
    """A lamp whose light overflows close by: nothing that is not a number gets out, and what was left out instead is said; else nothing."""
    for color in (1.0, 1e37):
        b = SceneBuilder()
        b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
        b.light(Light("Lamp", "point", (color,) * 3, (0.5, 0.5, 0.05)))
        b.camera = Camera("orthographic", (0.5, 0.5, 2), (1, 0, 0), (0, 1, 0), (0, 0, -1), (-0.5, 0.5, -0.5, 0.5), 8, 8)
        world = World(b.build())
        receivers = CameraReceivers(world) if measure == "radiance" else quad_points(*grid(8))
        found = solve(name, world, receivers, **GATHERED[name])
        told = [w for w in found.warnings if "were not numbers" in w.reason]
        assert all(np.isfinite(x).all() for x in (found.direct, found.indirect)) and len(told) == (color > 1)
        dark = int((found.direct == 0).all(axis=1).sum())
        assert not told or int(told[0].reason.split()[0]) >= dark > 0


def test_noise_is_said_with_what_it_takes():
    settings = method("path_tracing").Settings(samples=256)
    assert noise.notices(None, settings, "Path Tracing", "irradiance", 1) == ()
    assert noise.notices(0.1, settings, "Path Tracing", "irradiance", 1) == noise.notices(float("inf"), settings, "x", "radiance", 1) == ()
    (one,) = noise.notices(0.2, settings, "Path Tracing", "irradiance", 144)
    assert "about 20%" in one.reason and "4,096 Samples (samples) bring it to 5%" in one.remedy
    assert "144 lights Particle Tracing" in one.remedy
    (one,) = noise.notices(0.2, settings, "Path Tracing", "radiance", 1)
    assert "pixels" in one.reason and "Multi-Pass" in one.remedy
    (one,) = noise.notices(0.4, method("particle_tracing").Settings(particles=1000), "Particle Tracing", "irradiance", 1)
    assert "65,536 Particles (particles)" in one.remedy and "Path Tracing" in one.remedy


def test_a_noisy_result_says_so_once_and_a_clean_one_does_not():
    world = World(scenes.cornell(8, 8))
    path = method("path_tracing")

    def run(samples):
        *_, last = path.solve(world, CameraReceivers(world), path.Settings(samples=samples), np.random.default_rng(1))
        return last.solution()

    noisy = run(32)
    (one,) = said(noisy, "noise of single pixels")
    assert f"about {noisy.history[-1][1]:.0%}" in one.reason and one.severity == "info"
    assert not said(solve("path_tracing", World(scenes.cube(0.5, 1.0)), scattered(World(scenes.cube(0.5, 1.0)), 50)), "noise")


def test_the_stated_error_is_that_of_one_group_fewer():
    """Three groups of the same size: the variance of their mean is their spread over two, divided by three."""
    world = World(scenes.cube())
    run = Run(method("path_tracing").spec, world, scattered(world, 400), method("path_tracing").Settings(), Emitters(world))
    values = np.random.default_rng(3).normal(10, 1, (3, 400))
    for v in values:
        total = np.repeat(v[:, None] / 3, 3, axis=1) * 8
        run.film.add(slice(0, 400), 8, total, 0 * total)
    want = np.sqrt((values.var(axis=0, ddof=1) / 3).mean()) / values.mean()
    assert run.film.relative_error() == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize("name", sorted(set(ON_ELEMENTS) - {"two_pass", "multi_pass"}))
@pytest.mark.parametrize("measure", ["irradiance", "radiance"])
def test_elements_tell_the_noise_of_direct_light_near_a_panel(name, measure):
    """10 cm above the floor, where few light points see it; as much as they are off, or a little more, and none with many of them."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1.4, 0, 0), (0, 1.4, 0), diffuse("Grey", 0.5))
    b.quad("Panel", (0.4, 0.4, 0.1), (0, 0.6, 0), (0.6, 0, 0), diffuse("Panel", 0.0, 10.0))
    if measure == "radiance":
        # From above, onto the floor beside the panel.
        frame = (-0.2, 0.2, -0.2, 0.2)
        b.camera = Camera("orthographic", (0.2, 0.7, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), frame, 24, 24)
    world = World(b.build())
    receivers = quad_points(*grid(24)) if measure == "irradiance" else CameraReceivers(world, grid=1)

    def light(method, **options):
        found = solve(method, world, receivers, **options)
        return (found.direct + found.indirect).sum(axis=1), [n.reason for n in found.warnings if "noise" in n.reason]

    exact, _ = light("path_tracing", samples=1024)
    found, told = light(name, **ON_ELEMENTS[name])
    off = np.sqrt(((found - exact) ** 2).mean()) / exact.mean()
    (reason,) = told
    assert reason.startswith(f"the noise of direct light at single {'texels' if measure == 'irradiance' else 'pixels'} is about ")
    assert 0.9 < int(reason.partition("%")[0].split()[-1]) / 100 / off < 1.5
    assert not light(name, **ON_ELEMENTS[name], light_samples=256)[1]


def test_particles_state_the_error_of_one_batch_fewer():
    values, area = np.random.default_rng(3).normal(10, 1, (3, 50)), np.random.default_rng(4).random(50) + 0.5
    tally = Tally(50, 1)
    for v in values:
        tally.add(Batch(7, np.repeat(v[:, None] / 3, 3, axis=1), np.zeros((50, 3)), area, np.zeros((1, 3)), Ends()))
    mean, variance = values.mean(axis=0), values.var(axis=0, ddof=1) / 3
    assert tally.relative_error() == pytest.approx(np.sqrt((variance / area).sum() / (mean**2 / area).sum()), rel=1e-6)


def test_particles_that_bring_nothing_state_no_error():
    tally = Tally(5, 1)
    for _ in range(3):
        tally.add(Batch(7, np.zeros((5, 3)), np.zeros((5, 3)), np.ones(5), np.zeros((1, 3)), Ends()))
    assert tally.relative_error() == float("inf")


def shut_in(lit):
    """A closed room and a square outside, with lamps where `lit` says: outside, inside, or none."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), diffuse("White", 0.5))
    b.box("Room", (0, 0, 0), (4, 4, 3), diffuse("White", 0.5), inward=True)
    b.quad("Outside", (9, 0, 0), (4, 0, 0), (0, 4, 0), diffuse("White", 0.5))
    if lit is not None:
        b.light(Light("Lamp", "point", (5.0,) * 3, (2.0, 2.0, 2.0) if lit == "inside" else (9.0, 2.0, 4.0)))
    b.camera = Camera("perspective", (2, 2, 2.9), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-0.5, 0.5, -0.5, 0.5), 8, 8)
    return World(b.build())


ALL = ON_ELEMENTS | {
    "particle_tracing": {"particles": 20_000},
    "path_tracing": {"samples": 4},
    "distribution": {"samples": 2},
    "irradiance_cache": {"rays": 32},
    "local_illumination": {},
    "whitted": {},
}


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("measure", ["irradiance", "radiance"])
def test_a_result_without_any_light_says_so_once_where_something_emits(name, measure):
    for lit, count in (("outside", 1), ("inside", 0), (None, 0)):
        world = shut_in(lit)
        receivers = CameraReceivers(world) if measure == "radiance" else quad_points(*(0.1 + 0.8 * x for x in grid(4)))
        solution = solve(name, world, receivers, seed=1, **ALL[name])
        assert (solution.direct + solution.indirect).any() == (lit == "inside")
        told = said(solution, "no light has arrived")
        assert len(told) == count
        if told:
            what = "pixel" if measure == "radiance" else "texel"
            assert f"at any {what}, of 188 W that are emitted" in told[0].reason and told[0].remedy


def test_darkness_that_was_asked_for_is_not_told():
    black, settings = np.zeros((4, 3)), method("path_tracing").Settings
    about = "Path Tracing", "irradiance"
    assert len(noise.darkness((black, black), 1.0, settings(), *about)) == 1
    assert noise.darkness((black, black + 1e-9), 1.0, settings(), *about) == ()
    assert noise.darkness((black, black), 0.0, settings(), *about) == ()
    assert noise.darkness((black, black), 1.0, settings(max_length=0, min_length=0), *about) == ()
    assert noise.darkness((black[:0], black[:0]), 1.0, settings(), *about) == ()


def test_settings_that_have_no_samples_are_told_of_rays():
    settings = dataclasses.replace(method("irradiance_cache").Settings(), rays=64)
    (one,) = noise.notices(0.5, settings, "Irradiance Caching", "irradiance", 1)
    assert one.remedy.startswith("More rays and light samples lower it.")


def test_lights_are_lamps_that_shine_and_objects_that_emit():
    b = SceneBuilder()
    b.box("Screen", (0, 0, 0), (1, 1, 1), diffuse("Screen", 0.0, 1.0), inward=False)
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
    for name, power in (("On", 1.0), ("Off", 0.0)):
        b.light(Light(name, "point", (power,) * 3, (0, 0, 3)))
    assert lights_of(Emitters(World(b.build()))) == 6 + 1  # each side is an object of two triangles


def test_light_of_lamps_that_is_reflected_close_by_is_told():
    """Between two plates of 1 m and 2 cm apart, lit from outside: what they send there is too close for their elements."""
    b = SceneBuilder()
    b.quad("Below", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Above", (0, 0, 0.02), (0, 1, 0), (1, 0, 0), diffuse("Grey", 0.5))
    world = World(b.build())
    elements = Elements(world, 1.0)
    lit = np.zeros((4, 3))
    lit[0] = 1
    (notice,) = light_notices(elements, Emitters(world), lit)
    assert notice.object == "Below" and "surfaces 0.02" in notice.reason  # 2 cm, along rays


def test_random_methods_look_at_lamps_in_another_way_for_every_seed():
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.light(Light("Lamp", "area", (1.0, 1.0, 1.0), (0.5, 0.5, 1.0), size_x=1.0, size_y=1.0))
    world = World(b.build())
    found = []
    for seed in ((), (1,), (2,)):
        light = LampLight(Elements(world, 1.0), Emitters(world), 16, seed=seed)
        assert [*light.run()][-1] == 1
        found.append(light.irradiance[0, 0])
    assert len(set(found)) == 3 and found == pytest.approx([np.mean(found)] * 3, rel=0.2)
