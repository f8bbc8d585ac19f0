"""Fluxes by both equations against closed forms, and the statistics that say when methods disagree."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from adjgi.adjoint_gi.core.comparison import page
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.agreement import (
    ALPHA,
    LOUD,
    Groups,
    Measured,
    ShotFlux,
    agreement,
    allowance_of,
    groups_of,
    shoot,
    two_sided,
)
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import methods
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load
from adjgi.tests import scenes

load()
OBJECTS = 5


def groups(n=OBJECTS):
    return Groups(tuple(f"Object {i}" for i in range(n)), np.arange(n), np.ones(n), np.arange(n))


def measured(name, value, error=0.0, freedom=0, allowance=0.0, **more):
    value = np.broadcast_to(np.asarray(value, float), OBJECTS)
    return Measured(name, name.title(), value, np.full(OBJECTS, float(error)), freedom, allowance, **more)


def shot_by(world, found, low, high, both=True):
    """Flux by Eq. 4 of 16 batches."""
    return next(s for s in shoot(world, found, both, low, high, seed=1) if s is not None and s.batches >= 16)


TABLE = [(2.776, 4, 0.05), (4.604, 4, 0.01), (3.182, 3, 0.05), (2.042, 30, 0.05), (1.96, math.inf, 0.05), (0, 5, 1.0), (10, 3.0, 0.002128)]


@pytest.mark.parametrize(("t", "freedom", "p"), TABLE)
def test_students_t_of_printed_tables(t, freedom, p):
    assert two_sided(t, freedom) == pytest.approx(p, rel=2e-3)


@pytest.mark.parametrize("t", [0.1, 1.0, 10.0, 1e4, 1e8])
def test_students_t_in_closed_forms(t):
    assert two_sided(t, 1) == pytest.approx(2 / math.pi * math.atan(1 / t), rel=1e-9)
    assert two_sided(t, 2) == pytest.approx(2 / (math.sqrt(2 + t * t) * (math.sqrt(2 + t * t) + t)), rel=1e-9)
    assert two_sided(t, 2) < two_sided(t, 1.5) < two_sided(t, 1)


def test_weights_of_elements_and_points_are_areas():
    world = World(scenes.room())
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=1.0)))
    areas = {name: 2 * a for name, a in zip(found.names, (12, 12, 12, 12, 16, 16), strict=True)}
    for i, name in enumerate(found.names):
        assert found.weight[found.owner == i].sum() == pytest.approx(areas[name])
    assert found.flux(np.ones((len(found.owner), 3))).tolist() == pytest.approx([3 * a for a in areas.values()])


def test_points_weigh_a_linear_irradiance_as_particles_do():
    """Coarse texels: points off the middle, some receivers across an edge of the cube. For an irradiance linear on each triangle both
    equations then agree exactly, though with g = 1 they would be far apart."""
    world = World(scenes.cube())
    rng = np.random.default_rng(3)
    start = np.array([0, 3, 5, 9, 12, 16, 20, 24])
    triangle = np.concatenate([[0, 0, 1], [0, 1], rng.integers(0, 12, 19)])
    u = 0.6 * rng.random(24)
    v = (1 - u) * 0.5 * rng.random(24)
    found = groups_of(world, SurfaceReceivers("texels", start, triangle, u, v))
    c = rng.random((12, 3)) + 0.2

    def irradiance(t, u, v):
        return c[t, 0] + c[t, 1] * u + c[t, 2] * v

    mean = np.add.reduceat(irradiance(triangle, u.astype(np.float32), v.astype(np.float32)), start[:-1]) / np.diff(start)
    gathered = found.flux(np.repeat(mean[:, None], 3, axis=1)).sum()
    # Quadrature of degree 2: exact for products of linear functions.
    sites = np.array([(1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)])
    shot, plain = 0.0, 0.0
    for t in np.flatnonzero(found.triangle >= 0):
        for a, b in sites:
            at = SimpleNamespace(triangle=np.array([t]), u=np.array([a]), v=np.array([b]))
            shot += world.area[t] * irradiance(t, a, b) * found.source(at)[0]
            plain += world.area[t] * irradiance(t, a, b)
    assert gathered == pytest.approx(shot, rel=1e-5)
    assert abs(gathered / plain - 1) > 0.02
    assert found.points.sum() == 24 and (found.g[found.triangle < 0] == 0).all() and groups().source(None) == 1.0


def test_triangles_without_a_point_are_in_no_group():
    world = World(scenes.cube())
    one = SurfaceReceivers("texels", np.array([0, 2]), np.array([0, 0]), np.array([0.2, 0.3]), np.array([0.2, 0.3]))
    found = groups_of(world, one)
    assert (found.triangle >= 0).sum() == 1 and found.triangle[0] == 0
    assert found.weight.tolist() == pytest.approx([world.area[0]])


def test_flux_by_particles_is_that_of_the_closed_form():
    """T1: a cube whose walls all emit M and reflect rho has irradiance M / (1 - rho) everywhere."""
    rho, emitted = 0.5, 1.0
    world = World(scenes.cube(rho, emitted))
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=0.5)))
    for shot in shoot(world, found, True, 0, 64, seed=1):
        if shot is not None and shot.batches >= 16:
            break
    expected = 3 * emitted / (1 - rho)
    total = shot.value.sum()
    # Meshes emit from both sides; the outer sides see nothing.
    assert total == pytest.approx(6 * expected, abs=5 * shot.error.sum())
    assert shot.error.sum() < 0.01 * total
    assert shot.rays > 16 << 14
    # Without direct light what is left is rho times as much.
    later = shot_by(world, found, 2, 64)
    assert later.value.sum() == pytest.approx(6 * rho * expected, abs=5 * later.error.sum())
    assert not shot_by(world, found, 2, 1).value.any()


def test_the_error_of_batches_is_that_of_their_mean():
    """The sum of the squares of all batches, that values and errors tell, grows by the square of each."""
    world = World(scenes.cube(0.5, 1.0))
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=1.0)))
    shots = [s for s, _ in zip(shoot(world, found, True, 0, 1, seed=1), range(5), strict=False) if s is not None]
    k = np.array([s.batches for s in shots])[:, None]
    value, error = (np.array([getattr(s, name) for s in shots]) for name in ("value", "error"))
    assert k[:, 0].tolist() == [2, 3, 4, 5] and error.min() > 0
    squares = error**2 * k * (k - 1) + value**2 * k
    assert np.diff(squares, axis=0) == pytest.approx(np.diff(k * value, axis=0) ** 2, rel=1e-6)


@pytest.mark.parametrize("below", [False, True])
def test_light_from_behind_counts_for_elements_alone(below):
    """Elements answer for both sides, texels and vertices for the front."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), position=(0.5, 0.5, -1.0 if below else 1.0)))
    world = World(b.build())
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=1.0)))
    front, both = (shot_by(world, found, 0, 1, both).value.sum() for both in (False, True))
    assert both > 0 and front == (0 if below else both)


def test_the_page_holds_the_flux_of_particles_and_its_error():
    about = SimpleNamespace(agrees=True, lines=(), groups=groups(2), methods=(), differences=(), shot=ShotFlux(*np.eye(2), 4, 9))
    assert page._agreement_json(about)["shot"] == {"value": [1.0, 0.0], "error": [0.0, 1.0]}


def test_nothing_is_shot_in_the_dark():
    world = World(scenes.cube(0.5, 0.0))
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=1.0)))
    shot = next(shoot(world, found, True, 0, 8, seed=1))
    assert not shot.value.any() and not shot.error.any()


def test_pixels_belong_to_what_they_show():
    world = World(scenes.cornell())
    if world.scene.camera is None:
        pytest.fail("the Cornell box has lost its camera")
    found = groups_of(world, CameraReceivers(world, grid=1))
    assert len(found.names) > 3 and (found.owner >= 0).any()
    assert found.weight.sum() == pytest.approx(1.0)
    assert (found.triangle == -1).all()


def test_methods_that_agree_seldom_cry_wolf():
    """5 random methods of 4 runs each at 5 objects: in 400 worlds the alarm rings in a share of ALPHA, or less."""
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(400):
        runs = 1 + 0.02 * rng.standard_normal((5, 4, OBJECTS))
        all_ = [Measured(f"m{k}", f"M{k}", r.mean(axis=0), r.std(axis=0, ddof=1) / 2, 3, 0.0) for k, r in enumerate(runs)]
        alarms += not agreement(groups(), all_, None).agrees
    assert alarms <= 400 * ALPHA + 3 * math.sqrt(400 * ALPHA)


def test_a_planted_error_is_said_loudly():
    found = agreement(groups(), [measured("right", 1.0, 0.002, 7), measured("wrong", 1.05, 0.002, 7)], None)
    assert not found.agrees
    assert found.lines[0].startswith("DISAGREE: Right and Wrong differ by 4.88 % on Object")


def test_an_error_at_one_object_alone_is_found_there():
    value = np.ones(OBJECTS)
    value[3] = 1.2
    found = agreement(groups(), [measured("right", 1.0, 0.002, 7), measured("wrong", value, 0.002, 7)], None)
    assert found.differences[0].object == "Object 3" and found.differences[0].significant


def test_deterministic_methods_disagree_only_beyond_their_allowances():
    near = agreement(groups(), [measured("a", 1.0, allowance=0.03), measured("b", 1.05, allowance=0.03)], None)
    far = agreement(groups(), [measured("a", 1.0, allowance=0.03), measured("b", 1.10, allowance=0.03)], None)
    exact = agreement(groups(), [measured("a", 1.0), measured("b", 1.001)], None)
    assert near.agrees and near.lines[0].startswith("Agree: 1 of 1")
    assert not far.agrees and not exact.agrees


def test_what_a_method_states_is_no_disagreement_but_is_said():
    less = measured("less", 0.5, leaves_out="interreflection")
    lobes = measured("lobes", 0.7, notes=("Material Mirror glossy taken as diffuse",))
    found = agreement(groups(), [measured("full", 1.0), less, lobes], None)
    assert found.agrees
    stated = [line for line in found.lines if line.startswith("Differs as stated")]
    assert any("Less leaves out interreflection: 66.7 % from Full" in line for line in stated)
    assert any("Lobes replaces lobes (Material Mirror" in line for line in stated)


def test_both_equations_are_compared_too():
    shot = ShotFlux(np.ones(OBJECTS), np.full(OBJECTS, 0.001), 32, 1)
    found = agreement(groups(), [measured("fine", 1.005), measured("bad", 1.2)], shot)
    np.testing.assert_allclose(found.gaps, [[0.005] * OBJECTS, [0.2] * OBJECTS], atol=1e-12)
    assert any(line.startswith("DISAGREE: Bad and Eq. 4 differ") for line in found.lines)
    assert not any("Fine and Eq. 4" in line for line in found.lines)


def test_few_points_allow_for_the_edges_of_shadows():
    shot = ShotFlux(np.ones(OBJECTS), np.full(OBJECTS, 0.0001), 32, 1)
    for points, agrees in ((134, True), (20_000, False)):
        few = replace(groups(), points=np.full(OBJECTS, points))
        assert agreement(few, [measured("texels", 1.03)], shot).agrees == agrees


def test_other_path_lengths_are_not_compared():
    shot = ShotFlux(np.ones(OBJECTS), np.full(OBJECTS, 0.001), 32, 1)
    sides = [measured("all", 1.0), measured("also", 1.0), measured("later", 0.2, lengths=(2, 1024))]
    found = agreement(groups(), sides, shot)
    assert found.agrees and {d.first for d in found.differences} | {d.second for d in found.differences} == {"All", "Also", "Eq. 4"}
    assert np.isnan(found.gaps[2]).all() and np.isfinite(found.gaps[:2]).all()
    assert found.lines[-1].startswith("Not compared: path lengths 0 and more (All, Also, Eq. 4) with path lengths 2 and more (Later)")
    assert not agreement(groups(), sides, shot, (2, 1024)).agrees  # then Later stands against Eq. 4


@pytest.mark.filterwarnings("error")
def test_two_methods_that_find_nothing_at_an_object_agree_there():
    dark = np.array([1.0, 1.0, 0.0, 1.0, 1.0])
    for values in (dark, np.zeros(OBJECTS)):
        found = agreement(groups(), [measured("a", values), measured("b", values)], None)
        assert found.agrees and [(d.t, d.p) for d in found.differences] == [(0.0, 1.0)]


def test_few_repeats_that_hide_a_large_difference_are_said():
    """With one degree of freedom hardly anything is significant: that is no agreement."""
    far, near = measured("far", 0.4, 0.03, 1), measured("near", 0.99, 0.03, 1)
    found = agreement(groups(), [measured("exact", 1.0), near, far], None)
    assert found.agrees and not any(d.significant for d in found.differences)
    assert found.lines[0].startswith("Agree: 1 of 3 pairs") and "2 cannot be told" in found.lines[0]
    assert found.lines[1].startswith("Too few repeats to tell: Exact and Far differ by 85.7 % on Object")
    assert "(Near and Far with 2 repeats)" in found.lines[1] and found.lines[1].startswith(LOUD)
    enough = agreement(groups(), [measured("exact", 1.0), measured("far", 0.4, 0.01, 3)], None)
    assert enough.differences[0].unknown == "" and not enough.agrees


def test_a_leak_into_a_dark_object_is_no_disagreement():
    a, b = np.ones(OBJECTS), np.ones(OBJECTS)
    a[0], b[0] = 0.0, 0.0003
    assert agreement(groups(), [measured("a", a, allowance=0.03), measured("b", b, allowance=0.03)], None).agrees


def test_every_method_on_elements_has_an_allowance():
    for m in methods():
        assert (allowance_of(m.spec) > 0) >= m.spec.uses_elements
        assert 0 <= allowance_of(m.spec) <= 0.05
