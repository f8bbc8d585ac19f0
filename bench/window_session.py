# SPDX-License-Identifier: GPL-3.0-or-later
"""What `window_pictures.py` does inside Blender: walks through the states of the panel and takes a picture of each."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import addon_utils
import bpy
import numpy as np

EXTENSION = "bl_ext.user_default.adjoint_gi"
OUT = Path(sys.argv[sys.argv.index("--") + 1])
METHODS = "--methods" in sys.argv
PAUSE = 0.6  # seconds for Blender to draw what has changed
LIMIT = 120.0  # seconds that any state may take


def module(name: str):
    """A module of the extension."""
    return importlib.import_module(f"{EXTENSION}.{name}")


def view() -> tuple:
    """Window, area and sidebar region of the 3D View."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width * a.height)
    return window, area, next(r for r in area.regions if r.type == "UI")


def screenshot() -> np.ndarray:
    """(h, w, 4) float32 of the window, row 0 at the bottom."""
    path = Path(tempfile.gettempdir()) / f"adjoint_gi_window_{os.getpid()}.png"
    # Blender's own screenshot operator gives a black picture when it is called from a timer.
    subprocess.run(["import", "-window", "root", str(path)], check=True, timeout=30)
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    path.unlink()
    return pixels.reshape(height, width, 4)


def save(name: str, pixels: np.ndarray) -> None:
    """Write `pixels` as an 8-bit PNG."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("shot", width, height, alpha=False)
    image.pixels.foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
    image.filepath_raw = str(OUT / f"{name}.png")
    image.file_format = "PNG"
    image.save()
    bpy.data.images.remove(image)
    print(f"PICTURE {name} {width} x {height}, {(OUT / f'{name}.png').stat().st_size // 1024} KB", flush=True)


def save_panel(name: str) -> None:
    """The sidebar, cut off below its last line."""
    _, _, region = view()
    shot = screenshot()[region.y : region.y + region.height, region.x : region.x + region.width - 22]  # without the tabs
    used = np.flatnonzero(np.ptp(shot[..., :3], axis=1).max(axis=1) > 0.03)
    save(name, shot[max(0, used[0] - 8) :])


def save_area(name: str, area: bpy.types.Area) -> None:
    """The main region of an area at half its size."""
    region = next(r for r in area.regions if r.type == "WINDOW")
    height, width = region.height // 2 * 2, region.width // 2 * 2
    shot = screenshot()[region.y : region.y + height, region.x : region.x + width]
    save(name, shot.reshape(height // 2, 2, width // 2, 2, 4).mean(axis=(1, 3)))


def save_view(name: str) -> None:
    """The middle square of the 3D View at half its size."""
    _, area, _ = view()
    region = next(r for r in area.regions if r.type == "WINDOW")
    shot = screenshot()[region.y : region.y + region.height, region.x : region.x + region.width]
    side = min(shot.shape[:2]) // 2 * 2
    left = (shot.shape[1] - side) // 2
    square = shot[:side, left : left + side]
    save(name, square.reshape(side // 2, 2, side // 2, 2, 4).mean(axis=(1, 3)))


def wait(condition):
    """Let Blender work until `condition()` holds."""
    end = time.monotonic() + LIMIT
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError(f"waited more than {LIMIT} s for {condition.__name__}")
        yield 0.05


def operator(name: str, *arguments, **values) -> None:
    """Call one of our operators as a click on its button does."""
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        print(name, getattr(bpy.ops.adjoint_gi, name)("INVOKE_DEFAULT", *arguments, **values), flush=True)


def arrange() -> None:
    """The 3D View over the whole window with our tab open, seen from the camera."""
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.screen.screen_full_area(use_hide_panels=False)
    _, area, region = view()
    space = area.spaces.active
    space.show_region_ui, space.show_region_toolbar, space.show_gizmo = True, False, False
    space.overlay.show_overlays = False
    space.region_3d.view_perspective = "CAMERA"


def session():
    """The states one after the other; yields the seconds to wait."""
    yield from open_scene()
    yield from idle_and_refused()
    yield from baked()
    yield from balanced_and_shown()
    yield from rendered()
    yield from picture()
    yield from compared()
    yield from quit_while_baking()


def runner():
    """What runs bakes."""
    return module("adjoint_gi.bridge.baking.jobs").BAKES


def settings():
    """The panel's settings of the scene."""
    return bpy.context.window_manager.windows[0].scene.adjoint_gi


def open_scene():
    """The demo scene, all of it selected, and with METHODS the panel of each method."""
    operator("add_demo_scene")
    yield PAUSE
    arrange()
    yield PAUSE
    _, _, region = view()
    region.active_panel_category = "Adjoint GI"
    scene = bpy.context.window_manager.windows[0].scene
    for obj in scene.objects:
        obj.select_set(obj.type == "MESH")
    yield PAUSE
    for method in [m.spec.id for m in module("adjoint_gi.core.method.registry").methods()] if METHODS else []:
        settings().method = method
        yield 4 * PAUSE
        save_panel(f"method_{method}")


def idle_and_refused():
    """The panel before a bake, and with a setting that is refused."""
    check, state = module("adjoint_gi.bridge.baking.check"), settings()
    state.method = "path_tracing"
    state.resolution = 128
    state.settings_path_tracing.samples = 64
    yield from wait(lambda: check._Cache.notices is not None and not check._Cache.dirty)
    yield 3 * PAUSE
    save_panel("panel_idle")

    state.uv_layer = "Lightmap of mine"
    yield from wait(lambda: any(n.severity == "error" for n in check._Cache.notices))
    yield PAUSE
    save_panel("panel_refused")
    state.uv_layer = ""
    yield from wait(lambda: not any(n.severity == "error" for n in check._Cache.notices))


def baked():
    """A bake under way, stopped, continued and finished."""
    bakes = runner()
    operator("bake")
    yield from wait(lambda: not bakes.running or (not bakes.job.preparing and bakes.job.driver.fraction > 0.3))
    yield PAUSE
    save_panel("panel_running")
    began = time.monotonic()
    operator("stop")
    print(f"STOP took {time.monotonic() - began:.2f} s", flush=True)
    yield from wait(lambda: not bakes.running)
    yield 8 * PAUSE  # a new panel opens slowly on a busy machine
    save_panel("panel_stopped")
    operator("resume")
    yield from wait(lambda: not bakes.running)
    yield 8 * PAUSE
    save_panel("panel_finished")
    if bakes.job.state != "finished" or bakes.job.notices:
        raise RuntimeError(f"the bake ended as {bakes.job.state}: {[str(n) for n in bakes.job.notices]}")


def balanced_and_shown():
    """A bake by radiosity, which has an energy balance and no noise, and its result in the scene."""
    bakes, state = runner(), settings()
    state.method, state.resolution = "progressive_radiosity", 256
    yield PAUSE
    operator("bake")
    yield from wait(lambda: not bakes.running)
    yield 3 * PAUSE
    save_panel("panel_balance")
    operator("show_result")
    space = view()[1].spaces.active
    space.shading.type = "MATERIAL"
    space.show_region_ui = space.show_region_header = space.show_region_tool_header = False
    yield 60 * PAUSE  # a software renderer compiles shaders slowly
    save_view("baked_box")
    space.show_region_ui = space.show_region_header = True
    operator("restore")


def rendered():
    """F12: the engine works in a thread of Blender's while the window stays alive."""
    scene = bpy.context.window_manager.windows[0].scene
    scene.adjoint_gi.method = "path_tracing"
    scene.render.engine = "ADJOINT_GI"
    scene.render.resolution_percentage = 50
    bpy.context.preferences.view.render_display_type = "NONE"
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        print("render", bpy.ops.render.render("INVOKE_DEFAULT"), flush=True)
    yield from wait(lambda: bpy.app.is_job_running("RENDER"))
    yield from wait(lambda: not bpy.app.is_job_running("RENDER"))
    bpy.data.images["Render Result"].save_render(str(OUT / "render.png"))
    area.ui_type = "PROPERTIES"
    yield PAUSE
    area.spaces.active.context = "RENDER"
    yield 2 * PAUSE
    save_area("render_properties", area)
    area.ui_type = "VIEW_3D"
    yield PAUSE


def picture():
    """A picture by the button, whose numbers are radiance."""
    bakes, state = runner(), settings()
    state.method, state.target, state.folder = "path_tracing", "render", tempfile.mkdtemp()
    state.settings_path_tracing.samples = 4
    yield PAUSE
    operator("bake")
    yield from wait(lambda: not bakes.running)
    yield 8 * PAUSE
    save_panel("panel_picture")
    state.target, state.folder = "texture", ""


def compared():
    """Three methods compared at the pixels of the camera: their panel alone, as it starts closed and below all others."""
    panels = importlib.import_module(f"{EXTENSION}.panels.view3d"), importlib.import_module(f"{EXTENSION}.panels.compare")
    for owner in reversed(panels):
        owner.unregister()
    choice = panels[1].ADJOINTGI_PT_compare
    kept = choice.bl_parent_id
    del choice.bl_parent_id
    choice.bl_options = set()
    panels[1].register()
    state = bpy.context.window_manager.windows[0].scene.adjoint_gi_compare
    state.receivers, state.seconds, state.resolution = "camera", 2.0, 48
    for name in (p.identifier for p in state.bl_rna.properties if p.identifier.startswith("use_")):
        setattr(state, name, name in ("use_path_tracing", "use_distribution", "use_progressive_radiosity"))
    operator("compare")
    runs = module("adjoint_gi.bridge.comparison.job").COMPARISONS
    yield from wait(lambda: not runs.running)
    yield 8 * PAUSE
    save_panel("panel_compared")
    panels[1].unregister()
    choice.bl_parent_id, choice.bl_options = kept, {"DEFAULT_CLOSED"}
    for owner in panels:
        owner.register()
    yield PAUSE


def quit_while_baking():
    """Quitting in the middle of a bake must not wait for its end."""
    bakes = runner()
    operator("bake")
    yield from wait(lambda: bakes.running and not bakes.job.preparing and bakes.job.driver.fraction > 0.05)
    print(f"QUIT {time.time()}", flush=True)
    bpy.ops.wm.quit_blender()
    yield LIMIT


def step() -> float | None:
    """Go on with the session; end Blender with code 1 when it fails."""
    try:
        return next(SESSION)
    except StopIteration:
        return None
    except BaseException:
        traceback.print_exc()
        sys.stdout.flush()
        os._exit(1)


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.view.ui_scale = 1.0
if addon_utils.enable(EXTENSION) is None:
    sys.exit(f"{EXTENSION} could not be enabled")
SESSION = session()
bpy.app.timers.register(step, first_interval=1.0, persistent=True)
