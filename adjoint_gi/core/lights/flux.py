"""What all emitters of a scene emit, and what of it enters its surfaces: one definition for every method.

emitted   power of the lamps that have a place, and of the emitting faces; of suns and of the background, whose power has no end, that which
          falls on the scene: irradiance across the rays times the area that the scene shows them, from outside
entering  what of this arrives at surfaces straight from the emitters, before any reflection
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ..sampling.additive import STEPS, additive
from ..sampling.maps import PowerTable, cosine_directions, frame_rows, triangle
from ..scene.arrays import RayKind
from ..scene.world import World
from .background import Background
from .base import LightKind
from .emission import Emission
from .lamps import Lamps
from .mesh import MeshLights

PARTICLES = 1 << 13  # by which it is found how much of the light of lamps, and of faces, meets a surface
DIRECTIONS = 256  # of a sun with an angle, and of the background
GRID = 12  # rays a side across the scene for each of them
PARALLEL_GRID = 128  # the same for parallel light
ROUNDING = 1e-5  # share of the power of lamps that sums of float32 weights may miss


@dataclass(frozen=True)
class LightFlux:
    """W, the channels summed. passing: light of lamps that have a place which meets no surface."""

    emitted: float
    entering: float
    passing: float


_MEASURED: WeakKeyDictionary[World, LightFlux] = WeakKeyDictionary()  # a world does not change after it is made


def light_flux(world: World, mesh: MeshLights, lamps: Lamps, background: Background) -> LightFlux:
    """Of a world with its lights. Powers are exact but for products of images; what meets a surface is found by rays, always the same, so
    it is found once for each world."""
    if world not in _MEASURED:
        _MEASURED[world] = _measure(world, mesh, lamps, background)
    return _MEASURED[world]


def _measure(world: World, mesh: MeshLights, lamps: Lamps, background: Background) -> LightFlux:
    sources = lamps.sources() + background.sources()
    far = sum(_falling(world, s.kind, s.index) for s in sources if s.kind.far)
    near = [s for s in sources if not s.kind.far]
    power = sum(float(s.flux.sum()) for s in near)
    met = _lamps_met(world, near)
    met = power if met > power * (1 - ROUNDING) else met
    faces = float(mesh.importance.sum())
    return LightFlux(power + far + faces, met + far + faces * _faces_met(world, mesh), power - met)


def _falling(world: World, kind: LightKind, i: int) -> float:
    """Flux of light from far away that falls on the scene: `kind.flux` is that through the disk of `scene_radius`."""
    radius = kind.scene_radius
    parallel = not kind.sized
    # The first two of the four numbers of a ray make its direction.
    many = 1 if parallel else DIRECTIONS
    square = np.full((many, 4), 0.5)
    square[:, :2] = additive(np.arange(many), STEPS[2], 0.5).T
    directions = kind.shoot(i, square, np.random.default_rng(0), np.zeros(many, np.int64)).direction
    shown = _shown_area(world, directions, PARALLEL_GRID if parallel else GRID)
    return float(kind.flux[i].sum()) * float(shown.mean()) / (np.pi * radius**2)


def _shown_area(world: World, directions: np.ndarray, side: int) -> np.ndarray:
    """(n,) float64 m2 of the scene's silhouette along `directions` (n, 3), by side x side rays across the box around it."""
    corners = np.concatenate([world.rows[:, :3], world.rows[:, :3] + world.rows[:, 3:6], world.rows[:, :3] + world.rows[:, 6:9]])
    if not len(corners):
        return np.zeros(len(directions))
    low, high = corners.min(axis=0), corners.max(axis=0)
    box = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    k = np.arange(side**2)
    shift = np.random.default_rng(0).random((len(directions), 2))
    out = np.zeros(len(directions))
    start = 2 * float(np.linalg.norm(box, axis=1).max())
    for number, (w, x, y) in enumerate(zip(directions, *frame_rows(directions), strict=True)):
        # A grid with a shift of its own, so that what falls between its lines is another thing every time.
        a, b = (k % side + shift[number, 0]) / side, (k // side + shift[number, 1]) / side
        across, up = box @ x, box @ y
        width, height = np.ptp(across), np.ptp(up)
        origin = (across.min() + a * width)[:, None] * x + (up.min() + b * height)[:, None] * y - start * w
        out[number] = width * height * _share_met(world, origin, np.broadcast_to(w, origin.shape))
    return out


def _lamps_met(world: World, sources: list) -> float:
    """Flux of lamps that meets a surface."""
    emission = Emission(world, sources)
    if emission.is_dark:
        return 0.0
    p = emission.draw(PARTICLES, np.random.default_rng(0))
    triangle, _, _, t = world.intersect(p.origin, p.direction, p.kind)
    return float(p.weight[(triangle >= 0) & (t >= p.dark)].sum(dtype=np.float64))


def _faces_met(world: World, mesh: MeshLights) -> float:
    """Share of the flux of emitting faces that meets a surface."""
    if not mesh.any:
        return 0.0
    u = additive(np.arange(1, PARTICLES + 1), STEPS[4], 0.5)
    u = np.concatenate([u, additive(np.arange(1, PARTICLES + 1), STEPS[1], 0.5)])
    which = mesh.triangles[PowerTable(mesh.importance).pick(u[4])]
    surface = world.surface(which, *(x.astype(np.float32) for x in triangle(u[0], u[1])))
    back = u[2] < 0.5
    normal = np.where(back[:, None], -surface.ng, surface.ng)
    return _share_met(world, world.leave(surface, back), cosine_directions(normal, (2 * u[2]) % 1, u[3]))


def _share_met(world: World, origin: np.ndarray, direction: np.ndarray) -> float:
    rays = (np.ascontiguousarray(x, np.float32) for x in (origin, direction))
    return float((world.intersect(*rays, RayKind.SHADOW)[0] >= 0).mean())
