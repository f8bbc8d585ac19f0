# SPDX-License-Identifier: GPL-3.0-or-later
"""What has not been computed is not covered: the alpha of attributes, textures and pictures; and errors are warnings of a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.baking.bake import Bake
from adjgi.adjoint_gi.bridge.baking.report import of_bake
from adjgi.adjoint_gi.bridge.results.attribute import linked_attribute
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.adjoint_gi.core.base.errors import Notice
from adjgi.tests.blender.fakes import square
from adjgi.tests.blender.test_bake import request
from adjgi.tests.exr_layers import read_exr


def baked(*which, target, **more):
    """A square and its bake, the result without a sample at the receivers `which`."""
    plain = square()
    made = Bake(bpy.context, request(target=target, resolution=8, values={"samples": 1}, **more))
    solution = made.driver.run()
    weight = solution.weight.copy()
    weight[list(which)] = 0
    made.write(replace(solution, weight=weight))
    return plain, made


def test_vertices_without_a_sample_are_not_covered():
    plain, _ = baked(2, target="attribute", domain="POINT")
    values = np.empty(4 * 4, np.float32)
    plain.data.attributes[linked_attribute(plain, "irradiance")].data.foreach_get("color", values)
    assert values[3::4].tolist() == [1, 1, 0, 1]


def test_texels_without_a_sample_are_not_covered(tmp_path):
    plain, made = baked(0, 5, target="texture", margin=0, output=str(tmp_path))
    share = np.zeros(64)
    lightmap = made.writer.sheets[0].lightmap
    share[lightmap.pixel] = lightmap.share.reshape(-1)[lightmap.pixel]
    assert (share > 0).sum() > 20
    share[lightmap.pixel[[0, 5]]] = 0
    alpha = read_pixels(linked_image(plain, "irradiance"))[..., 3]
    coverage = read_exr(Path(made.files[1]))[0]["coverage"]
    for shown in (alpha, coverage.reshape(8, 8)):
        np.testing.assert_allclose(shown.reshape(-1), share, atol=1e-3)


@pytest.mark.parametrize("transparent", [False, True])
def test_a_baked_picture_is_as_transparent_as_the_film_of_the_scene(transparent, tmp_path):
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 4.0, (0, 0, 5)
    scene.collection.objects.link(camera)
    scene.camera, scene.render.film_transparent = camera, transparent
    _, made = baked(target="render", output=str(tmp_path), width=4, height=4)
    alpha = read_exr(Path(made.files[0]))[0][""][..., 3]
    assert alpha[1:3, 1:3].tolist() == [[1, 1], [1, 1]]
    assert alpha[0].tolist() == [0.0 if transparent else 1.0] * 4


def test_errors_are_among_the_warnings_of_a_report():
    _, made = baked(target="attribute")
    made.notices.extend(Notice(kind, "is said", "", kind) for kind in ("error", "warning", "info"))
    warnings = [n["object"] for n in of_bake(made)["warnings"]]
    assert {"error", "warning"} <= set(warnings) and "info" not in warnings
