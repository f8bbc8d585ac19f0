"""From the scene to texels and corners and back: what `extract` numbers is what the writers write."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.extract.depsgraph import extract
from adjgi.adjoint_gi.bridge.results.attribute import write_attribute
from adjgi.adjoint_gi.bridge.results.image import read_pixels, write_image
from adjgi.adjoint_gi.core.receivers.margin import FilledImage
from adjgi.adjoint_gi.core.receivers.texels import join, rasterize
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.baking import make_lightmap_uv


def mean_position(world, receivers):
    """(n, 3) world position of every receiver: a value whose right answer is known everywhere."""
    where = world.surface(receivers.triangle, receivers.u, receivers.v).position + world.center
    return np.add.reduceat(where, receivers.start[:-1]) / np.diff(receivers.start)[:, None]


def scene_of_twins():
    """Two objects that share a mesh, one of them mirrored, turned and scaled."""
    bpy.ops.mesh.primitive_monkey_add()
    first = bpy.context.view_layer.objects.active
    twin = bpy.data.objects.new("Twin", first.data)
    bpy.context.scene.collection.objects.link(twin)
    twin.location, twin.rotation_euler, twin.scale = (5, 1, 2), (0.3, 0.2, 0.1), (-1, 2, 0.5)
    bpy.context.view_layer.update()
    return first, twin


def test_texels_of_twins_hold_their_own_places():
    first, twin = scene_of_twins()
    mesh, twin.data = twin.data, twin.data.copy()
    name = make_lightmap_uv(first, resolution=128, padding=2)
    twin.data = mesh  # from now on the layer on the mesh is that of both
    bpy.context.view_layer.update()
    world = World(extract(bpy.context.evaluated_depsgraph_get()))
    names = [o.name for o in world.scene.objects]
    maps = [rasterize(world, [names.index(o.name)], name, 128) for o in (first, twin)]
    both, stretches = join([m.receivers for m in maps])
    value = mean_position(world, both)
    images = []
    for obj, lm, stretch in zip((first, twin), maps, stretches, strict=True):
        filled = FilledImage.of((lm.height, lm.width), lm.pixel, np.ones(len(lm.pixel), bool), 4)
        pixels = filled.image(value[stretch].astype(np.float32))
        images.append(write_image([obj], "irradiance", pixels, lm.share, uv_layer=name))
    assert images[0] != images[1]
    # The same texel of both images is the same point of the mesh, so one is the other moved by the twin's matrix.
    a, b = (read_pixels(image) for image in images)
    inside = (a[..., 3] == 1) & (b[..., 3] == 1)
    matrix = np.array(twin.matrix_world)
    want = a[inside][:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
    assert inside.sum() > 3000 and np.allclose(b[inside][:, :3], want, atol=2e-3)


@pytest.mark.parametrize("domain", ["POINT", "CORNER"])
def test_corners_and_points_of_a_mirrored_object_get_their_own_place(domain):
    first, twin = scene_of_twins()
    twin.data = twin.data.copy()
    world = World(extract(bpy.context.evaluated_depsgraph_get()))
    index = [o.name for o in world.scene.objects].index("Twin")
    m = vertex_receivers(world, [index], domain, inset=1e-3)
    value = m.spread(index, mean_position(world, m.receivers))
    name = write_attribute(twin, "irradiance", domain, value, m.covered(index)).attribute
    data = twin.data.attributes[name].data
    vertex = range(len(data)) if domain == "POINT" else [x.vertex_index for x in twin.data.loops]
    got = np.array([tuple(x.color)[:3] for x in data])
    want = np.array([tuple(twin.matrix_world @ twin.data.vertices[v].co) for v in vertex])
    assert np.abs(got - want).max() < 2e-3
