"""What rays meet: visibility by kind of ray, where rays start, and the normals that surfaces are shaded with."""

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import emitters
from adjgi.adjoint_gi.core.lights.flux import LightFlux
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.sampling.maps import columns
from adjgi.adjoint_gi.core.scene.arrays import Camera, Color, Light, Lobe, Material, RayKind
from adjgi.adjoint_gi.core.scene.faces import Faces
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.solvers import load
from adjgi.tests import scenes

KINDS = [RayKind.CAMERA, RayKind.DIFFUSE, RayKind.GLOSSY, RayKind.TRANSMISSION, RayKind.SHADOW]
load()


def hidden(scene, names, bits):
    """The scene with only rays of `bits` meeting the objects whose names begin with one of `names`."""
    visibility = [bits if o.name.startswith(names) else RayKind.ALL for o in scene.objects]
    return dataclasses.replace(scene, visibility=np.array(visibility, np.uint8))


def random_rays(n=20_000, seed=0):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32), direction.astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_pass_what_they_do_not_meet(kind):
    """With the boxes hidden from one kind, its rays find what they find without boxes, and all others find the boxes."""
    scene = scenes.cornell()
    full, bare = World(scene), World(scenes.cornell(boxes=False))
    part = World(hidden(scene, ("Short", "Tall"), RayKind.ALL & ~kind))
    origin, direction = random_rays()
    other = KINDS[(KINDS.index(kind) + 1) % 5]
    a, b = part.intersect(origin, direction, kind), bare.intersect(origin, direction, kind)
    same = a[0] == b[0]
    assert same.mean() > 0.9999  # but for rays that meet an edge
    assert np.allclose(a[3][same], b[3][same], rtol=1e-4, atol=1e-5)
    assert (a[0] != full.intersect(origin, direction, kind)[0]).mean() > 0.1
    for a, b in zip(part.intersect(origin, direction, other), full.intersect(origin, direction, other), strict=True):
        assert (a == b).all()


def test_rays_of_several_kinds_together():
    scene = hidden(scenes.cornell(), ("Short", "Tall"), RayKind.CAMERA | RayKind.SHADOW)
    world = World(scene)
    origin, direction = random_rays()
    kind = np.tile(np.array(KINDS, np.uint8), len(origin) // 5)
    triangle = world.intersect(origin, direction, kind)[0]
    for one in KINDS:
        which = kind == one
        assert (triangle[which] == world.intersect(origin[which], direction[which], one)[0]).all()


@pytest.mark.parametrize("kind", [RayKind.SHADOW, RayKind.DIFFUSE])
def test_what_a_ray_does_not_meet_does_not_hide(kind):
    scene = scenes.cornell()
    bare = World(scenes.cornell(boxes=False))
    part = World(hidden(scene, ("Short", "Tall"), RayKind.ALL & ~kind))
    origin, direction = random_rays()
    distance = np.full(len(origin), 0.4, np.float32)
    assert (part.occluded(origin, direction, distance, kind) == bare.occluded(origin, direction, distance, kind)).mean() > 0.9999
    other = RayKind.GLOSSY
    assert (part.occluded(origin, direction, distance, other) == World(scene).occluded(origin, direction, distance, other)).all()


def test_all_visible_costs_nothing():
    """No visibility and visibility to all are the same, and neither is looked at for any ray."""
    scene = scenes.cornell()
    origin, direction = random_rays(1000)
    for world in (World(scene), World(hidden(scene, ("Short",), RayKind.ALL))):
        assert world._meets is None
        hit = world.intersect(origin, direction, RayKind.CAMERA)
        assert all(h is a or (h == a).all() for h, a in zip(hit, world._nearest(origin, direction), strict=True))


def test_coincident_invisible_faces_are_all_passed():
    b = SceneBuilder()
    for i in range(4):
        b.quad(f"Veil {i}", (0, 0, 0.5), (1, 0, 0), (0, 1, 0), diffuse("Veil", 0.5))
    b.quad("Floor", (0, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Floor", 0.5))
    b.quad("Top", (0, 0, 1), (1, 0, 0), (0, 1, 0), diffuse("Top", 0.5))
    world = World(hidden(b.build(), ("Veil",), RayKind.SHADOW))
    origin = (np.array([[0.3, 0.6, 0.9]]) - world.center).astype(np.float32)
    triangle, _, _, t = world.intersect(origin, np.array([[0, 0, -2]], np.float32), RayKind.CAMERA)
    assert world.scene.objects[world.scene.object[triangle[0]]].name == "Floor"
    assert t[0] == pytest.approx(0.45, rel=1e-5)
    assert world.intersect(origin, np.array([[0, 0, -2]], np.float32), RayKind.SHADOW)[3][0] == pytest.approx(0.2, rel=1e-5)


def everything(veil=True, floor="diffuse", panels=True):
    """Mirror, gloss, glass and diffuse surfaces before a camera, under a lamp, with a black ceiling below it or without."""
    b = SceneBuilder()
    white = Color.of(0.8, 0.8, 0.8)
    b.quad("Floor", (-2, -2, 0), (4, 0, 0), (0, 4, 0), Material("Floor", (Lobe(floor, Color.of(0.6)),)))
    lobes = (Lobe("glossy", white, 0.0), Lobe("glossy", white, 0.3), Lobe("glass", white, 0.0, 1.4)) if panels else ()
    for i, lobe in enumerate(lobes):
        b.quad(f"Panel {i}", (-1.2 + 0.8 * i, 1, 0.1), (0.7, 0, 0), (0, 0.1, 0.8), Material(f"Panel {i}", (lobe,)))
    if veil:
        b.quad("Veil", (-2, -2, 1.2), (4, 0, 0), (0, 4, 0), diffuse("Veil", 0.0))
    b.light(Light("Lamp", "point", (5.0, 5.0, 5.0), position=(0.3, -0.5, 1.6), radius=0.1))
    b.background = (0.2, 0.3, 0.4)
    b.camera = Camera("perspective", (0, -4, 1), (1, 0, 0), (0, 0, 1), (0, 1, 0), (-0.4, 0.4, -0.3, 0.3), 16, 12)
    return b.build()


def picture(world, name, **options):
    solver = method(name)
    *_, last = solver.solve(world, CameraReceivers(world), solver.Settings(**options), np.random.default_rng(5))
    return last.solution()


METHODS = {
    "path_tracing": {"samples": 4},
    "distribution": {"samples": 4},
    "whitted": {},
    "local_illumination": {},
    "two_pass": {"samples": 2, "max_edge": 0.5},
    "particle_tracing": {"particles": 2000},
}


@pytest.mark.parametrize("floor", ["diffuse", "rough diffuse"])
@pytest.mark.parametrize("panels", [True, False])
@pytest.mark.parametrize("name", METHODS)
def test_methods_cast_every_ray_as_what_it_is(name, panels, floor, monkeypatch):
    """Kinds of nearest-hit rays by method; shadow rays only look for what hides a light. A rough diffuse floor scatters as a plain one."""
    cast, shadow = set(), set()
    intersect, occluded = World.intersect, World.occluded

    def spy(self, origin, direction, kind):
        cast.update(np.unique(kind).tolist())
        return intersect(self, origin, direction, kind)

    def spy_shadow(self, origin, direction, distance, kind):
        shadow.update(np.unique(kind).tolist())
        return occluded(self, origin, direction, distance, kind)

    # What enters the scene is measured by rays of its own, which are not of the method.
    monkeypatch.setattr(emitters, "light_flux", lambda *_: LightFlux(1.0, 1.0, 0.0))
    monkeypatch.setattr(World, "intersect", spy)
    monkeypatch.setattr(World, "occluded", spy_shadow)
    picture(World(everything(veil=False, floor=floor, panels=panels)), name, **METHODS[name])
    expected = set(KINDS) - {RayKind.SHADOW}
    if name in ("particle_tracing", "two_pass") or (name in ("whitted", "path_tracing", "distribution") and panels):
        # Particles of lamps fly as shadow rays do; they name lamps over mirrors that rays do not find, and lamps too close for elements.
        expected = set(KINDS)
    if not panels:
        expected -= {RayKind.GLOSSY, RayKind.TRANSMISSION}
    if name == "whitted":
        expected -= {RayKind.DIFFUSE}
    if name == "local_illumination":
        expected = {RayKind.CAMERA}
    assert cast == expected
    assert shadow == (set() if name == "particle_tracing" else {RayKind.SHADOW})


@pytest.mark.parametrize("name", ["path_tracing", "whitted", "distribution"])
def test_what_no_ray_meets_is_not_there(name):
    """Black and invisible to all, an object changes nothing; visible to shadow rays alone, it darkens the floor."""
    scene, bare = everything(), everything(veil=False)
    without, gone, shading = (
        picture(World(s), name, **METHODS[name]).quantity("radiance").astype(float).mean()
        for s in (bare, hidden(scene, ("Veil",), np.uint8(0)), hidden(scene, ("Veil",), RayKind.SHADOW))
    )
    assert gone == pytest.approx(without, rel=0.02)
    assert shading < 0.97 * without


def test_rays_leave_on_either_side_by_the_offset():
    world = World(scenes.cornell())
    surface = world.surface(np.array([0, 4]), *np.full((2, 2), 0.3, np.float32))
    through = np.array([False, True])
    offset = world.offset[surface.triangle]
    assert np.allclose(world.leave(surface) - surface.position, offset[:, None] * surface.ng, atol=1e-7)
    moved = np.einsum("ij,ij->i", world.leave(surface, through).astype(float) - surface.position, surface.ng)
    assert moved[0] > 0.5 * offset[0] and moved[1] < -0.5 * offset[1]
    lifted = Faces(world).lifted(columns(surface.position), columns(surface.ng), surface.triangle)
    assert (lifted == world.leave(surface).T).all()


def test_rows_and_columns_have_the_same_shading_normals():
    """A ball with smooth normals on a flat floor: the same normals to the last bit, and the face's own where it is flat."""
    vertices, triangles = scenes.icosphere(1)
    b = SceneBuilder()
    b.mesh("Ball", vertices, triangles, diffuse("Ball", 0.5), smooth_normals=vertices)
    b.quad("Floor", (-2, -2, -1.3), (4, 0.1, 0), (0, 4, 0.2), diffuse("Floor", 0.5))
    world = World(b.build())
    rng = np.random.default_rng(2)
    n = 5000
    triangle = rng.integers(0, world.triangle_count, n).astype(np.int32)
    u, v = rng.random((2, n), np.float32) * np.float32(0.5)
    towards = rng.normal(size=(n, 3)).astype(np.float32)
    surface = world.surface(triangle, u, v, towards)
    ng, ns = Faces(world).normals(triangle, u, v, -columns(towards))
    assert (surface.ng == ng.T).all() and (surface.ns == ns.T).all()
    flat = ~world.smooth[triangle]
    assert flat.any() and (surface.ns[flat] == surface.ng[flat]).all() and (surface.ns[~flat] != surface.ng[~flat]).any()
