# SPDX-License-Identifier: GPL-3.0-or-later
"""The passes of a picture: one list for naming, adding and filling them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...core.lights.background import Background
from ...core.method.registry import MethodSpec
from ...core.method.solution import Solution
from ...core.receivers.base import CameraReceivers
from ...core.scene.world import World

FAR = 1e10  # depth where there is no surface, as in Cycles


def passes(spec: MethodSpec | None) -> Iterator[tuple[str, int, str, str]]:
    """(name, channels, channel names, type) of every pass a picture by this method has."""
    yield ("Combined", 4, "RGBA", "COLOR")
    yield ("Depth", 1, "Z", "VALUE")
    yield ("Normal", 3, "XYZ", "VECTOR")
    yield ("Emission", 3, "RGB", "COLOR")
    yield ("Direct", 3, "RGB", "COLOR")
    yield ("Indirect", 3, "RGB", "COLOR")
    yield ("Albedo", 3, "RGB", "COLOR")
    if spec is not None and spec.uses_elements and spec.answers == "light":
        yield ("Elements", 3, "RGB", "COLOR")


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the camera meets: alpha (n,), depth (n,) along the axis in m, normal (n, 3), and the radiance of the background that it
    sees, `behind` (n, 3); all float32."""

    alpha: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    behind: np.ndarray

    @staticmethod
    def of(world: World, receivers: CameraReceivers) -> Geometry:
        """Alpha and normal are means over the fixed grid of each pixel, depth is that of the nearest of its points."""
        n = receivers.count
        camera = world.scene.camera
        forward = np.asarray(camera.forward, np.float32)
        hits, rays = np.zeros(n), np.zeros(n)
        normal, behind = np.zeros((n, 3)), np.zeros((n, 3))
        background = Background(world)
        depth = np.full(n, FAR, np.float32)
        for points in receivers.sites():
            hit = points.triangle >= 0
            at = np.flatnonzero(hit)
            owner = points.receiver[at]
            surface = world.surface(points.triangle[at], points.u[at], points.v[at], points.towards[at])
            rays += np.bincount(points.receiver, minlength=n)
            hits += np.bincount(owner, minlength=n)
            sky = background.radiance(-points.towards[~hit].T)
            for c in range(3):
                normal[:, c] += np.bincount(owner, surface.ns[:, c], minlength=n)
                behind[:, c] += np.bincount(points.receiver[~hit], sky[c], minlength=n)
            # The points of one pixel stand together, all in the same chunk.
            first = np.flatnonzero(np.diff(points.receiver, prepend=-1))
            along = camera.clip_start - np.where(hit, points.distance, 0) * (points.towards @ forward)
            depth[points.receiver[first]] = np.minimum.reduceat(np.where(hit, along, FAR), first)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        rays = np.maximum(rays, 1)
        unit = normal / np.maximum(length, 1e-12)
        return Geometry((hits / rays).astype(np.float32), depth, unit.astype(np.float32), (behind / rays[:, None]).astype(np.float32))


def pixels(spec: MethodSpec, solution: Solution, geometry: Geometry, transparent: bool = False) -> dict[str, np.ndarray]:
    """(n, channels) float32 for every pass; with a transparent film the background's share is taken out."""
    radiance, emission = solution.quantity(solution.whole), solution.emitted
    alpha = np.ones_like(geometry.alpha)
    if transparent:
        alpha = geometry.alpha
        behind = geometry.behind * (solution.measure == "radiance")
        radiance, emission = (np.where(alpha[:, None] > 0, np.maximum(x - behind, 0), 0) for x in (radiance, emission))
    out = {
        "Combined": np.concatenate([radiance, alpha[:, None]], axis=1),
        "Depth": geometry.depth[:, None],
        "Normal": geometry.normal,
        "Emission": emission,
        "Direct": solution.direct,
        "Indirect": solution.indirect,
        "Albedo": solution.albedo,
    }
    if spec.uses_elements and spec.answers == "light":
        out["Elements"] = solution.extra.get("elements", np.zeros_like(solution.direct))
    return out
