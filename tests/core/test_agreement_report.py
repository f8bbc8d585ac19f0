"""Fluxes by both equations against closed forms, and the statistics that say when methods disagree."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.agreement import (
    ALPHA,
    Groups,
    Measured,
    ShotFlux,
    agreement,
    allowance_of,
    groups_of,
    shoot,
    two_sided,
)
from adjgi.adjoint_gi.core.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.receivers import CameraReceivers, SurfaceReceivers
from adjgi.adjoint_gi.core.registry import methods
from adjgi.adjoint_gi.core.world import World
from adjgi.solvers import load
from adjgi.tests import scenes

load()
OBJECTS = 5


def groups(n=OBJECTS):
    return Groups(tuple(f"Object {i}" for i in range(n)), np.arange(n), np.ones(n), np.arange(n))


def measured(name, value, error=0.0, freedom=0, allowance=0.0, **more):
    value = np.broadcast_to(np.asarray(value, float), OBJECTS)
    return Measured(name, name.title(), value, np.full(OBJECTS, float(error)), freedom, allowance, **more)


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
    for shot in shoot(world, found, True, 64, seed=1):
        if shot is not None and shot.batches >= 16:
            break
    expected = 3 * emitted / (1 - rho)
    total = shot.value.sum()
    # Meshes emit from both sides; the outer sides see nothing.
    assert total == pytest.approx(6 * expected, abs=5 * shot.error.sum())
    assert shot.error.sum() < 0.01 * total
    assert shot.rays > 16 << 14


def test_nothing_is_shot_in_the_dark():
    world = World(scenes.cube(0.5, 0.0))
    found = groups_of(world, ElementReceivers(Elements(world, max_edge=1.0)))
    shot = next(shoot(world, found, True, 8, seed=1))
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


def test_a_leak_into_a_dark_object_is_no_disagreement():
    a, b = np.ones(OBJECTS), np.ones(OBJECTS)
    a[0], b[0] = 0.0, 0.0003
    assert agreement(groups(), [measured("a", a, allowance=0.03), measured("b", b, allowance=0.03)], None).agrees


def test_every_method_on_elements_has_an_allowance():
    for m in methods():
        assert (allowance_of(m.spec) > 0) >= m.spec.uses_elements
        assert 0 <= allowance_of(m.spec) <= 0.05
