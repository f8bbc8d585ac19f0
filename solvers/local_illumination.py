"""Local illumination (Bouknight 1970, Phong 1975, Cook and Torrance 1982; review, section 5.1, Eq. 6 to 8).

Gathering, deterministic. The hemisphere's integral is replaced by a sum over the light sources, each a few differential elements,
and one uniform ambient radiance L_a stands for all interreflection:

    Lo = Le + rho_a L_a + sum_j fr Le(j) cos theta(j) dw(j)                                                            (6)
    Bouknight   rho_a L_a + k_d sum_j Le(j) cos theta(j)                                                              (7)
    Phong       rho_a L_a + sum_j Le(j) [k_d cos theta(j) + k_s cos^n alpha(j)]                                       (8)
    Cook et al. rho_a L_a + sum_j Le(j) [k_d + k_s cos^n alpha(j)] cos theta(j) dw(j)
    1982        rho_a L_a + sum_j Le(j) [k_d + Rs] cos theta(j) dw(j)

The third line is how the review writes Cook and Torrance's model, with Phong's lobe for the highlight: here "Phong times cosine". The
fourth has the Rs of their paper: distribution, masking and Fresnel term (`core.bsdf.cook_torrance`).

In watts, the diffuse term of (7) and (8) is k_d / pi times the irradiance of the element, and the lobe cos^n alpha is scaled by
(n + 2) / 2 pi, so that k_s is the share of light it reflects at normal incidence. Roughness r maps to n = (2 / r^4 - 2) / 4.

W. J. Bouknight, CACM 13(9), 1970. B. T. Phong, CACM 18(6), 1975. R. L. Cook, K. E. Torrance, ACM TOG 1(1), 1982.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..adjoint_gi.core.base import settings as base
from ..adjoint_gi.core.base.settings import setting
from ..adjoint_gi.core.bsdf.cook_torrance import coat_curve, cook_torrance, reflected_base
from ..adjoint_gi.core.bsdf.table import BsdfTable
from ..adjoint_gi.core.lights.emitters import Emitters
from ..adjoint_gi.core.lights.light_points import LightPoints, background_notices, phong_lobe
from ..adjoint_gi.core.method import common_settings as common
from ..adjoint_gi.core.method.registry import DETERMINISTIC, GATHERING, MethodSpec, Solver, lines, register
from ..adjoint_gi.core.method.solution import Step
from ..adjoint_gi.core.receivers.base import Receivers
from ..adjoint_gi.core.scene.world import Surface, World
from ..adjoint_gi.core.walks.gathering import Run
from ..adjoint_gi.core.walks.paths import Gathered

MODELS = (
    ("bouknight", "Bouknight 1970", "Diffuse reflection only, Eq. 7"),
    ("phong", "Phong 1975", "Adds a highlight around the mirror direction, without the cosine of incidence, Eq. 8"),
    ("cook", "Phong times Cosine", "The form that the review gives for Cook et al.: Phong's highlight times the cosine of incidence"),
    ("cook_torrance", "Cook and Torrance 1982", "Facets by Beckmann's distribution, with their masking and Fresnel's equations"),
)


@dataclass(frozen=True)
class LocalSettings(base.Settings):
    """Settings of local illumination."""

    model: str = setting("cook", "Model", "Which reflection model shades the surfaces", choices=MODELS)
    ambient: float = common.ambient_radiance("all")
    ambient_color: tuple = common.ambient_color()
    shadows: bool = setting(True, "Shadows", "Occluded light points contribute nothing")
    light_points: int = common.light_points(16)


@register
class LocalIllumination(Solver):
    """Sums over light elements at every receiver point."""

    spec = MethodSpec(
        id="local_illumination",
        number=1,
        label="Local Illumination",
        strategies=GATHERING,
        natures=DETERMINISTIC,
        year=1970,
        authors="W. J. Bouknight; B. T. Phong; R. L. Cook, K. E. Torrance",
        title="A Procedure for Generation of Three-Dimensional Half-Toned Computer Graphics Presentations",
        equation="Lo = Le + rho_a L_a + sum_j fr Le(j) cos theta(j) dw(j)  (6)",
        section="5.1",
        idea="Only the light sources light a surface, as a few points each; one constant stands for everything else.",
        lobes=frozenset({"diffuse", "emission", "glossy", "metallic", "tinted metallic", "specular"}),
        limits=lines("""
            No interreflection: indirect light is one constant, the ambient radiance
            Soft shadows are made of one hard shadow per light point
            Roughness r maps to the exponent (2 / r^4 - 2) / 4 of a cosine lobe, or to the slope r^2 of facets
            Mirrors and glass reflect only highlights
            In Phong's two models a coat's highlight comes on top of its base, and a white one sends back 1.04 of the light
            Light of the world arrives only through the ambient radiance
        """),
        leaves_out="interreflection",
    )
    Settings = LocalSettings

    def solve(self, world: World, receivers: Receivers, settings: LocalSettings, rng: np.random.Generator) -> Iterator[Step]:
        """Yield after every few batches of receivers."""
        emitters = Emitters(world)
        run = Run(self.spec, world, receivers, settings, emitters, background_notices(emitters, settings.ambient))
        points = LightPoints(emitters, settings.light_points)
        table = BsdfTable(world.scene, self.spec.lobes)
        if settings.model == "cook_torrance":
            table.coats = table.coats.by(coat_curve)

        def estimate(surface: Surface, wo: np.ndarray | None, _: np.random.Generator) -> Gathered:
            return shade(world, points, table, surface, wo, settings)

        # Lo = Le + ambient + lights (Eq. 6), at every receiver's fixed points.
        yield from run.fixed_points(estimate, points.batch)


def shade(world: World, points: LightPoints, table: BsdfTable, surface: Surface, wo: np.ndarray | None, s: LocalSettings) -> Gathered:
    """Eq. 6 to 8 at surface points, Le left out: radiance towards `wo` (n, 3), or irradiance where it is None."""
    direct, indirect = np.zeros((2, len(surface.triangle), 3), np.float32)
    rays = 0
    # sum_j fr Le(j) cos theta(j) dw(j); irradiance is the same without the reflectance.
    if s.min_length <= 1 <= s.max_length and wo is None:
        direct, rays = points.irradiance(world, surface, s.shadows)
    elif s.min_length <= 1 <= s.max_length:
        lobes = table.at(surface.triangle, surface.u, surface.v, surface.ns, surface.side, wo)
        for wi, cosine, radiance, solid_angle, cast in points.at(world, surface, s.shadows):
            rays += cast
            # Bouknight (7) in watts: k_d / pi times the irradiance Le(j) cos theta(j) dw(j), with k_d the albedo.
            received = radiance * (cosine * solid_angle)[:, None]
            base = reflected_base(lobes, wi) if s.model == "cook_torrance" else lobes.diffuse
            direct += received * base / np.float32(np.pi)
            # Phong (8) adds k_s Le(j) cos^n alpha(j), without the cosine of incidence; the others have the cosine here, too.
            if s.model == "phong":
                direct += radiance * solid_angle[:, None] * phong_lobe(lobes, wi)
            elif s.model == "cook":
                direct += received * phong_lobe(lobes, wi)
            elif s.model == "cook_torrance":
                direct += received * cook_torrance(lobes, wi)
    # rho_a L_a.
    if s.max_length >= 2:
        ambient = common.ambient_of(s)
        indirect += ambient * np.float32(np.pi) if wo is None else ambient * world.albedo(surface)
    return Gathered(direct, indirect, rays)
