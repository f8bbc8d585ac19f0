"""What a result adds up to: quantities of its parts, and the energy that is not accounted for."""

from __future__ import annotations

import numpy as np
import pytest
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution


def solution(measure):
    parts = [np.full((2, 3), v, np.float32) for v in (1.0, 2.0, 4.0, 0.5)]
    return Solution("x", measure, *parts, np.ones(2, np.float32))


def test_quantities_are_sums_of_the_parts():
    surface, camera, walk = (solution(m) for m in ("irradiance", "radiance", "potential"))
    assert (surface.quantity("irradiance") == 6).all() and (surface.quantity("radiosity") == 1 + 0.5 * 6).all()
    assert (camera.quantity("radiance") == 7).all() and (walk.quantity("potential") == 7).all()
    assert (surface.quantity("emitted") == 1).all() and (camera.quantity("indirect") == 4).all()
    for one, name in ((camera, "irradiance"), (surface, "radiance"), (walk, "radiosity")):
        with pytest.raises(ValueError, match=f"has no {name}"):
            one.quantity(name)


def test_the_gap_is_a_share_of_what_is_emitted():
    balance = EnergyBalance(10.0, 5.0, 3.0, 1.5)
    assert balance.gap == pytest.approx(0.05) and EnergyBalance(0.0, 0.0, 0.0).gap == 0
    # Light that passes by is emitted and escapes: what is lost stays the same.
    more = balance.with_passing(2.0)
    assert (more.emitted, more.escaped) == (12, 5) and more.gap == pytest.approx(0.5 / 12)
