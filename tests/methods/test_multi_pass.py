"""The progressive multi-pass method: both passes, how one goes over into the other, and what it comes to."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SceneError
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.bsdf import table as bsdf
from adjgi.adjoint_gi.core.elements.answer import Parts
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method import clock
from adjgi.adjoint_gi.core.method.registry import Nature, Strategy, method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import radiance
from adjgi.adjoint_gi.core.walks.gathering import Run
from adjgi.solvers.multi_pass import MultiPassRun
from adjgi.tests import scenes, solving

steps = partial(solving.steps, "multi_pass")
solve = partial(solving.solve, "multi_pass")


def cavity():
    """T8: mirrors that are diffuse as well; everything emits what it does not reflect."""
    mixed = Material(
        "Mixed",
        (Lobe("diffuse", Color.of(0.3, 0.3, 0.3)), Lobe("glossy", Color.of(0.5, 0.5, 0.5), 0.0), Lobe("emission", Color.of(0.2, 0.2, 0.2))),
    )
    return scenes.cube(materials=[mixed, mixed, *[diffuse("Wall", 0.6, 0.4)] * 4])


def shiny_box(width=16):
    """A closed room with a mirror, a coated and a plain wall, lit by a lamp that hangs free."""
    mirror = Material("Mirror", (Lobe("glossy", Color.of(0.9, 0.9, 0.9), 0.0),))
    coated = Material("Coated", (Lobe("diffuse", Color.of(0.5, 0.3, 0.2)), Lobe("specular", Color.of(1, 1, 1), 0.4, 1.5)))
    grey = diffuse("Grey", 0.5)
    b = SceneBuilder()
    b.box("Room", (0, -2, 0), (1, 1, 1), [mirror, grey, grey, grey, coated, grey], inward=True)
    b.quad("Lamp", (0.3, 0.1, 0.75), (0, 0.4, 0), (0.4, 0, 0), diffuse("Lamp", 0.0, 5.0))
    b.camera = dataclasses.replace(scenes.cornell(width, width).camera)
    return b.build()


def test_its_place_in_the_taxonomy():
    spec = method("multi_pass").spec
    assert set(spec.strategies) == set(Strategy) and set(spec.natures) == set(Nature)


def test_one_furnace():
    receivers = ElementReceivers(Elements(World(scenes.cube(0.5, 1.0)), 0.5))
    s = solve(receivers, rays=50_000, samples=256, tolerance=1e-5)
    assert np.allclose(s.quantity("radiosity")[0::2].mean(axis=0), 2.0, rtol=0.005)
    for longest, want in enumerate((1, 1.5, 1.75, 1.875)):
        s = solve(receivers, rays=50_000, samples=256, max_length=longest)
        assert np.allclose(s.quantity("radiosity")[0::2].mean(axis=0), want, rtol=0.005)


@pytest.mark.parametrize("hops", [1, 3])
def test_eight_kirchhoff_cavity_with_mirrors(hops):
    receivers = ElementReceivers(Elements(World(cavity()), 0.5))
    s = solve(receivers, rays=400_000, samples=1024, depth=64, hops=hops, tolerance=1e-5)
    h = s.quantity("irradiance")[0::2] / np.pi
    assert h.mean() == pytest.approx(1.0, abs=0.006)
    assert np.abs(h - 1).max() < 0.08


def test_flux_is_conserved_over_mirrors_at_every_step():
    world = World(shiny_box(4))
    last = None
    for step in steps(CameraReceivers(world), max_edge=0.25, rays=100_000, samples=2):
        s = step.solution()
        if s.balance is not None and s.balance.emitted:
            assert s.balance.gap < 1e-9
            last = s.balance
    # The room is closed: only the grazing rays at edges and the backs of the walls see the outside.
    assert last.unshot < 2e-3 * last.emitted
    assert last.escaped < 1e-3 * last.emitted


@pytest.mark.parametrize("lobes", [[("transparent", 0.9)], [("transparent", 0.5), ("diffuse", 0.2)], [("glass", 1.0)], [("glossy", 0.9)]])
def test_light_of_a_lamp_that_goes_on_is_counted_once(lobes):
    """A lamp of 3 x 5 pi x 0.04 W in a closed room, with a sheet below it."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Grey", 0.8), inward=True)
    sheet = Material("Sheet", tuple(Lobe(name, Color.of(x, x, x), 0.0, 1.5) for name, x in lobes))
    b.quad("Sheet", (0.1, 0.1, 0.5), (0.8, 0, 0), (0, 0.8, 0), sheet)
    b.light(Light("Lamp", "area", (5.0, 5.0, 5.0), position=(0.5, 0.5, 0.8), axis_z=(0, 0, 1), axis_x=(1, 0, 0), size_x=0.2, size_y=0.2))
    world = World(b.build())
    found = solve(ElementReceivers(Elements(world, 0.5)), max_edge=0.25, samples=1).balance
    assert found.emitted == pytest.approx(3 * 5 * np.pi * 0.04, rel=0.06) and found.gap < 1e-9
    assert found.escaped < 1e-3 * found.emitted


def test_a_picture_at_once_that_goes_over_into_the_second(monkeypatch):
    # A step after every batch, so that the steps do not depend on the speed of the machine.
    monkeypatch.setattr(clock, "PAUSE", 0.0)
    world = World(shiny_box())
    receivers = CameraReceivers(world)
    fraction, pictures = 0.0, []
    for step in steps(receivers, rays=100_000, samples=512, max_edge=0.2):
        assert step.fraction >= fraction
        fraction = step.fraction
        pictures.append((fraction, step.solution()))
    final = pictures[-1][1]
    assert fraction == 1.0 and not final.partial
    # Well before the second pass begins every pixel has light.
    first = next(s for f, s in pictures if f > 0.1)
    assert first.partial and (first.quantity("radiance").sum(axis=1) > 0).mean() > 0.99
    error = [(f, np.abs(s.quantity("radiance") - final.quantity("radiance")).mean()) for f, s in pictures]
    before = [e for f, e in error if 0.2 < f < 0.3]
    middle = [e for f, e in error if 0.3 < f < 0.6]
    late = [e for f, e in error if 0.9 < f < 1.0]
    assert max(late) < min(middle) and max(late) < 0.3 * np.mean(before)


def test_it_comes_to_what_path_tracing_finds():
    world = World(shiny_box(12))
    receivers = CameraReceivers(world)
    walk = radiance.Walk(world, Emitters(world), bsdf.BsdfTable(world.scene))
    rng = np.random.default_rng(3)
    sums = []
    for _ in range(24):
        points = receivers.sample(np.repeat(np.arange(144), 16), rng)
        surface = world.surface(points.triangle, points.u, points.v, points.towards)
        found = radiance.gather(walk, surface, radiance.lobes_of(walk, surface, points.towards), rng)
        sums.append((found.direct + found.indirect).reshape(144, 16, 3).mean(axis=1))
    truth, spread = np.mean(sums, axis=0), np.std(sums, axis=0) / np.sqrt(24)
    s = solve(receivers, max_edge=0.06, rays=1_000_000, samples=256, depth=32)
    got = s.direct + s.indirect
    assert got.mean() == pytest.approx(truth.mean(), rel=0.015)
    # Pixel by pixel within both methods' noise, root mean square.
    assert np.sqrt(((got - truth) ** 2).mean()) < 3 * np.sqrt((spread**2).mean()) + 0.01 * truth.mean()


def test_caustics_of_a_lamp_without_size_come_from_particles():
    receivers = ElementReceivers(Elements(World(scenes.lamp_over_mirror(color=(1.0, 1.0, 1.0))), 50.0))
    ratio = []
    for particles in (2_000_000, 0):
        s = solve(receivers, particles=particles, samples=16, rays=1000)
        # The ceiling's front; the mirror shows the lamp at three times the distance.
        ratio.append(s.indirect[2, 0] / s.direct[2, 0])
    assert ratio[0] == pytest.approx(1 / 9, rel=0.1)
    assert ratio[1] < 1e-3


def under_panes(*panes, **sun):
    """A black floor below a sun and flat panes of (roughness, index), given from above."""
    b = SceneBuilder()
    b.quad("Floor", (-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), diffuse("Black", 0.0))
    for i, (roughness, ior) in enumerate(panes):
        clear = Material(f"Pane {i}", (Lobe("refraction", Color.of(0.8, 0.8, 0.8), roughness, ior),))
        b.quad(f"Pane {i}", (-4, -4, 0.5 - 0.1 * i), (8, 0, 0), (0, 8, 0), clear)
    b.light(Light("Sun", "sun", (1.0, 1.0, 1.0), **sun))
    return ElementReceivers(Elements(World(b.build()), 50.0))


@pytest.mark.parametrize("angle", [0.0, 0.00918, 1.2], ids=["parallel", "default", "wide"])
def test_the_finished_result_has_the_light_of_a_sun_through_a_pane(angle):
    s = solve(under_panes((0.0, 1.0), angle=angle), particles=100_000, samples=4, rays=1000)
    assert s.indirect[0, 0] == pytest.approx(0.8, rel=0.02) and s.direct[0, 0] < 1e-6


@pytest.mark.parametrize("angle", [0.0, 0.00918], ids=["parallel", "default"])
def test_light_through_a_clear_pane_and_a_rough_one_is_found_once(angle):
    """No light point sees through the clear pane, which lies above; by particles it is whole."""
    receivers = under_panes((0.0, 1.0), (0.4, 1.2), angle=angle)
    s = solve(receivers, particles=100_000, samples=64, rays=1000)
    expected = solving.solve("particle_tracing", receivers, particles=100_000).indirect[0, 0]
    assert expected > 0.5 and s.indirect[0, 0] == pytest.approx(expected, rel=0.03)


def test_light_over_a_rough_mirror_is_found_by_the_second_pass_alone():
    """Light points see the lamp from there; what particles bring to the elements serves later surfaces only."""
    b = SceneBuilder()
    b.quad("Mirror", (-4, -4, 0), (8, 0, 0), (0, 8, 0), Material("Rough", (Lobe("glossy", Color.of(1, 1, 1), 0.6),)))
    b.quad("Ceiling", (-0.1, -0.1, 2), (0, 0.2, 0), (0.2, 0, 0), diffuse("Black", 0.0))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0, 0, 1)))
    receivers = ElementReceivers(Elements(World(b.build()), 50.0))
    s = solve(receivers, particles=20_000, samples=1024, rays=1000)
    expected = solving.solve("path_tracing", receivers, samples=1024).indirect[2, 0]
    assert expected > 0 and s.indirect[2, 0] == pytest.approx(expected, rel=0.1)


def test_partial_results_count_caustics_as_indirect(monkeypatch):
    monkeypatch.setattr(clock, "PAUSE", 0.0)
    b = SceneBuilder()
    b.quad("Mirror", (-3, -3, 0), (6, 0, 0), (0, 6, 0), Material("Mirror", (Lobe("glossy", Color.of(1, 1, 1), 0.0),)))
    b.quad("Ceiling", (-0.5, -0.5, 2), (0, 1, 0), (1, 0, 0), diffuse("Ceiling", 0.5))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0, 0, 1)))
    receivers = ElementReceivers(Elements(World(b.build()), 50.0))
    run = steps(receivers, particles=20_000, samples=1, rays=1000, direct_light="elements")
    *_, last = (step.solution() for step in run if step.fraction < 0.3)
    # The mirror shows the lamp at about three times the distance.
    assert last.indirect[2, 0] == pytest.approx(last.direct[2, 0] / 9, rel=0.4)


@pytest.mark.parametrize("name", ["multi_pass", "two_pass"])
def test_caustics_count_by_their_length(name):
    """Light from the lamp over the mirror to the ceiling has flown two segments."""
    receivers = ElementReceivers(Elements(World(scenes.lamp_over_mirror(color=(1.0, 1.0, 1.0))), 50.0))
    more = {"gather": True} if name == "two_pass" else {}
    solver = method(name)
    found = {}
    for low, high in ((1, 1), (2, 2), (3, 3), (2, NO_LIMIT), (3, NO_LIMIT)):
        settings = solver.Settings(min_length=low, max_length=high, particles=200_000, samples=16, rays=16 if more else 1000, **more)
        *_, last = solver.solve(receivers.elements.world, receivers, settings, np.random.default_rng(0))
        found[low, high] = float(last.solution().indirect[2, 0])
    expected = found[2, 2]
    assert expected > 0
    assert found[2, NO_LIMIT] == pytest.approx(expected, rel=1e-5)
    for bounds in ((1, 1), (3, 3), (3, NO_LIMIT)):
        assert abs(found[bounds]) < 1e-3 * expected, bounds


def test_light_that_is_caught_is_refused_by_name():
    mats = [diffuse("Snow", 1.0)] * 5 + [diffuse("Lamp", 1.0, 1.0)]
    with pytest.raises(SceneError, match="(Snow|Lamp): reflects all light"):
        solve(ElementReceivers(Elements(World(scenes.cube(materials=mats)), 0.5)), rays=20_000)


def test_dark_and_empty_scenes():
    s = solve(ElementReceivers(Elements(World(scenes.cube()), 1.0)), samples=2)
    assert not s.quantity("radiosity").any()
    assert any("nothing emits light" in str(w) for w in s.warnings)
    assert solve(ElementReceivers(Elements(World(SceneBuilder().build()), 1.0)), samples=2).direct.shape == (0, 3)


def test_partial_results_pass_from_the_first_answer_to_the_second():
    """The first answer is worth four samples at the start, and none when all of the second pass have come in."""
    world, settings = World(scenes.cube()), method("multi_pass").Settings(samples=8)
    receivers = ElementReceivers(Elements(world, 50.0))
    run = Run(method("multi_pass").spec, world, receivers, settings, emitters := Emitters(world))
    passes = MultiPassRun(run, receivers.elements, emitters)
    one, zero = np.ones((receivers.count, 3), np.float32), np.zeros((receivers.count, 3), np.float32)
    passes.parts = Parts(one, one, one, one, one[:, 0])
    second = dataclasses.replace(run.solution(), emitted=zero, direct=zero, indirect=zero, partial=True)
    shares = []
    for count in (0, 2, 4, 8):
        run.film.count[:] = count
        shares.append(float(passes.joined(second).direct[0, 0]))
    assert shares == pytest.approx([1, 3 / 5, 2 / 6, 0])
