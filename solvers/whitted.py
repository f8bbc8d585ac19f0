"""Recursive ray tracing (Whitted 1980; review, section 5.1, Eq. 9).

Gathering, deterministic. The light elements of Eq. 6, seen through shadow rays, and one ray along the mirror direction, whose
radiance is found by the same equation:

    Lo(x) = Le(x) + rho_a L_a + rho_s(x) Lo(y) + sum_j fr(x) Le(j) cos theta(j) dw(j)                        (9, with Le)

Glass sends a second ray through the surface; Fresnel's equations share the light between the two. Both are traced, so the tree of
rays is the same every time. It is cut off at a depth and where a branch carries little.

T. Whitted, "An Improved Illumination Model for Shaded Display", CACM 23(6), 1980, 343-349.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.errors import Notice, SceneError
from ..adjoint_gi.core.base.parallel import thread_count
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf import mirrors
from ..adjoint_gi.core.bsdf import table as bsdf
from ..adjoint_gi.core.bsdf.lobes import ALL_LOBES, DIFFUSE, LOBE_KINDS, LOBES, REFRACTING, SHINING
from ..adjoint_gi.core.lights.direct import INF, Hit, from_hits
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.lights.light_points import LightPoints, background_notices, phong_lobe
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, GATHERING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.sampling.maps import columns
from ..adjoint_gi.core.scene.arrays import Lobe, RayKind, constant_of
from ..adjoint_gi.core.scene.faces import Faces
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks import unmet_lamps
from ..adjoint_gi.core.walks.gathering import Run
from ..adjoint_gi.core.walks.paths import Gathered

FRONT = 1 << 14  # rays that are followed at once
MANY_DOUBLINGS = 8  # glass surfaces after which rays that are all followed are very many

ROUGH = (
    ("highlights", "Highlights", "Rough surfaces reflect only the lights, by the BRDF in Eq. 9; rough glass is taken as clear"),
    ("phong", "Phong Highlights", "The same, by cos^n alpha of Eq. 8 times the cosine of incidence, n = (2 / r^4 - 2) / 4"),
    ("mirrors", "Mirrors", "Rough lobes are taken as perfectly smooth: sharp reflections"),
    ("refuse", "Refuse", "Stop with the name of the material"),
)


@dataclass(frozen=True)
class WhittedSettings(base.Settings):
    """Settings of recursive ray tracing."""

    depth: int = setting(8, "Depth", "Mirrors and glass surfaces that a ray may meet one after another", min=0, max=256, soft_max=32)
    contribution: float = setting(
        0.002,
        "Contribution Limit",
        "Rays whose light would reach the receiver weaker than this share are not followed; 0 follows all down to the depth",
        min=0.0,
        max=1.0,
    )
    ambient: float = common.ambient_radiance("all diffuse")
    ambient_color: tuple = common.ambient_color()
    light_points: int = common.light_points(16)
    rough: str = setting("highlights", "Rough Lobes", "What happens to lobes that are not perfectly smooth", choices=ROUGH)


@register
class Whitted(Solver):
    """Follows the tree of mirror and refracted rays of every receiver point, level by level."""

    spec = MethodSpec(
        id="whitted",
        number=2,
        label="Recursive Ray Tracing",
        strategies=GATHERING,
        natures=DETERMINISTIC,
        year=1980,
        authors="T. Whitted",
        title="An Improved Illumination Model for Shaded Display",
        equation="Lo(x) = Le + rho_a L_a + rho_s Lo(y) + sum_j fr Le(j) cos theta(j) dw(j)  (9, with Le)",
        section="5.1",
        idea="Besides the lights, a surface gathers from one more direction: the mirror's, and beyond glass the refracted one.",
        lobes=ALL_LOBES,
        limits=lines("""
            No diffuse interreflection: it is one constant, the ambient radiance
            No caustics: light that reaches a diffuse surface via mirrors or through glass is not found; glass casts full shadows
            Rough lobes reflect lights only, or are taken as mirrors, or refused, by setting
            Fresnel's equations for unpolarised light at every surface: a pane passes up to 4 percent too little at grazing angles
            Soft shadows are made of one hard shadow per light point
            Light of the world is seen in mirrors and through glass, and arrives on other surfaces only through the ambient radiance
        """),
        leaves_out="diffuse interreflection and caustics",
    )
    Settings = WhittedSettings

    def memory(self, world: World, receivers: Receivers, settings: WhittedSettings) -> int:
        """Sums and one copy of the result; the fronts of rays that wait at every depth in every thread."""
        table = bsdf.BsdfTable(world.scene)
        waiting = FRONT * (1 + 2 * table.count * settings.depth)
        return receivers.count * 400 + thread_count() * waiting * 64

    def solve(self, world: World, receivers: Receivers, settings: WhittedSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every few batches of receivers. Raises SceneError for rough lobes where they are refused."""
        emitters = Emitters(world)
        tracer = MirrorTracer(world, emitters, settings)
        notices = rough_notices(world, settings.rough) + unmet_lamps.notices(
            emitters, sized=True, measure=receivers.measure, longest=settings.max_length
        )
        notices += background_notices(emitters, settings.ambient)
        batch, doubling = guarded(tracer, self.spec.label)
        # Lo = Le + lights + ambient + mirrored and refracted rays (Eq. 9), at every receiver's fixed points.
        yield from Run(self.spec, world, receivers, settings, emitters, notices + doubling).fixed_points(tracer.estimate, batch)


def guarded(tracer: MirrorTracer, label: str) -> tuple[int, tuple[Notice, ...]]:
    """Receiver points in a batch, and a notice where all rays are followed over many glass surfaces, each of which doubles them.

    Few points at a time keep the steps short then, as far as that goes.
    """
    s, batch = tracer.settings, tracer.points.batch
    deepest = min(s.depth, s.max_length)
    if s.contribution > 0 or deepest <= MANY_DOUBLINGS or not tracer.splits:
        return batch, ()
    reason = f"every ray is followed over up to {deepest} glass surfaces, each of which doubles the rays"
    notice = Notice(label, reason, "Raise contribution above 0 or lower depth if it takes too long")
    return max(1, min(batch, (1 << 20) >> min(deepest, 20))), (notice,)


def rough_notices(world: World, rough: str) -> tuple[Notice, ...]:
    """One notice for each material in use with a lobe that is not solved as it is; raises SceneError where `rough` is "refuse"."""
    out = []
    used = dict.fromkeys(world.scene.materials[index] for index in np.unique(world.scene.material))
    for material in used:
        kinds = sorted({x.kind for x in material.lobes if not x.is_black and _is_rough(x)})
        if not kinds:
            continue
        name, what = f"Material {material.name}", ", ".join(kinds)
        if rough == "refuse":
            raise SceneError(
                name, f"its {what} lobe is rough, which recursive ray tracing does not solve", "Set roughness to 0 or allow it"
            )
        how = "as perfectly smooth" if rough == "mirrors" else "to reflect lights only, and light to pass straight"
        out.append(Notice(name, f"rough {what} taken {how} by this method", "Choose a method that handles it, or accept the substitute"))
    return tuple(out)


def _is_rough(lobe: Lobe) -> bool:
    """Whether a lobe would be followed by rays if it were smooth."""
    kind = LOBES[LOBE_KINDS.get(lobe.kind, DIFFUSE)]
    return (kind.reflects or kind.passes) and (lobe.varies or constant_of(lobe.roughness) ** 2 >= kind.delta_below)


@dataclass(frozen=True, eq=False)
class Front:
    """Rays under way: the receiver point (m,) that each is for, origin, wi and weight (m, 3), and their `RayKind` (m,)."""

    row: np.ndarray
    origin: np.ndarray
    wi: np.ndarray
    weight: np.ndarray
    kind: np.ndarray

    def take(self, which: np.ndarray | slice) -> Front:
        """Some of the rays."""
        return Front(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


class MirrorTracer:
    """Eq. 9 in a world."""

    def __init__(self, world: World, emitters: Emitters, settings: WhittedSettings) -> None:
        self.world, self.emitters, self.settings = world, emitters, settings
        self.points, self.faces = LightPoints(emitters, settings.light_points), Faces(world)
        self.table = bsdf.BsdfTable(world.scene)

    @property
    def splits(self) -> bool:
        """Whether any surface both reflects and passes rays."""
        kinds = (LOBES[LOBE_KINDS.get(x.kind, DIFFUSE)] for m in self.world.scene.materials for x in m.lobes if not x.is_black)
        return any(kind.reflects and kind.passes for kind in kinds)

    def estimate(self, surface: Surface, wo: np.ndarray | None, _: np.random.Generator) -> Gathered:
        """Radiance towards `wo` (n, 3), or irradiance where it is None."""
        s, n = self.settings, len(surface.triangle)
        direct, indirect = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        if wo is None:
            rays = 0
            if s.min_length <= 1 <= s.max_length:
                direct, rays = self.points.irradiance(self.world, surface)
            if s.max_length >= 2:
                indirect += np.float32(np.pi) * common.ambient_of(s)
            return Gathered(direct, indirect, rays)

        # Step 1: the visible points themselves. Rows are all different here, so plain addition does.
        front = Front(np.arange(n), np.zeros((n, 0), np.float32), -wo, np.ones((n, 3), np.float32), np.full(n, RayKind.CAMERA))
        lit, ambient, nexts, rays = self._shade(surface, front, 1)
        direct += lit
        indirect += ambient
        # Step 2: the tree of rays, the deepest front first, so that few wait.
        waiting = [(1, f) for f in nexts]
        while waiting:
            depth, front = waiting.pop()
            if len(front.row) > FRONT:
                waiting += [(depth, front.take(slice(a, a + FRONT))) for a in range(0, len(front.row), FRONT)]
                continue
            found, reflected, nexts, behind, cast = self._follow(front, depth)
            rays += cast
            waiting += [(depth, f) for f in behind]
            # What the ray meets has path length `depth`; what the surface there reflects has one more.
            _add(direct if depth == 1 else indirect, front.row, found)
            _add(indirect, front.row, reflected)
            waiting += [(depth + 1, f) for f in nexts]
        return Gathered(direct, indirect, rays)

    def _follow(self, front: Front, depth: int) -> tuple[np.ndarray, np.ndarray, list[Front], list[Front], int]:
        """One step of rays that make paths of length `depth`: emission met and light reflected, (m, 3) each, new rays, the same rays behind
        surfaces that let them straight through, rays cast."""
        s = self.settings
        triangle, u, v, t = met = self.world.intersect(front.origin, front.wi, front.kind)
        found, reflected = np.zeros_like(front.weight), np.zeros_like(front.weight)
        if s.min_length <= depth <= s.max_length:
            # Le(y), seen in mirrors and through glass: the light points stand only for the other lobes.
            all_of_it = np.full(len(t), INF)
            for rows, value in from_hits(self.emitters, self.faces, columns(front.origin), columns(front.wi), met, all_of_it):
                found[rows] += value.T
            found *= front.weight
        hit = np.flatnonzero(triangle >= 0)
        behind = self._behind(front, met)
        if not len(hit) or depth >= s.max_length:
            return found, reflected, [], behind, len(triangle)
        # What the surface there reflects, by the same equation.
        surface = self.world.surface(triangle[hit], u[hit], v[hit], -front.wi[hit])
        lit, ambient, nexts, rays = self._shade(surface, front.take(hit), depth + 1)
        reflected[hit] = lit + ambient
        return found, reflected, nexts, behind, len(triangle) + rays

    def _behind(self, front: Front, met: Hit) -> list[Front]:
        """What goes straight on through the surfaces that rays have met, which is neither a mirror nor a segment of its own."""
        passing = self.world.passing
        rows = np.flatnonzero(passing.lets[met[0]]) if passing is not None else np.zeros(0, np.int64)
        if not len(rows):
            return []
        at = tuple(a[rows] for a in met[:3])
        some = front.take(rows)
        weight = some.weight * passing.through(*at)
        strength = weight.max(axis=1)
        keep = np.flatnonzero((strength > 0) & (strength >= self.settings.contribution))
        surface = self.world.surface(*at, -some.wi).take(keep)
        origin = np.ascontiguousarray(self.world.leave(surface, np.ones(len(keep), bool)))
        return [replace(some.take(keep), origin=origin, weight=weight[keep])] if len(keep) else []

    def _shade(self, surface: Surface, front: Front, length: int) -> tuple[np.ndarray, np.ndarray, list[Front], int]:
        """Eq. 9 where rays hit: light of the light elements and ambient light, both (m, 3) and weighted, the next rays, rays cast.

        `length` is the path length of light that reaches the surface directly.
        """
        s = self.settings
        lobes = self.table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, -front.wi)
        mirror = self._mirrors(lobes)
        rest = lobes.without(mirror)
        lit, ambient = np.zeros_like(front.weight), np.zeros_like(front.weight)
        rays = 0
        # sum_j fr(x) Le(j) cos theta(j) dw(j).
        if s.min_length <= length <= s.max_length:
            # Purely diffuse points, most of all, are done together and at less cost.
            shiny = rest.others()
            if self.table.any_coat:
                shiny |= rest.coat().any(axis=1)
            for which, sum_up in ((~shiny & (rest.diffuse.max(axis=1) > 0), self._diffuse), (shiny, self._shiny)):
                able = np.flatnonzero(which)
                if len(able):
                    lit[able], cast = sum_up(surface.take(able), rest.take(able))
                    rays += cast
            lit *= front.weight
        # rho_a L_a.
        if s.ambient > 0 and length < s.max_length:
            ambient = common.ambient_of(s) * front.weight * _ambient_reflectance(rest)
        # rho_s(x) Lo(y): the rays that go on to the points y.
        nexts = []
        if length <= s.depth and length <= s.max_length:
            for branch in mirrors.branches(lobes, mirror):
                nexts.append(self._leave(surface, front, branch))
        nexts = [f for f in nexts if len(f.row)]
        # Small fronts cost as much as large ones: all branches go on together.
        return lit, ambient, [_join(nexts)] if nexts else [], rays

    def _mirrors(self, lobes: bsdf.Lobes) -> tuple[np.ndarray, ...]:
        """For each slot where it is followed by rays, (n,) bool."""
        if self.settings.rough == "mirrors":
            return tuple(SHINING[x.kind] for x in lobes.slots)
        return tuple((x.kind > 0) & (x.delta | REFRACTING[x.kind]) for x in lobes.slots)

    def _diffuse(self, surface: Surface, lobes: bsdf.Lobes) -> tuple[np.ndarray, int]:
        """The sum over the light elements at diffuse points, (n, 3), and the shadow rays cast."""
        total, rays = self.points.irradiance(self.world, surface)
        return total * lobes.diffuse / np.float32(np.pi), rays

    def _shiny(self, surface: Surface, lobes: bsdf.Lobes) -> tuple[np.ndarray, int]:
        """The same for any lobes."""
        out = np.zeros((len(surface.triangle), 3), np.float32)
        rays = 0
        phong = self.settings.rough == "phong"
        base_lobes = lobes.without(tuple(SHINING[x.kind] for x in lobes.slots)) if phong else lobes
        p = bsdf.weights(base_lobes)
        for wi, cosine, radiance, weight, cast in self.points.at(self.world, surface, True):
            rays += cast
            lit = np.flatnonzero(weight > 0)
            if len(lit):
                value, _ = bsdf.evaluate(base_lobes.take(lit), wi[lit], p[:, lit])
                if phong:
                    value += phong_lobe(lobes.take(lit), wi[lit]) * cosine[lit, None]
                out[lit] += value * radiance[lit] * weight[lit, None]
        return out, rays

    def _leave(self, surface: Surface, front: Front, branch: mirrors.Branch) -> Front:
        """The rays of a branch that carry enough and leave on the right side of the surface."""
        rows = branch.rows
        weight = front.weight[rows] * branch.weight
        side = np.float32(-1 if branch.through else 1)
        above = np.einsum("ij,ij->i", branch.wi, surface.ng[rows]) * side > 0
        strength = weight.max(axis=1)
        keep = np.flatnonzero(above & (strength > 0) & (strength >= self.settings.contribution))
        rows = rows[keep]
        kind = np.full(len(rows), RayKind.TRANSMISSION if branch.through else RayKind.GLOSSY)
        origin = self.world.leave(surface.take(rows), np.full(len(rows), branch.through))
        return Front(front.row[rows], np.ascontiguousarray(origin), np.ascontiguousarray(branch.wi[keep]), weight[keep], kind)


def _ambient_reflectance(lobes: bsdf.Lobes) -> np.ndarray:
    """(n, 3) average reflectance rho_a of the lobes that are not followed by rays."""
    out = lobes.diffuse * (1 - lobes.coat())
    albedo = [np.where(slot.kind[:, None] > 0, slot.color, np.float32(0)) for slot in lobes.slots]
    for i, rows, partial in lobes.albedos():
        albedo[i][rows] = partial
    for slot, part in zip(lobes.slots, albedo, strict=True):
        out = out + part * slot.weight[:, None]
    return out


def _join(fronts: list[Front]) -> Front:
    return fronts[0] if len(fronts) == 1 else Front(*(np.concatenate([getattr(f, n) for f in fronts]) for n in Front.__dataclass_fields__))


def _add(out: np.ndarray, rows: np.ndarray, value: np.ndarray) -> None:
    """Add `value` (m, 3) to `rows` (m,) of `out`; rows may come more than once."""
    for c in range(3):
        out[:, c] += np.bincount(rows, value[:, c], len(out)).astype(np.float32)
