# SPDX-License-Identifier: GPL-3.0-or-later
"""The standing test room, with nothing applied, against a Cycles bake of its applied meshes into the same texels."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.tests import baking, room

TEXELS, LENGTH = 128, 3
SEEDS = 3
DARK = 0.3  # W m-2; below, where a few paths to the sun's patch make all of the light, texels are compared with this
COMPARED = ("Walls", "Planks", "Cupboard", "Stool Twin")


def ours(seed):
    """The atlas, and the object of each texel that lies wholly on one triangle."""
    values = {"samples": 16, "max_length": LENGTH, "seed": seed}
    made = baking.bake(baking.request(atlas=True, resolution=TEXELS, values=values))
    (sheet,), world = made.writer.sheets, made.driver.world
    r = sheet.lightmap.receivers
    first = r.start[:-1]
    one = np.minimum.reduceat(r.triangle, first) == np.maximum.reduceat(r.triangle, first)
    owner = np.full(TEXELS * TEXELS, -1)
    owner[sheet.lightmap.pixel] = np.where(one, world.scene.object[r.triangle[first]], -1)
    owner = np.where(sheet.lightmap.share == 1, owner.reshape(TEXELS, TEXELS), -1)
    pixels = read_pixels(linked_image(bpy.data.objects["Walls"], "irradiance"))[..., :3].astype(np.float64)
    return pixels, owner, [o.source for o in world.scene.objects]


def applied(name):
    """A copy of an object with its modifiers applied, in its place."""
    obj = bpy.data.objects[name]
    depsgraph = bpy.context.evaluated_depsgraph_get()
    mesh = bpy.data.meshes.new_from_object(obj.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph)
    assert len(mesh.polygons) and "Lightmap" in mesh.uv_layers
    copy = bpy.data.objects.new(f"{name} applied", mesh)
    copy.matrix_world = obj.matrix_world
    bpy.context.scene.collection.objects.link(copy)
    obj.hide_render = True
    return copy


def test_texels_of_the_room_are_those_of_the_applied_meshes():
    if not hasattr(bpy.types.Scene, "cycles"):
        pytest.skip("this Blender has no Cycles")
    scene = room.build(extras=False)
    mine = [ours(seed) for seed in range(SEEDS)]
    owner, names = mine[0][1:]
    copies = {name: applied(name) for name in COMPARED}
    bpy.context.view_layer.update()
    baking.use_cycles(scene, LENGTH)
    for name, copy in copies.items():
        theirs = np.stack([baking.cycles_irradiance(copy, TEXELS, "Lightmap", 16, seed) for seed in range(SEEDS)])
        own = np.stack([pixels for pixels, _, _ in mine])
        used = owner == names.index(name)
        a, b = own.mean(axis=0)[used], theirs.mean(axis=0)[used]
        error = np.sqrt((own.var(axis=0, ddof=1)[used] + theirs.var(axis=0, ddof=1)[used]) / SEEDS)
        lit = b.mean(axis=0) > 0
        difference, noise = a.mean() / b.mean() - 1, np.sqrt((error**2).sum()) / b.sum()
        far = np.abs(a - b) > 5 * np.maximum(error, 0.1 * max(b.mean(), DARK))
        print(f"{name}: {used.sum()} texels, {100 * difference:+.1f} +- {100 * noise:.1f} %, {100 * far.mean():.1f} % far off")
        assert lit.all() and used.sum() > 20
        assert abs(a.mean() - b.mean()) < 0.02 * b.mean() + 3 * noise * b.mean() + 0.1 * DARK
        assert far.any(axis=1).sum() <= max(1, 0.03 * len(far)), "one may be a firefly"
