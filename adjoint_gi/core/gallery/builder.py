"""Builds `SceneArrays` by hand: for tests, benchmarks and scripts that use the core without Blender."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..scene.arrays import Camera, Color, Light, Lobe, Material, ObjectArrays, Rgb, SceneArrays


def diffuse(name: str, albedo: float | Rgb, emission: float | Rgb = 0.0) -> Material:
    """A diffuse material that also emits `emission` (radiance, W m-2 sr-1)."""
    lobes = [Lobe("diffuse", _color(albedo))]
    if np.any(np.asarray(emission)):
        lobes.append(Lobe("emission", _color(emission)))
    return Material(name, tuple(lobes))


def _color(value: float | Rgb) -> Color:
    return Color.of(*np.broadcast_to(np.asarray(value, float), 3).tolist())


class SceneBuilder:
    """Collects meshes and lights, then `build()` makes the arrays."""

    def __init__(self) -> None:
        self._parts: list[dict] = []
        self._materials: list[Material] = []
        self._lights: list[Light] = []
        self.background: Rgb = (0.0, 0.0, 0.0)
        self.camera: Camera | None = None

    def mesh(
        self,
        name: str,
        vertices: np.ndarray,
        triangles: np.ndarray,
        material: Material | Sequence[Material],
        *,
        polygon: np.ndarray | None = None,
        which: np.ndarray | None = None,
        smooth_normals: np.ndarray | None = None,
        uv: np.ndarray | None = None,
    ) -> None:
        """Add a mesh: vertices (nv, 3), triangles (nt, 3).

        `polygon` (nt,) groups triangles into faces; `which` (nt,) picks from several materials; `smooth_normals` (nv, 3)
        makes it smooth; `uv` (nt, 3, 2) becomes the layer "UVMap".
        """
        materials = [material] if isinstance(material, Material) else list(material)
        triangles = np.asarray(triangles, np.int32)
        part = {
            "name": name,
            "vertices": np.asarray(vertices, np.float64),
            "triangles": triangles,
            "polygon": np.arange(len(triangles)) if polygon is None else np.asarray(polygon),
            "material": len(self._materials) + (np.zeros(len(triangles), int) if which is None else np.asarray(which)),
            "normals": smooth_normals,
            "uv": uv,
        }
        self._materials += materials
        self._parts.append(part)

    def quad(self, name: str, corner: Sequence[float], edge_x: Sequence[float], edge_y: Sequence[float], material: Material) -> None:
        """Add a parallelogram; its normal is edge_x x edge_y."""
        p, a, b = (np.asarray(x, float) for x in (corner, edge_x, edge_y))
        uv = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32)
        self.mesh(name, np.array([p, p + a, p + a + b, p + b]), np.array([[0, 1, 2], [0, 2, 3]]), material, polygon=np.zeros(2), uv=uv)

    def box(self, name: str, low: Sequence[float], high: Sequence[float], materials: Material | Sequence[Material], inward: bool) -> None:
        """Add an axis-aligned box of six quads (-x, +x, -y, +y, -z, +z), normals inward or outward, one material or six."""
        low_, high_ = np.asarray(low, float), np.asarray(high, float)
        x, y, z = np.diag(high_ - low_)
        faces = [(low_, y, z), (low_ + x, z, y), (low_, z, x), (low_ + y, x, z), (low_, x, y), (low_ + z, y, x)]
        mats = [materials] * 6 if isinstance(materials, Material) else list(materials)
        for (corner, a, b), m, label in zip(faces, mats, ("-x", "+x", "-y", "+y", "-z", "+z"), strict=True):
            if not inward:
                a, b = b, a
            self.quad(f"{name} {label}", corner, a, b, m)

    def light(self, light: Light) -> None:
        """Add a lamp."""
        self._lights.append(light)

    def build(self) -> SceneArrays:
        """The arrays of everything added so far."""
        vertices, triangles, normals, smooth, material, owner, polygon, objects = ([] for _ in range(8))
        nv = nt = 0
        for index, p in enumerate(self._parts):
            v, t = p["vertices"], p["triangles"]
            corners = v[t]
            flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
            is_smooth = p["normals"] is not None
            normals.append(np.asarray(p["normals"])[t] if is_smooth else np.repeat(flat[:, None], 3, axis=1))
            smooth.append(np.full(len(t), is_smooth))
            vertices.append(v)
            triangles.append(t + nv)
            material.append(p["material"])
            owner.append(np.full(len(t), index))
            polygon.append(p["polygon"])
            uvs = {} if p["uv"] is None else {"UVMap": np.asarray(p["uv"], np.float32)}
            counts = {"corner_count": 3 * len(t), "polygon_count": int(p["polygon"].max(initial=-1)) + 1}
            obj = ObjectArrays(
                p["name"], p["name"], index + 1, (), nt, len(t), nv, len(v), **counts, uvs=uvs, render_uv="UVMap" if uvs else ""
            )
            objects.append(obj)
            nv, nt = nv + len(v), nt + len(t)

        def join(parts: list, shape: tuple, dtype: type) -> np.ndarray:
            return np.concatenate(parts).astype(dtype) if parts else np.zeros(shape, dtype)

        return SceneArrays(
            join(vertices, (0, 3), np.float64),
            join(triangles, (0, 3), np.int32),
            join(normals, (0, 3, 3), np.float32),
            join(smooth, (0,), bool),
            join(material, (0,), np.int32),
            join(owner, (0,), np.int32),
            join(polygon, (0,), np.int32),
            join([np.arange(3 * len(p["triangles"])).reshape(-1, 3) for p in self._parts], (0, 3), np.int32),
            tuple(self._materials),
            tuple(objects),
            lights=tuple(self._lights),
            background=self.background,
            camera=self.camera,
        )
