"""Principled's default in a closed room against Cycles: how much more light its base below the coat keeps, by where the light comes from.

    python bench/principled_room.py [--samples 256] [--seeds 4] [--resolution 32]        (a Python with bpy, numpy, embreex)

A closed cube of 2 m: five walls of a material, the ceiling diffuse; bounces without limit. Bakes the ceiling (of the lamp: the floor) by
our path tracing and by Cycles, several seeds each, and prints ours over Cycles less one with its standard error.
docs/cycles-differences.md, "The base below the coat of Principled", has the table and the reason.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import bpy
import numpy as np
from cycles_agreement import baking, demo

FACES = {
    "Floor": [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)],
    "Ceiling": [(-1, -1, 1), (-1, 1, 1), (1, 1, 1), (1, -1, 1)],
    "Left": [(-1, -1, -1), (-1, 1, -1), (-1, 1, 1), (-1, -1, 1)],
    "Right": [(1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1)],
    "Front": [(-1, -1, -1), (-1, -1, 1), (1, -1, 1), (1, -1, -1)],
    "Back": [(-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)],
}


def room(principled: bool, emission: float = 0.0) -> None:
    """The cube alone."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    walls = demo.material("Walls", (0.8, 0.8, 0.8))
    if principled:
        walls = bpy.data.materials.new("Principled")
        walls.use_nodes = True
        (shader,) = (n for n in walls.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        shader.inputs["Emission Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        shader.inputs["Emission Strength"].default_value = emission
    ceiling = demo.material("Ceiling", (0.8, 0.8, 0.8))
    for name, corners in FACES.items():
        baking.quad(name, corners, ceiling if name == "Ceiling" else walls)


def beam(degrees: float) -> None:
    """A parallel beam, some 0.9 m wide where it meets the middle of the floor, at an angle to its normal."""
    angle = math.radians(degrees)
    lamp = bpy.data.lights.new("Beam", "AREA")
    lamp.energy, lamp.shape, lamp.spread = 10.0, "RECTANGLE", math.radians(1.0)
    lamp.size, lamp.size_y = 0.9 * math.cos(angle), 0.9
    obj = bpy.data.objects.new("Beam", lamp)
    obj.location, obj.rotation_euler = (0.9 * math.sin(angle), 0.0, 0.9 * math.cos(angle) - 1.0), (0.0, angle, 0.0)
    bpy.context.scene.collection.objects.link(obj)


def lamp() -> None:
    """A ball of light in the middle."""
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = 100.0, 0.3
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Lamp", data))


CASES: dict[str, tuple[Callable[[], None], bool, float, str, float]] = {
    "emission on all walls but the ceiling": (lambda: None, True, 1.0, "Ceiling", 0.0),
    "a beam straight on the floor": (lambda: beam(0.0), True, 0.0, "Ceiling", 0.0),
    "a beam at 60 degrees": (lambda: beam(60.0), True, 0.0, "Ceiling", 0.0),
    "a beam at 80 degrees": (lambda: beam(80.0), True, 0.0, "Ceiling", 0.0),
    "a lamp of 0.3 m radius in the middle (of the floor's irradiance)": (lamp, True, 0.0, "Floor", 0.0),
    "the same, walls Diffuse 0.8": (lamp, False, 0.0, "Floor", 0.0),
    "the same against Cycles with Filter Glossy at its default of 1": (lamp, True, 0.0, "Floor", 1.0),
}


def main() -> None:
    """Bake and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=256, help="of each bake")
    parser.add_argument("--seeds", type=int, default=4, help="bakes by each renderer")
    parser.add_argument("--resolution", type=int, default=32)
    options = parser.parse_args()
    print("| lit by | ours over Cycles - 1 |\n| --- | --- |")
    for name, (light, principled, emission, receiver, filtered) in CASES.items():
        room(principled, emission)
        light()
        scene = bpy.context.scene
        baking.use_cycles(scene, 1024)
        scene.cycles.blur_glossy = filtered
        ours, theirs = [], []
        for seed in range(options.seeds):
            values = {"samples": options.samples, "seed": seed}
            found = baking.lightmaps(baking.request(values=values, resolution=options.resolution, subsamples=4))[receiver]
            ours.append(found.values[found.whole].mean())
            obj = scene.objects[receiver]
            theirs.append(baking.cycles_irradiance(obj, options.resolution, found.layer, options.samples, seed)[found.whole].mean())
        means, errors = zip(*((np.mean(x), np.std(x, ddof=1) / math.sqrt(len(x)) / np.mean(x)) for x in (ours, theirs)), strict=True)
        print(f"| {name} | {means[0] / means[1] - 1:+.1%} +- {math.hypot(*errors):.1%} |", flush=True)


if __name__ == "__main__":
    main()
