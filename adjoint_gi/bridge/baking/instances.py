# SPDX-License-Identifier: GPL-3.0-or-later
"""Making real for a bake what has no mesh of its own: an object of ours for each instance, each curve, text, surface and family of
metaballs, with its evaluated mesh, in a collection of ours.

The user's objects stay as they are. `results.real` says how the objects are kept, and `extract.instances` how they come into the light.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace

import bpy
from mathutils import Matrix

from ...core.base.errors import Notice, TargetError
from ..extract.instances import MADE_BY_NODES, InstanceWalk, determinant_of, is_flat
from ..host.notices import Notices, listed
from ..props.request import BakeRequest
from ..results import links, preview, stored
from ..results import real as reals
from ..results.lightmap_uv import own_layer
from ..results.show import unhidden
from ..results.stored import ATTRIBUTES, MADE, REAL, REALS

MOST = 20_000  # instances that are made objects: Blender itself slows down with more
SHEAR = 1e-5  # largest difference of a matrix, relative to its largest coefficient, from one that an object can have


@dataclass(eq=False)
class Asked:
    """An instance that is asked for, a `whole` object that is no mesh, or the `own` faces of what makes instances.

    `mesh` is our copy of its faces, which it may share with others.
    """

    name: str
    original: bpy.types.Object
    maker: bpy.types.Object
    matrix: Matrix
    mesh: bpy.types.Mesh | None
    materials: list[bpy.types.Material | None]
    whole: bool = False
    own: bool = False

    @property
    def key(self) -> str | int:
        """By what the object of an earlier bake is found: a whole one may have been renamed."""
        return self.maker.session_uid if self.whole else self.name

    @property
    def title(self) -> str:
        """What the object is called that is made of it."""
        if self.whole:
            return f"{self.name} GI"
        return own_faces(self.name) if self.own else self.name

    @property
    def left_out(self) -> str:
        """What stands for it in `BakeRequest.left_out`."""
        return self.name if self.whole else self.title


@dataclass(frozen=True, eq=False)
class Before:
    """An object of an earlier bake before it is renewed: session_uids of it, of its mesh and of the materials, and its state."""

    uid: int
    mesh: int
    matrix: Matrix
    sum: str
    sheared: bool
    materials: list[int | None]


@dataclass(eq=False)
class Real:
    """Objects made, by the name that extraction has for what each was made of.

    `left_out` has by the name of each what to leave out instead of it. `undo` takes back what was made; `settle` removes for good what has
    been replaced, once there is a result.
    """

    objects: dict[str, bpy.types.Object] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)
    undo: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    _new_objects: list[int] = field(default_factory=list)  # session_uids, because an undo step of Blender moves datablocks
    _renewed: list[Before] = field(default_factory=list)
    _old_objects: list[int] = field(default_factory=list)
    _old_meshes: list[int] = field(default_factory=list)

    def fitting(self, notices: list[Notice]) -> list[Notice]:
        """`notices` without infos on objects that are not baked themselves, because an object of ours stands for their own faces."""
        replaced = {name for name, obj in self.objects.items() if reals.is_own(obj)}
        out = []
        for n in notices:
            names = [x for x in n.names or (n.object,) if n.severity != "info" or x not in replaced]
            out += [Notice(x, n.reason, n.remedy, n.severity) for x in names]
        return out

    def settle(self) -> None:
        """See the class; doing it twice changes nothing."""
        reals.remove_objects(self._old_objects)
        bpy.data.batch_remove([m for m in bpy.data.meshes if m.session_uid in self._old_meshes and m.users == 0])
        self._old_objects, self._old_meshes = [], []


def make(context: bpy.types.Context, request: BakeRequest) -> Real:
    """An object for all that `request` means, a render shows and has no mesh of its own, made or, from an earlier bake, renewed: curves
    and the like, and with Bake Instances each instance.

    Where an instancer has faces of its own, these get an object as well: it is hidden where its instances are shown as objects.
    Raises `TargetError`; then nothing has changed.
    """
    made = Real()
    if request.target == "render" or not (request.instances or _any_whole(context)):
        return made
    with unhidden(context.view_layer):
        walk = _Walk(context.evaluated_depsgraph_get(), request)
    try:
        made.notices = walk.notices()
        with contextlib.ExitStack() as undo:
            made.undo = undo
            _place(context.scene, request, walk.found, made)
            made.undo = undo.pop_all()
    finally:
        bpy.data.batch_remove(list(walk.copies.values()))
    context.view_layer.update()
    return made


def _any_whole(context: bpy.types.Context) -> bool:
    """Whether there may be an object that is no mesh and has faces, or what an earlier bake made of one."""
    return any(reals.may_become_mesh(o) for o in context.view_layer.objects) or any(map(reals.is_whole, reals.objects_of(context.scene)))


def own_faces(name: str) -> str:
    """What the object is called for the faces that the instancer `name` has itself."""
    return f"{name}[{name}]"


class _Walk(InstanceWalk):
    """Finds the instances and what is no mesh, under the names that the extraction will give them, and copies each mesh once."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, request: BakeRequest) -> None:
        super().__init__(lambda material: 0, frozenset(), Notices())
        self._depsgraph, self._request = depsgraph, request
        self._own: dict[bpy.types.Object, tuple[str, Matrix]] = {}  # surfaces of objects themselves, some of which are makers
        self._locked: dict[str, TargetError] = {}
        self.copies: dict[int, bpy.types.Mesh] = {}
        self.found: list[Asked] = []
        self.run(depsgraph)
        for maker in {f.maker: None for f in self.found}:
            if maker in self._own:
                name, matrix = self._own[maker]
                self._add(Asked(name, maker, maker, matrix, None, [], own=True), maker.evaluated_get(depsgraph))

    def notices(self) -> list[Notice]:
        """What becomes of the instances of each maker."""
        of: dict[str, list[str]] = {}
        for f in self.found:
            if not f.whole and not f.own:
                of.setdefault(f.maker.name, []).append(f.original.name if f.original != f.maker else MADE_BY_NODES)
        one, more = "makes 1 instance of {1}, baked as an object of its own", "makes {0} instances of {1}, baked as objects of their own"
        texts = {n: (one if len(s) == 1 else more).format(len(s), listed(list(dict.fromkeys(s)))) for n, s in of.items()}
        told = [Notice(n, text, "", "info") for n, text in texts.items()]
        return told + [Notice(n, f"{e.notice.reason}; its instances are not baked", e.notice.remedy) for n, e in self._locked.items()]

    def _visit_mesh(self, inst: bpy.types.DepsgraphObjectInstance, obj: bpy.types.Object, original: bpy.types.Object, over: object) -> bool:
        """Note what is met, all at once: see `run`."""
        self._note(inst, obj, original)
        return True

    def _note(self, inst: bpy.types.DepsgraphObjectInstance, obj: bpy.types.Object, original: bpy.types.Object) -> None:
        name, _, ids = self._identify(inst, original)
        matrix = inst.matrix_world.copy()
        if is_flat([x for row in matrix for x in row]) or not obj.data.polygons:
            return
        whole = not ids and original.type != "MESH"
        if not whole and (not ids or inst.parent is None):
            self._own[original] = name, matrix
            return
        maker = original if whole else inst.parent.original
        if self._request.objects and maker.name not in self._request.objects or not (whole or self._request.instances):
            return
        error = reals.locked(maker)
        if error is None:
            self._add(Asked(name, original, maker, matrix, None, [], whole), obj)
        elif not whole:
            self._locked[maker.name] = error

    def _add(self, asked: Asked, obj: bpy.types.Object) -> None:
        """Note one, with a copy of the mesh of `obj` as it would be without what a bake has left on the original."""
        if asked.left_out in self._request.left_out:
            return
        if len(self.found) >= MOST:
            remedy = "Choose some of the objects that make them, or turn off Bake Instances"
            raise TargetError("Bake Instances", f"means more than {MOST:,} instances", remedy)
        key = obj.data.as_pointer()
        if key not in self.copies:
            self.copies[key] = _stripped(self._copied(obj, asked.original), asked.original)
        materials = [m and m.original for m in self.user_materials(obj, obj.data)]
        self.found.append(replace(asked, mesh=self.copies[key], materials=materials))

    def _copied(self, obj: bpy.types.Object, original: bpy.types.Object) -> bpy.types.Mesh:
        """A mesh as that of `obj`, with all of its layers: these have to be asked for, which evaluates the object again. What nodes have
        made has them all, and evaluated again it would be another mesh: that of its maker; that of a curve crashes Blender 4.2."""
        its_own = original.type == "MESH" and obj.data == original.evaluated_get(self._depsgraph).data
        layers = {"preserve_all_data_layers": True, "depsgraph": self._depsgraph} if its_own else {}
        return bpy.data.meshes.new_from_object(obj, **layers)


def _stripped(mesh: bpy.types.Mesh, original: bpy.types.Object) -> bpy.types.Mesh:
    """`mesh` without the layers, attributes and properties that bakes of `original` have left."""
    for name in [k for k in mesh.keys() if k in stored.PROPERTIES]:  # noqa: SIM118
        del mesh[name]
    if original.type != "MESH":
        return mesh
    layer = mesh.uv_layers.get(own_layer(original) or " ")
    if layer is not None:
        mesh.uv_layers.remove(layer)
    for key in stored.keys(original.data, ATTRIBUTES):
        for entry in stored.entry(original.data, ATTRIBUTES, key):
            attribute = mesh.color_attributes.get(entry["name"])
            if attribute is not None:
                mesh.color_attributes.remove(attribute)
    return mesh


# ---- the objects


def _place(scene: bpy.types.Scene, request: BakeRequest, found: list[Asked], made: Real) -> None:
    """Have an object for each of `found`, and none for instances of the same makers that are no more."""
    known = {reals.key(o): o for o in reals.of_makers(scene, request.objects) if request.instances or reals.is_whole(o)}
    for obj in known.values():
        links.check_edit_mode(obj)
    collection = reals.collection_of(scene)
    if not found and collection is None:
        return
    if collection is None:
        collection = bpy.data.collections.new(reals.collection_name(scene))
        collection[REALS] = True
        scene.collection.children.link(collection)
        made.undo.callback(reals.remove, scene)
    made.undo.callback(_go_back, made._renewed, made._new_objects)
    for f in found:
        obj = known.get(f.key)
        if obj is not None and not obj.modifiers and obj.data.users == 1:
            _renew(known.pop(f.key), f, made)
        else:
            obj = _new(collection, f, made)
        made.objects[f.name], made.left_out[obj.name] = obj, f.left_out
    made.undo.callback(_put_back, scene, made._old_objects)
    for obj in known.values():  # what they were made of is gone
        collection.objects.unlink(obj)
        made._old_objects.append(obj.session_uid)


def _new(collection: bpy.types.Collection, f: Asked, made: Real) -> bpy.types.Object:
    """An object for what had none; hidden until it is shown."""
    mesh, sheared, matrix, total = _shaped(f)
    obj = bpy.data.objects.new(f.title, mesh)
    made._new_objects.append(obj.session_uid)
    mesh.name = obj.name
    obj.hide_render = obj.hide_viewport = True
    obj[MADE] = True
    obj[REAL] = {"instance": f.name, "sum": total, "sheared": sheared, **({"kind": f.maker.type} if f.whole else {})}
    obj[REAL]["maker"] = f.maker
    obj.matrix_world = matrix
    if hasattr(obj, "adjoint_gi_density"):
        obj.adjoint_gi_density = f.original.adjoint_gi_density
    collection.objects.link(obj)
    _set_materials(mesh, f.materials)
    return obj


def _renew(obj: bpy.types.Object, f: Asked, made: Real) -> None:
    """Bring an object of an earlier bake up to date: the mesh, with its UVs, stays where it is as it was."""
    mesh, sheared, matrix, total = _shaped(f)
    state = obj[REAL]
    materials = [m and m.session_uid for m in obj.data.materials]
    made._renewed.append(Before(obj.session_uid, obj.data.session_uid, obj.matrix_world.copy(), state["sum"], state["sheared"], materials))
    obj.matrix_world = matrix
    if state["sum"] == total:
        bpy.data.meshes.remove(mesh)
        mesh = obj.data
    else:
        preview.restore([obj])
        made._old_meshes.append(obj.data.session_uid)
        obj.data = mesh
        state["sum"], state["sheared"] = total, sheared
    if [m for m in mesh.materials if m] != [m for m in f.materials if m] or len(mesh.materials) < len(f.materials):
        preview.restore([obj])
        _set_materials(mesh, f.materials)


def _shaped(f: Asked) -> tuple[bpy.types.Mesh, bool, Matrix, str]:
    """A mesh for the instance, whether it is in world space because no object can be sheared, the object's matrix, and the checksum."""
    mesh, total = f.mesh.copy(), reals.checksum(f.mesh)
    largest = max(abs(x) for row in f.matrix for x in row)
    rebuilt = Matrix.LocRotScale(*f.matrix.decompose())
    sheared = max(abs(x) for row in rebuilt - f.matrix for x in row) > SHEAR * largest
    if not sheared:
        return mesh, False, f.matrix, total
    mesh.transform(f.matrix)
    if determinant_of([x for row in f.matrix for x in row]) < 0.0:
        mesh.flip_normals()
    return mesh, True, Matrix.Identity(4), f"{total} {reals.checksum(mesh)}"


def _set_materials(mesh: bpy.types.Mesh, materials: list[bpy.types.Material | None]) -> None:
    """The slots of `mesh`, changed only where they differ: Blender looks through all objects for each slot that comes or goes."""
    if list(mesh.materials) == materials:
        return
    mesh.materials.clear()
    for material in materials:
        mesh.materials.append(material)


def _go_back(renewed: list[Before], new: list[int]) -> None:
    """Undo `_renew` and `_new`, of all objects at once: looking for one takes as long as there are many."""
    objects, meshes, materials = ({x.session_uid: x for x in kind} for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.materials))
    unused = []
    for before in renewed:
        obj, old = objects.get(before.uid), meshes.get(before.mesh)
        if obj is None or old is None:
            continue
        now, obj.data, obj.matrix_world = obj.data, old, before.matrix
        obj[REAL]["sum"], obj[REAL]["sheared"] = before.sum, before.sheared
        if [m and m.session_uid for m in old.materials] != before.materials:
            _set_materials(old, [materials.get(m) for m in before.materials])
        if now != old and now.users == 0:
            unused.append(now)
    bpy.data.batch_remove(unused)
    reals.remove_objects(new)


def _put_back(scene: bpy.types.Scene, uids: list[int]) -> None:
    """Undo that objects were taken from the collection."""
    collection, wanted = reals.collection_of(scene), set(uids)
    for obj in [o for o in bpy.data.objects if o.session_uid in wanted] if wanted and collection is not None else []:
        collection.objects.link(obj)
