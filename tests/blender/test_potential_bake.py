# SPDX-License-Identifier: GPL-3.0-or-later
"""The potential in Blender: selected faces come along, and requests name what the method answers."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.bridge.props.request import BakeRequest, fitting_quantity
from adjgi.adjoint_gi.core.flux.detectors import detector
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

load()


def two_quads():
    """Two separate quads in one mesh, the second mirrored object of which shares it."""
    mesh = bpy.data.meshes.new("mesh")
    vertices = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (3, 0, 0), (3, 1, 0), (2, 1, 0)]
    mesh.from_pydata(vertices, [], [(0, 1, 2, 3), (4, 5, 6, 7)])
    mesh.update()
    for name, scale in (("Plain", 1.0), ("Mirrored", -1.0)):
        obj = bpy.data.objects.new(name, mesh)
        obj.scale[0] = scale
        bpy.context.scene.collection.objects.link(obj)
    return mesh


def test_selection_of_faces_comes_along():
    mesh = two_quads()
    for chosen in ([False, True], [True, False], [False, False]):
        mesh.polygons.foreach_set("select", chosen)
        mesh.update()
        bpy.context.view_layer.update()
        arrays = extract(bpy.context.evaluated_depsgraph_get())
        for obj in arrays.objects:
            assert obj.selected.tolist() == np.repeat(chosen, 2).tolist(), obj.name
    mesh.polygons.foreach_set("select", [False, True])
    mesh.update()
    bpy.context.view_layer.update()
    world = World(extract(bpy.context.evaluated_depsgraph_get()))
    mask = detector(world, "faces", "Mirrored").mask
    (index,) = [i for i, o in enumerate(world.scene.objects) if o.name == "Mirrored"]
    assert mask.sum() == 2 and (world.scene.object[mask] == index).all()


@pytest.mark.parametrize(
    "method,quantity,fits",
    [
        ("potential", "potential", True),
        ("potential", "direct", True),
        ("potential", "irradiance", False),
        ("path_tracing", "potential", False),
    ],
)
def test_a_quantity_that_a_method_does_not_answer_is_refused(method, quantity, fits):
    solver = registry.method(method)
    errors = [str(n) for n in BakeRequest(method, solver.Settings(), quantity=quantity).problems()]
    assert (errors == []) == fits
    assert fits or f"does not answer {quantity}" in errors[0]
    # A camera picture holds all that the method answers.
    assert not BakeRequest(method, solver.Settings(), "render", quantity=quantity).problems()


def test_the_panel_asks_for_what_the_method_answers():
    potential, paths = registry.method("potential"), registry.method("path_tracing")
    assert [fitting_quantity(potential, q) for q in ("irradiance", "radiosity", "direct", "potential")] == [
        "potential",
        "potential",
        "direct",
        "potential",
    ]
    assert fitting_quantity(paths, "irradiance") == "irradiance"
