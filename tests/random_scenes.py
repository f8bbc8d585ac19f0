# SPDX-License-Identifier: GPL-3.0-or-later
"""Random Blender scenes from a seed: meshes, modifiers, instances, nodes, lamps, cameras, worlds and stored properties. Needs bpy.

Much of it is nonsense on purpose: numbers that are none, links in circles, properties of ours that hold something else. A step that
this Blender refuses is left out, so the same seed may give another scene in another version.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Sequence

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

NAN, INF = float("nan"), float("inf")
MOST = 20_000  # faces of a scene
REFUSED = (AttributeError, KeyError, RuntimeError, TypeError, ValueError, OverflowError, IndexError, ReferenceError)
HOSTILE = (NAN, INF, -INF, -1.0, 0.0, 1e30, -1e30, 1e-30, 1e9)
OURS = ("results", "about", "made", "attributes", "uv", "uv_atlas", "preview", "slot", "material", "original", "hidden", "carried", "")
WRONG = (1, 0, 2.5, "x", "", "{}", "[]", '{"a": 1}', [1, 2], [0.5], {}, {"owner": 1}, {"irradiance": 3}, {"irradiance": {"image": 5}},
         {"irradiance": "[{}]"}, {"layer": 3, "seen": "x", "scene": 1}, {"count": "y", "link0": 4, "key": 7}, True)  # fmt: skip
MODIFIERS = ("ARRAY", "MIRROR", "SOLIDIFY", "BEVEL", "SUBSURF", "TRIANGULATE", "DECIMATE", "REMESH", "SCREW", "WIREFRAME", "EDGE_SPLIT",
             "BOOLEAN", "BUILD", "MASK", "SKIN", "DISPLACE", "WELD", "CAST", "WAVE", "EXPLODE", "UV_WARP", "WEIGHTED_NORMAL",
             "SIMPLE_DEFORM", "NODES", "NODES", "NODES")  # fmt: skip
GEOMETRY = ("GeometryNodeMeshCube", "GeometryNodeMeshUVSphere", "GeometryNodeMeshLine", "GeometryNodeInstanceOnPoints",
            "GeometryNodeMeshToPoints", "GeometryNodeRealizeInstances", "GeometryNodeJoinGeometry", "GeometryNodeDeleteGeometry",
            "GeometryNodeMeshToCurve", "GeometryNodeSubdivideMesh", "GeometryNodeSetMaterial", "GeometryNodeExtrudeMesh",
            "GeometryNodeObjectInfo", "GeometryNodeCollectionInfo", "GeometryNodeStoreNamedAttribute", "GeometryNodeCurveToMesh",
            "GeometryNodeDualMesh", "GeometryNodeFlipFaces", "GeometryNodeTransform", "GeometryNodeConvexHull")  # fmt: skip
SHADERS = tuple(name for name in dir(bpy.types) if name.startswith("ShaderNode") and name != "ShaderNodeCustomGroup")
COMMON = ("ShaderNodeBsdfPrincipled", "ShaderNodeBsdfDiffuse", "ShaderNodeEmission", "ShaderNodeMixShader", "ShaderNodeAddShader",
          "ShaderNodeBsdfGlass", "ShaderNodeBsdfTransparent", "ShaderNodeTexImage", "ShaderNodeValToRGB", "ShaderNodeMix",
          "ShaderNodeMath", "ShaderNodeAttribute", "ShaderNodeBackground")  # fmt: skip


class RandomScene:
    """Builds the scene of one seed in the open, empty file."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.hostile = self.rng.choice((0.0, 0.0, 0.05, 0.3))  # share of numbers that are chosen to hurt
        self.scene = bpy.context.scene
        self.materials: list[bpy.types.Material | None] = [None]
        self.images: list[bpy.types.Image] = []
        self.collections: list[bpy.types.Collection] = []

    def build(self) -> None:
        """Everything, in an order in which later steps can refer to earlier ones."""
        rng = self.rng
        self.some(0, 3, self.image)
        self.some(0, 4, self.material)
        self.some(0, 2, self.collection)
        self.some(1, 6, self.mesh_object)
        self.some(0, 2, self.other_object)
        self.some(0, 2, self.copy)
        self.some(0, 2, self.instancer)
        self.some(0, 3, self.modifier)
        self.some(0, 3, self.lamp)
        self.some(0, 1, self.camera)
        self.some(0, 1, self.world)
        self.some(0, 2, self.switch)
        if rng.random() < 0.3:
            self.some(1, 4, self.stored)
        if rng.random() < 0.1:
            self.attempt(self.other_scene)
        if rng.random() < 0.3:
            self.attempt(self.settings)
        self.bounded()
        for obj in bpy.context.view_layer.objects:
            self.attempt(obj.select_set, rng.random() < 0.4)

    def bounded(self) -> None:
        """Take modifiers, then instances away from a scene that would take long for its size alone."""
        for step in (lambda o: o.modifiers.clear(), lambda o: setattr(o, "instance_type", "NONE")):
            bpy.context.view_layer.update()  # until then its list of objects may have holes
            instances = bpy.context.evaluated_depsgraph_get().object_instances
            if sum(len(i.object.data.polygons) for i in instances if i.object.type == "MESH") > MOST:
                for obj in bpy.data.objects:
                    step(obj)
        bpy.context.view_layer.update()

    # ---- choices

    def some(self, least: int, most: int, step: Callable[[], object]) -> None:
        for _ in range(self.rng.randint(least, most)):
            self.attempt(step)

    def attempt(self, step: Callable[..., object], *values: object) -> None:
        """Take a step that this Blender may refuse."""
        with contextlib.suppress(*REFUSED):
            step(*values)

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        return self.rng.choice(HOSTILE) if self.rng.random() < self.hostile else self.rng.uniform(low, high)

    def numbers(self, count: int, low: float = -3.0, high: float = 3.0) -> list[float]:
        return [self.number(low, high) for _ in range(count)]

    def any(self, items: Sequence, default: object = None) -> object:
        return self.rng.choice(list(items)) if len(items) else default

    def meshes(self) -> list[bpy.types.Object]:
        return [o for o in bpy.data.objects if o.type == "MESH"]

    def vary(self, owner: bpy.types.bpy_struct, share: float = 0.2) -> None:
        """Set some of the numbers, switches and menus of `owner`."""
        for p in owner.bl_rna.properties:
            if p.is_readonly or self.rng.random() > share or p.identifier.startswith(("bl_", "show_", "location", "width", "height")):
                continue
            if p.type == "BOOLEAN" and not p.is_array:
                self.attempt(setattr, owner, p.identifier, self.rng.random() < 0.5)
            elif p.type == "ENUM" and not p.is_enum_flag and len(p.enum_items):
                self.attempt(setattr, owner, p.identifier, self.rng.choice([i.identifier for i in p.enum_items]))
            elif p.type == "FLOAT":
                value = self.numbers(p.array_length) if p.is_array else self.number(0.0, 2.0)
                self.attempt(setattr, owner, p.identifier, value)
            elif p.type == "INT" and not p.is_array:
                self.attempt(setattr, owner, p.identifier, self.rng.randint(max(p.hard_min, 0), min(p.hard_max, 3)))

    # ---- objects

    def put(self, data: bpy.types.ID | None, name: str) -> bpy.types.Object:
        obj = bpy.data.objects.new(self.rng.choice((name, name, "Ding é", "a/b", "x" * 60)), data)
        where = self.rng.choice([self.scene.collection, self.scene.collection, *self.collections])
        where.objects.link(obj)
        obj.location, obj.rotation_euler = self.numbers(3), self.numbers(3)
        if self.rng.random() < 0.3:
            obj.scale = self.numbers(3, 0.1, 2.0)
        if self.rng.random() < 0.05:
            obj.scale = self.rng.choice(((0, 1, 1), (-1, 1, 1), (1e-3, 1, 1), (0, 0, 0)))
        return obj

    def mesh_object(self) -> None:
        rng = self.rng
        data, bm = bpy.data.meshes.new("mesh"), bmesh.new()
        kind = rng.randrange(9)
        if kind == 0:
            bmesh.ops.create_cube(bm, size=2.0)
        elif kind == 1:
            bmesh.ops.create_grid(bm, x_segments=3, y_segments=2, size=4.0)
        elif kind == 2:
            bmesh.ops.create_icosphere(bm, subdivisions=1, radius=1.0)
        elif kind == 3:
            bmesh.ops.create_cone(bm, cap_ends=rng.random() < 0.5, segments=5, radius1=1.0, radius2=rng.choice((0.0, 0.5)), depth=1.0)
        elif kind == 4:
            bmesh.ops.create_cube(bm, size=20.0)
            bmesh.ops.reverse_faces(bm, faces=bm.faces)
        elif kind == 5:  # vertices anywhere, faces between any of them
            points = [bm.verts.new(self.numbers(3)) for _ in range(rng.randint(0, 8))]
            for _ in range(rng.randint(0, 5)):
                self.attempt(bm.faces.new, rng.sample(points, min(len(points), rng.randint(3, 5))))
        elif kind == 6:
            for k in range(3):
                bm.verts.new((float(k), 0.0, 0.0))
        else:
            bmesh.ops.create_grid(bm, x_segments=1, y_segments=1, size=rng.choice((0.5, 5.0, 200.0)))
        bm.to_mesh(data)
        bm.free()
        if kind == 5 and rng.random() < 0.3:
            data.from_pydata([(0, 0, 0)] * 3 + [(1, 0, 0)], [], [(0, 1, 2), (0, 3, 3), (0, 1, 3)])
        for _ in range(rng.choice((0, 0, 1, 1, 2, 8))):
            data.uv_layers.new(name=rng.choice(("UVMap", "Lightmap", "é")))
        for _ in range(rng.choice((0, 0, 1, 2))):
            domain, type = (
                rng.choice(("POINT", "CORNER", "FACE")),
                rng.choice(("FLOAT_COLOR", "BYTE_COLOR", "FLOAT", "INT", "FLOAT_VECTOR")),
            )
            self.attempt(data.attributes.new, rng.choice(("AdjointGI", "Col", "any")), type, domain)
        for _ in range(rng.choice((0, 1, 1, 2))):
            data.materials.append(self.any(self.materials))
        if len(data.polygons):
            data.polygons.foreach_set("material_index", [rng.choice((0, 0, 1, 7)) for _ in data.polygons])
            if rng.random() < 0.5:
                data.polygons.foreach_set("use_smooth", [True] * len(data.polygons))
        obj = self.put(data, "mesh")
        if rng.random() < 0.1:
            obj.shape_key_add(name="Basis")
            self.attempt(lambda: obj.shape_key_add(name="Key").data[0].co.__setitem__(slice(None), self.numbers(3)))
        if rng.random() < 0.1 and obj.material_slots:
            obj.material_slots[0].link = "OBJECT"
            obj.material_slots[0].material = self.any(self.materials)

    def other_object(self) -> None:
        kind = self.rng.choice(
            ("CURVE", "SURFACE", "FONT", "META", "VOLUME", "EMPTY", "ARMATURE", "LATTICE", "SPEAKER", "HAIR", "POINTS", "PROBE")
        )
        if kind in ("CURVE", "SURFACE", "FONT"):
            data = bpy.data.curves.new("curve", kind)
            if kind == "CURVE":
                spline = data.splines.new("POLY")
                spline.points.add(2)
                for point in spline.points:
                    point.co = (*self.numbers(3), 1.0)
                data.bevel_depth = self.rng.choice((0.0, 0.1, self.number()))
            elif kind == "FONT":
                data.body = self.rng.choice(("a", ""))
        elif kind == "META":
            data = bpy.data.metaballs.new("meta")
            data.elements.new()
        else:
            made = {"VOLUME": "volumes", "ARMATURE": "armatures", "LATTICE": "lattices", "SPEAKER": "speakers", "HAIR": "hair_curves",
                    "POINTS": "pointclouds"}  # fmt: skip
            data = (
                None
                if kind == "EMPTY"
                else bpy.data.lightprobes.new("probe", "SPHERE")
                if kind == "PROBE"
                else getattr(bpy.data, made[kind]).new(kind)
            )
        self.put(data, kind.lower())

    def collection(self) -> None:
        made = bpy.data.collections.new("collection")
        self.scene.collection.children.link(made)
        self.collections.append(made)

    def copy(self) -> None:
        """A linked duplicate, or a full one."""
        made = self.any(list(self.scene.objects)).copy()
        if made.data is not None and self.rng.random() < 0.3:
            made.data = made.data.copy()
        self.scene.collection.objects.link(made)
        made.location = self.numbers(3)

    def instancer(self) -> None:
        rng = self.rng
        if rng.random() < 0.5 and self.collections:
            made = self.put(None, "instancer")
            made.instance_type, made.instance_collection = "COLLECTION", self.any(self.collections)
        elif rng.random() < 0.7:
            parent, child = self.any(self.meshes()), self.any(self.meshes())
            if parent != child and child.parent is None and parent.parent is None:
                child.parent = parent
                parent.instance_type = rng.choice(("VERTS", "FACES", "NONE"))
                if rng.random() < 0.2:
                    child.matrix_parent_inverse = Matrix(((1, 0.8, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)))
        else:
            obj = self.any(self.meshes())
            obj.modifiers.new("particles", "PARTICLE_SYSTEM")
            settings = obj.particle_systems[-1].settings
            settings.count = 3
            settings.type = rng.choice(("HAIR", "EMITTER"))
            settings.render_type = rng.choice(("OBJECT", "PATH", "HALO", "COLLECTION"))
            self.attempt(setattr, settings, "instance_object", self.any(self.meshes()))

    def modifier(self) -> None:
        kind = self.rng.choice(MODIFIERS)
        made = self.any(self.meshes()).modifiers.new(kind.lower(), kind)
        if kind in ("ARRAY", "BOOLEAN", "MASK", "BUILD", "SOLIDIFY", "BEVEL"):
            self.vary(made, 0.1)
        if kind == "BOOLEAN":
            made.object = self.any(self.meshes())
        elif kind == "NODES":
            made.node_group = self.geometry()
        if self.rng.random() < 0.1:
            made.show_viewport = not made.show_viewport
        elif self.rng.random() < 0.1:
            made.show_render = not made.show_render

    def geometry(self) -> bpy.types.NodeTree:
        """A chain of random geometry nodes."""
        tree = bpy.data.node_groups.new("geometry", "GeometryNodeTree")
        for direction in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
        last = tree.nodes.new("NodeGroupInput").outputs[0]
        for _ in range(self.rng.randint(0, 4)):
            self.attempt(tree.nodes.new, self.rng.choice(GEOMETRY))
        for node in list(tree.nodes)[1:]:
            for socket in node.inputs:
                if socket.type == "GEOMETRY" and self.rng.random() < 0.9:
                    tree.links.new(last, socket)
                elif socket.type == "OBJECT":
                    socket.default_value = self.any(list(self.scene.objects))
                elif socket.type == "COLLECTION":
                    socket.default_value = self.any(self.collections)
                elif socket.type == "MATERIAL":
                    socket.default_value = self.any(self.materials)
                elif socket.type == "STRING":
                    socket.default_value = "UVMap"
            out = next((s for s in node.outputs if s.type == "GEOMETRY" and s.enabled), None)
            last = out or last
        tree.links.new(last, tree.nodes.new("NodeGroupOutput").inputs[0])
        return tree

    def switch(self) -> None:
        """Hide an object or a collection in one of many ways, or enter edit mode."""
        rng, obj = self.rng, self.any(list(self.scene.objects))
        what = rng.choice(("hide_render", "hide_viewport", "hide", "show_instancer_for_render", "exclude", "collection", "edit"))
        if what == "hide":
            obj.hide_set(True)
        elif what == "exclude":
            bpy.context.view_layer.layer_collection.children[self.any(self.collections).name].exclude = True
        elif what == "collection":
            self.any(self.collections).hide_render = True
        elif what == "edit" and rng.random() < 0.3:
            bpy.context.view_layer.objects.active = self.any(self.meshes())
            bpy.ops.object.mode_set(mode="EDIT")
        else:
            setattr(obj, what, what != "show_instancer_for_render")

    # ---- materials, lamps, camera, world

    def image(self) -> None:
        rng = self.rng
        made = bpy.data.images.new(
            "image", rng.choice((1, 2, 5)), rng.choice((1, 3)), alpha=rng.random() < 0.5, float_buffer=rng.random() < 0.5
        )
        made.pixels.foreach_set(np.array(self.numbers(len(made.pixels), 0.0, 1.0), np.float32))
        if rng.random() < 0.2:
            made.source, made.filepath = rng.choice(("FILE", "SEQUENCE", "MOVIE", "TILED")), "//nothing.png"
        self.attempt(setattr, made.colorspace_settings, "name", rng.choice(("sRGB", "Non-Color", "Linear Rec.709", "ACES2065-1")))
        made.alpha_mode = rng.choice(("STRAIGHT", "PREMUL", "CHANNEL_PACKED", "NONE"))
        self.images.append(made)

    def material(self) -> None:
        made = bpy.data.materials.new("material")
        self.materials.append(made)
        if made.node_tree is None and self.rng.random() < 0.9:
            made.use_nodes = True
        if made.node_tree is not None:
            self.nodes(made.node_tree, "ShaderNodeOutputMaterial")

    def nodes(self, tree: bpy.types.NodeTree, end: str, depth: int = 0) -> None:
        """Random nodes and links; an output at the end, most of the time."""
        rng = self.rng
        if rng.random() < 0.1:
            return
        tree.nodes.clear()
        if rng.random() < 0.95:
            tree.nodes.new(end)
        for _ in range(rng.randint(1, 7)):
            with contextlib.suppress(*REFUSED):
                node = tree.nodes.new(rng.choice(rng.choice((COMMON, COMMON, SHADERS, ("NodeReroute", "NodeFrame")))))
                self.vary(node)
                node.mute = rng.random() < 0.05
                if hasattr(node, "image"):
                    node.image = self.any(self.images)
                for name in ("attribute_name", "layer_name", "uv_map"):
                    if hasattr(node, name):
                        setattr(node, name, rng.choice(("", "Col", "UVMap")))
                for socket in node.inputs:
                    self.attempt(self.value, socket)
        if depth < 2 and rng.random() < 0.2:
            self.attempt(self.group, tree, depth)
        outputs = [s for n in tree.nodes for s in n.outputs]
        inputs = [s for n in tree.nodes for s in n.inputs]
        for _ in range(rng.randint(0, 10)):
            if outputs and inputs:
                self.attempt(self.link, tree)
        last = next((n for n in tree.nodes if n.bl_idname == end), None)
        shaders = [s for n in tree.nodes for s in n.outputs if s.type == "SHADER"]
        if last is not None and shaders and rng.random() < 0.9:
            tree.links.new(rng.choice(shaders), last.inputs[0])

    def link(self, tree: bpy.types.NodeTree) -> None:
        """Any output to any input: sockets of reroutes change with every link, so they are looked up anew."""
        tree.links.new(self.any([s for n in tree.nodes for s in n.outputs]), self.any([s for n in tree.nodes for s in n.inputs]))

    def value(self, socket: bpy.types.NodeSocket) -> None:
        if self.rng.random() < 0.3 and hasattr(socket, "default_value"):
            if socket.type == "VALUE":
                socket.default_value = self.number()
            elif socket.type in ("RGBA", "VECTOR"):
                socket.default_value = self.numbers(len(socket.default_value), 0.0, 1.0)

    def group(self, tree: bpy.types.NodeTree, depth: int) -> None:
        inner = bpy.data.node_groups.new("group", "ShaderNodeTree")
        for kind in ("NodeSocketShader", "NodeSocketColor", "NodeSocketFloat"):
            for direction in ("INPUT", "OUTPUT"):
                inner.interface.new_socket(kind, in_out=direction, socket_type=kind)
        inner.nodes.new("NodeGroupInput")
        self.nodes(inner, "NodeGroupOutput", depth + 1)
        tree.nodes.new("ShaderNodeGroup").node_tree = self.rng.choice((inner, inner, inner, None))

    def lamp(self) -> None:
        rng = self.rng
        data = bpy.data.lights.new("lamp", rng.choice(("POINT", "SUN", "SPOT", "AREA")))
        data.energy = self.number(0.0, 100.0)
        self.vary(data, 0.15)
        if rng.random() < 0.15:
            data.use_nodes = True
            self.nodes(data.node_tree, "ShaderNodeOutputLight")
        self.put(data, "lamp")

    def camera(self) -> None:
        rng = self.rng
        data = bpy.data.cameras.new("camera")
        self.vary(data, 0.1)
        self.attempt(self.vary, data.dof, 0.2)
        made = self.put(data, "camera")
        self.scene.camera = rng.choice((made, made, made, self.any(list(self.scene.objects))))

    def world(self) -> None:
        made = bpy.data.worlds.new("world")
        made.color = self.numbers(3, 0.0, 1.0)
        self.scene.world = made
        if made.node_tree is None and self.rng.random() < 0.8:
            made.use_nodes = True
        if made.node_tree is not None and self.rng.random() < 0.8:
            self.nodes(made.node_tree, "ShaderNodeOutputWorld")

    # ---- the file

    def stored(self) -> None:
        """A property with a name of ours that holds something else."""
        owners = [*bpy.data.objects, *bpy.data.meshes, *bpy.data.materials, *bpy.data.images, *bpy.data.node_groups, *bpy.data.scenes]
        self.any(owners)["adjoint_gi" + self.rng.choice(("_", "_", "_", "")) + self.rng.choice(OURS)] = self.rng.choice(WRONG)

    def other_scene(self) -> None:
        """A second scene that shares objects with the first and has its own."""
        made = bpy.data.scenes.new("other")
        made.collection.objects.link(self.any(list(self.scene.objects)))
        self.any(list(made.objects))["adjoint_gi_hidden"] = self.rng.choice(WRONG)

    def settings(self) -> None:
        """Of the scene and its view layer."""
        self.vary(self.scene.render, 0.03)
        self.scene.render.resolution_x, self.scene.render.resolution_y = 8, 6
        self.scene.render.use_simplify = self.rng.random() < 0.3
        if self.rng.random() < 0.2:
            bpy.context.view_layer.material_override = self.any(self.materials)
