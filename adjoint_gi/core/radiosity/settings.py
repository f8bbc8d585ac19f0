"""Settings of every method on elements."""

from __future__ import annotations

from dataclasses import dataclass

from ..base import settings as base
from ..method import common_settings as common


@dataclass(frozen=True)
class RadiositySettings(base.Settings):
    """Settings of every radiosity method. The seed has no effect on those that are deterministic."""

    max_length: int = common.max_length("Longest light path that counts: 1 is direct light only, 2 adds one bounce; 1024 is no limit")
    max_edge: float = common.max_edge()
    direct_light: str = common.direct_light()
    light_samples: int = common.light_samples(
        8,
        "Points on lights, and rays to the background, for each receiver point, two at least: their noise is measured. "
        "Each element takes four times as many",
    )
