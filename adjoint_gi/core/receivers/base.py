"""Where an answer is wanted: texels, vertices or corners, elements, camera pixels, all behind one interface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from ..sampling.maps import disk
from ..scene.arrays import RayKind
from ..scene.world import World

POINTS_PER_CHUNK = 1 << 15


@dataclass(frozen=True, eq=False)
class Points:
    """Sample points of receivers.

    receiver (n,) int64; triangle (n,) int32, -1 where there is no surface (a camera ray that misses);
    u, v (n,) float32; towards (n, 3) float32 direction back to the viewer, or None on the front side of the surface.
    origin (n, 3) float32 where camera rays start. rays: how many rays finding the points took.
    """

    receiver: np.ndarray
    triangle: np.ndarray
    u: np.ndarray
    v: np.ndarray
    towards: np.ndarray | None = None
    origin: np.ndarray | None = None
    distance: np.ndarray | None = None
    rays: int = 0

    def take(self, which: np.ndarray) -> Points:
        """Some of the points."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return Points(**{name: x[which] if isinstance(x, np.ndarray) else x for name, x in parts.items()})


class Receivers:
    """Base. `kind` is texels, vertices, camera or elements; `measure` is irradiance or radiance; `count` how many there are."""

    kind: str
    measure: str = "irradiance"
    count: int = 0
    takes_uniform: bool = False  # whether sample() accepts `uniform`

    def sample(self, receiver: np.ndarray, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Points:
        """One random point on each of the receivers (n,) int64, from `uniform` (2, n) float32 in 0..1 where given, else from `rng`."""
        raise TypeError(f"{type(self).__name__} does not define sample()")

    def sites(self) -> Iterator[Points]:
        """A fixed set of points that covers every receiver evenly, in chunks: for values that need no random numbers."""
        raise TypeError(f"{type(self).__name__} does not define sites()")


class SurfaceReceivers(Receivers):
    """Receivers that are small sets of surface points: the sub-texels of a texel, the faces around a vertex.

    Point k of receiver i is entry `start[i] + k` of `triangle`, `u`, `v`; `start` has count + 1 entries and every receiver
    has at least one point. facing (nt, 3) float32: the normals of the baked sides of all triangles of the scene; None: their fronts.
    """

    takes_uniform = True

    def __init__(
        self, kind: str, start: np.ndarray, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, facing: np.ndarray | None = None
    ) -> None:
        self.kind = kind
        self.facing = facing
        self.start = np.asarray(start, np.int64)
        self.triangle = np.asarray(triangle, np.int32)
        self.u = np.asarray(u, np.float32)
        self.v = np.asarray(v, np.float32)
        self.count = len(self.start) - 1

    def sample(self, receiver: np.ndarray, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Points:
        """One of the receiver's points, all equally likely."""
        x = rng.random(len(receiver), np.float32) if uniform is None else uniform[0]
        first = self.start.take(receiver)
        many = self.start.take(receiver + 1) - first
        pick = first + np.minimum((x * many).astype(np.int64), many - 1)
        triangle = self.triangle.take(pick)
        return Points(receiver, triangle, self.u.take(pick), self.v.take(pick), self.towards(triangle))

    def towards(self, triangle: np.ndarray) -> np.ndarray | None:
        """(n, 3) float32 directions on the baked side of triangles (n,); None where all are fronts."""
        return None if self.facing is None else self.facing[triangle]

    def sites(self) -> Iterator[Points]:
        """All points."""
        owner = np.repeat(np.arange(self.count), np.diff(self.start))
        for a in range(0, len(owner), POINTS_PER_CHUNK):
            b = slice(a, a + POINTS_PER_CHUNK)
            yield Points(owner[b], self.triangle[b], self.u[b], self.v[b], self.towards(self.triangle[b]))


def turned(world: World, facing: np.ndarray | None) -> np.ndarray:
    """(nt,) bool: the triangles of `world` whose backs are baked, by `facing` as in `SurfaceReceivers`."""
    if facing is None:
        return np.zeros(world.triangle_count, bool)
    return np.einsum("ij,ij->i", world.rows[:, 9:12], facing) < 0


class CameraReceivers(Receivers):
    """The pixels of the scene's camera, row 0 at the bottom; receiver index is row * width + column."""

    kind = "camera"
    measure = "radiance"
    takes_uniform = True

    def __init__(self, world: World, grid: int = 4) -> None:
        self.world = world
        self.camera = world.scene.camera
        self.width, self.height = self.camera.width, self.camera.height
        self.count = self.width * self.height
        self.grid = grid

    def rays(self, receiver: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions (n, 3) float32 through offsets dx, dy in 0..1 of the pixels."""
        camera = self.camera
        left, right, bottom, top = camera.frame
        x = left + (right - left) * ((receiver % self.width) + dx) / self.width
        y = bottom + (top - bottom) * ((receiver // self.width) + dy) / self.height
        r, u, f = (np.asarray(a, np.float64) for a in (camera.right, camera.up, camera.forward))
        position = np.asarray(camera.position, np.float64) - self.world.center
        plane = x[:, None] * r + y[:, None] * u
        if camera.kind == "orthographic":
            origin = position + plane + camera.clip_start * f
            direction = np.broadcast_to(f, origin.shape)
        else:
            direction = plane + f
            origin = position + camera.clip_start * direction
            direction = direction / np.linalg.norm(direction, axis=1)[:, None]
        return np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)

    def lens_rays(self, receiver: np.ndarray, dx: np.ndarray, dy: np.ndarray, lens: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `rays`, but through points of the round aperture, uniform in it for `lens` (2, n) uniform in 0..1 (thin lens, Cook 1984)."""
        camera = self.camera
        origin, direction = (a.astype(np.float64) for a in self.rays(receiver, dx, dy))
        r, u, f = (np.asarray(a, np.float64) for a in (camera.right, camera.up, camera.forward))
        # Step 1: the point in the plane of focus on which all rays of this place in the pixel meet.
        depth = camera.focus_distance - camera.clip_start
        focus = origin + direction * (depth / (direction @ f))[:, None]
        # Step 2: the point on the lens, which stands in the plane of the camera's position.
        x, y = disk(lens[0], lens[1])
        start = origin - direction * (camera.clip_start / (direction @ f))[:, None]
        start += camera.aperture_radius * (x[:, None] * r + y[:, None] * u)
        # Step 3: the ray between them, from the near clipping plane on.
        direction = focus - start
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        origin = start + direction * (camera.clip_start / (direction @ f))[:, None]
        return np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)

    def _points(self, receiver: np.ndarray, dx: np.ndarray, dy: np.ndarray, lens: np.ndarray | None = None) -> Points:
        sharp = lens is None or self.camera.aperture_radius <= 0
        origin, direction = self.rays(receiver, dx, dy) if sharp else self.lens_rays(receiver, dx, dy, lens)
        triangle, u, v, t = self.world.intersect(origin, direction, RayKind.CAMERA)
        return Points(receiver, self._clipped(triangle, t, direction), u, v, -direction, origin, t, len(receiver))

    def _clipped(self, triangle: np.ndarray, t: np.ndarray, direction: np.ndarray) -> np.ndarray:
        beyond = t * np.abs(direction @ np.asarray(self.camera.forward, np.float32)) > self.camera.clip_end - self.camera.clip_start
        return np.where(beyond, np.int32(-1), triangle)

    def onward(self, points: Points, rows: np.ndarray) -> Points:
        """`points` with those in `rows` (m,) replaced by what their rays meet behind the surfaces that they have hit."""
        hit = tuple(np.array(a) for a in (points.triangle, points.u, points.v, points.distance))
        self.world.onward(points.origin, -points.towards, RayKind.CAMERA, hit, rows)
        triangle = hit[0]
        triangle[rows] = self._clipped(triangle[rows], hit[3][rows], -points.towards[rows])
        return replace(points, triangle=triangle, u=hit[1], v=hit[2], distance=hit[3])

    def sample(
        self, receiver: np.ndarray, rng: np.random.Generator, uniform: np.ndarray | None = None, lens: np.ndarray | None = None
    ) -> Points:
        """Where a random ray through each pixel meets the scene (box filter); `lens` (2, n) float32 in 0..1 gives depth of field."""
        d = rng.random((2, len(receiver)), np.float32) if uniform is None else uniform
        return self._points(receiver, d[0], d[1], lens)

    def sites(self) -> Iterator[Points]:
        """A regular grid of rays in every pixel."""
        steps = (np.arange(self.grid) + 0.5) / self.grid
        dx, dy = (a.ravel() for a in np.meshgrid(steps, steps))
        block = max(1, POINTS_PER_CHUNK // len(dx))
        for a in range(0, self.count, block):
            pixel = np.arange(a, min(a + block, self.count))
            receiver = np.repeat(pixel, len(dx))
            yield self._points(receiver, np.tile(dx, len(pixel)), np.tile(dy, len(pixel)))


class Places(Receivers):
    """The surface points of other receivers, asked for a value of the surface there instead of their own measure."""

    def __init__(self, receivers: Receivers, measure: str) -> None:
        self._of = receivers
        self.kind, self.measure, self.count = receivers.kind, measure, receivers.count
        self.takes_uniform = receivers.takes_uniform
        self.elements = getattr(receivers, "elements", None)

    def sample(self, receiver: np.ndarray, rng: np.random.Generator, uniform: np.ndarray | None = None) -> Points:
        """As the others."""
        return self._of.sample(receiver, rng) if uniform is None else self._of.sample(receiver, rng, uniform)

    def sites(self) -> Iterator[Points]:
        """As the others."""
        return self._of.sites()
