"""From the meshes that were copied to world space: instances in groups, and the groups in the layout of `SceneArrays`. Needs no Blender."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace

import numpy as np

from ...core.base.digest import digest
from ...core.base.steps import Steps
from ...core.scene.arrays import ObjectArrays, SceneArrays
from ..host.notices import Notices
from .mesh import LARGEST_COORDINATE, MeshArrays, MeshCopy


@dataclass(frozen=True, eq=False)
class Visit:
    """One object or instance with faces, as the walk has met it.

    mesh        key of its mesh among those that were copied
    mirrored    whether its matrix turns the mesh inside out
    slots       (ns,) int32 scene material of each slot, at least one
    maker       who makes the instance, "" for an object
    instance    its path among the instances of the maker
    matrix      (16,) its place in the world, by rows
    """

    mesh: int
    mirrored: bool
    slots: np.ndarray
    name: str
    source: str
    maker: str
    uid: int
    instance: tuple[int, ...]
    matrix: tuple[float, ...]
    terminator: float


@dataclass(eq=False)
class Group:
    """Instances that share mesh, handedness and materials."""

    mesh: MeshArrays
    materials: np.ndarray  # (ns,) int32: scene material of each slot, at least one
    visits: list[Visit] = field(default_factory=list)


@dataclass(eq=False)
class Walked:
    """What the walk has copied.

    meshes      by the key that visits name
    bodiless    materials whose faces are no surface
    faceless    reason and remedy by object without faces of its own
    metas       those of them that are metaballs
    """

    meshes: Mapping[int, MeshCopy]
    visits: list[Visit]
    bodiless: Set[int]
    faceless: Mapping[str, tuple[str, str]]
    metas: Set[str]

    def key(self) -> bytes:
        """A digest of all of it; that a mesh is elsewhere in memory does not count."""
        number = {key: k for k, key in enumerate(self.meshes)}
        visits = [replace(visit, mesh=number[visit.mesh]) for visit in self.visits]
        meshes = [copy.key() for copy in self.meshes.values()]
        return digest((meshes, visits, self.bodiless, self.faceless, self.metas))

    def grouping(self, notices: Notices) -> Steps[list[Group]]:
        """All groups with at least one instance, in the order of first appearance; a step a mesh. The copies are empty afterwards."""
        meshes: dict[tuple[int, bool], MeshArrays | None] = {}
        for k, (key, copy) in enumerate(self.meshes.items()):
            meshes[key, False] = copy.arrays(notices)
            yield 0.9 * (k + 1) / len(self.meshes)
        groups: dict[tuple[int, bool, bytes], Group | None] = {}
        made: Counter[str] = Counter()  # how many instances with faces each object makes
        for visit in self.visits:
            key = visit.mesh, visit.mirrored, visit.slots.tobytes()
            if key not in groups:
                groups[key] = self._group(visit, meshes)
            group = groups[key]
            if group is not None:
                group.visits.append(visit)
                made[visit.maker] += 1
            elif meshes[visit.mesh, False] is not None:
                reason = "has volumes only, no surface, and is left out: light passes through it"
                notices.add(visit.source, reason, "", "info")
        found = [group for group in groups.values() if group is not None]
        self._name_faceless(made, notices)
        return found

    def _group(self, visit: Visit, meshes: dict[tuple[int, bool], MeshArrays | None]) -> Group | None:
        """An empty group for what is as `visit` is; None when no surface is left of its mesh."""
        arrays = meshes[visit.mesh, False]
        if arrays is not None and visit.mirrored:
            arrays = meshes[visit.mesh, True] = meshes.get((visit.mesh, True)) or arrays.mirrored()
        solid = self._solid(arrays, visit.slots) if arrays is not None else None
        return Group(solid, visit.slots) if solid is not None else None

    def _solid(self, arrays: MeshArrays, slots: np.ndarray) -> MeshArrays | None:
        """The mesh without the faces of materials that are no surface; None when nothing is left."""
        if not self.bodiless.intersection(slots.tolist()):
            return arrays
        keep = ~np.isin(slots[np.clip(arrays.slot, 0, len(slots) - 1)], list(self.bodiless))
        return arrays.taken(keep) if keep.any() else None

    def _name_faceless(self, made: Mapping[str, int], notices: Notices) -> None:
        """Name objects without faces, by what is in the light of them."""
        present = {visit.source for visit in self.visits}  # what is left out of these has been named with its own reason
        families = {name.split(".")[0] for name in present}
        for name, (reason, remedy) in self.faceless.items():
            # Metaballs of one name form one surface, which the first of them owns.
            if name in present or (name in self.metas and name.split(".")[0] in families):
                continue
            count = made[name]
            if count:
                reason, remedy = f"has no faces of its own; what it makes ({count} instance{'s' * (count > 1)}) is in the light", ""
            notices.add(name, reason, remedy, "info")


def place(groups: list[Group], default_color: bool, notices: Notices) -> SceneArrays:
    """Transform every instance to world space and join the arrays; per-mesh UV and colour arrays are shared by instances. Of what is no
    geometry there is nothing yet.

    With `default_color` the colour attribute used in rendering is entered under "" too, for nodes that name none.
    """
    objects: list[ObjectArrays] = []
    parts: list[tuple[np.ndarray, ...]] = []
    vertex_base = triangle_base = 0
    for group in groups:
        mesh = group.mesh
        matrices = np.array([visit.matrix for visit in group.visits], np.float64).reshape(-1, 4, 4)
        vertices = mesh.vertices @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]
        used = vertices[:, np.unique(mesh.triangles)] if len(matrices) == 1 else vertices
        near = (np.abs(used) <= LARGEST_COORDINATE).all(axis=(1, 2))
        for i in np.flatnonzero(~near):
            notices.add(
                group.visits[i].name, f"lies further out than {LARGEST_COORDINATE:.0e} m and is left out", "Move it closer to the origin"
            )
        kept = np.flatnonzero(near)
        k, nv, nt = len(kept), len(mesh.vertices), len(mesh.triangles)
        if not k:
            continue
        shift = vertex_base + nv * np.arange(k)[:, None, None]
        slots = group.materials[np.clip(mesh.slot, 0, len(group.materials) - 1)]
        first = len(objects)
        parts.append(
            (
                vertices[kept].reshape(-1, 3),
                (mesh.triangles[None] + shift).astype(np.int32).reshape(-1, 3),
                _world_normals(mesh.normals, matrices[kept]),
                np.tile(mesh.smooth, k),
                np.tile(slots, k),
                np.repeat(np.arange(first, first + k, dtype=np.int32), nt),
                np.tile(mesh.polygon, k),
                np.tile(mesh.corners, (k, 1)),
            )
        )
        objects += _objects(group, kept, triangle_base, vertex_base, default_color)
        vertex_base += nv * k
        triangle_base += nt * k
    empty = (
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 3, 3), np.float32),
        np.zeros(0, bool),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 3), np.int32),
    )
    columns = [np.concatenate([e, *(p[c] for p in parts)]) for c, e in enumerate(empty)]
    return SceneArrays(*columns, materials=(), objects=tuple(objects))


def _objects(group: Group, kept: np.ndarray, first_triangle: int, first_vertex: int, default_color: bool) -> list[ObjectArrays]:
    """The instances `kept` (k,) of a group, whose triangles and vertices lie behind one another from the first ones on."""
    mesh, colors = group.mesh, group.mesh.colors
    nv, nt = len(mesh.vertices), len(mesh.triangles)
    if default_color and mesh.render_color in colors:
        colors = {**colors, "": colors[mesh.render_color]}
    return [
        ObjectArrays(
            name=visit.name,
            source=visit.source,
            maker=visit.maker,
            uid=visit.uid,
            instance=visit.instance,
            first_triangle=first_triangle + j * nt,
            triangle_count=nt,
            first_vertex=first_vertex + j * nv,
            vertex_count=nv,
            corner_count=mesh.corner_count,
            polygon_count=mesh.polygon_count,
            uvs=mesh.uvs,
            render_uv=mesh.render_uv,
            colors=colors,
            selected=mesh.selected,
            terminator=visit.terminator,
        )
        for j, visit in enumerate(group.visits[i] for i in kept.tolist())
    ]


def _world_normals(normals: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Object-space unit normals (nt, 3, 3) by the inverse transpose of each matrix (k, 4, 4) -> (k * nt, 3, 3) float32 unit.

    The inverse transpose maps an outward normal to an outward normal for mirrored matrices too.
    """
    inverse = np.linalg.inv(matrices[:, :3, :3])
    # Only the direction counts: scaling keeps float32 in range for tiny and huge matrices.
    inverse /= np.abs(inverse).max(axis=(1, 2), keepdims=True)
    world = (normals.reshape(-1, 3) @ inverse.astype(np.float32)).reshape(-1, 3, 3)
    length = np.linalg.norm(world, axis=2, keepdims=True)
    return world / np.maximum(length, np.float32(1e-30))
