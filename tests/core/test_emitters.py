"""Emitters: irradiance of every kind against closed forms or quadrature, and drawn points against what rays meet."""

from __future__ import annotations

import math

import numpy as np
import pytest
from adjgi.adjoint_gi.core.gallery.builder import SceneBuilder, diffuse
from adjgi.adjoint_gi.core.lights import direct
from adjgi.adjoint_gi.core.lights.direct import direct_irradiance
from adjgi.adjoint_gi.core.lights.emitters import MOST_LAMPS, Emitters
from adjgi.adjoint_gi.core.lights.emitters import _Table as Table
from adjgi.adjoint_gi.core.sampling.maps import columns
from adjgi.adjoint_gi.core.scene.arrays import Color, Light, Lobe, Material, RayKind, Source, Term, Texture
from adjgi.adjoint_gi.core.scene.faces import Faces
from adjgi.adjoint_gi.core.scene.world import World

# Standard deviations that sound emitters exceed once in a thousand runs of the 60 z-tests here (Sidak).
Z = 4.3
N = 100_000
PI = math.pi
ONE = (1.0, 1.0, 1.0)


def floor(size=2.0):
    """A builder with a square floor of side 2 `size` about the origin; triangles 0 and 1."""
    b = SceneBuilder()
    b.quad("Floor", (-size, -size, 0), (2 * size, 0, 0), (0, 2 * size, 0), diffuse("Grey", 0.5))
    return b


def at(world, x, y, size=2.0, n=N):
    """The same floor point n times."""
    a, b = (x + size) / (2 * size), (y + size) / (2 * size)
    triangle, u, v = (0, a - b, b) if a >= b else (1, a, b - a)
    return world.surface(np.full(n, triangle, np.int32), np.full(n, u, np.float32), np.full(n, v, np.float32))


def irradiance(builder, x=0.0, y=0.0, seed=1, samples=1, n=N, mesh=True):
    """Mean and standard error (3,) of the irradiance at a floor point."""
    world = World(builder.build())
    values, rays = direct_irradiance(world, Emitters(world), at(world, x, y, n=n), samples, np.random.default_rng(seed), mesh)
    assert values.dtype == np.float32 and np.isfinite(values).all() and (values >= 0).all() and rays >= 0
    return values.mean(axis=0, dtype=float), values.std(axis=0, dtype=float) / math.sqrt(n)


def agrees(builder, exact, x=0.0, y=0.0, **options):
    """Assert the irradiance within Z standard errors and a rounding of 2e-5, and that the test could see 0.5 %."""
    mean, error = irradiance(builder, x, y, **options)
    assert (error <= 0.0012 * np.max(exact)).all(), f"too noisy to tell: {error} of {exact}"
    assert (np.abs(mean - exact) <= Z * error + 2e-5 * np.max(exact)).all(), f"{mean} +- {error}, not {exact}"


def lamp(kind, **options):
    """A white lamp three metres up, shining down."""
    return Light("Lamp", kind, options.pop("color", ONE), options.pop("position", (0.0, 0.0, 3.0)), **options)


def corner(a, b, c):
    """View factor of a point to a parallel rectangle a x b at distance c, over whose corner it lies."""
    x, y = a / c, b / c
    s, t = math.sqrt(1 + x * x), math.sqrt(1 + y * y)
    return (x / s * math.atan(y / s) + y / t * math.atan(x / t)) / (2 * PI)


def test_picks_among_a_million_emitters_are_as_the_power_says():
    """The 2^24 steps of a float32 number are some ten for each emitter, which gave weak ones a third too many."""
    power = np.random.default_rng(1).random(1_600_000) ** 3
    picked = []
    table = Table([(power, lambda k, *_: picked.append(k))])
    n, rng = 1 << 20, np.random.default_rng(2)
    even = ((np.arange(n) + rng.random(n)) / n * 2**24).astype(np.uint32) * np.float32(2**-24)
    table.draw(np.zeros((3, n), np.float32), np.stack([even, *rng.random((2, n), np.float32)]))
    weak = power < np.median(power)
    expected = power[weak].sum() / power.sum()
    assert abs(weak[picked[0]].mean() - expected) < Z * math.sqrt(expected * (1 - expected) / n)


# ---- closed forms


@pytest.mark.parametrize("x", [0.0, 1.3])
def test_point(x):
    b = floor()
    b.light(lamp("point", color=(1.0, 2.0, 4.0)))
    agrees(b, 3 / (9 + x * x) ** 1.5 * np.array([1, 2, 4]), x=x)


def test_sphere():
    b = floor()
    b.light(lamp("point", radius=1.0))
    # E = pi L (r / d)^2 cos, a radiance of I / (pi r^2): the radius does not change it.
    agrees(b, 1 / 9)
    agrees(b, 3 / (9 + 1.69) ** 1.5, x=1.3)


@pytest.mark.parametrize("z", [None, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)])
def test_inside_a_sphere(z):
    """Radiance 4 / pi from all sides, also where a spot sends no light: as in Cycles it has no cone there."""
    spot, b = {} if z is None else {"axis_x": (0, 1, 0), "axis_y": np.cross(z, (0, 1, 0)), "axis_z": z, "spot_angle": 1.0}, floor()
    b.light(lamp("spot" if spot else "point", position=(0.0, 0.0, 0.1), radius=0.5, **spot))
    agrees(b, 4.0, x=0.4)


def test_soft_disk():
    b = floor()
    b.light(lamp("point", radius=1.0, soft_falloff=True))
    agrees(b, 1 / (9 + 1))


@pytest.mark.parametrize("kind", ["sphere", "rectangle"])
def test_a_large_lamp_without_shadow_shines_through_what_is_in_between(kind):
    """Rays that meet lamps end at surfaces, so these lamps are left to light points alone."""
    sized = {"sphere": ("point", {"radius": 1.5}), "rectangle": ("area", {"size_x": 3.0, "size_y": 3.0})}[kind]
    b = floor()
    b.quad("Shelf", (0, -1, 1), (1, 0, 0), (0, 2, 0), diffuse("Black", 0.0))
    b.light(lamp(sized[0], shadow=False, **sized[1]))
    agrees(b, 1 / 9 if kind == "sphere" else PI * 4 * corner(1.5, 1.5, 3))


def test_spot_inside_its_cone_and_outside():
    b = floor()
    b.light(lamp("spot", spot_angle=1.0))
    agrees(b, 1 / 9)
    assert irradiance(b, x=1.9)[0].max() == 0


@pytest.mark.parametrize("x", [0.8, 1.2, 1.5])
def test_spot_blend(x):
    b = floor()
    b.light(lamp("spot", spot_angle=math.radians(60), spot_blend=0.7))
    edge = math.cos(math.radians(30))
    t = min(max((3 / math.hypot(3, x) - edge) / ((1 - edge) * 0.7), 0), 1)
    agrees(b, 3 / (9 + x * x) ** 1.5 * t * t * (3 - 2 * t), x=x)


def test_elliptic_spot():
    b = floor()
    b.light(lamp("spot", spot_angle=math.radians(40), spot_scale=(2.0, 0.5)))
    agrees(b, 3 / (9 + 1.8**2) ** 1.5, x=1.8)  # tan 20 deg * 2 * 3 = 2.18
    assert irradiance(b, y=0.8)[0].max() == 0  # tan 20 deg / 2 * 3 = 0.55


def test_rectangle():
    b = floor()
    b.light(lamp("area", size_x=2.0, size_y=1.0))
    agrees(b, PI * 4 * corner(1, 0.5, 3))
    # Beside it: differences of rectangles that have their corner above the point.
    agrees(b, PI * 2 * (corner(2.5, 0.5, 3) - corner(0.5, 0.5, 3)), x=1.5)


def test_rectangle_is_dark_behind():
    b = floor()
    b.light(lamp("area", size_x=2.0, size_y=1.0, axis_z=(0.0, 0.0, -1.0), axis_y=(0.0, -1.0, 0.0)))
    assert irradiance(b)[0].max() == 0


def test_rectangle_turned():
    b = floor()
    # A vertical unit square that shines towards -x, its lower edge in the floor: receiver normal along one of its sides.
    b.light(
        lamp(
            "area",
            position=(1.0, 0.0, 0.5),
            size_x=1.0,
            size_y=1.0,
            axis_x=(0.0, 0.0, -1.0),
            axis_y=(0.0, 1.0, 0.0),
            axis_z=(1.0, 0.0, 0.0),
        )
    )

    def along(a, b_, c):
        x, y = a / b_, c / b_
        s = math.hypot(x, y)
        return (math.atan(1 / y) - y / s * math.atan(1 / s)) / (2 * PI)

    agrees(b, PI * 2 * along(1.0, 0.5, 1.0), n=2 * N)


def test_ellipse():
    b = floor()
    b.light(lamp("area", size_x=2.0, size_y=2.0, shape="ELLIPSE"))
    agrees(b, PI / (1 + 9))


@pytest.mark.parametrize("spread", [0.3, 1.5, 3.0])
def test_spread(spread):
    b = floor()
    b.light(lamp("area", size_x=2.0, size_y=2.0, shape="ELLIPSE", spread=spread))
    h = spread / 2
    r = (np.arange(20_000) + 0.5) / 20_000
    share = np.maximum(math.tan(h) - r / 3, 0) / (math.tan(h) - h)
    exact = (share * 9 / (9 + r * r) ** 2 * 2 * PI * r).mean()
    agrees(b, exact, n=8 * N)


@pytest.mark.parametrize("angle", [0.0, 0.009, 0.5, 2.0])
def test_sun(angle):
    b = floor()
    b.light(lamp("sun", angle=angle, axis_z=(0.6, 0.0, 0.8)))
    if angle < 1.2:  # all of the disk above the horizon
        agrees(b, 0.8)
    else:
        b = floor()
        b.light(lamp("sun", angle=angle))
        agrees(b, 1.0)


def test_background():
    b = floor()
    b.background = (2.0, 1.0, 0.0)
    mean, error = irradiance(b)
    assert np.allclose(mean, np.array([2, 1, 0]) * PI, rtol=1e-6) and error.max() < 1e-6


@pytest.mark.parametrize("height", [1.0, 0.02])
def test_mesh_light(height):
    b = floor()
    b.quad("Light", (-0.5, -0.5, height), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
    agrees(b, PI * 4 * corner(0.5, 0.5, height), n=4 * N)


def test_mesh_light_shines_from_both_sides():
    up, down = floor(), floor()
    up.quad("Light", (-0.5, -0.5, 1), (1, 0, 0), (0, 1, 0), diffuse("L", 0.0, 1.0))
    down.quad("Light", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
    agrees(up, PI * 4 * corner(0.5, 0.5, 1), n=2 * N)
    agrees(down, PI * 4 * corner(0.5, 0.5, 1), n=2 * N)


def test_large_mesh_light_of_one_triangle_by_lamberts_formula():
    b = floor()
    p = np.array([(-1.0, -1.0, 0.4), (1.5, -0.5, 0.8), (0.2, 1.5, 0.3)])
    b.mesh("Light", p, np.array([[0, 1, 2]]), diffuse("L", 0.0, 3.0))
    v = p / np.linalg.norm(p, axis=1, keepdims=True)
    total = 0.0
    for k in range(3):
        c = np.cross(v[k], v[(k + 1) % 3])
        total += math.acos(v[k] @ v[(k + 1) % 3]) * c[2] / np.linalg.norm(c)
    agrees(b, 3 * abs(total) / 2, n=4 * N)


def test_everything_at_once_adds_up():
    def parts():
        yield lambda b: b.quad("Light", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
        yield lambda b: b.light(lamp("point", position=(1.0, 0.0, 0.8), radius=0.3))
        yield lambda b: b.light(lamp("sun", angle=0.3))
        yield lambda b: b.light(lamp("spot", position=(0.0, 0.5, 0.5)))
        yield lambda b: setattr(b, "background", (0.3, 0.3, 0.3))

    single = []
    for k, part in enumerate(parts()):
        # The quad stands in all of them, black, as it casts shadows.
        b = floor()
        if k:
            b.quad("Light", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0))
        part(b)
        single.append(irradiance(b, 0.7, 0.2, seed=k))
    b = floor()
    for part in parts():
        part(b)
    mean, error = irradiance(b, 0.7, 0.2, n=4 * N)
    expected, noise = sum(m for m, _ in single), np.sqrt(error**2 + sum(e**2 for _, e in single))
    assert (noise < 0.003 * expected).all()
    assert (np.abs(mean - expected) < Z * noise).all()


def test_without_mesh_emission():
    b = floor()
    b.quad("Light", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
    assert irradiance(b, mesh=False)[0].max() == 0
    b.light(lamp("point", position=(0.0, 0.0, 0.5)))
    agrees(b, 4.0, mesh=False)
    b.background = ONE
    # The quad hides the sky behind it.
    agrees(b, 4.0 + PI * (1 - 4 * corner(0.5, 0.5, 1)), mesh=False)


def test_no_light_at_all():
    mean, _ = irradiance(floor())
    assert mean.max() == 0


# ---- shadows


@pytest.mark.parametrize("shadow", [True, False])
@pytest.mark.parametrize(
    "options", [{"kind": "point"}, {"kind": "point", "radius": 0.5}, {"kind": "area", "size_x": 1.0, "size_y": 1.0}, {"kind": "sun"}]
)
def test_shadow(options, shadow):
    b = floor()
    b.quad("Blocker", (-1.5, -1.5, 1), (3, 0, 0), (0, 3, 0), diffuse("Black", 0.0))
    kind = options["kind"]
    b.light(lamp(kind, shadow=shadow, **{k: v for k, v in options.items() if k != "kind"}))
    mean, _ = irradiance(b)
    assert (mean > 0).all() if not shadow else mean.max() == 0


@pytest.mark.parametrize(
    ("large", "exact"),
    [(lamp("area", size_x=4.0, size_y=4.0, shadow=False), PI * 4 * corner(2, 2, 3)), (lamp("point", radius=1.5, shadow=False), 1 / 9)],
    ids=["area", "sphere"],
)
def test_a_large_lamp_without_shadows_gives_all_its_light_behind_a_wall(large, exact):
    """Rays end at the wall, so that none of this light may be left to them."""
    b = floor()
    b.quad("Wall", (-3, -3, 1), (6, 0, 0), (0, 6, 0), diffuse("Black", 0.0))
    b.light(large)
    agrees(b, exact, n=4 * N)
    emitters = Emitters(World(b.build()))
    assert emitters.lamps.large.all() and not len(emitters.shared)


def test_lamps_do_not_block_light():
    b = floor()
    b.light(lamp("area", position=(0.0, 0.0, 2.0), size_x=1.0, size_y=1.0, color=(0.0, 0.0, 0.0)))
    b.light(lamp("point"))
    agrees(b, 1 / 9)


# ---- textured emission


def test_textured_emission_is_drawn_where_it_shines():
    pixels = np.zeros((8, 8, 4), np.float32)
    pixels[:, :4, :3] = (1.0, 2.0, 4.0)  # the half x < 0
    color = Color((Term(ONE, (Source("image", texture=0),)),))
    b = floor()
    b.quad("Light", (-1, -1, 1.5), (2, 0, 0), (0, 2, 0), Material("L", (Lobe("emission", color),)))
    scene = b.build()
    scene = scene.__class__(**{**scene.__dict__, "textures": (Texture("T", pixels, "EXTEND", "Closest"),)})
    world = World(scene)
    values, _ = direct_irradiance(world, Emitters(world), at(world, 0.3, 0.1, n=4 * N), 1, np.random.default_rng(1))
    x = -1 + (np.arange(1000) + 0.5) / 1000
    y = -1 + (np.arange(1000) + 0.5) / 500
    d2 = (x[:, None] - 0.3) ** 2 + (y - 0.1) ** 2 + 2.25
    exact = (2.25 / d2**2).mean() * 2 * np.array([1, 2, 4])
    mean, error = values.mean(axis=0, dtype=float), values.std(axis=0, dtype=float) / math.sqrt(4 * N)
    assert (error < 0.003 * exact).all() and (np.abs(mean - exact) < Z * error + 1e-5).all()


def test_light_points_of_a_picture_lie_where_it_shines():
    """One bright texel of 256: nearly every light point hits it, and the mean is what uniform points would give."""
    pixels = np.zeros((16, 16, 4), np.float32)
    pixels[5, 9, :3] = 256.0
    b = floor()
    material = Material("L", (Lobe("emission", Color((Term(ONE, (Source("image", texture=0),)),))),))
    b.quad("Light", (-1, -1, 1.5), (2, 0, 0), (0, 2, 0), material)
    scene = b.build()
    world = World(scene.__class__(**{**scene.__dict__, "textures": (Texture("T", pixels, "EXTEND", "Closest"),)}))
    values, _ = direct_irradiance(world, Emitters(world), at(world, 0.3, 0.1), 1, np.random.default_rng(1))
    x, y = (-1 + (k + (np.arange(200) + 0.5) / 200) / 8 for k in (9, 5))
    exact = 256 * (2.25 / ((x[:, None] - 0.3) ** 2 + (y - 0.1) ** 2 + 2.25) ** 2).mean() / 64
    mean, error = values[:, 0].mean(dtype=float), values[:, 0].std(dtype=float) / math.sqrt(N)
    assert error * math.sqrt(N) < 0.8 * exact and abs(mean - exact) < Z * error + 1e-4 * exact


# ---- drawn points against met rays

SIZED = {
    "sphere": lamp("point", position=(0.5, 0.2, 1.5), radius=0.6),
    "disk": lamp("point", position=(0.5, 0.2, 1.5), radius=0.6, soft_falloff=True),
    "spot sphere": lamp("spot", position=(0.5, 0.2, 1.5), radius=0.6, spot_angle=1.6, spot_blend=0.5),
    "around": lamp("point", position=(0.1, 0.0, 0.3), radius=1.0),
    "rectangle": lamp("area", position=(0.5, 0.2, 1.5), size_x=1.5, size_y=0.7, spread=2.0),
    "narrow": lamp("area", position=(0.5, 0.2, 1.5), size_x=1.5, size_y=0.7, shape="ELLIPSE", spread=0.8),
    "ellipse": lamp("area", position=(0.5, 0.2, 1.5), size_x=1.5, size_y=0.7, shape="ELLIPSE"),
    "sun": lamp("sun", angle=1.2, axis_z=(0.6, 0.0, 0.8)),
}


def lone(light):
    """World and emitters of one lamp over a floor, and the origin of rays."""
    b = floor()
    b.light(light)
    world = World(b.build())
    return world, Emitters(world), np.array([0, 0, 0], float) - world.center


@pytest.mark.parametrize("name", SIZED)
def test_rays_meet_what_is_drawn(name):
    """Density, radiance and distance of drawn points are those of rays sent along their directions."""
    _, emitters, p = lone(SIZED[name])
    origin = np.repeat(p[:, None], 20_000, axis=1).astype(np.float32)
    s = emitters.draw(origin, np.random.default_rng(2).random((3, 20_000), np.float32))
    assert np.allclose((s.wi**2).sum(axis=0), 1, atol=1e-5) and not s.delta.any() and (s.pdf_w > 0).all()
    beyond = np.where(s.distance > 1e20, np.inf, s.distance * 1.001).astype(np.float32)
    met = list(emitters.lamps.seen(origin, s.wi, beyond, emitters.sized))
    assert len(met) == 1
    _, (rows, radiance, pdf) = met[0]
    # The very rim is missed by rounding; a narrow lamp is dark in the corners of the window that is drawn from.
    assert len(rows) > 0.995 * (s.radiance[0] > 0).sum() and (name == "narrow" or len(rows) > 19_900)
    # A factor of the cosine at the rim of a sphere is ill conditioned: compare medians and 99 %.
    for a, b in ((pdf, s.pdf_w[rows]), (radiance[0], s.radiance[0, rows])):
        assert np.quantile(np.abs(a - b) / np.abs(b).max(), 0.99) < 1e-3
    if name != "sun":
        nearer = list(emitters.lamps.seen(origin, s.wi, (s.distance * 0.999).astype(np.float32), emitters.sized))
        assert sum(len(seen.rows) for _, seen in nearer) < 0.01 * 20_000


@pytest.mark.parametrize("name", SIZED)
def test_drawn_directions_have_their_density(name):
    """Chi-square of directions over equal cells of the sphere, expected counts by summing the density that rays report."""
    _, emitters, p = lone(SIZED[name])
    n, rows, columns_ = 40_000, 40, 80
    origin = np.repeat(p[:, None], n, axis=1).astype(np.float32)
    drawn = emitters.draw(origin, np.random.default_rng(3).random((3, n), np.float32))
    w = drawn.wi[:, drawn.radiance[0] > 0]
    assert w.shape[1] == n or name in ("narrow", "spot sphere")
    z, phi = w[2].astype(float), np.arctan2(w[1], w[0]) / (2 * PI) % 1
    cells = np.clip((0.5 + 0.5 * z) * rows, 0, rows - 1).astype(int) * columns_ + np.clip(phi * columns_, 0, columns_ - 1).astype(int)
    fine = 24
    zs = 2 * (np.arange(rows * fine) + 0.5) / (rows * fine) - 1
    phis = 2 * PI * (np.arange(columns_ * fine) + 0.5) / (columns_ * fine)
    expected = np.zeros((rows * fine, len(phis)))
    for i, c in enumerate(zs):
        r = math.sqrt(1 - c * c)
        d = np.stack([r * np.cos(phis), r * np.sin(phis), np.full(len(phis), c)]).astype(np.float32)
        o = np.repeat(p[:, None], len(phis), axis=1).astype(np.float32)
        for _, seen in emitters.lamps.seen(o, d, np.full(len(phis), np.inf, np.float32), emitters.sized):
            expected[i, seen.rows] += seen.pdf_w
    expected = expected.reshape(rows, fine, columns_, fine).mean(axis=(1, 3)).ravel() * 4 * PI / (rows * columns_)
    assert abs(expected.sum() - w.shape[1] / n) < 5e-3 + Z * 0.5 / math.sqrt(n)
    counts = np.bincount(cells, minlength=rows * columns_)
    many = expected * n >= 10
    # Cells on the rim are known to 1 / fine only; each gets that uncertainty besides its Poisson variance.
    inner = np.abs(counts - expected * n) / np.sqrt(expected * n + (expected * n / fine) ** 2 + 1e-12)
    assert counts[expected == 0].sum() < 0.005 * n  # slivers of the rim that the sum steps over
    assert many.sum() >= 20 and (inner[many] ** 2).mean() < 1.6 and inner[many].max() < 5.5


def test_mesh_density_is_the_same_from_both_sides():
    b = floor()
    b.quad("Light", (-0.5, -0.5, 1), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
    b.light(lamp("point"))
    world = World(b.build())
    emitters, n = Emitters(world), 5000
    origin = world.leave(at(world, 0.6, 0.3, n=n))
    s = emitters.draw(columns(origin), np.random.default_rng(4).random((3, n), np.float32))
    assert 0.1 < s.delta.mean() < 0.9 and (s.radiance[:, ~s.delta] == 1).all()
    mesh = np.flatnonzero(~s.delta)
    wi = np.ascontiguousarray(s.wi.T[mesh])
    assert not world.occluded(origin[mesh], wi, s.distance[mesh], RayKind.SHADOW).any()
    hit = world.intersect(origin[mesh], wi, RayKind.CAMERA)
    assert (hit[0] >= 2).all()
    assert np.allclose(emitters.pdf_met(hit, columns(wi), columns(origin[mesh])), s.pdf_w[mesh], rtol=1e-3)


def test_light_points_and_rays_alone_agree_with_both_joined():
    """Each technique alone is unbiased, so the weights, not luck, make the sum right."""
    b = floor()
    b.quad("Light", (-0.5, -0.5, 0.5), (0, 1, 0), (1, 0, 0), diffuse("L", 0.0, 1.0))
    world = World(b.build())
    emitters, faces = Emitters(world), Faces(world)
    s = at(world, 0.4, 0.1)
    origin, n = columns(world.leave(s)), columns(s.ng)
    rng = np.random.default_rng(5)
    alone = np.zeros((3, N), np.float32)
    rows, values, _ = direct.from_lights(world, emitters, origin, rng.random((3, N), np.float32), direct.irradiance(n, n), joined=False)
    alone[:, rows] = values
    exact = PI * (corner(0.9, 0.6, 0.5) + corner(0.9, 0.4, 0.5) + corner(0.1, 0.6, 0.5) + corner(0.1, 0.4, 0.5))
    assert abs(alone[0].mean(dtype=float) - exact) < Z * alone[0].std() / math.sqrt(N)
    assert faces.emits[2:4].all() and not faces.emits[-1]


def test_rays_see_lamps_up_to_the_surface():
    b = floor()
    b.light(lamp("point", position=(0.0, 0.0, 1.0), radius=0.5, color=(PI / 4, 0.0, 0.0)))  # radiance 1
    b.light(lamp("area", position=(0.0, 0.0, 3.0), size_x=1.0, size_y=1.0, color=(0.0, 1.0, 0.0)))
    b.light(lamp("point", position=(0.0, 0.0, 0.5)))  # without size: never seen
    world = World(b.build())
    emitters = Emitters(world)
    origin = (np.zeros((4, 3)) - world.center).astype(np.float32)
    up = np.array([[0, 0, 1]] * 3 + [[1, 0, 0]], np.float32)
    seen = emitters.along(origin, up, np.array([np.inf, 2.0, 0.4, np.inf], np.float32))
    assert np.allclose(seen, [[1, 1, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]], atol=1e-5)


def test_many_lamps_are_left_to_light_points():
    b = floor()
    for i in range(MOST_LAMPS + 4):
        b.light(lamp("area", position=(0.05 * i, 0.0, 2.0), size_x=1.0, size_y=1.0))
    world = World(b.build())
    assert len(Emitters(world).shared) == 0
    exact = 0.0
    for i in range(MOST_LAMPS + 4):
        c = 0.05 * i
        exact += PI * 2 * (corner(0.5 + c, 0.5, 2) + math.copysign(corner(abs(0.5 - c), 0.5, 2), 0.5 - c))
    agrees(b, exact)


def test_far_from_the_origin():
    b = SceneBuilder()
    far = np.array([1e6, -2e6, 5e5])
    b.quad("Floor", far - (2, 2, 0), (4, 0, 0), (0, 4, 0), diffuse("Grey", 0.5))
    b.light(lamp("area", position=tuple(far + (0, 0, 3)), size_x=2.0, size_y=1.0))
    agrees(b, PI * 4 * corner(1, 0.5, 3))
