# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels of a bake follow what is seen, the user's factor, and the size of many objects."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking import report
from adjgi.adjoint_gi.bridge.baking.bake import Bake, BakeRequest
from adjgi.adjoint_gi.core.method import registry


def plane(name, size, z=0.0, at=(0, 0), flip=False):
    bpy.ops.mesh.primitive_plane_add(size=size, location=(*at, z), rotation=(np.pi if flip else 0, 0, 0))
    bpy.context.object.name = name


def given(**options):
    """What each object got, by the report of a bake."""
    solver = registry.method("local_illumination")
    bake = Bake(bpy.context, BakeRequest("local_illumination", solver.Settings(), **options))
    return {row["object"]: row for row in report.of_bake(bake)["lightmaps"]}, bake


def test_a_ground_plane_leaves_the_room_its_texels_and_the_user_decides(registered):
    plane("Ground", 29, -0.01)
    plane("Floor", 4)
    plane("Ceiling", 4, 2.6, flip=True)
    got, _ = given(resolution=128, atlas=True)
    assert got["Floor"]["texels"] + got["Ceiling"]["texels"] > got["Ground"]["texels"] > 0
    assert got["Floor"]["texels_per_metre"] > 4 * got["Ground"]["texels_per_metre"]
    for name in got:
        bpy.data.objects[name].adjoint_gi_density = 0.25 if name == "Ceiling" else 1.0
        bpy.data.objects[name].data.uv_layers.remove(bpy.data.objects[name].data.uv_layers["Lightmap"])
    assert [got[name]["weight"] for name in got].count(1.0) == 1 and sum(row["share"] for row in got.values()) > 0.999
    less, _ = given(resolution=128, atlas=True)
    ratio = less["Floor"]["texels_per_metre"] / less["Ceiling"]["texels_per_metre"]
    assert 3 < ratio * got["Ceiling"]["texels_per_metre"] / got["Floor"]["texels_per_metre"] < 5


def test_a_changed_density_renews_our_layers_at_the_next_bake(registered):
    for name in ("Left", "Right"):
        plane(name, 2, at=(3 * (name == "Right"), 0))
    before, _ = given(resolution=64, atlas=True)
    bpy.data.objects["Left"].adjoint_gi_density = 0.25
    after, bake = given(resolution=64, atlas=True)
    assert before["Left"]["texels_per_metre"] == pytest.approx(before["Right"]["texels_per_metre"], rel=0.1)
    assert after["Left"]["weight"] == pytest.approx(0.25, rel=0.15)
    assert any(n.object == "Left" and "another density" in n.reason for n in bake.notices)
    _, bake = given(resolution=64, atlas=True)
    assert not any("made anew" in n.reason for n in bake.notices)


@pytest.mark.parametrize("change", [{"resolution": 64}, {"texels_per_metre": 20.0}, {"texels_per_metre": 0.0}])
def test_what_else_is_asked_renews_our_layers_too(registered, change):
    """An image is never larger than the resolution, and has the texels a metre that are asked for now."""
    plane("Floor", 4)
    asked = {"resolution": 256, "texels_per_metre": 40.0}
    before, _ = given(**asked)
    again, bake = given(**asked)
    assert again == before and not any("another density" in n.reason for n in bake.notices)
    after, bake = given(**asked | change)
    assert any("another density" in n.reason for n in bake.notices)
    obj = bpy.data.objects["Floor"]
    obj.data.uv_layers.remove(obj.data.uv_layers["Lightmap"])
    fresh, _ = given(**asked | change)
    assert after == fresh != before


def test_images_of_many_objects_follow_their_size_and_say_so():
    for k in range(24):
        plane(f"Prop {k:02}", 2.0 if k < 12 else 0.1, at=(3 * k, 0))
    got, bake = given(resolution=64)
    assert {got[f"Prop {k:02}"]["texels"] > 0.8 * 64**2 for k in range(12)} == {True}
    assert {got[f"Prop {k:02}"]["texels"] <= 32**2 for k in range(12, 24)} == {True}
    (said,) = [n for n in bake.notices if n.object == "Lightmaps"]
    assert "12 of 32, 12 of 64" in said.reason and said.severity == "info"


@pytest.mark.parametrize("atlas", (False, True))
def test_with_a_given_density_nothing_gets_more_and_what_does_not_fit_is_said(atlas, registered):
    """A kerb of 100 m at 10 texels a metre in an image of 256: it has 2.56 along its length, and its neighbours have theirs."""
    plane("House", 4)
    plane("Small", 0.2, 1.0)
    plane("Twice", 2, at=(9, 0))
    plane("Kerb", 1, at=(0, 9))
    kerb = bpy.data.objects["Kerb"]
    kerb.scale, bpy.data.objects["Twice"].adjoint_gi_density = (100, 0.8, 1), 2.0
    bpy.context.view_layer.update()
    got, bake = given(resolution=256, atlas=atlas, texels_per_metre=10.0)
    found = {name: row["texels_per_metre"] for name, row in got.items()}
    assert found == pytest.approx({"House": 10, "Small": 10, "Twice": 20, "Kerb": (2.56 * 10) ** 0.5}, rel=0.03)
    (said,) = [n for n in bake.notices if "fit into" in n.reason]
    assert said.object == "Kerb" and said.severity == "warning" and "only 2.5" in said.reason and "not 10" in said.reason
    assert not any("the others would get few" in n.reason for n in bake.notices)
