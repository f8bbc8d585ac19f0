# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes through the whole pipeline, the same bakes by Cycles, and fingerprints of the open file. Needs bpy."""

from __future__ import annotations

import contextlib
import hashlib
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from adjgi.adjoint_gi.bridge.baking.bake import Bake, BakeRequest
from adjgi.adjoint_gi.bridge.baking.writer import find_objects
from adjgi.adjoint_gi.bridge.results.image import linked_image, read_pixels
from adjgi.adjoint_gi.bridge.results.lightmap_uv import FACES, NAME, SHARED, STORED, make_lightmap_uvs, own_layer
from adjgi.adjoint_gi.bridge.results.links import ABOUT, MADE, RESULTS, link
from adjgi.adjoint_gi.core.base.errors import AdjointError
from adjgi.adjoint_gi.core.method import registry
from adjgi.adjoint_gi.core.receivers.texels import Lightmap
from adjgi.adjoint_gi.core.scene.arrays import RayKind
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load

__all__ = ["AdjointError"]  # for tests
load()
SMOOTH = 2  # texels on each side over which variances of one image are averaged


# ---- our bakes


@dataclass(frozen=True, eq=False)
class Baked:
    """One lightmap of ours: what the image datablock holds.

    values  (h, w, 3) float64 irradiance
    share   (h, w) float32 share of each texel's points that lie on the surface
    whole   (h, w) bool: see `on_one_triangle`
    layer   the UV layer
    lightmap, world   where the texels lie
    """

    values: np.ndarray
    share: np.ndarray
    whole: np.ndarray
    layer: str
    lightmap: Lightmap
    world: World


def request(method: str = "path_tracing", target: str = "texture", values: dict | None = None, **more: object) -> BakeRequest:
    """A bake by `method` with settings `values`; `more` are fields of the request."""
    return BakeRequest(method, registry.method(method).Settings().replaced(values or {}), target, **more)


def bake(req: BakeRequest) -> Bake:
    """Bake to the end and write."""
    made = Bake(bpy.context, req)
    solution = made.driver.run()
    assert solution is not None and not solution.partial
    made.write(solution)
    return made


def lightmaps(req: BakeRequest) -> dict[str, Baked]:
    """Bake textures, one an object, and read them from Blender's images; by name of the object."""
    made = bake(req)
    out = {}
    for sheet in made.writer.sheets:
        (obj,) = find_objects(sheet.uids, sheet.name)
        pixels = read_pixels(linked_image(obj, req.quantity)).astype(np.float64)
        out[sheet.name] = Baked(
            pixels[..., :3],
            sheet.lightmap.share,
            on_one_triangle(sheet.lightmap),
            link(obj, req.quantity)["uv_layer"],
            sheet.lightmap,
            made.driver.world,
        )
    return out


def quad(name: str, corners: Sequence[tuple[float, float, float]], material: bpy.types.Material) -> bpy.types.Object:
    """An object of one face with four `corners`."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    mesh.materials.append(material)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def on_one_triangle(lightmap: Lightmap) -> np.ndarray:
    """(h, w) bool: all points of the texel lie on one triangle, where Cycles samples the texel as we do."""
    r = lightmap.receivers
    first = r.start[:-1]
    one = np.minimum.reduceat(r.triangle, first) == np.maximum.reduceat(r.triangle, first)
    return lightmap.image((one & lightmap.whole).astype(np.float32))[..., 0] > 0


def make_lightmap_uv(obj: bpy.types.Object, name: str = NAME, resolution: int = 512, padding: int = 4) -> str:
    """Make (or renew) our UV layer of `obj` and return its name; see `make_lightmap_uvs`."""
    make_lightmap_uvs([obj], resolution, (padding,), name)
    return own_layer(obj)


def outlined(baked: Baked, boxes: Sequence[bpy.types.Object]) -> np.ndarray:
    """(h, w) bool: texels that the outline of a box standing on them cuts."""
    receivers, world = baked.lightmap.receivers, baked.world
    position = world.surface(receivers.triangle, receivers.u, receivers.v).position + world.center
    cut = np.zeros(baked.share.shape, bool)
    for box in boxes:
        back, bound = box.matrix_world.inverted(), np.array(box.bound_box)
        local = position @ np.array(back.to_3x3()).T + np.array(back.translation)
        within = (local[:, :2] > bound.min(axis=0)[:2]) & (local[:, :2] < bound.max(axis=0)[:2])
        inside = within.all(axis=1) & (np.abs(local[:, 2]) < 1e-4)
        count = np.add.reduceat(inside.astype(int), receivers.start[:-1])
        mixed = (count > 0) & (count < np.diff(receivers.start))
        cut |= baked.lightmap.image(mixed.astype(np.float32))[..., 0] > 0
    return cut


def doubled(baked: Baked, distance: float = 2e-3) -> np.ndarray:
    """(h, w) bool: texels with a point on which another surface lies within `distance` metres, above or below.

    Where faces coincide, Cycles' rays may meet the other one at distance zero, while ours start an offset away from both.
    """
    receivers, world = baked.lightmap.receivers, baked.world
    surface = world.surface(receivers.triangle, receivers.u, receivers.v)
    mixed = np.zeros(len(receivers.triangle), bool)
    for side in (1.0, -1.0):
        normal = (side * surface.ng).astype(np.float32)
        origin = np.ascontiguousarray(surface.position + np.float32(distance) * normal, np.float32)
        hit, _, _, t = world.intersect(origin, np.ascontiguousarray(-normal), RayKind.CAMERA)
        mixed |= (hit != receivers.triangle) & (t < 2 * distance)
    count = np.add.reduceat(mixed.astype(int), receivers.start[:-1])
    return baked.lightmap.image((count > 0).astype(np.float32))[..., 0] > 0


# ---- Cycles


@contextlib.contextmanager
def shown(scene: bpy.types.Scene) -> Iterator[None]:
    """`scene` as the scene of the window, as when a user chooses it; operators of Cycles ask the window."""
    window = bpy.context.window_manager.windows[0]
    before, window.scene = window.scene, scene
    try:
        with bpy.context.temp_override(window=window):
            yield
    finally:
        window.scene = before


def use_cycles(scene: bpy.types.Scene, max_length: int) -> None:
    """Cycles without any trick that changes the mean; paths of up to `max_length` segments between light and receiver."""
    scene.render.engine = "CYCLES"
    c = scene.cycles
    c.device, c.use_adaptive_sampling, c.use_denoising = "CPU", False, False
    # Cycles counts bounces after the surface that is baked; its diffuse limit is 4 by default.
    for name in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces"):
        setattr(c, name, max_length - 1)
    c.sample_clamp_direct = c.sample_clamp_indirect = c.blur_glossy = 0.0
    c.light_sampling_threshold = 0.0


def cycles_irradiance(obj: bpy.types.Object, resolution: int, layer: str, samples: int, seed: int) -> np.ndarray:
    """(h, w, 3) float64 irradiance of `obj` baked by Cycles into the UV layer `layer`; nothing of the bake stays behind.

    A diffuse bake without colour gives outgoing radiance of a white diffuser, which is irradiance / pi.
    """
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.seed = samples, seed
    image = bpy.data.images.new("cycles", resolution, resolution, alpha=False, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    nodes = []
    for material in {m.name: m for m in obj.data.materials}.values():
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = image
        material.node_tree.nodes.active = node
        nodes.append((material.node_tree, node))
    for other in scene.objects:
        other.select_set(other == obj)
    bpy.context.view_layer.objects.active = obj
    try:
        bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT", "INDIRECT"}, margin=0, use_clear=True, uv_layer=layer)
        return read_pixels(image)[..., :3].astype(np.float64) * np.pi
    finally:
        for tree, node in nodes:
            tree.nodes.remove(node)
        bpy.data.images.remove(image)


# ---- statistics


@dataclass(frozen=True, eq=False)
class TexelComparison:
    """Two bakes of the same texels, each repeated with several seeds.

    ours, theirs  (h, w, 3) means over the seeds
    error         (h, w, 3) standard error of their difference: variances over the seeds, averaged over neighbouring texels
    careful       (h, w, 3) the same, but nowhere below what the texel's own seeds show
    used          (h, w) bool texels that are compared
    """

    ours: np.ndarray
    theirs: np.ndarray
    error: np.ndarray
    careful: np.ndarray
    used: np.ndarray

    @property
    def mean(self) -> float:
        """Relative difference of the means over the texels and channels."""
        return float(self.ours[self.used].mean() / self.theirs[self.used].mean() - 1)

    @property
    def mean_error(self) -> float:
        """Relative standard error of `mean`: paths carry all channels, so their errors add up as they are; those of texels by squares."""
        return float(np.sqrt((self.error[self.used].sum(axis=1) ** 2).sum()) / self.theirs[self.used].sum())

    @property
    def z(self) -> np.ndarray:
        """(n, 3) differences in standard errors."""
        return ((self.ours - self.theirs) / np.maximum(self.error, self.floor))[self.used]

    @property
    def worst(self) -> float:
        """Largest |difference| in careful standard errors."""
        return float(np.abs((self.ours - self.theirs) / np.maximum(self.careful, self.floor))[self.used].max())

    @property
    def floor(self) -> float:
        """Below this a difference is rounding of float32 and nothing else."""
        return 1e-5 * float(self.theirs[self.used].mean())

    @property
    def noise(self) -> float:
        """Typical standard error of a texel, relative to the mean."""
        return float(np.median(self.error[self.used]) / self.theirs[self.used].mean())

    def limit(self, comparisons: int = 1) -> float:
        """Limit of `worst` at 0.1 % for all texels and channels of that many such comparisons together (Sidak), for normal deviates."""
        return sidak(3 * int(self.used.sum()) * comparisons)


def sidak(tests: int, alpha: float = 1e-3) -> float:
    """Two-sided limit of |z| which `tests` independent normal deviates all keep with probability 1 - alpha."""
    return statistics.NormalDist().inv_cdf(0.5 + 0.5 * (1 - alpha) ** (1 / tests))


def compare(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], used: np.ndarray) -> TexelComparison:
    """Compare runs (h, w, 3) with different seeds of two renderers on the texels `used` (h, w)."""
    parts = []
    for runs in (np.stack(ours), np.stack(theirs)):
        own = runs.var(axis=0, ddof=1) / len(runs)
        parts.append((runs.mean(axis=0), own, _neighbours(own, used)))
    (a, va, sa), (b, vb, sb) = parts
    return TexelComparison(a, b, np.sqrt(sa + sb), np.sqrt(np.maximum(va, sa) + np.maximum(vb, sb)), used)


def _neighbours(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Mean of `values` (h, w, 3) over the used texels of a square around each texel."""

    def box(x: np.ndarray) -> np.ndarray:
        padded = np.pad(x, [(SMOOTH, SMOOTH)] * 2 + [(0, 0)] * (x.ndim - 2))
        n = 2 * SMOOTH + 1
        return sum(padded[i : i + x.shape[0], j : j + x.shape[1]] for i in range(n) for j in range(n))

    weight = used.astype(np.float64)[..., None]
    return box(values * weight) / np.maximum(box(weight), 1)


# ---- what must not change


def fingerprint() -> dict[str, object]:
    """Everything of the user's in the open file by name, our results left out: two are equal when nothing of it has changed."""
    out: dict[str, object] = {}
    made = [o for o in bpy.data.objects if MADE in o]
    for mesh in {*bpy.data.meshes} - {o.data for o in made}:
        out[f"mesh {mesh.name}"] = mesh_state(mesh)
    for obj in {*bpy.data.objects} - {*made}:
        slots = [(s.link, s.material.name if s.material else None) for s in obj.material_slots]
        custom = _custom(obj, RESULTS)
        state = (obj.mode, obj.select_get() if obj.name in bpy.context.view_layer.objects else None, obj.hide_render, obj.hide_viewport)
        values = [repr(x) for row in obj.matrix_world for x in row] + [repr(x) for x in obj.scale]
        out[f"object {obj.name}"] = (values, slots, custom, state, [m.name for m in obj.modifiers], obj.data.name if obj.data else None)
    trees = [*bpy.data.materials, *bpy.data.worlds, *bpy.data.lights]
    for owner in trees:
        if owner.node_tree is not None:
            out[f"tree of {owner.name}"] = _tree(owner.node_tree)
    for tree in bpy.data.node_groups:
        out[f"group {tree.name}"] = _tree(tree)
    for image in bpy.data.images:
        if ABOUT not in image:
            out[f"image {image.name}"] = (tuple(image.size), image.source, image.filepath)
    out["active"] = getattr(bpy.context.view_layer.objects.active, "name", None)
    return out


def mesh_state(mesh: bpy.types.Mesh) -> tuple[object, ...]:
    """All of `mesh` but our UV layer and what we note of it."""
    ours = mesh.get(STORED)
    layers = [(x.name, x.active_render, _digest(x.uv, "vector", 2)) for x in mesh.uv_layers if x.name != ours]
    colors = [(x.name, x.domain, x.data_type, _digest(x.data, "color", 4)) for x in mesh.color_attributes]
    geometry = [
        _digest(mesh.vertices, "co", 3),
        _digest(mesh.loops, "vertex_index", 1),
        _digest(mesh.polygons, "loop_start", 1),
        _digest(mesh.polygons, "material_index", 1),
    ]
    materials = [m.name if m else None for m in mesh.materials]
    return geometry, layers, colors, materials, _custom(mesh, STORED, SHARED, FACES, ABOUT)


def _custom(owner: bpy.types.ID, *ours: str) -> dict[str, str]:
    """Custom properties but `ours`. Before Blender 5.0 groups of add-ons are among them, and merely reading one makes it, empty."""
    values = {k: v.to_dict() if hasattr(v, "to_dict") else v for k, v in owner.items() if k not in ours}
    return {k: str(v) for k, v in values.items() if v != {}}


def _digest(items: object, name: str, width: int) -> str:
    values = np.zeros(len(items) * width, np.float32 if width > 1 else np.int32)
    items.foreach_get(name, values)
    return hashlib.sha256(values.tobytes()).hexdigest()


def _tree(tree: bpy.types.NodeTree) -> tuple[object, ...]:
    nodes = [(n.name, n.bl_idname, n.mute, [_value(s) for s in n.inputs]) for n in tree.nodes]
    return nodes, [(x.from_node.name, x.from_socket.name, x.to_node.name, x.to_socket.name) for x in tree.links]


def _value(socket: bpy.types.NodeSocket) -> str:
    value = getattr(socket, "default_value", None)
    return repr(tuple(value)) if hasattr(value, "__len__") and not isinstance(value, str) else repr(value)
