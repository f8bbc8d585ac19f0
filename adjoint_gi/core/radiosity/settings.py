"""Settings of every method on elements."""

from __future__ import annotations

from dataclasses import dataclass

from ..base import settings as base
from ..base.settings import NO_LIMIT, setting


@dataclass(frozen=True)
class RadiositySettings(base.Settings):
    """Settings of every radiosity method. The seed has no effect: these methods are deterministic."""

    max_length: int = setting(
        NO_LIMIT,
        label="Max Path Length",
        help="Longest light path that counts: 1 is direct light only, 2 adds one bounce; 1024 is no limit",
        min=0,
        max=NO_LIMIT,
        soft_max=64,
    )
    max_edge: float = setting(
        0.0,
        label="Max Element Edge",
        help="Longest edge of the elements that faces are cut into; 0 chooses it",
        min=0.0,
        max=1e6,
        unit="distance",
    )
    direct_light: str = setting(
        "receivers",
        label="Direct Light",
        help="Where light that comes straight from lamps, background and emitting faces is evaluated in the result",
        choices=(
            ("receivers", "At Receivers", "At every texel, vertex or pixel, so that shadows are sharp; not part of the original method"),
            ("elements", "On Elements", "On the elements, as in the paper: shadows are as sharp as the elements are small"),
        ),
    )
    light_samples: int = setting(
        8,
        label="Light Samples",
        help="Points on lights, and rays to the background, for each receiver point; each element takes four times as many",
        min=1,
        max=4096,
        soft_max=64,
    )
