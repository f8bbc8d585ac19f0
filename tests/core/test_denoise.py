"""The denoising step: noise goes, means and crisp shadows stay, and no light crosses a border."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from adjgi.adjoint_gi.core.denoise import wavelets
from adjgi.adjoint_gi.core.denoise.ground import GridNeighbours, Ground, pixel_ground, texel_ground, vertex_ground
from adjgi.adjoint_gi.core.denoise.images import BORDER, Tile, image_denoiser
from adjgi.adjoint_gi.core.denoise.step import NoisyLight, can_denoise, denoised, merged, noisy_share, own_denoiser, trusted
from adjgi.adjoint_gi.core.denoise.wavelets import smoothed
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.method.registry import method
from adjgi.adjoint_gi.core.method.solution import Solution
from adjgi.adjoint_gi.core.receivers.base import CameraReceivers
from adjgi.adjoint_gi.core.receivers.texels import join, rasterize
from adjgi.adjoint_gi.core.receivers.vertices import vertex_receivers
from adjgi.adjoint_gi.core.scene.arrays import Camera
from adjgi.adjoint_gi.core.scene.world import World
from adjgi.tests.scenes import cornell
from adjgi.tests.solving import solve

SIDE = 32


@pytest.fixture(scope="module")
def floor():
    """World, lightmap and ground of the Cornell box's floor, and its light by few and by many samples."""
    world = World(cornell())
    lightmap = rasterize(world, [0], "", SIDE, 4)
    few, many = (solve("path_tracing", world, lightmap.receivers, samples=n, seed=n) for n in (32, 1024))
    return texel_ground(world, lightmap.receivers, [lightmap]), few, many


def error(found: np.ndarray, right: np.ndarray) -> float:
    return float(np.sqrt(((found - right) ** 2).mean()) / right.mean())


def result(direct: np.ndarray, indirect: np.ndarray, **errors: np.ndarray) -> Solution:
    """A solution for receivers that all have samples."""
    zero = np.zeros_like(direct)
    return Solution("path_tracing", "irradiance", zero, direct, indirect, zero + 1, np.ones(len(direct), np.float32), extra=errors)


def grid(piece: np.ndarray) -> Ground:
    """A flat ground of pixels, `piece` (h, w)."""
    h, w = piece.shape
    y, x = np.mgrid[:h, :w]
    position = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, 1]), position.shape)
    flat = piece.reshape(-1)
    ones = np.ones(len(flat), np.float32)
    return Ground(flat, position, normal, ones, np.ones((len(flat), 3), np.float32), GridNeighbours([np.arange(h * w).reshape(h, w)], flat))


def test_error_falls_and_the_mean_stays(floor):
    ground, few, many = floor
    clean = denoised(few, ground, own_denoiser(ground))
    for name, factor in (("indirect", 0.35), ("direct", 1.1)):  # shadows on so few texels have no room for a filter
        before, after, right = (getattr(s, name) for s in (few, clean, many))
        assert error(after, right) < factor * error(before, right), name
        assert after.mean(axis=0, dtype=float) == pytest.approx(before.mean(axis=0, dtype=float), rel=1e-5), name
    whole = clean.quantity("irradiance")
    assert (
        np.array_equal(whole, clean.direct + clean.indirect) and (clean.albedo == few.albedo).all() and (clean.emitted == few.emitted).all()
    )


def test_no_light_crosses_the_border_of_a_chart():
    piece = np.zeros((32, 64), np.int64)
    piece[:, 32:] = 1
    rng, ground = np.random.default_rng(1), grid(piece)
    level = 1.0 - piece.reshape(-1, 1)
    values = (level + rng.normal(0, 0.3, (piece.size, 3)) * (level + 0.01)).astype(np.float32)
    noise = np.full(piece.size, 0.6, np.float32)
    clean = denoised(result(0 * values, values, indirect_error=noise, direct_error=0 * noise), ground, own_denoiser(ground))
    for k, mean in enumerate((1.0, 0.0)):
        own = clean.indirect[piece.reshape(-1) == k]
        assert own.mean() == pytest.approx(values[piece.reshape(-1) == k].mean(), abs=1e-5), k
        assert own.mean() == pytest.approx(mean, abs=0.02) and own.std() < 0.1, k


def test_even_an_image_denoiser_that_blurs_all_keeps_the_charts_apart():
    piece = np.zeros((16, 64), np.int64)
    piece[:, 32:] = 1
    values = np.repeat(1.0 - 0.999 * piece.reshape(-1, 1), 3, axis=1).astype(np.float32)
    ground = grid(piece)
    seen = []

    def blur(image, albedo, normal):
        seen.append((image, albedo, normal))
        return np.full_like(image, image.mean())

    noise = np.full(piece.size, 0.5, np.float32)
    denoiser = image_denoiser(ground, blur, np.random.default_rng(0))
    clean = denoised(result(0 * values, values, indirect_error=noise, direct_error=0 * noise), ground, denoiser)
    assert np.allclose(clean.indirect, values, rtol=1e-5)
    ((image, albedo, normal),) = seen  # one layer, the noisy one
    assert (
        image.shape == (16 + 2 * BORDER, 64 + 2 * BORDER, 3) and (image > 0).all() and image.mean() == pytest.approx(1, rel=0.1)
    )  # no black comes near
    assert (albedo == 1).all() and (normal[..., 2] == 1).all()


def test_what_has_no_noise_stays_to_the_last_bit():
    """The edge of a point lamp's shadow beside noisy indirect light."""
    piece = np.zeros((24, 24), np.int64)
    ground, rng = grid(piece), np.random.default_rng(2)
    direct = np.repeat((np.arange(24) < 12).astype(np.float32)[None, :, None], 24, axis=0)
    direct = np.broadcast_to(direct, (24, 24, 3)).reshape(-1, 3)
    indirect = rng.exponential(0.1, direct.shape).astype(np.float32)
    found = result(direct, indirect, direct_error=np.zeros(576, np.float32), indirect_error=np.full(576, 0.17, np.float32))
    clean = denoised(found, ground, own_denoiser(ground))
    assert np.array_equal(clean.direct, direct) and clean.indirect.std() < 0.25 * indirect.std()
    quiet = dataclasses.replace(found, extra={k: np.zeros(576, np.float32) for k in found.extra})
    assert denoised(quiet, ground, own_denoiser(ground)) is quiet


def test_filter_keeps_edges_that_stand_out_of_the_noise():
    ground, rng = grid(np.zeros((32, 32), np.int64)), np.random.default_rng(3)
    right = np.repeat(np.where(np.arange(32) < 16, 1.0, 4.0)[None], 32, axis=0).reshape(-1, 1)
    values = (right + rng.normal(0, 0.1, (1024, 3))).astype(np.float32)
    clean = smoothed(values, np.full(1024, 0.17, np.float32), ground, np.ones(1024, bool))
    assert np.abs(clean - right).mean() < 0.3 * np.abs(values - right).mean()
    # Where nobody knows the noise it is taken from the surroundings, and the edge stays all the same.
    clean = smoothed(values, np.full(1024, np.inf, np.float32), ground, np.ones(1024, bool))
    assert np.abs(clean - right).mean() < 0.6 * np.abs(values - right).mean()


@pytest.mark.parametrize("holes", ["every other", "at random", "half"])
def test_receivers_without_a_sample_stay_black_and_darken_nobody(holes):
    """Nor do they brighten anybody, by a denoiser that leaves all as it is or takes the mean of a pixel and all around it."""
    ground, n = grid(np.zeros((16, 16), np.int64)), 256
    k, random = np.arange(n), np.random.default_rng(8).random(n)
    lit = {"every other": k % 2 == 1, "at random": random < 0.7, "half": k < n // 2}[holes]
    values = np.repeat(lit.astype(np.float32)[:, None], 3, axis=1)
    noise = result(0 * values, values, direct_error=0 * values[:, 0], indirect_error=np.full(n, 0.5, np.float32))
    found = dataclasses.replace(noise, weight=values[:, 0].copy())

    def blur(image, *_):
        return sum(np.roll(image, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)) / np.float32(9)

    images = (image_denoiser(ground, f, np.random.default_rng(0)) for f in (lambda image, *_: image, blur))
    for denoiser in (own_denoiser(ground), *images):
        clean = denoised(found, ground, denoiser)
        assert np.allclose(clean.indirect, values, atol=1e-6)


def test_vertices_of_a_mesh_are_smoothed_along_its_edges_and_no_farther():
    n = 24
    x, y = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    b = SceneBuilder()
    for name, z in (("One", 0.0), ("Two", 1e-4)):
        b.mesh(name, points + (0, 0, z), faces, diffuse(name, 0.5))
    world = World(b.build())
    rng = np.random.default_rng(4)
    for domain in ("POINT", "CORNER"):
        vertices = vertex_receivers(world, [0, 1], domain)
        ground = vertex_ground(world, vertices)
        level = 1.0 - 0.9 * ground.piece[:, None]
        values = (level * rng.normal(1, 0.3, (len(level), 3))).astype(np.float32)
        noise = (level[:, 0] * 0.5).astype(np.float32)
        clean = denoised(result(0 * values, values, indirect_error=noise, direct_error=0 * noise), ground, own_denoiser(ground))
        for k in (0, 1):
            own, was = (x[ground.piece == k] / level[ground.piece == k] for x in (clean.indirect, values))
            assert own.mean() == pytest.approx(was.mean(), rel=1e-5) and np.abs(own - 1).mean() < 0.3 * np.abs(was - 1).mean()


def test_pixels_keep_textures_and_edges_of_objects():
    world = World(cornell(32, 32))
    receivers = CameraReceivers(world)
    few, many = (solve("path_tracing", world, receivers, samples=n, seed=n) for n in (8, 256))
    ground = pixel_ground(receivers, few.extra["normal"], few.extra["depth"], few.albedo)
    clean = denoised(few, ground, own_denoiser(ground))
    assert error(clean.indirect, many.indirect) < 0.4 * error(few.indirect, many.indirect)
    assert clean.quantity("radiance").mean() == pytest.approx(few.quantity("radiance").mean(), rel=1e-4)


def test_film_states_the_error_of_each_part(floor):
    _, few, many = floor
    for name in ("direct", "indirect"):
        stated = np.sqrt((few.extra[f"{name}_error"] ** 2).mean())
        true = np.sqrt(((getattr(few, name) - getattr(many, name)).sum(axis=1) ** 2).mean())
        assert 0.6 * true < stated < 4 * true, name  # Sobol points make direct light better than groups of them tell


def test_methods_without_noise_are_never_denoised():
    assert can_denoise(method("path_tracing").spec) and can_denoise(method("multi_pass").spec)
    assert not any(
        can_denoise(method(name).spec) for name in ("matrix_radiosity", "progressive_radiosity", "whitted", "local_illumination")
    )


def test_share_follows_the_noise():
    ground = grid(np.zeros((6, 6), np.int64))
    ones, valid = np.ones((36, 3), np.float32), np.ones(36, bool)
    shares = [noisy_share(NoisyLight("direct", ones, np.full(36, e, np.float32), valid), ground) for e in (0.0, 0.01, 3.0, np.inf)]
    assert (shares[0] == 0).all() and (shares[1] == 0).all() and (shares[2] == 1).all()
    # Where the error is not known, values tell of it by how they differ: those of one sample that are all the same stay.
    uneven = (ones * np.random.default_rng(1).exponential(size=(36, 1))).astype(np.float32)
    assert (shares[3] == 0).all()
    assert (noisy_share(NoisyLight("direct", uneven, np.full(36, np.inf, np.float32), valid), ground) == 1).all()


@pytest.mark.parametrize("name", ["direct", "indirect"])
def test_what_smoothing_spoils_comes_back_with_more_samples(name):
    """A smooth picture of an edge is half wrong beside it: what it is trusted falls with the noise, so that the error goes to nothing."""
    ground, rng = grid(np.zeros((24, 24), np.int64)), np.random.default_rng(3)
    right = np.repeat(np.where(np.arange(576) % 24 < 12, 1.0, 2.0)[:, None], 3, axis=1)
    blurred = right.reshape(24, 24, 3).copy()
    blurred[:, 8:16] = 1.5
    found, shares = [], []
    for noise in (0.3, 0.03, 0.003):
        values = (right + noise * rng.standard_normal((576, 1))).astype(np.float32)
        layer = NoisyLight(name, values, np.full(576, 3 * noise, np.float32), np.ones(576, bool))
        share = trusted(layer, blurred.reshape(576, 3), ground)
        mixed = values + share[:, None] * (blurred.reshape(576, 3) - values)
        found.append(error(mixed, right))
        shares.append(share.reshape(24, 24))
        assert found[-1] < 1.02 * min(error(values, right), error(blurred.reshape(576, 3), right))
    assert found[0] > 5 * found[1] > 25 * found[2]
    if name == "direct":  # away from the edge nothing is spoiled
        assert (shares[2][:, :3] > 0.5).all() and (shares[2][:, 9:15] < 0.01).all()


@pytest.mark.parametrize("level", [0, 1])
def test_pixels_lie_beside_those_of_all_eight_directions(level):
    """Every pixel of an image is joined with the eight at the distance of the level, with those at the corners for half as much."""
    ground, step = grid(np.zeros((7, 9), np.int64)), 1 << level
    weight = np.zeros((63, 63))
    for i, j, h in ground.neighbours.pairs(level):
        np.add.at(weight, (i, j), h)
    y, x = np.divmod(np.arange(63), 9)
    dy, dx = np.abs(y[:, None] - y), np.abs(x[:, None] - x)
    straight = (dy + dx == step) & ((dy == 0) | (dx == 0))
    assert (weight == 0.5 * straight + 0.25 * ((dy == step) & (dx == step))).all()


def test_charts_of_two_images_are_pieces_of_their_own():
    """Objects that each have a lightmap: no light goes from the texels of one to those of the other, nor do they share a mean."""
    b = SceneBuilder()
    for k in range(2):
        b.quad(f"Quad {k}", (3 * k, 0, 0), (1, 0, 0), (0, 1, 0), diffuse("Grey", 0.5))
    world = World(b.build())
    maps = [rasterize(world, [k], "", 4, 1) for k in range(2)]
    ground = texel_ground(world, join([m.receivers for m in maps])[0], maps)
    assert ground.piece.tolist() == [0] * 16 + [1] * 16
    assert [image.min() for image in ground.neighbours.images] == [0, 16]


def flat(values: np.ndarray, error: float | np.ndarray, ground: Ground) -> np.ndarray:
    """Smoothed where all receivers have a value."""
    n = len(values)
    return smoothed(np.asarray(values, np.float32), np.broadcast_to(np.float32(error), n), ground, np.ones(n, bool))


def test_noise_that_nobody_knows_is_judged_alike_in_bright_and_in_dim_light():
    ground, valid = grid(np.zeros((8, 8), np.int64)), np.ones(64, bool)
    values = 1 + 0.013 * np.random.default_rng(5).standard_normal((64, 1)) * np.ones(3)
    unknown = np.full(64, np.inf, np.float32)
    shares = [noisy_share(NoisyLight("indirect", (values * s).astype(np.float32), unknown, valid), ground) for s in (1.0, 0.01, 100.0)]
    assert shares[0].min() > 0.2 and shares[0].max() < 0.8  # what 1 % of noise gets
    assert shares[1] == pytest.approx(shares[0], rel=1e-3) and shares[2] == pytest.approx(shares[0], rel=1e-3)


def test_light_under_a_grey_texture_is_smoothed_as_the_light_itself():
    ground, rng = grid(np.zeros((12, 12), np.int64)), np.random.default_rng(6)
    values = rng.normal(1, 0.2, (144, 3))
    white = flat(values, 0.1, ground)
    grey = flat(values * 0.25, 0.025, dataclasses.replace(ground, albedo=np.full((144, 3), 0.25, np.float32)))
    assert grey == pytest.approx(0.25 * white, rel=1e-5)


@pytest.mark.parametrize("border", ["edge", "step"])
def test_light_does_not_go_round_an_edge_nor_down_a_step(border):
    """Two halves that face apart, or lie 9 pixels over each other, keep their light however noisy it is."""
    ground = grid(np.zeros((8, 16), np.int64))
    right = np.arange(128) % 16 >= 8
    if border == "edge":
        ground = dataclasses.replace(ground, normal=np.where(right[:, None], np.float32([1, 0, 0]), np.float32([0, 0, 1])))
    else:
        ground = dataclasses.replace(ground, position=ground.position + np.where(right[:, None], np.float32([0, 0, 900]), 0))
    values = np.where(right[:, None], 2.0, 1.0) * np.ones(3)
    assert flat(values, 50.0, ground) == pytest.approx(values, rel=1e-4)
    assert np.ptp(flat(values, 50.0, grid(np.zeros((8, 16), np.int64)))) < 0.9


def test_noise_falls_with_the_squares_of_the_weights():
    """The mean over a pixel and its eight neighbours, weights 4 x 1/2 and 4 x 1/4 beside its own: (1 + 1 + 1/4) / 16 of the variance."""
    ground, n = grid(np.zeros((5, 5), np.int64)), 25
    _, variance = wavelets._level(np.ones((n, 3)), np.ones(n), ground, np.ones(n, bool), 0)
    assert variance[12] == pytest.approx(2.25 / 16)


def test_images_and_layers_that_share_a_packed_image_come_back_to_their_places():
    """Three images of two layers, a thousand times as bright one as the other, through a denoiser that leaves all as it is."""
    shapes, first, images = ((5, 9), (12, 4), (7, 7)), 0, []
    for h, w in shapes:
        images.append(first + np.arange(h * w).reshape(h, w))
        first += h * w
    piece = np.repeat(np.arange(3), [h * w for h, w in shapes])
    ones = np.ones((first, 3), np.float32)
    ground = Ground(piece, ones * 0, ones, ones[:, 0], ones, GridNeighbours(images, piece))
    rng, valid = np.random.default_rng(7), np.ones(first, bool)
    layers = [
        NoisyLight(name, (scale * rng.random((first, 3))).astype(np.float32), ones[:, 0], valid)
        for name, scale in zip("ab", (1, 1000), strict=True)
    ]
    seen = []
    found = image_denoiser(ground, lambda image, *_: seen.append(image.mean()) or image, np.random.default_rng(0))(layers)
    assert len(seen) == 1
    for layer, values in zip(layers, found, strict=True):
        assert values == pytest.approx(layer.values, rel=1e-5)


def test_pixels_far_apart_may_lie_as_much_farther_from_the_plane():
    """On a slope that the normals know nothing of, neighbours at eight times the distance count as much as the nearest."""
    ground, n = grid(np.zeros((33, 33), np.int64)), 33 * 33
    slope = ground.position + ground.position[:, :1] * np.float32([0, 0, 0.5])
    ground = dataclasses.replace(ground, position=slope.astype(np.float32))
    near, far = (wavelets._level(np.ones((n, 3)), np.ones(n), ground, np.ones(n, bool), level)[1][n // 2] for level in (0, 3))
    assert near < 0.3 and far == pytest.approx(near, rel=1e-3)


def test_beside_a_chart_lies_its_own_mirror_image():
    """Where it is too narrow for one, what lies at its border; never the chart behind it."""
    tile = Tile.of(np.array([[0, 1, 2]]), np.ones(3, bool), np.array([0, 1, 1]), np.random.default_rng(0))
    assert tile.receiver[BORDER, BORDER - 1 : BORDER + 4].tolist() == [0, 0, 1, 2, 1]
    assert tile.own[BORDER, BORDER - 1 : BORDER + 4].tolist() == [False, True, True, True, False]


@pytest.mark.parametrize("shape", [(1, 60), (60, 1), (2, 60), (3, 5)], ids=str)
def test_charts_of_few_rows_are_not_drawn_out_to_streaks(shape):
    """What lies beside a chart shows others of its texels than those in the same row, and nothing of the chart next to it."""
    h, w = shape
    image = np.full((2 * h + 12, w + 12), -1)
    image[4 : 4 + h, 4 : 4 + w] = np.arange(h * w).reshape(shape)
    image[8 + h : 8 + 2 * h, 4 : 4 + w] = np.arange(h * w, 2 * h * w).reshape(shape)
    piece = np.repeat([0, 1], h * w)
    tile = Tile.of(image, np.ones(2 * h * w, bool), piece, np.random.default_rng(5))
    y, x = np.nonzero(tile.own)
    around = np.stack([tile.receiver[y + dy, x + dx] for dy in range(-2, 3) for dx in range(-2, 3)])
    assert (piece[around] == piece[around[12]]).all()
    if 1 in shape:
        across = [2, 7, 17, 22] if h == 1 else [10, 11, 13, 14]
        assert np.mean(around[across] == around[12]) < 0.7  # all of them, if the row were drawn out


def test_pixels_lie_where_their_rays_meet_the_floor():
    """Of a tilted camera at a height of 2."""
    f = np.array([0.6, 0, -0.8])
    b = SceneBuilder()
    b.camera = Camera("perspective", (1, 0, 2), (0, 1, 0), (0.8, 0, 0.6), tuple(f), (-0.4, 0.4, -0.4, 0.4), 4, 4)
    receivers = CameraReceivers(World(b.build()))
    middle = np.full(16, 0.5)
    origin, direction = receivers.rays(np.arange(16), middle, middle)
    depth = origin[:, 2] / -direction[:, 2]
    ground = pixel_ground(receivers, np.tile(np.float32([0, 0, 1]), (16, 1)), depth, np.ones((16, 3), np.float32))
    assert np.abs(ground.position[:, 2]).max() < 1e-5
    middle_of_all = ground.position.mean(axis=0)
    assert middle_of_all[:2] == pytest.approx([1 + 2 * 0.6 / 0.8, 0], abs=0.3) and np.ptp(ground.position[:, 1]) > 0.5


@pytest.mark.parametrize("left, kept", [(0.0, True), (1e-4, True), (0.5, False)])
def test_what_a_denoiser_takes_away_as_a_whole_stays(left, kept):
    """Of a single bright texel next to nothing may be left, which scaled up would be another picture."""
    ground = grid(np.zeros((4, 4), np.int64))
    values = np.zeros((16, 3), np.float32)
    values[5] = 8.0
    smooth = np.full((16, 3), left / 2, np.float32)
    found = merged(NoisyLight("direct", values, np.ones(16, np.float32), np.ones(16, bool)), smooth, np.ones(16), ground)
    np.testing.assert_allclose(found, values if kept else 0.5, atol=1e-6)


def test_what_a_denoiser_makes_negative_is_dark():
    ground, values = grid(np.zeros((2, 4), np.int64)), np.ones((8, 3), np.float32)
    smooth = np.where(np.arange(8) == 3, -5.0, 1.0)[:, None] * np.ones(3, np.float32)
    found = merged(NoisyLight("direct", values, np.ones(8, np.float32), np.ones(8, bool)), smooth, np.ones(8), ground)
    np.testing.assert_allclose(found, np.where(np.arange(8) == 3, 0, 8 / 7)[:, None] * np.ones(3), rtol=1e-6)
