# SPDX-License-Identifier: GPL-3.0-or-later
"""The last bake of a scene as a whole: which objects hold its result, showing it on them, and taking that back.

An object "NAME GI" stands exactly where its original stands, so of the two only the one that shows the result is left visible in the
viewport. The other is hidden by the eye of one view layer, and the one that is seen takes its place in the selection. Both are
remembered in a custom property of the hidden object, which is saved with the file. For a bake nothing is hidden by this.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import bpy

from ...core.base.errors import Notice, TargetError
from ..host.notices import listed
from . import links as targets
from . import preview, real, stored
from .attribute import check_attribute_target, linked_attribute, result_object
from .stored import HIDDEN


def holders(scene: bpy.types.Scene, quantity: str, target: str, new_object: bool = False) -> list[bpy.types.Object]:
    """The mesh objects of `scene` that hold a result for `quantity`: as a texture; as an attribute on objects made for it (`new_object`);
    or as an attribute on themselves, and where their mesh cannot hold one, on objects made for it."""
    results = {o for o in targets.results() if not real.is_real(o)}  # second objects, each of which stands where its original does
    meshes = [o for o in scene.objects if o.type == "MESH"]
    if target == "texture":
        return [o for o in meshes if o not in results and targets.link(o, quantity) is not None]
    holding = [o for o in meshes if linked_attribute(o, quantity) is not None]
    made = [o for o in holding if o in results or (new_object and real.is_whole(o))]
    if new_object:
        return made
    own = [o for o in holding if o not in results]
    instead = {o: result_object(o) for o in meshes if o not in results and result_object(o) in made}
    instead = {o: result for o, result in instead.items() if o not in own or not _can_hold(o)}
    return [o for o in own if o not in instead] + list(instead.values())


def _can_hold(obj: bpy.types.Object) -> bool:
    """Whether its mesh is one that an attribute can be written to."""
    try:
        check_attribute_target(obj, bpy.context.evaluated_depsgraph_get())
    except TargetError:
        return False
    return True


def show(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer | None = None) -> int:
    """Show the last bake on all objects that hold it; returns their number. Raises TargetError when there are none.

    In `view_layer`, the scene's first one by default, what stands in the same place is hidden.
    """
    record = scene.adjoint_gi.result
    objects = holders(scene, record.quantity, record.target, record.new_object)
    if not objects:
        raise TargetError(scene.name, f"has no object with a baked {record.quantity or 'result'}", "Bake to a texture or attribute first")
    preview.show(objects, record.quantity, attributes=record.target != "texture")
    layer = view_layer or scene.view_layers[0]
    layer.update()  # so that it knows what was made last
    _show_instances(scene, layer, objects)
    for obj in scene.objects:
        made = result_object(obj)
        if made is not None and (obj in objects or made in objects):
            hidden, seen = (obj, made) if made in objects else (made, obj)
            _reveal(seen)
            _hide(hidden, seen, scene, layer)
    return len(objects)


def not_exported(scene: bpy.types.Scene) -> Notice | None:
    """On which objects of `scene` what is shown does not reach a glTF export, and what to do about it; None where there are none."""
    names = [o.name for o in scene.objects if o.type == "MESH" and not preview.exported(o)]
    if not names:
        return None
    reason = "shows its result by slots of the object, not of its mesh, which others use or which you have not linked to Data: a glTF "
    reason += "export with Apply Modifiers has its lightmap UVs, but no lightmap"
    remedy = "Before such an export use Make Single User (Object & Data), link slots to Data, and press Show Result again"
    return Notice(listed(names), reason, remedy, "info", tuple(names))


def restore(scene: bpy.types.Scene) -> int:
    """Put the materials of all objects of `scene` back, and show again what `show` hid; returns how many objects showed a result."""
    for obj in scene.objects:
        _reveal(obj)
    real.rest(scene)
    return preview.restore([o for o in scene.objects if o.type == "MESH"])


@contextlib.contextmanager
def unhidden(view_layer: bpy.types.ViewLayer) -> Iterator[None]:
    """What `show` hid in `view_layer` is visible for a while, so that the depsgraph lists it; afterwards all is as before."""
    hidden = [
        o
        for o in view_layer.objects
        if stored.read(o, HIDDEN) is not None and view_layer in _layers(o) and o.hide_get(view_layer=view_layer)
    ]
    try:
        _set_hidden(hidden, False, view_layer)
        yield
    finally:
        _set_hidden(hidden, True, view_layer)


@contextlib.contextmanager
def put_aside(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> Iterator[None]:
    """The scene as the user has it for a while, without anything that `show` changed."""
    with unhidden(view_layer), preview.lifted([o for o in scene.objects if o.type == "MESH"]):
        yield


def selected(view_layer: bpy.types.ViewLayer, instances: bool = False) -> tuple[str, ...]:
    """Names of the selected objects that have faces. Results are none of them; one that is seen in place of its original stands for it.

    Of metaballs the one that has the surface is named. With `instances` also objects without a mesh that can have instances.
    """

    def seen_for(obj: bpy.types.Object) -> bpy.types.Object | None:
        state = stored.read(obj, HIDDEN)
        return state.get("seen") if state is not None and view_layer in _layers(obj) else None

    def stands_selected(obj: bpy.types.Object) -> bool:
        seen = seen_for(obj)
        return (seen if seen is not None and obj.hide_get(view_layer=view_layer) else obj).select_get(view_layer=view_layer)

    def is_selected(obj: bpy.types.Object) -> bool:
        seen = seen_for(obj)
        if seen is not None and real.is_real(seen):
            return any(stands_selected(o) for o in _instances_of(obj, view_layer))
        return stands_selected(obj)

    able = [o for o in view_layer.objects if o.type == "MESH" or real.may_become_mesh(o) or (instances and real.may_make(o))]
    results = targets.results()
    chosen = [o for o in able if o not in results and is_selected(o)]
    return tuple(dict.fromkeys(real.surface_owner(o, view_layer.id_data).name for o in chosen))


def nothing_selected(view_layer: bpy.types.ViewLayer) -> tuple[str, str]:
    """Reason and remedy for a selection in which there is nothing to bake."""
    results = targets.results()
    ours = [o for o in view_layer.objects.selected if o in results]
    if not ours:
        return "is on, but no mesh object is selected", "Select what to bake, or turn it off"
    made_of = [o.name for o in view_layer.objects if result_object(o) in ours]
    what = f"what they were made of ({listed(made_of)})" if made_of else "other objects"
    return f"is on, but only results are selected ({listed([o.name for o in ours])})", f"Select {what}, or turn it off"


def _show_instances(scene: bpy.types.Scene, layer: bpy.types.ViewLayer, objects: list[bpy.types.Object]) -> None:
    """Show those of `objects` that a bake made of instances, or what holds their result, and hide who made the instances, so that
    nothing is there twice; where that cannot be hidden, all stays as it is."""
    made = [o for o in real.objects_of(scene) if o in objects or result_object(o) in objects]
    for maker in {real.maker_of(o): None for o in made}:
        if maker is None or stored.read(maker, HIDDEN) is not None or not maker.visible_get(view_layer=layer):
            continue
        own = [o for o in made if real.maker_of(o) == maker]
        if all(map(real.is_whole, own)) and _makes_more(maker, layer):
            continue
        _set_resting(own, False)
        layer.update()
        _hide(maker, own[0], scene, layer)
        if stored.read(maker, HIDDEN) is None:
            _set_resting(own, True)
    layer.update()


def _makes_more(obj: bpy.types.Object, layer: bpy.types.ViewLayer) -> bool:
    """Whether `obj`, which is no mesh, makes instances beside its own surface, which would be hidden with it."""
    if not real.may_make(obj):
        return False
    made = (i for i in layer.depsgraph.object_instances if i.is_instance and i.parent is not None)
    return any(i.parent.original == obj and i.object.original != obj for i in made)


def _set_resting(objects: list[bpy.types.Object], resting: bool) -> None:
    for obj in objects:
        obj.hide_viewport = resting


def _instances_of(maker: bpy.types.Object, view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """The objects in `view_layer` that stand for instances of `maker`."""
    return [o for o in view_layer.objects if real.maker_of(o) == maker]


def _hide(obj: bpy.types.Object, seen: bpy.types.Object, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Hide `obj` in favour of `seen` and remember it; not what is hidden already or worked on. A result that is seen in place of its
    original takes its place in the selection too."""
    there = {o.session_uid for o in layer.objects}
    if not {obj.session_uid, seen.session_uid} <= there or obj.hide_get(view_layer=layer) or not seen.visible_get(view_layer=layer):
        return
    if obj.mode != "OBJECT" or not obj.is_editable:
        return
    made, chosen = _second(obj, seen), obj.select_get(view_layer=layer)
    obj[HIDDEN] = {"layer": layer.name, "made_selected": made.select_get(view_layer=layer)}
    obj[HIDDEN]["scene"], obj[HIDDEN]["seen"] = scene, seen
    obj.hide_set(True, view_layer=layer)
    if made == seen:
        seen.select_set(chosen, view_layer=layer)


def _second(obj: bpy.types.Object, seen: bpy.types.Object | None) -> bpy.types.Object | None:
    """Which of `obj` and what is `seen` in its place a bake has made for the other."""
    return obj if seen is not None and result_object(seen) == obj else seen


def _reveal(obj: bpy.types.Object) -> None:
    """Undo `_hide`; what is selected of the two stays so."""
    state = stored.read(obj, HIDDEN)
    if state is None:
        return
    seen, was_selected, layers = state.get("seen"), bool(state["made_selected"]), _layers(obj)
    del obj[HIDDEN]
    if seen is not None:
        _reveal(seen)  # it may have handed the selection on
    made = _second(obj, seen)
    for layer in layers:
        objects = {o.session_uid for o in layer.objects}
        if obj.session_uid not in objects:
            continue
        hidden = obj.hide_get(view_layer=layer)
        obj.hide_set(False, view_layer=layer)
        if hidden and seen is not None and seen.session_uid in objects:
            if made == seen:
                obj.select_set(made.select_get(view_layer=layer), view_layer=layer)
            made.select_set(was_selected, view_layer=layer)


def _layers(obj: bpy.types.Object) -> list[bpy.types.ViewLayer]:
    """The view layer in which `obj` was hidden; all of its scene when none has that name any more."""
    state = stored.read(obj, HIDDEN)
    scene = state.get("scene")
    if scene is None:
        return []
    layer = scene.view_layers.get(state["layer"])
    return [layer] if layer is not None else list(scene.view_layers)


def _set_hidden(objects: list[bpy.types.Object], hidden: bool, view_layer: bpy.types.ViewLayer) -> None:
    for obj in objects:
        obj.hide_set(hidden, view_layer=view_layer)
    if objects:
        view_layer.update()
