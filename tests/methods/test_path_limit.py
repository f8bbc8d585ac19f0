"""The longest path: no method has one by default, and what a given one leaves out is stated."""

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.settings import NO_LIMIT
from adjgi.adjoint_gi.core.method.registry import methods
from adjgi.adjoint_gi.core.method.solution import EnergyBalance
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.adjoint_gi.core.walks import path_limit, paths
from adjgi.tests import scenes
from adjgi.tests.solving import scattered, solve

COARSE = {"max_edge": 0.6}
QUICK = {
    "path_tracing": {"samples": 32},
    "distribution": {"samples": 4},
    "irradiance_cache": {"rays": 256, "light_samples": 2, "accuracy": 1.0},
    "particle_tracing": {"particles": 8000, **COARSE},
    "two_pass": {"samples": 4, "rays": 32, **COARSE},
    "multi_pass": {"samples": 8, "rays": 10_000, **COARSE},
    "matrix_radiosity": {"rays": 64, **COARSE},
    "progressive_radiosity": {"rays": 10_000, **COARSE},
    "stochastic_jacobi": {"rays": 10_000, **COARSE},
    "spherical_harmonics": {"rays": 10_000, "order": 0, **COARSE},
    "directional_radiosity": {"rays": 8, "bin_rows": 2, "bin_columns": 4, **COARSE},
}


def closed_room(name, rho, **options):
    """A closed room whose walls emit 1: the solution, and its irradiance over 1 / (1 - rho)."""
    world = World(scenes.cube(rho, 1.0))
    found = solve(name, world, scattered(world, 200), seed=1, **QUICK[name], **options)
    return found, float(found.quantity("irradiance").mean()) * (1 - rho)


def test_no_method_has_a_longest_path_by_default():
    assert {m.spec.id: m.Settings().max_length for m in methods()} == {m.spec.id: NO_LIMIT for m in methods()}


@pytest.mark.parametrize("name", QUICK)
def test_what_a_longest_path_leaves_out_is_stated(name):
    """All that is longer than k segments is rho^k of the light."""
    found, share = closed_room(name, 0.9, max_length=16)
    assert share == pytest.approx(1 - 0.9**16, rel=0.03)
    assert found.left_out == pytest.approx(0.9**16, rel=0.15)
    (said,) = [w for w in found.warnings if w.object == "Path Length"]
    assert "more than 16 segments are left out: about 1" in said.reason and "1024" in said.remedy


@pytest.mark.parametrize(("name", "rho"), [("path_tracing", 0.98), ("particle_tracing", 0.95), ("irradiance_cache", 0.95)])
def test_white_rooms_are_whole(name, rho):
    """With 64 segments 27 % would be missing at an albedo of 0.98, and 4 % at 0.95."""
    found, share = closed_room(name, rho)
    assert share == pytest.approx(1, abs=0.025)
    assert not found.left_out and not any(w.object == "Path Length" for w in found.warnings)


def test_light_that_never_ends_is_cut_and_said(monkeypatch):
    monkeypatch.setattr(path_limit, "LONGEST", 64)
    found, _ = closed_room("path_tracing", 1.0)
    assert found.direct.mean() + found.indirect.mean() == pytest.approx(64, rel=0.02)
    (said,) = [w for w in found.warnings if w.object == "Path Length"]
    assert "more than 64 segments are left out: most of the light" in said.reason and "albedos" in said.remedy


def test_paths_without_roulette_end_where_they_carry_a_millionth(monkeypatch):
    longest, step = [], paths.Paths.step

    def watched(self):
        longest.append(self.length)
        return step(self)

    monkeypatch.setattr(paths.Paths, "step", watched)
    world = World(scenes.cube(0.5, 1.0))
    options = {"samples": 4, "roulette": False, "split_depth": 0}
    found = solve("distribution", world, scattered(world, 50), seed=1, **options)
    assert found.quantity("irradiance").mean() == pytest.approx(2, rel=0.05)
    assert max(longest) == 21  # at the 21st vertex 0.5^20 is left, below a millionth


def test_blocks_are_the_last_lengths_that_count():
    found = [path_limit.block_of(k, 0, 8) for k in range(10)]
    assert found == [None, None, None, None, None, 0, 0, 1, 1, None]
    assert [path_limit.block_of(k, 7, 8) for k in (6, 7, 8)] == [None, 0, 1]
    assert path_limit.block_length(3, 3) == 0 and path_limit.block_of(3, 3, 3) is None
    # 1 + 1/2 + 1/4 + ..., cut after eight of them.
    light = 0.5 ** np.arange(8.0)
    tail = np.array([light[4:6].sum(), light[6:].sum()])
    assert path_limit.left_out(tail, light.sum()) == pytest.approx(0.5**8)


def test_what_is_unshot_is_a_share_of_what_is_absorbed_in_the_end():
    assert path_limit.left_unshot(EnergyBalance(10.0, 3.0, 6.0, 1.0), 5) == pytest.approx(0.25)
    assert path_limit.left_unshot(EnergyBalance(10.0, 3.0, 6.0, 1.0), NO_LIMIT) == 0
    assert path_limit.left_unshot(EnergyBalance(1.0, 0.0, 1.0), 5) is None
