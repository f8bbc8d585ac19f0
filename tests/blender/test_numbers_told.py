# SPDX-License-Identifier: GPL-3.0-or-later
"""The numbers that panels, reports, passes and pictures of comparisons state of a result are those of the result."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.report import of_solution
from adjgi.adjoint_gi.bridge.comparison.request import SHOWN, Compare, CompareRequest, ReferenceChoice
from adjgi.adjoint_gi.bridge.engine.passes import FAR, Geometry, pixels
from adjgi.adjoint_gi.bridge.props import records
from adjgi.adjoint_gi.core.comparison.budget import Budget
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World


def solution(**values):
    """Four receivers with an irradiance of 3, half of them without a sample."""
    zero, got = np.zeros((4, 3), np.float32), np.array([1, 0, 1, 0], np.float32)
    lit = got[:, None] * np.ones((4, 3), np.float32)
    balance = EnergyBalance(10.0, 5.0, 3.0, 1.5)
    return Solution("x", "irradiance", zero, 1 * lit, 2 * lit, 0.5 * lit, got, rays=400, seconds=8.0, balance=balance, **values)


def test_the_panel_shows_the_mean_of_what_was_reached_and_the_fluxes_by_name(registered):
    record = bpy.context.scene.adjoint_gi.result
    records.store(record, solution(emitted_flux=9.0, entering_flux=7.0), target="texture", quantity="irradiance", applied=True)
    assert tuple(record.mean) == pytest.approx((3, 3, 3))
    assert (record.absorbed, record.escaped, record.unshot) == pytest.approx((5, 3, 1.5)) and record.gap == pytest.approx(0.05)
    assert (record.emitted, record.entering, record.seconds, record.rays) == (9, 7, 8, "400")


def test_the_report_has_means_of_what_was_reached(registered):
    told = of_solution(solution())
    assert told["mean"]["irradiance"] == [3, 3, 3] and told["mean"]["radiosity"] == [1.5] * 3
    assert (told["without_samples"], told["rays_per_second"], told["unit"]) == (2, 50, "W m-2")


def view(background=0.0):
    """A wall 2 m before a wide camera that covers the left half of its picture."""
    b = SceneBuilder()
    b.quad("Wall", (-9, 2, -9), (9, 0, 0), (0, 0, 18), diffuse("Wall", 0.5))
    b.camera = Camera("perspective", (0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-1, 1, -1, 1), 9, 5, clip_start=0.5)
    b.background = (background,) * 3
    world = World(b.build())
    return Geometry.of(world, CameraReceivers(world))


def test_depth_is_along_the_axis_of_the_camera():
    depth = view().depth.reshape(5, 9)
    np.testing.assert_allclose(depth[:, :5], 2.0, rtol=1e-5)
    assert (depth[:, 5:] == np.float32(FAR)).all()


def test_a_transparent_film_takes_out_as_much_of_the_background_as_is_seen():
    """The middle column of pixels is half wall: radiance 1 of the wall and 4 of the background make 2.5 there."""
    geometry = view(4.0)
    half = geometry.alpha.reshape(5, 9)[:, 4]
    np.testing.assert_allclose(half, 0.5)
    zero, radiance = np.zeros((45, 3), np.float32), (geometry.alpha + 4 * (1 - geometry.alpha))[:, None] * np.ones(3, np.float32)
    seen = Solution("x", "radiance", radiance, zero, zero, zero, np.ones(45, np.float32))
    combined = pixels(method("path_tracing").spec, seen, geometry, transparent=True)["Combined"].reshape(5, 9, 4)
    np.testing.assert_allclose(combined[:, :4], 1.0, rtol=1e-6)
    np.testing.assert_allclose(combined[:, 4], 0.5, rtol=1e-6)
    assert not combined[:, 5:].any()


def test_a_reference_gets_four_times_the_budget_where_no_time_is_given():
    methods, budget = ("path_tracing",), Budget("time", 10.0)
    assert CompareRequest(methods, budget).plan().reference_seconds == 40
    assert CompareRequest(methods, budget, ReferenceChoice("method", "path_tracing", 7.0)).plan().reference_seconds == 7


def test_lightmaps_stand_in_reading_order():
    sheets = [SimpleNamespace(part=slice(k, k + 1), lightmap=SimpleNamespace(image=lambda v: np.full((4, 4, 1), v[0]))) for k in range(3)]
    compare = SimpleNamespace(request=SimpleNamespace(receivers="texture"), sheets=sheets)
    picture = Compare.picture(compare, np.array([1.0, 2.0, 3.0]))[..., 0]
    assert len(picture) >= SHOWN
    assert (picture[-1, 0], picture[-1, -1], picture[0, 0], picture[0, -1]) == (1, 2, 3, 0)
