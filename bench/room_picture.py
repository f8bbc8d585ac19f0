# SPDX-License-Identifier: GPL-3.0-or-later
"""The standing test room: its lightmap in the window of a real Blender, beside F12 of Cycles, as one picture.

    python bench/room_picture.py [--out docs/pictures] [--blender PROGRAM] [--samples 256] [--resolution 512] [--bake-samples N]

Builds `tests/room.py`, bakes it as the button Bake does - by the default method and settings, denoised, to one atlas - shows the result
and saves the file; nothing is applied. Then a Blender with a window opens that file, without the extension, and its viewport is taken; and
Cycles renders the room as it was before. Prints the seconds of the bake, from the call to the result, and of the render. Needs a
Python with the bpy wheel that is no newer than that Blender, which must be ../shared/tools/real-blender: it has ImageMagick at hand.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SIZE = (480, 360)  # of each half
SECONDS = 150.0  # that the window has to compile and to draw; before that EEVEE shows grey in the light of the world
SESSION = """
import subprocess, sys, bpy
out = sys.argv[-1]
def shoot():
    subprocess.run(["import", "-window", "root", out], check=True, timeout=60)
    bpy.ops.wm.quit_blender()
def arrange():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)
    with bpy.context.temp_override(window=window, area=area, region=next(r for r in area.regions if r.type == "WINDOW")):
        bpy.ops.screen.screen_full_area(use_hide_panels=True)
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    space = area.spaces.active
    space.show_region_ui = space.show_region_toolbar = space.show_gizmo = False
    space.overlay.show_overlays = False
    space.shading.type = "RENDERED"
    space.region_3d.view_perspective = "CAMERA"
    with bpy.context.temp_override(window=window, area=area, region=next(r for r in area.regions if r.type == "WINDOW")):
        bpy.ops.view3d.view_center_camera()
    bpy.app.timers.register(shoot, first_interval=float(sys.argv[-2]))
    from bpy_extras.view3d_utils import location_3d_to_region_2d as place
    region = next(r for r in area.regions if r.type == "WINDOW")
    def told():
        camera = bpy.context.scene.camera
        corners = [camera.matrix_world @ v for v in camera.data.view_frame(scene=bpy.context.scene)]
        at, corner = [place(region, space.region_3d, c) for c in corners], (region.x, region.y)
        print("FRAME", window.height, *(round(f([p[k] for p in at]) + corner[k]) for f in (min, max) for k in (0, 1)), flush=True)
    bpy.app.timers.register(told, first_interval=float(sys.argv[-2]) - 5)
bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(arrange, first_interval=2.0)
"""


def bake_room(folder: Path, samples: int, resolution: int, bake_samples: int | None) -> None:
    """Save the baked room as room.blend in `folder`, and F12 of the room as rendered.png. Loads the repository as the package adjgi."""
    spec = importlib.util.spec_from_file_location("adjgi", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["adjgi"])
    import bpy
    from adjgi.tests import room

    sys.modules["adjgi"].register()
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    scene = room.build()
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *SIZE, 100
    scene.view_settings.view_transform = "Standard"
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", samples, "CPU"
    scene.render.filepath = str(folder / "rendered.png")
    began = time.perf_counter()
    bpy.ops.render.render(write_still=True)
    rendered = time.perf_counter() - began
    state = scene.adjoint_gi
    state.selection_only, state.atlas, state.resolution = False, True, resolution
    if bake_samples is not None:
        state.settings_path_tracing.samples = bake_samples
    began = time.perf_counter()
    bpy.ops.adjoint_gi.bake()
    whole, paths = time.perf_counter() - began, state.settings_path_tracing.samples
    print(f"baked in {whole:.1f} s ({state.result.seconds:.1f} s solving): {resolution} x {resolution} texels, {paths} samples each")
    print(f"rendered in {rendered:.1f} s: {SIZE[0]} x {SIZE[1]} pixels, {samples} samples each")
    bpy.ops.adjoint_gi.show_result()
    scene.render.filepath = str(folder / "shown.png")
    bpy.ops.render.render(write_still=True)
    see_through(scene)
    scene.render.engine = next(e for e in ("BLENDER_EEVEE_NEXT", "BLENDER_EEVEE") if e in engines(scene))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "room.blend"))


def see_through(scene) -> None:
    """EEVEE shows the world in place of what is behind glass, unless it is told to trace rays."""
    if hasattr(scene.eevee, "use_raytracing"):
        scene.eevee.use_raytracing = True
    pane = scene.objects["Pane"].active_material
    for name in ("use_raytrace_refraction", "use_screen_refraction"):
        if hasattr(pane, name):
            setattr(pane, name, True)


def engines(scene) -> list[str]:
    """Names that Blender knows for its engines, of which EEVEE has had two."""
    try:
        scene.render.engine = ""
    except TypeError as error:
        return str(error).split("'")
    return []


def take_window(folder: Path, blender: str) -> None:
    """Save what the viewport of `blender` shows of room.blend through the camera as window.png."""
    script, shot = folder / "session.py", folder / "root.png"
    script.write_text(SESSION)
    command = [blender, "--factory-startup", str(folder / "room.blend"), "--python", str(script), "--", str(SECONDS), str(shot)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, stdin=subprocess.DEVNULL)
    frame = next((line for line in done.stdout.splitlines() if line.startswith("FRAME ")), None)
    if frame is None:
        sys.exit(f"the window gave no picture:\n{done.stdout}\n{done.stderr}")
    height, left, low, right, high = map(int, frame.split()[1:])
    crop = f"{right - left}x{high - low}+{left}+{height - high}"
    subprocess.run(
        [blender, "--exec", "convert", str(shot), "-crop", crop, "+repage", "-resize", f"{SIZE[0]}x{SIZE[1]}!", str(folder / "window.png")],
        check=True,
    )


def main() -> int:
    """Bake, take both pictures and put them side by side."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    parser.add_argument("--blender", default=str(ROOT.parent / "shared" / "tools" / "real-blender"))
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--bake-samples", type=int, help="paths of a texel (default: that of the method)")
    parser.add_argument("--folder", type=Path, help="keep all files here")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp())
    bake_room(folder, arguments.samples, arguments.resolution, arguments.bake_samples)
    take_window(folder, arguments.blender)
    pair = [str(folder / "window.png"), str(folder / "rendered.png")]
    whole = str(arguments.out.resolve() / "baked_room.png")
    subprocess.run([arguments.blender, "--exec", "convert", *pair, "+append", "-strip", "-colors", "256", whole], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
