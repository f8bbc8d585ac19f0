# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera pictures as files: one OpenEXR with all passes, and a PNG to look at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...core.base.color import luminance
from ...core.images.exr import write_exr
from ...core.images.png import write_png
from ...core.method.registry import MethodSpec
from ...core.method.solution import Solution
from ...core.receivers.base import CameraReceivers
from ..host import files
from .passes import Geometry, pixels


def exposure(values: np.ndarray) -> float:
    """A whole number of stops (as a factor) that brings the bright parts of `values` (n, 3) below 1; 1 where they are about right."""
    found = luminance(values.reshape(-1, values.shape[-1])[:, :3])
    found = found[found > 0]
    if not len(found):
        return 1.0
    bright = float(np.percentile(found, 95))
    return 1.0 if 0.25 <= bright <= 1.0 else float(2.0 ** -np.ceil(np.log2(bright)))


def write_picture(
    spec: MethodSpec,
    receivers: CameraReceivers,
    solution: Solution,
    transparent: bool,
    folder: Path,
    stem: str,
    metadata: Mapping[str, str],
) -> list[Path]:
    """Write STEM.exr and STEM.png of a camera `solution` into `folder`; returns both paths. Raises TargetError or WriteError."""
    passes = pixels(spec, solution, Geometry.of(receivers.world, receivers), transparent)
    layers = {name: np.asarray(values, np.float32).reshape(receivers.height, receivers.width, -1) for name, values in passes.items()}
    combined = layers.pop("Combined")
    picture, look = (files.output_file(folder, stem, suffix) for suffix in (".exr", ".png"))
    write_exr(picture, combined, layers, folder=folder, metadata=metadata)
    factor = exposure(combined[..., :3])
    shown = combined * np.array([factor, factor, factor, 1], np.float32)
    write_png(look, shown if transparent else shown[..., :3], folder=folder)
    return [picture, look]
