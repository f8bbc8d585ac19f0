# SPDX-License-Identifier: GPL-3.0-or-later
"""Notices that state numbers, made of numbers chosen here, line by line; see `tests/approval.py`.

By hand: noise of 52 % of 64 samples needs 64 (0.52 / 0.05)^2 = 6922 for 5 %, so 8192. Of lengths that bring 8 and 4 W of 24 W, the next
bring 2, 1, ... so 4 W: 4 / 28 = 14.3 %. Of 100 W absorbed or left 7 W are left: 7 %. 9 s of 10 s are a budget that was used, 8.9 s are not.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
from adjgi import solvers
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.adjoint_gi.core.base.resources import require_memory, require_within, size_text
from adjgi.adjoint_gi.core.comparison.budget import Budget, constant_reference, reason_not_to
from adjgi.adjoint_gi.core.comparison.effort import unused_budget
from adjgi.adjoint_gi.core.flux import facing
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method import noise
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import EnergyBalance
from adjgi.adjoint_gi.core.receivers.uv_check import Faults
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import openness, path_limit, unmet_lamps
from adjgi.adjoint_gi.core.walks.openness import Openness
from adjgi.tests.approval import approve

solvers.load()


def squares(names):
    """Squares of two triangles each."""
    b = SceneBuilder()
    for k, name in enumerate(names):
        b.quad(name, (3.0 * k, 0, 0), (1, 0, 0), (0, 1, 0), diffuse(name, 0.5))
    return World(b.build())


def refusal(function, *values):
    try:
        function(*values)
    except AdjointError as error:
        return str(error)
    return "nothing"


def test_notices_with_numbers_are_told_as_approved(monkeypatch):
    told = ["# sizes", *(f"{n}: {size_text(n)}" for n in (0, 999, 1000, 12_345, 999_499, 1_500_000, 123_456_789, 25 * 10**8, 8 * 10**12))]
    told += [refusal(require_memory, "Walks", 910, 1000), refusal(require_memory, "Walks", 890, 1000)]
    told += [refusal(require_within, "Factors", 3 << 20, 2, "Take fewer"), refusal(require_within, "Factors", 2 << 20, 2, "Take fewer")]

    told += ["", "# noise"]
    walks, particles = method("path_tracing").Settings(samples=64), method("particle_tracing").Settings(particles=1000)
    for error, settings, measure, lights in (
        (0.52, walks, "irradiance", 15),
        (0.52, walks, "irradiance", 16),
        (0.23, walks, "radiance", 16),
        (0.5, particles, "irradiance", 1),
        (0.33, method("matrix_radiosity").Settings(), "irradiance", 1),
        (0.149, walks, "irradiance", 1),
    ):
        told += [str(n) for n in noise.notices(error, settings, "Some", measure, lights)] or [f"nothing of {error}"]

    elements = method("progressive_radiosity").Settings(light_samples=8)
    told += [str(n) for n in noise.notices(0.31, elements, "Some", "irradiance", 1, part="direct light", lowered_by="light_samples")]

    told += ["", "# path lengths", f"{path_limit.left_out(np.array([8.0, 4.0]), 24.0):.4g}"]
    told.append(f"{path_limit.left_unshot(EnergyBalance(120.0, 93.0, 20.0, 7.0), 8):.4g}")
    for share, longest in ((0.0009, 8), (0.0016, 8), (0.0944, 8), (0.127, 8), (0.95, 8), (0.0123, 1024)):
        told += [str(n) for n in path_limit.notices(share, longest)] or [f"nothing of {share}"]

    told += ["", "# openness: a leak of 1.36 %; of three objects one has a dark front, one in part, of one too little is known"]
    world = squares(("Dark", "Part", "Few"))
    found = Openness(0.0136, np.array([0.95, 0.5, 1.0]), np.array([900, 50, 49]), np.zeros((2, 6), np.int64))
    monkeypatch.setattr(openness, "measure", lambda *_: found)
    told += [str(n) for n in openness.notices(world, {0, 1, 2})]
    for share in (0.0009, 0.03):  # nothing is at stake
        monkeypatch.setattr(openness, "measure", lambda *_, share=share: dataclasses.replace(found, escaped=share))
        assert not any("leaves the scene" in n.reason for n in openness.notices(world, {1}))
    told += [str(n) for n in openness.notices(world, {1})]
    told += [str(n) for n in facing._notices(world, np.array([1, 1, 1, 0, 0, 0], bool))]

    told += ["", "# comparisons"]
    elements, budget = method("matrix_radiosity").Settings(rays=1500, max_edge=0.25, light_samples=3), Budget("time", 10.0)
    rays = Budget("rays", 10.0)
    for settings, seconds, limit in ((elements, 8.9, budget), (elements, 9.0, budget), (elements, 1.0, rays), (walks, 0.5, budget)):
        told.append(str(unused_budget("Some", settings, seconds, limit)))
    told += [Budget("time", 2.5).text, Budget("rays", 1234567.0).text, Budget("error", 0.0225).text]
    told += [constant_reference(v, 2).label for v in (0.25, (0.25, 0.25, 0.25), (1.0, 0.5, 0.25))]
    solver = SimpleNamespace(spec=SimpleNamespace(label="Some", answers="light", receivers=("texels",)), memory=lambda *_: 3000 << 20)
    told.append(str(reason_not_to(solver, None, SimpleNamespace(kind="texels"), SimpleNamespace(memory_limit=2048))))
    told.append(str(reason_not_to(solver, None, SimpleNamespace(kind="pixels"), None)))

    told += ["", "# lists", *(unmet_lamps._listed(list("ABCDEA"[:n])) for n in (1, 3, 4, 6))]
    none = np.zeros(0, np.int64)
    told += [str(Faults(none, 3, 4, np.arange(5), 6, 7, 8)), str(Faults(none, 0, 4, none, 0, 7, 8))]
    assert not Faults(none, 0, 0, none, 0, 7, 8)
    approve("notices", told)
