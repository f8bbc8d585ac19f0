# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that would prevent a bake, or make its result a surprise, found before it starts.

Two parts: what can be read off Blender's data at once, and what needs the extracted scene. An error refuses the bake.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import bpy
import numpy as np

from ...core.base.errors import AdjointError, Notice, TargetError
from ...core.base.resources import SHARE, available_memory, size_text
from ...core.elements.elements import Elements
from ...core.flux.density import own_resolutions
from ...core.flux.facing import baked_sides
from ...core.lights.background import Background
from ...core.receivers.base import Receivers
from ...core.receivers.texels import memory as lightmap_memory
from ...core.scene.arrays import SceneArrays
from ...core.scene.world import World
from ...core.walks import openness
from ..extract.camera import NO_PICTURE, render_size
from ..extract.depsgraph import extracting
from ..extract.images import reading, return_images
from ..extract.instances import MADE_BY_NODES
from ..extract.scene_store import BYTES_A_TRIANGLE, SCENES
from ..host import files
from ..host.notices import Notices, listed
from ..host.preparation import Aside, Stages, finish_stages, once
from ..props.request import RECEIVERS, BakeRequest
from ..results import links as targets
from ..results import real as reals
from ..results import stored
from ..results.attribute import NotOnMesh, check_attribute_target, name_taken
from ..results.lightmap_uv import NAME, check_target, own_layer
from ..results.show import unhidden
from . import outputs
from .promises import SEPARATE, fulfilled
from .sides import planned, unfits
from .watch import unchanged

QUICK = 300_000  # triangles above which the panel's check does not extract the scene
LEFT_OUT = ("and is left out", "so it is left out")  # words of the extraction for a whole object that is not there


def preflight(context: bpy.types.Context, request: BakeRequest, thorough: bool = False) -> list[Notice]:
    """All notices, errors first. Nothing is changed. Big scenes are extracted only when `thorough`."""
    return finish_stages(preflighting(context, request, thorough))


def preflighting(context: bpy.types.Context, request: BakeRequest, thorough: bool = False) -> Stages[list[Notice]]:
    """`preflight` in slices, as a bake is prepared. Raises `AdjointError` when the user changes the scene meanwhile."""
    request, notices = resolve(context, request)
    if any(n.severity == "error" for n in notices):
        return notices
    count = triangle_count(context.evaluated_depsgraph_get())
    if count > QUICK and not thorough:
        notices.append(Notice("Scene", f"has about {count:,} triangles; they are looked at when the bake starts", "", "info"))
        notices += _memory_notice("Scene", count * BYTES_A_TRIANGLE)
        return ordered(notices)
    same = unchanged()
    try:
        yield from reading(context)
        yield "Reading the scene"
        same()
        size = picture_size(context.scene, request)
        arrays = yield from extracting(size)
        notices = fulfilled(notices, arrays, receiving(arrays, request))
    finally:
        return_images()
    world = yield Aside("Building the tree of rays", once(lambda: SCENES.world(arrays)))
    same()
    found = yield from inspecting(world, request)
    same()
    taken = outputs.problems(request, arrays, receiving(arrays, request), context.scene.name)
    return ordered([*notices, *found, *taken])


def ordered(notices: list[Notice]) -> list[Notice]:
    """Errors, warnings, infos; objects with the same sentence together."""
    grouped = Notices()
    for n in notices:
        for name in n.names or (n.object,):
            grouped.add(name, n.reason, n.remedy, n.severity)
    return list(grouped.result())


def look(context: bpy.types.Context, request: BakeRequest) -> list[Notice]:
    """What is found without extracting the scene."""
    return resolve(context, request)[1]


def resolve(context: bpy.types.Context, request: BakeRequest) -> tuple[BakeRequest, list[Notice]]:
    """`request` with what Blender's data say of each object, and what is found without extracting the scene.

    Where no objects are named, those that cannot receive are left out, and are errors only when there are no others. An attribute that a
    mesh cannot hold goes to an object of its own.
    """
    notices = request.problems()
    scene = context.scene
    context.view_layer.update()  # after a removal its list of objects has a hole until then
    if request.target == "render":
        if scene.camera is None:
            notices.append(Notice("Camera", "the scene has no active camera", "Add a camera and make it active", "error"))
    else:
        present, results = _by_name(context), targets.results()
        for name in request.objects:
            notices += _named(context, name, present.get(name), request.instances, results)
        owners = [reals.surface_owner(present[name], scene).name for name in request.objects if name in present]
        request = replace(request, objects=tuple(dict.fromkeys(owners))) if len(owners) == len(request.objects) else request
        if not any(n.severity == "error" for n in notices):
            request, found = _resolve_objects(context, request)
            notices += found
    notices += _output(request)
    notices += _damaged()
    return request, ordered(notices)


def _resolve_objects(context: bpy.types.Context, request: BakeRequest) -> tuple[BakeRequest, list[Notice]]:
    """The same, of the objects alone."""
    objects = [o for o in _meant(context, request) if o.name not in request.left_out]
    check = checker(request, objects)
    found = {o: check(o) for o in objects}
    bad = [o for o in objects if any(n.severity == "error" for n in found[o])]
    notices = [n for o in objects for n in found[o]]
    request = replace(request, separate=tuple(o.name for o in objects if any(SEPARATE in n.reason for n in found[o])))
    if request.objects or len(bad) == len(objects):
        return request, notices
    notices = [left_out(n) if n.severity == "error" else n for n in notices]
    return replace(request, left_out=(*request.left_out, *(o.name for o in bad))), notices


def checker(request: BakeRequest, objects: Sequence[bpy.types.Object]) -> Callable[[bpy.types.Object], list[Notice]]:
    """What looks at one of `objects`, which are baked together, for the target of `request`."""
    if request.target != "texture":
        return lambda obj: _attribute_target(obj, request)
    why = {} if request.uv_layer else unfits(objects, request, bpy.context.evaluated_depsgraph_get())
    return lambda obj: _texture_target(obj, request, why.get(obj, ""))


def left_out(error: Notice) -> Notice:
    """What is said of an object that cannot receive where others do."""
    return replace(error, reason=f"{error.reason}; it is in the light, but not baked", severity="warning")


def _damaged() -> list[Notice]:
    """What stands under the names of our properties and is not ours."""
    reason, remedy = "is not as a bake stores it, and counts as absent", "Clear Results with Remove Baked Data removes it"
    return [Notice(owner, f'its property "{name}" {reason}', remedy) for owner, name in stored.damaged()]


def target_objects(context: bpy.types.Context, request: BakeRequest) -> list[bpy.types.Object]:
    """The mesh objects that `request` means: those named, or all that have faces, are not hidden in render and can be written to.

    Also the objects that are there for instances, which a bake makes.
    """
    request = resolve(context, request)[0]
    real = [o for o in reals.of_makers(context.scene, request.objects) if request.instances or reals.is_whole(o)]
    replaced = {reals.maker_of(o) for o in real if reals.is_own(o)}
    able = [o for o in _meant(context, request) if o not in replaced and (request.objects or targets.linked(o, False) is None)]
    return [o for o in (*able, *real) if reals.standing_for(o).name not in request.left_out]


def _meant(context: bpy.types.Context, request: BakeRequest) -> list[bpy.types.Object]:
    """The mesh objects named, or all that have faces and are not hidden in render, whether they can be written to or not."""
    wanted = dict.fromkeys(request.objects)
    if wanted:
        present = _by_name(context)
        return [present[name] for name in wanted if name in present and present[name].type == "MESH"]
    return _with_faces(context)


def _with_faces(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Mesh objects that have faces and are not hidden in render."""
    depsgraph = context.evaluated_depsgraph_get()
    with unhidden(context.view_layer):
        shown = {i.object.original.session_uid for i in depsgraph.object_instances if not i.is_instance and i.object.type == "MESH"}
    results = targets.results()
    meshes = [o for o in context.view_layer.objects if o.type == "MESH" and o not in results]
    objects = [o for o in meshes if o.session_uid in shown and not o.hide_render]
    # In edit mode the evaluated mesh shows no faces here, although the scene has them.
    return [o for o in objects if o.mode == "EDIT" or len(o.evaluated_get(depsgraph).data.polygons)]


def inspect(world: World, request: BakeRequest) -> list[Notice]:
    """What is found in the extracted scene: its own notices, no light, open gaps and turned normals, memory."""
    return finish_stages(inspecting(world, request))


def inspecting(world: World, request: BakeRequest) -> Stages[list[Notice]]:
    """`inspect` in slices: what is asked of Blender first, and what is computed of arrays aside."""
    receivers = receiving(world.scene, request)
    notices = _of_objects(world, request, receivers)
    sides = resolutions(world, receivers, request) if request.target == "texture" else np.zeros(0, np.int64)
    computed = yield Aside("Checking the scene", once(lambda: _of_arrays(world, request, receivers, sides)))
    return ordered([*notices, *computed])


def _of_objects(world: World, request: BakeRequest, receivers: list[int]) -> list[Notice]:
    """What is said of the camera, and of objects that receive or do not."""
    arrays = world.scene
    notices = list(arrays.warnings)
    if request.target == "render":
        notices = [replace(n, severity="error") if NO_PICTURE in n.reason else n for n in notices]
        if arrays.camera is None and not any(n.severity == "error" for n in notices):
            notices.append(Notice("Camera", "there is no camera that can be used", "Make it perspective or orthographic", "error"))
        return notices
    made = _makers(arrays) if request.instances else set()
    present = made | {name for i in receivers for name in (arrays.objects[i].source, arrays.objects[i].maker)}
    notices = refusals(notices, [n for n in request.objects if n not in present])
    notices += _meshless(arrays, request)
    if not request.objects:
        notices += [*_instances(arrays, request), *_shown_results(arrays)]
    if not receivers and not made and not request.objects and not any(n.severity == "error" for n in notices):
        notices.append(_nothing_to_bake(arrays))
    return notices


def _nothing_to_bake(arrays: SceneArrays) -> Notice:
    """That no object can receive, and what would."""
    others = [s for s in bpy.data.scenes if s != bpy.context.scene and any(o.type == "MESH" and o.data.polygons for o in s.objects)]
    if others and not arrays.objects:
        names = listed([f'"{s.name}"' for s in others])
        reason = f"is the active scene and has no mesh object with faces to bake; other scenes of the file have: {names}"
        return Notice(f'Scene "{bpy.context.scene.name}"', reason, "Make one of these the active scene, and save the file", "error")
    if any(o.instance for o in arrays.objects):
        reason, remedy = "has faces to bake in instances only", "Turn on Bake Instances (--instances)"
    else:
        reason, remedy = "has no mesh object with faces to bake", "Add one, or show one in renders"
    return Notice("Scene", reason, remedy, "error")


def _of_arrays(world: World, request: BakeRequest, receivers: list[int], sides: np.ndarray) -> list[Notice]:
    """What is found without Blender. `sides` (n,) int64 are the texels a side of every image."""
    notices = []
    if not emits(world):
        notices.append(Notice("Scene", "nothing emits light; the result is black", "Add a light, an emitting material or a world colour"))
    behind = baked_sides(world, receivers).notices
    turned = {n.object for n in behind}
    notices += [*behind, *(n for n in openness.notices(world, set(receivers)) if n.object not in turned)]
    notices += world.shading.substitutions(request.solver.spec.lobes)
    return notices + estimates(world, request, receivers, sides)


def refusals(notices: list[Notice], missing: list[str]) -> list[Notice]:
    """`notices`, and an error for each object of `missing`, which was asked for and is not in the scene as it is rendered.

    Where the extraction has a reason for leaving an object out, that notice becomes the error.
    """
    left_out = [n for n in notices if any(words in n.reason for words in LEFT_OUT)]
    explained = {name: n for n in left_out for name in n.names or (n.object,) if name in missing}
    out = []
    for n in notices:
        names = n.names or (n.object,)
        out += [Notice(name, n.reason, n.remedy, n.severity) for name in names if explained.get(name) is not n]
    for name in missing:
        if name in explained:
            out.append(Notice(name, explained[name].reason, explained[name].remedy or "Give it faces, or do not bake it", "error"))
        else:
            reason = "is not in the scene as it is rendered: it is seen only as an instance, or has no faces with an area"
            out.append(Notice(name, reason, "Make its instances real, or give it faces", "error"))
    return out


def receiving(arrays: SceneArrays, request: BakeRequest) -> list[int]:
    """Indices of the objects that receive: no instances nor objects of other files. Of what is no mesh the bake makes an object."""
    if request.target == "render":
        return []
    results = targets.results()
    objects = {o.session_uid: o for o in bpy.data.objects if reals.is_real(o) or o not in results}
    own = [i for i, o in enumerate(arrays.objects) if not o.instance and o.uid in objects]
    if request.objects:
        wanted = set(request.objects)
        return [i for i in own if wanted & {arrays.objects[i].source, arrays.objects[i].maker}]
    able = [i for i in own if targets.linked(objects[arrays.objects[i].uid], False) is None]
    return [i for i in able if arrays.objects[i].source not in request.left_out]


def emits(world: World) -> bool:
    """Whether there is any light at all."""
    lamps = any(any(light.color) for light in world.scene.lights)
    return lamps or Background(world).any or bool(world.shading.emissive().any())


def estimates(world: World, request: BakeRequest, receiving: list[int], sides: np.ndarray) -> list[Notice]:
    """Receivers, elements and memory of the bake as infos, and an error when the memory is not there. Needs no Blender."""
    solver, settings = request.solver, request.settings
    receivers = Receivers()
    receivers.kind = RECEIVERS[request.target]
    needed = 0
    if request.target == "texture":
        receivers.count = int((sides**2).sum())
        needed += lightmap_memory(receivers.count, 1, request.subsamples)
        what = f"up to {receivers.count:,} texels"
    elif request.target == "attribute":
        if request.new_object and solver.spec.uses_elements and world.triangle_count:
            # At most the four corners of every element.
            receivers.count = 4 * Elements.planned(world, settings.max_edge, solver.element_target(settings))
        else:
            receivers.count = sum(world.scene.objects[i].corner_count for i in receiving)
        what = f"up to {receivers.count:,} vertices and corners"
    else:
        camera = world.scene.camera
        width, height = (camera.width, camera.height) if camera else (0, 0)
        receivers.count, receivers.measure = width * height, "radiance"
        what = f"{width} x {height} pixels"
    notices = []
    try:
        if solver.spec.uses_elements and world.triangle_count:
            count = Elements.planned(world, settings.max_edge, solver.element_target(settings))
            what += f", {count:,} elements"
        needed += solver.memory(world, receivers, settings)
    except AdjointError as error:
        notices.append(error.notice)
    return notices + _memory_notice(solver.spec.label, needed, f"{world.triangle_count:,} triangles, {what}")


def resolutions(world: World, objects: list[int], request: BakeRequest) -> np.ndarray:
    """(n,) int64 texels a side of every image of `objects` (indices), which is one for all of them in an atlas."""
    if request.texels_per_metre and not request.uv_layer:
        return planned(world, objects, request)
    if request.atlas:
        return np.full(min(1, len(objects)), request.resolution)
    return own_resolutions(np.array([world.area[world.scene.objects[i].triangles].sum() for i in objects]), request.resolution)


def triangle_count(depsgraph: bpy.types.Depsgraph) -> int:
    """About how many triangles the evaluated scene has, without objects that are hidden in render themselves."""
    known: dict[int, int] = {}
    total = 0
    for inst in depsgraph.object_instances:
        obj = inst.object
        if obj.type == "MESH" and (inst.is_instance or not obj.hide_render):
            key = obj.data.as_pointer()
            if key not in known:
                known[key] = max(0, len(obj.data.loops) - 2 * len(obj.data.polygons))
            total += known[key]
    return total


def picture_size(scene: bpy.types.Scene, request: BakeRequest) -> tuple[int, int]:
    """Width and height of the camera picture."""
    width, height = render_size(scene)
    return request.width or width, request.height or height


def _by_name(context: bpy.types.Context) -> dict[str, bpy.types.Object]:
    """The objects of the view layer: looked up in Blender by name, each would take a walk through all of them."""
    return {obj.name: obj for obj in reversed(context.view_layer.objects.values())}


def _named(
    context: bpy.types.Context, name: str, obj: bpy.types.Object | None, instances: bool, results: set[bpy.types.Object]
) -> list[Notice]:
    """Whether `obj`, called `name`, can be baked to at all, or with `instances` what it makes; `results` are those of bakes."""
    if obj is None:
        known = name in bpy.data.objects
        reason = "is not in this view layer, or its collection is excluded" if known else "does not exist"
        have = ", ".join(o.name for o in context.view_layer.objects if o.type == "MESH") or "none"
        return [Notice(name, reason, f"Choose of the mesh objects: {have}", "error")]
    if obj.is_missing:
        return [Notice(name, *targets.missing(obj), "error")]
    if obj.type != "MESH" and not reals.may_become_mesh(obj) and not (instances and reals.may_make(obj)):
        return [Notice(name, f"is {reals.described(obj)}, not a mesh", "Choose a mesh, or what has faces when it is evaluated", "error")]
    if reals.may_become_mesh(obj) and reals.locked(obj) is not None:
        return [replace(reals.locked(obj).notice, severity="error")]
    if obj in results:
        return [Notice(name, "was made by a bake to hold a result, so nothing is baked to it", "Bake the object it was made of", "error")]
    if obj.hide_render:
        return [Notice(name, "is hidden in render, so no light reaches it", "Enable it in renders", "error")]
    return []


def _makers(arrays: SceneArrays) -> set[str]:
    """Names of the objects whose instances a bake makes objects of; in a bake that has made them there are none left."""
    objects = {o.name: o for o in bpy.data.objects}
    names = {o.maker for o in arrays.objects if o.instance} & set(objects)
    return {name for name in names if reals.locked(objects[name]) is None}


def _meshless(arrays: SceneArrays, request: BakeRequest) -> list[Notice]:
    """What becomes of texts, curves and the like."""
    present = {o.session_uid: o for o in bpy.data.objects}
    meant = [o for o in arrays.objects if not o.instance and (not request.objects or o.source in request.objects)]
    found = [reals.standing_for(present[o.uid]) for o in meant if o.uid in present and o.source not in request.left_out]
    return [_of_meshless(obj) for obj in found if obj.type != "MESH"]


def _of_meshless(obj: bpy.types.Object) -> Notice:
    """The same, of one."""
    error = reals.locked(obj)
    if error is not None:
        return left_out(error.notice)
    reason = (
        f'is {reals.described(obj)}, whose result is on an object of its own in the collection "{reals.collection_name(bpy.context.scene)}"'
    )
    return Notice(obj.name, reason, "", "info")


def _instances(arrays: SceneArrays, request: BakeRequest) -> list[Notice]:
    """Instances, which are in the light but not baked until a bake makes them objects, with their number, by what makes them."""
    made: dict[str, list[str]] = {}
    for o in arrays.objects:
        if o.instance:
            made.setdefault(o.maker, []).append(o.source if o.source != o.maker else MADE_BY_NODES)
    reason = "makes {} instance{} of {}, in the light but not baked"
    remedy = "To bake them, turn on Bake Instances (--instances), or use Object > Apply > Make Instances Real"
    if request.instances:
        reason, remedy = "makes {} instance{} of {}, which the bake makes objects of", ""
    texts = {maker: reason.format(len(of), "s" * (len(of) > 1), listed(list(dict.fromkeys(of)))) for maker, of in made.items()}
    return [Notice(maker, text, remedy, "info") for maker, text in texts.items()]


def _shown_results(arrays: SceneArrays) -> list[Notice]:
    """Objects that hold the result of another and are shown in renders all the same."""
    of = {made.session_uid: obj for made, obj in targets.originals().items()}
    reason = 'was made by a bake to hold the result of "{}": it is in the light, because it is shown in renders, but not baked'
    shown = [o for o in arrays.objects if not o.instance and o.uid in of]
    return [Notice(o.name, reason.format(of[o.uid].name), "Hide it in renders, or duplicate it and bake the copy") for o in shown]


def _texture_target(obj: bpy.types.Object, request: BakeRequest, why: str) -> list[Notice]:
    """Whether the UV layer is there or can be made; `why` ours does not fit, where it is there."""
    mesh = obj.data
    try:
        targets.check_object(obj)
    except TargetError as error:
        return [error.notice]
    if request.uv_layer:
        if request.uv_layer not in mesh.uv_layers:
            have = ", ".join(f'"{layer.name}"' for layer in mesh.uv_layers) or "none"
            reason = f'has no UV layer "{request.uv_layer}" (layers: {have})'
            return [Notice(obj.name, reason, "Choose one of its layers, or leave it empty to have one made", "error")]
        return []
    if own_layer(obj) and not why:
        return []
    try:
        check_target(obj)
    except TargetError as error:
        return [replace(error.notice, remedy=f"{error.notice.remedy}, or name one of its UV layers")]
    if own_layer(obj):
        return [Notice(obj.name, f"{why}; they are made anew", "", "info")]
    numbered = f' with a number, because it has one called "{NAME}"' if NAME in mesh.uv_layers else ""
    return [Notice(obj.name, f"has no lightmap UV layer yet; one is made{numbered}", "", "info")]


def _attribute_target(obj: bpy.types.Object, request: BakeRequest) -> list[Notice]:
    """Whether the mesh can hold the attribute, or an object of its own can."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    try:
        check_attribute_target(obj, depsgraph, request.new_object)
    except TargetError as error:
        if request.new_object or targets.linked(obj, False) is not None or obj.mode == "EDIT":
            return [error.notice]
        why = error.kind if isinstance(error, NotOnMesh) else error.notice.reason
        return [Notice(obj.name, f"{why}; {SEPARATE}", "", "info")]
    taken = None if request.new_object else name_taken(obj, request.quantity, request.attribute)
    return [taken] if taken is not None else []


def _output(request: BakeRequest) -> list[Notice]:
    """Whether files can be written where they are wanted, and whether anything outlives the session."""
    if not request.output:
        if request.target == "render":
            return [Notice("Output", "no folder is given for the picture", "Choose a folder", "error")]
        if not bpy.data.filepath:
            reason = "the file was never saved and no folder is given: the result is kept in this session only"
            return [Notice("Output", reason, "Save the file or choose a folder", "info")]
        return []
    try:
        files.output_folder(request.output, create=False)
    except AdjointError as error:
        return [error.notice]
    return []


def _memory_notice(label: str, needed: int, what: str = "") -> list[Notice]:
    """The estimate as an info, or as an error when so much is not free; `what` says what it is for."""
    free = available_memory()
    amount = f"about {size_text(needed)} of memory" + (f" for {what}" if what else "")
    if free is None:
        return [Notice(label, f"takes {amount}", "", "info")]
    if needed > SHARE * free:
        remedy = "Lower the resolution or the number of elements, or choose another method"
        return [Notice(label, f"needs {amount}, and {size_text(free)} are free", remedy, "error")]
    return [Notice(label, f"takes {amount}; {size_text(free)} are free", "", "info")]
