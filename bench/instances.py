"""What thousands of instances cost from the command line: processor time of check, bake, Show Result and Clear Results.

    python bench/instances.py [NUMBER ...] [--target attribute] [--layers 8]        (default: 1000 2000 4000)

Each NUMBER is a grid of so many cubes, all instances of one mesh with that many UV layers, baked with Bake Instances at one sample.
Figures of two numbers beside each other show whether a step grows in line with them.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parent.parent
WORDS = ["--instances", "--resolution", "16", "--subsamples", "1", "--threads", "1", "--method", "path_tracing"]
WORDS += ["--set", "samples=1", "--set", "max_length=3"]


def load() -> None:
    """The extension as the package `adjgi`, registered, as a bake needs it."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
    sys.modules["adjgi"].register()


def build(number: int, layers: int) -> int:
    """A scene of some `number` cubes below a sun, instances on the vertices of a grid; returns how many there are."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    side = round(math.sqrt(number))
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=side - 1, y_subdivisions=side - 1, size=float(side))
    grid = bpy.context.object
    bpy.ops.mesh.primitive_cube_add(size=0.5)
    cube = bpy.context.object
    for k in range(len(cube.data.uv_layers), layers):
        cube.data.uv_layers.new(name=f"UV{k}")
    cube.parent, grid.instance_type = grid, "VERTS"
    bpy.ops.object.light_add(type="SUN", location=(0.0, 0.0, 5.0))
    return side * side


def measured(work: Callable[[], None]) -> float:
    """Seconds of processor time of `work`."""
    before = time.process_time()
    work()
    return time.process_time() - before


def command(*words: str) -> None:
    """A command of ours in this Blender; stops with what it said where it refuses."""
    from adjgi.adjoint_gi.bridge.cli.main import main as run

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run([*words], in_blender=True)
    if code:
        sys.exit(f"{words[0]} ended with {code}:\n{said.getvalue()[-2000:]}")


def show(target: str) -> None:
    """Show Result."""
    from adjgi.adjoint_gi.bridge.results import show as results

    record = bpy.context.scene.adjoint_gi.result  # the panel would have written it
    record.target, record.quantity = target, "irradiance"
    print(f"   shown on {results.show(bpy.context.scene, bpy.context.view_layer)} objects", flush=True)


def clear() -> None:
    """Clear Results with Remove Baked Data."""
    from adjgi.adjoint_gi.bridge.results import show as results
    from adjgi.adjoint_gi.bridge.results.remove import remove_results

    results.restore(bpy.context.scene)
    remove_results(bpy.context.scene)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("numbers", nargs="*", type=int, default=[1000, 2000, 4000])
    parser.add_argument("--target", choices=("attribute", "texture"), default="attribute")
    parser.add_argument("--layers", type=int, default=1, help="UV layers of the mesh (default: %(default)s)")
    options = parser.parse_args()
    load()
    for number in options.numbers:
        there = build(number, options.layers)
        with tempfile.TemporaryDirectory() as folder:
            own = ["--output", folder] if options.target == "texture" else ["--save-blend", str(Path(folder) / "out.blend")]
            words = ["--target", options.target, *WORDS]
            print(f"{there} instances, {options.target}, {options.layers} UV layers", flush=True)
            steps = {"check": lambda w=words: command("check", *w), "bake": lambda w=words, o=own: command("bake", *w, *o)}
            for name, work in {**steps, "show": lambda: show(options.target), "clear": clear}.items():
                seconds = measured(work)
                print(f"   {name:6}{seconds:8.1f} s of processor time, {1000 * seconds / there:6.1f} ms each", flush=True)


if __name__ == "__main__":
    main()
