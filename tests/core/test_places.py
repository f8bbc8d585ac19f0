"""Emitters picked by place: probabilities are those of the draw, nothing is out of reach, and estimates keep their mean with less noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import emitters as emitters_module
from adjgi.adjoint_gi.core.lights import places
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import Emitters
from adjgi.adjoint_gi.core.scene.arrays import Light
from adjgi.adjoint_gi.core.scene.world import World

# Standard deviations that sound code exceeds once in a thousand runs of the some 30 comparisons here (Sidak).
Z = 4.2
N = 60_000


def street(lamps=("point", "area", "spot", "sun"), panels=0, n=6):
    """A long floor below lamps of all kinds in turn, and small emitting panels; every second lamp has a size."""
    b = SceneBuilder()
    b.quad("Floor", (0, 0, 0), (4 * n, 0, 0), (0, 2, 0), diffuse("Grey", 0.5))
    for i in range(n * len(lamps)):
        kind = lamps[i % len(lamps)]
        color = (0.05, 0.02, 0.01) if kind == "sun" else (1.0 + i % 3, 1.0, 0.5)
        size = {"point": {"radius": 0.1 * (i % 2)}, "area": {"size_x": 0.5, "size_y": 0.3}, "spot": {"spot_angle": 1.5, "spot_blend": 0.3}}
        b.light(Light(f"L{i}", kind, color, (4.0 * n * (i + 0.5) / (n * len(lamps)), 1.0, 1.0), **size.get(kind, {})))
    for i in range(panels):
        b.quad(f"P{i}", (4 * n * i / panels, 0.2, 0.5), (0.1, 0, 0.05), (0, 0.1, 0), diffuse(f"Panel{i % 3}", 0.0, 5.0 + i % 3))
    return b


SCENES = {
    "lamps": {},
    "panels": {"lamps": ("point",), "panels": 40},
    "clusters": {"lamps": ("area",), "panels": 300},
    "suns too": {"lamps": ("sun", "point")},
}


def floor_points(world, n, rng):
    triangle = rng.integers(0, 2, n).astype(np.int32)
    u, v = rng.random((2, n), np.float32)
    fold = u + v > 1
    return world.surface(triangle, np.where(fold, 1 - u, u), np.where(fold, 1 - v, v))


@pytest.mark.parametrize("name", SCENES)
def test_picks_have_the_probabilities_that_are_said(name):
    """Chi-square over all emitters at a few points, and the sum of all probabilities."""
    world = World(street(**SCENES[name]).build())
    emitters = Emitters(world)
    table, rng = emitters._all, np.random.default_rng(1)
    assert table.places is not None and (name != "clusters" or table.places.clusters < table.count)
    for p in (world.rows[0, :3], world.rows[0, :3] + 0.5 * world.rows[0, 3:6], -40 * np.ones(3, np.float32)):
        at = np.repeat(p[:, None], N, axis=1)
        index, chance = table.places.draw(at, rng.random(N))
        expected = table.chance(np.repeat(p[:, None], table.count, axis=1), np.arange(table.count)).astype(float)
        assert expected.sum() == pytest.approx(1, abs=1e-5) and (expected[table.power > 0] > 0).all()
        np.testing.assert_array_equal(chance, table.chance(at, index))
        counts = np.bincount(index, minlength=table.count)
        used = N * expected >= 5
        chi = ((counts - N * expected) ** 2)[used] / (N * expected[used])
        freedom = max(int(used.sum()) - 1, 1)
        assert chi.sum() < freedom + Z * math.sqrt(2 * freedom) + Z**2
        assert abs(counts[~used].sum() - N * expected[~used].sum()) < Z * math.sqrt(N * expected[~used].sum() + 1) + 1


@pytest.mark.parametrize("name", SCENES)
def test_irradiance_keeps_its_mean_and_has_less_noise(name, monkeypatch):
    world = World(street(**SCENES[name]).build())
    found = {}
    for fewest in (places.FEWEST, 1 << 30):
        monkeypatch.setattr(emitters_module, "FEWEST", fewest)
        emitters, rng = Emitters(world), np.random.default_rng(2)
        assert (emitters._all.places is None) == (fewest > places.FEWEST)
        value = np.concatenate([direct_irradiance(world, emitters, floor_points(world, N, rng), 1, rng)[0] for _ in range(2)])
        found[fewest] = value.mean(axis=0, dtype=float), value.std(axis=0, dtype=float) / math.sqrt(len(value))
    (mean, error), (plain, noise) = found.values()
    assert (np.abs(mean - plain) < Z * np.hypot(error, noise)).all() and (error < 0.02 * mean).all()
    assert (error < 0.85 * noise).all()


def test_a_lamp_next_door_is_picked_most():
    b = street(("point",), n=30)
    world = World(b.build())
    emitters = Emitters(world)
    p = np.repeat((np.array([62.0, 1.0, 0.0]) - world.center)[:, None], emitters.lamps.count, axis=1).astype(np.float32)
    chance = emitters._all.chance(p, np.arange(emitters.lamps.count))
    assert abs(int(np.argmax(chance)) - 15) <= 1 and np.sort(chance)[-2:].sum() > 10 / emitters.lamps.count


def test_few_emitters_are_picked_by_power_alone():
    assert Emitters(World(street(("point",), n=3).build()))._all.places is None


def test_what_gives_much_at_a_place_is_picked_there_often():
    """Whatever shape its light has, by lamps that look any way: of its share in what arrives all but a twentieth have 7 % at least.

    Elliptic cones are taken for round ones around them, so other lamps give way to them where they do not shine.
    """
    b, rng = SceneBuilder(), np.random.default_rng(3)
    b.box("Room", (0, 0, 0), (8, 2, 2), diffuse("Grey", 0.5), inward=True)
    for i in range(24):
        z = rng.normal(size=3)
        z /= np.linalg.norm(z)
        x = np.cross(z, (0.3, 0.5, 0.8))
        x /= np.linalg.norm(x)
        axes = {f"axis_{name}": tuple(v.tolist()) for name, v in (("x", x), ("y", np.cross(z, x)), ("z", z))}
        place = tuple((rng.random(3) * (8, 2, 2)).tolist())
        if i % 2:
            spot = {"spot_angle": 1.0, "spot_blend": 0.2, "spot_scale": ((3.0, 1.0), (1.0, 4.0), (1.0, 1.0))[i % 3]}
            b.light(Light(f"S{i}", "spot", (2.0, 1.0, 1.0), place, **axes, **spot))
        else:
            b.light(Light(f"A{i}", "area", (9.0, 5.0, 1.0), place, **axes, size_x=0.4, size_y=0.2))
    world = World(b.build())
    emitters, count = Emitters(world), 600
    p = np.ascontiguousarray((rng.random((count, 3)) * (8, 2, 2) - world.center).T, np.float32)
    given = []
    for lamp in range(emitters.lamps.count):
        points = [emitters.draw_from(lamp, p, u, v) for u, v in rng.random((16, 2))]
        given.append(np.mean([s.radiance.sum(axis=0) / s.pdf_w for s in points], axis=0))
    share = np.array(given) / np.sum(given, axis=0)
    chance = np.array([emitters._all.chance(p, np.full(count, lamp)) for lamp in range(emitters.lamps.count)])
    much = share > 0.1
    assert much.sum() > count and np.percentile(chance[much] / share[much], 5) > 0.07
