# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes through the whole pipeline against Cycles' own bakes of the same scene, texels and path lengths: means and every texel.

What is compared, and what is not:

- Cycles' diffuse bake without colour is irradiance / pi. Its bounce limit counts surfaces after the baked one: path length - 1.
- Cycles bakes a texel when its centre is covered, and samples inside the one triangle that covers the centre. Compared are texels that
  lie wholly on one triangle.
- Cycles before 5.2 spreads its samples over the middle half of a texel (half its width and height), ours cover all of it; see
  `test_how_cycles_samples_a_texel`. Where light is smooth, second order says what that changes, see `widened`. Texels that
  the outline of a box cuts are left out, and lamps with hard shadows get a scene whose shadow falls beside the floor.

Noise is measured: every bake is repeated with independent seeds, and the variances of neighbouring texels are averaged.
"""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from adjgi.adjoint_gi.bridge.cli import cornell as demo
from adjgi.tests import baking
from adjgi.tests.cycles_patch import add_light, diffuse_material, shader_material, white_plane

SEEDS = 8
MORE_SEEDS = {"spot": 12}  # which lights a part of the floor alone, so that its mean has more noise
TEXELS = 16
SAMPLES = 48
BRIGHT = {"energy": 100.0}
DOWN = (0.15, -0.1, 0.0)  # rotation of lamps that have a direction, rad
# kind, values of the lamp, whether its shadows are soft
LAMPS = {
    "point without radius": ("POINT", {**BRIGHT, "shadow_soft_size": 0.0}, False),
    "point": ("POINT", {**BRIGHT, "shadow_soft_size": 0.4, "use_soft_falloff": False, "color": (1.0, 0.5, 0.25)}, True),
    "point, soft falloff": ("POINT", {**BRIGHT, "shadow_soft_size": 0.4, "use_soft_falloff": True}, True),
    "sun without angle": ("SUN", {"energy": 3.0, "angle": 0.0}, False),
    "sun": ("SUN", {"energy": 3.0, "angle": 0.7}, True),
    "spot without radius": ("SPOT", {**BRIGHT, "shadow_soft_size": 0.0, "spot_size": 2.0, "spot_blend": 1.0}, False),
    "spot": ("SPOT", {**BRIGHT, "shadow_soft_size": 0.3, "spot_size": 1.6, "spot_blend": 0.8, "use_soft_falloff": False}, True),
    "square": ("AREA", {**BRIGHT, "shape": "SQUARE", "size": 1.0}, True),
    "rectangle": ("AREA", {**BRIGHT, "shape": "RECTANGLE", "size": 0.5, "size_y": 1.5}, True),
    "disk": ("AREA", {**BRIGHT, "shape": "DISK", "size": 1.2}, True),
    "ellipse": ("AREA", {**BRIGHT, "shape": "ELLIPSE", "size": 0.6, "size_y": 1.5}, True),
    "area with spread": ("AREA", {**BRIGHT, "shape": "SQUARE", "size": 1.0, "spread": 2.5}, True),
}
OTHERS = ("mesh", "world")


def stage(blocker):
    """A floor of 4 m with a red wall along one side; with `blocker` a sheet hangs over it. Returns the floor."""
    floor = white_plane(4.0, diffuse_material("floor", 0.6))
    red = shader_material("red", "ShaderNodeBsdfDiffuse", Color=(0.8, 0.3, 0.2, 1.0))
    baking.quad("wall", [(2, -2, 0), (2, 2, 0), (2, 2, 2), (2, -2, 2)], red)
    if blocker:
        baking.quad("blocker", [(-0.9, -0.4, 1), (0.1, -0.5, 1), (0.2, 0.5, 1), (-0.8, 0.5, 1)], red)
    return floor


def light(case):
    """The stage with one light."""
    if case == "mesh":
        floor = stage(True)
        lamp = shader_material("lamp", "ShaderNodeEmission", Color=(1.0, 0.8, 0.5, 1.0), Strength=12.0)
        # Its normal points up: Cycles emits from both sides.
        baking.quad("lamp", [(-0.9, -0.3, 2), (0.1, -0.3, 2.2), (0.1, 0.7, 2.2), (-0.9, 0.7, 2)], lamp)
    elif case == "world":
        floor = stage(True)
        world = bpy.context.scene.world = bpy.data.worlds.new("sky")
        demo.black_world(world, (0.5, 0.7, 1.0))
    else:
        kind, values, soft = LAMPS[case]
        floor = stage(soft)
        add_light(kind, location=(-0.4, 0.2, 2.0), rotation=DOWN, **values)
    bpy.context.view_layer.update()
    return floor


def show(comparison, limit):
    """The numbers of a comparison, for the message of a failure."""
    c = comparison
    rms = float(np.sqrt((c.z**2).mean()))
    means = f"mean {100 * c.mean:+.2f} +- {100 * c.mean_error:.2f} %"
    return f"{means}, z rms {rms:.2f}, worst {c.worst:.2f} of {limit:.2f}, noise {100 * c.noise:.2f} %"


def check(comparison, noise, comparisons):
    """Means within 1 %, every texel of all such comparisons within noise, noise as small as said and as large as it claims to be."""
    c, limit = comparison, comparison.limit(comparisons)
    said = show(c, limit)
    print(said)
    assert abs(c.mean) < 0.01, said
    assert c.mean_error < 0.003, said
    assert c.worst < limit, said
    assert np.sqrt((c.z**2).mean()) < 1.2, said
    assert c.noise < noise, said


def widened(image):
    """A bake over the middle half of each texel as one over all of it: their second moments differ by 1/12 - 1/48 = 1/16 texels^2."""
    p = np.pad(image, [(1, 1), (1, 1), (0, 0)], mode="edge")
    return image + (p[2:, 1:-1] + p[:-2, 1:-1] + p[1:-1, 2:] + p[1:-1, :-2] - 4 * image) / 32


def inner(mask):
    """Texels whose neighbours are known."""
    out = np.zeros_like(mask)
    out[1:-1, 1:-1] = mask[1:-1, 1:-1]
    return out


@pytest.fixture(scope="module")
def edge():
    return slanted_edge()


def covers_all(edge):
    """Whether this Cycles spreads its samples over the whole texel: then it gives a texel of which an eighth is lit some light."""
    return edge[0][1] > 0.1


@pytest.mark.parametrize("case", [*LAMPS, *OTHERS])
def test_every_kind_of_light(edge, case):
    floor = light(case)
    baking.use_cycles(bpy.context.scene, 3)
    values = {"samples": SAMPLES, "max_length": 3}
    more = {"resolution": TEXELS, "subsamples": 256, "objects": ("plane",), "uv_layer": "UVMap"}
    seeds = range(MORE_SEEDS.get(case, SEEDS))
    ours = [baking.lightmaps(baking.request(values={**values, "seed": seed}, **more))["plane"] for seed in seeds]
    theirs = [baking.cycles_irradiance(floor, TEXELS, "UVMap", SAMPLES, seed) for seed in seeds]
    theirs = theirs if covers_all(edge) else [widened(image) for image in theirs]
    used = inner(ours[0].whole)
    assert used.sum() > 0.7 * TEXELS**2
    check(baking.compare([o.values for o in ours], theirs, used), noise=0.035, comparisons=len(LAMPS) + len(OTHERS))


SHARES = (np.arange(8) + 0.5) / 8  # of the texels of `slanted_edge` that the sun reaches


def slanted_edge():
    """(8,) irradiance by Cycles and by us of texels that the edge of a hard shadow crosses, each a little further along."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    floor = white_plane(8.0, diffuse_material("floor", 0.5))
    baking.quad("edge", [(-9, -9 / 8 + 2.5, 1), (9, 9 / 8 + 2.5, 1), (9, 20, 1), (-9, 20, 1)], diffuse_material("edge", 0.5))
    add_light("SUN", energy=1.0, angle=0.0)
    bpy.context.view_layer.update()
    baking.use_cycles(bpy.context.scene, 1)
    theirs = baking.cycles_irradiance(floor, 8, "UVMap", 512, 0)[6, :, 0]
    more = {"resolution": 8, "subsamples": 256, "objects": ("plane",), "uv_layer": "UVMap"}
    ours = baking.lightmaps(baking.request(values={"samples": 1024, "max_length": 1}, **more))["plane"].values[6, :, 0]
    return theirs, ours


def test_how_cycles_samples_a_texel(edge):
    """Ours covers the texel exactly. Cycles covers its middle half, from 5.2 on all of it; on the diagonal (texel 6) only a triangle."""
    (theirs, ours), off_diagonal = edge, np.arange(8) != 6
    np.testing.assert_allclose(ours, SHARES, atol=0.02)
    expected = SHARES if covers_all(edge) else np.clip(2 * SHARES - 0.5, 0, 1)
    np.testing.assert_allclose(theirs[off_diagonal], expected[off_diagonal], atol=0.02)


# ---- the Cornell box

BOX = 52  # texels; with fewer too many of the boxes lie on the edges of charts
BOX_SAMPLES = 64
LENGTH = 5
WALLS = ("Floor", "Ceiling", "Back Wall", "Left Wall", "Right Wall", "Short Box", "Tall Box")


def cornell(monkeypatch, cells):
    """The demonstration scene, its walls cut into `cells` x `cells` faces."""
    monkeypatch.setattr(demo, "CELLS", cells)
    scene = demo.build_cornell()
    baking.use_cycles(scene, LENGTH)
    return scene


def box_request(method, values, **more):
    return baking.request(method, values={"max_length": LENGTH, **values}, resolution=BOX, **{"subsamples": 64, **more})


@pytest.fixture(scope="module")
def reference():
    """Cycles' bakes of the Cornell box, three seeds of each object, and our path tracing's of the same texels."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with pytest.MonkeyPatch.context() as patch:
        scene = cornell(patch, 2)
        with baking.shown(scene):
            ours = [baking.lightmaps(box_request("path_tracing", {"samples": BOX_SAMPLES, "seed": seed})) for seed in range(3)]
            theirs = {
                name: [baking.cycles_irradiance(scene.objects[name], BOX, ours[0][name].layer, BOX_SAMPLES, seed) for seed in range(3)]
                for name in WALLS
            }
            boxes = [scene.objects[name] for name in WALLS if "Box" in name]
            used = {name: ours[0][name].whole & ~baking.outlined(ours[0][name], boxes) for name in WALLS}
    return ours, theirs, used


@pytest.mark.slow
@pytest.mark.parametrize("name", WALLS)
def test_cornell_box(reference, name):
    ours, theirs, used = reference
    share = used[name].sum() / (ours[0][name].share > 0).sum()
    assert share > (0.7 if "Box" in name else 0.85)
    noise = 0.11 if name == "Ceiling" else 0.06  # the lamp is a centimetre below the ceiling
    check(baking.compare([o[name].values for o in ours], theirs[name], used[name]), noise=noise, comparisons=len(WALLS))


# Settings, and the stated error of the mean irradiance of an object: elements of 5 cm, a million particles.
OTHER_METHODS = {
    "matrix_radiosity": ({"max_edge": 0.05, "rays": 512}, 0.015),
    "progressive_radiosity": ({"max_edge": 0.05, "rays": 4_000_000}, 0.015),
    "particle_tracing": ({"particles": 1_000_000}, 0.015),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", OTHER_METHODS)
def test_other_methods_in_the_cornell_box(reference, monkeypatch, method):
    _, theirs, used = reference
    values, allowed = OTHER_METHODS[method]
    scene = cornell(monkeypatch, 2)
    with baking.shown(scene):
        got = baking.lightmaps(box_request(method, values))
    ours = {name: got[name].values[used[name]] for name in WALLS}
    expected = {name: np.mean(theirs[name], axis=0)[used[name]] for name in WALLS}
    difference = {name: ours[name].mean() / expected[name].mean() - 1 for name in WALLS}
    said = ", ".join(f"{name} {100 * d:+.2f} %" for name, d in difference.items())
    print(said)
    assert all(abs(d) < allowed for d in difference.values()), said
    whole = [sum(part.sum() for part in parts.values()) for parts in (ours, expected)]
    assert whole[0] == pytest.approx(whole[1], rel=0.01)
