"""Plants known bugs in a copy of the code, one at a time, and sees that each turns a test red: a check of the tests themselves.

    python tests/plant_bugs.py            all of them, a table at the end
    python tests/plant_bugs.py 3 7        only numbers 3 and 7

Exit code 0 when every planted bug is found. Bugs 1 to 10 are the list of the verification page, section 2.7; the others are ours.
Run it in an environment that has numpy, embreex and pytest, and bpy for the bugs of the bridge, which count as not found without it.
Nothing in the checkout is changed. More than 500 lines because it is one list.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Bug:
    """A bug: in `file`, `right` becomes `wrong`; some test of `tests` must fail."""

    name: str
    file: str
    right: str
    wrong: str
    tests: str


BUGS = (
    Bug(
        "uniform instead of cosine directions",
        "adjoint_gi/core/sampling/maps.py",
        "    w = sphere(u, v)\n    w += normal\n",
        "    w = sphere(u, v)\n    w *= np.copysign(ONE, dot(w, normal))\n    return w, dot(w, normal)\n    w += normal\n",
        "tests/methods/test_path_tracing.py -k two_zone",
    ),
    Bug(
        "cosine squared instead of cosine",
        "adjoint_gi/core/sampling/maps.py",
        "    w = sphere(u, v)\n    w += normal\n",
        "    w = sphere(u, v)\n    w += np.float32(1.5) * normal\n",
        "tests/methods/test_path_tracing.py -k two_zone",
    ),
    Bug(
        "lost 1 / pi",
        "adjoint_gi/core/bsdf/diffuse.py",
        "    return color * (cosine / mf.PI)[:, None]",
        "    return color * cosine[:, None]",
        "tests/core/test_bsdf.py -k albedo",
    ),
    Bug(
        "Eq. 13 with F(ji)",
        "adjoint_gi/core/radiosity/transports.py",
        "        return arrived / self.area[:, None], escaped\n\n\nclass RayTransport",
        "        return arrived / self.area[index].mean(), escaped\n\n\nclass RayTransport",
        "tests/core/test_transports.py",
    ),
    Bug(
        "dropped reciprocity",
        "adjoint_gi/core/radiosity/transports.py",
        "        return product(self.factors.swapaxes(-1, -2), self.area[:, None] * y) / self.area[:, None]",
        "        return product(self.factors.swapaxes(-1, -2), y)",
        "tests/core/test_transports.py",
    ),
    Bug(
        "double-counted emission",
        "adjoint_gi/core/lights/direct.py",
        "            radiance *= sampling.power_heuristic(",
        "            sampling.power_heuristic(",
        "tests/methods/test_path_tracing.py -k furnace",
    ),
    Bug(
        "roulette without weight",
        "adjoint_gi/core/walks/paths.py",
        "weight.take(survive, axis=1) / chance\n",
        "weight.take(survive, axis=1)\n",
        "tests/methods/test_path_tracing.py -k furnace",
    ),
    Bug(
        "flipped normals",
        "adjoint_gi/core/scene/world.py",
        "np.float32(-1), np.float32(1))\n            ng = ng * side[:, None]",
        "np.float32(1), np.float32(-1))\n            ng = ng * side[:, None]",
        "tests/methods/test_particle_tracing.py -x",
    ),
    Bug(
        "float32 sums",
        "adjoint_gi/core/radiosity/southwell.py",
        "            self.absorbed += (area * (1 - rho) * light).sum(axis=0)",
        "            self.absorbed += np.float32((area * (1 - rho) * light).sum(axis=0))",
        "tests/methods/test_progressive_radiosity.py",
    ),
    Bug(
        "lost last bounce",
        "adjoint_gi/core/walks/paths.py",
        "        if self.length == walk.longest:",
        "        if self.length == walk.longest - 1:",
        "tests/methods/test_path_tracing.py -k partial",
    ),
    Bug(
        "index of refraction not turned over inside",
        "adjoint_gi/core/bsdf/lobe.py",
        "        return np.where(self.entering, self.ior, 1 / self.ior).astype(np.float32)",
        "        return self.ior",
        "tests/core/test_bsdf.py -k total",
    ),
    Bug(
        "margin bleeds across charts",
        "adjoint_gi/core/receivers/margin.py",
        "        nearer = np.where(at - a <= b - at, a, b)",
        "        nearer = a",
        "tests/core/test_margin.py",
    ),
    Bug(
        "ray offset does not grow with the scene",
        "adjoint_gi/core/scene/world.py",
        "        self.offset = clearance(corners[:, 0], e1, e2, normal)",
        "        self.offset = np.full(len(e1), 1e-9, np.float32)",
        "tests/methods/test_path_tracing.py -k furnace",
    ),
    Bug(
        "texels half a texel off",
        "adjoint_gi/core/receivers/texels.py",
        "additive(np.arange(subsamples), STEPS[2], 0.5)",
        "additive(np.arange(subsamples), STEPS[2], 0.0)",
        "tests/core/test_lightmap.py",
    ),
    Bug(
        "bounces between microfacets given back by the view's angle alone",
        "adjoint_gi/core/bsdf/multiscatter.py",
        "        return self.at(row, inside, wo[:, 2]) * self.at(row, inside ^ (wi[:, 2] < 0), wi[:, 2]) - 1",
        "        return self.at(row, inside, wo[:, 2]) ** 2 - 1",
        "tests/core/test_bsdf.py -k reciprocal",
    ),
    Bug(
        "a coat does not dim a rough diffuse lobe",
        "adjoint_gi/core/bsdf/table.py",
        "        if kind.under_coat and below is not None:",
        "        if kind.under_coat and not kind.nearly_diffuse and below is not None:",
        "tests/core/test_bsdf.py -k coat_dims",
    ),
    Bug(
        "elements always keep what bounces again between rough diffuse facets",
        "adjoint_gi/core/bsdf/oren_nayar.py",
        "        return [color, many * color * kept(",
        "        return [color, color * kept(",
        "tests/core/test_bsdf.py -k factors",
    ),
    Bug(
        "rough diffuse surfaces cast glossy rays",
        "adjoint_gi/core/bsdf/oren_nayar.py",
        "    ray_kind = RayKind.DIFFUSE",
        "    ray_kind = RayKind.GLOSSY",
        "tests/core/test_world.py -k cast_every",
    ),
    Bug(
        "caustics counted at every path length",
        "adjoint_gi/core/two_pass/caustics.py",
        "self.unmet[window[0] : window[1] + 1].sum(axis=0)",
        "self.unmet.sum(axis=0)",
        "tests/methods/test_multi_pass.py -k caustics",
    ),
    Bug(
        "time in which a step is held counts while sampling",
        "adjoint_gi/core/walks/gathering.py",
        "yield from self.clock.pause(Step(done / total, text, self.solution))",
        "yield Step(done / total, text, self.solution)",
        "tests/methods/test_seconds.py",
    ),
    Bug(
        "light of shadowless lamps left to rays that walls stop",
        "adjoint_gi/core/lights/emitters.py",
        "(self.lamps.large & self.lamps.shadow)[self.sized]",
        "self.lamps.large[self.sized]",
        "tests/core/test_emitters.py -k behind_a_wall",
    ),
    Bug(
        "unshot light of refined sides as even as before",
        "adjoint_gi/core/radiosity/southwell.py",
        "        new.unshot[1:] *= factor\n",
        "",
        "tests/core/test_southwell.py",
    ),
    Bug(
        "rotation gradient of the wrong sign",
        "adjoint_gi/core/walks/irradiance_records.py",
        "    v = np.stack([-np.sin(middle), np.cos(middle)])",
        "    v = np.stack([np.sin(middle), -np.cos(middle)])",
        "tests/methods/test_irradiance_cache.py -k rotation",
    ),
    Bug(
        "direct light of the cache without its seed",
        "adjoint_gi/core/walks/gathering.py",
        "default_rng([*seed, 11, index])",
        "default_rng([11, index])",
        "tests/methods/test_irradiance_cache.py -k seed",
    ),
    Bug(
        "lobes do not weigh what their weight says",
        "adjoint_gi/core/bsdf/table.py",
        "        value[rows] += f * lobes.slots[i].weight[rows, None]",
        "        value[rows] += f",
        "tests/core/test_mixes.py -k shares",
    ),
    Bug(
        "a coat dims the bases of other nodes, too",
        "adjoint_gi/core/bsdf/coat.py",
        "            below.append(sum((c for s, c in others if s == stack), Color()))",
        "            below.append(sum((c for s, c in others), Color()))",
        "tests/core/test_mixes.py -k own_base",
    ),
    Bug(
        "elements pair no coats and bases",
        "adjoint_gi/core/directional/scattering.py",
        "            dims.append(-dim)",
        "            dims.append(-np.ones_like(dim))",
        "tests/core/test_mixes.py -k pair_coats",
    ),
    Bug(
        "black metal is dropped",
        "adjoint_gi/core/scene/arrays.py",
        "(self.color.is_black and self.kind not in WHITE_AT_GRAZING)",
        "self.color.is_black",
        "tests/core/test_mixes.py -k black",
    ),
    Bug(
        "index squared on the wrong side in direction bins",
        "adjoint_gi/core/directional/scattering.py",
        "measure = np.array([1.0, ior * ior if lobe.refracts else 1.0])",
        "measure = np.array([ior * ior if lobe.refracts else 1.0, 1.0])",
        "tests/core/test_mixes.py -k basic_radiance",
    ),
    Bug(
        "Cook and Torrance without masking",
        "adjoint_gi/core/bsdf/cook_torrance.py",
        "scale = lobes.slots[i].weight[rows] * d * g /",
        "scale = lobes.slots[i].weight[rows] * d /",
        "tests/methods/test_local_illumination.py -k mask",
    ),
    Bug(
        "white rooms cut after 64 segments",
        "adjoint_gi/core/walks/path_limit.py",
        "LONGEST = 4096",
        "LONGEST = 64",
        "tests/methods/test_path_limit.py",
    ),
    Bug(
        "shadow rays of coarse smooth meshes start on their triangles",
        "adjoint_gi/core/lights/direct.py",
        "    if answer.edge is not None:",
        "    if False:",
        "tests/core/test_terminator.py",
    ),
    Bug(
        "rough caustics counted twice",
        "adjoint_gi/core/two_pass/caustics.py",
        "power, met.clear & lamp))",
        "power, np.full(len(met.row), lamp)))",
        "tests/methods/test_multi_pass.py -k rough_mirror",
    ),
    Bug(
        "lamp caustics counted as direct in partial results",
        "solvers/multi_pass.py",
        "self.emitted, self.outside.straight)\n        state.arrive_later(self.outside.caustics.total)",
        "self.emitted, self.outside.straight + self.outside.caustics.total)",
        "tests/methods/test_multi_pass.py -k partial_results",
    ),
    Bug(
        "a sized lamp without shadow joined with bounced rays",
        "adjoint_gi/core/lights/emitters.py",
        "self.sized[(self.lamps.large & self.lamps.shadow)[self.sized]]",
        "self.sized[self.lamps.large[self.sized]]",
        "tests/core/test_emitters.py -k without_shadow",
    ),
    Bug(
        "texture emission taking a cell's mean in particles",
        "adjoint_gi/core/lights/mesh.py",
        "self._emission_at(self.triangle[cell], u, v) * self.full[cell, None])",
        "self.flux[cell])",
        "tests/core/test_emission.py -k finer_than_its_cells",
    ),
    Bug(
        "lamps met behind a pane counted beside their particles",
        "adjoint_gi/core/two_pass/view_pass.py",
        "None if self.unmet is None else ~spread",
        "None",
        "tests/methods/test_multi_pass.py -k through_a_pane",
    ),
    Bug(
        "stated error with n for n - 1 groups",
        "adjoint_gi/core/receivers/film.py",
        "/ (self._groups[known] - 1)",
        "/ self._groups[known]",
        "tests/core/test_said_of_results.py -k group",
    ),
    Bug(
        "elements are silent about a panel that touches them",
        "adjoint_gi/core/elements/closeness.py",
        "distance < CLOSE * width",
        "distance < 0",
        "tests/core/test_said_of_results.py -k panel",
    ),
    Bug(
        "roulette weight lost in chains",
        "adjoint_gi/core/walks/mirror_chains.py",
        "weight[survive] / chance[:, None]",
        "weight[survive]",
        "tests/core/test_first_passes.py -k chains",
    ),
    Bug(
        "known light below min_length 3",
        "adjoint_gi/core/two_pass/known_light.py",
        "for k, h in enumerate(by_length) if 2 <= k < least), np.zeros_like(first))",
        "for k, h in enumerate(by_length) if 2 < k < least), np.zeros_like(first))",
        "tests/core/test_first_passes.py -k known",
    ),
    Bug(
        "ambient estimate ignoring escape",
        "adjoint_gi/core/radiosity/southwell.py",
        "* stays / whole / np.maximum(1 - mean_rho * stays, 1e-3)",
        "/ whole / np.maximum(1 - mean_rho * stays, 1e-3)",
        "tests/core/test_first_passes.py -k ambient",
    ),
    Bug(
        "shadow rays stop at surfaces that let light straight through",
        "adjoint_gi/core/scene/world.py",
        "        if self.passing is None:\n            return self.occluded(origin, direction, distance, kind), None\n",
        "        if kind:\n            return self.occluded(origin, direction, distance, kind), None\n",
        "tests/methods/test_straight_through.py -k tinted_sheet",
    ),
    Bug(
        "what has passed a surface is weighted as if it began there",
        "adjoint_gi/core/scene/world.py",
        '        t[rows] += np.einsum("ij,ij->i", start - origin[rows], d) / np.einsum("ij,ij->i", d, d)\n',
        "",
        "tests/methods/test_straight_through.py -k counted_twice",
    ),
    Bug(
        "light points through rough glass do not know that they look on one side only",
        "adjoint_gi/core/walks/radiance.py",
        "np.where(above, pdf / share, np.float32(0))",
        "np.where(above, pdf, np.float32(0))",
        "tests/methods/test_path_lobes.py -k rough_glass",
    ),
    Bug(
        "rays through rough glass do not know that light points look on one side only",
        "adjoint_gi/core/walks/radiance.py",
        "drawn.pdf_w[go] / light_share(self.lobes)[go]",
        "drawn.pdf_w[go]",
        "tests/methods/test_path_lobes.py -k rough_glass",
    ),
    Bug(
        "importance reaches beyond the far plane by the near one",
        "adjoint_gi/core/flux/detectors.py",
        "depth = self.camera.clip_end - self.camera.clip_start",
        "depth = self.camera.clip_end",
        "tests/core/test_detectors.py -k far_plane",
    ),
    Bug(
        "the error of a flux is that of a batch, not of their mean",
        "adjoint_gi/core/flux/detectors.py",
        "found.std(axis=0, ddof=1) / np.sqrt(batches)",
        "found.std(axis=0, ddof=1)",
        "tests/core/test_detectors.py -k spread_of_repeats",
    ),
    Bug(
        "particles that weigh lightmaps leave large objects by their area",
        "adjoint_gi/core/flux/density.py",
        "world.area[triangle] / np.sqrt(whole[owner])",
        "world.area[triangle]",
        "tests/core/test_density.py -k root_of_its_area",
    ),
    Bug(
        "the noise of a reference is the whole difference of its halves",
        "adjoint_gi/core/comparison/run.py",
        "half = 0.5 * (quantity(found[0])",
        "half = (quantity(found[0])",
        "tests/core/test_comparison.py -k halves_differ",
    ),
    Bug(
        "pictures are exposed for the mean of the colours",
        "adjoint_gi/core/comparison/figures.py",
        "np.asarray(linear).max(axis=-1), 98)",
        "np.asarray(linear).mean(axis=-1), 98)",
        "tests/core/test_figures.py -k brightest",
    ),
    Bug(
        "margins prefer the right texel",
        "adjoint_gi/core/receivers/margin.py",
        "np.where(at - a <= b - at, a, b)",
        "np.where(at - a < b - at, a, b)",
        "tests/core/test_margin.py -k ties",
    ),
    Bug(
        "points about a vertex are scaled by the wrong edge",
        "adjoint_gi/core/receivers/vertices.py",
        "* radius / length2[item]",
        "* radius / length1[item]",
        "tests/core/test_vertices.py -k arcs",
    ),
    Bug(
        "soft lamps light what is nearer than their disk, as the entering flux counts it",
        "adjoint_gi/core/lights/flux.py",
        "(t >= p.dark)",
        "(t >= 0)",
        "tests/core/test_light_flux.py -k soft_lamp",
    ),
    Bug(
        "the remainder of a division has the sign of the divisor",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "math.fmod(a, b) if b else 0.0",
        "a % b if b else 0.0",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "truncated numbers are rounded down",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "float(math.trunc(a))",
        "float(math.floor(a))",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "equal numbers do not compare as equal",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "abs(a - b) <= max(c, 1e-5)",
        "abs(a - b) < c",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "logarithm and its base exchanged",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "math.log(a, b) if a > 0.0 and b > 0.0",
        "math.log(b, a) if a > 0.0 and b > 0.0",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "exclusion without its factor of two",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "x + y - 2.0 * x * y",
        "x + y - x * y",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "overlay by the wrong one of its colours",
        "adjoint_gi/bridge/extract/color_nodes.py",
        "np.where(x < 0.5, 2.0 * x * y",
        "np.where(y < 0.5, 2.0 * x * y",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "ranges that are the wrong way round are kept so",
        "adjoint_gi/bridge/extract/color_nodes.py",
        'node.clamp_type == "RANGE" and low > high',
        'node.clamp_type == "MINMAX" and low > high',
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "a vector is a number by its first component",
        "adjoint_gi/bridge/extract/colors.py",
        "Color.of(sum(color.constant) / 3.0)",
        "Color.of(color.constant[0])",
        "tests/blender/test_extract_constants.py",
    ),
    Bug(
        "the luminance of a tinted image forgets the tint",
        "adjoint_gi/bridge/extract/color_math.py",
        "np.array(LUMINANCE) * np.array(term.constant)",
        "np.array(LUMINANCE) * np.mean(term.constant)",
        "tests/blender/test_extract_colors.py -k tinted",
    ),
    Bug(
        "the mean of alpha is that of red",
        "adjoint_gi/bridge/extract/color_math.py",
        "(m[3] if source.alpha else m[:3])",
        "(m[0] if source.alpha else m[:3])",
        "tests/blender/test_extract_colors.py -k mean_of_alpha",
    ),
    Bug(
        "spots are stretched along y as along x",
        "adjoint_gi/bridge/extract/lights.py",
        "float(lengths[1] / lengths[2]))",
        "float(lengths[0] / lengths[2]))",
        "tests/blender/test_extract_lights.py -k both_sides",
    ),
    Bug(
        "sheared lamps keep the slant of their first axis",
        "adjoint_gi/bridge/extract/lights.py",
        "x = axes[:, 0] - (axes[:, 0] @ z) * z",
        "x = axes[:, 0]",
        "tests/blender/test_extract_lights.py -k sheared",
    ),
    Bug(
        "an index below one becomes one above it",
        "adjoint_gi/bridge/extract/principled.py",
        "return adjusted if ior >= 1.0 else 1.0 / adjusted",
        "return adjusted",
        "tests/blender/test_extract_materials.py -k below_one",
    ),
    Bug(
        "the time left is that of the whole",
        "adjoint_gi/core/method/driver.py",
        "self.seconds * (1 - self.fraction) / self.fraction",
        "self.seconds / self.fraction",
        "tests/core/test_driver.py -k time_left",
    ),
    Bug(
        "scanlines of a cropped EXR count from zero",
        "adjoint_gi/core/images/exr.py",
        "rows = out[y - top : y - top + lines]",
        "rows = out[y : y + lines]",
        "tests/core/test_exr_file.py -k begin_at_zero",
    ),
    Bug(
        "nodes are means of elements whatever their areas",
        "adjoint_gi/core/elements/smooth.py",
        "self.weight = np.repeat(e.area[:, None], 4, axis=1)",
        "self.weight = np.ones((e.count, 4))",
        "tests/core/test_elements.py -k means_by_area",
    ),
    Bug(
        "large elements rule the nodes that they share with small ones",
        "adjoint_gi/core/elements/refinement.py",
        "np.repeat(1 / np.sqrt(np.maximum(e.area, 1e-300))[:, None], 4, axis=1)",
        "np.repeat(np.maximum(e.area, 1e-300)[:, None], 4, axis=1)",
        "tests/core/test_elements.py -k smaller_ones",
    ),
    Bug(
        "the longest edge of an element is its shortest",
        "adjoint_gi/core/elements/refinement.py",
        "axis=2).max(axis=1)\n",
        "axis=2).min(axis=1)\n",
        "tests/core/test_elements.py -k longest_edge",
    ),
    Bug(
        "what is unshot is left out of what it is a share of",
        "adjoint_gi/core/walks/path_limit.py",
        "/ (balance.absorbed + balance.unshot)\n",
        "/ balance.absorbed\n",
        "tests/methods/test_path_limit.py -k unshot",
    ),
    Bug(
        "repeats are not given the rays of their first pass",
        "adjoint_gi/core/comparison/budget.py",
        "rays + share * max(self.value - rays, 0.0)",
        "share * max(self.value - rays, 0.0)",
        "tests/core/test_comparison.py -k share_what_is_left",
    ),
    Bug(
        "a budget of rays gives as many samples as its time would",
        "adjoint_gi/core/comparison/effort.py",
        "share = min(share, budget.value / (rays / fraction))",
        "pass",
        "tests/core/test_comparison.py -k bounds_the_samples",
    ),
    Bug(
        "bins are dimmed for the squared cosine",
        "adjoint_gi/core/directional/bins.py",
        "np.asarray(curve(np.sqrt(1 - s).ravel()), np.float64)",
        "np.asarray(curve((1 - s).ravel()), np.float64)",
        "tests/core/test_directions.py -k dimming",
    ),
    Bug(
        "harmonics are dimmed without the cosine of the projection",
        "adjoint_gi/core/directional/harmonics.py",
        "(weight * w[:, 2] * np.asarray(curve(w[:, 2]), np.float64))[:, None]",
        "(weight * np.asarray(curve(w[:, 2]), np.float64))[:, None]",
        "tests/core/test_directions.py -k dimming",
    ),
    Bug(
        "windows end at the last band",
        "adjoint_gi/core/directional/harmonics.py",
        "np.sinc(self.l / (order + 1)) ** window",
        "np.sinc(self.l / max(order, 1)) ** window",
        "tests/core/test_harmonics.py -k lanczos",
    ),
    Bug(
        "residuals count small sides as much as large ones",
        "adjoint_gi/core/radiosity/relaxation.py",
        "return float((transport.area[:, None] * np.abs(change)).sum()) / scale if scale else 0.0",
        "return float((transport.area.mean() * np.abs(change)).sum()) / scale if scale else 0.0",
        "tests/core/test_transports.py -k mean_by_area",
    ),
    Bug(
        "shadow rays end before a face by its clearance along the ray",
        "adjoint_gi/core/scene/world.py",
        "(self.offset.take(triangle) + SHORT * distance) / np.maximum(cosine, np.float32(1e-6))",
        "(self.offset.take(triangle) + SHORT * distance)",
        "tests/core/test_precision.py -k end_before",
    ),
    Bug(
        "light that meets nothing is a leak",
        "adjoint_gi/core/walks/openness.py",
        "left = ends.escaped - (ends.emitted - count)",
        "left = ends.escaped",
        "tests/core/test_openness.py -k no_leak",
    ),
    Bug(
        "objects of tiny faces are dark where their fronts are lit",
        "adjoint_gi/core/walks/openness.py",
        "whole = np.where(back >= DARK * arrivals, back / np.maximum(arrivals, 1), 0.0)",
        "whole = np.where(back >= DARK * arrivals, 0.0, back / np.maximum(arrivals, 1))",
        "tests/core/test_openness.py -k tiny_faces",
    ),
    Bug(
        "kernels of particles without pi",
        "adjoint_gi/core/walks/particle_density.py",
        "(np.pi * max(1, particles))",
        "max(1, particles)",
        "tests/core/test_particle_density.py -k evenly",
    ),
    Bug(
        "particles round a corner count",
        "adjoint_gi/core/walks/particle_density.py",
        "self.normal[point], normal[hit]) > FACING)",
        "self.normal[point], normal[hit]) > -FACING)",
        "tests/core/test_particle_density.py -k turned_alike",
    ),
    Bug(
        "the faces of a receiver count alike whatever its points on them",
        "adjoint_gi/core/walks/particle_density.py",
        "self.share = many / np.maximum(np.bincount(owner, minlength=r.count), 1)[self.owner]",
        "self.share = np.ones(len(self.owner))",
        "tests/core/test_particle_density.py -k by_their_number",
    ),
    Bug(
        "the panel's mean counts what was not reached",
        "adjoint_gi/bridge/props/records.py",
        "solution.quantity(name)[got].mean(",
        "solution.quantity(name).mean(",
        "tests/blender/test_numbers_told.py -k panel",
    ),
    Bug(
        "escaped and unshot flux exchanged in the panel",
        "adjoint_gi/bridge/props/records.py",
        "b.absorbed, b.escaped, b.unshot, b.gap",
        "b.absorbed, b.unshot, b.escaped, b.gap",
        "tests/blender/test_numbers_told.py -k panel",
    ),
    Bug(
        "the report's means count what was not reached",
        "adjoint_gi/bridge/baking/report.py",
        "values[got].mean(axis=0",
        "values.mean(axis=0",
        "tests/blender/test_numbers_told.py -k report",
    ),
    Bug(
        "rays a second are rays times seconds",
        "adjoint_gi/bridge/baking/report.py",
        "solution.rays / solution.seconds if",
        "solution.rays * solution.seconds if",
        "tests/blender/test_numbers_told.py -k report",
    ),
    Bug(
        "depth is the distance along the ray",
        "adjoint_gi/bridge/engine/passes.py",
        "np.where(hit, points.distance, 0) * (points.towards @ forward)",
        "np.where(hit, points.distance, 0) * np.float32(-1)",
        "tests/blender/test_numbers_told.py -k depth",
    ),
    Bug(
        "a transparent film takes out all of the background at an edge",
        "adjoint_gi/bridge/engine/passes.py",
        "(behind / rays[:, None]).astype",
        "(behind / np.maximum(rays - hits, 1)[:, None]).astype",
        "tests/blender/test_numbers_told.py -k film",
    ),
    Bug(
        "a reference gets the time of one method",
        "adjoint_gi/bridge/comparison/request.py",
        "r.seconds or 4 * self.budget.seconds",
        "r.seconds or self.budget.seconds",
        "tests/blender/test_numbers_told.py -k four_times",
    ),
    Bug(
        "lightmaps side by side stand upside down",
        "adjoint_gi/bridge/comparison/request.py",
        "(rows - 1 - i // columns) * (h + gap)",
        "(i // columns) * (h + gap)",
        "tests/blender/test_numbers_told.py -k reading_order",
    ),
    Bug(
        "the error of walks is that of one batch",
        "adjoint_gi/core/flux/potential_walks.py",
        "* batches / (batches - 1)",
        "* batches**2 / (batches - 1)",
        "tests/methods/test_potential.py -k of_walks_is",
    ),
    Bug(
        "refinement may cut as many elements as it may add",
        "adjoint_gi/core/radiosity/importance.py",
        "room = max(0, GROWTH * self.base.count - self.elements.count) // 3",
        "room = max(0, GROWTH * self.base.count - self.elements.count)",
        "tests/methods/test_importance_refinement.py -k at_most",
    ),
    Bug(
        "importance is a share of the mean over elements",
        "adjoint_gi/core/radiosity/importance.py",
        "float((elements.area * potential).sum() / elements.area.sum())",
        "float(potential.mean())",
        "tests/methods/test_importance_refinement.py -k share_of_the_mean",
    ),
    Bug(
        "cached values in front of a point serve it",
        "adjoint_gi/core/walks/irradiance_records.py",
        "(error < self.accuracy) & ~ahead",
        "(error < self.accuracy)",
        "tests/methods/test_irradiance_cache.py -k index_finds",
    ),
    Bug(
        "cached values weigh by what is left of the accuracy",
        "adjoint_gi/core/walks/irradiance_records.py",
        "(1 / np.maximum(error[good], np.float32(1e-4)))",
        "(1 - error[good] / self.accuracy)",
        "tests/methods/test_irradiance_cache.py -k index_finds",
    ),
    Bug(
        "depth is a mean over rays that escape, too",
        "adjoint_gi/core/receivers/film.py",
        "depth / surface, np.inf",
        "depth / np.maximum(sites, 1), np.inf",
        "tests/core/test_film.py -k part_of",
    ),
    Bug(
        "albedo of a pixel is that of what it sees a part of",
        "adjoint_gi/core/receivers/film.py",
        "(albedo / np.maximum(sites, 1)[:, None])",
        "(albedo / np.maximum(solid, 1)[:, None])",
        "tests/core/test_film.py -k part_of",
    ),
    Bug(
        "the far plane counts from the near one",
        "adjoint_gi/core/receivers/base.py",
        "> self.camera.clip_end - self.camera.clip_start",
        "> self.camera.clip_end",
        "tests/core/test_film.py -k clipping",
    ),
    Bug(
        "the gap of a balance is a share of what is absorbed",
        "adjoint_gi/core/method/solution.py",
        "abs(lost) / self.emitted if self.emitted",
        "abs(lost) / self.absorbed if self.emitted",
        "tests/core/test_solution.py -k share_of",
    ),
    Bug(
        "light that passes by does not escape",
        "adjoint_gi/core/method/solution.py",
        "escaped=self.escaped + flux)",
        "escaped=self.escaped)",
        "tests/core/test_solution.py -k share_of",
    ),
    Bug(
        "radiosity without what is emitted",
        "adjoint_gi/core/method/solution.py",
        "return self.emitted + self.albedo * (self.direct + self.indirect)",
        "return self.albedo * (self.direct + self.indirect)",
        "tests/core/test_solution.py -k sums",
    ),
    Bug(
        "the mesh of the elements shows their backs",
        "adjoint_gi/core/elements/mesh.py",
        "nodes.values(values)[2 * corners]",
        "nodes.values(values)[2 * corners + 1]",
        "tests/core/test_elements.py -k fronts",
    ),
    Bug(
        "corners of triangles look past the middle",
        "adjoint_gi/core/elements/mesh.py",
        "np.where(elements.is_quad[element], 0.5, 1 / 3)",
        "np.where(elements.is_quad[element], 0.5, 0.5)",
        "tests/core/test_elements.py -k tenth_of",
    ),
    Bug(
        "light on elements is spread over what a wall stands on",
        "adjoint_gi/core/elements/smooth.py",
        "(e.outside[:, None], np.ones((e.count, 1)))",
        "(np.ones((e.count, 1)), np.ones((e.count, 1)))",
        "tests/core/test_inside.py -k elements",
    ),
    Bug(
        "bodies that are open stay bodies wherever the point lies",
        "adjoint_gi/core/receivers/inside.py",
        "bodies.back(world, hit, direction) & bodies.open_towards(hit, point, ng)",
        "bodies.back(world, hit, direction)",
        "tests/core/test_inside.py -k no_body",
    ),
    Bug(
        "the density of a lightmap follows the potential, not its root",
        "adjoint_gi/core/flux/density.py",
        "np.sqrt(potential / typical)",
        "potential / typical",
        "tests/core/test_density.py -k weights",
    ),
    Bug(
        "rays between elements keep only the grey of what they pass",
        "adjoint_gi/core/elements/rays.py",
        "                color[rows] *= passing.color(triangle[rows], u[rows], v[rows])",
        "                color[rows] *= np.float32(1)",
        "tests/methods/test_straight_through.py",
    ),
    Bug(
        "closed forms take sides that let light through as whole",
        "adjoint_gi/core/radiosity/factor_matrix.py",
        "            exchange = piece.exchange / (share[i] * share[j])",
        "            exchange = piece.exchange",
        "tests/methods/test_straight_through.py",
    ),
    Bug(
        "what tinted sheets take on the way of a shot is lost from the balance",
        "adjoint_gi/core/radiosity/transports.py",
        "            self.other = (share * rays[:, None]).sum(axis=0) - arrived.sum(axis=0)",
        "            self.other = np.zeros(share.shape[1])",
        "tests/methods/test_straight_through.py",
    ),
    Bug(
        "backs that are seen are baked as fronts",
        "adjoint_gi/core/receivers/base.py",
        "        return None if self.facing is None else self.facing[triangle]",
        "        return None",
        "tests/methods/test_baked_sides.py -k path_tracing",
    ),
    Bug(
        "area of particles on the front where the back is baked",
        "adjoint_gi/core/walks/particle_density.py",
        "        return self.world.surface(triangle, u, v, self.receivers.towards(triangle)), np.where(inside, 0.0, 1.0)",
        "        return self.world.surface(triangle, u, v), np.where(inside, 0.0, 1.0)",
        "tests/methods/test_baked_sides.py -k particle_tracing",
    ),
    Bug(
        "the first answer of multi-pass does not fade",
        "solvers/multi_pass.py",
        "PRIOR_SAMPLES * (1 - count / self.settings.samples)",
        "PRIOR_SAMPLES * np.ones_like(count)",
        "tests/methods/test_multi_pass.py -k pass_from",
    ),
    Bug(
        "nine of ten receivers may count nothing unsaid",
        "solvers/particle_tracing.py",
        "if empty < 0.5:",
        "if empty < 0.9:",
        "tests/methods/test_particle_tracing.py -k count_nothing",
    ),
    Bug(
        "the scale of differences is labelled in units of the quantity",
        "adjoint_gi/core/comparison/figures.py",
        'f"{100 * value / mean:+.3g}%"',
        'f"{100 * value:+.3g}%"',
        "tests/core/test_figures.py -k labelled",
    ),
    Bug(
        "the noise of a Cycles bake is the whole difference of its halves",
        "adjoint_gi/bridge/comparison/cycles_reference.py",
        "(0.25 * (values[0]",
        "(1.0 * (values[0]",
        "tests/blender/test_numbers_told.py -k cycles_bake",
    ),
    Bug(
        "planned sizes count the factor of an object once, not for both sides",
        "adjoint_gi/bridge/baking/sides.py",
        "for i in indices]) * factor**2",
        "for i in indices]) * factor",
        "tests/blender/test_numbers_told.py -k planned",
    ),
    Bug(
        "the least spacing of cached values is not their reach",
        "solvers/irradiance_cache.py",
        "s.min_spacing * size / s.accuracy",
        "s.min_spacing * size",
        "tests/methods/test_irradiance_cache.py -k reach_as_far",
    ),
    Bug(
        "cached values that reach further than they may are extrapolated as much",
        "solvers/irradiance_cache.py",
        "translation * np.minimum(1, bound / radius)",
        "translation * np.maximum(1, bound / radius)",
        "tests/methods/test_irradiance_cache.py -k below_zero",
    ),
    Bug(
        "cached values reach to where they are extrapolated below zero",
        "solvers/irradiance_cache.py",
        "np.where(slope > 0, np.minimum(radius, within), radius)",
        "np.where(slope > 0, radius, within)",
        "tests/methods/test_irradiance_cache.py -k below_zero",
    ),
    Bug(
        "cached values crowd where all is dark",
        "solvers/irradiance_cache.py",
        "np.where(slope > 0, np.minimum(radius, within), radius)",
        "np.minimum(radius, within)",
        "tests/methods/test_irradiance_cache.py -k far",
    ),
    Bug(
        "error curves are shares where percent is written",
        "adjoint_gi/bridge/comparison/request.py",
        "(p.seconds, 100 * p.error)",
        "(p.seconds, p.error)",
        "tests/blender/test_numbers_told.py -k pictures_of",
    ),
    Bug(
        "histograms end where the scale of differences does",
        "adjoint_gi/bridge/comparison/request.py",
        "histogram(errors, labels, 2 * limit)",
        "histogram(errors, labels, limit)",
        "tests/blender/test_numbers_told.py -k pictures_of",
    ),
    Bug(
        "weight of paths that survive in the dark stays as it was",
        "adjoint_gi/core/walks/paths.py",
        "            weight = weight.take(survive, axis=1) / chance",
        "            weight = weight.take(survive, axis=1) / walk.survival(strength.take(survive))",
        "tests/methods/test_path_tracing.py -k find_late",
    ),
    Bug(
        "small bodies turned inside out are baked inside",
        "adjoint_gi/core/flux/facing.py",
        " | agreed | (all_back & _inside_out(world))",
        "",
        "tests/methods/test_baked_sides.py -k small_body",
    ),
    Bug(
        "crossed faces stay crossed",
        "adjoint_gi/core/receivers/projection.py",
        "        if ring is not None:",
        "        if ring is None:",
        "tests/core/test_unwrap.py -k crossed",
    ),
    Bug(
        "holes of cut-outs hold back a fiftieth of the light between elements",
        "adjoint_gi/core/scene/passing.py",
        "        sends = np.maximum(self._rest.at(*at), self._glow.at(*at)).max(axis=1) > 0",
        "        sends = np.ones(len(high), bool)",
        "tests/methods/test_straight_through.py -k nearly_clear",
    ),
    Bug(
        "what scatters little holds back a fiftieth of the light between elements",
        "adjoint_gi/core/scene/passing.py",
        "    return capped or any(",
        "    return any(",
        "tests/methods/test_straight_through.py -k nearly_clear",
    ),
    Bug(
        "lamps beside walls are not close to them",
        "adjoint_gi/core/elements/closeness.py",
        "np.concatenate([part, spots.close])",
        "np.concatenate([part, 0 * spots.close])",
        "tests/core/test_said_of_results.py -k beside",
    ),
    Bug(
        "direction bins do not say what a longest path leaves out",
        "solvers/directional_radiosity.py",
        "                whole += term",
        "                whole += 0 * term",
        "tests/methods/test_path_limit.py -k directional",
    ),
    Bug(
        "what lies in a lantern has no light",
        "adjoint_gi/core/receivers/inside.py",
        "lantern = emits[triangles].any() and",
        "lantern = False and",
        "tests/core/test_inside.py -k lantern",
    ),
)


def plant(bug: Bug, folder: Path) -> str:
    """Run the bug's tests on a copy with the bug in it: "found", "NOT FOUND" or what went wrong."""
    copy = folder / "code"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv*", "wheels", "dist", "out", "__pycache__", "*.egg-info"))
    path = copy / bug.file
    text = path.read_text()
    if text.count(bug.right) < 1 or not bug.right:
        return "the code to break is not there any more"
    path.write_text(text.replace(bug.right, bug.wrong, 1))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *bug.tests.split()]
    result = subprocess.run(command, cwd=copy, capture_output=True, text=True, timeout=600)
    if result.returncode == 1:
        failed = [line.split(" ")[1] for line in result.stdout.splitlines() if line.startswith("FAILED")]
        return "found by " + (failed[0].split("::")[-1] if failed else "a test")
    return "NOT FOUND" if result.returncode == 0 else f"the tests did not run (exit code {result.returncode})"


def main() -> int:
    """Plant the bugs asked for; 0 when all are found."""
    wanted = [int(x) for x in sys.argv[1:]] or range(1, len(BUGS) + 1)
    missed = 0
    for number in wanted:
        bug = BUGS[number - 1]
        began = time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="adjoint_gi_bug_") as folder:
            outcome = plant(bug, Path(folder))
        missed += not outcome.startswith("found")
        print(f"{number:2d}  {bug.name:45s} {outcome}  ({time.perf_counter() - began:.0f} s)", flush=True)
    print(f"{len(list(wanted)) - missed} of {len(list(wanted))} planted bugs found")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
