# SPDX-License-Identifier: GPL-3.0-or-later
"""Light through Transparent, alpha and mixes with them: passing straight is no event, in any method, for any lamp, layer and side."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.flux.detectors import CameraDetector
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.receivers.texels import join
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, RayKind, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.passing import MOST_GREY
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks.sight import see
from adjgi.tests import scenes
from adjgi.tests.solving import grid, look, quad_points, solve

LAMPS = {
    "sun": Light("Sun", "sun", (2.0, 2.0, 2.0), angle=0.00918),
    "sharp sun": Light("Sun", "sun", (2.0, 2.0, 2.0)),
    "point": Light("Point", "point", (3.0, 3.0, 3.0), position=(0.1, 0, 2.0)),
    "ball": Light("Ball", "point", (3.0, 3.0, 3.0), position=(0.1, 0, 2.0), radius=0.05),
    "spot": Light("Spot", "spot", (3.0, 3.0, 3.0), position=(0, 0, 2.0), spot_angle=1.5, spot_blend=0.2),
    "area": Light("Area", "area", (9.0, 9.0, 9.0), position=(0, 0, 2.0), size_x=0.3, size_y=0.3),
    "large area": Light("Area", "area", (1.0, 1.0, 1.0), position=(0, 0, 2.0), size_x=2, size_y=2),
}
TINT = (0.5, 0.3, 0.1)
GATHERING = {
    "path_tracing": {"samples": 64},
    "distribution": {"samples": 16},
    "irradiance_cache": {"light_samples": 64},
    "whitted": {},
    "local_illumination": {},
}
ELEMENTS = {
    "matrix_radiosity": {"max_edge": 1.0, "rays": 256, "light_samples": 64},
    "progressive_radiosity": {"max_edge": 1.0, "rays": 300_000, "light_samples": 64},
    "stochastic_jacobi": {"max_edge": 1.0, "rays": 300_000, "light_samples": 64},
    "directional_radiosity": {"max_edge": 1.5, "light_samples": 256},
    "spherical_harmonics": {"max_edge": 1.0, "rays": 300_000, "light_samples": 64},
    "two_pass": {"max_edge": 1.0},
    "multi_pass": {"max_edge": 2.0, "rays": 300_000, "samples": 16},
}
PARTICLES = {"particle_tracing": {"particles": 60_000}}


def sheet(color, *lobes):
    return Material("Sheet", (Lobe("transparent", Color.of(*np.broadcast_to(color, 3).astype(float))), *lobes))


def under(material, lamp, layers=1, floor=0.0):
    """A floor of 2 m, its first two triangles, under `layers` large sheets 1 cm apart."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", floor))
    for i in range(layers):
        b.quad(f"Sheet {i}", (-3, -3, 1 + 0.01 * i), (6, 0, 0), (0, 6, 0), material)
    if lamp:
        b.light(LAMPS[lamp])
    return b


def direct(scene, name, **options):
    receivers = quad_points(*grid(4))
    return solve(name, World(scene), receivers, **options)


@pytest.mark.parametrize("lamp", LAMPS)
@pytest.mark.parametrize("name", [*GATHERING, "two_pass"])
def test_a_tinted_sheet_colours_the_light_of_every_lamp(name, lamp):
    """Exactly by its colour, as direct light, where nothing else scatters; all of it from the same random numbers."""
    options = (GATHERING | ELEMENTS)[name]
    bare, tinted = (direct(under(sheet(TINT), lamp, n).build(), name, **options) for n in (0, 1))
    both = tinted.direct.mean(axis=0), bare.direct.mean(axis=0) * TINT
    assert both[0] == pytest.approx(both[1], rel=0.04 if lamp in ("area", "large area") else 0.003)
    assert bare.direct.min() > 0 and not tinted.indirect.any()


@pytest.mark.parametrize("lamp", ["sun", "point", "area"])
def test_particles_pass_tinted_sheets(lamp):
    bare, tinted = (direct(under(sheet(TINT), lamp, n).build(), "particle_tracing", particles=400_000) for n in (0, 1))
    assert tinted.direct.mean(axis=0) == pytest.approx(bare.direct.mean(axis=0) * TINT, rel=0.03)
    assert not tinted.indirect.any()


@pytest.mark.parametrize("name", [*GATHERING, "particle_tracing"])
def test_ten_sheets_in_a_stack(name):
    options = (GATHERING | {"particle_tracing": {"particles": 100_000}})[name]
    bare, stacked = (direct(under(sheet(0.9), "sun", n).build(), name, **options).direct.mean() for n in (0, 10))
    assert stacked == pytest.approx(0.9**10 * bare, rel=0.03 if name == "particle_tracing" else 1e-3)


@pytest.mark.parametrize("name", ["path_tracing", "local_illumination", "whitted", "directional_radiosity"])
def test_lamps_that_cast_no_shadow_are_not_tinted(name):
    b = under(sheet(TINT), None)
    b.light(dataclasses.replace(LAMPS["point"], shadow=False))
    elements = name == "directional_radiosity"  # with other ones under a sheet
    options = {"direct_light": "elements", "rays": 1, "light_samples": 4, "max_edge": 1.0} if elements else {}
    bare = direct(under(sheet(TINT), "point", 0).build(), name, **options)
    assert direct(b.build(), name, **options).direct.mean(axis=0) == pytest.approx(bare.direct.mean(axis=0), rel=0.05 if elements else 1e-5)


def alpha_image():
    """A texture of 2 x 2 texels whose alpha cuts out two of them."""
    pixels = np.ones((2, 2, 4), np.float32)
    pixels[0, 0, 3] = pixels[1, 1, 3] = 0
    return Texture("Leaf", pixels, interpolation="Closest")


@pytest.mark.parametrize("name", ["path_tracing", "whitted", "local_illumination"])
def test_an_alpha_image_cuts_holes_into_a_shadow(name):
    """Two of four quarters of the card are holes: the sun from above lights the floor below these alone, in full."""
    alpha = Color((Term((1.0, 1.0, 1.0), (Source("image", texture=0, alpha=True),)),))
    card = Material("Card", (Lobe("transparent", alpha.complement()), Lobe("diffuse", alpha)))
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.0))
    b.quad("Card", (-1, -1, 1), (2, 0, 0), (0, 2, 0), card)
    b.light(LAMPS["sharp sun"])
    scene = dataclasses.replace(b.build(), textures=(alpha_image(),))
    found = direct(scene, name, **({"samples": 4} if name == "path_tracing" else {})).direct[:, 0].reshape(4, 4)
    assert found == pytest.approx(np.kron([[2.0, 0.0], [0.0, 2.0]], np.ones((2, 2))), abs=1e-5)


def furnace(share, tint=(1.0, 1.0, 1.0)):
    """A closed room of radiance 1 everywhere, with cards in it that pass `share`, reflect 0.3 of the rest and emit what is lost."""
    b = SceneBuilder()
    b.box("Room", (-2, -2, 0), (2, 2, 3), diffuse("Wall", 0.5, 0.5), inward=True)
    rest = np.array([1 - share * t for t in tint])
    card = sheet(share * np.array(tint), Lobe("diffuse", Color.of(*(0.3 * rest))), Lobe("emission", Color.of(*(0.7 * rest))))
    for i in range(3):
        b.quad(f"Card {i}", (-1.2, -1.2, 0.8 + 0.5 * i), (2.4, 0, 0.1), (0, 2.4, 0.2), card)
    return b.build()


def floor_and_card():
    """Nine points of the floor and nine of the second card, which one solve answers, and where each nine are."""
    u, v = grid(3)
    return join([quad_points(0.2 + 0.6 * u, 0.2 + 0.6 * v, first=first) for first in (8, 14)])


@pytest.mark.parametrize("share", [0.3, 0.8])
@pytest.mark.parametrize("name", [*sorted(GATHERING.keys() - {"whitted", "local_illumination"}), *ELEMENTS, *PARTICLES])
def test_cards_in_a_furnace_are_invisible(name, share):
    """Emission mixed with Transparent, both sides, several layers: radiance 1 everywhere, so pi on the floor and on the cards."""
    options = (GATHERING | ELEMENTS | PARTICLES)[name] | ({"samples": 256} if name in ("path_tracing", "distribution") else {})
    receivers, places = floor_and_card()
    found = solve(name, World(furnace(share)), receivers, **options).quantity("irradiance")
    for place in places:
        assert found[place].mean() == pytest.approx(np.pi, rel=0.03), place


@pytest.mark.parametrize(
    ("name", "noise"),
    [("matrix_radiosity", 0), ("directional_radiosity", 0)]
    + [(n, 0.015) for n in ("progressive_radiosity", "stochastic_jacobi", "spherical_harmonics")],
)
def test_elements_of_any_size_balance_in_a_furnace(name, noise):
    """Elements of 3 m alone have pi on floor and cards: what sides pass, reflect and emit is counted once, however coarse they are.

    With direct light of the receivers themselves it does not belong to such elements: with 2 m they have 3 % too much, with 0.5 m 0.3 %.
    """
    options = ELEMENTS[name] | {"max_edge": 3.0, "light_samples": 1, "direct_light": "elements"}
    receivers, places = floor_and_card()
    found = solve(name, World(furnace(0.3)), receivers, **options).quantity("irradiance")
    for place in places:
        assert found[place].mean() == pytest.approx(np.pi, rel=noise or 1e-3), place


COLOURED = {  # every way in which rays between elements are kept and used
    "matrix": ("matrix_radiosity", {"rays": 2048}),
    "matrix by Jacobi": ("matrix_radiosity", {"rays": 2048, "solver": "jacobi", "closed_forms": False}),
    "progressive": ("progressive_radiosity", {"rays": 300_000}),
    "stochastic": ("stochastic_jacobi", {"rays": 300_000}),
    "bins": ("directional_radiosity", {"rays": 16}),
    "bins by Jacobi": ("directional_radiosity", {"rays": 16, "solver": "jacobi"}),
    "bins by Southwell": ("directional_radiosity", {"rays": 16, "strategy": "shooting"}),
    "harmonics": ("spherical_harmonics", {"rays": 300_000}),
}


@pytest.mark.parametrize("way", COLOURED)
def test_tinted_cards_in_a_furnace_are_invisible(way):
    """As above by channel: each passes another share, and cards emit what is lost of it. No flux is lost on the way."""
    name, options = COLOURED[way]
    receivers, places = floor_and_card()
    found = solve(name, World(furnace(0.8, (1.0, 0.5, 0.2))), receivers, **options, max_edge=1.0, direct_light="elements")
    for place in places:
        assert found.quantity("irradiance")[place].mean(axis=0) == pytest.approx(np.full(3, np.pi), rel=0.03), place
    b = found.balance
    assert b.absorbed + b.escaped + b.unshot == pytest.approx(b.emitted, rel=0.01 if "bins" in way else 1e-4)


@pytest.mark.parametrize("way", COLOURED)
def test_light_between_elements_takes_the_colour_of_sheets(way):
    """Of a panel, and of the sky, over a black floor, all light taken from elements: it has exactly the colour of the sheet.

    The sheet takes more of light that is blue than of grey light; what it takes is counted.
    """
    name, options = COLOURED[way]
    found = []
    for layers in (0, 1):
        b = under(sheet(TINT), None, layers)
        b.quad("Panel", (-1, -1, 1.5), (0, 2, 0), (2, 0, 0), diffuse("Panel", 0.0, (0.5, 1.0, 4.0)))
        for x, y, dx, dy in ((-1, -1, 2, 0), (1, -1, 0, 2), (1, 1, -2, 0), (-1, 1, 0, -2)):
            b.quad("Side", (x, y, 0), (dx, dy, 0), (0, 0, 1), diffuse("Black", 0.0))
        b.background = (0.15, 0.3, 1.2)
        got = solve(name, World(b.build()), quad_points(*grid(2)), **options, max_edge=0.5, direct_light="elements")
        found.append(got.direct.mean(axis=0))
        lost = got.balance
        assert lost.absorbed + lost.escaped + lost.unshot == pytest.approx(lost.emitted, rel=0.01 if "bins" in way else 1e-4)
    level = found[1] / found[0] / TINT
    assert level == pytest.approx(np.full(3, level.mean()), rel=1e-4)
    assert level.mean() == pytest.approx(1, rel=0.05)


def leaf(opacity):
    """A card that scatters and glows by its `opacity`."""
    return Material("Leaf", (Lobe("transparent", opacity.complement()), Lobe("diffuse", opacity), Lobe("emission", opacity)))


NEARLY_CLEAR = {
    "holes": (leaf(Color((Term((1.0, 1.0, 1.0), (Source("image", texture=0, alpha=True),)),))), 1.0),
    "haze": (sheet(0.99, Lobe("diffuse", Color.of(0.01))), 0.99**10),
}


@pytest.mark.parametrize("way", ["matrix", "progressive"])
@pytest.mark.parametrize("kind", NEARLY_CLEAR)
def test_ten_nearly_clear_cards_hold_back_no_more_than_they_do(kind, way):
    """Of a panel over a black floor, all light taken from elements: the holes of a cut-out let all of it pass, a haze what it says."""
    (name, options), (material, share) = COLOURED[way], NEARLY_CLEAR[kind]
    holes = Texture("Leaf", np.concatenate([np.ones((2, 2, 3)), np.zeros((2, 2, 1))], axis=2).astype(np.float32), interpolation="Closest")
    found = []
    for layers in (0, 10):
        b = under(material, None, layers)
        b.quad("Panel", (-1, -1, 1.5), (0, 2, 0), (2, 0, 0), diffuse("Panel", 0.0, 2.0))
        scene = dataclasses.replace(b.build(), textures=(holes,))
        options = options | {"max_edge": 2.0, "rays": {"matrix": 512, "progressive": 60_000}[way], "direct_light": "elements"}
        found.append(solve(name, World(scene), quad_points(*grid(2)), **options).direct.mean())
    assert found[1] / found[0] == pytest.approx(share, rel=0.04)  # with a chance of 0.98 a card: 0.82


STOPPED = {  # the chance to pass, of rays between elements
    "a coloured sheet": (sheet(TINT), 0.3),
    "a clear sheet": (sheet(0.99), 0.99),
    "the holes of a leaf": (NEARLY_CLEAR["holes"][0], 1.0),
    "a haze": (NEARLY_CLEAR["haze"][0], MOST_GREY),
    "a hologram": (sheet(1.0, Lobe("emission", Color.of(2.0))), MOST_GREY),
    "more than there is": (sheet(1.0, Lobe("diffuse", Color.of(0.5))), MOST_GREY),
}


@pytest.mark.parametrize("kind", STOPPED)
def test_some_rays_stop_at_all_that_sends_light(kind):
    """Else nothing would be seen of it; those that pass carry what they would have had."""
    material, chance = STOPPED[kind]
    holes = Texture("Leaf", np.concatenate([np.ones((2, 2, 3)), np.zeros((2, 2, 1))], axis=2).astype(np.float32), interpolation="Closest")
    passing = World(dataclasses.replace(under(material, None).build(), textures=(holes,))).passing
    at = np.array([2, 3]), np.full(2, 0.25, np.float32), np.full(2, 0.5, np.float32)
    assert passing.grey(*at) == pytest.approx(np.full(2, chance), rel=1e-6)
    assert passing.grey(*at)[:, None] * passing.color(*at) == pytest.approx(passing.through(*at), rel=1e-6)


@pytest.mark.parametrize("scheme", ["jacobi", "southwell"])
@pytest.mark.parametrize("factors", ["matrix", "rays"])
@pytest.mark.parametrize("receivers", ["objects", "camera"])
def test_potential_on_elements_takes_the_colour_of_sheets(receivers, factors, scheme):
    """Light of a panel reaches a floor, and a camera that looks at it, through one sheet, or two: the way there and the way back."""
    found = []
    for layers in (0, 1):
        b = under(sheet(TINT), None, layers, floor=0.5)
        b.quad("Panel", (-1, -1, 1.5), (0, 2, 0), (2, 0, 0), diffuse("Panel", 0.0, 2.0))
        b.camera = look((0, 0, 1.4), (0, 0, -1), size=4)
        panel = quad_points(*grid(2), first=2 + 2 * layers)
        options = {"receivers": receivers, "factors": factors, "scheme": scheme, "max_edge": 1.0}
        options |= {"objects": "Floor"} if receivers == "objects" else {}
        found.append(solve("potential", World(b.build()), panel, **options).direct.mean(axis=0))
    passes = 1 if receivers == "objects" else 2
    assert found[0].min() > 0
    assert found[1] == pytest.approx(found[0] * np.array(TINT) ** passes, rel=0.06)


@pytest.mark.parametrize("options", [{}, {"joined": False}, {"light_importance": False}, {"lobe_importance": False}, {"roulette": False}])
def test_no_light_is_counted_twice_however_paths_find_it(options):
    """A large lamp and an emitting panel behind leaves that also reflect: every mix of techniques has the same mean."""
    b = under(sheet(0.4, Lobe("diffuse", Color.of(0.3))), "large area", 3, floor=0.5)
    b.quad("Panel", (-0.5, -0.5, 1.6), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0.0, 2.0))
    world, receivers = World(b.build()), quad_points(*grid(4))
    reference = solve("path_tracing", world, receivers, samples=512).quantity("irradiance").mean()
    runs = [solve("path_tracing", world, receivers, seed=s, samples=64, **options).quantity("irradiance").mean() for s in range(6)]
    error = np.std(runs, ddof=1) / np.sqrt(len(runs))
    assert error < 0.08 * reference
    assert abs(np.mean(runs) - reference) < 4 * error + 0.02 * reference


@pytest.mark.parametrize("name", ["path_tracing", "distribution", "whitted", "local_illumination", "irradiance_cache", "matrix_radiosity"])
def test_cameras_see_through_sheets(name):
    """A panel of radiance 2 behind three tinted sheets, one of which glows: 2 t^3 + 0.4 t^2, whatever method looks."""
    b = SceneBuilder()
    t = np.array((0.9, 0.6, 0.3))
    b.quad("Panel", (-9, 3, -9), (18, 0, 0), (0, 0, 18), diffuse("Panel", 0.0, 2.0))
    for i in range(3):
        lobes = (Lobe("emission", Color.of(0.4)),) if i == 2 else ()
        b.quad(f"Sheet {i}", (-9, 1 + 0.1 * i, -9), (18, 0, 0), (0, 0, 18), sheet(t, *lobes))
    b.camera = look((0, 0, 0), (0, 1, 0), size=4)
    world = World(b.build())
    options = {"max_edge": 6.0} if name == "matrix_radiosity" else {}
    found = solve(name, world, CameraReceivers(world), **options)
    assert found.emitted == pytest.approx(np.tile(2 * t**3 + 0.4 * t**2, (16, 1)), rel=1e-4)
    assert np.abs(found.quantity("radiance") - found.emitted).max() < 1e-5


def test_a_lamp_before_a_sheet_is_seen_once():
    """Of two lamps the one behind the sheet has its colour, and the one before it does not shine again behind it."""
    b = SceneBuilder()
    b.quad("Sheet", (-9, 2, -9), (18, 0, 0), (0, 0, 18), sheet(TINT))
    for y, level in ((1.0, 3.0), (3.0, 5.0)):
        axes = {"axis_x": (1, 0, 0), "axis_y": (0, 0, -1), "axis_z": (0, 1, 0)}
        b.light(Light("Lamp", "area", (level,) * 3, (0, y, 0), size_x=9, size_y=9, **axes))
    b.camera = look((0, 0, 0), (0, 1, 0), size=2)
    world = World(b.build())
    receivers = CameraReceivers(world, 1)
    (points,) = receivers.sites()
    bright = Emitters(world).along(points.origin, -points.towards, np.full(4, np.inf, np.float32))
    assert bright == pytest.approx(np.full((4, 3), bright.max()), rel=1e-4) and bright.max() > 0
    for split in (False, True):
        found = see(Emitters(world), receivers, points, np.random.default_rng(1), split=split).emitted
        assert found == pytest.approx(bright * (3 + 5 * np.array(TINT)) / 8, rel=1e-4)


@pytest.mark.parametrize(("name", "options"), [("path_tracing", {"samples": 64}), ("irradiance_cache", {"light_samples": 64})])
def test_a_large_lamp_before_a_sheet_lights_once(name, options):
    """Rays that meet it on their way to the sheet do not meet it again behind."""
    found = []
    for layers in (0, 1):
        b = under(sheet(1.0), None, layers)
        b.light(dataclasses.replace(LAMPS["large area"], position=(0.0, 0.0, 0.5)))
        found.append(direct(b.build(), name, **options).direct.mean())
    assert found[1] == pytest.approx(found[0], rel=0.02 if name == "path_tracing" else 0.1)


def test_rays_behind_sheets_are_counted():
    """Of 64 points each casts a light ray, a ray by the cosine, and as many of those again as pass a sheet: all but hardly any."""
    cast = []
    for layers in (0, 1, 3):
        b = under(sheet(1.0), None, layers)
        b.quad("Panel", (-0.5, -0.5, 1.6), (0, 1, 0), (1, 0, 0), diffuse("Panel", 0.0, 2.0))
        world = World(b.build())
        surface = world.surface(np.zeros(64, np.int32), *np.random.default_rng(1).random((2, 64), np.float32) / 2)
        cast.append(direct_irradiance(world, Emitters(world), surface, 16, np.random.default_rng(2))[1])
    assert 0.8 * 1024 < cast[1] - cast[0] <= 1024 and cast[2] - cast[0] == pytest.approx(3 * (cast[1] - cast[0]), rel=0.02)


@pytest.mark.parametrize(("end", "seen"), [(1.9, False), (2.1, True)])
def test_the_far_plane_is_as_far_behind_a_sheet(end, seen):
    """What camera rays meet behind a sheet at 1 m lies beyond the far plane or not by its distance from the camera; its potential, too."""
    b = SceneBuilder()
    b.quad("Wall", (-9, 2, -9), (18, 0, 0), (0, 0, 18), diffuse("Wall", 0.5))
    b.quad("Sheet", (-9, 1, -9), (18, 0, 0), (0, 0, 18), sheet(0.9))
    b.camera = dataclasses.replace(look((0, 0, 0), (0, 1, 0), size=2), clip_end=end)
    world = World(b.build())
    receivers = CameraReceivers(world, 1)
    (points,) = receivers.sites()
    _, behind = see(Emitters(world), receivers, points, np.random.default_rng(1), split=True).layers
    assert (behind.points.triangle >= 0).tolist() == [seen] * 4
    elements = Elements(world, 20.0)
    g = CameraDetector(world).on_elements(elements).any(axis=1)
    assert g[: 2 * int((elements.patch_triangle[elements.patch] < 2).sum())].any() == seen


def test_rays_keep_their_kind_behind_a_sheet():
    """An object that only diffuse rays meet is seen behind a sheet by those, and one that only rays through surfaces meet is not."""
    b = under(sheet(1.0), None)
    b.quad("Lid", (-9, -9, 1.5), (0, 18, 0), (18, 0, 0), diffuse("Lid", 0.0, 1.0))
    scene = b.build()
    for bits, expected in ((RayKind.DIFFUSE, True), (RayKind.TRANSMISSION, False)):
        visibility = np.array([bits if o.name == "Lid" else RayKind.ALL for o in scene.objects], np.uint8)
        found = direct(dataclasses.replace(scene, visibility=visibility), "path_tracing", samples=64, light_importance=False)
        assert (found.direct.mean() > 2.5) == expected


def test_passing_costs_no_segment():
    """One bounce behind ten sheets is a path of two segments."""
    b = under(sheet(0.95), "point", 10, floor=0.5)
    b.box("Room", (-3.5, -3.5, -0.5), (3.5, 3.5, 2.5), diffuse("Wall", 0.5), inward=True)
    world, receivers = World(b.build()), quad_points(*grid(4))
    short = solve("path_tracing", world, receivers, samples=128, max_length=2)
    assert short.direct.mean() > 0 and short.indirect.mean() > 0.05 * short.direct.mean()


def test_scenes_without_such_surfaces_ask_nothing():
    assert World(scenes.cornell()).passing is None


@pytest.mark.parametrize("name", ["matrix_radiosity", "progressive_radiosity", "stochastic_jacobi", "spherical_harmonics"])
@pytest.mark.parametrize("kind", ["box", "free"])
def test_sheets_that_let_all_light_through_change_nothing(name, kind):
    """No ray stays on them, so their elements have no area that counts; they are lit, and nothing of that is not a number."""
    found = []
    for clear in (False, True):
        b = SceneBuilder()
        if kind == "box":
            b.box("Room", (-1, -1, 0), (2, 2, 3), [diffuse("Wall", 0.5)] * 5 + [diffuse("Ceiling", 0.3, 0.3)], inward=True)
        else:
            b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.5))
            b.quad("Wall", (1, -1, 0), (0, 0, 2), (0, 2, 0), diffuse("Wall", 0.5))
        if clear:
            b.quad("Sheet", (-0.6, -0.6, 1), (1.2, 0, 0), (0, 1.2, 0), sheet(1.0))
        b.light(LAMPS["spot"])
        options = {"max_edge": 1.0, "rays": 64 if name == "matrix_radiosity" else 3000, "light_samples": 1}
        receivers = ElementReceivers(Elements(World(b.build()), 1.0))
        found.append(solve(name, receivers, **options).quantity("irradiance"))
    assert np.isfinite(found[1]).all() and found[1][len(found[0]) :].any()
    assert found[1][: len(found[0])].mean() == pytest.approx(found[0].mean(), rel=0.02)


def test_the_albedo_of_a_pixel_is_that_of_what_is_seen_by_its_share():
    b = under(sheet(0.25), None, floor=0.8)
    b.camera = look((0, 0, 3), (0, 0, -1), half=0.2, size=4)
    world = World(b.build())
    assert solve("local_illumination", world, CameraReceivers(world, grid=2)).albedo == pytest.approx(np.full((16, 3), 0.25 * 0.8))


@pytest.mark.parametrize("color", [1.0, 0.5])
def test_particles_pass_a_sheet_within_the_dark_of_a_soft_lamp(color):
    """A sheet 0.1 m below a soft lamp of radius 0.3, whose disk reaches through it, takes from particles what it takes from paths."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Floor", 0.0))
    b.quad("Sheet", (-1.5, -1.5, 0.9), (3, 0, 0), (0, 3, 0), Material("Sheet", (Lobe("transparent", Color.of(color)),)))
    b.light(Light("Lamp", "point", (1.0, 1.0, 1.0), (0.0, 0.0, 1.0), radius=0.3, soft_falloff=True))
    world, receivers = World(b.build()), quad_points(*grid(4))
    particles = solve("particle_tracing", world, receivers, seed=1, particles=200_000).direct.mean()
    assert particles == pytest.approx(solve("path_tracing", world, receivers, samples=256).direct.mean(), rel=0.02)


@pytest.mark.parametrize("name", ["path_tracing", "distribution", "irradiance_cache"])
def test_light_of_a_ceiling_takes_the_colour_of_a_sheet(name):
    """Lit by a lamp above the sheet."""
    found = []
    for layers in (0, 1):
        b = under(sheet(TINT), None, layers)
        b.quad("Ceiling", (-1, -1, 1.5), (0, 2, 0), (2, 0, 0), diffuse("Ceiling", 0.8))
        b.light(Light("Lamp", "point", (3.0, 3.0, 3.0), position=(0, 0, 1.25)))
        found.append(direct(b.build(), name, **GATHERING[name], max_length=2).indirect.mean(axis=0))
    assert found[0].min() > 0 and found[1] == pytest.approx(found[0] * TINT, rel=0.05)


@pytest.mark.parametrize("name", [*GATHERING, *(name for name in ELEMENTS if name not in ("directional_radiosity", "spherical_harmonics"))])
@pytest.mark.parametrize("far", [0.0, 500.0])
def test_a_panel_behind_tilted_sheets_does_not_hide_itself(name, far):
    """Rays go on behind each sheet where they met it, not beside: at last they end before the panel that they are cast to."""

    def lit(layers):
        b = SceneBuilder()
        a, c = np.array([0.8, 0.1, -0.6]), np.array([0.2, 0.9, 0.4])
        at, up = np.array([far, 0.7 * far, 0]), np.cross(a, c)
        b.quad("Floor", at - a - c, 2 * a, 2 * c, diffuse("Floor", 0.0))
        for i in range(layers):
            b.quad(f"Sheet {i}", at - 3 * (a + c) + (1 + 0.03 * i) * up, 6 * a, 6 * c, sheet(0.9))
        b.quad("Panel", at - 0.15 * (a + c) + 2 * up, 0.3 * c, 0.3 * a, diffuse("Panel", 0.0, 9.0))
        return direct(b.build(), name, **(GATHERING | ELEMENTS)[name]).direct.mean()

    assert lit(4) / lit(0) == pytest.approx(0.9**4, rel=0.01)
