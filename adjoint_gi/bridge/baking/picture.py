# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes of the camera's picture: an EXR with all passes, and a PNG to look at."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ...core.denoise.ground import Ground, pixel_ground
from ...core.method.solution import Solution
from ...core.receivers.base import CameraReceivers
from ...core.receivers.film import read_surfaces
from ..engine.pictures import write_picture
from ..host.preparation import Aside, Stages, once
from . import outputs
from .writer import Writer


class PictureWriter(Writer):
    """Two files; while the solve runs there is nowhere to write to."""

    needs_folder = True

    def placing(self) -> Stages[None]:
        """The pixels of the camera."""
        self.transparent = bool(bpy.context.scene.render.film_transparent)
        self.receivers = yield Aside("Placing pixels", once(lambda: CameraReceivers(self.world)))

    def ground(self, solution: Solution) -> Ground:
        """The pixels, as the surfaces that are seen guide the denoiser."""
        if not {"normal", "depth"} <= solution.extra.keys():
            seen: dict[str, np.ndarray] = {}
            for _ in read_surfaces(self.world, self.receivers, seen):  # a result that was stopped has not come to it
                pass
            return pixel_ground(self.receivers, seen["normal"], seen["depth"], seen["albedo"])
        return pixel_ground(self.receivers, solution.extra["normal"], solution.extra["depth"], solution.albedo)

    def write(self, solution: Solution, folder: Path | None) -> tuple[list[str], list[Path]]:
        """Both files: see the class."""
        if folder is None:
            return [], []
        stem, spec = outputs.stem(self.request, self.scene_name, solution.partial), self.request.solver.spec
        return [], write_picture(spec, self.receivers, solution, self.transparent, folder, stem, self.metadata(solution))
