# SPDX-License-Identifier: GPL-3.0-or-later
"""Our OpenEXR files read back as layers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from adjgi.adjoint_gi.core.images import exr


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Layers by name ("" is the picture) as (h, w, c) float32, row 0 at the bottom, and our metadata."""
    channels, header = exr.read_channels(Path(path))
    layers: dict[str, dict[str, np.ndarray]] = {}
    for name, values in channels.items():
        layer, _, letter = name.rpartition(".")
        layers.setdefault(layer, {})[letter] = values
    out = {}
    for layer, parts in layers.items():
        letters = next((text for text in exr.LETTERS.values() if set(text) == set(parts)), "".join(sorted(parts)))
        out[layer] = np.ascontiguousarray(np.stack([parts[x] for x in letters], axis=-1)[::-1])
    return out, {k.removeprefix("adjoint_gi."): v for k, v in header.items() if k.startswith("adjoint_gi.")}
