# SPDX-License-Identifier: GPL-3.0-or-later
"""The step between a solve and its files that takes noise out, by Blender's own denoiser where there is an image, else by our filter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.base.errors import Notice
from ...core.denoise.ground import GridNeighbours, Ground
from ...core.denoise.images import image_denoiser
from ...core.denoise.step import Denoiser, NoisyLight, can_denoise, denoised, own_denoiser
from ...core.method.solution import Solution
from ..host import compositor
from ..props.request import BakeRequest
from .writer import Writer


def denoise(request: BakeRequest, writer: Writer, solution: Solution) -> tuple[Solution, list[Notice]]:
    """`solution` as it is written, its seams closed, and what there is to say; the same one where nothing is asked for or has noise."""
    if not (request.denoise and can_denoise(request.solver.spec)):
        return solution, []
    ground = writer.ground(solution)
    if ground is None:
        return solution, [Notice("Denoise", "leaves values on elements as they are", "", "info")]
    told: list[Notice] = []
    return writer.seamless(denoised(solution, ground, _with_blender(ground, told))), told


def _with_blender(ground: Ground, told: list[Notice]) -> Denoiser:
    """Blender's denoiser for images, ours where there is none, which `told` says then."""
    own = own_denoiser(ground)
    if not isinstance(ground.neighbours, GridNeighbours):
        return own
    by_blender = image_denoiser(ground, compositor.denoise, np.random.default_rng(0))

    def denoise(layers: Sequence[NoisyLight]) -> list[np.ndarray]:
        try:
            return by_blender(layers)
        except compositor.NoDenoiser as error:
            told.append(Notice("Denoise", f"Blender's denoiser cannot be used ({error}), so a filter of Adjoint GI's own was", "", "info"))
            return own(layers)

    return denoise
