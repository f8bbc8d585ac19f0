# SPDX-License-Identifier: GPL-3.0-or-later
"""The numbers that panels, reports, passes and pictures of comparisons state of a result are those of the result."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.report import of_solution
from adjgi.adjoint_gi.bridge.baking.sides import planned
from adjgi.adjoint_gi.bridge.comparison import cycles_reference
from adjgi.adjoint_gi.bridge.comparison.records import request_of
from adjgi.adjoint_gi.bridge.comparison.request import SHOWN, Compare, CompareRequest, ReferenceChoice
from adjgi.adjoint_gi.bridge.engine.passes import FAR, Geometry, pixels
from adjgi.adjoint_gi.bridge.engine.pictures import exposure
from adjgi.adjoint_gi.bridge.props import records
from adjgi.adjoint_gi.core.comparison import figures
from adjgi.adjoint_gi.core.comparison.budget import Budget, Reference
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import EnergyBalance, Solution
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.operators.bake import ADJOINTGI_OT_bake
from adjgi.tests import baking, hostile
from adjgi.tests.cycles_patch import add_light, diffuse_material
from adjgi.tests.exr_layers import read_exr


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


def test_the_bake_operator_reports_time_rays_and_the_gap_in_percent(registered):
    scene = bpy.context.scene
    for found, words in ((solution(), ", energy gap 5 %"), (dataclasses.replace(solution(), balance=None), "")):
        records.store(scene.adjoint_gi.result, found, target="texture", quantity="irradiance", applied=True)
        assert ADJOINTGI_OT_bake.summary(None, scene) == f"Baked in 8.0 s with 400 rays{words}"


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
    made = pixels(method("path_tracing").spec, seen, geometry, transparent=True)
    combined, emission = made["Combined"].reshape(5, 9, 4), made["Emission"].reshape(5, 9, 3)
    np.testing.assert_allclose(combined[:, :4], 1.0, rtol=1e-6)
    np.testing.assert_allclose(combined[:, 4], 0.5, rtol=1e-6)
    assert not combined[:, 5:].any()
    np.testing.assert_array_equal(emission, combined[..., :3])  # of which all the light is here
    opaque = pixels(method("path_tracing").spec, seen, geometry)
    np.testing.assert_array_equal(opaque["Emission"], radiance)
    np.testing.assert_array_equal(opaque["Combined"], np.concatenate([radiance, np.ones((45, 1), np.float32)], axis=1))


@pytest.mark.parametrize("bright", [1e-3, 0.2, 0.26, 0.99, 1.01, 2.0, 700.0])
def test_pictures_are_exposed_by_whole_stops_until_what_is_bright_is_below_one(bright):
    """What is bright is less than all but a twentieth of what is lit, however much is black."""
    grey = np.concatenate([np.zeros(900), np.full(94, bright), np.full(4, 100 * bright)])
    factor = exposure(np.repeat(grey[:, None], 3, axis=1))
    assert np.log2(factor) == np.round(np.log2(factor))
    assert factor == 1 if 0.25 <= bright <= 1 else 0.5 <= bright * factor <= 1
    assert exposure(np.zeros((3, 3))) == 1
    assert exposure(np.float32([[0, 0, 2]])) == 4, "blue is dark: its luminance is 0.14"


def test_a_reference_gets_four_times_the_budget_where_no_time_is_given():
    methods, budget = ("path_tracing",), Budget("time", 10.0)
    assert CompareRequest(methods, budget).plan().reference_seconds == 40
    assert CompareRequest(methods, budget, ReferenceChoice("method", "path_tracing", 7.0)).plan().reference_seconds == 7


@pytest.mark.parametrize(("kind", "seconds"), [("time", 600), ("rays", 60), ("error", 60)])
def test_an_equal_time_is_not_cut_by_the_limit_of_other_budgets(registered, kind, seconds):
    state = bpy.context.scene.adjoint_gi_compare
    state.budget, state.seconds, state.limit, state.reference = kind, 600.0, 60.0, "constant"
    budget = request_of(bpy.context.scene, bpy.context.view_layer).budget
    assert (budget.kind, budget.seconds) == (kind, seconds)


def test_lightmaps_stand_in_reading_order():
    sheets = [SimpleNamespace(part=slice(k, k + 1), lightmap=SimpleNamespace(image=lambda v: np.full((4, 4, 1), v[0]))) for k in range(3)]
    compare = SimpleNamespace(request=SimpleNamespace(receivers="texture"), sheets=sheets)
    picture = Compare.picture(compare, np.array([1.0, 2.0, 3.0]))[..., 0]
    assert len(picture) >= SHOWN
    assert (picture[-1, 0], picture[-1, -1], picture[0, 0], picture[0, -1]) == (1, 2, 3, 0)


def test_the_noise_of_a_cycles_bake_is_half_of_what_its_halves_differ_by(monkeypatch):
    halves = iter((1.2, 0.8))
    image = SimpleNamespace(pixel=np.arange(4))
    sheet = SimpleNamespace(part=slice(0, 4), lightmap=image, uids=(), name="Sheet")
    for name in ("_cycles", "in_place"):
        monkeypatch.setattr(cycles_reference, name, lambda *_: nullcontext())
    monkeypatch.setattr(cycles_reference, "find_objects", lambda *_: [None])
    monkeypatch.setattr(cycles_reference, "_problem", lambda _: "")
    monkeypatch.setattr(cycles_reference, "comparable", lambda *_: np.array([True, True, True, False]))
    monkeypatch.setattr(cycles_reference, "coat_notices", lambda _: ())
    monkeypatch.setattr(cycles_reference, "in_place", lambda *_: nullcontext())
    monkeypatch.setattr(cycles_reference, "_bake", lambda *_: np.full((2, 2, 3), next(halves)))
    found = cycles_reference.bake_reference(SimpleNamespace(scene=None, view_layer=None), World(SceneBuilder().build()), [sheet], 4, 16, 5)
    assert found.noise == pytest.approx(0.2) and found.values == pytest.approx(np.ones((4, 3))) and found.valid.sum() == 3


@pytest.mark.parametrize(("atlas", "expected"), [(False, [100, 200]), (True, [224])])
def test_planned_sizes_follow_the_texels_a_metre_times_the_factor(registered, atlas, expected):
    """A share of 0.6 of an image is thought to be filled: 0.6 m2 at 100 texels a metre are 100 texels a side."""
    for name, factor in (("Plain", 1.0), ("Twice", 2.0)):
        obj = bpy.data.objects.new(name, bpy.data.meshes.new(name))
        bpy.context.scene.collection.objects.link(obj)
        obj.adjoint_gi_density = factor
    uids = [bpy.data.objects[name].session_uid for name in ("Plain", "Twice")]
    parts = [SimpleNamespace(uid=uid, triangles=slice(k, k + 1)) for k, uid in enumerate(uids)]
    world = SimpleNamespace(scene=SimpleNamespace(objects=parts), area=np.array([0.6, 0.6]))
    request = SimpleNamespace(texels_per_metre=100.0, resolution=1024, atlas=atlas)
    assert planned(world, [0, 1], request).tolist() == expected


def test_pictures_of_a_comparison_have_their_scales_from_the_errors(monkeypatch):
    """Irradiance 3 where 2 is right: an error of half the mean; curves and the noise are in percent."""
    drawn = {}
    for name in ("differences", "plot", "histogram"):
        monkeypatch.setattr(figures, name, lambda *values, name=name, **named: drawn.update({name: (values, named)}))
    entry = SimpleNamespace(label="One", solution=solution(), curve=[SimpleNamespace(seconds=2.0, error=0.25)])
    reference = Reference("Known", np.full((4, 3), 2.0), np.array([True, False, True, False]), 0.01)
    sheet = SimpleNamespace(part=slice(0, 4), lightmap=SimpleNamespace(image=lambda v: np.asarray(v, np.float32).reshape(2, 2, -1)))
    compare = SimpleNamespace(request=SimpleNamespace(receivers="texture"), sheets=[sheet])
    compare.picture = lambda values: Compare.picture(compare, values)
    Compare.pictures(compare, SimpleNamespace(entries=[entry], reference=reference))
    assert drawn["differences"][0][4:] == (0.5 * 2, 2.0)
    (curves, *_), named = drawn["plot"]
    assert curves[0].points.tolist() == [[2.0, 25.0]] and named["floor"] == pytest.approx(1.0)
    errors, _, limit = drawn["histogram"][0]
    assert errors[0] == pytest.approx(np.full(6, 0.5)) and limit == 2 * 0.5


def test_what_any_method_has_computed_is_shown(monkeypatch):
    """A method that has left out texels still shows those that the other has; what neither has is grey."""
    drawn = []
    monkeypatch.setattr(figures, "side_by_side", lambda *values: drawn.append(values))
    one, other = solution(), dataclasses.replace(solution(), weight=np.array([1, 1, 0, 0], np.float32))
    nothing = dataclasses.replace(one, weight=np.zeros(4, np.float32))
    entries = [SimpleNamespace(label=str(i), solution=s) for i, s in enumerate((one, other, nothing))]
    compare = SimpleNamespace(picture=lambda v: np.asarray(v, np.float32).reshape(2, 2, -1))
    Compare.pictures(compare, SimpleNamespace(entries=entries, reference=None))
    images, labels, _, covered = drawn[0]
    assert (len(images), labels, covered.tolist()) == (2, ["0", "1"], [[True, True], [True, False]])


def test_a_budget_of_rays_is_in_millions(registered):
    state = bpy.context.scene.adjoint_gi_compare
    state.budget, state.mega_rays = "rays", 2.0
    asked = request_of(bpy.context.scene, bpy.context.view_layer).budget
    assert (asked.kind, asked.value) == ("rays", 2e6)


def test_the_file_of_all_parts_has_each_of_them_under_its_name(tmp_path):
    """An emitting plane of albedo 0.25 and a wall below a sun."""
    for name, corner in (("floor", (1, 1, 0)), ("wall", (1, 0, 1))):
        made = hostile.mesh([(0, 0, 0), (corner[0], 0, 0), corner, (0, *corner[1:])], [(0, 1, 2, 3)], name=name)
        made.data.materials.append(diffuse_material("grey", 0.25))
    add_light("SUN", energy=2.0, rotation=(0.5, 0.4, 0))
    found = baking.bake(baking.request(objects=("floor",), resolution=8, values={"samples": 4}, output=str(tmp_path)))
    (path,) = [p for p in found.files if "components" in str(p)]
    layers, (sheet,), solution = read_exr(path)[0], found.writer.sheets, found.driver.solution()
    names = ("emitted", "direct", "indirect", "albedo")
    for name in names:
        right, covered = sheet.lightmap.image(getattr(solution, name)[sheet.part]), sheet.lightmap.covered
        np.testing.assert_array_equal(layers[name][covered], right[covered])
    assert len({layers[name].tobytes() for name in names}) == 4
    np.testing.assert_array_equal(layers["coverage"][..., 0], sheet.lightmap.share)
