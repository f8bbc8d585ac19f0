# SPDX-License-Identifier: GPL-3.0-or-later
"""A method that does nothing but count, for tests of what surrounds methods: `with fake_method(adjgi): ...`."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np
from adjgi.adjoint_gi.core.base.errors import Notice, SceneError
from adjgi.adjoint_gi.core.base.settings import Settings, setting
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.method.registry import Nature, Solver, Strategy
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution, Step
from adjgi.tests.specs import spec_of

WORDS = (("fine", "Fine", "All goes well."), ("fails", "Fails", "It raises in the middle."))


@dataclass(frozen=True)
class FakeSettings(Settings):
    """One field of every kind that a method may have."""

    steps: int = setting(4, label="Steps", help="How many steps it makes", min=1, max=10**9)
    pause: float = setting(0.0, label="Pause", help="Seconds that a step takes", min=0.0, max=1.0, unit="time")
    tiny: float = setting(1e-4, label="Tiny", help="A small number", min=0.0, max=0.1)
    edge: float = setting(0.5, label="Edge", help="A length", min=0.01, unit="distance")
    max_edge: float = setting(0.0, label="Max Edge", help="Longest edge of an element", min=0.0, unit="distance")
    flag: bool = setting(True, label="Flag", help="A switch.")
    mode: str = setting("fine", label="Mode", help="What it does", choices=WORDS)
    note: str = setting("", label="Note", help="Any text")


class Fake(Solver):
    """Irradiance 1, 2, 3 in the channels times the share of steps done; `elements` is 7."""

    spec = spec_of(
        "fake",
        990,
        Strategy.SHOOTING,
        Nature.DETERMINISTIC,
        equation="L = 1",
        idea="Counts to the number of steps.",
        limits=("solves nothing at all, which takes a rather long sentence to say and therefore must be broken into lines",),
        lobes=frozenset({"diffuse"}),
        elements=100,
    )
    Settings = FakeSettings

    def solve(self, world, receivers, settings, rng):
        n = receivers.count
        started = time.monotonic()
        for i in range(settings.steps):
            time.sleep(settings.pause)
            if settings.mode == "fails" and i >= settings.steps // 2:
                raise SceneError("Fake", "fails on purpose", "Choose Fine")
            share = (i + 1) / settings.steps

            def solution(share=share, i=i):
                direct = np.tile(np.array([1, 2, 3], np.float32), (n, 1))
                return Solution(
                    "fake",
                    receivers.measure,
                    np.zeros((n, 3), np.float32),
                    direct * np.float32(share),
                    direct * np.float32(2),
                    np.full((n, 3), 0.5, np.float32),
                    np.ones(n, np.float32),
                    rays=3_000_000_000 * (i + 1),
                    seconds=time.monotonic() - started,
                    balance=EnergyBalance(10.0, 8.0, 1.9),
                    emitted_flux=10.0,
                    entering_flux=9.5,
                    warnings=(Notice("Material Fake", "is not real", "Accept it"),),
                    settings=settings.as_dict(),
                    partial=share < 1,
                    extra={"elements": np.full((n, 3), 7, np.float32)},
                )

            yield Step(share, f"Step {i + 1} of {settings.steps}", solution)


@contextlib.contextmanager
def fake_method(adjgi):
    """The extension registered with the fake among its methods, chosen in the scene."""
    import bpy

    adjgi.unregister()
    registry.register(Fake)
    adjgi.register()
    try:
        bpy.context.scene.adjoint_gi.method = "fake"
        yield Fake
    finally:
        adjgi.unregister()
        del registry._METHODS["fake"]
        adjgi.register()


QUICK = {"samples": 4, "particles": 20_000, "max_edge": 0.25, "rays": 1024, "tolerance": 0.01}


def quick(scene, method):
    """Choose `method` with settings that end in a second on a Cornell box; returns the root properties."""
    from adjgi.adjoint_gi.bridge.props import properties

    state = scene.adjoint_gi
    state.method = method
    group = getattr(state, properties.group_name(method))
    for name, value in QUICK.items():
        if name in group.bl_rna.properties:
            default = group.bl_rna.properties[name].default
            setattr(group, name, min(value, default) if default else value)
    return state


def square(name="Square", size=2.0, z=0.0):
    """A mesh object with one face, a UV layer and a material, linked and selected."""
    import bpy

    h = size / 2
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(-h, -h, 0), (h, -h, 0), (h, h, 0), (-h, h, 0)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    material = bpy.data.materials.new(name)
    mesh.materials.append(material)
    obj = bpy.data.objects.new(name, mesh)
    obj.location.z = z
    bpy.context.scene.collection.objects.link(obj)
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj
    return obj


def camera(z=5.0, ortho=3.0):
    """An orthographic camera that looks down and is the scene's active one."""
    import bpy

    data = bpy.data.cameras.new("Camera")
    data.type, data.ortho_scale = "ORTHO", ortho
    obj = bpy.data.objects.new("Camera", data)
    obj.location.z = z
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.scene.camera = obj
    return obj
