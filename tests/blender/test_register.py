# SPDX-License-Identifier: GPL-3.0-or-later
"""Registering adds what it says and unregistering leaves nothing behind, however often."""

import os
from types import SimpleNamespace

import bpy
import pytest

HANDLERS = [name for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)]


def traces() -> dict[str, object]:
    """Everything that an extension could leave behind in Blender."""
    found = {name for name in dir(bpy.types) if "ADJOINTGI" in name.upper().replace("_", "")} - {"adjoint_gi"}
    operators = set(dir(bpy.ops.adjoint_gi))
    handlers = {name for name in HANDLERS for f in getattr(bpy.app.handlers, name) if "adjoint_gi" in (getattr(f, "__module__", "") or "")}
    compatible = {p.__name__ for p in bpy.types.Panel.__subclasses__() if "ADJOINT_GI" in getattr(p, "COMPAT_ENGINES", ())}
    return {
        "types": found,
        "engines": {
            c.bl_idname for c in bpy.types.RenderEngine.__subclasses__() if "ADJOINT" in getattr(c, "bl_idname", "") and c.is_registered
        },
        "operators": operators,
        "handlers": handlers,
        "scene property": hasattr(bpy.types.Scene, "adjoint_gi"),
        "panels": {name for name in compatible if "ADJOINTGI" not in name},
    }


def test_everything_is_registered(registered):
    there = traces()
    assert {"ADJOINTGI_PT_main", "ADJOINTGI_PT_render_method", "ADJOINT_GI_OT_bake"} <= there["types"]
    assert there["engines"] == {"ADJOINT_GI"}
    assert {"bake", "stop", "resume", "write", "check", "show_result", "restore", "clear_results", "add_demo_scene"} <= there["operators"]
    assert there["handlers"] == {
        "load_pre",
        "load_post",
        "load_post_fail",
        "undo_post",
        "redo_post",
        "depsgraph_update_post",
        "frame_change_post",
        "render_init",
    }
    assert there["scene property"]
    assert {"RENDER_PT_output", "EEVEE_MATERIAL_PT_surface", "DATA_PT_EEVEE_light"} <= there["panels"]
    bpy.context.scene.render.engine = "ADJOINT_GI"
    assert bpy.context.scene.render.engine == "ADJOINT_GI"


def test_twenty_times_without_a_trace(registered):
    before = traces()
    for _ in range(20):
        registered.unregister()
        gone = traces()
        assert not any(gone.values()), f"left behind: {gone}"
        registered.register()
    assert traces() == before


def test_unregistering_parts_twice_is_harmless(registered):
    from adjgi.adjoint_gi.bridge.baking import check
    from adjgi.adjoint_gi.bridge.extract import scene_store
    from adjgi.adjoint_gi.bridge.host import background, changes
    from adjgi.adjoint_gi.bridge.props import properties

    registered.unregister()
    for part in (check, scene_store, changes, background, properties):
        part.unregister()
    registered.register()


@pytest.mark.parametrize(("wanted", "environment", "threads"), [(0, "", os.cpu_count()), (0, "2", 2), (3, "", 3), (3, "2", 3)])
def test_threads_are_as_many_as_the_user_wants_or_else_the_environment_or_every_core(wanted, environment, threads, monkeypatch):
    from adjgi.adjoint_gi.bridge.host import preferences
    from adjgi.adjoint_gi.core.base.parallel import thread_count

    chosen = SimpleNamespace(preferences=SimpleNamespace(threads=wanted))
    addons = SimpleNamespace(preferences=SimpleNamespace(addons={preferences.base_package: chosen}))
    monkeypatch.setattr(preferences, "bpy", SimpleNamespace(context=addons))
    monkeypatch.setattr(preferences, "_ENVIRONMENT", environment)
    monkeypatch.setenv("ADJOINT_GI_THREADS", "7")  # of the render before
    preferences.apply_threads()
    assert thread_count() == threads


@pytest.mark.parametrize("name", ["strategy", "nature", "target", "quantity", "domain"])
def test_every_choice_has_words(registered, name):
    items = bpy.context.scene.adjoint_gi.bl_rna.properties[name].enum_items
    assert all(item.name and item.description and not item.description.endswith(".") for item in items)
