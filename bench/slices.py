"""How long what comes before a solve holds the main thread at a time: the longest slices, and what they spent their time on.

    python bench/slices.py objects | grid | images | painted | FILE.blend [--resolution 256] [--top 5] [--profile]

The scenes made here: 1,000 objects with a mesh each, one object of a million triangles, and 8 textures of 2048, of files or painted.
A bake is prepared as the panel does it, slice after slice, with the parts aside in their thread; it is not solved.
"""

from __future__ import annotations

import argparse
import cProfile
import importlib.util
import pstats
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SIDE = 2048  # pixels of an image


def load() -> None:
    """The extension as the package `adjgi`."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])


def add_grid(name: str, side: int, x: float = 0.0, y: float = 0.0, size: float = 1.0) -> bpy.types.Object:
    """A wavy square of `side` quads a side."""
    step = np.linspace(0.0, size, side + 1, dtype=np.float32)
    points = np.zeros((side + 1, side + 1, 3), np.float32)
    points[..., 0], points[..., 1] = step[None, :] + x, step[:, None] + y
    points[..., 2] = 0.1 * np.sin(7.0 * points[..., 0]) * np.cos(5.0 * points[..., 1])
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    corners = np.stack([first, first + 1, first + side + 2, first + side + 1], axis=1).astype(np.int32)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(points.size // 3)
    mesh.vertices.foreach_set("co", points.ravel())
    mesh.loops.add(corners.size)
    mesh.loops.foreach_set("vertex_index", corners.ravel())
    mesh.polygons.add(len(corners))
    mesh.polygons.foreach_set("loop_start", np.arange(0, corners.size, 4, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(corners), bool))
    mesh.update(calc_edges=True)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def add_textured(k: int, image: bpy.types.Image) -> None:
    """A small square with a material that shows `image`."""
    obj = add_grid(f"Square{k}", 1, x=2.0 * k)
    obj.data.uv_layers.new(name="UVMap")
    material = bpy.data.materials.new(f"Material{k}")
    material.use_nodes = True
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    obj.data.materials.append(material)


def painted(k: int) -> bpy.types.Image:
    """An image with pixels that no file has."""
    image = bpy.data.images.new(f"Image{k}", SIDE, SIDE, alpha=True)
    image.pixels.foreach_set(np.random.default_rng(k).random(4 * SIDE * SIDE, np.float32))
    return image


def of_file(k: int, folder: Path | None = None) -> bpy.types.Image:
    """The same, from a file."""
    image = painted(k)
    image.filepath_raw, image.file_format = str((folder or Path(tempfile.gettempdir())) / f"slices{k}.png"), "PNG"
    image.save()
    path = image.filepath_raw
    bpy.data.images.remove(image)
    return bpy.data.images.load(path)


def make(what: str) -> None:
    """Open or build the scene `what`."""
    if what.endswith(".blend"):
        bpy.ops.wm.open_mainfile(filepath=what, use_scripts=False)
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")  # as the level zdm2 was saved
    else:
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if what == "objects":
        for k in range(1000):
            add_grid(f"Object{k}", 8, x=1.5 * (k % 32), y=1.5 * (k // 32))
    elif what == "grid":
        add_grid("Grid", 708, size=10.0)
    elif what in ("images", "painted"):
        for k in range(8):
            add_textured(k, of_file(k) if what == "images" else painted(k))
    if bpy.context.scene.world is None:
        bpy.context.scene.world = bpy.data.worlds.new("Lit")
        bpy.context.scene.world.color = (1.0, 1.0, 1.0)
    bpy.context.view_layer.update()


def measure(stages, profiled: bool) -> list[tuple[float, str, pstats.Stats | None]]:
    """Prepare to the end; seconds, name and profile of every part on the main thread."""
    from adjgi.adjoint_gi.bridge.host.preparation import Preparation

    rows: list[tuple[float, str, pstats.Stats | None]] = []
    name = "start"
    preparation = Preparation(stages)
    whole = preparation._next

    def timed() -> None:
        nonlocal name
        profile = cProfile.Profile() if profiled else None
        began = time.perf_counter()
        profile.runcall(whole) if profile else whole()
        rows.append((time.perf_counter() - began, f"after {name!r}", pstats.Stats(profile) if profile else None))
        name = preparation.text

    preparation._next = timed
    while preparation.state == "running":
        preparation.advance(0.05)
    if preparation.error is not None:
        raise preparation.error
    return rows


def main() -> None:
    """Build, prepare, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene")
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--top", type=int, default=6)
    parser.add_argument("--profile", action="store_true", help="print what the longest spent its time on")
    parser.add_argument("--objects", nargs="*", default=())
    options = parser.parse_args()
    load()
    sys.modules["adjgi"].register()
    from adjgi.adjoint_gi.bridge.baking.bake import Bake
    from adjgi.adjoint_gi.bridge.baking.preflight import preflighting
    from adjgi.tests.baking import request

    make(options.scene)
    wanted = request(values={"samples": 1}, resolution=options.resolution, atlas=True, objects=tuple(options.objects))
    for title, stages in (
        ("Check", lambda: preflighting(bpy.context, wanted)),
        ("Bake", lambda: Bake(bpy.context, wanted, now=False).preparing()),
        ("Bake again", lambda: Bake(bpy.context, wanted, now=False).preparing()),
    ):
        began = time.perf_counter()
        rows = measure(stages(), options.profile)
        spent = sum(seconds for seconds, _, _ in rows)
        print(f"{title}: {time.perf_counter() - began:.2f} s, {spent:.2f} s on the main thread in {len(rows)} parts; the longest:")
        for seconds, name, profile in sorted(rows, key=lambda row: -row[0])[: options.top]:
            print(f"  {seconds:.3f} s {name}")
            if profile is not None and seconds > 0.08:
                profile.sort_stats("tottime").print_stats(12)
    sys.modules["adjgi"].unregister()


if __name__ == "__main__":
    main()
