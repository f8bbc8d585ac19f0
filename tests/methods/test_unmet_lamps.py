"""Light of lamps that walks from receivers cannot find is named, with its share, where it matters."""

from __future__ import annotations

import pytest
from adjgi.adjoint_gi.core.elements.elements import ElementReceivers, Elements
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import unmet_lamps
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
    share = float(notice.reason.split("(")[1].split(" %")[0])
    assert 12 < share < 16


@pytest.mark.parametrize(
    "quiet", [{"roughness": 0.5}, {"radius": 0.1}, {"edge": 0.1}, {"color": (0.01,)}], ids=["rough", "sized", "small", "dark"]
)
def test_nothing_is_said_where_nothing_is_missing(quiet):
    assert not unmet_lamps.notices(Emitters(World(room(**quiet))))


def test_whitted_names_lamps_with_a_size_too():
    (notice,) = unmet_lamps.notices(Emitters(World(room(radius=0.1))), sized=True)
    assert "not found by this method" in notice.reason and "size" not in notice.remedy
