"""What a large atlas costs: processor time and peak memory of a bake from the command line, with all of its files.

    python bench/atlas.py [RESOLUTION]        (default: 4096)

21 cubes below a sun in one atlas, path tracing with one sample, not denoised; written are EXR, components and PNG.
"""

from __future__ import annotations

import sys
import tempfile

import bpy
from instances import command, load, measured


def build() -> None:
    """Seven by three cubes and a sun."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    for k in range(21):
        bpy.ops.mesh.primitive_cube_add(size=0.8, location=(k % 7, k // 7, 0.5))
    bpy.ops.object.light_add(type="SUN", location=(0.0, 0.0, 5.0))


def main() -> None:
    """Measure and print."""
    load()
    from adjgi.adjoint_gi.core.base.resources import peak_memory, size_text

    side = sys.argv[1] if len(sys.argv) > 1 else "4096"
    build()
    with tempfile.TemporaryDirectory() as folder:
        words = ["--atlas", "--resolution", side, "--set", "samples=1", "--no-denoise", "--output", folder]
        seconds = measured(lambda: command("bake", *words))
    print(f"atlas of {side}: {seconds:.0f} s of processor time, peak memory {size_text(peak_memory())}")


if __name__ == "__main__":
    main()
