# SPDX-License-Identifier: GPL-3.0-or-later
"""The standing test room, with nothing applied, against a Cycles bake of its applied meshes into the same texels."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.tests import baking, room

TEXELS, LENGTH, SEEDS = 128, 3, 3
# Samples by object. Where it is dark, few paths to the sun's patch make all of the light: of too few, the estimated noise is too small too.
SAMPLES = {"Walls": 16, "Planks": 64, "Cupboard": 64, "Table": 128, "Stool Twin": 512}


def ours(name, seed, samples):
    """Pixels of the atlas with the light of object `name`, and the texels of it that lie wholly on one triangle."""
    values = {"samples": samples, "max_length": LENGTH, "seed": seed}
    made = baking.bake(baking.request(atlas=True, resolution=TEXELS, objects=(name,), values=values))
    (sheet,) = made.writer.sheets
    pixels = read_pixels(linked_image(bpy.data.objects[name], "irradiance"))[..., :3]
    return pixels.astype(np.float64), baking.on_one_triangle(sheet.lightmap)


def applied(name):
    """A copy of an object with its modifiers applied, in its place."""
    obj = bpy.data.objects[name]
    depsgraph = bpy.context.evaluated_depsgraph_get()
    mesh = bpy.data.meshes.new_from_object(obj.evaluated_get(depsgraph), preserve_all_data_layers=True, depsgraph=depsgraph)
    assert len(mesh.polygons) and "Lightmap" in mesh.uv_layers
    mesh.uv_layers.active = mesh.uv_layers["Lightmap"]  # Blender 5.2 leaves none active
    copy = bpy.data.objects.new(f"{name} applied", mesh)
    copy.matrix_world = obj.matrix_world
    bpy.context.scene.collection.objects.link(copy)
    obj.hide_render = True
    return copy


def test_texels_of_the_room_are_those_of_the_applied_meshes():
    if not hasattr(bpy.types.Scene, "cycles"):
        pytest.skip("this Blender has no Cycles")
    scene = room.build(extras=False)
    baking.bake(baking.request(atlas=True, resolution=TEXELS, objects=tuple(SAMPLES), values={"samples": 1}))  # lays out the atlas
    mine = {name: [ours(name, seed, n) for seed in range(SEEDS)] for name, n in SAMPLES.items()}
    copies = {name: applied(name) for name in SAMPLES}
    bpy.context.view_layer.update()
    baking.use_cycles(scene, LENGTH)
    for name, copy in copies.items():
        theirs = np.stack([baking.cycles_irradiance(copy, TEXELS, "Lightmap", SAMPLES[name], seed) for seed in range(SEEDS)])
        own, used = np.stack([pixels for pixels, _ in mine[name]]), mine[name][0][1]
        a, b = own.mean(axis=0)[used], theirs.mean(axis=0)[used]
        error = np.sqrt((own.var(axis=0, ddof=1)[used] + theirs.var(axis=0, ddof=1)[used]) / SEEDS)
        lit = b.mean(axis=0) > 0
        difference, noise = a.mean() / b.mean() - 1, np.sqrt((error**2).sum()) / b.sum()
        # Of three seeds a texel's own noise is a guess: it counts nowhere for less than that of its object.
        far = np.abs(a - b) > 5 * np.maximum(error, max(0.1 * b.mean(), np.sqrt((error**2).mean())))
        print(f"{name}: {used.sum()} texels, {100 * difference:+.1f} +- {100 * noise:.1f} %, {100 * far.mean():.1f} % far off")
        assert lit.all() and used.sum() > 20
        assert abs(difference) < 0.02 + 3 * noise
        assert far.any(axis=1).sum() <= max(1, 0.03 * len(far)), "one may be a firefly"
