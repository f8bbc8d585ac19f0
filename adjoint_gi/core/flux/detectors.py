"""Sets of receivers S and their function g, the source term of the potential equation (review, Eq. 2), and the flux of a set by both
equations (Eq. 3 and 4).

Flux and potential are those of

    faces    S holds all directions out of some faces, on their front or on both sides. Flux Phi is the light that leaves them, W; g is
             1 on them; W is the share of light emitted at a place that is part of Phi, without unit.
    camera   S holds what goes to the camera through its picture. A perspective camera has Phi = integral of L cos over the picture's
             solid angle, the light that falls on a unit of lens area within the picture, W m-2, so W is in m-2. An orthographic one
             has Phi = integral of L over its window, W sr-1, and W is in sr-1.

Lamps have no surface that could have a potential. By Eq. 4 a lamp's flux is the integral of its radiance times W(x, direction), and
W(x, direction) is rho(y) W(y) at the first point y that it meets: so the light of lamps and background counts where it first arrives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.errors import SceneError, SettingsError
from ..bsdf.table import BsdfTable
from ..elements.elements import Elements
from ..lights.emission import Emission, Particles
from ..receivers.base import CameraReceivers, Receivers
from ..sampling.additive import STEPS, additive
from ..scene.arrays import RayKind
from ..scene.passing import MOST_LAYERS
from ..scene.world import World
from ..walks.particles import Hits, walk

CAMERA_RAYS = 1 << 18  # that find what the camera sees
SAMPLES_PER_BATCH = 1 << 15
LEAST = 16  # batches of particles, so that their spread tells the error


class Detector:
    """A set of receivers. name for reports; unit of its flux."""

    name: str
    unit: str

    def on_elements(self, elements: Elements) -> np.ndarray:
        """(2 ne, 3) float64: g of every element side, its mean over the side and, by the cosine, over its directions."""
        raise TypeError(f"{type(self).__name__} does not define on_elements()")


class FaceDetector(Detector):
    """All directions out of the triangles `mask` (nt,) bool, from their front or, with `both`, from both sides.

    The inside of a closed object is lit by nothing, but has a high potential towards itself, which elements that reach under the
    object would carry outside: so closed objects are better taken by their fronts.
    """

    unit = "W"

    def __init__(self, mask: np.ndarray, name: str, both: bool = False) -> None:
        self.mask = np.asarray(mask, bool)
        self.name = name
        self.both = both

    def holds(self, triangle: np.ndarray, side: np.ndarray) -> np.ndarray:
        """(n,) bool: whether points on the side (n,), +1 front or -1 back, of triangles (n,) are in the set; not where those are -1."""
        return (triangle >= 0) & self.mask[triangle] & (self.both | (side > 0))

    def on_elements(self, elements: Elements) -> np.ndarray:
        """1 on the sides of these faces."""
        out = np.repeat(self.mask[elements.patch_triangle[elements.patch]].astype(np.float64), 2)
        out[1::2] *= self.both
        return np.repeat(out[:, None], 3, axis=1)

    def on_receivers(self, world: World, receivers: Receivers) -> np.ndarray:
        """(n, 3) float32: g of other receivers, the share of each one's points that are in the set."""
        total, count = np.zeros(receivers.count), np.zeros(receivers.count)
        for points in receivers.sites():
            side = np.ones(len(points.receiver))
            if points.towards is not None:
                side = np.einsum("ij,ij->i", world.rows[points.triangle, 9:12], points.towards)
            total += np.bincount(points.receiver, self.holds(points.triangle, side), receivers.count)
            count += np.bincount(points.receiver, minlength=receivers.count)
        return np.repeat((total / np.maximum(count, 1)).astype(np.float32)[:, None], 3, axis=1)


class CameraDetector(Detector):
    """What the scene's camera sees through its picture. Raises SceneError without a camera."""

    name = "Camera"

    def __init__(self, world: World) -> None:
        if world.scene.camera is None:
            raise SceneError("Scene", "has no camera, so nothing has a potential for its view", "Add a camera, or choose objects or faces")
        self.world = world
        self.camera = world.scene.camera
        self.eye = CameraReceivers(world)
        self.unit = "W m-2" if self.camera.kind == "perspective" else "W sr-1"
        left, right, bottom, top = self.camera.frame
        self._frame_area = abs((right - left) * (top - bottom))

    def share(self, direction: np.ndarray) -> np.ndarray:
        """(n,) float64: what the radiance along rays into the scene, spread evenly over the picture, is weighted with; sr or m2.

        The mean of share times radiance over the picture is its flux. A square of the frame at distance 1 has cos^3 of its area as
        solid angle, and the lens sees it by another cosine.
        """
        if self.camera.kind == "orthographic":
            return np.full(len(direction), self._frame_area)
        cosine = direction.astype(np.float64) @ np.asarray(self.camera.forward, np.float64)
        return self._frame_area * cosine**4

    def rays(self, s: np.ndarray, t: np.ndarray, lens: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (n, 3) float32 through places s, t (n,) of the picture in 0..1, and points of the lens (2, n)."""
        e, none = self.eye, np.zeros(len(s), np.int64)
        x, y = s * e.width, t * e.height
        if lens is None or self.camera.aperture_radius <= 0:
            return e.rays(none, x, y)
        return e.lens_rays(none, x, y, lens)

    def reach(self, direction: np.ndarray) -> np.ndarray:
        """(n,) float32 length of rays up to the far clipping plane."""
        depth = self.camera.clip_end - self.camera.clip_start
        return (depth / np.maximum(direction @ np.asarray(self.camera.forward, np.float32), np.float32(1e-6))).astype(np.float32)

    def on_elements(self, elements: Elements) -> np.ndarray:
        """A g = integral over the picture of the share / pi, from a fixed grid of rays: a diffuse side sends B / pi to the camera."""
        columns = max(1, round(np.sqrt(CAMERA_RAYS * self.eye.width / self.eye.height)))
        rows = max(1, CAMERA_RAYS // columns)
        total = np.zeros((2 * elements.count, 3))
        for first in range(0, rows * columns, SAMPLES_PER_BATCH):
            k = np.arange(first, min(first + SAMPLES_PER_BATCH, rows * columns))
            lens = additive(k, STEPS[2])
            o, d = self.rays((k % columns + 0.5) / columns, (k // columns + 0.5) / rows, lens.astype(np.float32))
            self._add(total, elements, o, d)
        return total / (rows * columns) / np.pi / np.maximum(np.repeat(elements.area, 2), 1e-300)[:, None]

    def _add(self, total: np.ndarray, elements: Elements, o: np.ndarray, d: np.ndarray) -> None:
        """Add to `total` (2 ne, 3) the share of rays at every side that they see, through what lets light straight through, too."""
        passing, share = self.world.passing, np.repeat(self.share(d).astype(np.float64)[:, None], 3, axis=1)
        hit = triangle, u, v, t = tuple(np.array(a) for a in self.world.intersect(o, d, RayKind.CAMERA))
        rows = np.flatnonzero((triangle >= 0) & (t <= self.reach(d)))
        for _ in range(MOST_LAYERS):
            at = triangle[rows], u[rows], v[rows]
            facing = np.where(np.einsum("ij,ij->i", self.world.rows[at[0], 9:12], d[rows]) > 0, -1, 1)
            side = elements.side(*at, facing)
            for c in range(3):
                total[:, c] += np.bincount(side, share[rows, c], len(total))
            if passing is None or not passing.lets[at[0]].any():
                return
            share[rows] *= passing.through(*at)
            rows = rows[share[rows].max(axis=1) > 0]
            self.world.onward(o, d, RayKind.CAMERA, hit, rows)
            rows = rows[(triangle[rows] >= 0) & (t[rows] <= self.reach(d[rows]))]

    def particles(self, n: int, rng: np.random.Generator) -> Particles:
        """`n` particles of importance that leave through the picture; together they weigh the integral of the share, over pi.

        The importance that arrives on a surface, per area, is the potential there of what it emits.
        """
        s = additive(np.arange(1, n + 1), STEPS[1], rng.random())[0]
        t = (np.arange(n) + rng.random(n)) / n
        o, d = self.rays(s, t, rng.random((2, n), np.float32))
        weight = np.repeat((self.share(d) / (np.pi * n)).astype(np.float32)[:, None], 3, axis=1)
        return Particles(o, d, weight, np.zeros(n, np.int32), np.zeros(n, np.float32), self.reach(d), RayKind.CAMERA)


def objects_named(world: World, names: Sequence[str]) -> np.ndarray:
    """(k,) indices of the scene's objects that are called so, or made from an object called so; SettingsError for an unknown name."""
    objects = world.scene.objects
    found = []
    for name in names:
        these = [i for i, o in enumerate(objects) if name in (o.name, o.source)]
        if not these:
            known = ", ".join(o.name for o in objects[:20]) + (" and more" if len(objects) > 20 else "")
            raise SettingsError("objects", f"no object is called {name!r}", f"Choose from: {known}")
        found += these
    return np.unique(np.array(found, np.int64))


def names_in(text: str) -> list[str]:
    """The names in a list separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def detector(world: World, kind: str, objects: str = "", both: bool = False) -> Detector:
    """The receivers "camera"; "objects" of these names (separated by commas); or the selected "faces", of these or of all objects.

    `both`: faces count on both sides. Raises SceneError or SettingsError where there are none.
    """
    if kind == "camera":
        return CameraDetector(world)
    names = names_in(objects)
    if kind == "objects" and not names:
        raise SettingsError("objects", "names no object", "Write the names of the receivers, separated by commas")
    chosen = objects_named(world, names) if names else np.arange(len(world.scene.objects))
    mask = np.zeros(world.triangle_count, bool)
    for index in chosen:
        obj = world.scene.objects[index]
        if kind == "objects":
            mask[obj.triangles] = True
        elif obj.selected is not None:
            mask[obj.triangles] = obj.selected
    if not mask.any():
        raise SceneError(", ".join(names) or "Scene", "has no selected face to be the receiver", "Select faces in Edit Mode, then leave it")
    return FaceDetector(mask, ", ".join(names) if names else "Selected faces", both)


@dataclass(frozen=True, eq=False)
class Flux:
    """The flux of a receiver set by path length - of light emitted there, (0), arriving directly and sent on (1), and after more
    reflections (2 and more) - as value and standard error, (3 parts, 3 colours) float64; error 0 where nothing is random."""

    value: np.ndarray
    error: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """(3,) all of it."""
        return self.value.sum(axis=0)

    def arrays(self) -> dict[str, np.ndarray]:
        """For `Solution.extra`: "flux" and "flux_error", (3 path lengths, 3 colours) float64."""
        return {"flux": self.value, "flux_error": self.error}


def flux_by_potential(elements: Elements, arriving: np.ndarray, parts: Sequence[np.ndarray]) -> Flux:
    """Phi = <W, Le> (Eq. 4, 14) for the potential `parts` (k, 2 ne, 3) of 0, 1 and more reflections: sum of E A W over element sides;
    lamps and background by the irradiance `arriving` (2 ne, 3) that they cause: sum of A H rho W, one length more."""
    area = np.repeat(elements.area, 2)[:, None]
    own = area * np.repeat(elements.emitted, 2, axis=0)
    lamps = area * np.repeat(elements.albedo, 2, axis=0) * arriving
    g, first, rest = parts
    value = np.stack([(own * g).sum(axis=0), (own * first + lamps * g).sum(axis=0), (own * rest + lamps * (first + rest)).sum(axis=0)])
    return Flux(value, np.zeros((3, 3)))


def flux_by_particles(world: World, detect: FaceDetector, particles: int, max_length: int, rng: np.random.Generator) -> Flux:
    """Phi = E / n sum_i [g(x_i0) + sum_k g(x_ik)] (Eq. 15) for faces: particles of all lights; a hit counts what the surface scatters."""
    emission = Emission(world)
    own = emission.mesh.flux_of_triangles()[detect.mask].sum(axis=0) * (1.0 if detect.both else 0.5)
    if emission.is_dark or particles == 0:
        return Flux(np.stack([own, np.zeros(3), np.zeros(3)]), np.zeros((3, 3)))
    table = BsdfTable(world.scene)
    table = None if table.only_diffuse else table
    batches = max(LEAST, -(-particles // SAMPLES_PER_BATCH))
    found = np.zeros((batches, 2, 3))
    for batch in found:
        _shoot(world, detect, emission, table, -(-particles // batches), max_length, rng, batch)
    value, error = found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(batches)
    return Flux(np.concatenate([own[None], value]), np.concatenate([np.zeros((1, 3)), error]))


def _shoot(
    world: World,
    detect: FaceDetector,
    emission: Emission,
    table: BsdfTable | None,
    n: int,
    max_length: int,
    rng: np.random.Generator,
    into: np.ndarray,
) -> None:
    """Follow `n` particles and add what the faces scatter of them to `into` (2, 3): at first hits, and later."""

    def visit(hits: Hits) -> None:
        on = detect.holds(hits.surface.triangle, hits.surface.side)
        into[min(hits.length, 2) - 1] += hits.leaving[on].sum(axis=0, dtype=np.float64)

    walk(world, emission.draw(n, rng), max_length, rng, visit, table)
