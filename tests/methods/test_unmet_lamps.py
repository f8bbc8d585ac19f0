"""Light of lamps that walks from receivers cannot find is named, with its share, where it matters."""

from __future__ import annotations

import dataclasses

import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import unmet_lamps
from adjgi.adjoint_gi.core.walks.gathering import batches
from adjgi.tests import solving

WALKS = ("path_tracing", "distribution", "irradiance_cache")


def room(roughness=0.0, color=(0.9,), edge=1.0, light=(1.0, 1.0, 1.0), coats=(), **lamp):
    """A grey room whose floor is a mirror up to `edge`, and a lamp in its middle. `coats`: lobes over the grey of the walls."""
    b = SceneBuilder()
    mirror = Material("Silver", (Lobe("glossy", Color.of(*color), roughness),))
    b.box("Room", (0, 0, 0), (1, 1, 1), Material("Grey", (*diffuse("Grey", 0.5).lobes, *coats)), inward=True)
    b.quad("Mirror", (0, 0, 0.01), (edge, 0, 0), (0, edge, 0), mirror)
    b.light(Light("Lamp", "point", light, (0.5, 0.5, 0.5), **lamp))
    return b.build()


@pytest.mark.parametrize("name", [*WALKS, "whitted", "particle_tracing", "multi_pass"])
def test_methods_that_walk_from_receivers_say_so(name):
    receivers = ElementReceivers(Elements(World(room()), 1.0))
    options = {
        "irradiance_cache": {},
        "whitted": {},
        "particle_tracing": {"particles": 1000},
        "multi_pass": {"samples": 1, "rays": 1000, "particles": 1000},
    }.get(name, {"samples": 1})
    told = [w for w in solving.solve(name, receivers, **options).warnings if "by way of Mirror" in w.reason]
    assert len(told) == (name in (*WALKS, "whitted"))
    assert all(w.object == "Lamp" and "Particle Tracing" in w.remedy for w in told)


def test_the_share_is_that_of_the_mirror():
    """The floor gets a sixth of the light and keeps a tenth of that."""
    (notice,) = unmet_lamps.notices(Emitters(World(room())))
    assert "15 %" in notice.reason


def test_the_share_is_of_each_colour_for_itself():
    """Of a red lamp a mirror of one red, green or blue sends as much as that has red, not as much as it has in the mean."""
    lamp = {"light": (3.0, 0.0, 0.0)}
    (red,) = unmet_lamps.notices(Emitters(World(room(color=(0.9, 0, 0), **lamp))))
    assert "15 %" in red.reason
    assert not unmet_lamps.notices(Emitters(World(room(color=(0, 0.9, 0.9), **lamp))))


def test_the_share_is_what_coats_let_through():
    """Walls with a strong coat scatter no more than the mirror sends: the coat keeps the rest from the grey below it."""
    coat = Lobe("specular", Color.of(1), 0.5, 3.0)
    (notice,) = unmet_lamps.notices(Emitters(World(room(coats=(coat,)))))
    assert 12 < share_of(notice) < 16


@pytest.mark.parametrize(
    "quiet", [{"roughness": 0.5}, {"radius": 0.1}, {"edge": 0.1}, {"color": (0.01,)}], ids=["rough", "sized", "small", "dark"]
)
def test_nothing_is_said_where_nothing_is_missing(quiet):
    assert not unmet_lamps.notices(Emitters(World(room(**quiet))))


def test_whitted_names_lamps_with_a_size_too():
    (notice,) = unmet_lamps.notices(Emitters(World(room(radius=0.1))), sized=True)
    assert "not found by this method" in notice.reason and "size" not in notice.remedy


def paned(light=None, panel=0.0):
    """A grey room below a pane that the light shines through; panel: half the edge of a square that shines, instead of a lamp."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Grey", 0.5))
    b.box("Pane", (-2, -2, 1), (2, 2, 1.05), Material("Glass", (Lobe("glass", Color.of(1), 0.0),)), inward=False)
    if panel:
        b.quad("Panel", (-panel, -panel, 2), (0, 2 * panel, 0), (2 * panel, 0, 0), diffuse("Glow", 0.0, 10.0))
    if light:
        b.light(light)
    return Emitters(World(b.build()))


SUN = Light("Sun", "sun", (1.0, 1.0, 1.0), (0, 0, 3), angle=0.00918)


@pytest.mark.parametrize("name", WALKS)
def test_methods_name_lamps_that_few_of_their_paths_meet(name):
    receivers = ElementReceivers(Elements(paned(SUN).world, 1.0))
    options = {"max_length": 4} | ({"rays": 16} if name == "irradiance_cache" else {"samples": 4})
    (told,) = (w for w in solving.solve(name, receivers, **options).warnings if "by luck alone" in w.reason)
    assert told.object == "Sun" and "by way of Pane" in told.reason and "Particle Tracing" in told.remedy


@pytest.mark.parametrize("lamp", [{"light": SUN}, {"panel": 0.01}, {"light": Light("Lamp", "point", (1, 1, 1), (0, 0, 2), radius=0.01)}])
def test_a_lamp_is_named_until_enough_paths_meet_it(lamp):
    """The chance of a path straight below is the lamp's solid angle by pi: of the sun 2.1e-5."""
    emitters = paned(**lamp)
    (told,) = unmet_lamps.notices(emitters, 64)
    assert "of 64 paths" in told.reason
    expected = (
        64
        * {
            "sun": 2.1e-5,
            "mesh": 0.5e-4 / 3.14,  # half of it shows in the mean over directions
            "point": 2.5e-5,
        }["mesh" if "panel" in lamp else lamp["light"].kind]
    )
    assert float(told.reason.split("from a place ")[1].split()[0]) == pytest.approx(expected, rel=0.4)
    assert not unmet_lamps.notices(emitters, 1 << 17)


def lit_below(base, measure, lamp=SUN):
    """Notices of a lamp above a pane, over a floor of lobes `base`."""
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), Material("Floor", base))
    b.box("Pane", (-2, -2, 1), (2, 2, 1.05), Material("Glass", (Lobe("glass", Color.of(1), 0.0),)), inward=False)
    b.light(lamp)
    return unmet_lamps.notices(Emitters(World(b.build())), 64, measure=measure)


COAT = Lobe("specular", Color.of(1), 0.5, 1.5)
BLACK = {"black": (), "coated": (COAT,), "black diffuse": (Lobe("diffuse", Color.of(0.0)),), "shining": (Lobe("emission", Color.of(1.0)),)}


def share_of(notice):
    """The percents that a notice tells."""
    return float(notice.reason.split("(")[1].split(" %")[0])


@pytest.mark.parametrize("lamp", [SUN, Light("Lamp", "point", (1, 1, 1), (0, 0, 2))], ids=["sun", "point"])
@pytest.mark.parametrize("kind", ["glossy", "metallic", "tinted metallic"])
def test_irradiance_of_metals_lacks_what_that_of_grey_ones_lacks(kind, lamp):
    """They send some of it on to other surfaces, of which it is missing, too; a picture shows no diffuse light of theirs."""
    metal = (Lobe(kind, Color.of(0.5), 0.3),)
    (said,), (same,) = lit_below(metal, "irradiance", lamp), lit_below(diffuse("Grey", 0.5).lobes, "irradiance", lamp)
    assert same.object == said.object and share_of(same) <= share_of(said) < 1.3 * share_of(same) and not lit_below(metal, "radiance", lamp)


@pytest.mark.parametrize("lamp", [SUN, Light("Lamp", "point", (1, 1, 1), (0, 0, 2))], ids=["sun", "point"])
@pytest.mark.parametrize("base", BLACK)
def test_irradiance_of_black_surfaces_lacks_what_that_of_grey_ones_lacks(base, lamp):
    """A picture of them lacks nothing. What a coat keeps is irradiance, too."""
    (said,) = lit_below(BLACK[base], "irradiance", lamp)
    (same,) = lit_below(diffuse("Grey", 0.5).lobes, "irradiance", lamp)
    assert said.reason == same.reason and not lit_below(BLACK[base], "radiance", lamp)


@pytest.mark.parametrize("name", [*WALKS, "whitted"])
def test_methods_ask_for_the_irradiance_of_black_surfaces(name):
    b = SceneBuilder()
    b.quad("Floor", (-1, -1, 0), (2, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    b.box("Pane", (-2, -2, 1), (2, 2, 1.05), Material("Glass", (Lobe("glass", Color.of(1), 0.0),)), inward=False)
    b.light(SUN)
    receivers = ElementReceivers(Elements(World(b.build()), 1.0))
    options = {"irradiance_cache": {"rays": 16}, "whitted": {}}.get(name, {"samples": 4})
    assert [w for w in solving.solve(name, receivers, **options).warnings if "by way of Pane" in w.reason]


def test_all_of_the_light_is_100_percent():
    """Not 1e+02 %: two mirrors send it to the floor, which has it from nowhere else."""
    light = unmet_lamps.ChanceLight(0.998, 0.0, ["Lamp"], ["Mirror"])
    assert "(100 % of what it gives)" in light.notice("is missing", "Go").reason


def test_lamps_that_no_path_meets_are_told_apart_from_those_few_meet():
    told = unmet_lamps.notices(paned(Light("Lamp", "point", (1, 1, 1), (0, 0, 2))), 64)
    assert len(told) == 1 and "without size" in told[0].reason


def test_few_receivers_tell_their_noise_too():
    """All samples of few receivers would fit into one pass, from which no noise can be known."""
    first, *rest = batches(20, 16)
    assert first[2] == 8 and [b[2] for b in rest] == [8]
    assert [b[2] for b in batches(20, 1)] == [1]


def polished(roughness, light=None, panel=False):
    """A grey room whose floor is a metal of some roughness, and a lamp in its middle or a panel below its ceiling."""
    b = SceneBuilder()
    grey = diffuse("Grey", 0.5)
    b.box("Room", (0, 0, 0), (1, 1, 1), [grey] * 4 + [Material("Metal", (Lobe("glossy", Color.of(1), roughness),)), grey], inward=True)
    if light:
        b.light(light)
    if panel:
        b.quad("Panel", (0.45, 0.45, 0.9), (0, 0.1, 0), (0.1, 0, 0), diffuse("Panel", 0.0, 50.0))
    return World(b.build())


POINT = Light("Lamp", "point", (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
NEARLY = {  # light; and of how rough a floor 64 paths hardly find it
    "point": ({"light": POINT}, 0.1),
    "ball": ({"light": dataclasses.replace(POINT, radius=0.02)}, 0.1),
    "area": ({"light": dataclasses.replace(POINT, kind="area", position=(0.5, 0.5, 0.9), size_x=0.1, size_y=0.1)}, 0.1),
    "panel": ({"panel": True}, 0.1),
}


@pytest.mark.parametrize("name", [*WALKS, "multi_pass", "two_pass", "particle_tracing"])
@pytest.mark.parametrize("light", NEARLY)
def test_methods_name_light_by_way_of_nearly_smooth_surfaces(name, light):
    """Of a point lamp over roughness 0.1 single runs of 64 paths were 7 % low and stated 6 % noise: few samples find the light, so they do
    not know how noisy it is, either."""
    options, roughness = NEARLY[light]
    told = []
    for rough in (roughness, 0.5):
        receivers = ElementReceivers(Elements(polished(rough, **options), 0.5))
        few = {
            "irradiance_cache": {"rays": 64},
            "distribution": {"samples": 4},
            "particle_tracing": {"particles": 1000},
            "multi_pass": {"samples": 64, "rays": 1000, "particles": 1000},
            "two_pass": {"rays": 16, "particles": 1000},
        }.get(name, {"samples": 64})
        told.append([w for w in solving.solve(name, receivers, max_length=8, **few).warnings if "by way of Room" in w.reason])
    assert [len(x) for x in told] == [int(name in (*WALKS, "multi_pass")), 0]
    assert all("by luck alone" in w.reason and "Two-Pass" in w.remedy for w in told[0])


def test_the_share_by_way_of_a_nearly_smooth_floor_is_that_of_the_floor():
    """It gets a sixth of the light and keeps none. The chance is that of the lobe: a ray from the ceiling leads into it by a
    solid angle of some 4 pi alpha^2 over four, as the lamp is halfway."""
    (told,) = unmet_lamps.notices(Emitters(polished(0.05, POINT)), 64)
    assert 13 < share_of(told) < 17.5
    chance = 64 * 0.05**4
    assert chance / 4 < float(told.reason.split("from a place ")[1].split()[0]) < 20 * chance


def test_multi_pass_finds_lamps_by_way_of_mirrors_and_not_panels():
    """Its particles are those of lamps."""
    for panel, light in ((False, POINT), (False, dataclasses.replace(POINT, radius=0.01)), (True, None)):
        told = unmet_lamps.notices(Emitters(polished(0.0, light, panel)), 64, by_particles=True)
        assert len(told) == panel


def pooled(lights, edge, power=1.0):
    """A grey room with a mirror in the middle of its floor, of `edge` m, and balls of 1 cm: at places, each of as much power."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Grey", 0.5), inward=True)
    low = 0.5 - edge / 2
    b.quad("Mirror", (low, low, 0.01), (edge, 0, 0), (0, edge, 0), Material("Silver", (Lobe("glossy", Color.of(0.9), 0.0),)))
    for k, (x, y, z, strength) in enumerate(lights):
        b.light(Light(f"Lamp {k}", "point", (strength,) * 3, (x, y, z), radius=0.01))
    return Emitters(World(b.build()))


def test_the_share_is_that_of_each_light():
    """Another lamp, 16 times as strong, of which hardly any light meets the mirror, makes what is missing of the first one no smaller."""
    b = SceneBuilder()
    b.box("Room", (0, 0, 0), (1, 1, 1), diffuse("Grey", 0.5), inward=True)
    b.quad("Mirror", (0.4, 0.4, 0.3), (0.2, 0, 0), (0, 0.2, 0), Material("Silver", (Lobe("glossy", Color.of(0.9), 0.0),)))
    b.light(Light("Lamp", "point", (1.0,) * 3, (0.5, 0.5, 0.4)))
    alone = unmet_lamps.notices(Emitters(World(b.build())))
    b.light(Light("Fill", "point", (16.0,) * 3, (0.95, 0.95, 0.31)))
    (both,) = unmet_lamps.notices(Emitters(World(b.build())))
    assert both.object == alone[0].object == "Lamp"
    assert share_of(both) == pytest.approx(share_of(alone[0]), rel=0.2)


def test_paths_find_light_where_they_meet_any_of_many_lamps():
    """One ball of 1 cm over a mirror is met by few of 4,096 paths; of 100 of them any will do."""
    one = pooled([(0.5, 0.5, 0.9, 1.0)], 0.5)
    grid = [(0.05 + 0.1 * (k % 10), 0.05 + 0.1 * (k // 10), 0.9, 0.01) for k in range(100)]
    assert unmet_lamps.notices(one, 512) and not unmet_lamps.notices(pooled(grid, 0.5), 512)


def test_nothing_is_said_of_light_that_is_longer_than_what_counts():
    scene = room()
    receivers = ElementReceivers(Elements(World(scene), 1.0))
    for longest, said in ((1, 0), (2, 1)):
        told = solving.solve("path_tracing", receivers, samples=1, max_length=longest).warnings
        assert sum("by way of Mirror" in w.reason for w in told) == said
