# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of comparisons made by hand, of which every number that is told can be reckoned: for tests of pages, tables and panels.

Three receivers stand on two objects, one on none: weights 1 and 2 m2 on the floor, 0.5 m2 on the wall. A method with the values
(a, 2 a, 3 a) on the floor and (b, 2 b, 3 b) on the wall gathers 3 * 6 a = 18 a and 0.5 * 6 b = 3 b, in W.
"""

from __future__ import annotations

import numpy as np
from adjgi.adjoint_gi.core.base.errors import Notice
from adjgi.adjoint_gi.core.comparison.budget import Budget, Entry, Point, Reference
from adjgi.adjoint_gi.core.comparison.run import Result
from adjgi.adjoint_gi.core.flux.agreement import EVERY_LENGTH, Groups, Measured, ShotFlux, agreement
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution

DIM = Notice("Lamp", "is dim", "Change it")  # found before, and by the reference as well
GROUPS = Groups(("Floor", "Wall"), np.array([0, 0, 1, -1]), np.array([1.0, 2.0, 0.5, 9.0]), np.array([0, 1, -1]))


def solution(
    method: str, a: float, b: float, *, weight: tuple[float, ...] = (1, 1, 1, 1), measure: str = "irradiance", **values
) -> Solution:
    """A third of the light is indirect; the last receiver, on no object, has 100 times as much as the floor."""
    whole = np.float32([[a], [a], [b], [100 * a]]) * np.float32([1, 2, 3])
    zero = np.zeros((4, 3), np.float32)
    return Solution(method, measure, zero, whole * np.float32(2 / 3), whole / 3, zero + np.float32(0.5), np.float32(weight), **values)


def entry(label: str, state: str, found: Solution, seconds: float, rays: int, error: float | None, bias: float | None, **more) -> Entry:
    """One row; its curve is its end, and half of its time with twice its error."""
    curve = (Point(0.5 * seconds, rays // 2, 2 * error), Point(seconds, rays, error)) if error is not None else ()
    return Entry(found.method, label, state, found, seconds, rays, error, bias, curve, **({"settings": {}} | more))


def row(
    label: str, a: float, b: float, noise: tuple[float, float] = (0.0, 0.0), freedom: int = 0, allowance: float = 0.0, **more
) -> Measured:
    """What a method measures: 18 a and 3 b, as above."""
    return Measured(label.lower(), label, np.array([18 * a, 3 * b]), np.array(noise), freedom, allowance, **more)


def disagreeing() -> Result:
    """Four methods, equal time; every state of a row, and every kind of line but those of few repeats.

    Alpha 18 + 1.5 = 19.5 W, Delta 20.7 + 1.2 = 21.9 W, Beta as Alpha, Gamma 9 + 0.75 W; shot 18.5 + 1.5 = 20 W +- 0.25 + 0.05.
    So the duality gaps are -2.5 % and +9.5 %; Beta has not ended, and Gamma counts other lengths: they have none.

    A pair by hand, Alpha and Delta on the floor: 2.7 of 19.35 W are 14 %. Allowed are 3 % of 19.35 W and 1 % of the mean flux per area
    (the median of all sums, 19.75 W, on 3.5 m2) for 3 m2, so 0.58 + 0.17 W; 1.95 W are beyond, 6.5 errors of 0.3 W. By Student's t of 3
    degrees p is 0.0074, and after Sidak for 10 pairs on 2 objects 1 - (1 - 0.0074)^20 = 0.14.
    """
    balance = EnergyBalance(40.0, 30.0, 8.0, 1.0)  # 1 of 40 is lost: 2.5 %
    entries = (
        entry(
            "Beta", "limit", solution("beta", 1, 0.5, partial=True), 25.0, 950, 0.15, 0.02, notices=(Notice("Glass", "is opaque", "Wait"),)
        ),
        entry(
            "Alpha",
            "budget",
            solution("alpha", 1, 0.5, balance=balance, emitted_flux=40.0, entering_flux=33.0, settings={}),
            10.04,
            1_234_567,
            0.0213,
            -0.0051,
            settings={"samples": 64, "tolerance": 0.001, "mode": "all"},
            notices=(Notice("Glass", "is opaque", "Wait"),),
        ),
        entry("Gamma", "finished", solution("gamma", 0.5, 0.25), 3.25, 12_345, None, None, lengths=(1, 2)),
        entry("Delta", "finished", solution("delta", 1.15, 0.4), 75.0, 2_000_000_000, 0.0534, 0.061, settings={"edge": 0.125}),
    )
    methods = (
        row("Alpha", 1.0, 0.5, (0.3, 0.04), 3),
        row("Beta", 1.0, 0.2, leaves_out="caustics"),
        row("Gamma", 0.5, 0.25, lengths=(1, 2)),
        row("Delta", 1.15, 0.4, allowance=0.03, notes=("glass by diffuse",)),
        row("Omega", 2.0, 0.5),
    )
    shot = ShotFlux(np.array([18.5, 1.5]), np.array([0.25, 0.05]), 16, 262_144)
    reference = Reference(
        "Path Tracing, 40 s", np.full((4, 3), 2.5), np.array([1, 1, 1, 0], bool), 0.0123, 41.5, (Notice("Sky", "is dark"), DIM)
    )
    refused = (Notice("Whitted", "could need 4,096 MB, over its limit of 2,048 MB", "Raise max_edge or memory_limit"),)
    found = agreement(GROUPS, methods, shot)
    return Result(entries, refused, reference, found, GROUPS, Budget("time", 10.0), "irradiance", 113.0, 2_001_248_000, False, {"seed": 7})


def too_few() -> Result:
    """Beta reached the error first, Alpha had too few repeats. Of three pairs one agrees, one cannot be told, one differs as stated."""
    entries = (
        entry("Alpha", "reached", solution("alpha", 1, 0.5), 7.77, 555, 0.019, 0.0, random=True),
        entry("Beta", "reached", solution("beta", 1, 0.9), 6.66, 666, 0.0195, -0.0),
    )
    methods = (row("Alpha", 1.0, 0.5, (0.1, 0.2), 1), row("Beta", 1.0, 0.9), row("Delta", 1.001, 0.5, allowance=0.02, leaves_out="mirrors"))
    known = Reference("closed form 2.5", np.full((4, 3), 2.5), np.ones(4, bool), 0.0)
    return Result(entries, (), known, agreement(GROUPS, methods, None), GROUPS, Budget("error", 0.02), "irradiance", partial=False)


def pictured() -> Result:
    """One method at a camera, stopped: no winner, no reference, radiances instead of fluxes."""
    one = entry("Alpha", "partial", solution("alpha", 1, 0.5, measure="radiance", weight=(1, 1, 0, 1)), 0.5, 1000, None, None)
    return Result((one,), (), None, None, GROUPS, Budget("rays", 2e6), "radiance", partial=True, lengths=EVERY_LENGTH)
