"""Scenes with known answers (verification page, section 2.3), built without Blender. Names T1, T3 and so on are that page's."""

from __future__ import annotations

import numpy as np
from adjgi.adjoint_gi.core.bsdf.microfacet import fresnel
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, SceneArrays
from adjgi.adjoint_gi.core.scene.world import World


def cube(rho=0.5, emission=0.0, materials=None) -> SceneArrays:
    """Unit cube seen from inside; T1 with uniform emission. `emission` is radiosity; face order -x +x -y +y -z +z."""
    b = SceneBuilder()
    b.box("Cube", (0, 0, 0), (1, 1, 1), materials or diffuse("Wall", rho, emission / np.pi), inward=True)
    return b.build()


def lit_cube(rho) -> SceneArrays:
    """T9: unit cube whose ceiling has emitted radiosity 1; `rho` is one number or six (-x +x -y +y -z +z)."""
    rho = np.broadcast_to(rho, 6)
    mats = [diffuse(f"Face{i}", float(r), 1 / np.pi if i == 5 else 0.0) for i, r in enumerate(rho)]
    return cube(materials=mats)


def room(rho_ceiling=0.7, rho_floor=0.2, rho_wall=0.5, emission=(0, 0, 0, 0, 0, 1.0)) -> SceneArrays:
    """4 x 4 x 3 room with faces of unequal area; `emission` is the radiosity of -x +x -y +y -z +z."""
    rho = (rho_wall,) * 4 + (rho_floor, rho_ceiling)
    mats = [diffuse(f"Face{i}", r, e / np.pi) for i, (r, e) in enumerate(zip(rho, emission, strict=True))]
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (4, 4, 3), mats, inward=True)
    return b.build()


def icosphere(level: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of 20 * 4**level triangles, wound outward: vertices (n, 3), triangles (m, 3)."""
    g = (1 + 5**0.5) / 2
    v = [
        (-1, g, 0),
        (1, g, 0),
        (-1, -g, 0),
        (1, -g, 0),
        (0, -1, g),
        (0, 1, g),
        (0, -1, -g),
        (0, 1, -g),
        (g, 0, -1),
        (g, 0, 1),
        (-g, 0, -1),
        (-g, 0, 1),
    ]
    t = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8)]
    t += [(3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    vertices = np.array(v, float)
    triangles = np.array(t)
    for _ in range(level):
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, back = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + back.reshape(3, -1).T
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = triangles.T
        ab, bc, ca = middle.T
        triangles = np.concatenate([np.stack(x, 1) for x in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, triangles


def two_zone_sphere(level=4, emission=(1.0, 0.0), rho=(0.2, 0.8)) -> SceneArrays:
    """T3: sphere seen from inside, z > 0 is zone 0 and z < 0 zone 1. H = mean(E) / (1 - mean(rho)) everywhere."""
    vertices, triangles = icosphere(level)
    triangles = triangles[:, ::-1]
    which = (vertices[triangles].mean(axis=1)[:, 2] < 0).astype(int)
    mats = [diffuse(f"Zone{i}", rho[i], emission[i] / np.pi) for i in (0, 1)]
    b = SceneBuilder()
    b.mesh("Sphere", vertices, triangles, mats, which=which)
    return b.build()


def sphere_wall(level: int, keep_below: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere cut at z = keep_below, exactly: a grid in (z, phi) so that the rim is a true circle, normals inward."""
    rows, cols = 4 * 2**level, 8 * 2**level
    z = np.linspace(-1, keep_below, rows + 1)
    phi = 2 * np.pi * np.arange(cols) / cols
    r = np.sqrt(np.maximum(0, 1 - z**2))
    vertices = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.repeat(z[:, None], cols, 1)], -1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"))
    a, b = i * cols + j, i * cols + (j + 1) % cols
    c, d = a + cols, b + cols
    triangles = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])
    p = vertices[triangles]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return vertices, triangles[area > 1e-12]


def snowman(level=4, c=0.1, rho=(0.5, 0.5), emission=(1.0, 0.0)) -> SceneArrays:
    """T6: two unit spheres, each missing a cap of area share c, joined at the common circle. Room A is below."""
    z0 = 1 - 2 * c
    vertices, triangles = sphere_wall(level, z0)
    mats = [diffuse(f"Room{i}", rho[i], emission[i] / np.pi) for i in (0, 1)]
    b = SceneBuilder()
    b.mesh("A", vertices, triangles, mats[0])
    upper = vertices * (1, 1, -1) + (0, 0, 2 * z0)
    b.mesh("B", upper, triangles[:, ::-1], mats[1])
    return b.build()


def snowman_answer(c, rho, emission) -> tuple[float, float]:
    """Radiosities of the two rooms of T6."""
    (pa, pb), (ea, eb) = rho, emission
    d = (1 - pa * (1 - c)) * (1 - pb * (1 - c)) - pa * pb * c * c
    return (ea * (1 - pb * (1 - c)) + pa * c * eb) / d, (eb * (1 - pa * (1 - c)) + pb * c * ea) / d


def lamp_over_mirror(kind="point", color=(1.0, 2.0, 3.0), **options) -> SceneArrays:
    """A perfect mirror at z = 0 below a lamp at height 1, and a small ceiling at z = 2: the lamp in the mirror is three times as far."""
    b = SceneBuilder()
    mirror = Material("Mirror", (Lobe("glossy", Color.of(1, 1, 1), 0.0),))
    b.quad("Mirror", (-20, -20, 0), (40, 0, 0), (0, 40, 0), mirror)
    b.quad("Ceiling", (-0.1, -0.1, 2), (0, 0.2, 0), (0.2, 0, 0), diffuse("Ceiling", 0.5))
    b.light(Light("Lamp", kind, color, position=(0, 0, 1), **options))
    return b.build()


def cornell(width=64, height=64, boxes=True, light=15.0) -> SceneArrays:
    """A unit Cornell box open towards -y, mesh light below the ceiling, two boxes, camera in front."""
    return cornell_builder(width, height, boxes, light).build()


def cornell_builder(width=64, height=64, boxes=True, light=15.0) -> SceneBuilder:
    """The same before it is built, for adding to."""
    white, red, green = diffuse("White", 0.73), diffuse("Red", (0.63, 0.065, 0.05)), diffuse("Green", (0.14, 0.45, 0.091))
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), white)
    b.quad("Ceiling", (0, 0, 1), (0, 1, 0), (1, 0, 0), white)
    b.quad("Back", (0, 1, 0), (1, 0, 0), (0, 0, 1), white)
    b.quad("Left", (0, 0, 0), (0, 1, 0), (0, 0, 1), red)
    b.quad("Right", (1, 0, 0), (0, 0, 1), (0, 1, 0), green)
    b.quad("Lamp", (0.35, 0.35, 0.99), (0, 0.3, 0), (0.3, 0, 0), diffuse("Lamp", 0.0, light))
    if boxes:
        _turned_box(b, "Short", (0.67, 0.32), 0.3, 0.3, 0.3, -0.29, white)
        _turned_box(b, "Tall", (0.34, 0.64), 0.3, 0.3, 0.6, 0.3, white)
    b.camera = Camera("perspective", (0.5, -1.35, 0.5), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.38, 0.38, -0.38, 0.38), width, height)
    return b


def _turned_box(b, name, centre, sx, sy, height, angle, material) -> None:
    x = np.array([np.cos(angle), np.sin(angle), 0]) * sx
    y = np.array([-np.sin(angle), np.cos(angle), 0]) * sy
    z = np.array([0, 0, height])
    low = np.array([*centre, 0]) - x / 2 - y / 2
    for label, corner, e, f in (("-x", low, z, y), ("+x", low + x, y, z), ("-y", low, x, z), ("+y", low + y, z, x), ("top", low + z, x, y)):
        b.quad(f"{name} {label}", corner, e, f, material)


BELOW_AREA = np.array([16.0, 6.0, 6.0, 6.0, 6.0])  # of the five quads of `box_below_panes`


def box_below_panes(pane: Material, thick: float = 0.1, panes: int = 1) -> SceneBuilder:
    """A black box, open at the top (quads 0 to 4: floor 4 x 4, walls 1.5 high), under closed panes that cover it, 0.4 apart; no light."""
    b, black = SceneBuilder(), diffuse("Black", 0.0)
    b.quad("Floor", (0, 0, 0), (4, 0, 0), (0, 4, 0), black)
    x, y, z = (4, 0, 0), (0, 4, 0), (0, 0, 1.5)
    for i, quad in enumerate((((0, 0, 0), y, z), (x, z, y), ((0, 0, 0), z, x), (y, x, z))):
        b.quad(f"Wall {i}", *quad, black)
    for k in range(panes):
        low = 1.5 + 0.4 * k
        b.box(f"Pane {k}", (0.001, 0.001, low), (3.999, 3.999, low + thick), pane, inward=False)
    return b


def below_a_pane(light: str, ior: float = 1.45) -> tuple[World, float]:
    """`box_below_panes` with one pane of clear glass under the sky or an area lamp; the flux in W that passes the pane: (1 - R) / (1 + R)
    of what falls on it, at every angle."""
    b = box_below_panes(Material("Pane", (Lobe("glass", Color.of(1), 0.0, ior),)))
    if light == "area":
        b.light(Light("Area", "area", (5.0, 5.0, 5.0), position=(2, 2, 2.9), size_x=1.0, size_y=1.0))
        # Pairs of points of lamp and pane: 1.3 apart in height.
        px, py, lx, ly = np.random.default_rng(1).random((4, 1_000_000))
        square = (1.5 + lx - 4 * px) ** 2 + (1.5 + ly - 4 * py) ** 2 + 1.3**2
        cosine, flux = 1.3 / np.sqrt(square), 5 * 16 * 1.3**2 / square**2
    else:
        b.background = (1.0, 1.0, 1.0)
        cosine = (np.arange(100_000) + 0.5) / 100_000
        flux = 16 * np.pi * 2 * cosine
    r = fresnel(cosine.astype(np.float32), np.full(len(cosine), ior, np.float32))
    return World(b.build()), float((flux * (1 - r) / (1 + r)).mean())
