"""Rough diffuse walls (Oren and Nayar) in every method: computed, or taken as diffuse with a notice."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Lobe, Material
from adjgi.adjoint_gi.core.scene.substitutes import as_diffuse
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load
from adjgi.tests import scenes

load()
SMALL = {"max_edge": 0.5, "rays": 256, "samples": 64, "particles": 100_000, "seed": 3}


def walls(rough):
    """A room with one bright wall; white and coloured walls are rough, or diffuse with the same mean albedo."""
    lamp = Material("Lamp", (Lobe("diffuse", Color.of(0.2)), Lobe("emission", Color.of(1.0))))
    out = [lamp]
    for i, color in enumerate((0.9, 0.9, 0.5, 0.7, 0.8)):
        material = Material(f"Rough {i}", (Lobe("rough diffuse", Color.of(color), 1.0, multiscatter=True),))
        out.append(material if rough else Material(f"Plain {i}", (Lobe("diffuse", as_diffuse(material)),)))
    return World(scenes.cube(materials=out))


def solved(name, world, receivers=None, **values):
    solver = method(name)
    fields = solver.Settings.__dataclass_fields__
    settings = solver.Settings(**{k: v for k, v in (SMALL | values).items() if k in fields})
    receivers = receivers or ElementReceivers(Elements(world, 0.5))
    *_, last = solver.solve(world, receivers, settings, np.random.default_rng(settings.seed))
    return last.solution()


@pytest.mark.parametrize("name", ["local_illumination", "matrix_radiosity", "progressive_radiosity", "two_pass", "multi_pass"])
def test_methods_of_diffuse_elements_take_the_mean_albedo_and_say_so(name):
    assert "rough diffuse" not in method(name).spec.lobes
    rough, plain = (solved(name, walls(is_rough)) for is_rough in (True, False))
    assert np.allclose(rough.quantity("irradiance"), plain.quantity("irradiance"), rtol=1e-4)
    said = [n.object for n in rough.warnings if n.reason == "rough diffuse taken as diffuse by this method"]
    assert said == [f"Material Rough {i}" for i in range(5)]


@pytest.mark.parametrize("rough", ["highlights", "phong", "mirrors", "refuse"])
def test_recursive_ray_tracing_lights_it_whatever_it_makes_of_rough_reflection(rough):
    world = walls(True)
    camera = Camera("perspective", (0.5, 0.5, 0.5), (0, 1, 0), (0, 0, 1), (1, 0, 0), (-0.5, 0.5, -0.5, 0.5), 8, 8)
    world = World(dataclasses.replace(world.scene, camera=camera))
    found = solved("whitted", world, CameraReceivers(world), rough=rough, light_points=256)
    want = solved("path_tracing", world, CameraReceivers(world), samples=512, max_length=1)
    assert found.quantity("radiance").mean() == pytest.approx(want.quantity("radiance").mean(), rel=0.03)


@pytest.mark.parametrize("name", ["distribution", "directional_radiosity", "spherical_harmonics", "particle_tracing"])
def test_methods_that_compute_it_agree_with_path_tracing(name):
    assert "rough diffuse" in method(name).spec.lobes
    want = solved("path_tracing", walls(True), samples=1024).quantity("irradiance")[0::2].mean(axis=0)
    found = solved(name, walls(True))
    got = found.quantity("irradiance")[0::2].mean(axis=0)
    assert got == pytest.approx(want, rel=0.015)
    assert not any("rough diffuse taken" in n.reason for n in found.warnings)
