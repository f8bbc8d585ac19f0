"""Subdivision driven by the potential never worsens the receivers' light and spends fewer elements (verification page, section 2.7)."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.errors import SettingsError
from adjgi.adjoint_gi.core.elements.elements import Elements
from adjgi.adjoint_gi.core.flux import detectors
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.radiosity import importance as adaptive
from adjgi.adjoint_gi.core.radiosity.lamp_light import LampLight
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests import scenes, solving
from adjgi.tests.solving import grid, quad_points

solve = partial(solving.solve, "progressive_radiosity", max_edge=0.75, direct_light="elements", rays=400_000)


def two_rooms():
    """Two closed rooms, each with a small block under a lamp that throws a sharp shadow; no light passes between them."""
    b = SceneBuilder()
    for k, name in ((0.0, "Near"), (5.0, "Far")):
        b.box(f"{name} room", (k, 0, 0), (k + 3, 3, 2), diffuse(f"{name} wall", 0.6), inward=True)
        b.box(f"{name} block", (k + 1.2, 1.2, 0.6), (k + 1.8, 1.8, 0.7), diffuse(f"{name} block", 0.5), inward=False)
        b.light(Light(f"{name} lamp", "point", (5.0, 5.0, 5.0), (k + 1.5, 1.5, 1.6)))
    return World(b.build())


def elements_used(world, important=""):
    """Elements after subdivision."""
    base = Elements(world, 0.75)
    weight = adaptive.importance(base, detectors.detector(world, "objects", important)) if important else None
    emitters = Emitters(world)
    look = LampLight(base, emitters, 16)
    for _ in look.run():
        pass
    division = adaptive.Subdivision(base, emitters, 16, 0.25, 0.1, weight)
    for _ in division.run(look.irradiance):
        pass
    return division.elements.count


def named(world, elements, part):
    """(count,) bool: elements of objects with `part` in their names."""
    n = elements.count
    triangle = elements.point(np.arange(n), np.full(n, 0.3), np.full(n, 0.3))[0]
    names = np.array([part in o.name for o in world.scene.objects])
    return names[world.scene.object[triangle]]


def test_importance_is_high_where_the_receivers_light_comes_from():
    world = two_rooms()
    elements = Elements(world, 0.75)
    weight = adaptive.importance(elements, detectors.detector(world, "objects", "Near room -z"))
    assert weight[named(world, elements, "Near room")].min() > 0.2
    assert (weight[named(world, elements, "Near room -z")] == 1).all()
    assert not weight[named(world, elements, "Far")].any()


def test_refinement_by_the_potential_never_worsens_the_receivers_light():
    world = two_rooms()
    receivers = quad_points(*grid(24), first=next(o.first_triangle for o in world.scene.objects if o.name == "Near room -z"))
    tracer = method("path_tracing")
    *_, last = tracer.solve(world, receivers, tracer.Settings(samples=512), np.random.default_rng(3))
    truth = last.solution().quantity("irradiance").astype(float)

    def error(**options):
        got = solve(world, receivers, **options).quantity("irradiance").astype(float)
        return np.sqrt(((got - truth) ** 2).mean()) / truth.mean(), abs(got.mean() / truth.mean() - 1)

    plain, plain_mean = error()
    driven, driven_mean = error(adaptive=True, min_edge=0.1, important="Near room -z")
    everywhere, _ = error(adaptive=True, min_edge=0.1)
    # <g, B> is no worse than without, point by point it is better, and as good as cutting everywhere.
    # Cutting keeps the flux of every element, so the mean moves by what interpolation between smaller ones changes.
    assert driven_mean <= plain_mean + 0.005
    assert driven < 0.8 * plain
    assert driven < 1.1 * everywhere
    # The other room, which does not matter, is not cut.
    assert elements_used(world, "Near room -z") < 0.65 * elements_used(world)


def test_unknown_name_is_refused():
    world = World(scenes.cornell(8, 8))
    with pytest.raises(SettingsError, match="Nobody"):
        solve(world, CameraReceivers(world), adaptive=True, important="Nobody")


def test_there_are_at_most_so_many_times_the_elements():
    """Where all of a floor would be cut again and again, and nothing of what lies in its shadow."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Below", (0.2, 0.2, -0.01), (0.6, 0, 0), (0, 0.6, 0), diffuse("Grey", 0.5))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.3, 0.4, 0.2)))
    world = World(b.build())
    base, emitters = Elements(world, 0.34), Emitters(world)
    light = LampLight(base, emitters, 1)
    for _ in light.run():
        pass
    cut = adaptive.Subdivision(base, emitters, 1, 1e-9, 1e-4)
    for _ in cut.run(light.irradiance):
        pass
    assert cut.full and 0.9 * adaptive.GROWTH * base.count < cut.elements.count <= adaptive.GROWTH * base.count


def test_importance_is_a_share_of_the_mean_by_area():
    """A large part of the scene that sees nothing of the receiver lowers the mean, and with it what counts in full."""
    b = SceneBuilder()
    b.quad("Lit", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    b.quad("Receiver", (0, 1, 0), (1, 0, 0), (0, 0, 1), diffuse("Grey", 0.5))
    b.quad("Away", (50, 0, 0), (4, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    world = World(b.build())
    elements = Elements(world, 5.0)
    weight = adaptive.importance(elements, detectors.detector(world, "objects", "Receiver"))
    # Potential 1 + (rho F)^2 of the receiver, and rho F of the square at right angles to it; areas are 1, 1 and 4.
    factor = 0.5 * 0.2
    assert weight == pytest.approx([factor / ((1 + factor**2 + factor) / 6), 1, 0], rel=0.15)


def test_where_not_all_may_be_cut_those_of_the_highest_contrast_are(monkeypatch):
    monkeypatch.setattr(adaptive, "GROWTH", 2)
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    world = World(b.build())
    base = Elements(world, 0.125)
    light = np.repeat((1 + base.centroid[:, :1] - base.centroid[:, :1].min()) ** 3 * np.ones(3), 2, axis=0)
    division = adaptive.Subdivision(base, Emitters(world), 16, 1e-3, 0.0)
    split, change = division._choose(light), adaptive.contrast(base, light)
    assert division.full and split.sum() == base.count // 3
    assert change[split].min() >= change[~split].max() and change[split].max() > change[~split].max()


def test_an_element_matters_as_much_as_the_side_that_matters_more(monkeypatch):
    b = SceneBuilder()
    for x in (0, 2):
        b.quad(f"Quad {x}", (x, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    alone = SimpleNamespace(on_elements=lambda _: np.array([1.0, 0.0, 1.0, 1.0])[:, None] * np.ones(3))
    monkeypatch.setattr(adaptive.RayTransport, "cast", lambda *_: SimpleNamespace(adjoint=np.zeros_like))
    np.testing.assert_allclose(adaptive.importance(Elements(World(b.build()), 1.0), alone), 1.0)
