"""What a large bake costs: processor time and peak memory of a bake from the command line, with all of its files.

    python bench/costs.py atlas [RESOLUTION]        21 cubes below a sun in one atlas (default: 4096); EXR, components and PNG
    python bench/costs.py triangles [NUMBER]        a wavy square of so many triangles (default: 1000000), 512 texels, new UV layer
    python bench/costs.py derived [NUMBER] [SIDE]   so many opaque images (default: 12) of SIDE pixels (4096) through Hue/Saturation

One scene for each run, as memory is that of the whole process. Path tracing with one sample, not denoised. Blender's start is left out.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import bpy
import numpy as np
import slices
from instances import command, load, measured


def atlas(side: int) -> list[str]:
    """Seven by three cubes; how they are baked."""
    for k in range(21):
        bpy.ops.mesh.primitive_cube_add(size=0.8, location=(k % 7, k // 7, 0.5))
    return ["--atlas", "--resolution", str(side)]


def triangles(number: int) -> list[str]:
    """One object of so many; how it is baked."""
    slices.add_grid("Grid", round(math.sqrt(number / 2)), size=10.0)
    return ["--resolution", "512"]


def photo(k: int, side: int, folder: Path) -> bpy.types.Image:
    """An opaque image from a file with about as many colours as a photograph: waves in three colours, and grain."""
    x = np.linspace(0.0, 9.0, side, dtype=np.float32)
    color = np.ones((side, side, 4), np.float32)
    for c in range(3):
        color[..., c] = 0.5 + 0.2 * np.sin(x * (c + 1) + k)[:, None] + 0.2 * np.cos(x * (3 - c))
    color[..., :3] += np.random.default_rng(k).normal(0.0, 0.02, (side, side, 1))
    image = bpy.data.images.new(f"Image{k}", side, side, alpha=False)
    image.pixels.foreach_set(color.ravel())
    path = str(folder / f"photo{k}.png")
    image.filepath_raw, image.file_format = path, "PNG"
    image.save()
    bpy.data.images.remove(image)
    return bpy.data.images.load(path)


def derived(number: int, side: int, folder: Path) -> list[str]:
    """Squares, each with an image that a node changes; how they are baked."""
    for k in range(number):
        slices.add_textured(k, photo(k, side, folder))
        tree = bpy.data.materials[f"Material{k}"].node_tree
        (link,) = (x for x in tree.links if x.from_node.type == "TEX_IMAGE")
        source, target = link.from_socket, link.to_socket
        node = tree.nodes.new("ShaderNodeHueSaturation")
        node.inputs["Saturation"].default_value = 0.5
        tree.links.new(source, node.inputs["Color"])
        tree.links.new(node.outputs["Color"], target)
    return ["--resolution", "64"]


def main() -> None:
    """Build, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", choices=("atlas", "triangles", "derived"))
    parser.add_argument("numbers", nargs="*", type=int)
    options = parser.parse_args()
    load()
    from adjgi.adjoint_gi.core.base.resources import peak_memory, size_text

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.object.light_add(type="SUN", location=(0.0, 0.0, 5.0))
    first, second = (*options.numbers, None, None)[:2]
    with tempfile.TemporaryDirectory() as folder:
        if options.scene == "atlas":
            words = atlas(first or 4096)
        elif options.scene == "triangles":
            words = triangles(first or 1_000_000)
        else:
            words = derived(first or 12, second or 4096, Path(folder))
        bpy.context.view_layer.update()
        words += ["--set", "samples=1", "--no-denoise", "--output", folder]
        seconds = measured(lambda: command("bake", *words))
    name = " ".join([options.scene, *map(str, options.numbers)])
    print(f"{name}: {seconds:.0f} s of processor time, peak memory {size_text(peak_memory())}")


if __name__ == "__main__":
    main()
